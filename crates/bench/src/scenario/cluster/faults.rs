//! The faults of a run: each begins at a random moment, lasts for a while and ends with all engines
//! running again.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::{Context as _, bail, ensure};
use clap::ValueEnum;
use rand::RngExt as _;
use rand::rngs::SmallRng;
use tokio::time::Instant;

use super::database::{Database, RobotRow, promote};
use super::engines::Engines;
use crate::system::clock::monotonic_ns;

/// Time limit for finding a server with the exclusive lock.
const LOCK_TIMEOUT: Duration = Duration::from_secs(60);
/// How often F9 ends the listeners.
const LISTENER_CUTS: u32 = 100;
/// Pause between two servers of a rolling restart.
const ROLLING_PAUSE: Duration = Duration::from_secs(2);

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Fault {
    /// None
    #[value(name = "F0")]
    Nothing,
    /// A server is killed, and started again later
    #[value(name = "F1")]
    KillNode,
    /// A server is paused (SIGSTOP), and goes on later
    #[value(name = "F2")]
    PauseNode,
    /// A server is paused while it holds the exclusive lock
    #[value(name = "F3")]
    PauseLockHolder,
    /// The database's primary is killed, and its standby promoted
    #[value(name = "F4")]
    KillPrimary,
    /// One of two S3 servers is killed
    #[value(name = "F5")]
    KillGateway,
    /// One HAProxy is killed
    #[value(name = "F6")]
    KillBalancer,
    /// A server's connections to the database pass nothing on
    #[value(name = "F7")]
    CutDatabase,
    /// All servers are restarted one after the other
    #[value(name = "F8")]
    RollingRestart,
    /// The connections on which servers listen are ended, 100 times
    #[value(name = "F9")]
    EndListeners,
    /// The servers do not notify each other for the whole run
    #[value(name = "F10")]
    BusOff,
}

impl Fault {
    /// The fault as a series of the result.
    pub fn label(self) -> &'static str {
        match self {
            Self::Nothing => "F0 none",
            Self::KillNode => "F1 server killed",
            Self::PauseNode => "F2 server paused",
            Self::PauseLockHolder => "F3 paused with the lock",
            Self::KillPrimary => "F4 primary killed",
            Self::KillGateway => "F5 S3 server killed",
            Self::KillBalancer => "F6 HAProxy killed",
            Self::CutDatabase => "F7 database cut off",
            Self::RollingRestart => "F8 rolling restart",
            Self::EndListeners => "F9 listeners ended",
            Self::BusOff => "F10 bus off",
        }
    }
}

/// When a fault began and ended, by the machine's monotonic clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FaultTimes {
    pub began_ns: u64,
    pub ended_ns: u64,
}

/// A fault that is over.
#[derive(Debug)]
pub struct Injected {
    pub times: FaultTimes,
    /// The robots' rows in the standby when it was promoted.
    pub promoted: Option<BTreeMap<String, RobotRow>>,
}

/// Brings the fault about, holds it, and ends it.
pub async fn inject(
    fault: Fault,
    engines: &mut Engines,
    database: &mut Database,
    hold: Duration,
    random: &mut SmallRng,
) -> anyhow::Result<Injected> {
    let mut promoted = None;
    let node = random.random_range(0..engines.nodes.len());
    let mut began_ns = monotonic_ns();
    match fault {
        Fault::Nothing | Fault::BusOff => tokio::time::sleep(hold).await,
        Fault::KillNode => {
            engines.nodes[node].kill().await;
            tokio::time::sleep(hold).await;
            engines.nodes[node].start()?;
            engines.nodes[node].wait_ready().await?;
        }
        Fault::PauseNode => {
            engines.nodes[node].pause();
            tokio::time::sleep(hold).await;
            engines.nodes[node].go_on();
        }
        Fault::PauseLockHolder => {
            let paused = pause_lock_holder(engines, database).await?;
            began_ns = monotonic_ns();
            tokio::time::sleep(hold).await;
            engines.nodes[paused].go_on();
        }
        Fault::KillPrimary => {
            engines.primary.kill().await;
            let standby = engines.database.last().context("no standby")?;
            promote(standby).await?;
            // Before many robots have reported again.
            promoted = Some(database.robots().await?);
        }
        Fault::KillGateway => {
            engines.objects.kill_one().await?;
            tokio::time::sleep(hold).await;
            engines.objects.start_again().await?;
        }
        Fault::KillBalancer => {
            ensure!(!engines.balancers.is_empty(), "F6 needs the program haproxy");
            let balancer = random.random_range(0..engines.balancers.len());
            engines.balancers[balancer].kill().await;
            tokio::time::sleep(hold).await;
            engines.balancers[balancer].start_again().await?;
        }
        Fault::CutDatabase => {
            let relays = &engines.relays[node];
            ensure!(!relays.is_empty(), "no relays");
            relays.iter().for_each(|relay| relay.set_cut(true));
            tokio::time::sleep(hold).await;
            relays.iter().for_each(|relay| relay.set_cut(false));
        }
        Fault::RollingRestart => {
            for node in &mut engines.nodes {
                node.end().await;
                node.start()?;
                node.wait_ready().await?;
                tokio::time::sleep(ROLLING_PAUSE).await;
            }
        }
        Fault::EndListeners => end_listeners(database, hold).await?,
    }
    Ok(Injected { times: FaultTimes { began_ns, ended_ns: monotonic_ns() }, promoted })
}

/// Pauses a server that holds the exclusive lock, and returns its number. The lock is looked at
/// again once the server can't release it.
async fn pause_lock_holder(engines: &Engines, database: &mut Database) -> anyhow::Result<usize> {
    let deadline = Instant::now() + LOCK_TIMEOUT;
    while Instant::now() < deadline {
        let Some(holder) = database.lock_holder().await? else { continue };
        let found = engines.nodes.iter().position(|node| node.name == holder);
        let Some(number) = found else { continue };
        engines.nodes[number].pause();
        if database.lock_holder().await?.as_ref() == Some(&holder) {
            return Ok(number);
        }
        engines.nodes[number].go_on();
    }
    bail!("no server was found with the exclusive lock within {LOCK_TIMEOUT:?}")
}

async fn end_listeners(database: &mut Database, hold: Duration) -> anyhow::Result<()> {
    let mut tick = tokio::time::interval(hold / LISTENER_CUTS);
    let mut ended = 0;
    for _ in 0..LISTENER_CUTS {
        tick.tick().await;
        ended += database.end_listeners().await?;
    }
    ensure!(ended > 0, "no server had a listener");
    Ok(())
}
