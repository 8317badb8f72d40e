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
pub(crate) struct RegistryError {
    /// Error code of the specification; empty if the body is not a registry's error.
    pub(crate) code: String,
    /// The message, or the whole body, on one line.
    pub(crate) text: String,
}

impl RegistryError {
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
    pub(crate) fn is_from_registry(&self) -> bool {
        !self.code.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn registry_error_keeps_the_servers_message() {
        let error = br#"{"errors":[{"code":"SIZE_INVALID","message":"the output\nhas 9 bytes","detail":{}}]}"#;
        let registry_error = RegistryError {
            code: "SIZE_INVALID".to_owned(),
            text: "the output has 9 bytes".to_owned(),
        };
        assert_eq!(RegistryError::of(error), registry_error);
        for other in
            ["<h1>Forbidden</h1>", r#"{"errors":[]}"#, r#"{"error":{"code":"x"}}"#, "[]", ""]
        {
            let registry_error = RegistryError::of(other.as_bytes());
            assert_eq!(
                (registry_error.is_from_registry(), registry_error.text.as_str()),
                (false, other)
            );
        }
        assert_eq!(RegistryError::of(b"\xff\x1b[2J").text, "\u{fffd} [2J");
    }
}
