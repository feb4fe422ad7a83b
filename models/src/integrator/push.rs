//! What a change of the inputs does to a step, guessed before the step is looked at.
//!
//! Forces of inputs enter the residual of a step `k` as `h w`, `w = a f[k] + (1 − a) f[k−1]`, beside the momentum
//! that a motion without their last change would have had. What past increments cannot foretell of the next one
//! is hence `−K⁻¹ h (w − w_before)`, by the Newton matrix of the last step, whose factors are still there.
//!
//! A guess must follow from the state alone. So the state has the point where the equations of its last step were
//! factored first; whoever does not have those factors, after a snapshot was restored, makes them again.

use plantd_math::rotation::Turn;
use plantd_math::scalar::Scalar;
use plantd_math::spatial::{Mat3, Vec3, three};

use crate::constraints::closure::Known;
use crate::integrator::point::Parts;
use crate::integrator::response::Place;
use crate::integrator::workspace::{StepContext, Workspace};
use crate::kkt::system::Factors;
use crate::model::mechanism::Model;

/// `a f[k] + (1 − a) f[k−1]`.
#[inline(always)]
pub(crate) fn weigh<S: Scalar>(at_start: f64, force: S, before: S) -> S {
    force * at_start + before * (1.0 - at_start)
}

impl Workspace {
    /// Adds to the guess what the change of inputs does.
    #[inline(never)]
    pub(crate) fn push(&mut self, at: StepContext<'_>) {
        let StepContext { model, settings, state, .. } = at;
        let (h, a) = (settings.time_step_s, settings.force_split.at_start());
        let (nd, n) = (model.dimensions.dynamic, model.dimensions.coordinates());
        self.response.place = Place::Nowhere;
        let last = &state.past.point;
        self.response.pushed.fill(0.0);
        if !last.is_of_length(h) {
            return;
        }
        let Parts { force: before, weighed, .. } = last.parts(nd, n);
        let mut is_pushed = false;
        let rows = self.response.pushed.iter_mut().zip(&self.mid.input_force);
        for ((pushed, force), (before, weighed)) in rows.zip(before.iter().zip(weighed)) {
            *pushed = h * (weigh(a, *force, *before) - weighed);
            is_pushed |= *pushed != 0.0;
        }
        if !is_pushed {
            return;
        }
        if !self.response.kept_at.is_factored_as(last, nd) && !self.factor_again(at) {
            self.response.pushed.fill(0.0);
            return;
        }
        let Self { kkt, constraints, response, residual, step, .. } = self;
        if last.has_ends && response.kept.valid != Factors::Recursion {
            // All equations were taken together.
            response.pushed.fill(0.0);
            return;
        }
        std::mem::swap(&mut kkt.factored, &mut response.kept);
        residual.constraints.fill(0.0);
        kkt.solve(model, &constraints.end, &mut response.pushed, &mut residual.constraints);
        std::mem::swap(&mut kkt.factored, &mut response.kept);
        if !response.pushed.iter().all(|x| x.is_finite()) {
            response.pushed.fill(0.0);
        }
        response.pushed.iter_mut().for_each(|x| *x = -*x);
        if state.past.extrapolates() {
            step.increment.iter_mut().zip(&response.pushed).for_each(|(x, pushed)| *x += pushed);
        }
    }

    /// Makes the factors of the last step again; whether that went well.
    #[cold]
    fn factor_again(&mut self, at: StepContext<'_>) -> bool {
        let StepContext { model, settings, state, .. } = at;
        let (nd, n) = (model.dimensions.dynamic, model.dimensions.coordinates());
        let Parts { force, increment, angles, prescribed, orientations, ends, .. } =
            state.past.point.parts(nd, n);
        let (mid, inverse) = (&mut self.mid, 1.0 / settings.time_step_s);
        mid.q.copy_from_slice(angles);
        mid.angles.copy_from_slice(angles);
        mid.velocity[..nd].iter_mut().zip(increment).for_each(|(v, x)| *v = x * inverse);
        mid.velocity[nd..].copy_from_slice(prescribed);
        for (matrix, numbers) in mid.orientations.iter_mut().zip(orientations.as_chunks::<9>().0) {
            *matrix = Mat3([0, 3, 6].map(|i| three(numbers, i)));
        }
        mid.input_force.copy_from_slice(force);
        mid.force.copy_from_slice(force);
        for (o, &i) in model.orientations.iter().enumerate() {
            if i < nd {
                self.balls.set_turn(o, Turn::new(three(increment, i)));
            }
        }
        mid.evaluate(model);
        if state.past.point.has_ends {
            self.go_to_ends(model, ends);
            self.nudge.position.copy_from_slice(&self.step.increment);
            self.step.increment.copy_from_slice(increment);
        }
        let is_factored = self.factor(model, settings, state).is_ok();
        if state.past.point.has_ends {
            self.step.increment.copy_from_slice(&self.nudge.position);
            self.constraints.start.known = Known::Nothing;
        }
        if is_factored {
            std::mem::swap(&mut self.kkt.factored, &mut self.response.kept);
            self.response.kept_at.copy_from(&state.past.point);
        }
        // Inputs and prescribed motion are those of this step again.
        self.prepare(at);
        is_factored
    }

    /// Goes back to the constraints at the ends of the last step.
    fn go_to_ends(&mut self, model: &Model, [start, end]: [[&[f64]; 2]; 2]) {
        let Self { constraints, balls, step, .. } = self;
        for (closure, matrices, [q, turned]) in [
            (&mut constraints.start, &mut balls.start, start),
            (&mut constraints.end, &mut balls.end, end),
        ] {
            for (matrix, numbers) in matrices.iter_mut().zip(turned.as_chunks::<9>().0) {
                *matrix = Mat3([0, 3, 6].map(|i| three(numbers, i)));
            }
            closure.complete(model, q, matrices);
        }
        step.q_end.copy_from_slice(end[0]);
    }

    /// Takes note of the point where the step has just been factored for the first time.
    #[inline(never)]
    pub(crate) fn note_point(&mut self, at: StepContext<'_>) {
        let StepContext { model, settings, state, .. } = at;
        let (h, a) = (settings.time_step_s, settings.force_split.at_start());
        let Self { response, mid, step, balls, .. } = self;
        response.place = Place::System;
        let (nd, n) = (model.dimensions.dynamic, model.dimensions.coordinates());
        let end = response.point.numbers.len() - nd;
        let (points, weighed) = response.point.numbers.split_at_mut(end);
        let last = &state.past.point;
        let before = if last.is_known() { last.parts(nd, n).force } else { &mid.input_force };
        for (w, (force, before)) in weighed.iter_mut().zip(mid.input_force.iter().zip(before)) {
            *w = weigh(a, *force, *before);
        }
        let mut done = 0;
        let mut put = |numbers: &[f64]| {
            points[done..done + numbers.len()].copy_from_slice(numbers);
            done += numbers.len();
        };
        put(&[h]);
        put(&mid.input_force);
        put(&step.increment);
        put(&mid.angles);
        put(&mid.velocity[nd..]);
        let put_all = |orientations: &[Mat3], put: &mut dyn FnMut(&[f64])| {
            for Mat3([x, y, z]) in orientations {
                [x, y, z].into_iter().for_each(|Vec3(column)| put(column));
            }
        };
        put_all(&mid.orientations, &mut put);
        if last.has_ends {
            for (q, turned) in [(&state.q, &balls.start), (&step.q_end, &balls.end)] {
                put(q);
                put_all(turned, &mut put);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use crate::integrator::settings::Settings;
    use crate::linearization::linearize::Linearization;
    use crate::model::mechanism::Model;
    use crate::plant::facade::Plant;
    use crate::plant::initial::Initial;
    use crate::plant::snapshot::Snapshot;
    use plantd_scene::builtin;

    /// Moves from a posture in which all joints move, with torques that change at each step.
    fn pushed(name: &str, torque: f64) -> (Plant, impl FnMut(u32) -> Vec<f64>) {
        let model = Arc::new(Model::compile(&builtin::scene(name).unwrap()).unwrap());
        let settings = Settings { time_step_s: 0.002, ..Settings::new(&model) };
        let mut plant = Plant::new(Arc::clone(&model), settings).unwrap();
        let n = model.dimensions.coordinates();
        let (q, v) = (plant.q().to_vec(), (0..n).map(|i| 0.5 * (1.7 * i as f64).sin()).collect());
        plant.initialize(&Initial::Velocity { q, v }).unwrap();
        let inputs = model.dimensions.input();
        let input = move |k: u32| -> Vec<f64> {
            (0..inputs).map(|i| torque * f64::from(k * k + 7 * i as u32).sin()).collect()
        };
        (plant, input)
    }

    #[test]
    fn guesses_follow_from_the_state_alone() {
        for name in ["tree-15", "tree-127", "walker-4"] {
            let (mut plant, mut input) = pushed(name, 0.3);
            let mut out = Linearization::new(plant.model());
            for k in 0..40 {
                let u = input(k);
                let bytes = plant.snapshot().to_bytes();
                // Factors of nothing, of another step, and of this one at its solution.
                let mut restored =
                    Plant::new(Arc::clone(plant.model()), *plant.settings()).unwrap();
                restored.restore(&Snapshot::from_bytes(&bytes).unwrap()).unwrap();
                let mut linearized = plant.clone();
                linearized.linearize(&input(k + 3), &mut out).unwrap();
                plant.step(&u).unwrap();
                restored.step(&u).unwrap();
                linearized.step_and_linearize(&u, &mut out).unwrap();
                assert_eq!(plant.snapshot(), restored.snapshot(), "{name} {k}");
                assert_eq!(plant.snapshot(), linearized.snapshot(), "{name} {k}");
                if k % 3 == 0 {
                    plant = restored;
                } else if k % 3 == 1 {
                    plant = linearized;
                }
            }
        }
    }

    #[test]
    fn a_plant_that_begins_anew_knows_of_no_push() {
        let (mut plant, mut input) = pushed("tree-15", 0.3);
        let (begin, mut other) = (plant.snapshot(), plant.clone());
        for k in 0..5 {
            plant.step(&input(k)).unwrap();
        }
        plant.restore(&begin).unwrap();
        let u = input(9);
        plant.step(&u).unwrap();
        other.step(&u).unwrap();
        assert_eq!(plant.snapshot(), other.snapshot());
    }

    #[test]
    fn torques_that_change_are_guessed() {
        for name in ["tree-15", "walker-9"] {
            let (mut plant, mut input) = pushed(name, 0.3);
            let (mut evaluations, steps) = (0, 40);
            for k in 0..steps + 10 {
                let report = plant.step(&input(k)).unwrap();
                evaluations += if k < 10 { 0 } else { report.iterations };
            }
            assert!(evaluations <= 3 * steps, "{name}: {evaluations}");
        }
    }
}
