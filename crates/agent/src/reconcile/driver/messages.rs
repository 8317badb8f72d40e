//! Handles messages from the server: desired states, confirmations, refusals.

use bytes::Bytes;
use task_proto::api::ReportReply;
use task_proto::desired::Inline;
use task_proto::error_chain::chain;
use task_proto::ids::Labels;
use task_proto::messages::report::{Condition, Report};
use task_proto::trust::envelope::Envelope;

use super::{AgentIdentity, Driver, requires_labels};
use crate::link::state::ServerMessage;
use crate::reconcile::admission::{self, AdmissionError};
use crate::task::effects::Effects;
use crate::task::ledger::Accepted;

/// The condition of a robot that refuses the state sent to it.
const STATE_REFUSED: &str = "state_refused";
/// The conditions that end once a state is accepted.
pub(super) const REFUSALS: [&str; 2] = [STATE_REFUSED, Report::STATE_CONTRADICTED];
/// The maximum length of the server's reason for refusing the token.
const MOST_REASON_CHARS: usize = 300;

impl<E: Effects> Driver<E> {
    pub(super) fn handle_message(&mut self, message: ServerMessage) {
        match message {
            ServerMessage::Desired { envelope, inline, was_asked_for } => {
                if was_asked_for {
                    self.clear_removal();
                }
                self.admit_state(*envelope, &inline);
            }
            ServerMessage::Unchanged => self.clear_removal(),
            ServerMessage::Confirmed { reply, .. } => {
                if let Some(reply) = reply {
                    self.clear_removal();
                    self.compare_settings(&reply);
                }
            }
            ServerMessage::TokenRefused(why) => {
                let why: String =
                    why.chars().filter(|c| !c.is_control()).take(MOST_REASON_CHARS).collect();
                if !self.ledger.removed || self.ledger.removed_because != why {
                    tracing::warn!(
                        why,
                        "the server does not accept this robot's token: no new work is started"
                    );
                    (self.ledger.removed, self.ledger.removed_because) = (true, why);
                    self.dirty = true;
                }
            }
            ServerMessage::StateUnavailable { code, text } => {
                if self.state_unavailable.as_ref().is_none_or(|known| known.code != code) {
                    tracing::info!(code, text, "the server refused to send the desired state");
                }
                self.state_unavailable = Some(Condition { code, text });
            }
        }
    }

    /// Clears a removal. The server has answered this robot or signed something new for it, so the
    /// robot was not removed, or not for good.
    fn clear_removal(&mut self) {
        self.state_unavailable = None;
        if self.ledger.removed {
            (self.ledger.removed, self.ledger.removed_because) = (false, String::new());
            self.dirty = true;
        }
    }

    /// Accepts a desired state or reports the reason of its refusal.
    fn admit_state(&mut self, envelope: Envelope, inline: &Inline) {
        let AgentIdentity { server_key, robot_id, .. } = &self.agent_identity;
        let wall_ms = self.effects.now().wall_ms;
        match admission::admit(&envelope, server_key, robot_id, self.desired.as_ref(), wall_ms) {
            Ok(state) => {
                REFUSALS.iter().for_each(|code| drop(self.conditions.remove(code)));
                self.state_unavailable = None;
                if !inline.is_empty() {
                    let packages = state
                        .tasks
                        .iter()
                        .flat_map(|task| [task.package.config, task.package.content]);
                    let blobs = packages.chain(state.evidence.blobs());
                    let came = blobs.filter_map(|blob| {
                        Some((blob, Bytes::copy_from_slice(inline.get(&blob)?)))
                    });
                    self.effects.offer(came.collect());
                }
                self.effects.apply_state(&state);
                if self.desired.as_ref() != Some(&state) {
                    self.clear_removal();
                    tracing::info!(generation = %state.generation, tasks = state.tasks.len(), "accepted a desired state");
                    self.ledger.accepted =
                        Some(Accepted { generation: state.generation, envelope });
                    // The order may depend on a label that the robot was given just before, or on
                    // software that a person has installed since the last order. Look up both
                    // again.
                    (self.robot.labels, self.robot.installations) = (None, None);
                    if self
                        .views
                        .values()
                        .filter_map(|view| view.prepared.as_ref())
                        .any(requires_labels)
                    {
                        self.link_state.post.notify_one();
                    }
                    self.desired = Some(state);
                    self.dirty = true;
                }
            }
            Err(refused) => {
                let text = format!("a desired state was refused: {}", chain(&refused));
                tracing::warn!("{text}");
                let is_other = matches!(refused, AdmissionError::Contradicts(_));
                self.conditions.insert(
                    if is_other { Report::STATE_CONTRADICTED } else { STATE_REFUSED },
                    text,
                );
            }
        }
    }

    /// The server's values win; differences from the robot's own settings are reported.
    fn compare_settings(&mut self, reply: &ReportReply) {
        let mut differences = Vec::new();
        if let Some(own) = self.agent_identity.name.as_ref().filter(|own| **own != reply.name) {
            differences.push(format!("name is {own} here and {} there", reply.name));
        }
        if let Some(own) = self.agent_identity.labels.as_ref().filter(|own| **own != reply.labels) {
            let text = |labels: &Labels| {
                labels
                    .iter()
                    .map(|(key, value)| format!("{key}={value}"))
                    .collect::<Vec<_>>()
                    .join(",")
            };
            differences.push(format!(
                "labels are {:?} here and {:?} there",
                text(own),
                text(&reply.labels)
            ));
        }
        if differences.is_empty() {
            self.conditions.remove("settings_differ");
        } else {
            let text = format!(
                "the server's settings hold, the robot's own differ: {}",
                differences.join("; ")
            );
            self.conditions.insert("settings_differ", text);
        }
        self.robot.labels = Some(reply.labels.clone());
    }
}
