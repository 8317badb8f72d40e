//! The pin of a server's private certificate authority. An enrollment token contains it, so that a
//! robot can authenticate its server without any other authority.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::ids::digest::{hex, unhex};

/// The ALPN protocol (RFC 7301) that a client requests if it trusts a pinned authority. A server
/// with two certificates shows such a client the one issued by that authority, and all other
/// clients its own.
pub const PINNED_PROTOCOL: &[u8] = b"taskd-pinned";

/// The SHA-256 of an authority's SubjectPublicKeyInfo (DER), 64 hex digits. The authority's
/// certificate may be renewed.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(
    feature = "openapi",
    derive(utoipa::ToSchema),
    schema(
        value_type = String,
        pattern = "^[0-9a-f]{64}$",
        example = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    )
)]
#[serde(try_from = "String", into = "String")]
pub struct CaPin([u8; 32]);

/// A text that is not 64 lower-case hex digits.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("not a pin: expected 64 lower-case hex digits")]
pub struct InvalidPin;

impl CaPin {
    /// The pin of the authority with this SubjectPublicKeyInfo.
    pub fn of(public_key_info: &[u8]) -> Self {
        Self(Sha256::digest(public_key_info).into())
    }
}

impl FromStr for CaPin {
    type Err = InvalidPin;
    fn from_str(text: &str) -> Result<Self, InvalidPin> {
        unhex(text).map(Self).ok_or(InvalidPin)
    }
}

crate::ids::serde_by_text!(CaPin, InvalidPin);

impl fmt::Display for CaPin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&hex(&self.0))
    }
}

impl fmt::Debug for CaPin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}
