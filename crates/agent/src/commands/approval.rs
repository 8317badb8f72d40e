//! Waits until an administrator approves a robot that has just registered, or turns it away. Who it
//! is has been written down, so that the wait goes on after a restart; an agent that runs meanwhile
//! notices by itself.

use std::time::Duration;

use anyhow::{Context as _, bail};
use task_proto::api::AWAITS_APPROVAL;

use super::say;
use crate::reconcile::admission;
use crate::system::durable;
use crate::system::error_chain::chain;
use crate::system::identity::Identity;
use crate::system::layout::DataDir as Layout;
use crate::task::plan::backoff_ms;
use crate::transfer::server::{Sent, Server, ServerError};

/// The longest pause between two questions; the shortest is a quarter of it.
const PAUSE: Duration = Duration::from_secs(8);
/// The longest while the server can't be reached.
const MAX_AWAY_MS: u64 = 60 * 1000;

/// The server must hold the key that the token pins: a desired state that it signed shows it.
pub(super) fn check_key(sent: &Sent, robot: &Identity) -> anyhow::Result<()> {
    admission::open(&sent.envelope, &robot.server_key, &robot.robot_id)
        .context("the server does not hold the key that the enrolment token names")?;
    Ok(())
}

/// Waits, and makes `robot` the registered one or forgets it. `before` is who this robot was.
pub(super) async fn wait(
    data: &Layout,
    server: &Server,
    robot: Identity,
    before: Option<Identity>,
) -> anyhow::Result<()> {
    say(format_args!(
        "{} waits to be approved at {} (taskd robot approve)",
        robot.robot_id, robot.server
    ));
    match answer(server).await {
        Ok(sent) => {
            if let Some(sent) = sent
                && let Err(error) = check_key(&sent, &robot)
            {
                forget(data, before)?;
                return Err(error);
            }
            if is_still(data, &robot) {
                Identity { awaits_approval: false, ..robot }.write(&data.identity())?;
            }
            Ok(())
        }
        Err(why) => {
            if is_still(data, &robot) {
                forget(data, before)?;
            }
            bail!("{} did not approve this robot: {why}", robot.server)
        }
    }
}

/// Whether the robot was not registered anew, and has not gone over to another token, while it
/// waited.
fn is_still(data: &Layout, robot: &Identity) -> bool {
    Identity::read(&data.identity()).is_ok_and(|known| known.token == robot.token)
}

/// Who this robot was before, or nobody.
pub(super) fn forget(data: &Layout, before: Option<Identity>) -> anyhow::Result<()> {
    match before {
        Some(before) => Ok(before.write(&data.identity())?),
        None => durable::remove_file(&data.identity()).context("cannot remove the identity"),
    }
}

/// What comes of the wait: the state the server sends first, or why the robot was turned away.
async fn answer(server: &Server) -> Result<Option<Sent>, String> {
    let mut failures = 0;
    loop {
        let pause = match server.desired(None).await {
            Ok(sent) => return Ok(sent),
            Err(ServerError::TokenRefused(why)) => return Err(why),
            Err(ServerError::Refused { code, .. }) if code == AWAITS_APPROVAL => {
                failures = 0;
                PAUSE.mul_f64(0.25 + 0.75 * rand::random::<f64>())
            }
            // It is let in; why it gets no state now is not this command's to settle.
            Err(ServerError::Refused { .. }) => return Ok(None),
            Err(error) => {
                failures += 1;
                if failures == 1 {
                    say(format_args!("{}: it is asked again", chain(&error)));
                }
                PAUSE / 4 + Duration::from_millis(backoff_ms(failures, MAX_AWAY_MS, rand::random()))
            }
        };
        tokio::time::sleep(pause).await;
    }
}
