//! The one writer of reports: a bounded queue, emptied in batches, each one write to the store. A caller's future resolves
//! when its report is stored. Of several reports of a robot in a batch only the last is written; the others are
//! acknowledged with it, since each is a whole snapshot.

use std::collections::{BTreeSet, HashMap};
use std::time::Duration;

use task_proto::api::ReportReply;
use task_proto::report::{Report, TaskReport};
use task_proto::{DeploymentId, RobotId};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;

use crate::advance::advance;
use crate::changes::{Changes, Consequences};
use crate::chooser::Chooser;
use crate::clock::Clock;
use crate::store::{OpenAssignment, ReportedRobot, Store, StoreError, Write};

/// Reports that may wait; beyond it callers wait for room.
const QUEUE: usize = 16 * 1024;
/// How long a caller waits for room.
const PATIENCE: Duration = Duration::from_secs(10);
/// The most reports of one batch.
const MAX_BATCH: usize = 2048;
/// How often a failing batch is tried.
const TRIES: u32 = 3;
/// The pause before the second try; it doubles.
const FIRST_PAUSE: Duration = Duration::from_millis(50);

/// Where reports are handed in. Clones feed the same writer.
#[derive(Debug, Clone)]
pub struct ReportWriter {
    queue: mpsc::Sender<Submission>,
}

/// Why a report was not stored. The robot keeps it and sends it again.
#[derive(Debug, Clone, thiserror::Error)]
pub enum ReportError {
    /// No such robot, or no longer.
    #[error("there is no robot {0}")]
    RobotNotFound(RobotId),
    /// Another token of the robot was used since the sender showed its own: it speaks for the robot no longer.
    #[error("robot {0} uses a newer token")]
    TokenEnded(RobotId),
    /// The queue stays full, or the server is stopping.
    #[error("reports can't be taken now")]
    Busy,
    /// The database did not take it.
    #[error("the report could not be stored")]
    NotStored,
}

#[derive(Debug)]
struct Submission {
    report: Report,
    token_number: u64,
    answer: oneshot::Sender<Result<ReportReply, ReportError>>,
}

impl ReportWriter {
    /// Starts the writer. The task ends, after all that was handed in, when the last clone is dropped.
    pub fn start(store: Store, clock: Clock, changes: Changes, chooser: Chooser) -> (Self, JoinHandle<()>) {
        let (queue, submissions) = mpsc::channel(QUEUE);
        (Self { queue }, tokio::spawn(write_all(submissions, store, clock, changes, chooser)))
    }

    /// Stores `report`, whose `robot_id` the caller has authenticated by the robot's token of this number. Resolves after
    /// the commit.
    pub async fn submit(&self, report: Report, token_number: u64) -> Result<ReportReply, ReportError> {
        let (answer, answered) = oneshot::channel();
        let submission = Submission { report, token_number, answer };
        self.queue.send_timeout(submission, PATIENCE).await.map_err(|_| ReportError::Busy)?;
        answered.await.map_err(|_| ReportError::Busy)?
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
    while submissions.recv_many(&mut batch, MAX_BATCH).await > 0 {
        let newest = newest_by_robot(&batch);
        let answers = match write_with_retries(&store, &chooser, &newest, &clock).await {
            Ok((answers, consequences)) => {
                changes.publish(consequences);
                newest.iter().for_each(|submission| changes.part_requests().hear(&submission.report));
                Ok(answers)
            }
            Err(error) => {
                tracing::error!(
                    error = &error as &dyn std::error::Error,
                    reports = batch.len(),
                    "reports were refused"
                );
                Err(ReportError::NotStored)
            }
        };
        for Submission { report, token_number, answer } in batch.drain(..) {
            let reply =
                answers.as_ref().map_err(Clone::clone).and_then(|answers| match answers.get(&report.robot_id) {
                    None => Err(ReportError::RobotNotFound(report.robot_id)),
                    Some(answer) if token_number < answer.token_number => Err(ReportError::TokenEnded(report.robot_id)),
                    Some(answer) => Ok(answer.reply.clone()),
                });
            // A caller that has gone away does not need to know.
            let _ = answer.send(reply);
        }
    }
}

/// The last report of each robot in a batch.
fn newest_by_robot(batch: &[Submission]) -> Vec<&Submission> {
    let mut newest: HashMap<&RobotId, &Submission> = HashMap::new();
    // An agent that came with a newer token may count its starts from 1 again.
    let position = |submission: &Submission| (submission.token_number, position(&submission.report));
    for submission in batch {
        let last = newest.entry(&submission.report.robot_id).or_insert(submission);
        if position(submission) > position(last) {
            *last = submission;
        }
    }
    newest.into_values().collect()
}

/// What orders the reports of one robot.
fn position(report: &Report) -> (u64, u64) {
    (report.start, report.seq)
}

/// What all that reported for a robot are answered, those by an ended token excepted.
struct Answer {
    reply: ReportReply,
    token_number: u64,
}

type Answers = HashMap<RobotId, Answer>;

async fn write_with_retries(
    store: &Store,
    chooser: &Chooser,
    reports: &[&Submission],
    clock: &Clock,
) -> Result<(Answers, Consequences), StoreError> {
    let mut pause = FIRST_PAUSE;
    for _ in 1..TRIES {
        match write_batch(store, chooser, reports, clock.now_ms()).await {
            Ok(written) => return Ok(written),
            Err(error) => tracing::warn!(
                error = &error as &dyn std::error::Error,
                reports = reports.len(),
                "reports are tried again"
            ),
        }
        tokio::time::sleep(pause).await;
        pause *= 2;
    }
    write_batch(store, chooser, reports, clock.now_ms()).await
}

/// Stores a batch and what follows from it, in one write.
async fn write_batch(
    store: &Store,
    chooser: &Chooser,
    reports: &[&Submission],
    now_ms: u64,
) -> Result<(Answers, Consequences), StoreError> {
    let mut write = store.begin().await?;
    let robots: Vec<RobotId> = reports.iter().map(|submission| submission.report.robot_id.clone()).collect();
    let mut known: HashMap<RobotId, ReportedRobot> =
        write.reported_robots(&robots).await?.into_iter().map(|robot| (robot.id.clone(), robot)).collect();
    // A report that is older than the stored one is acknowledged, so that it is not sent again, and ignored.
    let is_news = |submission: &&Submission| {
        known.get(&submission.report.robot_id).is_some_and(|robot| {
            submission.token_number >= robot.token_number && position(&submission.report) > robot.last_report
        })
    };
    let news: Vec<&Report> = reports.iter().copied().filter(is_news).map(|submission| &submission.report).collect();
    let mut consequences = Consequences::default();
    consequences.robots.extend(news.iter().map(|report| report.robot_id.clone()));
    let moved = write_standings(&mut write, &news, now_ms).await?;
    write.store_reports(&news, now_ms).await?;
    consequences.deployments.extend(moved.iter().cloned());
    advance(&mut write, chooser, moved, now_ms, &mut consequences).await?;
    // A batch that has just been released may have raised generations.
    let rung: Vec<RobotId> = consequences.rings.iter().filter(|robot| known.contains_key(*robot)).cloned().collect();
    known.extend(write.reported_robots(&rung).await?.into_iter().map(|robot| (robot.id.clone(), robot)));
    write.commit().await?;
    let answer = |robot: ReportedRobot| {
        let reply = ReportReply { generation: robot.generation, name: robot.name, labels: robot.labels };
        (robot.id, Answer { reply, token_number: robot.token_number })
    };
    Ok((known.into_values().map(answer).collect(), consequences))
}

/// Stores where the robots' assignments stand after `reports`. Returns the deployments of which some phase has changed.
async fn write_standings(
    write: &mut Write,
    reports: &[&Report],
    now_ms: u64,
) -> Result<BTreeSet<DeploymentId>, StoreError> {
    let by_robot: HashMap<&RobotId, &Report> = reports.iter().map(|report| (&report.robot_id, *report)).collect();
    let robots: Vec<RobotId> = by_robot.keys().map(|robot| (*robot).clone()).collect();
    let mut moved = BTreeSet::new();
    let mut changed = Vec::new();
    for mut assignment in write.open_assignments(&robots).await? {
        let Some(report) = by_robot.get(&assignment.robot) else { continue };
        let next = match task_of(report, &assignment) {
            Some(task) => assignment.standing.after(task),
            None => assignment.standing.after_absence(assignment.removed, report.observed_generation),
        };
        let Some(next) = next else { continue };
        if next.phase != assignment.standing.phase {
            moved.insert(assignment.deployment.clone());
        }
        assignment.standing = next;
        changed.push(assignment);
    }
    write.store_standings(&changed, now_ms).await?;
    Ok(moved)
}

fn task_of<'a>(report: &'a Report, assignment: &OpenAssignment) -> Option<&'a TaskReport> {
    report.tasks.iter().find(|task| task.deployment == assignment.deployment)
}
