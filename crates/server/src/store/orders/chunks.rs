//! The rest of large orders: selected robots that have no assignment yet, in chunks. A chunk leaves
//! this table in the write that places it. Like a robot that waits for its batch, a robot here
//! loses its part to a newer order for the task.

use std::collections::{BTreeSet, HashSet};

use sqlx::Row as _;
use task_proto::{DeploymentId, RobotId, TaskName};

use crate::store::repositories::OrderChunks;
use crate::store::rows::{id, number, stored};
use crate::store::{Store, StoreError, Transaction};

/// Marks a robot that is to get no part of the order any more.
const DROPPED: char = '-';

/// Selected robots that an order is to be placed for in one write.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OrderChunk {
    pub deployment: DeploymentId,
    pub task: TaskName,
    /// The number of the deployment: a later one has a higher number.
    pub number: u64,
    /// Whether the order restarts services that run.
    pub restart: bool,
    /// The place of the first robot in the order.
    pub first_place: u64,
    /// The robots, in the order of their places.
    pub robots: Vec<RobotId>,
    /// Those of the robots on which the task was ordered stopped or removed in the meantime.
    pub dropped: Vec<RobotId>,
}

impl OrderChunks<&Store> {
    /// Whether an order is not placed for all its robots, or a cancel not carried out for all.
    pub async fn are_any(self) -> Result<bool, StoreError> {
        let sql = "SELECT deployment_id FROM order_chunks
             UNION ALL SELECT id FROM deployments WHERE cancel_from IS NOT NULL LIMIT 1";
        let found: Option<String> = sqlx::query_scalar(sql).fetch_optional(&self.0.reads).await?;
        Ok(found.is_some())
    }
}

impl OrderChunks<&mut Transaction> {
    /// Stores robots that an order is to be placed for later, at most `size` at a time. The first
    /// one has the place `first_place` in the order.
    pub async fn insert(
        &mut self,
        deployment: &DeploymentId,
        first_place: usize,
        robots: &[RobotId],
        size: usize,
    ) -> Result<(), StoreError> {
        let sql = "INSERT INTO order_chunks (deployment_id, place, robots) VALUES ($1, $2, $3)";
        for (chunk, robots) in robots.chunks(size).enumerate() {
            let ids: Vec<&str> = robots.iter().map(RobotId::as_str).collect();
            sqlx::query(sql)
                .bind(deployment.as_str())
                .bind(stored((first_place + chunk * size) as u64))
                .bind(ids.join(","))
                .execute(self.0.connection())
                .await?;
        }
        Ok(())
    }

    /// The next chunk of the oldest order.
    pub async fn next(&mut self) -> Result<Option<OrderChunk>, StoreError> {
        let sql = "SELECT c.deployment_id, c.place, c.robots, d.task, d.number, d.restart
             FROM order_chunks c JOIN deployments d ON d.id = c.deployment_id
             ORDER BY d.number, d.id, c.place LIMIT 1";
        let row = sqlx::query(sql).fetch_optional(self.0.connection()).await?;
        row.map(|row| order_chunk(&row)).transpose()
    }

    /// Removes a chunk that was placed.
    pub async fn remove(&mut self, chunk: &OrderChunk) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM order_chunks WHERE deployment_id = $1 AND place = $2")
            .bind(chunk.deployment.as_str())
            .bind(stored(chunk.first_place))
            .execute(self.0.connection())
            .await?;
        sqlx::query("UPDATE deployments SET placed = placed + $2 WHERE id = $1")
            .bind(chunk.deployment.as_str())
            .bind(stored(chunk.robots.len() as u64))
            .execute(self.0.connection())
            .await?;
        Ok(())
    }

    /// Removes the unplaced rest of an order. Returns whether there was a rest.
    pub async fn remove_all(&mut self, deployment: &DeploymentId) -> Result<bool, StoreError> {
        let removed = sqlx::query("DELETE FROM order_chunks WHERE deployment_id = $1")
            .bind(deployment.as_str())
            .execute(self.0.connection())
            .await?;
        Ok(removed.rows_affected() > 0)
    }

    /// Takes the parts of `robots` away from orders for `task`: the task was ordered stopped or
    /// removed there. Returns the orders.
    pub async fn drop_robots(
        &mut self,
        task: &TaskName,
        robots: &[RobotId],
    ) -> Result<BTreeSet<DeploymentId>, StoreError> {
        let sql = "SELECT c.deployment_id, c.place, c.robots FROM order_chunks c
             JOIN deployments d ON d.id = c.deployment_id WHERE d.task = $1";
        let chunks: Vec<(String, i64, String)> =
            sqlx::query_as(sql).bind(task.as_str()).fetch_all(self.0.connection()).await?;
        let dropped: HashSet<&str> = robots.iter().map(RobotId::as_str).collect();
        let mut touched = BTreeSet::new();
        for (deployment, place, listed) in chunks {
            let mark = |robot: &str| match dropped.contains(robot) {
                true => format!("{DROPPED}{robot}"),
                false => robot.to_owned(),
            };
            let marked = listed.split(',').map(mark).collect::<Vec<_>>().join(",");
            if marked == listed {
                continue;
            }
            sqlx::query(
                "UPDATE order_chunks SET robots = $3 WHERE deployment_id = $1 AND place = $2",
            )
            .bind(deployment.as_str())
            .bind(place)
            .bind(marked)
            .execute(self.0.connection())
            .await?;
            touched.insert(id("order_chunks.deployment_id", &deployment)?);
        }
        Ok(touched)
    }
}

fn order_chunk(row: &sqlx::any::AnyRow) -> Result<OrderChunk, StoreError> {
    let (mut robots, mut dropped) = (Vec::new(), Vec::new());
    for listed in row.try_get::<&str, _>("robots")?.split(',') {
        let robot: RobotId = id("order_chunks.robots", listed.trim_start_matches(DROPPED))?;
        if listed.starts_with(DROPPED) {
            dropped.push(robot.clone());
        }
        robots.push(robot);
    }
    Ok(OrderChunk {
        deployment: id("order_chunks.deployment_id", row.try_get("deployment_id")?)?,
        task: id("deployments.task", row.try_get("task")?)?,
        number: number(row.try_get("number")?),
        restart: row.try_get::<i64, _>("restart")? == 1,
        first_place: number(row.try_get("place")?),
        robots,
        dropped,
    })
}
