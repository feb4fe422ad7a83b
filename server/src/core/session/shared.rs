//! A session: a plant with everything that belongs to it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, mpsc};

use plantd_models::{
    Initial, InitialError, Model, Plant, Settings, Snapshot, SnapshotError, Spare, State,
};
use tokio::sync::watch;
use tokio_util::sync::WaitForCancellationFutureOwned;

use crate::core::channels::pipeline::ChannelMemory;
use crate::core::feedback::active::InForce;
use crate::core::limits::LimitExceeded;
use crate::core::metrics::registry::Metrics;
use crate::core::mutex::lock;
use crate::core::plant::closing::Closing;
use crate::core::plant::core::Core;
use crate::core::plant::event::Events;
use crate::core::plant::leases::Leases;
use crate::core::plant::mark::MarkReason;
use crate::core::plant::view::{Mechanics, PlantSnapshot, View};
use crate::core::plant::watchdog::Safety;
use crate::core::publish::feed::Feed;
use crate::core::publish::frame::{Frame, record_words};
use crate::core::publish::ring::{RING_RECORDS, Ring};
use crate::core::publish::subscription::Subscription;
use crate::core::realtime::loops::RealTime;
use crate::core::session::creation::{Accuracy, Creation, Origin};
use crate::core::session::life::{Kept, Life};
use crate::core::session::place::Place;
use crate::core::session::run::RunControl;
use crate::core::tenant::Tenant;

/// A plant with everything that belongs to it, shared by all who use it.
pub struct Session {
    pub(super) creation: Creation,
    life: Arc<Life>,
    kept: Mutex<Option<Kept>>,
    pub(super) place: Mutex<Place>,
    /// Held by whoever replaces the plant; taken before the core's lock.
    replacing: Mutex<()>,
    pub(super) run: RunControl,
    pub(super) leases: Arc<Leases>,
    pub(super) gains: Gains,
    link: LinkState,
    pub(super) closing: Arc<Closing>,
    pub(super) feed: Arc<Feed>,
    events: Arc<Events>,
    pub(super) metrics: Arc<Metrics>,
    pub(super) realtime: Arc<RealTime>,
}

/// The feedback's law for those who watch gains.
pub(super) struct Gains {
    pub(super) in_force: watch::Sender<Option<InForce>>,
    /// A task computes the law anew.
    pub(super) is_recomputing: AtomicBool,
}

/// The plant's shared-memory link.
#[derive(Default)]
struct LinkState {
    is_open: AtomicBool,
    was_opened: AtomicBool,
}

impl Session {
    /// A session around a plant in its initial state, to which a reset returns.
    pub fn new(
        origin: Origin,
        plant: Plant,
        metrics: Arc<Metrics>,
        realtime: Arc<RealTime>,
    ) -> Arc<Self> {
        let events = Arc::new(Events::default());
        let in_force = watch::Sender::new(None);
        Arc::new(Self {
            life: Arc::new(Life::new(origin.expires)),
            kept: Mutex::default(),
            creation: Creation::of(&plant, origin),
            place: Mutex::new(Place::Rest(Box::new(Core::new(plant, Arc::clone(&events))))),
            replacing: Mutex::default(),
            run: RunControl::default(),
            leases: Arc::default(),
            gains: Gains { in_force, is_recomputing: AtomicBool::new(false) },
            link: LinkState::default(),
            closing: Arc::default(),
            feed: Arc::default(),
            events,
            metrics,
            realtime,
        })
    }

    /// Id of the plant.
    pub fn id(&self) -> &str {
        &self.creation.id
    }

    /// Whose the plant is.
    pub fn owner(&self) -> Tenant {
        self.creation.owner.tenant
    }

    /// Name of the model at the time of creation.
    pub fn model_name(&self) -> &str {
        &self.creation.model_name
    }

    /// The model at the time of creation. [`Session::mechanics`] has the one in force, with the same
    /// names and sizes.
    pub fn model(&self) -> &Arc<Model> {
        &self.creation.model
    }

    /// What the file holds in which it survives its server; held by whoever writes or removes the file.
    pub fn kept(&self) -> MutexGuard<'_, Option<Kept>> {
        lock(&self.kept)
    }

    /// How long it lives when nobody uses it.
    pub fn life(&self) -> &Arc<Life> {
        &self.life
    }

    /// Nobody has used it for as long as it is to be kept.
    pub fn is_expired(&self) -> bool {
        if self.life.expires().is_none() {
            return false;
        }
        if self.driver().is_some() || self.feed.watchers.count() > 0 {
            self.life.touch();
        }
        self.life.is_over()
    }

    /// About how many instructions a step of order 2 takes.
    pub fn step_instructions(&self) -> f64 {
        self.creation.step_instructions
    }

    /// What was promised when the method was chosen by a tolerance.
    pub fn accuracy(&self) -> Option<Accuracy> {
        self.creation.accuracy
    }

    /// The settings at the time of creation.
    pub(crate) fn start_settings(&self) -> Settings {
        self.creation.settings
    }

    /// The state at the time of creation, to which a reset returns.
    pub(crate) fn start(&self) -> &Snapshot {
        &self.creation.snapshot
    }

    /// The model and the settings in force.
    pub fn mechanics(&self) -> Mechanics {
        self.with_core(|core| core.mechanics())
    }

    /// Metrics of the server.
    pub fn metrics(&self) -> &Arc<Metrics> {
        &self.metrics
    }

    /// The state as it is.
    pub fn state(&self) -> State {
        self.with_core(|core| core.plant.state())
    }

    /// The plant as it is.
    pub fn view(&self) -> View {
        self.with_core(|core| core.view())
    }

    /// The plant as it is, and a copy of it to compute on.
    pub fn view_and_copy(&self) -> (View, Plant) {
        self.with_core(|core| (core.view(), core.plant.clone()))
    }

    /// The last step.
    pub fn frame(&self) -> Frame {
        self.with_core(|core| core.frame())
    }

    /// The present step.
    pub fn step_index(&self) -> u64 {
        self.with_core(|core| core.plant.step_index())
    }

    /// A snapshot of the plant as it is.
    pub fn snapshot(&self) -> PlantSnapshot {
        self.with_core(|core| core.snapshot())
    }

    /// A copy of the plant as it is, to compute on.
    pub fn copy_plant(&self) -> Plant {
        self.with_core(|core| core.plant.clone())
    }

    /// Copies of all plants that can be in force; the first is the one without changes that faults make.
    pub(crate) fn copy_plants(&self) -> Vec<Spare> {
        self.with_core(|core| core.copy_plants())
    }

    /// A copy of the plant, and the number of changes of its parameters so far.
    pub fn copy_plant_and_generation(&self) -> (Plant, u64) {
        self.with_core(|core| (core.plant.clone(), core.changed.generation))
    }

    /// A copy of the plant, and the input of its last step; before the first one, the input that holds it.
    pub fn copy_plant_and_input(&self) -> (Plant, Vec<f64>) {
        self.with_core(|core| (core.plant.clone(), core.last.input.clone()))
    }

    /// The shared-memory link is open.
    pub fn link_open(&self) -> bool {
        self.link.is_open.load(Ordering::Acquire)
    }

    /// Whether the next server that has this plant opens its link: it was open with this one. A server
    /// that ends in good order closes its links before it saves the plants.
    pub fn keeps_link(&self) -> bool {
        self.link.was_opened.load(Ordering::Acquire)
    }

    /// Notes whether the shared-memory link is open.
    pub fn set_link_open(&self, open: bool) {
        self.link.was_opened.fetch_or(open, Ordering::AcqRel);
        match (self.link.is_open.swap(open, Ordering::AcqRel), open) {
            (false, true) => self.metrics.link_opened(),
            (true, false) => self.metrics.link_closed(),
            _ => {}
        }
    }

    /// Ends the session: leases and streams of the plant fail from now on. False when it had ended.
    pub fn close(&self) -> bool {
        self.closing.close()
    }

    /// Says where the plant goes on, before it is closed here.
    pub(crate) fn note_move(&self, address: String) {
        self.closing.note_move(address);
    }

    /// Address of the server on which a plant goes on that was closed here.
    pub fn moved_to(&self) -> Option<&str> {
        self.closing.moved_to()
    }

    /// The plant was deleted.
    pub fn is_closed(&self) -> bool {
        self.closing.is_closed()
    }

    /// Completes when the plant is deleted.
    pub fn closed(&self) -> WaitForCancellationFutureOwned {
        self.closing.closed()
    }

    /// Subscribes to every `every`-th state. Starts with the state as it is, if its step counts.
    pub fn subscribe(
        self: &Arc<Self>,
        every: u64,
        queue: usize,
        watchers_max: u64,
    ) -> Result<Subscription, LimitExceeded> {
        let (feed, metrics) = (Arc::clone(&self.feed), Arc::clone(&self.metrics));
        let frames = vec![self.frame(); queue];
        // In the core's hands no step falls between the registration and the first frame.
        let subscribed = self.with_core(move |core| {
            let from = core.records.written();
            let subscription = Subscription::new(feed, metrics, every, from, frames, watchers_max)?;
            subscription.offer(&core.published());
            Ok(subscription)
        });
        self.realtime.ring_pump();
        subscribed
    }

    /// Takes the lease away from the driver, who is told so when it acts next.
    pub(crate) fn revoke_driver(&self) {
        let lease = self.leases.input();
        if lease != 0 {
            self.leases.revoke(lease);
            self.tell_run_status();
        }
    }

    /// Does something with the core, between two steps: keep it short. Waits for a step in progress. Not
    /// from within itself.
    pub fn with_core<R: Send + 'static>(
        &self,
        mut act: impl FnOnce(&mut Core) -> R + Send + 'static,
    ) -> R {
        loop {
            let (key, handle) = match &mut *lock(&self.place) {
                Place::Rest(core) => return act(core),
                Place::Running { key, handle, .. } => (*key, handle.clone()),
            };
            // The channel is of one type for all results: it is much code, which would be compiled for each.
            let (done, is_done) = mpsc::sync_channel(1);
            let outcome = Arc::new(Mutex::new(None));
            let place = Arc::clone(&outcome);
            let in_loop = move |core: Option<&mut Core>| {
                *lock(&place) = Some(match core {
                    Some(core) => Ok(act(core)),
                    None => Err(act),
                });
                // The receiver waits for it.
                let _ = done.send(());
            };
            handle.act(key, Box::new(in_loop));
            let _ = is_done.recv();
            let outcome = lock(&outcome).take();
            match outcome.expect("a loop does what it is told") {
                Ok(outcome) => return outcome,
                // The loop has put it back since.
                Err(back) => act = back,
            }
        }
    }

    /// Does something with the core, without waiting for a plant that runs.
    pub(super) fn post(self: &Arc<Self>, act: impl FnOnce(&mut Core) + Send + 'static) {
        let (key, handle) = match &mut *lock(&self.place) {
            Place::Rest(core) => return act(core),
            Place::Running { key, handle, .. } => (*key, handle.clone()),
        };
        let session = Arc::clone(self);
        let in_loop = move |core: Option<&mut Core>| match core {
            Some(core) => act(core),
            None => session.post(act),
        };
        handle.act(key, Box::new(in_loop));
    }

    /// Held by whoever replaces the plant or what belongs to its steps.
    pub(crate) fn replacing(&self) -> MutexGuard<'_, ()> {
        lock(&self.replacing)
    }

    /// Replaces the plant by a copy of it that was put into another state, which comes back. The caller
    /// holds `replacing`.
    pub(super) fn replace_plant(
        self: &Arc<Self>,
        plant: Plant,
        memory: Option<ChannelMemory>,
    ) -> Frame {
        let session = Arc::clone(self);
        // The former plant is dropped here, not in the core's hands.
        let (put, _former) = self.with_core(move |core| {
            let former = core.replace_plant(plant, memory.as_ref());
            core.mark(MarkReason::Reset);
            if core.own_loop.has_core {
                // The way that the steps take, so that watchers learn of it in order.
                core.write_ring();
            } else {
                session.publish(core);
            }
            (core.frame(), (former, memory))
        });
        put
    }

    /// Puts the plant into the state of a snapshot: one of the same parameters, time step, channels and faults.
    /// The caller holds the lease.
    pub(crate) fn restore(
        self: &Arc<Self>,
        snapshot: PlantSnapshot,
    ) -> Result<Frame, SnapshotError> {
        let _replacing = lock(&self.replacing);
        let plant = self.plant_of(&snapshot.plant)?;
        let memory = snapshot.channels;
        let (checked, memory) = self.with_core(move |core| {
            (memory.as_ref().map_or(Ok(()), |memory| core.check(memory)), memory)
        });
        checked.map_err(SnapshotError::Mismatch)?;
        Ok(self.replace_plant(plant, memory))
    }

    /// Tells watchers of a core at rest.
    pub(super) fn publish(&self, core: &mut Core) {
        if self.feed.watchers.count() > 0 {
            self.feed.publish(&core.published());
        }
    }

    /// The events of the plant.
    pub fn events(&self) -> &Arc<Events> {
        &self.events
    }

    /// Sets what protects the plant.
    pub fn set_safety(&self, safety: Safety) -> Result<(), InitialError> {
        let _replacing = lock(&self.replacing);
        let home = if safety.resets() { Some(Box::new(self.plant_at_start()?)) } else { None };
        // The former guard is dropped here, not in the core's hands.
        drop(self.with_core(move |core| core.protect(safety, home)));
        Ok(())
    }

    /// A copy of the plant, put back into the state in which the session began; changed parameters stay.
    pub(super) fn plant_at_start(&self) -> Result<Plant, InitialError> {
        if let Ok(plant) = self.plant_of(&self.creation.snapshot) {
            return Ok(plant);
        }
        // Of other parameters or another time step: what can be kept is x.
        let State { step, q, p, v, .. } = self.creation.state.clone();
        let spare = self.copy_plants().swap_remove(0);
        let mut plant = spare.start(&Initial::Momentum { q, p, v })?;
        plant.set_step_index(step);
        Ok(plant)
    }

    /// The plant of a snapshot, among those that can be in force. The error is that of the first.
    fn plant_of(&self, snapshot: &Snapshot) -> Result<Plant, SnapshotError> {
        let mut plants = self.copy_plants().into_iter().map(|spare| spare.restore(snapshot));
        let first = plants.next().unwrap_or(Err(SnapshotError::Mismatch("model")));
        first.or_else(|error| plants.find_map(Result::ok).ok_or(error))
    }

    /// The ring into which each step is written; made at the first call.
    pub fn ring(&self) -> Arc<Ring> {
        let ring =
            Arc::new(Ring::new(RING_RECORDS, record_words(self.creation.model.dimensions())));
        self.with_core(move |core| core.records.ring_or(ring))
    }
}
