//! The event stream: notices of change are gathered for a moment, read once from the store and sent
//! to every subscriber with access to their robots. The stream never replays: a subscriber that
//! missed events is told and fetches the lists again.

use std::collections::{BTreeSet, HashSet, VecDeque};
use std::convert::Infallible;
use std::ops::RangeInclusive;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;

use axum::extract::State;
use axum::response::sse::{Event as SentEvent, KeepAlive, Sse};
use futures_util::{Stream, StreamExt as _};
use http::{HeaderMap, header};
use task_macros::operation;
use task_proto::api::Event;
use task_proto::trust::token::Token;
use task_proto::{DeploymentId, Digest, RobotId, UserName};
use tokio::sync::broadcast;
use tokio_stream::wrappers::BroadcastStream;
use tokio_util::sync::CancellationToken;

use super::auth::{authorization_token, session_digest};
use super::error::ApiError;
use super::views::{Views, narrowed};
use crate::domain::person::{Person, Scope};
use crate::orders::changes::{Change, Changes};
use crate::store::{FeedAudience, KnownRobot, Store, StoreError, TokenHolder};
use crate::system::clock::Clock;

/// Window in which notices are gathered: a robot that reports ten times in one window is sent once.
const BATCH_WINDOW: Duration = Duration::from_millis(200);
/// Number of events a slow subscriber may lag behind before it misses some.
const BACKLOG: usize = 16 * 1024;
/// Total bytes of the backlog. Above this, the oldest events are dropped, and subscribers that have
/// not taken them have missed them.
const BACKLOG_BYTES: usize = 64 << 20;
/// The most subscribers at once.
const MAX_SUBSCRIBERS: usize = 512;
/// The most subscribers of one person; otherwise one person could keep all others out.
const MAX_PER_PERSON: usize = 32;
/// Interval at which a stream checks its subscriber's rights without an announced change of rights.
const RIGHTS_INTERVAL: Duration = Duration::from_secs(30);
const KEEP_ALIVE: Duration = Duration::from_secs(15);

/// An event as sent to subscribers, serialized once.
#[derive(Debug, Clone)]
struct SerializedEvent {
    name: &'static str,
    text: Arc<EventText>,
    audience: Audience,
}

/// An event's text, kept while a subscriber has yet to take it and the backlog has room.
#[derive(Debug)]
struct EventText {
    text: Mutex<Option<Arc<str>>>,
    kept_bytes: Arc<AtomicUsize>,
}

impl EventText {
    fn get(&self) -> Option<Arc<str>> {
        self.text.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn release(&self) {
        if let Some(text) = self.text.lock().unwrap_or_else(PoisonError::into_inner).take() {
            self.kept_bytes.fetch_sub(text.len(), Ordering::Relaxed);
        }
    }
}

impl Drop for EventText {
    fn drop(&mut self) {
        self.release();
    }
}

/// The texts that wait for subscribers, the oldest first. A text that all subscribers have taken is
/// freed by itself.
#[derive(Debug, Clone, Default)]
struct Backlog {
    texts: Arc<Mutex<VecDeque<Weak<EventText>>>>,
    kept_bytes: Arc<AtomicUsize>,
}

impl Backlog {
    /// Appends a text, and drops the oldest while the backlog exceeds its bytes.
    fn append(&self, text: Arc<str>) -> Arc<EventText> {
        self.kept_bytes.fetch_add(text.len(), Ordering::Relaxed);
        let kept = Arc::new(EventText {
            text: Mutex::new(Some(text)),
            kept_bytes: self.kept_bytes.clone(),
        });
        let mut texts = self.texts.lock().unwrap_or_else(PoisonError::into_inner);
        texts.push_back(Arc::downgrade(&kept));
        while let Some(oldest) = texts.front() {
            match oldest.upgrade() {
                Some(text) if self.kept_bytes.load(Ordering::Relaxed) > BACKLOG_BYTES => {
                    text.release()
                }
                Some(_) => break,
                None => {}
            }
            texts.pop_front();
        }
        kept
    }
}

/// The subscribers that an event is for.
#[derive(Debug, Clone)]
enum Audience {
    Everyone,
    /// Subscribers that may see this robot.
    Robot(Arc<KnownRobot>),
    /// Subscribers with exactly this scope: they see only their part of a deployment.
    Scope(Scope),
    /// Subscribers with a scope limited to some robots.
    Limited,
}

impl Audience {
    fn includes(&self, scope: &Scope) -> bool {
        match self {
            Self::Everyone => true,
            Self::Robot(robot) => scope.covers(&robot.id, &robot.name, &robot.labels),
            Self::Scope(only) => only == scope,
            Self::Limited => !scope.is_everything(),
        }
    }
}

#[derive(Clone, PartialEq, Eq)]
struct Subscriber {
    name: UserName,
    scope: Scope,
}

/// The connected subscribers, one for each slot.
#[derive(Clone, Default)]
struct Subscribers(Arc<Mutex<Vec<Subscriber>>>);

impl Subscribers {
    fn all(&self) -> MutexGuard<'_, Vec<Subscriber>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The limited scopes of the subscribers, without duplicates.
    fn limited_scopes(&self) -> Vec<Scope> {
        let mut scopes: Vec<Scope> = Vec::new();
        for Subscriber { scope, .. } in self.all().iter() {
            if !scope.is_everything() && !scopes.contains(scope) {
                scopes.push(scope.clone());
            }
        }
        scopes
    }
}

/// A subscriber's slot; dropping the guard frees the slot.
pub(super) struct SubscriberSlot {
    subscribers: Subscribers,
    subscriber: Subscriber,
}

impl Drop for SubscriberSlot {
    fn drop(&mut self) {
        let mut all = self.subscribers.all();
        if let Some(at) = all.iter().position(|other| *other == self.subscriber) {
            all.swap_remove(at);
        }
    }
}

/// The feed that subscribers subscribe to.
#[derive(Clone)]
pub struct EventFeed {
    lines: broadcast::Sender<SerializedEvent>,
    backlog: Backlog,
    subscribers: Subscribers,
}

impl EventFeed {
    /// A feed without subscribers; [`EventFeed::run`] fills it.
    pub fn new() -> Self {
        let (lines, backlog) = (broadcast::Sender::new(BACKLOG), Backlog::default());
        Self { lines, backlog, subscribers: Subscribers::default() }
    }

    /// Reserves a slot for a person with this scope, until the guard is dropped.
    pub(super) fn reserve_slot(
        &self,
        name: &UserName,
        scope: &Scope,
    ) -> Result<SubscriberSlot, ApiError> {
        let mut all = self.subscribers.all();
        if all.len() >= MAX_SUBSCRIBERS {
            return Err(ApiError::unavailable("too many event streams are open"));
        }
        if all.iter().filter(|other| other.name == *name).count() >= MAX_PER_PERSON {
            let message = format!(
                "{name} already has {MAX_PER_PERSON} open streams of events and logs; close a page or a log"
            );
            return Err(ApiError::unavailable(message));
        }
        let subscriber = Subscriber { name: name.clone(), scope: scope.clone() };
        all.push(subscriber.clone());
        Ok(SubscriberSlot { subscribers: self.subscribers.clone(), subscriber })
    }

    /// The number of open streams.
    pub fn listeners(&self) -> usize {
        self.lines.receiver_count()
    }

    /// Turns notices into events with these views until `stop`.
    pub async fn run(self, views: Views, changes: Changes, stop: CancellationToken) {
        let mut notices = changes.subscribe();
        loop {
            let first = tokio::select! {
                () = stop.cancelled() => return,
                first = notices.recv() => first,
            };
            tokio::select! {
                () = stop.cancelled() => return,
                () = tokio::time::sleep(BATCH_WINDOW) => {}
            }
            let mut gathered = BTreeSet::new();
            let mut missed = matches!(first, Err(broadcast::error::RecvError::Lagged(_)));
            gathered.extend(first);
            loop {
                match notices.try_recv() {
                    Ok(change) => drop(gathered.insert(change)),
                    Err(broadcast::error::TryRecvError::Lagged(_)) => missed = true,
                    Err(_) => break,
                }
            }
            if self.lines.receiver_count() == 0 {
                continue;
            }
            if let Err(error) = self.send_all(&views, gathered).await {
                error.log("events could not be read; subscribers have to fetch the lists again");
                missed = true;
            }
            if missed {
                self.send(&Event::Missed, Audience::Everyone);
            }
        }
    }

    async fn send_all(&self, views: &Views, gathered: BTreeSet<Change>) -> Result<(), StoreError> {
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
                Change::Missed => self.send(&Event::Missed, Audience::Everyone),
                Change::Package(name) => self.send(&Event::Package { name }, Audience::Everyone),
                Change::Deployment(id) => drop(deployments.insert(id)),
                Change::Feed { first, last } => {
                    self.send_entries(&views.store, first..=last).await?;
                }
            }
        }
        self.send_deployments(views, deployments).await?;
        let robots: Vec<RobotId> = robots.into_iter().collect();
        views.peers.ask_for_figures(robots.iter()).await;
        for row in views.store.robots().among(&robots).await? {
            let audience = Audience::Robot(Arc::new(row.robot.clone()));
            self.send(&Event::Robot { robot: Box::new(views.of_robot(row)) }, audience);
        }
        Ok(())
    }

    /// Sends the feed entries with these numbers that still exist, each to its audience.
    async fn send_entries(
        &self,
        store: &Store,
        numbers: RangeInclusive<u64>,
    ) -> Result<(), StoreError> {
        for (entry, audience) in store.feed().between(&numbers).await? {
            let audience = match audience {
                FeedAudience::Everybody => Audience::Everyone,
                FeedAudience::Robot(robot) => Audience::Robot(Arc::new(robot)),
                FeedAudience::Unlimited => Audience::Scope(Scope::everything()),
            };
            self.send(&Event::Feed { entry }, audience);
        }
        Ok(())
    }

    /// Sends deployments. Subscribers with a limited scope get their part of a deployment; each part
    /// is read and serialized once per scope.
    async fn send_deployments(
        &self,
        views: &Views,
        deployments: BTreeSet<DeploymentId>,
    ) -> Result<(), StoreError> {
        if deployments.is_empty() {
            return Ok(());
        }
        let mut scopes = Vec::new();
        for scope in self.subscribers.limited_scopes() {
            let robots: HashSet<RobotId> =
                views.store.robots().ids_in(&scope).await?.into_iter().collect();
            scopes.push((scope, robots));
        }
        for id in deployments {
            let summary = views.store.deployments().summary(&id).await?;
            let Some(summary) = summary else { continue };
            let deployment = Box::new(summary.into_view(None));
            self.send(&Event::Deployment { deployment }, Audience::Scope(Scope::everything()));
            if scopes.is_empty() {
                continue;
            }
            let whole = views.store.deployments().get(&id, false).await?;
            let Some((whole, assignments)) = whole else { continue };
            for (scope, robots) in &scopes {
                if let Some((part, _)) = narrowed(whole.clone(), assignments.clone(), robots) {
                    let deployment = Box::new(part.into_view(None));
                    self.send(&Event::Deployment { deployment }, Audience::Scope(scope.clone()));
                }
            }
        }
        Ok(())
    }

    fn send(&self, event: &Event, audience: Audience) {
        match serde_json::to_string(event) {
            Ok(text) => self.send_text(name_of(event), text.into(), audience),
            Err(error) => tracing::error!(%error, "an event could not be serialized"),
        }
    }

    fn send_text(&self, name: &'static str, text: Arc<str>, audience: Audience) {
        // A send error only means that there are no subscribers.
        let _ =
            self.lines.send(SerializedEvent { name, text: self.backlog.append(text), audience });
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

/// Opens event streams, and ends each when its person may no longer listen.
#[derive(Clone)]
pub struct EventStreams {
    pub(super) events: EventFeed,
    pub(super) store: Store,
    pub(super) changes: Changes,
    pub(super) clock: Clock,
    pub(super) stop: CancellationToken,
}

/// The credential that a stream was opened with.
enum Credential {
    Token(Box<Token>),
    /// A page session, by its digest.
    Session(Digest),
}

impl EventStreams {
    /// Reserves a slot for a person with this scope, until the guard is dropped.
    pub(super) fn reserve_slot(
        &self,
        name: &UserName,
        scope: &Scope,
    ) -> Result<SubscriberSlot, ApiError> {
        self.events.reserve_slot(name, scope)
    }

    /// Resolves when the sender of these headers may no longer listen: the session ended (perhaps
    /// since the guard ran), the person's rights changed, or `robot` left the person's scope. After
    /// a change of rights, the client reconnects and gets its new view.
    pub(super) fn end(
        &self,
        by: Person,
        robot: Option<RobotId>,
        headers: &HeaderMap,
    ) -> Result<impl Future<Output = ()> + use<>, ApiError> {
        let credential = match session_digest(headers) {
            Some(session) if !headers.contains_key(header::AUTHORIZATION) => {
                Credential::Session(session)
            }
            _ => Credential::Token(Box::new(authorization_token(headers)?)),
        };
        let (stop, streams, mut rights) = (self.stop.clone(), self.clone(), self.changes.rights());
        let access_ended = async move {
            // While the database does not answer, no rights can change either.
            while streams.is_authorized(&by, &credential, robot.as_ref()).await.unwrap_or(true) {
                // Tokens and sessions can also expire without a notice.
                tokio::select! {
                    _ = rights.changed() => {}
                    () = tokio::time::sleep(RIGHTS_INTERVAL) => {}
                }
            }
        };
        Ok(async move {
            tokio::select! {
                () = stop.cancelled() => {}
                () = access_ended => {}
            }
        })
    }

    /// True while the credential still belongs to the same person with the same rights, and `robot`,
    /// if given, is in the person's scope.
    async fn is_authorized(
        &self,
        by: &Person,
        credential: &Credential,
        robot: Option<&RobotId>,
    ) -> Result<bool, StoreError> {
        let person = self.person(credential).await?;
        if !person.is_some_and(|person| person.has_the_rights_of(by)) {
            return Ok(false);
        }
        let Some(robot) = robot.filter(|_| !by.scope.is_everything()) else { return Ok(true) };
        let robot = self.store.robots().find(robot.as_str()).await?;
        Ok(robot.is_some_and(|robot| by.scope.covers(&robot.id, &robot.name, &robot.labels)))
    }

    /// The person that the credential stands for now.
    async fn person(&self, credential: &Credential) -> Result<Option<Person>, StoreError> {
        let now_ms = self.clock.now_ms();
        Ok(match credential {
            Credential::Token(token) => match self.store.tokens().holder(token, now_ms).await? {
                Some(TokenHolder::Person(person)) => Some(person),
                _ => None,
            },
            Credential::Session(session) => {
                let session = self.store.page_sessions().get(session, now_ms).await?;
                session.map(|session| session.person)
            }
        })
    }
}

/// Streams changes from now on, until the server stops or the session ends.
#[operation(tag = "events",
    responses((status = 200, description = "Server-sent events, each with an `Event` as its data.",
            content((Event = "text/event-stream"))),
        (status = 503, description = "Too many streams are open, in total or for this person.")))]
pub(super) async fn stream(
    State(streams): State<EventStreams>,
    by: Person,
    headers: HeaderMap,
) -> Result<Sse<impl Stream<Item = Result<SentEvent, Infallible>>>, ApiError> {
    // The slot is freed when the stream is dropped.
    let slot = streams.reserve_slot(&by.name, &by.scope)?;
    let lines = BroadcastStream::new(streams.events.lines.subscribe());
    let mut missed = false;
    let events = lines.filter_map(move |line| {
        let (name, text) = match line {
            Ok(line) if !line.audience.includes(&slot.subscriber.scope) => {
                return std::future::ready(None);
            }
            Ok(line) => (line.name, line.text.get()),
            Err(_) => ("missed", None),
        };
        // Several missed events in a row are announced once.
        let is_announced = std::mem::replace(&mut missed, text.is_none()) && missed;
        let event = match text {
            Some(text) => SentEvent::default().event(name).data(text),
            None => SentEvent::default().event("missed").data(r#"{"type":"missed"}"#),
        };
        std::future::ready((!is_announced).then_some(Ok(event)))
    });
    // An immediate first line makes proxies pass the headers on, and tells the page that the stream
    // is connected.
    let greeting = futures_util::stream::iter([Ok(SentEvent::default()
        .retry(Duration::from_secs(2))
        .comment("hello"))]);
    let events = greeting.chain(events).take_until(streams.end(by, None, &headers)?);
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(KEEP_ALIVE)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(text: &str) -> UserName {
        text.parse().expect("a name")
    }

    #[test]
    fn backlog_for_slow_subscribers_is_bounded_in_bytes() {
        const LINE_BYTES: usize = 1 << 20;
        let feed = EventFeed::new();
        let kept_bytes = || feed.backlog.kept_bytes.load(Ordering::Relaxed);
        let send = || feed.send_text("robot", "x".repeat(LINE_BYTES).into(), Audience::Everyone);
        send();
        assert_eq!(kept_bytes(), 0, "there is no subscriber");
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
    fn subscriptions_of_one_person_are_bounded() {
        let (feed, everything) = (EventFeed::new(), Scope::everything());
        let lab = Scope::of(["site=lab".parse().expect("a selector")]);
        let mut held: Vec<SubscriberSlot> = (0..MAX_PER_PERSON)
            .map(|n| {
                feed.reserve_slot(&name("alice"), if n % 2 == 0 { &everything } else { &lab })
                    .expect("room")
            })
            .collect();
        let refused =
            feed.reserve_slot(&name("alice"), &lab).map(drop).expect_err("she has her share");
        assert_eq!((refused.status.as_u16(), refused.code), (503, "unavailable"));
        assert!(refused.message.starts_with("alice already has"), "{}", refused.message);
        let bobs = feed.reserve_slot(&name("bob"), &lab).expect("there is room for others");
        assert_eq!(feed.subscribers.limited_scopes(), std::slice::from_ref(&lab));
        held.pop();
        held.push(feed.reserve_slot(&name("alice"), &everything).expect("one left"));
        drop((held, bobs));
        assert!(feed.subscribers.limited_scopes().is_empty() && feed.subscribers.all().is_empty());
    }

    #[test]
    fn subscriptions_of_all_people_are_bounded() {
        let (feed, everything) = (EventFeed::new(), Scope::everything());
        let names: Vec<UserName> =
            (0..=MAX_SUBSCRIBERS).map(|n| name(&format!("user{n}"))).collect();
        let held: Vec<SubscriberSlot> = names[1..]
            .iter()
            .map(|name| feed.reserve_slot(name, &everything).expect("room"))
            .collect();
        let refused =
            feed.reserve_slot(&names[0], &everything).map(drop).expect_err("all are taken");
        assert_eq!((refused.status.as_u16(), refused.code), (503, "unavailable"));
        drop(held);
        assert!(feed.reserve_slot(&names[0], &everything).is_ok());
    }
}
