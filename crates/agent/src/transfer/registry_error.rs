//! Marks that identify a registry (OCI distribution specification): the header with the digest of
//! its bytes, and the body of its errors. An answer without them comes from a proxy or a portal,
//! not from the server.

use std::borrow::Cow;

use http::HeaderName;
use reqwest::Response;

/// Header with the digest of the answer's subject.
pub(crate) const CONTENT_DIGEST: HeaderName = HeaderName::from_static("docker-content-digest");

/// Most bytes of an error's body that are read.
const MAX_BYTES: usize = 4096;

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RegistryWords {
    /// Error code of the specification; empty if the body is not a registry's error.
    pub(crate) code: String,
    /// The message, or the whole body, on one line.
    pub(crate) text: String,
}

impl RegistryWords {
    /// Reads the error from an answer. A truncated body counts as complete.
    pub(crate) async fn read(response: &mut Response) -> Self {
        let mut body = Vec::new();
        while let Ok(Some(chunk)) = response.chunk().await {
            body.extend_from_slice(&chunk);
            if body.len() > MAX_BYTES {
                break;
            }
        }
        body.truncate(MAX_BYTES);
        Self::of(&body)
    }

    fn of(body: &[u8]) -> Self {
        let parsed: serde_json::Value = serde_json::from_slice(body).unwrap_or_default();
        let [code, message] = ["code", "message"].map(|key| parsed["errors"][0][key].as_str());
        let text = message
            .map_or_else(|| String::from_utf8_lossy(body), Cow::Borrowed)
            .replace(char::is_control, " ");
        Self { code: code.unwrap_or_default().to_owned(), text }
    }

    /// Whether the error comes from a registry.
    pub(crate) fn are_a_registrys(&self) -> bool {
        !self.code.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_is_told_in_the_servers_words() {
        let error = br#"{"errors":[{"code":"SIZE_INVALID","message":"the output\nhas 9 bytes","detail":{}}]}"#;
        let words = RegistryWords {
            code: "SIZE_INVALID".to_owned(),
            text: "the output has 9 bytes".to_owned(),
        };
        assert_eq!(RegistryWords::of(error), words);
        for other in
            ["<h1>Forbidden</h1>", r#"{"errors":[]}"#, r#"{"error":{"code":"x"}}"#, "[]", ""]
        {
            let words = RegistryWords::of(other.as_bytes());
            assert_eq!((words.are_a_registrys(), words.text.as_str()), (false, other));
        }
        assert_eq!(RegistryWords::of(b"\xff\x1b[2J").text, "\u{fffd} [2J");
    }
}
