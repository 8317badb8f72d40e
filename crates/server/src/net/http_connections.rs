//! The authenticated HTTP connections by holder: the person, robot or enrollment token. All
//! connections of a holder can be cut at once, when a robot is revoked. When connections run out, a
//! holder with more than its share loses its oldest one. Unauthenticated connections belong to the
//! `unauthenticated` module.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use task_proto::{RobotId, UserName};
use tokio::sync::OwnedMutexGuard;
use tokio_util::sync::CancellationToken;

/// A holder may always have this number of connections: a browser opens six, an agent fewer.
const ALWAYS_ALLOWED: usize = 8;

/// The account that a connection counts for. Among holders with equally many connections, the last
/// in this order loses one first.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Holder {
    /// A robot, with any of its tokens.
    Robot(RobotId),
    /// A person, with all tokens and sessions.
    Person(UserName),
    /// An enrollment token, by its id.
    Enrollment(String),
}

/// All connections that have a holder. The listener bounds their number.
#[derive(Debug, Default)]
pub struct HttpConnections {
    by_holder: Mutex<ConnectionsByHolder>,
    last_number: AtomicU64,
    robots_ended: AtomicU64,
}

#[derive(Debug, Default)]
struct ConnectionsByHolder {
    /// Each holder's connections, the oldest first.
    connections: HashMap<Holder, BTreeMap<u64, CancellationToken>>,
    /// The same holders in the order of their numbers of connections.
    by_count: BTreeSet<(usize, Holder)>,
}

/// A connection, attached to its requests. Clones share the same state.
#[derive(Debug, Clone, Default)]
pub struct Connection {
    cut: CancellationToken,
    authenticated: CancellationToken,
    /// Locked while a token of this connection is looked up.
    lookup: Arc<tokio::sync::Mutex<()>>,
    bytes_out: Arc<AtomicU64>,
    /// The holder of the last token presented on the connection.
    registration: Arc<Mutex<Option<Registration>>>,
}

/// Counts a connection for a holder until dropped.
#[derive(Debug)]
struct Registration {
    connections: Arc<HttpConnections>,
    holder: Holder,
    number: u64,
}

/// A request whose token is being looked up.
#[derive(Debug)]
pub struct Arrival<'a> {
    connections: &'a Arc<HttpConnections>,
    robots_ended: u64,
}

impl HttpConnections {
    /// Registers a request's arrival. Call this before looking up the request's token.
    pub fn arrival(self: &Arc<Self>) -> Arrival<'_> {
        Arrival { connections: self, robots_ended: self.robots_ended.load(Ordering::SeqCst) }
    }

    fn register(self: &Arc<Self>, holder: &Holder, connection: &Connection) {
        let mut registration =
            connection.registration.lock().unwrap_or_else(PoisonError::into_inner);
        if registration.as_ref().is_some_and(|registration| registration.holder == *holder) {
            return;
        }
        let number = self.last_number.fetch_add(1, Ordering::Relaxed);
        self.by_holder().change(holder, |connections| {
            connections.insert(number, connection.cut.clone());
        });
        *registration =
            Some(Registration { connections: self.clone(), holder: holder.clone(), number });
    }

    /// Cuts all connections of the robot.
    pub fn end(&self, robot: &RobotId) {
        self.robots_ended.fetch_add(1, Ordering::SeqCst);
        let ended = self.by_holder().change(&Holder::Robot(robot.clone()), std::mem::take);
        ended.values().for_each(CancellationToken::cancel);
    }

    /// Cuts the oldest connection of the holder with the most, if that is more than its fair share
    /// of `limit` connections. False if no holder exceeds its share.
    pub fn cut_oldest_of_largest(&self, limit: usize) -> bool {
        let mut by_holder = self.by_holder();
        let share = by_holder.fair_share(limit);
        let largest = by_holder
            .by_count
            .last()
            .filter(|(count, _)| *count > share)
            .map(|(_, holder)| holder.clone());
        let Some(holder) = largest else { return false };
        let oldest = by_holder.change(&holder, BTreeMap::pop_first);
        drop(by_holder);
        tracing::debug!(
            ?holder,
            share,
            "connections run out: the oldest of the holder with the most is cut"
        );
        oldest.inspect(|(_, cut)| cut.cancel()).is_some()
    }

    fn by_holder(&self) -> MutexGuard<'_, ConnectionsByHolder> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.by_holder.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ConnectionsByHolder {
    /// Each holder's share of `limit` connections if one more holder comes.
    fn fair_share(&self, limit: usize) -> usize {
        (limit / (self.connections.len() + 1)).max(ALWAYS_ALLOWED.min(limit / 2)).max(1)
    }

    /// Changes a holder's connections, and updates the order by number.
    fn change<T>(
        &mut self,
        holder: &Holder,
        change: impl FnOnce(&mut BTreeMap<u64, CancellationToken>) -> T,
    ) -> T {
        let connections = self.connections.entry(holder.clone()).or_default();
        let before = connections.len();
        let changed = change(connections);
        let after = connections.len();
        if after == 0 {
            self.connections.remove(holder);
        }
        if before != after {
            self.by_count.remove(&(before, holder.clone()));
            if after > 0 {
                self.by_count.insert((after, holder.clone()));
            }
        }
        changed
    }
}

impl Arrival<'_> {
    /// Assigns `connection` to the request's holder. False if a robot's tokens ended since the
    /// request arrived: the connection was not yet registered and so was not cut, and the token has
    /// to be looked up again.
    pub fn identified(self, holder: &Holder, connection: &Connection) -> bool {
        self.connections.register(holder, connection);
        self.connections.robots_ended.load(Ordering::SeqCst) == self.robots_ended
    }
}

impl Connection {
    /// Removes the connection from its holder until the next token is presented.
    pub fn release(&self) {
        *self.registration.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    /// Adds bytes that the other side received, as far as the operating system can tell.
    pub fn wrote(&self, bytes: usize) {
        self.bytes_out.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// Bytes that the other side received so far.
    pub fn bytes_out(&self) -> u64 {
        self.bytes_out.load(Ordering::Relaxed)
    }

    /// Cuts the connection, also in the middle of a response.
    pub fn end(&self) {
        self.cut.cancel();
    }

    /// Records that a valid token was presented on the connection.
    pub fn authenticate(&self) {
        self.authenticated.cancel();
    }

    /// Resolves when a valid token was presented.
    pub async fn authenticated(&self) {
        self.authenticated.cancelled().await;
    }

    /// Marks a token lookup on the connection until the guard is dropped.
    pub async fn lookup(&self) -> OwnedMutexGuard<()> {
        self.lookup.clone().lock_owned().await
    }

    /// Whether a valid token was presented; waits for a pending lookup.
    pub async fn is_authenticated_after_lookup(&self) -> bool {
        let _lookup = self.lookup.lock().await;
        self.authenticated.is_cancelled()
    }

    /// Resolves when the connection has to end.
    pub async fn cut(&self) {
        self.cut.cancelled().await;
    }
}

impl Drop for Registration {
    fn drop(&mut self) {
        self.connections
            .by_holder()
            .change(&self.holder, |connections| connections.remove(&self.number));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn person(name: &str) -> Holder {
        Holder::Person(name.parse().expect("a name"))
    }

    fn connected(all: &Arc<HttpConnections>, holder: &Holder, count: usize) -> Vec<Connection> {
        let new = |_| {
            let connection = Connection::default();
            assert!(all.arrival().identified(holder, &connection));
            connection
        };
        (0..count).map(new).collect()
    }

    fn cut(connections: &[Connection]) -> Vec<bool> {
        connections.iter().map(|connection| connection.cut.is_cancelled()).collect()
    }

    #[test]
    fn revoked_robot_loses_only_its_own_connections() {
        let all = Arc::new(HttpConnections::default());
        let [one, other] = [(); 2].map(|()| RobotId::random());
        let own = connected(&all, &Holder::Robot(one.clone()), 2);
        assert!(all.arrival().identified(&Holder::Robot(one.clone()), &own[0]), "its next request");
        let strangers = connected(&all, &Holder::Robot(other.clone()), 1);
        all.end(&one);
        assert_eq!((cut(&own), cut(&strangers)), (vec![true; 2], vec![false]));
        // Behind a proxy, a connection that carries another robot's requests is assigned to that
        // robot or to no holder.
        all.arrival().identified(&Holder::Robot(one.clone()), &strangers[0]);
        all.end(&other);
        strangers[0].release();
        all.end(&one);
        assert_eq!(cut(&strangers), [false]);
        drop((own, strangers));
        let by_holder = all.by_holder();
        assert!(by_holder.connections.is_empty() && by_holder.by_count.is_empty());
    }

    #[test]
    fn revocation_during_token_lookup_repeats_the_lookup() {
        let (all, robot) = (Arc::new(HttpConnections::default()), RobotId::random());
        assert!(all.arrival().identified(&Holder::Robot(robot.clone()), &Connection::default()));
        let arrival = all.arrival();
        all.end(&robot);
        assert!(!arrival.identified(&Holder::Robot(robot), &Connection::default()));
    }

    #[test]
    fn largest_holder_loses_its_oldest_connections_down_to_its_share() {
        let all = Arc::new(HttpConnections::default());
        let viewer = connected(&all, &person("viewer"), 60);
        let robots: Vec<_> =
            (0..5).map(|_| connected(&all, &Holder::Robot(RobotId::random()), 4)).collect();
        let operator = connected(&all, &person("operator"), 1);
        let cuts = (0..100).filter(|_| all.cut_oldest_of_largest(80)).count();
        assert_eq!(cuts, 50, "80 connections for eight holders: ten each");
        assert_eq!(cut(&viewer), [vec![true; 50], vec![false; 10]].concat());
        assert!(
            !robots
                .iter()
                .flatten()
                .chain(&operator)
                .any(|connection| connection.cut.is_cancelled())
        );
    }

    #[test]
    fn robot_has_a_fair_share_like_other_holders() {
        let all = Arc::new(HttpConnections::default());
        let flood = connected(&all, &Holder::Robot(RobotId::random()), 30);
        let _operator = connected(&all, &person("operator"), 2);
        assert!(all.cut_oldest_of_largest(32));
        assert!(flood[0].cut.is_cancelled() && !flood[1].cut.is_cancelled());
    }

    #[tokio::test]
    async fn authentication_check_waits_for_a_pending_lookup() {
        let connection = Connection::default();
        assert!(!connection.is_authenticated_after_lookup().await);
        let lookup = connection.lookup().await;
        let mut judged = Box::pin(connection.is_authenticated_after_lookup());
        assert!(futures_util::poll!(judged.as_mut()).is_pending());
        connection.authenticate();
        drop(lookup);
        assert!(judged.await);
    }

    #[test]
    fn few_connections_are_never_too_many() {
        let all = Arc::new(HttpConnections::default());
        let _fleet: Vec<_> =
            (0..50).map(|_| connected(&all, &Holder::Robot(RobotId::random()), 2)).collect();
        assert!(!all.cut_oldest_of_largest(100), "each has its share");
        let small = Arc::new(HttpConnections::default());
        let flood = connected(&small, &person("viewer"), 4);
        assert!(small.cut_oldest_of_largest(4), "all places of a small server");
        assert_eq!(cut(&flood), [true, false, false, false]);
    }
}
