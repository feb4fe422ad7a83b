//! The exact first-order linearization of a step, in increment form.
//!
//! Unknown `y = (x, λ)`, parameters `θ = (q_d, q_k, p, k, u)`: start configuration (dynamic,
//! prescribed), momentum, next prescribed positions, inputs. With both ends of the step shifted
//! together no terms of size `1/h` cancel. At the midpoint, with `a` the weight of `F⁻`,
//!
//! ```text
//! C_q = ½h L_qq − L_vq        C_v = ½h L_qv − L_vv + a h f_v        H = Σ λ D²h(q[k])
//!
//! column      of r1                       of r2
//! q_d         (C_q − H)_dd                A1_d
//! q_k         (½C_q − C_v/h − H)_dk       0
//! p           1                           0
//! k           (½C_q + C_v/h)_dk           A1_k
//!
//! x' = K⁻¹ (A0ᵀ λ' − r1')      S λ' = A1 K⁻¹ r1' − r2'      q[k+1]' = q_d' + x'
//! p[k+1]' = p' + (½h L_qq + L_qv + h f_v/h) x' + h L_qq q_d' + (prescribed) − A0ᵀ λ' − H q'
//! ```
//!
//! An input acts like momentum: its column is `Σ_i a h ∂f_i/∂u` times that of `p_i`, plus
//! `(1 − a) h ∂f_i/∂u` on `p[k+1]_i`. Prescribed positions that signals replace have no effect.

mod chain;
mod map;
mod step;

use nalgebra::DMatrix;

use crate::Model;
use crate::plant::balls::Turning;
use crate::plant::collocation::StageTangents;
use crate::plant::newton::{At, Workspace};
use crate::plant::pivoted_lu::PivotedLu;
use crate::plant::rows::{padded, spread};
use crate::plant::{Settings, StepError};
use crate::spatial::{Mat3, Vec3};

pub(crate) use chain::{Chain, Part};

/// What a unit input gives to the residual and to `p[k+1]` of a dynamic coordinate.
#[derive(Clone, Copy, Debug)]
struct InputImpulse {
    input: usize,
    coordinate: usize,
    residual: f64,
    momentum: f64,
}

/// What was linearized.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A step of the midpoint rule.
    Step,
    /// One of collocation.
    Collocation,
    /// A control period of so many steps.
    Period { steps: usize },
}

/// The exact first-order linearization of a control period. Preallocated for one step of the midpoint
/// rule; for other methods it gets its memory when it is first used.
#[derive(Clone, Debug)]
pub struct Linearization {
    kind: Kind,
    /// The steps of a period, as many as are kept, and others of periods before.
    parts: Vec<Part>,
    parts_max: usize,
    /// `x'`, `λ'` and `p[k+1]'` by the inputs, row-major, 2 nd + nc rows of ni; for collocation and
    /// periods.
    driven: Vec<f64>,
    /// What the second derivatives of a step of collocation need.
    stages: Option<Box<StageTangents>>,
    nd: usize,
    nk: usize,
    time_step_s: f64,
    ni: usize,
    inputs: Vec<InputImpulse>,
    /// Prescribed coordinates that signals drive, as columns of `B`.
    replaced: Vec<usize>,
    at_start: f64,
    /// Length of a row: the columns of the parameters `(q_d, q_k, p, k)`, padded.
    stride: usize,
    /// `x'`, row-major, nd rows.
    increment: Vec<f64>,
    /// `p[k+1]'`, row-major, nd rows.
    momentum: Vec<f64>,
    /// `λ'`, row-major, nc rows.
    multipliers: Vec<f64>,
    /// How ball joints turn in the step.
    turnings: Vec<Turning>,
    solved: SolvedStep,
}

/// The step that was linearized: what its second derivatives need.
#[derive(Clone, Debug)]
pub(crate) struct SolvedStep {
    pub(crate) settings: Settings,
    /// Configuration at the start, nd + nk, and orientations of ball joints.
    pub(crate) q: Vec<f64>,
    pub(crate) orientations: Vec<Mat3>,
    /// How ball joints turn.
    pub(crate) turns: Vec<Vec3>,
    /// Increments of dynamic coordinates, nd.
    pub(crate) increment: Vec<f64>,
    /// Next positions of prescribed ones, nk, and inputs, ni, with the signals.
    pub(crate) next: Vec<f64>,
    pub(crate) inputs: Vec<f64>,
    /// `λ`, nc.
    pub(crate) multipliers: Vec<f64>,
    /// `K⁻¹ A0ᵀ`, row-major, nd by padded nc.
    pub(crate) responses: Vec<f64>,
    /// The factors of `S`.
    pub(crate) schur: PivotedLu,
    /// Loops were eliminated without these two.
    pub(crate) in_loops: bool,
}

impl SolvedStep {
    fn new(model: &Model) -> Self {
        let d = model.dimensions;
        let zeros = |len: usize| vec![0.0; len];
        Self {
            settings: Settings::new(model),
            q: zeros(d.coordinates()),
            orientations: vec![Mat3::IDENTITY; model.orientations.len()],
            turns: vec![Vec3::ZERO; model.orientations.len()],
            increment: zeros(d.dynamic),
            next: zeros(d.prescribed),
            inputs: zeros(d.inputs),
            multipliers: zeros(d.constraints),
            responses: zeros(d.dynamic * padded(d.constraints)),
            schur: PivotedLu::of_constraints(model, 1),
            in_loops: false,
        }
    }

    /// Remembers the solution in the workspace.
    fn remember(&mut self, workspace: &Workspace, at: At<'_>) {
        let (inputs, next) = at.u.split_at(self.inputs.len());
        self.settings = *at.settings;
        for (to, from) in [
            (&mut self.q, &at.state.q[..]),
            (&mut self.increment, &workspace.increment),
            (&mut self.next, next),
            (&mut self.inputs, inputs),
        ] {
            to.copy_from_slice(from);
        }
        if !self.orientations.is_empty() {
            self.orientations.copy_from_slice(&workspace.orientations_start);
            self.turns.copy_from_slice(&workspace.turns);
        }
        if !self.multipliers.is_empty() {
            self.multipliers.copy_from_slice(&workspace.multipliers);
            self.in_loops = workspace.in_loops;
            if !self.in_loops {
                self.responses.copy_from_slice(&workspace.responses);
                self.schur.take_factors_of(&workspace.schur);
            }
        }
    }
}

impl Linearization {
    /// Room for the linearization of a model.
    pub fn new(model: &Model) -> Self {
        let d = model.dimensions();
        let stride = spread(padded(2 * d.coordinates()));
        Self {
            kind: Kind::Step,
            parts: Vec::new(),
            parts_max: 0,
            driven: Vec::new(),
            stages: None,
            nd: d.dynamic,
            nk: d.prescribed,
            time_step_s: model.scene().time_step_s,
            ni: d.inputs,
            inputs: model
                .input_pattern()
                .map(|(coordinate, input)| InputImpulse {
                    input,
                    coordinate,
                    residual: 0.0,
                    momentum: 0.0,
                })
                .collect(),
            replaced: model.replaced_inputs().collect(),
            at_start: 0.5,
            stride,
            increment: vec![0.0; d.dynamic * stride],
            momentum: vec![0.0; d.dynamic * stride],
            multipliers: vec![0.0; d.constraints * stride],
            turnings: Vec::with_capacity(model.orientations.len()),
            solved: SolvedStep::new(model),
        }
    }

    /// Panics if the linearization was made for a model of other dimensions.
    pub(crate) fn assert_model(&self, model: &Model) {
        let d = model.dimensions;
        assert!(
            self.nd == d.dynamic
                && self.nk == d.prescribed
                && self.constraints() == d.constraints
                && self.ni == d.inputs
                && self.inputs.len() == model.input_pattern().count(),
            "the linearization belongs to another model"
        );
    }

    /// The steps of a period of several; none if it is one step.
    ///
    /// # Errors
    ///
    /// [`StepError::TooManySteps`] if they are not kept.
    pub(crate) fn parts(&self) -> Result<Option<&[Part]>, StepError> {
        match self.kind {
            Kind::Period { steps } if steps > self.parts_max => {
                Err(StepError::TooManySteps { steps })
            }
            Kind::Period { steps } => Ok(Some(&self.parts[..steps])),
            Kind::Step | Kind::Collocation => Ok(None),
        }
    }

    /// The stages of a step of collocation.
    pub(crate) fn stages(&self) -> Option<&StageTangents> {
        if self.kind == Kind::Collocation { self.stages.as_deref() } else { None }
    }

    /// Whether it is one step of the midpoint rule.
    pub(crate) fn is_midpoint_step(&self) -> bool {
        self.kind == Kind::Step
    }

    /// Room for stages, from the last linearization of collocation.
    pub(crate) fn take_stages(&mut self) -> Option<Box<StageTangents>> {
        self.stages.take()
    }

    pub(crate) fn keep_stages(&mut self, stages: Box<StageTangents>) {
        self.stages = Some(stages);
    }

    /// Begins a linearization of collocation over a step of length `h`.
    pub(crate) fn begin_collocation(&mut self, h: f64) {
        self.kind = Kind::Collocation;
        self.time_step_s = h;
        self.turnings.clear();
        self.driven.resize((2 * self.nd + self.constraints()) * self.ni, 0.0);
    }

    /// Sets `x_i'` and `p_i[k+1]'` by the parameters `(q, p, inputs, k)`, for collocation.
    pub(crate) fn set_rows(&mut self, i: usize, by: [&[f64]; 2]) {
        let (next, nk, ni, nd) = (self.next_columns(), self.nk, self.ni, self.nd);
        let driven = [i, nd + self.constraints() + i];
        for ((rows, driven), by) in
            [&mut self.increment, &mut self.momentum].into_iter().zip(driven).zip(by)
        {
            self.driven[driven * ni..][..ni].copy_from_slice(&by[next..][..ni]);
            let row = &mut rows[i * self.stride..][..self.stride];
            row[..next].copy_from_slice(&by[..next]);
            row[next..][..nk].copy_from_slice(&by[next + ni..][..nk]);
        }
    }

    pub(crate) fn solved_step(&self) -> &SolvedStep {
        &self.solved
    }

    /// `A = ∂f/∂x`, square of `2 nd + 2 nk`; its `v` columns are zero.
    pub fn a(&self) -> DMatrix<f64> {
        let size = 2 * (self.nd + self.nk);
        let mut a = DMatrix::zeros(size, size);
        self.write_a(&mut a);
        a
    }

    /// Writes `A` over a matrix of its shape.
    pub(crate) fn write_a(&self, a: &mut DMatrix<f64>) {
        let (nd, nk) = (self.nd, self.nk);
        let (n, state_columns) = (nd + nk, self.next_columns());
        a.fill(0.0);
        for i in 0..nd {
            for j in 0..state_columns {
                a[(i, j)] = self.increment[i * self.stride + j];
                a[(n + i, j)] = self.momentum[i * self.stride + j];
            }
            a[(i, i)] += 1.0;
        }
        for k in 0..nk {
            a[(n + nd + k, nd + k)] = -1.0 / self.time_step_s;
        }
        for t in &self.turnings {
            let i = t.coordinate;
            if i < nd {
                a[(i, i)] -= 1.0;
                a[(i + 1, i + 1)] -= 1.0;
                a[(i + 2, i + 2)] -= 1.0;
                turn_rows(&t.to_end, i, a);
                add_block(&t.carried, (i, i), a);
            } else {
                let v = n + i;
                a.view_mut((v, i), (3, 3)).fill(0.0);
                add_block(&t.momentum.transpose().scaled(-1.0 / self.time_step_s), (v, i), a);
            }
        }
    }

    /// `B = ∂f/∂u`, `2 nd + 2 nk` by `ni + nk`; zero where a signal replaces the entry of `u`.
    pub fn b(&self) -> DMatrix<f64> {
        let mut b = DMatrix::zeros(2 * (self.nd + self.nk), self.ni + self.nk);
        self.write_b(&mut b);
        b
    }

    /// Writes `B` over a matrix of its shape.
    pub(crate) fn write_b(&self, b: &mut DMatrix<f64>) {
        let (nd, nk, ni) = (self.nd, self.nk, self.ni);
        let (n, next) = (nd + nk, self.next_columns());
        b.fill(0.0);
        for &InputImpulse { input, coordinate, residual, momentum } in self.impulses() {
            for i in 0..nd {
                let column = i * self.stride + n + coordinate;
                b[(i, input)] += residual * self.increment[column];
                b[(n + i, input)] += residual * self.momentum[column];
            }
            b[(n + coordinate, input)] += momentum - residual;
        }
        for i in 0..nd {
            for (input, entry) in self.driven(i).iter().enumerate() {
                b[(i, input)] = *entry;
            }
            for (input, entry) in self.driven(nd + self.constraints() + i).iter().enumerate() {
                b[(n + i, input)] = *entry;
            }
        }
        for k in 0..nk {
            for i in 0..nd {
                b[(i, ni + k)] = self.increment[i * self.stride + next + k];
                b[(n + i, ni + k)] = self.momentum[i * self.stride + next + k];
            }
            b[(nd + k, ni + k)] = 1.0;
            b[(n + nd + k, ni + k)] = 1.0 / self.time_step_s;
        }
        for t in &self.turnings {
            let i = t.coordinate;
            if i < nd {
                turn_rows(&t.to_end, i, b);
            } else {
                let at = (n + i, ni + i - nd);
                b.view_mut(at, (3, 3)).fill(0.0);
                add_block(&t.momentum.scaled(1.0 / self.time_step_s), at, b);
            }
        }
        for &column in &self.replaced {
            b.column_mut(column).fill(0.0);
        }
    }

    /// `∂λ/∂x`, nc by `2 nd + 2 nk`.
    ///
    /// With redundant constraints it is the derivative of least norm: `Dh(q[k])ᵀ λ'` is the derivative
    /// of the constraints' impulse; what `λ` itself, which has least norm at every state, changes by
    /// along combinations of equations that exert no force is left out.
    pub fn multipliers_x(&self) -> DMatrix<f64> {
        let state_columns = self.next_columns();
        let rows = self.constraints();
        DMatrix::from_fn(rows, 2 * (self.nd + self.nk), |c, j| {
            if j < state_columns { self.multipliers[c * self.stride + j] } else { 0.0 }
        })
    }

    /// `∂λ/∂u`, nc by `ni + nk`; see [`Linearization::multipliers_x`]. Zero where a signal replaces the
    /// entry of `u`.
    pub fn multipliers_u(&self) -> DMatrix<f64> {
        let (n, ni, next) = (self.nd + self.nk, self.ni, self.next_columns());
        let mut by_u = DMatrix::zeros(self.constraints(), ni + self.nk);
        for c in 0..self.constraints() {
            let row = &self.multipliers[c * self.stride..][..self.stride];
            for &InputImpulse { input, coordinate, residual, .. } in self.impulses() {
                by_u[(c, input)] += residual * row[n + coordinate];
            }
            for (input, entry) in self.driven(self.nd + c).iter().enumerate() {
                by_u[(c, input)] = *entry;
            }
            for k in 0..self.nk {
                by_u[(c, ni + k)] = row[next + k];
            }
        }
        for &column in &self.replaced {
            by_u.column_mut(column).fill(0.0);
        }
        by_u
    }

    /// The derivative by `p[k]` of `z_x·x + z_λ·λ + z_p·p[k+1]`, nd entries.
    pub(crate) fn pull_back_to_momentum(&self, z: [&[f64]; 3], out: &mut [f64]) {
        let n = self.nd + self.nk;
        out.fill(0.0);
        for (rows, z) in [&self.increment, &self.multipliers, &self.momentum].into_iter().zip(z) {
            for (row, z) in rows.chunks_exact(self.stride.max(1)).zip(z) {
                let by_momentum = &row[n..][..self.nd];
                out.iter_mut().zip(by_momentum).for_each(|(out, entry)| *out += z * entry);
            }
        }
    }

    /// What unit inputs give to the residual, `a h ∂f/∂u`, and to `p[k+1]` beyond that,
    /// `(1 − a) h ∂f/∂u`, nd by ni each.
    pub(crate) fn input_impulses(&self) -> [DMatrix<f64>; 2] {
        let [mut at_start, mut at_end] = [0; 2].map(|_| DMatrix::zeros(self.nd, self.ni));
        for &InputImpulse { input, coordinate, residual, momentum } in &self.inputs {
            at_start[(coordinate, input)] += residual;
            at_end[(coordinate, input)] += momentum - residual;
        }
        [at_start, at_end]
    }

    /// Writes `x'` (nd rows) and `λ'` (nc rows) by the parameters `(q, p, inputs, k)`.
    pub(crate) fn write_tangent(&self, stride: usize, out: &mut [f64]) {
        let (n, next) = (self.nd + self.nk, self.next_columns());
        let width = self.stride.max(1);
        let rows = self.increment.chunks_exact(width).chain(self.multipliers.chunks_exact(width));
        for (row, out) in rows.zip(out.chunks_exact_mut(stride)) {
            out[..next].copy_from_slice(&row[..next]);
            out[next..][..self.ni].fill(0.0);
            for &InputImpulse { input, coordinate, residual, .. } in &self.inputs {
                out[next + input] += residual * row[n + coordinate];
            }
            out[next + self.ni..][..self.nk].copy_from_slice(&row[next..][..self.nk]);
        }
    }

    /// What unit inputs give to a step of the midpoint rule.
    fn impulses(&self) -> &[InputImpulse] {
        if self.kind == Kind::Step { &self.inputs } else { &[] }
    }

    /// A row of derivatives by the inputs of collocation and periods.
    fn driven(&self, row: usize) -> &[f64] {
        if self.kind == Kind::Step { &[] } else { &self.driven[row * self.ni..][..self.ni] }
    }

    /// First column of the next prescribed positions.
    fn next_columns(&self) -> usize {
        2 * self.nd + self.nk
    }

    fn constraints(&self) -> usize {
        self.multipliers.len().checked_div(self.stride).unwrap_or_default()
    }
}

/// Multiplies three rows, beginning at `i`, by a matrix.
fn turn_rows(by: &Mat3, i: usize, matrix: &mut DMatrix<f64>) {
    for column in matrix.column_iter_mut() {
        let mut column = column;
        let turned = by.apply(Vec3([column[i], column[i + 1], column[i + 2]]));
        column.rows_mut(i, 3).copy_from_slice(&turned.0);
    }
}

/// Adds a 3 by 3 block.
fn add_block(block: &Mat3, (row, column): (usize, usize), matrix: &mut DMatrix<f64>) {
    for (b, entries) in block.0.iter().enumerate() {
        for a in 0..3 {
            matrix[(row + a, column + b)] += entries[a];
        }
    }
}
