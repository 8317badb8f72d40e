//! Envelopes and the desired states in them, as a robot receives them from any source.

use task_agent::reconcile::admission::{AdmissionError, admit};
use task_proto::desired::{BlobRef, DesiredNotice, DesiredState, Inline};
use task_proto::trust::envelope::{DESIRED_STATE_TYPE, Envelope, SigningKey};
use task_proto::{Digest, Generation, RobotId};

use crate::messages::round_trip;

/// The payloads that the key has signed: the envelopes of the corpus have no others.
const SIGNED: [&[u8]; 2] = [b"{}", b"{\"generation\":1}"];
const KEY: [u8; 32] = [9; 32];
/// The year 2100: a state that expires later is in force.
const NOW_MS: u64 = 4_102_444_800_000;

/// An envelope, or a message on a robot's `desired` topic: only payloads signed by the key are
/// returned, and only blobs that hash to their digest.
pub fn envelope(bytes: &[u8]) {
    let (mut envelopes, mut inlines) = (Vec::new(), Vec::new());
    envelopes.extend(round_trip::<Envelope>(bytes));
    if let Some(DesiredNotice::State { envelope, inline }) = round_trip::<DesiredNotice>(bytes) {
        envelopes.push(envelope);
        inlines.push(inline);
    }
    let key = SigningKey::from_bytes(KEY).public_key();
    for envelope in envelopes {
        if let Ok(payload) = envelope.open(DESIRED_STATE_TYPE, &key) {
            assert!(
                SIGNED.contains(&&*payload),
                "opened without a signature: {}",
                payload.escape_ascii()
            );
        }
    }
    inlines.extend(round_trip::<Inline>(bytes));
    for inline in inlines {
        for size in 0..8 {
            let blob = BlobRef { digest: Digest::of(b"true"), size };
            assert!(inline.get(&blob).is_none_or(|bytes| bytes == b"true"));
        }
    }
}

/// A desired state signed by the server's key, with any content: a robot obeys only its own state,
/// never an earlier one, and each task once.
pub fn desired(bytes: &[u8]) {
    let (key, robot) =
        (SigningKey::from_bytes(KEY), "r00000000000000a1".parse::<RobotId>().expect("valid"));
    let envelope = Envelope::seal(DESIRED_STATE_TYPE, bytes, &key);
    let Ok(state) = admit(&envelope, &key.public_key(), &robot, None, NOW_MS) else { return };
    assert!(state.robot_id == robot && state.expires_at_ms > NOW_MS);
    let mut names: Vec<_> = state.tasks.iter().map(|task| &task.task).collect();
    names.sort();
    names.dedup();
    assert_eq!(names.len(), state.tasks.len());
    assert_eq!(round_trip::<DesiredState>(bytes).as_ref(), Some(&state));
    let again =
        admit(&envelope, &key.public_key(), &robot, Some(&state), NOW_MS).expect("the same state");
    assert_eq!(again, state);
    if let Some(generation) = state.generation.0.checked_add(1) {
        let newer = DesiredState { generation: Generation(generation), ..state.clone() };
        let stale = admit(&envelope, &key.public_key(), &robot, Some(&newer), NOW_MS);
        assert!(matches!(stale, Err(AdmissionError::Stale { .. })));
    }
}
