//! Packages, as the operator's commands and the page list them. Their bytes are the registry's.

use axum::Json;
use axum::extract::State;
use task_proto::api::PackageList;

use super::App;
use super::error::ApiError;

/// `GET /packages`: every package version.
pub(super) async fn list(State(app): State<App>) -> Result<Json<PackageList>, ApiError> {
    Ok(Json(PackageList { packages: app.store.packages().await? }))
}
