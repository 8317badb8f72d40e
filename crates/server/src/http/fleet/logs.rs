//! Robots' log lines: recent lines, from the robot or else from memory, and a stream of new lines.
//! While a robot has followers, one task keeps asking the robot to publish. The task ends with the
//! last follower.

use std::convert::Infallible;
use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::response::sse::{Event as SentEvent, KeepAlive, Sse};
use axum::response::{IntoResponse as _, Response};
use futures_util::{Stream, StreamExt as _};
use http::HeaderMap;
use task_macros::operation;
use task_proto::api::{LogEvent, LogsFrom, LogsQuery, LogsView};
use task_proto::messages::request::{Answer, Ask};
use task_proto::telemetry::log::{LogBatch, LogLevel, LogLine, MAX_KEPT_LINES};
use task_proto::time::millis;
use task_proto::{RobotId, RobotName, TaskName};
use tokio_stream::wrappers::BroadcastStream;
use tokio_util::sync::CancellationToken;

use super::live_robots::LiveRobots;
use super::robots::find;
use crate::domain::person::{Person, Scope};
use crate::fleet::requests::RequestError;
use crate::fleet::robot_logs::{FollowEvent, Subscription};
use crate::http::error::ApiError;
use crate::http::events::EventStreams;
use crate::http::extract::{PathParam, QueryParams};
use crate::store::Store;

/// Time limit for a robot to look up its lines, before memory is used instead.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);
/// How long a robot publishes after one request.
const LEASE: Duration = Duration::from_secs(60);
/// Interval at which the request is renewed.
const RENEWAL: Duration = Duration::from_secs(20);
/// Pause before the next request when the robot could not be reached.
const RETRY: Duration = Duration::from_secs(3);
const KEEP_ALIVE: Duration = Duration::from_secs(15);
const DEFAULT_LINES: u64 = 500;

/// Returns a robot's newest log lines, or with `follow` streams new lines.
#[operation(tag = "robots",
    responses((status = 200, description = "The lines; or server-sent events, each with a `LogEvent` as its data.",
            content((LogsView = "application/json"), (LogEvent = "text/event-stream"))),
        (status = 409, description = "`no_such_task`: the robot has no such task."),
        (status = 503, description = "Too many streams are open, in total or for this person.")))]
pub(in crate::http) async fn show(
    State(store): State<Store>,
    State(live): State<LiveRobots>,
    State(streams): State<EventStreams>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
    QueryParams(query): QueryParams<LogsQuery>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let id = find(&store, &by, &robot).await?;
    let filter = Filter { task: query.task, level: query.level.unwrap_or(LogLevel::Debug) };
    if query.follow {
        return Ok(stream(&live, &streams, by, id, filter, &headers)?.into_response());
    }
    let max_lines = query.max_lines.unwrap_or(DEFAULT_LINES).min(MAX_KEPT_LINES as u64);
    Ok(Json(newest(&live, &id, filter, query.since_s, max_lines).await?).into_response())
}

/// The selection of log lines.
struct Filter {
    task: Option<TaskName>,
    level: LogLevel,
}

impl Filter {
    fn accepts(&self, line: &LogLine) -> bool {
        line.level >= self.level && (self.task.is_none() || line.task == self.task)
    }
}

async fn newest(
    live: &LiveRobots,
    robot: &RobotId,
    filter: Filter,
    since_s: Option<u64>,
    max_lines: u64,
) -> Result<LogsView, ApiError> {
    let since_ms = since_s.map(|since_s| since_s.saturating_mul(1000));
    let Filter { task, level } = &filter;
    let ask = Ask::Logs { task: task.clone(), level: *level, since_ms, max_lines };
    let reason = match live.ask(robot, ask, ANSWER_TIMEOUT).await {
        Ok(Answer::Logs(LogBatch { lines, suppressed, .. })) => {
            return Ok(LogsView {
                from: LogsFrom::Robot,
                age_ms: 0,
                reason: None,
                lines,
                suppressed,
            });
        }
        Ok(_) => "the robot sent an unexpected answer".to_owned(),
        Err(error @ RequestError::Refused(_)) if is_unknown_task(&error) => {
            return Err(error.into());
        }
        Err(error) => error.to_string(),
    };
    Ok(remembered_lines(live, robot, &filter, since_ms, max_lines, reason))
}

/// True if the error concerns the question itself, so that memory has no answer either.
fn is_unknown_task(error: &RequestError) -> bool {
    matches!(error, RequestError::Refused(refusal) if refusal.code == "no_such_task")
}

fn remembered_lines(
    live: &LiveRobots,
    robot: &RobotId,
    filter: &Filter,
    since_ms: Option<u64>,
    max_lines: u64,
    reason: String,
) -> LogsView {
    let Some(snapshot) = live.logs.snapshot(robot) else {
        let (lines, age_ms) = (Vec::new(), 0);
        return LogsView {
            from: LogsFrom::Server,
            age_ms,
            reason: Some(reason),
            lines,
            suppressed: 0,
        };
    };
    let age_ms = live.clock.now_ms().saturating_sub(snapshot.received_ms);
    // The robot's clock now, if it has run on evenly since its last message.
    let robot_now_ms = snapshot.robot_ms.saturating_add(age_ms);
    let oldest_ms = since_ms.map_or(0, |since_ms| robot_now_ms.saturating_sub(since_ms));
    let matching =
        snapshot.lines.into_iter().filter(|line| line.at_ms >= oldest_ms && filter.accepts(line));
    let mut lines: Vec<LogLine> = matching.collect();
    let surplus = lines.len().saturating_sub(usize::try_from(max_lines).unwrap_or(usize::MAX));
    lines.drain(..surplus);
    LogsView {
        from: LogsFrom::Server,
        age_ms,
        reason: Some(reason),
        lines,
        suppressed: snapshot.suppressed,
    }
}

fn stream(
    live: &LiveRobots,
    streams: &EventStreams,
    by: Person,
    robot: RobotId,
    filter: Filter,
    headers: &HeaderMap,
) -> Result<Sse<impl Stream<Item = Result<SentEvent, Infallible>> + use<>>, ApiError> {
    let slot = streams.reserve_slot(&by.name, &Scope::everything())?;
    let end = streams.end(by, Some(robot.clone()), headers)?;
    let Subscription { follower, events, is_first } = live.logs.follow(&robot, filter.level);
    if is_first {
        tokio::spawn(keep_following(live.clone(), streams.stop.clone(), robot));
    }
    let mut was_confirmed = false;
    let is_here = |event: &Result<_, _>| !matches!(event, Ok(FollowEvent::Moved));
    let events = BroadcastStream::new(events)
        .take_while(move |event| std::future::ready(is_here(event)))
        .filter_map(move |event| {
            // The slots are freed when the stream is dropped.
            let _held = (&slot, &follower);
            let event = match event {
                // A follower that joined later has not been told yet that the robot publishes.
                Ok(FollowEvent::Following { again }) => (again
                    || !std::mem::replace(&mut was_confirmed, true))
                .then_some(LogEvent::Following),
                Ok(FollowEvent::Away(reason)) => {
                    Some(LogEvent::Away { reason: reason.to_string() })
                }
                Ok(FollowEvent::Lines(batch)) => lines(&batch, &filter),
                Ok(FollowEvent::Moved) => None,
                // The listener lagged behind, so lines are missing.
                Err(_) => Some(LogEvent::Following),
            };
            std::future::ready(event.map(|event| Ok(sse_event(&event))))
        });
    // An immediate first line makes proxies pass the headers on, and tells the listener that the
    // stream is connected.
    let greeting = futures_util::stream::iter([Ok(SentEvent::default()
        .retry(Duration::from_secs(2))
        .comment("hello"))]);
    Ok(Sse::new(greeting.chain(events).take_until(end))
        .keep_alive(KeepAlive::new().interval(KEEP_ALIVE)))
}

fn lines(batch: &LogBatch, filter: &Filter) -> Option<LogEvent> {
    let lines: Vec<LogLine> =
        batch.lines.iter().filter(|line| filter.accepts(line)).cloned().collect();
    (!lines.is_empty() || batch.suppressed > 0)
        .then_some(LogEvent::Lines { lines, suppressed: batch.suppressed })
}

fn sse_event(event: &LogEvent) -> SentEvent {
    let name = match event {
        LogEvent::Following => "following",
        LogEvent::Away { .. } => "away",
        LogEvent::Lines { .. } => "lines",
    };
    // Names, numbers and texts can always be serialized.
    SentEvent::default().event(name).data(serde_json::to_string(event).unwrap_or_default())
}

/// Keeps asking the robot to publish its lines while it has followers.
async fn keep_following(live: LiveRobots, stop: CancellationToken, robot: RobotId) {
    let mut connection = None;
    while let Some(level) = live.logs.requested_level(&robot) {
        let ask = Ask::Follow { level, lease_ms: millis(LEASE) };
        let now =
            live.presence.get(&robot, live.clock.now_ms()).and_then(|presence| presence.connection);
        let pause = match live.ask(&robot, ask, ANSWER_TIMEOUT).await {
            Ok(_) => {
                // The robot has a new connection: lines from the time in between are unknown.
                let again = connection.is_some_and(|last| Some(last) != now);
                connection = now;
                live.logs.notify_followers(&robot, FollowEvent::Following { again });
                RENEWAL
            }
            Err(error) => {
                // Counts as a gap, whichever connection the robot comes back by.
                connection = connection.map(|_| 0);
                let event = match live.is_elsewhere(&robot).await {
                    true => FollowEvent::Moved,
                    false => FollowEvent::Away(error.to_string().into()),
                };
                live.logs.notify_followers(&robot, event);
                RETRY
            }
        };
        let Some(changed) = live.logs.changed(&robot) else { return };
        tokio::select! {
            () = stop.cancelled() => return,
            () = tokio::time::sleep(pause) => {}
            () = changed.notified() => {}
        }
    }
}
