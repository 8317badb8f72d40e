//! Decides which desired states this robot obeys: signed by the pinned key, for this robot, not
//! older than its current state, still in force. Pure. A refusal gives the reason, and the previous
//! state stays.

use std::collections::BTreeSet;

use task_proto::RobotId;
use task_proto::desired::DesiredState;
use task_proto::trust::envelope::{DESIRED_STATE_TYPE, Envelope, EnvelopeError, PublicKey};
use task_proto::{Generation, TaskName};

use crate::system::clock::PROGRAM_EXISTS_SINCE_MS;

/// The maximum number of tasks in one robot's desired state.
const MAX_TASKS: usize = 1024;

/// Why a desired state is refused.
#[derive(Debug, thiserror::Error)]
pub enum AdmissionError {
    /// The state is not signed by the server at which this robot registered.
    #[error("it is not signed by the server that this robot registered with")]
    Signature(#[source] EnvelopeError),
    /// The payload is signed but is not a desired state.
    #[error("it is signed, but is not a desired state")]
    Malformed(#[source] serde_json::Error),
    /// The state is for another robot.
    #[error("it is for robot {0}")]
    OtherRobot(RobotId),
    /// The state is older than the robot's current one.
    #[error("its generation {offered} is older than {accepted}, which this robot has")]
    Stale {
        offered: Generation,
        /// The generation accepted before.
        accepted: Generation,
    },
    /// The generation is the same, but the content differs.
    #[error("its generation {0} was accepted before with other content")]
    Contradicts(Generation),
    /// The state has expired.
    #[error("it expired at {0} ms since 1970")]
    Expired(u64),
    /// The state names a task twice, a package of another name, or too many tasks.
    #[error(
        "it names task {0} twice, or a package of another name for it, or more than {MAX_TASKS} tasks"
    )]
    Tasks(TaskName),
}

/// Returns the desired state in `envelope` if this robot may obey that state. `accepted` is the
/// current state.
pub fn admit(
    envelope: &Envelope,
    key: &PublicKey,
    robot: &RobotId,
    accepted: Option<&DesiredState>,
    wall_ms: u64,
) -> Result<DesiredState, AdmissionError> {
    let state = open(envelope, key, robot)?;
    if let Some(accepted) = accepted {
        let offered = state.generation;
        let accepted_generation = accepted.generation;
        if offered < accepted_generation {
            return Err(AdmissionError::Stale { offered, accepted: accepted_generation });
        }
        // The server signs a state anew before it expires; the content must be the same.
        if offered == accepted_generation && state.tasks != accepted.tasks {
            return Err(AdmissionError::Contradicts(offered));
        }
        if offered == accepted_generation && state.issued_at_ms < accepted.issued_at_ms {
            return Ok(accepted.clone());
        }
    }
    if is_expired(&state, wall_ms) {
        return Err(AdmissionError::Expired(state.expires_at_ms));
    }
    Ok(state)
}

/// Opens the desired state in `envelope`. Signature, robot and shape are verified; the age is not.
pub fn open(
    envelope: &Envelope,
    key: &PublicKey,
    robot: &RobotId,
) -> Result<DesiredState, AdmissionError> {
    let payload = envelope.open(DESIRED_STATE_TYPE, key).map_err(AdmissionError::Signature)?;
    let state: DesiredState =
        serde_json::from_slice(&payload).map_err(AdmissionError::Malformed)?;
    if state.robot_id != *robot {
        return Err(AdmissionError::OtherRobot(state.robot_id));
    }
    let mut names = BTreeSet::new();
    for (count, task) in state.tasks.iter().enumerate() {
        if count >= MAX_TASKS || task.package.name != task.task || !names.insert(&task.task) {
            return Err(AdmissionError::Tasks(task.task.clone()));
        }
    }
    Ok(state)
}

/// Whether the state has expired. A clock that shows a time before this program existed is wrong,
/// as on a robot without a battery clock, and must not lock the robot out.
pub fn is_expired(state: &DesiredState, wall_ms: u64) -> bool {
    wall_ms >= PROGRAM_EXISTS_SINCE_MS && wall_ms >= state.expires_at_ms
}

#[cfg(test)]
mod tests {
    use task_proto::desired::{BlobRef, Delivery, DesiredTask, PackageRef, TargetState};
    use task_proto::trust::envelope::SigningKey;
    use task_proto::{DeploymentId, Digest};

    use super::*;

    const NOW_MS: u64 = PROGRAM_EXISTS_SINCE_MS + 1000;

    fn task(name: &str) -> DesiredTask {
        let blob = BlobRef { digest: Digest::of(name.as_bytes()), size: 1 };
        let name: TaskName = name.parse().expect("valid");
        let version = "1".parse().expect("valid");
        DesiredTask {
            task: name.clone(),
            deployment: DeploymentId::random(),
            package: PackageRef { name, version, manifest: blob, config: blob, content: blob },
            wanted: TargetState::Running,
            run: 1,
            delivery: Delivery::PushPull,
            priority: 0,
        }
    }

    fn state(robot: &RobotId, generation: u64) -> DesiredState {
        DesiredState {
            robot_id: robot.clone(),
            generation: Generation(generation),
            issued_at_ms: NOW_MS,
            expires_at_ms: NOW_MS + 1,
            tasks: vec![task("a"), task("b")],
            evidence: Default::default(),
            settings: Default::default(),
            robot: Default::default(),
        }
    }

    fn seal(state: &DesiredState, key: &SigningKey) -> Envelope {
        Envelope::seal(DESIRED_STATE_TYPE, &serde_json::to_vec(state).expect("json"), key)
    }

    #[test]
    fn admission_requires_a_signed_newer_state_for_this_robot() {
        let key = SigningKey::random();
        let robot = RobotId::random();
        let accepted = state(&robot, 5);
        let admit_sealed = |state: &DesiredState, key_used: &SigningKey| {
            admit(&seal(state, key_used), &key.public_key(), &robot, Some(&accepted), NOW_MS)
        };
        assert_eq!(admit_sealed(&state(&robot, 6), &key).expect("newer").generation, Generation(6));
        assert!(matches!(
            admit_sealed(&state(&robot, 6), &SigningKey::random()),
            Err(AdmissionError::Signature(_))
        ));
        assert!(matches!(
            admit_sealed(&state(&RobotId::random(), 6), &key),
            Err(AdmissionError::OtherRobot(_))
        ));
        assert!(matches!(admit_sealed(&state(&robot, 4), &key), Err(AdmissionError::Stale { .. })));
        assert!(matches!(
            admit_sealed(&state(&robot, 5), &key),
            Err(AdmissionError::Contradicts(_))
        ));
        let resigned = DesiredState {
            issued_at_ms: NOW_MS + 9,
            expires_at_ms: NOW_MS + 99,
            ..accepted.clone()
        };
        assert_eq!(admit_sealed(&resigned, &key).expect("signed anew"), resigned);
        let expired = DesiredState { expires_at_ms: NOW_MS, ..state(&robot, 6) };
        assert!(matches!(admit_sealed(&expired, &key), Err(AdmissionError::Expired(_))));
        let doubled = DesiredState { tasks: vec![task("a"), task("a")], ..state(&robot, 6) };
        assert!(matches!(admit_sealed(&doubled, &key), Err(AdmissionError::Tasks(_))));
    }

    #[test]
    fn impossible_clock_does_not_expire_a_state() {
        let key = SigningKey::random();
        let robot = RobotId::random();
        let old = DesiredState { expires_at_ms: 1, ..state(&robot, 1) };
        assert!(admit(&seal(&old, &key), &key.public_key(), &robot, None, 0).is_ok());
    }
}
