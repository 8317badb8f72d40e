//! The parts of a server that are different in a cluster, made by its settings.

use std::sync::Arc;

use task_proto::time::millis;
use tokio_util::task::TaskTracker;

use crate::cluster::{Cluster, Signals};
use crate::config::Config;
use crate::fleet::live_nodes::LiveNodes;
use crate::fleet::presence::Presence;
use crate::fleet::shared_presence::SharedPresence;
use crate::http::App;
use crate::orders::changes::Changes;
use crate::orders::delivery_planner::ServerLoad;
use crate::orders::outbox::Outbox;

/// The live servers, and the presence of robots, which the servers of a cluster share.
pub(super) fn new_presence(config: &Config, now_ms: u64) -> (LiveNodes, Arc<Presence>) {
    let nodes = LiveNodes::default();
    let presence = Presence::new(millis(config.presence_timeout), now_ms);
    let presence = match config.cluster {
        Some(_) => presence.share(SharedPresence::new(nodes.clone())),
        None => presence,
    };
    (nodes, Arc::new(presence))
}

/// The channels of changes, and the outbox for the other servers of a cluster.
pub(super) fn new_changes(config: &Config) -> (Changes, Outbox) {
    let (changes, outbox) = (Changes::new(), Outbox::default());
    match config.cluster {
        Some(_) => (changes.with_outbox(outbox.clone()), outbox),
        None => (changes, outbox),
    }
}

/// Starts this server's part in its cluster, if it is in one.
pub(super) async fn start_cluster(
    tasks: &TaskTracker,
    app: &App,
    config: &Config,
    outbox: Outbox,
    load: Arc<ServerLoad>,
) {
    let (Some(settings), Some(run)) = (&config.cluster, app.store.cluster_run()) else { return };
    let events = app.events.clone();
    let cluster = Cluster {
        settings: settings.clone(),
        run: run.into(),
        store: app.store.clone(),
        clock: app.clock.clone(),
        nodes: app.nodes.clone(),
        presence: app.presence.clone(),
        changes: app.changes.clone(),
        outbox,
        broker: app.broker.clone(),
        http_connections: app.http_connections.clone(),
        load,
        listeners: Arc::new(move || events.listeners()),
        signals: Signals::default(),
    };
    cluster.start(tasks, &app.stop).await;
}
