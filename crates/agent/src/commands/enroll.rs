//! `task-agent enroll`: registers this robot at a server with an enrollment token, and stores its
//! identity.

use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context as _, bail};
use task_proto::api::{EnrollRequest, EnrollResponse};
use task_proto::ids::{LabelKey, LabelValue};
use task_proto::trust::token::{Token, TokenKind};
use task_proto::{MacAddress, RobotName};
use task_transport::ClientKey;

use super::approval::{self, check_key};
use super::{DataDir, refuse_plain_text, say, tls};
use crate::config::{Config, Settings, parse_server};
use crate::system::clock;
use crate::system::durable;
use crate::system::identity::{self, Identity};
use crate::system::layout::DataDir as Layout;
use crate::task::timing::backoff_ms;
use crate::transfer::server::{self, Server, ServerError};

/// Maximum number of requests to the server.
const TRIES: u32 = 4;
/// Maximum pause between two attempts.
const MAX_PAUSE_MS: u64 = 4000;

#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// URL of the server [default: the one in agent.toml]
    #[arg(long, value_name = "URL")]
    server: Option<String>,
    /// Enrollment token, from `taskd enroll-token create`. Prefer the variable: other users of the
    /// machine can read the command line
    #[arg(long, value_name = "TOKEN", env = "TASK_AGENT_ENROLL_TOKEN", hide_env_values = true)]
    token: Option<String>,
    /// Name of the robot
    #[arg(long)]
    name: Option<RobotName>,
    /// Label of the robot; may be repeated
    #[arg(long = "label", value_name = "K=V", value_parser = parse_label)]
    labels: Vec<(LabelKey, LabelValue)>,
    /// MAC address that identifies the robot [default: that of its first physical network
    /// interface]
    #[arg(long)]
    mac: Option<MacAddress>,
    /// Register again even if this robot is already registered
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    data: DataDir,
}

pub(super) fn parse_label(text: &str) -> Result<(LabelKey, LabelValue), String> {
    let (key, value) = text.split_once('=').ok_or("expected key=value")?;
    let key = key.parse().map_err(|error: task_proto::ids::InvalidId| error.to_string())?;
    Ok((key, value.parse().map_err(|error: task_proto::ids::InvalidId| error.to_string())?))
}

pub fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(enroll(arguments))
}

async fn enroll(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let data = Layout::new(&arguments.data.data)?;
    if data.identity().exists() && !arguments.force {
        let known = Identity::read(&data.identity())?;
        if known.awaits_approval {
            return resume_waiting(&data, known).await;
        }
        bail!(
            "this robot is registered as {} at {}: use --force to register again",
            known.robot_id,
            known.server
        );
    }
    let Some(shown_token) = &arguments.token else {
        bail!("--token: no enrollment token given, here or in TASK_AGENT_ENROLL_TOKEN");
    };
    let token: Token = shown_token.parse().context("--token")?;
    let (TokenKind::Enrollment, Some(key)) = (token.kind(), token.server_key()) else {
        bail!("--token: not an enrollment token; create one with taskd enroll-token create");
    };
    let config = Config::load(data.root(), std::env::vars_os())?;
    let server = match (&arguments.server, &config.server) {
        (Some(server), _) => parse_server(server)?,
        (None, Some(server)) => server.clone(),
        (None, None) => bail!("--server: no server given, here or in agent.toml"),
    };
    let mac = match arguments.mac {
        Some(mac) => mac,
        None => identity::find_own_mac()?,
    };
    durable::create_dir_all(data.root())
        .with_context(|| format!("cannot make {}", data.root().display()))?;

    let mut labels = config.labels.clone().unwrap_or_default();
    labels.extend(arguments.labels.iter().cloned());
    refuse_plain_text(token.ca_pin(), &server, "--server")?;
    let client_key = ClientKey::random();
    let request = EnrollRequest {
        mac,
        name: arguments.name.clone().or(config.name.clone()),
        labels: labels.clone(),
        client_key: Some(client_key.public_key()),
    };
    let client = server::client(tls(token.ca_pin(), Some(&client_key))?)?;
    let response = match register(&client, &server, shown_token, &request).await {
        Ok(response) => response,
        Err(error) => {
            return Err(
                anyhow::Error::new(error).context(format!("{server} did not register the robot"))
            );
        }
    };
    remember_settings(&data, &arguments, &server, &response, labels)?;
    let robot = Identity {
        robot_id: response.robot_id.clone(),
        token: response.token.clone(),
        next_token: None,
        token_since_ms: clock::wall_ms(),
        server: server.to_string(),
        server_key: key.clone(),
        ca_pin: token.ca_pin(),
        client_key: Some(client_key),
        mqtt: response.mqtt.clone(),
        mac,
        awaits_approval: response.awaits_approval,
    };
    // The identity is written before the token is used: after the first use, the server gives no
    // other token for the same enrollment token.
    let before = Identity::read(&data.identity()).ok();
    robot.write(&data.identity())?;
    let registered =
        Server::new(client, server.clone(), response.robot_id.clone(), response.token.clone());
    if response.awaits_approval {
        approval::wait(&data, &registered, robot, before).await?;
    } else if let Ok(Some(sent)) = registered.desired(None).await
        // Without that answer the robot is registered all the same and must not forget its
        // identity: every state is verified before it is obeyed.
        && let Err(error) = check_key(&sent, &robot)
    {
        approval::forget(&data, before)?;
        return Err(error);
    }
    say(format_args!(
        "{} is registered at {server} as {}, by {mac}",
        response.name, response.robot_id
    ));
    Ok(ExitCode::SUCCESS)
}

/// Resumes the wait of an earlier call of the command.
async fn resume_waiting(data: &Layout, robot: Identity) -> anyhow::Result<ExitCode> {
    let server = parse_server(&robot.server)?;
    let id = robot.robot_id.clone();
    refuse_plain_text(robot.ca_pin, &server, "server")?;
    let client = server::client(tls(robot.ca_pin, robot.client_key.as_ref())?)?;
    let asked = Server::new(client, server.clone(), id.clone(), robot.token.clone());
    approval::wait(data, &asked, robot, None).await?;
    say(format_args!("this robot is registered at {server} as {id}"));
    Ok(ExitCode::SUCCESS)
}

/// Registers the robot, with another attempt if no answer came: until the token in the answer has
/// been used, the server repeats the same answer.
async fn register(
    client: &reqwest::Client,
    server: &reqwest::Url,
    token: &str,
    request: &EnrollRequest,
) -> Result<EnrollResponse, ServerError> {
    let mut tried = 0;
    loop {
        tried += 1;
        match server::enroll(client, server, token, request).await {
            Err(ServerError::Unreachable(_) | ServerError::Busy { .. }) if tried < TRIES => {
                tokio::time::sleep(Duration::from_millis(backoff_ms(
                    tried,
                    MAX_PAUSE_MS,
                    rand::random(),
                )))
                .await;
            }
            answer => return answer,
        }
    }
}

/// Stores the values from the command line in the property file.
fn remember_settings(
    data: &Layout,
    arguments: &Arguments,
    server: &reqwest::Url,
    response: &EnrollResponse,
    labels: task_proto::ids::Labels,
) -> anyhow::Result<()> {
    let before = Settings::read(data.root())?;
    let mut settings = before.clone();
    settings.server = Some(server.to_string());
    if arguments.name.is_some() {
        settings.name = Some(response.name.clone());
    }
    if !arguments.labels.is_empty() {
        settings.labels = Some(labels);
    }
    if settings != before {
        settings.write(data.root())?;
    }
    Ok(())
}
