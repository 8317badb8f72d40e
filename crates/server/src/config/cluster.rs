//! `[cluster]`: this server's place among several servers on one Postgres. This module checks the
//! settings and never reads the keys.

use std::path::{Path, PathBuf};

use task_proto::ids::NodeName;

use super::{Config, ConfigError, Origin};
use crate::system::host::host_name;

/// `[cluster]`. Present: other servers may use the same database at the same time.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ClusterSettings {
    /// This server's name, different from the names of all others.
    pub name: NodeName,
    /// The URL at which the other servers reach this one, without a path.
    pub url: String,
    /// The directory with the keys that all servers share, in place of the data directory's own.
    pub secrets: Option<PathBuf>,
    /// How the servers notify each other.
    pub bus: Bus,
}

/// How the servers of a cluster notify each other of changes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Bus {
    /// By `NOTIFY` of the database.
    #[default]
    Postgres,
    /// Not at all: a server finds changes by looking.
    Off,
}

/// [`ClusterSettings`] before all sources are read.
#[derive(Debug, Clone, Default)]
pub(crate) struct ClusterDraft {
    pub(super) name: Option<NodeName>,
    pub(super) url: Option<String>,
    pub(super) secrets: Option<PathBuf>,
    pub(super) bus: Bus,
}

impl Config {
    /// The directory with the cluster's keys.
    pub fn secrets(&self) -> Option<PathBuf> {
        self.cluster.as_ref()?.secrets.clone()
    }

    /// The settings of the cluster, complete and without contradictions. Errors name the key in
    /// `file`, or else the variable.
    pub(super) fn finish_cluster(
        &mut self,
        file: Option<&Path>,
    ) -> Result<Option<ClusterSettings>, ConfigError> {
        let Some(draft) = self.cluster_draft.take() else { return Ok(None) };
        let invalid = |key: &str, reason: &str| {
            let origin = match file {
                Some(path) => Origin::File { key: key.to_owned(), path: path.to_owned() },
                None => Origin::Variable(format!("TASKD_{}", key.replace('.', "_").to_uppercase())),
            };
            ConfigError::Value { origin, reason: reason.to_owned() }
        };
        if self.postgres().is_none() {
            let reason = "a cluster requires a Postgres; set `database` to its URL";
            return Err(invalid("cluster", reason));
        }
        if self.standby {
            let reason =
                "a server of a cluster serves and is no standby; remove one of the two settings";
            return Err(invalid("standby", reason));
        }
        if self.broker.is_some() {
            let reason =
                "the servers of a cluster serve MQTT themselves; remove one of the two settings";
            return Err(invalid("broker", reason));
        }
        let missing = "missing: the URL at which the other servers reach this one, like http://10.0.0.11:8080";
        let url = draft.url.ok_or_else(|| invalid("cluster.url", missing))?;
        let host = || host_name().and_then(|name| name.parse().ok());
        let nameless = "missing: the host's name can't be used as the server's name";
        let name = draft.name.or_else(host).ok_or_else(|| invalid("cluster.name", nameless))?;
        if self.blob_store.is_none() {
            let reason =
                "a cluster requires a common store of packages; set `blobs.store` to its URL";
            return Err(invalid("cluster", reason));
        }
        Ok(Some(ClusterSettings { name, url, secrets: draft.secrets, bus: draft.bus }))
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::load;
    use super::*;

    const POSTGRES: (&str, &str) = ("TASKD_DATABASE", "postgres://u@h/d");
    const BLOBS: (&str, &str) = ("TASKD_BLOBS_STORE", "file:///mnt/taskd");

    #[test]
    fn cluster_table_is_read_completely() {
        let file = "[cluster]\nname = \"a\"\nurl = \"https://10.0.0.11:8080/\"\n\
                    secrets = \"/etc/taskd/secrets\"\nbus = \"off\"";
        let read = load(&[], &[POSTGRES, BLOBS], Some(file)).expect("loads").cluster;
        let expected = ClusterSettings {
            name: "a".parse().expect("a name"),
            url: "https://10.0.0.11:8080".to_owned(),
            secrets: Some(PathBuf::from("/etc/taskd/secrets")),
            bus: Bus::Off,
        };
        assert_eq!(read, Some(expected));
        assert_eq!(load(&[], &[POSTGRES], None).expect("loads").cluster, None);
    }

    #[test]
    fn name_of_a_server_defaults_to_its_host() {
        let env = [POSTGRES, BLOBS, ("TASKD_CLUSTER_URL", "http://10.0.0.11:8080")];
        let cluster = load(&[], &env, None).expect("loads").cluster.expect("a cluster");
        assert_eq!(Some(cluster.name.to_string()), host_name());
        assert_eq!((cluster.bus, cluster.secrets), (Bus::Postgres, None));
    }

    #[test]
    fn contradictory_cluster_is_refused_by_key_and_file() {
        let url = "[cluster]\nurl = \"http://10.0.0.11:8080\"";
        for (env, file, expected) in [
            (&[][..], url, "cluster in taskd.toml: a cluster requires a Postgres"),
            (&[("TASKD_DATABASE", "sqlite:/x")], url, "cluster in taskd.toml: a cluster requires"),
            (&[POSTGRES], "[cluster]", "cluster.url in taskd.toml: missing"),
            (&[POSTGRES], url, "cluster in taskd.toml: a cluster requires a common store"),
            (&[POSTGRES, ("TASKD_STANDBY", "true")], url, "standby in taskd.toml: a server of a"),
            (
                &[POSTGRES, ("TASKD_BROKER", "mqtts://u:p@b")],
                url,
                "broker in taskd.toml: the servers",
            ),
            (
                &[POSTGRES],
                "[cluster]\nname = \"a b\"",
                "cluster.name in taskd.toml: \"a b\" is not",
            ),
            (
                &[POSTGRES],
                "[cluster]\nurl = \"10.0.0.1\"",
                "cluster.url in taskd.toml: \"10.0.0.1\"",
            ),
            (&[POSTGRES], "[cluster]\nbus = \"nats\"", "cluster.bus in taskd.toml: \"nats\" is"),
            (&[POSTGRES], "[cluster]\nnodes = 3", "cluster.nodes in taskd.toml: there is no such"),
        ] {
            let message = load(&[], env, Some(file)).expect_err(expected);
            assert!(message.starts_with(expected), "{message}");
        }
        let message =
            load(&[], &[POSTGRES, ("TASKD_CLUSTER_NAME", "a")], None).expect_err("no url");
        assert!(message.starts_with("TASKD_CLUSTER_URL: missing"), "{message}");
    }
}
