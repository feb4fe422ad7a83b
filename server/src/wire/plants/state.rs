//! The plants of a server in a directory: saved while they change, and made again by the next server.
//!
//! A file `ID.plant` is a `PlantRecord` in protobuf and the FNV-1a hash (u64, little-endian) of it. It is
//! written aside and renamed: what is there is complete.

use std::collections::HashMap;
use std::path::Path;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::{fs, io};

use anyhow::{Context as _, Result, bail};
use plantd_models::{Initial, Model, Snapshot, Spare};
use plantd_proto::v1;
use prost::Message as _;

use crate::core::channels::noise::hash;
use crate::core::connection::Connection;
use crate::core::mutex::lock;
use crate::core::plant::view::PlantSnapshot;
use crate::core::session::life::Kept;
use crate::core::session::shared::Session;
use crate::core::tenant::Tenant;
use crate::wire::message::run_info::run_info;
use crate::wire::message::{checks, models, settings, start};
use crate::wire::models::model::compile;
use crate::wire::plants::feedback::set_feedback;
use crate::wire::plants::run::{protect, run};
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
            match load(hub, id, &path).await {
                Ok(session) => {
                    tracing::info!(plant = id, step = session.step_index(), "plant restored");
                    let model = Arc::clone(session.model());
                    *session.kept() = Some(Kept { model, hash: 0 });
                }
                Err(error) => {
                    let error = format!("{error:#}");
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
        Connection::server(Tenant::NONE).scope(|| self.save_all(hub));
    }

    fn save_all(&self, hub: &Hub) {
        let mut after = String::new();
        loop {
            let (sessions, has_more) = hub.page(&after, 100);
            let Some(last) = sessions.last() else { return };
            after = last.id().to_owned();
            self.save_changed(sessions.iter().filter_map(|each| self.changed(hub, each)).collect());
            if !has_more {
                return;
            }
        }
    }

    /// Writes plants side by side: each waits for the disk, which serves many as fast as one.
    fn save_changed(&self, changed: Vec<Changed>) {
        self.left.store(changed.len(), Ordering::Relaxed);
        let write = |changed: Changed| {
            let id = changed.session.id().to_owned();
            if let Err(error) = self.write(changed) {
                let error = format!("{error:#}");
                tracing::error!(plant = id, error, "plant not saved");
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
        let name = session.model_name();
        let entry = hub.catalog.get(name).ok();
        let message = |model: &Model| {
            let name = entry.as_ref().map_or("", |_| name);
            let builtin = entry.as_ref().is_some_and(|entry| entry.builtin);
            let plan = String::new();
            v1::Model { plan, ..models::model(name, builtin, model, true) }
        };
        record.model = Some(message(&model));
        let start = session.model();
        record.start_model = (start.digest() != model.digest()).then(|| message(start));
        let (session, bytes) = (Arc::clone(session), record.encode_to_vec());
        Some(Changed { session, kept: Kept { model, hash }, bytes })
    }
}

/// Makes the plant of a file anew.
async fn load(hub: &Arc<Hub>, id: &str, path: &Path) -> Result<Arc<Session>> {
    let record = decode(&fs::read(path)?)?;
    let v1::PlantRecord { plant, model, start_model, start_settings, feedback, channels, .. } =
        record;
    let mut snapshot = PlantSnapshot::from_bytes(&record.snapshot)?;
    let (info, model) = (plant.context("no plant in it")?, model.context("no model in it")?);
    if info.id != id {
        bail!("the plant in it is `{}`", info.id);
    }
    checks::check_name("id", id).map_err(sentence)?;
    let in_force = Arc::new(scene(hub, &model)?);
    let start_model = match &start_model {
        Some(model) => Arc::new(scene(hub, model)?),
        None => Arc::clone(&in_force),
    };
    let start_model = match hub.catalog.get(&info.model) {
        Ok(entry) if entry.model.digest() == start_model.digest() => entry.model,
        Err(_) if !model.name.is_empty() => hub.catalog.insert(&info.model, start_model)?.model,
        _ => start_model,
    };
    let spare = |model: &Arc<Model>, settings| -> Result<Spare> {
        let settings = settings::settings(settings, model, &hub.limits).map_err(sentence)?;
        Ok(Spare::new(Arc::clone(model), settings)?)
    };
    let start = Snapshot::from_bytes(&record.start_snapshot)?;
    let start = spare(&start_model, start_settings)?.restore(&start)?;
    let is_changed = in_force.digest() != start_model.digest();
    let in_force = if is_changed { in_force } else { start_model };
    let present = spare(&in_force, info.settings)?;
    let present = if record.faults.iter().any(is_change) {
        // The snapshot may be of a changed plant: until that is there, the plant rests nearby.
        let nearby = || start::initial_configuration(&in_force);
        let q = info.state.as_ref().map_or_else(nearby, |state| state.q.clone());
        present.start(&Initial::Projection { q, hold: Vec::new() })?
    } else {
        present.restore(&snapshot.plant)?
    };
    let accuracy = info.accuracy.map(settings::accuracy_of);
    let expires = settings::expires(info.expires_s).map_err(sentence)?;
    let session =
        hub.insert(id.to_owned(), info.model, start, accuracy, expires).map_err(sentence)?;
    let changed = info.parameters.into_iter().map(|p| (p.path, p.value)).collect();
    session.resume(present, changed);
    let warn = |what: &str, fault: RpcError| {
        tracing::warn!(plant = id, error = %sentence(fault), "{what}");
    };
    if let Some(channels) = channels
        && let Err(fault) = session.set_channels(channels, &hub.limits)
    {
        warn("its channels are not restored", fault);
        snapshot.channels = None;
    }
    resume_feedback(hub, &session, feedback, info.feedback).await;
    let v1::SafetyInfo { watchdogs, on_step_failure, frozen } = info.safety.unwrap_or_default();
    if let Err(fault) = protect(&session, watchdogs, on_step_failure) {
        warn("its watchdogs are not restored", fault);
    }
    if let Err(fault) = session.resume_faults(record.faults, record.fault_count, &hub.limits) {
        warn("its faults are not restored", fault);
        snapshot.channels = None;
    }
    if let Err(error) = session.restore(snapshot) {
        hub.delete(id).await.map_err(sentence)?;
        return Err(error.into());
    }
    if info.link_open
        && let Err(fault) = hub.open_link(Arc::clone(&session)).await
    {
        tracing::warn!(plant = id, error = %sentence(fault), "shared-memory link not opened");
    }
    if let Some(info) = info.run
        && let Err(fault) = resume_run(hub, &session, info)
    {
        tracing::warn!(plant = id, error = %sentence(fault), "the plant does not run by itself");
    }
    if let Some(trip) = frozen {
        session.resume_frozen(trip);
    }
    Ok(session)
}

/// Lets a plant run that ran by itself; one that was paused stands still in lockstep.
fn resume_run(hub: &Hub, session: &Arc<Session>, info: v1::RunInfo) -> Result<(), RpcError> {
    if !info.running {
        session.pause();
        return Ok(());
    }
    let id = session.id().to_owned();
    run(hub, v1::RunRequest { id, settings: info.settings, steps: info.steps_left, wait: false })?;
    Ok(())
}

/// Puts the feedback in force that the plant had. Without it the plant is still worth having.
async fn resume_feedback(
    hub: &Arc<Hub>,
    session: &Arc<Session>,
    request: Option<v1::SetFeedbackRequest>,
    info: Option<v1::FeedbackInfo>,
) {
    let Some(info) = info else { return };
    let id = session.id();
    let Some(request) = request else {
        tracing::warn!(plant = id, "its feedback is not restored: the time step has changed");
        return;
    };
    let request = v1::SetFeedbackRequest { id: id.to_owned(), ..request };
    match set_feedback(hub, request).await {
        Ok(_) => {
            if let Some(step) = info.tripped_at_step {
                session.resume_trip(step, &info.tripped_by);
            }
        }
        Err(fault) => {
            tracing::warn!(plant = id, error = %sentence(fault), "its feedback is not restored");
        }
    }
}

fn is_change(saved: &v1::SavedFault) -> bool {
    let kind = saved.fault.as_ref().and_then(|fault| fault.kind.as_ref());
    matches!(kind, Some(v1::fault_spec::Kind::Parameters(_)))
}

fn scene(hub: &Hub, model: &v1::Model) -> Result<Model> {
    let format = v1::SceneFormat::Toml.into();
    Ok(compile(&model.scene_toml, format, &HashMap::new(), &hub.limits).map_err(sentence)??.0)
}

fn decode(bytes: &[u8]) -> Result<v1::PlantRecord> {
    let (body, found) = bytes.split_last_chunk().context("it is cut short")?;
    if hash(body).to_le_bytes() != *found {
        bail!("it is damaged: its hash does not match");
    }
    Ok(v1::PlantRecord::decode(body)?)
}

fn sentence(fault: RpcError) -> anyhow::Error {
    anyhow::anyhow!("{}", tonic::Status::from(fault).message())
}
