//! Looks at every server for robots with a session there, and finds those that keep sessions at two
//! servers.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use crate::programs::server::{Server, ServerError};

/// A robot may have sessions at two servers for this long, while the older one ends.
const ALLOWED: Duration = Duration::from_secs(2);
/// Shortest pause between two looks.
const MIN_INTERVAL: Duration = Duration::from_millis(500);
/// Robots that are listed in a second of pause: a look at a large fleet is work for the servers.
const ROBOTS_PER_SECOND: u64 = 1000;
/// Time limit of a page: a paused server has no sessions that matter.
const PAGE_TIMEOUT: Duration = Duration::from_secs(3);

/// Robots seen at two servers at once, and since when.
#[derive(Debug, Default)]
pub struct DoubleSessions {
    since_ns: BTreeMap<String, u64>,
    /// Robots that kept two sessions for longer than allowed.
    pub found: BTreeSet<String>,
}

impl DoubleSessions {
    /// Adds a look at `at_ns`: the robots with a session at each server.
    pub fn see(&mut self, at_ns: u64, by_server: &[BTreeSet<String>]) {
        let mut counts: BTreeMap<&String, usize> = BTreeMap::new();
        for robot in by_server.iter().flatten() {
            *counts.entry(robot).or_default() += 1;
        }
        let double = |robot: &str| counts.get(&robot.to_owned()).is_some_and(|count| *count > 1);
        self.since_ns.retain(|robot, _| double(robot));
        for (robot, _) in counts.iter().filter(|(_, count)| **count > 1) {
            let since_ns = *self.since_ns.entry((*robot).clone()).or_insert(at_ns);
            if Duration::from_nanos(at_ns.saturating_sub(since_ns)) > ALLOWED {
                self.found.insert((*robot).clone());
            }
        }
    }
}

/// Looks again and again until `stop`; returns the robots with two sessions.
pub async fn watch(
    servers: Vec<(String, Arc<Server>)>,
    robots: usize,
    stop: CancellationToken,
) -> BTreeSet<String> {
    let pause = Duration::from_millis(robots as u64 * 1000 / ROBOTS_PER_SECOND).max(MIN_INTERVAL);
    let mut double = DoubleSessions::default();
    loop {
        let looks = servers.iter().map(|(name, server)| async move {
            let own = tokio::time::timeout(PAGE_TIMEOUT, own_sessions(name, server)).await;
            own.ok().and_then(Result::ok).unwrap_or_default()
        });
        let by_server = futures_util::future::join_all(looks).await;
        double.see(crate::system::clock::monotonic_ns(), &by_server);
        tokio::select! {
            () = stop.cancelled() => return double.found,
            () = tokio::time::sleep(pause) => {}
        }
    }
}

/// The robots whose sessions are at this server itself, by its own account.
async fn own_sessions(name: &str, server: &Server) -> Result<BTreeSet<String>, ServerError> {
    let mut own = BTreeSet::new();
    let mut after = None;
    loop {
        let page = server.sessions(after.as_ref()).await?;
        let here = page
            .sessions
            .into_iter()
            .filter(|session| session.node.as_ref().is_some_and(|node| node.as_str() == name));
        own.extend(here.map(|session| session.name.to_string()));
        after = page.next;
        if after.is_none() {
            return Ok(own);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn robots(names: &[&str]) -> BTreeSet<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    #[test]
    fn two_sessions_count_after_two_seconds() {
        let mut double = DoubleSessions::default();
        let look = [robots(&["a", "b", "c"]), robots(&["a", "b"])];
        double.see(1_000_000_000, &look);
        // One of them has left in between.
        double.see(2_000_000_000, &[robots(&["a", "b"]), robots(&["a"])]);
        double.see(3_500_000_000, &look);
        assert_eq!(double.found, robots(&["a"]));
        double.see(5_600_000_000, &look);
        assert_eq!(double.found, robots(&["a", "b"]));
    }
}
