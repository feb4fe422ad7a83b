//! Scenes whose Newton matrix is singular in every configuration.

use crate::constraints::conditioning::{SAMPLES, sample};
use crate::integrator::report::StepError;
use crate::integrator::settings::Settings;
use crate::integrator::workspace::Workspace;
use crate::model::manifold::orientations;
use crate::model::mechanism::Model;

impl Model {
    /// A coordinate at which the Newton matrix is singular in every configuration, at rest: nothing
    /// resists it, for example because all that it turns lies on its axis.
    pub(crate) fn always_singular(&self) -> Option<&str> {
        let settings = Settings::new(self);
        let mut workspace = Workspace::new(self);
        let mut culprit = None;
        // Configurations where something is singular by chance are rare.
        for k in (0..=SAMPLES).rev() {
            workspace.mid.q = sample(self, k, 1.0);
            workspace.mid.angles.copy_from_slice(&workspace.mid.q);
            workspace.mid.orientations = orientations(self, &workspace.mid.q);
            workspace.mid.evaluate(self);
            match workspace.factor_newton_matrix(self, &settings) {
                Err(StepError::Singular { coordinate, .. }) => culprit = Some(coordinate),
                _ => return None,
            }
        }
        self.coordinates.iter().find(|c| Some(&c.name) == culprit.as_ref()).map(|c| c.name.as_str())
    }
}
