//! The event stream: notices of change are gathered for a moment, read once from the store and sent
//! to every listener with access to their robots. The stream never replays: a listener that missed
//! events is told and fetches the lists again.

use std::collections::{BTreeSet, HashSet, VecDeque};
use std::convert::Infallible;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;

use axum::extract::State;
use axum::response::sse::{Event as SentEvent, KeepAlive, Sse};
use futures_util::{Stream, StreamExt as _};
use http::{HeaderMap, header};
use task_proto::api::{DeploymentView, Event, RobotView};
use task_proto::token::Token;
use task_proto::{DeploymentId, RobotId, UserName};
use tokio::sync::broadcast;
use tokio_stream::wrappers::BroadcastStream;
use tokio_util::sync::CancellationToken;

use super::App;
use super::auth::shown_token;
use super::error::ApiError;
use super::views::{complete_robot, narrowed};
use crate::domain::person::{Person, Scope};
use crate::fleet::presence::Presence;
use crate::fleet::robot_vitals::RobotVitals;
use crate::limits::conduct::Conduct;
use crate::orders::changes::{Change, Changes};
use crate::orders::feed::{Feed, FeedAudience};
use crate::store::{KnownRobot, Store, StoreError, TokenHolder};
use crate::system::clock::Clock;

/// Window in which notices are gathered: a robot that reports ten times in one window is sent once.
const GATHER: Duration = Duration::from_millis(200);
/// Number of events a slow listener may lag behind before it misses some.
const BACKLOG: usize = 16 * 1024;
/// Total bytes of the backlog. Above this, the oldest events are dropped, and listeners that have
/// not taken them have missed them.
const BACKLOG_BYTES: usize = 64 << 20;
/// The most listeners at once.
const MOST_LISTENERS: usize = 512;
/// The most listeners of one person; otherwise one person could keep all others out.
const MOST_OF_ONE: usize = 32;
/// Interval at which a stream checks its listener's rights when no change of rights was announced.
const RIGHTS_INTERVAL: Duration = Duration::from_secs(30);
const KEEP_ALIVE: Duration = Duration::from_secs(15);

/// An event as sent to listeners, serialized once.
#[derive(Debug, Clone)]
struct Line {
    name: &'static str,
    text: Arc<Text>,
    audience: Audience,
}

/// An event's text, kept while a listener has yet to take it and the backlog has room.
#[derive(Debug)]
struct Text {
    text: Mutex<Option<Arc<str>>>,
    kept_bytes: Arc<AtomicUsize>,
}

impl Text {
    fn get(&self) -> Option<Arc<str>> {
        self.text.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn let_go(&self) {
        if let Some(text) = self.text.lock().unwrap_or_else(PoisonError::into_inner).take() {
            self.kept_bytes.fetch_sub(text.len(), Ordering::Relaxed);
        }
    }
}

impl Drop for Text {
    fn drop(&mut self) {
        self.let_go();
    }
}

/// The texts that wait for listeners, the oldest first. A text that all listeners have taken is
/// freed by itself.
#[derive(Debug, Clone, Default)]
struct Backlog {
    texts: Arc<Mutex<VecDeque<Weak<Text>>>>,
    kept_bytes: Arc<AtomicUsize>,
}

impl Backlog {
    /// Appends a text, and drops the oldest while the backlog exceeds its bytes.
    fn keep(&self, text: Arc<str>) -> Arc<Text> {
        self.kept_bytes.fetch_add(text.len(), Ordering::Relaxed);
        let kept =
            Arc::new(Text { text: Mutex::new(Some(text)), kept_bytes: self.kept_bytes.clone() });
        let mut texts = self.texts.lock().unwrap_or_else(PoisonError::into_inner);
        texts.push_back(Arc::downgrade(&kept));
        while let Some(oldest) = texts.front() {
            match oldest.upgrade() {
                Some(text) if self.kept_bytes.load(Ordering::Relaxed) > BACKLOG_BYTES => {
                    text.let_go()
                }
                Some(_) => break,
                None => {}
            }
            texts.pop_front();
        }
        kept
    }
}

/// The listeners that an event is for.
#[derive(Debug, Clone)]
enum Audience {
    Everybody,
    /// Listeners that may see this robot.
    Robot(Arc<KnownRobot>),
    /// Listeners with exactly this scope: they see only their part of a deployment.
    Scope(Scope),
    /// Listeners with a scope limited to some robots.
    Limited,
}

impl Audience {
    fn includes(&self, scope: &Scope) -> bool {
        match self {
            Self::Everybody => true,
            Self::Robot(robot) => scope.covers(&robot.id, &robot.name, &robot.labels),
            Self::Scope(only) => only == scope,
            Self::Limited => !scope.is_everything(),
        }
    }
}

#[derive(Clone, PartialEq, Eq)]
struct Listener {
    name: UserName,
    scope: Scope,
}

/// The connected listeners, one for each place taken.
#[derive(Clone, Default)]
struct Listeners(Arc<Mutex<Vec<Listener>>>);

impl Listeners {
    fn all(&self) -> MutexGuard<'_, Vec<Listener>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The limited scopes of the listeners, without duplicates.
    fn limited_scopes(&self) -> Vec<Scope> {
        let mut scopes: Vec<Scope> = Vec::new();
        for Listener { scope, .. } in self.all().iter() {
            if !scope.is_everything() && !scopes.contains(scope) {
                scopes.push(scope.clone());
            }
        }
        scopes
    }
}

/// A listener's place; dropping the guard frees the place.
pub(super) struct Place {
    listeners: Listeners,
    listener: Listener,
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut all = self.listeners.all();
        if let Some(at) = all.iter().position(|other| *other == self.listener) {
            all.swap_remove(at);
        }
    }
}

/// The feed that listeners subscribe to.
#[derive(Clone)]
pub struct EventFeed {
    lines: broadcast::Sender<Line>,
    backlog: Backlog,
    listeners: Listeners,
}

/// The sources that the feed reads from.
pub struct EventSource {
    pub store: Store,
    /// Presence of the robots.
    pub presence: Arc<Presence>,
    /// Rate-limit state of the robots.
    pub conduct: Arc<Conduct>,
    /// Vitals of the robots' machines.
    pub vitals: RobotVitals,
    /// The feed of recent events.
    pub feed: Feed,
    pub clock: Clock,
}

impl EventFeed {
    /// A feed without listeners; [`EventFeed::run`] fills it.
    pub fn new() -> Self {
        let (lines, backlog) = (broadcast::Sender::new(BACKLOG), Backlog::default());
        Self { lines, backlog, listeners: Listeners::default() }
    }

    /// Reserves a place for a person with this scope, until the guard is dropped.
    pub(super) fn place(&self, name: &UserName, scope: &Scope) -> Result<Place, ApiError> {
        let mut all = self.listeners.all();
        if all.len() >= MOST_LISTENERS {
            return Err(ApiError::unavailable("too many pages listen to events already"));
        }
        if all.iter().filter(|other| other.name == *name).count() >= MOST_OF_ONE {
            let message = format!(
                "{name} listens to events and logs {MOST_OF_ONE} times already; close a page or a log"
            );
            return Err(ApiError::unavailable(message));
        }
        let listener = Listener { name: name.clone(), scope: scope.clone() };
        all.push(listener.clone());
        Ok(Place { listeners: self.listeners.clone(), listener })
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
                error.log("events could not be read; listeners are told to fetch the lists");
                has_missed = true;
            }
            if has_missed {
                self.send(&Event::Missed, Audience::Everybody);
            }
        }
    }

    async fn send_all(
        &self,
        source: &EventSource,
        gathered: BTreeSet<Change>,
    ) -> Result<(), StoreError> {
        let (mut robots, mut deployments) = (BTreeSet::new(), BTreeSet::new());
        for change in gathered {
            match change {
                Change::Robot(id) => drop(robots.insert(id)),
                Change::RobotRemoved(robot) => {
                    self.send(
                        &Event::RobotRemoved { id: robot.id.clone() },
                        Audience::Robot(Arc::new(*robot)),
                    );
                }
                Change::Scopes => self.send(&Event::Missed, Audience::Limited),
                Change::Package(name) => self.send(&Event::Package { name }, Audience::Everybody),
                Change::Deployment(id) => drop(deployments.insert(id)),
                Change::Feed(number) => self.send_entry(source, number),
            }
        }
        self.send_deployments(source, deployments).await?;
        let now_ms = source.clock.now_ms();
        let robots: Vec<RobotId> = robots.into_iter().collect();
        for mut robot in source.store.robots_among(&robots).await? {
            complete_robot(&mut robot, &source.presence, &source.conduct, &source.vitals, now_ms);
            let RobotView { id, name, mac, labels, .. } = &robot;
            let known = KnownRobot {
                id: id.clone(),
                name: name.clone(),
                mac: *mac,
                labels: labels.clone(),
            };
            self.send(&Event::Robot { robot: Box::new(robot) }, Audience::Robot(Arc::new(known)));
        }
        Ok(())
    }

    /// Sends a feed entry to its audience, if the entry still exists.
    fn send_entry(&self, source: &EventSource, number: u64) {
        let Some((entry, audience)) = source.feed.get(number) else { return };
        let event = Event::Feed { entry };
        match audience {
            FeedAudience::Everybody => self.send(&event, Audience::Everybody),
            FeedAudience::Robot(robot) => self.send(&event, Audience::Robot(robot)),
            FeedAudience::Unlimited => self.send(&event, Audience::Scope(Scope::everything())),
        }
    }

    /// Sends deployments. Listeners with a limited scope get their part of a deployment; each part
    /// is read and serialized once per scope.
    async fn send_deployments(
        &self,
        source: &EventSource,
        deployments: BTreeSet<DeploymentId>,
    ) -> Result<(), StoreError> {
        if deployments.is_empty() {
            return Ok(());
        }
        let mut scopes = Vec::new();
        for scope in self.listeners.limited_scopes() {
            let robots: HashSet<RobotId> =
                source.store.robots_in(&scope).await?.into_iter().collect();
            scopes.push((scope, robots));
        }
        for id in deployments {
            let summary = source.store.deployment_summary(&id).await?;
            let Some(deployment) = summary.map(Box::new) else { continue };
            self.send(&Event::Deployment { deployment }, Audience::Scope(Scope::everything()));
            if scopes.is_empty() {
                continue;
            }
            let Some(whole) = source.store.deployment(&id, false).await? else { continue };
            for (scope, robots) in &scopes {
                if let Some(part) = narrowed(whole.clone(), robots) {
                    let deployment = Box::new(DeploymentView { assignments: None, ..part });
                    self.send(&Event::Deployment { deployment }, Audience::Scope(scope.clone()));
                }
            }
        }
        Ok(())
    }

    fn send(&self, event: &Event, audience: Audience) {
        match serde_json::to_string(event) {
            Ok(text) => self.send_text(name_of(event), text.into(), audience),
            Err(error) => tracing::error!(%error, "an event could not be written"),
        }
    }

    fn send_text(&self, name: &'static str, text: Arc<str>, audience: Audience) {
        // A send error only means that there are no listeners.
        let _ = self.lines.send(Line { name, text: self.backlog.keep(text), audience });
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
        Event::Feed { .. } => "feed",
        Event::Missed => "missed",
    }
}

/// Streams changes from now on, until the server stops or the session ends.
#[utoipa::path(get, path = "/api/v1/events", tag = "events",
    responses((status = 200, description = "Server-sent events, each of which has an `Event` as its data.",
            content((Event = "text/event-stream"))),
        (status = 503, description = "Too many listen already, or this person too often.")))]
pub(super) async fn stream(
    State(app): State<App>,
    by: Person,
    headers: HeaderMap,
) -> Result<Sse<impl Stream<Item = Result<SentEvent, Infallible>>>, ApiError> {
    // The place is freed when the stream is dropped.
    let place = app.events.place(&by.name, &by.scope)?;
    let lines = BroadcastStream::new(app.events.lines.subscribe());
    let mut has_missed = false;
    let events = lines.filter_map(move |line| {
        let (name, text) = match line {
            Ok(line) if !line.audience.includes(&place.listener.scope) => {
                return std::future::ready(None);
            }
            Ok(line) => (line.name, line.text.get()),
            Err(_) => ("missed", None),
        };
        // Several missed events in a row are announced once.
        let is_said = std::mem::replace(&mut has_missed, text.is_none()) && has_missed;
        let event = match text {
            Some(text) => SentEvent::default().event(name).data(text),
            None => SentEvent::default().event("missed").data(r#"{"type":"missed"}"#),
        };
        std::future::ready((!is_said).then_some(Ok(event)))
    });
    // An immediate first line makes proxies pass the headers on, and tells the page that the stream
    // is connected.
    let greeting = futures_util::stream::iter([Ok(SentEvent::default()
        .retry(Duration::from_secs(2))
        .comment("hello"))]);
    let events = greeting.chain(events).take_until(end_of_stream(&app, by, None, &headers)?);
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(KEEP_ALIVE)))
}

/// True while the token still belongs to the same person with the same rights, and `robot`, if
/// given, is in the person's scope.
async fn still_may(
    app: &App,
    by: &Person,
    token: &Token,
    robot: Option<&RobotId>,
) -> Result<bool, StoreError> {
    match app.store.token_holder(token, app.clock.now_ms()).await? {
        Some(TokenHolder::Person(person)) if person.has_the_rights_of(by) => {}
        _ => return Ok(false),
    }
    let Some(robot) = robot.filter(|_| !by.scope.is_everything()) else { return Ok(true) };
    let robot = app.store.find_robot(robot.as_str()).await?;
    Ok(robot.is_some_and(|robot| by.scope.covers(&robot.id, &robot.name, &robot.labels)))
}

/// Resolves when the sender of these headers may no longer listen: the session ended (perhaps since
/// the guard ran), the person's rights changed, or `robot` left the person's scope. After a change
/// of rights, the client reconnects and gets its new view.
pub(super) fn end_of_stream(
    app: &App,
    by: Person,
    robot: Option<RobotId>,
    headers: &HeaderMap,
) -> Result<impl Future<Output = ()> + use<>, ApiError> {
    let now_ms = app.clock.now_ms();
    let (token, ended, left) = if headers.contains_key(header::AUTHORIZATION) {
        (shown_token(headers)?, CancellationToken::new(), Duration::MAX)
    } else {
        let session = app.sessions.find(headers, now_ms);
        let session = session.ok_or_else(|| ApiError::unauthorized("the session has ended"))?;
        (
            session.token,
            session.ended,
            Duration::from_millis(session.expires_at_ms.saturating_sub(now_ms)),
        )
    };
    let (stop, app, mut rights) = (app.stop.clone(), app.clone(), app.changes.rights());
    let may_no_longer = async move {
        // While the database does not answer, no rights can change either.
        while still_may(&app, &by, &token, robot.as_ref()).await.unwrap_or(true) {
            // A token can also expire without a notice.
            tokio::select! {
                _ = rights.changed() => {}
                () = tokio::time::sleep(RIGHTS_INTERVAL) => {}
            }
        }
    };
    Ok(async move {
        tokio::select! {
            () = stop.cancelled() => {}
            () = ended.cancelled() => {}
            () = tokio::time::sleep(left) => {}
            () = may_no_longer => {}
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(text: &str) -> UserName {
        text.parse().expect("a name")
    }

    #[test]
    fn what_waits_for_slow_listeners_is_bounded_in_bytes() {
        const LINE_BYTES: usize = 1 << 20;
        let feed = EventFeed::new();
        let kept_bytes = || feed.backlog.kept_bytes.load(Ordering::Relaxed);
        let send = || feed.send_text("robot", "x".repeat(LINE_BYTES).into(), Audience::Everybody);
        send();
        assert_eq!(kept_bytes(), 0, "nobody listens");
        let mut slow = feed.lines.subscribe();
        let lines = BACKLOG_BYTES / LINE_BYTES + 3;
        for _ in 0..lines {
            send();
        }
        assert_eq!(kept_bytes(), BACKLOG_BYTES);
        let heard: Vec<bool> =
            (0..lines).map(|_| slow.try_recv().expect("a line").text.get().is_some()).collect();
        assert!(
            heard[..3].iter().all(|was_kept| !was_kept)
                && heard[3..].iter().all(|was_kept| *was_kept)
        );
        assert_eq!(kept_bytes(), 0, "all of them were taken");
    }

    #[test]
    fn one_person_has_a_share_of_the_places() {
        let (feed, everything) = (EventFeed::new(), Scope::everything());
        let lab = Scope::of(["site=lab".parse().expect("a selector")]);
        let mut held: Vec<Place> = (0..MOST_OF_ONE)
            .map(|n| {
                feed.place(&name("alice"), if n % 2 == 0 { &everything } else { &lab })
                    .expect("room")
            })
            .collect();
        let refused = feed.place(&name("alice"), &lab).map(drop).expect_err("she has her share");
        assert_eq!((refused.status.as_u16(), refused.code), (503, "unavailable"));
        assert!(refused.message.starts_with("alice listens"), "{}", refused.message);
        let bobs = feed.place(&name("bob"), &lab).expect("there is room for others");
        assert_eq!(feed.listeners.limited_scopes(), std::slice::from_ref(&lab));
        held.pop();
        held.push(feed.place(&name("alice"), &everything).expect("one left"));
        drop((held, bobs));
        assert!(feed.listeners.limited_scopes().is_empty() && feed.listeners.all().is_empty());
    }

    #[test]
    fn all_together_have_so_many_places() {
        let (feed, everything) = (EventFeed::new(), Scope::everything());
        let comers: Vec<UserName> =
            (0..=MOST_LISTENERS).map(|n| name(&format!("user{n}"))).collect();
        let held: Vec<Place> =
            comers[1..].iter().map(|name| feed.place(name, &everything).expect("room")).collect();
        let refused = feed.place(&comers[0], &everything).map(drop).expect_err("all are taken");
        assert_eq!((refused.status.as_u16(), refused.code), (503, "unavailable"));
        drop(held);
        assert!(feed.place(&comers[0], &everything).is_ok());
    }
}
