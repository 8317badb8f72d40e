//! `taskd push` and `taskd pack`: from a directory to a package, to the server and, with `--to`, to
//! robots.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueEnum};
use task_package::{Launch, Packed};
use task_proto::RepositoryName;
use task_proto::api::{
    AssignmentView, CreateDeployment, DeliveryChoice, DeploymentView, MAX_PRIORITY, MIN_PRIORITY,
    join_names,
};
use task_proto::desired::PackageRef;
use task_proto::ids::selector::Selector;
use task_proto::messages::report::Phase;
use task_proto::packages::publisher::{PackageStatement, SIGNATURE_ARTIFACT};
use task_proto::size::format_bytes;
use task_proto::time::parse_lifetime;
use task_proto::trust::envelope::SigningKey;

use crate::api::{client, complete, upload, wait};
use crate::display::confirm::confirm;
use crate::display::output::{Output, robots, say};
use crate::display::view;
use crate::keys::key_file;
use crate::robots::selection;
use crate::{CommandError, Outcome, Session};

/// The package, the robots, and how to deploy.
#[derive(Debug, Args)]
#[group(skip)]
pub struct PushArgs {
    /// Package directory, with task.toml, package.xml or both
    dir: PathBuf,
    /// Deploy to these robots: *, names or ids, label=value, !TERM to exclude; without --to, only
    /// upload
    #[arg(long, value_name = "SELECTOR", add = complete::selectors())]
    to: Option<Selector>,
    /// Wait until the task runs (a job: has succeeded) on all robots
    #[arg(long, requires = "to")]
    wait: bool,
    /// Maximum time to wait
    #[arg(long, value_name = "TIME", value_parser = parse_lifetime, default_value = "10m", requires = "to")]
    timeout: Duration,
    /// Restart robots that already run this package
    #[arg(long, requires = "to")]
    restart: bool,
    /// Number of robots per batch [default: all at once]
    #[arg(long, value_name = "N", value_parser = parse_positive, requires = "to")]
    batch: Option<u64>,
    /// Pause the rollout when more than this many robots have failed [default: no limit]
    #[arg(long, value_name = "N", requires = "to")]
    max_failures: Option<u64>,
    /// Delivery method
    #[arg(long, value_enum, default_value_t = DeliveryName::Adaptive, requires = "to")]
    delivery: DeliveryName,
    /// Priority on the robot and in the transfer queue, from -100 to 100; the highest goes first
    #[arg(long, value_name = "N", allow_negative_numbers = true, default_value_t = 0, requires = "to",
          value_parser = clap::value_parser!(i32).range(i64::from(MIN_PRIORITY)..=i64::from(MAX_PRIORITY)))]
    priority: i32,
    /// Time after which unfinished assignments expire [default: the server's setting]
    #[arg(long, value_name = "TIME", value_parser = parse_lifetime, requires = "to")]
    expires: Option<Duration>,
    /// Sign the package with this private key (see taskd key new); may be repeated
    #[arg(long = "sign", value_name = "KEY")]
    keys: Vec<PathBuf>,
    /// Replace an existing version that has other content; robots with the old content are marked
    /// as outdated
    #[arg(long)]
    force: bool,
    /// Only check the package and list the matching robots
    #[arg(long)]
    dry_run: bool,
    /// Skip the confirmation prompt
    #[arg(short, long)]
    yes: bool,
    /// Idempotency key: a repeated command with the same key is carried out once
    #[arg(long, value_name = "KEY", requires = "to")]
    idempotency_key: Option<String>,
}

/// A delivery method, by its name on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum DeliveryName {
    /// The server's rules choose for each robot
    Adaptive,
    /// The server notifies the robot, which downloads over HTTP
    PushPull,
    /// The content is published once over MQTT for all robots
    DirectPush,
    /// The robot polls on its own timer
    Poll,
    /// A small package is embedded in the notification
    Inline,
}

impl From<DeliveryName> for DeliveryChoice {
    fn from(name: DeliveryName) -> Self {
        match name {
            DeliveryName::Adaptive => Self::Adaptive,
            DeliveryName::PushPull => Self::PushPull,
            DeliveryName::DirectPush => Self::DirectPush,
            DeliveryName::Poll => Self::Poll,
            DeliveryName::Inline => Self::Inline,
        }
    }
}

/// The package, and the file to write.
#[derive(Debug, Args)]
pub struct PackArgs {
    /// Package directory
    dir: PathBuf,
    /// Write the content archive (tar+zstd) to this file
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

pub(crate) async fn run(session: &Session, push: PushArgs) -> Result<Outcome, CommandError> {
    // First of all: an unusable key must not leave an unsigned package on the server.
    let keys = push.keys.iter().map(|path| key_file::read(path)).collect::<Result<Vec<_>, _>>()?;
    // A mistake in the local package is reported before one in the selection of robots.
    let packed = packed(push.dir.clone(), None).await?;
    let matched = match &push.to {
        // The server recognises a repeated order even if its robots are gone.
        Some(selector) if push.idempotency_key.is_some() && !push.dry_run => {
            Some(selection::to_matched(selection::list_robots(session, selector).await?.robots))
        }
        // An empty selection is a usage error, reported before any upload.
        Some(selector) => Some(selection::resolve_robots(session, selector).await?),
        None => None,
    };
    if push.dry_run {
        view::print_matched(session, &matched.unwrap_or_default())?;
        return Ok(Outcome::Succeeded);
    }
    if let (Some(selector), Some(matched)) = (&push.to, &matched) {
        confirm(
            &format!("push {} to {selector}", packed.package.name),
            matched.robots.len(),
            push.yes,
        )?;
    }
    let package = upload::Upload { force: push.force, ..upload::Upload::of(&packed, true) };
    upload::upload(&session.client, &package).await?;
    sign(session, &packed.package, &keys).await?;
    let Some(selector) = push.to else {
        session.output.print_object(&packed.package, reference, |_| describe(&packed))?;
        return Ok(Outcome::Succeeded);
    };
    let order = CreateDeployment {
        package: packed.package.name.clone(),
        manifest: packed.package.manifest.digest,
        selector,
        delivery: push.delivery.into(),
        priority: push.priority,
        batch: push.batch,
        max_failures: push.max_failures,
        expires_in_s: push.expires.map(|expires| expires.as_secs()),
        restart: push.restart,
        dry_run: false,
    };
    let key = push.idempotency_key.unwrap_or_else(client::random_key);
    let ordered: DeploymentView =
        session.client.post_with_key("/deployments", &order, &key).await?;
    let count = robots(ordered.counts.iter().map(|count| count.count).sum());
    say(&format!(
        "deployment {}: {} {} to {count}",
        ordered.id, order.package, ordered.package.version
    ));
    for superseded in &ordered.supersedes {
        say(&format!("supersedes {superseded}"));
    }
    report_already_running(&ordered);
    if !push.wait {
        view::print(session, &ordered)?;
        return Ok(Outcome::Succeeded);
    }
    wait::until_settled(session, &ordered.id, push.timeout).await
}

/// Reports the robots on which a new deployment found its package running.
pub(crate) fn report_already_running(ordered: &DeploymentView) {
    const MAX_NAMES: usize = 5;
    let assignments = ordered.assignments.as_deref().unwrap_or_default();
    let running: Vec<&AssignmentView> =
        assignments.iter().filter(|one| one.phase == Phase::Running).collect();
    if !running.is_empty() {
        say(&format!(
            "already running on {}; use --restart to restart it",
            join_names(&running, MAX_NAMES)
        ));
    }
}

/// Stores the publishers' signatures of the package beside the package.
pub(crate) async fn sign(
    session: &Session,
    package: &PackageRef,
    keys: &[SigningKey],
) -> Result<(), CommandError> {
    let repository = RepositoryName::of_package(&package.name);
    for key in keys {
        let envelope = PackageStatement { package: package.clone() }.seal(key);
        let reference = (Some(package.manifest), None);
        upload::upload_signed(
            &session.client,
            &repository,
            SIGNATURE_ARTIFACT,
            &envelope,
            reference,
        )
        .await?;
        say(&format!("{} {}: signed by {}", package.name, package.version, key.public_key().id()));
    }
    Ok(())
}

pub(crate) async fn packed(dir: PathBuf, launch: Option<Launch>) -> Result<Packed, CommandError> {
    let packing = tokio::task::spawn_blocking(move || match &launch {
        Some(launch) => task_package::pack_with_launch(&dir, launch),
        None => task_package::pack(&dir),
    });
    let packed = packing.await.map_err(|error| CommandError::Io {
        what: "packing was aborted".to_owned(),
        source: error.into(),
    })??;
    Ok(packed)
}

pub(crate) async fn pack(output: &Output, args: PackArgs) -> Result<Outcome, CommandError> {
    let packed = packed(args.dir, None).await?;
    if let Some(path) = &args.out {
        std::fs::copy(packed.content.path(), path).map_err(|source| CommandError::Io {
            what: format!("can't write {}", path.display()),
            source,
        })?;
    }
    output.print_object(&packed.package, reference, |_| describe(&packed))?;
    Ok(Outcome::Succeeded)
}

/// The package's name in other commands.
fn reference(package: &PackageRef) -> String {
    format!("{}:{}", package.name, package.version)
}

fn describe(packed: &Packed) -> String {
    let (package, facts) = (&packed.package, &packed.manifest.content);
    format!(
        "package     {} {}\nmanifest    {}\ncontent     {} ({}, {} unpacked, {} entries)\n",
        package.name,
        package.version,
        package.manifest.digest,
        package.content.digest,
        format_bytes(package.content.size),
        format_bytes(facts.tar_size),
        facts.entries
    )
}

/// Parses a count that must be at least one.
fn parse_positive(text: &str) -> Result<u64, String> {
    text.parse()
        .ok()
        .filter(|count| *count > 0)
        .ok_or_else(|| "expected a whole number, 1 or more".to_owned())
}
