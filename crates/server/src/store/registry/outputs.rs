//! Outputs of runs: the files that came back from each robot. Their bytes lie in the blob store,
//! under the robot's repository.

use futures_util::TryStreamExt as _;
use sqlx::Row as _;
use task_proto::api::OutputView;
use task_proto::packages::output::OutputSet;
use task_proto::{Digest, RepositoryName, RobotId, TaskName};

use super::robot_blobs::disk_usage;
use crate::domain::person::Scope;
use crate::store::repositories::Outputs;
use crate::store::{Store, StoreError, Transaction, rows};

/// The newest runs kept of one task on one robot.
const MAX_RUNS_OF_TASK: usize = 10;
/// The newest runs kept of one robot: the robot itself chooses the names of its tasks.
const MAX_RUNS_OF_ROBOT: usize = 200;
/// The most outputs listed.
const MAX_LISTED: usize = 1000;
/// The most bytes of JSON in a list: an output of many files with long names takes a lot of room.
const MAX_LISTED_BYTES: usize = 16 * 1024 * 1024;

/// An output to be stored.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewOutput {
    /// The description of the output.
    pub set: OutputSet,
    /// The limit on the bytes of its robot's outputs.
    pub max_bytes: u64,
}

impl Outputs<&Store> {
    /// The newest outputs first, of one robot or of all in a scope, of one task or of all. Returns
    /// at most 1,000, and fewer if they are large.
    pub async fn list(
        self,
        robot: Option<&RobotId>,
        task: Option<&TaskName>,
        scope: &Scope,
    ) -> Result<Vec<OutputView>, StoreError> {
        let mut connection = self.0.reads.acquire().await?;
        let mut found = sqlx::query(
            "SELECT o.manifest, o.output, o.pushed_at_ms, r.name, o.robot_id, r.labels FROM outputs o JOIN robots r ON r.id = o.robot_id
             WHERE ($1 = '' OR o.robot_id = $1) AND ($2 = '' OR o.task = $2)
             ORDER BY o.pushed_at_ms DESC, o.manifest LIMIT $3",
        )
        .bind(robot.map_or("", RobotId::as_str))
        .bind(task.map_or("", TaskName::as_str))
        // The share of the scope among the newest outputs is not known before they are read.
        .bind(if scope.is_everything() { MAX_LISTED as i64 } else { i64::MAX })
        .fetch(connection.connection());
        let (mut views, mut bytes) = (Vec::new(), 0);
        while let Some(row) = found.try_next().await? {
            let robot_name = rows::id("robots.name", row.try_get("name")?)?;
            if !scope.is_everything() {
                let labels = rows::from_json("robots.labels", row.try_get("labels")?)?;
                if !scope.covers(
                    &rows::id("outputs.robot_id", row.try_get("robot_id")?)?,
                    &robot_name,
                    &labels,
                ) {
                    continue;
                }
            }
            let output: &str = row.try_get("output")?;
            bytes += output.len();
            if bytes > MAX_LISTED_BYTES || views.len() == MAX_LISTED {
                break;
            }
            views.push(OutputView {
                robot_name,
                manifest: rows::id("outputs.manifest", row.try_get("manifest")?)?,
                pushed_at_ms: rows::number(row.try_get("pushed_at_ms")?),
                output: rows::from_json("outputs.output", output)?,
            });
        }
        Ok(views)
    }
}

impl Outputs<&mut Transaction> {
    /// Stores an output, which replaces an earlier one of the same run. Returns the manifests of
    /// the robot's repositories that now exceed the limits on number or bytes.
    pub(in crate::store) async fn insert(
        &mut self,
        repository: &RepositoryName,
        manifest: &Digest,
        NewOutput { set: output, max_bytes }: &NewOutput,
        now_ms: u64,
    ) -> Result<Vec<(RepositoryName, Digest)>, StoreError> {
        let tag = format!("{}-{}", output.deployment, output.run);
        sqlx::query(
            "INSERT INTO outputs (repository, manifest, robot_id, task, tag, output, pushed_at_ms, bytes)
             VALUES ($1, $2, $3, $4, $5, $6, $7, $8)
             ON CONFLICT (repository, manifest)
             DO UPDATE SET pushed_at_ms = excluded.pushed_at_ms, bytes = excluded.bytes",
        )
        .bind(repository.as_str())
        .bind(manifest.to_string())
        .bind(output.robot_id.as_str())
        .bind(output.task.as_str())
        .bind(&tag)
        .bind(rows::json(output))
        .bind(rows::stored(now_ms))
        .bind(rows::stored(disk_usage(output)))
        .execute(self.0.connection())
        .await?;
        let others = sqlx::query(
            "SELECT repository, manifest, tag, bytes FROM outputs
             WHERE robot_id = $1 AND NOT (repository = $2 AND manifest = $3)
             ORDER BY pushed_at_ms DESC, manifest",
        )
        .bind(output.robot_id.as_str())
        .bind(repository.as_str())
        .bind(manifest.to_string())
        .fetch_all(self.0.connection())
        .await?;
        let (mut surplus, mut kept, mut kept_here, mut kept_bytes) =
            (Vec::new(), 1, 1, disk_usage(output));
        for row in &others {
            let is_here = row.try_get::<&str, _>("repository")? == repository.as_str();
            let is_replaced = is_here && row.try_get::<&str, _>("tag")? == tag;
            let is_surplus = is_replaced || (is_here && kept_here >= MAX_RUNS_OF_TASK);
            if !is_surplus {
                kept += 1;
                kept_bytes = kept_bytes.saturating_add(rows::number(row.try_get("bytes")?));
            }
            // If one output has no room, no older one has.
            if is_surplus || kept > MAX_RUNS_OF_ROBOT || kept_bytes > *max_bytes {
                let repository = rows::id("outputs.repository", row.try_get("repository")?)?;
                surplus.push((repository, rows::id("outputs.manifest", row.try_get("manifest")?)?));
            } else {
                kept_here += usize::from(is_here);
            }
        }
        Ok(surplus)
    }
}
