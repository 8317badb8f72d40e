//! The tables, as a list of migrations that only grows: a shipped migration is never edited. Each
//! is one SQL text for both databases, so it only uses TEXT and BIGINT columns; the one way in
//! which they read JSON is translated. Each noun's tables have their own file.

use std::borrow::Cow;

use sqlx::migrate::{MigrateError, Migration, MigrationType, Migrator};
use sqlx::{AnyConnection, AssertSqlSafe, SqlSafeStr as _};

use super::dialect::{POSTGRES, SQLITE};
use crate::domain::database_url::{is_postgres, without_password};
use crate::store::StoreError;

/// Version, name and text of every migration.
const MIGRATIONS: &[(i64, &str, &str)] = &[
    (1, "fleet", include_str!("../migrations/0001_fleet.sql")),
    (2, "packages", include_str!("../migrations/0002_packages.sql")),
    (3, "token_rotation", include_str!("../migrations/0003_token_rotation.sql")),
    (4, "outputs", include_str!("../migrations/0004_outputs.sql")),
    (5, "broker_credentials", include_str!("../migrations/0005_broker_credentials.sql")),
    (6, "delivery", include_str!("../migrations/0006_delivery.sql")),
    (7, "people", include_str!("../migrations/0007_people.sql")),
    (8, "direct_pushes", include_str!("../migrations/0008_direct_pushes.sql")),
    (9, "publishers", include_str!("../migrations/0009_publishers.sql")),
    (10, "robots", include_str!("../migrations/0010_robots.sql")),
    (11, "client_keys", include_str!("../migrations/0011_client_keys.sql")),
    (12, "provider", include_str!("../migrations/0012_provider.sql")),
    (13, "approval", include_str!("../migrations/0013_approval.sql")),
    (14, "history", include_str!("../migrations/0014_history.sql")),
    (15, "ran", include_str!("../migrations/0015_ran.sql")),
    (16, "ran_before", include_str!("../migrations/0016_ran_before.sql")),
    (17, "robot_blobs", include_str!("../migrations/0017_robot_blobs.sql")),
    (18, "referrers", include_str!("../migrations/0018_referrers.sql")),
    (19, "needs", include_str!("../migrations/0019_needs.sql")),
    (20, "last_run", include_str!("../migrations/0020_last_run.sql")),
    (21, "replaced", include_str!("../migrations/0021_replaced.sql")),
    (22, "guard", include_str!("../migrations/0022_guard.sql")),
    (23, "pages", include_str!("../migrations/0023_pages.sql")),
    (24, "cluster", include_str!("../migrations/0024_cluster.sql")),
    (25, "blob_store", include_str!("../migrations/0025_blob_store.sql")),
    (26, "bounds", include_str!("../migrations/0026_bounds.sql")),
    (27, "order_chunks", include_str!("../migrations/0027_order_chunks.sql")),
];

/// The version of the tables after all migrations.
pub(in crate::store) const NEWEST: i64 = MIGRATIONS[MIGRATIONS.len() - 1].0;

/// Applies the pending migrations to the database at `url`.
pub(in crate::store) async fn run(
    url: &str,
    connection: &mut AnyConnection,
) -> Result<(), StoreError> {
    let dialect = if is_postgres(url) { &POSTGRES } else { &SQLITE };
    let migrations = MIGRATIONS.iter().map(|&(version, name, sql)| {
        let sql = AssertSqlSafe(dialect.translate(sql)).into_sql_str();
        Migration::new(version, Cow::Borrowed(name), MigrationType::Simple, sql, false)
    });
    // The future of `run` itself is not guaranteed to be `Send`.
    let migrator = Migrator::with_migrations(migrations.collect());
    let url = || without_password(url);
    migrator.run_direct(None, connection, false).await.map_err(|source| match source {
        MigrateError::VersionMissing(version) => StoreError::Newer { url: url(), version },
        source => StoreError::Migrate { url: url(), source },
    })
}
