//! Entries of the feed: finished texts with their audience. Only the newest are kept. This module
//! never decides which events are told.

use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};
use sqlx::{AssertSqlSafe, Row as _};
use task_proto::api::{FeedEntry, FeedKind};
use task_proto::telemetry::log::LogLevel;
use task_proto::{DeploymentId, RobotId, RobotName};

use crate::store::repositories::Feed;
use crate::store::rows::{from_json, groups, json, number, stored, values};
use crate::store::{KnownRobot, Store, StoreError, Transaction};

/// The most entries kept.
const MAX_KEPT: i64 = 1_000;
/// Time within which another server of the cluster may have told the same about a deployment.
const SAME_MS: u64 = 60_000;
const COLUMN_TYPES: [&str; 4] = ["BIGINT", "BIGINT", "TEXT", "TEXT"];

/// The users who may see an entry.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FeedAudience {
    Everybody,
    /// Users who may see every robot: the entry counts robots.
    Unlimited,
    /// Users who may see this robot.
    Robot(KnownRobot),
}

/// An entry without its number and time.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewFeedEntry {
    pub kind: FeedKind,
    pub level: LogLevel,
    pub robot: Option<(RobotId, RobotName)>,
    pub deployment: Option<DeploymentId>,
    pub text: String,
    pub audience: FeedAudience,
}

impl NewFeedEntry {
    /// Whether another server has told the same about a deployment: each sees the reports of its own
    /// robots, and all have the same deployments.
    fn is_same(&self, known: &FeedEntry) -> bool {
        self.deployment.is_some()
            && (self.kind, &self.deployment, &self.text)
                == (known.kind, &known.deployment, &known.text)
    }

    fn numbered(&self, number: u64, at_ms: u64) -> FeedEntry {
        let Self { kind, level, robot, deployment, text, audience: _ } = self.clone();
        let (robot, robot_name) = robot.unzip();
        FeedEntry { number, at_ms, kind, level, robot, robot_name, deployment, text }
    }
}

impl Feed<&Store> {
    /// The kept entries whose numbers are higher than `number`, the oldest first.
    pub async fn after(self, number: u64) -> Result<Vec<(FeedEntry, FeedAudience)>, StoreError> {
        self.between(&(number.saturating_add(1)..=u64::MAX)).await
    }

    /// The kept entries with these numbers, the oldest first.
    pub async fn between(
        self,
        numbers: &RangeInclusive<u64>,
    ) -> Result<Vec<(FeedEntry, FeedAudience)>, StoreError> {
        let rows = sqlx::query(
            "SELECT entry, audience FROM feed WHERE number >= $1 AND number <= $2 ORDER BY number",
        )
        .bind(stored(*numbers.start()))
        .bind(stored(*numbers.end()))
        .fetch_all(&self.0.reads)
        .await?;
        let read = |row: &sqlx::any::AnyRow| {
            let entry = from_json("feed.entry", row.try_get("entry")?)?;
            Ok((entry, from_json("feed.audience", row.try_get("audience")?)?))
        };
        rows.iter().map(read).collect()
    }

    /// Stores entries of the time `at_ms`, and deletes all but the newest. Returns the numbers of
    /// the new entries. A number is higher than all earlier ones and at least `at_ms`, so numbers
    /// go on growing if the database is replaced by an older copy.
    pub async fn append(
        self,
        entries: &[NewFeedEntry],
        at_ms: u64,
    ) -> Result<RangeInclusive<u64>, StoreError> {
        let mut write = self.0.begin_without_auth_invalidation().await?;
        let last: Option<i64> = sqlx::query_scalar("SELECT MAX(number) FROM feed")
            .fetch_one(write.connection())
            .await?;
        let first = last.map_or(0, |last| number(last) + 1).max(at_ms);
        let known = match self.0.cluster_run() {
            Some(_) => entries_since(&mut write, at_ms.saturating_sub(SAME_MS)).await?,
            None => Vec::new(),
        };
        let new = entries.iter().filter(|new| !known.iter().any(|known| new.is_same(known)));
        let numbered: Vec<_> = (first..).zip(new).collect();
        for group in groups(&numbered) {
            let sql = format!(
                "INSERT INTO feed (number, at_ms, entry, audience) {}",
                values(1, group.len(), &COLUMN_TYPES)
            );
            let mut insert = sqlx::query(AssertSqlSafe(sql));
            for (number, entry) in group {
                insert = insert
                    .bind(stored(*number))
                    .bind(stored(at_ms))
                    .bind(json(&entry.numbered(*number, at_ms)))
                    .bind(json(&entry.audience));
            }
            insert.execute(write.connection()).await?;
        }
        sqlx::query(
            "DELETE FROM feed
             WHERE number <= (SELECT number FROM feed ORDER BY number DESC LIMIT 1 OFFSET $1)",
        )
        .bind(MAX_KEPT)
        .execute(write.connection())
        .await?;
        write.commit().await?;
        Ok(first..=first + (numbered.len() as u64).saturating_sub(1))
    }
}

async fn entries_since(write: &mut Transaction, at_ms: u64) -> Result<Vec<FeedEntry>, StoreError> {
    let entries: Vec<String> = sqlx::query_scalar("SELECT entry FROM feed WHERE number >= $1")
        .bind(stored(at_ms))
        .fetch_all(write.connection())
        .await?;
    entries.iter().map(|entry| from_json("feed.entry", entry)).collect()
}
