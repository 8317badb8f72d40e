//! The tables of the configuration file: `[blobs]`, `[cluster]`, `[delivery]` with the operator's
//! rules, `[transfers]` with the limits of each site, `[robots]` and `[people]` with rate limits,
//! `[oidc]`, `[tls]`. A key with a single value is an ordinary setting; the rest is read here.
//! Every error names its key.

use std::collections::BTreeMap;
use std::path::Path;

use task_proto::desired::Delivery;
use task_proto::ids::LabelValue;
use task_proto::size::parse_bytes;
use task_proto::time::{millis, parse_duration};

use super::oidc::TableError;
use super::settings::Setting;
use super::{Config, ConfigError, Origin, oidc, suggestion};
use crate::domain::delivery::{Condition, ConditionKey, MAX_RULES, Quantity, Rule, Rules, Unit};

/// Maximum number of sites with limits of their own.
const MAX_SITES: usize = 4096;
/// Maximum length of a rule's name.
const MAX_NAME_CHARS: usize = 64;
/// The mechanisms that a rule may use, by their words.
const MECHANISMS: [Delivery; 4] =
    [Delivery::PushPull, Delivery::DirectPush, Delivery::Inline, Delivery::Poll];

/// The bounds on transfers of packages over HTTP.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TransferLimits {
    /// For all robots together.
    pub all: SiteLimits,
    /// For the robots on one site, by the value of [`super::DeliverySettings::site_label`].
    pub sites: BTreeMap<LabelValue, SiteLimits>,
}

/// `[people]`: rate limits of a person.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PersonRates {
    /// Sustained requests per second, with a burst of ten seconds' worth. Orders have a separate
    /// limit of the same size.
    pub requests_per_s: u64,
}

impl Default for PersonRates {
    fn default() -> Self {
        Self { requests_per_s: 200 }
    }
}

/// Limits of a group of robots together; `None`: unlimited.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SiteLimits {
    pub max: Option<u64>,
    pub bytes_per_s: Option<u64>,
}

/// Minimum bandwidth of a transfer: several times the speed that an agent treats as a stall.
const MIN_SHARE_BYTES_PER_S: u64 = 4 << 10;

impl SiteLimits {
    /// Maximum concurrent transfers, such that each has a minimum share of the bandwidth.
    pub fn max_transfers(&self) -> Option<u64> {
        let with_share = self.bytes_per_s.map(|bytes| (bytes / MIN_SHARE_BYTES_PER_S).max(1));
        [self.max, with_share].into_iter().flatten().min()
    }
}

/// The tables that the file may have.
pub(super) const TABLES: [&str; 9] =
    ["blobs", "cluster", "delivery", "enrolment", "oidc", "people", "robots", "tls", "transfers"];

/// Whether the file may have a table of this name.
pub(super) fn is_known(name: &str) -> bool {
    TABLES.contains(&name)
}

impl Config {
    /// Applies the keys of a table, and adds their errors to `errors`.
    pub(super) fn apply_table(
        &mut self,
        path: &Path,
        name: &str,
        table: toml::Table,
        errors: &mut Vec<ConfigError>,
    ) {
        let origin =
            |key: String| Origin::File { key: format!("{name}.{key}"), path: path.to_owned() };
        if name == "cluster" {
            // An empty table is a mistake, and not a single server.
            self.cluster_mut();
        }
        for (key, value) in table {
            let setting = format!("{name}_{key}");
            let read = match (name, key.as_str()) {
                ("delivery", "rules") => rules(value).map(|rules| self.delivery.own_rules = rules),
                ("oidc", "rules") => oidc::rules(value).map(|rules| self.oidc.rules = rules),
                ("transfers", "sites") => sites(value).map(|sites| self.transfers.sites = sites),
                _ if Setting::by_key(&setting).is_none() => {
                    let hint = suggestion(&setting);
                    errors.push(ConfigError::Unknown { hint, origin: origin(key) });
                    continue;
                }
                _ => {
                    errors.extend(self.apply_value(&setting, value, origin(key)).err());
                    continue;
                }
            };
            errors.extend(read.err().map(|error| ConfigError::Value {
                origin: origin(error.key),
                reason: error.reason,
            }));
        }
    }
}

/// `[[delivery.rules]]`, counted from 1.
fn rules(value: toml::Value) -> Result<Vec<Rule>, TableError> {
    let error_at = |reason: String| TableError { key: "rules".to_owned(), reason };
    let toml::Value::Array(values) = value else {
        return Err(error_at("expected [[delivery.rules]], a list of tables".to_owned()));
    };
    if values.len() > MAX_RULES {
        return Err(error_at(format!("{} rules; at most {MAX_RULES} are allowed", values.len())));
    }
    let mut rules: Vec<Rule> = Vec::with_capacity(values.len());
    for (at, value) in values.into_iter().enumerate() {
        let below = |error: TableError| {
            let dot = if error.key.is_empty() { "" } else { "." };
            TableError { key: format!("rules[{}]{dot}{}", at + 1, error.key), reason: error.reason }
        };
        let own = |key: &str, reason: String| below(TableError { key: key.to_owned(), reason });
        let toml::Value::Table(table) = value else {
            return Err(own("", "expected a table".to_owned()));
        };
        let rule = rule(table).map_err(below)?;
        if Rules::is_reserved(&rule.name) || rules.iter().any(|other| other.name == rule.name) {
            return Err(own("name", format!("{:?} is the name of another rule", rule.name)));
        }
        if let Some(last) = rules.last().filter(|last| last.conditions.is_empty()) {
            return Err(own(
                "",
                format!("never reached: the rule {:?} before it has no conditions", last.name),
            ));
        }
        rules.push(rule);
    }
    Ok(rules)
}

fn rule(table: toml::Table) -> Result<Rule, TableError> {
    let (mut name, mut mechanism, mut conditions) = (None, None, Vec::new());
    for (key, value) in table {
        let read = match (key.as_str(), Condition::by_key(&key)) {
            ("name", _) => rule_name(&value).map(|read| name = Some(read)),
            ("use", _) => mechanism_named(&value).map(|read| mechanism = Some(read)),
            (_, Some(known)) => {
                condition(known, &value).map(|read| conditions.push((key.clone(), read)))
            }
            _ => Err("there is no such condition; docs/delivery.md lists them".to_owned()),
        };
        read.map_err(|reason| TableError { key, reason })?;
    }
    let missing = |key: &str, what: &str| TableError {
        key: key.to_owned(),
        reason: format!("missing: {what}"),
    };
    let name = name.ok_or_else(|| missing("name", "the rule's name, shown with its decisions"))?;
    let mechanism =
        mechanism.ok_or_else(|| missing("use", "the mechanism for matching deliveries"))?;
    check_possible(&conditions)?;
    Ok(Rule {
        name,
        conditions: conditions.into_iter().map(|(_, condition)| condition).collect(),
        mechanism,
    })
}

fn rule_name(value: &toml::Value) -> Result<String, String> {
    let is_name = |name: &&str| {
        (1..=MAX_NAME_CHARS).contains(&name.chars().count())
            && name.trim() == *name
            && !name.chars().any(char::is_control)
    };
    let name = value.as_str().filter(is_name);
    name.map(str::to_owned)
        .ok_or_else(|| format!("expected a string of 1 to {MAX_NAME_CHARS} printable characters"))
}

fn mechanism_named(value: &toml::Value) -> Result<Delivery, String> {
    let found =
        value.as_str().and_then(|word| MECHANISMS.into_iter().find(|known| known.as_str() == word));
    let words = || MECHANISMS.map(|known| format!("{:?}", known.as_str())).join(", ");
    found.ok_or_else(|| format!("{value} is none of {}", words()))
}

fn condition(key: ConditionKey, value: &toml::Value) -> Result<Condition, String> {
    let (quantity, comparison) = match key {
        ConditionKey::Flag(flag) => {
            let wanted =
                value.as_bool().ok_or_else(|| format!("{value} is neither true nor false"))?;
            return Ok(Condition::Flag(flag, wanted));
        }
        ConditionKey::Measure(quantity, comparison) => (quantity, comparison),
    };
    let whole = value.as_integer().and_then(|number| u64::try_from(number).ok());
    let (read, expected) = match quantity.unit() {
        Unit::Bytes => {
            (whole.or_else(|| parse_bytes(value.as_str()?)), "a size, for example \"256 KB\"")
        }
        Unit::BytesPerSecond => {
            let rate = |text: &str| parse_bytes(text.strip_suffix("/s").unwrap_or(text));
            (whole.or_else(|| rate(value.as_str()?)), "a rate, for example \"500 KB/s\"")
        }
        Unit::Milliseconds => {
            let time = |text: &str| parse_duration(text).map(millis);
            (value.as_str().and_then(time), "a time, for example \"100ms\"")
        }
        Unit::Percent => (whole.filter(|percent| *percent <= 100), "a whole number from 0 to 100"),
        Unit::Count => (whole, "a whole number"),
    };
    let read = read.ok_or_else(|| format!("{value} is not {expected}"))?;
    Ok(Condition::Measure(quantity, comparison, read))
}

/// Refuses conditions that can never hold, alone or together.
fn check_possible(conditions: &[(String, Condition)]) -> Result<(), TableError> {
    let mut ranges: BTreeMap<&str, (u64, u64)> = BTreeMap::new();
    for (key, condition) in conditions {
        let Condition::Measure(quantity, comparison, value) = condition else { continue };
        let most = if quantity.unit() == Unit::Percent { 100 } else { u64::MAX };
        let known = ranges.entry(quantity.key()).or_insert((minimum(*quantity), most));
        let range =
            comparison.range(*value).map(|(least, most)| (least.max(known.0), most.min(known.1)));
        match range.filter(|(least, most)| least <= most) {
            Some(range) => *known = range,
            None => {
                let shown = quantity.unit().format(*value);
                let reason = format!(
                    "{shown}: no {} can satisfy this and the rule's other conditions",
                    quantity.key()
                );
                return Err(TableError { key: key.clone(), reason });
            }
        }
    }
    Ok(())
}

/// A robot always counts itself in its deployment, batch and site.
fn minimum(quantity: Quantity) -> u64 {
    u64::from(matches!(quantity, Quantity::Robots | Quantity::Batch | Quantity::SameSite))
}

/// `[transfers.sites.NAME]`, by the label's value.
fn sites(value: toml::Value) -> Result<BTreeMap<LabelValue, SiteLimits>, TableError> {
    let error_at = |key: String, reason: String| TableError { key: format!("sites{key}"), reason };
    let toml::Value::Table(table) = value else {
        return Err(error_at(
            String::new(),
            "expected [transfers.sites.NAME], tables by the label's value".to_owned(),
        ));
    };
    if table.len() > MAX_SITES {
        return Err(error_at(
            String::new(),
            format!("{} sites; at most {MAX_SITES} are allowed", table.len()),
        ));
    }
    let mut sites = BTreeMap::new();
    for (name, value) in table {
        let site: LabelValue =
            name.parse().map_err(|error| error_at(format!(".{name}"), format!("{error}")))?;
        let toml::Value::Table(limits) = value else {
            return Err(error_at(
                format!(".{name}"),
                "expected a table with max or bytes_per_s".to_owned(),
            ));
        };
        let mut read = SiteLimits::default();
        for (key, value) in limits {
            let at_least = |least: u64| move |number: &u64| *number >= least;
            let whole = value.as_integer().and_then(|number| u64::try_from(number).ok());
            let (limit, found, expected) = match key.as_str() {
                "max" => (&mut read.max, whole.filter(at_least(1)), "a whole number from 1"),
                "bytes_per_s" => {
                    let bytes =
                        whole.or_else(|| parse_bytes(value.as_str()?)).filter(at_least(1024));
                    (&mut read.bytes_per_s, bytes, "a size from 1 KB, for example \"10 MB\"")
                }
                _ => {
                    return Err(error_at(
                        format!(".{name}.{key}"),
                        "there is no such limit".to_owned(),
                    ));
                }
            };
            *limit = Some(found.ok_or_else(|| {
                error_at(format!(".{name}.{key}"), format!("{value} is not {expected}"))
            })?);
        }
        sites.insert(site, read);
    }
    Ok(sites)
}

#[cfg(test)]
mod tests {
    use super::super::tests::load;
    use super::*;

    #[test]
    fn delivery_and_transfer_tables_are_read_completely() {
        let file = r#"
            [delivery]
            part_bytes = "1 MB"
            qos = 2
            inline_bytes = 1000
            site_label = "hall"
            [[delivery.rules]]
            name = "slow modems"
            metered = true
            throughput_below = "500 KB/s"
            rtt_above = "100ms"
            battery_below = 20
            size_above = "256 KB"
            size_at_most = 1048576
            use = "poll"
            [[delivery.rules]]
            name = "everyone else"
            use = "direct-push"
            [transfers]
            max = 8
            bytes_per_s = "20 MB"
            [transfers.sites.lab]
            max = 2
            [transfers.sites.yard]
            bytes_per_s = "1 MB"
        "#;
        let config = load(&[("transfers-max", "9")], &[("TASKD_DELIVERY_QOS", "0")], Some(file))
            .expect("loads");
        let delivery = &config.delivery;
        assert_eq!((delivery.part_bytes, delivery.qos, delivery.inline_bytes), (1 << 20, 0, 1000));
        assert_eq!(delivery.site_label.as_str(), "hall");
        let names: Vec<(&str, usize, Delivery)> = delivery
            .own_rules
            .iter()
            .map(|rule| (rule.name.as_str(), rule.conditions.len(), rule.mechanism))
            .collect();
        assert_eq!(
            names,
            [("slow modems", 6, Delivery::Poll), ("everyone else", 0, Delivery::DirectPush)]
        );
        let measure = |key: &str, value| match Condition::by_key(key) {
            Some(ConditionKey::Measure(quantity, comparison)) => {
                Condition::Measure(quantity, comparison, value)
            }
            other => panic!("{key}: {other:?}"),
        };
        for (key, value) in [
            ("throughput_below", 512_000),
            ("rtt_above", 100),
            ("size_above", 262_144),
            ("battery_below", 20),
        ] {
            assert!(delivery.own_rules[0].conditions.contains(&measure(key, value)), "{key}");
        }
        let limits = |max, bytes_per_s| SiteLimits { max, bytes_per_s };
        assert_eq!(config.transfers.all, limits(Some(9), Some(20 << 20)));
        assert_eq!(
            config.transfers.sites[&"lab".parse::<LabelValue>().expect("valid")],
            limits(Some(2), None)
        );
        assert_eq!(config.transfers.sites.len(), 2);
    }

    #[test]
    fn invalid_rule_is_refused_by_its_key() {
        let good = "[[delivery.rules]]\nname = \"one\"\nrobots_at_least = 2\nuse = \"poll\"\n[[delivery.rules]]\n";
        for (second, expected) in [
            ("name = \"two\"", "delivery.rules[2].use in taskd.toml: missing"),
            ("use = \"poll\"", "delivery.rules[2].name in taskd.toml: missing"),
            (
                "name = \"\"\nuse = \"poll\"",
                "delivery.rules[2].name in taskd.toml: expected a string",
            ),
            (
                "name = \"one\"\nuse = \"poll\"",
                "delivery.rules[2].name in taskd.toml: \"one\" is the name of another",
            ),
            (
                "name = \"tiny\"\nuse = \"poll\"",
                "delivery.rules[2].name in taskd.toml: \"tiny\" is the name of another",
            ),
            (
                "name = \"ordered\"\nuse = \"poll\"",
                "delivery.rules[2].name in taskd.toml: \"ordered\" is the name",
            ),
            (
                "use = \"adaptive\"",
                "delivery.rules[2].use in taskd.toml: \"adaptive\" is none of \"push-pull\", ",
            ),
            ("use = 1", "delivery.rules[2].use in taskd.toml: 1 is none of"),
            (
                "size_over = 1",
                "delivery.rules[2].size_over in taskd.toml: there is no such condition",
            ),
            (
                "size_above = \"9.7 mb/s\"",
                "delivery.rules[2].size_above in taskd.toml: \"9.7 mb/s\" is not a size, for",
            ),
            ("size_above = -1", "delivery.rules[2].size_above in taskd.toml: -1 is not a size"),
            (
                "throughput_below = \"fast\"",
                "delivery.rules[2].throughput_below in taskd.toml: \"fast\" is not a rate",
            ),
            ("rtt_above = 100", "delivery.rules[2].rtt_above in taskd.toml: 100 is not a time"),
            (
                "battery_below = 101",
                "delivery.rules[2].battery_below in taskd.toml: 101 is not a whole number from 0",
            ),
            (
                "losses_above = \"x\"",
                "delivery.rules[2].losses_above in taskd.toml: \"x\" is not a whole number",
            ),
            (
                "metered = \"yes\"",
                "delivery.rules[2].metered in taskd.toml: \"yes\" is neither true nor false",
            ),
        ] {
            let message = load(&[], &[], Some(&format!("{good}{second}"))).expect_err(expected);
            assert!(message.starts_with(expected), "{message}");
        }
        for (file, expected) in [
            ("[delivery]\nrules = 1", "delivery.rules in taskd.toml: expected [[delivery.rules]]"),
            ("[delivery]\nrules = [1]", "delivery.rules[1] in taskd.toml: expected a table"),
        ] {
            let message = load(&[], &[], Some(file)).expect_err(expected);
            assert!(message.starts_with(expected), "{message}");
        }
    }

    #[test]
    fn impossible_rules_are_refused() {
        let rule = |conditions: &str| {
            format!("[[delivery.rules]]\nname = \"one\"\nuse = \"poll\"\n{conditions}")
        };
        for (conditions, key) in [
            ("size_below = 0", "size_below"),
            ("battery_above = 100", "battery_above"),
            ("robots_below = 1", "robots_below"),
            ("size_above = \"1 MB\"\nsize_at_most = \"1 MB\"", "size_at_most"),
            ("rtt_above = \"10ms\"\nrtt_below = \"11ms\"", "rtt_below"),
        ] {
            let message = load(&[], &[], Some(&rule(conditions))).expect_err(conditions);
            assert!(
                message.starts_with(&format!("delivery.rules[1].{key} in taskd.toml: ")),
                "{message}"
            );
            assert!(message.contains("can satisfy this"), "{message}");
        }
        assert!(load(&[], &[], Some(&rule("rtt_above = \"10ms\"\nrtt_below = \"12ms\""))).is_ok());
        let dead = format!("{}\n[[delivery.rules]]\nname = \"two\"\nuse = \"poll\"", rule(""));
        let message = load(&[], &[], Some(&dead)).expect_err("never reached");
        assert!(
            message.starts_with("delivery.rules[2] in taskd.toml: never reached: the rule \"one\""),
            "{message}"
        );
        let many: String = (0..=MAX_RULES)
            .map(|n| {
                format!("[[delivery.rules]]\nname = \"n{n}\"\nmetered = true\nuse = \"poll\"\n")
            })
            .collect();
        let message = load(&[], &[], Some(&many)).expect_err("too many");
        assert!(
            message.starts_with("delivery.rules in taskd.toml: 65 rules; at most 64"),
            "{message}"
        );
    }

    #[test]
    fn invalid_site_is_refused_by_its_key() {
        for (file, expected) in [
            (
                "[transfers]\nsites = 1",
                "transfers.sites in taskd.toml: expected [transfers.sites.NAME]",
            ),
            ("[transfers.sites]\nlab = 1", "transfers.sites.lab in taskd.toml: expected a table"),
            (
                "[transfers.sites.lab]\nmax = 0",
                "transfers.sites.lab.max in taskd.toml: 0 is not a whole number from 1",
            ),
            (
                "[transfers.sites.lab]\nbytes_per_s = 1",
                "transfers.sites.lab.bytes_per_s in taskd.toml: 1 is not a size",
            ),
            (
                "[transfers.sites.lab]\nmix = 1",
                "transfers.sites.lab.mix in taskd.toml: there is no such limit",
            ),
            (
                "[transfers.sites.\"a b\"]\nmax = 1",
                "transfers.sites.a b in taskd.toml: \"a b\" is not a valid label",
            ),
        ] {
            let message = load(&[], &[], Some(file)).expect_err(expected);
            assert!(message.starts_with(expected), "{message}");
        }
    }
}
