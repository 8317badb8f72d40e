//! Which robots an order is for. `*` is every robot; commas separate alternatives; within one, `&` joins conditions; a
//! condition is `label=value` or a robot's name or id.
//!
//! ```
//! use task_proto::selector::Selector;
//! let selector: Selector = "site=lab&base=turtlebot,spare-1".parse().unwrap();
//! assert_eq!(selector.to_string(), "site=lab&base=turtlebot,spare-1");
//! ```

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::id::{LabelKey, LabelValue, Labels};
use crate::{RobotId, RobotName};

/// A parsed selector.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Selector(Vec<Vec<Condition>>);

#[derive(Debug, Clone, PartialEq, Eq)]
enum Condition {
    Everyone,
    Label(LabelKey, LabelValue),
    NameOrId(RobotName),
}

/// A text that is not a selector.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{part:?} in the selector is none of \"*\", a robot's name or id, and label=value")]
pub struct InvalidSelector {
    part: String,
}

/// The most bytes a selector's text may have.
const MAX_SELECTOR_BYTES: usize = 64 * 1024;

impl Selector {
    /// Whether a robot with this id, name and labels is meant.
    pub fn matches(&self, id: &RobotId, name: &RobotName, labels: &Labels) -> bool {
        self.0.iter().any(|all| {
            all.iter().all(|condition| match condition {
                Condition::Everyone => true,
                Condition::Label(key, value) => labels.get(key) == Some(value),
                Condition::NameOrId(text) => text == name || text.as_str() == id.as_str(),
            })
        })
    }
}

impl FromStr for Selector {
    type Err = InvalidSelector;
    fn from_str(text: &str) -> Result<Self, InvalidSelector> {
        let invalid = |part: &str| InvalidSelector { part: part.chars().take(80).collect() };
        if text.len() > MAX_SELECTOR_BYTES {
            return Err(invalid(text));
        }
        let condition = |part: &str| {
            let part = part.trim();
            if part == "*" {
                return Ok(Condition::Everyone);
            }
            if let Some((key, value)) = part.split_once('=') {
                let key = key.parse().map_err(|_| invalid(part))?;
                return Ok(Condition::Label(key, value.parse().map_err(|_| invalid(part))?));
            }
            part.parse().map(Condition::NameOrId).map_err(|_| invalid(part))
        };
        let alternatives: Result<_, _> =
            text.split(',').map(|all| all.split('&').map(condition).collect::<Result<Vec<_>, _>>()).collect();
        alternatives.map(Self)
    }
}

impl TryFrom<String> for Selector {
    type Error = InvalidSelector;
    fn try_from(text: String) -> Result<Self, InvalidSelector> {
        text.parse()
    }
}

impl From<Selector> for String {
    fn from(selector: Selector) -> String {
        selector.to_string()
    }
}

impl fmt::Display for Selector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, all) in self.0.iter().enumerate() {
            f.write_str(if i > 0 { "," } else { "" })?;
            for (j, condition) in all.iter().enumerate() {
                f.write_str(if j > 0 { "&" } else { "" })?;
                match condition {
                    Condition::Everyone => f.write_str("*")?,
                    Condition::Label(key, value) => write!(f, "{key}={value}")?,
                    Condition::NameOrId(text) => write!(f, "{text}")?,
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matches_by_everything_name_id_and_labels() {
        let id = RobotId::random();
        let name: RobotName = "Atlas-1".parse().expect("valid");
        let labels: Labels = [("site", "lab"), ("base", "turtlebot")]
            .map(|(k, v)| (k.parse().expect("valid"), v.parse().expect("valid")))
            .into();
        let yes = ["*", "Atlas-1", id.as_str(), "site=lab", "site=lab&base=turtlebot", "nobody,site=lab", "*&site=lab"];
        let no = ["atlas-1", "site=field", "site=lab&base=husky", "Atlas-1&site=field"];
        for (text, expected) in yes.map(|t| (t, true)).into_iter().chain(no.map(|t| (t, false))) {
            let selector: Selector = text.parse().expect(text);
            assert_eq!(selector.matches(&id, &name, &labels), expected, "{text}");
            assert_eq!(selector.to_string(), text);
        }
    }

    #[test]
    fn nonsense_is_refused_by_part() {
        for bad in ["", ",", "a,,b", "a&", "=x", "a b", "site=l ab", "**"] {
            assert!(bad.parse::<Selector>().is_err(), "{bad:?}");
        }
    }
}
