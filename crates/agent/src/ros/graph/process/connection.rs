//! The agent's end of the pipes to the program that takes part in the graph. It forwards requests,
//! keeps the program's last state, and ends the program when the graph is no longer needed, when
//! the program hangs, or when the program violates the protocol. The program reads bytes from
//! untrusted senders, so its output is bounded here and decides nothing.

use std::collections::HashMap;
use std::pin::pin;
use std::process::ExitStatus;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use task_proto::telemetry::ros::GraphName;
use task_proto::time::millis;
use tokio::io::{AsyncWriteExt as _, BufReader};
use tokio::process::{Child, ChildStdin, ChildStdout};
use tokio::sync::{broadcast, mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::program::GraphProgram;
use super::protocol::{ALIVE_INTERVAL, Answer, Call, Event, Lines, MAX_EVENT_BYTES, Request};
use crate::ros::graph::dds::snapshot::Snapshot;
use crate::ros::graph::feeds::{CAPACITY, DiagnosticStatus, RosoutLine};
use crate::ros::graph::rate::{Rate, RateMeter};
use crate::ros::graph::{GraphError, GraphSettings};

/// Maximum time for the program to join the graph.
const JOIN_TIMEOUT: Duration = Duration::from_secs(20);
/// Maximum silence of the program.
const SILENCE_TIMEOUT: Duration = ALIVE_INTERVAL.saturating_mul(7);
/// Extra time for an answer beyond the requested limit: a call for all parameters consists of
/// several calls.
const CALL_SLACK: Duration = Duration::from_secs(5);
/// Maximum number of calls to a node that one request may need. The time limit of a request applies
/// to each of them.
const CALLS_PER_REQUEST: u32 = 40;
/// Maximum time for the program to leave the graph.
const LEAVE_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum number of requests that wait to be written.
const QUEUED_REQUESTS: usize = 512;
/// Maximum number of pending calls, and of topics that are counted.
const MAX_CALLS: usize = 256;
const MAX_METERS: usize = 1024;

/// A connection to the program; see the module.
pub(in crate::ros::graph) struct Connection {
    pid: u32,
    requests: mpsc::Sender<Request>,
    numbers: AtomicU64,
    missed: AtomicU64,
    routes: Mutex<Routes>,
}

/// Destinations of the program's events. All of them are dropped once the program has ended.
#[derive(Default)]
struct Routes {
    closed: bool,
    calls: HashMap<u64, oneshot::Sender<Result<Answer, GraphError>>>,
    meters: HashMap<u64, watch::Sender<(Rate, Instant)>>,
    rosout: Option<broadcast::Sender<Arc<RosoutLine>>>,
    diagnostics: Option<broadcast::Sender<Arc<DiagnosticStatus>>>,
}

type Events = Lines<BufReader<ChildStdout>>;

impl Connection {
    /// Starts the program and waits until it takes part in the graph. The connection ends with
    /// `closing`, and cancels `closing` if the program ends first.
    pub async fn open(
        settings: GraphSettings,
        program: &GraphProgram,
        closing: &CancellationToken,
        tracker: &TaskTracker,
    ) -> Result<(Arc<Self>, watch::Receiver<Arc<Snapshot>>), GraphError> {
        let failed = |error: std::io::Error| GraphError::Start { reason: error.to_string() };
        let starting = program.clone();
        let started = tokio::task::spawn_blocking(move || starting.start()).await;
        let mut child = started.map_err(std::io::Error::other).flatten().map_err(failed)?;
        let pipes = (child.stdin.take(), child.stdout.take(), child.id());
        let (Some(mut input), Some(output), Some(pid)) = pipes else {
            return Err(GraphError::Closed);
        };
        let mut events = Lines::new(BufReader::new(output), MAX_EVENT_BYTES);
        let joining = join(settings, &mut input, &mut events);
        let too_late =
            || GraphError::Start { reason: format!("it did not join within {JOIN_TIMEOUT:?}") };
        let joined = tokio::time::timeout(JOIN_TIMEOUT, joining).await;
        if let Err(error) = joined.unwrap_or_else(|_| Err(too_late())) {
            let _ = child.kill().await;
            program.clean_up().await;
            return Err(error);
        }
        let (requests, queued) = mpsc::channel(QUEUED_REQUESTS);
        let (snapshots, snapshot) = watch::channel(Arc::new(Snapshot::empty(Instant::now())));
        let connection = Arc::new(Self {
            pid,
            requests,
            numbers: AtomicU64::new(1),
            missed: AtomicU64::new(0),
            routes: Mutex::default(),
        });
        let running = connection.clone();
        let closing = closing.clone();
        let program = program.clone();
        tracker.spawn(async move {
            let end = running.exchange(&closing, events, (input, queued), &snapshots).await;
            closing.cancel();
            // The end of the changes wakes callers that then ask whether the graph is closed.
            drop(snapshots);
            running.end_waits();
            leave(child, end).await;
            program.clean_up().await;
        });
        Ok((connection, snapshot))
    }

    /// Forwards messages both ways until one side ends. The program's input ends with this call,
    /// and the program ends with its input.
    async fn exchange(
        &self,
        closing: &CancellationToken,
        events: Events,
        (input, queued): (ChildStdin, mpsc::Receiver<Request>),
        snapshots: &watch::Sender<Arc<Snapshot>>,
    ) -> SessionEnd {
        let mut receiving = pin!(self.receive(events, snapshots));
        let mut sending = pin!(write(input, queued));
        tokio::select! {
            // Nothing follows: unsent and unread messages are of no use any more.
            () = closing.cancelled() => SessionEnd::Closed,
            why = &mut receiving => SessionEnd::Lost(why),
            why = &mut sending => SessionEnd::Lost(why),
        }
    }

    /// Processes the program's events; returns the reason for their end.
    async fn receive(
        &self,
        mut events: Events,
        snapshots: &watch::Sender<Arc<Snapshot>>,
    ) -> String {
        loop {
            match tokio::time::timeout(SILENCE_TIMEOUT, events.next::<Event>()).await {
                Ok(Ok(Some(event))) => self.handle_event(event, snapshots),
                Ok(Ok(None)) => return "it has ended".to_owned(),
                Ok(Err(error)) => return error.to_string(),
                Err(_) => return format!("no output for {SILENCE_TIMEOUT:?}"),
            }
        }
    }

    fn handle_event(&self, event: Event, snapshots: &watch::Sender<Arc<Snapshot>>) {
        match event {
            Event::Snapshot(message) => {
                let now = Instant::now();
                snapshots.send_modify(|current| {
                    *current = Arc::new(message.into_snapshot(now, current))
                });
            }
            Event::Unchanged { age_ms } => {
                let now = Instant::now();
                let at = now.checked_sub(Duration::from_millis(age_ms)).unwrap_or(now);
                // No receiver is woken: the graph has not changed.
                snapshots.send_if_modified(|current| {
                    Arc::make_mut(current).at = at;
                    false
                });
            }
            Event::Answer { id, answer } => self.complete_call(id, Ok(answer)),
            Event::Refused { id, error } => self.complete_call(id, Err(error)),
            Event::Rosout(line) => {
                let listeners = self.routes().rosout.clone();
                // Without a current listener the line is dropped, not kept for later.
                listeners.map(|listeners| listeners.send(Arc::new(line)));
            }
            Event::Diagnostic(status) => {
                let listeners = self.routes().diagnostics.clone();
                listeners.map(|listeners| listeners.send(Arc::new(status)));
            }
            Event::Missed { count } => {
                self.missed.fetch_add(count, Ordering::Relaxed);
            }
            Event::Rate { meter, hz, since_last_ms, samples } => {
                let rate =
                    Rate { hz, since_last: since_last_ms.map(Duration::from_millis), samples };
                if let Some(known) = self.routes().meters.get(&meter) {
                    known.send_replace((rate, Instant::now()));
                }
            }
            // These events come only once, at the beginning.
            Event::Joined | Event::Failed { .. } => {}
        }
    }

    fn complete_call(&self, id: u64, answer: Result<Answer, GraphError>) {
        let caller = self.routes().calls.remove(&id);
        // The caller may have gone.
        let _ = caller.map(|caller| caller.send(answer));
    }

    /// Ends all waits for answers and events.
    fn end_waits(&self) {
        *self.routes() = Routes { closed: true, ..Routes::default() };
    }

    pub fn pid(&self) -> u32 {
        self.pid
    }

    /// Number of feed messages that the program could not forward.
    pub fn missed_messages(&self) -> u64 {
        self.missed.load(Ordering::Relaxed)
    }

    /// Queues a request for the program, without waiting.
    pub fn send(&self, request: Request) -> Result<(), GraphError> {
        self.requests.try_send(request).map_err(|error| match error {
            mpsc::error::TrySendError::Full(_) => GraphError::Busy,
            mpsc::error::TrySendError::Closed(_) => GraphError::Closed,
        })
    }

    /// Has the program make a call. `within` applies to each of the calls to a node that this
    /// takes.
    pub async fn call(&self, call: Call, within: Duration) -> Result<Answer, GraphError> {
        let id = self.next_number();
        let within_ms = millis(within);
        let (answer, answered) = oneshot::channel();
        {
            let mut routes = self.routes();
            // Calls without a waiting caller are removed.
            routes.calls.retain(|_, caller| !caller.is_closed());
            if routes.closed {
                return Err(GraphError::Closed);
            }
            if routes.calls.len() >= MAX_CALLS {
                return Err(GraphError::Busy);
            }
            routes.calls.insert(id, answer);
        }
        self.send(Request::Call { id, within_ms, call })?;
        let time_limit = within.saturating_mul(CALLS_PER_REQUEST).saturating_add(CALL_SLACK);
        match tokio::time::timeout(time_limit, answered).await {
            Ok(Ok(answer)) => answer,
            Ok(Err(_)) => Err(GraphError::Closed),
            Err(_) => Err(GraphError::Write {
                reason: "the program on the graph does not answer".to_owned(),
            }),
        }
    }

    /// Subscribes to the log lines of nodes.
    pub fn rosout(&self) -> Result<broadcast::Receiver<Arc<RosoutLine>>, GraphError> {
        let mut routes = self.routes();
        if routes.closed {
            return Err(GraphError::Closed);
        }
        Ok(routes.rosout.get_or_insert_with(|| broadcast::channel(CAPACITY).0).subscribe())
    }

    /// Subscribes to the diagnostics that nodes publish about the robot's parts.
    pub fn diagnostics(&self) -> Result<broadcast::Receiver<Arc<DiagnosticStatus>>, GraphError> {
        let mut routes = self.routes();
        if routes.closed {
            return Err(GraphError::Closed);
        }
        Ok(routes.diagnostics.get_or_insert_with(|| broadcast::channel(CAPACITY).0).subscribe())
    }

    /// Has the program count a topic's messages until the meter is dropped.
    pub fn meter(this: &Arc<Self>, topic: &GraphName, kind: &str) -> Result<RateMeter, GraphError> {
        let meter = this.next_number();
        let (rate, last) = watch::channel((Rate::NONE, Instant::now()));
        {
            let mut routes = this.routes();
            if routes.closed {
                return Err(GraphError::Closed);
            }
            if routes.meters.len() >= MAX_METERS {
                return Err(GraphError::Busy);
            }
            routes.meters.insert(meter, rate.clone());
        }
        let counting =
            this.send(Request::Count { meter, topic: topic.clone(), kind: kind.to_owned() });
        if let Err(error) = counting {
            this.routes().meters.remove(&meter);
            return Err(error);
        }
        let connection = Arc::downgrade(this);
        let ending = CancellationToken::new();
        let dropped = ending.clone();
        // This task is detached: the meter's owner may keep it longer than the graph exists.
        tokio::spawn(async move {
            // Cancel-safe: either way it is over.
            tokio::select! {
                () = dropped.cancelled() => {}
                () = rate.closed() => {}
            }
            let Some(connection) = connection.upgrade() else { return };
            let counted = connection.routes().meters.remove(&meter).is_some();
            if counted && connection.requests.send(Request::StopCounting { meter }).await.is_err() {
                tracing::trace!("the graph has ended, and its meters with it");
            }
        });
        Ok(RateMeter::new(last, ending))
    }

    fn next_number(&self) -> u64 {
        self.numbers.fetch_add(1, Ordering::Relaxed)
    }

    fn routes(&self) -> MutexGuard<'_, Routes> {
        // Maps of senders stay valid after a panic.
        self.routes.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Reasons for the end of the exchange with the program.
enum SessionEnd {
    /// The graph is no longer needed.
    Closed,
    /// The program has ended, or must be ended.
    Lost(String),
}

async fn join(
    settings: GraphSettings,
    input: &mut ChildStdin,
    events: &mut Events,
) -> Result<(), GraphError> {
    let failed = |error: std::io::Error| GraphError::Start { reason: error.to_string() };
    let line = Request::Join(settings).line().map_err(failed)?;
    // A program that ends at once may have written its reason.
    let written = input.write_all(&line).await;
    loop {
        match events.next().await.map_err(failed)? {
            Some(Event::Joined) => return Ok(()),
            Some(Event::Failed { error }) => return Err(error),
            Some(_) => {}
            None => {
                written.map_err(failed)?;
                return Err(GraphError::Start { reason: "it ended at once".to_owned() });
            }
        }
    }
}

/// Writes requests; returns the reason for the end.
async fn write(mut input: ChildStdin, mut queued: mpsc::Receiver<Request>) -> String {
    while let Some(request) = queued.recv().await {
        let written = match request.line() {
            Ok(line) => input.write_all(&line).await,
            Err(error) => {
                tracing::warn!(%error, "cannot send a request to the ROS graph");
                continue;
            }
        };
        if let Err(error) = written {
            return error.to_string();
        }
    }
    "no more requests".to_owned()
}

/// Waits until the program has ended, which it does when its input ends, and kills it otherwise.
async fn leave(mut child: Child, end: SessionEnd) {
    let ended = match end {
        SessionEnd::Closed => tokio::time::timeout(LEAVE_TIMEOUT, child.wait()).await.ok(),
        SessionEnd::Lost(why) => {
            let _ = child.start_kill();
            let ended = child.wait().await;
            let status = ended.as_ref().map_or_else(ToString::to_string, ExitStatus::to_string);
            tracing::warn!(%why, %status, "the program that takes part in the ROS graph has ended; restarting it");
            Some(ended)
        }
    };
    if ended.is_none() {
        let _ = child.kill().await;
    }
}
