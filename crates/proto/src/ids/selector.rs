//! Selects the robots of an order. `*` is every robot. Commas separate terms: each includes robots,
//! or excludes them if it begins with `!`, in any position. Within a term, `&` joins conditions; a
//! condition is `label=value` or a robot's name or id. If no term includes robots, all robots that
//! no term excludes are selected.
//!
//! ```
//! use task_proto::ids::selector::Selector;
//! let selector: Selector = "site=lab&base=turtlebot,spare-1,!arm".parse().unwrap();
//! assert_eq!(selector.to_string(), "site=lab&base=turtlebot,spare-1,!arm");
//! ```

use std::collections::{BTreeSet, HashMap, HashSet};
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::ids::{LabelKey, LabelValue, Labels};
use crate::{RobotId, RobotName};

/// A parsed selector.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(
    feature = "openapi",
    derive(utoipa::ToSchema),
    schema(value_type = String, example = "site=lab,spare-1")
)]
#[serde(try_from = "String", into = "String")]
pub struct Selector(Box<Parsed>);

#[derive(Debug, Clone, PartialEq, Eq)]
struct Parsed {
    /// The text as written, without spaces.
    text: String,
    includes: Terms,
    excludes: Terms,
}

/// Robots that meet one of the terms.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Terms {
    /// Terms that are only a name or an id: there may be as many as robots, so we look them up.
    pub named: HashSet<RobotName>,
    /// Terms that are only a label: looked up as well.
    pub labelled: HashMap<LabelKey, HashSet<LabelValue>>,
    /// All other terms: a robot must meet all conditions of one. Each is tried on every robot, so
    /// we limit their number.
    pub described: Vec<Vec<Condition>>,
}

/// A condition of a term.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Condition {
    /// Every robot meets it.
    AnyRobot,
    /// The robot has this label.
    Label(LabelKey, LabelValue),
    /// The robot has this name or this id.
    NameOrId(RobotName),
}

/// A text that is not a selector.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InvalidSelector {
    /// One of the parts is not a valid term.
    #[error(
        "{0:?} in the selector is not \"*\", a robot's name or id, or label=value, \
         optionally prefixed with \"!\""
    )]
    Part(String),
    /// The text is longer than [`MAX_SELECTOR_BYTES`].
    #[error("the selector has {0} bytes; at most {MAX_SELECTOR_BYTES} are allowed")]
    TooLong(usize),
    /// The text has more than [`MAX_CONDITIONS`].
    #[error("the selector has more than {MAX_CONDITIONS} conditions in compound terms")]
    TooManyConditions,
}

/// The longest selector, in bytes: enough for ten thousand robots by their ids.
pub const MAX_SELECTOR_BYTES: usize = 200 * 1024;
/// The most conditions in a selector's terms that are more than a name, an id or a label.
pub const MAX_CONDITIONS: usize = 256;

impl Selector {
    /// Whether the selector matches a robot with this id, name and labels.
    pub fn matches(&self, id: &RobotId, name: &RobotName, labels: &Labels) -> bool {
        let Parsed { includes, excludes, .. } = &*self.0;
        (includes.is_empty() || includes.match_robot(id, name, labels))
            && !excludes.match_robot(id, name, labels)
    }
}

impl Selector {
    /// The terms that include robots. If there are none, all robots are included.
    pub fn includes(&self) -> &Terms {
        &self.0.includes
    }

    /// The terms that exclude robots, also included ones.
    pub fn excludes(&self) -> &Terms {
        &self.0.excludes
    }

    /// The names and ids in the selector, including excluded ones, sorted.
    pub fn names(&self) -> BTreeSet<RobotName> {
        self.0.includes.names().chain(self.0.excludes.names()).cloned().collect()
    }
}

impl Terms {
    fn names(&self) -> impl Iterator<Item = &RobotName> {
        let described = self.described.iter().flatten().filter_map(|condition| match condition {
            Condition::NameOrId(name) => Some(name),
            Condition::AnyRobot | Condition::Label(..) => None,
        });
        self.named.iter().chain(described)
    }

    /// Whether there are no terms.
    pub fn is_empty(&self) -> bool {
        self.named.is_empty() && self.labelled.is_empty() && self.described.is_empty()
    }

    fn match_robot(&self, id: &RobotId, name: &RobotName, labels: &Labels) -> bool {
        let is_met = |condition: &Condition| match condition {
            Condition::AnyRobot => true,
            Condition::Label(key, value) => labels.get(key) == Some(value),
            Condition::NameOrId(text) => text == name || text.as_str() == id.as_str(),
        };
        self.named.contains(name.as_str())
            || self.named.contains(id.as_str())
            || labels.iter().any(|(key, value)| {
                self.labelled.get(key).is_some_and(|values| values.contains(value))
            })
            || self.described.iter().any(|all| all.iter().all(is_met))
    }

    fn add(&mut self, mut all: Vec<Condition>) {
        match (all.pop(), all.is_empty()) {
            (Some(Condition::NameOrId(text)), true) => _ = self.named.insert(text),
            (Some(Condition::Label(key, value)), true) => {
                _ = self.labelled.entry(key).or_default().insert(value)
            }
            (last, _) => self.described.push(all.into_iter().chain(last).collect()),
        }
    }

    fn conditions(&self) -> usize {
        self.described.iter().map(Vec::len).sum()
    }
}

impl FromStr for Condition {
    type Err = InvalidSelector;
    fn from_str(part: &str) -> Result<Self, InvalidSelector> {
        let invalid = || InvalidSelector::Part(part.chars().take(80).collect());
        if part == "*" {
            return Ok(Self::AnyRobot);
        }
        if let Some((key, value)) = part.split_once('=') {
            let key = key.parse().map_err(|_| invalid())?;
            return Ok(Self::Label(key, value.parse().map_err(|_| invalid())?));
        }
        part.parse().map(Self::NameOrId).map_err(|_| invalid())
    }
}

impl FromStr for Selector {
    type Err = InvalidSelector;
    fn from_str(text: &str) -> Result<Self, InvalidSelector> {
        if text.len() > MAX_SELECTOR_BYTES {
            return Err(InvalidSelector::TooLong(text.len()));
        }
        let (mut includes, mut excludes) = (Terms::default(), Terms::default());
        for term in text.split(',') {
            let without = term.trim_start().strip_prefix('!');
            let all = without
                .unwrap_or(term)
                .split('&')
                .map(|part| part.trim().parse())
                .collect::<Result<_, _>>()?;
            if without.is_some() { excludes.add(all) } else { includes.add(all) }
        }
        if includes.conditions() + excludes.conditions() > MAX_CONDITIONS {
            return Err(InvalidSelector::TooManyConditions);
        }
        // Valid parts contain no spaces.
        let text = text.split_whitespace().collect();
        Ok(Self(Box::new(Parsed { text, includes, excludes })))
    }
}

super::serde_by_text!(Selector, InvalidSelector);

impl fmt::Display for Selector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0.text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn selector_matches_by_name_id_and_labels() {
        let id = RobotId::random();
        let name: RobotName = "Atlas-1".parse().expect("valid");
        let labels: Labels = [("site", "lab"), ("base", "turtlebot")]
            .map(|(k, v)| (k.parse().expect("valid"), v.parse().expect("valid")))
            .into();
        let yes = [
            "*",
            "Atlas-1",
            id.as_str(),
            "site=lab",
            "site=lab&base=turtlebot",
            "nobody,site=lab",
            "*&site=lab",
            "!Atlas-2",
            "!site=lab&base=husky",
            "site=lab,!arm",
            "!arm,!site=field",
        ];
        let no = [
            "atlas-1",
            "site=field",
            "site=lab&base=husky",
            "Atlas-1&site=field",
            "!Atlas-1",
            "!*",
            "*,!*",
            "site=lab,!Atlas-1",
            "!Atlas-1,site=lab",
            "!site=lab&base=turtlebot",
            "nobody,!arm",
        ];
        for (text, expected) in yes.map(|t| (t, true)).into_iter().chain(no.map(|t| (t, false))) {
            let selector: Selector = text.parse().expect(text);
            assert_eq!(selector.matches(&id, &name, &labels), expected, "{text}");
            assert_eq!(selector.to_string(), text);
        }
    }

    #[test]
    fn invalid_selector_names_the_invalid_part() {
        for bad in
            ["", ",", "a,,b", "a&", "=x", "a b", "site=l ab", "**", "!", "!!a", "a&!b", "!,a"]
        {
            assert!(bad.parse::<Selector>().is_err(), "{bad:?}");
        }
    }

    #[test]
    fn selector_holds_ten_thousand_ids() {
        let robots: Vec<RobotId> = (0..10_000).map(|_| RobotId::random()).collect();
        let (name, labels): (RobotName, _) = ("atlas".parse().expect("valid"), Labels::new());
        let stranger = RobotId::random();
        for (without, is_meant) in [("", true), ("!", false)] {
            let text =
                robots.iter().map(|id| format!("{without}{id}")).collect::<Vec<_>>().join(",");
            let selector: Selector = text.parse().expect("it fits");
            assert!(robots.iter().all(|id| selector.matches(id, &name, &labels) == is_meant));
            assert_eq!(selector.matches(&stranger, &name, &labels), !is_meant);
            assert_eq!(selector.to_string(), text);
        }
        let text = "a,".repeat(MAX_SELECTOR_BYTES / 2) + "a";
        assert_eq!(text.parse::<Selector>(), Err(InvalidSelector::TooLong(MAX_SELECTOR_BYTES + 1)));
    }

    #[test]
    fn compound_conditions_are_limited() {
        let text = "b=c,".repeat(50_000) + "b=d";
        let selector: Selector = text.parse().expect("a label is looked up");
        assert_eq!(selector.0.includes.conditions(), 0);
        let most = ["a&b=c"; MAX_CONDITIONS / 2].join(",");
        assert!(most.parse::<Selector>().is_ok());
        for more in ["*", "!*", "!a&b"] {
            assert_eq!(
                format!("{most},{more}").parse::<Selector>(),
                Err(InvalidSelector::TooManyConditions),
                "{more}"
            );
        }
    }

    #[test]
    fn spaces_between_the_parts_are_left_out() {
        let selector: Selector = " site=lab & arm,! cart ".parse().expect("valid");
        assert_eq!(selector.to_string(), "site=lab&arm,!cart");
    }

    #[test]
    fn names_are_those_of_all_terms() {
        let selector: Selector = "b,site=lab&a,!c,!base=husky&d,*".parse().expect("valid");
        assert_eq!(
            selector.names().iter().map(RobotName::as_str).collect::<Vec<_>>(),
            ["a", "b", "c", "d"]
        );
        assert!("*,!site=lab".parse::<Selector>().expect("valid").names().is_empty());
    }
}
