//! Owns the routes about packages and their bytes; never decides where a package runs.

pub mod archives;
pub mod oci;
pub(super) mod packages;
pub mod upload;

use self::archives::ArchiveReaders;
use crate::blobs::Blobs;
use crate::http::peers::Peers;
use crate::link::transfers::Transfers;
use crate::orders::changes::Changes;
use crate::store::Store;
use crate::system::clock::Clock;

/// State of the handlers that read and change packages.
#[derive(Clone)]
pub struct Registry {
    pub store: Store,
    pub blobs: Blobs,
    /// The clock for push times.
    pub clock: Clock,
    /// Scheduler of pulls by robots.
    pub transfers: Transfers,
    /// Announces changed packages and newly signed documents.
    pub changes: Changes,
    /// Readers of whole archives.
    pub readers: ArchiveReaders,
    /// The other servers of the cluster, at which uploads may have begun.
    pub peers: Peers,
}
