//! `taskd run`: the counterpart of `ros2 launch` on a robot. The launch file and its arguments
//! become part of the ordered package, so that the robot, its restarts and later readers all see
//! the same intention.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use clap::Args;
use task_proto::api::{CreateDeployment, DeploymentView, RobotView};
use task_proto::desired::PackageRef;
use task_proto::{RobotId, RobotName};

use super::push::{packed, say_running, sign};
use crate::commands::api::upload::{Upload, upload};
use crate::commands::api::{client, complete, wait};
use crate::commands::display::output::{printable, say};
use crate::commands::display::view;
use crate::commands::keys::key_file;
use crate::commands::packages::package::{PackageName, find, short};
use crate::commands::robots::{logs, selection};
use crate::commands::{CommandError, Outcome, Session};
use crate::config::lifetime;
use crate::package::{Launch, PackageError, Problem, describe};

/// What to run where.
#[derive(Debug, Args)]
#[group(skip)]
pub struct RunOrder {
    /// The robot's name or id
    #[arg(add = complete::robots())]
    robot: RobotName,
    /// A package's directory (with a / in it, or .), or a package on the server as NAME,
    /// NAME:VERSION or NAME@DIGEST
    #[arg(value_name = "PKG", add = complete::packages(), value_hint = clap::ValueHint::DirPath)]
    package: String,
    /// The launch file's name; without it the package runs as its own [run] says, which needs no
    /// ros2 launch if that is a command
    #[arg(value_name = "FILE.launch.py")]
    file: Option<String>,
    /// Launch arguments; those of the package's own launch file stay where nothing else is said
    #[arg(value_name = "ARG:=VALUE")]
    arguments: Vec<Argument>,
    /// The ROS package that has the launch file [default: that of the package's own launch file,
    /// else the one of its name]
    #[arg(long, value_name = "NAME", requires = "file")]
    ros_package: Option<String>,
    /// Show what the robot's task says once it runs, until Ctrl-C; it runs on
    #[arg(short, long, conflicts_with = "detach")]
    follow: bool,
    /// Order it and don't wait until it runs
    #[arg(short, long)]
    detach: bool,
    /// Run it anew also where the same package runs already, with the same arguments
    #[arg(long)]
    restart: bool,
    /// How long to wait
    #[arg(long, value_name = "TIME", value_parser = lifetime, default_value = "10m")]
    timeout: Duration,
    /// Sign it with this private key, of taskd key new; may be repeated
    #[arg(long = "sign", value_name = "KEY")]
    keys: Vec<PathBuf>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Argument {
    name: String,
    value: String,
}

impl FromStr for Argument {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once(":=") {
            Some((name, value)) if !name.is_empty() => {
                Ok(Self { name: name.to_owned(), value: value.to_owned() })
            }
            _ => Err("expected ARG:=VALUE, as ros2 launch takes it".to_owned()),
        }
    }
}

pub(in crate::commands) async fn run(
    session: &Session,
    order: RunOrder,
) -> Result<Outcome, CommandError> {
    let keys = order.keys.iter().map(|path| key_file::read(path)).collect::<Result<Vec<_>, _>>()?;
    let robot = selection::one(session, &order.robot).await?;
    let arguments: BTreeMap<String, String> = order
        .arguments
        .iter()
        .map(|argument| (argument.name.clone(), argument.value.clone()))
        .collect();
    let file = order.file.clone();
    if let Some(argument) = file.as_ref().filter(|file| file.contains(":=")) {
        return Err(CommandError::Usage(format!(
            "{argument}: FILE.launch.py comes before the arguments for it"
        )));
    }
    let launch =
        file.map(|file| Launch { ros_package: order.ros_package.clone(), file, arguments });
    let package = match order.package.contains('/') || order.package == "." {
        true => {
            let packed = packed(PathBuf::from(&order.package), launch).await?;
            upload(&session.client, &Upload::of(&packed, false)).await?;
            packed.package
        }
        false => stored(session, &order.package, launch).await?,
    };
    sign(session, &package, &keys).await?;
    let selector =
        robot.id.as_str().parse().map_err(|error| CommandError::Usage(format!("{error}")))?;
    let create = CreateDeployment {
        restart: order.restart,
        ..CreateDeployment::new(package.name.clone(), package.manifest.digest, selector)
    };
    let ordered: DeploymentView =
        session.client.order("/deployments", &create, &client::random_key()).await?;
    say(&format!(
        "deployment {}: {} {} to {}",
        ordered.id, package.name, package.version, robot.name
    ));
    say_running(&ordered);
    if order.detach {
        view::print(session, &ordered)?;
        return Ok(Outcome::Succeeded);
    }
    let outcome = wait::until_settled(session, &ordered.id, order.timeout).await?;
    if matches!(outcome, Outcome::Failed | Outcome::SomeFailed | Outcome::TimedOut) {
        say_what_still_runs(session, &robot.id, &ordered).await?;
    }
    match order.follow && outcome == Outcome::Succeeded {
        true => logs::follow_task(session, robot.name, package.name).await,
        false => Ok(outcome),
    }
}

/// A package on the server, with this launch file instead of its own.
async fn stored(
    session: &Session,
    text: &str,
    launch: Option<Launch>,
) -> Result<PackageRef, CommandError> {
    let named: PackageName =
        text.parse().map_err(|error| CommandError::Usage(format!("PKG: {error}")))?;
    let stored = find(session, &named).await?;
    let Some(launch) = launch else { return Ok(stored.package) };
    let manifest = launch.put_into(stored.manifest);
    let problems = manifest.problems();
    if !problems.is_empty() {
        let problem = |problem: task_proto::manifest::ManifestProblem| Problem {
            file: "FILE and ARG".to_owned(),
            reason: problem.to_string(),
        };
        let problems = problems.into_iter().map(problem).collect();
        return Err(PackageError::Invalid { dir: PathBuf::from(text), problems }.into());
    }
    let variant = describe(&manifest, stored.package.content)?;
    let (config, manifest) = (&variant.config_bytes[..], &variant.manifest_bytes[..]);
    let package = &variant.package;
    let new = Upload { package, config, manifest, content: None, tagged: false, force: false };
    upload(&session.client, &new).await?;
    Ok(variant.package)
}

/// Reports that the previous version keeps running where the new one could not replace it.
async fn say_what_still_runs(
    session: &Session,
    robot: &RobotId,
    ordered: &DeploymentView,
) -> Result<(), CommandError> {
    let robot: RobotView = session.client.get(&format!("/robots/{robot}"), &[]).await?;
    let Some(task) = robot.tasks.iter().find(|task| task.task == ordered.package.name) else {
        return Ok(());
    };
    let Some(active) = task.active.as_ref().filter(|active| active.deployment != ordered.id) else {
        return Ok(());
    };
    let digest =
        active.manifest.map_or_else(String::new, |digest| format!(" ({})", short(&digest)));
    let why =
        task.failure.as_ref().map_or_else(|| task.phase.to_string(), |failure| failure.to_string());
    say(&printable(&format!(
        "{} still runs {} {}{digest}, which it had before; the new one does not run: {why}",
        robot.name, task.task, active.version
    )));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_written_as_for_ros2_launch() {
        let argument =
            |text: &str| text.parse::<Argument>().map(|argument| (argument.name, argument.value));
        assert_eq!(argument("map:=a:=b"), Ok(("map".to_owned(), "a:=b".to_owned())));
        assert_eq!(argument("use_sim_time:="), Ok(("use_sim_time".to_owned(), String::new())));
        assert!(argument(":=x").is_err() && argument("map=x").is_err());
    }
}
