//! Chooses the mechanism that brings a package to a robot: the first matching rule decides. These
//! are pure functions. [`crate::orders::delivery_planner`] gathers their inputs, and
//! [`crate::config`] reads the operator's rules.

use std::fmt;

use serde::Serialize;
use task_proto::api::{DeliveryChoice, DeliveryDecision, RuleView};
use task_proto::desired::Delivery;
use task_proto::size::{format_bytes, format_rate};

/// The most rules an operator may write.
pub const MAX_RULES: usize = 64;
/// The name of the last resort, which decides when no rule matches.
const DEFAULT_RULE: &str = "otherwise";

/// The facts known when one robot's part of a deployment begins.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Inputs {
    /// Bytes of the package in transit: content and config.
    pub size: u64,
    /// The part of `size` that this robot does not have.
    pub lacking: u64,
    /// Robots in the deployment.
    pub robots: u64,
    /// Robots that begin together with this one.
    pub batch: u64,
    /// Robots of the deployment on the same site, this one included; `None` if no rule asks for the
    /// number.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub same_site: Option<u64>,
    /// Whether the robot is connected over MQTT.
    pub connected: bool,
    /// Whether the robot's traffic costs money: the label `metered=true`.
    pub metered: bool,
    /// The link's throughput in earlier transfers; `None`: not measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub throughput_bytes_per_s: Option<u64>,
    /// The link's round-trip time in earlier transfers; `None`: not measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rtt_ms: Option<u64>,
    /// Transfers that broke off in the last hour before the robot's report.
    pub losses: u64,
    /// Sessions lost in the same hour.
    pub reconnects: u64,
    /// The battery's charge; `None`: not reported.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub battery_percent: Option<u64>,
    /// Transfers that the server serves at the moment.
    pub transfers: u64,
    /// Bytes of parts that wait in the server for subscribers to take them.
    pub backlog: u64,
}

/// A number that rules can compare.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Quantity {
    Size,
    Lacking,
    Robots,
    Batch,
    SameSite,
    Throughput,
    Rtt,
    Losses,
    Reconnects,
    Battery,
    Transfers,
    Backlog,
}

/// The unit in which a quantity is given and shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// `256 KB`; a KB is 1,024 bytes.
    Bytes,
    /// `256 KB/s`, in the units of [`Unit::Bytes`].
    BytesPerSecond,
    Milliseconds,
    Percent,
    Count,
}

/// The comparison of a quantity with a rule's value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Comparison {
    Above,
    AtMost,
    AtLeast,
    Below,
}

/// A fact that is true or false.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Flag {
    Metered,
    Connected,
}

/// One condition of a rule. A quantity that is not known satisfies no condition.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Condition {
    /// The quantity satisfies the comparison with a value.
    Measure(Quantity, Comparison, u64),
    /// The flag has this value.
    Flag(Flag, bool),
}

/// A rule: its mechanism is used if all conditions hold.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rule {
    /// The name shown with a decision.
    pub name: String,
    /// The conditions; without any, the rule always matches.
    pub conditions: Vec<Condition>,
    /// The mechanism to use.
    pub mechanism: Delivery,
}

/// All rules: the operator's, then the built-in ones. The last resort is to push the link and let
/// the robot pull.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rules(Vec<Rule>);

impl Rules {
    /// `own` rules before the built-in ones. No rule puts more than `inline_bytes` into an
    /// announcement.
    pub fn new(own: Vec<Rule>, inline_bytes: u64) -> Self {
        let mut rules: Vec<Rule> = own.into_iter().chain(Self::built_in()).collect();
        for rule in rules.iter_mut().filter(|rule| rule.mechanism == Delivery::Inline) {
            rule.conditions.push(Condition::Measure(
                Quantity::Size,
                Comparison::AtMost,
                inline_bytes,
            ));
        }
        Self(rules)
    }

    /// The rules that follow the operator's. In our measurements no mechanism was faster or cheaper
    /// than these rules and the last resort; see docs/delivery.md.
    pub fn built_in() -> Vec<Rule> {
        // Its condition on the size is added later, because the limit is a setting.
        vec![Rule { name: "tiny".to_owned(), conditions: Vec::new(), mechanism: Delivery::Inline }]
    }

    /// Describes all rules in their order, with the last resort.
    pub fn views(&self) -> Vec<RuleView> {
        let describe = |rule: &Rule| {
            rule.conditions.iter().map(Condition::describe).collect::<Vec<_>>().join(", ")
        };
        let last = Rule {
            name: DEFAULT_RULE.to_owned(),
            conditions: Vec::new(),
            mechanism: Delivery::PushPull,
        };
        let view = |(order, rule): (u64, &Rule)| RuleView {
            order,
            name: rule.name.clone(),
            condition: describe(rule),
            mechanism: rule.mechanism,
            own: !Self::is_reserved(&rule.name),
        };
        (1..).zip(self.0.iter().chain([&last])).map(view).collect()
    }

    /// Whether `name` belongs to a rule that the operator did not write.
    pub fn is_reserved(name: &str) -> bool {
        [DeliveryDecision::ORDERED, DeliveryDecision::FELL_BEHIND, DEFAULT_RULE].contains(&name)
            || Self::built_in().iter().any(|rule| rule.name == name)
    }

    /// Whether any rule asks for `quantity`.
    pub fn use_quantity(&self, quantity: Quantity) -> bool {
        let asks = |condition: &Condition| matches!(condition, Condition::Measure(asked, ..) if *asked == quantity);
        self.0.iter().any(|rule| rule.conditions.iter().any(asks))
    }
}

/// Chooses the mechanism for a robot with these `inputs`, where `choice` was ordered.
pub fn choose(rules: &Rules, choice: DeliveryChoice, inputs: &Inputs) -> DeliveryDecision {
    if let Some(mechanism) = choice.mechanism() {
        let because = format!("the order says {mechanism}");
        let rule = DeliveryDecision::ORDERED.to_owned();
        return DeliveryDecision { mechanism, rule, because };
    }
    let matching = rules
        .0
        .iter()
        .position(|rule| rule.conditions.iter().all(|condition| condition.holds(inputs)));
    let (before, name, mechanism, conditions) = match matching {
        Some(at) => {
            let rule = &rules.0[at];
            (&rules.0[..at], rule.name.as_str(), rule.mechanism, rule.conditions.as_slice())
        }
        None => (rules.0.as_slice(), DEFAULT_RULE, Delivery::PushPull, &[][..]),
    };
    let decisive: Vec<Condition> = if conditions.is_empty() {
        blocking_conditions(before, mechanism, inputs)
    } else {
        conditions.to_vec()
    };
    let reasons: Vec<String> =
        decisive.iter().map(|condition| condition.describe_with(inputs)).collect();
    let because =
        if reasons.is_empty() { "it has no condition".to_owned() } else { reasons.join(", ") };
    DeliveryDecision { mechanism, rule: name.to_owned(), because }
}

/// The conditions that kept the earlier rules from choosing a mechanism other than `mechanism`: the
/// first failed condition of each rule. Of several conditions on the same subject, only the last is
/// kept.
fn blocking_conditions(before: &[Rule], mechanism: Delivery, inputs: &Inputs) -> Vec<Condition> {
    let mut found: Vec<Condition> = Vec::new();
    for rule in before.iter().filter(|rule| rule.mechanism != mechanism) {
        if let Some(failed) = rule.conditions.iter().find(|condition| !condition.holds(inputs)) {
            found.retain(|earlier| earlier.subject() != failed.subject());
            found.push(*failed);
        }
    }
    found
}

impl Condition {
    /// Finds a condition by its key in the configuration. Conditions on quantities come without a
    /// value.
    pub fn by_key(key: &str) -> Option<ConditionKey> {
        if let Some(flag) = Flag::ALL.into_iter().find(|flag| flag.name() == key) {
            return Some(ConditionKey::Flag(flag));
        }
        Comparison::ALL.into_iter().find_map(|comparison| {
            let quantity = key.strip_suffix(comparison.word())?.strip_suffix('_')?;
            let quantity = Quantity::ALL.into_iter().find(|known| known.key() == quantity)?;
            Some(ConditionKey::Measure(quantity, comparison))
        })
    }

    /// Whether the inputs satisfy the condition.
    pub fn holds(&self, inputs: &Inputs) -> bool {
        match *self {
            Self::Measure(quantity, comparison, value) => {
                quantity.of(inputs).is_some_and(|found| comparison.holds(found, value))
            }
            Self::Flag(flag, wanted) => flag.of(inputs) == wanted,
        }
    }

    /// The state of the condition, whether it holds or not: `size 9.7 MB > 256 KB`.
    fn describe_with(&self, inputs: &Inputs) -> String {
        match *self {
            Self::Measure(quantity, comparison, value) => {
                let Some(found) = quantity.of(inputs) else {
                    return format!("{} not known", quantity.display_name());
                };
                let said =
                    if comparison.holds(found, value) { comparison } else { comparison.opposite() };
                let (mut left, mut right) =
                    (quantity.unit().format(found), quantity.unit().format(value));
                if left == right && found != value {
                    (left, right) = (format!("{found} B"), format!("{value} B"));
                }
                format!("{} {left} {} {right}", quantity.display_name(), said.sign())
            }
            Self::Flag(flag, _) if flag.of(inputs) => flag.name().to_owned(),
            Self::Flag(flag, _) => format!("not {}", flag.name()),
        }
    }

    /// The condition in words: `size ≤ 256 KB`.
    fn describe(&self) -> String {
        match *self {
            Self::Measure(quantity, comparison, value) => {
                format!(
                    "{} {} {}",
                    quantity.display_name(),
                    comparison.sign(),
                    quantity.unit().format(value)
                )
            }
            Self::Flag(flag, true) => flag.name().to_owned(),
            Self::Flag(flag, false) => format!("not {}", flag.name()),
        }
    }

    fn subject(&self) -> &'static str {
        match self {
            Self::Measure(quantity, ..) => quantity.key(),
            Self::Flag(flag, _) => flag.name(),
        }
    }
}

/// A condition without its value, which is read later.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ConditionKey {
    /// A comparison; its value is a number in the quantity's unit.
    Measure(Quantity, Comparison),
    /// A flag; its value is true or false.
    Flag(Flag),
}

impl Quantity {
    pub const ALL: [Self; 12] = [
        Self::Size,
        Self::Lacking,
        Self::Robots,
        Self::Batch,
        Self::SameSite,
        Self::Throughput,
        Self::Rtt,
        Self::Losses,
        Self::Reconnects,
        Self::Battery,
        Self::Transfers,
        Self::Backlog,
    ];

    /// The prefix of the quantity's keys in the configuration.
    pub fn key(self) -> &'static str {
        match self {
            Self::Size => "size",
            Self::Lacking => "lacking",
            Self::Robots => "robots",
            Self::Batch => "batch",
            Self::SameSite => "same_site",
            Self::Throughput => "throughput",
            Self::Rtt => "rtt",
            Self::Losses => "losses",
            Self::Reconnects => "reconnects",
            Self::Battery => "battery",
            Self::Transfers => "transfers",
            Self::Backlog => "backlog",
        }
    }

    fn display_name(self) -> &'static str {
        if self == Self::SameSite { "robots on site" } else { self.key() }
    }

    /// The unit of the quantity's values.
    pub fn unit(self) -> Unit {
        match self {
            Self::Size | Self::Lacking | Self::Backlog => Unit::Bytes,
            Self::Throughput => Unit::BytesPerSecond,
            Self::Rtt => Unit::Milliseconds,
            Self::Battery => Unit::Percent,
            Self::Robots
            | Self::Batch
            | Self::SameSite
            | Self::Losses
            | Self::Reconnects
            | Self::Transfers => Unit::Count,
        }
    }

    fn of(self, inputs: &Inputs) -> Option<u64> {
        match self {
            Self::Size => Some(inputs.size),
            Self::Lacking => Some(inputs.lacking),
            Self::Robots => Some(inputs.robots),
            Self::Batch => Some(inputs.batch),
            Self::SameSite => inputs.same_site,
            Self::Throughput => inputs.throughput_bytes_per_s,
            Self::Rtt => inputs.rtt_ms,
            Self::Losses => Some(inputs.losses),
            Self::Reconnects => Some(inputs.reconnects),
            Self::Battery => inputs.battery_percent,
            Self::Transfers => Some(inputs.transfers),
            Self::Backlog => Some(inputs.backlog),
        }
    }
}

impl Unit {
    /// Formats a value for people.
    pub fn format(self, value: u64) -> String {
        match self {
            Self::Bytes => format_bytes(value),
            Self::BytesPerSecond => format_rate(value),
            Self::Milliseconds => format!("{value} ms"),
            Self::Percent => format!("{value}%"),
            Self::Count => value.to_string(),
        }
    }
}

impl Comparison {
    pub const ALL: [Self; 4] = [Self::Above, Self::AtMost, Self::AtLeast, Self::Below];

    /// The suffix of a key in the configuration.
    pub fn word(self) -> &'static str {
        match self {
            Self::Above => "above",
            Self::AtMost => "at_most",
            Self::AtLeast => "at_least",
            Self::Below => "below",
        }
    }

    /// The least and the greatest value that satisfy the comparison; `None`: no value does.
    pub fn range(self, value: u64) -> Option<(u64, u64)> {
        match self {
            Self::Above => Some((value.checked_add(1)?, u64::MAX)),
            Self::AtMost => Some((0, value)),
            Self::AtLeast => Some((value, u64::MAX)),
            Self::Below => Some((0, value.checked_sub(1)?)),
        }
    }

    fn holds(self, found: u64, value: u64) -> bool {
        self.range(value).is_some_and(|(least, most)| (least..=most).contains(&found))
    }

    fn opposite(self) -> Self {
        match self {
            Self::Above => Self::AtMost,
            Self::AtMost => Self::Above,
            Self::AtLeast => Self::Below,
            Self::Below => Self::AtLeast,
        }
    }

    fn sign(self) -> &'static str {
        match self {
            Self::Above => ">",
            Self::AtMost => "≤",
            Self::AtLeast => "≥",
            Self::Below => "<",
        }
    }
}

impl Flag {
    pub const ALL: [Self; 2] = [Self::Metered, Self::Connected];

    /// The flag's key in the configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Metered => "metered",
            Self::Connected => "connected",
        }
    }

    fn of(self, inputs: &Inputs) -> bool {
        match self {
            Self::Metered => inputs.metered,
            Self::Connected => inputs.connected,
        }
    }
}

impl fmt::Display for ConditionKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Measure(quantity, comparison) => {
                write!(f, "{}_{}", quantity.key(), comparison.word())
            }
            Self::Flag(flag) => f.write_str(flag.name()),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const KB: u64 = 1 << 10;
    const MB: u64 = 1 << 20;

    fn rule(name: &str, conditions: &[(&str, u64)], mechanism: Delivery) -> Rule {
        let condition = |(key, value): &(&str, u64)| match Condition::by_key(key).expect(key) {
            ConditionKey::Measure(quantity, comparison) => {
                Condition::Measure(quantity, comparison, *value)
            }
            ConditionKey::Flag(flag) => Condition::Flag(flag, *value == 1),
        };
        Rule {
            name: name.to_owned(),
            conditions: conditions.iter().map(condition).collect(),
            mechanism,
        }
    }

    fn decide(own: &[Rule], inputs: Inputs) -> (Delivery, String, String) {
        let decision =
            choose(&Rules::new(own.to_vec(), 32 * KB), DeliveryChoice::Adaptive, &inputs);
        (decision.mechanism, decision.rule, decision.because)
    }

    /// Checks the text of condition `key` with `value`, for inputs that satisfy the condition and
    /// for inputs that do not.
    #[track_caller]
    fn check(key: &str, value: u64, yes: Inputs, because: &str, no: Inputs) {
        let own = [rule("own", &[(key, value)], Delivery::Poll)];
        assert_eq!(decide(&own, yes), (Delivery::Poll, "own".to_owned(), because.to_owned()));
        assert_ne!(decide(&own, no).1, "own", "{key}");
    }

    #[test]
    fn every_condition_decides_and_is_named_as_the_reason() {
        let of = Inputs::default;
        check(
            "size_above",
            256 * KB,
            Inputs { size: 97 * MB / 10, ..of() },
            "size 9.7 MB > 256 KB",
            Inputs { size: 256 * KB, ..of() },
        );
        check(
            "size_at_most",
            2 * MB,
            Inputs { size: 2 * MB, ..of() },
            "size 2 MB ≤ 2 MB",
            Inputs { size: 2 * MB + 1, ..of() },
        );
        check(
            "lacking_at_most",
            10,
            Inputs { lacking: 0, ..of() },
            "lacking 0 B ≤ 10 B",
            Inputs { lacking: 11, ..of() },
        );
        check(
            "robots_at_least",
            8,
            Inputs { robots: 40, ..of() },
            "robots 40 ≥ 8",
            Inputs { robots: 7, ..of() },
        );
        check(
            "batch_at_least",
            8,
            Inputs { batch: 8, ..of() },
            "batch 8 ≥ 8",
            Inputs { batch: 7, robots: 9, ..of() },
        );
        let on_site = |robots| Inputs { same_site: Some(robots), ..of() };
        check("same_site_at_least", 3, on_site(4), "robots on site 4 ≥ 3", on_site(2));
        let carrying = |rate| Inputs { throughput_bytes_per_s: rate, ..of() };
        check(
            "throughput_below",
            MB,
            carrying(Some(MB / 2)),
            "throughput 512 KB/s < 1 MB/s",
            carrying(Some(MB)),
        );
        check(
            "throughput_below",
            MB,
            carrying(Some(0)),
            "throughput 0 B/s < 1 MB/s",
            carrying(None),
        );
        let away = |rtt_ms| Inputs { rtt_ms, ..of() };
        check("rtt_above", 100, away(Some(120)), "rtt 120 ms > 100 ms", away(Some(100)));
        check("rtt_above", 100, away(Some(101)), "rtt 101 ms > 100 ms", away(None));
        check(
            "losses_above",
            2,
            Inputs { losses: 3, ..of() },
            "losses 3 > 2",
            Inputs { losses: 2, ..of() },
        );
        check(
            "reconnects_above",
            5,
            Inputs { reconnects: 6, ..of() },
            "reconnects 6 > 5",
            Inputs { reconnects: 5, ..of() },
        );
        check("metered", 1, Inputs { metered: true, ..of() }, "metered", of());
        check("metered", 0, of(), "not metered", Inputs { metered: true, ..of() });
        check("connected", 0, of(), "not connected", Inputs { connected: true, ..of() });
        check("connected", 1, Inputs { connected: true, ..of() }, "connected", of());
        let charged = |battery_percent| Inputs { battery_percent, ..of() };
        check("battery_below", 20, charged(Some(15)), "battery 15% < 20%", charged(Some(20)));
        check("battery_below", 20, charged(Some(0)), "battery 0% < 20%", charged(None));
        check(
            "transfers_at_least",
            16,
            Inputs { transfers: 16, ..of() },
            "transfers 16 ≥ 16",
            Inputs { transfers: 15, ..of() },
        );
        check(
            "backlog_at_least",
            100,
            Inputs { backlog: 200, ..of() },
            "backlog 200 B ≥ 100 B",
            Inputs { backlog: 99, ..of() },
        );
    }

    #[test]
    fn every_quantity_has_every_comparison() {
        for quantity in Quantity::ALL {
            for comparison in Comparison::ALL {
                let key = ConditionKey::Measure(quantity, comparison);
                assert_eq!(Condition::by_key(&key.to_string()), Some(key));
            }
        }
        for unknown in [
            "",
            "size",
            "size_",
            "_above",
            "size_over",
            "sizeabove",
            "weather_above",
            "metered_above",
        ] {
            assert_eq!(Condition::by_key(unknown), None, "{unknown}");
        }
    }

    /// The built-in rules one by one, as docs/delivery.md shows them.
    #[test]
    fn built_in_rules_decide() {
        let expect = |size, mechanism, rule: &str, because: &str| {
            let inputs =
                Inputs { size, batch: 40, robots: 40, connected: true, ..Inputs::default() };
            assert_eq!(decide(&[], inputs), (mechanism, rule.to_owned(), because.to_owned()));
        };
        expect(20 * KB, Delivery::Inline, "tiny", "size 20 KB ≤ 32 KB");
        expect(10_171_187, Delivery::PushPull, "otherwise", "size 9.7 MB > 32 KB");
    }

    #[test]
    fn first_matching_rule_wins() {
        let own = [
            rule("far and slow", &[("rtt_above", 100), ("throughput_below", MB)], Delivery::Poll),
            rule("far", &[("rtt_above", 100)], Delivery::DirectPush),
            rule("all others", &[], Delivery::PushPull),
        ];
        let far = Inputs { size: 1, rtt_ms: Some(150), ..Inputs::default() };
        let slow = Inputs { throughput_bytes_per_s: Some(KB), ..far };
        assert_eq!(decide(&own, slow).1, "far and slow");
        assert_eq!(decide(&own, slow).2, "rtt 150 ms > 100 ms, throughput 1 KB/s < 1 MB/s");
        assert_eq!(decide(&own, far).1, "far");
        let because = "rtt not known".to_owned();
        assert_eq!(
            decide(&own, Inputs::default()),
            (Delivery::PushPull, "all others".to_owned(), because)
        );
        let only = [rule("all", &[], Delivery::Poll)];
        assert_eq!(
            decide(&only, far),
            (Delivery::Poll, "all".to_owned(), "it has no condition".to_owned())
        );
    }

    #[test]
    fn no_rule_makes_an_announcement_too_large() {
        let own = [rule("always inside", &[("robots_at_least", 1)], Delivery::Inline)];
        let inputs = Inputs { size: 32 * KB, robots: 1, ..Inputs::default() };
        assert_eq!(decide(&own, inputs).1, "always inside");
        let decision = decide(&own, Inputs { size: 32 * KB + 1, ..inputs });
        assert_eq!((decision.0, decision.1.as_str()), (Delivery::PushPull, "otherwise"));
        assert_eq!(decision.2, "size 32769 B > 32768 B");
    }

    #[test]
    fn ordered_mechanism_overrides_the_rules() {
        let rules = Rules::new(Vec::new(), 32 * KB);
        let decision = choose(
            &rules,
            DeliveryChoice::DirectPush,
            &Inputs { metered: true, ..Inputs::default() },
        );
        assert_eq!((decision.mechanism, decision.rule.as_str()), (Delivery::DirectPush, "ordered"));
        assert_eq!(decision.because, "the order says direct-push");
    }

    proptest! {
        /// A comparison and its opposite share nothing and leave nothing out.
        #[test]
        fn comparison_or_its_opposite_holds(found in any::<u64>(), value in any::<u64>(), near in 0u64..3) {
            for value in [value, found.saturating_add(near), found.saturating_sub(near)] {
                for comparison in Comparison::ALL {
                    prop_assert_ne!(comparison.holds(found, value), comparison.opposite().holds(found, value));
                }
            }
        }

        #[test]
        fn any_inputs_give_a_mechanism_and_a_reason(
            size in 0u64..1_000_000, batch in 0u64..20, losses in 0u64..5, metered in any::<bool>(), connected in any::<bool>(),
        ) {
            let inputs = Inputs { size, batch, losses, metered, connected, ..Inputs::default() };
            let (mechanism, rule, because) = decide(&[], inputs);
            prop_assert!(!because.is_empty() && !rule.is_empty());
            prop_assert!(mechanism != Delivery::Inline || size <= 32 * KB);
            prop_assert!(matches!(mechanism, Delivery::Inline | Delivery::PushPull));
        }
    }
}
