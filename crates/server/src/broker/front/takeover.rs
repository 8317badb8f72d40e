//! Session slots: one session for each robot, and one for each client id of a person, with a limit
//! for each person. A new session takes over a slot only after the previous session has fully
//! ended. This module never touches a socket.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use task_proto::api::Subscription;
use task_proto::{RobotId, UserName};
use tokio_util::sync::CancellationToken;

use super::doorbell::Doorbell;
use super::traffic::Meter;

/// The identity of a session. Robots and operators can't take over each other's sessions, whatever
/// client id they present.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) enum SeatName {
    Robot(RobotId),
    Operator(UserName, String),
    /// An operator without a client id of its own choice.
    Unnamed(UserName, u128),
    Canary,
}

impl SeatName {
    fn person(&self) -> Option<&UserName> {
        match self {
            Self::Operator(person, _) | Self::Unnamed(person, _) => Some(person),
            Self::Robot(_) | Self::Canary => None,
        }
    }
}

/// All slots in use.
pub(super) struct Seats {
    table: Mutex<Table>,
    most_of_a_person: usize,
    /// How often robots were evicted.
    put_out: AtomicU64,
}

#[derive(Default)]
struct Table {
    occupants: HashMap<SeatName, Arc<Occupant>>,
    robots: usize,
    people: HashMap<UserName, usize>,
    last_number: u64,
}

struct Occupant {
    number: u64,
    leave: CancellationToken,
    left: CancellationToken,
    doorbell: Arc<Doorbell>,
    meter: Arc<Meter>,
    subscriptions: Mutex<Vec<Subscription>>,
}

/// A session's hold on its slot; dropping it marks the session as fully ended.
pub(super) struct Seat {
    seats: Arc<Seats>,
    name: SeatName,
    occupant: Arc<Occupant>,
}

impl Seats {
    /// Starts with no slots in use, and a maximum for each person.
    pub(super) fn new(most_of_a_person: usize) -> Arc<Self> {
        Arc::new(Self { table: Mutex::default(), most_of_a_person, put_out: AtomicU64::new(0) })
    }

    /// Asks the session in the slot to leave, waits until it has ended, and takes the slot.
    /// Sessions that want the same slot get it one after another in the order of arrival; all but
    /// the last are asked to leave again at once. `None`: the person has reached the maximum.
    pub(super) async fn take(self: &Arc<Self>, name: SeatName, meter: Arc<Meter>) -> Option<Seat> {
        let (seat, before) = self.claim(name, meter)?;
        if let Some(before) = before {
            before.leave.cancel();
            before.left.cancelled().await;
        }
        Some(seat)
    }

    fn claim(
        self: &Arc<Self>,
        name: SeatName,
        meter: Arc<Meter>,
    ) -> Option<(Seat, Option<Arc<Occupant>>)> {
        let mut table = self.table();
        if !table.occupants.contains_key(&name) && table.of_person(&name) >= self.most_of_a_person {
            return None;
        }
        table.last_number += 1;
        let occupant = Arc::new(Occupant {
            number: table.last_number,
            leave: CancellationToken::new(),
            left: CancellationToken::new(),
            doorbell: Arc::new(Doorbell::default()),
            meter,
            subscriptions: Mutex::default(),
        });
        let before = table.occupants.insert(name.clone(), occupant.clone());
        if before.is_none() {
            table.taken(&name);
        }
        Some((Seat { seats: self.clone(), name, occupant }, before))
    }

    /// The doorbell of the robot's session.
    pub(super) fn doorbell(&self, robot: &RobotId) -> Option<Arc<Doorbell>> {
        self.table()
            .occupants
            .get(&SeatName::Robot(robot.clone()))
            .map(|occupant| occupant.doorbell.clone())
    }

    /// The traffic meter of the robot's session.
    pub(super) fn meter(&self, robot: &RobotId) -> Option<Arc<Meter>> {
        self.table()
            .occupants
            .get(&SeatName::Robot(robot.clone()))
            .map(|occupant| occupant.meter.clone())
    }

    /// The subscriptions of the robot's session.
    pub(super) fn subscriptions(&self, robot: &RobotId) -> Vec<Subscription> {
        let occupant = self.table().occupants.get(&SeatName::Robot(robot.clone())).cloned();
        occupant.map_or_else(Vec::new, |occupant| occupant.subscriptions().clone())
    }

    /// How often robots were evicted so far. A client that was admitted before the number changed
    /// has to be checked again.
    pub(super) fn put_out(&self) -> u64 {
        self.put_out.load(Ordering::SeqCst)
    }

    /// Asks the robot's session to leave.
    pub(super) fn ask_to_leave(&self, robot: &RobotId) {
        self.put_out.fetch_add(1, Ordering::SeqCst);
        if let Some(occupant) = self.table().occupants.get(&SeatName::Robot(robot.clone())) {
            occupant.leave.cancel();
        }
    }

    /// Asks all of a person's sessions to leave.
    pub(super) fn ask_person_to_leave(&self, person: &UserName) {
        for (name, occupant) in &self.table().occupants {
            if name.person() == Some(person) {
                occupant.leave.cancel();
            }
        }
    }

    /// The number of robots with a slot.
    pub(super) fn robots(&self) -> usize {
        self.table().robots
    }

    fn table(&self) -> MutexGuard<'_, Table> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Table {
    /// The slots of the person that owns this slot; none for a robot.
    fn of_person(&self, name: &SeatName) -> usize {
        name.person().and_then(|person| self.people.get(person)).copied().unwrap_or_default()
    }

    /// Counts one more slot.
    fn taken(&mut self, name: &SeatName) {
        self.robots += usize::from(matches!(name, SeatName::Robot(_)));
        if let Some(person) = name.person() {
            *self.people.entry(person.clone()).or_default() += 1;
        }
    }

    /// Counts one slot fewer.
    fn given_back(&mut self, name: &SeatName) {
        self.robots -= usize::from(matches!(name, SeatName::Robot(_)));
        let Some(person) = name.person() else { return };
        if let Some(seats) = self.people.get_mut(person) {
            *seats -= 1;
            if *seats == 0 {
                self.people.remove(person);
            }
        }
    }
}

impl Occupant {
    fn subscriptions(&self) -> MutexGuard<'_, Vec<Subscription>> {
        // Replaced as a whole.
        self.subscriptions.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Seat {
    /// Publishes the session's subscriptions for display.
    pub(super) fn listens_to(&self, mut subscriptions: Vec<Subscription>) {
        subscriptions.sort_by(|one, other| one.topic_filter.cmp(&other.topic_filter));
        *self.occupant.subscriptions() = subscriptions;
    }

    /// The session's number; later sessions have higher ones.
    pub(super) fn number(&self) -> u64 {
        self.occupant.number
    }

    /// Cancelled when the session should leave.
    pub(super) fn leave(&self) -> &CancellationToken {
        &self.occupant.leave
    }

    /// The meter of this session's traffic.
    pub(super) fn meter(&self) -> &Meter {
        &self.occupant.meter
    }

    /// The doorbell of this session.
    pub(super) fn doorbell(&self) -> &Doorbell {
        &self.occupant.doorbell
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        let mut table = self.seats.table();
        if table
            .occupants
            .get(&self.name)
            .is_some_and(|occupant| occupant.number == self.occupant.number)
        {
            table.occupants.remove(&self.name);
            table.given_back(&self.name);
        }
        drop(table);
        self.occupant.left.cancel();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_person_has_so_many_seats_and_the_others_theirs() {
        let seats = Seats::new(2);
        let [alice, bob]: [UserName; 2] =
            ["alice", "bob"].map(|name| name.parse().expect("a name"));
        let take = async |name: SeatName| seats.take(name, Arc::default()).await;
        let named = SeatName::Operator(alice.clone(), "one".to_owned());
        let first = take(named.clone()).await.expect("room");
        let second = take(SeatName::Unnamed(alice.clone(), 1)).await.expect("room");
        assert!(take(SeatName::Unnamed(alice.clone(), 2)).await.is_none());
        for other in
            [SeatName::Unnamed(bob, 3), SeatName::Robot(RobotId::random()), SeatName::Canary]
        {
            assert!(take(other).await.is_some());
        }
        // A slot that is taken over is the same slot.
        let (again, ()) = tokio::join!(take(named), async {
            first.leave().cancelled().await;
            drop(first);
        });
        let again = again.expect("its own");
        drop(second);
        let third = take(SeatName::Unnamed(alice.clone(), 2)).await.expect("room again");
        assert!(take(SeatName::Unnamed(alice, 4)).await.is_none());
        drop((again, third));
        assert!(seats.table().people.is_empty());
        assert!(seats.table().occupants.is_empty());
    }
}
