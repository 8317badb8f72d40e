//! The feed: the latest noteworthy events of the fleet, in memory. Similar events are gathered for
//! a moment and reported together, so that a restart of the server is one line and not ten
//! thousand. The feed decides nothing, and events that must not be lost are in the audit.

mod pending;

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use task_proto::api::{FeedEntry, FeedKind, MAX_FEED_ENTRIES};
use task_proto::log::LogLevel;
use task_proto::{DeploymentId, RobotId, RobotName};
use tokio::sync::broadcast::error::RecvError;
use tokio_util::sync::CancellationToken;

use self::pending::Pending;
use super::changes::{Change, Changes};
use crate::broker::{Broker, Health};
use crate::store::{KnownRobot, Store};
use crate::system::clock::Clock;
use crate::system::data_directory::room;

/// Interval between two passes over the gathered events.
const TURN: Duration = Duration::from_secs(1);
/// Interval between checks of the disk, in turns.
const DISK_TURNS: u64 = 60;
/// Of a longer text the rest is left out.
const MOST_CHARACTERS: usize = 500;
/// Below this share of free space, in percent, the disk is nearly full.
const LEAST_FREE_PERCENT: u64 = 5;

/// The users who may see an entry.
#[derive(Debug, Clone)]
pub enum FeedAudience {
    Everybody,
    /// Users who may see every robot: the entry counts robots.
    Unlimited,
    /// Users who may see this robot.
    Robot(Arc<KnownRobot>),
}

/// The latest entries. Clones share them.
#[derive(Clone)]
pub struct Feed(Arc<Mutex<Entries>>);

struct Entries {
    kept: VecDeque<(FeedEntry, FeedAudience)>,
    next: u64,
}

/// Inputs of the feed.
pub struct FeedSource {
    /// The database, for names.
    pub store: Store,
    /// The broker, for its health.
    pub broker: Broker,
    pub clock: Clock,
    /// On the disk that is looked at.
    pub data: PathBuf,
}

/// An entry without its number and time.
struct Said {
    kind: FeedKind,
    level: LogLevel,
    robot: Option<(RobotId, RobotName)>,
    deployment: Option<DeploymentId>,
    text: String,
    audience: FeedAudience,
}

impl Feed {
    /// Nothing happened yet. Numbers go on growing over restarts, as the clock does.
    pub fn new(now_ms: u64) -> Self {
        Self(Arc::new(Mutex::new(Entries { kept: VecDeque::new(), next: now_ms })))
    }

    /// The entry with this number, if the feed still holds it.
    pub fn get(&self, number: u64) -> Option<(FeedEntry, FeedAudience)> {
        self.entries().kept.iter().rev().find(|(entry, _)| entry.number == number).cloned()
    }

    /// The entries after `number`, the oldest first.
    pub fn after(&self, number: u64) -> Vec<(FeedEntry, FeedAudience)> {
        self.entries().kept.iter().filter(|(entry, _)| entry.number > number).cloned().collect()
    }

    fn say(&self, said: Said, at_ms: u64) -> u64 {
        let mut entries = self.entries();
        let number = entries.next;
        entries.next += 1;
        if entries.kept.len() >= MAX_FEED_ENTRIES {
            entries.kept.pop_front();
        }
        let Said { kind, level, robot, deployment, text, audience } = said;
        let (robot, robot_name) = robot.unzip();
        let text = one_line(&text);
        let entry = FeedEntry { number, at_ms, kind, level, robot, robot_name, deployment, text };
        entries.kept.push_back((entry, audience));
        number
    }

    fn entries(&self) -> MutexGuard<'_, Entries> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Gathers events and reports them, until `stop`.
    pub async fn run(self, source: FeedSource, changes: Changes, stop: CancellationToken) {
        let (mut happenings, mut notices) = (changes.happenings(), changes.subscribe());
        let mut health = source.broker.health();
        let (mut pending, mut turns) = (Pending::default(), 0u64);
        let (mut was_well, mut had_room) = (true, true);
        let mut ticks = tokio::time::interval(TURN);
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            let mut said = Vec::new();
            tokio::select! {
                () = stop.cancelled() => return,
                happening = happenings.recv() => match happening {
                    Ok(happening) => pending.take(happening),
                    // Events beyond the channel's capacity are too many to read.
                    Err(RecvError::Lagged(_)) => {}
                    Err(RecvError::Closed) => return,
                },
                notice = notices.recv() => match notice {
                    Ok(Change::Deployment(id)) => pending.deployment(id),
                    Ok(Change::RobotRemoved(robot)) => pending.removed(*robot),
                    Err(RecvError::Closed) => return,
                    Ok(_) | Err(RecvError::Lagged(_)) => {}
                },
                Ok(()) = health.changed() => said.extend(about_broker(&health.borrow_and_update(), &mut was_well)),
                _ = ticks.tick() => {
                    turns += 1;
                    if turns % DISK_TURNS == 1 {
                        said.extend(about_disk(&source, &mut had_room));
                    }
                    said.extend(pending.due(&source.store, source.clock.now_ms()).await);
                }
            }
            for said in said {
                let number = self.say(said, source.clock.now_ms());
                changes.announce(Change::Feed(number));
            }
        }
    }
}

/// A text that may come from a robot, as one line of limited length.
fn one_line(text: &str) -> String {
    let mut characters = text.chars().map(|c| if c.is_control() { ' ' } else { c });
    let line: String = characters.by_ref().take(MOST_CHARACTERS).collect();
    if characters.next().is_some() { line + "…" } else { line }
}

fn about_broker(health: &Health, was_well: &mut bool) -> Option<Said> {
    let (is_well, text) = match health {
        Health::Serving => (true, "the MQTT broker is back".to_owned()),
        Health::Recovering(seen) | Health::Failed(seen) => {
            (false, format!("the MQTT broker: {seen}"))
        }
    };
    (std::mem::replace(was_well, is_well) != is_well)
        .then(|| about_server(FeedKind::Broker, is_well, text))
}

fn about_disk(source: &FeedSource, had_room: &mut bool) -> Option<Said> {
    let (free, all) = room(&source.data)?;
    let percent = free.saturating_mul(100).checked_div(all)?;
    let has_room = percent >= LEAST_FREE_PERCENT;
    let text = format!("{percent}% of the server's disk are free");
    (std::mem::replace(had_room, has_room) != has_room)
        .then(|| about_server(FeedKind::Disk, has_room, text))
}

fn about_server(kind: FeedKind, is_well: bool, text: String) -> Said {
    let level = if is_well { LogLevel::Info } else { LogLevel::Error };
    Said { kind, level, robot: None, deployment: None, text, audience: FeedAudience::Everybody }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_feed_is_bounded_and_its_numbers_grow() {
        let feed = Feed::new(1000);
        for number in 0..=MAX_FEED_ENTRIES as u64 {
            assert_eq!(
                feed.say(about_server(FeedKind::Disk, true, String::new()), 7),
                1000 + number
            );
        }
        assert_eq!(feed.after(0).len(), MAX_FEED_ENTRIES);
        assert!(feed.get(1000).is_none() && feed.get(1001).is_some());
        assert_eq!(feed.after(1000 + MAX_FEED_ENTRIES as u64 - 1).len(), 1);
    }

    #[test]
    fn trouble_is_told_once_and_so_is_its_end() {
        let mut was_well = true;
        assert!(about_broker(&Health::Serving, &mut was_well).is_none());
        let trouble = Health::Recovering("no canary".to_owned());
        assert_eq!(
            about_broker(&trouble, &mut was_well).map(|said| said.level),
            Some(LogLevel::Error)
        );
        assert!(
            about_broker(&Health::Recovering("still none".to_owned()), &mut was_well).is_none()
        );
        assert_eq!(
            about_broker(&Health::Serving, &mut was_well).map(|said| said.level),
            Some(LogLevel::Info)
        );
    }
}
