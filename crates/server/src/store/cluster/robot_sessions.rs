//! The last session of each robot, at whichever server. Rows are written without the lock of
//! orders, by the server that has the session. This module never decides which server lives.

use sqlx::any::AnyRow;
use sqlx::{AssertSqlSafe, Row as _};
use task_proto::RobotId;

use crate::store::repositories::RobotSessions;
use crate::store::rows::{groups, id, number, stored, values};
use crate::store::{Store, StoreError};

/// A session to be stored.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewRobotSession {
    pub robot: RobotId,
    /// The epoch of the row when this server last wrote it; `None`: the session has begun.
    pub known_epoch: Option<u64>,
    pub token_number: u64,
    /// The start of the MQTT connection; `None`: the robot polls over HTTP.
    pub since_ms: Option<u64>,
    pub seen_ms: u64,
    pub address: Option<String>,
    /// The agent that serves the robot's work, as JSON.
    pub agent: Option<String>,
}

/// A session that has ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LeftSession {
    pub robot: RobotId,
    /// The epoch of the row when this server last wrote it.
    pub epoch: u64,
    pub left_ms: u64,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RobotSession {
    pub robot: RobotId,
    pub run: String,
    /// Grows with each write of the row.
    pub epoch: u64,
    /// Grows with each statement of the run.
    pub change: u64,
    pub since_ms: Option<u64>,
    pub seen_ms: u64,
    pub left_ms: Option<u64>,
    pub address: Option<String>,
    /// The agent that serves the robot's work, as JSON.
    pub agent: Option<String>,
}

/// The number of a run's last statement that a reader has seen.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SessionPosition {
    pub run: String,
    pub change: u64,
}

/// The server that has a robot's session.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SessionNode {
    pub name: String,
    pub url: Option<String>,
}

const SESSION_TYPES: [&str; 7] = ["TEXT", "BIGINT", "BIGINT", "BIGINT", "BIGINT", "TEXT", "TEXT"];
const LEFT_TYPES: [&str; 3] = ["TEXT", "BIGINT", "BIGINT"];
/// The most changed rows of one read.
const MAX_CHANGED: i64 = 5_000;

impl RobotSessions<&Store> {
    /// Stores sessions of `run`, which must be sorted by robot, each group of rows with the next
    /// number of `change`. A session that has begun replaces that of another server, and polling
    /// replaces no MQTT connection at one of `live_runs`. A session that the server has written
    /// before is stored if no other server has stored one since. Returns the stored epochs.
    pub async fn put(
        self,
        run: &str,
        change: &mut u64,
        sessions: &[NewRobotSession],
        live_runs: &[String],
    ) -> Result<Vec<(RobotId, u64)>, StoreError> {
        let mut written = Vec::with_capacity(sessions.len());
        for group in groups(sessions) {
            *change += 1;
            written.extend(self.put_group(run, *change, group, live_runs).await?);
        }
        Ok(written)
    }

    async fn put_group(
        self,
        run: &str,
        change: u64,
        sessions: &[NewRobotSession],
        live_runs: &[String],
    ) -> Result<Vec<(RobotId, u64)>, StoreError> {
        let first_run = 3 + sessions.len() * SESSION_TYPES.len();
        let runs = values(first_run, live_runs.len().max(1), &["TEXT"]);
        let sql = format!(
            "WITH v (robot_id, epoch, token_number, since_ms, seen_ms, address, agent) AS ({})
             INSERT INTO robot_sessions (robot_id, run, epoch, change, token_number, since_ms,
                 seen_ms, left_ms, address, agent)
             SELECT robot_id, $1, epoch + 1, $2, token_number, since_ms, seen_ms, NULL, address,
                 agent
             FROM v WHERE TRUE
             ON CONFLICT (robot_id) DO UPDATE SET run = excluded.run, change = excluded.change,
                 epoch = CASE WHEN robot_sessions.epoch < excluded.epoch THEN excluded.epoch
                     ELSE robot_sessions.epoch + 1 END,
                 token_number = excluded.token_number, since_ms = excluded.since_ms,
                 seen_ms = excluded.seen_ms, left_ms = NULL, address = excluded.address,
                 agent = excluded.agent
             WHERE (excluded.epoch = 1 OR robot_sessions.epoch < excluded.epoch)
               AND (excluded.since_ms IS NOT NULL OR robot_sessions.since_ms IS NULL
                   OR robot_sessions.left_ms IS NOT NULL OR robot_sessions.run = excluded.run
                   OR robot_sessions.run NOT IN ({runs}))
             RETURNING robot_id, epoch",
            values(3, sessions.len(), &SESSION_TYPES),
        );
        let mut query = sqlx::query(AssertSqlSafe(sql)).bind(run).bind(stored(change));
        for session in sessions {
            query = query
                .bind(session.robot.as_str())
                .bind(stored(session.known_epoch.unwrap_or(0)))
                .bind(stored(session.token_number))
                .bind(session.since_ms.map(stored))
                .bind(stored(session.seen_ms))
                .bind(session.address.as_deref())
                .bind(session.agent.as_deref());
        }
        if live_runs.is_empty() {
            query = query.bind(run);
        }
        for live in live_runs {
            query = query.bind(live.as_str());
        }
        let rows = query.fetch_all(&self.0.cluster_writes).await?;
        rows.iter().map(|row| Ok((robot(row)?, number(row.try_get("epoch")?)))).collect()
    }

    /// Stores that sessions of `run` have ended, unless another server has stored one since.
    pub async fn leave(
        self,
        run: &str,
        change: &mut u64,
        left: &[LeftSession],
    ) -> Result<(), StoreError> {
        for group in groups(left) {
            *change += 1;
            let sql = format!(
                "WITH v (robot_id, epoch, left_ms) AS ({})
                 UPDATE robot_sessions SET left_ms = v.left_ms, change = $2,
                     epoch = robot_sessions.epoch + 1
                 FROM v WHERE robot_sessions.robot_id = v.robot_id AND robot_sessions.run = $1
                     AND robot_sessions.epoch = v.epoch AND robot_sessions.left_ms IS NULL",
                values(3, group.len(), &LEFT_TYPES)
            );
            let mut query = sqlx::query(AssertSqlSafe(sql)).bind(run).bind(stored(*change));
            for session in group {
                query = query
                    .bind(session.robot.as_str())
                    .bind(stored(session.epoch))
                    .bind(stored(session.left_ms));
            }
            query.execute(&self.0.cluster_writes).await?;
        }
        Ok(())
    }

    /// Stores that a run has ended, and with it its sessions. Returns the robots that had one.
    pub async fn end_run(self, run: &str, now_ms: u64) -> Result<Vec<RobotId>, StoreError> {
        let rows = sqlx::query(
            "UPDATE robot_sessions SET left_ms = $2, epoch = epoch + 1
             WHERE run = $1 AND left_ms IS NULL RETURNING robot_id",
        )
        .bind(run)
        .bind(stored(now_ms))
        .fetch_all(&self.0.cluster_writes)
        .await?;
        rows.iter().map(robot).collect()
    }

    /// The sessions of runs that were stored after these positions, in the order of their changes.
    /// Of many, only the first; true: there are more.
    pub async fn changed(
        self,
        positions: &[SessionPosition],
    ) -> Result<(Vec<RobotSession>, bool), StoreError> {
        if positions.is_empty() {
            return Ok((Vec::new(), false));
        }
        let sql = format!(
            "WITH p (run, change) AS ({})
             SELECT s.robot_id, s.run, s.epoch, s.change, s.since_ms, s.seen_ms, s.left_ms,
                 s.address, s.agent
             FROM p JOIN robot_sessions s ON s.run = p.run AND s.change > p.change
             ORDER BY s.change LIMIT $1",
            values(2, positions.len(), &["TEXT", "BIGINT"])
        );
        let mut query = sqlx::query(AssertSqlSafe(sql)).bind(MAX_CHANGED);
        for position in positions {
            query = query.bind(position.run.as_str()).bind(stored(position.change));
        }
        let rows = query.fetch_all(&self.0.reads).await?;
        let mut sessions = rows.iter().map(session).collect::<Result<Vec<_>, _>>()?;
        let is_cut = sessions.len() as i64 == MAX_CHANGED;
        if let Some(last) = sessions.last().map(|session| session.change).filter(|_| is_cut) {
            // Rows of one statement have the same number, and the limit may have cut between them.
            sessions.retain(|session| session.change < last);
        }
        Ok((sessions, is_cut))
    }

    /// The server that has the robot's session, if it is one of `live_runs`.
    pub async fn node_of(
        self,
        robot: &RobotId,
        live_runs: &[String],
    ) -> Result<Option<SessionNode>, StoreError> {
        let found: Option<(String, Option<String>, String)> = sqlx::query_as(
            "SELECT n.name, n.url, n.run FROM robot_sessions s JOIN nodes n ON n.run = s.run
             WHERE s.robot_id = $1 AND s.left_ms IS NULL",
        )
        .bind(robot.as_str())
        .fetch_optional(&self.0.reads)
        .await?;
        let live = found.filter(|(_, _, run)| live_runs.contains(run));
        Ok(live.map(|(name, url, _)| SessionNode { name, url }))
    }

    /// Robots with a session of `run` that have not reported their newest desired state, with its
    /// generation. Robots that are to poll for it are left out.
    pub async fn behind(self, run: &str) -> Result<Vec<(RobotId, u64)>, StoreError> {
        let rows = sqlx::query(
            "SELECT r.id AS robot_id, r.generation
             FROM robots r JOIN robot_sessions s ON s.robot_id = r.id
             WHERE r.generation > r.observed_generation AND r.removed_at_ms IS NULL
               AND s.run = $1 AND s.left_ms IS NULL
               AND NOT EXISTS (SELECT 1 FROM assignments a WHERE a.robot_id = r.id
                   AND a.desired = 1 AND a.phase = 'assigned' AND a.mechanism = 'poll')",
        )
        .bind(run)
        .fetch_all(&self.0.reads)
        .await?;
        rows.iter().map(|row| Ok((robot(row)?, number(row.try_get("generation")?)))).collect()
    }

    /// Robots with an MQTT connection of `run` to which they have no right any more: they were
    /// removed or revoked, or have another token.
    pub async fn without_right(self, run: &str) -> Result<Vec<RobotId>, StoreError> {
        let rows = sqlx::query(
            "SELECT s.robot_id FROM robot_sessions s JOIN robots r ON r.id = s.robot_id
             WHERE s.run = $1 AND s.left_ms IS NULL AND s.since_ms IS NOT NULL
               AND (r.removed_at_ms IS NOT NULL OR r.revoked_at_ms IS NOT NULL
                   OR r.token_number <> s.token_number)",
        )
        .bind(run)
        .fetch_all(&self.0.reads)
        .await?;
        rows.iter().map(robot).collect()
    }
}

fn robot(row: &AnyRow) -> Result<RobotId, StoreError> {
    id("robot_sessions.robot_id", row.try_get("robot_id")?)
}

fn session(row: &AnyRow) -> Result<RobotSession, StoreError> {
    Ok(RobotSession {
        robot: robot(row)?,
        run: row.try_get("run")?,
        epoch: number(row.try_get("epoch")?),
        change: number(row.try_get("change")?),
        since_ms: row.try_get::<Option<i64>, _>("since_ms")?.map(number),
        seen_ms: number(row.try_get("seen_ms")?),
        left_ms: row.try_get::<Option<i64>, _>("left_ms")?.map(number),
        address: row.try_get("address")?,
        agent: row.try_get("agent")?,
    })
}
