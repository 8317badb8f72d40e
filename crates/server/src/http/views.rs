//! Views for the operator: each is built here once, from a row of the store and the state in
//! memory.

use std::collections::HashSet;
use std::sync::Arc;

use task_proto::api::{
    AWAITS_APPROVAL, DeploymentView, MatchedRobot, MatchedRobots, MqttConnection, PhaseCount,
    RobotView,
};
use task_proto::messages::report::{Condition, Phase};
use task_proto::{DeploymentId, RobotId};

use super::error::ApiError;
use super::peers::{Peers, RobotFigures};
use crate::domain::limits::robot_limiter::RobotLimiter;
use crate::domain::person::Person;
use crate::fleet::presence::{Presence, RobotPresence};
use crate::fleet::robot_vitals::RobotVitals;
use crate::orders::actions::SelectedRobot;
use crate::store::{AssignmentRow, DeploymentRow, KnownRobot, RobotRow, Store};
use crate::system::clock::Clock;

/// The sources of views.
#[derive(Clone)]
pub struct Views {
    pub store: Store,
    pub presence: Arc<Presence>,
    pub robot_limiter: Arc<RobotLimiter>,
    pub vitals: RobotVitals,
    pub peers: Peers,
    pub clock: Clock,
}

impl Views {
    /// A robot, with its MQTT connection where the view shows it; an error if there is none.
    pub async fn robot(
        &self,
        id: &RobotId,
        mqtt: Option<MqttConnection>,
    ) -> Result<RobotView, ApiError> {
        let found = self.store.robots().get(id).await?;
        let row = found.ok_or_else(|| ApiError::not_found(format!("there is no robot {id}")))?;
        Ok(RobotView { mqtt, ..self.of_robot(row) })
    }

    /// The view of a robot's row, without its MQTT connection.
    pub(super) fn of_robot(&self, row: RobotRow) -> RobotView {
        let (id, now_ms) = (&row.robot.id, self.clock.now_ms());
        let presence = self.presence.get(id, now_ms);
        // Each server of a cluster has seen only its own part.
        let is_duplicate = presence.as_ref().is_some_and(|presence| presence.duplicate)
            || row.instances.as_ref().is_some_and(|instances| instances.is_duplicate(now_ms));
        let mut figures = self.peers.figures(id).unwrap_or_default();
        let (vitals, penalty) = (self.vitals.newest(id), self.robot_limiter.penalty(id));
        figures.merge(RobotFigures { vitals, penalty });
        let RobotFigures { vitals, penalty } = figures;
        let conditions = server_conditions(&row, presence.as_ref(), is_duplicate, penalty);
        let KnownRobot { id, name, mac, labels } = row.robot;
        let mut host = row.host;
        let effective_settings = host.as_mut().and_then(|host| host.settings.take());
        RobotView {
            id,
            name,
            mac,
            labels,
            online: presence.as_ref().is_some_and(|presence| presence.online),
            address: presence.as_ref().and_then(RobotPresence::address_text),
            last_seen_ms: row.last_seen_ms.max(presence.map(|presence| presence.last_seen_ms)),
            enrolled_at_ms: row.enrolled_at_ms,
            generation: row.generation,
            observed_generation: row.observed_generation,
            conditions: conditions.into_iter().chain(row.conditions).collect(),
            host,
            link: row.link,
            tasks: row.tasks,
            mqtt: None,
            vitals,
            settings: row.settings,
            effective_settings,
        }
    }

    /// The part of a deployment that concerns the person, with its assignments.
    pub async fn deployment(
        &self,
        by: &Person,
        id: &DeploymentId,
        with_timelines: bool,
    ) -> Result<DeploymentView, ApiError> {
        let found = self.store.deployments().get(id, with_timelines).await?;
        let (mut deployment, mut assignments) =
            found.ok_or_else(|| ApiError::not_found(format!("there is no deployment {id}")))?;
        if !by.scope.is_everything() {
            let robots = self.store.robots().ids_in(&by.scope).await?.into_iter().collect();
            (deployment, assignments) = narrowed(deployment, assignments, &robots)
                .ok_or_else(|| ApiError::out_of_scope(format!("deployment {id}"), by))?;
        }
        let now_ms = self.clock.now_ms();
        let view = |row: AssignmentRow| {
            let online = self.presence.is_online(&row.robot, now_ms);
            row.into_view(online)
        };
        Ok(deployment.into_view(Some(assignments.into_iter().map(view).collect())))
    }

    /// The robots that an order selected.
    pub(super) fn matched(&self, robots: Vec<SelectedRobot>) -> MatchedRobots {
        let now_ms = self.clock.now_ms();
        let view = |SelectedRobot { id, name }| {
            let online = self.presence.is_online(&id, now_ms);
            MatchedRobot { id, name, online }
        };
        MatchedRobots { robots: robots.into_iter().map(view).collect() }
    }
}

/// The conditions that the server has seen by itself.
fn server_conditions(
    row: &RobotRow,
    presence: Option<&RobotPresence>,
    is_duplicate: bool,
    penalty: Option<String>,
) -> Vec<Condition> {
    let (generation, observed) = (row.generation, row.observed_generation);
    let has = |holds: bool, text: &str| holds.then(|| text.to_owned());
    let conditions = [
        (
            "duplicate_identity",
            has(
                is_duplicate,
                "two agents use this robot's identity and keep displacing each other; enroll one of them again",
            ),
        ),
        (
            "instance_waits",
            has(
                presence.is_some_and(|presence| presence.has_waiting_instance),
                "another agent uses this robot's identity and gets no work until the known agent has been \
                 silent for 30 s: the robot was restarted, or its identity is used elsewhere",
            ),
        ),
        ("misbehaves", penalty),
        (
            "revoked",
            has(
                row.is_revoked,
                "its tokens were revoked; enroll it again with a token made for it, or remove it",
            ),
        ),
        (
            AWAITS_APPROVAL,
            has(
                row.awaits_approval,
                "waiting for approval by an administrator (taskd robot approve)",
            ),
        ),
        (
            "diverged",
            (observed > generation).then(|| {
                format!(
                    "its generation {observed} is ahead of this server's {generation}; left alone until its next order"
                )
            }),
        ),
    ];
    let condition = |(code, text): (&str, Option<String>)| {
        Some(Condition { code: code.to_owned(), text: text? })
    };
    conditions.into_iter().filter_map(condition).collect()
}

/// Narrows a deployment to its assignments to these robots; `None` if there are none.
pub(super) fn narrowed(
    deployment: DeploymentRow,
    mut assignments: Vec<AssignmentRow>,
    robots: &HashSet<RobotId>,
) -> Option<(DeploymentRow, Vec<AssignmentRow>)> {
    assignments.retain(|assignment| robots.contains(&assignment.robot));
    if assignments.is_empty() {
        return None;
    }
    let count = |phase| PhaseCount {
        phase,
        count: assignments.iter().filter(|assignment| assignment.phase == phase).count() as u64,
    };
    let counts = Phase::ALL.into_iter().map(count).filter(|counted| counted.count > 0).collect();
    Some((without_others(DeploymentRow { counts, ..deployment }), assignments))
}

/// Removes the fields that could name robots and deployments outside the person's scope.
pub(super) fn without_others(deployment: DeploymentRow) -> DeploymentRow {
    DeploymentRow { selector: None, supersedes: Vec::new(), ..deployment }
}
