//! Presence of robots: whether a robot is connected over MQTT or polls over HTTP, its address,
//! since when, and which robots have two instances that displace each other. Kept in memory only;
//! in a cluster, the presence that other servers share is laid over it. This module never
//! communicates and never reads a clock.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use task_proto::{InstanceId, RobotId};

pub use super::robot_presence::{AgentIdentity, RobotPresence};
use super::shared_presence::{SessionHere, SharedPresence};
use crate::domain::instance_history::InstanceHistory;

/// Silence of the serving instance before another instance takes over the robot's work. An MQTT
/// session without a sign of life ends within this time, and an agent without a session polls more
/// often.
pub const HANDOVER_SILENCE_MS: u64 = 30 * 1000;
/// How long we show that another instance has appeared and waits.
const WAIT_DISPLAY_MS: u64 = 60 * 1000;
/// Maximum robots in memory; beyond the limit, the longest silent robots are forgotten.
const MAX_ROBOTS: usize = 100_000;

/// All robots that this process has seen, and those that other servers of the cluster see.
pub struct Presence {
    window_ms: u64,
    /// Robots not seen since then count as offline since then.
    started_ms: AtomicU64,
    robots: Mutex<HashMap<RobotId, PresenceRecord>>,
    /// The exchange with the other servers; `None`: this server is alone.
    shared: Option<SharedPresence>,
}

/// The result of an agent's statement about itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Admission {
    /// Whether this instance serves the robot's work; otherwise the instance waits.
    pub is_serving: bool,
    /// Whether the instance begins to serve now, or its session has just become known: send it the
    /// desired state.
    pub needs_state: bool,
}

#[derive(Default)]
struct PresenceRecord {
    address: Option<SocketAddr>,
    connection: Option<Connection>,
    /// `None`: the robot is only remembered.
    last_seen_ms: Option<u64>,
    /// Time of the last HTTP request. The end of a connection clears this field: a robot that
    /// disconnects is offline until its next request.
    polled_ms: Option<u64>,
    instances: InstanceHistory,
    /// The instance that serves the robot's work, and the time of its last message or request.
    serving: Option<(AgentIdentity, u64)>,
    /// The instance that owns the MQTT session, once the agent has stated it.
    session_instance: Option<InstanceId>,
    /// When another instance was last told to wait.
    last_wait_ms: Option<u64>,
    /// The token that admitted the last MQTT session.
    token_number: u64,
    /// Time of the last message or request that was shared with the other servers.
    shared_ms: Option<u64>,
}

#[derive(Clone, Copy)]
struct Connection {
    number: u64,
    since_ms: u64,
}

impl Presence {
    /// Starts with no robots. A polling robot is online for `window_ms` after its last request.
    pub fn new(window_ms: u64, now_ms: u64) -> Self {
        Self { window_ms, started_ms: now_ms.into(), robots: Mutex::default(), shared: None }
    }

    /// Shares the presence of robots with the other servers of the cluster.
    pub fn share(self, shared: SharedPresence) -> Self {
        Self { shared: Some(shared), ..self }
    }

    /// The exchange with the other servers; `None`: this server is alone.
    pub fn shared(&self) -> Option<&SharedPresence> {
        self.shared.as_ref()
    }

    /// Counts robots that are not seen as offline since `now_ms`: a standby, which could not see
    /// them, takes over.
    pub fn restart(&self, now_ms: u64) {
        self.started_ms.store(now_ms, Ordering::Relaxed);
    }

    /// The robot's MQTT session number `connection` began.
    pub fn connected(
        &self,
        robot: &RobotId,
        address: Option<SocketAddr>,
        connection: u64,
        now_ms: u64,
    ) {
        let mut robots = self.robots();
        let record = touch(&mut robots, robot, address, now_ms);
        if record.connection.is_none_or(|known| known.number < connection) {
            record.session_ended(now_ms);
            record.connection = Some(Connection { number: connection, since_ms: now_ms });
            record.address = address.or(record.address);
            self.to_share(robot);
        }
    }

    /// The robot's MQTT session is admitted by this token.
    pub fn admitted_by(&self, robot: &RobotId, token_number: u64) {
        entry(&mut self.robots(), robot).token_number = token_number;
    }

    /// The robot's MQTT session number `connection` ended. An end that arrives after the next
    /// session has begun changes nothing.
    pub fn disconnected(&self, robot: &RobotId, connection: u64, now_ms: u64) {
        if let Some(record) = self.robots().get_mut(robot)
            && record.connection.is_some_and(|known| known.number == connection)
        {
            record.session_ended(now_ms);
            record.connection = None;
            record.polled_ms = None;
            record.last_seen_ms = record.last_seen_ms.max(Some(now_ms));
            self.to_share(robot);
        }
    }

    /// The robot sent an HTTP request.
    pub fn seen(&self, robot: &RobotId, address: SocketAddr, now_ms: u64) {
        let mut robots = self.robots();
        let record = touch(&mut robots, robot, Some(address), now_ms);
        record.polled_ms = Some(now_ms);
        let is_shared =
            record.shared_ms.is_some_and(|at_ms| now_ms.saturating_sub(at_ms) < self.window_ms / 2);
        if record.connection.is_none() && !is_shared {
            self.to_share(robot);
        }
    }

    /// The robot's session at this server, for the others. `None`: the robot is offline here.
    pub fn session_here(&self, robot: &RobotId, now_ms: u64) -> Option<SessionHere> {
        let mut robots = self.robots();
        let record = robots.get_mut(robot)?;
        let seen = record.view(self.window_ms, now_ms).filter(|seen| seen.online);
        record.shared_ms = seen.as_ref().map(|_| now_ms);
        seen.map(|seen| SessionHere {
            token_number: record.token_number,
            connection: seen.connection,
            since_ms: seen.connected_since_ms,
            seen_ms: seen.last_seen_ms,
            address: seen.address,
            agent: record.serving.as_ref().map(|(agent, _)| agent.clone()),
        })
    }

    /// Has all sessions at this server shared again.
    pub fn share_all(&self) {
        let robots: Vec<RobotId> = self.robots().keys().cloned().collect();
        robots.iter().for_each(|robot| self.to_share(robot));
    }

    fn to_share(&self, robot: &RobotId) {
        if let Some(shared) = &self.shared {
            shared.unwritten.add(robot);
        }
    }

    /// The robot's agent identified itself, in the MQTT session number `connection` if in a
    /// session. An instance that does not serve the robot's work waits until the serving instance
    /// ends or falls silent.
    pub fn identify(
        &self,
        robot: &RobotId,
        address: Option<SocketAddr>,
        connection: Option<u64>,
        agent: AgentIdentity,
        now_ms: u64,
    ) -> Admission {
        let mut robots = self.robots();
        let record = touch(&mut robots, robot, address, now_ms);
        let is_new_instance = record.instances.observe(&agent.instance, now_ms);
        let is_current_session =
            connection.is_some() && connection == record.connection.map(|known| known.number);
        let is_first_in_session =
            is_current_session && record.session_instance.as_ref() != Some(&agent.instance);
        if is_current_session {
            record.session_instance = Some(agent.instance.clone());
        }
        if let Some(shared) = &self.shared
            && (is_new_instance || is_first_in_session || shared.elsewhere.is_online(robot))
        {
            shared.instances.add(robot, &agent.instance, now_ms);
        }
        if let Some(elsewhere) =
            self.shared.as_ref().and_then(|shared| shared.elsewhere.agent(robot, now_ms))
            && record.serving.as_ref().is_none_or(|(_, active_ms)| *active_ms <= elsewhere.1)
        {
            record.serving = Some(elsewhere);
        }
        if !record.hands_over_to(&agent, now_ms) {
            record.last_wait_ms = Some(now_ms);
            return Admission { is_serving: false, needs_state: false };
        }
        let is_known =
            record.serving.as_ref().is_some_and(|(serving, _)| serving.instance == agent.instance);
        // The session of an older agent gets its state without identifying itself.
        let needs_state = agent.place.is_some() && (is_first_in_session || !is_known);
        record.serving = Some((agent, now_ms));
        if !is_known {
            self.to_share(robot);
        }
        Admission { is_serving: true, needs_state }
    }

    /// Remembers an agent that was seen before this process started, and may appear again.
    pub fn remember(&self, robot: &RobotId, agent: AgentIdentity, now_ms: u64) {
        entry(&mut self.robots(), robot).serving.get_or_insert((agent, now_ms));
    }

    /// Whether requests in the robot's name must identify their agent, because the robot's agent
    /// does.
    pub fn requires_identity(&self, robot: &RobotId) -> bool {
        self.robots().get(robot).is_some_and(PresenceRecord::requires_identity)
    }

    /// Whether the robot's MQTT session belongs to the agent that serves its work, as far as its
    /// agents have identified themselves.
    pub fn accepts_downlink(&self, robot: &RobotId) -> bool {
        self.robots()
            .get(robot)
            .is_none_or(|record| !record.requires_identity() || record.has_session())
    }

    /// The agent instance that serves the robot's work.
    pub fn instance(&self, robot: &RobotId) -> Option<InstanceId> {
        self.robots().get(robot)?.serving.as_ref().map(|(serving, _)| serving.instance.clone())
    }

    /// The presence of the robot; `None` if neither this process nor another server of the cluster
    /// has seen the robot.
    pub fn get(&self, robot: &RobotId, now_ms: u64) -> Option<RobotPresence> {
        let here = self.robots().get(robot).and_then(|record| record.view(self.window_ms, now_ms));
        match &self.shared {
            Some(shared) => shared.elsewhere.overlay(robot, here),
            None => here,
        }
    }

    /// Whether the robot is online at another server of the cluster, and not here. A robot that is
    /// connected there may send requests to this one.
    pub fn is_elsewhere(&self, robot: &RobotId, now_ms: u64) -> bool {
        let Some(shared) = &self.shared else { return false };
        let here = self.robots().get(robot).and_then(|record| record.view(self.window_ms, now_ms));
        match here {
            Some(here) if here.connection.is_some() => false,
            Some(here) if here.online => shared.elsewhere.is_connected(robot),
            _ => shared.elsewhere.is_online(robot),
        }
    }

    /// The robot's connection to another server has ended: a robot that disconnects is offline
    /// until its next request.
    pub fn disconnected_elsewhere(&self, robot: &RobotId) {
        if let Some(record) = self.robots().get_mut(robot) {
            record.polled_ms = None;
        }
    }

    /// Whether the robot is online.
    pub fn is_online(&self, robot: &RobotId, now_ms: u64) -> bool {
        self.get(robot, now_ms).is_some_and(|sighting| sighting.online)
    }

    /// How long each of these robots has been offline, as far as this process knows; `None`: the
    /// robot is online.
    pub fn offline_ms<'a>(
        &self,
        robots: impl IntoIterator<Item = &'a RobotId>,
        now_ms: u64,
    ) -> Vec<Option<u64>> {
        let started_ms = self.started_ms.load(Ordering::Relaxed);
        let offline_ms = |robot: &RobotId| {
            let since_ms = match self.get(robot, now_ms) {
                Some(sighting) if sighting.online => return None,
                Some(sighting) => sighting.last_seen_ms.max(started_ms),
                None => started_ms,
            };
            Some(now_ms.saturating_sub(since_ms))
        };
        robots.into_iter().map(offline_ms).collect()
    }

    /// Whether the robot is connected over MQTT.
    pub fn is_connected(&self, robot: &RobotId) -> bool {
        self.robots().get(robot).is_some_and(|record| record.connection.is_some())
    }

    /// Robots without a connection that were online at `since_ms` and are offline at `now_ms`,
    /// because the window passed without a request.
    pub fn timed_out(&self, since_ms: u64, now_ms: u64) -> Vec<RobotId> {
        let mut fell = self.timed_out_here(since_ms, now_ms);
        fell.iter().for_each(|robot| self.to_share(robot));
        fell.retain(|robot| !self.is_elsewhere(robot, now_ms));
        fell
    }

    fn timed_out_here(&self, since_ms: u64, now_ms: u64) -> Vec<RobotId> {
        let robots = self.robots();
        let fell = robots.iter().filter(|(_, record)| {
            let ends_ms =
                record.polled_ms.map(|polled_ms| polled_ms.saturating_add(self.window_ms));
            record.connection.is_none()
                && ends_ms.is_some_and(|ends_ms| since_ms < ends_ms && ends_ms <= now_ms)
        });
        fell.map(|(robot, _)| robot.clone()).collect()
    }

    /// Whether two instances of the robot keep displacing each other.
    pub fn is_duplicate(&self, robot: &RobotId, now_ms: u64) -> bool {
        self.robots().get(robot).is_some_and(|record| record.instances.is_duplicate(now_ms))
    }

    /// The robot's other tokens have ended, so no other client is admitted by them any more.
    pub fn end_other_instances(&self, robot: &RobotId) {
        if let Some(record) = self.robots().get_mut(robot) {
            record.instances = InstanceHistory::default();
            (record.serving, record.session_instance, record.last_wait_ms) = (None, None, None);
        }
    }

    /// The same, with the other servers of the cluster.
    pub fn end_other_instances_everywhere(&self, robot: &RobotId) {
        self.end_other_instances(robot);
        if let Some(shared) = &self.shared {
            shared.instances.reset(robot);
        }
    }

    /// The instances of the robot that any server of the cluster has seen.
    pub fn set_instances(&self, robot: &RobotId, instances: InstanceHistory) {
        if let Some(record) = self.robots().get_mut(robot) {
            record.instances = instances;
        }
    }

    /// The robot was removed.
    pub fn forget(&self, robot: &RobotId) {
        self.robots().remove(robot);
        self.to_share(robot);
    }

    fn robots(&self) -> MutexGuard<'_, HashMap<RobotId, PresenceRecord>> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.robots.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn touch<'a>(
    robots: &'a mut HashMap<RobotId, PresenceRecord>,
    robot: &RobotId,
    address: Option<SocketAddr>,
    now_ms: u64,
) -> &'a mut PresenceRecord {
    let record = entry(robots, robot);
    let is_elsewhere =
        address.map(|address| address.ip()) != record.address.map(|address| address.ip());
    // During a session the port is that of the session: each HTTP request may have another port.
    if address.is_some() && (record.connection.is_none() || is_elsewhere) {
        record.address = address;
    }
    record.last_seen_ms = record.last_seen_ms.max(Some(now_ms));
    record
}

fn entry<'a>(
    robots: &'a mut HashMap<RobotId, PresenceRecord>,
    robot: &RobotId,
) -> &'a mut PresenceRecord {
    if robots.len() >= MAX_ROBOTS && !robots.contains_key(robot) {
        make_room(robots);
    }
    robots.entry(robot.clone()).or_default()
}

/// Forgets the longest silent sixteenth of the robots, so that the next scan is far off.
fn make_room(robots: &mut HashMap<RobotId, PresenceRecord>) {
    let mut silent: Vec<(bool, Option<u64>, RobotId)> = robots
        .iter()
        .map(|(robot, record)| (record.connection.is_some(), record.last_seen_ms, robot.clone()))
        .collect();
    silent.sort_unstable();
    for (_, _, robot) in silent.into_iter().take(MAX_ROBOTS / 16) {
        robots.remove(&robot);
    }
}

impl PresenceRecord {
    /// Whether this agent serves the robot's work. That is true for the agent that already serves,
    /// for an agent that could only start after the serving one had ended, and once the serving one
    /// has been silent for long enough. An older agent does not state its place, so a restart looks
    /// like a copy. In that case the next instance takes over at once, as in earlier versions.
    fn hands_over_to(&self, agent: &AgentIdentity, now_ms: u64) -> bool {
        let Some((serving, active_ms)) = &self.serving else { return true };
        let Some(place) = serving.place else { return true };
        let is_silent =
            !self.has_session() && now_ms.saturating_sub(*active_ms) >= HANDOVER_SILENCE_MS;
        serving.instance == agent.instance || agent.place == Some(place) || is_silent
    }

    fn requires_identity(&self) -> bool {
        self.serving.as_ref().is_some_and(|(serving, _)| serving.place.is_some())
    }

    /// Whether the serving agent also owns the robot's session.
    fn has_session(&self) -> bool {
        let speaks = |(serving, _): &(AgentIdentity, u64)| {
            self.session_instance.as_ref() == Some(&serving.instance)
        };
        self.connection.is_some() && self.serving.as_ref().is_some_and(speaks)
    }

    /// The owner of the session was present until now.
    fn session_ended(&mut self, now_ms: u64) {
        if self.has_session()
            && let Some((_, active_ms)) = &mut self.serving
        {
            *active_ms = now_ms;
        }
        self.session_instance = None;
    }

    fn view(&self, window_ms: u64, now_ms: u64) -> Option<RobotPresence> {
        Some(RobotPresence {
            online: self.connection.is_some()
                || self
                    .polled_ms
                    .is_some_and(|polled_ms| now_ms.saturating_sub(polled_ms) < window_ms),
            address: self.address,
            connected_since_ms: self.connection.map(|connection| connection.since_ms),
            connection: self.connection.map(|connection| connection.number),
            last_seen_ms: self.last_seen_ms?,
            duplicate: self.instances.is_duplicate(now_ms),
            has_waiting_instance: self
                .last_wait_ms
                .is_some_and(|at_ms| now_ms.saturating_sub(at_ms) < WAIT_DISPLAY_MS),
        })
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use task_proto::Digest;

    use super::*;
    use crate::fleet::live_nodes::LiveNodes;
    use crate::fleet::sessions_elsewhere::SessionElsewhere;

    const MINUTE_MS: u64 = 60_000;

    fn address() -> SocketAddr {
        "127.0.0.1:4000".parse().expect("an address")
    }

    #[test]
    fn connected_or_recently_polling_robot_is_online() {
        let presence = Presence::new(1000, 0);
        let robot = RobotId::random();
        assert_eq!(presence.get(&robot, 0), None);
        presence.seen(&robot, address(), 10);
        assert!(presence.is_online(&robot, 1009));
        assert!(!presence.is_online(&robot, 1010));
        presence.connected(&robot, Some(address()), 7, 2000);
        let sighting = presence.get(&robot, 90_000).expect("seen");
        assert!(sighting.online);
        assert_eq!((sighting.connection, sighting.connected_since_ms), (Some(7), Some(2000)));
        presence.disconnected(&robot, 7, 100_000);
        assert!(!presence.is_online(&robot, 100_000), "a disconnected robot is offline at once");
        presence.connected(&robot, None, 8, 100_000);
        let sighting = presence.get(&robot, 100_000).expect("seen");
        assert_eq!(
            (sighting.connection, sighting.address),
            (Some(8), Some(address())),
            "known from before"
        );
        presence.disconnected(&robot, 8, 100_000);
        presence.seen(&robot, address(), 100_001);
        assert!(presence.is_online(&robot, 100_500));
        presence.forget(&robot);
        assert_eq!(presence.get(&robot, 100_000), None);
    }

    #[test]
    fn absence_is_counted_from_the_last_sign_of_life_or_the_start() {
        let presence = Presence::new(1000, 500);
        let (unseen, polls, hung_up) = (RobotId::random(), RobotId::random(), RobotId::random());
        presence.seen(&polls, address(), 600);
        presence.connected(&hung_up, None, 1, 600);
        let robots = [unseen, polls, hung_up.clone()];
        assert_eq!(presence.offline_ms(&robots, 1500), [Some(1000), None, None]);
        presence.disconnected(&hung_up, 1, 1500);
        assert_eq!(presence.offline_ms(&robots, 1700), [Some(1200), Some(1100), Some(200)]);
    }

    #[test]
    fn duplicate_ends_when_the_other_tokens_end() {
        let presence = Presence::new(1000, 0);
        let (robot, a, b) = (RobotId::random(), InstanceId::random(), InstanceId::random());
        for instance in [&a, &b, &a, &b] {
            presence.identify(
                &robot,
                None,
                None,
                AgentIdentity { instance: instance.clone(), place: None },
                1,
            );
        }
        assert!(presence.is_duplicate(&robot, 2));
        presence.end_other_instances(&robot);
        presence.identify(&robot, None, None, agent(1), 2);
        assert!(!presence.is_duplicate(&robot, 2));
    }

    /// A new instance in this place.
    fn agent(place: u8) -> AgentIdentity {
        AgentIdentity { instance: InstanceId::random(), place: Some(Digest::of(&[place])) }
    }

    #[test]
    fn second_instance_waits_until_the_serving_one_is_silent() {
        let (presence, robot, original, copy) =
            (Presence::new(1000, 0), RobotId::random(), agent(1), agent(2));
        let polls = |agent: &AgentIdentity, now_ms| {
            presence.identify(&robot, None, None, agent.clone(), now_ms)
        };
        assert!(!presence.requires_identity(&robot), "the robot is unknown");
        let first = polls(&original, 0);
        assert!(first.is_serving && first.needs_state && presence.requires_identity(&robot));
        assert!(!polls(&original, 5).needs_state);
        assert!(!polls(&copy, 10).is_serving);
        assert_eq!(presence.instance(&robot).as_ref(), Some(&original.instance));
        assert!(presence.get(&robot, 10).expect("seen").has_waiting_instance);
        assert!(!polls(&copy, 4 + HANDOVER_SILENCE_MS).is_serving);
        assert!(polls(&original, 4 + HANDOVER_SILENCE_MS).is_serving, "the original was only away");
        assert!(!polls(&copy, 5 + HANDOVER_SILENCE_MS).is_serving);
        let silent_ms = 4 + 2 * HANDOVER_SILENCE_MS;
        assert!(polls(&copy, silent_ms).needs_state, "like a restarted robot");
        assert!(!polls(&original, silent_ms + 1).is_serving);
    }

    #[test]
    fn copy_waits_while_the_original_is_at_another_server() {
        let (nodes, robot, original, copy) =
            (LiveNodes::default(), RobotId::random(), agent(1), agent(2));
        let presence = Presence::new(1000, 0).share(SharedPresence::new(nodes.clone()));
        nodes.join("a-1");
        nodes.observe([("b-1", 1)], Instant::now());
        let session = SessionElsewhere {
            run: "b-1".into(),
            since_ms: Some(5),
            seen_ms: 5,
            left_ms: None,
            address: None,
            agent: Some(original.clone()),
            left_at: None,
        };
        let elsewhere = &presence.shared().expect("shared").elsewhere;
        elsewhere.put(&robot, session.clone());
        assert!(presence.is_online(&robot, 10) && presence.is_elsewhere(&robot, 10));
        let polls = |agent: &AgentIdentity, now_ms| {
            presence.identify(&robot, None, None, agent.clone(), now_ms).is_serving
        };
        assert!(!polls(&copy, 10) && !polls(&copy, 10 + 2 * HANDOVER_SILENCE_MS));
        let left_ms = 10 * MINUTE_MS;
        elsewhere.put(&robot, SessionElsewhere { left_ms: Some(left_ms), ..session });
        assert!(!polls(&copy, left_ms + HANDOVER_SILENCE_MS - 1));
        assert!(polls(&copy, left_ms + HANDOVER_SILENCE_MS), "like a restarted robot");
    }

    #[test]
    fn restart_in_the_same_place_serves_at_once() {
        let (presence, robot) = (Presence::new(1000, 0), RobotId::random());
        for now_ms in 0..5 {
            assert!(presence.identify(&robot, None, None, agent(1), now_ms).needs_state);
        }
        presence.remember(&robot, agent(2), 6);
        assert!(
            presence.identify(&robot, None, None, agent(1), 6).is_serving,
            "what is known is newer"
        );
    }

    #[test]
    fn remembered_instance_keeps_its_work_after_a_server_restart() {
        let (presence, robot, original, copy) =
            (Presence::new(1000, 0), RobotId::random(), agent(1), agent(2));
        presence.remember(&robot, original.clone(), 1000);
        assert_eq!(presence.get(&robot, 1000), None, "this process has not seen the robot");
        assert!(!presence.identify(&robot, None, None, copy, 1001).is_serving);
        assert!(presence.identify(&robot, None, None, original, 1002).is_serving);
    }

    #[test]
    fn session_accepts_downlink_once_its_agent_is_serving() {
        let (presence, robot, original, copy) =
            (Presence::new(1000, 0), RobotId::random(), agent(1), agent(2));
        let says = |agent: &AgentIdentity, connection, now_ms| {
            presence.identify(&robot, None, Some(connection), agent.clone(), now_ms).is_serving
        };
        presence.connected(&robot, None, 1, 0);
        assert!(presence.accepts_downlink(&robot), "no agent has identified itself yet");
        assert!(says(&original, 1, 0) && presence.accepts_downlink(&robot));
        // A copy takes over the session. The earlier instance was last heard when its session
        // ended.
        let later_ms = 10 * MINUTE_MS;
        presence.disconnected(&robot, 1, later_ms);
        presence.connected(&robot, None, 2, later_ms);
        assert!(!presence.accepts_downlink(&robot), "the session has not identified itself");
        assert!(!says(&copy, 2, later_ms) && !presence.accepts_downlink(&robot));
        assert!(
            !says(&original, 1, later_ms + 1) || !presence.accepts_downlink(&robot),
            "said in a session that is over"
        );
        presence.disconnected(&robot, 2, later_ms + 2);
        presence.connected(&robot, None, 3, later_ms + 2);
        assert!(says(&original, 3, later_ms + 3) && presence.accepts_downlink(&robot));
        // An instance with a live session is not silent.
        assert!(!presence.identify(&robot, None, None, copy, later_ms + MINUTE_MS).is_serving);
    }

    #[test]
    fn older_agents_follow_each_other_at_once() {
        let (presence, robot) = (Presence::new(1000, 0), RobotId::random());
        for now_ms in 0..5 {
            let older = AgentIdentity { instance: InstanceId::random(), place: None };
            assert!(presence.identify(&robot, None, None, older, now_ms).is_serving);
            assert!(!presence.requires_identity(&robot));
        }
        assert!(
            presence.identify(&robot, None, None, agent(1), 6).is_serving,
            "an agent that was brought up to date"
        );
        let older = AgentIdentity { instance: InstanceId::random(), place: None };
        assert!(!presence.identify(&robot, None, None, older, 7).is_serving);
    }

    #[test]
    fn silence_of_a_polling_robot_is_reported_once() {
        let presence = Presence::new(1000, 0);
        let (polls, connected) = (RobotId::random(), RobotId::random());
        presence.seen(&polls, address(), 500);
        presence.seen(&connected, address(), 500);
        presence.connected(&connected, Some(address()), 1, 600);
        assert!(presence.timed_out(0, 1499).is_empty());
        assert_eq!(presence.timed_out(1499, 1500), [polls]);
        assert!(presence.timed_out(1500, 9000).is_empty());
    }

    #[test]
    fn late_disconnect_of_the_old_session_keeps_the_new_one() {
        let presence = Presence::new(1000, 0);
        let robot = RobotId::random();
        presence.connected(&robot, Some(address()), 2, 0);
        presence.connected(&robot, Some(address()), 1, 1);
        presence.disconnected(&robot, 1, 2);
        assert_eq!(presence.get(&robot, 50_000).and_then(|sighting| sighting.connection), Some(2));
    }

    #[test]
    fn session_port_is_kept_when_requests_use_other_ports() {
        let presence = Presence::new(1000, 0);
        let robot = RobotId::random();
        let shown = || presence.get(&robot, 0)?.address_text();
        presence.seen(&robot, "10.0.0.7:5000".parse().expect("valid"), 0);
        presence.connected(&robot, "10.0.0.7:4000".parse().ok(), 1, 0);
        presence.seen(&robot, "10.0.0.7:5001".parse().expect("valid"), 0);
        assert_eq!(shown().as_deref(), Some("10.0.0.7:4000"));
        presence.seen(&robot, "10.0.9.9:5002".parse().expect("valid"), 0);
        assert_eq!(
            shown().as_deref(),
            Some("10.0.9.9:5002"),
            "it has moved, and its session has not noticed yet"
        );
        presence.connected(&robot, "10.0.9.9:4001".parse().ok(), 2, 0);
        assert_eq!(shown().as_deref(), Some("10.0.9.9:4001"));
        presence.disconnected(&robot, 2, 0);
        presence.seen(&robot, "10.0.9.9:5003".parse().expect("valid"), 0);
        assert_eq!(shown().as_deref(), Some("10.0.9.9:5003"));
    }

    #[test]
    fn address_of_a_proxys_client_has_no_port() {
        let (presence, robot) = (Presence::new(0, 0), RobotId::random());
        for (peer, shown) in [("192.0.2.7:0", "192.0.2.7"), ("[2001:db8::7]:0", "2001:db8::7")] {
            presence.seen(&robot, peer.parse().expect("valid"), 0);
            let address = presence.get(&robot, 0).and_then(|presence| presence.address_text());
            assert_eq!(address.as_deref(), Some(shown));
        }
    }

    #[test]
    fn memory_is_bounded() {
        let mut robots = HashMap::new();
        let silent = RobotId::random();
        touch(&mut robots, &silent, Some(address()), 1);
        for at_ms in 2..=MAX_ROBOTS as u64 + 1 {
            touch(&mut robots, &RobotId::random(), Some(address()), at_ms);
        }
        assert!(robots.len() <= MAX_ROBOTS);
        assert!(!robots.contains_key(&silent));
    }
}
