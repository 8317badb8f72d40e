//! The event stream: notices of change, gathered for a moment, read once from the store and sent to every listener.
//! It never replays: whoever missed something is told so and fetches the lists again.

use std::collections::BTreeSet;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::response::sse::{Event as SentEvent, KeepAlive, Sse};
use futures_util::{Stream, StreamExt as _};
use http::{HeaderMap, header};
use task_proto::RobotId;
use task_proto::api::Event;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, broadcast};
use tokio_stream::wrappers::BroadcastStream;
use tokio_util::sync::CancellationToken;

use super::App;
use super::error::ApiError;
use super::views::complete_robot;
use crate::changes::{Change, Changes};
use crate::clock::Clock;
use crate::presence::Presence;
use crate::store::{Store, StoreError};

/// For how long notices are gathered: a robot that reports ten times in it is sent once.
const GATHER: Duration = Duration::from_millis(200);
/// Events a slow listener may fall behind before it misses some.
const BACKLOG: usize = 16 * 1024;
/// The most listeners at once.
const MOST_LISTENERS: usize = 512;
const KEEP_ALIVE: Duration = Duration::from_secs(15);

/// An event as it goes to every listener: written once.
#[derive(Debug, Clone)]
struct Line {
    name: &'static str,
    data: Arc<str>,
}

/// Where listeners come to.
#[derive(Clone)]
pub struct EventFeed {
    lines: broadcast::Sender<Line>,
    places: Arc<Semaphore>,
}

/// What the feed reads from.
pub struct EventSource {
    /// The database.
    pub store: Store,
    /// Who is there.
    pub presence: Arc<Presence>,
    /// The time.
    pub clock: Clock,
}

impl EventFeed {
    /// A feed without listeners; [`EventFeed::run`] fills it.
    pub fn new() -> Self {
        Self { lines: broadcast::Sender::new(BACKLOG), places: Arc::new(Semaphore::new(MOST_LISTENERS)) }
    }

    /// A place among the listeners, for as long as it is held.
    pub(super) fn place(&self) -> Result<OwnedSemaphorePermit, ApiError> {
        let place = self.places.clone().try_acquire_owned();
        place.map_err(|_| ApiError::unavailable("too many pages listen to events already"))
    }

    /// Turns notices into events until `stop`.
    pub async fn run(self, source: EventSource, changes: Changes, stop: CancellationToken) {
        let mut notices = changes.subscribe();
        loop {
            let first = tokio::select! {
                () = stop.cancelled() => return,
                first = notices.recv() => first,
            };
            tokio::select! {
                () = stop.cancelled() => return,
                () = tokio::time::sleep(GATHER) => {}
            }
            let mut gathered = BTreeSet::new();
            let mut has_missed = matches!(first, Err(broadcast::error::RecvError::Lagged(_)));
            gathered.extend(first);
            loop {
                match notices.try_recv() {
                    Ok(change) => drop(gathered.insert(change)),
                    Err(broadcast::error::TryRecvError::Lagged(_)) => has_missed = true,
                    Err(_) => break,
                }
            }
            if self.lines.receiver_count() == 0 {
                continue;
            }
            if let Err(error) = self.send_all(&source, gathered).await {
                tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "events could not be read; listeners are told to fetch the lists"
                );
                has_missed = true;
            }
            if has_missed {
                self.send(&Event::Missed);
            }
        }
    }

    async fn send_all(&self, source: &EventSource, gathered: BTreeSet<Change>) -> Result<(), StoreError> {
        let mut robots = BTreeSet::new();
        for change in gathered {
            match change {
                Change::Robot(id) => drop(robots.insert(id)),
                Change::RobotRemoved(id) => self.send(&Event::RobotRemoved { id }),
                Change::Package(name) => self.send(&Event::Package { name }),
                Change::Deployment(id) => {
                    if let Some(deployment) = source.store.deployment_summary(&id).await? {
                        self.send(&Event::Deployment { deployment: Box::new(deployment) });
                    }
                }
            }
        }
        let now_ms = source.clock.now_ms();
        let robots: Vec<RobotId> = robots.into_iter().collect();
        for mut robot in source.store.robots_among(&robots).await? {
            complete_robot(&mut robot, &source.presence, now_ms);
            self.send(&Event::Robot { robot: Box::new(robot) });
        }
        Ok(())
    }

    fn send(&self, event: &Event) {
        match serde_json::to_string(event) {
            // Nobody listening is fine.
            Ok(data) => drop(self.lines.send(Line { name: name_of(event), data: data.into() })),
            Err(error) => tracing::error!(%error, "an event could not be written"),
        }
    }
}

impl Default for EventFeed {
    fn default() -> Self {
        Self::new()
    }
}

fn name_of(event: &Event) -> &'static str {
    match event {
        Event::Robot { .. } => "robot",
        Event::RobotRemoved { .. } => "robot_removed",
        Event::Deployment { .. } => "deployment",
        Event::Package { .. } => "package",
        Event::Missed => "missed",
    }
}

/// `GET /events`: what changes from now on, until the server stops or the listener's session ends.
pub(super) async fn stream(
    State(app): State<App>,
    headers: HeaderMap,
) -> Result<Sse<impl Stream<Item = Result<SentEvent, Infallible>>>, ApiError> {
    let place = app.events.place()?;
    let lines = BroadcastStream::new(app.events.lines.subscribe());
    let events = lines.map(move |line| {
        // The place is free again when the stream is dropped.
        let _held = &place;
        Ok(match line {
            Ok(line) => SentEvent::default().event(line.name).data(line.data),
            Err(_) => SentEvent::default().event("missed").data(r#"{"type":"missed"}"#),
        })
    });
    // A first line, so that proxies pass the headers on and the page knows that it is connected.
    let greeting =
        futures_util::stream::iter([Ok(SentEvent::default().retry(Duration::from_secs(2)).comment("hello"))]);
    let events = greeting.chain(events).take_until(end_of_stream(&app, &headers)?);
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(KEEP_ALIVE)))
}

/// Resolves when whoever sent these headers may listen no longer. A session may have ended since the guard looked.
pub(super) fn end_of_stream(app: &App, headers: &HeaderMap) -> Result<impl Future<Output = ()> + use<>, ApiError> {
    let now_ms = app.clock.now_ms();
    let (ended, left) = if headers.contains_key(header::AUTHORIZATION) {
        (CancellationToken::new(), Duration::MAX)
    } else {
        let session = app.sessions.find(headers, now_ms);
        let session = session.ok_or_else(|| ApiError::unauthorized("the session has ended"))?;
        (session.ended, Duration::from_millis(session.expires_at_ms.saturating_sub(now_ms)))
    };
    let stop = app.stop.clone();
    Ok(async move {
        tokio::select! {
            () = stop.cancelled() => {}
            () = ended.cancelled() => {}
            () = tokio::time::sleep(left) => {}
        }
    })
}
