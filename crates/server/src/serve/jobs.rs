//! Periodic jobs beside the listeners: each waits for its interval or an event, and asks another
//! part to act.

use std::sync::Arc;
use std::time::Duration;

use task_proto::api::FeedKind;
use tokio::sync::broadcast::{
    self,
    error::{RecvError, TryRecvError},
};
use tokio::time::{Interval, MissedTickBehavior};
use tokio_util::sync::CancellationToken;

use crate::domain::happening::Happening;
use crate::http::App;
use crate::orders::actions::ActionError;
use crate::orders::changes::Change;
use crate::orders::chooser::ServerLoad;

/// How often the server looks for assignments that have expired.
const EXPIRY_INTERVAL: Duration = Duration::from_secs(30);
/// How often it looks for robots that have fallen silent.
const SILENCE_INTERVAL: Duration = Duration::from_secs(5);
/// How often it looks for rollouts that go on without robots that stay away.
const ROLLOUT_INTERVAL: Duration = Duration::from_secs(10);
/// The pause between two looks at rollouts, however many robots come meanwhile.
const ROLLOUT_PAUSE: Duration = Duration::from_millis(250);
/// How often it looks for robots that misbehave no longer.
const FORGIVING_INTERVAL: Duration = Duration::from_secs(1);
/// How often it looks at how busy it is.
const LOAD_INTERVAL: Duration = Duration::from_secs(1);

/// Ends assignments that were not done in time.
pub(super) async fn expire_assignments(app: App) {
    let mut ticks = ticks(EXPIRY_INTERVAL);
    while next_tick(&mut ticks, &app.stop).await {
        match app.actions.expire().await {
            // They come back with a token that is good, if they have one.
            Ok(users) => users.iter().for_each(|user| app.broker.disconnect_person(user)),
            Err(ActionError::Store(error)) => {
                error.log("assignments could not be looked through for expired ones")
            }
            Err(error) => tracing::error!(
                error = &error as &dyn std::error::Error,
                "assignments could not be looked through for expired ones"
            ),
        }
    }
}

/// Moves rollouts on where robots come or stay away: what a report or an order changes moves them
/// on by itself.
pub(super) async fn advance_rollouts(app: App) {
    let mut ticks = ticks(ROLLOUT_INTERVAL);
    let mut happenings = app.changes.happenings();
    while !app.stop.is_cancelled() {
        tokio::select! {
            () = app.stop.cancelled() => return,
            _ = ticks.tick() => {}
            () = robot_came(&mut happenings) => {}
        }
        if let Err(error) = app.actions.advance_rollouts().await {
            tracing::error!(
                error = &error as &dyn std::error::Error,
                "rollouts could not be moved on"
            );
        }
        // Robots that come at once, as after a restart, are looked at once.
        tokio::select! {
            () = app.stop.cancelled() => return,
            () = tokio::time::sleep(ROLLOUT_PAUSE) => {}
        }
    }
}

/// Waits until some robot has come online. Takes all that has been said so far.
async fn robot_came(happenings: &mut broadcast::Receiver<Happening>) {
    let mut came = false;
    while !came {
        came = match happenings.recv().await {
            Ok(happening) => matches!(happening, Happening::Presence(_, true)),
            Err(RecvError::Lagged(_)) => true,
            Err(RecvError::Closed) => std::future::pending().await,
        };
    }
    while !matches!(happenings.try_recv(), Err(TryRecvError::Empty | TryRecvError::Closed)) {}
}

/// Shows that robots misbehave, and that they do so no longer.
pub(super) async fn show_conduct(app: App) {
    let mut ticks = ticks(FORGIVING_INTERVAL);
    loop {
        let news = tokio::select! {
            () = app.stop.cancelled() => return,
            _ = ticks.tick() => {
                app.conduct.forgive(tokio::time::Instant::now());
                continue;
            }
            news = app.conduct.news() => news,
        };
        for robot in news {
            if let Some(text) = app.conduct.trouble(&robot) {
                app.changes.happened(Happening::Robot(
                    robot.clone(),
                    FeedKind::RobotMisbehaved,
                    text,
                ));
            }
            app.changes.announce(Change::Robot(robot));
        }
    }
}

/// Measures the server's load, by which deliveries are chosen.
pub(super) async fn watch_load(app: App, load: Arc<ServerLoad>) {
    let mut ticks = ticks(LOAD_INTERVAL);
    while next_tick(&mut ticks, &app.stop).await {
        app.transfers.look();
        load.set(app.transfers.running(), app.broker.queued_part_bytes() as u64);
    }
}

/// Announces robots that have fallen silent.
pub(super) async fn notice_silence(app: App) {
    let mut ticks = ticks(SILENCE_INTERVAL);
    let mut since_ms = app.clock.now_ms();
    while next_tick(&mut ticks, &app.stop).await {
        let now_ms = app.clock.now_ms();
        for robot in app.presence.fell_silent(since_ms, now_ms) {
            app.changes.happened(Happening::Presence(robot.clone(), false));
            app.changes.announce(Change::Robot(robot));
        }
        since_ms = now_ms;
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
