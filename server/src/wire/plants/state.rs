//! The plants of a server in a directory: saved while they change, and made again by the next server.
//!
//! A file `ID.plant` is a `PlantRecord` in protobuf and the FNV-1a hash (u64, little-endian) of it. It is
//! written aside and renamed: what is there is complete.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::SystemTime;
use std::{fs, io};

use prost::Message as _;

use crate::core::channels::noise::hash;
use crate::core::connection::Connection;
use crate::core::mutex::lock;
use crate::core::session::life::Kept;
use crate::core::session::shared::Session;
use crate::core::tenant::Tenant;
use crate::wire::message::run_info::run_info;
use crate::wire::plants::record;
use crate::wire::record::folders::folders;
use crate::wire::shared::hub::Hub;
use crate::wire::shared::state_directory::{Changed, EXTENSION, StateDirectory};
use crate::wire::status::RpcError;

/// Plants that are written side by side.
const WRITERS: usize = 16;

impl StateDirectory {
    /// Makes the plants anew that the directory holds. What cannot be used is named in the log and
    /// left as it is.
    pub async fn load(&self, hub: &Arc<Hub>) -> io::Result<()> {
        for (tenant, folder) in folders(&self.path, &self.tenants)? {
            // What is made is this tenant's.
            Connection::server(tenant).work(self.load_folder(hub, &folder)).await?;
        }
        Ok(())
    }

    async fn load_folder(&self, hub: &Arc<Hub>, folder: &Path) -> io::Result<()> {
        let mut paths =
            fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>()?;
        paths.retain(|path| path.extension().is_some_and(|kind| kind == EXTENSION));
        paths.sort();
        for path in paths {
            let Some(id) = path.file_stem().and_then(|stem| stem.to_str()) else { continue };
            match load(hub, id, &path).await.map_err(sentence) {
                Ok(session) => {
                    tracing::info!(plant = id, step = session.step_index(), "plant restored");
                    let model = Arc::clone(session.model());
                    *session.kept() = Some(Kept { model, hash: 0 });
                }
                Err(error) => {
                    tracing::error!(path = %path.display(), error, "plant not restored");
                    self.note_broken(id);
                }
            }
        }
        Ok(())
    }

    /// Saves all plants that have changed since they were saved.
    pub fn save(&self, hub: &Hub) {
        let _saving = lock(&self.saving);
        if Connection::server(Tenant::NONE).scope(|| self.save_all(hub)) {
            hub.metrics.state_saved(SystemTime::now());
        }
    }

    /// True when all have been written.
    fn save_all(&self, hub: &Hub) -> bool {
        let (mut after, mut are_written) = (String::new(), true);
        loop {
            let (sessions, has_more) = hub.page(&after, 100);
            let Some(last) = sessions.last() else { return are_written };
            after = last.id().to_owned();
            let changed = sessions.iter().filter_map(|each| self.changed(hub, each)).collect();
            are_written &= self.save_changed(changed);
            if !has_more {
                return are_written;
            }
        }
    }

    /// Writes plants side by side: each waits for the disk, which serves many as fast as one. True when all have been
    /// written.
    fn save_changed(&self, changed: Vec<Changed>) -> bool {
        let are_written = AtomicBool::new(true);
        self.left.store(changed.len(), Ordering::Relaxed);
        let write = |changed: Changed| {
            let id = changed.session.id().to_owned();
            if let Err(error) = self.write(changed) {
                let error = format!("{error:#}");
                tracing::error!(plant = id, error, "plant not saved");
                are_written.store(false, Ordering::Relaxed);
            }
            self.answers.fetch_add(1, Ordering::Relaxed);
            self.left.fetch_sub(1, Ordering::Relaxed);
        };
        let writers = changed.len().min(WRITERS);
        let queue = Mutex::new(changed);
        let next = || lock(&queue).pop();
        std::thread::scope(|scope| {
            for _ in 0..writers {
                scope.spawn(|| std::iter::from_fn(next).for_each(write));
            }
        });
        are_written.into_inner()
    }

    /// What is to be written of a plant; nothing if it is as it was saved.
    fn changed(&self, hub: &Hub, session: &Arc<Session>) -> Option<Changed> {
        let (mut record, model) = session.saved();
        if let Some(plant) = &mut record.plant {
            let mut run = run_info(session);
            if let Some(running) = self.running.get() {
                run.running = running.contains(session.id());
            }
            plant.run = Some(run);
        }
        let hash = hash(&record.encode_to_vec());
        let is_kept =
            session.kept().as_ref().is_some_and(|Kept { model: before, hash: of_before }| {
                Arc::ptr_eq(before, &model) && *of_before == hash
            });
        if is_kept {
            return None;
        }
        record::add_models(&mut record, hub, session, &model);
        let (session, bytes) = (Arc::clone(session), record.encode_to_vec());
        Some(Changed { session, kept: Kept { model, hash }, bytes })
    }
}

/// Makes the plant of a file anew. Without some of what belongs to it, it is still worth having.
async fn load(hub: &Arc<Hub>, id: &str, path: &Path) -> Result<Arc<Session>, RpcError> {
    let bytes = fs::read(path).map_err(|error| record::unusable(error.to_string()))?;
    let record = record::decode(&bytes)?;
    let found = record.plant.as_ref().map_or("", |plant| plant.id.as_str());
    if found != id {
        return Err(record::unusable(format!("the plant in it is `{found}`")));
    }
    let name = id.to_owned();
    let lose: record::Lose = Arc::new(move |what, fault| {
        let error = sentence(fault);
        tracing::warn!(plant = name, error, "{what}");
        Ok(())
    });
    record::make(hub, id.to_owned(), record, lose).await
}

fn sentence(fault: RpcError) -> String {
    tonic::Status::from(fault).message().to_owned()
}
