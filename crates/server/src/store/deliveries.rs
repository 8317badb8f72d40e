//! Delivery decisions: the known facts about the robots when a batch begins, and the decision for
//! each robot.

use sqlx::{AssertSqlSafe, Row as _};
use task_proto::api::{DeliveryChoice, DeliveryDecision};
use task_proto::desired::PackageRef;
use task_proto::ids::Labels;
use task_proto::messages::report::{LinkFacts, Report, TaskReport};
use task_proto::{DeploymentId, Digest, RobotId};

use super::repositories::Deliveries;
use super::rows::{from_json, from_optional_json, from_word, groups, id, number, values, word};
use super::{StoreError, Transaction};

/// The part of an order that concerns delivery.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeliveryRequest {
    /// The operator's choice of the mechanism.
    pub choice: DeliveryChoice,
    /// The package to deliver.
    pub package: PackageRef,
    /// The number of robots in the order.
    pub robots: u64,
}

/// The known facts about a robot that is to get a package.
#[derive(Debug, Clone, PartialEq)]
pub struct RobotFacts {
    pub robot: RobotId,
    pub labels: Labels,
    /// The robot's link to the server, as far as it was measured.
    pub link: Option<LinkFacts>,
    /// The battery's charge, in percent.
    pub battery_percent: Option<u64>,
    /// A task in the robot's report with the same content.
    pub has: Option<TaskReport>,
}

/// The delivery decision for a robot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RobotDecision {
    pub robot: RobotId,
    /// The mechanism, and the reason for it.
    pub decision: DeliveryDecision,
    /// The inputs of the decision, as JSON.
    pub inputs: String,
}

impl Deliveries<&mut Transaction> {
    /// The part of the order of `deployment` that concerns delivery.
    pub async fn request(
        &mut self,
        deployment: &DeploymentId,
    ) -> Result<DeliveryRequest, StoreError> {
        let row = sqlx::query(
            "SELECT delivery, package,
                 COALESCE(selected, (SELECT COUNT(*) FROM assignments WHERE deployment_id = deployments.id)) AS robots
             FROM deployments WHERE id = $1",
        )
        .bind(deployment.as_str())
        .fetch_one(self.0.connection())
        .await?;
        Ok(DeliveryRequest {
            choice: from_word("deployments.delivery", row.try_get("delivery")?)?,
            package: from_json("deployments.package", row.try_get("package")?)?,
            robots: number(row.try_get("robots")?),
        })
    }

    /// The known facts about `robots`, which may have `content` already.
    pub async fn robot_facts(
        &mut self,
        robots: &[RobotId],
        content: &Digest,
    ) -> Result<Vec<RobotFacts>, StoreError> {
        let mut facts = Vec::with_capacity(robots.len());
        for group in groups(robots) {
            // Few reports name the content; only those are read.
            let sql = format!(
                "WITH v (id) AS ({})
                 SELECT r.id, r.labels, r.link, r.battery, CASE WHEN r.report LIKE $1 THEN r.report END AS report
                 FROM v JOIN robots r ON r.id = v.id",
                values(2, group.len(), &["TEXT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql)).bind(format!("%{content}%"));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            for row in query.fetch_all(self.0.connection()).await? {
                facts.push(robot_facts(&row, content)?);
            }
        }
        Ok(facts)
    }

    /// The labels of all robots of `deployment`.
    pub async fn labels(
        &mut self,
        deployment: &DeploymentId,
    ) -> Result<Vec<(RobotId, Labels)>, StoreError> {
        let rows: Vec<(String, String)> = sqlx::query_as(
            "SELECT r.id, r.labels FROM assignments a JOIN robots r ON r.id = a.robot_id WHERE a.deployment_id = $1",
        )
        .bind(deployment.as_str())
        .fetch_all(self.0.connection())
        .await?;
        rows.iter()
            .map(|(robot, labels)| {
                Ok((id("robots.id", robot)?, from_json("robots.labels", labels)?))
            })
            .collect()
    }

    /// Stores the decisions for robots of `deployment`.
    pub async fn store_decisions(
        &mut self,
        deployment: &DeploymentId,
        decided: &[RobotDecision],
    ) -> Result<(), StoreError> {
        for group in groups(decided) {
            let sql = format!(
                "WITH v (robot_id, mechanism, rule, because, inputs) AS ({})
                 UPDATE assignments SET mechanism = v.mechanism, rule = v.rule, because = v.because, inputs = v.inputs
                 FROM v WHERE assignments.deployment_id = $1 AND assignments.robot_id = v.robot_id",
                values(2, group.len(), &["TEXT"; 5])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql)).bind(deployment.as_str());
            for RobotDecision { robot, decision, inputs } in group {
                query = query
                    .bind(robot.as_str())
                    .bind(word(&decision.mechanism))
                    .bind(decision.rule.as_str())
                    .bind(decision.because.as_str())
                    .bind(inputs.as_str());
            }
            query.execute(self.0.connection()).await?;
        }
        Ok(())
    }
}

fn robot_facts(row: &sqlx::any::AnyRow, content: &Digest) -> Result<RobotFacts, StoreError> {
    let report: Option<Report> = from_optional_json("robots.report", row.try_get("report")?)?;
    let mut tasks = report.into_iter().flat_map(|report| report.tasks);
    Ok(RobotFacts {
        robot: id("robots.id", row.try_get("id")?)?,
        labels: from_json("robots.labels", row.try_get("labels")?)?,
        link: from_optional_json("robots.link", row.try_get("link")?)?,
        battery_percent: row.try_get::<Option<i64>, _>("battery")?.map(number),
        has: tasks.find(|task| task.package.content.digest == *content),
    })
}

/// The decision in an assignment's row; older rows have none.
pub(super) fn decision(row: &sqlx::any::AnyRow) -> Result<Option<DeliveryDecision>, StoreError> {
    let Some(mechanism) = row.try_get::<Option<String>, _>("mechanism")? else { return Ok(None) };
    Ok(Some(DeliveryDecision {
        mechanism: from_word("assignments.mechanism", &mechanism)?,
        rule: row.try_get::<Option<String>, _>("rule")?.unwrap_or_default(),
        because: row.try_get::<Option<String>, _>("because")?.unwrap_or_default(),
    }))
}
