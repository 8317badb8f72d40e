//! `taskd blobs`: moves the blobs of a stopped server.

use std::io::{self, Write as _};

use clap::Subcommand;
use task_proto::size::format_bytes;

use crate::blobs::{MoveError, Moved, move_to_common_store};
use crate::config::{Config, ConfigError, ServeFlags};
use crate::serve::blobs::{blob_settings, open_common_store};
use crate::serve::{ServeError, open_store};
use crate::store::StoreError;
use crate::system::data_directory::DataDirectory;

#[derive(Debug, Subcommand)]
pub enum BlobsCommand {
    /// Move the blobs of the data directory to the store named by blobs.store
    ///
    /// Takes the settings of taskd serve. The server has to be stopped. Each blob is written, read
    /// back and compared; after an interruption run the command again. The files become local
    /// copies.
    Move(ServeFlags),
}

/// The reason why the blobs were not moved, or not all of them.
#[derive(Debug, thiserror::Error)]
pub enum BlobsCommandError {
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// There is no other place.
    #[error("blobs.store: no store is set, so the blobs stay in the data directory")]
    NoStore,
    #[error(transparent)]
    Serve(#[from] ServeError),
    #[error(transparent)]
    Move(#[from] MoveError),
}

impl From<StoreError> for BlobsCommandError {
    fn from(error: StoreError) -> Self {
        Self::Serve(error.into())
    }
}

impl BlobsCommand {
    /// Runs the command. Progress is on stderr, the result on stdout.
    pub async fn run(&self) -> Result<(), BlobsCommandError> {
        let Self::Move(flags) = self;
        let config = Config::load(flags, std::env::vars_os())?;
        let Some(url) = &config.blob_store else { return Err(BlobsCommandError::NoStore) };
        let data = DataDirectory::open(&config.data).map_err(ServeError::from)?;
        let key = data.signing_key().map_err(ServeError::from)?.public_key();
        let store = open_store(&config, &data, &key).await?;
        // Takes the lock of a Postgres, so no server uses the database.
        store.prepare().await?;
        let common = open_common_store(&store, url).await?;
        let max_cache_bytes = blob_settings(&config).max_cache_bytes;
        // Closed output does not stop the move.
        let mut stderr = io::stderr();
        let moving = move_to_common_store(data.path(), max_cache_bytes, &common, |moved, left| {
            let _ = write!(
                stderr,
                "\r{} blobs, {} moved, {left} left ",
                moved.blobs,
                format_bytes(moved.bytes)
            );
        });
        let moved = moving.await;
        store.close().await;
        let Moved { blobs, bytes, known, damaged } = moved?;
        let _ = writeln!(
            io::stdout(),
            "\n{blobs} blobs ({}) moved to {url} and compared, {known} were there already",
            format_bytes(bytes)
        );
        if damaged > 0 {
            let _ = writeln!(
                io::stdout(),
                "{damaged} files did not hold their blob and were renamed to end in .damaged: push these packages again"
            );
        }
        Ok(())
    }
}
