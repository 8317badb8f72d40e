//! Messages from robots over MQTT and HTTP, and parts of a package sent to robots.

use std::fmt::Debug;

use serde::Serialize;
use serde::de::DeserializeOwned;
use task_proto::messages::part::{MAX_PARTS, Part, PartLayout};
use task_proto::messages::report::{Condition, Phase, Report, Status};
use task_proto::messages::request::{Reply, Request};
use task_proto::telemetry::log::LogBatch;
use taskd::domain::deployment::AssignmentState;

/// A report, a status or a batch of log lines. No report moves an assignment out of a final phase.
pub fn report(bytes: &[u8]) {
    round_trip::<Status>(bytes);
    round_trip::<LogBatch>(bytes);
    let Some(report) = round_trip::<Report>(bytes).map(Report::tidied) else { return };
    for Condition { code, text } in &report.conditions {
        is_clean(code);
        is_clean(text);
    }
    for task in &report.tasks {
        for phase in Phase::ALL {
            let standing = AssignmentState {
                run: task.run,
                phase,
                progress: None,
                failure: None,
                attempts: 0,
            };
            let Some(next) = standing.after(task) else { continue };
            assert!(!phase.is_final(), "{phase:?} was left");
            is_clean(&next.failure.map(|failure| failure.to_string()).unwrap_or_default());
        }
    }
}

fn is_clean(text: &str) {
    assert!(
        !text.contains(|c: char| c.is_control() && c != '\n'),
        "{text:?} has a control character"
    );
}

/// A question to a robot, or its answer.
pub fn reply(bytes: &[u8]) {
    round_trip::<Request>(bytes);
    round_trip::<Reply>(bytes);
}

/// A part of a package, after eight bytes with the package's size: an accepted part lies inside the
/// package.
pub fn part(bytes: &[u8]) {
    let Some((size, message)) = bytes.split_first_chunk::<8>() else { return };
    let size = u64::from_be_bytes(*size);
    let Ok(part) = Part::decode(message, size) else { return };
    let cut = PartLayout::new(size, part.part_bytes).expect("a cut that was accepted");
    let range = cut.range(part.index);
    assert!(part.index < part.count && part.count == cut.count() && part.count <= MAX_PARTS);
    assert!(range.end <= size && range.end - range.start == part.bytes.len() as u64);
    // All bytes except the reserved one.
    let again = part.encode();
    assert_eq!((again[0], &again[2..]), (message[0], &message[2..]));
}

/// Parses `bytes` as a `T`, if possible; written and read again, the value is the same.
pub(crate) fn round_trip<T: DeserializeOwned + Serialize + PartialEq + Debug>(
    bytes: &[u8],
) -> Option<T> {
    let read: T = serde_json::from_slice(bytes).ok()?;
    let written = serde_json::to_vec(&read).expect("a parsed value can be written");
    let again: T = serde_json::from_slice(&written).expect("a written value can be parsed");
    assert_eq!(again, read);
    Some(read)
}
