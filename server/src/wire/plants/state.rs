//! The plants of a server in a store: saved while they change, made again by the next server, and taken from servers
//! that share the store.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::SystemTime;

use futures::{StreamExt as _, future, stream};
use plantd_models::Model;
use plantd_proto::v1;
use prost::Message as _;
use tokio::runtime::Handle;

use crate::core::channels::noise::hash;
use crate::core::connection::Connection;
use crate::core::mutex::lock;
use crate::core::session::life::Kept;
use crate::core::session::shared::Session;
use crate::core::tenant::Tenant;
use crate::core::workers::pool::Abandoned;
use crate::wire::message::run_info::run_info;
use crate::wire::plants::record::{self, sentence};
use crate::wire::shared::hub::Hub;
use crate::wire::shared::state::store::{Place, Shared, Store, StoreError};
use crate::wire::shared::state::{Changed, State, unsealed};
use crate::wire::status::RpcError;

/// Plants that are read or written side by side.
const SIDE_BY_SIDE: usize = 16;

impl State {
    /// Makes the plants anew that are this server's. What cannot be used is named in the log and left as it is.
    pub async fn load(&self, hub: &Arc<Hub>) -> Result<(), StoreError> {
        let restored = self.store.own()?.into_iter().map(|place| async move {
            let read = read(Arc::clone(&self.store), place.clone()).await;
            match restore(hub, &place, read, record::lossy(&place.id)).await {
                Ok(session) => {
                    let step = session.step_index();
                    tracing::info!(plant = place.id, step, "plant restored");
                }
                Err(NotRestored::Gone) => {}
                Err(NotRestored::Broken(fault)) => {
                    let error = sentence(fault);
                    let path = self.store.location(&place);
                    tracing::error!(path, error, "plant not restored");
                    self.note_broken(&place.id);
                }
            }
        });
        stream::iter(restored).buffer_unordered(SIDE_BY_SIDE).for_each(future::ready).await;
        Ok(())
    }

    /// Saves all plants that have changed since they were saved.
    pub fn save(&self, hub: &Arc<Hub>) {
        let _saving = lock(&self.saving);
        if Connection::server(Tenant::NONE).scope(|| self.save_all(hub)) {
            hub.metrics.state_saved(SystemTime::now());
        }
    }

    /// True when all have been written.
    fn save_all(&self, hub: &Arc<Hub>) -> bool {
        let (mut after, mut are_written) = (String::new(), true);
        loop {
            let (sessions, has_more) = hub.page(&after, 100);
            let Some(last) = sessions.last() else { return are_written };
            after = last.id().to_owned();
            // Where servers share a store a new plant is first written by who makes it, who is told if it is another's.
            let is_claimed =
                |each: &&Arc<Session>| self.shared().is_none() || each.kept().is_some();
            let claimed = sessions.iter().filter(is_claimed);
            let changed = claimed.filter_map(|each| self.changed(hub, each)).collect();
            are_written &= self.save_changed(hub, changed);
            if !has_more {
                return are_written;
            }
        }
    }

    /// Writes plants side by side: each waits for the store, which serves many as fast as one. True when all have been
    /// written.
    fn save_changed(&self, hub: &Arc<Hub>, changed: Vec<Changed>) -> bool {
        let are_written = AtomicBool::new(true);
        self.left.store(changed.len(), Ordering::Relaxed);
        let lost = Mutex::new(Vec::new());
        let write = |changed: Changed| {
            let session = Arc::clone(&changed.session);
            match self.write(changed, false) {
                Ok(()) => {}
                Err(StoreError::Elsewhere(address)) => lock(&lost).push((session, address)),
                Err(error) => {
                    tracing::error!(plant = session.id(), %error, "plant not saved");
                    are_written.store(false, Ordering::Relaxed);
                }
            }
            self.answers.fetch_add(1, Ordering::Relaxed);
            self.left.fetch_sub(1, Ordering::Relaxed);
        };
        let writers = changed.len().min(SIDE_BY_SIDE);
        let queue = Mutex::new(changed);
        let next = || lock(&queue).pop();
        std::thread::scope(|scope| {
            for _ in 0..writers {
                scope.spawn(|| std::iter::from_fn(next).for_each(write));
            }
        });
        for (session, address) in lost.into_inner().unwrap_or_default() {
            leave(hub, session, address);
        }
        are_written.into_inner()
    }

    /// A plant as a record without its models, and the model in force.
    fn record(&self, session: &Session) -> (v1::PlantRecord, Arc<Model>) {
        let (mut record, model) = session.saved();
        if let Some(plant) = &mut record.plant {
            let mut run = run_info(session);
            if let Some(running) = self.running.get() {
                run.running = running.contains(session.id());
            }
            plant.run = Some(run);
        }
        (record, model)
    }

    /// What is to be written of a plant; nothing if it is as it was saved.
    fn changed(&self, hub: &Hub, session: &Arc<Session>) -> Option<Changed> {
        let (mut record, model) = self.record(session);
        let hash = hash(&record.encode_to_vec());
        let is_kept =
            session.kept().as_ref().is_some_and(|Kept { model: before, hash: of_before }| {
                Arc::ptr_eq(before, &model) && *of_before == hash
            });
        if is_kept && !self.gives_up() {
            return None;
        }
        record::add_models(&mut record, hub, session, &model);
        Some(Changed { session: Arc::clone(session), kept: Kept { model, hash }, record })
    }
}

/// Another server has the plant by now.
fn leave(hub: &Arc<Hub>, session: Arc<Session>, address: String) {
    tracing::warn!(plant = session.id(), address, "another server has taken the plant");
    if !address.is_empty() {
        session.note_move(address);
    }
    if session.close()
        && let Ok(runtime) = Handle::try_current()
    {
        let hub = Arc::clone(hub);
        runtime.spawn(async move { hub.clear_away(session).await });
    }
}

/// Makes a plant that was made here the store's, where servers share one: from now on its id is taken for all of them,
/// and the plant is known to them. One that cannot be is ended.
pub(crate) async fn claim(
    hub: &Arc<Hub>,
    session: &Arc<Session>,
    takes: bool,
) -> Result<(), RpcError> {
    if hub.shared_store().is_none() {
        return Ok(());
    }
    let job = {
        let (hub, session) = (Arc::clone(hub), Arc::clone(session));
        move |_: &Abandoned| {
            let Some(state) = &hub.state else { return Ok(Ok(())) };
            let changed = state.changed(&hub, &session);
            Ok::<_, RpcError>(changed.map_or(Ok(()), |changed| state.write(changed, takes)))
        }
    };
    let id = session.id();
    let refused = match hub.attendants.resume(job).await? {
        Ok(()) => return Ok(()),
        Err(StoreError::Elsewhere(address)) if !address.is_empty() => {
            RpcError::plant_elsewhere(id, &address)
        }
        Err(StoreError::Elsewhere(_) | StoreError::Taken) => RpcError::plant_exists(id),
        Err(error) => RpcError::store_failed(&error),
    };
    if session.close() {
        hub.clear_away(Arc::clone(session)).await?;
    }
    Err(refused)
}

/// Why a plant of the store is not here.
pub(crate) enum NotRestored {
    /// It is not in the store any more, or another server's.
    Gone,
    /// It cannot be used.
    Broken(RpcError),
}

/// The bytes of a plant that is this server's.
async fn read(store: Arc<dyn Store>, place: Place) -> Result<Vec<u8>, StoreError> {
    let read = tokio::task::spawn_blocking(move || store.read(&place)).await;
    read.unwrap_or_else(|error| Err(StoreError::Failed(error.to_string())))
}

/// Makes the plant anew that was read at a place.
pub(crate) async fn restore(
    hub: &Arc<Hub>,
    place: &Place,
    read: Result<Vec<u8>, StoreError>,
    lose: record::Lose,
) -> Result<Arc<Session>, NotRestored> {
    let bytes = match read {
        Ok(bytes) => bytes,
        Err(StoreError::Missing | StoreError::Elsewhere(_)) => return Err(NotRestored::Gone),
        Err(error) => return Err(NotRestored::Broken(record::unusable(error.to_string()))),
    };
    let made = async {
        let record = unsealed(&bytes).map_err(record::unusable)?;
        let found = record.plant.as_ref().map_or("", |plant| plant.id.as_str());
        if found != place.id {
            return Err(record::unusable(format!("the plant in it is `{found}`")));
        }
        record::make(hub, place.id.clone(), record, lose).await
    };
    // What is made is this tenant's.
    let session = Connection::server(place.tenant).work(made).await.map_err(NotRestored::Broken)?;
    let state = hub.state.as_ref();
    // Where others look for it, it is written again once this server knows where it is reached.
    let is_as_written = state.and_then(State::shared).is_none_or(Shared::is_announced);
    let (hash, model) = match state.filter(|_| is_as_written) {
        Some(state) => {
            let (record, model) = state.record(&session);
            (hash(&record.encode_to_vec()), model)
        }
        None => (0, Arc::clone(session.model())),
    };
    *session.kept() = Some(Kept { model, hash });
    Ok(session)
}
