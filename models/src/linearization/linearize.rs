//! The exact first-order linearization of a step, in increment form (sections IV and V of the paper).
//!
//! Unknown `y = (x, λ)`, parameters `θ = (q, p, u, k)` with `q = (q_d, q_k)`: start configuration
//! (dynamic, prescribed), momentum, inputs, next prescribed positions. With both ends of the step
//! shifted together no terms of size `1/h` cancel. At the midpoint, with `a` the weight of `F⁻`,
//!
//! ```text
//! C_q = ½h L_qq − L_vq + a h f_q      C_v = ½h L_qv − L_vv + a h f_v      H = Σ λ D²h(q[k])
//! M_q = h (L_qq + f_q)                M_v = h (L_qv + f_v)                S = A1 K⁻¹ A0ᵀ
//!
//! column      of r1                       of r2      of p[k+1], at fixed x and λ
//! q_d         (C_q − H)_dd                A1_d       (M_q − H)_dd
//! q_k         (½C_q − C_v/h − H)_dk       0          (½M_q − M_v/h − H)_dk
//! p           1                           0          1
//! u           a h f_u                     0          h f_u
//! k           (½C_q + C_v/h)_dk           A1_k       (½M_q + M_v/h)_dk
//! x           K = (½C_q + C_v/h)_dd       A1_d       (½M_q + M_v/h)_dd
//! λ           −A0ᵀ                        0          −A0ᵀ
//!
//! x' = K⁻¹ (A0ᵀ λ' − r1')      S λ' = A1 K⁻¹ r1' − r2'      q[k+1]' = q_d' + x'
//! p[k+1]' = p' + (½M_q + M_v/h) x' + M_q q_d' + (prescribed) − A0ᵀ λ' − H q'
//! ```
//!
//! An input acts like momentum: its column is `Σ_i a h ∂f_i/∂u` times that of `p_i`, plus
//! `(1 − a) h ∂f_i/∂u` on `p[k+1]_i`; rows leave the columns of `u` out. Prescribed positions that
//! signals replace have no effect.

use nalgebra::DMatrix;
use plantd_math::dense_inverse::DenseInverse;
use plantd_math::pivoted_lu::PivotedLu;
use plantd_math::rows::{AlignedRows, Term, padded, spread};
use plantd_math::spatial::{Mat3, Vec3};

use crate::integrator::collocation::slopes::Closing;
use crate::integrator::parameters::Parameters;
use crate::integrator::report::StepError;
use crate::integrator::scheme::Tableau;
use crate::integrator::settings::Settings;
use crate::integrator::workspace::{StepContext, Workspace};
use crate::kkt::schur::room_for_schur;
use crate::linearization::ends::{Ends, InputImpulse};
use crate::linearization::matrices::Layout;
use crate::model::mechanism::Model;

/// What a row holds the derivatives of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Output {
    /// `x_i`.
    Increment(usize),
    /// `λ_c`.
    Multiplier(usize),
    /// `p_i[k+1]`.
    Momentum(usize),
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
///
/// ```
/// use std::sync::Arc;
///
/// use plantd_models::{Linearization, Model, Plant, Settings, builtin};
///
/// let scene = builtin::scene("pendulum").expect("a builtin scene");
/// let model = Arc::new(Model::compile(&scene)?);
/// let mut plant = Plant::new(model.clone(), Settings::new(&model))?;
/// let mut first = Linearization::new(&model);
/// plant.linearize(&[0.5], &mut first)?;
///
/// // x = (q, p): the map of a pendulum keeps areas.
/// let (a, b) = (first.a(), first.b());
/// assert!((a.determinant() - 1.0).abs() < 1e-12);
/// assert_eq!(b.shape(), (2, 1));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Linearization {
    pub(crate) kind: Kind,
    /// The steps of a period, as many as are kept, and others of periods before.
    pub(crate) parts: Vec<Part>,
    pub(crate) parts_max: usize,
    /// `x'`, `λ'` and `p[k+1]'` by the inputs, row-major, 2 nd + nc rows of ni; for collocation and
    /// periods.
    pub(crate) driven: Vec<f64>,
    /// What the second derivatives of a step of collocation need.
    stages: Option<Box<StageTangents>>,
    pub(crate) nd: usize,
    pub(crate) nk: usize,
    pub(crate) ni: usize,
    pub(crate) ends: Ends,
    /// Length of a row: the columns of the parameters `(q, p, k)`, padded.
    pub(crate) stride: usize,
    /// `x'`, row-major, nd rows.
    pub(crate) increment: AlignedRows,
    /// `p[k+1]'`, row-major, nd rows.
    pub(crate) momentum: AlignedRows,
    /// `λ'`, row-major, nc rows.
    pub(crate) multipliers: AlignedRows,
    pub(crate) solved: SolvedStep,
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
    /// Constraints were eliminated without these two.
    pub(crate) without_schur: bool,
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
            schur: room_for_schur(model, 1),
            without_schur: false,
        }
    }

    /// Remembers the solution in the workspace.
    pub(crate) fn remember(&mut self, workspace: &Workspace, at: StepContext<'_>) {
        let (inputs, next) = at.u.split_at(self.inputs.len());
        self.settings = *at.settings;
        for (to, from) in [
            (&mut self.q, &at.state.q[..]),
            (&mut self.increment, &workspace.step.increment),
            (&mut self.next, next),
            (&mut self.inputs, inputs),
        ] {
            to.copy_from_slice(from);
        }
        if !self.orientations.is_empty() {
            self.orientations.copy_from_slice(&workspace.balls.start);
            for (to, turn) in self.turns.iter_mut().zip(workspace.balls.turns()) {
                *to = turn.xi;
            }
        }
        if !self.multipliers.is_empty() {
            self.multipliers.copy_from_slice(&workspace.step.multipliers);
            self.without_schur = !workspace.kkt.has_schur();
            if !self.without_schur {
                self.responses.copy_from_slice(&workspace.kkt.schur.responses);
                self.schur.take_factors_of(&workspace.kkt.schur.lu);
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
            ni: d.inputs,
            ends: Ends::new(model),
            stride,
            increment: AlignedRows::zeros(d.dynamic * stride),
            momentum: AlignedRows::zeros(d.dynamic * stride),
            multipliers: AlignedRows::zeros(d.constraints * stride),
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
                && self.ends.inputs.len() == model.impulses,
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
        self.ends.time_step_s = h;
        self.ends.turnings.clear();
        self.driven.resize((2 * self.nd + self.constraints()) * self.ni, 0.0);
    }

    /// Sets `x_i'` and `p_i[k+1]'` by the parameters `(q, p, u, k)`, for collocation.
    pub(crate) fn set_rows(&mut self, i: usize, by: [&[f64]; 2]) {
        let theta = self.parameters();
        let driven = [i, theta.nd + theta.nc + i];
        for ((rows, driven), by) in
            [&mut self.increment, &mut self.momentum].into_iter().zip(driven).zip(by)
        {
            let by_inputs = &by[theta.inputs()..theta.next()];
            self.driven[driven * theta.ni..][..theta.ni].copy_from_slice(by_inputs);
            theta.drop_inputs(by, &mut rows[i * self.stride..][..self.stride]);
        }
    }

    /// Sets `λ_c'` by the parameters `(q, p, u, k)`, for collocation.
    pub(crate) fn set_multiplier(&mut self, c: usize, by: &[f64]) {
        let theta = self.parameters();
        let by_inputs = &by[theta.inputs()..theta.next()];
        self.driven[(theta.nd + c) * theta.ni..][..theta.ni].copy_from_slice(by_inputs);
        theta.drop_inputs(by, &mut self.multipliers[c * self.stride..][..self.stride]);
    }

    pub(crate) fn solved_step(&self) -> &SolvedStep {
        &self.solved
    }

    /// `A = ∂f/∂x`, square of `2 nd + 2 nk`; its `v` columns are zero.
    pub fn a(&self) -> DMatrix<f64> {
        let size = 2 * (self.nd + self.nk);
        let mut a = DMatrix::zeros(size, size);
        self.a_into(a.as_mut_slice(), Layout::Columns);
        a
    }

    /// `B = ∂f/∂u`, `2 nd + 2 nk` by `ni + nk`; zero where a signal replaces the entry of `u`.
    pub fn b(&self) -> DMatrix<f64> {
        let mut b = DMatrix::zeros(2 * (self.nd + self.nk), self.ni + self.nk);
        self.b_into(b.as_mut_slice(), Layout::Columns);
        b
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
        let mut row = vec![0.0; self.ni + self.nk];
        let mut by_u = DMatrix::zeros(self.constraints(), row.len());
        for (c, mut target) in by_u.row_iter_mut().enumerate() {
            self.write_by_input(Output::Multiplier(c), &mut row);
            target.iter_mut().zip(&row).for_each(|(to, from)| *to = *from);
        }
        for &column in &self.ends.replaced {
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
    pub fn input_impulses(&self) -> [DMatrix<f64>; 2] {
        let [mut at_start, mut at_end] = [0; 2].map(|_| DMatrix::zeros(self.nd, self.ni));
        for &InputImpulse { input, coordinate, residual, momentum } in &self.ends.inputs {
            at_start[(coordinate, input)] += residual;
            at_end[(coordinate, input)] += momentum - residual;
        }
        [at_start, at_end]
    }

    /// Writes `x'` (nd rows) and `λ'` (nc rows) by the parameters `(q, p, u, k)`.
    pub(crate) fn write_tangent(&self, stride: usize, out: &mut [f64]) {
        let theta = self.parameters();
        let outputs = (0..theta.nd).map(Output::Increment);
        let outputs = outputs.chain((0..theta.nc).map(Output::Multiplier));
        for (output, out) in outputs.zip(out.chunks_exact_mut(stride)) {
            let (by_state, by_input) = out[..theta.count()].split_at_mut(theta.inputs());
            by_state.copy_from_slice(&self.row(output)[..theta.inputs()]);
            self.write_by_input(output, by_input);
        }
    }

    /// Derivatives of an output by `(q, p, k)`, padded.
    fn row(&self, output: Output) -> &[f64] {
        let (rows, i) = match output {
            Output::Increment(i) => (&self.increment, i),
            Output::Multiplier(c) => (&self.multipliers, c),
            Output::Momentum(i) => (&self.momentum, i),
        };
        &rows[i * self.stride..][..self.stride]
    }

    /// Writes the derivatives of an output by the input of the map, `(u, k)`, those that signals replace
    /// included.
    pub(crate) fn write_by_input(&self, output: Output, out: &mut [f64]) {
        let (theta, row) = (self.parameters(), self.row(output));
        let driven = match output {
            Output::Increment(i) => i,
            Output::Multiplier(c) => theta.nd + c,
            Output::Momentum(i) => theta.nd + theta.nc + i,
        };
        let (by_u, by_k) = out.split_at_mut(theta.ni);
        by_u.fill(0.0);
        by_u.iter_mut().zip(self.driven(driven)).for_each(|(to, from)| *to = *from);
        for &InputImpulse { input, coordinate, residual, momentum } in self.impulses() {
            by_u[input] += residual * row[theta.n() + coordinate];
            if output == Output::Momentum(coordinate) {
                by_u[input] += momentum - residual;
            }
        }
        by_k.copy_from_slice(&row[theta.inputs()..][..theta.nk]);
    }

    /// What unit inputs give to a step of the midpoint rule.
    fn impulses(&self) -> &[InputImpulse] {
        if self.kind == Kind::Step { &self.ends.inputs } else { &[] }
    }

    /// A row of derivatives by the inputs of collocation and periods.
    fn driven(&self, row: usize) -> &[f64] {
        if self.kind == Kind::Step { &[] } else { &self.driven[row * self.ni..][..self.ni] }
    }

    /// The parameters of the map. Rows leave the columns of the inputs out.
    pub(crate) fn parameters(&self) -> Parameters {
        let (nd, nk, ni, nc) = (self.nd, self.nk, self.ni, self.constraints());
        Parameters { nd, nk, ni, nc, stride: self.stride }
    }

    /// First column of the next prescribed positions in rows without the inputs.
    pub(crate) fn next_columns(&self) -> usize {
        self.parameters().inputs()
    }

    pub(crate) fn constraints(&self) -> usize {
        self.multipliers.len().checked_div(self.stride).unwrap_or_default()
    }
}

/// A step of a period: its own derivatives, and the tangent of where it begins.
#[derive(Clone, Debug)]
pub(crate) struct Part {
    pub(crate) step: Linearization,
    /// `D`, row-major: rows `(q, p, k)`.
    pub(crate) tangent: Vec<f64>,
}

/// The stages of a linearized step: what its second derivatives need.
#[derive(Clone, Debug)]
pub(crate) struct StageTangents {
    pub(crate) time_step_s: f64,
    pub(crate) tableau: Tableau,
    /// `Q_i`, `V_i` and inputs, stage by stage; of ball joints `η_i` and its rate.
    pub(crate) q: Vec<f64>,
    pub(crate) velocity: Vec<f64>,
    pub(crate) inputs: Vec<f64>,
    /// `Y'` by the parameters `(q, p, u, k)`, row-major, `n s` padded rows: those of the stages of a
    /// coordinate side by side.
    pub(crate) tangent: Vec<f64>,
    /// `∂P_i/∂θ`, the same way.
    pub(crate) impulses: Vec<f64>,
    /// `Σ ∂P_i/∂Y`, row-major, n by `n s`.
    pub(crate) slopes: Vec<f64>,
    /// The inverse of `∂R/∂Y`.
    pub(crate) matrix: DenseInverse,
    pub(crate) terms: Vec<Term>,
    /// Momentum, and orientations of ball joints, at the start; with ball joints.
    pub(crate) momentum: Vec<f64>,
    pub(crate) orientations: Vec<Mat3>,
    pub(crate) nodes: Option<NodeTangents>,
}

/// The same of the nodes where constraints hold.
#[derive(Clone, Debug)]
pub(crate) struct NodeTangents {
    /// `Q̃_j`, `Dh` and `Λ_j`, node after node.
    pub(crate) q: Vec<f64>,
    pub(crate) jacobians: Vec<f64>,
    pub(crate) multipliers: Vec<f64>,
    /// `Λ_j'`, node after node, rows of the parameters.
    pub(crate) tangent: Vec<f64>,
    /// `J⁻¹ B`, row-major, padded, and the factors of `S`.
    pub(crate) responses: Vec<f64>,
    pub(crate) schur: PivotedLu,
    /// With ball joints, `B` and `G`.
    pub(crate) closing: Option<Box<Closing>>,
}
