//! Servers that write to one Postgres at the same time: orders meet a world that stands still, and
//! reports of different robots do not wait for each other.

use std::cell::RefCell;
use std::time::Duration;

use futures_util::future::join_all;
use proptest::prelude::*;
use task_proto::desired::TargetState;
use task_proto::messages::report::{Phase, TaskReport};
use task_proto::{Generation, RobotId};
use taskd::domain::deployment::AssignmentState;
use taskd::orders::actions::TaskOrder;
use taskd::orders::report_writer::{ReportError, ReportWriter};
use taskd::store::{ReportTransaction, Store};
use tokio::task::JoinHandle;
use tokio::time::timeout;

use crate::database::{postgres, postgres_of_two};
use crate::fleet::{Fleet, Robot, random_key};

/// Time limit that only a hanging test exceeds.
const PATIENCE: Duration = Duration::from_secs(30);
/// Robots of the comparison with a serial order.
const ROBOTS: usize = 2;

async fn begin_report(store: Store, robot: RobotId) -> ReportTransaction {
    store.begin_report(&[&robot].into()).await.expect("begins")
}

async fn done<T>(task: JoinHandle<T>) -> T {
    timeout(PATIENCE, task).await.expect("it ends").expect("no panic")
}

#[tokio::test(flavor = "multi_thread")]
async fn order_waits_only_for_the_reports_under_way() {
    let fleet = Fleet::new(postgres().await).await;
    let robots = fleet.enroll(2).await;
    let (one, other) = (robots[0].id.clone(), robots[1].id.clone());
    let stores = [(); 3].map(|()| fleet.database.another_store());
    let [a, b, c] = <[Store; 3]>::try_from(join_all(stores).await).expect("three");
    let under_way = begin_report(a, one.clone()).await;
    // Reports of another robot do not wait.
    let beside = begin_report(b.clone(), other.clone());
    timeout(PATIENCE, beside).await.expect("at once").commit().await.expect("written");
    let order = tokio::spawn(async move { b.begin().await.expect("begins") });
    fleet.database.sessions_wait_for_locks(1).await;
    let late = tokio::spawn(begin_report(c, other));
    fleet.database.sessions_wait_for_locks(2).await;
    under_way.commit().await.expect("written");
    let order = done(order).await;
    fleet.database.sessions_wait_for_locks(1).await;
    assert!(!late.is_finished(), "it waits for the order");
    let sequence = order.sequence();
    order.commit().await.expect("written");
    assert_eq!(done(late).await.last_order(), sequence);
}

#[tokio::test(flavor = "multi_thread")]
async fn reports_of_one_robot_wait_for_each_other() {
    let fleet = Fleet::new(postgres().await).await;
    let mut robots = fleet.enroll(1).await;
    let held = begin_report(fleet.database.another_store().await, robots[0].id.clone()).await;
    let (writer, report) = (fleet.writer.clone(), robots[0].next_report());
    let stored = tokio::spawn(async move { writer.submit(report, 0).await });
    fleet.database.sessions_wait_for_locks(1).await;
    held.commit().await.expect("written");
    done(stored).await.expect("stored");
}

/// A server remembers a robot's assignments, and reads them again where the robot has reported to
/// the other server.
#[tokio::test(flavor = "multi_thread")]
async fn report_to_another_server_is_not_overwritten() {
    let fleet = Fleet::new(postgres_of_two().await).await;
    let mut robots = fleet.enroll(1).await;
    let id = fleet.deploy("1", |_| ()).await;
    let desired = fleet.desired(&robots[0]).await.expect("state");
    for (server, phase) in [(0, Phase::Fetching), (1, Phase::Failed), (0, Phase::Running)] {
        robots[0].accept(&desired, phase);
        let report = robots[0].next_report();
        fleet.writer.of(server).submit(report, 0).await.expect("stored");
    }
    assert_eq!(fleet.phases(&id).await, [Phase::Failed], "no report leaves a final phase");
}

#[tokio::test(flavor = "multi_thread")]
async fn report_that_settles_a_batch_releases_the_next_once() {
    let fleet = Fleet::new(postgres_of_two().await).await;
    let mut robots = fleet.enroll(6).await;
    let id = fleet.deploy("1", |order| order.batch = Some(2)).await;
    // Both reports are under way before either is stored.
    let elsewhere = fleet.database.another_store().await;
    let both = [&robots[0].id, &robots[1].id].into();
    let held = elsewhere.begin_report(&both).await.expect("begins");
    let mut submitted = Vec::new();
    for (server, robot) in robots.iter_mut().take(2).enumerate() {
        let desired = fleet.desired(robot).await.expect("state");
        robot.accept(&desired, Phase::Running);
        let (writer, report) = (fleet.writer.of(server).clone(), robot.next_report());
        submitted.push(tokio::spawn(async move { writer.submit(report, 0).await }));
    }
    fleet.database.sessions_wait_for_locks(2).await;
    drop(held);
    for submitted in submitted {
        done(submitted).await.expect("stored");
    }
    let view = fleet.deployment(&id).await;
    let released = view.assignments.iter().flatten().map(|one| one.released).collect::<Vec<_>>();
    assert_eq!(released, [true, true, true, true, false, false]);
}

#[tokio::test(flavor = "multi_thread")]
async fn batch_lost_with_its_server_begins_at_the_next_check() {
    let fleet = Fleet::new(postgres().await).await;
    let mut robots = fleet.enroll(2).await;
    fleet.deploy("1", |order| order.batch = Some(1)).await;
    let desired = fleet.desired(&robots[0]).await.expect("state");
    let elsewhere = fleet.database.another_store().await;
    let held = elsewhere.begin_report(&[].into()).await.expect("begins");
    let (writer, server) = ReportWriter::start(
        fleet.database.another_store().await,
        fleet.clock.clone(),
        fleet.changes.clone(),
        fleet.planner.clone(),
    );
    robots[0].accept(&desired, Phase::Running);
    let report = robots[0].next_report();
    let submitted = tokio::spawn(async move { writer.submit(report, 0).await });
    // The report is stored, and the second write waits.
    fleet.database.sessions_wait_for_locks(1).await;
    server.abort();
    assert!(matches!(done(submitted).await, Err(ReportError::Busy)));
    drop(held);
    assert_eq!(fleet.view(&robots[0]).await.tasks[0].phase, Phase::Running);
    assert!(fleet.desired(&robots[1]).await.expect("state").tasks.is_empty());
    fleet.deployments.advance_rollouts().await.expect("advanced");
    assert_eq!(fleet.desired(&robots[1]).await.expect("state").tasks.len(), 1);
}

/// A call to one of the servers.
#[derive(Debug, Clone, Copy)]
enum Call {
    /// A robot's report on its run, or on the run that a concurrent order may begin.
    Report { robot: usize, phase: Phase, is_of_next_run: bool },
    /// An order for all robots.
    Order(TaskOrder),
}

/// A call with its answer.
#[derive(Debug, Clone)]
enum Answered {
    Report { robot: usize, position: (u64, u64), task: Box<TaskReport>, reply: Generation },
    Order(TaskOrder),
}

/// A robot and its assignment as they should be stored.
#[derive(Debug, Clone, PartialEq)]
struct Stored {
    generation: Generation,
    last_report: (u64, u64),
    wanted: TargetState,
    state: AssignmentState,
}

impl Stored {
    fn order(&mut self, order: TaskOrder) {
        let is_restarted = match order {
            TaskOrder::Restart => true,
            TaskOrder::Start => self.wanted == TargetState::Stopped || self.state.phase.is_final(),
            TaskOrder::Stop | TaskOrder::Remove => false,
        };
        if is_restarted {
            (self.wanted, self.state) = (TargetState::Running, assigned(self.state.run + 1));
        } else if order == TaskOrder::Stop && self.wanted == TargetState::Running {
            self.wanted = TargetState::Stopped;
        } else {
            return;
        }
        self.generation.0 += 1;
    }

    fn report(&mut self, position: (u64, u64), task: &TaskReport) {
        if position > self.last_report {
            self.last_report = position;
            self.state = self.state.after(task).unwrap_or_else(|| self.state.clone());
        }
    }

    /// The columns that a robot's view shows.
    fn shown(&self) -> (Generation, (u64, u64), TargetState, u64, Phase) {
        (self.generation, self.last_report, self.wanted, self.state.run, self.state.phase)
    }
}

fn assigned(run: u64) -> AssignmentState {
    AssignmentState { run, phase: Phase::Assigned, progress: None, failure: None, attempts: 0 }
}

/// The state after the calls in some order in which each has the answer that it got, if that state
/// is shown like `end`.
fn in_some_order(
    before: &[Stored; ROBOTS],
    calls: &[Answered],
    end: &impl Fn(&[Stored; ROBOTS]) -> bool,
) -> Option<[Stored; ROBOTS]> {
    if calls.is_empty() {
        return end(before).then(|| before.clone());
    }
    (0..calls.len()).find_map(|first| {
        let (mut after, mut rest) = (before.clone(), calls.to_vec());
        match rest.remove(first) {
            Answered::Order(order) => after.iter_mut().for_each(|robot| robot.order(order)),
            Answered::Report { robot, position, task, reply } => {
                after[robot].report(position, &task);
                if after[robot].generation != reply {
                    return None;
                }
            }
        }
        in_some_order(&after, &rest, end)
    })
}

/// Two servers with some robots, and the robots as the calls so far have left them.
struct Compared {
    fleet: Fleet,
    robots: [Robot; ROBOTS],
    stored: [Stored; ROBOTS],
}

impl Compared {
    async fn new() -> Self {
        let fleet = Fleet::new(postgres_of_two().await).await;
        let robots = fleet.enroll(ROBOTS as u32).await;
        let mut robots: [Robot; ROBOTS] = robots.try_into().ok().expect("as many");
        fleet.deploy("1", |_| ()).await;
        for robot in &mut robots {
            let desired = fleet.desired(robot).await.expect("state");
            robot.accept(&desired, Phase::Assigned);
            robot.observed = Generation(0);
        }
        let stored = Stored {
            generation: Generation(1),
            last_report: (0, 0),
            wanted: TargetState::Running,
            state: assigned(1),
        };
        Self { fleet, robots, stored: [stored.clone(), stored] }
    }

    /// Makes the calls at the same time, each to its server.
    async fn make(&mut self, calls: &[(usize, Call)]) -> Vec<Answered> {
        let Self { fleet, robots, stored } = self;
        let mut answers: Vec<futures_util::future::BoxFuture<'_, Answered>> = Vec::new();
        for &(server, call) in calls {
            match call {
                Call::Report { robot, phase, is_of_next_run } => {
                    let task = robots[robot].tasks.get_mut("talker").expect("deployed");
                    task.phase = phase;
                    task.run = stored[robot].state.run + u64::from(is_of_next_run);
                    let (task, report) = (Box::new(task.clone()), robots[robot].next_report());
                    let (position, writer) = ((report.start, report.seq), fleet.writer.of(server));
                    answers.push(Box::pin(async move {
                        let reply = writer.submit(report, 0).await.expect("stored").generation;
                        Answered::Report { robot, position, task, reply }
                    }));
                }
                Call::Order(order) => {
                    let (by, actions) = (&fleet.operator, fleet.actions.of(server));
                    answers.push(Box::pin(async move {
                        let (task, everyone) =
                            ("talker".parse().expect("valid"), "*".parse().expect("valid"));
                        let key = random_key();
                        let ordered =
                            actions.deployments.order_task(by, &key, order, &task, &everyone).await;
                        ordered.expect("ordered");
                        Answered::Order(order)
                    }));
                }
            }
        }
        join_all(answers).await
    }

    /// Whether the calls, made at the same time, leave the database as one after the other would.
    async fn equals_a_serial_order(
        &mut self,
        calls: &[(usize, Call)],
    ) -> Result<(), TestCaseError> {
        let answered = self.make(calls).await;
        let ids = self.robots.each_ref().map(|robot| &robot.id);
        let read = self.fleet.database.store.begin_report(&ids.into()).await.expect("begins");
        let mut shown = Vec::new();
        for robot in &self.robots {
            let view = self.fleet.view(robot).await;
            let reported = read.robots().iter().find(|one| one.id == robot.id).expect("there");
            let task = &view.tasks[0];
            shown.push((view.generation, reported.last_report, task.wanted, task.run, task.phase));
        }
        let end = |after: &[Stored; ROBOTS]| after.each_ref().map(Stored::shown) == shown[..];
        let Some(after) = in_some_order(&self.stored, &answered, &end) else {
            let before = &self.stored;
            return Err(TestCaseError::fail(format!("{before:#?}\n{answered:#?}\n{shown:#?}")));
        };
        self.stored = after;
        Ok(())
    }
}

fn arbitrary_call() -> impl Strategy<Value = Call> {
    let phase = proptest::sample::select(vec![Phase::Fetching, Phase::Running, Phase::Failed]);
    let report = (0..ROBOTS, phase, any::<bool>())
        .prop_map(|(robot, phase, is_of_next_run)| Call::Report { robot, phase, is_of_next_run });
    let orders = vec![TaskOrder::Start, TaskOrder::Restart, TaskOrder::Stop];
    prop_oneof![3 => report, 1 => proptest::sample::select(orders).prop_map(Call::Order)]
}

#[test]
fn reports_and_orders_of_two_servers_equal_a_serial_order() {
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let compared = RefCell::new(runtime.block_on(Compared::new()));
    // Each case goes on from the one before, so a failing one can't be made smaller.
    let config = ProptestConfig {
        cases: 100,
        max_shrink_iters: 0,
        failure_persistence: None,
        ..ProptestConfig::default()
    };
    proptest!(config, |(calls in proptest::collection::vec((0..2usize, arbitrary_call()), 2..6))| {
        runtime.block_on(compared.borrow_mut().equals_a_serial_order(&calls))?;
    });
}
