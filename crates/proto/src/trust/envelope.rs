//! DSSE envelopes (Dead Simple Signing Envelope, protocol v1.0.2) over ed25519: how desired states,
//! packages and lists of publishers are signed. A payload is read with [`Envelope::open`] or
//! [`Envelope::signers`], which verify first.

use std::fmt;
use std::str::FromStr;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use ed25519_dalek::{Signature, Signer as _};
use serde::{Deserialize, Serialize};

use crate::Digest;

/// The most keys in a role of a signed document.
pub const MAX_KEYS: usize = 16;
/// The payload type of a signed [`crate::desired::DesiredState`].
pub const DESIRED_STATE_TYPE: &str = "application/vnd.taskd.desired.v1+json";

/// A signed payload: JSON `{"payload": base64, "payloadType": text, "signatures": [{"keyid", "sig":
/// base64}]}`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Envelope {
    payload: String,
    #[serde(rename = "payloadType")]
    payload_type: String,
    signatures: Vec<EnvelopeSignature>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
struct EnvelopeSignature {
    #[serde(default)]
    keyid: String,
    sig: String,
}

/// Why an envelope was not opened.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EnvelopeError {
    /// The payload is of another type than expected.
    #[error("payload is {found:?}, expected {expected:?}")]
    WrongType {
        /// The type in the envelope.
        found: String,
        /// The type that the caller expected.
        expected: &'static str,
    },
    /// A base64 field does not decode.
    #[error("envelope field {0} is not base64")]
    Encoding(&'static str),
    /// No signature is by the pinned key.
    #[error("no valid signature by key {0}")]
    NotSigned(String),
    /// The envelope already has the maximum number of signatures.
    #[error("it has {MAX_SIGNATURES} signatures already")]
    TooManySignatures,
}

impl Envelope {
    /// Signs `payload`.
    pub fn seal(payload_type: &'static str, payload: &[u8], key: &SigningKey) -> Self {
        let sig = key.0.sign(&pre_authentication_encoding(payload_type, payload));
        Self {
            payload: STANDARD.encode(payload),
            payload_type: payload_type.to_owned(),
            signatures: vec![EnvelopeSignature {
                keyid: key.public_key().id(),
                sig: STANDARD.encode(sig.to_bytes()),
            }],
        }
    }

    /// An envelope without signatures.
    pub fn unsigned(payload_type: &'static str, payload: &[u8]) -> Self {
        Self {
            payload: STANDARD.encode(payload),
            payload_type: payload_type.to_owned(),
            signatures: Vec::new(),
        }
    }

    /// Adds a signature of the same payload by another key; a key that has already signed is not
    /// added again.
    pub fn add_signature(
        &mut self,
        expected: &'static str,
        key: &SigningKey,
    ) -> Result<(), EnvelopeError> {
        let payload = self.unverified_payload(expected)?;
        if self.has_signed(&pre_authentication_encoding(expected, &payload), &key.public_key()) {
            return Ok(());
        }
        if self.signatures.len() >= MAX_SIGNATURES {
            return Err(EnvelopeError::TooManySignatures);
        }
        self.signatures.extend(Self::seal(expected, &payload, key).signatures);
        Ok(())
    }

    /// The payload, after verification of a signature by `key`. Key ids are hints only and are not
    /// trusted.
    pub fn open(&self, expected: &'static str, key: &PublicKey) -> Result<Vec<u8>, EnvelopeError> {
        let payload = self.unverified_payload(expected)?;
        let signed = self.has_signed(&pre_authentication_encoding(expected, &payload), key);
        if signed { Ok(payload) } else { Err(EnvelopeError::NotSigned(key.id())) }
    }

    /// The payload, and those of `keys` that have signed it, in the order of `keys` and without
    /// duplicates; possibly none.
    pub fn signers<'a>(
        &self,
        expected: &'static str,
        keys: &'a [PublicKey],
    ) -> Result<(Vec<u8>, Vec<&'a PublicKey>), EnvelopeError> {
        let payload = self.unverified_payload(expected)?;
        let message = pre_authentication_encoding(expected, &payload);
        let mut signers: Vec<&PublicKey> = Vec::new();
        for key in keys {
            if !signers.contains(&key) && self.has_signed(&message, key) {
                signers.push(key);
            }
        }
        Ok((payload, signers))
    }

    /// The payload as received, to show, sign or pass on. It proves nothing.
    pub fn unverified_payload(&self, expected: &'static str) -> Result<Vec<u8>, EnvelopeError> {
        if self.payload_type != expected {
            return Err(EnvelopeError::WrongType {
                found: self.payload_type.chars().take(80).collect(),
                expected,
            });
        }
        STANDARD.decode(&self.payload).map_err(|_| EnvelopeError::Encoding("payload"))
    }

    /// The key ids claimed by the signatures, not verified.
    pub fn claimed_signers(&self) -> impl Iterator<Item = &str> {
        self.signatures.iter().take(MAX_SIGNATURES).map(|signature| signature.keyid.as_str())
    }

    /// Whether one of the signatures is by `key`. A signature that names another key is not tried,
    /// because each verification costs time.
    fn has_signed(&self, message: &[u8], key: &PublicKey) -> bool {
        let id = key.id();
        let may_be =
            |signature: &&EnvelopeSignature| signature.keyid.is_empty() || signature.keyid == id;
        self.signatures.iter().take(MAX_SIGNATURES).filter(may_be).any(|signature| {
            STANDARD
                .decode(&signature.sig)
                .ok()
                .and_then(|sig| Signature::from_slice(&sig).ok())
                .is_some_and(|sig| key.0.verify_strict(message, &sig).is_ok())
        })
    }
}

/// The most signatures that we examine, because each costs a verification. A list of publishers
/// that hands over to a full set of new keepers may need signatures by all old and all new keepers.
const MAX_SIGNATURES: usize = 2 * MAX_KEYS;

/// DSSE's `PAE(type, body)`: "DSSEv1", then each field's length and bytes, separated by single
/// spaces.
fn pre_authentication_encoding(payload_type: &str, payload: &[u8]) -> Vec<u8> {
    let mut encoded =
        format!("DSSEv1 {} {payload_type} {} ", payload_type.len(), payload.len()).into_bytes();
    encoded.extend_from_slice(payload);
    encoded
}

/// An ed25519 private key.
pub struct SigningKey(ed25519_dalek::SigningKey);

impl SigningKey {
    /// A fresh key from the operating system's random generator.
    pub fn random() -> Self {
        Self::from_bytes(rand::random())
    }

    /// From its 32-byte seed.
    pub fn from_bytes(seed: [u8; 32]) -> Self {
        Self(ed25519_dalek::SigningKey::from_bytes(&seed))
    }

    /// The 32-byte seed, to be stored with mode 0600.
    pub fn to_bytes(&self) -> [u8; 32] {
        self.0.to_bytes()
    }

    /// The key that verifies.
    pub fn public_key(&self) -> PublicKey {
        PublicKey(self.0.verifying_key())
    }
}

/// An ed25519 public key, as text standard base64 of its 32 bytes.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(
    feature = "openapi",
    derive(utoipa::ToSchema),
    schema(value_type = String, example = "11qYAYKxCrfVS/7TyWQHOg7hcvPapiMlrwIaaPcHURo=")
)]
#[serde(try_from = "String", into = "String")]
pub struct PublicKey(ed25519_dalek::VerifyingKey);

impl PublicKey {
    /// From its 32 bytes; `None` if they are no point of the curve.
    pub fn from_bytes(bytes: [u8; 32]) -> Option<Self> {
        ed25519_dalek::VerifyingKey::from_bytes(&bytes).ok().map(Self)
    }

    /// The 32 bytes of the public key.
    pub fn to_bytes(&self) -> [u8; 32] {
        self.0.to_bytes()
    }

    /// A short name for it: the first 16 hex digits of its SHA-256.
    pub fn id(&self) -> String {
        Digest::of(&self.to_bytes()).hex()[..16].to_owned()
    }
}

/// A text that is not a public key.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("not an ed25519 public key: expected base64 of 32 bytes")]
pub struct InvalidKey;

impl FromStr for PublicKey {
    type Err = InvalidKey;
    fn from_str(text: &str) -> Result<Self, InvalidKey> {
        let bytes = STANDARD.decode(text).map_err(|_| InvalidKey)?;
        bytes.try_into().ok().and_then(Self::from_bytes).ok_or(InvalidKey)
    }
}

crate::ids::serde_by_text!(PublicKey, InvalidKey);

impl fmt::Display for PublicKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&STANDARD.encode(self.to_bytes()))
    }
}

impl fmt::Debug for PublicKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "PublicKey({})", self.id())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn envelope_opens_only_with_a_signature_by_the_pinned_key() {
        let key = SigningKey::from_bytes([7; 32]);
        let envelope = Envelope::seal(DESIRED_STATE_TYPE, b"{}", &key);
        assert_eq!(envelope.open(DESIRED_STATE_TYPE, &key.public_key()), Ok(b"{}".to_vec()));
        let stranger = SigningKey::from_bytes([8; 32]).public_key();
        assert_eq!(
            envelope.open(DESIRED_STATE_TYPE, &stranger),
            Err(EnvelopeError::NotSigned(stranger.id()))
        );
    }

    #[test]
    fn each_key_counts_once_and_only_if_it_signed() {
        let [ada, bob, eve] = [1, 2, 3].map(|seed| SigningKey::from_bytes([seed; 32]));
        let mut envelope = Envelope::seal(DESIRED_STATE_TYPE, b"{}", &ada);
        for key in [&ada, &bob, &bob] {
            envelope.add_signature(DESIRED_STATE_TYPE, key).expect("signed");
        }
        assert_eq!(envelope.signatures.len(), 2);
        let keys = [&bob, &eve, &ada, &ada].map(SigningKey::public_key);
        let (payload, signers) = envelope.signers(DESIRED_STATE_TYPE, &keys).expect("opens");
        assert_eq!((payload, signers), (b"{}".to_vec(), vec![&keys[0], &keys[2]]));
        // A key id is only a claim of its writer: a signature with another key's id counts for no
        // key.
        envelope.signatures[0].keyid = eve.public_key().id();
        assert_eq!(envelope.signers(DESIRED_STATE_TYPE, &keys).expect("opens").1, [&keys[0]]);
        envelope.signatures[0].keyid.clear();
        assert_eq!(
            envelope.signers(DESIRED_STATE_TYPE, &keys).expect("opens").1,
            [&keys[0], &keys[2]]
        );
        assert!(envelope.signers("text/plain", &keys).is_err());
    }

    #[test]
    fn any_changed_payload_is_refused() {
        let key = SigningKey::from_bytes([7; 32]);
        let mut envelope = Envelope::seal(DESIRED_STATE_TYPE, b"{\"generation\":1}", &key);
        envelope.payload = STANDARD.encode(b"{\"generation\":2}");
        assert!(matches!(
            envelope.open(DESIRED_STATE_TYPE, &key.public_key()),
            Err(EnvelopeError::NotSigned(_))
        ));
        envelope.payload_type = "text/plain".to_owned();
        assert!(matches!(
            envelope.open(DESIRED_STATE_TYPE, &key.public_key()),
            Err(EnvelopeError::WrongType { .. })
        ));
    }

    #[test]
    fn encoding_matches_the_specification() {
        // The example of the DSSE protocol document.
        let encoded = pre_authentication_encoding("http://example.com/HelloWorld", b"hello world");
        assert_eq!(encoded, b"DSSEv1 29 http://example.com/HelloWorld 11 hello world");
    }
}
