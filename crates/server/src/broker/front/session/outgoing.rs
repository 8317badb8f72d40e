//! One session's unacknowledged messages to its client: packet ids, the window, the QoS 2 steps.
//! This module never holds a payload, since a clean session sends nothing again.

use std::collections::HashMap;

use rumqttd::protocol::QoS;

use crate::broker::front::parts::MAX_PARTS_IN_FLIGHT;

/// Maximum messages in flight.
const MAX_IN_FLIGHT: usize = 32;

/// The window of messages in flight.
#[derive(Debug, Default)]
pub(super) struct Outgoing {
    last_id: u16,
    in_flight: HashMap<u16, Awaiting>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Awaiting {
    Acknowledgement,
    Receipt,
    Completion,
}

impl Outgoing {
    /// Whether another message may be sent.
    pub(super) fn has_room(&self) -> bool {
        self.in_flight.len() < MAX_IN_FLIGHT
    }

    /// Whether another part of a package may be sent.
    pub(super) fn has_room_for_part(&self) -> bool {
        self.in_flight.len() < MAX_PARTS_IN_FLIGHT
    }

    /// The packet id for a message that is about to be sent; 0 for QoS 0, which needs none.
    pub(super) fn begin(&mut self, qos: QoS) -> u16 {
        let awaiting = match qos {
            QoS::AtMostOnce => return 0,
            QoS::AtLeastOnce => Awaiting::Acknowledgement,
            QoS::ExactlyOnce => Awaiting::Receipt,
        };
        // Ends soon: far fewer ids are in flight than exist.
        loop {
            self.last_id = self.last_id.checked_add(1).unwrap_or(1);
            if !self.in_flight.contains_key(&self.last_id) {
                self.in_flight.insert(self.last_id, awaiting);
                return self.last_id;
            }
        }
    }

    /// Handles a PUBACK; true if a message is complete. Unexpected acknowledgements change nothing.
    pub(super) fn acknowledged(&mut self, id: u16) -> bool {
        self.end(id, Awaiting::Acknowledgement)
    }

    /// Handles a PUBREC; the answer is a PUBREL in any case, as a client may repeat the PUBREC.
    pub(super) fn received(&mut self, id: u16) {
        if let Some(awaiting) = self.in_flight.get_mut(&id)
            && *awaiting == Awaiting::Receipt
        {
            *awaiting = Awaiting::Completion;
        }
    }

    /// Handles a PUBCOMP; true if a message is complete. Unexpected ones change nothing.
    pub(super) fn completed(&mut self, id: u16) -> bool {
        self.end(id, Awaiting::Completion)
    }

    fn end(&mut self, id: u16, expected: Awaiting) -> bool {
        let is_expected = self.in_flight.get(&id) == Some(&expected);
        if is_expected {
            self.in_flight.remove(&id);
        }
        is_expected
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_in_flight_are_not_used_twice() {
        let mut outgoing = Outgoing { last_id: u16::MAX - 1, ..Outgoing::default() };
        assert_eq!(outgoing.begin(QoS::AtLeastOnce), u16::MAX);
        assert_eq!(outgoing.begin(QoS::AtLeastOnce), 1);
        outgoing.last_id = 0;
        assert_eq!(outgoing.begin(QoS::AtLeastOnce), 2);
        assert_eq!(outgoing.begin(QoS::AtMostOnce), 0);
    }

    #[test]
    fn each_quality_of_service_ends_with_its_own_answer() {
        let mut outgoing = Outgoing::default();
        let (once, exactly) = (outgoing.begin(QoS::AtLeastOnce), outgoing.begin(QoS::ExactlyOnce));
        outgoing.completed(once);
        outgoing.acknowledged(exactly);
        outgoing.completed(exactly);
        assert_eq!(outgoing.in_flight.len(), 2, "wrong answers change nothing");
        outgoing.acknowledged(once);
        outgoing.received(exactly);
        outgoing.completed(exactly);
        assert!(outgoing.in_flight.is_empty());
    }

    #[test]
    fn outgoing_window_is_bounded() {
        let mut outgoing = Outgoing::default();
        for number in 0..MAX_IN_FLIGHT {
            assert!(outgoing.has_room());
            assert_eq!(outgoing.has_room_for_part(), number < MAX_PARTS_IN_FLIGHT);
            outgoing.begin(QoS::ExactlyOnce);
        }
        assert!(!outgoing.has_room());
        outgoing.received(1);
        assert!(!outgoing.has_room());
        outgoing.completed(1);
        assert!(outgoing.has_room());
    }
}
