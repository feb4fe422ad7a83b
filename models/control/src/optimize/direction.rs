//! The direction of an iteration: the linear-quadratic problem of a method, and the motion that it asks
//! for.

use std::ops::ControlFlow;

use nalgebra::{DMatrix, DVector};
use plantd_math::null_space::tangent_basis;
use plantd_math::sparse_map::Map;
use plantd_models::Contraction;

use crate::lq::recursion::LqRecursion;
use crate::optimize::derivatives::{CostDerivatives, SecondDerivatives};
use crate::optimize::error::OptimizeError;
use crate::optimize::linearizer::{Linearizer, block_length};
use crate::optimize::options::Method;
use crate::optimize::problem::{Point, Problem};
use crate::optimize::products::{dot, subtract_product};
use crate::optimize::question::{Question, ask_at};

/// Curvature, relative to the largest, that a free initial state is given where projected momenta leave it
/// none.
const LEAST_CURVATURE: f64 = 1e-10;

/// A direction, `dx` and `du`, and the law of the descent that leads along it.
#[derive(Debug)]
pub(super) struct Direction {
    pub(super) dx: Vec<f64>,
    pub(super) du: Vec<f64>,
    pub(super) gains: Vec<DMatrix<f64>>,
    offsets: Vec<DVector<f64>>,
    /// Whether that law is the one of the projection, too.
    pub(super) is_projection: bool,
    recursion: LqRecursion,
    pub(super) map_curvature: MapCurvature,
    packed: Vec<f64>,
}

/// Second derivatives of the map, contracted with the adjoint.
#[derive(Debug)]
pub(super) struct MapCurvature {
    /// The adjoint along a projection of its own.
    pub(super) adjoint: Vec<DVector<f64>>,
    /// Contractions of the block at hand, and of the one that is made meanwhile; empty without such a
    /// projection.
    blocks: [Vec<SecondDerivatives>; 2],
    /// Of the step at hand, where the recursion contracts it itself.
    pub(super) contraction: Contraction,
    pub(super) second: SecondDerivatives,
    pub(super) zero_multipliers: Vec<f64>,
    offset: DVector<f64>,
    packed: Vec<f64>,
}

impl MapCurvature {
    /// `in_blocks` where a projection of its own gives the adjoint.
    fn new(problem: &Problem, in_blocks: bool) -> Self {
        let (states, inputs) = (problem.states, problem.inputs);
        let block = if in_blocks { block_length(states).min(problem.steps) } else { 0 };
        Self {
            adjoint: vec![DVector::zeros(states); problem.steps + 1],
            blocks: [0; 2].map(|_| vec![SecondDerivatives::zeros(states, inputs); block]),
            contraction: Contraction::new(&problem.model),
            second: SecondDerivatives::zeros(states, inputs),
            zero_multipliers: vec![0.0; problem.model.dimensions().constraints],
            offset: DVector::zeros(inputs),
            packed: Vec::new(),
        }
    }

    /// Finds the adjoint along the projection, `z[k] = l_x − Kᵀ l_u + (A − BK)ᵀ z[k+1]`.
    pub(super) fn find_adjoint(
        &mut self,
        derivatives: &CostDerivatives,
        maps: &[Map],
        gains: &[DMatrix<f64>],
        go_on: Question<'_>,
    ) -> Result<(), OptimizeError> {
        let Self { adjoint, offset, packed, .. } = self;
        adjoint[maps.len()].copy_from(&derivatives.by_x[maps.len()]);
        for (k, map) in maps.iter().enumerate().rev() {
            ask_at(k, go_on)?;
            let (head, tail) = adjoint.split_at_mut(k + 1);
            let (z, next) = (&mut head[k], &tail[0]);
            // l_x + Aᵀ z[k+1] − Kᵀ (l_u + Bᵀ z[k+1]).
            z.copy_from(&derivatives.by_x[k]);
            offset.copy_from(&derivatives.by_u[k]);
            let (by_x, by_u) = (z.as_mut_slice(), offset.as_mut_slice());
            map.add_pulled_back(next.as_slice(), packed, by_x, by_u);
            z.gemv_tr(-1.0, &gains[k], offset, 1.0);
        }
        Ok(())
    }
}

impl Direction {
    /// `contracts_in_blocks` where Newton's method has the adjoint of a projection of its own.
    pub(super) fn new(problem: &Problem, contracts_in_blocks: bool) -> Self {
        let (states, inputs, steps) = (problem.states, problem.inputs, problem.steps);
        Self {
            dx: vec![0.0; (steps + 1) * states],
            du: vec![0.0; steps * inputs],
            gains: vec![DMatrix::zeros(inputs, states); steps],
            offsets: vec![DVector::zeros(inputs); steps],
            is_projection: false,
            recursion: LqRecursion::new(states, inputs),
            map_curvature: MapCurvature::new(problem, contracts_in_blocks),
            packed: Vec::new(),
        }
    }

    /// Finds the law of a method's descent; the step at which its quadratic model has no minimum. Newton's
    /// method takes the linear part of the cost to go for the adjoint.
    pub(super) fn find_law(
        &mut self,
        point: Point<'_>,
        method: Method,
        derivatives: &mut CostDerivatives,
        linearizer: &mut Linearizer,
        go_on: Question<'_>,
    ) -> Result<Option<usize>, OptimizeError> {
        self.begin(point, method, derivatives);
        let Self { gains, offsets, recursion, map_curvature, .. } = self;
        let MapCurvature { contraction, second, zero_multipliers: zero, .. } = map_curvature;
        linearizer.visit_backwards(point.motion, go_on, |k, map, linearization| {
            let stage = match linearization.filter(|_| method == Method::Newton) {
                Some(linearization) => {
                    let z = recursion.linear().as_slice();
                    contraction
                        .contract(&point.problem.model, linearization, z, zero)
                        .map_err(|error| OptimizeError::Linearization { step: k, error })?;
                    second.copy_from(contraction);
                    derivatives.newton_stage(point, k, second)
                }
                None => derivatives.stage(point, k, method),
            };
            let found = recursion.step(map, stage, &mut gains[k], &mut offsets[k]);
            Ok(found.map_or(ControlFlow::Break(()), ControlFlow::Continue))
        })
    }

    /// Finds the law of Newton's descent, with the second derivatives of the map along the adjoint that was
    /// found, contracted block by block; the step at which the quadratic model has no minimum.
    pub(super) fn find_law_in_blocks(
        &mut self,
        point: Point<'_>,
        derivatives: &mut CostDerivatives,
        linearizer: &mut Linearizer,
        go_on: Question<'_>,
    ) -> Result<Option<usize>, OptimizeError> {
        self.begin(point, Method::Newton, derivatives);
        let Self { gains, offsets, recursion, map_curvature, .. } = self;
        let MapCurvature { adjoint, blocks, zero_multipliers: zero, .. } = map_curvature;
        let model = &*point.problem.model;
        linearizer.visit_contracted(
            blocks,
            go_on,
            |contraction, k, linearization, second: &mut SecondDerivatives| {
                contraction.contract(model, linearization, adjoint[k + 1].as_slice(), zero)?;
                second.copy_from(contraction);
                Ok(())
            },
            |k, map, second| {
                let stage = derivatives.newton_stage(point, k, second);
                let found = recursion.step(map, stage, &mut gains[k], &mut offsets[k]);
                Ok(found.map_or(ControlFlow::Break(()), ControlFlow::Continue))
            },
        )
    }

    fn begin(&mut self, point: Point<'_>, method: Method, derivatives: &mut CostDerivatives) {
        derivatives.final_weight(point, method);
        let CostDerivatives { by_x, second, .. } = derivatives;
        self.recursion.begin(&second.xx, Some(&by_x[point.problem.steps]));
    }

    /// Finds the best change `dx[0]` of the initial state, where the constraint Jacobian is `jacobian`;
    /// false if there is none.
    pub(super) fn find_initial_change(
        &mut self,
        Point { problem, motion, .. }: Point<'_>,
        entries: &[bool],
        jacobian: &DMatrix<f64>,
    ) -> bool {
        let basis = free_directions(entries, jacobian, motion.d.coordinates());
        if basis.ncols() == 0 {
            return true;
        }
        let mut value = self.recursion.value();
        if let Some((change, weight)) = problem.initial_change(motion.x(0)) {
            value += problem.turned_weight(change.as_slice(), weight);
        }
        let mut reduced = basis.transpose() * (value * &basis);
        if problem.projects() {
            // What a momentum has along `Dh_dᵀ` costs nothing.
            let least = LEAST_CURVATURE * reduced.diagonal().amax();
            (0..reduced.nrows()).for_each(|i| reduced[(i, i)] += least);
        }
        let slope = basis.tr_mul(self.recursion.linear());
        let Some(factor) = reduced.cholesky() else { return false };
        let step = -(&basis * factor.solve(&slope));
        self.dx[..problem.states].copy_from_slice(step.as_slice());
        true
    }

    /// Runs the law through the linearized map from `dx[0]`; returns the directional derivative.
    pub(super) fn roll_out(
        &mut self,
        derivatives: &CostDerivatives,
        maps: &[Map],
        go_on: Question<'_>,
    ) -> Result<f64, OptimizeError> {
        let CostDerivatives { by_x, by_u, .. } = derivatives;
        let (states, inputs) = (by_x[0].len(), by_u[0].len());
        let Self { dx, du, gains, offsets, packed, .. } = self;
        let mut derivative = dot(by_x[0].as_slice(), &dx[..states]);
        for (k, map) in maps.iter().enumerate() {
            ask_at(k, go_on)?;
            let (head, tail) = dx.split_at_mut((k + 1) * states);
            let (x, next) = (&head[k * states..], &mut tail[..states]);
            let u = &mut du[k * inputs..][..inputs];
            for (u, offset) in u.iter_mut().zip(offsets[k].iter()) {
                *u = -offset;
            }
            subtract_product(&gains[k], x, u);
            map.apply(x, u, packed, next);
            derivative += dot(by_u[k].as_slice(), u) + dot(by_x[k + 1].as_slice(), next);
        }
        Ok(derivative)
    }
}

/// Directions of `x` along free entries that keep the constraints, as orthonormal columns.
fn free_directions(entries: &[bool], jacobian: &DMatrix<f64>, n: usize) -> DMatrix<f64> {
    let free = |range: std::ops::Range<usize>| range.filter(|i| entries[*i]).collect::<Vec<_>>();
    let (configuration, others) = (free(0..n), free(n..entries.len()));
    let mut columns = DMatrix::zeros(jacobian.nrows(), configuration.len());
    for (to, &from) in configuration.iter().enumerate() {
        columns.set_column(to, &jacobian.column(from));
    }
    let tangent = tangent_basis(&columns);
    let mut basis = DMatrix::zeros(entries.len(), tangent.ncols() + others.len());
    for (row, &entry) in configuration.iter().enumerate() {
        basis.view_mut((entry, 0), (1, tangent.ncols())).copy_from(&tangent.row(row));
    }
    for (column, &entry) in others.iter().enumerate() {
        basis[(entry, tangent.ncols() + column)] = 1.0;
    }
    basis
}
