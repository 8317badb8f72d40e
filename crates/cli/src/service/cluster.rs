//! `taskd cluster`: the servers of a cluster, and the keys that they share. Keys are only copied
//! between directories of this machine, never sent.

use std::fs::{DirBuilder, File, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Subcommand;
use task_proto::api::{NodeList, NodeState, NodeView};
use task_proto::data_directory::{SECRETS, SIGNING_KEY};
use task_proto::ids::NodeName;
use task_proto::time::span;

use crate::api::client::data_directory;
use crate::display::output::say;
use crate::display::output::table::Columns;
use crate::{CommandError, Connection, Outcome, Session};

#[derive(Debug, Subcommand)]
pub enum Action {
    /// Copy the keys in the data directory of a server to a new directory, for the setting
    /// cluster.secrets of all servers
    Export {
        /// Directory to make
        dir: PathBuf,
    },
    /// List the servers of the cluster
    Nodes,
    /// Make a server send its robots to the others; it serves until it is stopped
    Drain {
        /// Name of the server
        name: NodeName,
    },
}

pub(crate) async fn run(connection: &Connection, action: Action) -> Result<Outcome, CommandError> {
    match action {
        Action::Export { dir } => {
            let data = data_directory(connection).ok_or_else(|| {
                CommandError::Usage("--data: the server's data directory is not known".to_owned())
            })?;
            let absent = export(&data, &dir)?;
            say(&format!("copied the keys of {} to {}", data.display(), dir.display()));
            if !absent.is_empty() {
                say(&format!(
                    "not there: {}; a server makes ca.key and ca.pem when it first encrypts, broker.secret for an \
                     external broker",
                    absent.join(", ")
                ));
            }
        }
        Action::Nodes => {
            let session = connection.open()?;
            let list: NodeList = session.client.get("/cluster/nodes", &[]).await?;
            print(&session, &list)?;
        }
        Action::Drain { name } => {
            let session = connection.open()?;
            session.client.post(&format!("/cluster/nodes/{name}/drain")).await?;
            say(&format!(
                "server {name} sends its robots to the others; stop it when they have left"
            ));
        }
    }
    Ok(Outcome::Succeeded)
}

fn print(session: &Session, list: &NodeList) -> Result<(), CommandError> {
    if list.nodes.is_empty() {
        say("this server is part of no cluster");
    }
    session.output.print_list(list, &COLUMNS, |list| list.nodes.iter().map(row).collect())
}

const COLUMNS: Columns = Columns {
    name: "name",
    narrow: &["name", "state", "sessions", "reports", "version", "last heartbeat", "url"],
    wide: &["uptime", "transfers"],
};

fn row(node: &NodeView) -> Vec<String> {
    let unknown = || "-".to_owned();
    let figure = |of: fn(&NodeView) -> Option<String>| of(node).unwrap_or_else(unknown);
    vec![
        node.name.to_string(),
        state(node).to_owned(),
        figure(|node| Some(node.figures?.mqtt.robots_connected.to_string())),
        figure(|node| Some(format!("{:.1}/s", node.figures?.reports.per_s))),
        node.version.clone(),
        figure(|node| Some(format!("{:.1} s ago", node.heartbeat_age_ms? as f64 / 1000.0))),
        node.url.clone().unwrap_or_else(unknown),
        figure(|node| Some(span(Duration::from_secs(node.figures?.uptime_s)))),
        figure(|node| Some(node.figures?.transfers.active.to_string())),
    ]
}

fn state(node: &NodeView) -> &'static str {
    match node.state {
        NodeState::Serving if node.answers => "serving, answers",
        NodeState::Serving => "serving",
        NodeState::Draining => "draining",
        NodeState::Silent => "does not answer",
        NodeState::Lost => "lost",
        NodeState::Unknown => "unknown",
    }
}

/// Copies the keys from `data` to the new directory `to`, which exists as a whole or not at all.
/// Returns the names of the keys that the server does not have.
fn export(data: &Path, to: &Path) -> Result<Vec<&'static str>, CommandError> {
    let failed = |what: String| move |source| CommandError::Io { what, source };
    if to.symlink_metadata().is_ok() {
        return Err(CommandError::Usage(format!(
            "{} exists already; keys are never overwritten",
            to.display()
        )));
    }
    let name = to.file_name().ok_or_else(|| {
        CommandError::Usage(format!("{} is not the name of a new directory", to.display()))
    })?;
    let partial = to.with_file_name(format!(".{}.{:08x}", name.display(), rand::random::<u32>()));
    let write = || {
        DirBuilder::new().mode(0o700).create(&partial)?;
        let mut absent = Vec::new();
        for name in SECRETS {
            match std::fs::read(data.join(name)) {
                Ok(content) => write_new(&partial.join(name), &content)?,
                Err(error) if error.kind() == io::ErrorKind::NotFound && name != SIGNING_KEY => {
                    absent.push(name);
                }
                Err(error) => return Err(error),
            }
        }
        File::open(&partial)?.sync_all()?;
        std::fs::rename(&partial, to)?;
        Ok(absent)
    };
    let written = write();
    if written.is_err() {
        let _ = std::fs::remove_dir_all(&partial);
    }
    written.map_err(failed(format!(
        "the keys of {} can't be copied to {}",
        data.display(),
        to.display()
    )))
}

fn write_new(path: &Path, content: &[u8]) -> io::Result<()> {
    let mut file = OpenOptions::new().create_new(true).write(true).mode(0o600).open(path)?;
    file.write_all(content)?;
    file.sync_all()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    fn mode(path: &Path) -> u32 {
        std::fs::metadata(path).expect("exists").permissions().mode() & 0o777
    }

    #[test]
    fn keys_are_exported_once_with_private_modes() {
        let directory = tempfile::tempdir().expect("a directory");
        let (data, to) = (directory.path().join("data"), directory.path().join("secrets"));
        std::fs::create_dir(&data).expect("made");
        let refused = export(&data, &to).expect_err("there is no key");
        assert!(refused.to_string().contains("can't be copied"), "{refused}");
        assert!(!to.exists() && std::fs::read_dir(directory.path()).expect("read").count() == 1);

        for name in [SIGNING_KEY, "ca.key", "taskd.sqlite"] {
            std::fs::write(data.join(name), name).expect("written");
        }
        let absent = export(&data, &to).expect("copied");
        assert_eq!(absent, ["ca.pem", "broker.secret", "operator.token"]);
        assert_eq!((mode(&to), mode(&to.join(SIGNING_KEY))), (0o700, 0o600));
        assert_eq!(std::fs::read_to_string(to.join("ca.key")).expect("read"), "ca.key");
        assert!(!to.join("taskd.sqlite").exists());

        std::fs::write(data.join(SIGNING_KEY), "another").expect("written");
        let refused = export(&data, &to).expect_err("it exists");
        assert!(refused.to_string().contains("never overwritten"), "{refused}");
        assert_eq!(std::fs::read_to_string(to.join(SIGNING_KEY)).expect("read"), SIGNING_KEY);
    }
}
