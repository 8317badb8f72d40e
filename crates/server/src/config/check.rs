//! `taskd config check`: all errors of a configuration file with their lines, by the rules of the
//! start. Never creates anything.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use task_proto::toml_keys::FileProblem;

use super::{Config, ConfigError, Origin, ServeFlags, read_file};

impl Config {
    /// The errors for which `taskd serve --config` would refuse the file at `path` in this
    /// environment: those of all keys, else the first contradiction between settings.
    pub fn check_file(
        path: &Path,
        environment: impl IntoIterator<Item = (OsString, OsString)>,
    ) -> Result<Vec<FileProblem>, ConfigError> {
        let (text, table) = match read_file(path) {
            Err(ConfigError::Syntax { line, reason, .. }) => {
                return Ok(vec![FileProblem { line, text: format!("not valid TOML: {reason}") }]);
            }
            read => read?,
        };
        let mut errors = Self::with_data(PathBuf::new()).apply_file(path, table);
        if errors.is_empty() {
            let flags = ServeFlags { config: Some(path.to_owned()), settings: Vec::new() };
            errors.extend(Self::load(&flags, environment).err());
        }
        Ok(errors.iter().map(|error| error.in_file(&text)).collect())
    }
}

impl ConfigError {
    /// The error with its place in a file with this content.
    fn in_file(&self, content: &str) -> FileProblem {
        match self {
            Self::Value { origin: Origin::File { key, .. }, reason } => {
                FileProblem::of_key(content, key, reason)
            }
            Self::Unknown { origin: Origin::File { key, .. }, hint } => {
                FileProblem::of_key(content, key, &format!("there is no such setting{hint}"))
            }
            other => {
                // A setting of a table may also be written as one word.
                let lines =
                    other.key().into_iter().flat_map(|key| [key.to_owned(), key.replace('.', "_")]);
                let line =
                    lines.filter_map(|key| task_proto::toml_keys::key_line(content, &key)).next();
                FileProblem { line, text: other.to_string() }
            }
        }
    }

    /// The setting that a contradiction names first.
    fn key(&self) -> Option<&'static str> {
        match self {
            Self::PublicAddressWithSeveralBrokers | Self::PlaintextBroker { .. } => Some("broker"),
            Self::PlaintextBlobStore { .. } => Some("blobs.store"),
            Self::IncompleteCertificate { given, .. } => Some(given),
            Self::StandbyWithoutPostgres => Some("standby"),
            Self::ClientCertificatesWithoutTls => Some("tls.client_certificates"),
            Self::OidcIncomplete { .. } => Some("oidc"),
            Self::Plaintext { key, .. } => Some(key),
            Self::PasswordOnCommandLine { name } => Some(name),
            Self::Value { .. }
            | Self::Unknown { .. }
            | Self::Unreadable { .. }
            | Self::Syntax { .. }
            | Self::NoDataDirectory => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(content: &str, environment: &[(&str, &str)]) -> Vec<String> {
        let directory = tempfile::tempdir().expect("temp dir");
        let path = directory.path().join("taskd.toml");
        std::fs::write(&path, content).expect("written");
        let environment = [("HOME", "/home/ada")].iter().chain(environment);
        let environment: Vec<_> = environment
            .map(|(name, value)| (OsString::from(name), OsString::from(value)))
            .collect();
        let found = Config::check_file(&path, environment.clone()).expect("readable");
        let flags = ServeFlags { config: Some(path.clone()), settings: Vec::new() };
        assert_eq!(found.is_empty(), Config::load(&flags, environment).is_ok(), "{found:?}");
        assert_eq!(std::fs::read_dir(directory.path()).expect("readable").count(), 1);
        found.iter().map(|problem| problem.at("taskd.toml")).collect()
    }

    #[test]
    fn every_error_has_its_line_and_its_key() {
        let content = "htpp = \"127.0.0.1:1\"\nmqtt = 3\n[delivery]\nqos = 7\npart_byts = 1\n\
                       [[delivery.rules]]\nname = \"a\"\nuse = \"fax\"\n[limits]\nx = 1\n";
        let found = check(content, &[]);
        let expected = [
            "taskd.toml:5: delivery.part_byts: there is no such setting; did you mean delivery_part_bytes?",
            "taskd.toml:4: delivery.qos: \"7\" is not a quality of service",
            "taskd.toml:8: delivery.rules[1].use: \"fax\" is none of",
            "taskd.toml:1: htpp: there is no such setting; did you mean http?",
            "taskd.toml:9: limits: there is no such setting",
            "taskd.toml:2: mqtt: \"3\" is not an address",
        ];
        assert_eq!(found.len(), expected.len(), "{found:#?}");
        for (found, expected) in found.iter().zip(expected) {
            assert!(found.starts_with(expected), "{found}");
        }
    }

    #[test]
    fn contradictions_and_syntax_errors_have_lines() {
        assert_eq!(check("http = \"127.0.0.1:1\"\n", &[]), Vec::<String>::new());
        let found = check("drain = \"1s\"\nstandby = true\n", &[]);
        assert!(found[0].starts_with("taskd.toml:2: standby = true: a standby"), "{found:?}");
        let database = [("TASKD_DATABASE", "postgres://ada@db/taskd")];
        assert_eq!(check("standby = true\n", &database), Vec::<String>::new());
        let found = check("[tls]\ncertificate = \"c.pem\"\n", &[]);
        assert!(found[0].starts_with("taskd.toml:2: tls.certificate: tls.key"), "{found:?}");
        let found = check("drain = \"1s\"\nbroker = \"mqtt://ada:swordfish\n", &[]);
        assert!(found[0].starts_with("taskd.toml:2: not valid TOML: "), "{found:?}");
        assert!(!found[0].contains("swordfish"));
    }
}
