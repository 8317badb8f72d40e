//! By what a registry is known (OCI distribution specification): the header that names the bytes it
//! has, and the error body when it refuses. Who answers with anything else is a proxy or a portal,
//! and not the server.

use std::borrow::Cow;

use http::HeaderName;
use reqwest::Response;

/// The digest of what an answer is about.
pub(crate) const CONTENT_DIGEST: HeaderName = HeaderName::from_static("docker-content-digest");

/// The most of an error's body that is read.
const MAX_BYTES: usize = 4096;

/// An error in the registry's words.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RegistryWords {
    /// The code of the specification; empty where what came is no registry's error.
    pub(crate) code: String,
    /// The message, or all that came, on one line.
    pub(crate) text: String,
}

impl RegistryWords {
    /// Reads them from an answer; what breaks off is as good as whole.
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

    /// Whether a registry said it.
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
