//! Opens the blob store of the configuration: the data directory, or the servers' common store with
//! local copies. This module never moves a blob from one to the other.

use super::ServeError;
use crate::blobs::{BlobSettings, Blobs, CommonStore, upload_mark};
use crate::config::Config;
use crate::domain::blob_store_url::BlobStoreUrl;
use crate::store::{Fault, Store, StoreError};
use crate::system::data_directory::{DataDirectory, disk_space};

/// Default disk reserve that people must leave free: this share of the disk, up to an absolute
/// maximum in bytes.
const RESERVE_SHARE: u64 = 40;
const MAX_RESERVE_BYTES: u64 = 1 << 30;
/// Default upper bound of one robot's stored outputs, as a share of the disk.
const ROBOT_SHARE: u64 = 8;
/// Default upper bound of the local copies of blobs in a common store, as a share of the disk.
const CACHE_SHARE: u64 = 4;

/// Opens the blob store, and refuses a place other than that of the database's blobs.
pub(super) async fn open_blobs(
    config: &Config,
    data: &DataDirectory,
    store: &Store,
) -> Result<Blobs, ServeError> {
    let settings = blob_settings(config);
    match &config.blob_store {
        Some(url) => {
            // Before the store is named in the database, so that a refused start changes nothing.
            Blobs::check_moved(data.path())?;
            let common = open_common_store(store, url).await?;
            Ok(Blobs::open_with(data.path(), settings, common)?)
        }
        None if has_common_blobs(store).await? => Err(ServeError::NoCommonStore),
        None => Ok(Blobs::open(data.path(), settings)?),
    }
}

/// Whether the database's blobs lie in a common store. A database that is away is not asked, so that
/// the server can wait for it.
async fn has_common_blobs(store: &Store) -> Result<bool, StoreError> {
    match store.stored_blobs().has_any().await {
        Err(error) if error.fault() == Some(Fault::Unreachable) => Ok(false),
        answer => answer,
    }
}

/// The common store of the setting.
pub(super) async fn open_common_store(
    store: &Store,
    url: &BlobStoreUrl,
) -> Result<CommonStore, ServeError> {
    Ok(CommonStore::open(store.clone(), url).await?)
}

/// The limits of the configuration, with defaults for this disk.
pub(super) fn blob_settings(config: &Config) -> BlobSettings {
    let defaults = BlobSettings::default();
    let disk_bytes = disk_space(&config.data).map_or(u64::MAX, |(_, total)| total);
    BlobSettings {
        reading: config.blob_read,
        max_blob_bytes: config.max_blob_bytes,
        max_robot_bytes: config
            .max_robot_bytes
            .unwrap_or(defaults.max_robot_bytes.min(disk_bytes / ROBOT_SHARE)),
        reserve_bytes: config
            .disk_reserve
            .unwrap_or(MAX_RESERVE_BYTES.min(disk_bytes / RESERVE_SHARE)),
        max_cache_bytes: config
            .blob_cache_bytes
            .unwrap_or(defaults.max_cache_bytes.min(disk_bytes / CACHE_SHARE)),
        upload_mark: config.cluster.as_ref().map(|cluster| upload_mark(cluster.name.as_str())),
        ..defaults
    }
}
