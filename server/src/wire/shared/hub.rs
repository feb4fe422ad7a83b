//! What the services share: models, plants, workers, limits, metrics and the shared-memory links.

use std::collections::BTreeMap;
use std::collections::hash_map::RandomState;
use std::hash::{BuildHasher, Hasher};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Duration;

use futures::{StreamExt, future, stream};
use plantd_models::Plant;
use plantd_models::scene::UnknownName;
use plantd_proto::v1;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_util::sync::CancellationToken;
use tonic::Code;

use crate::core::catalog::Catalog;
use crate::core::connection::{Caller, Connection};
use crate::core::identity::{Drain, Identity, Moved};
use crate::core::limits::{LimitExceeded, Limits};
use crate::core::metrics::registry::Metrics;
use crate::core::plant::view::View;
use crate::core::priority::Priority;
use crate::core::realtime::loops::RealTime;
use crate::core::realtime::settings::RealTimeSettings;
use crate::core::room::{Reservation, Room};
use crate::core::session::creation::{Accuracy, Origin, Owner};
use crate::core::session::shared::Session;
use crate::core::tenant::{Tenant, TenantSettings, Tenants};
use crate::core::workers::pool::Workers;
use crate::wire::answers::Answers;
use crate::wire::link::host::{LinkError, LinkHost, LinkInfo};
use crate::wire::message::plant_info::plant_info;
use crate::wire::record::directory::Recordings;
use crate::wire::shared::jobs::Jobs;
use crate::wire::shared::state::State;
use crate::wire::shared::state::store::Shared;
use crate::wire::status::RpcError;

/// Ids with which an unknown one is compared, at most.
const COMPARED_PLANTS_MAX: usize = 1000;

/// Looks for a plant by its id: it is here now, or the error says where it is. Waits for a store.
pub type Find = Box<dyn Fn(&str) -> Option<Result<Arc<Session>, RpcError>> + Send + Sync>;

/// Everything that belongs to one server.
pub struct Hub {
    /// Limits in force.
    pub limits: Limits,
    /// Metrics.
    pub metrics: Arc<Metrics>,
    /// Workers for long computations, at low priority.
    pub workers: Jobs,
    /// Workers for what belongs to the running of plants, at the usual priority: long computations do
    /// not keep it waiting.
    pub attendants: Jobs,
    /// Workers for steps in lockstep that take long, alone or together: the attendants stay free for
    /// others.
    pub steppers: Jobs,
    /// Whose things are, and how much each may have.
    pub tenants: Arc<Tenants>,
    /// Models.
    pub catalog: Catalog,
    /// Permits to hold a trajectory's regulator, filter or optimisation in memory.
    pub trajectory_solves: Arc<Semaphore>,
    /// Which server this is.
    pub identity: Identity,
    /// Its end, once it is decided.
    pub drain: Drain,
    /// Plants that have gone to other servers.
    pub moved: Moved,
    /// Cancelled when the server begins to shut down: streams end.
    pub ending: CancellationToken,
    /// Threads of one search.
    pub search_threads: usize,
    /// Recordings of plants.
    pub recordings: Option<Recordings>,
    /// Where plants survive the server.
    pub state: Option<State>,
    /// Looks elsewhere for plants that are not here, where servers share a store.
    pub find: OnceLock<Find>,
    realtime: Arc<RealTime>,
    links: Option<Arc<LinkHost>>,
    plants: Mutex<BTreeMap<String, Arc<Session>>>,
}

impl Hub {
    /// A hub without plants. Tenants are kept apart where there are settings of theirs.
    pub fn new(
        name: String,
        limits: Limits,
        worker_count: usize,
        priority: Priority,
        realtime: RealTimeSettings,
        links: Option<LinkHost>,
        tenants: Option<BTreeMap<String, TenantSettings>>,
    ) -> Self {
        let feedback_room = Room::new(
            "feedback_numbers",
            "numbers in the feedbacks of all plants",
            limits.feedback_numbers,
        );
        let watch_room = Room::new(
            "watch_numbers",
            "numbers in the queues of all watchers",
            limits.watch_numbers,
        );
        let are_apart = tenants.is_some();
        let tenants = tenants.unwrap_or_default();
        let tenants = Arc::new(Tenants::new(are_apart, tenants, &watch_room, &feedback_room));
        let metrics = Arc::new(Metrics::new(Arc::clone(&tenants), &name));
        let realtime = RealTime::new(realtime, &metrics);
        let pool = |name, priority| {
            let (limit, tenants) = (limits.queued_jobs, Arc::clone(&tenants));
            Jobs::new(Workers::new(name, worker_count, limit, priority, tenants))
        };
        Self {
            workers: pool("worker", priority),
            attendants: pool("attendant", Priority::Normal),
            steppers: pool("stepper", Priority::Normal),
            catalog: Catalog::new(&limits, metrics.models.clone(), Arc::clone(&tenants)),
            tenants,
            trajectory_solves: Arc::new(Semaphore::new(Limits::size(limits.trajectory_solves))),
            identity: Identity::new(name),
            drain: Drain::default(),
            moved: Moved::default(),
            ending: CancellationToken::new(),
            search_threads: 1,
            recordings: None,
            state: None,
            find: OnceLock::new(),
            realtime,
            links: links.map(Arc::new),
            plants: Mutex::default(),
            limits,
            metrics,
        }
    }

    /// The store that other servers have too, if there is one.
    pub fn shared_store(&self) -> Option<&dyn Shared> {
        self.state.as_ref().and_then(State::shared)
    }

    /// The plant of that id, if it is there for the caller.
    pub fn session(&self, id: &str) -> Result<Arc<Session>, RpcError> {
        Caller::note(id);
        if let Some(session) = self.present(id) {
            session.life().touch();
            return Ok(session);
        }
        let moved = self.moved.address(id);
        if let Some((_, address)) = moved.filter(|(owner, _)| self.tenants.shows(*owner)) {
            return Err(RpcError::plant_elsewhere(id, &address));
        }
        if let Some(found) = self.find.get().and_then(|find| find(id)) {
            return found;
        }
        let plants = self.plants();
        let is_known = |session: &Session| !session.is_closed() && self.shows(session);
        let known = plants.iter().filter(|(_, session)| is_known(session));
        let known = known.map(|(id, _)| id).take(COMPARED_PLANTS_MAX);
        Err(RpcError::plant_not_found(&UnknownName::among(id, known)))
    }

    /// The same, if it is on this server.
    pub fn present(&self, id: &str) -> Option<Arc<Session>> {
        let plants = self.plants();
        let found = plants.get(id);
        found.filter(|session| !session.is_closed() && self.shows(session)).map(Arc::clone)
    }

    /// Refuses a change by somebody who may only look, in a call that changes nothing otherwise.
    pub fn check_may_drive(&self) -> Result<(), RpcError> {
        match self.tenants.may_drive() {
            true => Ok(()),
            false => Err(RpcError::new(
                Code::PermissionDenied,
                "ROLE",
                "to look is all that the role `viewer` may do; this needs `driver`",
            )),
        }
    }

    /// It is there for the caller.
    fn shows(&self, session: &Session) -> bool {
        self.tenants.shows(session.owner())
    }

    /// A plant as a message. Waits for a step in progress, which is long on a large model: call it on a
    /// worker unless you hold the lease.
    pub fn plant_info(&self, session: &Session) -> v1::PlantInfo {
        self.info(session, session.view())
    }

    /// The same, of a view that was taken before.
    pub(crate) fn info(&self, session: &Session, view: View) -> v1::PlantInfo {
        let (server, address) = (self.identity.name(), self.identity.address());
        let (server, address) = (server.to_owned(), address.to_owned());
        v1::PlantInfo { server, address, ..plant_info(session, view) }
    }

    /// Plants of the caller.
    pub fn count(&self) -> usize {
        let plants = self.plants();
        plants.values().filter(|session| !session.is_closed() && self.shows(session)).count()
    }

    /// Plants that somebody drives.
    pub fn driven(&self) -> usize {
        self.plants().values().filter(|session| session.driver().is_some()).count()
    }

    /// Refuses what is new where the server is about to end.
    pub fn check_takes_new(&self) -> Result<(), RpcError> {
        match self.drain.has_begun() {
            true => Err(RpcError::draining(self.identity.name())),
            false => Ok(()),
        }
    }

    /// Refuses a new plant that would not be kept, before work is done for it.
    pub fn check_new_plant(&self, id: &str) -> Result<(), RpcError> {
        self.check_takes_new()?;
        self.admit(&self.plants(), id)
    }

    fn admit(&self, plants: &BTreeMap<String, Arc<Session>>, id: &str) -> Result<(), RpcError> {
        if plants.contains_key(id) {
            return Err(RpcError::plant_exists(id));
        }
        Ok(LimitExceeded::check("plants", self.limits.plants, "plants", plants.len() + 1)?)
    }

    /// Keeps a plant under an id; an empty one means that the server chooses.
    pub fn insert(
        &self,
        id: String,
        model_name: String,
        plant: Plant,
        accuracy: Option<Accuracy>,
        expires: Option<Duration>,
    ) -> Result<Arc<Session>, RpcError> {
        let account = self.tenants.current();
        let owner = Owner {
            tenant: account.tenant,
            room: Some(account.rooms.plants.reserve(1)?),
            running: Some(Arc::clone(&account.rooms.running_plants)),
            overruns: Arc::clone(&account.counts.overruns),
        };
        let mut plants = self.plants();
        let id = if id.is_empty() { free_id(&plants) } else { id };
        Caller::note(&id);
        self.admit(&plants, &id)?;
        let metrics = Arc::clone(&self.metrics);
        let realtime = Arc::clone(&self.realtime);
        let origin = Origin { id: id.clone(), model_name, accuracy, expires, owner };
        let session = Session::new(origin, plant, metrics, realtime);
        self.moved.forget(&id);
        plants.insert(id, Arc::clone(&session));
        self.metrics.set_plants(plants.len());
        Ok(session)
    }

    /// A plant that nobody but the caller knows, counted in metrics of its own.
    pub fn apart(&self, model: &str, plant: Plant, metrics: Arc<Metrics>) -> Arc<Session> {
        Session::new(Origin::new("case", model), plant, metrics, Arc::clone(&self.realtime))
    }

    /// Ends a plant. Its id is free again when everything that belonged to it is gone.
    pub async fn delete(self: &Arc<Self>, id: &str) -> Result<(), RpcError> {
        let session = self.session(id)?;
        if !session.close() {
            return Err(RpcError::closed(&session));
        }
        self.clear_away(session).await
    }

    /// Removes a plant that was closed, with what belongs to it.
    pub async fn clear_away(self: &Arc<Self>, session: Arc<Session>) -> Result<(), RpcError> {
        let hub = Arc::clone(self);
        // In a task of its own, so that it is finished even if the caller goes away.
        let end = tokio::task::spawn_blocking(move || {
            if let Some(links) = &hub.links {
                links.close(session.id());
            }
            session.pause();
            if let Some(state) = &hub.state {
                state.remove(&session);
            }
            let mut plants = hub.plants();
            plants.remove(session.id());
            if let Some(address) = session.moved_to() {
                hub.moved.note(session.owner(), session.id(), address);
            }
            hub.metrics.set_plants(plants.len());
        });
        end.await.map_err(|error| RpcError::internal(error.to_string()))
    }

    /// Ends the plants that nobody has used for as long as they are to be kept.
    pub async fn delete_expired(self: &Arc<Self>) {
        let is_expired = |(_, session): &(&String, &Arc<Session>)| session.is_expired();
        let expired: Vec<String> =
            self.plants().iter().filter(is_expired).map(|(id, _)| id.clone()).collect();
        for id in expired {
            // Whoever has deleted it meanwhile has done what was to be done.
            if Connection::server(Tenant::NONE).work(self.delete(&id)).await.is_ok() {
                tracing::info!(plant = id, "plant deleted: nobody has used it");
            }
        }
    }

    /// Up to `size` plants after the one with id `after`, and whether there are more.
    pub fn page(&self, after: &str, size: usize) -> (Vec<Arc<Session>>, bool) {
        let plants = self.plants();
        let mut rest = plants
            .iter()
            .filter(|(id, session)| {
                id.as_str() > after && !session.is_closed() && self.shows(session)
            })
            .map(|(_, session)| Arc::clone(session));
        let page = rest.by_ref().take(size).collect();
        let has_more = rest.next().is_some();
        (page, has_more)
    }

    /// Opens the shared-memory link of a plant.
    pub async fn open_link(&self, session: Arc<Session>) -> Result<LinkInfo, RpcError> {
        let Some(links) = self.links.clone() else {
            return Err(RpcError::precondition(
                "LINK_DISABLED",
                "server",
                "this server runs without shared-memory links",
            ));
        };
        let host = Arc::clone(&session);
        let opened = tokio::task::spawn_blocking(move || links.open(host))
            .await
            .map_err(|error| RpcError::internal(error.to_string()))?;
        opened.map_err(|error| match error {
            LinkError::Closing { .. } => RpcError::closed(&session),
            LinkError::Domain(_) | LinkError::Thread(_) | LinkError::Failed { .. } => {
                RpcError::new(Code::Unavailable, "LINK_FAILED", error.to_string())
            }
        })
    }

    /// Room in memory for one more trajectory's regulator, filter or optimisation.
    pub fn trajectory_permit(&self) -> Result<TrajectoryPermit, RpcError> {
        self.check_takes_new()?;
        let own = self.tenants.take(|rooms| &rooms.trajectory_solves)?;
        let (name, limit) = ("trajectory_solves", self.limits.trajectory_solves);
        let (what, actual) = ("regulators, filters and optimisations at a time", limit + 1);
        let of_all = Arc::clone(&self.trajectory_solves).try_acquire_owned();
        let of_all = of_all.map_err(|_| LimitExceeded { name, limit, what, actual })?;
        let room = Arc::clone(&self.tenants.current().rooms.trajectory_numbers);
        Ok(TrajectoryPermit { _of_all: of_all, _own: own, room, held: None })
    }

    /// A stream that ends, unfinished, when the server begins to shut down.
    pub fn until_ending<T: Send + 'static>(&self, answers: Answers<T>) -> Answers<T> {
        let ending = self.ending.clone().cancelled_owned();
        let farewell = stream::once(async { Err(RpcError::shutting_down().into()) });
        // `Some(None)` marks the end that came by itself.
        let ended_by_itself = answers.map(Some).chain(stream::once(async { None }));
        let interruptible = ended_by_itself.take_until(ending).chain(farewell.map(Some));
        Box::pin(
            interruptible
                .take_while(|item| future::ready(item.is_some()))
                .filter_map(future::ready),
        )
    }

    /// Ends all streams, plants and links. Blocks for a fraction of a second.
    pub fn shut_down(&self) {
        self.ending.cancel();
        if let Some(links) = &self.links {
            links.shutdown();
        }
        if let Some(recordings) = &self.recordings {
            recordings.stop_all();
        }
        let plants: Vec<Arc<Session>> = self.plants().values().cloned().collect();
        if let Some(state) = &self.state {
            state.note_running(&plants);
        }
        plants.iter().for_each(|session| session.pause());
    }

    fn plants(&self) -> MutexGuard<'_, BTreeMap<String, Arc<Session>>> {
        self.plants.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Room for a trajectory's regulator, filter or optimisation, of the server and of the tenant.
#[derive(Debug)]
pub struct TrajectoryPermit {
    _of_all: OwnedSemaphorePermit,
    _own: Reservation,
    /// The tenant's room for numbers.
    room: Arc<Room>,
    held: Option<Reservation>,
}

impl TrajectoryPermit {
    /// Takes room for so many numbers, until the permit ends.
    pub(crate) fn hold(&mut self, numbers: usize) -> Result<(), LimitExceeded> {
        self.held = Some(self.room.reserve(numbers)?);
        Ok(())
    }
}

/// An id that no plant has. Random, so that ids differ between runs of a server.
fn free_id(plants: &BTreeMap<String, Arc<Session>>) -> String {
    loop {
        let random = RandomState::new().build_hasher().finish();
        let id = format!("plant-{:08x}", random as u32);
        if !plants.contains_key(&id) {
            return id;
        }
    }
}
