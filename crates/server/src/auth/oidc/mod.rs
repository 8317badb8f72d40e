//! Sign-in by an OpenID Connect provider, the authorization code flow with PKCE: the authorization
//! URL, the exchange of the code, and the user that the ID token identifies. This module caches the
//! provider's documents and keys. It never decides the user's rights here, and stores nothing.

mod attempt;
mod id_token;
mod keys;

use std::path::PathBuf;
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use reqwest::{Client, RequestBuilder, StatusCode, Url};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use tokio::sync::{Mutex, Semaphore};

use crate::config::{OidcSettings, RoleRule, private_url};

pub use attempt::SignInAttempt;
pub use id_token::{Claims, IdTokenError};

use id_token::{Expected, IdToken};
use keys::KeySet;

/// Time limit for one answer of the provider.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum size of an answer.
const MAX_ANSWER_BYTES: usize = 1024 * 1024;
/// Maximum concurrent code exchanges; a further one is refused.
const MAX_EXCHANGES: usize = 16;
/// Lifetime of the provider's documents in the cache.
const CACHE_LIFETIME_MS: u64 = 60 * 60 * 1000;
/// Pause before the documents are fetched again, after a failure or when a key was missing.
const BACKOFF_MS: u64 = 10_000;
/// Maximum length of the secret in the file.
const MAX_SECRET_BYTES: u64 = 4096;

/// The reason why no user was signed in.
#[derive(Debug, thiserror::Error)]
pub enum OidcError {
    /// The provider did not answer.
    #[error("the provider's {resource} can't be reached")]
    Unreachable { resource: &'static str, source: reqwest::Error },
    /// The provider's answer is unusable.
    #[error("the provider's {resource} can't be used: {reason}")]
    Unusable {
        resource: &'static str,
        /// The error in the answer.
        reason: String,
    },
    /// The provider's documents could not be fetched a moment ago.
    #[error("the provider failed recently and is not contacted again yet")]
    BackingOff,
    /// The maximum number of exchanges is running.
    #[error("too many concurrent sign-ins")]
    Busy,
    /// The ID token failed validation.
    #[error("the provider's ID token is invalid")]
    IdToken(#[from] IdTokenError),
}

/// The reason why the settings can't be used.
#[derive(Debug, thiserror::Error)]
pub enum OidcSetupError {
    /// The file with the secret can't be read.
    #[error("oidc.client_secret_file: {} can't be read", path.display())]
    SecretFile {
        path: PathBuf,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// The file contains no secret.
    #[error("oidc.client_secret_file: {} contains no secret: expected one line", path.display())]
    NoSecret { path: PathBuf },
    /// The HTTP client can't be created.
    #[error("oidc: the HTTP client can't be created")]
    Client(#[source] reqwest::Error),
}

pub struct Provider {
    settings: OidcSettings,
    secret: Option<String>,
    http: Client,
    cache: Mutex<Cache>,
    exchanges: Semaphore,
}

#[derive(Default)]
struct Cache {
    document: Option<(Document, u64)>,
    keys: Option<(KeySet, u64)>,
    failed_ms: Option<u64>,
}

/// The fields of the discovery document that are needed here.
#[derive(Clone, Deserialize)]
struct Document {
    issuer: String,
    authorization_endpoint: String,
    token_endpoint: String,
    jwks_uri: String,
    #[serde(default)]
    token_endpoint_auth_methods_supported: Option<Vec<String>>,
}

#[derive(Deserialize)]
struct TokenResponse {
    id_token: String,
}

#[derive(Deserialize)]
struct TokenErrorResponse {
    error: String,
}

impl Provider {
    /// Creates the provider from these settings. Nothing is requested yet.
    pub fn new(settings: OidcSettings) -> Result<Self, OidcSetupError> {
        let secret = settings.client_secret_file.as_ref().map(read_secret).transpose()?;
        // A second installation fails because the first is in place, which is sufficient.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let http = Client::builder()
            .timeout(ANSWER_TIMEOUT)
            .redirect(reqwest::redirect::Policy::none())
            .user_agent(concat!("taskd/", env!("CARGO_PKG_VERSION")))
            .build()
            .map_err(OidcSetupError::Client)?;
        Ok(Self {
            settings,
            secret,
            http,
            cache: Mutex::default(),
            exchanges: Semaphore::new(MAX_EXCHANGES),
        })
    }

    pub fn settings(&self) -> &OidcSettings {
        &self.settings
    }

    /// The rule that gives a user with these claims rights; `None`: no rights.
    pub fn rule_for(&self, claims: &Claims) -> Option<&RoleRule> {
        self.settings.rules.iter().find(|rule| claims.has(&rule.claim, &rule.value))
    }

    /// The authorization URL for the browser.
    pub async fn authorization_url(
        &self,
        attempt: &SignInAttempt,
        now_ms: u64,
    ) -> Result<String, OidcError> {
        let document = self.document(now_ms).await?;
        let resource = "authorization endpoint";
        let mut url = Url::parse(&document.authorization_endpoint)
            .map_err(|error| OidcError::Unusable { resource, reason: error.to_string() })?;
        url.query_pairs_mut()
            .append_pair("response_type", "code")
            .append_pair("client_id", &self.settings.client_id)
            .append_pair("redirect_uri", &self.settings.redirect_uri())
            .append_pair("scope", &self.settings.scopes)
            .append_pair("state", &attempt.state())
            .append_pair("nonce", &attempt.nonce())
            .append_pair("code_challenge", &attempt.challenge())
            .append_pair("code_challenge_method", "S256");
        Ok(url.into())
    }

    /// The user identified by the code that the attempt returned.
    pub async fn authenticate(
        &self,
        attempt: &SignInAttempt,
        code: &str,
        now_ms: u64,
    ) -> Result<Claims, OidcError> {
        let _permit = self.exchanges.try_acquire().map_err(|_| OidcError::Busy)?;
        let document = self.document(now_ms).await?;
        let token = self.exchange(&document, attempt, code).await?;
        let token = IdToken::parse(&token)?;
        let keys = self.keys(&document, &token, now_ms).await?;
        let nonce = attempt.nonce();
        let expected = Expected {
            issuer: &self.settings.issuer,
            client_id: &self.settings.client_id,
            nonce: &nonce,
            now_ms,
        };
        Ok(token.verify(&keys, &expected)?)
    }

    async fn exchange(
        &self,
        document: &Document,
        attempt: &SignInAttempt,
        code: &str,
    ) -> Result<String, OidcError> {
        let resource = "token endpoint";
        let (redirect_uri, verifier) = (self.settings.redirect_uri(), attempt.verifier());
        let mut form = vec![
            ("grant_type", "authorization_code"),
            ("code", code),
            ("redirect_uri", &redirect_uri),
            ("code_verifier", &verifier),
        ];
        let mut request = self.http.post(&document.token_endpoint);
        match &self.secret {
            Some(secret) if document.takes_basic() => {
                request = request.header("authorization", basic(&self.settings.client_id, secret));
            }
            Some(secret) => form.extend([
                ("client_id", self.settings.client_id.as_str()),
                ("client_secret", secret),
            ]),
            None => form.push(("client_id", &self.settings.client_id)),
        }
        let (status, body) = read(resource, request.form(&form)).await?;
        if status.is_success() {
            return Ok(parsed::<TokenResponse>(resource, &body)?.id_token);
        }
        let code_text = parsed::<TokenErrorResponse>(resource, &body)
            .map_or(String::new(), |refusal| refusal.error);
        let code_text: String =
            code_text.chars().filter(|c| c.is_ascii_graphic()).take(40).collect();
        Err(OidcError::Unusable { resource, reason: format!("HTTP {status} {code_text}") })
    }

    async fn document(&self, now_ms: u64) -> Result<Document, OidcError> {
        let mut cache = self.cache.lock().await;
        if let Some((document, since_ms)) = &cache.document
            && now_ms.saturating_sub(*since_ms) < CACHE_LIFETIME_MS
        {
            return Ok(document.clone());
        }
        if cache.is_backing_off(now_ms) {
            return Err(OidcError::BackingOff);
        }
        let document =
            self.fetch_document().await.inspect_err(|_| cache.failed_ms = Some(now_ms))?;
        cache.document = Some((document.clone(), now_ms));
        Ok(document)
    }

    async fn fetch_document(&self) -> Result<Document, OidcError> {
        let resource = "discovery document";
        let url = format!(
            "{}/.well-known/openid-configuration",
            self.settings.issuer.trim_end_matches('/')
        );
        let document: Document = self.fetch(resource, &url).await?;
        let unusable = |reason: String| Err(OidcError::Unusable { resource, reason });
        // Otherwise one provider could speak for another.
        if document.issuer != self.settings.issuer {
            return unusable(format!(
                "its issuer is {:?}, not {:?}",
                document.issuer, self.settings.issuer
            ));
        }
        for (key, url) in [
            ("authorization_endpoint", &document.authorization_endpoint),
            ("token_endpoint", &document.token_endpoint),
            ("jwks_uri", &document.jwks_uri),
        ] {
            if let Err(reason) = private_url(url) {
                return unusable(format!("{key}: {reason}"));
            }
        }
        Ok(document)
    }

    /// The provider's keys, including the key that the token names, if that key exists.
    async fn keys(
        &self,
        document: &Document,
        token: &IdToken<'_>,
        now_ms: u64,
    ) -> Result<KeySet, OidcError> {
        let mut cache = self.cache.lock().await;
        if let Some((keys, since_ms)) = &cache.keys {
            let age_ms = now_ms.saturating_sub(*since_ms);
            // The provider may have a new key; but unknown key names must not make the server fetch
            // again and again.
            let is_enough = age_ms < BACKOFF_MS || token.has_key_in(keys);
            if age_ms < CACHE_LIFETIME_MS && is_enough {
                return Ok(keys.clone());
            }
        }
        if cache.is_backing_off(now_ms) {
            return Err(OidcError::BackingOff);
        }
        let fetched = self.fetch::<serde_json::Value>("keys", &document.jwks_uri).await;
        let keys = KeySet::read(&fetched.inspect_err(|_| cache.failed_ms = Some(now_ms))?);
        cache.keys = Some((keys.clone(), now_ms));
        Ok(keys)
    }

    async fn fetch<T: DeserializeOwned>(
        &self,
        resource: &'static str,
        url: &str,
    ) -> Result<T, OidcError> {
        let (status, body) = read(resource, self.http.get(url)).await?;
        if !status.is_success() {
            return Err(OidcError::Unusable { resource, reason: format!("HTTP {status}") });
        }
        parsed(resource, &body)
    }
}

impl Cache {
    fn is_backing_off(&self, now_ms: u64) -> bool {
        self.failed_ms.is_some_and(|failed_ms| now_ms.saturating_sub(failed_ms) < BACKOFF_MS)
    }
}

impl Document {
    /// Whether the client's secret is sent in the header, which is the default unless the provider
    /// excludes it.
    fn takes_basic(&self) -> bool {
        let methods = self.token_endpoint_auth_methods_supported.as_deref().unwrap_or_default();
        let takes = |wanted: &str| methods.iter().any(|method| method == wanted);
        !takes("client_secret_post") || takes("client_secret_basic")
    }
}

async fn read(
    resource: &'static str,
    request: RequestBuilder,
) -> Result<(StatusCode, Vec<u8>), OidcError> {
    let unreachable = |source| OidcError::Unreachable { resource, source };
    let mut response = request.send().await.map_err(unreachable)?;
    let mut body = Vec::new();
    while let Some(chunk) = response.chunk().await.map_err(unreachable)? {
        if body.len() + chunk.len() > MAX_ANSWER_BYTES {
            return Err(OidcError::Unusable {
                resource,
                reason: format!("it has more than {MAX_ANSWER_BYTES} bytes"),
            });
        }
        body.extend_from_slice(&chunk);
    }
    Ok((response.status(), body))
}

fn parsed<T: DeserializeOwned>(resource: &'static str, body: &[u8]) -> Result<T, OidcError> {
    // The error text of serde may repeat a secret.
    let reason =
        |error: serde_json::Error| format!("line {}: {:?}", error.line(), error.classify());
    serde_json::from_slice(body)
        .map_err(|error| OidcError::Unusable { resource, reason: reason(error) })
}

/// Both values are form-encoded before they are joined (RFC 6749, 2.3.1).
fn basic(client_id: &str, secret: &str) -> String {
    let form = |text: &str| {
        let mut url = Url::parse("http://localhost").expect("a URL");
        url.query_pairs_mut().append_key_only(text);
        url.query().unwrap_or_default().to_owned()
    };
    format!("Basic {}", STANDARD.encode(format!("{}:{}", form(client_id), form(secret))))
}

fn read_secret(path: &PathBuf) -> Result<String, OidcSetupError> {
    use std::io::Read as _;
    let unreadable = |source| OidcSetupError::SecretFile { path: path.clone(), source };
    let file = std::fs::File::open(path).map_err(unreadable)?;
    let mut text = String::new();
    file.take(MAX_SECRET_BYTES).read_to_string(&mut text).map_err(unreadable)?;
    let secret = text.trim();
    match secret.is_empty() || secret.contains(char::is_control) {
        true => Err(OidcSetupError::NoSecret { path: path.clone() }),
        false => Ok(secret.to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn client_secret_is_form_encoded() {
        assert_eq!(
            basic("taskd", "a b:c%&ä"),
            format!("Basic {}", STANDARD.encode("taskd:a+b%3Ac%25%26%C3%A4"))
        );
    }

    #[test]
    fn client_secret_is_one_line_of_a_file() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("secret");
        assert!(matches!(read_secret(&path), Err(OidcSetupError::SecretFile { .. })));
        for (text, expected) in
            [("s3cret\n", Some("s3cret")), ("", None), (" \n", None), ("a\nb", None)]
        {
            std::fs::write(&path, text).expect("written");
            assert_eq!(read_secret(&path).ok().as_deref(), expected, "{text:?}");
        }
    }
}
