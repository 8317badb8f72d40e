//! How the bytes of a package travel: the operator's choice, and the decision for each robot.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::desired::Delivery;

/// Delivery methods that an operator may order. An unknown word is refused, because the order would
/// be only half understood.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum DeliveryChoice {
    /// The server's rules decide for each robot.
    #[default]
    Adaptive,
    /// The server announces, the robot pulls over HTTP.
    PushPull,
    /// The bytes travel inside MQTT messages, published once for all robots.
    DirectPush,
    /// Nothing is published; the robot asks on its own timer.
    Poll,
    /// The bytes travel inside the announcement itself.
    Inline,
}

/// The method by which one robot receives its bytes, with the reason.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct DeliveryDecision {
    /// How the bytes travel.
    pub mechanism: Delivery,
    /// The rule's name; `ordered` if the operator chose, `fell behind` if a robot was told to pull
    /// instead.
    pub rule: String,
    /// For people: the deciding condition, with its values: `size 9.7 MB > 256 KB`.
    pub because: String,
}

impl DeliveryDecision {
    /// The rule's name if the operator chose.
    pub const ORDERED: &str = "ordered";
    /// The rule's name if a robot that could not be kept up to date was told to pull.
    pub const FELL_BEHIND: &str = "fell behind";
}

/// The lowest priority of an order.
pub const MIN_PRIORITY: i32 = -100;
/// The highest priority of an order.
pub const MAX_PRIORITY: i32 = 100;

impl DeliveryChoice {
    /// The method, if the operator's choice leaves nothing to decide.
    pub fn mechanism(self) -> Option<Delivery> {
        match self {
            Self::Adaptive => None,
            Self::PushPull => Some(Delivery::PushPull),
            Self::DirectPush => Some(Delivery::DirectPush),
            Self::Poll => Some(Delivery::Poll),
            Self::Inline => Some(Delivery::Inline),
        }
    }
}

impl fmt::Display for DeliveryChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.mechanism().map_or("adaptive", Delivery::as_str))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn choice_and_mechanism_have_the_same_name() {
        for (word, mechanism) in [
            ("adaptive", None),
            ("push-pull", Some(Delivery::PushPull)),
            ("direct-push", Some(Delivery::DirectPush)),
            ("poll", Some(Delivery::Poll)),
            ("inline", Some(Delivery::Inline)),
        ] {
            let choice: DeliveryChoice = serde_json::from_value(word.into()).expect(word);
            assert_eq!(choice.to_string(), word);
            assert_eq!(choice.mechanism(), mechanism);
            assert_eq!(serde_json::to_value(choice).expect("json"), word);
            if let Some(mechanism) = mechanism {
                assert_eq!(serde_json::to_value(mechanism).expect("json"), word);
            }
        }
        assert!(serde_json::from_str::<DeliveryChoice>("\"by-pigeon\"").is_err());
    }
}
