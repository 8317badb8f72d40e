//! A fresh database for each test, on SQLite and on Postgres.

#![expect(clippy::disallowed_methods, reason = "making a test's database takes SQL")]

use std::time::Duration;

use sqlx::{Connection as _, Row as _};
use task_proto::{DeploymentId, Digest, RobotId};
use taskd::store::{Store, sqlite_url};

/// Time limit that only a hanging test exceeds.
const PATIENCE: Duration = Duration::from_secs(30);

/// An empty, migrated database of one test.
pub struct TestDatabase {
    pub store: Store,
    /// The same database as another server opens it, if two servers share it.
    pub second: Option<Store>,
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
        second: None,
        url,
        _directory: Some(directory),
    }
}

pub async fn postgres() -> TestDatabase {
    let Ok(server) = std::env::var("TASKD_TEST_POSTGRES") else {
        panic!(
            "TASKD_TEST_POSTGRES is not set: run ./scripts/test, which starts a Postgres for the \
             tests, or set it to the URL of a server where databases may be created, for example \
             postgres://postgres@127.0.0.1:5432"
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
    let store = Store::open(&url).await.expect("opens");
    TestDatabase { store, second: None, url, _directory: None }
}

/// A database on Postgres that two servers share.
pub async fn postgres_of_two() -> TestDatabase {
    let mut database = postgres().await;
    database.second = Some(database.another_store().await);
    database
}

impl TestDatabase {
    /// The database as one more server opens it.
    pub async fn another_store(&self) -> Store {
        Store::open(&self.url).await.expect("opens")
    }

    /// Returns when this number of sessions wait for a lock of another session. For Postgres only.
    pub async fn sessions_wait_for_locks(&self, count: i64) {
        let mut connection = sqlx::AnyConnection::connect(&self.url).await.expect("connects");
        let waiting = "SELECT COUNT(*) FROM pg_stat_activity
             WHERE datname = current_database() AND wait_event_type = 'Lock'";
        let wait = async {
            while sqlx::query_scalar::<_, i64>(waiting)
                .fetch_one(&mut connection)
                .await
                .expect("reads")
                != count
            {}
        };
        tokio::time::timeout(PATIENCE, wait).await.expect("as many sessions wait");
    }

    /// Makes writes of a table wait until the returned connection is dropped. For Postgres only.
    pub async fn keep_from_writing(&self, table: &str) -> sqlx::AnyConnection {
        let mut connection = sqlx::AnyConnection::connect(&self.url).await.expect("connects");
        let lock = sqlx::AssertSqlSafe(format!("BEGIN; LOCK TABLE {table} IN SHARE MODE"));
        sqlx::raw_sql(lock).execute(&mut connection).await.expect("locked");
        connection
    }

    /// Makes the next `count` writes of reports lose their connection. For Postgres only.
    pub async fn lose_connections(&self, count: u32) {
        let mut connection = sqlx::AnyConnection::connect(&self.url).await.expect("connects");
        // A sequence goes on counting where a transaction is rolled back.
        let lose = sqlx::AssertSqlSafe(format!(
            "CREATE SEQUENCE losses;
             CREATE FUNCTION lose() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN
                 IF nextval('losses') <= {count} THEN
                     PERFORM pg_terminate_backend(pg_backend_pid());
                 END IF;
                 RETURN NULL;
             END $$;
             CREATE TRIGGER lose BEFORE UPDATE ON robots FOR EACH STATEMENT EXECUTE FUNCTION lose();"
        ));
        sqlx::raw_sql(lose).execute(&mut connection).await.expect("made");
    }

    /// The number of writes of reports since [`Self::lose_connections`].
    pub async fn report_writes(&self) -> i64 {
        let mut connection = sqlx::AnyConnection::connect(&self.url).await.expect("connects");
        let last = sqlx::query_scalar("SELECT last_value FROM losses");
        last.fetch_one(&mut connection).await.expect("reads")
    }

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

/// Takes the tables back to the version before `0027_order_chunks.sql`. No order may be in chunks.
pub async fn undo_order_chunks(url: &str) {
    let mut connection = sqlx::AnyConnection::connect(url).await.expect("connects");
    let undo =
        "DROP TABLE robot_labels; DROP TABLE order_chunks; DROP INDEX deployments_cancelling;
         ALTER TABLE deployments DROP COLUMN cancel_from;
         ALTER TABLE deployments DROP COLUMN selected; ALTER TABLE deployments DROP COLUMN placed;
         ALTER TABLE deployments DROP COLUMN restart;
         DELETE FROM _sqlx_migrations WHERE version = 27";
    sqlx::raw_sql(undo).execute(&mut connection).await.expect("undone");
    connection.close().await.expect("closes");
}

/// The names of all tables except that of the migrations, sorted.
pub async fn tables(url: &str) -> Vec<String> {
    let list = match url.starts_with("sqlite:") {
        true => "SELECT name FROM sqlite_schema WHERE type = 'table'",
        false => "SELECT CAST(tablename AS TEXT) FROM pg_tables WHERE schemaname = 'public'",
    };
    let mut connection = sqlx::AnyConnection::connect(url).await.expect("connects");
    let mut names: Vec<String> =
        sqlx::query_scalar(list).fetch_all(&mut connection).await.expect("reads");
    names.retain(|name| name != "_sqlx_migrations");
    names.sort();
    names
}

/// Gives each table of a migrated SQLite database two rows, the second one with NULL in each column
/// that may be NULL. One table has thousands, and the write lock has a holder.
pub async fn fill_all_tables(url: &str) {
    let mut connection = sqlx::AnyConnection::connect(url).await.expect("connects");
    let columns = "SELECT t.name, c.name, c.type, c.pk + c.\"notnull\" FROM sqlite_schema t,
             pragma_table_info(t.name) c
         WHERE t.type = 'table' AND t.name NOT IN ('_sqlx_migrations', 'write_lock')
         ORDER BY t.rowid, c.cid";
    let columns: Vec<(String, String, String, i64)> =
        sqlx::query_as(columns).fetch_all(&mut connection).await.expect("reads");
    for table in columns.chunk_by(|one, next| one.0 == next.0) {
        let names: Vec<_> = table.iter().map(|(_, name, ..)| format!("\"{name}\"")).collect();
        for (text, number, has_all) in [("'a'", "1", true), ("'É \"\n'", "9007199254740993", false)]
        {
            let value = |(.., kind, needed): &(String, String, String, i64)| match kind.as_str() {
                _ if !has_all && *needed == 0 => "NULL",
                "TEXT" => text,
                _ => number,
            };
            let values: Vec<_> = table.iter().map(value).collect();
            let (table, names, values) = (&table[0].0, names.join(", "), values.join(", "));
            let insert = format!("INSERT INTO {table} ({names}) VALUES ({values})");
            let insert = sqlx::AssertSqlSafe(insert);
            sqlx::query(insert).execute(&mut connection).await.expect("inserts");
        }
    }
    let more = "UPDATE write_lock SET turn = 7, holder = 'rack-1', held_since_ms = 7;
         WITH RECURSIVE counted (n) AS (SELECT 2 UNION ALL SELECT n + 1 FROM counted WHERE n < 2100)
         INSERT INTO orders (key, request, answer, created_at_ms)
         SELECT 'key-' || n, 'request', 'answer', n FROM counted;";
    sqlx::raw_sql(more).execute(&mut connection).await.expect("inserts");
    connection.close().await.expect("closes");
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
    let mut lines = Vec::new();
    for table in TABLES {
        lines.extend(rows(url, table).await.into_iter().map(|row| format!("{table}: {row}")));
    }
    lines.sort();
    lines
}

/// The rows of a table as text.
pub async fn rows(url: &str, table: &str) -> Vec<String> {
    let mut connection = sqlx::AnyConnection::connect(url).await.expect("connects");
    let select = sqlx::AssertSqlSafe(format!("SELECT * FROM {table}"));
    let rows = sqlx::query(select).fetch_all(&mut connection).await.expect("reads");
    let text = |row: &sqlx::any::AnyRow| {
        let value = |at| match row.try_get::<Option<i64>, _>(at) {
            Ok(number) => format!("{number:?}"),
            Err(_) => {
                format!("{:?}", row.try_get::<Option<String>, _>(at).expect("a number or a text"))
            }
        };
        (0..row.len()).map(value).collect::<Vec<_>>().join(" ")
    };
    rows.iter().map(text).collect()
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

/// Does as [`on_both_databases`], and runs each function with two servers on one Postgres as well,
/// which get the calls in turns.
macro_rules! on_all_databases {
    ($($story:ident),* $(,)?) => {
        on_both_databases! { $($story),* }
        mod two_servers {
            $(#[tokio::test(flavor = "multi_thread")] async fn $story() {
                super::$story(crate::database::postgres_of_two().await).await;
            })*
        }
    };
}
pub(crate) use on_all_databases;
