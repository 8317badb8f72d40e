//! Translates selectors and scopes to SQL for sets of robots' ids, of which the database makes
//! unions, differences and intersections. This module runs no statement. The sets are those of
//! [`Selector::matches`] and [`Scope::covers`]; a test compares the two.

use serde::Serialize;
use sqlx::any::AnyArguments;
use sqlx::query::Query;
use sqlx::{Any, AssertSqlSafe};
use task_proto::ids::selector::{Condition, Selector, Terms};

use crate::domain::person::Scope;
use crate::store::database::dialect::Dialect;
use crate::store::rows::json;

/// Robots that can take orders, as a condition on `robots r`.
pub(super) const ORDERABLE: &str = "r.removed_at_ms IS NULL AND r.awaits_approval = 0";
/// Registered robots, as a condition on `robots r`.
pub(super) const REGISTERED: &str = "r.removed_at_ms IS NULL";
/// All robots ever registered, as a condition on `robots r`.
pub(super) const EVER_REGISTERED: &str = "1 = 1";

/// Makes SQL for sets of those robots that meet a condition. Each set is a query with one column,
/// `robot_id`, and may list an id twice. `None` stands for all robots.
pub(super) struct RobotSets {
    dialect: &'static Dialect,
    /// The condition, on `robots r`.
    among: &'static str,
    /// The values of the parameters so far, from $1 on.
    parameters: Vec<String>,
}

impl RobotSets {
    pub(super) fn new(dialect: &'static Dialect, among: &'static str) -> Self {
        Self { dialect, among, parameters: Vec::new() }
    }

    /// The condition on `robots r` that they are among the robots and in the set.
    pub(super) fn condition(&self, set: Option<&str>) -> String {
        let among = self.among;
        set.map_or_else(|| among.to_owned(), |set| format!("{among} AND r.id IN ({set})"))
    }

    /// The robots that match a selector.
    pub(super) fn selector(&mut self, selector: &Selector) -> Option<String> {
        let excluded = match selector.excludes() {
            excludes if excludes.is_empty() => None,
            // Every parameter must be in the text, since Postgres caches both. So the included
            // terms make theirs only if the excluded ones leave a robot.
            excludes => match self.terms(excludes) {
                None => {
                    return Some("SELECT r.id AS robot_id FROM robots r WHERE 1 = 0".to_owned());
                }
                excluded => excluded,
            },
        };
        let included = match selector.includes() {
            includes if includes.is_empty() => None,
            includes => self.terms(includes),
        };
        let Some(excluded) = excluded else { return included };
        let included = included.unwrap_or_else(|| {
            format!("SELECT r.id AS robot_id FROM robots r WHERE {}", self.among)
        });
        Some(combined("EXCEPT", &[included, excluded]))
    }

    /// The robots of a scope.
    pub(super) fn scope(&mut self, scope: &Scope) -> Option<String> {
        let sets: Vec<String> =
            scope.selectors().iter().filter_map(|selector| self.selector(selector)).collect();
        match sets.as_slice() {
            [] => None,
            [set] => Some(set.clone()),
            sets => Some(combined("INTERSECT", sets)),
        }
    }

    /// A query for the texts in a list, in a column `value`.
    pub(super) fn texts(&mut self, texts: &impl Serialize) -> String {
        let list = self.parameter(json(texts));
        self.dialect.texts(list)
    }

    /// A query with the parameters that its sets need.
    pub(super) fn query(self, sql: String) -> Query<'static, Any, AnyArguments> {
        self.parameters.into_iter().fold(sqlx::query(AssertSqlSafe(sql)), Query::bind)
    }

    /// The number of a new parameter with this value.
    pub(super) fn parameter(&mut self, value: String) -> usize {
        self.parameters.push(value);
        self.parameters.len()
    }

    /// The robots that meet one of the terms, of which there is at least one.
    fn terms(&mut self, terms: &Terms) -> Option<String> {
        let is_all = |term: &Vec<Condition>| term.iter().all(|one| *one == Condition::AnyRobot);
        if terms.described.iter().any(is_all) {
            return None;
        }
        let mut sets = Vec::new();
        if !terms.named.is_empty() {
            let (names, among) = (self.texts(&terms.named), self.among);
            for column in ["id", "name"] {
                sets.push(format!(
                    "SELECT r.id AS robot_id FROM ({names}) AS named JOIN robots r ON r.{column} = named.value
                     WHERE {among}"
                ));
            }
        }
        if !terms.labelled.is_empty() {
            let pairs: Vec<_> = terms
                .labelled
                .iter()
                .flat_map(|(key, values)| values.iter().map(move |value| (key, value)))
                .collect();
            let list = self.parameter(json(&pairs));
            sets.push(format!(
                "SELECT l.robot_id FROM ({}) AS wanted
                 JOIN robot_labels l ON l.key = wanted.key AND l.value = wanted.value",
                self.dialect.pairs(list)
            ));
        }
        for term in &terms.described {
            let conditions: Vec<String> = term.iter().map(|one| self.met(one)).collect();
            sets.push(format!(
                "SELECT r.id AS robot_id FROM robots r WHERE {} AND {}",
                self.among,
                conditions.join(" AND ")
            ));
        }
        Some(sets.join(" UNION ALL "))
    }

    /// Whether `robots r` meet a condition.
    fn met(&mut self, condition: &Condition) -> String {
        match condition {
            Condition::AnyRobot => "1 = 1".to_owned(),
            Condition::Label(key, value) => {
                let key = self.parameter(key.to_string());
                let value = self.parameter(value.to_string());
                format!(
                    "r.id IN (SELECT l.robot_id FROM robot_labels l WHERE l.key = ${key} AND l.value = ${value})"
                )
            }
            Condition::NameOrId(name) => {
                let name = self.parameter(name.to_string());
                format!("(r.id = ${name} OR r.name = ${name})")
            }
        }
    }
}

fn combined(operator: &str, sets: &[String]) -> String {
    let sets: Vec<String> =
        sets.iter().map(|set| format!("SELECT robot_id FROM ({set}) AS part")).collect();
    sets.join(&format!(" {operator} "))
}
