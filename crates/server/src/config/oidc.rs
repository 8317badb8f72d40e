//! `[oidc]`: the OpenID Connect provider for sign-ins, and `[[oidc.rules]]`, which map the
//! provider's claims to rights. A user without a matching rule has no rights.

use std::path::PathBuf;

use reqwest::Url;
use task_proto::ids::selector::Selector;
use task_proto::people::roles::Roles;

use super::ConfigError;

/// Maximum number of rules.
const MAX_RULES: usize = 256;
/// Maximum length of a rule's claim or value.
const MAX_TEXT_BYTES: usize = 1024;

/// `[oidc]`. Active if an issuer is set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OidcSettings {
    /// The provider's URL, exactly as the provider states it.
    pub issuer: String,
    /// The provider's id of this server.
    pub client_id: String,
    /// The file with the shared secret; absent: the client is a public one.
    pub client_secret_file: Option<PathBuf>,
    /// The URL at which browsers reach this server, without a path.
    pub public_url: String,
    pub scopes: String,
    /// The claim that becomes a new user's name.
    pub name_claim: String,
    /// The page's name for the provider.
    pub title: String,
    /// The role rules; the first matching rule decides.
    pub rules: Vec<RoleRule>,
}

/// `[[oidc.rules]]`: a user with this claim has these roles.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RoleRule {
    /// The claim's name, or its path.
    pub claim: String,
    /// The claim's value, or one of its values.
    pub value: String,
    /// The roles of the user.
    pub roles: Roles,
    /// The robots to which the roles are limited; `None`: no limit.
    pub robots: Option<Selector>,
}

impl Default for OidcSettings {
    fn default() -> Self {
        Self {
            issuer: String::new(),
            client_id: String::new(),
            client_secret_file: None,
            public_url: String::new(),
            scopes: "openid profile".to_owned(),
            name_claim: "preferred_username".to_owned(),
            title: "single sign-on".to_owned(),
            rules: Vec::new(),
        }
    }
}

impl OidcSettings {
    /// The redirect URI for the browser. The provider has to know this address.
    pub fn redirect_uri(&self) -> String {
        format!("{}/api/v1/oidc/callback", self.public_url)
    }

    /// Checks the settings, if there are any: an error if a required one is missing.
    pub(super) fn check(&self) -> Result<(), ConfigError> {
        if *self == Self::default() {
            return Ok(());
        }
        let rules = if self.rules.is_empty() { "" } else { "there" };
        for (missing, value) in [
            ("oidc.issuer", self.issuer.as_str()),
            ("oidc.client_id", &self.client_id),
            ("oidc.public_url", &self.public_url),
            ("oidc.rules", rules),
        ] {
            if value.is_empty() {
                return Err(ConfigError::OidcIncomplete { missing });
            }
        }
        Ok(())
    }
}

/// An error, and the key below the table.
pub(super) struct TableError {
    pub(super) key: String,
    pub(super) reason: String,
}

/// A URL that is safe from eavesdroppers: `https`, or on this machine.
pub fn private_url(text: &str) -> Result<String, String> {
    let url = Url::parse(text).map_err(|_| format!("{text:?} is not a URL"))?;
    let is_local = matches!(url.host_str(), Some("localhost" | "127.0.0.1" | "[::1]"));
    let is_private = url.scheme() == "https" || url.scheme() == "http" && is_local;
    if !is_private
        || !url.username().is_empty()
        || url.password().is_some()
        || url.fragment().is_some()
    {
        return Err(format!("{text:?} is not a URL that begins with https://"));
    }
    Ok(text.to_owned())
}

/// The server's public origin: scheme, host and port.
pub(super) fn public_url(text: &str) -> Result<String, String> {
    let url = Url::parse(text).ok().filter(|url| matches!(url.scheme(), "http" | "https"));
    let url =
        url.filter(|url| url.path() == "/" && url.query().is_none() && url.fragment().is_none());
    let url = url.filter(|url| url.username().is_empty() && url.password().is_none());
    let found = url.map(|url| url.origin().ascii_serialization());
    found.ok_or_else(|| {
        format!("{text:?} is not a URL without a path, like https://fleet.example.org")
    })
}

/// `[[oidc.rules]]`, counted from 1.
pub(super) fn rules(value: toml::Value) -> Result<Vec<RoleRule>, TableError> {
    let error_at = |reason: String| TableError { key: "rules".to_owned(), reason };
    let toml::Value::Array(values) = value else {
        return Err(error_at("expected [[oidc.rules]], a list of tables".to_owned()));
    };
    if values.len() > MAX_RULES {
        return Err(error_at(format!("{} rules; at most {MAX_RULES} are allowed", values.len())));
    }
    let below = |at: usize, (key, reason): (String, String)| TableError {
        key: format!("rules[{}]{key}", at + 1),
        reason,
    };
    values
        .into_iter()
        .enumerate()
        .map(|(at, value)| rule(value).map_err(|error| below(at, error)))
        .collect()
}

fn rule(value: toml::Value) -> Result<RoleRule, (String, String)> {
    let toml::Value::Table(table) = value else {
        return Err((String::new(), "expected a table".to_owned()));
    };
    let (mut claim, mut wanted, mut roles, mut robots) = (None, None, None, None);
    for (key, value) in table {
        let error_at = |reason: String| (format!(".{key}"), reason);
        let text = value.as_str().filter(|text| (1..=MAX_TEXT_BYTES).contains(&text.len()));
        let text = text
            .ok_or_else(|| error_at(format!("expected a string of 1 to {MAX_TEXT_BYTES} bytes")))?;
        match key.as_str() {
            "claim" => claim = Some(text.to_owned()),
            "value" => wanted = Some(text.to_owned()),
            "roles" => {
                roles = Some(text.parse::<Roles>().map_err(|error| error_at(error.to_string()))?)
            }
            "robots" => {
                robots =
                    Some(text.parse::<Selector>().map_err(|error| error_at(error.to_string()))?)
            }
            _ => {
                return Err(error_at(
                    "there is no such key: expected claim, value, roles or robots".to_owned(),
                ));
            }
        }
    }
    let missing = |key: &str, what: &str| (format!(".{key}"), format!("missing: {what}"));
    Ok(RoleRule {
        claim: claim
            .ok_or_else(|| missing("claim", "the name of the claim to match, such as groups"))?,
        value: wanted.ok_or_else(|| missing("value", "the claim's value, or one of its values"))?,
        roles: roles.ok_or_else(|| missing("roles", "the roles of matching users"))?,
        robots: robots.filter(|robots| robots.to_string() != "*"),
    })
}

#[cfg(test)]
mod tests {
    use super::super::tests::load;
    use super::*;

    const FILE: &str = r#"
        [oidc]
        issuer = "https://id.example.org/realms/lab"
        client_id = "taskd"
        client_secret_file = "/etc/taskd/oidc.secret"
        public_url = "https://fleet.example.org/"
        title = "the lab's account"
        [[oidc.rules]]
        claim = "groups"
        value = "robotics"
        roles = "operator,publisher"
        robots = "site=lab"
        [[oidc.rules]]
        claim = "groups"
        value = "admins"
        roles = "admin"
        robots = "*"
    "#;

    #[test]
    fn oidc_table_is_read_completely() {
        let oidc =
            load(&[], &[("TASKD_OIDC_SCOPES", "openid groups")], Some(FILE)).expect("loads").oidc;
        assert_eq!(oidc.redirect_uri(), "https://fleet.example.org/api/v1/oidc/callback");
        assert_eq!(
            (oidc.scopes.as_str(), oidc.name_claim.as_str()),
            ("openid groups", "preferred_username")
        );
        let rules: Vec<_> =
            oidc.rules.iter().map(|rule| (rule.value.as_str(), rule.roles.to_string())).collect();
        assert_eq!(
            rules,
            [("robotics", "operator,publisher".to_owned()), ("admins", "admin".to_owned())]
        );
        assert_eq!(
            oidc.rules[0].robots.as_ref().map(Selector::to_string).as_deref(),
            Some("site=lab")
        );
        assert_eq!(oidc.rules[1].robots, None);
        assert_eq!(load(&[], &[], None).expect("loads").oidc, OidcSettings::default());
    }

    #[test]
    fn invalid_oidc_settings_are_named() {
        let without = |line: &str| {
            FILE.lines().filter(|given| !given.contains(line)).collect::<Vec<_>>().join("\n")
        };
        for (file, expected) in [
            (without("issuer ="), "oidc.issuer is missing"),
            (without("client_id ="), "oidc.client_id is missing"),
            (without("public_url ="), "oidc.public_url is missing"),
            (FILE.split("[[").next().expect("a part").to_owned(), "oidc.rules is missing"),
            ("[oidc]\nrules = 1".to_owned(), "oidc.rules in taskd.toml: expected [[oidc.rules]]"),
            ("[oidc]\nrules = [1]".to_owned(), "oidc.rules[1] in taskd.toml: expected a table"),
            (
                FILE.replace("\"operator,", "\"root,"),
                "oidc.rules[1].roles in taskd.toml: \"root\" is not a role",
            ),
            (FILE.replace("site=lab", "site=lab=x"), "oidc.rules[1].robots in taskd.toml: "),
            (
                FILE.replace("value = \"admins\"", "valeu = \"x\""),
                "oidc.rules[2].valeu in taskd.toml: there is no such",
            ),
            (FILE.replace("value = \"admins\"", ""), "oidc.rules[2].value in taskd.toml: missing"),
            (
                FILE.replace("\"admins\"", "1"),
                "oidc.rules[2].value in taskd.toml: expected a string",
            ),
            (
                FILE.replace("https://id", "http://id"),
                "oidc.issuer in taskd.toml: \"http://id.example.org/realms/lab\" is",
            ),
            (
                FILE.replace("org/\"", "org/x\""),
                "oidc.public_url in taskd.toml: \"https://fleet.example.org/x\" is not",
            ),
            (
                FILE.replace("title =", "secret ="),
                "oidc.secret in taskd.toml: there is no such setting",
            ),
        ] {
            let message = load(&[], &[], Some(&file)).expect_err(expected);
            assert!(message.starts_with(expected), "{message}");
        }
        for good in [
            "https://id.example/x",
            "http://localhost:9400",
            "http://127.0.0.1:1/x",
            "http://[::1]:1",
        ] {
            assert_eq!(private_url(good).as_deref(), Ok(good));
        }
        for bad in [
            "http://10.0.0.1",
            "ftp://localhost",
            "https://a:b@id.example",
            "https://id.example#x",
            "id.example",
        ] {
            assert!(private_url(bad).is_err(), "{bad}");
        }
    }
}
