//! Delays robots that request or report too often, each robot separately, and refuses robots that
//! persist. Desired states, which may tell a robot to stop a task, are never refused for long.

use http::Method;
use task_proto::RobotId;
use tokio::time::{Instant, sleep_until};

use crate::http::App;
use crate::http::error::ApiError;
use crate::limits::conduct::{Verdict, Way};

/// Waits for the robot's next allowed request time. A refusal names that time.
pub(in crate::http) async fn hold_up(
    app: &App,
    robot: &RobotId,
    way: Way,
    method: &Method,
) -> Result<(), ApiError> {
    let now = Instant::now();
    let watched = app.conduct.watch(robot, way, now);
    // A robot that only polls gets its answer at each allowed time, even while barred.
    if *method != Method::GET
        && let Some(until) = watched.barred_until(now)
    {
        return Err(too_often(until, now));
    }
    match watched.asks(now) {
        Verdict::Fine => Ok(()),
        Verdict::Slow(until) => {
            sleep_until(until).await;
            Ok(())
        }
        Verdict::Cut(until) => Err(too_often(until, now)),
    }
}

fn too_often(until: Instant, now: Instant) -> ApiError {
    let seconds = until.duration_since(now).as_secs() + 1;
    let error = ApiError::too_many(format!(
        "this robot asks or reports too often: try again in {seconds} s"
    ));
    ApiError { retry_after_s: seconds, ..error }
}
