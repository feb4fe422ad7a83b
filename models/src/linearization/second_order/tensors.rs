//! All second derivatives of a step.

use nalgebra::DMatrix;
use plantd_math::scalar::Dual;
use plantd_math::spatial::Mat3;

use crate::integrator::parameters::Parameters;
use crate::integrator::report::StepError;
use crate::lagrangian::turning::Turning;
use crate::linearization::linearize::Linearization;
use crate::linearization::second_order::Scratch;
use crate::linearization::second_order::contraction::Contraction;
use crate::model::mechanism::Model;

/// Full tensors with more numbers than this are refused: 1 GiB.
const ENTRIES_MAX: usize = 1 << 27;

/// The full second-order linearization would be too large.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the full second-order linearization of {parameters} parameters has {entries} entries, more than {ENTRIES_MAX}; contract it instead"
)]
pub struct TooLarge {
    /// Parameters: coordinates, momenta, inputs, next prescribed positions.
    pub parameters: usize,
    /// Numbers it would hold.
    pub entries: usize,
}

/// The exact second-order linearization of one step, preallocated.
///
/// One symmetric matrix of second derivatives for each entry of `x[k+1] = (q, p, v)` and for each
/// multiplier; the rows and columns of `v`, and the outputs of prescribed coordinates, are zero.
///
/// ```
/// use std::sync::Arc;
///
/// use plantd_models::{Initial, Linearization, Model, Plant, SecondOrder, Settings, builtin};
///
/// let scene = builtin::scene("pendulum").expect("a builtin scene");
/// let model = Arc::new(Model::compile(&scene)?);
/// let mut plant = Plant::new(model.clone(), Settings::new(&model))?;
/// let mut first = Linearization::new(&model);
/// let mut second = SecondOrder::new(&model)?;
/// plant.linearize_second_order(&[0.0], &mut first, &mut second)?;
/// let at_an_angle = second.xx(0);
///
/// // A pendulum swings to both sides alike: where it hangs, its map has no second derivatives.
/// plant.initialize(&Initial::OperatingPoint("hanging".into()))?;
/// plant.linearize_second_order(&[0.0], &mut first, &mut second)?;
/// assert!(second.xx(0).amax() < 1e-12 && at_an_angle.amax() > 1e-3);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct SecondOrder {
    pub(crate) scratch: Scratch,
    /// One block for each parameter `a`: rows `x''` (nd), `λ''` (nc), `p''` (nd), columns `b ≤ a`.
    pub(crate) tensor: Vec<f64>,
    /// Velocities of prescribed ball joints, `ξ/h`, by both ends of the step.
    pub(crate) spins: Vec<Spin>,
}

/// Second derivatives of the velocity of a prescribed ball joint.
#[derive(Clone, Debug)]
pub(crate) struct Spin {
    /// First of its coordinates.
    pub(crate) coordinate: usize,
    /// For each component, by the start and by the end of the step.
    pub(crate) tensor: [DMatrix<f64>; 3],
}

/// Where the second derivatives of an output stand.
#[derive(Clone, Copy, Debug)]
enum Output {
    /// Nowhere: they are zero.
    Linear,
    /// In a row of the blocks.
    Row(usize),
    /// A component of a spin.
    Spin(usize, usize),
}

impl SecondOrder {
    /// Room for the second-order linearization of a model: `(2 nd + nc) N²` numbers for
    /// `N = 2 nd + 2 nk + ni` parameters.
    ///
    /// # Errors
    ///
    /// If these are more than 2²⁷, which is 1 GiB. [`Contraction`](crate::linearization::second_order::contraction::Contraction) has no such limit.
    pub fn new(model: &Model) -> Result<Self, TooLarge> {
        let layout = Parameters::new(model);
        let parameters = layout.count();
        let entries = parameters * layout.stride * (2 * layout.nd + layout.nc);
        if entries > ENTRIES_MAX {
            return Err(TooLarge { parameters, entries });
        }
        let spin =
            |&coordinate: &usize| Spin { coordinate, tensor: [0; 3].map(|_| DMatrix::zeros(6, 6)) };
        let spins = model.orientations.iter().filter(|i| **i >= layout.nd).map(spin).collect();
        Ok(Self { scratch: Scratch::new(model), tensor: vec![0.0; entries], spins })
    }

    /// `∂²x_i[k+1]/∂x∂x` of output `i`, square of `2 nd + 2 nk`.
    ///
    /// # Panics
    ///
    /// If there is no such output.
    pub fn xx(&self, output: usize) -> DMatrix<f64> {
        self.state_block(self.output_row(output))
    }

    /// `∂²x_i[k+1]/∂x∂u` of output `i`, `2 nd + 2 nk` by `ni + nk`.
    ///
    /// # Panics
    ///
    /// If there is no such output.
    pub fn xu(&self, output: usize) -> DMatrix<f64> {
        self.mixed_block(self.output_row(output))
    }

    /// `∂²x_i[k+1]/∂u∂u` of output `i`, square of `ni + nk`.
    ///
    /// # Panics
    ///
    /// If there is no such output.
    pub fn uu(&self, output: usize) -> DMatrix<f64> {
        self.input_block(self.output_row(output))
    }

    /// `∂²λ_c/∂x∂x`.
    ///
    /// # Panics
    ///
    /// If there is no such constraint equation.
    pub fn multiplier_xx(&self, c: usize) -> DMatrix<f64> {
        self.state_block(self.multiplier_row(c))
    }

    /// `∂²λ_c/∂x∂u`.
    ///
    /// # Panics
    ///
    /// If there is no such constraint equation.
    pub fn multiplier_xu(&self, c: usize) -> DMatrix<f64> {
        self.mixed_block(self.multiplier_row(c))
    }

    /// `∂²λ_c/∂u∂u`.
    ///
    /// # Panics
    ///
    /// If there is no such constraint equation.
    pub fn multiplier_uu(&self, c: usize) -> DMatrix<f64> {
        self.input_block(self.multiplier_row(c))
    }

    /// Fills the tensor output by output.
    pub(crate) fn gather(&mut self, model: &Model, first: &Linearization) -> Result<(), StepError> {
        let Parameters { nd, nc, stride, .. } = self.scratch.layout;
        let (n, rows) = (self.scratch.layout.n(), 2 * nd + nc);
        let mut contraction = Contraction::new(model);
        for row in 0..rows {
            let (mut x, mut multipliers) = (vec![0.0; 2 * n], vec![0.0; nc]);
            match row.checked_sub(nd) {
                None => x[row] = 1.0,
                Some(c) if c < nc => multipliers[c] = 1.0,
                Some(c) => x[n + c - nc] = 1.0,
            }
            contraction.contract_any(model, first, &x, &multipliers)?;
            for (a, block) in self.tensor.chunks_exact_mut(rows * stride).enumerate() {
                for (b, entry) in block[row * stride..][..=a].iter_mut().enumerate() {
                    *entry = contraction.entry(a, b);
                }
            }
        }
        Ok(())
    }

    fn output_row(&self, output: usize) -> Output {
        let ((nd, n), nc) = (self.scratch.layout.coordinates(), self.scratch.layout.nc);
        assert!(output < 2 * n, "output {output} of {}", 2 * n);
        match output {
            i if i < nd => Output::Row(i),
            i if i < n => Output::Linear,
            i if i < n + nd => Output::Row(nd + nc + i - n),
            i => {
                let coordinate = i - n;
                let holds =
                    |spin: &Spin| (spin.coordinate..spin.coordinate + 3).contains(&coordinate);
                match self.spins.iter().position(holds) {
                    Some(spin) => Output::Spin(spin, coordinate - self.spins[spin].coordinate),
                    None => Output::Linear,
                }
            }
        }
    }

    fn multiplier_row(&self, c: usize) -> Output {
        let Parameters { nd, nc, .. } = self.scratch.layout;
        assert!(c < nc, "constraint {c} of {nc}");
        Output::Row(nd + c)
    }

    fn entry(&self, output: Output, a: usize, b: usize) -> f64 {
        let layout = self.scratch.layout;
        let Parameters { nd, nc, stride, .. } = layout;
        match output {
            Output::Linear => 0.0,
            Output::Row(row) => self.tensor[((a.max(b)) * (2 * nd + nc) + row) * stride + a.min(b)],
            Output::Spin(spin, component) => {
                let Spin { coordinate, tensor } = &self.spins[spin];
                match (layout.end_of(*coordinate, a), layout.end_of(*coordinate, b)) {
                    (Some(a), Some(b)) => tensor[component][(a, b)],
                    _ => 0.0,
                }
            }
        }
    }

    fn state_block(&self, row: Output) -> DMatrix<f64> {
        let (n, moving) = (self.scratch.layout.n(), self.scratch.layout.inputs());
        DMatrix::from_fn(2 * n, 2 * n, |a, b| {
            if a < moving && b < moving { self.entry(row, a, b) } else { 0.0 }
        })
    }

    fn mixed_block(&self, row: Output) -> DMatrix<f64> {
        let layout = self.scratch.layout;
        let moving = layout.inputs();
        let mut block = DMatrix::from_fn(2 * layout.n(), layout.ni + layout.nk, |a, b| {
            if a < moving { self.entry(row, a, moving + b) } else { 0.0 }
        });
        self.scratch.drop_replaced_columns(&mut block);
        block
    }

    fn input_block(&self, row: Output) -> DMatrix<f64> {
        let layout = self.scratch.layout;
        let (moving, size) = (layout.inputs(), layout.ni + layout.nk);
        let mut block =
            DMatrix::from_fn(size, size, |a, b| self.entry(row, moving + a, moving + b));
        self.scratch.drop_replaced_columns(&mut block);
        self.scratch.drop_replaced_rows(&mut block);
        block
    }
}

impl Parameters {
    /// Writes the dual parts of row `i` of a block by start, next, and inputs into the columns of the
    /// parameters that these are; the columns of `x` are for the tangents.
    pub(crate) fn place(&self, row: &mut [f64], i: usize, by: [&[Dual]; 2], by_inputs: &[Dual]) {
        let [start, next] = by.map(|block| &block[i * self.n()..][..self.n()]);
        row.fill(0.0);
        put(row, 0, start);
        put(row, self.inputs(), &by_inputs[i * self.ni..][..self.ni]);
        put(row, self.next(), &next[self.nd..]);
    }

    /// Writes the dual parts of a row of the constraint Jacobian at the end: a shift of the start moves both ends.
    pub(crate) fn place_end(&self, row: &mut [f64], by_start: &[Dual], by_next: &[Dual]) {
        row.fill(0.0);
        put(row, 0, &by_start[..self.nd]);
        put(row, self.next(), &by_next[self.nd..]);
    }

    /// From `ξ''` of a ball joint to the second derivative of how its end turns, `dexp₋ξ ξ' + exp(−ξ) η`
    /// once more along the direction of the duals.
    pub(crate) fn turn_rows(&self, t: &Turning<Dual>, tangent: &[f64], rows: &mut [f64]) {
        let (i, stride) = (t.coordinate, self.stride);
        let entry = |m: &Mat3<Dual>, a: usize, b: usize| m.0[b][a];
        for column in 0..stride {
            let at = |b: usize| (i + b) * stride + column;
            let second = [0, 1, 2].map(|b| rows[at(b)]);
            for a in 0..3 {
                let turned = (0..3).map(|b| {
                    let to_end = entry(&t.to_end, a, b);
                    to_end.re * second[b] + to_end.eps * tangent[at(b)]
                });
                rows[at(a)] = turned.sum();
                if (i..i + 3).contains(&column) {
                    rows[at(a)] += entry(&t.carried, a, column - i).eps;
                }
            }
        }
    }
}

/// Replaces the derivative along `a` of the tangent `b` by its mean with that along `b` of the tangent
/// `a`: the second derivative in the chart `exp` of each ball joint. Their difference is a commutator.
pub(crate) fn symmetrise(tensor: &mut [f64], rows: usize, stride: usize) {
    let parameters = tensor.len() / rows;
    for a in 0..parameters {
        for b in 0..a {
            for row in 0..rows / stride {
                let lower = a * rows + row * stride + b;
                tensor[lower] = 0.5 * (tensor[lower] + tensor[b * rows + row * stride + a]);
            }
        }
    }
}

/// Writes dual parts from a column on, as far as the row goes.
fn put(row: &mut [f64], column: usize, entries: &[Dual]) {
    for (target, entry) in row.iter_mut().skip(column).zip(entries) {
        *target = entry.eps;
    }
}
