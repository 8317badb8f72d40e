//! The servers that share the database, one row for each name. A row is written by its own server
//! only, and outlives it. This module compares no clocks.

use sqlx::Row as _;
use sqlx::any::AnyRow;

use crate::store::repositories::Nodes;
use crate::store::rows::{number, stored};
use crate::store::{Store, StoreError};

/// A server that begins to serve.
#[derive(Debug, Clone, Copy)]
pub struct NewNode<'a> {
    pub name: &'a str,
    /// This start of the server.
    pub run: &'a str,
    /// Where the other servers reach it.
    pub url: Option<&'a str>,
    pub version: &'a str,
}

/// The load of a server.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct NodeLoad {
    /// Open streams of events.
    pub listeners: u64,
    pub transfers: u64,
    /// Bytes of parts that wait to be sent over MQTT.
    pub backlog: u64,
}

/// A server, alive or not.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Node {
    pub name: String,
    pub run: String,
    /// The server lives while this number grows.
    pub heartbeat: u64,
    pub url: Option<String>,
    pub version: String,
    pub load: NodeLoad,
}

impl Nodes<&Store> {
    /// Stores a server that begins to serve, in place of an earlier start of the same name.
    pub async fn join(self, node: NewNode<'_>) -> Result<(), StoreError> {
        sqlx::query(
            "INSERT INTO nodes (name, run, heartbeat, url, version, listeners, transfers, backlog)
             VALUES ($1, $2, 1, $3, $4, 0, 0, 0)
             ON CONFLICT (name) DO UPDATE SET run = excluded.run, heartbeat = nodes.heartbeat + 1,
                 url = excluded.url, version = excluded.version",
        )
        .bind(node.name)
        .bind(node.run)
        .bind(node.url)
        .bind(node.version)
        .execute(&self.0.cluster_writes)
        .await?;
        Ok(())
    }

    /// Raises the heartbeat of a server. Returns whether the name still belongs to this run.
    pub async fn heartbeat(
        self,
        name: &str,
        run: &str,
        load: NodeLoad,
    ) -> Result<bool, StoreError> {
        let updated = sqlx::query(
            "UPDATE nodes SET heartbeat = heartbeat + 1, listeners = $3, transfers = $4, backlog = $5
             WHERE name = $1 AND run = $2",
        )
        .bind(name)
        .bind(run)
        .bind(stored(load.listeners))
        .bind(stored(load.transfers))
        .bind(stored(load.backlog))
        .execute(&self.0.cluster_writes)
        .await?;
        Ok(updated.rows_affected() == 1)
    }

    /// Deletes a run that has ended.
    pub async fn delete(self, run: &str) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM nodes WHERE run = $1")
            .bind(run)
            .execute(&self.0.cluster_writes)
            .await?;
        Ok(())
    }

    /// All servers, by name.
    pub async fn list(self) -> Result<Vec<Node>, StoreError> {
        let rows = sqlx::query(
            "SELECT name, run, heartbeat, url, version, listeners, transfers, backlog FROM nodes
             ORDER BY name",
        )
        .fetch_all(&self.0.reads)
        .await?;
        rows.iter().map(node).collect()
    }
}

fn node(row: &AnyRow) -> Result<Node, StoreError> {
    let count = |column| row.try_get(column).map(number);
    Ok(Node {
        name: row.try_get("name")?,
        run: row.try_get("run")?,
        heartbeat: count("heartbeat")?,
        url: row.try_get("url")?,
        version: row.try_get("version")?,
        load: NodeLoad {
            listeners: count("listeners")?,
            transfers: count("transfers")?,
            backlog: count("backlog")?,
        },
    })
}
