//! A plant session: one plant, its lease, and what it publishes.
//!
//! Only the holder of the lease moves the plant. Others lock the core to copy a state or a plant
//! out of it, which takes microseconds; energies, linearizations and gains are computed on copies.

mod core;
mod feedback;
mod gate;
mod lease;
mod running;
pub(crate) mod tap;

use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, mpsc};

use plantd_models::{
    Initial, InitialError, Model, Plant, Settings, Snapshot, SnapshotError, Spare, State,
};
use tokio::sync::watch;
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};

use crate::core::channels::ChannelMemory;
use crate::core::feedback::{FeedbackInfo, InForce};
use crate::core::frame::{Frame, record_words};
use crate::core::limits::LimitExceeded;
use crate::core::metrics::Metrics;
use crate::core::parameters::Parameters;
use crate::core::realtime::event::Events;
use crate::core::realtime::watchdog::{Safety, Trip};
use crate::core::realtime::{Live, RealTime};
use crate::core::ring::Ring;
use crate::core::watch::{Relay, Subscription, Watchers};

pub use self::core::{Core, Mechanics};
use self::gate::Gate;
pub use self::lease::{DriveError, Lease, LeaseHeld};
use self::running::Place;
pub use self::running::{Run, RunError, RunStatus, StoppedBy};
pub(crate) use self::tap::MarkReason;
pub use crate::core::driver::DriverKind;

/// Records that the ring of a plant keeps: a quarter of a second at 1 kHz.
const RING_RECORDS: usize = 256;

/// Everything that a session's plant needs to go on bit for bit.
#[derive(Clone, Debug, PartialEq)]
pub struct PlantSnapshot {
    /// The plant.
    pub plant: Snapshot,
    /// What is under way in its channels and faults, if it has any.
    pub channels: Option<ChannelMemory>,
}

/// What was promised when the method of a plant was chosen by a tolerance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Accuracy {
    /// The tolerance.
    pub tolerance: f64,
    /// The error that was estimated.
    pub error: f64,
    /// Over how many periods.
    pub periods: u32,
}

/// A plant as it is, to be shown.
pub struct View {
    /// State.
    pub state: State,
    /// Its time, s.
    pub time_s: f64,
    /// Settings in force.
    pub settings: Settings,
    /// Feedback.
    pub feedback: Option<FeedbackInfo>,
    /// Numbers of the scene that were changed.
    pub parameters: Arc<Parameters>,
    /// What protects it.
    pub safety: Safety,
    /// The bound because of which it stands still.
    pub frozen: Option<Trip>,
}

/// A plant with everything that belongs to it, shared by all who use it.
pub struct Session {
    id: String,
    model_name: String,
    /// The model at the time of creation; later ones differ from it in numbers only.
    model: Arc<Model>,
    /// About how many instructions a step of order 2 takes.
    step_instructions: f64,
    pub(crate) start: Snapshot,
    start_state: State,
    pub(crate) start_settings: Settings,
    /// Why the method is as it is, if it was chosen by a tolerance.
    accuracy: Option<Accuracy>,
    place: Mutex<Place>,
    /// How the plant is run; never held while a loop is waited for.
    run: Mutex<Run>,
    /// Held by whoever changes how the plant is run.
    changing_run: Mutex<()>,
    run_status: watch::Sender<RunStatus>,
    /// When the driver of a plant in lockstep may step.
    gate: Gate,
    /// Made when the plant runs by itself for the first time.
    live: OnceLock<Arc<Live>>,
    realtime: Arc<RealTime>,
    events: Arc<Events>,
    /// Counts the leases.
    leases: AtomicU64,
    /// Number of the lease under which inputs come; 0 for none.
    input_lease: AtomicU64,
    /// Number of the last lease that was taken away.
    revoked: AtomicU64,
    /// Number of the lease in force.
    holder: AtomicU64,
    /// The name under which a lease can be taken over, and its number.
    named: Mutex<Option<(String, u64)>>,
    /// Held by whoever replaces the plant; taken before the core's lock.
    replacing: Mutex<()>,
    /// The feedback's law for watchers of gains.
    in_force: watch::Sender<Option<InForce>>,
    /// A task computes the feedback's law anew.
    is_recomputing: AtomicBool,
    driver: AtomicU8,
    link_open: AtomicBool,
    link_was_opened: AtomicBool,
    is_closed: AtomicBool,
    closed: CancellationToken,
    watchers: Watchers,
    /// What brings the steps of the plant's own loop to them.
    relay: Relay,
    metrics: Arc<Metrics>,
}

impl Session {
    /// A session around a plant in its initial state, to which a reset returns.
    pub fn new(
        id: String,
        model_name: String,
        plant: Plant,
        accuracy: Option<Accuracy>,
        metrics: Arc<Metrics>,
        realtime: Arc<RealTime>,
    ) -> Arc<Self> {
        let events = Arc::new(Events::default());
        Arc::new(Self {
            id,
            model_name,
            start: plant.snapshot(),
            start_state: plant.state(),
            start_settings: *plant.settings(),
            accuracy,
            step_instructions: step_instructions(plant.model()),
            model: Arc::clone(plant.model()),
            place: Mutex::new(Place::Rest(Box::new(Core::new(plant, Arc::clone(&events))))),
            run: Mutex::new(Run { is_running: true, ..Run::default() }),
            changing_run: Mutex::default(),
            run_status: watch::Sender::new(RunStatus { is_running: true, ..RunStatus::default() }),
            gate: Gate::default(),
            live: OnceLock::new(),
            realtime,
            events,
            leases: AtomicU64::new(0),
            input_lease: AtomicU64::new(0),
            revoked: AtomicU64::new(0),
            holder: AtomicU64::new(0),
            named: Mutex::default(),
            replacing: Mutex::default(),
            in_force: watch::Sender::new(None),
            is_recomputing: AtomicBool::new(false),
            driver: AtomicU8::new(0),
            link_open: AtomicBool::new(false),
            link_was_opened: AtomicBool::new(false),
            is_closed: AtomicBool::new(false),
            closed: CancellationToken::new(),
            watchers: Watchers::default(),
            relay: Relay::default(),
            metrics,
        })
    }

    /// Id of the plant.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Name of the model at the time of creation.
    pub fn model_name(&self) -> &str {
        &self.model_name
    }

    /// The model at the time of creation. [`Session::mechanics`] has the one in force, with the same
    /// names and sizes.
    pub fn model(&self) -> &Arc<Model> {
        &self.model
    }

    /// About how many instructions a step of order 2 takes.
    pub fn step_instructions(&self) -> f64 {
        self.step_instructions
    }

    /// What was promised when the method was chosen by a tolerance.
    pub fn accuracy(&self) -> Option<Accuracy> {
        self.accuracy
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

    /// The same with a copy of it, to compute on.
    pub fn view_and_copy(&self) -> (View, Plant) {
        self.with_core(|core| (core.view(), core.plant.clone()))
    }

    /// The last step.
    pub fn frame(&self) -> Frame {
        self.with_core(|core| {
            let mut frame = Frame::default();
            frame.copy_from(&core.published());
            frame
        })
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

    /// The same with the number of changes of its parameters so far.
    pub fn copy_plant_and_generation(&self) -> (Plant, u64) {
        self.with_core(|core| (core.plant.clone(), core.generation))
    }

    /// The same with the input of its last step; before the first one, the input that holds it.
    pub fn copy_plant_and_input(&self) -> (Plant, Vec<f64>) {
        self.with_core(|core| (core.plant.clone(), core.input.clone()))
    }

    /// The shared-memory link is open.
    pub fn link_open(&self) -> bool {
        self.link_open.load(Ordering::Acquire)
    }

    /// Whether the next server that has this plant opens its link: it was open with this one. A server
    /// that ends in good order closes its links before it saves the plants.
    pub fn keeps_link(&self) -> bool {
        self.link_was_opened.load(Ordering::Acquire)
    }

    /// Notes whether the shared-memory link is open.
    pub fn set_link_open(&self, open: bool) {
        self.link_was_opened.fetch_or(open, Ordering::AcqRel);
        match (self.link_open.swap(open, Ordering::AcqRel), open) {
            (false, true) => self.metrics.link_opened(),
            (true, false) => self.metrics.link_closed(),
            _ => {}
        }
    }

    /// Ends the session: leases and streams of the plant fail from now on. False when it had ended.
    pub fn close(&self) -> bool {
        let was_open = !self.is_closed.swap(true, Ordering::AcqRel);
        self.closed.cancel();
        was_open
    }

    /// The plant was deleted.
    pub fn is_closed(&self) -> bool {
        self.is_closed.load(Ordering::Acquire)
    }

    /// Completes when the plant is deleted.
    pub fn closed(&self) -> WaitForCancellationFutureOwned {
        self.closed.clone().cancelled_owned()
    }

    /// Subscribes to every `every`-th state. Starts with the state as it is, if its step counts.
    pub fn subscribe(
        self: &Arc<Self>,
        every: u64,
        queue: usize,
        watchers_max: u64,
    ) -> Result<Subscription, LimitExceeded> {
        let session = Arc::clone(self);
        let frames = vec![self.frame(); queue];
        // In the core's hands no step falls between the registration and the first frame.
        let subscribed = self.with_core(move |core| {
            let from = core.records();
            let subscription = Subscription::new(session, every, from, frames, watchers_max)?;
            subscription.offer(&core.published());
            Ok(subscription)
        });
        self.realtime.ring_pump();
        subscribed
    }

    /// The watchers of the plant.
    pub fn watchers(&self) -> &Watchers {
        &self.watchers
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
            let (give, taken) = mpsc::sync_channel(1);
            let in_loop = move |core: Option<&mut Core>| {
                let outcome = match core {
                    Some(core) => Ok(act(core)),
                    None => Err(act),
                };
                // The receiver waits for it.
                let _ = give.send(outcome);
            };
            handle.act(key, Box::new(in_loop));
            match taken.recv().expect("a loop does what it is told") {
                Ok(outcome) => return outcome,
                // The loop has put it back since.
                Err(back) => act = back,
            }
        }
    }

    /// The same without waiting for a plant that runs.
    fn post(self: &Arc<Self>, act: impl FnOnce(&mut Core) + Send + 'static) {
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

    /// Replaces the plant by a copy of it that was put into another state, which comes back with its
    /// time. The caller holds `replacing`.
    fn replace_plant(
        self: &Arc<Self>,
        plant: Plant,
        memory: Option<ChannelMemory>,
    ) -> (State, f64) {
        let session = Arc::clone(self);
        // The former plant is dropped here, not in the core's hands.
        let (put, _former) = self.with_core(move |core| {
            let former = core.replace_plant(plant, memory.as_ref());
            core.mark(MarkReason::Reset);
            if core.is_running {
                // The way that the steps take, so that watchers learn of it in order.
                core.write_ring();
            } else {
                session.publish(core);
            }
            (core.state(), (former, memory))
        });
        put
    }

    /// Puts the plant into the state of a snapshot: one of the same parameters and time step. The caller
    /// holds the lease.
    pub(crate) fn restore(
        self: &Arc<Self>,
        snapshot: PlantSnapshot,
    ) -> Result<(State, f64), SnapshotError> {
        let _replacing = lock(&self.replacing);
        let plant = self.plant_of(&snapshot.plant)?;
        Ok(self.replace_plant(plant, snapshot.channels))
    }

    /// Tells watchers of a core at rest, after what is still on its way to them from the plant's own loop.
    fn publish(&self, core: &Core) {
        if self.watchers.count() == 0 {
            return;
        }
        self.relay.hand_on(&self.watchers);
        self.watchers.publish(&core.published());
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
    fn plant_at_start(&self) -> Result<Plant, InitialError> {
        if let Ok(plant) = self.plant_of(&self.start) {
            return Ok(plant);
        }
        // Of other parameters or another time step: what can be kept is x.
        let State { step, q, p, v, .. } = self.start_state.clone();
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
        let ring = Arc::new(Ring::new(RING_RECORDS, record_words(self.model.dimensions())));
        self.with_core(move |core| core.ring_or(ring))
    }
}

fn step_instructions(model: &Model) -> f64 {
    model.stage_costs().iter().map(|stage| stage.times * stage.instructions).sum()
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // The mechanics does not panic, and leaves the plant as it was when it fails.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
