//! `taskd key`: publishers' keys, which never leave their machine, and the list of publishers that
//! robots trust. A list is drafted, signed by the required number of keepers, each on the machine
//! with their key, and published.

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Subcommand;
use reqwest::StatusCode;
use serde::{Deserialize, Serialize};
use task_proto::Digest;
use task_proto::packages::oci::ImageManifest;
use task_proto::packages::publisher::{
    InvalidRole, LIST_ARTIFACT, LIST_REPOSITORY, LIST_TYPE, PublisherList, Role,
};
use task_proto::time::parse_lifetime;
use task_proto::trust::envelope::{Envelope, PublicKey};

use super::key_file;
use crate::api::client::{Client, ClientError};
use crate::api::upload;
use crate::display::output::{Output, say, time};
use crate::{CommandError, Connection, Outcome, clock};

#[derive(Debug, Subcommand)]
pub enum Action {
    /// Create a key pair: the private key in FILE, the public key in FILE.pub
    New {
        /// File for the private key; must not exist
        file: PathBuf,
    },
    /// Print a public key and its id
    Show {
        /// Public key, or a file that contains a key
        #[arg(value_name = "KEY")]
        key: String,
    },
    /// Show the server's latest list of publishers
    List,
    /// Write the next list of publishers to a file, to be signed; options that are not given keep
    /// their value from the latest list
    Draft(DraftArgs),
    /// Sign a drafted list and print it
    Sign {
        /// File with the draft
        file: PathBuf,
        /// Private key to sign with
        #[arg(long, value_name = "KEY")]
        key: PathBuf,
    },
    /// Publish a signed list to the server, which distributes it to all robots
    Publish {
        /// File with the signed draft
        file: PathBuf,
    },
}

/// Contents of the next list.
#[derive(Debug, clap::Args)]
#[group(skip)]
pub struct DraftArgs {
    /// File to write
    file: PathBuf,
    /// Key of a publisher, or a file that contains it; repeat for all publishers
    #[arg(long = "publisher", value_name = "KEY")]
    publishers: Vec<String>,
    /// Number of publishers that must sign a package
    #[arg(long, value_name = "N")]
    threshold: Option<u32>,
    /// Key that signs lists; repeat for all keepers [default for the first list: the publishers]
    #[arg(long = "keeper", value_name = "KEY")]
    keepers: Vec<String>,
    /// Number of keepers that must sign the next list
    #[arg(long, value_name = "N")]
    keeper_threshold: Option<u32>,
    /// Withdraw a package, by its manifest's digest; earlier withdrawals remain; may be repeated
    #[arg(long = "withdraw", value_name = "DIGEST")]
    withdrawn: Vec<Digest>,
    /// Validity of the list: afterwards robots start no new work
    #[arg(long, value_name = "TIME", value_parser = parse_lifetime, default_value = "90d")]
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

pub(crate) async fn run(connection: &Connection, action: Action) -> Result<Outcome, CommandError> {
    let output = Output::new(connection.output);
    match action {
        Action::New { file } => {
            let key = key_file::create(&file)?;
            print_key(&output, key)?;
            say(&format!(
                "the private key is in {}; keep it secret, and never on the server",
                file.display()
            ));
        }
        Action::Show { key } => print_key(&output, key_file::public(&key)?)?,
        Action::List => {
            let newest = newest_list(&Client::connect(connection)?).await?;
            let newest = newest.ok_or_else(|| {
                CommandError::Usage("the server has no list of publishers".to_owned())
            })?;
            output.print_object(&newest, version, describe)?;
        }
        Action::Draft(draft) => {
            let newest = newest_list(&Client::connect(connection)?).await?;
            let list = next_list(&draft, newest, clock::now_ms())?;
            let payload = serde_json::to_vec(&list).expect("a list always has a JSON form");
            write(&draft.file, &Envelope::unsigned(LIST_TYPE, &payload))?;
            output.print_object(&list, version, describe)?;
        }
        Action::Sign { file, key } => {
            let mut envelope = read(&file)?;
            let list = PublisherList::unverified(&envelope)
                .map_err(|error| invalid_list(&file, &error))?;
            let key = key_file::read(&key)?;
            envelope.add_signature(LIST_TYPE, &key).map_err(|error| invalid_list(&file, &error))?;
            write(&file, &envelope)?;
            output.print_object(&list, version, describe)?;
            say(&format!("signed by {}", key.public_key().id()));
        }
        Action::Publish { file } => {
            let envelope = read(&file)?;
            let list = PublisherList::verify_self_signed(&envelope)
                .map_err(|error| invalid_list(&file, &error))?;
            let client = Client::connect(connection)?;
            let repository = LIST_REPOSITORY.parse().expect("a repository's name");
            let under = (None, Some(list.version.to_string()));
            upload::upload_signed(&client, &repository, LIST_ARTIFACT, &envelope, under).await?;
            output.print_object(&list, version, describe)?;
            let signers: Vec<&str> = envelope.claimed_signers().collect();
            say(&format!(
                "published, signed by {}; robots accept the list if enough of their current keepers signed it",
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
    output.print_object(&KeyView { id: key.id(), key }, |view| view.id.to_string(), text)
}

/// The newest list according to the server; robots check its validity themselves.
async fn newest_list(client: &Client) -> Result<Option<PublisherList>, CommandError> {
    let tags: Tags = match client.get_path(&format!("/v2/{LIST_REPOSITORY}/tags/list")).await {
        Ok(tags) => tags,
        Err(ClientError::Refused { status: StatusCode::NOT_FOUND, .. }) => return Ok(None),
        Err(error) => return Err(error.into()),
    };
    let Some(version) = tags.tags.iter().filter_map(|tag| tag.parse::<u64>().ok()).max() else {
        return Ok(None);
    };
    let manifest: ImageManifest =
        client.get_path(&format!("/v2/{LIST_REPOSITORY}/manifests/{version}")).await?;
    let what = format!("version {version} of the list of publishers");
    let blob = manifest
        .lone_envelope()
        .ok_or_else(|| CommandError::Usage(format!("{what} is not a signed document")))?;
    let envelope: Envelope =
        client.get_path(&format!("/v2/{LIST_REPOSITORY}/blobs/{}", blob.digest)).await?;
    let list = PublisherList::unverified(&envelope);
    list.map(Some).map_err(|error| CommandError::Usage(format!("{what}: {error}")))
}

/// The list after `newest`, with the changes of the command line.
fn next_list(
    args: &DraftArgs,
    newest: Option<PublisherList>,
    now_ms: u64,
) -> Result<PublisherList, CommandError> {
    let before = newest.as_ref();
    let options = ("publisher", "threshold");
    let publishers =
        role(options, &args.publishers, args.threshold, before.map(|list| &list.publishers))?;
    let keepers_before = before.map_or(&publishers, |list| &list.keepers);
    let options = ("keeper", "keeper-threshold");
    let keepers = role(options, &args.keepers, args.keeper_threshold, Some(keepers_before))?;
    let mut withdrawn = before.map(|list| list.withdrawn.clone()).unwrap_or_default();
    withdrawn.extend(
        args.withdrawn
            .iter()
            .filter(|digest| !before.is_some_and(|list| list.withdrawn.contains(digest))),
    );
    Ok(PublisherList {
        version: before.map_or(0, |list| list.version) + 1,
        issued_at_ms: now_ms,
        expires_at_ms: now_ms + u64::try_from(args.lifetime.as_millis()).unwrap_or(u64::MAX / 2),
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
    serde_json::from_slice(&bytes).map_err(|_| {
        CommandError::Usage(format!("{} is not a draft made by taskd key draft", file.display()))
    })
}

fn write(file: &Path, envelope: &Envelope) -> Result<(), CommandError> {
    let failed =
        |source| CommandError::Io { what: format!("can't write {}", file.display()), source };
    let text = serde_json::to_string_pretty(envelope).expect("an envelope always has a JSON form");
    std::fs::write(file, format!("{text}\n")).map_err(failed)
}

fn invalid_list(file: &Path, error: &dyn std::fmt::Display) -> CommandError {
    CommandError::Usage(format!("the list of publishers in {}: {error}", file.display()))
}

fn describe(list: &PublisherList) -> String {
    let mut text = format!(
        "version     {}\ncreated     {}\nexpires     {}\n",
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
    use task_proto::trust::envelope::SigningKey;

    use super::*;

    fn draft(publishers: &[u8], threshold: Option<u32>, withdrawn: &[Digest]) -> DraftArgs {
        let key = |seed: &u8| SigningKey::from_bytes([*seed; 32]).public_key().to_string();
        DraftArgs {
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
    fn draft_continues_from_the_previous_list() {
        let first = next_list(&draft(&[1, 2], Some(2), &[]), None, 1000).expect("drafted");
        assert_eq!((first.version, first.issued_at_ms, first.expires_at_ms), (1, 1000, 61_000));
        assert_eq!(first.keepers, first.publishers);
        let bad = [Digest::of(b"1"), Digest::of(b"2")];
        let second = next_list(&draft(&[1, 2, 3], None, &bad[..1]), Some(first.clone()), 2000)
            .expect("drafted");
        assert_eq!(
            (second.version, second.publishers.keys().len(), second.publishers.threshold()),
            (2, 3, 2)
        );
        assert_eq!(second.keepers, first.keepers, "another publisher is no keeper");
        let third =
            next_list(&draft(&[], None, &bad), Some(second.clone()), 3000).expect("drafted");
        assert_eq!((third.publishers, third.withdrawn), (second.publishers, bad.to_vec()));
    }

    #[test]
    fn invalid_role_names_its_option() {
        for (draft, expected) in [
            (draft(&[], None, &[]), "--publisher: 0 keys"),
            (draft(&[1], Some(2), &[]), "--threshold: a threshold of 2 with 1 keys"),
            (draft(&[1, 1], None, &[]), "--publisher: key "),
        ] {
            let error = next_list(&draft, None, 0).expect_err("refused").to_string();
            assert!(error.starts_with(expected), "{error}");
        }
    }
}
