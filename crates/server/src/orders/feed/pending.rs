//! Events that the feed has not reported yet. A few events of one kind are reported one by one,
//! many together.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::Arc;

use task_proto::api::{DeploymentState, FeedKind};
use task_proto::messages::report::Phase;
use task_proto::telemetry::log::LogLevel;
use task_proto::{DeploymentId, RobotId};

use crate::domain::fleet_event::{FleetEvent, TaskEvent};
use crate::store::{DeploymentRow, FeedAudience, KnownRobot, NewFeedEntry, Store, StoreError};

/// More entries of one kind than this are combined into one.
const MAX_SEPARATE: usize = 5;
/// Presence changes are reported after `QUIET_TICKS` ticks without a change, and after
/// `MAX_TICKS` ticks at the latest.
const QUIET_TICKS: u32 = 3;
const MAX_TICKS: u32 = 60;
/// Failed tasks and unsettled deployments remembered; above this limit all are forgotten, and their
/// ends are not reported.
const MAX_REMEMBERED: usize = 10_000;
/// A deployment older than this when first seen is not new.
const NEW_MS: u64 = 60_000;

#[derive(Default)]
pub(super) struct Pending {
    /// The first and the last state of each robot: a robot that is back in its first state is no
    /// news.
    presence: HashMap<RobotId, (bool, bool)>,
    quiet_ticks: u32,
    presence_ticks: u32,
    tasks: Vec<Arc<TaskEvent>>,
    robots: HashMap<FeedKind, HashMap<RobotId, Vec<String>>>,
    removed: Vec<KnownRobot>,
    deployments: BTreeSet<DeploymentId>,
    /// The last known state of each deployment.
    states: HashMap<DeploymentId, DeploymentState>,
    /// The assignments that failed, by robot and deployment.
    failed: HashSet<(RobotId, DeploymentId)>,
}

impl Pending {
    pub(super) fn take(&mut self, event: FleetEvent) {
        match event {
            FleetEvent::Presence(robot, online) => {
                self.presence.entry(robot).or_insert((online, online)).1 = online;
                self.quiet_ticks = 0;
            }
            FleetEvent::Task(news) => self.tasks.push(news),
            FleetEvent::Robot(robot, kind, text) => {
                self.robots.entry(kind).or_default().entry(robot).or_default().push(text);
            }
        }
    }

    pub(super) fn deployment(&mut self, id: DeploymentId) {
        self.deployments.insert(id);
    }

    pub(super) fn removed(&mut self, robot: KnownRobot) {
        self.removed.push(robot);
    }

    /// The entries due now. Objects that can't be read are left out.
    pub(super) async fn due(&mut self, store: &Store, now_ms: u64) -> Vec<NewFeedEntry> {
        let mut entries = removed_entries(std::mem::take(&mut self.removed));
        for (kind, news) in std::mem::take(&mut self.robots) {
            entries.extend(robot_entries(kind, news, store).await);
        }
        for id in std::mem::take(&mut self.deployments) {
            if let Some(deployment) = read(store.deployments().summary(&id).await) {
                entries.extend(self.deployment_entry(&deployment, now_ms));
            }
        }
        entries.extend(self.task_entries(store).await);
        if !self.presence.is_empty() {
            self.quiet_ticks += 1;
            self.presence_ticks += 1;
            if self.quiet_ticks >= QUIET_TICKS || self.presence_ticks >= MAX_TICKS {
                self.presence_ticks = 0;
                entries.extend(presence_entries(std::mem::take(&mut self.presence), store).await);
            }
        }
        entries
    }

    fn deployment_entry(
        &mut self,
        deployment: &DeploymentRow,
        now_ms: u64,
    ) -> Option<NewFeedEntry> {
        let state = deployment.state();
        if self.states.len() >= MAX_REMEMBERED {
            self.states.clear();
        }
        let before = self.states.get(&deployment.id).copied();
        // A settled deployment is not reported again because one of its services was restarted.
        if before == Some(DeploymentState::Settled) && state != DeploymentState::Cancelled {
            return None;
        }
        self.states.insert(deployment.id.clone(), state);
        let is_new = before.is_none() && now_ms.saturating_sub(deployment.created_at_ms) < NEW_MS;
        let robots: u64 = deployment.counts.iter().map(|counted| counted.count).sum();
        let counts: Vec<_> = deployment
            .counts
            .iter()
            .map(|counted| format!("{} {}", counted.count, counted.phase.as_str()))
            .collect();
        let counts = counts.join(", ");
        let (kind, level, what) = match state {
            DeploymentState::Active if is_new => (
                FeedKind::DeploymentBegun,
                LogLevel::Info,
                format!("was started on {}", counted(robots)),
            ),
            DeploymentState::Active if before == Some(DeploymentState::Paused) => {
                (FeedKind::DeploymentBegun, LogLevel::Info, "continues".to_owned())
            }
            DeploymentState::Paused if before != Some(DeploymentState::Paused) => (
                FeedKind::DeploymentPaused,
                LogLevel::Warn,
                format!("is paused: too many robots failed ({counts})"),
            ),
            DeploymentState::Settled if before.is_some() || is_new => {
                (FeedKind::DeploymentSettled, LogLevel::Info, format!("has settled: {counts}"))
            }
            DeploymentState::Cancelled if before.is_some() || is_new => {
                (FeedKind::DeploymentCancelled, LogLevel::Info, format!("was cancelled: {counts}"))
            }
            _ => return None,
        };
        let package = &deployment.package;
        Some(NewFeedEntry {
            kind,
            level,
            robot: None,
            deployment: Some(deployment.id.clone()),
            text: format!("{} {} {what}", package.name, package.version),
            // Counts are of all its robots.
            audience: FeedAudience::Unlimited,
        })
    }

    async fn task_entries(&mut self, store: &Store) -> Vec<NewFeedEntry> {
        let mut groups: BTreeMap<(DeploymentId, bool), Vec<Arc<TaskEvent>>> = BTreeMap::new();
        for news in std::mem::take(&mut self.tasks) {
            let part = (news.robot.clone(), news.deployment.clone());
            let is_failure = matches!(news.phase, Phase::Failed | Phase::RolledBack);
            if self.failed.len() >= MAX_REMEMBERED {
                self.failed.clear();
            }
            let is_news =
                if is_failure { self.failed.insert(part) } else { self.failed.remove(&part) };
            if is_news {
                groups.entry((news.deployment.clone(), is_failure)).or_default().push(news);
            }
        }
        let mut entries = Vec::new();
        for ((deployment, is_failure), group) in groups {
            let Some(row) = read(store.deployments().summary(&deployment).await) else { continue };
            let package = format!("{} {}", row.package.name, row.package.version);
            let (kind, level) = match is_failure {
                true => (FeedKind::TaskFailed, LogLevel::Error),
                false => (FeedKind::TaskRecovered, LogLevel::Info),
            };
            if group.len() > MAX_SEPARATE {
                let what = if is_failure { "failed" } else { "recovered" };
                let text = format!("{package} {what} on {} robots", group.len());
                entries.push(NewFeedEntry {
                    deployment: Some(deployment),
                    ..summary_entry(kind, level, text)
                });
                continue;
            }
            for news in group {
                let why = news
                    .failure
                    .as_ref()
                    .filter(|_| is_failure)
                    .map(|failure| format!(": {failure}"));
                let text = format!(
                    "{package} {} on {}{}",
                    news.phase.as_str(),
                    news.name,
                    why.unwrap_or_default()
                );
                if let Some(robot) = read(store.robots().find(news.robot.as_str()).await) {
                    let about = robot_entry(robot, kind, level, text);
                    entries
                        .push(NewFeedEntry { deployment: Some(news.deployment.clone()), ..about });
                }
            }
        }
        entries
    }
}

/// The object read, if it exists.
fn read<T>(found: Result<Option<T>, StoreError>) -> Option<T> {
    found.unwrap_or_else(|error| {
        error.log("the feed could not read an object to report");
        None
    })
}

fn counted(robots: u64) -> String {
    if robots == 1 { "1 robot".to_owned() } else { format!("{robots} robots") }
}

fn removed_entries(robots: Vec<KnownRobot>) -> Vec<NewFeedEntry> {
    let (kind, level) = (FeedKind::RobotRevoked, LogLevel::Info);
    if robots.len() > MAX_SEPARATE {
        return vec![summary_entry(kind, level, format!("{} robots were removed", robots.len()))];
    }
    let about = |robot: KnownRobot| {
        let text = format!("{} was removed", robot.name);
        robot_entry(robot, kind, level, text)
    };
    robots.into_iter().map(about).collect()
}

async fn robot_entries(
    kind: FeedKind,
    news: HashMap<RobotId, Vec<String>>,
    store: &Store,
) -> Vec<NewFeedEntry> {
    let (level, what) = match kind {
        FeedKind::RobotEnrolled => (LogLevel::Info, "registered"),
        FeedKind::RobotRevoked => (LogLevel::Warn, "were revoked"),
        FeedKind::RobotCondition => (LogLevel::Warn, "report a problem"),
        _ => (LogLevel::Warn, "exceeded their limits"),
    };
    if news.len() > MAX_SEPARATE {
        return vec![summary_entry(kind, level, format!("{} robots {what}", news.len()))];
    }
    let mut entries = Vec::new();
    for (id, texts) in news {
        if let Some(robot) = read(store.robots().find(id.as_str()).await) {
            // A robot with more texts than this at once does not push out other robots' texts.
            for text in texts.into_iter().take(MAX_SEPARATE) {
                let text = format!("{}: {text}", robot.name);
                entries.push(robot_entry(robot.clone(), kind, level, text));
            }
        }
    }
    entries
}

async fn presence_entries(
    presence: HashMap<RobotId, (bool, bool)>,
    store: &Store,
) -> Vec<NewFeedEntry> {
    let mut entries = Vec::new();
    for (is_online, kind, level, what) in [
        (true, FeedKind::RobotOnline, LogLevel::Info, "came online"),
        (false, FeedKind::RobotOffline, LogLevel::Warn, "went offline"),
    ] {
        let moved = presence
            .iter()
            .filter(|(_, heard)| **heard == (is_online, is_online))
            .map(|(robot, _)| robot);
        let moved: Vec<&RobotId> = moved.collect();
        if moved.len() > MAX_SEPARATE {
            entries.push(summary_entry(kind, level, format!("{} robots {what}", moved.len())));
            continue;
        }
        for id in moved {
            if let Some(robot) = read(store.robots().find(id.as_str()).await) {
                let text = format!("{} {what}", robot.name);
                entries.push(robot_entry(robot, kind, level, text));
            }
        }
    }
    entries
}

/// About more robots than are named.
fn summary_entry(kind: FeedKind, level: LogLevel, text: String) -> NewFeedEntry {
    NewFeedEntry {
        kind,
        level,
        robot: None,
        deployment: None,
        text,
        audience: FeedAudience::Unlimited,
    }
}

fn robot_entry(robot: KnownRobot, kind: FeedKind, level: LogLevel, text: String) -> NewFeedEntry {
    NewFeedEntry {
        kind,
        level,
        robot: Some((robot.id.clone(), robot.name.clone())),
        deployment: None,
        text,
        audience: FeedAudience::Robot(robot),
    }
}
