//! Robots' settings as they are typed: `workspace=/home/robot/ws`, by the keys of the robot's own
//! property file.

use std::str::FromStr;

use serde_json::{Map, Value};
use task_proto::expected::in_file_words;
use task_proto::settings::RobotSettings;

use crate::commands::CommandError;

/// A setting to change or to reset.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Setting {
    key: String,
    value: String,
}

impl FromStr for Setting {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once('=') {
            Some((key, value)) if !key.is_empty() && !value.is_empty() => {
                Ok(Self { key: key.to_owned(), value: value.to_owned() })
            }
            _ => {
                Err("expected KEY=VALUE, like workspace=/home/robot/ws or limits.log_bytes=1000000"
                    .to_owned())
            }
        }
    }
}

/// `settings` with these changes; the error names the key as typed.
pub(in crate::commands) fn changed(
    settings: Option<&RobotSettings>,
    set: &[Setting],
    unset: &[String],
) -> Result<Option<RobotSettings>, CommandError> {
    let settings = settings.cloned().unwrap_or_default();
    let mut values = match serde_json::to_value(settings) {
        Ok(Value::Object(values)) => values,
        _ => Map::new(),
    };
    let wrong = |text: String| CommandError::Usage(text);
    for key in unset {
        if !RobotSettings::has(key) {
            return Err(wrong(format!("{key}: there is no such setting")));
        }
        put(&mut values, key, None);
    }
    for Setting { key, value } in set {
        if !RobotSettings::has(key) {
            return Err(wrong(format!("{key}: there is no such setting")));
        }
        put(&mut values, key, Some(typed(key, value)));
    }
    let read: RobotSettings =
        serde_path_to_error::deserialize(Value::Object(values)).map_err(|error| {
            wrong(format!("{}: {}", error.path(), in_file_words(&error.inner().to_string())))
        })?;
    read.check().map_err(|error| wrong(error.to_string()))?;
    Ok((!read.is_empty()).then_some(read))
}

/// Formats settings as typed: `workspace=/ws limits.log_bytes=1000000`.
pub(in crate::commands) fn shown(settings: &RobotSettings) -> String {
    let mut texts = Vec::new();
    if let Ok(Value::Object(values)) = serde_json::to_value(settings) {
        for (key, value) in values {
            match value {
                Value::Object(table) => {
                    texts.extend(
                        table
                            .iter()
                            .map(|(inner, value)| format!("{key}.{inner}={}", plain(value))),
                    );
                }
                value => texts.push(format!("{key}={}", plain(&value))),
            }
        }
    }
    if texts.is_empty() { "-".to_owned() } else { texts.join(" ") }
}

fn plain(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Array(values) => values.iter().map(plain).collect::<Vec<_>>().join(","),
        other => other.to_string(),
    }
}

fn put(values: &mut Map<String, Value>, key: &str, value: Option<Value>) {
    let (table, rest) = match key.split_once('.') {
        Some((table, rest)) => (Some(table), rest),
        None => (None, key),
    };
    let values = match table {
        Some(table) => match values.entry(table).or_insert_with(|| Value::Object(Map::new())) {
            Value::Object(values) => values,
            _ => return,
        },
        None => values,
    };
    match value {
        Some(value) => drop(values.insert(rest.to_owned(), value)),
        None => drop(values.remove(rest)),
    }
}

fn typed(key: &str, value: &str) -> Value {
    match value.parse::<u64>() {
        Ok(number) => number.into(),
        Err(_) if key == "underlays" => value.split(',').map(str::trim).collect(),
        Err(_) => value.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(texts: &[&str]) -> Result<Option<RobotSettings>, String> {
        let settings: Vec<Setting> = texts.iter().map(|text| text.parse().expect(text)).collect();
        changed(None, &settings, &[]).map_err(|error| error.to_string())
    }

    #[test]
    fn settings_are_typed_by_their_keys() {
        let read = set(&[
            "underlays=/a/setup.bash, /b/setup.bash",
            "ros_domain_id=7",
            "limits.log_bytes=5000000",
        ]);
        let read = read.expect("good").expect("some");
        assert_eq!((read.underlays.as_ref().map(Vec::len), read.ros_domain_id), (Some(2), Some(7)));
        assert_eq!(read.limits.log_bytes, Some(5_000_000));
        assert_eq!(
            shown(&read),
            "limits.log_bytes=5000000 ros_domain_id=7 underlays=/a/setup.bash,/b/setup.bash"
        );
        let unset = ["underlays", "ros_domain_id", "limits.log_bytes"].map(str::to_owned);
        assert_eq!(changed(Some(&read), &[], &unset).expect("good"), None);
        let kept = changed(Some(&read), &[], &unset[..2]).expect("good").expect("some");
        assert_eq!(kept.limits.log_bytes, Some(5_000_000));
    }

    #[test]
    fn what_is_wrong_is_named_by_its_key() {
        for (text, said) in [
            ("workspce=/ws", "workspce: there is no such setting"),
            ("limits.log=1", "limits.log: there is no such setting"),
            ("workspace=ws", "workspace: "),
            ("ros_domain_id=400", "ros_domain_id: 400 is not between"),
            ("ros_domain_id=x", "ros_domain_id: "),
            (
                "limits.log_bytes=1MB",
                "limits.log_bytes: invalid type: string \"1MB\", expected a whole number",
            ),
        ] {
            let error = set(&[text]).expect_err(text);
            assert!(error.starts_with(said), "{text}: {error}");
        }
        assert!("workspace".parse::<Setting>().is_err());
        let error = changed(None, &[], &["workspce".to_owned()]).expect_err("no such setting");
        assert_eq!(error.to_string(), "workspce: there is no such setting");
    }
}
