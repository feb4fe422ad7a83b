//! The exact second-order linearization of a step (sections IV and V of the paper), as full tensors or
//! contracted with weights.
//!
//! The equations of a step are `R(θ, y) = 0` for the unknowns `y = (x, λ)` with the parameters
//! `θ = (q, p, u, k)`; `k` are the next prescribed positions, `O(θ, y)` is `p[k+1]`. The tangent
//! of parameter `a` is `W_a = (e_a, y'_a)`, from the first-order linearization. One more derivative:
//!
//! ```text
//! E y''_ab = −(D_a R_y y'_b + D_a R_θ,b)        E = R_y = [K  −A0ᵀ; A1  0]
//! p''_ab   = D_a O_y y'_b + D_a O_θ,b + O_y y''_ab
//! ```
//!
//! where `D_a` is the derivative of a block along `W_a`: its dual part when the block is evaluated in
//! [`Dual`] numbers seeded with `W_a`. [`SecondOrder`](tensors::SecondOrder) holds all of it, [`Contraction`](contraction::Contraction) weighted sums.

pub(crate) mod chain;
pub(crate) mod contraction;
pub(crate) mod tensors;

use nalgebra::DMatrix;
use plantd_math::rotation;
use plantd_math::rows::Term;
use plantd_math::scalar::Dual;
use plantd_math::spatial::{Mat3, Vec3};

use crate::integrator::blocks::StepBlocks;
use crate::integrator::parameters::Parameters;
use crate::lagrangian::turning::Turning;
use crate::linearization::linearize::SolvedStep;
use crate::model::mechanism::Model;

/// What both forms compute with.
#[derive(Clone, Debug)]
pub(crate) struct Scratch {
    pub(crate) layout: Parameters,
    pub(crate) blocks: StepBlocks<Dual>,
    /// `x'` and `λ'` by all parameters, row-major, nd + nc rows.
    pub(crate) tangent: Vec<f64>,
    pub(crate) terms: Vec<Term>,
    /// Entries of `u` that signals replace: they have no effect.
    pub(crate) replaced: Vec<usize>,
}

pub(crate) fn assert_layout(model: &Model, scratch: &Scratch) {
    assert!(
        scratch.layout == Parameters::new(model),
        "the second-order linearization belongs to another model"
    );
}

/// How the derivatives of the velocity of a prescribed ball joint by the ends of the step,
/// `(N⁻ η₁ − N⁺ η₀) / h`, change along the direction of the duals.
pub(crate) fn spin_change(t: &Turning<Dual>, time_step_s: f64) -> [[f64; 6]; 3] {
    [0, 1, 2].map(|row| {
        [0, 1, 2, 3, 4, 5].map(|column| {
            let entry = if column < 3 {
                -t.momentum.0[row][column].eps
            } else {
                t.momentum.0[column - 3][row].eps
            };
            entry / time_step_s
        })
    })
}

impl Scratch {
    fn new(model: &Model) -> Self {
        let layout = Parameters::new(model);
        let rows = layout.nd + layout.nc;
        Self {
            layout,
            blocks: StepBlocks::new(model),
            tangent: vec![0.0; rows * layout.stride],
            terms: Vec::with_capacity(layout.nd * layout.n() + layout.nc),
            replaced: model.replaced_inputs().collect(),
        }
    }

    /// Zeroes the columns of the entries of `u` that signals replace.
    fn drop_replaced_columns(&self, by_u: &mut DMatrix<f64>) {
        self.replaced.iter().for_each(|&column| by_u.column_mut(column).fill(0.0));
    }

    /// Zeroes the rows of the entries of `u` that signals replace.
    fn drop_replaced_rows(&self, by_u: &mut DMatrix<f64>) {
        self.replaced.iter().for_each(|&row| by_u.row_mut(row).fill(0.0));
    }

    /// Places the blocks at a solved step, with the tangent of parameter `a`.
    pub(crate) fn seed(&mut self, a: usize, model: &Model, step: &SolvedStep) {
        let Parameters { nd, stride, .. } = self.layout;
        let (inputs, next) = (self.layout.inputs(), self.layout.next());
        let unit = |is: bool| if is { 1.0 } else { 0.0 };
        let tangent = |row: usize| self.tangent[row * stride + a];
        for (i, q) in step.q.iter().enumerate() {
            self.blocks.q_start[i] = Dual::new(*q, unit(a == i));
        }
        for (i, x) in step.increment.iter().enumerate() {
            self.blocks.next[i] = Dual::new(*x, tangent(i));
        }
        for (k, value) in step.next.iter().enumerate() {
            self.blocks.next[nd + k] = Dual::new(*value, unit(a == next + k));
        }
        for (c, lambda) in step.multipliers.iter().enumerate() {
            self.blocks.multipliers[c] = Dual::new(*lambda, tangent(nd + c));
        }
        for (i, value) in step.inputs.iter().enumerate() {
            self.blocks.inputs[i] = Dual::new(*value, unit(a == inputs + i));
        }
        self.seed_orientations(a, model, step);
    }

    /// Places the ball joints at a solved step, with the tangent of parameter `a`.
    fn seed_orientations(&mut self, a: usize, model: &Model, step: &SolvedStep) {
        let next = self.layout.next();
        for (o, &i) in model.orientations.iter().enumerate() {
            let axis = |first: usize| {
                let mut axis = Vec3::ZERO;
                if (first..first + 3).contains(&a) {
                    axis.0[a - first] = 1.0;
                }
                axis
            };
            let (start, by_start) = (step.orientations[o], axis(i));
            let along = |v: Vec3, rate: Vec3| Vec3([0, 1, 2].map(|k| Dual::new(v[k], rate[k])));
            let rate = [0, 1, 2].map(|k| start.apply(by_start.cross(Mat3::IDENTITY.0[k])));
            self.blocks.orientations[0][o] = Mat3([0, 1, 2].map(|k| along(start.0[k], rate[k])));
            if i >= self.layout.nd {
                let turn = step.turns[o];
                let momentum = rotation::momentum_at_start(turn);
                let rate = momentum.apply(axis(next + i - self.layout.nd))
                    - momentum.apply_transposed(by_start);
                self.blocks.next[i..i + 3].copy_from_slice(&along(turn, rate).0);
            }
        }
    }
}
