//! Robots' settings as they are typed: `workspace=/home/robot/ws`, by the keys of the robot's own
//! property file.

use std::str::FromStr;

use serde_json::{Map, Value};
use task_proto::desired::settings::RobotSettings;
use task_proto::expected::in_file_terms;

use crate::CommandError;

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
            _ => Err(
                "expected KEY=VALUE, such as workspace=/home/robot/ws or limits.log_bytes=1000000"
                    .to_owned(),
            ),
        }
    }
}

/// `settings` with these changes; the error names the key as typed.
pub(crate) fn apply_changes(
    settings: Option<&RobotSettings>,
    set: &[Setting],
    unset: &[String],
) -> Result<Option<RobotSettings>, CommandError> {
    let settings = settings.cloned().unwrap_or_default();
    let mut values = match serde_json::to_value(settings) {
        Ok(Value::Object(values)) => values,
        _ => Map::new(),
    };
    let usage = |text: String| CommandError::Usage(text);
    for key in unset {
        if !RobotSettings::has(key) {
            return Err(usage(format!("{key}: unknown setting")));
        }
        set_value(&mut values, key, None);
    }
    for Setting { key, value } in set {
        if !RobotSettings::has(key) {
            return Err(usage(format!("{key}: unknown setting")));
        }
        set_value(&mut values, key, Some(parse_value(key, value)));
    }
    let read: RobotSettings =
        serde_path_to_error::deserialize(Value::Object(values)).map_err(|error| {
            usage(format!("{}: {}", error.path(), in_file_terms(&error.inner().to_string())))
        })?;
    read.check().map_err(|error| usage(error.to_string()))?;
    Ok((!read.is_empty()).then_some(read))
}

/// Formats settings as typed: `workspace=/ws limits.log_bytes=1000000`.
pub(crate) fn format_settings(settings: &RobotSettings) -> String {
    let mut texts = Vec::new();
    if let Ok(Value::Object(values)) = serde_json::to_value(settings) {
        for (key, value) in values {
            match value {
                Value::Object(table) => {
                    texts.extend(
                        table
                            .iter()
                            .map(|(inner, value)| format!("{key}.{inner}={}", format_value(value))),
                    );
                }
                value => texts.push(format!("{key}={}", format_value(&value))),
            }
        }
    }
    if texts.is_empty() { "-".to_owned() } else { texts.join(" ") }
}

fn format_value(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Array(values) => values.iter().map(format_value).collect::<Vec<_>>().join(","),
        other => other.to_string(),
    }
}

fn set_value(values: &mut Map<String, Value>, key: &str, value: Option<Value>) {
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

fn parse_value(key: &str, value: &str) -> Value {
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
        apply_changes(None, &settings, &[]).map_err(|error| error.to_string())
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
            format_settings(&read),
            "limits.log_bytes=5000000 ros_domain_id=7 underlays=/a/setup.bash,/b/setup.bash"
        );
        let unset = ["underlays", "ros_domain_id", "limits.log_bytes"].map(str::to_owned);
        assert_eq!(apply_changes(Some(&read), &[], &unset).expect("good"), None);
        let kept = apply_changes(Some(&read), &[], &unset[..2]).expect("good").expect("some");
        assert_eq!(kept.limits.log_bytes, Some(5_000_000));
    }

    #[test]
    fn invalid_setting_is_named_by_its_key() {
        for (text, said) in [
            ("workspce=/ws", "workspce: unknown setting"),
            ("limits.log=1", "limits.log: unknown setting"),
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
        let error =
            apply_changes(None, &[], &["workspce".to_owned()]).expect_err("no such setting");
        assert_eq!(error.to_string(), "workspce: unknown setting");
    }
}
