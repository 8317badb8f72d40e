//! `taskd key`: publishers' keys, which never leave their machine, and the list of publishers that
//! robots trust. A list is drafted, signed by the required number of keepers, each on the machine
//! with their key, and published.

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Subcommand;
use reqwest::StatusCode;
use serde::{Deserialize, Serialize};
use task_proto::Digest;
use task_proto::envelope::{Envelope, PublicKey};
use task_proto::oci::ImageManifest;
use task_proto::publisher::{
    InvalidRole, LIST_ARTIFACT, LIST_REPOSITORY, LIST_TYPE, PublisherList, Role,
};

use super::key_file;
use crate::commands::api::client::{Client, ClientError};
use crate::commands::api::upload;
use crate::commands::display::output::{Output, say, time};
use crate::commands::{CommandError, Connection, Outcome};
use crate::config::lifetime;
use crate::system::clock::Clock;

/// What to do with keys and their list.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// Make a key: the private half in FILE, only for its owner, the public one in FILE.pub
    New {
        /// The file, which must not exist
        file: PathBuf,
    },
    /// Print a public key and its id
    Show {
        /// A key, or a file with one
        #[arg(value_name = "KEY")]
        key: String,
    },
    /// Print the newest list of publishers on the server
    List,
    /// Write the next list of publishers into a file, to be signed; what is not given is as in the
    /// newest
    Draft(Draft),
    /// Sign a drafted list, and say what it says
    Sign {
        /// The draft
        file: PathBuf,
        /// The private key to sign it with
        #[arg(long, value_name = "KEY")]
        key: PathBuf,
    },
    /// Put a signed list on the server, which tells all robots
    Publish {
        /// The signed draft
        file: PathBuf,
    },
}

/// What the next list says.
#[derive(Debug, clap::Args)]
#[group(skip)]
pub struct Draft {
    /// Where to write it
    file: PathBuf,
    /// A key that may publish, or a file with it; all that may are to be given
    #[arg(long = "publisher", value_name = "KEY")]
    publishers: Vec<String>,
    /// How many publishers must have signed a package
    #[arg(long, value_name = "N")]
    threshold: Option<u32>,
    /// A key that signs lists; all that do are to be given [default for the first list: the
    /// publishers]
    #[arg(long = "keeper", value_name = "KEY")]
    keepers: Vec<String>,
    /// How many keepers must have signed the next list
    #[arg(long, value_name = "N")]
    keeper_threshold: Option<u32>,
    /// A package that must not run any more, by its manifest's digest; those before stay so
    #[arg(long = "withdraw", value_name = "DIGEST")]
    withdrawn: Vec<Digest>,
    /// How long robots begin new work by it
    #[arg(long, value_name = "TIME", value_parser = lifetime, default_value = "90d")]
    lifetime: Duration,
}

/// The printed form of a key.
#[derive(Serialize)]
struct KeyView {
    id: String,
    key: PublicKey,
}

#[derive(Deserialize)]
struct Tags {
    tags: Vec<String>,
}

pub(in crate::commands) async fn run(
    connection: &Connection,
    action: Action,
) -> Result<Outcome, CommandError> {
    let output = Output::new(connection.output);
    match action {
        Action::New { file } => {
            let key = key_file::create(&file)?;
            print_key(&output, key)?;
            say(&format!(
                "the private key is in {}: whoever has it can publish; keep it off the server",
                file.display()
            ));
        }
        Action::Show { key } => print_key(&output, key_file::public(&key)?)?,
        Action::List => {
            let newest = newest(&Client::connect(connection)?).await?;
            let newest = newest.ok_or_else(|| {
                CommandError::Usage("the server has no list of publishers".to_owned())
            })?;
            output.described(&newest, version, describe)?;
        }
        Action::Draft(draft) => {
            let newest = newest(&Client::connect(connection)?).await?;
            let list = drafted(&draft, newest, Clock::system().now_ms())?;
            let payload = serde_json::to_vec(&list).expect("a list always has a JSON form");
            write(&draft.file, &Envelope::unsigned(LIST_TYPE, &payload))?;
            output.described(&list, version, describe)?;
        }
        Action::Sign { file, key } => {
            let mut envelope = read(&file)?;
            let list =
                PublisherList::unverified(&envelope).map_err(|error| unusable(&file, &error))?;
            let key = key_file::read(&key)?;
            envelope.sign_also(LIST_TYPE, &key).map_err(|error| unusable(&file, &error))?;
            write(&file, &envelope)?;
            output.described(&list, version, describe)?;
            say(&format!("signed by {}", key.public_key().id()));
        }
        Action::Publish { file } => {
            let envelope = read(&file)?;
            let list = PublisherList::alone(&envelope).map_err(|error| unusable(&file, &error))?;
            let client = Client::connect(connection)?;
            let repository = LIST_REPOSITORY.parse().expect("a repository's name");
            let under = (None, Some(list.version.to_string()));
            upload::upload_signed(&client, &repository, LIST_ARTIFACT, &envelope, under).await?;
            output.described(&list, version, describe)?;
            let signers: Vec<&str> = envelope.claimed_signers().collect();
            say(&format!(
                "published, signed by {}: robots follow it if those are enough of the keepers they go by",
                signers.join(", ")
            ));
        }
    }
    Ok(Outcome::Succeeded)
}

fn version(list: &PublisherList) -> String {
    list.version.to_string()
}

fn print_key(output: &Output, key: PublicKey) -> Result<(), CommandError> {
    let text = |view: &KeyView| format!("key  {}\nid   {}\n", view.key, view.id);
    output.described(&KeyView { id: key.id(), key }, |view| view.id.to_string(), text)
}

/// The newest list according to the server; robots check its validity themselves.
async fn newest(client: &Client) -> Result<Option<PublisherList>, CommandError> {
    let tags: Tags = match client.read(&format!("/v2/{LIST_REPOSITORY}/tags/list")).await {
        Ok(tags) => tags,
        Err(ClientError::Refused { status: StatusCode::NOT_FOUND, .. }) => return Ok(None),
        Err(error) => return Err(error.into()),
    };
    let Some(version) = tags.tags.iter().filter_map(|tag| tag.parse::<u64>().ok()).max() else {
        return Ok(None);
    };
    let manifest: ImageManifest =
        client.read(&format!("/v2/{LIST_REPOSITORY}/manifests/{version}")).await?;
    let what = format!("version {version} of the list of publishers");
    let blob = manifest
        .lone_envelope()
        .ok_or_else(|| CommandError::Usage(format!("{what} is no signed document")))?;
    let envelope: Envelope =
        client.read(&format!("/v2/{LIST_REPOSITORY}/blobs/{}", blob.digest)).await?;
    let list = PublisherList::unverified(&envelope);
    list.map(Some).map_err(|error| CommandError::Usage(format!("{what}: {error}")))
}

/// The list after `newest`, with the changes of the command line.
fn drafted(
    draft: &Draft,
    newest: Option<PublisherList>,
    now_ms: u64,
) -> Result<PublisherList, CommandError> {
    let before = newest.as_ref();
    let options = ("publisher", "threshold");
    let publishers =
        role(options, &draft.publishers, draft.threshold, before.map(|list| &list.publishers))?;
    let keepers_before = before.map_or(&publishers, |list| &list.keepers);
    let options = ("keeper", "keeper-threshold");
    let keepers = role(options, &draft.keepers, draft.keeper_threshold, Some(keepers_before))?;
    let mut withdrawn = before.map(|list| list.withdrawn.clone()).unwrap_or_default();
    withdrawn.extend(
        draft
            .withdrawn
            .iter()
            .filter(|digest| !before.is_some_and(|list| list.withdrawn.contains(digest))),
    );
    Ok(PublisherList {
        version: before.map_or(0, |list| list.version) + 1,
        issued_at_ms: now_ms,
        expires_at_ms: now_ms + u64::try_from(draft.lifetime.as_millis()).unwrap_or(u64::MAX / 2),
        publishers,
        keepers,
        withdrawn,
    })
}

/// A role from its two options; absent options keep their value from `before`.
fn role(
    (keys_option, threshold_option): (&str, &str),
    keys: &[String],
    threshold: Option<u32>,
    before: Option<&Role>,
) -> Result<Role, CommandError> {
    let given = keys.iter().map(|key| key_file::public(key)).collect::<Result<Vec<_>, _>>()?;
    let (keys, least) = match before {
        Some(before) if given.is_empty() => (before.keys().to_vec(), before.threshold()),
        Some(before) => (given, before.threshold()),
        None => (given, 1),
    };
    Role::new(keys, threshold.unwrap_or(least)).map_err(|error| {
        let is_count = matches!(error, InvalidRole::Threshold { .. });
        let option = if is_count { threshold_option } else { keys_option };
        CommandError::Usage(format!("--{option}: {error}"))
    })
}

fn read(file: &Path) -> Result<Envelope, CommandError> {
    let failed =
        |source| CommandError::Io { what: format!("can't read {}", file.display()), source };
    let bytes = std::fs::read(file).map_err(failed)?;
    serde_json::from_slice(&bytes)
        .map_err(|_| CommandError::Usage(format!("{} is no draft of taskd key", file.display())))
}

fn write(file: &Path, envelope: &Envelope) -> Result<(), CommandError> {
    let failed =
        |source| CommandError::Io { what: format!("can't write {}", file.display()), source };
    let text = serde_json::to_string_pretty(envelope).expect("an envelope always has a JSON form");
    std::fs::write(file, format!("{text}\n")).map_err(failed)
}

fn unusable(file: &Path, error: &dyn std::fmt::Display) -> CommandError {
    CommandError::Usage(format!("the list of publishers in {}: {error}", file.display()))
}

fn describe(list: &PublisherList) -> String {
    let mut text = format!(
        "version     {}\nmade        {}\nexpires     {}\n",
        list.version,
        time(list.issued_at_ms),
        time(list.expires_at_ms)
    );
    for (name, role) in [("publishers", &list.publishers), ("keepers", &list.keepers)] {
        text.push_str(&format!("{name:<12}{} of {}\n", role.threshold(), role.keys().len()));
        text.extend(role.keys().iter().map(|key| format!("            {} {key}\n", key.id())));
    }
    text.extend(list.withdrawn.iter().map(|digest| format!("withdrawn   {digest}\n")));
    text
}

#[cfg(test)]
mod tests {
    use task_proto::envelope::SigningKey;

    use super::*;

    fn draft(publishers: &[u8], threshold: Option<u32>, withdrawn: &[Digest]) -> Draft {
        let key = |seed: &u8| SigningKey::from_bytes([*seed; 32]).public_key().to_string();
        Draft {
            file: PathBuf::new(),
            publishers: publishers.iter().map(key).collect(),
            threshold,
            keepers: Vec::new(),
            keeper_threshold: None,
            withdrawn: withdrawn.to_vec(),
            lifetime: Duration::from_secs(60),
        }
    }

    #[test]
    fn a_list_goes_on_from_the_one_before_it() {
        let first = drafted(&draft(&[1, 2], Some(2), &[]), None, 1000).expect("drafted");
        assert_eq!((first.version, first.issued_at_ms, first.expires_at_ms), (1, 1000, 61_000));
        assert_eq!(first.keepers, first.publishers);
        let bad = [Digest::of(b"1"), Digest::of(b"2")];
        let second = drafted(&draft(&[1, 2, 3], None, &bad[..1]), Some(first.clone()), 2000)
            .expect("drafted");
        assert_eq!(
            (second.version, second.publishers.keys().len(), second.publishers.threshold()),
            (2, 3, 2)
        );
        assert_eq!(second.keepers, first.keepers, "another publisher is no keeper");
        let third = drafted(&draft(&[], None, &bad), Some(second.clone()), 3000).expect("drafted");
        assert_eq!((third.publishers, third.withdrawn), (second.publishers, bad.to_vec()));
    }

    #[test]
    fn what_makes_no_sense_is_said_by_its_option() {
        for (draft, expected) in [
            (draft(&[], None, &[]), "--publisher: 0 keys"),
            (draft(&[1], Some(2), &[]), "--threshold: a threshold of 2 with 1 keys"),
            (draft(&[1, 1], None, &[]), "--publisher: key "),
        ] {
            let error = drafted(&draft, None, 0).expect_err("refused").to_string();
            assert!(error.starts_with(expected), "{error}");
        }
    }
}
