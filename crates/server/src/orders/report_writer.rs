//! The only writer of reports: a bounded queue, emptied in batches, each one write to the store. A
//! caller's future resolves when its report is stored. Of several reports of a robot in a batch
//! only the last is written; the others are acknowledged too, since each report is a complete
//! snapshot. The writer caches stored rows ([`cache`]): a batch of robots that keep reporting
//! reads only their rows, and writes only changes. A batch that settles assignments of a rollout is
//! followed by a second write, which advances the rollout; if that one fails, the periodic check of
//! rollouts makes up for it.

mod cache;

use std::collections::{BTreeSet, HashMap};
use std::hash::{DefaultHasher, Hasher as _};
use std::sync::Arc;
use std::time::Duration;

use task_proto::api::{FeedKind, ReportReply};
use task_proto::messages::report::{Condition, Phase, Report, TaskReport};
use task_proto::{DeploymentId, Generation, RobotId};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio::time::Instant;

use super::changes::{Changes, PendingNotifications};
use super::delivery_planner::DeliveryPlanner;
use super::report_meter::ReportMeter;
use super::rollout;
use crate::domain::fleet_event::{FleetEvent, TaskEvent};
use crate::store::{
    DatabaseState, Fault, OpenAssignment, ReportTransaction, ReportedRobot, Store, StoreError,
};
use crate::system::clock::Clock;
use cache::RowCache;

/// Queue capacity in reports; when the queue is full, callers wait for room.
const QUEUE: usize = 16 * 1024;
/// How long a caller waits for room in the queue.
const QUEUE_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum number of reports in a batch.
const MAX_BATCH: usize = 2048;
/// How often a batch is tried that the database refuses.
const MAX_REFUSALS: u32 = 3;
/// How long a batch is tried while the connection to the database fails, as during a failover. It is
/// shorter than the broker's time limit for a message, so robots' sessions stay.
const OUTAGE_PATIENCE: Duration = Duration::from_secs(12);
/// The first pause between two tries, and the longest; each is twice the one before.
const RETRY_PAUSES: [Duration; 2] = [Duration::from_millis(50), Duration::from_millis(500)];
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
    #[error("the server can't accept reports now")]
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
        planner: DeliveryPlanner,
    ) -> (Self, JoinHandle<()>) {
        let (queue, submissions) = mpsc::channel(QUEUE);
        let (meter, database) = (ReportMeter::new(Instant::now()), store.state().clone());
        (
            Self { queue, meter, database },
            tokio::spawn(write_all(submissions, store, clock, changes, planner)),
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
        if !self.database.is_available() {
            return Err(ReportError::NotStored(Some(Fault::Unreachable)));
        }
        let (received_at, report) = (Instant::now(), report.tidied());
        let (answer, answered) = oneshot::channel();
        let submission =
            Submission { fingerprint: fingerprint(&report), report, token_number, answer };
        self.queue.send_timeout(submission, QUEUE_TIMEOUT).await.map_err(|_| ReportError::Busy)?;
        let reply = answered.await.map_err(|_| ReportError::Busy)??;
        self.meter.stored(Instant::now(), received_at.elapsed());
        Ok(reply)
    }

    /// Resolves when the database answers. Cancel-safe.
    pub async fn database_there(&self) {
        self.database.available().await;
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
    planner: DeliveryPlanner,
) {
    let mut batch = Vec::with_capacity(MAX_BATCH);
    let mut cache = RowCache::default();
    while submissions.recv_many(&mut batch, MAX_BATCH).await > 0 {
        let newest = newest_by_robot(&batch);
        let answers = match write_with_retries(&store, &mut cache, &newest, &clock).await {
            Ok(Written { mut answers, notifications, to_advance }) => {
                changes.publish(notifications);
                newest
                    .iter()
                    .for_each(|submission| changes.part_requests().record(&submission.report));
                match rollout::advance(&store, &planner, to_advance, clock.now_ms()).await {
                    Ok(advanced) => {
                        renew_generations(&store, &advanced.to_notify, &mut answers).await;
                        changes.publish(advanced);
                    }
                    // The reports are stored all the same.
                    Err(error) => error.log("rollouts could not be advanced after reports"),
                }
                Ok(answers)
            }
            Err(error) => {
                error.log("reports could not be stored");
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

/// The outcome of a batch, which is committed.
struct Written {
    answers: Answers,
    notifications: PendingNotifications,
    /// Deployments that may begin another batch, because an assignment has settled.
    to_advance: BTreeSet<DeploymentId>,
}

async fn write_with_retries(
    store: &Store,
    cache: &mut RowCache,
    reports: &[&Submission],
    clock: &Clock,
) -> Result<Written, StoreError> {
    let (began, mut refusals) = (Instant::now(), 0);
    let [mut pause, longest] = RETRY_PAUSES;
    loop {
        let error = match write_batch(store, cache, reports, clock.now_ms()).await {
            Ok(written) => return Ok(written),
            Err(error) => error,
        };
        // The cache already contains the changes that the failed batch did not store.
        cache.clear();
        let is_worth_a_retry = match error.fault() {
            // A retry would fail in the same way. Robots keep their reports and send them again.
            Some(Fault::Corrupt | Fault::Full) => false,
            Some(Fault::Unreachable) => began.elapsed() + pause < OUTAGE_PATIENCE,
            Some(Fault::Busy) | None => {
                refusals += 1;
                refusals < MAX_REFUSALS
            }
        };
        if !is_worth_a_retry {
            return Err(error);
        }
        error.log("storing reports failed; trying again");
        tokio::time::sleep(pause).await;
        pause = longest.min(pause * 2);
    }
}

/// Stores a batch in one write.
async fn write_batch(
    store: &Store,
    cache: &mut RowCache,
    reports: &[&Submission],
    now_ms: u64,
) -> Result<Written, StoreError> {
    let robots = reports.iter().map(|submission| &submission.report.robot_id).collect();
    let mut write = store.begin_report(&robots).await?;
    cache.load(&mut write).await?;
    // A report older than the stored one is acknowledged, so that the robot does not send it again,
    // and otherwise ignored.
    let is_news = |submission: &&Submission| {
        cache.get(&submission.report.robot_id).is_some_and(|known| {
            submission.token_number >= known.robot.token_number
                && position(&submission.report) > known.robot.last_report
        })
    };
    let news: Vec<&Submission> = reports.iter().copied().filter(is_news).collect();
    let mut notifications = PendingNotifications::default();
    notifications.robots.extend(news.iter().map(|submission| submission.report.robot_id.clone()));
    let Moved { deployments, settled } =
        write_assignment_states(&mut write, cache, &news, now_ms, &mut notifications.fleet_events)
            .await?;
    notifications.deployments = deployments;
    write_reports(&mut write, cache, &news, now_ms).await?;
    let to_advance = waiting_among(&mut write, cache, settled).await?;
    write.commit().await?;
    notifications
        .fleet_events
        .extend(news.iter().flat_map(|submission| new_condition_events(cache, &submission.report)));
    let answers = robots.iter().filter_map(|robot| cache.get(robot)).map(|it| answer(&it.robot));
    Ok(Written { answers: answers.collect(), notifications, to_advance })
}

fn answer(robot: &ReportedRobot) -> (RobotId, Answer) {
    let ReportedRobot { id, name, labels, generation, token_number, .. } = robot.clone();
    (id, Answer { reply: ReportReply { generation, name, labels }, token_number })
}

/// Puts the present generations of `robots` into their answers. An answer with an older one is
/// right too: it costs the robot a further request.
async fn renew_generations(store: &Store, robots: &BTreeSet<RobotId>, answers: &mut Answers) {
    let answered: Vec<&RobotId> =
        robots.iter().filter(|robot| answers.contains_key(*robot)).collect();
    match store.reports().generations(&answered).await {
        Ok(generations) => {
            for (robot, generation) in generations {
                if let Some(answer) = answers.get_mut(&robot) {
                    answer.reply.generation = generation;
                }
            }
        }
        Err(error) => error.log("generations could not be read after a batch began"),
    }
}

/// Those of the deployments that may begin another batch.
async fn waiting_among(
    write: &mut ReportTransaction,
    cache: &mut RowCache,
    deployments: BTreeSet<DeploymentId>,
) -> Result<BTreeSet<DeploymentId>, StoreError> {
    let unknown: Vec<DeploymentId> =
        deployments.into_iter().filter(|deployment| cache.may_begin(deployment)).collect();
    let waiting = write.reports().waiting(&unknown).await?;
    cache.mark_at_rest(unknown.into_iter().filter(|deployment| !waiting.contains(deployment)));
    Ok(waiting)
}

/// Deployments with assignments in a new phase.
#[derive(Default)]
struct Moved {
    deployments: BTreeSet<DeploymentId>,
    /// Those of them in which an assignment has settled.
    settled: BTreeSet<DeploymentId>,
}

/// Stores the state of the robots' assignments after `news`.
async fn write_assignment_states(
    write: &mut ReportTransaction,
    cache: &mut RowCache,
    news: &[&Submission],
    now_ms: u64,
    fleet_events: &mut Vec<FleetEvent>,
) -> Result<Moved, StoreError> {
    let mut outcome = Moved::default();
    let (mut moved, mut progressed) = (Vec::new(), Vec::new());
    for Submission { report, .. } in news {
        let Some(known) = cache.get_mut(&report.robot_id) else { continue };
        for assignment in &mut known.open {
            let next = match task_of(report, assignment) {
                Some(task) => assignment.state.after(task),
                None => {
                    assignment.state.after_absence(assignment.removed, report.observed_generation)
                }
            };
            let Some(next) = next else { continue };
            let is_moved = next.phase != assignment.state.phase;
            let is_retry = next.attempts > assignment.state.attempts;
            assignment.state = next;
            if is_moved {
                outcome.deployments.insert(assignment.deployment.clone());
                if assignment.state.phase.is_settled(assignment.kind) {
                    outcome.settled.insert(assignment.deployment.clone());
                }
                fleet_events.extend(task_event(&known.robot, assignment));
            }
            if is_moved || is_retry {
                moved.push(assignment.clone());
            } else {
                progressed.push(assignment.clone());
            }
        }
        known.open.retain(|assignment| !assignment.state.phase.is_final());
    }
    write.reports().store_assignment_states(&moved, now_ms).await?;
    write.reports().store_progress(&progressed, now_ms).await?;
    Ok(outcome)
}

/// Stores the reports; for a report equal to the previous one, only its position.
async fn write_reports(
    write: &mut ReportTransaction,
    cache: &mut RowCache,
    news: &[&Submission],
    now_ms: u64,
) -> Result<(), StoreError> {
    let (mut whole, mut repeated) = (Vec::new(), Vec::new());
    for submission in news {
        let Some(known) = cache.get_mut(&submission.report.robot_id) else { continue };
        known.robot.last_report = position(&submission.report);
        if known.fingerprint.replace(submission.fingerprint) == Some(submission.fingerprint) {
            repeated.push(&submission.report);
        } else {
            whole.push(&submission.report);
        }
    }
    write.reports().store(&whole, now_ms).await?;
    write.reports().store_repeated(&repeated, now_ms).await
}

/// Conditions that are new in this report.
fn new_condition_events(cache: &mut RowCache, report: &Report) -> Vec<FleetEvent> {
    let news = cache.new_conditions(&report.robot_id, &report.conditions).into_iter();
    let text =
        |condition: &Condition| format!("{}: {}", condition.code.replace('_', " "), condition.text);
    news.map(|one| FleetEvent::Robot(report.robot_id.clone(), FeedKind::RobotCondition, text(one)))
        .collect()
}

/// The feed event of a failed phase, or of a phase that resolves a failure.
fn task_event(robot: &ReportedRobot, assignment: &OpenAssignment) -> Option<FleetEvent> {
    let OpenAssignment { deployment, state, .. } = assignment;
    matches!(state.phase, Phase::Failed | Phase::RolledBack | Phase::Running | Phase::Succeeded)
        .then(|| {
            FleetEvent::Task(Arc::new(TaskEvent {
                robot: robot.id.clone(),
                name: robot.name.clone(),
                deployment: deployment.clone(),
                phase: state.phase,
                failure: state.failure.clone(),
            }))
        })
}

fn task_of<'a>(report: &'a Report, assignment: &OpenAssignment) -> Option<&'a TaskReport> {
    report.tasks.iter().find(|task| task.deployment == assignment.deployment)
}
