//! `taskd run`: the counterpart of `ros2 launch` on a robot. The launch file and its arguments
//! become part of the ordered package, so that the robot, its restarts and later readers all see
//! the same intention.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use clap::Args;
use task_package::{Launch, PackageError, Problem, describe};
use task_proto::api::{CreateDeployment, DeploymentView, RobotView};
use task_proto::desired::PackageRef;
use task_proto::time::parse_lifetime;
use task_proto::{RobotId, RobotName};

use super::push::{packed, report_already_running, sign};
use crate::api::upload::{Upload, upload};
use crate::api::{client, complete, wait};
use crate::display::output::{printable, say, short_digest};
use crate::display::view;
use crate::keys::key_file;
use crate::packages::package::{PackageName, find};
use crate::robots::{logs, selection};
use crate::{CommandError, Outcome, Session};

/// The package, the launch file and the robot.
#[derive(Debug, Args)]
#[group(skip)]
pub struct RunArgs {
    /// Robot name or id
    #[arg(add = complete::robots())]
    robot: RobotName,
    /// Package directory (a path with a /, or .), or a package on the server: NAME, NAME:VERSION or
    /// NAME@DIGEST
    #[arg(value_name = "PKG", add = complete::packages(), value_hint = clap::ValueHint::DirPath)]
    package: String,
    /// Launch file [default: the command or launch file in [run] of task.toml]
    #[arg(value_name = "FILE.launch.py")]
    file: Option<String>,
    /// Launch arguments, in addition to those of the package's own launch file
    #[arg(value_name = "ARG:=VALUE")]
    arguments: Vec<Argument>,
    /// ROS package of the launch file [default: that of the package's own launch file, then the
    /// package's name]
    #[arg(long, value_name = "NAME", requires = "file")]
    ros_package: Option<String>,
    /// Follow the task's log once it runs; Ctrl-C does not stop the task
    #[arg(short, long, conflicts_with = "detach")]
    follow: bool,
    /// Return immediately, without waiting until the task runs
    #[arg(short, long)]
    detach: bool,
    /// Restart the task if it already runs with the same package and arguments
    #[arg(long)]
    restart: bool,
    /// Maximum time to wait
    #[arg(long, value_name = "TIME", value_parser = parse_lifetime, default_value = "10m")]
    timeout: Duration,
    /// Sign the package with this private key (see taskd key new); may be repeated
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
            _ => Err("expected ARG:=VALUE, as for ros2 launch".to_owned()),
        }
    }
}

pub(crate) async fn run(session: &Session, args: RunArgs) -> Result<Outcome, CommandError> {
    let keys = args.keys.iter().map(|path| key_file::read(path)).collect::<Result<Vec<_>, _>>()?;
    let robot = selection::resolve_robot(session, &args.robot).await?;
    let arguments: BTreeMap<String, String> = args
        .arguments
        .iter()
        .map(|argument| (argument.name.clone(), argument.value.clone()))
        .collect();
    let file = args.file.clone();
    if let Some(argument) = file.as_ref().filter(|file| file.contains(":=")) {
        return Err(CommandError::Usage(format!(
            "{argument}: give FILE.launch.py before its arguments"
        )));
    }
    let launch = file.map(|file| Launch { ros_package: args.ros_package.clone(), file, arguments });
    let package = match args.package.contains('/') || args.package == "." {
        true => {
            let packed = packed(PathBuf::from(&args.package), launch).await?;
            upload(&session.client, &Upload::of(&packed, false)).await?;
            packed.package
        }
        false => stored(session, &args.package, launch).await?,
    };
    sign(session, &package, &keys).await?;
    let selector =
        robot.id.as_str().parse().map_err(|error| CommandError::Usage(format!("{error}")))?;
    let create = CreateDeployment {
        restart: args.restart,
        ..CreateDeployment::new(package.name.clone(), package.manifest.digest, selector)
    };
    let ordered: DeploymentView =
        session.client.post_with_key("/deployments", &create, &client::random_key()).await?;
    say(&format!(
        "deployment {}: {} {} to {}",
        ordered.id, package.name, package.version, robot.name
    ));
    report_already_running(&ordered);
    if args.detach {
        view::print(session, &ordered)?;
        return Ok(Outcome::Succeeded);
    }
    let outcome = wait::until_settled(session, &ordered.id, args.timeout).await?;
    if matches!(outcome, Outcome::Failed | Outcome::SomeFailed | Outcome::TimedOut) {
        report_active_version(session, &robot.id, &ordered).await?;
    }
    match args.follow && outcome == Outcome::Succeeded {
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
    let manifest = launch.apply_to(stored.manifest);
    let problems = manifest.problems();
    if !problems.is_empty() {
        let problem = |problem: task_proto::packages::manifest::ManifestProblem| Problem {
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
async fn report_active_version(
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
        active.manifest.map_or_else(String::new, |digest| format!(" ({})", short_digest(&digest)));
    let why =
        task.failure.as_ref().map_or_else(|| task.phase.to_string(), |failure| failure.to_string());
    say(&printable(&format!(
        "{} still runs the previous version, {} {}{digest}; the new version does not run: {why}",
        robot.name, task.task, active.version
    )));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn launch_arguments_are_parsed_like_ros2_launch() {
        let argument =
            |text: &str| text.parse::<Argument>().map(|argument| (argument.name, argument.value));
        assert_eq!(argument("map:=a:=b"), Ok(("map".to_owned(), "a:=b".to_owned())));
        assert_eq!(argument("use_sim_time:="), Ok(("use_sim_time".to_owned(), String::new())));
        assert!(argument(":=x").is_err() && argument("map=x").is_err());
    }
}
