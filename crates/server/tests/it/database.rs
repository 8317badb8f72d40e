//! A fresh database for each test, on SQLite and on Postgres.

#![expect(clippy::disallowed_methods, reason = "making a test's database takes SQL")]

use sqlx::{Connection as _, Row as _};
use task_proto::{DeploymentId, Digest, RobotId};
use taskd::store::{Store, sqlite_url};

/// An empty, migrated database of one test.
pub struct TestDatabase {
    pub store: Store,
    /// The database's URL, to open it again.
    pub url: String,
    /// Removed with the test.
    _directory: Option<tempfile::TempDir>,
}

pub async fn sqlite() -> TestDatabase {
    let directory = tempfile::tempdir().expect("temporary directory");
    let url = sqlite_url(&directory.path().join("taskd.db"));
    TestDatabase {
        store: Store::open(&url).await.expect("opens"),
        url,
        _directory: Some(directory),
    }
}

pub async fn postgres() -> TestDatabase {
    let Ok(server) = std::env::var("TASKD_TEST_POSTGRES") else {
        panic!(
            "TASKD_TEST_POSTGRES is not set: run ./scripts/test, which starts a Postgres for the tests, or set it to the \
             URL of a server where databases may be created, for example postgres://postgres@127.0.0.1:5432"
        );
    };
    let name = format!("taskd_test_{:016x}", rand::random::<u64>());
    sqlx::any::install_default_drivers();
    let mut connection = sqlx::AnyConnection::connect(&format!("{server}/postgres"))
        .await
        .expect("the test server answers");
    let create = sqlx::AssertSqlSafe(format!("CREATE DATABASE {name}"));
    sqlx::query(create).execute(&mut connection).await.expect("may create databases");
    connection.close().await.expect("closes");
    let url = format!("{server}/{name}");
    TestDatabase { store: Store::open(&url).await.expect("opens"), url, _directory: None }
}

impl TestDatabase {
    /// The recorded inputs of the decision on how a deployment travels to a robot, as JSON.
    pub async fn inputs(&self, deployment: &DeploymentId, robot: &RobotId) -> String {
        let mut connection = sqlx::AnyConnection::connect(&self.url).await.expect("connects");
        let query = sqlx::query_scalar(
            "SELECT inputs FROM assignments WHERE deployment_id = $1 AND robot_id = $2",
        );
        let query = query.bind(deployment.as_str()).bind(robot.as_str());
        query.fetch_one(&mut connection).await.expect("decided")
    }

    /// Changes an entry of the audit behind its back.
    pub async fn forge_audit(&self, number: i64, from: &str, to: &str) {
        let mut connection = sqlx::AnyConnection::connect(&self.url).await.expect("connects");
        let forge =
            sqlx::query("UPDATE audit SET entry = REPLACE(entry, $2, $3) WHERE number = $1");
        let forged =
            forge.bind(number).bind(from).bind(to).execute(&mut connection).await.expect("forges");
        assert_eq!(forged.rows_affected(), 1);
    }

    /// Takes an entry of the audit away.
    pub async fn drop_audit(&self, number: i64) {
        let mut connection = sqlx::AnyConnection::connect(&self.url).await.expect("connects");
        let query = sqlx::query("DELETE FROM audit WHERE number = $1").bind(number);
        assert_eq!(query.execute(&mut connection).await.expect("drops").rows_affected(), 1);
    }

    /// Deletes a package's manifest, as was once possible while robots should have the package.
    pub async fn drop_package(&self, name: &str, manifest: &Digest) {
        let mut connection = sqlx::AnyConnection::connect(&self.url).await.expect("connects");
        for query in [
            "DELETE FROM packages WHERE name = $1 AND manifest = $2",
            "DELETE FROM manifest_parts WHERE repository = $1 AND manifest = $2",
            "DELETE FROM tags WHERE repository = $1 AND manifest = $2",
            "DELETE FROM manifests WHERE repository = $1 AND digest = $2",
        ] {
            let query = sqlx::query(query).bind(name).bind(manifest.to_string());
            query.execute(&mut connection).await.expect("drops");
        }
    }

    /// Makes all assignments such as they were before decisions were kept.
    pub async fn forget_decisions(&self) {
        let mut connection = sqlx::AnyConnection::connect(&self.url).await.expect("connects");
        let forget =
            "UPDATE assignments SET mechanism = NULL, rule = NULL, because = NULL, inputs = NULL";
        sqlx::query(forget).execute(&mut connection).await.expect("forgets");
    }
}

/// Renames a table, so that queries do not find the table.
pub async fn rename(url: &str, table: &str, name: &str) {
    let mut connection = sqlx::AnyConnection::connect(url).await.expect("connects");
    let rename = sqlx::AssertSqlSafe(format!("ALTER TABLE {table} RENAME TO {name}"));
    sqlx::query(rename).execute(&mut connection).await.expect("renames");
}

/// All there is in the tables that orders change, row by row.
pub async fn contents(url: &str) -> Vec<String> {
    const TABLES: [&str; 12] = [
        "users",
        "tokens",
        "robots",
        "deployments",
        "assignments",
        "orders",
        "repository_blobs",
        "manifests",
        "manifest_parts",
        "tags",
        "packages",
        "outputs",
    ];
    let mut connection = sqlx::AnyConnection::connect(url).await.expect("connects");
    let mut lines = Vec::new();
    for table in TABLES {
        let select = sqlx::AssertSqlSafe(format!("SELECT * FROM {table}"));
        for row in sqlx::query(select).fetch_all(&mut connection).await.expect("reads") {
            let value = |at| match row.try_get::<Option<i64>, _>(at) {
                Ok(number) => format!("{number:?}"),
                Err(_) => format!(
                    "{:?}",
                    row.try_get::<Option<String>, _>(at).expect("a number or a text")
                ),
            };
            let values: Vec<String> = (0..row.len()).map(value).collect();
            lines.push(format!("{table}: {}", values.join(" ")));
        }
    }
    lines.sort();
    lines
}

/// Runs each of the async functions, which take a [`TestDatabase`], as one test on each database.
macro_rules! on_both_databases {
    ($($story:ident),* $(,)?) => {
        mod sqlite {
            $(#[tokio::test(flavor = "multi_thread")] async fn $story() {
                super::$story(crate::database::sqlite().await).await;
            })*
        }
        mod postgres {
            $(#[tokio::test(flavor = "multi_thread")] async fn $story() {
                super::$story(crate::database::postgres().await).await;
            })*
        }
    };
}
pub(crate) use on_both_databases;
