//! Steps of one joint in a plane, or of two of which one hangs on the other, of several plants side by side, in one
//! function for each: the same map, the same bits.
//!
//! To the loop of [`abreast`](super) what [`few`](crate::integrator::few) is to that of [`newton`](crate::integrator::newton):
//! all formulas are the same, on lists whose length the compiler knows ([`InARow`]). A lane that needs new factors where
//! others keep theirs is not solved here; so there is one matrix, and nothing to put aside but results.
//!
//! One loop for one plant and for several was measured: a pendulum by itself took 1.05 to 1.06 of the time, two joints
//! 1.08 to 1.13. What this one gains is in `docs/figures.md`.

use std::f64::consts::PI;

use plantd_math::norms::largest_of_each;
use plantd_math::scalar::{Compared, LanesOf, Scalar, Truths, in_registers};
use plantd_math::tree_lu::TreeLu;

use crate::integrator::abreast::{Abreast, States, System};
use crate::integrator::foresight::{Strayed, change_of, is_negligible};
use crate::integrator::midpoint::middle;
use crate::integrator::newton::{CONVERGED, Chord, STALE, is_round_off};
use crate::integrator::predictor::{least, take_note};
use crate::integrator::report::{StepError, StepReport};
use crate::integrator::residual::{impulse_of, sum_of};
use crate::integrator::settings::Settings;
use crate::integrator::state::add;
use crate::kkt::system::TREE_CORRECTIONS;
use crate::lagrangian::arrangement::{InARow, Ones};
use crate::lagrangian::forces::{damped, input_forces_here};
use crate::lagrangian::planar::Joints;
use crate::model::mechanism::Model;
use crate::model::planar_tree::PlanarJoints;

/// What `K` joints have, of `N` plants.
type List<const N: usize, const K: usize> = [LanesOf<N>; K];

/// A row of `K` joints of `N` plants in a step: where it was evaluated last, and how it was solved.
struct Row<const N: usize, const K: usize> {
    joints: Joints<Ones<LanesOf<N>, InARow<K>>>,
    l_q: List<N, K>,
    force: List<N, K>,
    /// Zero where there is none.
    damping: [f64; K],
    is_damped: bool,
    /// Which plants are done; what follows is of them.
    done: Truths<N>,
    increment: List<N, K>,
    impulse: List<N, K>,
    residual: LanesOf<N>,
    /// The smallest pivot, relative.
    pivot: LanesOf<N>,
    evaluations: LanesOf<N>,
}

impl<const N: usize, const K: usize> Row<N, K> {
    /// Factors at the last evaluation.
    #[inline(always)]
    fn factor(
        &mut self,
        model: &Model,
        joints: &PlanarJoints,
        settings: &Settings,
        matrix: &mut TreeLu<LanesOf<N>>,
    ) {
        let Settings { time_step_s: h, force_split, .. } = *settings;
        self.joints.differentiate_here(joints);
        self.joints.place_here(joints);
        let (elimination, inertia) = (&model.elimination, &model.conditioning.inertia[..K]);
        let [starts, diagonals] = elimination.places(K);
        for (below, first) in starts.iter().enumerate() {
            for above in 0..=below {
                self.joints.fill_entry(joints, [above, below], h, (matrix, first + above));
            }
        }
        for (slot, c) in diagonals.iter().zip(self.damping) {
            let slope = LanesOf::constant(-force_split.at_start() * c);
            matrix.add_to_diagonal(*slot, slope);
        }
        self.pivot = matrix.factor_few(elimination, inertia, 1.0 / h.abs()).relative;
    }

    /// Takes what some plants have come to after so many iterations; the impulse of those that are `nudged` has not been
    /// evaluated at the increment.
    #[inline(always)]
    fn take(
        &mut self,
        [ends, nudged]: [Truths<N>; 2],
        [x, r]: [&List<N, K>; 2],
        (joints, h): (&PlanarJoints, f64),
        iterations: u32,
    ) {
        let [mut position, mut rate, mut change] = [[LanesOf::ZERO; K]; 3];
        let is_nudged = LanesOf::<N>::any(nudged);
        if is_nudged {
            for i in 0..K {
                [position[i], rate[i]] = change_of(r[i], h);
            }
            self.joints.nudge_here(joints, [&position, &rate], &mut change);
        }
        for i in 0..K {
            let mut impulse = impulse_of(self.l_q[i], self.force[i], h);
            if is_nudged {
                let mut moved = impulse + change[i] * h;
                if self.is_damped {
                    moved += r[i] * self.damping[i];
                }
                impulse = LanesOf::choose(nudged, moved, impulse);
            }
            self.impulse[i] = LanesOf::choose(ends, impulse, self.impulse[i]);
            self.increment[i] = LanesOf::choose(ends, x[i], self.increment[i]);
        }
        let iterations = LanesOf::constant(f64::from(iterations));
        self.evaluations = LanesOf::choose(ends, iterations, self.evaluations);
        self.done = self.done | ends;
    }
}

impl<const N: usize> Abreast<N> {
    /// Solves a step of `K` joints as [`Abreast::solve`].
    #[inline(never)]
    pub(super) fn solve_joints<const K: usize>(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &States<N>,
        lanes: Truths<N>,
        results: &mut [Result<StepReport, StepError>],
    ) -> Truths<N> {
        in_registers!(LanesOf<N>, {
            self.predict(state);
            let Some(row) = self.solve_row::<K>(model, settings, state, lanes) else {
                return LanesOf::<N>::all(false);
            };
            let [increment, impulse] = &mut self.solved;
            increment.copy_from_slice(&row.increment);
            impulse.copy_from_slice(&row.impulse);
            self.evaluations = row.evaluations;
            for (lane, result) in results.iter_mut().enumerate().filter(|(l, _)| row.done.of(*l)) {
                *result = Ok(StepReport {
                    iterations: row.evaluations.0[lane] as u32,
                    factorizations: 1,
                    residual: row.residual.0[lane],
                    reciprocal_condition: row.pivot.0[lane],
                    ..StepReport::UNCONSTRAINED
                });
            }
            row.done
        })
    }

    /// `None` for a model of other joints.
    #[inline(always)]
    fn solve_row<const K: usize>(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &States<N>,
        lanes: Truths<N>,
    ) -> Option<Row<N, K>> {
        let constant = LanesOf::<N>::constant;
        let Settings { time_step_s: h, force_split, .. } = *settings;
        let (inverse, at_start) = (1.0 / h, force_split.at_start());
        let joints = model.planar.as_ref()?;
        let System::Tree(matrix) = &mut self.systems.first else { return None };
        let turns_per_radian = self.mid.turns_per_radian.first_chunk::<K>()?;
        let [q, q_low] = [state.q.first_chunk::<K>()?, state.q_low.first_chunk()?];
        let [p, p_low] = [state.p.first_chunk::<K>()?, state.p_low.first_chunk()?];
        let inertia = model.conditioning.inertia.first_chunk::<K>()?;
        let mut input_force = [LanesOf::ZERO; K];
        input_forces_here(&model.coordinate_inputs, &self.mid.inputs, &mut input_force);

        let zeros = [LanesOf::ZERO; K];
        let mut row = Row {
            joints: Joints::new(joints),
            l_q: zeros,
            force: zeros,
            damping: *model.damping.first_chunk().unwrap_or(&[0.0; K]),
            is_damped: !model.damping.is_empty(),
            done: LanesOf::<N>::all(false),
            increment: zeros,
            impulse: zeros,
            residual: LanesOf::ZERO,
            pivot: LanesOf::ONE,
            evaluations: LanesOf::ZERO,
        };
        let mut x = *self.increment.first_chunk::<K>()?;
        let [mut velocity, mut angles, mut l_v, mut r] = [zeros; 4];
        let mut chord = Chord::<LanesOf<N>>::new(settings, TREE_CORRECTIONS, false);
        let mut strayed = Strayed::<LanesOf<N>>::default();
        let none = LanesOf::<N>::all(false);
        let (mut live, mut closing, mut iterations) = (lanes, none, 0);
        loop {
            for i in 0..K {
                [_, velocity[i], angles[i]] =
                    middle(x[i], q[i], q_low[i], turns_per_radian[i], inverse);
            }
            row.joints.gradient_here(joints, [&angles, &velocity], [&mut row.l_q, &mut l_v]);
            let mut magnitudes = zeros;
            for i in 0..K {
                row.force[i] = damped(input_force[i], velocity[i], row.damping[i]);
                let terms = [row.l_q[i], l_v[i], row.force[i], angles[i]];
                [r[i], magnitudes[i]] = sum_of([p[i], p_low[i]], terms, 0.5 * h, at_start * h);
            }
            if LanesOf::<N>::any(closing) {
                row.take([closing, none], [&x, &r], (joints, h), iterations);
                live = live & !closing;
            }
            if !LanesOf::<N>::any(live) || iterations == settings.max_iterations {
                break;
            }
            let largest = largest_of_each(&magnitudes).max(constant(f64::MIN_POSITIVE));
            let round_off = largest * f64::EPSILON;
            let size = largest_of_each(&r) / round_off;
            iterations += 1;
            live = live & size.less(constant(f64::INFINITY));
            row.residual = LanesOf::choose(live, size, row.residual);
            let converged = chord.judge(size, LanesOf::ZERO);
            if iterations == 1 {
                row.factor(model, joints, settings, matrix);
                live = live & constant(settings.singular_below).at_most(row.pivot);
                let rests = live & size.at_most(constant(CONVERGED));
                if LanesOf::<N>::any(rests) {
                    row.take([rests, none], [&x, &r], (joints, h), iterations);
                    live = live & !rests;
                }
            } else {
                live = live & !chord.is_fresh;
            }
            if !LanesOf::<N>::any(live) {
                break;
            }
            matrix.substitute(&model.elimination, &mut r);
            for i in 0..K {
                x[i] -= r[i];
            }
            let stale = live & converged & size.at_most(constant(STALE));
            let left = strayed.left(&r, &x, inertia, round_off * h.abs());
            let expected = chord.expected();
            let nudged = live & !stale & is_negligible(left, expected);
            let ends = stale | nudged;
            if LanesOf::<N>::any(ends) {
                row.residual = LanesOf::choose(nudged, least(left, expected), row.residual);
                row.take([ends, nudged], [&x, &r], (joints, h), iterations);
                live = live & !ends;
                if !LanesOf::<N>::any(live) {
                    break;
                }
            }
            closing = live & converged;
            chord.is_idle = LanesOf::<N>::all(true);
            for i in 0..K {
                chord.is_idle = chord.is_idle & is_round_off(r[i], angles[i], x[i]);
            }
        }
        let is_near = largest_of_each(&row.increment).at_most(constant(PI));
        row.done = row.done & is_near;
        Some(row)
    }

    /// Moves `K` joints of all lanes on as [`Abreast::move_on`].
    #[inline(always)]
    pub(super) fn move_joints_on<const K: usize>(&self, model: &Model, state: &mut States<N>) {
        let [increment, impulse] = self.solved.each_ref().map(|list| &list[..K]);
        let States { q, q_low, p, p_low, past, known, order, .. } = state;
        add(&mut q[..K], &mut q_low[..K], increment);
        add(&mut p[..K], &mut p_low[..K], impulse);
        let (inertia, counts) = (&model.conditioning.inertia[..K], [*known, self.evaluations]);
        [*known, *order] = take_note(&mut past[..K], increment, inertia, &[], counts);
    }
}
