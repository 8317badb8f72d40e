//! Owns the bodies of the HTTP API under `/api/v1`; it never checks a request and never fills an
//! answer.
//!
//! Times are milliseconds since the Unix epoch by the server's clock, sizes are bytes. Unknown
//! fields are tolerated in answers; requests are checked by the server.

mod feed;
mod orders;
mod packages;
mod people;
mod robots;
mod server;

use serde::{Deserialize, Serialize};

pub use self::feed::*;
pub use self::orders::*;
pub use self::packages::*;
pub use self::people::*;
pub use self::robots::*;
pub use self::server::*;
use crate::{RobotId, TaskName};

/// Path prefix of every API route.
pub const BASE: &str = "/api/v1";
/// Request header with the agent's instance id, the same as in its reports.
pub const INSTANCE_HEADER: &str = "taskd-instance";
/// Request header with the digest of the place where the agent runs, the same as in its reports.
pub const PLACE_HEADER: &str = "taskd-place";
/// Request header that makes a deployment request safe to retry: the same key returns the same
/// deployment. 1 to 128 visible characters.
pub const IDEMPOTENCY_KEY: &str = "idempotency-key";

/// The body of every error response.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ErrorBody {
    /// The error.
    pub error: ApiError,
}

/// An error: a stable code for programs, a sentence for people.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ApiError {
    /// `not_found`, `invalid_request`, `unauthorized`, `forbidden`, `mac_known`, `no_robots_match`,
    /// …
    pub code: String,
    /// Description of the error for people, naming the key that the caller sent.
    pub message: String,
}

/// The largest page of a list, in entries.
pub const MAX_PAGE_ENTRIES: u32 = 1_000;

/// An event of the stream `GET /events` (read): each is the `data` of a server-sent event whose
/// `event` is the tag's value. A view replaces the client's earlier copy. After each connection,
/// fetch the lists once.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Event {
    /// A robot is new or has changed.
    Robot {
        /// The robot's current view.
        robot: Box<RobotView>,
    },
    /// A robot was removed.
    RobotRemoved {
        /// The robot's id.
        id: RobotId,
    },
    /// A deployment is new or has changed; without assignments.
    Deployment {
        /// The deployment's current view.
        deployment: Box<DeploymentView>,
    },
    /// A package was pushed or deleted.
    Package {
        /// The package's name.
        name: TaskName,
    },
    /// The feed has a new entry.
    Feed {
        /// The new entry.
        entry: FeedEntry,
    },
    /// The client was too slow and missed events: fetch the lists again.
    Missed,
}
