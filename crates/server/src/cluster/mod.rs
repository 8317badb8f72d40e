//! Owns the messages between the servers of one database about heartbeats, sessions of robots and
//! changes; it never decides which task a robot should run.
//!
//! A message is a hint. Heartbeats and sessions are rows, which every server reads. The sweep finds
//! the robots that missed a message.

mod bus;
mod membership;
mod message;
mod messenger;
mod postgres_bus;
mod robot_instances;
mod session_reader;
mod session_writer;
mod sweep;

use std::sync::Arc;

use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use self::bus::{Alone, Bus};
use self::membership::Membership;
use self::messenger::Messenger;
use self::postgres_bus::PostgresBus;
use self::session_reader::SessionReader;
use self::session_writer::SessionWriter;
use self::sweep::Sweep;
use crate::broker::Broker;
use crate::config::{Bus as BusKind, ClusterSettings};
use crate::fleet::live_nodes::LiveNodes;
use crate::fleet::presence::Presence;
use crate::net::http_connections::HttpConnections;
use crate::orders::changes::Changes;
use crate::orders::delivery_planner::ServerLoad;
use crate::orders::outbox::Outbox;
use crate::store::Store;
use crate::system::clock::Clock;

/// This server's part in a cluster. Clones share everything.
#[derive(Clone)]
pub struct Cluster {
    pub settings: ClusterSettings,
    /// The name of this start of the server.
    pub run: Arc<str>,
    pub store: Store,
    pub clock: Clock,
    pub nodes: LiveNodes,
    pub presence: Arc<Presence>,
    pub changes: Changes,
    pub outbox: Outbox,
    pub broker: Broker,
    pub http_connections: Arc<HttpConnections>,
    pub load: Arc<ServerLoad>,
    /// Counts the open streams of events.
    pub listeners: Arc<dyn Fn() -> usize + Send + Sync>,
    pub signals: Signals,
}

/// Wakes the parts of the cluster before their time.
#[derive(Clone, Default)]
pub struct Signals {
    /// Rows of robots' sessions have changed.
    sessions: Arc<Notify>,
    /// Something may have been missed.
    sweep: Arc<Notify>,
}

impl Cluster {
    /// Starts all parts, which run until `stop`.
    pub async fn start(self, tasks: &TaskTracker, stop: &CancellationToken) {
        let bus: Arc<dyn Bus> = match self.settings.bus {
            BusKind::Postgres => Arc::new(PostgresBus::new(self.store.clone(), self.run.clone())),
            BusKind::Off => Arc::new(Alone),
        };
        let membership = Membership::new(self.clone(), bus.clone());
        // Without the database it joins later.
        membership.join().await;
        let writer = Arc::new(SessionWriter::new(self.clone()));
        let until = |stop: &CancellationToken| stop.clone().cancelled_owned();
        let messenger = Messenger::new(self.clone(), bus);
        let (sending, receiving) = (messenger.clone().send(), messenger.receive());
        let reader = SessionReader::new(self.clone(), writer.clone());
        let instances = robot_instances::compare(self.clone());
        let departures = membership::announce_missing(self.clone());
        let sweep = Sweep::new(self).run();
        let stopped = until(stop);
        tasks.spawn(async move {
            tokio::select! {
                () = stopped => {}
                () = membership.run() => {}
                () = sending => {}
                () = receiving => {}
            }
        });
        let stopped = until(stop);
        tasks.spawn(async move {
            tokio::select! {
                () = stopped => {}
                () = writer.run() => {}
                () = reader.run() => {}
                () = instances => {}
                () = departures => {}
                () = sweep => {}
            }
        });
    }
}

/// Tells the other servers that this one has ended, so that they need not wait for its heartbeat.
pub async fn leave(store: &Store, run: &str) {
    if let Err(error) = store.nodes().delete(run).await {
        error.log("the other servers will notice the end of this one by themselves");
    }
}
