//! The rows by which servers of one database know each other and each other's robots.

use task_proto::{InstanceId, RobotId};
use taskd::domain::instance_history::InstanceHistory;
use taskd::store::{
    LeftSession, NewNode, NewRobotSession, NodeLoad, RobotSession, SessionNode, SessionPosition,
    Store,
};

use crate::database::{TestDatabase, on_both_databases};
use crate::fleet::Fleet;

on_both_databases! {
    heartbeat_grows_while_the_name_belongs_to_the_run,
    session_at_another_server_replaces_the_older,
    polling_replaces_no_connection_at_a_live_server,
    ended_run_leaves_the_robots_that_moved,
    changed_sessions_are_read_once_and_all,
    robots_behind_are_found_where_their_session_is,
    sessions_without_a_right_are_found,
    instances_of_all_servers_make_one_history,
}

fn node<'a>(name: &'a str, run: &'a str) -> NewNode<'a> {
    NewNode { name, run, url: Some("http://10.0.0.11:8080"), version: "1" }
}

fn session(robot: &RobotId, known_epoch: Option<u64>, since_ms: Option<u64>) -> NewRobotSession {
    NewRobotSession {
        robot: robot.clone(),
        known_epoch,
        token_number: 0,
        since_ms,
        seen_ms: 7,
        address: Some("10.0.0.7:4000".to_owned()),
        agent: None,
    }
}

/// A server that writes sessions.
struct Server<'a> {
    store: &'a Store,
    run: &'a str,
    change: u64,
}

impl<'a> Server<'a> {
    fn new(store: &'a Store, run: &'a str) -> Self {
        Self { store, run, change: 0 }
    }

    async fn put(&mut self, sessions: &[NewRobotSession]) -> Vec<(RobotId, u64)> {
        let live = ["a-1".to_owned(), "b-1".to_owned()];
        let sessions = self.store.robot_sessions().put(self.run, &mut self.change, sessions, &live);
        sessions.await.expect("stored")
    }

    async fn leave(&mut self, robot: &RobotId, epoch: u64) {
        let left = [LeftSession { robot: robot.clone(), epoch, left_ms: 9 }];
        self.store.robot_sessions().leave(self.run, &mut self.change, &left).await.expect("stored");
    }
}

async fn changed(store: &Store, run: &str, change: u64) -> Vec<RobotSession> {
    let positions = [SessionPosition { run: run.to_owned(), change }];
    let (sessions, has_more) = store.robot_sessions().changed(&positions).await.expect("reads");
    assert!(!has_more);
    sessions
}

async fn heartbeat_grows_while_the_name_belongs_to_the_run(database: TestDatabase) {
    let nodes = database.store.nodes();
    nodes.join(node("a", "a-1")).await.expect("stored");
    let load = NodeLoad { listeners: 1, transfers: 2, backlog: 3 };
    assert!(nodes.heartbeat("a", "a-1", load).await.expect("stored"));
    let known = nodes.list().await.expect("reads").remove(0);
    assert_eq!((known.heartbeat, known.load), (2, load));
    nodes.join(node("a", "a-2")).await.expect("stored");
    assert!(
        !nodes.heartbeat("a", "a-1", load).await.expect("stored"),
        "a newer start has the name"
    );
    let known = nodes.list().await.expect("reads").remove(0);
    assert_eq!((known.run.as_str(), known.heartbeat), ("a-2", 3));
    nodes.delete("a-1").await.expect("stored");
    assert_eq!(nodes.list().await.expect("reads").len(), 1);
    nodes.delete("a-2").await.expect("stored");
    assert_eq!(nodes.list().await.expect("reads"), []);
}

async fn session_at_another_server_replaces_the_older(database: TestDatabase) {
    let store = &database.store;
    store.nodes().join(node("b", "b-1")).await.expect("stored");
    let robot = RobotId::random();
    let (mut a, mut b) = (Server::new(store, "a-1"), Server::new(store, "b-1"));
    assert_eq!(a.put(&[session(&robot, None, Some(5))]).await, [(robot.clone(), 1)]);
    assert_eq!(b.put(&[session(&robot, None, Some(6))]).await, [(robot.clone(), 2)]);
    // What the older one still writes is late.
    assert_eq!(a.put(&[session(&robot, Some(1), Some(5))]).await, []);
    a.leave(&robot, 1).await;
    let expected = RobotSession {
        robot: robot.clone(),
        run: "b-1".to_owned(),
        epoch: 2,
        change: 1,
        since_ms: Some(6),
        seen_ms: 7,
        left_ms: None,
        address: Some("10.0.0.7:4000".to_owned()),
        agent: None,
    };
    assert_eq!(changed(store, "b-1", 0).await, [expected]);
    let node_of = async |live: &[&str]| {
        let live: Vec<String> = live.iter().map(ToString::to_string).collect();
        store.robot_sessions().node_of(&robot, &live).await.expect("reads")
    };
    let url = Some("http://10.0.0.11:8080".to_owned());
    assert_eq!(node_of(&["a-1", "b-1"]).await, Some(SessionNode { name: "b".to_owned(), url }));
    assert_eq!(node_of(&["a-1"]).await, None, "its server is dead");
    // Its own server writes it again, and then its end.
    assert_eq!(b.put(&[session(&robot, Some(2), Some(6))]).await, [(robot.clone(), 3)]);
    b.leave(&robot, 3).await;
    assert_eq!(changed(store, "b-1", 2).await[0].left_ms, Some(9));
    assert_eq!(node_of(&["a-1", "b-1"]).await, None);
}

async fn polling_replaces_no_connection_at_a_live_server(database: TestDatabase) {
    let robot = RobotId::random();
    let store = &database.store;
    let (mut b, mut dead) = (Server::new(store, "b-1"), Server::new(store, "c-1"));
    let (polls, connected) = (session(&robot, None, None), session(&robot, None, Some(5)));
    assert_eq!(Server::new(store, "a-1").put(std::slice::from_ref(&connected)).await.len(), 1);
    assert_eq!(b.put(std::slice::from_ref(&polls)).await, []);
    assert_eq!(dead.put(&[connected]).await.len(), 1);
    assert_eq!(b.put(&[polls]).await.len(), 1);
}

async fn ended_run_leaves_the_robots_that_moved(database: TestDatabase) {
    let [stays, moves] = [RobotId::random(), RobotId::random()];
    let store = &database.store;
    let mut both = [session(&stays, None, Some(5)), session(&moves, None, Some(5))];
    both.sort_by(|one, other| one.robot.cmp(&other.robot));
    Server::new(store, "a-1").put(&both).await;
    Server::new(store, "b-1").put(&[session(&moves, None, Some(6))]).await;
    let end = async || store.robot_sessions().end_run("a-1", 20).await.expect("stored");
    assert_eq!(end().await, std::slice::from_ref(&stays));
    assert_eq!(end().await, [], "another server has done it");
    assert_eq!(changed(store, "a-1", 0).await[0].left_ms, Some(20));
    assert_eq!(changed(store, "b-1", 0).await[0].left_ms, None);
}

async fn changed_sessions_are_read_once_and_all(database: TestDatabase) {
    const ROBOTS: usize = 5_100;
    let mut robots: Vec<RobotId> = (0..ROBOTS).map(|_| RobotId::random()).collect();
    robots.sort();
    let sessions: Vec<_> = robots.iter().map(|robot| session(robot, None, Some(5))).collect();
    Server::new(&database.store, "a-1").put(&sessions).await;
    let mut position = SessionPosition { run: "a-1".to_owned(), change: 0 };
    let mut found = Vec::new();
    loop {
        let positions = std::slice::from_ref(&position);
        let read = database.store.robot_sessions().changed(positions).await;
        let (sessions, has_more) = read.expect("reads");
        position.change = sessions.last().expect("some").change;
        found.extend(sessions.into_iter().map(|session| session.robot));
        if !has_more {
            break;
        }
    }
    found.sort();
    assert_eq!(found, robots);
}

async fn robots_behind_are_found_where_their_session_is(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(2).await;
    let store = &fleet.database.store;
    let mut both: Vec<_> = robots.iter().map(|robot| session(&robot.id, None, Some(5))).collect();
    both.sort_by(|one, other| one.robot.cmp(&other.robot));
    Server::new(store, "a-1").put(&both[..1]).await;
    Server::new(store, "b-1").put(&both[1..]).await;
    let behind = async |run: &str| store.robot_sessions().behind(run).await.expect("reads");
    assert_eq!(behind("a-1").await, []);
    fleet.deploy("1", |_| ()).await;
    assert_eq!(behind("a-1").await, [(both[0].robot.clone(), 1)]);
    assert_eq!(behind("b-1").await, [(both[1].robot.clone(), 1)]);
    assert_eq!(behind("c-1").await, []);
}

async fn sessions_without_a_right_are_found(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(2).await;
    let store = &fleet.database.store;
    let mut server = Server::new(store, "a-1");
    for robot in &robots {
        server.put(&[session(&robot.id, None, Some(5))]).await;
    }
    let found = async || store.robot_sessions().without_right("a-1").await.expect("reads");
    let current = found().await;
    fleet.robots.remove(&fleet.operator, &robots[0].id).await.expect("removed");
    assert_eq!(current, []);
    assert_eq!(found().await, std::slice::from_ref(&robots[0].id));
}

async fn instances_of_all_servers_make_one_history(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robot = fleet.enroll(1).await.remove(0).id;
    let instances = [InstanceId::random(), InstanceId::random()];
    let mut history = InstanceHistory::default();
    for at_ms in 0..4 {
        let instance = &instances[at_ms as usize % 2];
        let observe = |history: &mut InstanceHistory| history.observe(instance, at_ms);
        let sessions = fleet.database.store.robot_sessions();
        history = sessions.change_instances(&robot, observe).await.expect("stored");
    }
    assert!(history.is_duplicate(4));
    let sessions = fleet.database.store.robot_sessions();
    let read = sessions.change_instances(&robot, |_| false).await.expect("reads");
    assert_eq!(read, history);
    let nobody = sessions.change_instances(&RobotId::random(), |_| true).await.expect("reads");
    assert_eq!(nobody, InstanceHistory::default());
}
