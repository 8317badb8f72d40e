//! The only writer of reports: a bounded queue, emptied in batches, each one write to the store. A
//! caller's future resolves when its report is stored. Of several reports of a robot in a batch
//! only the last is written; the others are acknowledged too, since each report is a complete
//! snapshot. The writer caches stored rows ([`memory`]): a batch of robots that keep reporting
//! reads nothing, and writes only changes.

mod memory;

use std::collections::{BTreeSet, HashMap};
use std::hash::{DefaultHasher, Hasher as _};
use std::sync::Arc;
use std::time::Duration;

use task_proto::api::{FeedKind, ReportReply};
use task_proto::report::{Condition, Phase, Report, TaskReport};
use task_proto::{DeploymentId, Generation, RobotId};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio::time::Instant;

use super::advance::advance;
use super::changes::{Changes, Consequences};
use super::chooser::Chooser;
use super::report_meter::ReportMeter;
use crate::domain::happening::{Happening, TaskNews};
use crate::store::{DatabaseState, Fault, OpenAssignment, ReportedRobot, Store, StoreError, Write};
use crate::system::clock::Clock;
use memory::Memory;

/// Queue capacity in reports; when the queue is full, callers wait for room.
const QUEUE: usize = 16 * 1024;
/// How long a caller waits for room in the queue.
const PATIENCE: Duration = Duration::from_secs(10);
/// Maximum number of reports in a batch.
const MAX_BATCH: usize = 2048;
/// How often a failing batch is tried.
const TRIES: u32 = 3;
/// The pause before the second try; each further pause doubles.
const FIRST_PAUSE: Duration = Duration::from_millis(50);
/// A change in a robot's free disk space is stored when the difference is about this large.
const DISK_STEP_BYTES: u64 = 16 << 20;

/// The entry to the report queue. Clones feed the same writer.
#[derive(Debug, Clone)]
pub struct ReportWriter {
    queue: mpsc::Sender<Submission>,
    meter: ReportMeter,
    database: DatabaseState,
}

/// Why a report was not stored. The robot keeps the report and sends it again.
#[derive(Debug, Clone, thiserror::Error)]
pub enum ReportError {
    /// No such robot, or no longer.
    #[error("there is no robot {0}")]
    RobotNotFound(RobotId),
    /// A newer token of the robot has been used since the sender authenticated: the sender no
    /// longer speaks for the robot.
    #[error("robot {0} uses a newer token")]
    TokenEnded(RobotId),
    /// The queue stays full, or the server is stopping.
    #[error("reports can't be taken now")]
    Busy,
    /// The database rejected the write.
    #[error("the report could not be stored")]
    NotStored(Option<Fault>),
}

#[derive(Debug)]
struct Submission {
    report: Report,
    fingerprint: u64,
    token_number: u64,
    answer: oneshot::Sender<Result<ReportReply, ReportError>>,
}

impl ReportWriter {
    /// Starts the writer. The task ends, after all that was handed in, when the last clone is
    /// dropped.
    pub fn start(
        store: Store,
        clock: Clock,
        changes: Changes,
        chooser: Chooser,
    ) -> (Self, JoinHandle<()>) {
        let (queue, submissions) = mpsc::channel(QUEUE);
        let (meter, database) = (ReportMeter::new(Instant::now()), store.state().clone());
        (
            Self { queue, meter, database },
            tokio::spawn(write_all(submissions, store, clock, changes, chooser)),
        )
    }

    /// Stores the fields of `report` that are kept. The caller has authenticated the report's
    /// `robot_id` with the robot's token of this number. Resolves after the commit.
    pub async fn submit(
        &self,
        report: Report,
        token_number: u64,
    ) -> Result<ReportReply, ReportError> {
        // Otherwise the report would queue behind earlier ones, for nothing.
        if !self.database.is_there() {
            return Err(ReportError::NotStored(Some(Fault::Away)));
        }
        let (came, report) = (Instant::now(), report.tidied());
        let (answer, answered) = oneshot::channel();
        let submission =
            Submission { fingerprint: fingerprint(&report), report, token_number, answer };
        self.queue.send_timeout(submission, PATIENCE).await.map_err(|_| ReportError::Busy)?;
        let reply = answered.await.map_err(|_| ReportError::Busy)??;
        self.meter.stored(Instant::now(), came.elapsed());
        Ok(reply)
    }

    /// Resolves when the database answers. Cancel-safe.
    pub async fn database_there(&self) {
        self.database.there().await;
    }

    /// The meter of stored reports.
    pub fn meter(&self) -> &ReportMeter {
        &self.meter
    }
}

async fn write_all(
    mut submissions: mpsc::Receiver<Submission>,
    store: Store,
    clock: Clock,
    changes: Changes,
    chooser: Chooser,
) {
    let mut batch = Vec::with_capacity(MAX_BATCH);
    let mut memory = Memory::default();
    while submissions.recv_many(&mut batch, MAX_BATCH).await > 0 {
        let newest = newest_by_robot(&batch);
        let answers = match write_with_retries(&store, &chooser, &mut memory, &newest, &clock).await
        {
            Ok((answers, consequences)) => {
                changes.publish(consequences);
                newest
                    .iter()
                    .for_each(|submission| changes.part_requests().hear(&submission.report));
                Ok(answers)
            }
            Err(error) => {
                error.log("reports were refused");
                Err(ReportError::NotStored(error.fault()))
            }
        };
        for Submission { report, token_number, answer, .. } in batch.drain(..) {
            let reply = answers.as_ref().map_err(Clone::clone).and_then(|answers| {
                match answers.get(&report.robot_id) {
                    None => Err(ReportError::RobotNotFound(report.robot_id)),
                    Some(answer) if token_number < answer.token_number => {
                        Err(ReportError::TokenEnded(report.robot_id))
                    }
                    Some(answer) => Ok(answer.reply.clone()),
                }
            });
            // The caller may have gone away; its answer is then dropped.
            let _ = answer.send(reply);
        }
    }
}

/// Equal for reports that differ only in transient fields: times, and progress within a phase.
/// Those are not worth another write of the report; the states of assignments are stored
/// separately.
fn fingerprint(report: &Report) -> u64 {
    let mut lasting = report.clone();
    (lasting.seq, lasting.uptime_ms, lasting.observed_generation) = (0, 0, Generation(0));
    lasting.host.disk_free_bytes /= DISK_STEP_BYTES;
    for task in &mut lasting.tasks {
        (task.phase_ms, task.progress, task.missing_parts) = (0, None, None);
    }
    let mut hasher = DefaultHasher::new();
    hasher.write(&serde_json::to_vec(&lasting).unwrap_or_default());
    hasher.finish()
}

/// The last report of each robot in a batch.
fn newest_by_robot(batch: &[Submission]) -> Vec<&Submission> {
    let mut newest: HashMap<&RobotId, &Submission> = HashMap::new();
    // An agent that uses a newer token may count its starts from 1 again.
    let position =
        |submission: &Submission| (submission.token_number, position(&submission.report));
    for submission in batch {
        let last = newest.entry(&submission.report.robot_id).or_insert(submission);
        if position(submission) > position(last) {
            *last = submission;
        }
    }
    newest.into_values().collect()
}

/// The order of one robot's reports.
fn position(report: &Report) -> (u64, u64) {
    (report.start, report.seq)
}

/// The answer to all senders that reported for a robot, except those with an ended token.
struct Answer {
    reply: ReportReply,
    token_number: u64,
}

type Answers = HashMap<RobotId, Answer>;

async fn write_with_retries(
    store: &Store,
    chooser: &Chooser,
    memory: &mut Memory,
    reports: &[&Submission],
    clock: &Clock,
) -> Result<(Answers, Consequences), StoreError> {
    let mut pause = FIRST_PAUSE;
    let mut tries = 1;
    loop {
        let error = match write_batch(store, chooser, memory, reports, clock.now_ms()).await {
            Ok(written) => return Ok(written),
            Err(error) => error,
        };
        // The memory already contains the changes that the failed batch did not store.
        memory.forget();
        if tries == TRIES {
            return Err(error);
        }
        match error.fault() {
            // A retry would fail in the same way. Robots keep their reports and send them again.
            Some(Fault::Corrupt | Fault::Full) => return Err(error),
            // A restarted database is soon back. Reports that arrive meanwhile are refused earlier.
            Some(Fault::Away) => {
                let there = tokio::time::timeout(PATIENCE, store.state().there()).await;
                there.map_err(|_| error)?;
            }
            Some(Fault::Busy) | None => {
                error.log("reports are tried again");
                tokio::time::sleep(pause).await;
                pause *= 2;
            }
        }
        tries += 1;
    }
}

/// Stores a batch and its consequences, in one write.
async fn write_batch(
    store: &Store,
    chooser: &Chooser,
    memory: &mut Memory,
    reports: &[&Submission],
    now_ms: u64,
) -> Result<(Answers, Consequences), StoreError> {
    let mut write = store.begin_keeping_rights().await?;
    let turn = write.turn();
    memory.learn(&mut write, reports.iter().map(|submission| &submission.report.robot_id)).await?;
    // A report older than the stored one is acknowledged, so that the robot does not send it again,
    // and otherwise ignored.
    let is_news = |submission: &&Submission| {
        memory.get(&submission.report.robot_id).is_some_and(|known| {
            submission.token_number >= known.robot.token_number
                && position(&submission.report) > known.robot.last_report
        })
    };
    let news: Vec<&Submission> = reports.iter().copied().filter(is_news).collect();
    let mut consequences = Consequences::default();
    consequences.robots.extend(news.iter().map(|submission| submission.report.robot_id.clone()));
    let moved =
        write_standings(&mut write, memory, &news, now_ms, &mut consequences.happenings).await?;
    write_reports(&mut write, memory, &news, now_ms).await?;
    consequences.deployments.extend(moved.iter().cloned());
    let rolls =
        advance_waiting(&mut write, chooser, memory, moved, now_ms, &mut consequences).await?;
    let mut answers: Answers = reports
        .iter()
        .filter_map(|submission| memory.get(&submission.report.robot_id))
        .map(|known| answer(known.robot.clone()))
        .collect();
    // Releasing a batch may have raised generations.
    let rung: Vec<RobotId> =
        consequences.rings.iter().filter(|robot| answers.contains_key(*robot)).cloned().collect();
    answers.extend(write.reported_robots(&rung).await?.into_iter().map(answer));
    write.commit().await?;
    consequences
        .happenings
        .extend(news.iter().flat_map(|submission| newly_wrong(memory, &submission.report)));
    if rolls {
        memory.forget();
    } else {
        memory.committed(turn);
    }
    Ok((answers, consequences))
}

fn answer(robot: ReportedRobot) -> (RobotId, Answer) {
    let reply =
        ReportReply { generation: robot.generation, name: robot.name, labels: robot.labels };
    (robot.id, Answer { reply, token_number: robot.token_number })
}

/// Advances those of the deployments that have robots whose batch has not begun. Returns whether
/// there were any: then generations and assignments may have changed.
async fn advance_waiting(
    write: &mut Write,
    chooser: &Chooser,
    memory: &mut Memory,
    moved: BTreeSet<DeploymentId>,
    now_ms: u64,
    consequences: &mut Consequences,
) -> Result<bool, StoreError> {
    let mut waiting = BTreeSet::new();
    for deployment in
        moved.into_iter().filter(|deployment| memory.may_wait(deployment)).collect::<Vec<_>>()
    {
        if write.rollout(&deployment).await?.is_some() {
            waiting.insert(deployment);
        } else {
            memory.has_begun(deployment);
        }
    }
    let rolls = !waiting.is_empty();
    advance(write, chooser, waiting, now_ms, consequences).await?;
    Ok(rolls)
}

/// Stores the state of the robots' assignments after `news`. Returns the deployments with a changed
/// phase.
async fn write_standings(
    write: &mut Write,
    memory: &mut Memory,
    news: &[&Submission],
    now_ms: u64,
    happenings: &mut Vec<Happening>,
) -> Result<BTreeSet<DeploymentId>, StoreError> {
    let mut deployments = BTreeSet::new();
    let (mut moved, mut progressed) = (Vec::new(), Vec::new());
    for Submission { report, .. } in news {
        let Some(known) = memory.get_mut(&report.robot_id) else { continue };
        for assignment in &mut known.open {
            let next = match task_of(report, assignment) {
                Some(task) => assignment.standing.after(task),
                None => assignment
                    .standing
                    .after_absence(assignment.removed, report.observed_generation),
            };
            let Some(next) = next else { continue };
            let is_moved = next.phase != assignment.standing.phase;
            let tries_again = next.attempts > assignment.standing.attempts;
            assignment.standing = next;
            if is_moved {
                deployments.insert(assignment.deployment.clone());
                happenings.extend(worth_a_look(&known.robot, assignment));
            }
            if is_moved || tries_again {
                moved.push(assignment.clone());
            } else {
                progressed.push(assignment.clone());
            }
        }
        known.open.retain(|assignment| !assignment.standing.phase.is_final());
    }
    write.store_standings(&moved, now_ms).await?;
    write.store_progress(&progressed, now_ms).await?;
    Ok(deployments)
}

/// Stores the reports; for a report equal to the previous one, only its position.
async fn write_reports(
    write: &mut Write,
    memory: &mut Memory,
    news: &[&Submission],
    now_ms: u64,
) -> Result<(), StoreError> {
    let (mut whole, mut repeated) = (Vec::new(), Vec::new());
    for submission in news {
        let Some(known) = memory.get_mut(&submission.report.robot_id) else { continue };
        known.robot.last_report = position(&submission.report);
        if known.fingerprint.replace(submission.fingerprint) == Some(submission.fingerprint) {
            repeated.push(&submission.report);
        } else {
            whole.push(&submission.report);
        }
    }
    write.store_reports(&whole, now_ms).await?;
    write.store_repeated(&repeated, now_ms).await
}

/// Conditions that are new in this report.
fn newly_wrong(memory: &mut Memory, report: &Report) -> Vec<Happening> {
    let news = memory.new_conditions(&report.robot_id, &report.conditions).into_iter();
    let text =
        |condition: &Condition| format!("{}: {}", condition.code.replace('_', " "), condition.text);
    news.map(|one| Happening::Robot(report.robot_id.clone(), FeedKind::RobotCondition, text(one)))
        .collect()
}

/// The feed event of a failed phase, or of a phase that resolves a failure.
fn worth_a_look(robot: &ReportedRobot, assignment: &OpenAssignment) -> Option<Happening> {
    let OpenAssignment { deployment, standing, .. } = assignment;
    matches!(standing.phase, Phase::Failed | Phase::RolledBack | Phase::Running | Phase::Succeeded)
        .then(|| {
            Happening::Task(Arc::new(TaskNews {
                robot: robot.id.clone(),
                name: robot.name.clone(),
                deployment: deployment.clone(),
                phase: standing.phase,
                failure: standing.failure.clone(),
            }))
        })
}

fn task_of<'a>(report: &'a Report, assignment: &OpenAssignment) -> Option<&'a TaskReport> {
    report.tasks.iter().find(|task| task.deployment == assignment.deployment)
}
