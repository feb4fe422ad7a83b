//! Plants made ahead: with all their memory, but in no state yet.

use std::sync::Arc;

use crate::integrator::settings::Settings;
use crate::integrator::state::{PreciseState, State};
use crate::integrator::workspace::Workspace;
use crate::model::mechanism::Model;
use crate::plant::facade::Plant;
use crate::plant::initial::{Initial, InitialError, checked};
use crate::plant::period::Period;
use crate::plant::snapshot::{Snapshot, SnapshotError};

/// A plant that is made ahead: it has its model, its settings and its memory, and becomes a [`Plant`] with
/// the state that it is given. The scene's initial configuration need not satisfy the constraints.
#[derive(Clone, Debug)]
pub struct Spare(pub(crate) Plant);

impl Spare {
    /// A plant to be, whose settings are checked.
    pub fn new(model: Arc<Model>, settings: Settings) -> Result<Self, InitialError> {
        let scheme = settings.check(&model)?;
        let state = PreciseState::new(&model, scheme);
        Ok(Self(Plant {
            period: Period::new(&model, scheme, &state),
            state,
            workspace: Workspace::new(&model),
            settings,
            model,
        }))
    }

    /// The model.
    pub fn model(&self) -> &Arc<Model> {
        self.0.model()
    }

    /// The plant that it will be. Its state means nothing yet.
    pub fn plant(&self) -> &Plant {
        &self.0
    }

    /// The plant in a state, step 0.
    pub fn start(mut self, initial: &Initial) -> Result<Plant, InitialError> {
        self.0.initialize(initial)?;
        Ok(self.0)
    }

    /// The plant in the state of a snapshot, as [`Plant::restore`] takes it.
    pub fn restore(mut self, snapshot: &Snapshot) -> Result<Plant, SnapshotError> {
        self.0.restore(snapshot)?;
        Ok(self.0)
    }

    /// The plant in the state of another one, as [`Plant::go_on_from`] takes it.
    pub fn go_on_from(mut self, other: &Plant) -> Result<Plant, InitialError> {
        self.0.go_on_from(other)?;
        Ok(self.0)
    }

    /// Velocity `q̇` (nd + nk) that belongs to the projected momentum of a state, as [`Plant::velocity`]; its
    /// configuration need not satisfy the constraints (allocates). Refused where lengths do not fit the
    /// model.
    pub fn velocity_of(&mut self, state: &State) -> Result<Vec<f64>, InitialError> {
        let Plant { model, period, .. } = &self.0;
        let d = model.dimensions;
        let mut precise = PreciseState::new(model, period.scheme);
        precise.q = checked("q", &state.q, d.coordinates())?;
        precise.p = checked("p", &state.p, d.dynamic)?;
        precise.v = checked("v", &state.v, d.prescribed)?;
        precise.orient(model);
        self.0.state = precise;
        let velocity = self.0.velocity();
        self.0.workspace.forget();
        Ok(velocity)
    }

    /// Changes places with a plant and goes on from its state, as [`Plant::go_on_from`] does: `plant` is the
    /// spare one from then on, and the spare what `plant` was. Refused, and nothing changed, where the
    /// state violates the constraints. Allocates nothing.
    pub fn relieve(&mut self, plant: &mut Plant) -> Result<(), InitialError> {
        self.0.go_on_from(plant)?;
        std::mem::swap(&mut self.0, plant);
        Ok(())
    }
}

impl From<Plant> for Spare {
    /// The plant without its state; the count of its steps stays.
    fn from(plant: Plant) -> Self {
        Self(plant)
    }
}

impl Plant {
    /// A plant in the scene's initial configuration, at rest. Refused where that is only a guess
    /// ([`Model::initial_violations`]): [`Plant::at`] starts elsewhere.
    pub fn new(model: Arc<Model>, settings: Settings) -> Result<Self, InitialError> {
        Self::at(model, settings, &Initial::Scene)
    }

    /// A plant in a state, step 0.
    pub fn at(
        model: Arc<Model>,
        settings: Settings,
        initial: &Initial,
    ) -> Result<Self, InitialError> {
        Spare::new(model, settings)?.start(initial)
    }
}
