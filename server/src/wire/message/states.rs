//! States, outputs, linearizations and their names.

use plantd_models::scene::UnknownName;
use plantd_models::{
    Diagnostics, Dimensions, Energy, InitialError, Linearization, Model, Plant, Settings, Spare,
    State,
};
use plantd_proto::link::monotonic_ns;
use plantd_proto::v1;

use crate::core::plant::core::Core;
use crate::core::publish::frame::{Published, Timing};
use crate::core::realtime::clock::utc_ns;
use crate::wire::message::matrices::matrix;
use crate::wire::status::RpcError;

/// What output channels deliver, if there are any; flags are 1 where numbers stand for lost ones.
pub fn outputs(y: &[f64], lost: &[f64]) -> Option<v1::Outputs> {
    let is_lost = |&(_, flag): &(usize, &f64)| *flag != 0.0;
    let lost_channels = lost.iter().enumerate().filter(is_lost).map(|(index, _)| index as u32);
    let outputs = || v1::Outputs { y: y.to_vec(), lost: lost_channels.collect() };
    (!lost.is_empty()).then(outputs)
}

/// What the output channels of a plant deliver, if there are any.
pub fn core_outputs(core: &Core) -> Option<v1::Outputs> {
    let (y, lost) = core.outputs();
    outputs(y, lost)
}

/// When a state was there; `monotonic_ns` 0 means now.
pub fn clocks(plant_s: f64, monotonic_ns: u64) -> v1::Clocks {
    let monotonic_ns = if monotonic_ns == 0 { self::monotonic_ns() } else { monotonic_ns };
    v1::Clocks { plant_s, monotonic_ns, utc_ns: utc_ns(monotonic_ns) }
}

/// Times of a step in the plant's own loop; none in lockstep.
pub fn step_timing(timing: &Timing) -> Option<v1::StepTiming> {
    (timing.ended_ns != 0).then_some(v1::StepTiming {
        due_ns: timing.due_ns,
        began_ns: timing.began_ns,
        ended_ns: timing.ended_ns,
        input_sequence: timing.input_sequence,
        input_age_ns: timing.input_age_ns,
        input_late: timing.flags & Timing::LATE != 0,
        input_safe: timing.flags & Timing::SAFE != 0,
    })
}

/// A state that a plant shows, as a message.
pub(crate) fn shown(published: &Published<'_>) -> v1::State {
    let Published { step, time_s, q, p, v, velocity, .. } = *published;
    v1::State {
        step,
        time_s,
        q: q.to_vec(),
        p: p.to_vec(),
        v: v.to_vec(),
        multipliers: multipliers(step, published.multipliers),
        velocity: velocity.to_vec(),
    }
}

/// The state of a plant that nobody else sees, as a message.
pub fn plant_state(plant: &mut Plant) -> v1::State {
    let (step, velocity) = (plant.step_index(), plant.velocity());
    v1::State {
        step,
        time_s: plant.time_s(),
        q: plant.q().to_vec(),
        p: plant.p().to_vec(),
        v: plant.v().to_vec(),
        multipliers: multipliers(step, plant.multipliers()),
        velocity,
    }
}

/// A state that no plant is in, as a message; its time is that of its step.
pub fn state(state: &State, spare: &mut Spare) -> Result<v1::State, InitialError> {
    Ok(v1::State {
        step: state.step,
        time_s: state.step as f64 * spare.plant().settings().time_step_s,
        q: state.q.clone(),
        p: state.p.clone(),
        v: state.v.clone(),
        multipliers: multipliers(state.step, &state.multipliers),
        velocity: spare.velocity_of(state)?,
    })
}

/// There are none before the first step.
fn multipliers(step: u64, multipliers: &[f64]) -> Vec<f64> {
    if step == 0 { Vec::new() } else { multipliers.to_vec() }
}

/// `x = (q, p, v)` of a plant.
pub fn x(plant: &Plant) -> Vec<f64> {
    [plant.q(), plant.p(), plant.v()].concat()
}

/// The model has no such coordinate.
pub(crate) fn no_coordinate(field: impl Into<String>, name: &str, model: &Model) -> RpcError {
    let known = model.coordinates().iter().map(|coordinate| &coordinate.name);
    let name = UnknownName::among(name, known);
    RpcError::field(field, format!("there is no coordinate {name}"))
}

/// The model has no such frame.
pub(crate) fn no_frame(field: impl Into<String>, name: &str, model: &Model) -> RpcError {
    let known = model.scene().frames.iter().map(|frame| frame.name.as_str());
    let name = UnknownName::among(name, known.chain(["world"]));
    RpcError::field(field, format!("there is no frame {name}"))
}

/// Names of the entries of `x = (q, p, v)`: `theta`, `p(theta)`, `v(lift)`.
pub fn state_names(model: &Model) -> Vec<String> {
    let (dynamic, prescribed) = model.coordinates().split_at(model.dimensions().dynamic);
    let all = model.coordinates().iter().map(|c| c.name.clone());
    all.chain(dynamic.iter().map(|c| format!("p({})", c.name)))
        .chain(prescribed.iter().map(|c| format!("v({})", c.name)))
        .collect()
}

/// Names of the entries of `u`: inputs, and prescribed coordinates.
pub fn input_names(model: &Model) -> Vec<String> {
    let inputs = model.scene().inputs.iter().map(|input| input.name.clone());
    let prescribed = model.coordinates()[model.dimensions().dynamic..].iter();
    inputs.chain(prescribed.map(|coordinate| coordinate.name.clone())).collect()
}

/// Index of a bound's entry among `names`, and its ends; infinite where there is none.
pub fn bound(
    field: &str,
    bound: &v1::Bound,
    names: &[String],
) -> Result<(usize, f64, f64), RpcError> {
    let index = names.iter().position(|name| *name == bound.entry).ok_or_else(|| {
        let entry = UnknownName::among(&bound.entry, names);
        RpcError::field(format!("{field}.entry"), format!("there is no entry {entry}"))
    })?;
    if bound.min.is_none() && bound.max.is_none() {
        return Err(RpcError::field(field, "has neither `min` nor `max`"));
    }
    let (min, max) = (bound.min.unwrap_or(f64::NEG_INFINITY), bound.max.unwrap_or(f64::INFINITY));
    for (end, value) in [("min", bound.min), ("max", bound.max)] {
        if let Some(value) = value.filter(|value| !value.is_finite()) {
            return Err(RpcError::field(format!("{field}.{end}"), format!("is {value}")));
        }
    }
    if min > max {
        return Err(RpcError::field(field, format!("has min {min} above max {max}")));
    }
    Ok((index, min, max))
}

/// Indices in `x` at which the rotation vectors of ball joints begin.
pub fn rotations(model: &Model) -> Vec<u32> {
    model.orientations().iter().map(|&start| start as u32).collect()
}

/// What all gains of a map have in common: of which model and time step they are, and its rotations.
pub fn gain_of(name: &str, model: &Model, settings: &Settings) -> v1::Gain {
    v1::Gain {
        model: name.to_owned(),
        time_step_s: settings.time_step_s,
        rotations: rotations(model),
        ..Default::default()
    }
}

/// Numbers in the message of a linearization.
pub fn linearization_numbers(d: Dimensions) -> usize {
    (d.state() + d.constraints) * (d.state() + d.input())
}

/// Numbers in the message of a state.
pub fn state_numbers(d: Dimensions) -> usize {
    d.state() + d.constraints + d.coordinates()
}

/// Diagnostics of the state at `step` as a message.
pub fn diagnostics(step: u64, diagnostics: Diagnostics) -> v1::DiagnoseResponse {
    let count = |number: usize| number as u32;
    v1::DiagnoseResponse {
        step,
        degrees_of_freedom: count(diagnostics.degrees_of_freedom),
        constraint_rank: count(diagnostics.constraint_rank),
        redundant_constraints: diagnostics.redundant_constraints,
        energy: Some(energy(diagnostics.energy)),
        linear_momentum: diagnostics.linear_momentum.to_vec(),
        angular_momentum: diagnostics.angular_momentum.to_vec(),
        center_of_mass: diagnostics.center_of_mass.to_vec(),
        mass_kg: diagnostics.mass_kg,
        constraint_forces: diagnostics.constraint_forces,
        mass_matrix_reciprocal_condition: diagnostics.mass_matrix_reciprocal_condition,
        constraint_reciprocal_condition: diagnostics.constraint_reciprocal_condition,
    }
}

/// An energy as a message.
pub fn energy(energy: Energy) -> v1::Energy {
    v1::Energy { kinetic_j: energy.kinetic_j, potential_j: energy.potential_j }
}

/// A linearization at `x[step]` as a message.
pub fn linearization(step: u64, linearization: &Linearization) -> v1::Linearization {
    v1::Linearization {
        step,
        a: Some(matrix(&linearization.a())),
        b: Some(matrix(&linearization.b())),
        multipliers_x: Some(matrix(&linearization.multipliers_x())),
        multipliers_u: Some(matrix(&linearization.multipliers_u())),
    }
}
