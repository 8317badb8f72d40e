//! The provider's public keys (RFC 7517), and verification of signatures: RSA or ECDSA on P-256,
//! each with SHA-256. A key is only ever used for its own algorithm.

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use ring::signature::{
    ECDSA_P256_SHA256_FIXED, RSA_PKCS1_2048_8192_SHA256, RsaPublicKeyComponents, UnparsedPublicKey,
};
use serde_json::Value;

/// Maximum number of keys that are read.
const MAX_KEYS: usize = 64;
/// Length of a coordinate of a point on P-256, in bytes.
const COORDINATE_BYTES: usize = 32;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Algorithm {
    Rs256,
    Es256,
}

impl Algorithm {
    /// The algorithm by its name in a token; `none` and algorithms with a shared secret are not
    /// supported.
    pub(super) fn by_name(name: &str) -> Option<Self> {
        match name {
            "RS256" => Some(Self::Rs256),
            "ES256" => Some(Self::Es256),
            _ => None,
        }
    }
}

#[derive(Clone)]
pub(super) struct KeySet(Vec<Key>);

#[derive(Clone)]
struct Key {
    id: Option<String>,
    public: Public,
}

#[derive(Clone)]
enum Public {
    Rsa { modulus: Vec<u8>, exponent: Vec<u8> },
    P256 { point: Vec<u8> },
}

impl KeySet {
    /// The document's keys for supported signatures; others are ignored.
    pub(super) fn read(document: &Value) -> Self {
        let keys = document["keys"].as_array().map(Vec::as_slice).unwrap_or_default();
        Self(keys.iter().take(MAX_KEYS).filter_map(parse_key).collect())
    }

    /// Whether there is a key of this id for the algorithm.
    pub(super) fn has(&self, id: Option<&str>, algorithm: Algorithm) -> bool {
        self.candidates(id, algorithm).next().is_some()
    }

    /// Whether the key of this id, or any key if there is no id, made the signature.
    pub(super) fn verifies(
        &self,
        id: Option<&str>,
        algorithm: Algorithm,
        message: &[u8],
        signature: &[u8],
    ) -> bool {
        self.candidates(id, algorithm).any(|key| key.public.verifies(message, signature))
    }

    fn candidates(&self, id: Option<&str>, algorithm: Algorithm) -> impl Iterator<Item = &Key> {
        let has_id = move |key: &&Key| id.is_none() || key.id.as_deref() == id;
        self.0.iter().filter(move |key| key.public.algorithm() == algorithm).filter(has_id)
    }
}

impl Public {
    fn algorithm(&self) -> Algorithm {
        match self {
            Self::Rsa { .. } => Algorithm::Rs256,
            Self::P256 { .. } => Algorithm::Es256,
        }
    }

    fn verifies(&self, message: &[u8], signature: &[u8]) -> bool {
        match self {
            Self::Rsa { modulus, exponent } => {
                let key = RsaPublicKeyComponents { n: modulus, e: exponent };
                key.verify(&RSA_PKCS1_2048_8192_SHA256, message, signature).is_ok()
            }
            Self::P256 { point } => UnparsedPublicKey::new(&ECDSA_P256_SHA256_FIXED, point)
                .verify(message, signature)
                .is_ok(),
        }
    }
}

fn parse_key(key: &Value) -> Option<Key> {
    let text = |name: &str| key[name].as_str();
    let number = |name: &str| URL_SAFE_NO_PAD.decode(text(name)?.trim_end_matches('=')).ok();
    if text("use").is_some_and(|purpose| purpose != "sig") {
        return None;
    }
    let public = match text("kty")? {
        "RSA" => Public::Rsa {
            modulus: without_leading_zeros(number("n")?),
            exponent: without_leading_zeros(number("e")?),
        },
        "EC" if text("crv") == Some("P-256") => {
            let (x, y) = (number("x")?, number("y")?);
            if (x.len(), y.len()) != (COORDINATE_BYTES, COORDINATE_BYTES) {
                return None;
            }
            Public::P256 { point: [&[4], x.as_slice(), &y].concat() }
        }
        _ => return None,
    };
    if text("alg").is_some_and(|name| Algorithm::by_name(name) != Some(public.algorithm())) {
        return None;
    }
    Some(Key { id: text("kid").map(str::to_owned), public })
}

/// Removes leading zeros, which some providers write.
fn without_leading_zeros(bytes: Vec<u8>) -> Vec<u8> {
    bytes.into_iter().skip_while(|byte| *byte == 0).collect()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// A key made by another library, and its signature of "taskd". The number has a leading zero.
    const MODULUS: &str = "AMQuNJDfmwJ5gOo1I5qkpJlO-UAI7qEUDpLyXXVA9x2sUyVesowaz0BGCX2D9ABHuWY76W-j8QT1oJZTV7dFPKR7_LlHgY55KR8L\
         VQeIfGaKpCZez_0GXo8FNf755GJO3Sq5dDCgGDRSmCmkADvczU7JbTDMtw03cRe94-WZOOpeH6FLD86yb_nzBHazBLbQlcddbiCp\
         cg8iCjvzAx0-S0V4-uSEpAwBkVwB9KAV-U-UNA6nn-7vO2R-1I_Gy8YL4FqQpg4RImBbfBO14k7QbvWwTxSUNa0YMWPJxzX3AQXp\
         T5PqPBlN6hiSndKJFz_v7_Q2ssLrdhJEaOyCvCw6f-U";
    const SIGNATURE: &str = "nFShdw1-L2gi24R9YyIzFXZB8gUl7ShQmV2xG2KvAaOHZZT4O7s6EDklXd5_PBaWgspGimxPUPdEm3KYRc0Fd_oPdYl7yylJRH3e\
         m07xaIPoaQUJ4xwJ-7G58WvvV2yElTpzS3aFG3pjO3A2D8L7pZC10ExRUySa_ba7G2gaAaVrwSiqxPXbR8H7pBkJ5I2mPp113-bT\
         I44KKNlcwMWmuBbivrzv7UyWZ4-eWS-W4bvUIl7R02UcRVAb9fdKLvlbcH30stpWAqUT5-KljsYYs6Zi44wLp-9m_0Sk_VQdUjbp\
         hBQn6A6ZrmYmK_ehHsYCZ-kOtXmuKPtndUFwlDmVnQ";

    #[test]
    fn signature_binds_key_text_and_algorithm() {
        let set = KeySet::read(
            &json!({ "keys": [{ "kty": "RSA", "kid": "k", "n": MODULUS, "e": "AQAB" }] }),
        );
        let signature = URL_SAFE_NO_PAD.decode(SIGNATURE).expect("base64");
        assert!(set.verifies(Some("k"), Algorithm::Rs256, b"taskd", &signature));
        assert!(set.verifies(None, Algorithm::Rs256, b"taskd", &signature));
        assert!(!set.verifies(Some("other"), Algorithm::Rs256, b"taskd", &signature));
        assert!(!set.verifies(Some("k"), Algorithm::Es256, b"taskd", &signature));
        assert!(!set.verifies(Some("k"), Algorithm::Rs256, b"taske", &signature));
        assert!(!set.verifies(Some("k"), Algorithm::Rs256, b"taskd", &signature[1..]));
    }

    #[test]
    fn keys_for_unsupported_signatures_are_ignored() {
        let (n, e, x) = ("AQAB".repeat(8), "AQAB", URL_SAFE_NO_PAD.encode([1; 32]));
        let set = KeySet::read(&json!({ "keys": [
            { "kty": "RSA", "kid": "rsa", "n": n, "e": e },
            { "kty": "RSA", "kid": "encrypts", "use": "enc", "n": n, "e": e },
            { "kty": "RSA", "kid": "pss", "alg": "PS256", "n": n, "e": e },
            { "kty": "EC", "kid": "ec", "alg": "ES256", "use": "sig", "crv": "P-256", "x": x, "y": x },
            { "kty": "EC", "kid": "short", "crv": "P-256", "x": "AQAB", "y": x },
            { "kty": "EC", "kid": "other", "crv": "P-384", "x": x, "y": x },
            { "kty": "oct", "kid": "shared", "k": "AQAB" },
            "nonsense",
        ] }));
        let ids: Vec<_> = set.0.iter().map(|key| key.id.as_deref().expect("named")).collect();
        assert_eq!(ids, ["rsa", "ec"]);
        assert!(set.has(Some("rsa"), Algorithm::Rs256) && set.has(None, Algorithm::Es256));
        assert!(!set.has(Some("rsa"), Algorithm::Es256), "a key is for one algorithm");
        for nothing in [json!(null), json!({}), json!({ "keys": "x" })] {
            assert!(!KeySet::read(&nothing).has(None, Algorithm::Rs256));
        }
        for name in ["none", "HS256", "RS512", "rs256", ""] {
            assert_eq!(Algorithm::by_name(name), None, "{name}");
        }
    }
}
