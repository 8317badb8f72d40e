//! Bearer tokens: `tsko_`, `tske_`, `tskr_` (operator, enrollment, robot), an id, 256 random bits
//! and a CRC-32, so that a mistyped token is refused before anything is looked up. An enrollment
//! token also carries the server's public key and, where the server has a private certificate
//! authority, the pin of that. Only the SHA-256 of a secret is ever stored; tokens never appear in
//! `Debug` output.

use std::fmt;
use std::str::FromStr;

use crate::ids::digest::{hex, unhex};
use crate::trust::envelope::PublicKey;
use crate::{CaPin, Digest};

/// Type of a token's holder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum TokenKind {
    /// A person at the command line or the page.
    Operator,
    /// A robot that is about to register.
    Enrollment,
    /// A registered robot.
    Robot,
}

impl TokenKind {
    fn prefix(self) -> &'static str {
        match self {
            Self::Operator => "tsko",
            Self::Enrollment => "tske",
            Self::Robot => "tskr",
        }
    }
}

/// A token with its secret. Write it only to a file of mode 0600 or to its intended user.
#[derive(Clone, PartialEq, Eq)]
pub struct Token {
    kind: TokenKind,
    id: [u8; 6],
    secret: [u8; 32],
    server_key: Option<PublicKey>,
    ca_pin: Option<CaPin>,
}

/// A text that is not a token.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("not a token: a character is missing or wrong (a token starts with tsko_, tske_ or tskr_)")]
pub struct InvalidToken;

impl Token {
    /// A fresh operator's or robot's token.
    pub fn random(kind: TokenKind) -> Self {
        Self { kind, id: rand::random(), secret: rand::random(), server_key: None, ca_pin: None }
    }

    /// A fresh enrollment token that pins `server_key` and, if there is one, the server's
    /// certificate authority.
    pub fn random_enrollment(server_key: PublicKey, ca_pin: Option<CaPin>) -> Self {
        Self { server_key: Some(server_key), ca_pin, ..Self::random(TokenKind::Enrollment) }
    }

    /// Type of the token's holder.
    pub fn kind(&self) -> TokenKind {
        self.kind
    }

    /// The public part, 12 hex digits, by which the token is listed, looked up and revoked.
    pub fn id(&self) -> String {
        hex(&self.id)
    }

    /// The SHA-256 of the secret, which is stored and compared.
    pub fn secret_digest(&self) -> Digest {
        Digest::of(&self.secret)
    }

    /// The pinned server key of an enrollment token.
    pub fn server_key(&self) -> Option<&PublicKey> {
        self.server_key.as_ref()
    }

    /// The pinned certificate authority of an enrollment token.
    pub fn ca_pin(&self) -> Option<CaPin> {
        self.ca_pin
    }

    /// The token's full text, secret included.
    pub fn reveal(&self) -> String {
        let body = self.body();
        let checksum = crc32fast::hash(body.as_bytes());
        format!("{body}_{checksum:08x}")
    }

    fn body(&self) -> String {
        let mut body = format!("{}_{}_{}", self.kind.prefix(), hex(&self.id), hex(&self.secret));
        if let Some(key) = &self.server_key {
            body.push('_');
            body.push_str(&hex(&key.to_bytes()));
        }
        if let Some(pin) = &self.ca_pin {
            body.push('_');
            body.push_str(&pin.to_string());
        }
        body
    }
}

impl FromStr for Token {
    type Err = InvalidToken;
    fn from_str(text: &str) -> Result<Self, InvalidToken> {
        let (body, checksum) = text.trim().rsplit_once('_').ok_or(InvalidToken)?;
        if checksum != format!("{:08x}", crc32fast::hash(body.as_bytes())) {
            return Err(InvalidToken);
        }
        let fields: Vec<&str> = body.split('_').collect();
        let (kind, server_key, ca_pin) = match fields[..] {
            ["tsko", _, _] => (TokenKind::Operator, None, None),
            ["tskr", _, _] => (TokenKind::Robot, None, None),
            ["tske", _, _, key, ref pin @ ..] if pin.len() <= 1 => {
                let key = unhex(key).and_then(PublicKey::from_bytes).ok_or(InvalidToken)?;
                let pin =
                    pin.first().map(|pin| pin.parse().map_err(|_| InvalidToken)).transpose()?;
                (TokenKind::Enrollment, Some(key), pin)
            }
            _ => return Err(InvalidToken),
        };
        let id = unhex(fields[1]).ok_or(InvalidToken)?;
        let secret = unhex(fields[2]).ok_or(InvalidToken)?;
        Ok(Self { kind, id, secret, server_key, ca_pin })
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}_{}_…", self.kind.prefix(), self.id())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trust::envelope::SigningKey;

    #[test]
    fn tokens_parse_back_and_hide_their_secret() {
        let key = SigningKey::random().public_key();
        let pin = Some(CaPin::of(b"an authority's key"));
        for token in [
            Token::random(TokenKind::Operator),
            Token::random(TokenKind::Robot),
            Token::random_enrollment(key.clone(), None),
            Token::random_enrollment(key, pin),
        ] {
            let text = token.reveal();
            assert_eq!(text.parse(), Ok(token.clone()));
            assert!(!format!("{token:?}").contains(&text[18..40]));
        }
    }

    #[test]
    fn pins_are_part_of_the_token_text() {
        let (key, pin) = (SigningKey::random().public_key(), CaPin::of(b"an authority's key"));
        let token = Token::random_enrollment(key.clone(), Some(pin));
        let read: Token = token.reveal().parse().expect("a token");
        assert_eq!((read.server_key(), read.ca_pin()), (Some(&key), Some(pin)));
        assert!(token.reveal().contains(&format!("_{pin}_")));
        let with_checksum =
            |body: String| format!("{body}_{:08x}", crc32fast::hash(body.as_bytes()));
        let body = token.body();
        assert!(with_checksum(body.clone()).parse::<Token>().is_ok());
        for wrong in [format!("{body}_{pin}"), body.replace(&pin.to_string(), "ab")] {
            assert_eq!(with_checksum(wrong).parse::<Token>(), Err(InvalidToken));
        }
    }

    #[test]
    fn one_wrong_character_is_detected() {
        let text = Token::random(TokenKind::Robot).reveal();
        for at in 0..text.len() {
            let mut bytes = text.clone().into_bytes();
            bytes[at] = if bytes[at] == b'0' { b'1' } else { b'0' };
            let broken = String::from_utf8(bytes).expect("ascii");
            assert_eq!(broken.parse::<Token>(), Err(InvalidToken), "at {at}");
        }
        assert_eq!("".parse::<Token>(), Err(InvalidToken));
    }
}
