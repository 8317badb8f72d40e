//! An in-process OpenID Connect provider that knows one user, keeps to the protocol as strictly as
//! possible, and forges its ID tokens on request.

use std::collections::HashMap;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::{Arc, Mutex, MutexGuard};

use axum::extract::{Query, State};
use axum::response::{IntoResponse, Redirect, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use base64::Engine as _;
use base64::engine::general_purpose::{STANDARD, URL_SAFE_NO_PAD};
use reqwest::StatusCode;
use ring::rand::SystemRandom;
use ring::signature::{ECDSA_P256_SHA256_FIXED_SIGNING, EcdsaKeyPair, KeyPair as _};
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};

use crate::harness::NOW_MS;

pub const CLIENT_ID: &str = "taskd";
pub const SECRET: &str = "a secret & more";

/// The provider; ends with the test.
pub struct Provider {
    pub issuer: String,
    inner: Arc<Mutex<Inner>>,
    _serving: tokio_util::task::AbortOnDropHandle<()>,
}

struct Inner {
    issuer: String,
    key: EcdsaKeyPair,
    key_id: String,
    /// Claims about every user who signs in.
    claims: Value,
    /// Forged values in its tokens, in the header and in the claims.
    header_lie: Value,
    claims_lie: Value,
    /// Whether users can sign in.
    is_open: bool,
    /// Whether every request is answered with an error.
    is_broken: bool,
    codes: HashMap<String, HashMap<String, String>>,
    /// How often each path was asked for.
    asked: HashMap<&'static str, usize>,
}

type Shared = State<Arc<Mutex<Inner>>>;

fn new_key() -> EcdsaKeyPair {
    let random = SystemRandom::new();
    let document =
        EcdsaKeyPair::generate_pkcs8(&ECDSA_P256_SHA256_FIXED_SIGNING, &random).expect("a key");
    EcdsaKeyPair::from_pkcs8(&ECDSA_P256_SHA256_FIXED_SIGNING, document.as_ref(), &random)
        .expect("a key")
}

impl Provider {
    /// Under a name that is not the server's, so that browsers take them for two sites.
    pub async fn start() -> Self {
        let listener = tokio::net::TcpListener::bind(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))
            .await
            .expect("binds");
        let issuer =
            format!("http://localhost:{}", listener.local_addr().expect("an address").port());
        let inner = Arc::new(Mutex::new(Inner {
            issuer: issuer.clone(),
            key: new_key(),
            key_id: "first".to_owned(),
            claims: json!({
                "sub": "248289761001", "preferred_username": "Alice",
                "groups": ["robotics", "staff"],
            }),
            header_lie: json!({}),
            claims_lie: json!({}),
            is_open: true,
            is_broken: false,
            codes: HashMap::new(),
            asked: HashMap::new(),
        }));
        let router = Router::new()
            .route("/.well-known/openid-configuration", get(discovery))
            .route("/authorize", get(authorize))
            .route("/token", post(token))
            .route("/keys", get(keys))
            .with_state(inner.clone());
        let serving =
            tokio::spawn(async move { axum::serve(listener, router).await.expect("serves") });
        Self { issuer, inner, _serving: tokio_util::task::AbortOnDropHandle::new(serving) }
    }

    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().expect("nobody panicked")
    }

    /// Changes the claims about every user who signs in.
    pub fn says(&self, changes: Value) {
        merge(&mut self.inner().claims, &changes);
    }

    /// Sets the forged values in its tokens from now on.
    pub fn lies(&self, header: Value, claims: Value) {
        let mut inner = self.inner();
        (inner.header_lie, inner.claims_lie) = (header, claims);
    }

    pub fn lets_in(&self, yes: bool) {
        self.inner().is_open = yes;
    }

    pub fn breaks(&self, yes: bool) {
        self.inner().is_broken = yes;
    }

    /// Signs with another key, and publishes the key if requested.
    pub fn changes_key(&self, id: &str) {
        let mut inner = self.inner();
        (inner.key, inner.key_id) = (new_key(), id.to_owned());
    }

    pub fn asked(&self, path: &str) -> usize {
        self.inner().asked.get(path).copied().unwrap_or_default()
    }
}

impl Inner {
    fn count(&mut self, path: &'static str) -> Result<(), StatusCode> {
        *self.asked.entry(path).or_default() += 1;
        if self.is_broken { Err(StatusCode::BAD_GATEWAY) } else { Ok(()) }
    }
}

/// A null takes the key away.
fn merge(value: &mut Value, changes: &Value) {
    let fields = value.as_object_mut().expect("an object");
    for (key, change) in changes.as_object().expect("an object") {
        match change {
            Value::Null => fields.remove(key),
            change => fields.insert(key.clone(), change.clone()),
        };
    }
}

async fn discovery(State(inner): Shared) -> Result<Json<Value>, StatusCode> {
    let mut inner = inner.lock().expect("nobody panicked");
    inner.count("discovery")?;
    let issuer = &inner.issuer;
    Ok(Json(json!({
        "issuer": issuer,
        "authorization_endpoint": format!("{issuer}/authorize?theme=dark"),
        "token_endpoint": format!("{issuer}/token"),
        "jwks_uri": format!("{issuer}/keys"),
        "response_types_supported": ["code"],
        "subject_types_supported": ["public"],
        "id_token_signing_alg_values_supported": ["RS256", "ES256"],
    })))
}

async fn keys(State(inner): Shared) -> Result<Json<Value>, StatusCode> {
    let mut inner = inner.lock().expect("nobody panicked");
    inner.count("keys")?;
    let point = inner.key.public_key().as_ref();
    let (x, y) = (URL_SAFE_NO_PAD.encode(&point[1..33]), URL_SAFE_NO_PAD.encode(&point[33..]));
    let key =
        json!({ "kty": "EC", "crv": "P-256", "use": "sig", "kid": inner.key_id, "x": x, "y": y });
    Ok(Json(json!({ "keys": [key] })))
}

async fn authorize(State(inner): Shared, Query(asked): Query<HashMap<String, String>>) -> Response {
    let mut inner = inner.lock().expect("nobody panicked");
    let given = |name: &str| asked.get(name).map(String::as_str).unwrap_or_default();
    let is_right = given("theme") == "dark"
        && given("response_type") == "code"
        && given("client_id") == CLIENT_ID
        && given("scope").split(' ').any(|scope| scope == "openid")
        && given("code_challenge_method") == "S256"
        && given("code_challenge").len() == 43
        && !given("nonce").is_empty();
    if !is_right || !given("redirect_uri").ends_with("/api/v1/oidc/callback") {
        return StatusCode::BAD_REQUEST.into_response();
    }
    let (to, state) = (given("redirect_uri").to_owned(), given("state").to_owned());
    if !inner.is_open {
        return Redirect::to(&format!(
            "{to}?error=access_denied&error_description=no&state={state}"
        ))
        .into_response();
    }
    let code = format!("{:032x}", rand::random::<u128>());
    inner.codes.insert(code.clone(), asked);
    let issuer = inner.issuer.replace(':', "%3A").replace('/', "%2F");
    Redirect::to(&format!("{to}?code={code}&state={state}&iss={issuer}&session_state=x"))
        .into_response()
}

async fn token(
    State(inner): Shared,
    headers: http::HeaderMap,
    body: String,
) -> Result<Response, StatusCode> {
    let mut inner = inner.lock().expect("nobody panicked");
    inner.count("token")?;
    let query = reqwest::Url::parse(&format!("http://localhost/?{body}")).expect("a form");
    let form: HashMap<String, String> = query.query_pairs().into_owned().collect();
    let given = |name: &str| form.get(name).map(String::as_str).unwrap_or_default();
    let refused = |error: &str| {
        Ok((StatusCode::BAD_REQUEST, Json(json!({ "error": error }))).into_response())
    };
    let credentials =
        format!("Basic {}", STANDARD.encode(format!("{CLIENT_ID}:a+secret+%26+more")));
    if headers.get("authorization").is_none_or(|value| value.as_bytes() != credentials.as_bytes()) {
        return refused("invalid_client");
    }
    // A code is good once.
    let Some(asked) = inner.codes.remove(given("code")) else { return refused("invalid_grant") };
    let challenge = URL_SAFE_NO_PAD.encode(Sha256::digest(given("code_verifier")));
    if asked["code_challenge"] != challenge || asked["redirect_uri"] != given("redirect_uri") {
        return refused("invalid_grant");
    }
    if given("grant_type") != "authorization_code" {
        return refused("unsupported_grant_type");
    }
    let mut header = json!({ "alg": "ES256", "kid": inner.key_id, "typ": "JWT" });
    let mut claims = json!({
        "iss": inner.issuer, "aud": CLIENT_ID, "nonce": asked["nonce"], "iat": NOW_MS / 1000,
        "exp": NOW_MS / 1000 + 300,
    });
    merge(&mut claims, &inner.claims);
    merge(&mut header, &inner.header_lie);
    merge(&mut claims, &inner.claims_lie);
    let part = |value: &Value| URL_SAFE_NO_PAD.encode(value.to_string());
    let signed = format!("{}.{}", part(&header), part(&claims));
    let signature = inner.key.sign(&SystemRandom::new(), signed.as_bytes()).expect("signs");
    let id_token = format!("{signed}.{}", URL_SAFE_NO_PAD.encode(signature));
    Ok(Json(json!({ "access_token": "x", "token_type": "Bearer", "id_token": id_token }))
        .into_response())
}
