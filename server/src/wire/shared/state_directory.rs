//! The directory in which plants survive their server: its files, and what is known of them. Plants of a tenant lie
//! in a folder of its own, `tenants/NAME`.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use anyhow::Result;
use plantd_models::Model;

use crate::core::channels::noise::hash;
use crate::core::modes::Mode;
use crate::core::session::shared::Session;
use crate::core::tenant::Tenants;
use crate::wire::message::run_info::run_info;
use crate::wire::record::folders::folder_of;

pub(crate) const EXTENSION: &str = "plant";

/// A directory in which plants survive their server.
pub struct StateDirectory {
    pub(crate) path: PathBuf,
    pub(crate) mode: Mode,
    pub(crate) tenants: Arc<Tenants>,
    pub(crate) saved: Mutex<BTreeMap<String, Saved>>,
    /// Ids of the plants that were not paused when the server began to pause them all.
    pub(crate) running: OnceLock<BTreeSet<String>>,
}

/// What is known of a file.
pub(crate) enum Saved {
    /// It holds a plant of this server.
    Plant {
        /// Model in force when it was written.
        model: Arc<Model>,
        /// Hash of everything else.
        hash: u64,
    },
    /// It cannot be used and stays as it is.
    Broken,
}

impl StateDirectory {
    /// The directory at a path, made if there is none; the mode is that of its files.
    pub fn open(path: &Path, mode: Mode, tenants: Arc<Tenants>) -> io::Result<Self> {
        mode.create_directory(path)?;
        let path = path.to_owned();
        Ok(Self { path, mode, tenants, saved: Mutex::default(), running: OnceLock::new() })
    }

    /// Notes which plants are not paused: they go on with the next server.
    pub fn note_running(&self, plants: &[Arc<Session>]) {
        let is_running = |session: &&Arc<Session>| run_info(session).running;
        let ids = plants.iter().filter(is_running).map(|session| session.id().to_owned());
        let _ = self.running.set(ids.collect());
    }

    /// What a plant is written as: its bytes and their hash, by which damage is found.
    pub fn sealed(mut bytes: Vec<u8>) -> Vec<u8> {
        bytes.extend(hash(&bytes).to_le_bytes());
        bytes
    }

    pub(crate) fn write(&self, session: &Session, bytes: Vec<u8>) -> Result<()> {
        let bytes = Self::sealed(bytes);
        let folder = folder_of(&self.path, &self.tenants, session.owner());
        self.mode.create_directory(&folder)?;
        let path = self.file(session);
        let aside = path.with_extension("partial");
        let mut file = self.mode.create(&aside)?;
        file.write_all(&bytes)?;
        file.sync_data()?;
        drop(file);
        Ok(fs::rename(aside, path)?)
    }

    /// Forgets a plant that was deleted.
    pub fn remove(&self, session: &Session) {
        let id = session.id();
        let mut saved = self.saved();
        if let Some(Saved::Plant { .. }) = saved.get(id) {
            saved.remove(id);
            if let Err(error) = fs::remove_file(self.file(session)) {
                tracing::error!(plant = id, %error, "saved plant not removed");
            }
        }
    }

    fn file(&self, session: &Session) -> PathBuf {
        let folder = folder_of(&self.path, &self.tenants, session.owner());
        folder.join(session.id()).with_extension(EXTENSION)
    }

    pub(crate) fn saved(&self) -> MutexGuard<'_, BTreeMap<String, Saved>> {
        self.saved.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
