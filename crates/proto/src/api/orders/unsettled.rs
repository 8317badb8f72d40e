//! The robots that a deployment still waits for, by name.

use std::fmt;

use super::{AssignmentView, DeploymentView};

/// The most names listed for one group of robots.
const MAX_NAMES: usize = 20;

/// The robots on which a deployment has not settled.
#[derive(Debug, Default)]
pub struct UnsettledRobots<'a> {
    /// Online, and their batch has begun: the next batch waits for these robots.
    pub busy: Vec<&'a AssignmentView>,
    /// Online, and their batch has not begun.
    pub queued: Vec<&'a AssignmentView>,
    /// Offline: they continue when they are back, and the other robots don't wait for them.
    pub offline: Vec<&'a AssignmentView>,
    /// The number of selected robots that have no assignment yet.
    pub unplaced: u64,
}

impl DeploymentView {
    /// The robots on which the deployment has not settled; none if the view has no assignments.
    pub fn unsettled_robots(&self) -> UnsettledRobots<'_> {
        let unplaced =
            self.placing.map_or(0, |placing| placing.selected.saturating_sub(placing.placed));
        let mut unsettled = UnsettledRobots { unplaced, ..UnsettledRobots::default() };
        for one in self.assignments.iter().flatten().filter(|one| !one.phase.is_settled(self.kind))
        {
            match (one.online, one.released) {
                (false, _) => unsettled.offline.push(one),
                (true, true) => unsettled.busy.push(one),
                (true, false) => unsettled.queued.push(one),
            }
        }
        unsettled
    }
}

impl fmt::Display for UnsettledRobots<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let groups =
            [("waiting for ", &self.busy), ("next: ", &self.queued), ("offline: ", &self.offline)];
        let mut parts: Vec<String> = groups
            .iter()
            .filter(|(_, robots)| !robots.is_empty())
            .map(|(title, robots)| format!("{title}{}", join_names(robots, MAX_NAMES)))
            .collect();
        if self.unplaced > 0 {
            parts.push(format!("not placed yet: {} robots", self.unplaced));
        }
        if parts.is_empty() {
            f.write_str("settled on all robots")
        } else {
            f.write_str(&parts.join("; "))
        }
    }
}

/// The names of the first `most` robots, and the number of further robots.
pub fn join_names(robots: &[&AssignmentView], most: usize) -> String {
    let named: Vec<&str> = robots.iter().take(most).map(|one| one.name.as_str()).collect();
    match robots.len().saturating_sub(most) {
        0 => named.join(", "),
        more => format!("{} and {more} more", named.join(", ")),
    }
}
