//! Parameters of a plant and its time step, changed while it is there.

use std::sync::Arc;

use plantd_models::parameters::{self, ChangeError};
use plantd_models::{InitialError, Settings, Spare};

use crate::core::limits::{LimitExceeded, Limits};
use crate::core::plant::mark::MarkReason;
use crate::core::session::shared::Session;
use crate::wire::status::RpcError;

impl Session {
    /// Changes numbers of the scene, and the time step if one is given, between two steps: the state
    /// `x` and the count of steps stay, time goes on. True when the feedback's law is to be computed
    /// anew. Compiles a model: call it on a worker.
    pub fn change_parameters(
        &self,
        changes: &[(String, f64)],
        time_step_s: Option<f64>,
        limits: &Limits,
    ) -> Result<bool, ParametersError> {
        let _replacing = self.replacing();
        let (before, parameters) =
            self.with_core(|core| (core.mechanics(), Arc::clone(&core.changed.parameters)));
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
        let spare = Spare::new(model, settings)?;
        let changed = self.with_core(move |core| {
            let former = core.change_plant(spare, settings, parameters)?;
            let former = (former, core.renew_channels(renewed));
            core.mark(MarkReason::Parameters);
            let is_outdated = match &mut core.feedback {
                // A gain that was given holds as it is.
                Some(feedback) if feedback.spec.is_fixed() => {
                    feedback.generation = core.changed.generation;
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
    Channels(RpcError),
}

impl From<RpcError> for ParametersError {
    fn from(fault: RpcError) -> Self {
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

impl From<ParametersError> for RpcError {
    fn from(error: ParametersError) -> Self {
        match error {
            ParametersError::Change(error) => error.into(),
            ParametersError::Limit(error) => error.into(),
            ParametersError::State(error) => Self::from_initial(error, "parameters"),
            ParametersError::Channels(fault) => fault,
        }
    }
}
