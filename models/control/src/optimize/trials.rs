//! Trial motions: the projection of the current one, moved along a direction.

use nalgebra::DMatrix;
use plantd_models::{Initial, Plant, Snapshot};

use crate::optimize::direction::Direction;
use crate::optimize::error::OptimizeError;
use crate::optimize::problem::{Deviation, Point, Problem};
use crate::optimize::products::subtract_product;
use crate::optimize::question::{Question, ask_at};
use crate::optimize::trajectory::Trajectory;

/// A motion, and the plant at its initial state.
#[derive(Clone, Debug)]
pub(super) struct Motion {
    pub(super) trajectory: Trajectory,
    pub(super) start: Snapshot,
}

/// Where trials are rolled out.
#[derive(Debug)]
pub(super) struct Trials {
    pub(super) plant: Plant,
    /// The last trial.
    pub(super) last: Motion,
    /// The best one where a longer one is tried.
    kept: Motion,
    deviation: Deviation,
    nominal: Vec<f64>,
    error: Vec<f64>,
    input: Vec<f64>,
}

impl Trials {
    pub(super) fn new(plant: Plant, problem: &Problem, motion: &Motion) -> Self {
        Self {
            plant,
            last: motion.clone(),
            kept: motion.clone(),
            deviation: problem.deviation(),
            nominal: vec![0.0; problem.states],
            error: vec![0.0; problem.states],
            input: vec![0.0; problem.inputs],
        }
    }

    /// Keeps the last trial, or takes the kept one back.
    pub(super) fn swap_kept(&mut self) {
        std::mem::swap(&mut self.last, &mut self.kept);
    }

    /// Simulates the inputs of the guess from where the plant is.
    pub(super) fn simulate_guess(
        &mut self,
        problem: &Problem,
        guess: &mut Trajectory,
    ) -> Result<(), OptimizeError> {
        let Self { plant, deviation, .. } = self;
        guess.set_x(0, [plant.q(), plant.p(), plant.v()]);
        let mut cost = problem.initial_cost(guess.x(0));
        for k in 0..problem.steps {
            cost += problem.evaluate(k, guess.x(k), guess.u(k), deviation);
            plant.step(guess.u(k)).map_err(|error| OptimizeError::Guess { step: k, error })?;
            guess.set_x(k + 1, [plant.q(), plant.p(), plant.v()]);
            guess.set_multipliers(k, plant.multipliers());
        }
        cost += problem.evaluate(problem.steps, guess.x(problem.steps), &[], deviation);
        guess.cost = cost;
        if cost.is_finite() { Ok(()) } else { Err(OptimizeError::Cost { cost }) }
    }

    /// Projects the current motion moved by `length` along the direction. False if it does not run, or
    /// costs more than `enough`.
    pub(super) fn roll_out(
        &mut self,
        point: Point<'_>,
        (direction, length): (&Direction, f64),
        gains: &[DMatrix<f64>],
        enough: f64,
        go_on: Question<'_>,
    ) -> Result<bool, OptimizeError> {
        let Point { problem, bounds, motion: current } = point;
        let Self { plant, last, deviation, nominal, error, input, .. } = self;
        let trial = &mut last.trajectory;
        let (states, inputs, steps) = (problem.states, problem.inputs, problem.steps);
        trial.set_x(0, [plant.q(), plant.p(), plant.v()]);
        let (mut cost, mut penalties) = (problem.initial_cost(trial.x(0)), 0.0);
        let may_stop_early = problem.is_nonnegative && bounds.is_empty();
        for (k, gain) in gains.iter().enumerate() {
            ask_at(k, go_on)?;
            // u = ū + s du − K (x ⊖ (x̄ + s dx)).
            let dx = &direction.dx[k * states..][..states];
            problem.model.write_state_retraction(current.x(k), dx, length, nominal);
            problem.difference(nominal, trial.x(k), error);
            let change = &direction.du[k * inputs..][..inputs];
            for (u, (nominal, change)) in input.iter_mut().zip(current.u(k).iter().zip(change)) {
                *u = nominal + length * change;
            }
            subtract_product(gain, error, input);
            cost += problem.evaluate(k, trial.x(k), input, deviation);
            penalties += bounds.value(k, (trial.x(k), input));
            // What is still to come costs nothing at least.
            if may_stop_early && !(cost < enough) {
                return Ok(false);
            }
            trial.u[k * inputs..][..inputs].copy_from_slice(input);
            if plant.step(input).is_err() {
                return Ok(false);
            }
            trial.set_x(k + 1, [plant.q(), plant.p(), plant.v()]);
            trial.set_multipliers(k, plant.multipliers());
        }
        cost += problem.evaluate(steps, trial.x(steps), &[], deviation);
        penalties += bounds.value(steps, (trial.x(steps), &[]));
        (trial.cost, trial.merit) = (cost, cost + penalties);
        Ok(trial.merit.is_finite())
    }

    /// Puts the plant at the initial state of the trial; false if there is none.
    pub(super) fn start(
        &mut self,
        problem: &Problem,
        current: &Motion,
        (direction, length): (&Direction, f64),
    ) -> bool {
        let Some(entries) = &problem.initial.free else {
            return self.plant.restore(&current.start).is_ok();
        };
        let d = problem.model.dimensions();
        let (x, dx) = (current.trajectory.x(0), &direction.dx[..problem.states]);
        problem.model.write_state_retraction(x, dx, length, &mut self.nominal);
        let (q, rest) = self.nominal.split_at(d.coordinates());
        let (p, v) = rest.split_at(d.dynamic);
        let [mut q, p, v] = [q, p, v].map(<[f64]>::to_vec);
        if d.constraints > 0 && dx[..d.coordinates()].iter().any(|x| *x != 0.0) {
            match self.plant.project(q, &entries[..d.coordinates()]) {
                Ok(projected) => q = projected,
                Err(_) => return false,
            }
        }
        if self.plant.initialize(&Initial::Momentum { q, p, v }).is_err() {
            return false;
        }
        self.plant.set_step_index(current.trajectory.first_step);
        self.last.start = self.plant.snapshot();
        true
    }
}
