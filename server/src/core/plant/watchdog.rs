//! Bounds that a plant must not leave, and what happens when it does.

use plantd_models::{Model, Plant};

/// What a watchdog does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WatchdogAction {
    /// The plant stands still where it is until it is put into another state or released.
    Freeze,
    /// The plant goes back to the state that it was created in.
    Reset,
    /// The driver loses the lease.
    Disconnect,
}

/// What a watchdog looks at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// A coordinate, rad or m.
    Coordinate(usize),
    /// The mean velocity of a coordinate over the last step, 1/s.
    Velocity(usize),
    /// A constraint's multiplier over the time step: a force.
    Multiplier(usize),
    /// Kinetic and potential energy, J.
    Energy,
}

impl Quantity {
    /// A number for it, by which [`Quantity::name`] finds its name.
    pub fn code(self) -> u64 {
        let (kind, index) = match self {
            Self::Coordinate(index) => (0, index),
            Self::Velocity(index) => (1, index),
            Self::Multiplier(index) => (2, index),
            Self::Energy => (3, 0),
        };
        kind << 32 | index as u64
    }

    /// The name of the quantity with that number, as [`quantity`] takes it.
    pub fn name(code: u64, model: &Model) -> String {
        let index = (code & u64::from(u32::MAX)) as usize;
        let coordinate = || model.coordinates().get(index).map_or("?", |c| c.name.as_str());
        match code >> 32 {
            0 => coordinate().to_owned(),
            1 => format!("v({})", coordinate()),
            2 => format!("force({})", model.constraint_names().get(index).map_or("?", |name| name)),
            _ => "energy".to_owned(),
        }
    }
}

/// Bounds of one quantity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Watchdog {
    /// What it looks at.
    pub quantity: Quantity,
    /// Smallest value.
    pub min: f64,
    /// Largest value.
    pub max: f64,
    /// What it does.
    pub action: WatchdogAction,
}

/// What protects a plant.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Safety {
    /// Bounds, looked at in order after each step.
    pub watchdogs: Vec<Watchdog>,
    /// What happens when a step fails in the plant's own loop; `None` means that it stands still.
    pub on_step_failure: Option<WatchdogAction>,
}

impl Safety {
    /// Something may put the plant back to where it began.
    pub(crate) fn resets(&self) -> bool {
        let mut actions = self.watchdogs.iter().map(|dog| dog.action).chain(self.on_step_failure);
        actions.any(|action| action == WatchdogAction::Reset)
    }
}

/// A bound that was left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trip {
    /// Index of the watchdog.
    pub watchdog: usize,
    /// The watchdog.
    pub dog: Watchdog,
    /// Value of the quantity.
    pub value: f64,
    /// Step of the plant.
    pub step: u64,
}

impl Trip {
    /// The bound that was left.
    pub fn bound(&self) -> f64 {
        if self.value < self.dog.min { self.dog.min } else { self.dog.max }
    }
}

/// The watchdogs of a plant at work. Allocates nothing after its construction.
#[derive(Debug)]
pub(crate) struct Guard {
    pub(crate) safety: Safety,
    /// Configuration before the last step, when velocities are watched.
    before: Vec<f64>,
    increment: Vec<f64>,
    needs_velocity: bool,
    /// The plant in the state to which a reset returns.
    pub(crate) home: Option<Box<Plant>>,
}

impl Guard {
    /// `home` is the plant in the state to which a reset returns, if there may be one.
    pub(crate) fn new(safety: Safety, plant: &Plant, home: Option<Box<Plant>>) -> Self {
        let is_velocity = |dog: &Watchdog| matches!(dog.quantity, Quantity::Velocity(_));
        let needs_velocity = safety.watchdogs.iter().any(is_velocity);
        let before = plant.q().to_vec();
        Self { safety, increment: vec![0.0; before.len()], before, needs_velocity, home }
    }

    /// Notes the configuration before a step.
    pub(crate) fn begin(&mut self, plant: &Plant) {
        if self.needs_velocity {
            self.before.copy_from_slice(plant.q());
        }
    }

    /// The first bound that the plant has left. A NaN leaves every bound.
    pub(crate) fn check(&mut self, plant: &mut Plant) -> Option<Trip> {
        if self.needs_velocity {
            plant.model().write_difference(&self.before, plant.q(), &mut self.increment);
        }
        let time_step_s = plant.settings().time_step_s;
        for (watchdog, dog) in self.safety.watchdogs.iter().enumerate() {
            let value = match dog.quantity {
                Quantity::Coordinate(i) => plant.q()[i],
                Quantity::Velocity(i) => self.increment[i] / time_step_s,
                Quantity::Multiplier(i) => plant.multipliers()[i] / time_step_s,
                Quantity::Energy => {
                    let energy = plant.energy();
                    energy.kinetic_j + energy.potential_j
                }
            };
            if !(value >= dog.min && value <= dog.max) {
                return Some(Trip { watchdog, dog: *dog, value, step: plant.step_index() });
            }
        }
        None
    }
}

/// What protects a plant, and what it has found.
#[derive(Default)]
pub(crate) struct Protection {
    pub(super) guard: Option<Box<Guard>>,
    /// A bound was left in the last step.
    pub(super) trip: Option<Trip>,
    /// The bound because of which the plant stands still.
    pub(super) frozen: Option<Trip>,
}

/// The quantity of a name: a coordinate, `v(coordinate)`, `force(constraint)` or `energy`.
pub fn quantity(model: &Model, name: &str) -> Option<Quantity> {
    let inside = |prefix: &str| name.strip_prefix(prefix)?.strip_suffix(')');
    if let Some(index) = model.coordinate_index(name) {
        return Some(Quantity::Coordinate(index));
    }
    if let Some(coordinate) = inside("v(") {
        return model.coordinate_index(coordinate).map(Quantity::Velocity);
    }
    if let Some(constraint) = inside("force(") {
        let index = model.constraint_names().iter().position(|name| name == constraint);
        return index.map(Quantity::Multiplier);
    }
    (name == "energy").then_some(Quantity::Energy)
}
