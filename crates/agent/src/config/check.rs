//! `task-agent config check`: all errors of a property file with their lines, by the rules of the
//! start. Never writes.

use std::ffi::OsString;
use std::path::Path;

use task_proto::toml_keys::{FileProblem, closest_key, line_of};
use toml::{Table, Value};

use super::reference::KEYS;
use super::{Config, ConfigError, Settings, deserialize};

/// Tables whose keys are checked together, because they depend on each other.
const JOINT_TABLES: [&str; 2] = ["gate", "trusted_publishers"];

/// The errors for which the agent would refuse the file at `path` with these variables: those of
/// all keys, else the first one that the agent would report.
pub fn check_file(
    path: &Path,
    variables: impl Iterator<Item = (OsString, OsString)>,
) -> Result<Vec<FileProblem>, ConfigError> {
    let content = std::fs::read_to_string(path)
        .map_err(|source| ConfigError::Io { path: path.to_owned(), source })?;
    let table = match content.parse::<Table>() {
        Ok(table) => table,
        Err(error) => {
            let line = error.span().map(|span| line_of(&content, span.start));
            let text = format!("not valid TOML: {}", error.message());
            return Ok(vec![FileProblem { line, text }]);
        }
    };
    let found: Vec<_> = table.into_iter().flat_map(|(key, value)| problems(key, value)).collect();
    if found.is_empty() {
        let refused = Config::load_file(path, variables).err();
        let refused = refused.map(|error| FileProblem { line: None, text: error.to_string() });
        return Ok(refused.into_iter().collect());
    }
    let place = |(key, reason): (String, String)| FileProblem::of_key(&content, &key, &reason);
    Ok(found.into_iter().map(place).collect())
}

/// The errors of a key of the file: key and reason of each.
fn problems(key: String, value: Value) -> Vec<(String, String)> {
    let is_table = KEYS.iter().any(|(known, ..)| known.starts_with(&format!("{key}.")));
    match value {
        Value::Table(mut inner) if is_table => {
            let prefix = format!("{key}.");
            let names: Vec<String> = inner.keys().cloned().collect();
            let mut found = Vec::new();
            for name in names {
                if let Some(problem) = unknown(&format!("{prefix}{name}")) {
                    inner.remove(&name);
                    found.push(problem);
                }
            }
            if JOINT_TABLES.contains(&key.as_str()) {
                found.extend(problem(&key, Table::from_iter([(key.clone(), Value::Table(inner))])));
            } else {
                found.extend(inner.into_iter().filter_map(|(name, value)| {
                    let alone = Table::from_iter([(name.clone(), value)]);
                    let alone = Table::from_iter([(key.clone(), Value::Table(alone))]);
                    problem(&format!("{prefix}{name}"), alone)
                }));
            }
            found
        }
        value => match unknown(&key) {
            Some(unknown) if !is_table => vec![unknown],
            _ => problem(&key, Table::from_iter([(key.clone(), value)])).into_iter().collect(),
        },
    }
}

/// The error of a key that does not exist.
fn unknown(key: &str) -> Option<(String, String)> {
    let known = KEYS.map(|(known, ..)| known);
    if known.contains(&key) {
        return None;
    }
    let hint = closest_key(key, known).map(|best| format!("; did you mean {best}?"));
    let reason = format!("there is no such setting{}", hint.unwrap_or_default());
    Some((key.to_owned(), reason))
}

/// The error of `key`, which is alone in `table`.
fn problem(key: &str, table: Table) -> Option<(String, String)> {
    let settings: Settings = match deserialize(table, key) {
        Ok(settings) => settings,
        Err(error) => return Some((key.to_owned(), reason(error))),
    };
    match Config::from_settings(settings) {
        // This error names its key in a table, such as `gate.command`.
        Err(ConfigError::Invalid { origin, reason }) => Some((origin, reason)),
        Err(error) => Some((key.to_owned(), error.to_string())),
        Ok(_) => None,
    }
}

/// The reason of an error, without the position that the parser adds on further lines.
fn reason(error: ConfigError) -> String {
    match error {
        ConfigError::Invalid { reason, .. } => reason.lines().next().unwrap_or_default().to_owned(),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(content: &str) -> Vec<String> {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("robot.toml");
        std::fs::write(&path, content).expect("written");
        let found = check_file(&path, std::iter::empty()).expect("readable");
        let loads = Config::load_file(&path, std::iter::empty()).is_ok();
        assert_eq!(found.is_empty(), loads, "{content}: {found:?}");
        assert_eq!(std::fs::read_dir(dir.path()).expect("readable").count(), 1);
        found.iter().map(|problem| problem.at("robot.toml")).collect()
    }

    #[test]
    fn every_error_has_its_line_and_its_key() {
        let content = "servr = \"http://x\"\npoll_interval_s = \"soon\"\nros_domain_id = 400\n\
                       [gate]\ncommand = [\"gate\"]\ntimeout = 3\n\
                       [limits]\nlog_bytes = 1\nlog_byte = 2\nparallel_tasks = true\n";
        let mut found = check(content);
        found.sort_by_key(|problem| {
            problem.split(':').nth(1).and_then(|line| line.parse::<u32>().ok())
        });
        let expected = [
            "robot.toml:1: servr: there is no such setting; did you mean server?",
            "robot.toml:2: poll_interval_s: invalid type: string \"soon\", expected a whole number",
            "robot.toml:3: ros_domain_id: 400 is not between 0 and 232",
            "robot.toml:5: gate.command: needs a program by its absolute path",
            "robot.toml:6: gate.timeout: there is no such setting; did you mean gate.timeout_s?",
            "robot.toml:8: limits.log_bytes: 1 is not between 4096 and ",
            "robot.toml:9: limits.log_byte: there is no such setting; did you mean limits.log_bytes?",
            "robot.toml:10: limits.parallel_tasks: invalid type: boolean `true`, expected a whole number",
        ];
        assert_eq!(found.len(), expected.len(), "{found:#?}");
        for (found, expected) in found.iter().zip(expected) {
            assert!(found.starts_with(expected), "{found}");
        }
    }

    #[test]
    fn check_and_start_agree() {
        for content in [
            "",
            "server = \"http://server:8080\"\n[logs]\nforward_level = \"warn\"\n",
            "limits = 3\n",
            "[gate]\ntimeout_s = 3\n",
            "[trusted_publishers]\nkeys = []\n",
            "workspace = \"ws\"\n",
            "task_uids = \"1-2\"\n",
            "[colour]\nred = 1\n",
            "name =",
        ] {
            check(content);
        }
    }
}
