//! Events that the feed has not reported yet. A few events of one kind are reported one by one,
//! many together.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::Arc;

use task_proto::api::{DeploymentState, DeploymentView, FeedKind};
use task_proto::log::LogLevel;
use task_proto::report::Phase;
use task_proto::{DeploymentId, RobotId};

use super::{FeedAudience, Said};
use crate::domain::happening::{Happening, TaskNews};
use crate::store::{KnownRobot, Store, StoreError};

/// More entries of one kind than this are combined into one.
const MOST_ALONE: usize = 5;
/// Presence changes are reported after `QUIET_TURNS` turns without a change, and after `MOST_TURNS`
/// turns at the latest.
const QUIET_TURNS: u32 = 3;
const MOST_TURNS: u32 = 60;
/// Failed tasks and unsettled deployments remembered; above this limit all are forgotten, and their
/// ends are not reported.
const MOST_REMEMBERED: usize = 10_000;
/// A deployment older than this when first seen is not new.
const NEW_MS: u64 = 60_000;

#[derive(Default)]
pub(super) struct Pending {
    /// The first and the last state of each robot: a robot that is back in its first state is no
    /// news.
    presence: HashMap<RobotId, (bool, bool)>,
    quiet_turns: u32,
    presence_turns: u32,
    tasks: Vec<Arc<TaskNews>>,
    robots: HashMap<FeedKind, HashMap<RobotId, Vec<String>>>,
    removed: Vec<KnownRobot>,
    deployments: BTreeSet<DeploymentId>,
    /// The last known state of each deployment.
    states: HashMap<DeploymentId, DeploymentState>,
    /// The assignments that failed, by robot and deployment.
    failed: HashSet<(RobotId, DeploymentId)>,
}

impl Pending {
    pub(super) fn take(&mut self, happening: Happening) {
        match happening {
            Happening::Presence(robot, online) => {
                self.presence.entry(robot).or_insert((online, online)).1 = online;
                self.quiet_turns = 0;
            }
            Happening::Task(news) => self.tasks.push(news),
            Happening::Robot(robot, kind, text) => {
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
    pub(super) async fn due(&mut self, store: &Store, now_ms: u64) -> Vec<Said> {
        let mut said = about_removed(std::mem::take(&mut self.removed));
        for (kind, news) in std::mem::take(&mut self.robots) {
            said.extend(about_robots(kind, news, store).await);
        }
        for id in std::mem::take(&mut self.deployments) {
            if let Some(view) = read(store.deployment_summary(&id).await) {
                said.extend(self.about_deployment(&view, now_ms));
            }
        }
        said.extend(self.about_tasks(store).await);
        if !self.presence.is_empty() {
            self.quiet_turns += 1;
            self.presence_turns += 1;
            if self.quiet_turns >= QUIET_TURNS || self.presence_turns >= MOST_TURNS {
                self.presence_turns = 0;
                said.extend(about_presence(std::mem::take(&mut self.presence), store).await);
            }
        }
        said
    }

    fn about_deployment(&mut self, view: &DeploymentView, now_ms: u64) -> Option<Said> {
        if self.states.len() >= MOST_REMEMBERED {
            self.states.clear();
        }
        let before = self.states.get(&view.id).copied();
        // A settled deployment is not reported again because one of its services was restarted.
        if before == Some(DeploymentState::Settled) && view.state != DeploymentState::Cancelled {
            return None;
        }
        self.states.insert(view.id.clone(), view.state);
        let is_new = before.is_none() && now_ms.saturating_sub(view.created_at_ms) < NEW_MS;
        let robots: u64 = view.counts.iter().map(|counted| counted.count).sum();
        let counts: Vec<_> = view
            .counts
            .iter()
            .map(|counted| format!("{} {}", counted.count, counted.phase.as_str()))
            .collect();
        let counts = counts.join(", ");
        let (kind, level, what) = match view.state {
            DeploymentState::Active if is_new => (
                FeedKind::DeploymentBegun,
                LogLevel::Info,
                format!("was ordered on {}", counted(robots)),
            ),
            DeploymentState::Active if before == Some(DeploymentState::Paused) => {
                (FeedKind::DeploymentBegun, LogLevel::Info, "goes on".to_owned())
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
                (FeedKind::DeploymentCancelled, LogLevel::Info, format!("was taken back: {counts}"))
            }
            _ => return None,
        };
        let package = &view.package;
        Some(Said {
            kind,
            level,
            robot: None,
            deployment: Some(view.id.clone()),
            text: format!("{} {} {what}", package.name, package.version),
            // Counts are of all its robots.
            audience: FeedAudience::Unlimited,
        })
    }

    async fn about_tasks(&mut self, store: &Store) -> Vec<Said> {
        let mut groups: BTreeMap<(DeploymentId, bool), Vec<Arc<TaskNews>>> = BTreeMap::new();
        for news in std::mem::take(&mut self.tasks) {
            let part = (news.robot.clone(), news.deployment.clone());
            let is_failure = matches!(news.phase, Phase::Failed | Phase::RolledBack);
            if self.failed.len() >= MOST_REMEMBERED {
                self.failed.clear();
            }
            let is_news =
                if is_failure { self.failed.insert(part) } else { self.failed.remove(&part) };
            if is_news {
                groups.entry((news.deployment.clone(), is_failure)).or_default().push(news);
            }
        }
        let mut said = Vec::new();
        for ((deployment, is_failure), group) in groups {
            let Some(view) = read(store.deployment_summary(&deployment).await) else { continue };
            let package = format!("{} {}", view.package.name, view.package.version);
            let (kind, level) = match is_failure {
                true => (FeedKind::TaskFailed, LogLevel::Error),
                false => (FeedKind::TaskRecovered, LogLevel::Info),
            };
            if group.len() > MOST_ALONE {
                let what = if is_failure { "failed" } else { "recovered" };
                let text = format!("{package} {what} on {} robots", group.len());
                said.push(Said { deployment: Some(deployment), ..about_many(kind, level, text) });
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
                if let Some(robot) = read(store.find_robot(news.robot.as_str()).await) {
                    let about = about_robot(robot, kind, level, text);
                    said.push(Said { deployment: Some(news.deployment.clone()), ..about });
                }
            }
        }
        said
    }
}

/// The object read, if it exists.
fn read<T>(found: Result<Option<T>, StoreError>) -> Option<T> {
    found.unwrap_or_else(|error| {
        error.log("the feed could not read what it was to tell of");
        None
    })
}

fn counted(robots: u64) -> String {
    if robots == 1 { "1 robot".to_owned() } else { format!("{robots} robots") }
}

fn about_removed(robots: Vec<KnownRobot>) -> Vec<Said> {
    let (kind, level) = (FeedKind::RobotRevoked, LogLevel::Info);
    if robots.len() > MOST_ALONE {
        return vec![about_many(kind, level, format!("{} robots were removed", robots.len()))];
    }
    let about = |robot: KnownRobot| {
        let text = format!("{} was removed", robot.name);
        about_robot(robot, kind, level, text)
    };
    robots.into_iter().map(about).collect()
}

async fn about_robots(
    kind: FeedKind,
    news: HashMap<RobotId, Vec<String>>,
    store: &Store,
) -> Vec<Said> {
    let (level, what) = match kind {
        FeedKind::RobotEnrolled => (LogLevel::Info, "registered"),
        FeedKind::RobotRevoked => (LogLevel::Warn, "were put out"),
        FeedKind::RobotCondition => (LogLevel::Warn, "say that something is wrong with them"),
        _ => (LogLevel::Warn, "misbehaved"),
    };
    if news.len() > MOST_ALONE {
        return vec![about_many(kind, level, format!("{} robots {what}", news.len()))];
    }
    let mut said = Vec::new();
    for (id, texts) in news {
        if let Some(robot) = read(store.find_robot(id.as_str()).await) {
            // A robot with more texts than this at once does not push out other robots' texts.
            for text in texts.into_iter().take(MOST_ALONE) {
                let text = format!("{}: {text}", robot.name);
                said.push(about_robot(robot.clone(), kind, level, text));
            }
        }
    }
    said
}

async fn about_presence(presence: HashMap<RobotId, (bool, bool)>, store: &Store) -> Vec<Said> {
    let mut said = Vec::new();
    for (is_online, kind, level, what) in [
        (true, FeedKind::RobotOnline, LogLevel::Info, "came online"),
        (false, FeedKind::RobotOffline, LogLevel::Warn, "went offline"),
    ] {
        let moved = presence
            .iter()
            .filter(|(_, heard)| **heard == (is_online, is_online))
            .map(|(robot, _)| robot);
        let moved: Vec<&RobotId> = moved.collect();
        if moved.len() > MOST_ALONE {
            said.push(about_many(kind, level, format!("{} robots {what}", moved.len())));
            continue;
        }
        for id in moved {
            if let Some(robot) = read(store.find_robot(id.as_str()).await) {
                let text = format!("{} {what}", robot.name);
                said.push(about_robot(robot, kind, level, text));
            }
        }
    }
    said
}

/// About more robots than are named.
fn about_many(kind: FeedKind, level: LogLevel, text: String) -> Said {
    Said { kind, level, robot: None, deployment: None, text, audience: FeedAudience::Unlimited }
}

fn about_robot(robot: KnownRobot, kind: FeedKind, level: LogLevel, text: String) -> Said {
    Said {
        kind,
        level,
        robot: Some((robot.id.clone(), robot.name.clone())),
        deployment: None,
        text,
        audience: FeedAudience::Robot(Arc::new(robot)),
    }
}
