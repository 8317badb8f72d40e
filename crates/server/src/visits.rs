//! The connections by which robots came in over HTTP, so that those of a robot that may no more, or came by a token that
//! has ended, end at once, in the middle of a download or of what it sends. Of each it knows whether a good token was shown
//! on it, and how much it took. It decides nothing.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use task_proto::RobotId;
use tokio_util::sync::CancellationToken;

/// All connections of robots. There are no more of them than the listener lets in.
#[derive(Debug, Default)]
pub struct Visits {
    robots: Mutex<HashMap<RobotId, HashMap<u64, CancellationToken>>>,
    last_number: AtomicU64,
    ended: AtomicU64,
}

/// A connection, as its requests carry it along. Clones are the same.
#[derive(Debug, Clone, Default)]
pub struct Line {
    cut: CancellationToken,
    vouched: CancellationToken,
    bytes_out: Arc<AtomicU64>,
    /// The robot that came by it last.
    visit: Arc<Mutex<Option<Visit>>>,
}

/// That a robot came by a connection; over when it is dropped.
#[derive(Debug)]
struct Visit {
    visits: Arc<Visits>,
    robot: RobotId,
    number: u64,
}

/// Somebody who is about to come in.
#[derive(Debug)]
pub struct Arrival<'a> {
    visits: &'a Arc<Visits>,
    ended: u64,
}

impl Visits {
    /// Somebody comes. To be called before it is asked who that is.
    pub fn arrival(self: &Arc<Self>) -> Arrival<'_> {
        Arrival { visits: self, ended: self.ended.load(Ordering::SeqCst) }
    }

    fn begin(self: &Arc<Self>, robot: &RobotId, line: &Line) {
        let mut visit = line.visit.lock().unwrap_or_else(PoisonError::into_inner);
        if visit.as_ref().is_some_and(|visit| visit.robot == *robot) {
            return;
        }
        let number = self.last_number.fetch_add(1, Ordering::Relaxed);
        self.robots().entry(robot.clone()).or_default().insert(number, line.cut.clone());
        *visit = Some(Visit { visits: self.clone(), robot: robot.clone(), number });
    }

    /// Cuts all connections of the robot.
    pub fn end(&self, robot: &RobotId) {
        self.ended.fetch_add(1, Ordering::SeqCst);
        let lines = self.robots().remove(robot).unwrap_or_default();
        lines.values().for_each(CancellationToken::cancel);
    }

    fn robots(&self) -> MutexGuard<'_, HashMap<RobotId, HashMap<u64, CancellationToken>>> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing half-done.
        self.robots.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Arrival<'_> {
    /// It is this robot, and comes by `line`, which is cut when the robot is put out. False if a robot was put out since it
    /// came: as this one was not there yet to be cut, it has to be asked again who it is.
    pub fn enter(self, robot: &RobotId, line: &Line) -> bool {
        self.visits.begin(robot, line);
        self.visits.ended.load(Ordering::SeqCst) == self.ended
    }
}

impl Line {
    /// Somebody else comes by it now, as behind a proxy.
    pub fn leave(&self) {
        *self.visit.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    /// The other side took so much, as far as the system can tell.
    pub fn wrote(&self, bytes: usize) {
        self.bytes_out.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// How much that was so far.
    pub fn bytes_out(&self) -> u64 {
        self.bytes_out.load(Ordering::Relaxed)
    }

    /// Cuts it, in the middle of whatever it carries.
    pub fn end(&self) {
        self.cut.cancel();
    }

    /// A good token was shown on it.
    pub fn vouch(&self) {
        self.vouched.cancel();
    }

    /// Resolves when one was.
    pub async fn vouched(&self) {
        self.vouched.cancelled().await;
    }

    /// Resolves when the connection has to end.
    pub async fn cut(&self) {
        self.cut.cancelled().await;
    }
}

impl Drop for Visit {
    fn drop(&mut self) {
        let mut robots = self.visits.robots();
        if let Some(lines) = robots.get_mut(&self.robot) {
            lines.remove(&self.number);
            if lines.is_empty() {
                robots.remove(&self.robot);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_robots_own_lines_are_cut_and_nothing_is_kept() {
        let visits = Arc::new(Visits::default());
        let (one, other) = (RobotId::random(), RobotId::random());
        let (line, second, stranger) = (Line::default(), Line::default(), Line::default());
        for (robot, line) in [(&one, &line), (&one, &line), (&one, &second), (&other, &stranger)] {
            visits.begin(robot, line);
        }
        visits.end(&one);
        assert!(line.cut.is_cancelled() && second.cut.is_cancelled() && !stranger.cut.is_cancelled());
        // A connection that another robot's requests come by, behind a proxy, is that one's; or nobody's.
        visits.begin(&one, &stranger);
        visits.end(&other);
        stranger.leave();
        visits.end(&one);
        assert!(!stranger.cut.is_cancelled());
        drop((line, second, stranger));
        assert!(visits.robots().is_empty());
    }

    #[test]
    fn who_is_put_out_on_its_way_in_is_asked_again() {
        let (visits, robot) = (Arc::new(Visits::default()), RobotId::random());
        assert!(visits.arrival().enter(&robot, &Line::default()));
        let arrival = visits.arrival();
        visits.end(&robot);
        assert!(!arrival.enter(&robot, &Line::default()));
    }
}
