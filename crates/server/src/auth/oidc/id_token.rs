//! An ID token: a signed document in which the provider identifies the signed-in user (OpenID
//! Connect Core, 2 and 3.1.3.7). A token is valid if a key of the provider signed it, for this
//! server, now, and for this attempt.

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use serde_json::{Map, Value};
use subtle::ConstantTimeEq as _;

use super::keys::{Algorithm, KeySet};

/// Maximum size of a token.
const MAX_TOKEN_BYTES: usize = 64 * 1024;
/// Maximum length of a subject (OpenID Connect Core, 2).
const MAX_SUBJECT_BYTES: usize = 255;
/// Permitted difference of the provider's clock.
const SKEW_S: f64 = 60.0;

/// The reason for rejecting a token.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum IdTokenError {
    /// The text is not a token.
    #[error("not a signed JWT")]
    Malformed,
    /// The signature's algorithm proves nothing, or is not supported.
    #[error("the algorithm is neither RS256 nor ES256")]
    Algorithm,
    /// None of the provider's keys made the signature.
    #[error("none of the provider's keys made the signature")]
    Signature,
    /// A claim has an unexpected value.
    #[error("{claim}: {reason}")]
    Claim { claim: &'static str, reason: &'static str },
}

/// The claims that a token must contain.
pub(super) struct Expected<'a> {
    pub(super) issuer: &'a str,
    pub(super) client_id: &'a str,
    pub(super) nonce: &'a str,
    pub(super) now_ms: u64,
}

/// A token that is not yet verified.
pub(super) struct IdToken<'a> {
    key_id: Option<String>,
    algorithm: Algorithm,
    signed: &'a str,
    payload: &'a str,
    signature: Vec<u8>,
}

impl<'a> IdToken<'a> {
    pub(super) fn parse(text: &'a str) -> Result<Self, IdTokenError> {
        if text.len() > MAX_TOKEN_BYTES {
            return Err(IdTokenError::Malformed);
        }
        let (signed, signature) = text.rsplit_once('.').ok_or(IdTokenError::Malformed)?;
        let (header, payload) = signed.split_once('.').ok_or(IdTokenError::Malformed)?;
        let signature = URL_SAFE_NO_PAD.decode(signature).map_err(|_| IdTokenError::Malformed)?;
        let header = object(header)?;
        // Extensions are not supported, whatever they mean (RFC 7515, 4.1.11).
        if header.contains_key("crit") {
            return Err(IdTokenError::Malformed);
        }
        let name = header.get("alg").and_then(Value::as_str).unwrap_or_default();
        let algorithm = Algorithm::by_name(name).ok_or(IdTokenError::Algorithm)?;
        let key_id = header.get("kid").and_then(Value::as_str).map(str::to_owned);
        Ok(Self { key_id, algorithm, signed, payload, signature })
    }

    /// Whether the set contains the key that the token names.
    pub(super) fn has_key_in(&self, keys: &KeySet) -> bool {
        keys.has(self.key_id.as_deref(), self.algorithm)
    }

    /// The claims, if the token is valid.
    pub(super) fn verify(
        &self,
        keys: &KeySet,
        expected: &Expected<'_>,
    ) -> Result<Claims, IdTokenError> {
        if !keys.verifies(
            self.key_id.as_deref(),
            self.algorithm,
            self.signed.as_bytes(),
            &self.signature,
        ) {
            return Err(IdTokenError::Signature);
        }
        let claims = Claims(object(self.payload)?);
        claims.check(expected)?;
        Ok(claims)
    }
}

fn object(part: &str) -> Result<Map<String, Value>, IdTokenError> {
    let bytes = URL_SAFE_NO_PAD.decode(part).map_err(|_| IdTokenError::Malformed)?;
    serde_json::from_slice(&bytes).map_err(|_| IdTokenError::Malformed)
}

/// The claims of a verified token.
#[derive(Debug, Clone, PartialEq)]
pub struct Claims(Map<String, Value>);

impl Claims {
    /// The user's identifier at the provider: never reassigned there, unlike a name or an address.
    pub fn subject(&self) -> &str {
        self.text("sub").unwrap_or_default()
    }

    /// A claim by its name, or by its path, like `realm_access.roles`.
    pub fn get(&self, name: &str) -> Option<&Value> {
        self.0.get(name).or_else(|| {
            let mut path = name.split('.');
            let first = self.0.get(path.next()?)?;
            path.try_fold(first, |value, key| value.get(key))
        })
    }

    /// Whether the claim equals this value, or is a list that contains it.
    pub fn has(&self, name: &str, value: &str) -> bool {
        let is_value = |found: &Value| match found {
            Value::String(text) => text == value,
            Value::Bool(yes) => value == if *yes { "true" } else { "false" },
            _ => false,
        };
        match self.get(name) {
            Some(Value::Array(values)) => values.iter().any(is_value),
            Some(found) => is_value(found),
            None => false,
        }
    }

    fn text(&self, name: &str) -> Option<&str> {
        self.0.get(name).and_then(Value::as_str)
    }

    fn check(&self, expected: &Expected<'_>) -> Result<(), IdTokenError> {
        let wrong = |claim, reason| Err(IdTokenError::Claim { claim, reason });
        if self.text("iss") != Some(expected.issuer) {
            return wrong("iss", "unexpected issuer");
        }
        let audiences: Vec<&str> = match self.0.get("aud") {
            Some(Value::String(one)) => vec![one],
            Some(Value::Array(several)) => several.iter().filter_map(Value::as_str).collect(),
            _ => Vec::new(),
        };
        if !audiences.contains(&expected.client_id) {
            return wrong("aud", "issued for another client");
        }
        match self.text("azp") {
            Some(client) if client != expected.client_id => {
                return wrong("azp", "issued to another client");
            }
            None if audiences.len() > 1 => {
                return wrong("azp", "missing, although there are several audiences");
            }
            _ => {}
        }
        let now_s = expected.now_ms as f64 / 1000.0;
        let time = |name: &str| self.0.get(name).and_then(Value::as_f64);
        match time("exp") {
            Some(ends_s) if now_s < ends_s + SKEW_S => {}
            _ => return wrong("exp", "expired"),
        }
        match time("iat") {
            Some(made_s) if made_s <= now_s + SKEW_S => {}
            _ => return wrong("iat", "issued in the future"),
        }
        if time("nbf").is_some_and(|begins_s| now_s + SKEW_S < begins_s) {
            return wrong("nbf", "not valid yet");
        }
        let nonce = self.text("nonce").unwrap_or_default();
        if !bool::from(nonce.as_bytes().ct_eq(expected.nonce.as_bytes())) {
            return wrong("nonce", "belongs to another sign-in attempt");
        }
        let subject = self.subject();
        let is_subject = (1..=MAX_SUBJECT_BYTES).contains(&subject.len());
        if !is_subject || !subject.bytes().all(|byte| (b' '..=b'~').contains(&byte)) {
            return wrong("sub", "expected 1 to 255 printable ASCII characters");
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use ring::rand::SystemRandom;
    use ring::signature::{ECDSA_P256_SHA256_FIXED_SIGNING, EcdsaKeyPair, KeyPair as _};
    use serde_json::json;

    use super::*;

    const NOW_S: u64 = 1_800_000_000;
    const EXPECTED: Expected<'_> = Expected {
        issuer: "https://id.example",
        client_id: "taskd",
        nonce: "n",
        now_ms: NOW_S * 1000,
    };

    /// A provider's key and the set in which it is published.
    struct Signer {
        pair: EcdsaKeyPair,
        keys: KeySet,
    }

    impl Signer {
        fn new() -> Self {
            let random = SystemRandom::new();
            let document = EcdsaKeyPair::generate_pkcs8(&ECDSA_P256_SHA256_FIXED_SIGNING, &random)
                .expect("a key");
            let pair = EcdsaKeyPair::from_pkcs8(
                &ECDSA_P256_SHA256_FIXED_SIGNING,
                document.as_ref(),
                &random,
            );
            let pair = pair.expect("a key");
            let point = pair.public_key().as_ref();
            let (x, y) =
                (URL_SAFE_NO_PAD.encode(&point[1..33]), URL_SAFE_NO_PAD.encode(&point[33..]));
            let key = json!({ "kty": "EC", "crv": "P-256", "kid": "k", "x": x, "y": y });
            Self { pair, keys: KeySet::read(&json!({ "keys": [key] })) }
        }

        fn sign(&self, header: &Value, claims: &Value) -> String {
            let part = |value: &Value| URL_SAFE_NO_PAD.encode(value.to_string());
            let signed = format!("{}.{}", part(header), part(claims));
            let signature = self.pair.sign(&SystemRandom::new(), signed.as_bytes()).expect("signs");
            format!("{signed}.{}", URL_SAFE_NO_PAD.encode(signature))
        }

        fn verified(&self, token: &str) -> Result<Claims, IdTokenError> {
            IdToken::parse(token)?.verify(&self.keys, &EXPECTED)
        }
    }

    fn header() -> Value {
        json!({ "alg": "ES256", "kid": "k" })
    }

    fn claims() -> Value {
        json!({
            "iss": "https://id.example", "aud": "taskd", "sub": "248289761001", "nonce": "n",
            "iat": NOW_S, "exp": NOW_S + 300,
        })
    }

    #[test]
    fn id_token_is_accepted_only_if_every_claim_is_valid() {
        let signer = Signer::new();
        let claims_with = |changes: Value| {
            let mut claims = claims();
            for (key, value) in changes.as_object().expect("an object") {
                claims[key] = value.clone();
            }
            claims
        };
        for good in [
            json!({}),
            json!({ "aud": ["taskd"] }),
            json!({ "aud": ["other", "taskd"], "azp": "taskd" }),
            json!({ "exp": NOW_S - 59, "iat": NOW_S + 59, "nbf": NOW_S + 59 }),
            json!({ "exp": NOW_S as f64 + 0.5 }),
        ] {
            let verified = signer.verified(&signer.sign(&header(), &claims_with(good.clone())));
            assert_eq!(verified.expect("valid").subject(), "248289761001", "{good}");
        }
        for (claim, bad) in [
            ("iss", json!({ "iss": "https://id.example/" })),
            ("iss", json!({ "iss": null })),
            ("aud", json!({ "aud": "other" })),
            ("aud", json!({ "aud": [] })),
            ("aud", json!({ "aud": null })),
            ("azp", json!({ "aud": ["taskd", "other"] })),
            ("azp", json!({ "azp": "other" })),
            ("exp", json!({ "exp": NOW_S - 60 })),
            ("exp", json!({ "exp": null })),
            ("exp", json!({ "exp": "tomorrow" })),
            ("iat", json!({ "iat": NOW_S + 61 })),
            ("iat", json!({ "iat": null })),
            ("nbf", json!({ "nbf": NOW_S + 61 })),
            ("nonce", json!({ "nonce": "other" })),
            ("nonce", json!({ "nonce": null })),
            ("sub", json!({ "sub": "" })),
            ("sub", json!({ "sub": 7 })),
            ("sub", json!({ "sub": "a\nb" })),
            ("sub", json!({ "sub": "x".repeat(256) })),
        ] {
            let refused = signer
                .verified(&signer.sign(&header(), &claims_with(bad.clone())))
                .expect_err(claim);
            assert!(
                matches!(refused, IdTokenError::Claim { claim: found, .. } if found == claim),
                "{bad}: {refused}"
            );
        }
    }

    #[test]
    fn id_token_without_a_valid_signature_is_refused() {
        let (signer, other) = (Signer::new(), Signer::new());
        let good = signer.sign(&header(), &claims());
        let (signed, signature) = good.rsplit_once('.').expect("parts");
        assert_eq!(
            signer.verified(&other.sign(&header(), &claims())),
            Err(IdTokenError::Signature)
        );
        let admin = URL_SAFE_NO_PAD.encode(json!({ "groups": ["admins"] }).to_string());
        let forged = format!("{}.{admin}.{signature}", signed.split_once('.').expect("parts").0);
        assert_eq!(signer.verified(&forged), Err(IdTokenError::Signature));
        assert_eq!(signer.verified(&format!("{signed}.")), Err(IdTokenError::Signature));
        let unknown = json!({ "alg": "ES256", "kid": "other" });
        assert_eq!(
            signer.verified(&signer.sign(&unknown, &claims())),
            Err(IdTokenError::Signature)
        );
        for alg in ["none", "HS256", "RS512", ""] {
            let token = signer.sign(&json!({ "alg": alg, "kid": "k" }), &claims());
            assert_eq!(signer.verified(&token), Err(IdTokenError::Algorithm), "{alg}");
        }
        // A public key is not secret, so a token must not be signed with it.
        assert_eq!(
            signer.verified(&signer.sign(&json!({ "alg": "RS256" }), &claims())),
            Err(IdTokenError::Signature)
        );
        let critical = json!({ "alg": "ES256", "kid": "k", "crit": ["exp"] });
        assert_eq!(
            signer.verified(&signer.sign(&critical, &claims())),
            Err(IdTokenError::Malformed)
        );
        for bad in
            ["", "a", "a.b", "a.b.c", "..", &format!("{good}.x"), &"x".repeat(MAX_TOKEN_BYTES + 1)]
        {
            assert_eq!(signer.verified(bad), Err(IdTokenError::Malformed), "{bad:.40}");
        }
    }

    #[test]
    fn claims_are_found_by_name_and_by_path() {
        let value = json!({
            "groups": ["a", "b"], "email_verified": true, "department": "lab",
            "realm_access": { "roles": ["admin"] }, "https://example.org/roles": ["x"], "level": 3,
        });
        let Value::Object(map) = value else { panic!("an object") };
        let claims = Claims(map);
        let found = [
            ("groups", "b"),
            ("email_verified", "true"),
            ("department", "lab"),
            ("realm_access.roles", "admin"),
            ("https://example.org/roles", "x"),
        ];
        for (name, value) in found {
            assert!(claims.has(name, value), "{name}");
        }
        for (name, value) in
            [("groups", "c"), ("groups", ""), ("level", "3"), ("realm_access", "admin"), ("", "")]
        {
            assert!(!claims.has(name, value), "{name}");
        }
    }
}
