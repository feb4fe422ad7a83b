//! Ties, and armatures of sums of coordinates, in a system that is solved by generators: a product of few rows more.
//!
//! ```text
//! K = K_gen + R G      K⁻¹ b = y − Y (1 + G Y)⁻¹ G y      y = K_gen⁻¹ b      Y = K_gen⁻¹ R
//! ```
//!
//! (the formula of Sherman, Morrison and Woodbury), with `R` what the ties of [`ties`](crate::lagrangian::ties) push, and
//! `G` how their forces change. In the notation of [`generators`](crate::lagrangian::generators), of a row
//!
//! ```text
//! R_i = T⁻ ∂y/∂q      G_j = ¼h Cᵀ ∂T/∂q + ½ ∂T/∂v
//! ```
//!
//! and of an armature `a` of the sum `Σ c_i q_i`
//!
//! ```text
//! R_i = c_i           G_j = −a c_j / h
//! ```

use plantd_math::pivoted_lu::PivotedLu;
use plantd_math::rows::{AlignedRows, Term, add_rows, dot, non_zero, padded};
use plantd_math::spatial::{Mat3, Vec3};

use crate::kkt::closing::Closing;
use crate::kkt::pushes::Pushes;
use crate::kkt::space::columns::Rows;
use crate::lagrangian::ties::{Entry, Ties};
use crate::lagrangian::turning::{Turning, Weights};
use crate::model::mechanism::{Model, SumArmature};

/// The least pivot of `1 + G Y`, relative to the largest, that is taken: else matrices are filled entry by entry.
const SOUND: f64 = 1e-10;

/// The ties of a system, factored.
#[derive(Clone, Debug)]
pub(crate) struct Tied {
    pub(crate) ties: Ties,
    nd: usize,
    /// Armatures have the last rows.
    armatures: Vec<SumArmature>,
    /// `R`, `G` and `Y`, a row of nd for each tie and each armature.
    pushes: Vec<f64>,
    changes: Vec<f64>,
    responses: Vec<f64>,
    /// What their forces `φ` give to the momentum at the end at a fixed increment: `2 ∂y/∂q − R` of ties, and `−R` of
    /// armatures, which give the opposite of what they give to the residual.
    momenta: Vec<f64>,
    lu: PivotedLu,
    /// `G y`.
    forces: Vec<f64>,
    /// Factored are masses, to which they give nothing.
    pub(crate) is_idle: bool,
}

/// What a linearization needs of them beside.
#[derive(Clone, Debug)]
pub(crate) struct TiedTangents {
    pushes: Pushes,
    /// `X_p R`, a row of ties for each coordinate, and `G X_p R`, a row for each tie.
    increments: Vec<f64>,
    changes: Vec<f64>,
    /// Derivatives of the forces, a row for each tie.
    forces: AlignedRows,
}

impl TiedTangents {
    /// Room for those of a model, with rows of its linearization that are so long.
    pub(crate) fn new(model: &Model, stride: usize) -> Self {
        let (nd, count) = (model.dimensions.dynamic, model.tied_rows);
        Self {
            pushes: Pushes::new(model, stride, count),
            increments: vec![0.0; nd * padded(count)],
            changes: vec![0.0; padded(count)],
            forces: AlignedRows::zeros(count * stride),
        }
    }
}

impl Tied {
    /// Room for the ties of a model, and for right-hand sides in rows of so many.
    pub(crate) fn new(model: &Model, stride: usize) -> Self {
        let (nd, count) = (model.dimensions.dynamic, model.tied_rows);
        let zeros = || vec![0.0; count * nd];
        let (ties, armatures) = (Ties::new(model), model.armature.sums.clone());
        let [mut pushes, mut momenta] = [zeros(), zeros()];
        for (row, armature) in (ties.rows().len()..).zip(&armatures) {
            for &(i, c) in &armature.terms {
                (pushes[row * nd + i], momenta[row * nd + i]) = (c, -c);
            }
        }
        Self {
            ties,
            nd,
            armatures,
            pushes,
            changes: zeros(),
            responses: zeros(),
            momenta,
            lu: PivotedLu::new(&vec![1.0; count], stride).with_independent(count),
            forces: vec![0.0; count],
            is_idle: true,
        }
    }

    /// Finds `R` and `G` at the last evaluation of the ties.
    pub(crate) fn weigh(&mut self, model: &Model, balls: &[Weights], time_step_s: f64) {
        self.weigh_armatures(time_step_s);
        self.is_idle = false;
        let Self { ties, nd, pushes, changes, momenta, .. } = self;
        let (quarter, half) = (0.25 * time_step_s, 0.5);
        let pushed = pushes.chunks_exact_mut(*nd).zip(momenta.chunks_exact_mut(*nd));
        let rows = ties.rows().zip(changes.chunks_exact_mut(*nd)).zip(pushed);
        for ((row, changes), (pushes, momenta)) in rows {
            let entries = row.iter().zip(&mut *pushes).zip(&mut *changes);
            for ((entry, push), change) in entries {
                *push = entry.length;
                *change = quarter * entry.by_position + half * entry.by_velocity;
            }
            for (weights, &i) in balls.iter().zip(&model.orientations) {
                if i + 3 <= *nd {
                    let [length, position, velocity] = of_ball(row, i);
                    let change = weights.column.apply_transposed(position) * quarter;
                    put(pushes, i, weights.torque.apply(length));
                    put(changes, i, change + velocity * half);
                }
            }
            let entries = momenta.iter_mut().zip(row).zip(&*pushes);
            entries.for_each(|((momentum, entry), push)| *momentum = 2.0 * entry.length - push);
        }
    }

    /// Finds `G` of masses, to which ties give nothing.
    pub(crate) fn weigh_masses(&mut self, time_step_s: f64) {
        self.changes.fill(0.0);
        self.weigh_armatures(time_step_s);
        self.is_idle = self.armatures.is_empty();
    }

    fn weigh_armatures(&mut self, time_step_s: f64) {
        let rows = self.changes.chunks_exact_mut(self.nd).skip(self.ties.rows().len());
        for (changes, SumArmature { terms, inertia }) in rows.zip(&self.armatures) {
            terms.iter().for_each(|&(i, c)| changes[i] = -inertia * c / time_step_s);
        }
    }

    /// Factors, with what solves by generators; false where the pivots are not sound.
    pub(crate) fn factor(&mut self, mut solve: impl FnMut(&mut [f64])) -> bool {
        let Self { nd, pushes, changes, responses, lu, forces, .. } = self;
        responses.copy_from_slice(pushes);
        responses.chunks_exact_mut(*nd).for_each(&mut solve);
        let rows = lu.matrix.chunks_exact_mut(forces.len()).zip(changes.chunks_exact(*nd));
        for (t, (row, change)) in rows.enumerate() {
            for (entry, response) in row.iter_mut().zip(responses.chunks_exact(*nd)) {
                *entry = dot(change, response);
            }
            row[t] += 1.0;
        }
        lu.factor();
        lu.reciprocal_condition(forces.len(), 0.0) >= SOUND
    }

    /// From `y = K_gen⁻¹ b`, makes `K⁻¹ b`.
    pub(crate) fn close(&mut self, x: &mut [f64]) {
        let Self { nd, changes, responses, lu, forces, .. } = self;
        for (force, change) in forces.iter_mut().zip(changes.chunks_exact(*nd)) {
            *force = dot(change, x);
        }
        lu.solve(forces);
        for (force, response) in forces.iter().zip(responses.chunks_exact(*nd)) {
            x.iter_mut().zip(response).for_each(|(x, response)| *x -= force * response);
        }
    }

    /// From a linearization by the generators alone, whose increments are `X θ'` and momenta `P θ'`, makes that with
    /// the ties. Their forces `φ` give `R φ` to the residual and `V φ` to the momentum, of ties
    /// `V = 2 ∂y/∂q − R`, of armatures `−R`:
    ///
    /// ```text
    /// φ' = G x' + G_θ θ'      x' = X θ' + X_p R φ'      p[k+1]' = P θ' + (P_p R + V) φ'
    /// ```
    ///
    /// False where they are not sound.
    pub(crate) fn linearize(
        &mut self,
        (turnings, time_step_s): (&[Turning], f64),
        Rows { increment, momentum, stride }: Rows<'_>,
        tangents: &mut TiedTangents,
        terms: &mut Vec<Term>,
    ) -> bool {
        let TiedTangents { pushes, increments, changes: products, forces } = tangents;
        let (nd, count, width) = (self.nd, self.forces.len(), products.len());
        for (t, row) in self.pushes.chunks_exact(nd).enumerate() {
            pushes.take_column(t, row.iter().map(|push| -push));
        }
        pushes.respond(increment, increments, terms);
        pushes.respond_in_momentum(momentum, terms);
        let in_momentum = pushes.of_momentum();
        for (t, row) in self.momenta.chunks_exact(nd).enumerate() {
            let column = in_momentum.iter_mut().skip(t).step_by(width);
            column.zip(row).for_each(|(to, momentum)| *to += momentum);
        }
        forces.fill(0.0);
        for (row, force) in self.ties.rows().zip(forces.chunks_exact_mut(stride)) {
            by_parameters(row, nd, (turnings, time_step_s), force);
        }
        for (t, changes) in self.changes.chunks_exact(nd).enumerate() {
            let force = &mut forces[t * stride..][..stride];
            terms.clear();
            terms.extend(non_zero(changes.iter().copied()));
            add_rows(force, increment, stride, terms);
            products.fill(0.0);
            add_rows(products, increments, width, terms);
            let own = &mut self.lu.matrix[t * count..][..count];
            own.iter_mut().zip(&*products).for_each(|(own, product)| *own = -product);
            own[t] += 1.0;
        }
        self.lu.factor();
        if self.lu.reciprocal_condition(count, 0.0) < SOUND {
            return false;
        }
        self.lu.solve_rows(forces, stride);
        pushes.add_to(increment, increments, forces, terms);
        pushes.add_to_momentum(momentum, forces, terms);
        true
    }

    /// Room for products.
    pub(crate) fn new_closing(model: &Model) -> Closing {
        let (d, count) = (model.dimensions, model.tied_rows);
        let lu = PivotedLu::new(&vec![1.0; count], 1).with_independent(count);
        Closing::new(d.dynamic, 2 * d.coordinates(), lu, count)
    }

    /// Closes products of the tree, with what finds the increment and the momentum at the end that belong to a push, in
    /// its place. False where they are not sound.
    pub(crate) fn close_products(
        &mut self,
        step: (&[Turning], f64),
        closing: &mut Closing,
        respond: impl FnMut(&mut [f64], &mut [f64]),
    ) -> bool {
        let is_sound = self.factor(closing.take_responses(respond));
        closing.take_factors_of(&self.lu);
        let mut ties = self.ties.rows();
        let rows = self.momenta.chunks_exact(self.nd).zip(self.changes.chunks_exact(self.nd));
        for ((momenta, changes), equation) in rows.zip(closing.equations()) {
            equation.by_increment.copy_from_slice(changes);
            equation.by_parameters.fill(0.0);
            if let Some(row) = ties.next() {
                by_parameters(row, self.nd, step, equation.by_parameters);
            }
            equation.momentum.iter_mut().zip(momenta).for_each(|(to, momentum)| *to -= momentum);
        }
        is_sound
    }

    /// Adds, `weight` times, how the generalized forces change with changes of the coordinates and velocities.
    pub(crate) fn add_change(
        &self,
        [position, velocity]: [&[f64]; 2],
        weight: f64,
        force: &mut [f64],
    ) {
        for row in self.ties.rows() {
            let mut change = 0.0;
            for ((entry, position), velocity) in row.iter().zip(position).zip(velocity) {
                change += entry.by_position * position + entry.by_velocity * velocity;
            }
            let change = weight * change;
            force.iter_mut().zip(row).for_each(|(force, entry)| *force += change * entry.length);
        }
    }
}

/// Writes how the force of a tie changes with the columns `(q, p, k)` of a linearization, at fixed increments.
fn by_parameters(
    row: &[Entry],
    nd: usize,
    (turnings, time_step_s): (&[Turning], f64),
    force: &mut [f64],
) {
    let (n, quarter, half) = (row.len(), 0.25 * time_step_s, 0.5);
    for (i, entry) in row.iter().enumerate() {
        let (position, velocity) = (quarter * entry.by_position, half * entry.by_velocity);
        if i < nd {
            force[i] = 2.0 * position;
        } else {
            (force[i], force[n + i]) = (position - velocity, position + velocity);
        }
    }
    for turning in turnings {
        let i = turning.coordinate;
        let [_, position, velocity] = of_ball(row, i);
        let by = |(turned, faster): &(Mat3, Mat3)| {
            turned.apply_transposed(position) * (2.0 * quarter)
                + faster.apply_transposed(velocity) * (time_step_s * half)
        };
        put(force, i, by(&turning.by_start));
        if i >= nd {
            put(force, n + i, by(&turning.by_next));
        }
    }
}

/// The entries of a ball joint in a row.
fn of_ball(row: &[Entry], first: usize) -> [Vec3; 3] {
    let [a, b, c] = [row[first], row[first + 1], row[first + 2]];
    [
        Vec3([a.length, b.length, c.length]),
        Vec3([a.by_position, b.by_position, c.by_position]),
        Vec3([a.by_velocity, b.by_velocity, c.by_velocity]),
    ]
}

fn put(row: &mut [f64], first: usize, Vec3(numbers): Vec3) {
    row[first..first + 3].copy_from_slice(&numbers);
}
