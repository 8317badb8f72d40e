//! The reference of all keys of the server's configuration file, from the table that the server
//! reads its settings by. Never reads a file.

use task_proto::toml_keys::{KeyReference, reference_table};

use super::settings::{SETTINGS, Setting};
use super::tables::TABLES;
use crate::domain::delivery::{Comparison, Flag, Quantity, Unit};

/// Keys with several values, which have no flag and no variable: key, default, meaning.
const LISTS: [(&str, &str, &str); 9] = [
    (
        "delivery.rules[].name",
        "required",
        "Name of a rule in `[[delivery.rules]]`, the first of which that fits decides; see docs/delivery.md",
    ),
    ("delivery.rules[].use", "required", "`push-pull`, `direct-push`, `inline` or `poll`"),
    (
        "oidc.rules[].claim",
        "required",
        "Name of a claim in `[[oidc.rules]]`, the first of which that matches decides; see docs/people.md",
    ),
    ("oidc.rules[].value", "required", "Value of the claim, or one of its values"),
    ("oidc.rules[].roles", "required", "Roles of the users with this claim"),
    ("oidc.rules[].robots", "\"*\"", "Selector of the robots that the roles are limited to"),
    ("transfers.sites.NAME.max", "", "Maximum concurrent pulls of the robots at the site NAME"),
    ("transfers.sites.NAME.bytes_per_s", "", "Maximum bandwidth of the site, per second"),
    ("delivery.rules[].CONDITION", "", ""),
];

/// All keys of `taskd.toml`, in Markdown.
pub fn reference() -> String {
    let settings: Vec<_> = SETTINGS.iter().map(Described::of).collect();
    let conditions = conditions();
    let lists = LISTS.map(|(key, default, meaning)| KeyReference {
        key,
        variable: None,
        default,
        meaning: if key.ends_with("CONDITION") { &conditions } else { meaning },
    });
    let keys: Vec<_> = settings.iter().map(Described::reference).chain(lists).collect();
    reference_table(&keys)
}

/// A setting's texts for the reference.
struct Described {
    key: String,
    variable: String,
    default: &'static str,
    meaning: String,
}

impl Described {
    fn of(setting: &Setting) -> Self {
        let (help, default) = setting.described();
        let values = match setting.value_name {
            "BOOL" => "; `true` or `false`".to_owned(),
            words if words.contains('|') => format!("; `{}`", words.replace('|', "`, `")),
            _ => String::new(),
        };
        Self {
            key: setting.path(),
            variable: format!("TASKD_{}", setting.key().to_uppercase()),
            default,
            meaning: format!("{help}{values}"),
        }
    }

    fn reference(&self) -> KeyReference<'_> {
        KeyReference {
            key: &self.key,
            variable: Some(&self.variable),
            default: self.default,
            meaning: &self.meaning,
        }
    }
}

impl Setting {
    /// The help without the default, and the default.
    pub(super) fn described(&self) -> (&'static str, &'static str) {
        let (help, rest) = self.help.split_once(" [default: ").unwrap_or((self.help, ""));
        (help, rest.trim_end_matches(']'))
    }

    /// The key in its table of the file, such as `tls.key`.
    fn path(&self) -> String {
        let key = self.key();
        match key.split_once('_') {
            Some((table, name)) if TABLES.contains(&table) => format!("{table}.{name}"),
            _ => key,
        }
    }
}

/// The conditions of a rule.
fn conditions() -> String {
    let words = Comparison::ALL.map(|comparison| format!("`_{}`", comparison.word())).join(", ");
    let quantities = Quantity::ALL.map(|quantity| {
        let unit = match quantity.unit() {
            Unit::Bytes => "size",
            Unit::BytesPerSecond => "rate",
            Unit::Milliseconds => "time",
            Unit::Percent => "percent",
            Unit::Count => "number",
        };
        format!("`{}` ({unit})", quantity.key())
    });
    let flags = Flag::ALL.map(|flag| format!("`{}`", flag.name())).join(" or ");
    format!(
        "A condition of the rule: one of {} followed by one of {words}, as in `size_above = \"1 MB\"`; or {flags}, \
         `true` or `false`",
        quantities.join(", ")
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::config::cluster::ClusterDraft;

    #[test]
    fn documented_defaults_are_those_of_the_code() {
        let defaults = || Config::with_data("~/.local/share/taskd".into());
        // Any text is a value of these two, and their defaults are words.
        let is_described = |name: &str| matches!(name, "public-mqtt-host" | "cluster-secrets");
        let mut words = Vec::new();
        for setting in SETTINGS.iter().filter(|setting| !is_described(setting.name)) {
            let (_, default) = setting.described();
            let mut config = defaults();
            // A switch without a default is off.
            let is_switch = setting.value_name == "BOOL" && default.is_empty();
            let written = if is_switch { "false" } else { default };
            match (setting.set)(&mut config, written) {
                Ok(()) => {
                    // Any setting of the cluster makes its draft.
                    let draft = config.cluster_draft.take().unwrap_or_default();
                    assert_eq!(format!("{draft:?}"), format!("{:?}", ClusterDraft::default()));
                    let (set, unset) = (format!("{config:?}"), format!("{:?}", defaults()));
                    assert_eq!(set, unset, "{} = {default}", setting.name);
                }
                Err(_) => words.push(setting.name),
            }
        }
        // The others have no default, or one that depends on the machine.
        assert!(words.len() < SETTINGS.len() / 2, "{words:?}");
    }

    #[test]
    fn every_setting_is_listed_once() {
        let reference = reference();
        for setting in SETTINGS {
            let key = format!("| `{}` |", setting.path());
            assert_eq!(reference.matches(&key).count(), 1, "{key}");
        }
    }
}
