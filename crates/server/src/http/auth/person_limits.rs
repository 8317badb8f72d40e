//! Request limits per person, over all tokens and sessions of that person: requests per second, and
//! requests under way. The limits keep one person's requests from delaying those of others. Orders
//! are counted apart from all other requests, so that a person's own reads never keep them from
//! stopping a robot.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use http::Method;
use task_proto::UserName;
use task_proto::people::roles::Permission;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, sleep_until, timeout};

use super::Access;
use crate::config::PersonRates;
use crate::domain::limits::rate_limit::{Admission, RateLimiter};
use crate::http::error::ApiError;

/// Limit on one person's requests of one kind under way. A browser sends up to six in parallel.
const MAX_CONCURRENT: usize = 8;
/// Limit on one person's questions to robots under way; each may wait for long. The server allows
/// 1,024 in all.
const MAX_CONCURRENT_QUESTIONS: usize = 64;
/// How long a request above the limit waits for another to end.
const QUEUE_TIMEOUT: Duration = Duration::from_secs(15);
/// A long answer counts as one further request for each of these bytes.
const BYTES_PER_REQUEST: u64 = 64 * 1024;
/// Above this number of entries, one per person and kind, we drop those without requests under way.
const SWEEP_ABOVE: usize = 1_024;

/// The class under which a person's request is counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(in crate::http) enum RequestKind {
    /// Changes the work or the settings of robots.
    Order,
    Change,
    /// Answered from the database.
    Read,
    /// Uploads a part of a package.
    Upload,
    /// Waits for a robot's answer.
    Question,
    /// Runs for long; the number of streams is bounded elsewhere.
    Stream,
}

impl RequestKind {
    /// The kind of a request for a route with this access. `is_stream`: the route has no deadline.
    pub(in crate::http) fn of(access: Access, method: &Method, is_stream: bool) -> Self {
        match access {
            Access::Person(Permission::Operate | Permission::Maintain) if !method.is_safe() => {
                Self::Order
            }
            Access::PersonOrRobot if !method.is_safe() => Self::Upload,
            _ if is_stream => Self::Stream,
            _ if method.is_safe() => Self::Read,
            _ => Self::Change,
        }
    }

    /// The most requests of this kind that one person may have under way.
    fn limit(self) -> usize {
        match self {
            Self::Order | Self::Change | Self::Read | Self::Upload => MAX_CONCURRENT,
            Self::Question => MAX_CONCURRENT_QUESTIONS,
            Self::Stream => Semaphore::MAX_PERMITS,
        }
    }
}

/// The request counts of all people.
#[derive(Debug)]
pub struct PersonLimits {
    orders: RateLimiter<UserName>,
    others: RateLimiter<UserName>,
    semaphores: Mutex<HashMap<(UserName, RequestKind), Arc<Semaphore>>>,
}

/// Guard of a request under way; dropping it frees the slot.
#[derive(Debug)]
pub(in crate::http) struct RequestPermit(
    #[expect(dead_code, reason = "it is held, not read")] Option<OwnedSemaphorePermit>,
);

impl PersonLimits {
    /// Limits without any counted requests.
    pub fn new(rates: PersonRates) -> Self {
        let limiter = || RateLimiter::new(rates.requests_per_s);
        Self { orders: limiter(), others: limiter(), semaphores: Mutex::default() }
    }

    /// Waits until the rate and the number of requests under way admit this request. The wait is
    /// bounded.
    pub(in crate::http) async fn begin(
        &self,
        person: &UserName,
        kind: RequestKind,
    ) -> Result<RequestPermit, ApiError> {
        let now = Instant::now();
        match self.limiter(kind).admit(person.clone(), now) {
            Admission::At(at) if at > now => sleep_until(at).await,
            Admission::At(_) => {}
            Admission::Refused(until) => {
                let seconds = until.duration_since(now).as_secs() + 1;
                let error = ApiError::too_many(format!(
                    "{person} sends too many requests: try again in {seconds} s"
                ));
                return Err(ApiError { retry_after_s: seconds, ..error });
            }
        }
        let ended = timeout(QUEUE_TIMEOUT, self.semaphores(person, kind).acquire_owned()).await;
        ended.map(|permit| RequestPermit(permit.ok())).map_err(|_| {
            let message = format!(
                "{person} already has {} requests in progress: try again when one has ended",
                kind.limit()
            );
            ApiError { retry_after_s: 1, ..ApiError::too_many(message) }
        })
    }

    /// Charges a long answer of this many bytes to the person's rate.
    pub(in crate::http) fn charge_answer(&self, person: &UserName, kind: RequestKind, bytes: u64) {
        let more = bytes / BYTES_PER_REQUEST;
        if more > 0 {
            self.limiter(kind).charge(person.clone(), more, Instant::now());
        }
    }

    fn limiter(&self, kind: RequestKind) -> &RateLimiter<UserName> {
        if kind == RequestKind::Order { &self.orders } else { &self.others }
    }

    fn semaphores(&self, person: &UserName, kind: RequestKind) -> Arc<Semaphore> {
        let mut all = self.lock();
        if all.len() >= SWEEP_ABOVE {
            // Each holder of a permit and each waiter also holds the semaphore.
            all.retain(|_, semaphore| Arc::strong_count(semaphore) > 1);
        }
        all.entry((person.clone(), kind))
            .or_insert_with(|| Arc::new(Semaphore::new(kind.limit())))
            .clone()
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<(UserName, RequestKind), Arc<Semaphore>>> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves no
        // inconsistent state.
        self.semaphores.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt as _;

    use super::*;

    fn person(name: &str) -> UserName {
        name.parse().expect("a name")
    }

    fn begun(
        limits: &PersonLimits,
        name: &str,
        kind: RequestKind,
    ) -> Option<Result<RequestPermit, ApiError>> {
        limits.begin(&person(name), kind).now_or_never()
    }

    #[tokio::test]
    async fn reads_that_use_up_their_rate_leave_orders_and_others_theirs() {
        let limits = PersonLimits::new(PersonRates { requests_per_s: 1 });
        limits.charge_answer(&person("alice"), RequestKind::Read, 1 << 30);
        let refused =
            begun(&limits, "alice", RequestKind::Change).expect("at once").expect_err("refused");
        assert_eq!(refused.status, http::StatusCode::TOO_MANY_REQUESTS);
        assert!((10..=11).contains(&refused.retry_after_s), "{}", refused.retry_after_s);
        for (name, kind) in [("alice", RequestKind::Order), ("bob", RequestKind::Read)] {
            begun(&limits, name, kind).expect("at once").expect("it has its own rate");
        }
    }

    #[tokio::test]
    async fn request_beyond_the_limit_waits_for_one_of_its_kind_to_end() {
        let limits = PersonLimits::new(PersonRates::default());
        let start =
            |_| begun(&limits, "alice", RequestKind::Read).expect("at once").expect("begun");
        let mut reads: Vec<_> = (0..MAX_CONCURRENT).map(start).collect();
        assert!(begun(&limits, "alice", RequestKind::Read).is_none(), "it waits");
        for (name, kind) in [
            ("alice", RequestKind::Order),
            ("alice", RequestKind::Stream),
            ("bob", RequestKind::Read),
        ] {
            begun(&limits, name, kind).expect("at once").expect("begun");
        }
        reads.pop();
        begun(&limits, "alice", RequestKind::Read).expect("at once").expect("begun");
        drop(reads);
        (0..SWEEP_ABOVE).for_each(|n| drop(begun(&limits, &format!("u{n}"), RequestKind::Read)));
        assert!(limits.lock().len() <= SWEEP_ABOVE);
    }

    #[test]
    fn orders_changes_and_reads_are_classified() {
        let kind = |permission, method| RequestKind::of(Access::Person(permission), &method, false);
        assert_eq!(kind(Permission::Operate, Method::POST), RequestKind::Order);
        assert_eq!(kind(Permission::Maintain, Method::DELETE), RequestKind::Order);
        assert_eq!(kind(Permission::Read, Method::GET), RequestKind::Read);
        assert_eq!(kind(Permission::Read, Method::POST), RequestKind::Change);
        assert_eq!(
            RequestKind::of(Access::PersonOrRobot, &Method::PATCH, true),
            RequestKind::Upload
        );
    }
}
