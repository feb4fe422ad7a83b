//! Analysis of the linearized map: ranks, modes and frequency responses.

use std::sync::Arc;

use nalgebra::DMatrix;
use plantd_control::{self as control, Mode, TransferFunction};
use plantd_models::scene::UnknownName;
use plantd_models::{Continuous, ContinuousPoint, Linearization, Model, Plant};
use plantd_proto::v1;

use crate::core::feedback::regulator::Constraints;
use crate::core::feedback::space::Space;
use crate::core::limits::LimitExceeded;
use crate::core::workers::pool::Abandoned;
use crate::wire::control::points::at_point;
use crate::wire::message::{checks, matrices, states};
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// Velocity up to which a point counts as one at rest, m/s or rad/s.
const REST: f64 = 1e-9;

/// Answers an Analyze call.
pub(crate) fn analyze(
    hub: &Hub,
    request: v1::AnalyzeRequest,
    abandoned: &Abandoned,
) -> Result<v1::AnalyzeResponse, RpcError> {
    let constraints = Constraints::new(request.constraints)?;
    let (mut plant, u) = at_point(hub, &request.model, request.settings, request.point)?;
    let (x, u_matrix) = (request.output_x.as_ref(), request.output_u.as_ref());
    let outputs = Outputs::with_velocities("", request.outputs, x, u_matrix, &mut plant)?;
    check_frequencies(hub, &request.frequencies_hz, &outputs)?;
    let mut linearization = Linearization::new(plant.model());
    plant.linearize(&u, &mut linearization)?;
    let (a, b) = (linearization.a(), linearization.b());
    abandoned.check()?;

    let space = Space::new(&mut plant, constraints);
    let modes = control::modes(&space.free(&a), plant.settings().time_step_s)?;
    abandoned.check()?;
    let (a_moving, b_moving, c_moving) = space.moving(&a, &b, &outputs.x);
    let controllability_rank = control::controllability_rank(&a_moving, &b_moving);
    let observability_rank = control::observability_rank(&a_moving, &c_moving);
    let responses = responses(&request.frequencies_hz, &a, &b, &outputs, &plant, abandoned)?;
    Ok(v1::AnalyzeResponse {
        order: a_moving.nrows() as u32,
        controllability_rank: controllability_rank as u32,
        observability_rank: observability_rank as u32,
        spectral_radius: modes.first().map_or(0.0, |mode| mode.modulus),
        modes: modes.into_iter().map(mode).collect(),
        responses,
        outputs: outputs.names,
        state: Some(states::plant_state(&mut plant)),
        u,
    })
}

/// Outputs `y = x_matrix x + u_matrix u`.
pub(crate) struct Outputs {
    pub(crate) names: Vec<String>,
    pub(crate) x: DMatrix<f64>,
    pub(crate) u: DMatrix<f64>,
}

impl Outputs {
    /// From the fields `outputs`, `output_x` and `output_u` of what `prefix` names.
    pub(crate) fn new(
        prefix: &str,
        names: Vec<String>,
        x: Option<&v1::Matrix>,
        u: Option<&v1::Matrix>,
        model: &Model,
    ) -> Result<Self, RpcError> {
        let d = model.dimensions();
        let (nx, nu) = (d.state(), d.input());
        let Some(given) = x else {
            if u.is_some() {
                let problem = "is given without `output_x`";
                return Err(RpcError::field(format!("{prefix}output_u"), problem));
            }
            return Self::named(prefix, names, model);
        };
        if !names.is_empty() {
            let problem = "are given together with `output_x`";
            return Err(RpcError::field(format!("{prefix}outputs"), problem));
        }
        if given.rows as usize > nx {
            let problem = format!("has {} rows; the state has {nx} entries", given.rows);
            return Err(RpcError::field(format!("{prefix}output_x.rows"), problem));
        }
        let x = matrices::matrix_of(&format!("{prefix}output_x"), given, None, nx)?;
        let u = match u {
            Some(given) => {
                matrices::matrix_of(&format!("{prefix}output_u"), given, Some(x.nrows()), nu)?
            }
            None => DMatrix::zeros(x.nrows(), nu),
        };
        let names = (0..x.nrows()).map(|i| format!("y{i}")).collect();
        Ok(Self { names, x, u })
    }

    /// The same, where an output may also be the velocity `v(theta)` of a dynamic coordinate.
    pub(crate) fn with_velocities(
        prefix: &str,
        names: Vec<String>,
        x: Option<&v1::Matrix>,
        u: Option<&v1::Matrix>,
        plant: &mut Plant,
    ) -> Result<Self, RpcError> {
        let model = Arc::clone(plant.model());
        let dynamic = &model.coordinates()[..model.dimensions().dynamic];
        let index = |name: &String| {
            let of = name.strip_prefix("v(")?.strip_suffix(')')?;
            dynamic.iter().position(|coordinate| coordinate.name == of)
        };
        let moving: Vec<Option<usize>> = names.iter().map(index).collect();
        if moving.iter().all(Option::is_none) || x.is_some() {
            return Self::new(prefix, names, x, u, &model);
        }
        let entry = |(name, moving): (&String, &Option<usize>)| match moving {
            Some(index) => dynamic[*index].name.clone(),
            None => name.clone(),
        };
        let entries = names.iter().zip(&moving).map(entry).collect();
        let mut outputs = Self::new(prefix, entries, x, u, &model)?;
        let velocities = velocities(plant)
            .map_err(|problem| RpcError::field(format!("{prefix}outputs"), problem))?;
        for (row, index) in moving.iter().enumerate() {
            if let Some(index) = index {
                outputs.x.row_mut(row).copy_from(&velocities.row(*index));
            }
        }
        Ok(Self { names, ..outputs })
    }

    /// Entries of x by name; all of them when there are no names.
    fn named(prefix: &str, names: Vec<String>, model: &Model) -> Result<Self, RpcError> {
        let d = model.dimensions();
        let known = states::state_names(model);
        if names.is_empty() {
            let identity = DMatrix::identity(d.state(), d.state());
            return Ok(Self { names: known, x: identity, u: DMatrix::zeros(d.state(), d.input()) });
        }
        if names.len() > d.state() {
            let problem = format!("has {} entries; the state has {}", names.len(), d.state());
            return Err(RpcError::field(format!("{prefix}outputs"), problem));
        }
        let mut x = DMatrix::zeros(names.len(), d.state());
        for (row, name) in names.iter().enumerate() {
            let column = known.iter().position(|known| known == name).ok_or_else(|| {
                let name = UnknownName::among(name, &known);
                let problem = format!("there is no state entry {name}");
                RpcError::field(format!("{prefix}outputs[{row}]"), problem)
            })?;
            x[(row, column)] = 1.0;
        }
        let u = DMatrix::zeros(names.len(), d.input());
        Ok(Self { names, x, u })
    }
}

/// The derivatives of the velocities of the dynamic coordinates by `x = (q, p, v)`, at rest, where the mass matrix does
/// not change: `M_d⁻¹ (dp̃ − M_k dv)`, of the momentum p̃ projected onto the constraints.
fn velocities(plant: &mut Plant) -> Result<DMatrix<f64>, String> {
    let d = plant.model().dimensions();
    if plant.velocity().iter().any(|v| v.abs() > REST) {
        return Err("velocities are outputs of points at rest alone".to_owned());
    }
    let (nd, nk) = (d.dynamic, d.prescribed);
    let point = ContinuousPoint {
        q: plant.q().to_vec(),
        v: vec![0.0; nd + nk],
        inputs: vec![0.0; d.inputs],
        prescribed_acceleration: vec![0.0; nk],
    };
    let terms = Continuous::new(Arc::clone(plant.model())).terms(&point);
    let mass = terms.map_err(|error| error.to_string())?.mass_matrix;
    let mut momentum = plant.projected_momentum_by_state();
    let mut by_prescribed = momentum.columns_mut(d.state() - nk, nk);
    by_prescribed -= mass.view((0, nd), (nd, nk));
    let factors = mass.view((0, 0), (nd, nd)).into_owned().cholesky();
    let factors = factors.ok_or("the mass matrix is singular: momenta give no velocities")?;
    Ok(factors.solve(&momentum))
}

/// Refuses more frequencies than the limits allow, and those that are no numbers.
fn check_frequencies(hub: &Hub, frequencies_hz: &[f64], outputs: &Outputs) -> Result<(), RpcError> {
    let count = frequencies_hz.len();
    LimitExceeded::check("frequencies", hub.limits.frequencies, "frequencies", count)?;
    let numbers = count.saturating_mul(2 * outputs.u.len());
    let (name, limit) = ("reply_numbers", hub.limits.reply_numbers);
    LimitExceeded::check(name, limit, "numbers in the responses", numbers)?;
    checks::check_finite("frequencies_hz", frequencies_hz)
}

fn responses(
    frequencies_hz: &[f64],
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    outputs: &Outputs,
    plant: &Plant,
    abandoned: &Abandoned,
) -> Result<Vec<v1::FrequencyResponse>, RpcError> {
    if frequencies_hz.is_empty() {
        return Ok(Vec::new());
    }
    let time_step_s = plant.settings().time_step_s;
    let transfer = TransferFunction::new(a, b, &outputs.x, &outputs.u, time_step_s)?;
    let response = |&frequency_hz: &f64| {
        abandoned.check()?;
        let response = transfer.at(frequency_hz)?;
        Ok(v1::FrequencyResponse {
            frequency_hz,
            magnitude: Some(matrices::matrix(&response.map(|entry| entry.norm()))),
            phase_rad: Some(matrices::matrix(&response.map(|entry| entry.arg()))),
        })
    };
    frequencies_hz.iter().map(response).collect()
}

fn mode(mode: Mode) -> v1::Mode {
    v1::Mode {
        real: mode.real,
        imaginary: mode.imaginary,
        modulus: mode.modulus,
        natural_frequency_hz: mode.natural_frequency_hz,
        damping_ratio: mode.damping_ratio,
        time_constant_s: mode.time_constant_s,
    }
}
