//! A plant session: one plant, its lease, and what it publishes.
//!
//! Only the holder of the lease moves the plant. Others lock the core to copy a state or a plant
//! out of it, which takes microseconds; energies, linearizations and gains are computed on copies.

mod core;
mod gate;
mod saved;
pub(crate) mod tap;

use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, mpsc};
use std::time::{Duration, Instant};

use plantd_models::{
    Initial, InitialError, Linearization, Model, Plant, Settings, Snapshot, SnapshotError, State,
    StepError, StepReport,
};
use plantd_proto::link::monotonic_ns;
use plantd_proto::v1::{self, MarkReason};
use tokio::sync::watch::{self, Receiver};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};

use crate::feedback::{Feedback, InForce, Law};
use crate::frame::{Frame, record_words};
use crate::limits::{LimitExceeded, Limits};
use crate::metrics::Metrics;
use crate::parameters::{self, ChangeError, Parameters};
use crate::realtime::event::{EventKind, Events};
use crate::realtime::slot::Arrival;
use crate::realtime::watchdog::{Safety, Trip, WatchdogAction};
use crate::realtime::{Act, Handle, Live, Pace, RealTime, RunSettings, Runner, Stop, TimingCounts};
use crate::regulator::Spec;
use crate::ring::{Reader, Ring};
use crate::status::{Fault, step_error_reason};
use crate::watch::{Subscription, Watchers};

pub use self::core::{Core, Mechanics};
use self::gate::Gate;
pub use self::saved::PlantSnapshot;

/// Records that the ring of a plant keeps: a quarter of a second at 1 kHz.
const RING_RECORDS: usize = 256;
/// Pause between two looks for a core that a loop is about to put back.
const PUT_BACK_PERIOD: Duration = Duration::from_micros(50);

/// One step in this many is timed for the histogram of step times.
const TIMED_STEP_INTERVAL: u64 = 64;

/// Who may step a plant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DriverKind {
    /// A unary call that holds the lease while it runs.
    Step,
    /// A `Drive` stream.
    Drive,
    /// A driver over shared memory.
    Link,
}

impl DriverKind {
    /// The name in `PlantInfo.driver` and in metrics.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Step => "step",
            Self::Drive => "drive",
            Self::Link => "link",
        }
    }

    fn code(self) -> u8 {
        match self {
            Self::Step => 1,
            Self::Drive => 2,
            Self::Link => 3,
        }
    }

    /// The kind with that number, 0 for none.
    pub fn from_code(code: u8) -> Option<Self> {
        match code {
            1 => Some(Self::Step),
            2 => Some(Self::Drive),
            3 => Some(Self::Link),
            _ => None,
        }
    }
}

/// The lease is held by somebody else.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the plant is driven over `{}`", .by.as_str())]
pub struct LeaseHeld {
    /// What the holder is.
    pub by: DriverKind,
}

/// Why a lease's operation failed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DriveError {
    /// The plant was deleted.
    #[error("the plant was deleted")]
    Closed,
    /// The step failed; the plant is where it was.
    #[error(transparent)]
    Step(#[from] StepError),
    /// The plant takes its steps in a loop of its own.
    #[error("the plant runs by itself")]
    Running,
    /// The plant is paused, and this driver waits until it may go on.
    #[error("the plant is paused")]
    Paused,
    /// The plant keeps a speed, and the next step is due later, ns on the monotonic clock.
    #[error("the next step is due later")]
    NotDue(u64),
    /// A watchdog holds the plant.
    #[error("a watchdog holds the plant")]
    Frozen(Trip),
    /// The lease was taken away.
    #[error("the lease was taken away")]
    Revoked,
}

/// Where the core is.
enum Place {
    /// Here, for whoever holds the lock.
    Rest(Box<Core>),
    /// In a loop.
    Running { key: u64, handle: Handle },
}

/// How a plant is being run, in short.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RunStatus {
    /// Who decides when it takes a step.
    pub pace: Pace,
    /// It may take steps.
    pub is_running: bool,
    /// Number of the last lease that a watchdog has taken away.
    pub revoked: u64,
}

/// How a plant is being run.
#[derive(Clone, Debug, Default)]
pub struct Run {
    /// How.
    pub settings: RunSettings,
    /// It may take steps.
    pub is_running: bool,
    /// Why it stands still although nobody has paused it.
    pub stopped_by: Option<v1::Failure>,
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
    pub feedback: Option<v1::FeedbackInfo>,
    /// Numbers of the scene that were changed.
    pub parameters: Arc<Parameters>,
}

/// A plant with everything that belongs to it, shared by all who use it.
pub struct Session {
    id: String,
    model_name: String,
    /// The model at the time of creation; later ones differ from it in numbers only.
    model: Arc<Model>,
    start: Snapshot,
    start_state: State,
    start_settings: Settings,
    /// Why the method is as it is, if it was chosen by a tolerance.
    accuracy: Option<v1::Accuracy>,
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
    is_closed: AtomicBool,
    closed: CancellationToken,
    watchers: Watchers,
    metrics: Arc<Metrics>,
}

impl Session {
    /// A session around a plant in its initial state, to which a reset returns.
    pub fn new(
        id: String,
        model_name: String,
        plant: Plant,
        accuracy: Option<v1::Accuracy>,
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
            is_closed: AtomicBool::new(false),
            closed: CancellationToken::new(),
            watchers: Watchers::default(),
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

    /// What was promised when the method was chosen by a tolerance.
    pub fn accuracy(&self) -> Option<v1::Accuracy> {
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
        self.with_core(|core| {
            let (state, time_s) = core.state();
            View {
                state,
                time_s,
                settings: *core.plant.settings(),
                feedback: core.feedback.as_ref().map(|feedback| feedback.info()),
                parameters: Arc::clone(&core.parameters),
            }
        })
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
    pub(crate) fn copy_plants(&self) -> Vec<Plant> {
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

    /// Who drives the plant.
    pub fn driver(&self) -> Option<DriverKind> {
        DriverKind::from_code(self.driver.load(Ordering::Acquire))
    }

    /// The shared-memory link is open.
    pub fn link_open(&self) -> bool {
        self.link_open.load(Ordering::Acquire)
    }

    /// Notes whether the shared-memory link is open.
    pub fn set_link_open(&self, open: bool) {
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

    /// Takes the lease, which ends when the returned value is dropped.
    pub fn acquire(self: &Arc<Self>, kind: DriverKind) -> Result<Lease, LeaseHeld> {
        self.driver
            .compare_exchange(0, kind.code(), Ordering::AcqRel, Ordering::Acquire)
            .map_err(|code| LeaseHeld { by: DriverKind::from_code(code).unwrap_or(kind) })?;
        self.metrics.driver_started(kind);
        let lease = self.new_lease(kind);
        self.holder.store(lease.number, Ordering::Release);
        if kind != DriverKind::Step {
            self.input_lease.store(lease.number, Ordering::Release);
        }
        Ok(lease)
    }

    fn new_lease(self: &Arc<Self>, kind: DriverKind) -> Lease {
        let number = self.leases.fetch_add(1, Ordering::Relaxed) + 1;
        if kind != DriverKind::Step {
            self.with_core(move |core| {
                core.note(EventKind::DriverAttached, kind.code().into(), 0.0)
            });
        }
        Lease { session: Arc::clone(self), kind, number, untimed_steps: 0 }
    }

    /// Takes the lease of that name over from whoever holds it: a stream whose connection broke, noticed
    /// or not.
    pub fn take_over(self: &Arc<Self>, token: &str) -> Option<Lease> {
        let named = lock(&self.named).take_if(|(name, _)| name == token);
        let (_, former) = named?;
        let lease = self.new_lease(DriverKind::Drive);
        let taken =
            self.holder.compare_exchange(former, lease.number, Ordering::AcqRel, Ordering::Acquire);
        self.metrics.driver_started(DriverKind::Drive);
        // Dropped, it gives up nothing that is not its own.
        taken.ok()?;
        self.input_lease.store(lease.number, Ordering::Release);
        self.revoked.store(former, Ordering::Release);
        self.tell_run_status();
        Some(lease)
    }

    /// Subscribes to every `every`-th state. Starts with the state as it is, if its step counts.
    pub fn subscribe(
        self: &Arc<Self>,
        every: u64,
        queue: usize,
        watchers_max: u64,
    ) -> Result<Subscription, LimitExceeded> {
        let session = Arc::clone(self);
        let like = self.with_core(|core| {
            let mut frame = Frame::default();
            frame.copy_from(&core.published());
            frame
        });
        let frames = vec![like; queue];
        // In the core's hands no step falls between the registration and the first frame.
        let subscribed = self.with_core(move |core| {
            let from = core.ring.as_ref().map_or(0, |ring| ring.written());
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

    /// Does something with the core, between two steps: keep it short. Not from within itself.
    pub fn with_core<R: Send + 'static>(
        &self,
        mut act: impl FnOnce(&mut Core) -> R + Send + 'static,
    ) -> R {
        loop {
            let (key, handle) = match &mut *lock(&self.place) {
                Place::Rest(core) => return act(core),
                Place::Running { key, handle } => (*key, handle.clone()),
            };
            let (give, taken) = mpsc::sync_channel(1);
            let in_loop: Act = Box::new(move |core| {
                let outcome = match core {
                    Some(core) => Ok(act(core)),
                    None => Err(act),
                };
                // The receiver waits for it.
                let _ = give.send(outcome);
            });
            handle.act(key, in_loop);
            match taken.recv().expect("a loop does what it is told") {
                Ok(outcome) => return outcome,
                // The loop has just let go of the plant, and is about to put it back.
                Err(back) => act = back,
            }
            std::thread::sleep(PUT_BACK_PERIOD);
        }
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
        memory: Option<v1::ChannelMemory>,
    ) -> (State, f64) {
        let session = Arc::clone(self);
        // The former plant is dropped here, not in the core's hands.
        let (put, _former) = self.with_core(move |core| {
            let former = core.replace_plant(plant, memory.as_ref());
            core.mark(MarkReason::Reset);
            session.watchers.publish(&core.published());
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
        let mut plants = self.copy_plants();
        let fits = plants.iter_mut().position(|plant| plant.restore(&snapshot.plant).is_ok());
        let mut plant = plants.swap_remove(fits.unwrap_or(0));
        plant.restore(&snapshot.plant)?;
        Ok(self.replace_plant(plant, snapshot.channels))
    }

    /// Changes numbers of the scene, and the time step if one is given, between two steps: the state
    /// `x` and the count of steps stay, time goes on. True when the feedback's law is to be computed
    /// anew. Compiles a model: call it on a worker.
    pub fn change_parameters(
        &self,
        changes: &[(String, f64)],
        time_step_s: Option<f64>,
        limits: &Limits,
    ) -> Result<bool, ParametersError> {
        let _replacing = lock(&self.replacing);
        let (before, parameters) =
            self.with_core(|core| (core.mechanics(), Arc::clone(&core.parameters)));
        let (model, parameters) = if changes.is_empty() {
            (before.model, parameters)
        } else {
            let changed = parameters::change(&before.model, &parameters, changes)?;
            let (what, count) = ("numbers of the scene changed", changed.parameters.len());
            LimitExceeded::check("parameters", limits.parameters, what, count)?;
            (Arc::new(changed.model), Arc::new(changed.parameters))
        };
        let settings = Settings {
            time_step_s: time_step_s.unwrap_or(before.settings.time_step_s),
            ..before.settings
        };
        let renewed = self.renewed_channels(&model, settings, limits)?;
        let plant = Plant::new(model, settings)?;
        let changed = self.with_core(move |core| {
            let former = core.change_plant(plant, parameters)?;
            let former = (former, core.renew_channels(renewed));
            core.mark(MarkReason::Parameters);
            let is_outdated = match &mut core.feedback {
                // A gain that was given holds as it is.
                Some(feedback) if feedback.spec.is_fixed() => {
                    feedback.generation = core.generation;
                    false
                }
                feedback => feedback.is_some(),
            };
            Ok::<_, InitialError>((is_outdated, former))
        });
        // The former plant is dropped here, not in the core's hands.
        let (is_outdated, _former) = changed?;
        Ok(is_outdated)
    }

    /// Puts a feedback in force. `generation` is that of the mechanics for which its law was computed;
    /// true when it is to be computed anew.
    pub fn set_feedback(
        self: &Arc<Self>,
        mut feedback: Box<Feedback>,
        generation: u64,
        first_step: Option<u64>,
    ) -> (v1::FeedbackInfo, bool) {
        let session = Arc::clone(self);
        let (info, is_outdated, _former) = self.with_core(move |core| {
            core.revision += 1;
            let present = core.plant.step_index();
            feedback.revision = core.revision;
            feedback.since_step = present;
            feedback.first_step = match feedback.law.end {
                Some(_) => first_step.unwrap_or(present),
                None => present,
            };
            let is_outdated = generation != core.generation && !feedback.spec.is_fixed();
            feedback.generation = if is_outdated { generation } else { core.generation };
            let info = feedback.info();
            session.in_force.send_replace(Some(feedback.in_force()));
            (info, is_outdated, core.feedback.replace(feedback))
        });
        (info, is_outdated)
    }

    /// Takes the feedback away; false when there is none.
    pub fn clear_feedback(self: &Arc<Self>) -> bool {
        let session = Arc::clone(self);
        let former = self.with_core(move |core| {
            session.in_force.send_replace(None);
            core.feedback.take()
        });
        former.is_some()
    }

    /// What the feedback's law is to be computed from anew, if its parameters have changed since.
    pub fn outdated_feedback(&self) -> Option<(Arc<Spec>, Mechanics)> {
        self.with_core(|core| {
            let feedback = core.feedback.as_ref()?;
            let is_outdated = feedback.generation != core.generation && !feedback.spec.is_fixed();
            is_outdated.then(|| (Arc::clone(&feedback.spec), core.mechanics()))
        })
    }

    /// Puts a law in force that was computed anew; a failure leaves the former one in force and is
    /// shown. What belongs to a feedback that is gone is dropped.
    pub fn renew_feedback(
        self: &Arc<Self>,
        spec: &Arc<Spec>,
        generation: u64,
        outcome: Result<Law, Fault>,
    ) {
        let (session, spec) = (Arc::clone(self), Arc::clone(spec));
        self.with_core(move |core| {
            let Some(feedback) = core.feedback.as_mut().filter(|f| Arc::ptr_eq(&f.spec, &spec))
            else {
                return;
            };
            feedback.generation = generation;
            match outcome {
                Ok(law) => {
                    core.revision += 1;
                    feedback.revision = core.revision;
                    feedback.since_step = core.plant.step_index();
                    feedback.law = Arc::new(law);
                    feedback.failure = None;
                }
                Err(fault) => feedback.failure = Some(fault.into()),
            }
            session.in_force.send_replace(Some(feedback.in_force()));
        });
    }

    /// Claims the task of computing the feedback's law anew; false when somebody is at it.
    pub fn begin_recomputing(&self) -> bool {
        !self.is_recomputing.swap(true, Ordering::AcqRel)
    }

    /// Gives that task back.
    pub fn end_recomputing(&self) {
        self.is_recomputing.store(false, Ordering::Release);
    }

    /// Tells of the feedback's law and of each that replaces it.
    pub fn watch_gains(
        self: &Arc<Self>,
        watchers_max: u64,
    ) -> Result<Receiver<Option<InForce>>, LimitExceeded> {
        let (name, what) = ("watchers_per_plant", "watchers of gains");
        let session = Arc::clone(self);
        // In the core's hands counting and subscribing are one.
        self.with_core(move |_| {
            let count = session.in_force.receiver_count() + 1;
            LimitExceeded::check(name, watchers_max, what, count)?;
            Ok(session.in_force.subscribe())
        })
    }
}

/// Running.
impl Session {
    /// Runs the plant, with new settings if some are given, until it is paused or `steps` are taken; 0
    /// means without end.
    pub fn run(
        self: &Arc<Self>,
        settings: Option<RunSettings>,
        steps: u64,
        running_max: u64,
    ) -> Result<(), Fault> {
        let _changing = lock(&self.changing_run);
        if self.is_closed() {
            return Err(Fault::plant_deleted(&self.id));
        }
        let settings = settings.unwrap_or_else(|| lock(&self.run).settings.clone());
        let runs_by_itself = settings.pace != Pace::Lockstep;
        let was_in_loop = self.halt();
        let place = if runs_by_itself {
            self.realtime.admit(running_max)?;
            let assigned = self.realtime.assign(settings.pace);
            Some(assigned.inspect_err(|_| self.realtime.leave()).map_err(Fault::no_loop)?)
        } else {
            None
        };
        let keep = runs_by_itself && lock(&self.run).settings.pace != Pace::Lockstep;
        *lock(&self.run) = Run { settings: settings.clone(), is_running: true, stopped_by: None };
        let speed = settings.speed;
        let is_slowed = !runs_by_itself && speed > 0.0;
        let period_s = if is_slowed { self.mechanics().settings.time_step_s / speed } else { 0.0 };
        self.gate.open(if runs_by_itself { 0 } else { steps }, period_s);
        self.with_core(move |core| {
            core.release();
            core.keep_loop_input(keep || was_in_loop && runs_by_itself);
            if runs_by_itself {
                core.note(EventKind::Started, 0, speed);
            }
        });
        if let Some((key, handle)) = place {
            self.live().first_record.store(self.ring().written(), Ordering::Release);
            self.enter_loop(key, handle, &settings, steps)?;
        }
        self.tell_run_status();
        Ok(())
    }

    /// Pauses the plant between two steps.
    pub fn pause(&self) {
        let _changing = lock(&self.changing_run);
        self.halt();
        lock(&self.run).is_running = false;
        self.gate.close();
        self.with_core(|core| core.note(EventKind::Paused, 0, 0.0));
        self.tell_run_status();
    }

    /// How the plant is being run, and the steps after which it pauses; 0 means never.
    pub fn run_info(&self) -> (Run, u64) {
        let run = lock(&self.run).clone();
        let steps_left = match run.settings.pace {
            Pace::Lockstep => self.gate.steps_left(),
            _ => self.live().steps_left.load(Ordering::Relaxed),
        };
        (run, steps_left)
    }

    /// The same in short, and each change of it.
    pub fn run_status(&self) -> Receiver<RunStatus> {
        self.run_status.subscribe()
    }

    /// The plant takes its steps in a loop of its own, or would if it were not paused: inputs go there.
    pub fn runs_by_itself(&self) -> bool {
        self.run_status.borrow().pace != Pace::Lockstep
    }

    /// It runs in a loop at this moment.
    pub(crate) fn is_running(&self) -> bool {
        matches!(*lock(&self.place), Place::Running { .. })
    }

    pub(crate) fn is_paced(&self) -> bool {
        self.run_status.borrow().pace == Pace::Paced
    }

    /// What the plant's own loop shares.
    pub fn live(&self) -> &Arc<Live> {
        self.live.get_or_init(|| Arc::new(Live::new(self.model.dimensions())))
    }

    /// What the loops of the server have counted.
    pub(crate) fn loop_counts(&self) -> &Arc<TimingCounts> {
        &self.realtime.counts
    }

    /// Number of the lease under which inputs come; 0 for none.
    pub(crate) fn input_lease(&self) -> u64 {
        self.input_lease.load(Ordering::Acquire)
    }

    /// Takes the lease away from the driver, who is told so when it acts next.
    pub(crate) fn revoke_lease(&self) {
        let lease = self.input_lease();
        if lease != 0 {
            self.revoked.store(lease, Ordering::Release);
            self.tell_run_status();
        }
    }

    /// The events of the plant.
    pub fn events(&self) -> &Arc<Events> {
        &self.events
    }

    /// Sets what protects the plant.
    pub fn set_safety(self: &Arc<Self>, safety: Safety) -> Result<(), InitialError> {
        let _replacing = lock(&self.replacing);
        let resets = |action: WatchdogAction| action == WatchdogAction::Reset;
        let needs_home = safety.watchdogs.iter().any(|dog| resets(dog.action))
            || safety.on_step_failure.is_some_and(resets);
        let home = if needs_home { Some(Box::new(self.plant_at_start()?)) } else { None };
        // The former guard is dropped here, not in the core's hands.
        drop(self.with_core(move |core| core.protect(safety, home)));
        Ok(())
    }

    /// A copy of the plant, put back into the state in which the session began; changed parameters stay.
    fn plant_at_start(&self) -> Result<Plant, InitialError> {
        let mut plants = self.copy_plants();
        let restored = plants.iter_mut().position(|plant| plant.restore(&self.start).is_ok());
        let mut plant = plants.swap_remove(restored.unwrap_or(0));
        if restored.is_none() {
            // Of other parameters or another time step: what can be kept is x.
            let State { step, q, p, v, .. } = self.start_state.clone();
            plant.initialize(&Initial::Momentum { q, p, v })?;
            plant.set_step_index(step);
        }
        Ok(plant)
    }

    /// The ring into which each step is written; made at the first call.
    pub fn ring(&self) -> Arc<Ring> {
        let words = record_words(self.model.dimensions());
        let ring = Arc::new(Ring::new(RING_RECORDS, words));
        self.with_core(move |core| Arc::clone(core.ring.get_or_insert(ring)))
    }

    /// A reader of what the plant's loop wrote into the ring and a watcher has not seen.
    pub(crate) fn read_for_watchers(&self) -> Reader {
        let from = self.live().first_record.load(Ordering::Acquire);
        Reader::from(self.ring(), from.max(self.watchers.first_record()))
    }

    /// A reader of the ring, from its last record on.
    pub(crate) fn read_ring(&self) -> Reader {
        let ring = self.ring();
        let last = ring.written().saturating_sub(1);
        Reader::from(ring, last)
    }

    /// Takes the plant out of its loop, if it is in one.
    fn halt(&self) -> bool {
        let (key, handle) = match &*lock(&self.place) {
            Place::Rest(_) => return false,
            Place::Running { key, handle } => (*key, handle.clone()),
        };
        match handle.stop(key) {
            Some(core) => {
                *lock(&self.place) = Place::Rest(core);
                self.realtime.leave();
            }
            // The loop has just let go of it, and is about to put it back.
            None => {
                while self.is_running() {
                    std::thread::sleep(PUT_BACK_PERIOD);
                }
            }
        }
        true
    }

    fn enter_loop(
        self: &Arc<Self>,
        key: u64,
        handle: Handle,
        settings: &RunSettings,
        steps: u64,
    ) -> Result<(), Fault> {
        let pump = self.realtime.pump().map_err(Fault::no_loop)?;
        let mut place = lock(&self.place);
        let running = Place::Running { key, handle: handle.clone() };
        match std::mem::replace(&mut *place, running) {
            Place::Rest(core) => {
                let runner = Runner::new(key, core, Arc::clone(self), settings, steps);
                handle.run(runner);
            }
            // Nobody else starts loops while `changing_run` is held.
            former @ Place::Running { .. } => *place = former,
        }
        drop(place);
        pump.add(Arc::clone(self));
        Ok(())
    }

    /// A loop lets go of the plant.
    pub(crate) fn loop_ended(&self, core: Box<Core>, stop: Stop) {
        let stopped_by = match stop {
            Stop::StepsTaken => {
                core.note(EventKind::StepsTaken, 0, 0.0);
                None
            }
            Stop::Closed => None,
            Stop::Fault(fault) => Some(fault.into()),
        };
        self.live().due_ns.store(0, Ordering::Relaxed);
        {
            let mut run = lock(&self.run);
            run.is_running = false;
            run.stopped_by = stopped_by;
        }
        self.realtime.leave();
        *lock(&self.place) = Place::Rest(core);
        self.tell_run_status();
    }

    fn tell_run_status(&self) {
        let (pace, is_running) = {
            let run = lock(&self.run);
            (run.settings.pace, run.is_running)
        };
        let revoked = self.revoked.load(Ordering::Acquire);
        self.run_status.send_replace(RunStatus { pace, is_running, revoked });
    }
}

/// Why parameters were not changed.
#[derive(Debug)]
pub enum ParametersError {
    /// The changed scene is none.
    Change(ChangeError),
    /// Too many.
    Limit(LimitExceeded),
    /// The state does not satisfy the changed constraints.
    State(InitialError),
    /// Channels do not fit the changed time step.
    Channels(Fault),
}

impl From<Fault> for ParametersError {
    fn from(fault: Fault) -> Self {
        Self::Channels(fault)
    }
}

impl From<ChangeError> for ParametersError {
    fn from(error: ChangeError) -> Self {
        Self::Change(error)
    }
}

impl From<LimitExceeded> for ParametersError {
    fn from(error: LimitExceeded) -> Self {
        Self::Limit(error)
    }
}

impl From<InitialError> for ParametersError {
    fn from(error: InitialError) -> Self {
        Self::State(error)
    }
}

impl From<ParametersError> for Fault {
    fn from(error: ParametersError) -> Self {
        match error {
            ParametersError::Change(error) => error.into(),
            ParametersError::Limit(error) => error.into(),
            ParametersError::State(error) => Self::from_initial(error, "parameters"),
            ParametersError::Channels(fault) => fault,
        }
    }
}

/// The right to move a plant. Dropping it gives it up.
pub struct Lease {
    session: Arc<Session>,
    kind: DriverKind,
    number: u64,
    untimed_steps: u64,
}

impl Lease {
    /// The session.
    pub fn session(&self) -> &Arc<Session> {
        &self.session
    }

    /// Takes one step.
    pub fn step(&mut self, u: &[f64]) -> Result<StepReport, DriveError> {
        self.step_and(u, None, |core| core.report)
    }

    /// Takes one step and linearizes it.
    pub fn step_and_linearize(
        &mut self,
        u: &[f64],
        out: &mut Linearization,
    ) -> Result<StepReport, DriveError> {
        self.step_and(u, Some(out), |core| core.report)
    }

    /// Takes one step, linearizes it when asked to, and looks at the core before anybody else does.
    pub fn step_and<R>(
        &mut self,
        u: &[f64],
        linearization: Option<&mut Linearization>,
        look: impl FnOnce(&Core) -> R,
    ) -> Result<R, DriveError> {
        self.step_pushed_and(u, &[], linearization, look)
    }

    /// The same with an impulse that is added to the momentum before; none if it is empty.
    pub fn step_pushed_and<R>(
        &mut self,
        u: &[f64],
        impulse: &[f64],
        linearization: Option<&mut Linearization>,
        look: impl FnOnce(&Core) -> R,
    ) -> Result<R, DriveError> {
        if self.session.is_closed() {
            return Err(DriveError::Closed);
        }
        let started = self.is_step_timed().then(Instant::now);
        if self.is_revoked() {
            return Err(DriveError::Revoked);
        }
        if self.kind != DriverKind::Step {
            self.session.gate.pass()?;
        }
        let mut place = lock(&self.session.place);
        let Place::Rest(core) = &mut *place else { return Err(DriveError::Running) };
        let outcome = core.step_pushed(u, impulse, linearization);
        let metrics = &self.session.metrics;
        if let Some(started) = started {
            metrics.step_timed(started.elapsed());
        }
        match outcome {
            Ok(_) => {
                core.write_ring();
                self.session.watchers.publish(&core.published());
                metrics.stepped(self.kind);
                if let Some(trip) = core.take_trip()
                    && trip.action == WatchdogAction::Disconnect
                {
                    self.session.revoke_lease();
                }
                let (seen, full) = (look(core), core.full_tap());
                drop(place);
                // Whoever steps a plant waits for its recorder; a plant that runs by itself does not.
                if let Some(tap) = full {
                    tap.wait();
                }
                Ok(seen)
            }
            Err(error) => {
                if let DriveError::Step(error) = &error {
                    metrics.step_failed(step_error_reason(error));
                    core.note_failure(error);
                }
                Err(error)
            }
        }
    }

    /// Gives the plant's own loop an input, which acts from its next step on. `answers_ns` is when the
    /// state was there that the input answers, 0 if that is not known.
    pub fn offer(&mut self, sequence: u64, u: &[f64], answers_ns: u64) -> Result<(), DriveError> {
        if self.session.is_closed() {
            return Err(DriveError::Closed);
        }
        if self.is_revoked() {
            return Err(DriveError::Revoked);
        }
        self.session.model.check_input(u)?;
        let (live, arrived_ns) = (self.session.live(), monotonic_ns());
        live.slot.put(Arrival { lease: self.number, sequence, arrived_ns }, u);
        for counts in [&live.counts, &*self.session.realtime.counts] {
            counts.inputs.fetch_add(1, Ordering::Relaxed);
            if answers_ns != 0 && answers_ns <= arrived_ns {
                counts.round_trip.record(arrived_ns - answers_ns);
            }
        }
        Ok(())
    }

    /// Gives it a name, under which it can be taken over.
    pub fn set_name(&self, token: String) {
        *lock(&self.session.named) = Some((token, self.number));
    }

    /// It was taken away.
    pub fn is_revoked(&self) -> bool {
        self.session.revoked.load(Ordering::Acquire) >= self.number
    }

    /// Puts the plant back into the state in which the session began, and tells it. Changed parameters stay changed.
    pub fn reset(&mut self) -> Result<(State, f64), InitialError> {
        let _replacing = lock(&self.session.replacing);
        let plant = self.session.plant_at_start()?;
        Ok(self.session.replace_plant(plant, None))
    }

    /// Puts the plant into a state, step 0, and tells it.
    pub fn initialize(&mut self, initial: &Initial) -> Result<(State, f64), InitialError> {
        let _replacing = lock(&self.session.replacing);
        let mut plant = self.session.copy_plants().swap_remove(0);
        plant.initialize(initial)?;
        Ok(self.session.replace_plant(plant, None))
    }

    /// Puts the plant into the state of a snapshot: one of the same parameters and time step.
    pub fn restore(&mut self, snapshot: PlantSnapshot) -> Result<(State, f64), SnapshotError> {
        self.session.restore(snapshot)
    }

    fn is_step_timed(&mut self) -> bool {
        let timed = self.untimed_steps == 0;
        self.untimed_steps = (self.untimed_steps + 1) % TIMED_STEP_INTERVAL;
        timed
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        let (session, kind) = (&self.session, self.kind);
        session.metrics.driver_ended(kind);
        let holds =
            session.holder.compare_exchange(self.number, 0, Ordering::AcqRel, Ordering::Acquire);
        if holds.is_err() {
            // Somebody has taken it over.
            return;
        }
        if kind == DriverKind::Step {
            session.driver.store(0, Ordering::Release);
            return;
        }
        session.input_lease.store(0, Ordering::Release);
        session.driver.store(0, Ordering::Release);
        session.with_core(move |core| core.note(EventKind::DriverLeft, kind.code().into(), 0.0));
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // The mechanics does not panic, and leaves the plant as it was when it fails.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
