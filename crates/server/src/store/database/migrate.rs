//! The tables, as a list of migrations that only grows: a shipped migration is never edited. Each
//! is one SQL text for both databases, so it only uses TEXT and BIGINT columns. Each noun's tables
//! have their own file.

use std::borrow::Cow;

use sqlx::migrate::{MigrateError, Migration, MigrationType, Migrator};
use sqlx::{AnyConnection, SqlSafeStr};

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
];

/// Applies the pending migrations.
pub(in crate::store) async fn run(connection: &mut AnyConnection) -> Result<(), MigrateError> {
    let migrations = MIGRATIONS.iter().map(|&(version, name, sql)| {
        Migration::new(
            version,
            Cow::Borrowed(name),
            MigrationType::Simple,
            sql.into_sql_str(),
            false,
        )
    });
    // The future of `run` itself is not guaranteed to be `Send`.
    Migrator::with_migrations(migrations.collect()).run_direct(None, connection, false).await
}
