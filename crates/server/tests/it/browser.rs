//! A real browser, driven over WebDriver: a headless Chromium with a profile of its own, gone when the test ends.
#![expect(clippy::disallowed_methods, reason = "a test harness starts processes")]

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{Ipv4Addr, TcpStream};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use reqwest::{Client, Method};
use serde_json::{Value, json};
use tempfile::TempDir;

/// How long the page may take for anything on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);
const ARGUMENTS: [&str; 9] = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
];

pub struct Browser {
    driver: Child,
    port: u16,
    client: Client,
    session: String,
    _profile: TempDir,
}

impl Browser {
    pub async fn start() -> Self {
        let mut command = Command::new("chromedriver");
        command.arg("--port=0").stdin(Stdio::null()).stdout(Stdio::piped());
        let driver = command.spawn();
        let mut driver = driver.unwrap_or_else(|error| {
            panic!("chromedriver: {error}; install the packages chromium and chromium-driver, or use ./scripts/test")
        });
        let port = announced_port(&mut driver);
        let profile = TempDir::new().expect("a directory");
        let client = Client::builder().timeout(2 * PATIENCE).build().expect("a client");
        let mut browser = Self { driver, port, client, session: String::new(), _profile: profile };
        let arguments = ARGUMENTS.iter().map(|argument| (*argument).to_owned());
        let profile = format!("--user-data-dir={}", browser._profile.path().display());
        let capabilities = json!({
            "goog:chromeOptions": { "args": arguments.chain([profile]).collect::<Vec<_>>() },
            "goog:loggingPrefs": { "browser": "WARNING" },
            "timeouts": { "script": PATIENCE.as_millis() },
        });
        let asked = json!({ "capabilities": { "alwaysMatch": capabilities } });
        let session = browser.call(Method::POST, "/session", &asked).await;
        let id = session["sessionId"].as_str().unwrap_or_else(|| panic!("is chromium installed? {session}"));
        browser.session = format!("/session/{id}");
        browser
    }

    /// Goes to an address and waits until it is loaded.
    pub async fn open(&self, url: &str) {
        self.command("/url", &json!({ "url": url })).await;
    }

    /// What a function with this body returns in the page.
    pub async fn run(&self, body: &str) -> Value {
        self.command("/execute/sync", &json!({ "script": body, "args": [] })).await
    }

    /// Waits until an expression is true in the page. It is looked at whenever the page changes.
    pub async fn wait(&self, expression: &str) {
        let script = format!(
            "const done = arguments[0]; const look = () => {{ if ({expression}) done(true); }}; \
             new MutationObserver(look).observe(document, \
             {{ subtree: true, childList: true, attributes: true, characterData: true }}); look();"
        );
        let seen = self.command("/execute/async", &json!({ "script": script, "args": [] })).await;
        if seen != json!(true) {
            let text = self.run("return document.body.innerText").await;
            panic!("waited in vain for {expression}: {seen}\nthe page says: {}", text.as_str().unwrap_or_default());
        }
    }

    /// What the browser's console got since it was asked last: errors, warnings and violated policies.
    pub async fn console(&self) -> Vec<Value> {
        let entries = self.command("/se/log", &json!({ "type": "browser" })).await;
        entries.as_array().cloned().unwrap_or_default()
    }

    async fn command(&self, path: &str, body: &Value) -> Value {
        self.call(Method::POST, &format!("{}{path}", self.session), body).await
    }

    async fn call(&self, method: Method, path: &str, body: &Value) -> Value {
        let url = format!("http://127.0.0.1:{}{path}", self.port);
        let answer = self.client.request(method, url).json(body).send().await.expect("chromedriver answers");
        let mut answer: Value = answer.json().await.expect("json");
        answer["value"].take()
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // Killed, chromedriver would leave its browser behind; told to, it ends it first.
        if let Ok(mut stream) = TcpStream::connect((Ipv4Addr::LOCALHOST, self.port)) {
            let _ = stream.set_read_timeout(Some(Duration::from_secs(10)));
            let _ = stream.write_all(b"GET /shutdown HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
            let _ = stream.read_to_end(&mut Vec::new());
        } else {
            let _ = self.driver.kill();
        }
        let _ = self.driver.wait();
    }
}

fn announced_port(driver: &mut Child) -> u16 {
    let output = driver.stdout.as_mut().expect("piped");
    let mut lines = BufReader::new(output).lines().map_while(Result::ok);
    let port =
        lines.find_map(|line| line.split_once("started successfully on port ")?.1.trim_end_matches('.').parse().ok());
    port.expect("chromedriver says its port")
}
