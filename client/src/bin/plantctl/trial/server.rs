//! The server on which cases run.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

use plantd_client::Client;

/// The server on which cases run.
pub(crate) struct TestServer {
    pub(crate) client: Client,
    pub(crate) address: String,
    pub(crate) link_root: Option<PathBuf>,
    /// Plants that are to be deleted.
    pub(crate) plants: Mutex<BTreeSet<String>>,
}

impl TestServer {
    /// The plants that are to be deleted.
    pub(crate) fn plants(&self) -> MutexGuard<'_, BTreeSet<String>> {
        self.plants.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
