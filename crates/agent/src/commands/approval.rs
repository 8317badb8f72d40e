//! Waits until an administrator approves or rejects a robot that has just registered. The robot's
//! identity is stored first, so that the wait continues after a restart; an agent that runs
//! meanwhile notices the approval by itself.

use std::time::Duration;

use anyhow::{Context as _, bail};
use task_proto::api::AWAITS_APPROVAL;
use task_proto::error_chain::chain;

use super::say;
use crate::reconcile::admission;
use crate::system::durable;
use crate::system::identity::Identity;
use crate::system::layout::DataDir as Layout;
use crate::task::timing::backoff_ms;
use crate::transfer::server::{DesiredResponse, Server, ServerError};

/// Maximum pause between two requests; the minimum is a quarter of it.
const PAUSE: Duration = Duration::from_secs(8);
/// Maximum pause while the server can't be reached.
const MAX_AWAY_MS: u64 = 60 * 1000;

/// Checks that the server holds the key that the token pins: a desired state signed with that key
/// proves this.
pub(super) fn check_key(sent: &DesiredResponse, robot: &Identity) -> anyhow::Result<()> {
    admission::open(&sent.envelope, &robot.server_key, &robot.robot_id)
        .context("the server's key is not the one pinned by the enrollment token")?;
    Ok(())
}

/// Waits, and makes `robot` the registered robot or forgets it. `before` is the robot's previous
/// identity.
pub(super) async fn wait(
    data: &Layout,
    server: &Server,
    robot: Identity,
    before: Option<Identity>,
) -> anyhow::Result<()> {
    say(format_args!(
        "{} is waiting for approval at {} (taskd robot approve)",
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

/// Whether, during the wait, the robot was not registered again and did not change its token.
fn is_still(data: &Layout, robot: &Identity) -> bool {
    Identity::read(&data.identity()).is_ok_and(|known| known.token == robot.token)
}

/// Restores the robot's previous identity, or removes the identity if there was none.
pub(super) fn forget(data: &Layout, before: Option<Identity>) -> anyhow::Result<()> {
    match before {
        Some(before) => Ok(before.write(&data.identity())?),
        None => durable::remove_file(&data.identity()).context("cannot remove the identity"),
    }
}

/// The result of the wait: the first state from the server, or the reason for the rejection.
async fn answer(server: &Server) -> Result<Option<DesiredResponse>, String> {
    let mut failures = 0;
    loop {
        let pause = match server.desired(None).await {
            Ok(sent) => return Ok(sent),
            Err(ServerError::TokenRefused(why)) => return Err(why),
            Err(ServerError::Refused { code, .. }) if code == AWAITS_APPROVAL => {
                failures = 0;
                PAUSE.mul_f64(0.25 + 0.75 * rand::random::<f64>())
            }
            // The robot is approved. Another refusal to send a state is not this command's concern.
            Err(ServerError::Refused { .. }) => return Ok(None),
            Err(error) => {
                failures += 1;
                if failures == 1 {
                    say(format_args!("{}: retrying", chain(&error)));
                }
                PAUSE / 4 + Duration::from_millis(backoff_ms(failures, MAX_AWAY_MS, rand::random()))
            }
        };
        tokio::time::sleep(pause).await;
    }
}
