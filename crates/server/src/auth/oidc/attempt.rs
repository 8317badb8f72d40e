//! One attempt to sign in: a secret that only the browser keeps, in a cookie, while it is away at
//! the provider. What the provider is told is made of it, so that an answer is only good in the
//! browser that asked, and nothing is remembered here.

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use sha2::{Digest as _, Sha256};
use subtle::ConstantTimeEq as _;

/// The secret's bytes.
const SECRET_BYTES: usize = 32;

/// One attempt.
#[derive(Clone, PartialEq, Eq)]
pub struct Attempt([u8; SECRET_BYTES]);

impl Attempt {
    /// A new one.
    pub fn random() -> Self {
        Self(rand::random())
    }

    /// The one that the browser had kept; `None` if that is none.
    pub fn kept(text: &str) -> Option<Self> {
        URL_SAFE_NO_PAD.decode(text).ok()?.try_into().ok().map(Self)
    }

    /// What the browser is to keep.
    pub fn reveal(&self) -> String {
        URL_SAFE_NO_PAD.encode(self.0)
    }

    /// What comes back with the answer.
    pub fn state(&self) -> String {
        self.derived("state")
    }

    /// Whether an answer belongs to this attempt.
    pub fn has_state(&self, state: &str) -> bool {
        self.state().as_bytes().ct_eq(state.as_bytes()).into()
    }

    /// What comes back in the ID token.
    pub fn nonce(&self) -> String {
        self.derived("nonce")
    }

    /// What has to be shown with the code (RFC 7636).
    pub fn verifier(&self) -> String {
        self.derived("verifier")
    }

    /// What tells the provider which verifier that will be.
    pub fn challenge(&self) -> String {
        URL_SAFE_NO_PAD.encode(Sha256::digest(self.verifier()))
    }

    /// None of these tells anything about another one.
    fn derived(&self, purpose: &str) -> String {
        let digest = Sha256::new().chain_update(purpose).chain_update([0]).chain_update(self.0);
        URL_SAFE_NO_PAD.encode(digest.finalize())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_belongs_to_one_attempt() {
        let (attempt, other) = (Attempt::random(), Attempt::random());
        let kept = Attempt::kept(&attempt.reveal()).expect("it was kept");
        assert!(kept.has_state(&attempt.state()) && kept.nonce() == attempt.nonce());
        assert!(
            !other.has_state(&attempt.state())
                && !attempt.has_state("")
                && other.nonce() != attempt.nonce()
        );
        let told = [
            attempt.state(),
            attempt.nonce(),
            attempt.verifier(),
            attempt.challenge(),
            attempt.reveal(),
        ];
        let different: std::collections::BTreeSet<&String> = told.iter().collect();
        assert_eq!(different.len(), told.len());
        assert!(
            told.iter().all(|text| text.len() == 43),
            "as long as RFC 7636 wants a verifier at least"
        );
        for bad in ["", "x", &"A".repeat(42), &"A".repeat(44), &"!".repeat(43)] {
            assert!(Attempt::kept(bad).is_none(), "{bad:?}");
        }
    }
}
