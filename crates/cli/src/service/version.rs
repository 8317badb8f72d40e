//! `taskd version`: the version of this program, and of the server if one answers.

use std::time::Duration;

use serde::Serialize;
use task_proto::api::ServerInfo;

use crate::api::client::Client;
use crate::display::output::{Output, facts};
use crate::{CommandError, Connection, Outcome};

/// Time limit for the server's answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(3);

#[derive(Serialize)]
struct Versions {
    taskd: &'static str,
    server: Option<String>,
}

pub(crate) async fn run(connection: &Connection) -> Result<Outcome, CommandError> {
    let server = async {
        let client = Client::connect(connection).ok()?;
        let info: ServerInfo =
            tokio::time::timeout(ANSWER_TIMEOUT, client.get("/server", &[])).await.ok()?.ok()?;
        Some(info.version)
    };
    let versions = Versions { taskd: env!("CARGO_PKG_VERSION"), server: server.await };
    Output::new(connection.output).print_object(
        &versions,
        |versions| versions.taskd.to_owned(),
        |versions| {
            let server = versions.server.clone().unwrap_or_else(|| "unreachable".to_owned());
            facts([("taskd", versions.taskd.to_owned()), ("server", server)])
        },
    )?;
    Ok(Outcome::Succeeded)
}
