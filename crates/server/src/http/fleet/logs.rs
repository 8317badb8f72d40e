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
use task_proto::api::{LogEvent, LogsFrom, LogsQuery, LogsView};
use task_proto::log::{LogBatch, LogLevel, LogLine, MAX_KEPT_LINES};
use task_proto::request::{Answer, Ask};
use task_proto::{RobotId, RobotName, TaskName};
use tokio_stream::wrappers::BroadcastStream;

use super::robots::find;
use crate::domain::person::{Person, Scope};
use crate::fleet::requests::RequestError;
use crate::fleet::robot_logs::{Joined, Told};
use crate::http::App;
use crate::http::error::ApiError;
use crate::http::events::end_of_stream;
use crate::http::extract::{PathParam, QueryParams};

/// Time limit for a robot to look up its lines, before memory is used instead.
const PATIENCE: Duration = Duration::from_secs(10);
/// How long a robot publishes after one request.
const LEASE: Duration = Duration::from_secs(60);
/// Interval at which the request is renewed.
const RENEWAL: Duration = Duration::from_secs(20);
/// Pause before the next request when the robot could not be reached.
const RETRY: Duration = Duration::from_secs(3);
const KEEP_ALIVE: Duration = Duration::from_secs(15);
const DEFAULT_LINES: u64 = 500;

/// Returns a robot's newest log lines, or with `follow` streams new lines.
#[utoipa::path(get, path = "/api/v1/robots/{robot}/logs", tag = "robots",
    responses((status = 200, description = "The lines; or server-sent events, each of which has a `LogEvent` as its data.",
            content((LogsView = "application/json"), (LogEvent = "text/event-stream"))),
        (status = 409, description = "`no_such_task`: the robot has no such task."),
        (status = 503, description = "Too many listen already, or this person too often.")))]
pub(in crate::http) async fn show(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
    QueryParams(query): QueryParams<LogsQuery>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let id = find(&app, &by, &robot).await?;
    let filter = Filter { task: query.task, level: query.level.unwrap_or(LogLevel::Debug) };
    if query.follow {
        return Ok(stream(&app, by, id, filter, &headers)?.into_response());
    }
    let max_lines = query.max_lines.unwrap_or(DEFAULT_LINES).min(MAX_KEPT_LINES as u64);
    Ok(Json(newest(&app, &id, filter, query.since_s, max_lines).await?).into_response())
}

/// The selection of log lines.
struct Filter {
    task: Option<TaskName>,
    level: LogLevel,
}

impl Filter {
    fn wants(&self, line: &LogLine) -> bool {
        line.level >= self.level && (self.task.is_none() || line.task == self.task)
    }
}

async fn newest(
    app: &App,
    robot: &RobotId,
    filter: Filter,
    since_s: Option<u64>,
    max_lines: u64,
) -> Result<LogsView, ApiError> {
    let since_ms = since_s.map(|since_s| since_s.saturating_mul(1000));
    let Filter { task, level } = &filter;
    let ask = Ask::Logs { task: task.clone(), level: *level, since_ms, max_lines };
    let reason = match app.requests.ask(&app.broker, robot, ask, PATIENCE).await {
        Ok(Answer::Logs(LogBatch { lines, suppressed, .. })) => {
            return Ok(LogsView {
                from: LogsFrom::Robot,
                age_ms: 0,
                reason: None,
                lines,
                suppressed,
            });
        }
        Ok(_) => "the robot gave another answer".to_owned(),
        Err(error @ RequestError::Refused(_)) if is_about_the_question(&error) => {
            return Err(error.into());
        }
        Err(error) => error.to_string(),
    };
    Ok(remembered(app, robot, &filter, since_ms, max_lines, reason))
}

/// True if the error concerns the question itself, so that memory has no answer either.
fn is_about_the_question(error: &RequestError) -> bool {
    matches!(error, RequestError::Refused(refusal) if refusal.code == "no_such_task")
}

fn remembered(
    app: &App,
    robot: &RobotId,
    filter: &Filter,
    since_ms: Option<u64>,
    max_lines: u64,
    reason: String,
) -> LogsView {
    let Some(kept) = app.logs.remembered(robot) else {
        let (lines, age_ms) = (Vec::new(), 0);
        return LogsView {
            from: LogsFrom::Server,
            age_ms,
            reason: Some(reason),
            lines,
            suppressed: 0,
        };
    };
    let age_ms = app.clock.now_ms().saturating_sub(kept.received_ms);
    // The robot's clock now, if it has run on evenly since its last message.
    let robot_now_ms = kept.robot_ms.saturating_add(age_ms);
    let oldest_ms = since_ms.map_or(0, |since_ms| robot_now_ms.saturating_sub(since_ms));
    let wanted =
        kept.lines.into_iter().filter(|line| line.at_ms >= oldest_ms && filter.wants(line));
    let mut lines: Vec<LogLine> = wanted.collect();
    let surplus = lines.len().saturating_sub(usize::try_from(max_lines).unwrap_or(usize::MAX));
    lines.drain(..surplus);
    LogsView {
        from: LogsFrom::Server,
        age_ms,
        reason: Some(reason),
        lines,
        suppressed: kept.suppressed,
    }
}

fn stream(
    app: &App,
    by: Person,
    robot: RobotId,
    filter: Filter,
    headers: &HeaderMap,
) -> Result<Sse<impl Stream<Item = Result<SentEvent, Infallible>> + use<>>, ApiError> {
    let place = app.events.place(&by.name, &Scope::everything())?;
    let end = end_of_stream(app, by, Some(robot.clone()), headers)?;
    let Joined { follower, told, is_first } = app.logs.follow(&robot, filter.level);
    if is_first {
        tokio::spawn(keep_following(app.clone(), robot));
    }
    let mut is_told = false;
    let events = BroadcastStream::new(told).filter_map(move |told| {
        // The places are freed when the stream is dropped.
        let _held = (&place, &follower);
        let event = match told {
            // A follower that joined later has not been told yet that the robot publishes.
            Ok(Told::Following { again }) => {
                (again || !std::mem::replace(&mut is_told, true)).then_some(LogEvent::Following)
            }
            Ok(Told::Away(reason)) => Some(LogEvent::Away { reason: reason.to_string() }),
            Ok(Told::Lines(batch)) => lines(&batch, &filter),
            // The listener lagged behind, so lines are missing.
            Err(_) => Some(LogEvent::Following),
        };
        std::future::ready(event.map(|event| Ok(sent(&event))))
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
        batch.lines.iter().filter(|line| filter.wants(line)).cloned().collect();
    (!lines.is_empty() || batch.suppressed > 0)
        .then_some(LogEvent::Lines { lines, suppressed: batch.suppressed })
}

fn sent(event: &LogEvent) -> SentEvent {
    let name = match event {
        LogEvent::Following => "following",
        LogEvent::Away { .. } => "away",
        LogEvent::Lines { .. } => "lines",
    };
    // Names, numbers and texts can always be serialized.
    SentEvent::default().event(name).data(serde_json::to_string(event).unwrap_or_default())
}

/// Keeps asking the robot to publish its lines while it has followers.
async fn keep_following(app: App, robot: RobotId) {
    let mut connection = None;
    while let Some(level) = app.logs.wanted(&robot) {
        let ask =
            Ask::Follow { level, lease_ms: u64::try_from(LEASE.as_millis()).unwrap_or(u64::MAX) };
        let now =
            app.presence.get(&robot, app.clock.now_ms()).and_then(|sighting| sighting.connection);
        let pause = match app.requests.ask(&app.broker, &robot, ask, PATIENCE).await {
            Ok(_) => {
                // The robot has a new connection: lines from the time in between are unknown.
                let again = connection.is_some_and(|last| Some(last) != now);
                connection = now;
                app.logs.tell(&robot, Told::Following { again });
                RENEWAL
            }
            Err(error) => {
                // Counts as a gap, whichever connection the robot comes back by.
                connection = connection.map(|_| 0);
                app.logs.tell(&robot, Told::Away(error.to_string().into()));
                RETRY
            }
        };
        let Some(changed) = app.logs.changed(&robot) else { return };
        tokio::select! {
            () = app.stop.cancelled() => return,
            () = tokio::time::sleep(pause) => {}
            () = changed.notified() => {}
        }
    }
}
