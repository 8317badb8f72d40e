//! The times at which assignments reached their phases. The text only grows at its end: a letter
//! for the phase, thirteen digits for the moment, three for the try. Each step therefore costs
//! nothing beyond the write of its row, and the old text need not be read first. Steps in the
//! middle of a long timeline are dropped.

use sqlx::Row as _;
use task_proto::DeploymentId;
use task_proto::RobotId;
use task_proto::TaskName;
use task_proto::api::{MAX_TIMELINE, PastAssignment, TimelineEntry};
use task_proto::messages::report::Phase;

use super::repositories::Assignments;
use super::rows::{from_json, from_optional_json, from_word, id, number};
use super::{Store, StoreError, deliveries};

/// Length of a step in characters.
const STEP: usize = 17;
/// The number of steps kept from the beginning.
const FIRST: usize = MAX_TIMELINE / 2;
/// The last moment that thirteen digits hold, in the year 2286.
const LAST_MS: u64 = 9_999_999_999_999;

/// A page of a robot's past assignments.
#[derive(Debug)]
pub struct HistoryPage {
    /// The assignments, the newest first.
    pub assignments: Vec<PastAssignment>,
    /// The last assignment of this page, if there are older ones.
    pub next: Option<DeploymentId>,
}

#[derive(Debug, Clone, Copy)]
pub struct HistoryQuery<'a> {
    /// Only assignments of this task.
    pub task: Option<&'a TaskName>,
    /// Only assignments older than this deployment.
    pub before: Option<&'a DeploymentId>,
    /// The most assignments in the page.
    pub limit: u32,
}

/// A step in its stored form.
pub(super) fn step(phase: Phase, at_ms: u64, attempt: u32) -> String {
    format!("{}{:013}{:03}", letter(phase), at_ms.min(LAST_MS), attempt.min(999))
}

/// SQL for the column with a step appended; the step is SQL as well.
pub(super) fn appended_step(step: &str) -> String {
    let (most, first, after) = (MAX_TIMELINE * STEP, FIRST * STEP, (FIRST + 1) * STEP + 1);
    format!(
        "CASE WHEN length(assignments.timeline) < {most} THEN assignments.timeline || {step}
             ELSE substr(assignments.timeline, 1, {first}) || substr(assignments.timeline, {after}) || {step} END"
    )
}

/// [`appended_step`] by a phase that a person or the server has set, at the time in the parameter
/// `now`.
pub(super) fn appended_phase(phase: Phase, now: &str) -> String {
    let digits = format!("CAST(CAST({now} AS BIGINT) AS TEXT)");
    let padded = format!("substr('0000000000000' || {digits}, length({digits}) + 1)");
    appended_step(&format!("'{}' || {padded} || '000'", letter(phase)))
}

/// Parses a stored timeline, the oldest step first. Unreadable steps are skipped.
pub(super) fn read(text: &str) -> Vec<TimelineEntry> {
    let entry = |step: &[u8]| {
        let step = std::str::from_utf8(step).ok()?;
        let phase = Phase::ALL.into_iter().find(|phase| step.starts_with(letter(*phase)))?;
        Some(TimelineEntry {
            phase,
            at_ms: step.get(1..14)?.parse().ok()?,
            attempt: step.get(14..)?.parse().ok()?,
        })
    };
    text.as_bytes().chunks(STEP).filter_map(entry).collect()
}

/// The letters are stored, so they must never change.
fn letter(phase: Phase) -> char {
    match phase {
        Phase::Assigned => 'a',
        Phase::Fetching => 'f',
        Phase::Unpacking => 'u',
        Phase::Building => 'b',
        Phase::Staged => 's',
        Phase::Starting => 't',
        Phase::Running => 'r',
        Phase::Succeeded => 'S',
        Phase::Failed => 'F',
        Phase::Stopped => 'T',
        Phase::Unmet => 'U',
        Phase::Deferred => 'D',
        Phase::Superseded => 'P',
        Phase::Cancelled => 'C',
        Phase::Expired => 'E',
        Phase::RolledBack => 'R',
        Phase::Unknown => '?',
    }
}

impl Assignments<&Store> {
    /// A page of a robot's past assignments; `None` if the deployment to begin before does not
    /// exist.
    pub async fn history(
        self,
        robot: &RobotId,
        query: HistoryQuery<'_>,
    ) -> Result<Option<HistoryPage>, StoreError> {
        let before = match query.before {
            None => i64::MAX,
            Some(before) => {
                let asked = sqlx::query_scalar("SELECT number FROM deployments WHERE id = $1")
                    .bind(before.as_str());
                match asked.fetch_optional(&self.0.reads).await? {
                    Some(number) => number,
                    None => return Ok(None),
                }
            }
        };
        let rows = sqlx::query(
            "SELECT a.deployment_id, a.released, a.desired, a.wanted, a.phase, a.progress, a.failure, a.attempts,
                 a.mechanism, a.rule, a.because, a.timeline, a.updated_at_ms, a.superseded_by, d.package,
                 d.kind, d.created_at_ms
             FROM assignments a JOIN deployments d ON d.id = a.deployment_id
             WHERE a.robot_id = $1 AND d.number < $2 AND (a.task = $3 OR $3 = '')
             ORDER BY d.number DESC, a.deployment_id LIMIT $4",
        )
        .bind(robot.as_str())
        .bind(before)
        .bind(query.task.map_or("", TaskName::as_str).to_owned())
        .bind(i64::from(query.limit) + 1)
        .fetch_all(&self.0.reads)
        .await?;
        let mut assignments = rows.iter().map(past_assignment).collect::<Result<Vec<_>, _>>()?;
        let has_more = assignments.len() > query.limit as usize;
        assignments.truncate(query.limit as usize);
        let next = assignments.last().filter(|_| has_more).map(|last| last.deployment.clone());
        Ok(Some(HistoryPage { assignments, next }))
    }
}

fn past_assignment(row: &sqlx::any::AnyRow) -> Result<PastAssignment, StoreError> {
    let superseded_by: Option<String> = row.try_get("superseded_by")?;
    let is_desired = row.try_get::<i64, _>("desired")? == 1;
    let wanted = from_word("assignments.wanted", row.try_get("wanted")?)?;
    Ok(PastAssignment {
        deployment: id("assignments.deployment_id", row.try_get("deployment_id")?)?,
        package: from_json("deployments.package", row.try_get("package")?)?,
        kind: from_word("deployments.kind", row.try_get("kind")?)?,
        released: row.try_get::<i64, _>("released")? == 1,
        wanted: is_desired.then_some(wanted),
        phase: Phase::from_text(row.try_get("phase")?),
        progress: from_optional_json("assignments.progress", row.try_get("progress")?)?,
        failure: from_optional_json("assignments.failure", row.try_get("failure")?)?,
        attempts: u32::try_from(row.try_get::<i64, _>("attempts")?).unwrap_or(u32::MAX),
        delivery: deliveries::decision(row)?,
        timeline: read(row.try_get("timeline")?),
        created_at_ms: number(row.try_get("created_at_ms")?),
        updated_at_ms: number(row.try_get("updated_at_ms")?),
        superseded_by: superseded_by
            .map(|newer| id("assignments.superseded_by", &newer))
            .transpose()?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timeline_of_every_phase_round_trips() {
        let entries: Vec<TimelineEntry> = (0..)
            .zip(Phase::ALL)
            .map(|(at, phase)| TimelineEntry { phase, at_ms: 1_800_000_000_000 + at, attempt: 7 })
            .collect();
        let stored: String =
            entries.iter().map(|entry| step(entry.phase, entry.at_ms, entry.attempt)).collect();
        assert_eq!(read(&stored), entries);
        assert_eq!(stored.len(), entries.len() * STEP);
        assert_eq!(read(&step(Phase::Running, u64::MAX, u32::MAX))[0].attempt, 999);
        assert_eq!(step(Phase::Running, u64::MAX, u32::MAX).len(), STEP);
        assert_eq!(read("x0000000000001001F00000000000"), []);
    }
}
