//! The program that takes part in the graph: it executes the requests from its input, writes the
//! results to its output, and ends with its input. It has no other connection to the agent.

use std::collections::HashMap;
use std::io;
use std::sync::Arc;
use std::time::{Duration, Instant};

use task_proto::time::millis;
use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt as _, BufReader};
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::{Semaphore, broadcast, mpsc};
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval, timeout};

use super::participant::LocalGraph;
use super::protocol::{
    ALIVE_INTERVAL, Answer, Call, Event, Feed, Lines, MAX_REQUEST_BYTES, Request, SnapshotMessage,
};
use crate::ros::graph::GraphError;
use crate::ros::graph::rate::{Counter, Rate};

/// Maximum number of events that wait to be written.
const QUEUED_EVENTS: usize = 64;
/// Maximum number of concurrent calls.
const MAX_CALLS: usize = 256;
/// Maximum number of topics that are counted.
const MAX_COUNTERS: usize = 1024;
/// Interval between rate events while the rates change.
const RATE_INTERVAL: Duration = Duration::from_millis(250);

/// Executes the requests from `input` until its end, or until the graph is closed.
pub async fn serve(
    input: impl AsyncRead + Unpin + Send + 'static,
    output: impl AsyncWrite + Unpin,
) -> io::Result<()> {
    let mut requests = Lines::new(BufReader::new(input), MAX_REQUEST_BYTES);
    let Some(Request::Join(settings)) = requests.next().await? else {
        return Err(io::Error::new(
            io::ErrorKind::InvalidData,
            "the first line is not {\"join\":…}",
        ));
    };
    let (events, queued) = mpsc::channel(QUEUED_EVENTS);
    let serving = async move {
        match LocalGraph::open(&settings).await {
            Ok(graph) => run_requests(graph, requests, events).await,
            Err(error) => {
                let _ = events.send(Event::Failed { error }).await;
                Ok(())
            }
        }
    };
    let serving = tokio::spawn(serving);
    // The last event is the reason why the program could not take part; after it the queue is
    // closed.
    write_events(output, queued).await?;
    serving.await.map_err(io::Error::other)?
}

async fn write_events(
    mut output: impl AsyncWrite + Unpin,
    mut queued: mpsc::Receiver<Event>,
) -> io::Result<()> {
    while let Some(event) = queued.recv().await {
        output.write_all(&event.line()?).await?;
        output.flush().await?;
    }
    Ok(())
}

async fn run_requests(
    graph: LocalGraph,
    mut requests: Lines<BufReader<impl AsyncRead + Unpin>>,
    events: mpsc::Sender<Event>,
) -> io::Result<()> {
    let _ = events.send(Event::Joined).await;
    let mut tasks = JoinSet::new();
    let mut changes = graph.changes();
    tasks.spawn(send_snapshots(graph.clone(), events.clone()));
    let (meters, metered) = mpsc::channel(QUEUED_EVENTS);
    tasks.spawn(send_rates(metered, events.clone()));
    let calls = Arc::new(Semaphore::new(MAX_CALLS));
    let mut feeds = Vec::new();
    let closed = async move { while changes.changed().await.is_ok() {} };
    let serving = async {
        while let Some(request) = requests.next().await? {
            while tasks.try_join_next().is_some() {}
            match request {
                Request::Join(_) => {}
                Request::Call { id, within_ms, call } => {
                    let Ok(permit) = calls.clone().try_acquire_owned() else {
                        let _ = events.send(Event::Refused { id, error: GraphError::Busy }).await;
                        continue;
                    };
                    let graph = graph.clone();
                    let events = events.clone();
                    tasks.spawn(async move {
                        let _permit = permit;
                        let event =
                            match execute(&graph, call, Duration::from_millis(within_ms)).await {
                                Ok(answer) => Event::Answer { id, answer },
                                Err(error) => Event::Refused { id, error },
                            };
                        let _ = events.send(event).await;
                    });
                }
                Request::Listen(feed) if feeds.contains(&feed) => {}
                Request::Listen(feed) => {
                    feeds.push(feed);
                    subscribe(&graph, feed, &events, &mut tasks);
                }
                Request::Count { meter, topic, kind } => match graph.rate(&topic, &kind) {
                    Ok(counter) => drop(meters.send((meter, Some(counter))).await),
                    Err(error) => {
                        tracing::warn!(%topic, %error, "the messages of a topic can't be counted")
                    }
                },
                Request::StopCounting { meter } => drop(meters.send((meter, None)).await),
            }
        }
        Ok(())
    };
    let served = tokio::select! {
        // Nothing follows.
        served = serving => served,
        () = closed => Ok(()),
    };
    tasks.shutdown().await;
    graph.close().await;
    served
}

/// Sends the graph's state whenever it changes, and regularly an event that it has not changed.
async fn send_snapshots(graph: LocalGraph, events: mpsc::Sender<Event>) {
    let mut changes = graph.changes();
    changes.mark_changed();
    loop {
        let event = match timeout(ALIVE_INTERVAL, changes.changed()).await {
            Ok(Ok(())) => {
                Event::Snapshot(SnapshotMessage::of(&changes.borrow_and_update(), Instant::now()))
            }
            Ok(Err(_closed)) => return,
            Err(_) => {
                let age = changes.borrow().at.elapsed();
                Event::Unchanged { age_ms: millis(age) }
            }
        };
        if events.send(event).await.is_err() {
            return;
        }
    }
}

/// Sends the rates of the counted topics, each whenever it differs from the last one sent.
async fn send_rates(
    mut meters: mpsc::Receiver<(u64, Option<Counter>)>,
    events: mpsc::Sender<Event>,
) {
    let mut counters: HashMap<u64, (Counter, Rate)> = HashMap::new();
    let mut ticks = interval(RATE_INTERVAL);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            // Cancel-safe: a meter that was not received is still in the channel.
            meter = meters.recv() => match meter {
                Some((meter, Some(counter))) if counters.len() < MAX_COUNTERS => {
                    counters.insert(meter, (counter, Rate::NONE));
                }
                Some((_, Some(_))) => tracing::warn!("too many topics are counted"),
                Some((meter, None)) => drop(counters.remove(&meter)),
                None => return,
            },
            // Cancel-safe: a tick is not lost. Without counters this branch is disabled.
            _ = ticks.tick(), if !counters.is_empty() => {
                for (meter, (counter, last_sent)) in &mut counters {
                    let rate = counter.rate();
                    if (rate.hz, rate.samples) == (last_sent.hz, last_sent.samples) {
                        continue;
                    }
                    *last_sent = rate;
                    let since_last_ms = rate.since_last.map(millis);
                    let event = Event::Rate { meter: *meter, hz: rate.hz, since_last_ms, samples: rate.samples };
                    if events.send(event).await.is_err() {
                        return;
                    }
                }
            }
        }
    }
}

fn subscribe(
    graph: &LocalGraph,
    feed: Feed,
    events: &mpsc::Sender<Event>,
    tasks: &mut JoinSet<()>,
) {
    let subscribed = match feed {
        Feed::Rosout => graph.rosout().map(|messages| {
            tasks.spawn(forward(messages, events.clone(), |line| Event::Rosout((*line).clone())));
        }),
        Feed::Diagnostics => graph.diagnostics().map(|messages| {
            tasks.spawn(forward(messages, events.clone(), |status| {
                Event::Diagnostic((*status).clone())
            }));
        }),
    };
    if let Err(error) = subscribed {
        tracing::warn!(?feed, %error, "cannot subscribe to a feed of the ROS graph");
    }
}

async fn forward<T: Clone>(
    mut messages: broadcast::Receiver<T>,
    events: mpsc::Sender<Event>,
    event: impl Fn(T) -> Event,
) {
    loop {
        let event = match messages.recv().await {
            Ok(message) => event(message),
            Err(RecvError::Lagged(count)) => Event::Missed { count },
            Err(RecvError::Closed) => return,
        };
        if events.send(event).await.is_err() {
            return;
        }
    }
}

async fn execute(graph: &LocalGraph, call: Call, within: Duration) -> Result<Answer, GraphError> {
    Ok(match call {
        Call::Prepare { node } => graph.prepare(&node).await.map(|()| Answer::Done)?,
        Call::Servers { service, kind } => {
            Answer::Servers(graph.service_answers(&service, kind.as_deref(), within).await?)
        }
        Call::LifecycleState { node } => Answer::State(graph.lifecycle_state(&node, within).await?),
        Call::ChangeState { node, transition } => {
            Answer::Changed(graph.change_state(&node, transition, within).await?)
        }
        Call::Parameters { node } => Answer::Parameters(graph.parameters(&node, within).await?),
        Call::Parameter { node, name } => {
            Answer::Parameter(graph.parameter(&node, &name, within).await?)
        }
        Call::SetParameters { node, parameters } => {
            Answer::Set(graph.set_parameters(&node, parameters, within).await?)
        }
    })
}
