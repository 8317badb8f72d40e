//! Robots as rows of a server's database, for scenarios with more robots than a machine can
//! connect. They are as registered and as they have reported, and have no tokens. Nothing is read.

#![expect(clippy::disallowed_methods, reason = "a hundred thousand robots can't enroll one by one")]

use std::path::Path;

use anyhow::Context as _;
use sqlx::{AnyConnection, AssertSqlSafe, Connection as _};

/// The URL of a server's SQLite database.
pub fn sqlite_url(path: &Path) -> String {
    format!("sqlite://{}", path.display())
}

/// Adds `count` robots, each with a label `site` of ten values, to the database of a server. All
/// have made the same report as a robot that has reported to the server before.
pub async fn add_robots(url: &str, count: u32) -> anyhow::Result<()> {
    sqlx::any::install_default_drivers();
    let mut connection =
        AnyConnection::connect(url).await.context("the server's database can't be opened")?;
    let robots = format!(
        "WITH RECURSIVE counted (n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM counted WHERE n < {count}),
             made (n, id, name, hex) AS (
                 SELECT n, 'r' || substr(CAST(10000000000000000 + n AS TEXT), 2),
                     'fleet-' || substr(CAST(10000000 + n AS TEXT), 2),
                     substr(CAST(100000000 + n AS TEXT), 2)
                 FROM counted)
         INSERT INTO robots (id, name, mac, labels, enrolled_at_ms, report_start, report_seq, report, last_seen_ms)
         SELECT id, name, '02:ff:' || substr(hex, 1, 2) || ':' || substr(hex, 3, 2) || ':' || substr(hex, 5, 2) || ':'
                 || substr(hex, 7, 2),
             '{{\"site\":\"s' || (n % 10) || '\"}}', 0, 1, 1,
             (SELECT report FROM robots WHERE report IS NOT NULL LIMIT 1), 0
         FROM made"
    );
    let insert = sqlx::query(AssertSqlSafe(robots));
    insert.execute(&mut connection).await.context("robots can't be added")?;
    // Earlier versions have no table of labels.
    if sqlx::query("SELECT key FROM robot_labels LIMIT 1").execute(&mut connection).await.is_ok() {
        let labels = "INSERT INTO robot_labels (robot_id, key, value)
             SELECT id, 'site', substr(labels, 10, 2) FROM robots WHERE name LIKE 'fleet-%'";
        let insert = sqlx::query(labels);
        insert.execute(&mut connection).await.context("their labels can't be added")?;
    }
    if url.starts_with("postgres") {
        // As its own background job does after a minute.
        sqlx::query("ANALYZE").execute(&mut connection).await.context("ANALYZE failed")?;
    }
    connection.close().await.context("the database can't be closed")
}
