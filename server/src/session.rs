//! A plant session: one plant, its lease, and what it publishes.
//!
//! Only the holder of the lease moves the plant. Others lock the core to copy a state or a plant
//! out of it, which takes microseconds; energies, linearizations and gains are computed on copies.

use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use plantd_models::{
    Initial, InitialError, Linearization, Model, Plant, Settings, Snapshot, SnapshotError, State,
    StepError, StepReport,
};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};

use crate::limits::LimitExceeded;
use crate::metrics::Metrics;
use crate::status::step_error_reason;
use crate::watch::{Subscription, Watchers};

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

    fn from_code(code: u8) -> Option<Self> {
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
}

/// What the lock protects.
struct Core {
    plant: Plant,
    /// Input of the last step; before the first one, the input that holds the plant.
    input: Vec<f64>,
    /// Report of the last step.
    report: StepReport,
}

/// A plant with everything that belongs to it, shared by all who use it.
pub struct Session {
    id: String,
    model_name: String,
    model: Arc<Model>,
    settings: Settings,
    start: Snapshot,
    core: Mutex<Core>,
    driver: AtomicU8,
    link_open: AtomicBool,
    is_closed: AtomicBool,
    closed: CancellationToken,
    watchers: Watchers,
    metrics: Arc<Metrics>,
}

impl Session {
    /// A session around a plant in its initial state, to which a reset returns.
    pub fn new(id: String, model_name: String, plant: Plant, metrics: Arc<Metrics>) -> Arc<Self> {
        let model = Arc::clone(plant.model());
        let mut input = vec![0.0; model.dimensions().input()];
        plant.hold_input(&mut input);
        Arc::new(Self {
            id,
            model_name,
            settings: *plant.settings(),
            start: plant.snapshot(),
            model,
            core: Mutex::new(Core { plant, input, report: StepReport::default() }),
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

    /// The model.
    pub fn model(&self) -> &Arc<Model> {
        &self.model
    }

    /// The settings.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Metrics of the server.
    pub fn metrics(&self) -> &Arc<Metrics> {
        &self.metrics
    }

    /// The state as it is.
    pub fn state(&self) -> State {
        self.core().plant.state()
    }

    /// A snapshot of the plant as it is.
    pub fn snapshot(&self) -> Snapshot {
        self.core().plant.snapshot()
    }

    /// A copy of the plant as it is, to compute on.
    pub fn copy_plant(&self) -> Plant {
        self.core().plant.clone()
    }

    /// The same with the input of its last step; before the first one, the input that holds it.
    pub fn copy_plant_and_input(&self) -> (Plant, Vec<f64>) {
        let core = self.core();
        (core.plant.clone(), core.input.clone())
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
        Ok(Lease { session: Arc::clone(self), kind, untimed_steps: 0 })
    }

    /// Subscribes to every `every`-th state. Starts with the state as it is, if its step counts.
    pub fn subscribe(
        self: &Arc<Self>,
        every: u64,
        watchers_max: u64,
    ) -> Result<Subscription, LimitExceeded> {
        // Under the core's lock no step falls between the registration and the first frame.
        let core = self.core();
        let subscription = Subscription::new(Arc::clone(self), every, watchers_max)?;
        subscription.offer(&core.plant, &core.report, &core.input);
        Ok(subscription)
    }

    /// The watchers of the plant.
    pub fn watchers(&self) -> &Watchers {
        &self.watchers
    }

    fn core(&self) -> MutexGuard<'_, Core> {
        // The mechanics does not panic, and leaves the plant as it was when it fails.
        self.core.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Replaces the plant by a copy of it that was put into another state.
    fn replace_plant(&self, plant: Plant) {
        let mut core = self.core();
        let core = &mut *core;
        plant.hold_input(&mut core.input);
        core.plant = plant;
        core.report = StepReport::default();
        self.watchers.publish(&core.plant, &core.report, &core.input);
    }
}

/// The right to move a plant. Dropping it gives it up.
pub struct Lease {
    session: Arc<Session>,
    kind: DriverKind,
    untimed_steps: u64,
}

impl Lease {
    /// The session.
    pub fn session(&self) -> &Arc<Session> {
        &self.session
    }

    /// Takes one step.
    pub fn step(&mut self, u: &[f64]) -> Result<StepReport, DriveError> {
        self.step_by(u, |plant| plant.step(u))
    }

    /// Takes one step and linearizes it.
    pub fn step_and_linearize(
        &mut self,
        u: &[f64],
        out: &mut Linearization,
    ) -> Result<StepReport, DriveError> {
        self.step_by(u, |plant| plant.step_and_linearize(u, out))
    }

    /// Looks at the plant, which nobody else moves meanwhile.
    pub fn with_plant<R>(&self, look: impl FnOnce(&Plant) -> R) -> R {
        look(&self.session.core().plant)
    }

    /// Puts the plant back into the state in which the session began.
    pub fn reset(&mut self) -> Result<(), SnapshotError> {
        let start = self.session.start.clone();
        self.restore(&start)
    }

    /// Puts the plant into a state, step 0.
    pub fn initialize(&mut self, initial: &Initial) -> Result<(), InitialError> {
        let mut plant = self.session.copy_plant();
        plant.initialize(initial)?;
        self.session.replace_plant(plant);
        Ok(())
    }

    /// Puts the plant into the state of a snapshot.
    pub fn restore(&mut self, snapshot: &Snapshot) -> Result<(), SnapshotError> {
        let mut plant = self.session.copy_plant();
        plant.restore(snapshot)?;
        self.session.replace_plant(plant);
        Ok(())
    }

    fn step_by(
        &mut self,
        u: &[f64],
        advance: impl FnOnce(&mut Plant) -> Result<StepReport, StepError>,
    ) -> Result<StepReport, DriveError> {
        if self.session.is_closed() {
            return Err(DriveError::Closed);
        }
        let started = self.is_step_timed().then(Instant::now);
        let mut core = self.session.core();
        let outcome = advance(&mut core.plant);
        if let Some(started) = started {
            self.session.metrics.step_timed(started.elapsed());
        }
        match outcome {
            Ok(report) => {
                core.input.copy_from_slice(u);
                core.report = report;
                self.session.watchers.publish(&core.plant, &core.report, &core.input);
                self.session.metrics.stepped(self.kind);
                Ok(report)
            }
            Err(error) => {
                self.session.metrics.step_failed(step_error_reason(&error));
                Err(error.into())
            }
        }
    }

    fn is_step_timed(&mut self) -> bool {
        let timed = self.untimed_steps == 0;
        self.untimed_steps = (self.untimed_steps + 1) % TIMED_STEP_INTERVAL;
        timed
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        self.session.metrics.driver_ended(self.kind);
        self.session.driver.store(0, Ordering::Release);
    }
}
