//! What a session began with.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use plantd_models::{Model, Plant, Settings, Snapshot, State};

use crate::core::room::{Reservation, Room};
use crate::core::tenant::Tenant;

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

/// What a session is told of its plant.
pub struct Origin {
    /// Id.
    pub id: String,
    /// Name of its model.
    pub model_name: String,
    /// Why the method is as it is, if it was chosen by a tolerance.
    pub accuracy: Option<Accuracy>,
    /// How long it is kept when nobody uses it; `None` for as long as the server.
    pub expires: Option<Duration>,
    /// Whose it is.
    pub owner: Owner,
}

/// Whose a plant is.
#[derive(Debug, Default)]
pub struct Owner {
    /// The tenant.
    pub tenant: Tenant,
    /// Its room for the plant; none of somebody without limits.
    pub room: Option<Reservation>,
    /// Its room for plants that run by themselves.
    pub running: Option<Arc<Room>>,
    /// Where steps are counted that ended after the next one was due.
    pub overruns: Arc<AtomicU64>,
}

impl Origin {
    /// A plant of which no more is known.
    pub fn new(id: impl Into<String>, model_name: impl Into<String>) -> Self {
        Self {
            id: id.into(),
            model_name: model_name.into(),
            accuracy: None,
            expires: None,
            owner: Owner::default(),
        }
    }
}

/// A plant's name and origin, and the state to which a reset returns.
pub(super) struct Creation {
    pub(super) id: String,
    pub(super) model_name: String,
    /// The model at the time of creation; later ones differ from it in numbers only.
    pub(super) model: Arc<Model>,
    /// About how many instructions a step of order 2 takes.
    pub(super) step_instructions: f64,
    pub(super) snapshot: Snapshot,
    pub(super) state: State,
    pub(super) settings: Settings,
    /// Why the method is as it is, if it was chosen by a tolerance.
    pub(super) accuracy: Option<Accuracy>,
    pub(super) owner: Owner,
}

impl Creation {
    pub(super) fn of(plant: &Plant, origin: Origin) -> Self {
        let Origin { id, model_name, accuracy, expires: _, owner } = origin;
        Self {
            id,
            model_name,
            model: Arc::clone(plant.model()),
            step_instructions: step_instructions(plant.model()),
            snapshot: plant.snapshot(),
            state: plant.state(),
            settings: *plant.settings(),
            accuracy,
            owner,
        }
    }
}

fn step_instructions(model: &Model) -> f64 {
    model.stage_costs().iter().map(|stage| stage.times * stage.instructions).sum()
}
