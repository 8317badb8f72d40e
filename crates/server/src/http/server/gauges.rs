//! The sources of the server's figures. The sizes of database and packages are computed at most
//! every half minute, regardless of the number of requests.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::Mutex;
use tokio::time::Instant;

use super::readiness::Readiness;
use super::server_facts::ServerFacts;
use crate::blobs::Blobs;
use crate::broker::Broker;
use crate::domain::limits::robot_limiter::RobotLimiter;
use crate::fleet::live_nodes::LiveNodes;
use crate::fleet::presence::Presence;
use crate::http::connection::traffic::HttpTotals;
use crate::http::error::ApiError;
use crate::http::peers::Peers;
use crate::link::transfers::Transfers;
use crate::orders::report_writer::ReportWriter;
use crate::store::{DatabaseSize, Store};
use crate::system::clock::Clock;

/// How long the slow figures stay valid.
const SLOW_FIGURES_MAX_AGE: Duration = Duration::from_secs(30);

/// The parts of the server that have figures.
#[derive(Clone)]
pub struct Gauges {
    pub(in crate::http) store: Store,
    pub(in crate::http) blobs: Blobs,
    pub(in crate::http) data: PathBuf,
    pub(in crate::http) slow_figures: Arc<SlowFigures>,
    pub(in crate::http) reports: ReportWriter,
    pub(in crate::http) transfers: Transfers,
    pub(in crate::http) nodes: LiveNodes,
    pub(in crate::http) presence: Arc<Presence>,
    pub(in crate::http) readiness: Readiness,
    pub(in crate::http) peers: Peers,
    pub(in crate::http) broker: Broker,
    pub(in crate::http) http_traffic: Arc<HttpTotals>,
    pub(in crate::http) robot_limiter: Arc<RobotLimiter>,
    pub(in crate::http) facts: Arc<ServerFacts>,
    pub(in crate::http) clock: Clock,
}

/// The last result of the slow figures.
#[derive(Debug, Default)]
pub struct SlowFigures(Mutex<Option<(Instant, SlowValues)>>);

#[derive(Debug, Clone)]
pub(super) struct SlowValues {
    pub(super) database: DatabaseSize,
    pub(super) packages_bytes: u64,
}

impl Gauges {
    /// The sizes of the database and the packages, at most half a minute old.
    pub(super) async fn slow_values(&self) -> Result<SlowValues, ApiError> {
        // Concurrent callers wait here and share one answer.
        let mut known = self.slow_figures.0.lock().await;
        if let Some((at, slow)) = &*known
            && at.elapsed() < SLOW_FIGURES_MAX_AGE
        {
            return Ok(slow.clone());
        }
        let packages_bytes = self.blobs.used_bytes().await?;
        let slow = SlowValues { database: self.store.size().await?, packages_bytes };
        *known = Some((Instant::now(), slow.clone()));
        Ok(slow)
    }
}
