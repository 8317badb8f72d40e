//! Live shell completion: names that the server knows now. The shell runs the program itself, so a
//! server that is away or slow must cost little time and never print to the terminal.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::future::Future;
use std::time::Duration;

use clap_complete::engine::{ArgValueCompleter, CompletionCandidate};
use clap_complete::env::CompleteEnv;
use serde::de::DeserializeOwned;
use task_proto::api::{
    DeploymentList, EnrollmentTokenList, PackageList, RobotList, TokenList, UserList,
};
use task_proto::messages::request::{Answer, Ask};

use super::client::Client;
use crate::Connection;
use crate::display::output::{Format, printable};
use crate::display::view;

/// The variable by which a shell's script requests completion.
pub(crate) const VARIABLE: &str = "TASKD_COMPLETE";
/// Time limit for the server.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(1);
/// Separators between the terms of a selector.
const BETWEEN_TERMS: [char; 3] = [',', '&', '!'];

/// Completes words and ends the program, if a shell requests completion; otherwise does nothing.
pub fn complete(command_line: fn() -> clap::Command) {
    CompleteEnv::with_factory(command_line).var(VARIABLE).complete();
}

/// Names with their descriptions.
type Candidates = BTreeMap<String, String>;

pub(crate) fn robots() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| candidates(current, |_| robot_candidates()))
}

/// Selectors: the last term is completed.
pub(crate) fn selectors() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| {
        let Some(text) = current.to_str() else { return Vec::new() };
        let begun = text.rfind(BETWEEN_TERMS).map_or(0, |at| at + 1);
        let (kept, term) = text.split_at(begun);
        let completed = candidates(OsStr::new(term), |_| selector_terms());
        completed.into_iter().map(|candidate| candidate.add_prefix(kept)).collect()
    })
}

/// Names of the tasks that robots have.
pub(crate) fn tasks() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| {
        candidates(current, |_| {
            let list: RobotList = get("/robots")?;
            let tasks = list.robots.iter().flat_map(|robot| &robot.tasks);
            Some(tasks.map(|task| (task.task.to_string(), String::new())).collect())
        })
    })
}

/// Names of packages, and behind a colon their versions.
pub(crate) fn packages() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| {
        candidates(current, |text| {
            let list: PackageList = get("/packages")?;
            let name = |package: &task_proto::api::PackageView| match text.contains(':') {
                true => format!("{}:{}", package.package.name, package.package.version),
                false => package.package.name.to_string(),
            };
            Some(list.packages.iter().map(|package| (name(package), String::new())).collect())
        })
    })
}

pub(crate) fn deployments() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| {
        candidates(current, |_| {
            let list: DeploymentList = get("/deployments")?;
            let named = list.deployments.iter().map(|deployment| {
                let package = &deployment.package;
                let what = format!(
                    "{} {}, {}",
                    package.name,
                    package.version,
                    view::state(deployment.state)
                );
                (deployment.id.to_string(), what)
            });
            Some(named.collect())
        })
    })
}

pub(crate) fn users() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| {
        candidates(current, |_| {
            let list: UserList = get("/users")?;
            Some(
                list.users
                    .iter()
                    .map(|user| (user.name.to_string(), user.roles.to_string()))
                    .collect(),
            )
        })
    })
}

/// Ids of the user's own access tokens.
pub(crate) fn tokens() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| {
        candidates(current, |_| {
            let list: TokenList = get("/tokens")?;
            Some(
                list.tokens
                    .iter()
                    .map(|token| (token.id.to_string(), token.title.clone()))
                    .collect(),
            )
        })
    })
}

/// Ids of enrollment tokens.
pub(crate) fn enrollment_tokens() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| {
        candidates(current, |_| {
            let list: EnrollmentTokenList = get("/enrollment-tokens")?;
            Some(list.tokens.iter().map(|token| (token.id.to_string(), String::new())).collect())
        })
    })
}

/// Names of nodes on the graph of the robot that the command line names before.
pub(crate) fn nodes() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| {
        candidates(current, |_| {
            let words: Vec<String> = std::env::args().collect();
            let answer = query(async move |client| {
                let list: RobotList = client.get("/robots", &[]).await.ok()?;
                let robot = list
                    .robots
                    .into_iter()
                    .map(|robot| robot.name)
                    .find(|name| words.contains(&name.to_string()))?;
                client.query_robot(&robot, &Ask::Nodes).await.ok()
            })?;
            let Answer::Nodes { nodes, .. } = answer else { return None };
            Some(nodes.iter().map(|node| (node.name.to_string(), String::new())).collect())
        })
    })
}

fn robot_candidates() -> Option<Candidates> {
    let list: RobotList = get("/robots")?;
    let named = list.robots.iter().map(|robot| {
        let state = if robot.online { "online" } else { "offline" };
        (robot.name.to_string(), state.to_owned())
    });
    Some(named.collect())
}

fn selector_terms() -> Option<Candidates> {
    let list: RobotList = get("/robots")?;
    let mut terms = Candidates::from([("*".to_owned(), "all robots".to_owned())]);
    for robot in &list.robots {
        terms.insert(robot.name.to_string(), "robot".to_owned());
        terms.extend(
            robot.labels.iter().map(|(key, value)| (format!("{key}={value}"), "label".to_owned())),
        );
    }
    Some(terms)
}

/// Those of `find`'s names that begin with `current`; empty if the lookup fails.
fn candidates(
    current: &OsStr,
    find: impl FnOnce(&str) -> Option<Candidates>,
) -> Vec<CompletionCandidate> {
    let Some(text) = current.to_str() else { return Vec::new() };
    let found =
        find(text).unwrap_or_default().into_iter().filter(|(name, _)| name.starts_with(text));
    // The words may come from a robot or a package.
    let candidate = |(name, help): (String, String)| {
        let help = (!help.is_empty()).then(|| printable(&help).into());
        CompletionCandidate::new(printable(&name)).help(help)
    };
    found.map(candidate).collect()
}

fn get<T: DeserializeOwned + Send + 'static>(path: &'static str) -> Option<T> {
    query(async move |client| client.get(path, &[]).await.ok())
}

/// Sends a request to the server given on the command line, with a time limit of one second.
fn query<T, F>(request: impl FnOnce(Client) -> F) -> Option<T>
where
    F: Future<Output = Option<T>>,
{
    let client = Client::connect(&connection(std::env::args())).ok()?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().ok()?;
    let answer =
        runtime.block_on(async { tokio::time::timeout(ANSWER_TIMEOUT, request(client)).await });
    // Does not wait for a name lookup on another thread.
    runtime.shutdown_background();
    answer.ok().flatten()
}

/// The options of an incomplete command line, and the environment.
fn connection(words: impl Iterator<Item = String>) -> Connection {
    let words: Vec<String> = words.collect();
    let option = |name: &str| {
        let mut found =
            words.iter().enumerate().filter_map(|(at, word)| match word.strip_prefix(name)? {
                "" => words.get(at + 1).cloned(),
                rest => rest.strip_prefix('=').map(str::to_owned),
            });
        found.next_back()
    };
    let or_variable = |name: &str, variable: &str| {
        option(name).or_else(|| std::env::var(variable).ok()).filter(|value| !value.is_empty())
    };
    let mut connection = Connection {
        server: or_variable("--server", "TASKD_SERVER"),
        pin: or_variable("--pin", "TASKD_PIN").and_then(|pin| pin.parse().ok()),
        token: or_variable("--token", "TASKD_TOKEN"),
        token_file: option("--token-file").map(Into::into),
        data: or_variable("--data", "TASKD_DATA"),
        output: Format::Json,
    };
    connection.prefer_typed_options(|name| option(&format!("--{name}")).is_some());
    connection
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn server_is_read_from_an_incomplete_command_line() {
        let words = [
            "taskd",
            "--",
            "taskd",
            "--server",
            "http://a",
            "robot",
            "info",
            "--token-file=/t",
            "--token=x",
            "--data",
        ];
        let connection = connection(words.map(str::to_owned).into_iter());
        assert_eq!(connection.server.as_deref(), Some("http://a"));
        assert_eq!(connection.token.as_deref(), Some("x"));
        assert_eq!(connection.token_file, Some("/t".into()));
    }

    #[test]
    fn candidates_match_the_prefix_and_have_no_control_characters() {
        let found = || {
            Some(Candidates::from([
                ("atlas-1\u{1b}".to_owned(), String::new()),
                ("bolt".to_owned(), String::new()),
            ]))
        };
        let names: Vec<_> = candidates(OsStr::new("at"), |_| found())
            .iter()
            .map(|c| c.get_value().to_owned())
            .collect();
        assert_eq!(names, ["atlas-1 "]);
        assert!(candidates(OsStr::new(""), |_| None).is_empty());
    }
}
