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

pub use attempt::Attempt;
pub use id_token::{Claims, IdTokenError};

use id_token::{Expected, IdToken};
use keys::KeySet;

/// Time limit for one answer of the provider.
const PATIENCE: Duration = Duration::from_secs(10);
/// Maximum size of an answer.
const MOST_BYTES: usize = 1024 * 1024;
/// Maximum concurrent code exchanges; a further one is refused.
const MOST_EXCHANGES: usize = 16;
/// Lifetime of the provider's documents in the cache.
const LIFETIME_MS: u64 = 60 * 60 * 1000;
/// Pause before the documents are fetched again, after a failure or when a key was missing.
const PAUSE_MS: u64 = 10_000;
/// Maximum length of the secret in the file.
const MOST_SECRET_BYTES: u64 = 4096;

/// The reason why no user was signed in.
#[derive(Debug, thiserror::Error)]
pub enum OidcError {
    /// The provider did not answer.
    #[error("the provider's {what} can't be reached")]
    Unreachable { what: &'static str, source: reqwest::Error },
    /// The provider's answer is unusable.
    #[error("the provider's {what} can't be used: {reason}")]
    Unusable {
        what: &'static str,
        /// The error in the answer.
        reason: String,
    },
    /// The provider's documents could not be fetched a moment ago.
    #[error("the provider failed a moment ago and is not asked again yet")]
    Resting,
    /// The maximum number of exchanges is running.
    #[error("too many sign-ins at once")]
    Busy,
    /// The ID token failed validation.
    #[error("the provider's ID token is not to be believed")]
    IdToken(#[from] IdTokenError),
}

/// The reason why the settings can't be used.
#[derive(Debug, thiserror::Error)]
pub enum OidcSetUpError {
    /// The file with the secret can't be read.
    #[error("oidc.client_secret_file: {} can't be read", path.display())]
    SecretFile {
        path: PathBuf,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// The file contains no secret.
    #[error("oidc.client_secret_file: {} holds no secret: expected one line", path.display())]
    NoSecret { path: PathBuf },
    /// The HTTP client can't be created.
    #[error("oidc: the provider can't be asked")]
    Client(#[source] reqwest::Error),
}

pub struct Provider {
    settings: OidcSettings,
    secret: Option<String>,
    http: Client,
    known: Mutex<Known>,
    exchanges: Semaphore,
}

#[derive(Default)]
struct Known {
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
struct TokenAnswer {
    id_token: String,
}

#[derive(Deserialize)]
struct TokenRefusal {
    error: String,
}

impl Provider {
    /// Creates the provider from these settings. Nothing is requested yet.
    pub fn new(settings: OidcSettings) -> Result<Self, OidcSetUpError> {
        let secret = settings.client_secret_file.as_ref().map(read_secret).transpose()?;
        // A second installation fails because the first is in place, which is sufficient.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let http = Client::builder()
            .timeout(PATIENCE)
            .redirect(reqwest::redirect::Policy::none())
            .user_agent(concat!("taskd/", env!("CARGO_PKG_VERSION")))
            .build()
            .map_err(OidcSetUpError::Client)?;
        Ok(Self {
            settings,
            secret,
            http,
            known: Mutex::default(),
            exchanges: Semaphore::new(MOST_EXCHANGES),
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
    pub async fn address(&self, attempt: &Attempt, now_ms: u64) -> Result<String, OidcError> {
        let document = self.document(now_ms).await?;
        let what = "authorization endpoint";
        let mut url = Url::parse(&document.authorization_endpoint)
            .map_err(|error| OidcError::Unusable { what, reason: error.to_string() })?;
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
    pub async fn who(
        &self,
        attempt: &Attempt,
        code: &str,
        now_ms: u64,
    ) -> Result<Claims, OidcError> {
        let _turn = self.exchanges.try_acquire().map_err(|_| OidcError::Busy)?;
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
        attempt: &Attempt,
        code: &str,
    ) -> Result<String, OidcError> {
        let what = "token endpoint";
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
        let (status, body) = read(what, request.form(&form)).await?;
        if status.is_success() {
            return Ok(parsed::<TokenAnswer>(what, &body)?.id_token);
        }
        let said =
            parsed::<TokenRefusal>(what, &body).map_or(String::new(), |refusal| refusal.error);
        let said: String = said.chars().filter(|c| c.is_ascii_graphic()).take(40).collect();
        Err(OidcError::Unusable { what, reason: format!("it answered {status} {said}") })
    }

    async fn document(&self, now_ms: u64) -> Result<Document, OidcError> {
        let mut known = self.known.lock().await;
        if let Some((document, since_ms)) = &known.document
            && now_ms.saturating_sub(*since_ms) < LIFETIME_MS
        {
            return Ok(document.clone());
        }
        if known.is_resting(now_ms) {
            return Err(OidcError::Resting);
        }
        let document =
            self.fetch_document().await.inspect_err(|_| known.failed_ms = Some(now_ms))?;
        known.document = Some((document.clone(), now_ms));
        Ok(document)
    }

    async fn fetch_document(&self) -> Result<Document, OidcError> {
        let what = "discovery document";
        let url = format!(
            "{}/.well-known/openid-configuration",
            self.settings.issuer.trim_end_matches('/')
        );
        let document: Document = self.fetch(what, &url).await?;
        let unusable = |reason: String| Err(OidcError::Unusable { what, reason });
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
        let mut known = self.known.lock().await;
        if let Some((keys, since_ms)) = &known.keys {
            let age_ms = now_ms.saturating_sub(*since_ms);
            // The provider may have a new key; but unknown key names must not make the server fetch
            // again and again.
            let is_enough = age_ms < PAUSE_MS || token.has_key_in(keys);
            if age_ms < LIFETIME_MS && is_enough {
                return Ok(keys.clone());
            }
        }
        if known.is_resting(now_ms) {
            return Err(OidcError::Resting);
        }
        let fetched = self.fetch::<serde_json::Value>("keys", &document.jwks_uri).await;
        let keys = KeySet::read(&fetched.inspect_err(|_| known.failed_ms = Some(now_ms))?);
        known.keys = Some((keys.clone(), now_ms));
        Ok(keys)
    }

    async fn fetch<T: DeserializeOwned>(
        &self,
        what: &'static str,
        url: &str,
    ) -> Result<T, OidcError> {
        let (status, body) = read(what, self.http.get(url)).await?;
        if !status.is_success() {
            return Err(OidcError::Unusable { what, reason: format!("it answered {status}") });
        }
        parsed(what, &body)
    }
}

impl Known {
    fn is_resting(&self, now_ms: u64) -> bool {
        self.failed_ms.is_some_and(|failed_ms| now_ms.saturating_sub(failed_ms) < PAUSE_MS)
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
    what: &'static str,
    request: RequestBuilder,
) -> Result<(StatusCode, Vec<u8>), OidcError> {
    let unreachable = |source| OidcError::Unreachable { what, source };
    let mut response = request.send().await.map_err(unreachable)?;
    let mut body = Vec::new();
    while let Some(chunk) = response.chunk().await.map_err(unreachable)? {
        if body.len() + chunk.len() > MOST_BYTES {
            return Err(OidcError::Unusable {
                what,
                reason: format!("it has more than {MOST_BYTES} bytes"),
            });
        }
        body.extend_from_slice(&chunk);
    }
    Ok((response.status(), body))
}

fn parsed<T: DeserializeOwned>(what: &'static str, body: &[u8]) -> Result<T, OidcError> {
    // The error text of serde may repeat a secret.
    let reason =
        |error: serde_json::Error| format!("line {}: {:?}", error.line(), error.classify());
    serde_json::from_slice(body)
        .map_err(|error| OidcError::Unusable { what, reason: reason(error) })
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

fn read_secret(path: &PathBuf) -> Result<String, OidcSetUpError> {
    use std::io::Read as _;
    let unreadable = |source| OidcSetUpError::SecretFile { path: path.clone(), source };
    let file = std::fs::File::open(path).map_err(unreadable)?;
    let mut text = String::new();
    file.take(MOST_SECRET_BYTES).read_to_string(&mut text).map_err(unreadable)?;
    let secret = text.trim();
    match secret.is_empty() || secret.contains(char::is_control) {
        true => Err(OidcSetUpError::NoSecret { path: path.clone() }),
        false => Ok(secret.to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_secret_goes_as_a_form_would_have_it() {
        assert_eq!(
            basic("taskd", "a b:c%&ä"),
            format!("Basic {}", STANDARD.encode("taskd:a+b%3Ac%25%26%C3%A4"))
        );
    }

    #[test]
    fn a_secret_is_one_line_of_a_file() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("secret");
        assert!(matches!(read_secret(&path), Err(OidcSetUpError::SecretFile { .. })));
        for (text, expected) in
            [("s3cret\n", Some("s3cret")), ("", None), (" \n", None), ("a\nb", None)]
        {
            std::fs::write(&path, text).expect("written");
            assert_eq!(read_secret(&path).ok().as_deref(), expected, "{text:?}");
        }
    }
}
