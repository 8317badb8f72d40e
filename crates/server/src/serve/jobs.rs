//! Periodic jobs beside the listeners: each waits for its interval or an event, and then calls
//! another part of the server.

use std::sync::Arc;
use std::time::Duration;

use task_proto::api::FeedKind;
use tokio::sync::broadcast::{
    self,
    error::{RecvError, TryRecvError},
};
use tokio::time::{Instant, Interval, MissedTickBehavior};
use tokio_util::sync::CancellationToken;

use crate::domain::fleet_event::FleetEvent;
use crate::fleet::live_nodes::LiveNodes;
use crate::http::App;
use crate::orders::changes::Change;
use crate::orders::delivery_planner::ServerLoad;

/// Interval between checks for expired assignments.
const EXPIRY_INTERVAL: Duration = Duration::from_secs(30);
/// Interval between checks for robots that have fallen silent.
const SILENCE_INTERVAL: Duration = Duration::from_secs(5);
/// Interval between checks for rollouts that can continue without absent robots.
const ROLLOUT_INTERVAL: Duration = Duration::from_secs(10);
/// Minimum interval between checks of rollouts, however many robots come meanwhile.
const ROLLOUT_PAUSE: Duration = Duration::from_millis(250);
/// Interval between checks for orders that another server has left unfinished.
const CONTINUE_INTERVAL: Duration = Duration::from_secs(10);
/// Maximum pause between two parts of an order.
const MAX_CONTINUE_PAUSE: Duration = Duration::from_millis(500);
/// Interval between checks for robots whose violations have expired.
const VIOLATION_INTERVAL: Duration = Duration::from_secs(1);
/// Interval between measurements of the server's load.
const LOAD_INTERVAL: Duration = Duration::from_secs(1);

/// Ends assignments that were not done in time.
pub(super) async fn expire_assignments(app: App) {
    let mut ticks = SharedTicks::new(EXPIRY_INTERVAL, &app);
    while ticks.next(&app.stop).await {
        match app.actions.expire().await {
            // Clients reconnect with a valid token, if they have one.
            Ok(users) => users.iter().for_each(|user| {
                app.broker.disconnect_person(user);
                app.changes.end_person_elsewhere(user);
            }),
            Err(error) => error.log("expired assignments could not be processed"),
        }
    }
}

/// Advances rollouts when robots come online or stay away. Changes by a report or an order advance
/// rollouts directly.
pub(super) async fn advance_rollouts(app: App) {
    let mut ticks = SharedTicks::new(ROLLOUT_INTERVAL, &app);
    let mut fleet_events = app.changes.fleet_events();
    while !app.stop.is_cancelled() {
        tokio::select! {
            () = app.stop.cancelled() => return,
            _ = ticks.next(&app.stop) => {}
            () = robot_connected(&mut fleet_events) => {}
        }
        if let Err(error) = app.actions.deployments.advance_rollouts().await {
            tracing::error!(
                error = &error as &dyn std::error::Error,
                "rollouts could not be advanced"
            );
        }
        // Robots that come online together, as after a restart, are handled together.
        tokio::select! {
            () = app.stop.cancelled() => return,
            () = tokio::time::sleep(ROLLOUT_PAUSE) => {}
        }
    }
}

/// Carries out large orders part by part, also those that were left by a server which has ended.
/// After each part, reports have the database for as long as the part had it.
pub(super) async fn continue_orders(app: App) {
    let deployments = &app.actions.deployments;
    let mut ticks = ticks(CONTINUE_INTERVAL);
    loop {
        tokio::select! {
            () = app.stop.cancelled() => return,
            _ = ticks.tick() => {}
            () = deployments.order_to_continue() => {}
        }
        let mut began = Instant::now();
        loop {
            match deployments.continue_order().await {
                Ok(true) => {}
                Ok(false) => break,
                Err(error) => {
                    let error = &error as &dyn std::error::Error;
                    tracing::error!(
                        error,
                        "an order could not be carried out for its other robots"
                    );
                    break;
                }
            }
            tokio::select! {
                () = app.stop.cancelled() => return,
                () = tokio::time::sleep(began.elapsed().min(MAX_CONTINUE_PAUSE)) => {}
            }
            began = Instant::now();
        }
    }
}

/// Waits until a robot has come online. Consumes all pending events.
async fn robot_connected(fleet_events: &mut broadcast::Receiver<FleetEvent>) {
    let mut is_connected = false;
    while !is_connected {
        is_connected = match fleet_events.recv().await {
            Ok(event) => matches!(event, FleetEvent::Presence(_, true)),
            Err(RecvError::Lagged(_)) => true,
            Err(RecvError::Closed) => std::future::pending().await,
        };
    }
    while !matches!(fleet_events.try_recv(), Err(TryRecvError::Empty | TryRecvError::Closed)) {}
}

/// Displays that robots violate their limits, and when they no longer do.
pub(super) async fn announce_violations(app: App) {
    let mut ticks = ticks(VIOLATION_INTERVAL);
    loop {
        let news = tokio::select! {
            () = app.stop.cancelled() => return,
            _ = ticks.tick() => {
                app.robot_limiter.expire_penalties(tokio::time::Instant::now());
                continue;
            }
            news = app.robot_limiter.changed() => news,
        };
        for robot in news {
            if let Some(text) = app.robot_limiter.penalty(&robot) {
                app.changes.announce_event(FleetEvent::Robot(
                    robot.clone(),
                    FeedKind::RobotMisbehaved,
                    text,
                ));
            }
            app.changes.announce(Change::Robot(robot));
        }
    }
}

/// Measures the server's load, which influences the choice of deliveries.
pub(super) async fn sample_load(app: App, load: Arc<ServerLoad>) {
    let mut ticks = ticks(LOAD_INTERVAL);
    while next_tick(&mut ticks, &app.stop).await {
        app.transfers.sample();
        load.set(app.transfers.running(), app.broker.queued_part_bytes() as u64);
    }
}

/// Announces robots that have fallen silent.
pub(super) async fn announce_silent_robots(app: App) {
    let mut ticks = ticks(SILENCE_INTERVAL);
    let mut since_ms = app.clock.now_ms();
    while next_tick(&mut ticks, &app.stop).await {
        let now_ms = app.clock.now_ms();
        for robot in app.presence.timed_out(since_ms, now_ms) {
            app.changes.announce_event(FleetEvent::Presence(robot.clone(), false));
            app.changes.announce_here(Change::Robot(robot));
        }
        since_ms = now_ms;
    }
}

/// Ticks for work that every server of a cluster does for all: rarer the more servers live, and not
/// at the same time.
struct SharedTicks {
    interval: Duration,
    ticks: Interval,
    nodes: LiveNodes,
}

impl SharedTicks {
    /// The first tick comes at once, and the others at this interval if the server is alone.
    fn new(interval: Duration, app: &App) -> Self {
        Self { interval, ticks: ticks(interval), nodes: app.nodes.clone() }
    }

    /// Waits for the next tick; false when it is time to stop. Dropping the future loses none.
    async fn next(&mut self, stop: &CancellationToken) -> bool {
        let is_due = next_tick(&mut self.ticks, stop).await;
        let nodes = self.nodes.count();
        if nodes > 1 {
            let share = self.interval.mul_f64(nodes as f64 * rand::random_range(0.75..1.25));
            self.ticks.reset_after(share);
        }
        is_due
    }
}

fn ticks(interval: Duration) -> Interval {
    let mut ticks = tokio::time::interval(interval);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    ticks
}

/// Waits for the next tick; false when it is time to stop.
async fn next_tick(ticks: &mut Interval, stop: &CancellationToken) -> bool {
    tokio::select! {
        () = stop.cancelled() => false,
        _ = ticks.tick() => true,
    }
}
