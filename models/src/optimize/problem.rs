//! What does not change during a search: the cost, and where it is bounded.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};

use super::bounds::{Ends, Of};
use super::trajectory::rows;
use super::{Bounds, FreeInitialState, OptimizeError, TrajectoryCost};
use crate::control::matrix::symmetrize;
use crate::control::weights::error::WeightsError;
use crate::control::weights::{Momentum, StageWeights, TrajectoryWeights, Weights};
use crate::plant::balls::three;
use crate::rotation::{self, Quaternion};
use crate::scalar::Dual;
use crate::spatial::{Mat3, Vec3};
use crate::{Model, Plant};

/// A symmetric weight, which is diagonal more often than not.
#[derive(Clone, Debug)]
enum Shape {
    Diagonal,
    Full,
}

impl Shape {
    fn of(m: &DMatrix<f64>) -> Self {
        let off = |(i, j): (usize, usize)| i != j && m[(i, j)] != 0.0;
        let n = m.nrows();
        if (0..n).any(|j| (0..n).any(|i| off((i, j)))) { Self::Full } else { Self::Diagonal }
    }

    /// `out = m v`.
    fn multiply(&self, m: &DMatrix<f64>, v: &[f64], out: &mut [f64]) {
        match self {
            Self::Diagonal => {
                for (i, (out, v)) in out.iter_mut().zip(v).enumerate() {
                    *out = m[(i, i)] * v;
                }
            }
            Self::Full => {
                out.fill(0.0);
                for (column, v) in m.as_slice().chunks_exact(out.len().max(1)).zip(v) {
                    if *v != 0.0 {
                        out.iter_mut().zip(column).for_each(|(out, m)| *out += m * v);
                    }
                }
            }
        }
    }
}

/// Deviations from what is desired, and what the weights make of them, of one step.
#[derive(Clone, Debug)]
pub(super) struct Deviation {
    /// `x ⊖ x_desired`, of projected momenta where these are weighed.
    pub(super) x: Vec<f64>,
    /// `u − u_desired`.
    pub(super) u: Vec<f64>,
    /// `Q dx + S du + x_linear`.
    by_x: Vec<f64>,
    /// `R du + Sᵀ dx + u_linear`.
    by_u: Vec<f64>,
    /// At `x`; none where the state's own momentum is weighed.
    projector: Option<Box<Plant>>,
    /// `∂(p̃ − p)/∂x` of each step, as the last gradient there has found it; none without a projector.
    projections: Vec<DMatrix<f64>>,
}

#[derive(Debug)]
pub(super) struct Problem {
    pub(super) model: Arc<Model>,
    pub(super) steps: usize,
    pub(super) states: usize,
    pub(super) inputs: usize,
    weights: TrajectoryWeights,
    shapes: Vec<[Shape; 2]>,
    final_shape: Shape,
    /// Projects momenta; none where the state's own are weighed.
    projector: Option<Box<Plant>>,
    /// With projected momenta where these are weighed.
    x_desired: Vec<f64>,
    u_desired: Vec<f64>,
    pub(super) ends: Ends,
    pub(super) free: Option<Free>,
    /// No step costs less than nothing.
    pub(super) is_nonnegative: bool,
}

/// A free initial state.
#[derive(Debug)]
pub(super) struct Free {
    pub(super) entries: Vec<bool>,
    pub(super) weight: Option<DMatrix<f64>>,
}

impl Problem {
    pub(super) fn new(
        plant: &Plant,
        steps: usize,
        cost: TrajectoryCost,
        bounds: &Bounds,
        free: Option<FreeInitialState>,
    ) -> Result<Self, OptimizeError> {
        let model = Arc::clone(plant.model());
        let d = model.dimensions();
        let (states, inputs) = (d.state(), d.input());
        check("the desired x", &cost.x, steps + 1, states)?;
        check("the desired u", &cost.u, steps, inputs)?;
        let weights = cost.weights;
        for (weight, size, expected) in
            [("q", weights.states(), states), ("r", weights.inputs(), inputs)]
        {
            if size != expected {
                return Err(WeightsError::Dimension {
                    weight,
                    rows: size,
                    cols: size,
                    expected_rows: expected,
                    expected_cols: expected,
                }
                .into());
            }
        }
        if let Some(actual) = weights.steps().filter(|actual| *actual != steps) {
            return Err(OptimizeError::Stages { actual, expected: steps });
        }
        let own = weights.steps().unwrap_or(1).min(steps);
        let shapes = (0..own).map(|k| [weights.stage(k).q(), weights.stage(k).r()].map(Shape::of));
        let plain = |stage: &StageWeights| {
            stage.is_convex() && stage.x_linear().is_none() && stage.u_linear().is_none()
        };
        let is_nonnegative = (0..own).all(|k| plain(weights.stage(k)));
        let free = free.map(|free| Free::new(free, states)).transpose()?;
        let scale = |of, index| {
            let stage = weights.stage(0);
            let all =
                if of == Of::Input { stage.r().diagonal() } else { weights.q_final().diagonal() };
            let all = if of == Of::State { stage.q().diagonal() } else { all };
            let positive = all.iter().filter(|weight| **weight > 0.0);
            let mean = positive.clone().sum::<f64>() / positive.count().max(1) as f64;
            match all[index] {
                weight if weight > 0.0 => weight,
                _ if mean > 0.0 => mean,
                _ => 1.0,
            }
        };
        let projects = cost.momentum == Momentum::Projected && d.constraints > 0;
        let mut projector = projects.then(|| Box::new(plant.clone()));
        let x_desired = desired_states(&cost.x, projector.as_deref_mut())?;
        let ends = Ends::new(bounds, (states, inputs), steps, scale)?;
        Ok(Self {
            steps,
            states,
            inputs,
            shapes: shapes.collect(),
            final_shape: Shape::of(weights.q_final()),
            x_desired,
            projector,
            u_desired: rows(&cost.u),
            weights,
            ends,
            free,
            is_nonnegative,
            model,
        })
    }

    pub(super) fn deviation(&self) -> Deviation {
        let (x, u) = (vec![0.0; self.states], vec![0.0; self.inputs]);
        let projector = self.projector.clone();
        let count = if projector.is_some() { self.steps + 1 } else { 0 };
        let projections = vec![DMatrix::zeros(0, 0); count];
        Deviation { by_x: x.clone(), by_u: u.clone(), x, u, projector, projections }
    }

    pub(super) fn stage(&self, k: usize) -> &StageWeights {
        self.weights.stage(k)
    }

    /// Whether these are the second derivatives of all steps.
    pub(super) fn has_weights(&self, weights: &Weights) -> bool {
        let (own, other) = (self.weights.stage(0), weights.stage());
        self.weights.steps().is_none()
            && (own.q(), own.r(), own.s()) == (other.q(), other.r(), other.s())
            && self.weights.q_final() == weights.q_final()
    }

    pub(super) fn q_final(&self) -> &DMatrix<f64> {
        self.weights.q_final()
    }

    /// `x ⊖ reference`, of whole states.
    pub(super) fn difference(&self, reference: &[f64], x: &[f64], out: &mut [f64]) {
        for (out, (x, r)) in out.iter_mut().zip(x.iter().zip(reference)) {
            *out = x - r;
        }
        for &i in &self.model.orientations {
            let from = Quaternion::exp(three(reference, i)).inverse();
            let turned = from.times(Quaternion::exp(three(x, i)));
            out[i..i + 3].copy_from_slice(&turned.log().0);
        }
    }

    /// `x` moved by `length · change`, of whole states.
    pub(super) fn retract(&self, x: &[f64], change: &[f64], length: f64, out: &mut [f64]) {
        for (out, (x, change)) in out.iter_mut().zip(x.iter().zip(change)) {
            *out = x + length * change;
        }
        for &i in &self.model.orientations {
            let turn = Quaternion::exp(three(change, i) * length);
            out[i..i + 3].copy_from_slice(&Quaternion::exp(three(x, i)).times(turn).log().0);
        }
    }

    /// Evaluates the deviation at step `k`; of the final step without `u`. Returns the cost.
    pub(super) fn evaluate(&self, k: usize, x: &[f64], u: &[f64], at: &mut Deviation) -> f64 {
        let desired = &self.x_desired[k * self.states..][..self.states];
        self.difference(desired, x, &mut at.x);
        if let Some(plant) = &mut at.projector {
            let momentum = self.model.dimensions().momentum();
            plant.place(x);
            let momenta = plant.projected_momentum().into_iter().zip(&desired[momentum.clone()]);
            for (dx, (p, desired)) in at.x[momentum].iter_mut().zip(momenta) {
                *dx = p - desired;
            }
        }
        if k == self.steps {
            self.final_shape.multiply(self.weights.q_final(), &at.x, &mut at.by_x);
            return 0.5 * dot(&at.x, &at.by_x);
        }
        let desired = &self.u_desired[k * self.inputs..][..self.inputs];
        for (du, (u, desired)) in at.u.iter_mut().zip(u.iter().zip(desired)) {
            *du = u - desired;
        }
        let stage = self.weights.stage(k);
        let [q, r] = &self.shapes[if self.shapes.len() == 1 { 0 } else { k }];
        q.multiply(stage.q(), &at.x, &mut at.by_x);
        r.multiply(stage.r(), &at.u, &mut at.by_u);
        let mut cost = 0.5 * (dot(&at.x, &at.by_x) + dot(&at.u, &at.by_u));
        if let Some(s) = stage.s() {
            for (column, (by_u, du)) in
                s.as_slice().chunks_exact(self.states.max(1)).zip(at.by_u.iter_mut().zip(&at.u))
            {
                let product = dot(column, &at.x);
                cost += product * du;
                *by_u += product;
                at.by_x.iter_mut().zip(column).for_each(|(by_x, s)| *by_x += s * du);
            }
        }
        let linear =
            [(stage.x_linear(), &at.x, &mut at.by_x), (stage.u_linear(), &at.u, &mut at.by_u)];
        for (weight, deviation, by) in linear {
            if let Some(weight) = weight {
                cost += dot(weight.as_slice(), deviation);
                by.iter_mut().zip(weight.iter()).for_each(|(by, w)| *by += w);
            }
        }
        cost
    }

    /// What bounds add to the cost at step `k`.
    pub(super) fn penalty(
        &self,
        k: usize,
        (x, u): (&[f64], &[f64]),
        (multipliers, penalty): (&[f64], f64),
    ) -> f64 {
        if self.ends.is_empty() {
            return 0.0;
        }
        let of_x = self.ends.at(false, k).map(|(end, place)| (end, x[end.index], place));
        let inputs = if k < self.steps { Some(k) } else { None };
        let of_u = inputs.into_iter().flat_map(|k| self.ends.at(true, k));
        let of_u = of_u.map(|(end, place)| (end, u[end.index], place));
        let value = |(end, number, place): (&super::bounds::End, f64, usize)| {
            end.penalty(number, multipliers[place], penalty).value
        };
        of_x.chain(of_u).map(value).sum()
    }

    /// Writes the gradient of the cost at the deviation, which was evaluated at `x`.
    pub(super) fn gradient(
        &self,
        k: usize,
        (x, u): (&[f64], &[f64]),
        at: &mut Deviation,
        (multipliers, penalty): (&[f64], f64),
        by_x: &mut DVector<f64>,
        by_u: Option<&mut DVector<f64>>,
    ) {
        by_x.copy_from_slice(&at.by_x);
        for &i in &self.model.orientations {
            let turned = chart(&at.x, i).apply_transposed(three(&at.by_x, i));
            by_x.rows_mut(i, 3).copy_from_slice(&turned.0);
        }
        if let Some(plant) = &mut at.projector {
            let momentum = self.model.dimensions().momentum();
            let mut change = plant.projected_momentum_by_state();
            for (i, j) in momentum.clone().enumerate() {
                change[(i, j)] -= 1.0;
            }
            let by_p = by_x.rows_range(momentum).into_owned();
            by_x.gemv_tr(1.0, &change, &by_p, 1.0);
            at.projections[k] = change;
        }
        for (end, place) in self.ends.at(false, k) {
            let slope = end.penalty(x[end.index], multipliers[place], penalty).slope;
            match self.ball_of(end.index) {
                None => by_x[end.index] += slope,
                Some(i) => {
                    let row = chart(x, i).transpose().0[end.index - i] * slope;
                    (0..3).for_each(|a| by_x[i + a] += row[a]);
                }
            }
        }
        if let Some(by_u) = by_u {
            by_u.copy_from_slice(&at.by_u);
            for (end, place) in self.ends.at(true, k) {
                by_u[end.index] += end.penalty(u[end.index], multipliers[place], penalty).slope;
            }
        }
    }

    /// First coordinate of the ball joint that an entry of `x` belongs to.
    fn ball_of(&self, entry: usize) -> Option<usize> {
        self.model.orientations.iter().copied().find(|i| (*i..*i + 3).contains(&entry))
    }

    /// Turns second derivatives by `dx` into ones by the tangent space at `x`.
    pub(super) fn turn_weights(&self, at: &Deviation, q: &mut DMatrix<f64>, s: &mut DMatrix<f64>) {
        for &i in &self.model.orientations {
            let map = chart(&at.x, i);
            turn_rows(&map, i, q);
            turn_rows(&map, i, s);
            let mut transposed = q.transpose();
            turn_rows(&map, i, &mut transposed);
            q.copy_from(&transposed);
        }
    }

    /// Whether projected momenta are weighed in place of others.
    pub(super) fn projects(&self) -> bool {
        self.projector.is_some()
    }

    /// Whether what is weighed is anything but the difference of states.
    pub(super) fn is_curved(&self) -> bool {
        !self.model.orientations.is_empty() || self.projects()
    }

    /// Turns weights of step `k` into second derivatives by the tangent space at `x`, where deviation and
    /// gradient were evaluated; without the curvature of what is weighed.
    pub(super) fn pull_back(
        &self,
        k: usize,
        at: &Deviation,
        q: &mut DMatrix<f64>,
        s: &mut DMatrix<f64>,
    ) {
        self.turn_weights(at, q, s);
        let Some(change) = at.projections.get(k) else { return };
        let momentum = self.model.dimensions().momentum();
        let columns = q.columns_range(momentum.clone()).into_owned();
        q.gemm(1.0, &columns, change, 1.0);
        let change = change.transpose();
        for matrix in [&mut *q, s] {
            let rows = matrix.rows_range(momentum.clone()).into_owned();
            matrix.gemm(1.0, &change, &rows, 1.0);
        }
        symmetrize(q);
    }

    /// Adds the curvature of the rotation vectors themselves, which the gradient weighs.
    pub(super) fn add_chart_curvature(&self, at: &Deviation, q: &mut DMatrix<f64>) {
        for &i in &self.model.orientations {
            let (e, gradient) = (three(&at.x, i), three(&at.by_x, i));
            let map = chart(&at.x, i);
            let mut second = [[0.0; 3]; 3];
            for (a, second) in second.iter_mut().enumerate() {
                let along = map.0[a];
                let moved = Vec3([0, 1, 2].map(|k| Dual::new(e[k], along[k])));
                let change = rotation::momentum_at_start(moved);
                for (b, second) in second.iter_mut().enumerate() {
                    *second = (0..3).map(|k| gradient[k] * change.0[b][k].eps).sum();
                }
            }
            for a in 0..3 {
                for b in 0..3 {
                    q[(i + a, i + b)] += 0.5 * (second[a][b] + second[b][a]);
                }
            }
        }
    }

    /// Adds the second derivatives of the penalties at step `k`.
    pub(super) fn add_penalty_curvature(
        &self,
        k: usize,
        (x, u): (&[f64], &[f64]),
        (multipliers, penalty): (&[f64], f64),
        q: &mut DMatrix<f64>,
        r: Option<&mut DMatrix<f64>>,
    ) {
        for (end, place) in self.ends.at(false, k) {
            let curvature = end.penalty(x[end.index], multipliers[place], penalty).curvature;
            match self.ball_of(end.index) {
                None => q[(end.index, end.index)] += curvature,
                Some(i) => {
                    let row = chart(x, i).transpose().0[end.index - i];
                    for a in 0..3 {
                        (0..3).for_each(|b| q[(i + a, i + b)] += curvature * row[a] * row[b]);
                    }
                }
            }
        }
        if let Some(r) = r {
            for (end, place) in self.ends.at(true, k) {
                r[(end.index, end.index)] +=
                    end.penalty(u[end.index], multipliers[place], penalty).curvature;
            }
        }
    }

    /// Whether penalties bend the cost of step `k` at all.
    pub(super) fn has_bounds(&self) -> bool {
        !self.ends.is_empty()
    }
}

/// The desired states, one after the other, with their momenta projected if they are to be.
fn desired_states(x: &DMatrix<f64>, plant: Option<&mut Plant>) -> Result<Vec<f64>, OptimizeError> {
    let mut desired = rows(x);
    let Some(plant) = plant else { return Ok(desired) };
    let d = plant.model().dimensions();
    for (row, x) in desired.chunks_exact_mut(d.state().max(1)).enumerate() {
        plant.place(x);
        let p = plant.projected_momentum();
        if let Some(i) = p.iter().position(|entry| !entry.is_finite()) {
            let what = "the projected momentum of the desired x";
            return Err(OptimizeError::NotFinite { what, row, col: d.coordinates() + i });
        }
        x[d.momentum()].copy_from_slice(&p);
    }
    Ok(desired)
}

impl Free {
    fn new(free: FreeInitialState, states: usize) -> Result<Self, OptimizeError> {
        let all = free.entries.is_empty();
        let mut entries = vec![all; states];
        for entry in free.entries {
            *entries.get_mut(entry).ok_or(OptimizeError::FreeEntry { entry, states })? = true;
        }
        if let Some(weight) = &free.weight {
            // Convex and of the right size, by the rules of any state weight.
            if weight.shape() != (states, states) {
                let (rows, cols) = weight.shape();
                return Err(OptimizeError::Dimension {
                    what: "the weight of the initial state",
                    rows,
                    cols,
                    expected_rows: states,
                    expected_cols: states,
                });
            }
            StageWeights::new(weight.clone(), DMatrix::zeros(0, 0), None, None, None)?;
        }
        Ok(Self { entries, weight: free.weight })
    }
}

/// How the rotation vector at `e[i..]` changes with a turn of what it leads to, in its own axes.
pub(super) fn chart(e: &[f64], i: usize) -> Mat3 {
    rotation::momentum_at_start(three(e, i))
}

/// `rows ← mapᵀ rows`, three of them from `i` on.
fn turn_rows(map: &Mat3, i: usize, matrix: &mut DMatrix<f64>) {
    for mut column in matrix.column_iter_mut() {
        let turned = map.apply_transposed(Vec3([column[i], column[i + 1], column[i + 2]]));
        column.rows_mut(i, 3).copy_from_slice(&turned.0);
    }
}

pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Refuses a matrix of another shape, or with numbers that are not finite.
pub(super) fn check(
    what: &'static str,
    matrix: &DMatrix<f64>,
    expected_rows: usize,
    expected_cols: usize,
) -> Result<(), OptimizeError> {
    let (rows, cols) = matrix.shape();
    if (rows, cols) != (expected_rows, expected_cols) {
        return Err(OptimizeError::Dimension { what, rows, cols, expected_rows, expected_cols });
    }
    match matrix.iter().position(|entry| !entry.is_finite()) {
        None => Ok(()),
        Some(index) => Err(OptimizeError::NotFinite { what, row: index % rows, col: index / rows }),
    }
}
