//! Orders that follow from earlier ones, told on every database: restarting a task, retrying
//! failures, and rolling back.

use std::collections::BTreeSet;

use task_proto::api::{PackageView, RetryDeployment};
use task_proto::desired::DesiredTask;
use task_proto::ids::selector::Selector;
use task_proto::messages::report::{ActiveVersion, Failure, FailureCode, Phase};
use task_proto::packages::manifest::TaskKind;
use task_proto::packages::oci::MANIFEST_TYPE;
use task_proto::{DeploymentId, Digest, RepositoryName, TaskName};
use taskd::domain::person::Person;
use taskd::orders::actions::{DeploymentError, Rollback, SelectedRobot, TaskOrder};
use taskd::store::{NewManifest, PutManifest, Reference, StoredManifest};

use crate::database::{TestDatabase, on_both_databases};
use crate::fleet::{Fleet, Robot, package, random_key};
use crate::story::code;

on_both_databases! {
    running_package_is_not_started_again,
    package_restored_after_a_failure_is_not_started_again,
    restart_begins_a_new_run_on_all_robots_with_the_task,
    retry_orders_failed_robots_without_a_later_order,
    retry_of_some_robots_keeps_the_options_of_the_order,
    rollback_restores_the_previous_package,
    rollback_skips_packages_that_never_ran_or_were_deleted,
    retry_and_rollback_stay_in_the_scope,
    robot_may_fetch_the_package_that_it_goes_back_to,
}

fn task() -> TaskName {
    "talker".parse().expect("a name")
}

fn selector(text: &str) -> Selector {
    text.parse().expect("a selector")
}

impl Fleet {
    /// Makes a version one that can be ordered again.
    pub async fn publish(&self, version: &str) -> PackageView {
        let view = package(version, TaskKind::Service);
        let manifest = &view.package.manifest;
        let new = NewManifest {
            manifest: StoredManifest {
                digest: manifest.digest,
                size: manifest.size,
                media_type: MANIFEST_TYPE.to_owned(),
            },
            artifact_type: None,
            annotations: Default::default(),
            subject: None,
            parts: Vec::new(),
            tags: vec![version.parse().expect("a tag")],
            takes_version: false,
            package: Some((view.package.clone(), view.manifest.clone())),
            output: None,
            document: None,
        };
        let repository = RepositoryName::of_package(&task());
        let put =
            self.database.store.manifests().put(&repository, &new, None, self.clock.now_ms()).await;
        assert_eq!(put.expect("writes"), PutManifest::Stored);
        view
    }

    /// Deletes the version even if robots have it.
    pub async fn unpublish(&self, version: &str) {
        let digest = package(version, TaskKind::Service).package.manifest.digest;
        self.database.drop_package(task().as_str(), &digest).await;
    }

    async fn fail(&self, robot: &mut Robot, code: FailureCode) {
        let desired = self.desired(robot).await.expect("not withheld");
        robot.accept(&desired, Phase::Failed);
        for task in robot.tasks.values_mut() {
            task.failure = Some(Failure::new(code.clone(), "it did not work"));
        }
        self.report(robot).await;
    }

    async fn retry(
        &self,
        by: &Person,
        id: &DeploymentId,
        retry: &RetryDeployment,
    ) -> Result<DeploymentId, DeploymentError> {
        self.deployments.retry(by, &random_key(), id, retry).await
    }

    async fn rollback(&self, robots: &str) -> Result<Rollback, DeploymentError> {
        self.deployments.rollback(&self.operator, &random_key(), &task(), &selector(robots)).await
    }

    pub async fn version(&self, robot: &Robot) -> String {
        self.desired(robot).await.expect("not withheld").tasks[0].package.version.to_string()
    }
}

fn names(robots: &[SelectedRobot]) -> Vec<&str> {
    robots.iter().map(|robot| robot.name.as_str()).collect()
}

async fn running_package_is_not_started_again(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(4).await;
    let first = fleet.deploy("1", |order| order.selector = selector("!r3")).await;
    fleet.follow(&mut robots[0], Phase::Running).await;
    fleet.follow(&mut robots[1], Phase::Failed).await;
    fleet.follow(&mut robots[2], Phase::Running).await;
    let (key, third, task) = (random_key(), selector("r2"), task());
    fleet
        .deployments
        .order_task(&fleet.operator, &key, TaskOrder::Stop, &task, &third)
        .await
        .expect("ordered");
    fleet.follow(&mut robots[2], Phase::Stopped).await;
    fleet.changes.take_robots_to_notify().await;
    let before = fleet.desired(&robots[0]).await.expect("state");
    // The task failed on one robot, was stopped on one, and never reached one: the retry begins
    // there.
    let again = fleet.deploy("1", |order| order.batch = Some(3)).await;
    assert_eq!(
        fleet.phases(&again).await,
        [Phase::Running, Phase::Assigned, Phase::Assigned, Phase::Assigned]
    );
    assert_eq!(
        fleet.desired(&robots[0]).await.expect("state"),
        before,
        "the robot hears of nothing"
    );
    assert_eq!(before.tasks[0].deployment, first);
    assert_eq!(fleet.changes.take_robots_to_notify().await.robots.len(), 3);
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    assert_eq!(fleet.deployment(&again).await.state, task_proto::api::DeploymentState::Settled);
    // Where the task runs everywhere, all is settled at once, and nothing is left to cancel.
    let third = fleet.deploy("1", |_| ()).await;
    assert_eq!(fleet.deployment(&third).await.state, task_proto::api::DeploymentState::Settled);
    assert_eq!(code(fleet.deployments.cancel(&fleet.operator, &third).await), "nothing_to_cancel");
    // A restart can be forced, and another version is another matter.
    let forced = fleet.deploy("1", |order| order.restart = true).await;
    assert_eq!(fleet.phases(&forced).await, [Phase::Assigned; 4]);
    for robot in &mut robots {
        assert_eq!(fleet.desired(robot).await.expect("state").tasks[0].deployment, forced);
        fleet.follow(robot, Phase::Running).await;
    }
    let newer = fleet.deploy("2", |_| ()).await;
    assert_eq!(fleet.phases(&newer).await, [Phase::Assigned; 4]);
    // A job runs once for each order.
    let job = package("7", TaskKind::Job);
    let order = crate::fleet::order_of(&job);
    for _ in 0..2 {
        let id = fleet
            .deployments
            .create(&fleet.operator, &random_key(), &order, &job)
            .await
            .expect("ordered");
        assert_eq!(fleet.desired(&robots[0]).await.expect("state").tasks[0].deployment, id);
        fleet.follow(&mut robots[0], Phase::Running).await;
    }
}

/// The report of a live process that `deployment` brought.
fn active(deployment: &DeploymentId, version: &str) -> Option<ActiveVersion> {
    let manifest = Some(package(version, TaskKind::Service).package.manifest.digest);
    Some(ActiveVersion {
        deployment: deployment.clone(),
        version: version.parse().expect("valid"),
        manifest,
        pid: 7,
    })
}

async fn package_restored_after_a_failure_is_not_started_again(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.publish("1").await;
    let mut robots = fleet.enroll(4).await;
    let first = fleet.deploy("1", |_| ()).await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    let failed = fleet.deploy("2", |_| ()).await;
    // The second robot could not fetch the new version, the third one runs nothing, and the last
    // one still fetches.
    let ends = [Phase::RolledBack, Phase::Failed, Phase::Failed, Phase::Fetching];
    for ((number, robot), phase) in robots.iter_mut().enumerate().zip(ends) {
        robot.accept(&fleet.desired(robot).await.expect("not withheld"), phase);
        for task in robot.tasks.values_mut() {
            task.active = active(&first, "1").filter(|_| number != 2);
        }
        fleet.report(robot).await;
    }
    fleet.changes.take_robots_to_notify().await;
    let back = fleet.rollback("*").await.expect("ordered").deployments.remove(0);
    assert_eq!(
        fleet.changes.take_robots_to_notify().await.robots.len(),
        4,
        "the state of each is new"
    );
    assert_eq!(
        fleet.phases(&back).await,
        [Phase::Running, Phase::Running, Phase::Assigned, Phase::Assigned]
    );
    let run =
        |task: &DesiredTask| (task.deployment.clone(), task.run, task.package.version.to_string());
    for (robot, deployment) in robots.iter().zip([&first, &first, &back, &back]) {
        let desired = fleet.desired(robot).await.expect("state");
        assert_eq!(
            desired.tasks.iter().map(run).collect::<Vec<_>>(),
            [(deployment.clone(), 1, "1".to_owned())]
        );
    }
    assert_eq!(
        fleet.phases(&failed).await,
        [Phase::RolledBack, Phase::Failed, Phase::Failed, Phase::Superseded]
    );
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    assert_eq!(fleet.phases(&first).await[..2], [Phase::Running; 2]);
    assert_eq!(fleet.deployment(&back).await.state, task_proto::api::DeploymentState::Settled);
    // After another failure the task can still be started anew.
    fleet.deploy("3", |_| ()).await;
    for robot in &mut robots {
        robot.accept(&fleet.desired(robot).await.expect("not withheld"), Phase::RolledBack);
        for task in robot.tasks.values_mut() {
            task.active = active(&first, "1");
        }
        fleet.report(robot).await;
    }
    let forced = fleet.deploy("1", |order| order.restart = true).await;
    for robot in &robots {
        assert_eq!(fleet.desired(robot).await.expect("state").tasks[0].deployment, forced);
    }
}

async fn restart_begins_a_new_run_on_all_robots_with_the_task(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(3).await;
    let id = fleet.deploy("1", |order| order.selector = selector("!r2")).await;
    fleet.follow(&mut robots[0], Phase::Running).await;
    fleet.follow(&mut robots[1], Phase::Failed).await;
    fleet.changes.take_robots_to_notify().await;
    let (key, all, task) = (random_key(), selector("*"), task());
    let restart =
        || fleet.deployments.order_task(&fleet.operator, &key, TaskOrder::Restart, &task, &all);
    assert_eq!(names(&restart().await.expect("ordered")), ["r0", "r1"]);
    assert_eq!(names(&restart().await.expect("the same answer")), ["r0", "r1"]);
    assert_eq!(fleet.changes.take_robots_to_notify().await.robots.len(), 2);
    assert_eq!(fleet.phases(&id).await, [Phase::Assigned, Phase::Assigned]);
    for robot in &mut robots[..2] {
        assert_eq!(fleet.desired(robot).await.expect("state").tasks[0].run, 2);
        fleet.follow(robot, Phase::Running).await;
    }
    assert_eq!(fleet.phases(&id).await, [Phase::Running, Phase::Running]);
}

async fn retry_orders_failed_robots_without_a_later_order(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.publish("1").await;
    let mut robots = fleet.enroll(7).await;
    let id = fleet.deploy("1", |_| ()).await;
    fleet.follow(&mut robots[0], Phase::Running).await;
    for (robot, phase) in [(1, Phase::Failed), (2, Phase::RolledBack), (3, Phase::Unmet)] {
        fleet.follow(&mut robots[robot], phase).await;
    }
    for robot in &mut robots[4..] {
        fleet.follow(robot, Phase::Failed).await;
    }
    // The last failures have already been handled.
    fleet.deploy("2", |order| order.selector = selector("r4")).await;
    for (order, robot) in [(TaskOrder::Stop, "r5"), (TaskOrder::Remove, "r6")] {
        let ordered = fleet
            .deployments
            .order_task(&fleet.operator, &random_key(), order, &task(), &selector(robot))
            .await;
        ordered.expect("ordered");
    }
    let retry = RetryDeployment::default();
    let meant = fleet
        .deployments
        .preview_retry(&fleet.operator, &id, &retry)
        .await
        .expect("there are some");
    assert_eq!(names(&meant), ["r1", "r2", "r3"]);
    assert_eq!(fleet.deployments().await.len(), 2, "a dry run orders nothing");
    let key = random_key();
    let ordered = || fleet.deployments.retry(&fleet.operator, &key, &id, &retry);
    let new = ordered().await.expect("ordered");
    assert_eq!(ordered().await.expect("the same"), new);
    assert_eq!(fleet.phases(&new).await, [Phase::Assigned; 3]);
    assert_eq!(fleet.deployment(&new).await.package, fleet.deployment(&id).await.package);
    assert_eq!(code(fleet.retry(&fleet.operator, &id, &retry).await), "nothing_to_retry");
    let other =
        RetryDeployment { code: Some(FailureCode::DISK_FULL), ..RetryDeployment::default() };
    let reused = fleet.deployments.retry(&fleet.operator, &key, &id, &other).await;
    assert_eq!(code(reused), "idempotency_key_reused");
    // An expired or cancelled deployment can be retried as well, but not once its package is gone.
    fleet.deployments.cancel(&fleet.operator, &new).await.expect("cancelled");
    fleet.unpublish("1").await;
    assert_eq!(code(fleet.retry(&fleet.operator, &new, &retry).await), "package_not_found");
    fleet.publish("1").await;
    let third = fleet.retry(&fleet.operator, &new, &retry).await.expect("ordered");
    assert_eq!(fleet.phases(&third).await.len(), 3);
    assert_eq!(
        code(fleet.retry(&fleet.operator, &DeploymentId::random(), &retry).await),
        "not_found"
    );
}

async fn retry_of_some_robots_keeps_the_options_of_the_order(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.publish("1").await;
    let mut robots = fleet.enroll(4).await;
    let id = fleet
        .deploy("1", |order| {
            order.priority = 7;
            order.max_failures = Some(3);
            order.batch = Some(4);
            order.expires_in_s = Some(600);
            order.delivery = task_proto::api::DeliveryChoice::PushPull;
        })
        .await;
    for (robot, code) in robots.iter_mut().zip([
        FailureCode::DISK_FULL,
        FailureCode::BUILD_FAILED,
        FailureCode::DISK_FULL,
        FailureCode::DISK_FULL,
    ]) {
        fleet.fail(robot, code).await;
    }
    let retry = RetryDeployment {
        selector: Some(selector("!r3")),
        code: Some(FailureCode::DISK_FULL),
        ..RetryDeployment::default()
    };
    let new = fleet.retry(&fleet.operator, &id, &retry).await.expect("ordered");
    let view = fleet.deployment(&new).await;
    let robots: Vec<_> =
        view.assignments.as_ref().expect("there").iter().map(|one| one.name.as_str()).collect();
    assert_eq!(robots, ["r0", "r2"]);
    let ways = (
        view.priority,
        view.max_failures,
        view.batch,
        view.delivery,
        view.selector.expect("whole").to_string(),
    );
    let delivery = task_proto::api::DeliveryChoice::PushPull;
    assert_eq!(ways, (7, Some(3), Some(4), delivery, "!r3".to_owned()));
    assert_eq!(view.expires_at_ms - view.created_at_ms, 600_000);
}

async fn rollback_restores_the_previous_package(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    for version in ["1", "2", "3"] {
        fleet.publish(version).await;
    }
    let mut robots = fleet.enroll(4).await;
    fleet.deploy("1", |order| order.selector = selector("r0,r1")).await;
    fleet.deploy("2", |order| order.selector = selector("r2")).await;
    for robot in &mut robots[..3] {
        fleet.follow(robot, Phase::Running).await;
    }
    fleet.deploy("3", |_| ()).await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    let planned = fleet
        .deployments
        .preview_rollback(&fleet.operator, &task(), &selector("*"))
        .await
        .expect("reads");
    assert_eq!(
        (names(&planned.robots), names(&planned.without)),
        (vec!["r0", "r1", "r2"], vec!["r3"])
    );
    assert_eq!((planned.deployments.len(), fleet.deployments().await.len()), (0, 3));
    fleet.changes.take_robots_to_notify().await;
    let key = random_key();
    let order = || async {
        let all = selector("*");
        fleet.deployments.rollback(&fleet.operator, &key, &task(), &all).await.expect("ordered")
    };
    let done = order().await;
    assert_eq!(order().await, done, "the same key orders once");
    assert_eq!(
        (&done.robots, &done.without, done.deployments.len()),
        (&planned.robots, &planned.without, 2)
    );
    assert_eq!(fleet.changes.take_robots_to_notify().await.robots.len(), 3);
    for (robot, version) in robots.iter().zip(["1", "1", "2", "3"]) {
        assert_eq!(fleet.version(robot).await, version);
    }
    // Pages cut between deployments of one write lose none of them.
    let mut paged = Vec::new();
    let mut before = None;
    loop {
        let page = fleet
            .database
            .store
            .deployments()
            .page(None, before.as_ref(), 1)
            .await
            .expect("reads")
            .expect("there");
        paged.extend(page.deployments.into_iter().map(|view| view.id));
        before = page.next;
        if before.is_none() {
            break;
        }
    }
    assert_eq!(paged.len(), 5);
    assert!(done.deployments.iter().all(|id| paged.contains(id)));
    // Once more is back again: the newest other package that ran is the one that was left.
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    fleet.rollback("r0").await.expect("ordered");
    assert_eq!(fleet.version(&robots[0]).await, "3");
    let nobody = fleet.rollback("r3").await;
    assert_eq!(code(nobody), "nothing_to_roll_back");
    let unknown = fleet
        .deployments
        .preview_rollback(&fleet.operator, &"walker".parse().expect("a name"), &selector("*"))
        .await;
    assert_eq!(code(unknown), "no_robots_match");
}

async fn rollback_skips_packages_that_never_ran_or_were_deleted(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    for version in ["1", "2", "3", "4", "5"] {
        fleet.publish(version).await;
    }
    let mut robots = fleet.enroll(1).await;
    let runs = [
        ("1", Phase::Running),
        ("2", Phase::Succeeded),
        ("3", Phase::Failed),
        ("4", Phase::Running),
    ];
    for (version, phase) in runs {
        fleet.deploy(version, |_| ()).await;
        fleet.follow(&mut robots[0], phase).await;
    }
    // The same package once more is no rollback target, nor is a deployment that has not begun yet.
    fleet.deploy("5", |_| ()).await;
    fleet.deploy("4", |_| ()).await;
    fleet.follow(&mut robots[0], Phase::Failed).await;
    fleet.rollback("*").await.expect("ordered");
    assert_eq!(fleet.version(&robots[0]).await, "2");
    fleet
        .deployments
        .cancel(&fleet.operator, &fleet.deployments().await[0].id)
        .await
        .expect("cancelled");
    fleet.unpublish("2").await;
    fleet.rollback("*").await.expect("ordered");
    assert_eq!(fleet.version(&robots[0]).await, "1");
    let found = fleet
        .database
        .store
        .packages()
        .find(&task(), &Reference::Tag("1".parse().expect("a tag")))
        .await;
    assert_eq!(
        found.expect("reads").map(|view| view.package),
        Some(package("1", TaskKind::Service).package)
    );
}

async fn retry_and_rollback_stay_in_the_scope(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    for version in ["1", "2"] {
        fleet.publish(version).await;
    }
    let mut robots = fleet.enroll(2).await;
    let one = fleet.deploy("1", |_| ()).await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    let two = fleet.deploy("2", |_| ()).await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Failed).await;
    }
    let (alice, carol) = (fleet.limited("alice", "r0").await, fleet.limited("carol", "r7").await);
    let all = RetryDeployment::default();
    assert_eq!(code(fleet.retry(&alice, &two, &all).await), "out_of_scope");
    assert_eq!(code(fleet.retry(&carol, &one, &all).await), "out_of_scope");
    let back = fleet.deployments.rollback(&alice, &random_key(), &task(), &selector("*")).await;
    assert_eq!(code(back), "out_of_scope");
    let own = RetryDeployment { selector: Some(selector("r0")), ..RetryDeployment::default() };
    let new = fleet.retry(&alice, &two, &own).await.expect("hers");
    assert_eq!(fleet.phases(&new).await.len(), 1);
    let back = fleet
        .deployments
        .rollback(&alice, &random_key(), &task(), &selector("r0"))
        .await
        .expect("hers");
    assert_eq!(names(&back.robots), ["r0"]);
    assert_eq!(fleet.version(&robots[1]).await, "2");
}

/// A robot whose files were changed on its disk fetches them again, also those of an older package
/// than ordered.
async fn robot_may_fetch_the_package_that_it_goes_back_to(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(2).await;
    let ids = [0, 1].map(|robot: usize| robots[robot].id.clone());
    let may = async |robot: usize, digest: Digest| {
        let grant = fleet.database.store.robots().fetch_grant(&ids[robot], &digest).await;
        grant.expect("reads").is_some()
    };
    let content = |version| package(version, TaskKind::Service).package.content.digest;
    for (version, phase) in [
        ("1", Phase::Running),
        ("2", Phase::Running),
        ("3", Phase::RolledBack),
        ("4", Phase::Failed),
    ] {
        fleet.deploy(version, |order| order.selector = selector("r0")).await;
        fleet.follow(&mut robots[0], phase).await;
    }
    fleet.deploy("4", |order| order.selector = selector("r1")).await;
    assert!(may(0, content("4")).await && may(1, content("4")).await, "it is ordered");
    assert!(may(0, content("2")).await, "it ran before the orders that failed");
    let kept = fleet.database.store.deployments().packages_in_use().await.expect("reads");
    let kept: BTreeSet<_> = kept.iter().map(|package| package.version.as_str()).collect();
    assert_eq!(kept, BTreeSet::from(["2", "3", "4"]), "the collector keeps them");
    assert!(!may(1, content("2")).await, "it never was on this robot");
    assert!(!may(0, content("1")).await, "a later package ran since");
    fleet.deploy("5", |order| order.selector = selector("r0")).await;
    fleet.follow(&mut robots[0], Phase::Running).await;
    // The answer about the content is cached for some seconds.
    let config = package("2", TaskKind::Service).package.config.digest;
    assert!(!may(0, config).await, "a later package ran since");
}
