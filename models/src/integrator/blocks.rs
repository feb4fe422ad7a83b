//! First-order derivatives of the equations of a step as dense matrices, for any scalar.
//!
//! Evaluated with [`Dual`] numbers they give the second-order linearization: their dual parts are
//! derivatives of these along a direction. Steps and the first-order linearization itself, which is
//! [`linearize`](crate::linearization::linearize), know the sparsity.

use plantd_math::rotation::{self, Turn};
use plantd_math::scalar::{Dual, Scalar};
use plantd_math::spatial::{Mat3, Vec3, three};

use crate::constraints::closure::Closure;
use crate::integrator::settings::Settings;
use crate::lagrangian::derivatives::Derivatives;
use crate::lagrangian::turning::Turning;
use crate::model::mechanism::Model;

/// The blocks of one step's equations, row-major.
///
/// A column is a coordinate at the start of the step (`q[k]`, with the increment of a dynamic
/// coordinate kept), or what is next: the increment `x` of a dynamic coordinate, the next position of a
/// prescribed one. With `a` the weight of `F⁻` and `H = Σ λ D²h(q[k])`,
///
/// ```text
/// C_q = ½h L_qq − L_vq + a h f_q        C_v = ½h L_qv − L_vv + a h f_v
/// M_q = h (L_qq + f_q)                  M_v = h (L_qv + f_v)
///
/// column              of the residual r1     of p[k+1]
/// start, dynamic      C_q − H                M_q − H
/// start, prescribed   ½C_q − C_v/h − H       ½M_q − M_v/h − H
/// next                ½C_q + C_v/h           ½M_q + M_v/h
/// inputs              a h f_u                h f_u
/// ```
///
/// Ball joints weigh their rows and columns with the maps of their [`Turning`]; what is next of a
/// prescribed one is how it turns, too.
#[derive(Clone, Debug)]
pub(crate) struct StepBlocks<S: Scalar = f64> {
    /// At the midpoint.
    pub(crate) mid: Derivatives<S>,
    /// Constraints at `q[k]` and at `q[k+1]`, with their Jacobians.
    pub(crate) start: Closure<S>,
    pub(crate) end: Closure<S>,
    /// `H`, n by n; empty without constraints.
    pub(crate) hessian: Vec<S>,
    /// Where to evaluate: configuration at the start, n.
    pub(crate) q_start: Vec<S>,
    /// Increments of dynamic coordinates and of all ball joints, next positions of prescribed ones.
    pub(crate) next: Vec<S>,
    pub(crate) multipliers: Vec<S>,
    pub(crate) inputs: Vec<S>,
    pub(crate) q_mid: Vec<S>,
    pub(crate) velocity: Vec<S>,
    q_end: Vec<S>,
    /// Orientations of ball joints at the start, the midpoint, the end.
    pub(crate) orientations: [Vec<Mat3<S>>; 3],
    /// nd by n.
    pub(crate) residual_start: Vec<S>,
    /// nd by n.
    pub(crate) residual_next: Vec<S>,
    /// nd by ni.
    pub(crate) residual_inputs: Vec<S>,
    /// nd by n.
    pub(crate) momentum_start: Vec<S>,
    /// nd by n.
    pub(crate) momentum_next: Vec<S>,
    /// nd by ni.
    pub(crate) momentum_inputs: Vec<S>,
    /// Rows and columns of the blocks that may differ from zero.
    pattern: Vec<(usize, usize)>,
    /// Maps of the ball joints.
    pub(crate) turnings: Vec<Turning<S>>,
    /// With ball joints: `Dh(q[k+1])` by the start and by what is next, nc by n.
    end_by_start: Vec<S>,
    end_by_next: Vec<S>,
    /// With ball joints: torque, momentum and force by the start and by what is next, for up to three
    /// rows, n each.
    turned_rows: Vec<[Slopes<S>; 2]>,
}

/// Derivatives of torque `τ = L_q`, momentum `m = L_v` and force `f` of one coordinate.
#[derive(Clone, Copy, Debug, Default)]
struct Slopes<S> {
    torque: S,
    momentum: S,
    force: S,
}

impl<S: Scalar> StepBlocks<S> {
    pub(crate) fn new(model: &Model) -> Self {
        let d = model.dimensions;
        let (n, nd, ni, nc) = (d.coordinates(), d.dynamic, d.inputs, d.constraints);
        let no = model.orientations.len();
        let zeros = |len: usize| vec![S::ZERO; len];
        let mid = Derivatives::new(model);
        let pattern = mid.dynamic_pattern(model);
        Self {
            mid,
            start: Closure::new(model),
            end: Closure::new(model),
            hessian: zeros(if nc > 0 { n * n } else { 0 }),
            q_start: zeros(n),
            next: zeros(n),
            multipliers: zeros(nc),
            inputs: zeros(ni),
            q_mid: zeros(n),
            velocity: zeros(n),
            q_end: zeros(n),
            orientations: [0; 3].map(|_| vec![Mat3::IDENTITY; no]),
            residual_start: zeros(nd * n),
            residual_next: zeros(nd * n),
            residual_inputs: zeros(nd * ni),
            momentum_start: zeros(nd * n),
            momentum_next: zeros(nd * n),
            momentum_inputs: zeros(nd * ni),
            pattern,
            turnings: Vec::with_capacity(no),
            end_by_start: zeros(if no > 0 { nc * n } else { 0 }),
            end_by_next: zeros(if no > 0 { nc * n } else { 0 }),
            turned_rows: vec![Default::default(); if no > 0 { 3 * n } else { 0 }],
        }
    }

    /// `Dh(q[k+1])` by the start, with the increment of dynamic coordinates kept, and by what is next.
    pub(crate) fn end_jacobians(&self) -> [&[S]; 2] {
        if self.orientations[0].is_empty() {
            [&self.end.jacobian, &self.end.jacobian]
        } else {
            [&self.end_by_start, &self.end_by_next]
        }
    }

    /// Midpoint, velocity and end that belong to the start and what is next.
    pub(crate) fn place_midpoint(&mut self, model: &Model, h: f64) {
        let nd = model.dimensions.dynamic;
        for (i, (start, next)) in self.q_start.iter().zip(&self.next).enumerate() {
            let (moved, end) =
                if i < nd { (*next, *start + *next) } else { (*next - *start, *next) };
            self.q_mid[i] = *start + moved * 0.5;
            self.velocity[i] = moved * (1.0 / h);
            self.q_end[i] = end;
        }
        self.turnings.clear();
        for (o, &i) in model.orientations.iter().enumerate() {
            let turn = three(&self.next, i);
            self.velocity[i..i + 3].copy_from_slice(&turn.scaled(1.0 / h).0);
            let start = self.orientations[0][o];
            self.orientations[1][o] = start.times(&rotation::exp(turn.scaled(0.5)));
            self.orientations[2][o] = start.times(&rotation::exp(turn));
            self.turnings.push(Turning::new(model, i, Turn::new(turn), h));
        }
    }

    /// Evaluates all blocks at `q_start`, `next`, `multipliers`, `inputs`.
    pub(crate) fn evaluate(&mut self, model: &Model, settings: &Settings) {
        self.place_midpoint(model, settings.time_step_s);
        self.evaluate_mid(model);
        self.assemble(model, settings);
        if model.dimensions.constraints > 0 {
            self.evaluate_start(model);
            self.end.evaluate(model, &self.q_end, &self.orientations[2]);
            self.end.differentiate(model, &self.q_end);
            if !self.turnings.is_empty() {
                self.turn_end(model);
            }
            let rows = model.dimensions.dynamic * model.dimensions.coordinates();
            for (block, h) in self.residual_start.iter_mut().zip(&self.hessian[..rows]) {
                *block -= *h;
            }
            for (block, h) in self.momentum_start.iter_mut().zip(&self.hessian[..rows]) {
                *block -= *h;
            }
        }
    }

    /// Evaluates what stands at the midpoint.
    pub(crate) fn evaluate_mid(&mut self, model: &Model) {
        let at = (&self.q_mid[..], &self.orientations[1][..]);
        self.mid.evaluate(model, at, &self.velocity, &self.inputs);
    }

    /// Evaluates constraints and `H` at `q_start`, `multipliers`.
    pub(crate) fn evaluate_start(&mut self, model: &Model) {
        self.start.evaluate(model, &self.q_start, &self.orientations[0]);
        self.start.differentiate(model, &self.q_start);
        self.start.hessian(model, &self.q_start, &self.multipliers, &mut self.hessian);
    }

    /// Writes the blocks without constraints.
    pub(crate) fn assemble(&mut self, model: &Model, settings: &Settings) {
        let (n, nd) = (model.dimensions.coordinates(), model.dimensions.dynamic);
        let h = settings.time_step_s;
        let split = h * settings.force_split.at_start();
        let (mid, inverse) = (&self.mid, 1.0 / h);
        if model.dimensions.constraints > 0 {
            self.residual_start.fill(S::ZERO);
            self.momentum_start.fill(S::ZERO);
        }
        for &(i, j) in &self.pattern {
            let (entry, mirrored) = (i * n + j, j * n + i);
            let (l_qq, l_qv) = (mid.l_qq[entry], mid.l_qv[entry]);
            let (f_q, f_v) = (mid.f_q[entry], mid.f_v[entry]);
            let c_q = l_qq * (0.5 * h) - mid.l_qv[mirrored] + f_q * split;
            let c_v = l_qv * (0.5 * h) - mid.l_vv[entry] + f_v * split;
            let m_q = (l_qq + f_q) * h;
            let m_v = (l_qv + f_v) * h;
            let (half_c, slope_c) = (c_q * 0.5, c_v * inverse);
            let (half_m, slope_m) = (m_q * 0.5, m_v * inverse);
            self.residual_next[entry] = half_c + slope_c;
            self.momentum_next[entry] = half_m + slope_m;
            (self.residual_start[entry], self.momentum_start[entry]) =
                if j < nd { (c_q, m_q) } else { (half_c - slope_c, half_m - slope_m) };
        }
        for (entry, f_u) in mid.f_u.iter().enumerate() {
            self.residual_inputs[entry] = *f_u * split;
            self.momentum_inputs[entry] = *f_u * h;
        }
        if !self.turnings.is_empty() {
            self.assemble_turned(model, settings);
        }
    }

    /// Writes the rows and columns of ball joints.
    fn assemble_turned(&mut self, model: &Model, settings: &Settings) {
        let (n, nd, ni) =
            (model.dimensions.coordinates(), model.dimensions.dynamic, model.dimensions.inputs);
        let h = settings.time_step_s;
        let split = h * settings.force_split.at_start();
        let skew = 2.0 * split - h;
        let ball_at = |i: usize| self.turnings.iter().position(|t| t.coordinate == i);
        let mut i = 0;
        while i < nd {
            let ball = ball_at(i);
            let rows = if ball.is_some() { 3 } else { 1 };
            for row in 0..rows {
                turn_columns(
                    &self.mid,
                    &self.turnings,
                    nd,
                    h,
                    i + row,
                    &mut self.turned_rows[row * n..][..n],
                );
            }
            let Some(ball) = ball else {
                for t in &self.turnings {
                    for j in t.coordinate..t.coordinate + 3 {
                        let [start, next] = self.turned_rows[j];
                        let residual =
                            |s: Slopes<S>| s.torque * (0.5 * h) - s.momentum + s.force * split;
                        let momentum = |s: Slopes<S>| (s.torque + s.force) * h;
                        self.residual_start[i * n + j] = residual(start);
                        self.residual_next[i * n + j] = residual(next);
                        self.momentum_start[i * n + j] = momentum(start);
                        self.momentum_next[i * n + j] = momentum(next);
                    }
                }
                i += 1;
                continue;
            };
            let turning = self.turnings[ball];
            let weighed = |torque: Vec3<S>, momentum: Vec3<S>, force: Vec3<S>| {
                let impulse = torque.scaled(0.5 * h) + force.scaled(split);
                let residual = turning.torque.apply(impulse) - turning.momentum.apply(momentum);
                let split_force = (turning.torque.apply(force) - force).scaled(skew);
                let change =
                    (torque + force).scaled(h) + momentum.cross(turning.turn.xi) + split_force;
                (residual, change)
            };
            for j in 0..n {
                for (which, (residual, momentum)) in [
                    (&mut self.residual_start, &mut self.momentum_start),
                    (&mut self.residual_next, &mut self.momentum_next),
                ]
                .into_iter()
                .enumerate()
                {
                    let s = [0, 1, 2].map(|a| self.turned_rows[a * n + j][which]);
                    let (r, p) = weighed(
                        Vec3(s.map(|s| s.torque)),
                        Vec3(s.map(|s| s.momentum)),
                        Vec3(s.map(|s| s.force)),
                    );
                    for a in 0..3 {
                        residual[(i + a) * n + j] = r[a];
                        momentum[(i + a) * n + j] = p[a];
                    }
                }
            }
            // The maps turn with the joint's own increment.
            let (torque, momentum, force) =
                (three(&self.mid.l_q, i), three(&self.mid.l_v, i), three(&self.mid.force, i));
            let impulse = torque.scaled(0.5 * h) + force.scaled(split);
            let [residuals, forces] = turning.by_turn(impulse, momentum, force);
            for b in 0..3 {
                let mut axis = Vec3::ZERO;
                axis.0[b] = S::ONE;
                let change = momentum.cross(axis) + forces.0[b].scaled(skew);
                for a in 0..3 {
                    self.residual_next[(i + a) * n + i + b] += residuals.0[b][a];
                    self.momentum_next[(i + a) * n + i + b] += change[a];
                }
            }
            for j in 0..ni {
                let f_u = Vec3([0, 1, 2].map(|a| self.mid.f_u[(i + a) * ni + j]));
                let (residual, momentum) = weighed(Vec3::ZERO, Vec3::ZERO, f_u);
                for a in 0..3 {
                    self.residual_inputs[(i + a) * ni + j] = residual[a];
                    self.momentum_inputs[(i + a) * ni + j] = momentum[a];
                }
            }
            i += 3;
        }
    }

    /// The constraint Jacobian at the end by the start and by what is next.
    fn turn_end(&mut self, model: &Model) {
        let (n, nd) = (model.dimensions.coordinates(), model.dimensions.dynamic);
        self.end_by_start.copy_from_slice(&self.end.jacobian);
        self.end_by_next.copy_from_slice(&self.end.jacobian);
        for t in self.turnings.iter().filter(|t| t.coordinate < nd) {
            let range = t.coordinate..t.coordinate + 3;
            let rows = self.end.jacobian.chunks_exact(n);
            let turned =
                self.end_by_start.chunks_exact_mut(n).zip(self.end_by_next.chunks_exact_mut(n));
            for (row, (by_start, by_next)) in rows.zip(turned) {
                let gradient = Vec3([0, 1, 2].map(|a| row[t.coordinate + a]));
                by_start[range.clone()].copy_from_slice(&t.carried.apply_transposed(gradient).0);
                by_next[range.clone()].copy_from_slice(&t.to_end.apply_transposed(gradient).0);
            }
        }
    }
}

/// Derivatives of torque, momentum and force of coordinate `row` by the start and by what is next.
fn turn_columns<S: Scalar>(
    mid: &Derivatives<S>,
    turnings: &[Turning<S>],
    nd: usize,
    h: f64,
    row: usize,
    out: &mut [[Slopes<S>; 2]],
) {
    let n = out.len();
    for (j, out) in out.iter_mut().enumerate() {
        let (entry, mirrored) = (row * n + j, j * n + row);
        let slopes = |position: f64, velocity: f64| Slopes {
            torque: mid.l_qq[entry] * position + mid.l_qv[entry] * velocity,
            momentum: mid.l_qv[mirrored] * position + mid.l_vv[entry] * velocity,
            force: mid.f_q[entry] * position + mid.f_v[entry] * velocity,
        };
        let start = if j < nd { slopes(1.0, 0.0) } else { slopes(0.5, -1.0 / h) };
        *out = [start, slopes(0.5, 1.0 / h)];
    }
    for t in turnings {
        let c = t.coordinate;
        let in_row = |m: &[S]| Vec3([0, 1, 2].map(|b| m[row * n + c + b]));
        let in_column = Vec3([0, 1, 2].map(|b| mid.l_qv[(c + b) * n + row]));
        let by_position = [in_row(&mid.l_qq), in_column, in_row(&mid.f_q)];
        let by_velocity = [in_row(&mid.l_qv), in_row(&mid.l_vv), in_row(&mid.f_v)];
        for (which, (position, velocity)) in [t.by_start, t.by_next].into_iter().enumerate() {
            let [torque, momentum, force] = [0, 1, 2].map(|k| {
                position.apply_transposed(by_position[k])
                    + velocity.apply_transposed(by_velocity[k])
            });
            for b in 0..3 {
                out[c + b][which] =
                    Slopes { torque: torque[b], momentum: momentum[b], force: force[b] };
            }
        }
    }
}

impl StepBlocks<Dual> {
    /// What multiplies `x'` (nd) and `λ'` (nc) in row `i` of the change of a block by what is next.
    pub(crate) fn by_unknowns(&self, i: usize, next: &[Dual]) -> impl Iterator<Item = f64> {
        let (n, nd) = (self.q_start.len(), self.mid.l_q.len());
        let by_increment = next[i * n..][..nd].iter().map(|entry| entry.eps);
        let impulses =
            (0..self.multipliers.len()).map(move |c| -self.start.jacobian[c * n + i].eps);
        by_increment.chain(impulses)
    }
}
