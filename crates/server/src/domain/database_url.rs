//! The setting `database`: the URL of a SQLite file, or the URLs of one or several Postgres servers
//! separated by commas. No message repeats a URL, which may hold a password. This module opens no
//! connection.

use super::url_text::{percent_decoded, split};

/// The schemes of Postgres.
const POSTGRES: [&str; 2] = ["postgres://", "postgresql://"];
/// The most servers of one list.
const MAX_SERVERS: usize = 8;
/// The names that the Postgres driver accepts for the mode of TLS.
const TLS_MODE: [&str; 2] = ["sslmode", "ssl-mode"];
/// The names that the Postgres driver accepts for the file of the trusted authority.
const ROOT_CERTIFICATE: [&str; 3] = ["sslrootcert", "ssl-root-cert", "ssl-ca"];

/// The text is not a valid `database`. The message never repeats the text.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum InvalidDatabaseUrl {
    #[error("expected a URL that starts with sqlite: or postgres://")]
    Scheme,
    #[error("a list of several URLs may hold Postgres servers only")]
    Mixed,
    #[error("it names more than 8 servers")]
    TooMany,
    /// The form of libpq, which the driver does not read.
    #[error(
        "its host contains a comma: write each server as a whole URL, postgres://A/NAME,postgres://B/NAME"
    )]
    SeveralHosts,
    /// The driver adds the given authority to the public ones, and this mode compares no names:
    /// any holder of a public certificate would pass.
    #[error(
        "sslmode=verify-ca would accept every certificate of a public authority: use sslmode=verify-full"
    )]
    VerifyCa,
    /// The driver ignores the authority in any other mode.
    #[error("sslrootcert has an effect only with sslmode=verify-full")]
    UnverifiedRoot,
}

/// Checks the whole setting.
pub fn check(text: &str) -> Result<(), InvalidDatabaseUrl> {
    let servers = servers(text);
    if !is_postgres(text) {
        return match (text.starts_with("sqlite:"), servers.len()) {
            (true, 1) => Ok(()),
            (true, _) => Err(InvalidDatabaseUrl::Mixed),
            (false, _) => Err(InvalidDatabaseUrl::Scheme),
        };
    }
    if servers.len() > MAX_SERVERS {
        return Err(InvalidDatabaseUrl::TooMany);
    }
    for url in servers {
        let host = without_password(url);
        let host = host.split_once("://").map_or("", |(_, place)| place).split('/').next();
        if host.is_some_and(|host| host.contains(',')) {
            return Err(InvalidDatabaseUrl::SeveralHosts);
        }
        match (parameter(url, &TLS_MODE).as_deref(), root_certificate(url)) {
            (Some("verify-ca"), _) => return Err(InvalidDatabaseUrl::VerifyCa),
            (Some("verify-full"), _) | (_, None) => {}
            (_, Some(_)) => return Err(InvalidDatabaseUrl::UnverifiedRoot),
        }
    }
    Ok(())
}

/// Whether the setting names Postgres servers.
pub fn is_postgres(text: &str) -> bool {
    POSTGRES.iter().any(|scheme| text.starts_with(scheme))
}

/// The URLs of the setting, in their order; at least one.
pub fn servers(text: &str) -> Vec<&str> {
    split(text, &POSTGRES)
}

/// Whether one of the URLs has a password: `user:password@`, or in its query.
pub fn has_password(text: &str) -> bool {
    is_postgres(text)
        && servers(text).into_iter().any(|url| {
            let (place, query) = url.split_once('?').unwrap_or((url, ""));
            let user = place.rsplit_once('@').map_or("", |(user, _)| user);
            user.matches(':').count() > 1
                || query.split('&').any(|pair| pair.starts_with("password="))
        })
}

/// The URLs in a form that is safe to show: without user and password, and without the query, which
/// may hold a password too.
pub fn without_password(text: &str) -> String {
    let shown = |url: &str| {
        let (place, query) = url.split_once('?').unwrap_or((url, ""));
        let Some((scheme, place)) = place.split_once("://").filter(|_| is_postgres(url)) else {
            return place.to_owned();
        };
        let host = match place.rsplit_once('@') {
            Some((_, host)) => host,
            // The password of an invalid URL may contain the '?'.
            None if query.contains('@') => "…",
            None => place,
        };
        format!("{scheme}://{host}")
    };
    servers(text).into_iter().map(shown).collect::<Vec<_>>().join(", ")
}

/// The file of the authority that the server's certificate must be signed by, or its text in PEM.
pub fn root_certificate(url: &str) -> Option<String> {
    parameter(url, &ROOT_CERTIFICATE)
}

/// The last value in the query with one of these names.
fn parameter(url: &str, names: &[&str]) -> Option<String> {
    let (_, query) = url.split_once('?')?;
    let mut pairs = query.rsplit('&').filter_map(|pair| pair.split_once('='));
    let (_, value) = pairs.find(|(name, _)| names.contains(name))?;
    percent_decoded(&value.replace('+', " "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn list_is_split_at_commas_before_a_url() {
        let list = "postgres://u:a,b@one/x, postgresql://u@two:1/x?sslmode=require";
        assert_eq!(check(list), Ok(()));
        assert_eq!(
            servers(list),
            ["postgres://u:a,b@one/x", "postgresql://u@two:1/x?sslmode=require"]
        );
        assert_eq!(without_password(list), "postgres://one/x, postgresql://two:1/x");
        assert_eq!(servers("sqlite:///a,b.db"), ["sqlite:///a,b.db"]);
        assert_eq!(check("sqlite:///a,b.db"), Ok(()));
    }

    #[test]
    fn invalid_setting_is_refused() {
        use InvalidDatabaseUrl::{Mixed, Scheme, SeveralHosts, TooMany, UnverifiedRoot, VerifyCa};
        for (text, expected) in [
            ("", Scheme),
            ("mysql://host/db", Scheme),
            ("one,postgres://two", Scheme),
            ("sqlite:///a.db,postgres://host/db", Mixed),
            ("postgres://one:5432,two:5432/db", SeveralHosts),
            ("postgres://one/db,postgres://two,three/db", SeveralHosts),
            ("postgres://host/db?sslmode=verify-ca&sslrootcert=/ca.pem", VerifyCa),
            ("postgres://host/db?sslrootcert=/ca.pem", UnverifiedRoot),
            ("postgres://host/db?ssl-mode=require&ssl-ca=/ca.pem", UnverifiedRoot),
        ] {
            assert_eq!(check(text), Err(expected), "{text}");
        }
        assert_eq!(check(&["postgres://host/db"; 9].join(",")), Err(TooMany));
        assert_eq!(check("postgres://host/a,b?sslmode=verify-full&sslrootcert=/ca.pem"), Ok(()));
    }

    #[test]
    fn root_certificate_is_decoded() {
        let root = |url| root_certificate(url).unwrap_or_default();
        assert_eq!(
            root("postgres://host/db?sslmode=verify-full&sslrootcert=/a%20b.pem"),
            "/a b.pem"
        );
        assert_eq!(root("postgres://host/db"), "");
    }

    #[test]
    fn url_without_password_is_safe_to_show() {
        for (url, shown) in [
            ("postgres://u:p@ss@host/db", "postgres://host/db"),
            ("postgres://u:p?ss@host/db", "postgres://…"),
            ("postgres://host/db?password=secret", "postgres://host/db"),
            ("postgres://u@host/db?password=sec@ret", "postgres://host/db"),
            ("postgres://host?password=sec@ret", "postgres://…"),
            ("sqlite:///a@b.db?mode=rwc", "sqlite:///a@b.db"),
        ] {
            assert_eq!(without_password(url), shown);
        }
    }
}
