//! One sign-in attempt: a secret that only the browser keeps, in a cookie, while the user is at the
//! provider. The values sent to the provider are derived from the secret. So an answer is only
//! valid in the browser that made the attempt, and the server stores nothing.

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use sha2::{Digest as _, Sha256};
use subtle::ConstantTimeEq as _;

/// The secret's length in bytes.
const SECRET_BYTES: usize = 32;

#[derive(Clone, PartialEq, Eq)]
pub struct SignInAttempt([u8; SECRET_BYTES]);

impl SignInAttempt {
    /// A new attempt with a random secret.
    pub fn random() -> Self {
        Self(rand::random())
    }

    /// The attempt that the browser kept; `None` if the text is invalid.
    pub fn from_cookie(text: &str) -> Option<Self> {
        URL_SAFE_NO_PAD.decode(text).ok()?.try_into().ok().map(Self)
    }

    /// The secret, for the browser's cookie.
    pub fn reveal(&self) -> String {
        URL_SAFE_NO_PAD.encode(self.0)
    }

    /// The `state` parameter, which is returned with the answer.
    pub fn state(&self) -> String {
        self.derived("state")
    }

    /// Whether an answer belongs to this attempt.
    pub fn has_state(&self, state: &str) -> bool {
        self.state().as_bytes().ct_eq(state.as_bytes()).into()
    }

    /// The nonce, which is returned in the ID token.
    pub fn nonce(&self) -> String {
        self.derived("nonce")
    }

    /// The code verifier, sent with the code (RFC 7636).
    pub fn verifier(&self) -> String {
        self.derived("verifier")
    }

    /// The code challenge, which commits to the verifier.
    pub fn challenge(&self) -> String {
        URL_SAFE_NO_PAD.encode(Sha256::digest(self.verifier()))
    }

    /// Derives a value; no derived value reveals another one.
    fn derived(&self, purpose: &str) -> String {
        let digest = Sha256::new().chain_update(purpose).chain_update([0]).chain_update(self.0);
        URL_SAFE_NO_PAD.encode(digest.finalize())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answer_belongs_to_one_attempt() {
        let (attempt, other) = (SignInAttempt::random(), SignInAttempt::random());
        let restored = SignInAttempt::from_cookie(&attempt.reveal()).expect("it is valid");
        assert!(restored.has_state(&attempt.state()) && restored.nonce() == attempt.nonce());
        assert!(
            !other.has_state(&attempt.state())
                && !attempt.has_state("")
                && other.nonce() != attempt.nonce()
        );
        let texts = [
            attempt.state(),
            attempt.nonce(),
            attempt.verifier(),
            attempt.challenge(),
            attempt.reveal(),
        ];
        let different: std::collections::BTreeSet<&String> = texts.iter().collect();
        assert_eq!(different.len(), texts.len());
        assert!(
            texts.iter().all(|text| text.len() == 43),
            "RFC 7636 requires at least 43 characters"
        );
        for bad in ["", "x", &"A".repeat(42), &"A".repeat(44), &"!".repeat(43)] {
            assert!(SignInAttempt::from_cookie(bad).is_none(), "{bad:?}");
        }
    }
}
