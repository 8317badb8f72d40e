//! Session slots: one session for each robot, and one for each client id of a person, with a limit
//! for each person. A new session takes over a slot only after the previous session has fully
//! ended. This module never touches a socket.

mod mailbox;

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use task_proto::api::Subscription;
use task_proto::{RobotId, UserName};
use tokio_util::sync::CancellationToken;

use self::mailbox::RobotMailbox;
use super::traffic::Meter;

/// The identity of a session. Robots and operators can't take over each other's sessions, whatever
/// client id they present.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) enum SlotKey {
    Robot(RobotId),
    Operator(UserName, String),
    /// An operator without a client id of its own choice.
    Unnamed(UserName, u128),
    Canary,
}

impl SlotKey {
    fn person(&self) -> Option<&UserName> {
        match self {
            Self::Operator(person, _) | Self::Unnamed(person, _) => Some(person),
            Self::Robot(_) | Self::Canary => None,
        }
    }
}

/// All slots in use.
pub(super) struct SessionSlots {
    table: Mutex<Table>,
    max_per_person: usize,
    /// How often robots were evicted.
    evictions: AtomicU64,
}

#[derive(Default)]
struct Table {
    sessions: HashMap<SlotKey, Arc<ActiveSession>>,
    robots: usize,
    people: HashMap<UserName, usize>,
    last_number: u64,
}

struct ActiveSession {
    number: u64,
    /// The token that admitted a robot's session.
    token_number: Option<u64>,
    evicted: CancellationToken,
    ended: CancellationToken,
    mailbox: Arc<RobotMailbox>,
    meter: Arc<Meter>,
    subscriptions: Mutex<Vec<Subscription>>,
}

/// A session's hold on its slot; dropping it marks the session as fully ended.
pub(super) struct SessionSlot {
    slots: Arc<SessionSlots>,
    name: SlotKey,
    session: Arc<ActiveSession>,
}

impl SessionSlots {
    /// Starts with no slots in use, and a maximum for each person.
    pub(super) fn new(max_per_person: usize) -> Arc<Self> {
        Arc::new(Self { table: Mutex::default(), max_per_person, evictions: AtomicU64::new(0) })
    }

    /// Evicts the session in the slot, waits until it has ended, and takes the slot.
    /// Sessions that want the same slot get it one after another in the order of arrival; all but
    /// the last are evicted again at once. `None`: the person has reached the maximum.
    pub(super) async fn take(
        self: &Arc<Self>,
        name: SlotKey,
        token_number: Option<u64>,
        meter: Arc<Meter>,
    ) -> Option<SessionSlot> {
        let (slot, before) = self.register(name, token_number, meter)?;
        if let Some(before) = before {
            before.evicted.cancel();
            before.ended.cancelled().await;
        }
        Some(slot)
    }

    fn register(
        self: &Arc<Self>,
        name: SlotKey,
        token_number: Option<u64>,
        meter: Arc<Meter>,
    ) -> Option<(SessionSlot, Option<Arc<ActiveSession>>)> {
        let mut table = self.table();
        if !table.sessions.contains_key(&name)
            && table.count_of_person(&name) >= self.max_per_person
        {
            return None;
        }
        table.last_number += 1;
        let session = Arc::new(ActiveSession {
            number: table.last_number,
            token_number,
            evicted: CancellationToken::new(),
            ended: CancellationToken::new(),
            mailbox: Arc::new(RobotMailbox::default()),
            meter,
            subscriptions: Mutex::default(),
        });
        let before = table.sessions.insert(name.clone(), session.clone());
        if before.is_none() {
            table.count_added(&name);
        }
        Some((SessionSlot { slots: self.clone(), name, session }, before))
    }

    /// The mailbox of the robot's session.
    pub(super) fn mailbox(&self, robot: &RobotId) -> Option<Arc<RobotMailbox>> {
        self.table()
            .sessions
            .get(&SlotKey::Robot(robot.clone()))
            .map(|session| session.mailbox.clone())
    }

    /// The traffic meter of the robot's session.
    pub(super) fn meter(&self, robot: &RobotId) -> Option<Arc<Meter>> {
        self.table()
            .sessions
            .get(&SlotKey::Robot(robot.clone()))
            .map(|session| session.meter.clone())
    }

    /// The subscriptions of the robot's session.
    pub(super) fn subscriptions(&self, robot: &RobotId) -> Vec<Subscription> {
        let session = self.table().sessions.get(&SlotKey::Robot(robot.clone())).cloned();
        session.map_or_else(Vec::new, |session| session.subscriptions().clone())
    }

    /// How often robots were evicted so far. A client that was admitted before the number changed
    /// has to be checked again.
    pub(super) fn evictions(&self) -> u64 {
        self.evictions.load(Ordering::SeqCst)
    }

    /// Evicts the robot's session.
    pub(super) fn evict(&self, robot: &RobotId) {
        self.evictions.fetch_add(1, Ordering::SeqCst);
        if let Some(session) = self.table().sessions.get(&SlotKey::Robot(robot.clone())) {
            session.evicted.cancel();
        }
    }

    /// Evicts the robot's session unless the token `kept` has admitted it.
    pub(super) fn evict_other_tokens(&self, robot: &RobotId, kept: u64) {
        self.evictions.fetch_add(1, Ordering::SeqCst);
        if let Some(session) = self.table().sessions.get(&SlotKey::Robot(robot.clone()))
            && session.token_number != Some(kept)
        {
            session.evicted.cancel();
        }
    }

    /// Evicts the robot's session with this number.
    pub(super) fn evict_session(&self, robot: &RobotId, number: u64) {
        if let Some(session) = self.table().sessions.get(&SlotKey::Robot(robot.clone()))
            && session.number == number
        {
            session.evicted.cancel();
        }
    }

    /// The robots with a slot.
    pub(super) fn robots(&self) -> Vec<RobotId> {
        let robot = |name: &SlotKey| match name {
            SlotKey::Robot(robot) => Some(robot.clone()),
            _ => None,
        };
        self.table().sessions.keys().filter_map(robot).collect()
    }

    /// Evicts all of a person's sessions.
    pub(super) fn evict_person(&self, person: &UserName) {
        for (name, session) in &self.table().sessions {
            if name.person() == Some(person) {
                session.evicted.cancel();
            }
        }
    }

    /// Evicts the sessions of all people.
    pub(super) fn evict_people(&self) {
        for (name, session) in &self.table().sessions {
            if name.person().is_some() {
                session.evicted.cancel();
            }
        }
    }

    /// The number of robots with a slot.
    pub(super) fn robot_count(&self) -> usize {
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
    fn count_of_person(&self, name: &SlotKey) -> usize {
        name.person().and_then(|person| self.people.get(person)).copied().unwrap_or_default()
    }

    /// Counts one more slot.
    fn count_added(&mut self, name: &SlotKey) {
        self.robots += usize::from(matches!(name, SlotKey::Robot(_)));
        if let Some(person) = name.person() {
            *self.people.entry(person.clone()).or_default() += 1;
        }
    }

    /// Counts one slot fewer.
    fn count_removed(&mut self, name: &SlotKey) {
        self.robots -= usize::from(matches!(name, SlotKey::Robot(_)));
        let Some(person) = name.person() else { return };
        if let Some(slots) = self.people.get_mut(person) {
            *slots -= 1;
            if *slots == 0 {
                self.people.remove(person);
            }
        }
    }
}

impl ActiveSession {
    fn subscriptions(&self) -> MutexGuard<'_, Vec<Subscription>> {
        // Replaced as a whole.
        self.subscriptions.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl SessionSlot {
    /// Publishes the session's subscriptions for display.
    pub(super) fn set_subscriptions(&self, mut subscriptions: Vec<Subscription>) {
        subscriptions.sort_by(|one, other| one.topic_filter.cmp(&other.topic_filter));
        *self.session.subscriptions() = subscriptions;
    }

    /// The session's number; later sessions have higher ones.
    pub(super) fn number(&self) -> u64 {
        self.session.number
    }

    /// Cancelled when the session has to end.
    pub(super) fn evicted(&self) -> &CancellationToken {
        &self.session.evicted
    }

    /// The meter of this session's traffic.
    pub(super) fn meter(&self) -> &Meter {
        &self.session.meter
    }

    /// The mailbox of this session.
    pub(super) fn mailbox(&self) -> &RobotMailbox {
        &self.session.mailbox
    }
}

impl Drop for SessionSlot {
    fn drop(&mut self) {
        let mut table = self.slots.table();
        if table
            .sessions
            .get(&self.name)
            .is_some_and(|session| session.number == self.session.number)
        {
            table.sessions.remove(&self.name);
            table.count_removed(&self.name);
        }
        drop(table);
        self.session.ended.cancel();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn session_limit_applies_to_each_person_separately() {
        let slots = SessionSlots::new(2);
        let [alice, bob]: [UserName; 2] =
            ["alice", "bob"].map(|name| name.parse().expect("a name"));
        let take = async |name: SlotKey| slots.take(name, None, Arc::default()).await;
        let named = SlotKey::Operator(alice.clone(), "one".to_owned());
        let first = take(named.clone()).await.expect("room");
        let second = take(SlotKey::Unnamed(alice.clone(), 1)).await.expect("room");
        assert!(take(SlotKey::Unnamed(alice.clone(), 2)).await.is_none());
        for other in [SlotKey::Unnamed(bob, 3), SlotKey::Robot(RobotId::random()), SlotKey::Canary]
        {
            assert!(take(other).await.is_some());
        }
        // A slot that is taken over is the same slot.
        let (again, ()) = tokio::join!(take(named), async {
            first.evicted().cancelled().await;
            drop(first);
        });
        let again = again.expect("taken over");
        drop(second);
        let third = take(SlotKey::Unnamed(alice.clone(), 2)).await.expect("room again");
        assert!(take(SlotKey::Unnamed(alice, 4)).await.is_none());
        drop((again, third));
        assert!(slots.table().people.is_empty());
        assert!(slots.table().sessions.is_empty());
    }
}
