//! Who has which seat: one session for each robot, and for each of a person's client ids. A newcomer takes the seat over only
//! after the session before it has fully ended. It never touches a socket.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use task_proto::api::Subscription;
use task_proto::{RobotId, UserName};
use tokio_util::sync::CancellationToken;

use super::doorbell::Doorbell;
use super::traffic::Meter;

/// What a session is known by. Robots and operators can't take over each other, whatever client id they give.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) enum SeatName {
    Robot(RobotId),
    Operator(UserName, String),
    /// An operator who left the choice of a client id to us.
    Unnamed(UserName, u128),
    Canary,
}

/// All seats that are taken.
#[derive(Default)]
pub(super) struct Seats {
    table: Mutex<Table>,
    /// How often a robot was put out.
    put_out: AtomicU64,
}

#[derive(Default)]
struct Table {
    occupants: HashMap<SeatName, Arc<Occupant>>,
    robots: usize,
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

/// A session's hold on its seat; dropping it says that the session has fully ended.
pub(super) struct Seat {
    seats: Arc<Seats>,
    name: SeatName,
    occupant: Arc<Occupant>,
}

impl Seats {
    /// Asks whoever has the seat to leave, waits until they have, and sits down. Sessions that want the same seat get it
    /// one after another in the order of their arrival; all but the last find that they should leave again.
    pub(super) async fn take(self: &Arc<Self>, name: SeatName, meter: Arc<Meter>) -> Seat {
        let (seat, before) = self.claim(name, meter);
        if let Some(before) = before {
            before.leave.cancel();
            before.left.cancelled().await;
        }
        seat
    }

    fn claim(self: &Arc<Self>, name: SeatName, meter: Arc<Meter>) -> (Seat, Option<Arc<Occupant>>) {
        let mut table = self.table();
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
        if before.is_none() && matches!(name, SeatName::Robot(_)) {
            table.robots += 1;
        }
        (Seat { seats: self.clone(), name, occupant }, before)
    }

    /// The doorbell of the robot's session.
    pub(super) fn doorbell(&self, robot: &RobotId) -> Option<Arc<Doorbell>> {
        self.table().occupants.get(&SeatName::Robot(robot.clone())).map(|occupant| occupant.doorbell.clone())
    }

    /// The figures of the robot's session.
    pub(super) fn meter(&self, robot: &RobotId) -> Option<Arc<Meter>> {
        self.table().occupants.get(&SeatName::Robot(robot.clone())).map(|occupant| occupant.meter.clone())
    }

    /// What the robot's session listens to.
    pub(super) fn subscriptions(&self, robot: &RobotId) -> Vec<Subscription> {
        let occupant = self.table().occupants.get(&SeatName::Robot(robot.clone())).cloned();
        occupant.map_or_else(Vec::new, |occupant| occupant.subscriptions().clone())
    }

    /// How often a robot was put out so far. Who was let in before the number changed has to be asked again.
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
            if matches!(name, SeatName::Operator(user, _) | SeatName::Unnamed(user, _) if user == person) {
                occupant.leave.cancel();
            }
        }
    }

    /// How many robots have a seat.
    pub(super) fn robots(&self) -> usize {
        self.table().robots
    }

    fn table(&self) -> MutexGuard<'_, Table> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing half-done.
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Occupant {
    fn subscriptions(&self) -> MutexGuard<'_, Vec<Subscription>> {
        // Replaced as a whole.
        self.subscriptions.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Seat {
    /// Notes what the session listens to, for whoever looks.
    pub(super) fn listens_to(&self, mut subscriptions: Vec<Subscription>) {
        subscriptions.sort_by(|one, other| one.topic_filter.cmp(&other.topic_filter));
        *self.occupant.subscriptions() = subscriptions;
    }

    /// The session's number; later sessions have higher ones.
    pub(super) fn number(&self) -> u64 {
        self.occupant.number
    }

    /// Ends when the session should leave.
    pub(super) fn leave(&self) -> &CancellationToken {
        &self.occupant.leave
    }

    /// What counts this session's traffic.
    pub(super) fn meter(&self) -> &Meter {
        &self.occupant.meter
    }

    /// What rings for this session.
    pub(super) fn doorbell(&self) -> &Doorbell {
        &self.occupant.doorbell
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        let mut table = self.seats.table();
        if table.occupants.get(&self.name).is_some_and(|occupant| occupant.number == self.occupant.number) {
            table.occupants.remove(&self.name);
            if matches!(self.name, SeatName::Robot(_)) {
                table.robots -= 1;
            }
        }
        drop(table);
        self.occupant.left.cancel();
    }
}
