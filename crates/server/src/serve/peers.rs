//! Connects a server to the others of its cluster. This module sends no request.

use task_proto::trust::envelope::SigningKey;
use task_transport::Trust;
use tokio_util::sync::CancellationToken;

use super::Base;
use crate::config::Config;
use crate::fleet::live_nodes::LiveNodes;
use crate::http::peers::Peers;
use crate::net::tls::Tls;

/// The other servers of the cluster, if the settings name one. Their certificates are by the
/// authority that all have, which robots trust too.
pub(super) fn join(
    config: &Config,
    base: &Base,
    nodes: &LiveNodes,
    key: &SigningKey,
    stop: &CancellationToken,
) -> Result<Peers, reqwest::Error> {
    let Some(cluster) = &config.cluster else { return Ok(Peers::default()) };
    let trust = Trust::by(base.tls.as_ref().map(Tls::pin));
    let (nodes, store) = (nodes.clone(), base.store.clone());
    Peers::join(cluster.name.clone(), nodes, store, key, trust, stop.clone())
}
