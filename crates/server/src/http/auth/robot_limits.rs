//! Delays robots that request or report too often, each robot separately, and refuses robots that
//! persist. Desired states, which may tell a robot to stop a task, are never refused for long.

use http::Method;
use task_proto::RobotId;
use tokio::time::{Instant, sleep_until};

use crate::domain::limits::robot_limiter::{Channel, Verdict};
use crate::http::App;
use crate::http::error::ApiError;

/// Waits for the robot's next allowed request time. A refusal names that time.
pub(in crate::http) async fn throttle(
    app: &App,
    robot: &RobotId,
    channel: Channel,
    method: &Method,
) -> Result<(), ApiError> {
    let now = Instant::now();
    let channel = app.robot_limiter.channel(robot, channel, now);
    // A robot that only polls gets its answer at each allowed time, even during its backoff.
    if *method != Method::GET
        && let Some(until) = channel.backoff_until(now)
    {
        return Err(rate_limited(until, now));
    }
    match channel.count_request(now) {
        Verdict::Fine => Ok(()),
        Verdict::Slow(until) => {
            sleep_until(until).await;
            Ok(())
        }
        Verdict::Cut(until) => Err(rate_limited(until, now)),
    }
}

fn rate_limited(until: Instant, now: Instant) -> ApiError {
    let seconds = until.duration_since(now).as_secs() + 1;
    let error =
        ApiError::too_many(format!("this robot sends too many requests: try again in {seconds} s"));
    ApiError { retry_after_s: seconds, ..error }
}
