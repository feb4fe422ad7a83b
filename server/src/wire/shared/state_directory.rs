//! The directory in which plants survive their server: its files, and what is known of them. Plants of a tenant lie
//! in a folder of its own, `tenants/NAME`.

use std::collections::BTreeSet;
use std::fs::{self, File, TryLockError};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

use anyhow::{Result, bail};

use crate::core::channels::noise::hash;
use crate::core::modes::Mode;
use crate::core::mutex::lock;
use crate::core::session::life::Kept;
use crate::core::session::shared::Session;
use crate::core::tenant::Tenants;
use crate::wire::message::run_info::run_info;
use crate::wire::record::folders::folder_of;

pub(crate) const EXTENSION: &str = "plant";

/// Locked by the server whose plants are in the directory; its process is named in it.
const LOCK: &str = "lock";

/// A directory in which plants survive their server.
pub struct StateDirectory {
    pub(crate) path: PathBuf,
    pub(crate) mode: Mode,
    pub(crate) tenants: Arc<Tenants>,
    /// Ids of plants whose files cannot be used, and stay as they are.
    broken: Mutex<BTreeSet<String>>,
    /// Held while plants are saved: what was looked at earlier is also written earlier.
    pub(crate) saving: Mutex<()>,
    /// How often the disk has answered.
    pub(crate) answers: AtomicUsize,
    /// Plants that are still to be written.
    pub(crate) left: AtomicUsize,
    /// Ids of the plants that were not paused when the server began to pause them all.
    pub(crate) running: OnceLock<BTreeSet<String>>,
    lock: File,
}

/// A plant that has changed since it was saved.
pub(crate) struct Changed {
    pub(crate) session: Arc<Session>,
    pub(crate) kept: Kept,
    pub(crate) bytes: Vec<u8>,
}

impl StateDirectory {
    /// The directory at a path, made if there is none; the mode is that of its files. Refuses one that another
    /// server uses: each would overwrite the plants of the other.
    pub fn open(path: &Path, mode: Mode, tenants: Arc<Tenants>) -> Result<Self> {
        mode.create_directory(path)?;
        let path = path.to_owned();
        let lock = take(&path.join(LOCK), mode)?;
        Ok(Self {
            path,
            mode,
            tenants,
            broken: Mutex::default(),
            saving: Mutex::default(),
            answers: AtomicUsize::new(0),
            left: AtomicUsize::new(0),
            running: OnceLock::new(),
            lock,
        })
    }

    /// Leaves the directory to other servers.
    pub fn release(&self) {
        if let Err(error) = self.lock.unlock() {
            tracing::error!(%error, "{} stays locked", self.path.join(LOCK).display());
        }
    }

    /// Notes which plants are not paused: they go on with the next server.
    pub fn note_running(&self, plants: &[Arc<Session>]) {
        let is_running = |session: &&Arc<Session>| run_info(session).running;
        let ids = plants.iter().filter(is_running).map(|session| session.id().to_owned());
        let _ = self.running.set(ids.collect());
    }

    /// Writes a plant, unless it was deleted meanwhile.
    pub(crate) fn write(&self, changed: Changed) -> Result<()> {
        let Changed { session, kept, bytes } = changed;
        // Whoever deletes the plant waits here, and removes what is written.
        let mut file = session.kept();
        if session.is_closed() {
            return Ok(());
        }
        if lock(&self.broken).contains(session.id()) {
            bail!("its file is that of another plant, which is broken");
        }
        self.write_file(&session, bytes)?;
        *file = Some(kept);
        Ok(())
    }

    /// What a plant is written as: its bytes and their hash, by which damage is found.
    pub fn sealed(mut bytes: Vec<u8>) -> Vec<u8> {
        bytes.extend(hash(&bytes).to_le_bytes());
        bytes
    }

    fn write_file(&self, session: &Session, bytes: Vec<u8>) -> Result<()> {
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

    /// Forgets a plant that was deleted, while its id is still taken.
    pub fn remove(&self, session: &Session) {
        if session.kept().take().is_some()
            && let Err(error) = fs::remove_file(self.file(session))
        {
            tracing::error!(plant = session.id(), %error, "saved plant not removed");
        }
    }

    /// Notes a file that cannot be used.
    pub(crate) fn note_broken(&self, id: &str) {
        lock(&self.broken).insert(id.to_owned());
    }

    fn file(&self, session: &Session) -> PathBuf {
        let folder = folder_of(&self.path, &self.tenants, session.owner());
        folder.join(session.id()).with_extension(EXTENSION)
    }

    /// Plants that are still to be written, and how often the disk has answered.
    pub fn progress(&self) -> (usize, usize) {
        (self.left.load(Ordering::Relaxed), self.answers.load(Ordering::Relaxed))
    }
}

/// Locks a file, as long as the process lives, and names the process in it.
fn take(path: &Path, mode: Mode) -> Result<File> {
    let mut file = mode.open_or_create(path)?;
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            let holder = fs::read_to_string(path).unwrap_or_default();
            bail!(
                "another server (process {}) keeps its plants there, and each would overwrite those of the other: \
                 name another state_directory",
                holder.trim()
            );
        }
        Err(TryLockError::Error(error)) => return Err(error.into()),
    }
    file.set_len(0)?;
    writeln!(file, "{}", std::process::id())?;
    Ok(file)
}
