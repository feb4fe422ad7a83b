//! Steps of one joint in a plane, or of two of which one hangs on the other, in one function for each: the same map, the
//! same bits.
//!
//! A Newton loop beside that of [`newton`](super::newton), because the arithmetic of so small a step is the least of it: half
//! of a pendulum's was what goes from function to function by way of memory, and loops over lists of one number. All
//! formulas are those of the other loop, on lists whose length the compiler knows ([`InARow`]). It knows the usual way of a
//! step: bodies, inputs and damping, from a guess by past increments to convergence. A step that leaves it is taken by the
//! other loop from its beginning. What it gains is in `docs/figures.md`; a test holds it to the bits of the other loop.
//! Plants side by side have a loop of their own ([`row`](super::abreast::row)).

use std::f64::consts::PI;

use plantd_math::norms::largest_of_each;

use crate::integrator::foresight::{Strayed, change_of, is_negligible};
use crate::integrator::midpoint::middle;
use crate::integrator::newton::{CONVERGED, Chord, STALE, is_round_off};
use crate::integrator::report::StepReport;
use crate::integrator::residual::{impulse_of, sum_of};
use crate::integrator::settings::Settings;
use crate::integrator::state::{PreciseState, add};
use crate::integrator::workspace::{StepContext, StepIncrement, Workspace};
use crate::kkt::system::{Factors, TREE_CORRECTIONS};
use crate::lagrangian::arrangement::{InARow, Ones};
use crate::lagrangian::forces::{damped, input_forces_here};
use crate::lagrangian::planar::Joints;
use crate::model::mechanism::{Model, Solver};
use crate::model::planar_tree::PlanarJoints;

/// Joints for which there are such functions.
const MOST: usize = 2;

impl Model {
    /// Joints of a model whose steps have this way, else zero.
    pub(crate) fn few_joints(&self) -> usize {
        let d = self.dimensions;
        let is_bare = d.prescribed + d.constraints == 0
            && self.orientations.is_empty()
            && !self.potentials.any
            && self.forces.is_none();
        let are_in_a_row = self.planar.as_ref().is_some_and(PlanarJoints::are_in_a_row);
        let is_few = is_bare && are_in_a_row && self.solver == Solver::Tree && d.dynamic <= MOST;
        if is_few { d.dynamic } else { 0 }
    }
}

impl PreciseState {
    /// Moves on to the solution as [`PreciseState::move_on`]; `None` if that has to.
    #[inline(always)]
    pub(crate) fn move_few_on(&mut self, model: &Model, workspace: &Workspace) -> Option<()> {
        match workspace.few_joints {
            1 => self.move_joints_on::<1>(model, &workspace.step),
            2 => self.move_joints_on::<2>(model, &workspace.step),
            _ => None,
        }
    }

    #[inline(never)]
    fn move_joints_on<const N: usize>(
        &mut self,
        model: &Model,
        step: &StepIncrement,
    ) -> Option<()> {
        let increment = step.increment.first_chunk::<N>()?;
        add(self.q.first_chunk_mut::<N>()?, self.q_low.first_chunk_mut::<N>()?, increment);
        let impulse = step.impulse.first_chunk::<N>()?;
        add(self.p.first_chunk_mut::<N>()?, self.p_low.first_chunk_mut::<N>()?, impulse);
        let inertia = model.conditioning.inertia.first_chunk::<N>()?;
        self.past.record_here(increment, inertia, &[], step.report.iterations);
        Some(())
    }
}

impl Workspace {
    /// Solves one step as [`Workspace::solve`]; `None` if that has to.
    #[inline(always)]
    pub(crate) fn solve_few(&mut self, at: StepContext<'_>) -> Option<()> {
        match self.few_joints {
            1 => self.solve_joints::<1>(at),
            2 => self.solve_joints::<2>(at),
            _ => None,
        }
    }

    #[inline(never)]
    fn solve_joints<const N: usize>(&mut self, at: StepContext<'_>) -> Option<()> {
        let StepContext { model, settings, state, u } = at;
        let Settings { time_step_s: h, force_split, .. } = *settings;
        let (inverse, at_start) = (1.0 / h, force_split.at_start());
        let Self { step, mid, kkt, .. } = self;
        let joints = model.planar.as_ref()?;
        let mut row = Joints::<Ones<f64, InARow<N>>>::new(joints);
        let [q, q_low] = [state.q.first_chunk::<N>()?, state.q_low.first_chunk()?];
        let [p, p_low] = [state.p.first_chunk::<N>()?, state.p_low.first_chunk()?];
        let inertia = model.conditioning.inertia.first_chunk::<N>()?;
        let turns_per_radian = mid.turns_per_radian.first_chunk::<N>()?;
        let is_damped = !model.damping.is_empty();
        let damping = if is_damped { model.damping.first_chunk()? } else { &[0.0; N] };

        let mut x = [0.0; N];
        if !state.past.predict(&mut x) {
            return None;
        }
        let mut input_force = [0.0; N];
        input_forces_here(&model.coordinate_inputs, u, &mut input_force);
        let [mut middles, mut velocity, mut angles] = [[0.0; N]; 3];
        let [mut l_q, mut l_v, mut force, mut r] = [[0.0; N]; 4];

        let mut report = StepReport::default();
        let mut chord = Chord::<f64>::new(settings, TREE_CORRECTIONS, false);
        let mut strayed = Strayed::default();
        let (mut is_evaluated, mut is_done) = (true, false);
        loop {
            for i in 0..N {
                [middles[i], velocity[i], angles[i]] =
                    middle(x[i], q[i], q_low[i], turns_per_radian[i], inverse);
            }
            row.gradient_here(joints, [&angles, &velocity], [&mut l_q, &mut l_v]);
            let mut magnitudes = [0.0; N];
            for i in 0..N {
                force[i] = damped(input_force[i], velocity[i], damping[i]);
                let terms = [l_q[i], l_v[i], force[i], angles[i]];
                [r[i], magnitudes[i]] = sum_of([p[i], p_low[i]], terms, 0.5 * h, at_start * h);
            }
            if is_done {
                break;
            }
            let round_off = f64::EPSILON * largest_of_each(&magnitudes).max(f64::MIN_POSITIVE);
            let size = largest_of_each(&r) / round_off;
            if !size.is_finite() || report.iterations == settings.max_iterations {
                return None;
            }
            report.iterations += 1;
            report.residual = size;
            let converged = chord.judge(size, 0.0);
            if chord.is_fresh {
                let matrix = &mut kkt.factored.tree;
                row.differentiate_here(joints);
                row.place_here(joints);
                let [starts, diagonals] = model.elimination.places(N);
                for (below, first) in starts.iter().enumerate() {
                    for above in 0..=below {
                        row.fill_entry(joints, [above, below], h, (matrix, first + above));
                    }
                }
                for (slot, c) in diagonals.iter().zip(damping) {
                    matrix.add_to_diagonal(*slot, -at_start * c);
                }
                let pivot = matrix.factor_few(&model.elimination, inertia, 1.0 / h.abs());
                if !(pivot.relative >= settings.singular_below) {
                    return None;
                }
                kkt.estimates.matrix = pivot.relative;
                report.factorizations += 1;
                strayed = Strayed::default();
            }
            if report.iterations == 1 && size <= CONVERGED {
                break;
            }
            kkt.factored.tree.substitute(&model.elimination, &mut r);
            for i in 0..N {
                x[i] -= r[i];
            }
            if converged && size <= STALE {
                break;
            }
            let left = strayed.left(&r, &x, inertia, round_off * h.abs());
            let expected = chord.expected();
            if is_negligible(left, expected) {
                report.residual = left.min(expected);
                is_evaluated = false;
                break;
            }
            is_done = converged;
            chord.is_idle = (0..N).all(|i| is_round_off(r[i], angles[i], x[i]));
        }
        if !(largest_of_each(&x) <= PI) {
            return None;
        }
        let mut impulse = [0.0; N];
        for i in 0..N {
            impulse[i] = impulse_of(l_q[i], force[i], h);
        }
        if !is_evaluated {
            let [mut position, mut rate, mut change] = [[0.0; N]; 3];
            for i in 0..N {
                [position[i], rate[i]] = change_of(r[i], h);
            }
            row.nudge_here(joints, [&position, &rate], &mut change);
            for i in 0..N {
                impulse[i] += change[i] * h;
                if is_damped {
                    impulse[i] += r[i] * damping[i];
                }
            }
        }
        kkt.factored.valid = Factors::Tree;
        kkt.estimates.write(&mut report);
        (step.report, step.is_evaluated) = (report, is_evaluated);
        // What a linearization at the last evaluation needs of it.
        if is_evaluated {
            mid.mechanics.planar.as_deref_mut()?.take(&row);
        }
        for (to, numbers) in [
            (&mut step.increment, x),
            (&mut step.impulse, impulse),
            (&mut mid.q, middles),
            (&mut mid.velocity, velocity),
            (&mut mid.angles, angles),
            (&mut mid.l_q, l_q),
            (&mut mid.l_v, l_v),
            (&mut mid.input_force, input_force),
            (&mut mid.force, force),
        ] {
            *to.first_chunk_mut::<N>()? = numbers;
        }
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use plantd_scene::builtin;

    use super::*;
    use crate::linearization::linearize::Linearization;
    use crate::plant::facade::Plant;
    use crate::plant::initial::Initial;

    /// Steps, snapshots and derivatives are those of the loop for all scenes, in quiet motions, under inputs that change
    /// at each step, and where steps are too long for the motion.
    #[test]
    fn steps_have_the_bits_of_the_other_loop() {
        let names = ["pendulum", "damped-pendulum", "double-pendulum", "cart-pole"];
        let scenes = names.map(|name| builtin::scene(name).unwrap());
        for scene in scenes {
            let model = Arc::new(Model::compile(&scene).unwrap());
            let n = model.dimensions.dynamic;
            for (h, speed, push) in [(0.001, 1.0, 0.0), (0.01, 3.0, 2.0), (0.1, 9.0, 9.0)] {
                let settings = Settings { time_step_s: h, ..Settings::new(&model) };
                let mut plant = Plant::new(Arc::clone(&model), settings).unwrap();
                assert_eq!(plant.workspace.few_joints, n, "{}", scene.name);
                let v = (0..n).map(|i| speed * (1.7 * i as f64 + 1.0).sin()).collect();
                plant.initialize(&Initial::Velocity { q: vec![0.7; n], v }).unwrap();
                let mut other = plant.clone();
                other.workspace.few_joints = 0;
                let mut outs = [Linearization::new(&model), Linearization::new(&model)];
                let mut few = 0;
                for k in 0..200_u32 {
                    let u = vec![push * f64::from(k * k).sin(); model.dimensions.inputs];
                    let Plant { model, settings, state, workspace, .. } = &mut plant;
                    let at = StepContext { model, settings, state, u: &u };
                    few += u32::from(workspace.solve_few(at).is_some());
                    let reports = if k % 3 == 0 {
                        [
                            plant.step_and_linearize(&u, &mut outs[0]),
                            other.step_and_linearize(&u, &mut outs[1]),
                        ]
                    } else {
                        [plant.step(&u), other.step(&u)]
                    };
                    assert_eq!(reports[0], reports[1], "{} {h} {k}", scene.name);
                    assert_eq!(plant.snapshot(), other.snapshot(), "{} {h} {k}", scene.name);
                    assert_eq!(outs[0].a(), outs[1].a(), "{} {h} {k}", scene.name);
                    assert_eq!(outs[0].b(), outs[1].b(), "{} {h} {k}", scene.name);
                }
                assert!(few > 100, "{} {h}: {few} of 200 steps", scene.name);
            }
        }
    }
}
