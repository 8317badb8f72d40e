//! `taskd push` and `taskd pack`: from a directory to a package, to the server and, with `--to`, to
//! robots.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueEnum};
use task_proto::RepositoryName;
use task_proto::api::{
    AssignmentView, CreateDeployment, DeliveryChoice, DeploymentView, MAX_PRIORITY, MIN_PRIORITY,
    names,
};
use task_proto::desired::PackageRef;
use task_proto::envelope::SigningKey;
use task_proto::publisher::{PackageStatement, SIGNATURE_ARTIFACT};
use task_proto::report::Phase;
use task_proto::selector::Selector;

use crate::commands::api::{client, complete, upload, wait};
use crate::commands::display::confirm::confirm;
use crate::commands::display::output::{Output, bytes, robots, say};
use crate::commands::display::view;
use crate::commands::keys::key_file;
use crate::commands::robots::selection;
use crate::commands::{CommandError, Outcome, Session};
use crate::config::{at_least_one, lifetime};
use crate::package::{self, Launch, Packed};

/// What to push, where to and how.
#[derive(Debug, Args)]
#[group(skip)]
pub struct Push {
    /// The package's directory, with task.toml, package.xml or both
    dir: PathBuf,
    /// Deploy it to these robots: *, names, label=value, !term for all but; without it the package
    /// is only uploaded
    #[arg(long, value_name = "SELECTOR", add = complete::selectors())]
    to: Option<Selector>,
    /// Wait until it runs (a job: has succeeded) everywhere
    #[arg(long, requires = "to")]
    wait: bool,
    /// How long to wait
    #[arg(long, value_name = "TIME", value_parser = lifetime, default_value = "10m", requires = "to")]
    timeout: Duration,
    /// Run it anew also where the same package runs already
    #[arg(long, requires = "to")]
    restart: bool,
    /// So many robots at a time [default: all at once]
    #[arg(long, value_name = "N", value_parser = at_least_one, requires = "to")]
    batch: Option<u64>,
    /// Pause when more robots than this have failed [default: never]
    #[arg(long, value_name = "N", requires = "to")]
    max_failures: Option<u64>,
    /// How the bytes travel
    #[arg(long, value_enum, default_value_t = DeliveryName::Adaptive, requires = "to")]
    delivery: DeliveryName,
    /// What comes first, on a robot and where transfers have to wait: the highest, from -100 to 100
    #[arg(long, value_name = "N", allow_negative_numbers = true, default_value_t = 0, requires = "to",
          value_parser = clap::value_parser!(i32).range(i64::from(MIN_PRIORITY)..=i64::from(MAX_PRIORITY)))]
    priority: i32,
    /// When what is not done by then expires [default: the server's setting]
    #[arg(long, value_name = "TIME", value_parser = lifetime, requires = "to")]
    expires: Option<Duration>,
    /// Sign it with this private key, of taskd key new; may be repeated
    #[arg(long = "sign", value_name = "KEY")]
    keys: Vec<PathBuf>,
    /// Take the version from a package with other content; robots that have that one are marked as
    /// outdated
    #[arg(long)]
    force: bool,
    /// Only check the package and list the robots that are meant
    #[arg(long)]
    dry_run: bool,
    /// Don't ask, however many robots are meant
    #[arg(short, long)]
    yes: bool,
    /// Makes a repeated command the same order
    #[arg(long, value_name = "KEY", requires = "to")]
    idempotency_key: Option<String>,
}

/// How the bytes travel, by the name it has everywhere.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum DeliveryName {
    /// The server's rules decide for each robot
    Adaptive,
    /// The server announces, the robot pulls
    PushPull,
    /// The bytes travel in MQTT messages, published once for all robots
    DirectPush,
    /// The robot asks on its own timer
    Poll,
    /// A small package rides inside the announcement
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

/// What to pack.
#[derive(Debug, Args)]
pub struct Pack {
    /// The package's directory
    dir: PathBuf,
    /// Write the content archive (tar+zstd) to this file
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

pub(in crate::commands) async fn run(
    session: &Session,
    push: Push,
) -> Result<Outcome, CommandError> {
    // Before anything is done: a key that can't be used must not leave a package without its
    // signature on the server.
    let keys = push.keys.iter().map(|path| key_file::read(path)).collect::<Result<Vec<_>, _>>()?;
    let matched = match &push.to {
        // The server knows an order that may be a repetition, even if its robots are gone.
        Some(selector) if push.idempotency_key.is_some() && !push.dry_run => {
            Some(selection::named(selection::matching(session, selector).await?.robots))
        }
        // An empty selection is a mistake in the command, noticed before any upload.
        Some(selector) => Some(selection::matched(session, selector).await?),
        None => None,
    };
    let packed = packed(push.dir.clone(), None).await?;
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
        session.output.described(&packed.package, reference, |_| describe(&packed))?;
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
    let ordered: DeploymentView = session.client.order("/deployments", &order, &key).await?;
    let count = robots(ordered.counts.iter().map(|count| count.count).sum());
    say(&format!(
        "deployment {}: {} {} to {count}",
        ordered.id, order.package, ordered.package.version
    ));
    for superseded in &ordered.supersedes {
        say(&format!("it supersedes {superseded}"));
    }
    say_running(&ordered);
    if !push.wait {
        view::print(session, &ordered)?;
        return Ok(Outcome::Succeeded);
    }
    wait::until_settled(session, &ordered.id, push.timeout).await
}

/// Reports the robots on which a new deployment found its package running.
pub(in crate::commands) fn say_running(ordered: &DeploymentView) {
    const MAX_NAMES: usize = 5;
    let assignments = ordered.assignments.as_deref().unwrap_or_default();
    let running: Vec<&AssignmentView> =
        assignments.iter().filter(|one| one.phase == Phase::Running).collect();
    if !running.is_empty() {
        say(&format!(
            "already running on {}; --restart runs it anew there",
            names(&running, MAX_NAMES)
        ));
    }
}

/// Stores the publishers' signatures of the package beside the package.
pub(in crate::commands) async fn sign(
    session: &Session,
    package: &PackageRef,
    keys: &[SigningKey],
) -> Result<(), CommandError> {
    let repository = RepositoryName::of_package(&package.name);
    for key in keys {
        let envelope = PackageStatement { package: package.clone() }.seal(key);
        let about = (Some(package.manifest), None);
        upload::upload_signed(&session.client, &repository, SIGNATURE_ARTIFACT, &envelope, about)
            .await?;
        say(&format!("{} {}: signed by {}", package.name, package.version, key.public_key().id()));
    }
    Ok(())
}

pub(in crate::commands) async fn packed(
    dir: PathBuf,
    launch: Option<Launch>,
) -> Result<Packed, CommandError> {
    let packing = tokio::task::spawn_blocking(move || match &launch {
        Some(launch) => package::pack_to_launch(&dir, launch),
        None => package::pack(&dir),
    });
    let packed = packing.await.map_err(|error| CommandError::Io {
        what: "the packer ended unexpectedly".to_owned(),
        source: error.into(),
    })??;
    Ok(packed)
}

pub(in crate::commands) async fn pack(
    output: &Output,
    pack: Pack,
) -> Result<Outcome, CommandError> {
    let packed = packed(pack.dir, None).await?;
    if let Some(path) = &pack.out {
        std::fs::copy(packed.content.path(), path).map_err(|source| CommandError::Io {
            what: format!("can't write {}", path.display()),
            source,
        })?;
    }
    output.described(&packed.package, reference, |_| describe(&packed))?;
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
        bytes(package.content.size),
        bytes(facts.tar_size),
        facts.entries
    )
}
