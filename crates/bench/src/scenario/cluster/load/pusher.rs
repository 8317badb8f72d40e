//! Pushes packages that no robot gets and deletes them again, each at another server, so that the
//! servers' collectors have work.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use rand::RngExt as _;

use super::{Client, name_and_version, ticks};
use crate::programs::package::Package;
use crate::programs::server::{Server, ServerError};

const INTERVAL: Duration = Duration::from_millis(250);
const PAYLOAD_BYTES: u64 = 16 * 1024;
/// Versions that are not deleted yet.
const KEPT: usize = 3;
/// Contents that are pushed in turns, so that a push finds blobs that a deletion has just released.
const CONTENTS: u64 = 5;

pub(super) async fn run(client: Client) -> anyhow::Result<()> {
    let mut random = client.random(3);
    let mut tick = ticks(INTERVAL);
    let mut versions = VecDeque::new();
    let mut version = 0;
    while client.goes_on(&mut tick).await {
        version += 1;
        let (task, number) = name_and_version("churn", version)?;
        let content = client.args.seed.wrapping_add(version % CONTENTS);
        let package = || Package::random(task.clone(), number.clone(), PAYLOAD_BYTES, content);
        let first = random.random_range(0..client.servers.len());
        versions.push_back(client.push(first, package).await?);
        client.record().pushed += 1;
        if versions.len() > KEPT {
            let Some(manifest) = versions.pop_front() else { continue };
            let first = random.random_range(0..client.servers.len());
            // A version that was deleted by a try without an answer is gone.
            let (task, manifest) = (&task, &manifest);
            let delete =
                |server: Arc<Server>| async move { server.remove_package(task, manifest).await };
            match client.ask_until_answered(first, delete).await {
                Err(error) if is_not_found(&error) => {}
                deleted => drop(deleted?),
            }
            client.record().deleted += 1;
        }
    }
    Ok(())
}

fn is_not_found(error: &anyhow::Error) -> bool {
    let refused = error.downcast_ref::<ServerError>();
    matches!(refused, Some(ServerError::Refused(_, status, _)) if status.as_u16() == 404)
}
