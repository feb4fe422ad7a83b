//! What a watcher has asked for, and what is computed for it: energies, linearizations, gains and poles, from a
//! plant of the watcher's own, and poses of the plant's drawing.

use std::sync::Arc;

use nalgebra::DMatrix;
use plantd_control::{Momentum, Weights};
use plantd_models::drawing::{Drawing, Instant, Poses};
use plantd_models::{Initial, Linearization, Plant};
use plantd_proto::v1;
use v1::WatchField;

use crate::core::feedback::regulator::{self, Constraints};
use crate::core::limits::LimitExceeded;
use crate::core::publish::frame::Frame;
use crate::core::session::shared::Session;
use crate::wire::message::{drawing, matrices, poles, states};
use crate::wire::status::RpcError;

/// What a watcher has asked for.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Wanted {
    pub(super) state: bool,
    pub(super) report: bool,
    energy: bool,
    linearization: bool,
    pub(super) gain: bool,
    pub(super) input: bool,
    pub(super) outputs: bool,
    pub(super) timing: bool,
    poses: bool,
    poles: bool,
}

impl Wanted {
    pub(super) fn new(fields: &[i32]) -> Result<Self, RpcError> {
        let mut wanted = Self::default();
        for (index, field) in fields.iter().enumerate() {
            match WatchField::try_from(*field) {
                Ok(WatchField::State) => wanted.state = true,
                Ok(WatchField::Report) => wanted.report = true,
                Ok(WatchField::Energy) => wanted.energy = true,
                Ok(WatchField::Linearization) => wanted.linearization = true,
                Ok(WatchField::Gain) => wanted.gain = true,
                Ok(WatchField::Input) => wanted.input = true,
                Ok(WatchField::Outputs) => wanted.outputs = true,
                Ok(WatchField::Timing) => wanted.timing = true,
                Ok(WatchField::Poses) => wanted.poses = true,
                Ok(WatchField::Poles) => wanted.poles = true,
                Ok(WatchField::Unspecified) | Err(_) => {
                    let problem = format!("{field} is nothing to watch");
                    return Err(RpcError::field(format!("fields[{index}]"), problem));
                }
            }
        }
        if fields.is_empty() {
            return Err(RpcError::field("fields", "are missing: at least one is needed"));
        }
        Ok(wanted)
    }

    /// A and B of the map are needed.
    pub(super) fn needs_linearization(self) -> bool {
        self.linearization || self.gain || self.poles
    }

    /// A plant in the state of the frame is needed.
    fn needs_plant(self) -> bool {
        self.energy || self.needs_linearization()
    }

    /// Something is to be computed.
    pub(super) fn needs_computer(self) -> bool {
        self.poses || self.needs_plant()
    }
}

/// A watcher's own plant, on which it computes.
pub(super) struct Computer {
    session: Arc<Session>,
    plant: Plant,
    /// Number of changes that led to its parameters.
    generation: u64,
    linearization: Linearization,
    /// Made when first asked for.
    shown: Option<(Drawing, Poses)>,
    /// Numbers of a message at most.
    numbers_max: u64,
}

impl Computer {
    pub(super) fn new(session: Arc<Session>, numbers_max: u64) -> Self {
        let (plant, generation) = session.copy_plant_and_generation();
        let linearization = Linearization::new(session.model());
        Self { session, plant, generation, linearization, shown: None, numbers_max }
    }

    /// Number of changes that led to the plant's parameters.
    pub(super) fn generation(&self) -> u64 {
        self.generation
    }

    /// Computes what is wanted; what fails is reported in the message.
    pub(super) fn fill(
        &mut self,
        response: &mut v1::WatchResponse,
        frame: &Frame,
        wanted: Wanted,
        weights: Option<&(Weights, Momentum)>,
    ) {
        let poses = if wanted.poses { self.poses(frame).map(Some) } else { Ok(None) };
        let filled = poses.and_then(|poses| {
            response.poses = poses;
            self.try_fill(response, frame, wanted, weights)
        });
        if let Err(fault) = filled {
            response.failure = Some(fault.into());
        }
    }

    /// Where everything is, with the forces of the step that led there.
    fn poses(&mut self, frame: &Frame) -> Result<v1::Poses, RpcError> {
        // Signals add to what the driver sends, at the time at which that step began.
        self.plant.set_step_index(frame.state.step);
        self.plant.set_time_s(frame.time_s - frame.time_step_s);
        let inputs = self.plant.effective_input(&frame.input);
        let (shown, poses) = self.shown.get_or_insert_with(|| {
            let shown = Drawing::new(self.plant.model());
            let poses = shown.poses();
            (shown, poses)
        });
        let (name, limit) = ("reply_numbers", self.numbers_max);
        LimitExceeded::check(name, limit, "numbers in the poses", shown.numbers())?;
        let at = Instant {
            q: &frame.state.q,
            velocity: &frame.velocity,
            inputs: &inputs,
            multipliers: &frame.state.multipliers,
            time_step_s: frame.time_step_s,
        };
        shown.place(&at, poses);
        Ok(drawing::poses(poses))
    }

    fn try_fill(
        &mut self,
        response: &mut v1::WatchResponse,
        frame: &Frame,
        wanted: Wanted,
        weights: Option<&(Weights, Momentum)>,
    ) -> Result<(), RpcError> {
        if !wanted.needs_plant() {
            return Ok(());
        }
        let state = &frame.state;
        let momentum =
            Initial::Momentum { q: state.q.clone(), p: state.p.clone(), v: state.v.clone() };
        self.plant.initialize(&momentum).map_err(|error| RpcError::from_initial(error, "state"))?;
        self.plant.set_step_index(state.step);
        self.plant.set_time_s(frame.time_s);
        if wanted.energy {
            response.energy = Some(states::energy(self.plant.energy()));
        }
        if wanted.needs_linearization() {
            self.plant.linearize(&frame.input, &mut self.linearization)?;
        }
        if wanted.linearization {
            response.linearization = Some(states::linearization(state.step, &self.linearization));
        }
        if wanted.poles {
            response.poles = Some(self.poles(state.step)?);
        }
        if let Some((weights, momentum)) = weights {
            let space = Constraints::Manifold;
            let (plant, linearization) = (&mut self.plant, &self.linearization);
            let regulator = regulator::at_state(plant, linearization, weights, *momentum, space)?;
            response.gain = Some(v1::Gain {
                step: state.step,
                k: Some(matrices::matrix(&regulator.gain)),
                x_reference: state.x(),
                u_reference: frame.input.clone(),
                rotations: states::rotations(self.plant.model()),
                ..Default::default()
            });
        }
        Ok(())
    }

    /// With the gain that the plant's feedback has at a step, if it has one.
    fn poles(&mut self, step: u64) -> Result<v1::Poles, RpcError> {
        let d = self.plant.model().dimensions();
        let in_force = self.session.feedback_in_force();
        let gain = in_force.as_ref().map(|in_force| in_force.gain_at(step));
        let gain = gain.map(|gain| DMatrix::from_row_slice(d.input(), d.state(), gain));
        poles::poles(&mut self.plant, &self.linearization, gain.as_ref())
    }
}
