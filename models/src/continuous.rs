//! Continuous-time dynamics of a model with first and second derivatives, to compare with those of
//! its discrete map.
//!
//! With `q = (q_d, q_k)`, the Lagrangian `L`, generalized forces `f`, constraints `h(q) = 0`, and `a`
//! the accelerations of all coordinates, the equations for the dynamic accelerations and multipliers are
//!
//! ```text
//! 0 = D L_v − L_q − f + Dhᵀ λ        (dynamic rows)
//! 0 = Dh a + D²h(v, v)
//! ```
//!
//! where `D` is the derivative along the motion, `dq = v`, `dv = a`: the dual part of the momenta when
//! they are evaluated in [`Dual`] numbers seeded with it. One derivative more, in the parameters
//! `θ = (q, v, inputs, prescribed accelerations)`:
//!
//! ```text
//! by q   D L_vq − L_qq − f_q + Σ λ D²h        D² Dh
//! by v   D L_vv + L_vq − L_qv − f_v           2 D Dh
//! by a   L_vv                                 Dh
//! ```
//!
//! and second derivatives are the dual parts of these along the tangent of each parameter.

pub(crate) mod kinematics;
pub(crate) mod terms;

use std::sync::Arc;

use nalgebra::DMatrix;
use plantd_math::rotation;
use plantd_math::rows::padded;
use plantd_math::scalar::{Dual, Scalar};
use plantd_math::spatial::{Mat3, Vec3, three};
use plantd_math::tree_lu::TreeLu;

use crate::constraints::closure::Closure;
use crate::kkt::schur::SchurComplement;
use crate::lagrangian::derivatives::Derivatives;
use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::momenta::Momenta;
use crate::model::manifold::orientations;
use crate::model::mechanism::{Dimensions, Model};

/// A pivot of the mass matrix below this fraction of the largest inertia of its coordinate is zero.
const SINGULAR: f64 = 1e-14;
/// Constraint accelerations may miss by this much, relative to what is summed up.
const INCONSISTENT: f64 = 1e-8;
/// Second derivatives with more numbers than this are refused: 1 GiB.
const ENTRIES_MAX: usize = 1 << 27;

/// Where to evaluate.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ContinuousPoint {
    /// Configuration, nd + nk.
    pub q: Vec<f64>,
    /// Velocity, nd + nk.
    pub v: Vec<f64>,
    /// Inputs, ni.
    pub inputs: Vec<f64>,
    /// Accelerations of prescribed coordinates, nk.
    pub prescribed_acceleration: Vec<f64>,
}

/// The motion that follows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Accelerations {
    /// Of the dynamic coordinates, nd.
    pub acceleration: Vec<f64>,
    /// Constraint forces, nc; those of the discrete map are `h` times as large.
    pub multipliers: Vec<f64>,
}

/// Value and first derivatives.
#[derive(Clone, Debug, PartialEq)]
pub struct ContinuousLinearization {
    /// The value.
    pub value: Accelerations,
    /// Rows: accelerations (nd), multipliers (nc). Columns: `q` (nd + nk), `v` (nd + nk), inputs (ni),
    /// prescribed accelerations (nk).
    pub jacobian: DMatrix<f64>,
}

/// Why there are no accelerations.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ContinuousError {
    /// A vector has the wrong length.
    #[error("{name} has {actual} entries; {expected} are needed")]
    Dimension {
        /// Which vector.
        name: &'static str,
        /// Entries it must have.
        expected: usize,
        /// Entries it has.
        actual: usize,
    },
    /// A number is NaN or infinite.
    #[error("{name}[{index}] is {value}")]
    NotFinite {
        /// Which vector.
        name: &'static str,
        /// Index of the entry.
        index: usize,
        /// The entry.
        value: f64,
    },
    /// The numbers given are too large to compute with.
    #[error("what follows leaves the finite numbers")]
    Overflow,
    /// The mass matrix is singular.
    #[error(
        "singular mass matrix at coordinate `{coordinate}` (pivot {pivot:e} of its largest inertia)"
    )]
    SingularMass {
        /// Coordinate of the vanishing pivot.
        coordinate: String,
        /// The pivot relative to the largest inertia that the coordinate can have.
        pivot: f64,
    },
    /// No accelerations satisfy the constraints: they are singular at this configuration.
    #[error(
        "singular constraints: no accelerations satisfy `{constraint}` (missed by {residual:e})"
    )]
    SingularConstraints {
        /// The constraint equation that is missed by most.
        constraint: String,
        /// By how much its second time derivative is missed.
        residual: f64,
    },
    /// The second derivatives would be too large.
    #[error("second derivatives have {entries} entries, more than {ENTRIES_MAX}")]
    TooLarge {
        /// Numbers they would hold.
        entries: usize,
    },
}

/// The continuous-time dynamics of a model, with its workspace.
///
/// Neither the configuration is checked against the constraints nor the velocity against their
/// derivative: accelerations keep whatever violation there is at its rate.
#[derive(Clone, Debug)]
pub struct Continuous {
    model: Arc<Model>,
    equations: Equations<f64>,
    mass: TreeLu,
    /// `A_d M⁻¹ A_dᵀ`, with `M⁻¹ A_dᵀ`.
    schur: SchurComplement,
}

impl Continuous {
    /// The dynamics of a model.
    pub fn new(model: Arc<Model>) -> Self {
        Self {
            equations: Equations::new(&model),
            mass: TreeLu::new(&model.elimination),
            schur: SchurComplement::new(&model, model.dimensions.stride()),
            model,
        }
    }

    /// The model.
    pub fn model(&self) -> &Arc<Model> {
        &self.model
    }

    /// Accelerations of the dynamic coordinates and constraint forces.
    ///
    /// ```text
    /// M_dd a_d + … = L_q + f − Dh_dᵀ λ        Dh a + D²h(v, v) = 0
    /// ```
    ///
    /// Of redundant constraints, the multipliers are those of least norm.
    pub fn evaluate(&mut self, point: &ContinuousPoint) -> Result<Accelerations, ContinuousError> {
        self.solve(point)
    }

    /// Accelerations and constraint forces with their first derivatives, exact. Their cost is that of one evaluation of the derivative
    /// blocks in dual numbers and O(N nd·depth) for `N` parameters.
    pub fn linearize(
        &mut self,
        point: &ContinuousPoint,
    ) -> Result<ContinuousLinearization, ContinuousError> {
        let value = self.solve(point)?;
        let (tangent, d) = (self.differentiate(), self.equations.d);
        let (rows, stride) = (d.dynamic + d.constraints, d.stride());
        let jacobian = DMatrix::from_fn(rows, d.parameters(), |i, b| tangent[i * stride + b]);
        Ok(ContinuousLinearization { value, jacobian })
    }

    /// Second derivatives: for each acceleration, then for each multiplier, a symmetric matrix over the
    /// parameters `(q, v, inputs, prescribed accelerations)`. Costs O(N) first derivatives in dual
    /// numbers.
    pub fn second_order(
        &mut self,
        point: &ContinuousPoint,
    ) -> Result<Vec<DMatrix<f64>>, ContinuousError> {
        let d = self.equations.d;
        let (size, rows, stride) = (d.parameters(), d.dynamic + d.constraints, d.stride());
        let entries = rows * size * size;
        if entries > ENTRIES_MAX {
            return Err(ContinuousError::TooLarge { entries });
        }
        self.solve(point)?;
        let tangent = self.differentiate();
        let mut varied = Equations::<Dual>::new(&self.model);
        let mut out = vec![DMatrix::zeros(size, size); rows];
        let mut second = vec![0.0; rows * stride];
        for a in 0..size {
            varied.seed(&self.model, &self.equations, a, &tangent);
            varied.evaluate(&self.model);
            for (i, row) in second.chunks_exact_mut(stride).enumerate() {
                let block = &varied.jacobian[i * d.columns()..][..d.columns()];
                let (by_parameters, by_unknowns) = block.split_at(size);
                row.iter_mut().zip(by_parameters).for_each(|(entry, by)| *entry = by.eps);
                for (by, moved) in by_unknowns.iter().zip(tangent.chunks_exact(stride)) {
                    if by.eps != 0.0 {
                        row.iter_mut().zip(moved).for_each(|(entry, t)| *entry += by.eps * t);
                    }
                }
            }
            self.solve_rows(&mut second, stride);
            for (out, row) in out.iter_mut().zip(second.chunks_exact(stride)) {
                for b in 0..size {
                    out[(a, b)] = row[b];
                }
            }
        }
        // Derivatives along the axes of a ball joint differ by a commutator from those in its chart.
        for out in &mut out {
            *out = (&*out + out.transpose()) * 0.5;
        }
        Ok(out)
    }

    /// Finds accelerations and multipliers, and keeps the factors of the equations.
    fn solve(&mut self, point: &ContinuousPoint) -> Result<Accelerations, ContinuousError> {
        let model = &*self.model;
        let equations = &mut self.equations;
        equations.place(model, point)?;
        let (nd, nc) = (equations.d.dynamic, equations.d.constraints);
        equations.evaluate(model);
        self.factor()?;

        // The equations are linear in the unknowns, which are still zero.
        let width = padded(1);
        let mut unknowns = vec![0.0; (nd + nc) * width];
        for (row, residual) in unknowns.chunks_exact_mut(width).zip(&self.equations.residual) {
            row[0] = *residual;
        }
        self.solve_rows(&mut unknowns, width);
        let (accelerations, multipliers) = unknowns.split_at(nd * width);
        let first = |rows: &[f64]| rows.iter().step_by(width).copied().collect();
        let value =
            Accelerations { acceleration: first(accelerations), multipliers: first(multipliers) };
        self.check_solution(&value)?;
        self.equations.acceleration[..nd].copy_from_slice(&value.acceleration);
        self.equations.multipliers.copy_from_slice(&value.multipliers);
        Ok(value)
    }

    /// The constraints' accelerations vanish, and everything is finite.
    fn check_solution(&self, value: &Accelerations) -> Result<(), ContinuousError> {
        let (equations, d) = (&self.equations, self.equations.d);
        let Accelerations { acceleration, multipliers } = value;
        if !acceleration.iter().chain(multipliers).all(|x| x.is_finite()) {
            return Err(ContinuousError::Overflow);
        }
        for (c, bias) in equations.residual[d.dynamic..].iter().enumerate() {
            let row = &equations.closure.jacobian[c * d.coordinates()..][..d.dynamic];
            let terms = row.iter().zip(acceleration).map(|(entry, a)| entry * a);
            let (mut residual, mut scale) = (*bias, bias.abs());
            terms.for_each(|term| {
                residual += term;
                scale += term.abs();
            });
            // Where nothing accelerates, what the constraints take away tells the round-off.
            for (other, multiplier) in multipliers.iter().enumerate() {
                let responses = self.schur.responses.iter().skip(other);
                let responses = responses.step_by(padded(d.constraints));
                let taken: f64 = row.iter().zip(responses).map(|(a, r)| a * r).sum();
                scale += (taken * multiplier).abs();
            }
            if residual.abs() > INCONSISTENT * scale {
                let constraint = self.model.constraint_names[c].clone();
                return Err(ContinuousError::SingularConstraints { constraint, residual });
            }
        }
        Ok(())
    }

    /// Derivatives of the unknowns by the parameters: rows of them, a stride apart.
    fn differentiate(&mut self) -> Vec<f64> {
        let d = self.equations.d;
        let stride = d.stride();
        self.equations.evaluate(&self.model);
        let mut tangent = vec![0.0; (d.dynamic + d.constraints) * stride];
        let blocks = self.equations.jacobian.chunks_exact(d.columns().max(1));
        for (row, block) in tangent.chunks_exact_mut(stride).zip(blocks) {
            row[..d.parameters()].copy_from_slice(&block[..d.parameters()]);
        }
        self.solve_rows(&mut tangent, stride);
        tangent
    }

    /// Factors the mass matrix and `S = A_d M⁻¹ A_dᵀ`.
    fn factor(&mut self) -> Result<(), ContinuousError> {
        let model = &*self.model;
        let (d, elimination) = (self.equations.d, &model.elimination);
        let (n, nd, nc) = (d.coordinates(), d.dynamic, d.constraints);
        for row in 0..nd {
            for (slot, ancestor) in elimination.entries_of(row) {
                let entry = ancestor * n + row;
                let entry = self.equations.blocks.l_vv[entry].re;
                (self.mass.upper[slot], self.mass.lower[slot]) = (entry, entry);
            }
        }
        let pivot = self.mass.factor(elimination, &model.conditioning.inertia, 1.0);
        if pivot.relative < SINGULAR {
            let coordinate = model.coordinates[pivot.row].name.clone();
            return Err(ContinuousError::SingularMass { coordinate, pivot: pivot.relative });
        }
        if nc > 0 {
            let Equations { closure, q, .. } = &mut self.equations;
            closure.differentiate(model, q);
            let SchurComplement { responses, lu, .. } = &mut self.schur;
            let width = padded(nc);
            for (c, row) in closure.jacobian.chunks_exact(n).enumerate() {
                row[..nd]
                    .iter()
                    .enumerate()
                    .for_each(|(i, entry)| responses[i * width + c] = *entry);
            }
            self.mass.solve_rows(elimination, responses, width, width);
            for (row, target) in closure.jacobian.chunks_exact(n).zip(lu.matrix.chunks_mut(nc)) {
                target.fill(0.0);
                for (entry, responses) in row[..nd].iter().zip(responses.chunks_exact(width)) {
                    target.iter_mut().zip(responses).for_each(|(t, r)| *t += entry * r);
                }
            }
            lu.factor();
        }
        Ok(())
    }

    /// Solves `M a + A_dᵀ λ = −r1`, `A_d a = −r2` in place; rows `(r1, r2)` become `(a, λ)`.
    fn solve_rows(&mut self, rows: &mut [f64], stride: usize) {
        let model = &*self.model;
        let d = self.equations.d;
        let (n, nd, nc) = (d.coordinates(), d.dynamic, d.constraints);
        let (first, second) = rows.split_at_mut(nd * stride);
        self.mass.solve_rows(&model.elimination, first, stride, stride);
        // S λ = r2 − A_d M⁻¹ r1, a = −M⁻¹ r1 − M⁻¹ A_dᵀ λ.
        if nc > 0 {
            for (c, target) in second.chunks_exact_mut(stride).enumerate() {
                let jacobian = &self.equations.closure.jacobian[c * n..][..nd];
                for (entry, row) in jacobian.iter().zip(first.chunks_exact(stride)) {
                    target.iter_mut().zip(row).for_each(|(t, r)| *t -= entry * r);
                }
            }
            self.schur.lu.solve_rows(second, stride);
        }
        for (i, row) in first.chunks_exact_mut(stride).enumerate() {
            row.iter_mut().for_each(|entry| *entry = -*entry);
            let responses = &self.schur.responses[i * padded(nc)..][..nc];
            for (response, lambda) in responses.iter().zip(second.chunks_exact(stride)) {
                row.iter_mut().zip(lambda).for_each(|(entry, l)| *entry -= response * l);
            }
        }
    }
}

/// The parameters are `(q, v, inputs, prescribed accelerations)`; after their columns come those of the
/// unknowns.
impl Dimensions {
    fn parameters(&self) -> usize {
        2 * self.coordinates() + self.input()
    }

    fn stride(&self) -> usize {
        padded(self.parameters().max(1))
    }

    /// Columns of the equations' Jacobian.
    fn columns(&self) -> usize {
        self.parameters() + self.dynamic + self.constraints
    }

    /// Column of the acceleration of a coordinate.
    fn acceleration(&self, coordinate: usize) -> usize {
        if coordinate < self.dynamic {
            self.parameters() + coordinate
        } else {
            2 * self.coordinates() + self.inputs + coordinate - self.dynamic
        }
    }
}

/// The equations of motion and constraint accelerations at a point, with their first derivatives.
#[derive(Clone, Debug)]
struct Equations<S: Scalar> {
    d: Dimensions,
    q: Vec<S>,
    v: Vec<S>,
    inputs: Vec<S>,
    /// Of all coordinates.
    acceleration: Vec<S>,
    multipliers: Vec<S>,
    /// Along the motion.
    blocks: Derivatives<Dual<S>>,
    /// At the configuration, for second derivatives.
    closure: Closure<S>,
    /// Along the motion, twice.
    motion: Closure<Dual<Dual<S>>>,
    hessian: Vec<S>,
    orientations: Vec<Mat3<S>>,
    /// nd + nc.
    residual: Vec<S>,
    /// nd + nc rows, [`Dimensions::columns`] columns.
    jacobian: Vec<S>,
}

impl<S: Scalar> Equations<S> {
    fn new(model: &Model) -> Self {
        let d = model.dimensions;
        let (n, rows) = (d.coordinates(), d.dynamic + d.constraints);
        let zeros = |len: usize| vec![S::ZERO; len];
        Self {
            d,
            q: zeros(n),
            v: zeros(n),
            inputs: zeros(d.inputs),
            acceleration: zeros(n),
            multipliers: zeros(d.constraints),
            blocks: Derivatives::new(model),
            closure: Closure::new(model),
            motion: Closure::new(model),
            hessian: zeros(if d.constraints > 0 { n * n } else { 0 }),
            orientations: vec![Mat3::IDENTITY; model.orientations.len()],
            residual: zeros(rows),
            jacobian: zeros(rows * d.columns()),
        }
    }

    fn evaluate(&mut self, model: &Model) {
        let (along_q, along_v) = (along(&self.q, &self.v), along(&self.v, &self.acceleration));
        let constant = along(&self.inputs, &vec![S::ZERO; self.inputs.len()]);
        let turned = self.turned(model);
        let mut turned_twice = Vec::new();
        for (still, &i) in self.orientations.iter().zip(&model.orientations) {
            let (spin, change) = (three(&self.v, i), three(&self.acceleration, i));
            let twice = pairs(pairs(Vec3::ZERO, spin), pairs(spin, change));
            turned_twice.push(at_rest(&at_rest(still)).times(&rotation::exp(twice)));
        }
        self.blocks.evaluate(model, (&along_q, &turned), &along_v, &constant);
        if self.d.constraints > 0 {
            let twice = along(&along_q, &along_v);
            self.motion.evaluate(model, &twice, &turned_twice);
            self.motion.differentiate(model, &twice);
            self.closure.evaluate(model, &self.q, &self.orientations);
            self.closure.hessian(model, &self.q, &self.multipliers, &mut self.hessian);
        }
        self.fill_dynamics(model);
        self.fill_constraints();
        if !model.orientations.is_empty() {
            self.turn(model);
        }
    }

    /// Orientations of ball joints along the motion.
    fn turned(&self, model: &Model) -> Vec<Mat3<Dual<S>>> {
        let balls = self.orientations.iter().zip(&model.orientations);
        let turned = balls.map(|(still, &i)| {
            at_rest(still).times(&rotation::exp(pairs(Vec3::ZERO, three(&self.v, i))))
        });
        turned.collect()
    }

    /// What ball joints add to the derivatives. Their momenta `m` are in turning axes, and derivatives along their axes do
    /// not commute: with the axes `X_a`, the angular velocity `ω` and the angular acceleration `α`,
    ///
    /// ```text
    /// rows         ω × m
    /// by q, L      (e_j × ω)·X m
    /// by q, h      2 (e_j × ω)·D X h + (e_j × α + (e_j × ω) × ω)·X h
    /// by v, h      (e_j × ω)·X h
    /// ```
    fn turn(&mut self, model: &Model) {
        let d = self.d;
        let (n, nd, nc, columns) = (d.coordinates(), d.dynamic, d.constraints, d.columns());
        for &i in &model.orientations {
            let (spin, change) = (three(&self.v, i), three(&self.acceleration, i));
            for b in 0..3 {
                let mut axis = Vec3::ZERO;
                axis.0[b] = S::ONE;
                let turned = axis.cross(spin);
                let twice = axis.cross(change) + turned.cross(spin);
                for row in 0..nd {
                    let along = Vec3([0, 1, 2].map(|l| self.blocks.l_qv[(i + l) * n + row].re));
                    self.jacobian[row * columns + i + b] += turned.dot(along);
                }
                for c in 0..nc {
                    let gradient = [0, 1, 2].map(|l| self.motion.jacobian[c * n + i + l]);
                    let (still, along) =
                        (Vec3(gradient.map(|x| x.re.re)), Vec3(gradient.map(|x| x.re.eps)));
                    let row = &mut self.jacobian[(nd + c) * columns..][..columns];
                    row[i + b] += turned.dot(along) * 2.0 + twice.dot(still);
                    row[n + i + b] += turned.dot(still);
                }
            }
            if i >= nd {
                continue;
            }
            let rows = |values: [S; 3]| spin.cross(Vec3(values));
            let momentum = [0, 1, 2].map(|a| self.blocks.l_v[i + a].re);
            for j in 0..n {
                let by_q = rows([0, 1, 2].map(|a| self.blocks.l_qv[j * n + i + a].re));
                let mut by_v = rows([0, 1, 2].map(|a| self.blocks.l_vv[j * n + i + a].re));
                if (i..i + 3).contains(&j) {
                    let mut axis = Vec3::ZERO;
                    axis.0[j - i] = S::ONE;
                    by_v += axis.cross(Vec3(momentum));
                }
                for a in 0..3 {
                    self.jacobian[(i + a) * columns + j] += by_q[a];
                    self.jacobian[(i + a) * columns + n + j] += by_v[a];
                }
            }
        }
    }

    /// Rows of the dynamic coordinates.
    fn fill_dynamics(&mut self, model: &Model) {
        let (d, blocks) = (self.d, &self.blocks);
        let (n, nd, ni, nc) = (d.coordinates(), d.dynamic, d.inputs, d.constraints);
        write_rates(model, &self.v, [&blocks.l_q, &blocks.l_v], &mut self.residual[..nd]);
        for i in 0..nd {
            let row = &mut self.jacobian[i * d.columns()..][..d.columns()];
            for j in 0..n {
                let (entry, mirrored) = (i * n + j, j * n + i);
                let l_vq = blocks.l_qv[mirrored];
                row[j] = l_vq.eps - blocks.l_qq[entry].re - blocks.f_q[entry].re;
                if nc > 0 {
                    row[j] += self.hessian[entry];
                }
                row[n + j] =
                    blocks.l_vv[entry].eps + l_vq.re - blocks.l_qv[entry].re - blocks.f_v[entry].re;
                row[d.acceleration(j)] = blocks.l_vv[entry].re;
            }
            for j in 0..ni {
                row[2 * n + j] = -blocks.f_u[i * ni + j].re;
            }
            let mut residual = self.residual[i] - blocks.force[i].re;
            for c in 0..nc {
                let entry = self.motion.jacobian[c * n + i].re.re;
                row[d.parameters() + nd + c] = entry;
                residual += entry * self.multipliers[c];
            }
            self.residual[i] = residual;
        }
    }

    /// Rows of the constraints.
    fn fill_constraints(&mut self) {
        let d = self.d;
        let n = d.coordinates();
        for c in 0..d.constraints {
            let row = &mut self.jacobian[(d.dynamic + c) * d.columns()..][..d.columns()];
            for j in 0..n {
                let entry = self.motion.jacobian[c * n + j];
                row[j] = entry.eps.eps;
                row[n + j] = entry.re.eps * 2.0;
                row[d.acceleration(j)] = entry.re.re;
            }
            self.residual[d.dynamic + c] = self.motion.value[c].eps.eps;
        }
    }
}

impl Equations<f64> {
    /// `M a + bias` of all coordinates: the rate of their momenta less what bodies and gravity make of it.
    /// Costs O(n).
    fn inertial_forces(&self, model: &Model) -> Vec<f64> {
        let (tree, n) = (&model.dynamics, self.d.coordinates());
        let (along_q, along_v) = (along(&self.q, &self.v), along(&self.v, &self.acceleration));
        let (mut poses, mut momenta) = (Poses::new(tree), Momenta::new(tree));
        let (mut l_q, mut l_v) = (vec![Dual::ZERO; n], vec![Dual::ZERO; n]);
        poses.evaluate(tree, &along_q, &self.turned(model));
        momenta.gradient(tree, &poses, &along_v, model.gravity, &mut l_q, &mut l_v);
        model.armature.add_momentum(&along_v, &mut l_v);
        let mut forces = vec![0.0; n];
        write_rates(model, &self.v, [&l_q, &l_v], &mut forces);
        forces
    }

    /// Takes a point over, with unknowns zero.
    fn place(&mut self, model: &Model, point: &ContinuousPoint) -> Result<(), ContinuousError> {
        let (dynamic, prescribed) = self.acceleration.split_at_mut(self.d.dynamic);
        dynamic.fill(0.0);
        self.multipliers.fill(0.0);
        take("q", &point.q, &mut self.q)?;
        self.orientations = orientations(model, &self.q);
        take("v", &point.v, &mut self.v)?;
        take("inputs", &point.inputs, &mut self.inputs)?;
        take("prescribed_acceleration", &point.prescribed_acceleration, prescribed)
    }
}

impl Equations<Dual> {
    /// The point of `at`, moving along the tangent of parameter `a`.
    fn seed(&mut self, model: &Model, at: &Equations<f64>, a: usize, tangent: &[f64]) {
        let d = self.d;
        let (n, stride) = (d.coordinates(), d.stride());
        let unit = |is: bool| if is { 1.0 } else { 0.0 };
        for (o, &i) in model.orientations.iter().enumerate() {
            let turn = Vec3([0, 1, 2].map(|b| Dual::new(0.0, unit(a == i + b))));
            self.orientations[o] = at_rest(&at.orientations[o]).times(&rotation::exp(turn));
        }
        for i in 0..n {
            self.q[i] = Dual::new(at.q[i], unit(a == i));
            self.v[i] = Dual::new(at.v[i], unit(a == n + i));
            let moved =
                if i < d.dynamic { tangent[i * stride + a] } else { unit(a == d.acceleration(i)) };
            self.acceleration[i] = Dual::new(at.acceleration[i], moved);
        }
        for i in 0..d.inputs {
            self.inputs[i] = Dual::new(at.inputs[i], unit(a == 2 * n + i));
        }
        for c in 0..d.constraints {
            let moved = tangent[(d.dynamic + c) * stride + a];
            self.multipliers[c] = Dual::new(at.multipliers[c], moved);
        }
    }
}

/// Writes `D L_v − L_q` from `L_q` and `L_v` along the motion, for as many coordinates as `out` has. Momenta
/// `m` of ball joints are in axes that turn with `ω`: theirs change by `ω × m`, too.
fn write_rates<S: Scalar>(
    model: &Model,
    velocity: &[S],
    [l_q, l_v]: [&[Dual<S>]; 2],
    out: &mut [S],
) {
    for (out, (l_q, l_v)) in out.iter_mut().zip(l_q.iter().zip(l_v)) {
        *out = l_v.eps - l_q.re;
    }
    for &i in &model.orientations {
        let Some(out) = out.get_mut(i..i + 3) else { continue };
        let momentum = three(l_v, i).0.map(|m| m.re);
        let carried = three(velocity, i).cross(Vec3(momentum));
        (0..3).for_each(|a| out[a] += carried[a]);
    }
}

/// Numbers that change at the rates of others.
fn along<S: Scalar>(re: &[S], eps: &[S]) -> Vec<Dual<S>> {
    re.iter().zip(eps).map(|(re, eps)| Dual::new(*re, *eps)).collect()
}

fn pairs<S: Scalar>(re: Vec3<S>, eps: Vec3<S>) -> Vec3<Dual<S>> {
    Vec3([0, 1, 2].map(|k| Dual::new(re[k], eps[k])))
}

fn at_rest<S: Scalar>(m: &Mat3<S>) -> Mat3<Dual<S>> {
    Mat3(m.0.map(|column| pairs(column, Vec3::ZERO)))
}

fn take(name: &'static str, from: &[f64], to: &mut [f64]) -> Result<(), ContinuousError> {
    if from.len() != to.len() {
        let (expected, actual) = (to.len(), from.len());
        return Err(ContinuousError::Dimension { name, expected, actual });
    }
    if let Some(index) = from.iter().position(|value| !value.is_finite()) {
        return Err(ContinuousError::NotFinite { name, index, value: from[index] });
    }
    to.copy_from_slice(from);
    Ok(())
}
