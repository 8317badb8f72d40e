//! Views for the operator: the store's rows, completed with data from presence.

use std::collections::HashSet;

use task_proto::RobotId;
use task_proto::api::{DeploymentState, DeploymentView, MatchedRobot, PhaseCount, RobotView};
use task_proto::report::{Condition, Phase};

use crate::domain::deployment;
use crate::fleet::presence::Presence;
use crate::fleet::robot_vitals::RobotVitals;
use crate::limits::conduct::Conduct;

/// Adds a robot's presence, behavior, vitals and identity problems.
pub fn complete_robot(
    view: &mut RobotView,
    presence: &Presence,
    conduct: &Conduct,
    vitals: &RobotVitals,
    now_ms: u64,
) {
    view.vitals = vitals.newest(&view.id);
    if let Some(text) = conduct.trouble(&view.id) {
        view.conditions.insert(0, Condition { code: "misbehaves".to_owned(), text });
    }
    let Some(sighting) = presence.get(&view.id, now_ms) else { return };
    view.online = sighting.online;
    view.address = sighting.address.map(|address| address.to_string());
    view.last_seen_ms = view.last_seen_ms.max(Some(sighting.last_seen_ms));
    if sighting.waits {
        let text = "another agent came with this robot's identity, and gets no work before the one that is known was \
                    silent for 30 s: the robot was started again, or its identity is used elsewhere";
        view.conditions
            .insert(0, Condition { code: "instance_waits".to_owned(), text: text.to_owned() });
    }
    if sighting.duplicate {
        let text = "two agents use this robot's identity and keep displacing each other; enrol one of them again";
        let condition = Condition { code: "duplicate_identity".to_owned(), text: text.to_owned() };
        view.conditions.insert(0, condition);
    }
}

/// Adds the presence of a deployment's robots.
pub fn complete_deployment(view: &mut DeploymentView, presence: &Presence, now_ms: u64) {
    for assignment in view.assignments.iter_mut().flatten() {
        assignment.online = presence.is_online(&assignment.robot, now_ms);
    }
}

/// Narrows a deployment with its assignments to these robots; `None` if no assignment is left.
pub fn narrowed(mut view: DeploymentView, robots: &HashSet<RobotId>) -> Option<DeploymentView> {
    let assignments = view.assignments.as_mut()?;
    assignments.retain(|assignment| robots.contains(&assignment.robot));
    if assignments.is_empty() {
        return None;
    }
    let count = |phase: &Phase| {
        assignments.iter().filter(|assignment| assignment.phase == *phase).count() as u64
    };
    let counts = Phase::ALL.iter().map(|phase| PhaseCount { phase: *phase, count: count(phase) });
    view.counts = counts.filter(|counted| counted.count > 0).collect();
    let (is_cancelled, is_paused) =
        (view.state == DeploymentState::Cancelled, view.state == DeploymentState::Paused);
    view.state = deployment::state(view.kind, is_cancelled, is_paused, &view.counts);
    Some(without_others(view))
}

/// Removes the fields that could name robots and deployments outside the person's scope.
pub fn without_others(view: DeploymentView) -> DeploymentView {
    DeploymentView { selector: None, supersedes: Vec::new(), ..view }
}

/// Adds the presence of the matched robots.
pub fn complete_matched(robots: &mut [MatchedRobot], presence: &Presence, now_ms: u64) {
    for robot in robots {
        robot.online = presence.is_online(&robot.id, now_ms);
    }
}
