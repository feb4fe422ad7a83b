//! Where plants survive their server: in a directory, or in an object store that other servers have, too.

pub mod directory;
#[cfg(feature = "object-store")]
pub mod objects;
pub mod store;

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

use plantd_proto::v1;
use prost::Message as _;

use crate::core::channels::noise::hash;
use crate::core::mutex::lock;
use crate::core::session::life::Kept;
use crate::core::session::shared::Session;
use crate::wire::message::run_info::run_info;
use crate::wire::shared::state::store::{Place, Shared, Store, StoreError};

/// The store of a server's plants, and what is known of them.
pub struct State {
    pub(crate) store: Arc<dyn Store>,
    /// Ids of plants whose records cannot be used, and stay as they are.
    broken: Mutex<BTreeSet<String>>,
    /// Held while plants are saved: what was looked at earlier is also written earlier.
    pub(crate) saving: Mutex<()>,
    /// How often the store has answered.
    pub(crate) answers: AtomicUsize,
    /// Plants that are still to be written.
    pub(crate) left: AtomicUsize,
    /// Ids of the plants that were not paused when the server began to pause them all.
    pub(crate) running: OnceLock<BTreeSet<String>>,
}

/// A plant that has changed since it was saved.
pub(crate) struct Changed {
    pub(crate) session: Arc<Session>,
    pub(crate) kept: Kept,
    pub(crate) record: v1::PlantRecord,
}

impl State {
    /// The plants of a store.
    pub fn new(store: Arc<dyn Store>) -> Self {
        Self {
            store,
            broken: Mutex::default(),
            saving: Mutex::default(),
            answers: AtomicUsize::new(0),
            left: AtomicUsize::new(0),
            running: OnceLock::new(),
        }
    }

    /// The store, if other servers have it too.
    pub fn shared(&self) -> Option<&dyn Shared> {
        self.store.shared()
    }

    /// From now on plants are written as given up: the server ends.
    pub fn give_up(&self) {
        if let Some(shared) = self.shared() {
            shared.give_up();
        }
    }

    /// Plants are given up, also those that have not changed.
    pub(crate) fn gives_up(&self) -> bool {
        self.shared().is_some_and(Shared::gives_up)
    }

    /// Notes which plants are not paused: they go on with the next server.
    pub fn note_running(&self, plants: &[Arc<Session>]) {
        let is_running = |session: &&Arc<Session>| run_info(session).running;
        let ids = plants.iter().filter(is_running).map(|session| session.id().to_owned());
        let _ = self.running.set(ids.collect());
    }

    /// Writes a plant, unless it was deleted meanwhile.
    pub(crate) fn write(&self, changed: Changed, takes: bool) -> Result<(), StoreError> {
        let Changed { session, kept, record } = changed;
        // Whoever deletes the plant waits here, and removes what is written.
        let mut file = session.kept();
        if session.is_closed() {
            return Ok(());
        }
        if lock(&self.broken).contains(session.id()) {
            let problem = "its record is that of another plant, which is broken";
            return Err(StoreError::Failed(problem.to_owned()));
        }
        let written = self.store.write(&Place::of(&session), record, takes);
        // It is not this server's to remove.
        *file = if matches!(written, Err(StoreError::Elsewhere(_))) { None } else { file.take() };
        written?;
        *file = Some(kept);
        Ok(())
    }

    /// Forgets a plant that was deleted, while its id is still taken.
    pub fn remove(&self, session: &Session) {
        if session.kept().take().is_some()
            && let Err(error) = self.store.remove(&Place::of(session))
        {
            tracing::error!(plant = session.id(), %error, "saved plant not removed");
        }
    }

    /// Notes a record that cannot be used.
    pub(crate) fn note_broken(&self, id: &str) {
        lock(&self.broken).insert(id.to_owned());
    }

    /// Plants that are still to be written, and how often the store has answered.
    pub fn progress(&self) -> (usize, usize) {
        (self.left.load(Ordering::Relaxed), self.answers.load(Ordering::Relaxed))
    }
}

/// What a plant is written as: its record in protobuf and the FNV-1a hash of that (u64, little-endian), by which damage
/// is found.
pub(crate) fn sealed(record: &v1::PlantRecord) -> Vec<u8> {
    with_hash(record.encode_to_vec())
}

/// Bytes and their hash.
pub fn with_hash(mut bytes: Vec<u8>) -> Vec<u8> {
    bytes.extend(hash(&bytes).to_le_bytes());
    bytes
}

/// The record of bytes that were sealed; else what is wrong with them.
pub(crate) fn unsealed(bytes: &[u8]) -> Result<v1::PlantRecord, String> {
    let (body, found) = bytes.split_last_chunk().ok_or("is cut short")?;
    if hash(body).to_le_bytes() != *found {
        return Err("is damaged: its hash does not match".to_owned());
    }
    v1::PlantRecord::decode(body).map_err(|error| error.to_string())
}
