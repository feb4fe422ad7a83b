//! The search, one iteration at a time.

mod direction;
mod ending;

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};

use self::direction::{Foresight, block_length, linearize_behind};
use super::problem::{Deviation, Problem, check};
use super::trajectory::{Trajectory, rows};
use super::{
    Bounds, Checkpoint, Fallback, FreeInitialState, Method, OptimizeError, Options, Progress,
    Status, Stuck, TrajectoryCost,
};
use crate::control::Weights;
use crate::control::lq::Map;
use crate::control::lq::recursion::LqRecursion;
use crate::control::lq::stage::Stage;
use crate::{Contraction, Initial, Linearization, Plant, Snapshot, State};

/// Penalty with which a search begins.
const FIRST_PENALTY: f64 = 10.0;
/// A step of fewer states is differentiated sooner than a thread starts.
const STATES_FOR_THREADS: usize = 12;
/// Steps between two questions whether to go on.
const STEPS_BETWEEN_QUESTIONS: usize = 16;

/// A search for the trajectory of least cost; see the [module](super).
#[derive(Debug)]
pub struct Optimizer {
    problem: Arc<Problem>,
    options: Options,
    /// Weights of the projection; none where it is the law of the descent.
    projection: Option<Weights>,
    /// Moves through trial motions.
    plant: Plant,
    /// The plant at the initial state of the trajectory, and of the trial.
    start: Snapshot,
    trial_start: Snapshot,
    first_step: u64,
    /// Initial state of the guess.
    reference: State,
    current: Trajectory,
    trial: Trajectory,
    /// The best trial where a longer one is tried.
    kept: (Trajectory, Snapshot),
    multipliers: Vec<f64>,
    penalty: f64,
    bound_error: f64,
    /// Directional derivative of the last step since the multipliers were renewed; 0 before the first.
    last_derivative: f64,
    iterations: u32,
    first_cost: f64,
    backtracks: u32,
    status: Status,
    /// Block by block, whether the maps belong to the current trajectory, or else to the last trial.
    linearized: Vec<bool>,
    foreseen: Vec<bool>,
    maps: Vec<Map>,
    /// `K[k]` of a projection of its own, and whether they belong to the current trajectory.
    gains: Vec<DMatrix<f64>>,
    has_gains: bool,
    /// The projection's law is that of the last descent.
    projects_by_descent: bool,
    /// Gradient of the cost with penalties.
    by_x: Vec<DVector<f64>>,
    by_u: Vec<DVector<f64>>,
    /// The law of the descent, and the direction.
    descent_gains: Vec<DMatrix<f64>>,
    descent_offsets: Vec<DVector<f64>>,
    dx: Vec<f64>,
    du: Vec<f64>,
    /// One per thread; at least one.
    workers: Vec<Worker>,
    scratch: Scratch,
}

/// What a thread needs of its own to differentiate steps.
#[derive(Debug)]
struct Worker {
    plant: Plant,
    linearization: Linearization,
    contraction: Contraction,
}

/// Second derivatives of one step.
#[derive(Clone, Debug)]
struct Second {
    xx: DMatrix<f64>,
    xu: DMatrix<f64>,
    uu: DMatrix<f64>,
}

impl Second {
    fn new(states: usize, inputs: usize) -> Self {
        Self {
            xx: DMatrix::zeros(states, states),
            xu: DMatrix::zeros(states, inputs),
            uu: DMatrix::zeros(inputs, inputs),
        }
    }

    /// Copies, not swaps: what is always zero in a contraction is never written again.
    fn take(&mut self, contraction: &Contraction) {
        self.xx.copy_from(&contraction.xx);
        self.xu.copy_from(&contraction.xu);
        self.uu.copy_from(&contraction.uu);
    }

    fn stage(&self) -> Stage<'_> {
        Stage { q: &self.xx, r: &self.uu, s: Some(&self.xu), x_linear: None, u_linear: None }
    }
}

/// Memory that iterations use again.
#[derive(Debug)]
struct Scratch {
    /// One per step where Newton's method contracts them, else none.
    linearizations: Vec<Linearization>,
    /// Contractions of the block at hand, and of the one that is made meanwhile; empty without Newton's
    /// method.
    contractions: [Vec<Second>; 2],
    /// Where the recursion contracts a step itself.
    contraction: Contraction,
    second: Second,
    recursion: LqRecursion,
    deviation: Deviation,
    weights: Second,
    identity: Second,
    offset: DVector<f64>,
    adjoint: Vec<DVector<f64>>,
    packed: Vec<f64>,
    nominal: Vec<f64>,
    error: Vec<f64>,
    input: Vec<f64>,
    zero_multipliers: Vec<f64>,
}

/// A quadratic model that has a minimum, or why not.
enum Direction {
    Found { derivative: f64 },
    NotConvex { step: usize },
}

type Go<'a> = &'a mut dyn FnMut() -> bool;

/// Asks now and then whether to go on.
fn ask(k: usize, go_on: Go<'_>) -> Result<(), OptimizeError> {
    if k.is_multiple_of(STEPS_BETWEEN_QUESTIONS) && !go_on() {
        Err(OptimizeError::Cancelled)
    } else {
        Ok(())
    }
}

impl Optimizer {
    /// A search that begins with the motion from the state of `plant` under `inputs` (row k is `u[k]`,
    /// n rows of `ni + nk`).
    ///
    /// # Errors
    ///
    /// All of [`OptimizeError`] but those of an iteration. Simulates the guess.
    pub fn new(
        plant: Plant,
        inputs: DMatrix<f64>,
        cost: TrajectoryCost,
        bounds: &Bounds,
        free: Option<FreeInitialState>,
        options: Options,
    ) -> Result<Self, OptimizeError> {
        let initial = plant.state();
        let start = (&initial, &initial);
        let mut search = Self::at(plant, start, &inputs, cost, bounds, free, options)?;
        search.first_cost = search.current.cost;
        search.bound_error = search.error_of_bounds();
        search.current.merit = search.merit(&search.current);
        Ok(search)
    }

    /// Goes on, bit for bit, where a search of the same problem left off. The state of `plant` does not
    /// matter.
    ///
    /// # Errors
    ///
    /// Those of [`Optimizer::new`], and [`OptimizeError::Checkpoint`].
    pub fn resume(
        plant: Plant,
        cost: TrajectoryCost,
        bounds: &Bounds,
        free: Option<FreeInitialState>,
        options: Options,
        checkpoint: &Checkpoint,
    ) -> Result<Self, OptimizeError> {
        let fits = |fits: bool, what| {
            if fits { Ok(()) } else { Err(OptimizeError::Checkpoint { what }) }
        };
        let Checkpoint { initial, inputs, initial_reference: reference, .. } = checkpoint;
        let same = |a: &[f64], b: &[f64]| a.len() == b.len() && a.iter().all(|x| x.is_finite());
        let sizes = same(&reference.q, &initial.q)
            && same(&reference.p, &initial.p)
            && same(&reference.v, &initial.v);
        fits(sizes, "its initial reference")?;
        let start = (initial, reference);
        let mut search = Self::at(plant, start, inputs, cost, bounds, free, options)?;
        let last = checkpoint.last_derivative;
        let numbers = [checkpoint.first_cost, checkpoint.bound_violation, last];
        fits(numbers.iter().all(|x| x.is_finite()), "a number is not finite")?;
        let penalty = checkpoint.penalty;
        fits(penalty.is_finite() && penalty > 0.0, "its penalty is not greater than zero")?;
        let multipliers = &checkpoint.bound_multipliers;
        fits(multipliers.len() == search.problem.ends.count, "the number of its multipliers")?;
        fits(multipliers.iter().all(|x| x.is_finite()), "a multiplier is not finite")?;
        search.iterations = checkpoint.iterations;
        search.first_cost = checkpoint.first_cost;
        search.backtracks = checkpoint.backtracks;
        search.bound_error = checkpoint.bound_violation;
        search.last_derivative = last;
        search.penalty = penalty;
        search.multipliers.copy_from_slice(multipliers);
        search.current.merit = search.merit(&search.current);
        search.end_by_count(0.0);
        Ok(search)
    }

    /// A search at a trajectory, without a past; with the state that the initial one is weighed against.
    fn at(
        mut plant: Plant,
        (initial, reference): (&State, &State),
        inputs: &DMatrix<f64>,
        cost: TrajectoryCost,
        bounds: &Bounds,
        free: Option<FreeInitialState>,
        options: Options,
    ) -> Result<Self, OptimizeError> {
        let model = Arc::clone(plant.model());
        let d = model.dimensions();
        let (states, width, steps) = (d.state(), d.input(), inputs.nrows());
        if steps == 0 {
            return Err(OptimizeError::NoSteps);
        }
        check("the guess", inputs, steps, width)?;
        check_options(&options)?;
        let weights = options.projection.clone();
        let projection = weights.map(|weights| weights.for_system(states, width)).transpose()?;
        let problem = Arc::new(Problem::new(&plant, steps, cost, bounds, free)?);
        let State { q, p, v, .. } = initial.clone();
        plant.keep_periods_whole();
        plant.initialize(&Initial::Momentum { q, p, v })?;
        plant.set_step_index(initial.step);
        let start = plant.snapshot();
        let mut current = Trajectory::new(d, steps);
        current.u = rows(inputs);
        let vectors = |n: usize, count: usize| vec![DVector::zeros(n); count];
        let gains = |count: usize| vec![DMatrix::zeros(width, states); count];
        let methods = [Some(options.method), options.first_method];
        let (kept, block) = match methods.contains(&Some(Method::Newton)) {
            true => (steps, block_length(states).min(steps)),
            false => (0, 0),
        };
        let block = if projection.is_some() { block } else { 0 };
        let mut identity = Second::new(states, width);
        identity.xx.fill_with_identity();
        identity.uu.fill_with_identity();
        let mut search = Self {
            scratch: Scratch {
                linearizations: vec![Linearization::new(&model); kept],
                contractions: [0; 2].map(|_| vec![Second::new(states, width); block]),
                contraction: Contraction::new(&model),
                second: Second::new(states, width),
                recursion: LqRecursion::new(states, width),
                deviation: problem.deviation(),
                weights: Second::new(states, width),
                identity,
                offset: DVector::zeros(width),
                adjoint: vectors(states, steps + 1),
                packed: Vec::new(),
                nominal: vec![0.0; states],
                error: vec![0.0; states],
                input: vec![0.0; width],
                zero_multipliers: vec![0.0; d.constraints],
            },
            multipliers: vec![0.0; problem.ends.count],
            penalty: FIRST_PENALTY,
            bound_error: 0.0,
            last_derivative: 0.0,
            iterations: 0,
            first_cost: 0.0,
            status: Status::Running,
            backtracks: 0,
            linearized: vec![false; steps.div_ceil(block_length(states))],
            foreseen: vec![false; steps.div_ceil(block_length(states))],
            maps: (0..steps).map(|_| Map::default()).collect(),
            gains: gains(if projection.is_some() { steps } else { 0 }),
            has_gains: false,
            projects_by_descent: false,
            descent_gains: gains(steps),
            descent_offsets: vectors(width, steps),
            by_x: vectors(states, steps + 1),
            by_u: vectors(width, steps),
            dx: vec![0.0; (steps + 1) * states],
            du: vec![0.0; steps * width],
            first_step: initial.step,
            reference: reference.clone(),
            trial: current.clone(),
            kept: (current.clone(), start.clone()),
            current,
            trial_start: start.clone(),
            start,
            workers: vec![Worker::new(&plant)],
            plant,
            projection,
            options,
            problem,
        };
        search.simulate_guess()?;
        Ok(search)
    }

    fn simulate_guess(&mut self) -> Result<(), OptimizeError> {
        self.current.set_x(0, [self.plant.q(), self.plant.p(), self.plant.v()]);
        let mut cost = self.initial_cost(&self.current);
        let Self { problem, plant, current, scratch, .. } = self;
        for k in 0..problem.steps {
            cost += problem.evaluate(k, current.x(k), current.u(k), &mut scratch.deviation);
            plant.step(current.u(k)).map_err(|error| OptimizeError::Guess { step: k, error })?;
            current.set_x(k + 1, [plant.q(), plant.p(), plant.v()]);
            current.set_multipliers(k, plant.multipliers());
        }
        cost +=
            problem.evaluate(problem.steps, current.x(problem.steps), &[], &mut scratch.deviation);
        current.cost = cost;
        if cost.is_finite() { Ok(()) } else { Err(OptimizeError::Cost { cost }) }
    }

    /// Lets `threads` threads share the linearizations and contractions of an iteration, where the model
    /// is large enough to gain from it; 1 at first. Results are the same to the bit for any number.
    pub fn set_threads(&mut self, threads: usize) {
        let useful = if self.problem.states < STATES_FOR_THREADS { 1 } else { threads.max(1) };
        self.workers.truncate(useful);
        while self.workers.len() < useful {
            self.workers.push(Worker::new(&self.plant));
        }
    }

    /// Whether the search goes on.
    pub fn status(&self) -> Status {
        self.status
    }

    /// Cost of the trajectory, without penalties.
    pub fn cost(&self) -> f64 {
        self.current.cost
    }

    /// Largest violation of a bound.
    pub fn bound_violation(&self) -> f64 {
        self.worst(|end, number, _| end.violation(number))
    }

    /// Row k is `x[k]`: n + 1 rows.
    pub fn states(&self) -> DMatrix<f64> {
        DMatrix::from_row_slice(self.problem.steps + 1, self.problem.states, &self.current.x)
    }

    /// Row k is `u[k]`: n rows.
    pub fn inputs(&self) -> DMatrix<f64> {
        DMatrix::from_row_slice(self.problem.steps, self.problem.inputs, &self.current.u)
    }

    /// Iterations so far, with those of the search that was resumed.
    pub fn iterations(&self) -> u32 {
        self.iterations
    }

    /// Where the search stands.
    pub fn checkpoint(&self) -> Checkpoint {
        Checkpoint {
            initial: self.initial_state(),
            inputs: self.inputs(),
            iterations: self.iterations,
            first_cost: self.first_cost,
            bound_multipliers: self.multipliers.clone(),
            penalty: self.penalty,
            bound_violation: self.bound_error,
            initial_reference: self.reference.clone(),
            backtracks: self.backtracks,
            last_derivative: self.last_derivative,
        }
    }

    /// Initial state of the trajectory.
    pub fn initial_state(&self) -> State {
        let d = self.problem.model.dimensions();
        let (q, rest) = self.current.x(0).split_at(d.coordinates());
        let (p, v) = rest.split_at(d.dynamic);
        State {
            step: self.first_step,
            q: q.to_vec(),
            p: p.to_vec(),
            v: v.to_vec(),
            multipliers: vec![0.0; d.constraints],
        }
    }

    /// One iteration. `go_on` is asked every few steps of work; where it says no, the iteration ends
    /// with [`OptimizeError::Cancelled`] and the search is as it was before it.
    ///
    /// # Errors
    ///
    /// [`OptimizeError::Linearization`], [`OptimizeError::Projection`], [`OptimizeError::Cancelled`],
    /// and [`OptimizeError::Finished`] when the search has ended.
    pub fn iterate(&mut self, go_on: &mut dyn FnMut() -> bool) -> Result<Progress, OptimizeError> {
        if self.status != Status::Running {
            return Err(OptimizeError::Finished);
        }
        self.find_gradient(go_on)?;
        let asked = match self.options.first_method {
            Some(first) if self.iterations < self.options.first_iterations => first,
            _ => self.options.method,
        };
        let mut progress = Progress {
            iteration: self.iterations,
            cost_before: self.current.merit,
            cost: self.current.merit,
            directional_derivative: f64::NAN,
            method: asked,
            fallback: None,
            step_length: 0.0,
            backtracks: 0,
            bound_violation: 0.0,
        };
        self.step_or_end(asked, &mut progress, go_on)?;
        self.iterations += 1;
        self.end_by_count(progress.directional_derivative);
        progress.cost = self.current.merit;
        progress.bound_violation = self.bound_violation();
        Ok(progress)
    }

    /// A step along the direction of the method asked for, or of the first that has one after it; or what
    /// is to be done where nothing descends.
    fn step_or_end(
        &mut self,
        mut asked: Method,
        progress: &mut Progress,
        go_on: Go<'_>,
    ) -> Result<(), OptimizeError> {
        loop {
            let (method, fallback, derivative) = self.find_direction(asked, go_on)?;
            progress.method = method;
            progress.fallback = progress.fallback.or(fallback);
            progress.directional_derivative = derivative.unwrap_or(f64::NAN);
            let derivative = match derivative {
                Ok(derivative) => derivative,
                Err(step) => {
                    self.status = Status::Stuck(match method {
                        Method::QuasiNewton => Stuck::WeightsNotConvex { step },
                        _ => Stuck::NotConvex { step },
                    });
                    return Ok(());
                }
            };
            if self.has_ended(derivative) {
                return Ok(());
            }
            if self.search_along(derivative, progress, go_on)? {
                self.last_derivative = derivative.min(-f64::MIN_POSITIVE);
                return Ok(());
            }
            let is_spent = self.ends_at(derivative) || self.renews_at(derivative);
            asked = match method {
                Method::Newton if !is_spent => Method::QuasiNewton,
                Method::QuasiNewton if !is_spent => Method::Steepest,
                _ => {
                    self.end_without_step(derivative);
                    return Ok(());
                }
            };
            progress.fallback = progress.fallback.or(Some(Fallback::NoStep { derivative }));
        }
    }

    /// Cost with the penalties of bounds.
    fn merit(&self, trajectory: &Trajectory) -> f64 {
        let steps = self.problem.steps;
        let penalty = |k: usize| {
            let u = if k < steps { trajectory.u(k) } else { &[] };
            self.problem.penalty(k, (trajectory.x(k), u), (&self.multipliers, self.penalty))
        };
        trajectory.cost + (0..=steps).map(penalty).sum::<f64>()
    }

    /// What the initial state costs.
    fn initial_cost(&self, trajectory: &Trajectory) -> f64 {
        let weight = self.problem.free.as_ref().and_then(|free| free.weight.as_ref());
        let Some(weight) = weight else { return 0.0 };
        let mut change = DVector::zeros(self.problem.states);
        let reference = self.reference.x();
        self.problem.difference(&reference, trajectory.x(0), change.as_mut_slice());
        0.5 * change.dot(&(weight * &change))
    }

    /// Armijo's rule. True if a step was taken.
    fn search_along(
        &mut self,
        derivative: f64,
        progress: &mut Progress,
        go_on: Go<'_>,
    ) -> Result<bool, OptimizeError> {
        self.projects_by_descent = self.is_projection(progress.method);
        if !self.projects_by_descent {
            self.find_gains(go_on)?;
        }
        let most = self.options.max_backtracks;
        let last = if self.options.near_last_step { self.backtracks } else { 0 };
        let first = last.saturating_sub(1).min(most);
        let mut backtracks = None;
        for tried in (first..=most).chain((0..first).rev()) {
            if self.try_armijo(tried, derivative, go_on)? {
                backtracks = Some(tried);
                break;
            }
        }
        let Some(mut backtracks) = backtracks else {
            progress.backtracks = most;
            return Ok(false);
        };
        // As long as longer steps descend, too.
        if backtracks == first {
            while backtracks > 0 {
                self.swap_kept();
                if !self.try_armijo(backtracks - 1, derivative, go_on)? {
                    self.foreseen.fill(false);
                    self.swap_kept();
                    break;
                }
                backtracks -= 1;
            }
        }
        std::mem::swap(&mut self.current, &mut self.trial);
        if self.problem.free.is_some() {
            std::mem::swap(&mut self.start, &mut self.trial_start);
        }
        std::mem::swap(&mut self.linearized, &mut self.foreseen);
        self.has_gains = false;
        self.backtracks = backtracks;
        (progress.step_length, progress.backtracks) = (self.length(backtracks), backtracks);
        Ok(true)
    }

    /// Whether the law of a descent is that of the projection: it is so by choice, or the weights are the
    /// same.
    fn is_projection(&self, method: Method) -> bool {
        let Some(projection) = &self.projection else { return true };
        let problem = &self.problem;
        let is_plain = !problem.has_bounds() && !problem.is_curved();
        match method {
            Method::Steepest => {
                let Second { xx, uu, .. } = &self.scratch.identity;
                let stage = projection.stage();
                !problem.has_bounds()
                    && (stage.q(), stage.r(), stage.s()) == (xx, uu, None)
                    && projection.q_final() == xx
            }
            Method::QuasiNewton => is_plain && problem.has_weights(projection),
            Method::Newton => false,
        }
    }

    fn length(&self, backtracks: u32) -> f64 {
        (0..backtracks).fold(1.0, |length, _| length * self.options.beta)
    }

    fn swap_kept(&mut self) {
        std::mem::swap(&mut self.trial, &mut self.kept.0);
        std::mem::swap(&mut self.trial_start, &mut self.kept.1);
    }

    /// Whether the trial of a step descends enough.
    fn try_armijo(
        &mut self,
        backtracks: u32,
        derivative: f64,
        go_on: Go<'_>,
    ) -> Result<bool, OptimizeError> {
        let length = self.length(backtracks);
        let descent = self.options.alpha * length * derivative;
        let enough = self.current.merit + descent + self.slack(derivative);
        Ok(self.try_step(length, enough, go_on)? && self.trial.merit < enough)
    }

    /// Projects the trajectory moved by `length` along the direction. False if it does not run, or
    /// costs more than `enough`.
    fn try_step(&mut self, length: f64, enough: f64, go_on: Go<'_>) -> Result<bool, OptimizeError> {
        if !self.start_trial(length) {
            return Ok(false);
        }
        let initial_cost = {
            let states = self.problem.states;
            let (q, p, v) = (self.plant.q(), self.plant.p(), self.plant.v());
            self.trial.set_x(0, [q, p, v]);
            debug_assert_eq!(self.trial.states, states);
            self.initial_cost(&self.trial)
        };
        let bounds = (&self.multipliers[..], self.penalty);
        let gains = if self.projects_by_descent { &self.descent_gains } else { &self.gains };
        let Self { problem, plant, current, trial, dx, du, scratch, .. } = self;
        let Scratch { deviation, nominal, error, input, linearizations, .. } = scratch;
        let (states, inputs, steps) = (problem.states, problem.inputs, problem.steps);
        let (mut cost, mut penalties) = (initial_cost, 0.0);
        let may_stop_early = problem.is_nonnegative && !problem.has_bounds();
        self.foreseen.fill(false);
        if self.workers.len() > 1 {
            // The maps of the trial take their place.
            self.linearized.fill(false);
            self.has_gains = false;
        }
        let foresight = Foresight {
            helpers: &mut self.workers[1..],
            maps: &mut self.maps,
            linearizations,
            first_step: self.first_step,
            length: block_length(states),
            done: &mut self.foreseen,
        };
        let mut roll_out = |behind: &mut dyn FnMut(usize, &Trajectory)| {
            for k in 0..steps {
                ask(k, go_on)?;
                problem.retract(current.x(k), &dx[k * states..][..states], length, nominal);
                problem.difference(nominal, trial.x(k), error);
                let change = &du[k * inputs..][..inputs];
                for (u, (nominal, change)) in input.iter_mut().zip(current.u(k).iter().zip(change))
                {
                    *u = nominal + length * change;
                }
                subtract_product(&gains[k], error, input);
                cost += problem.evaluate(k, trial.x(k), input, deviation);
                penalties += problem.penalty(k, (trial.x(k), input), bounds);
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
                behind(k + 1, trial);
            }
            cost += problem.evaluate(steps, trial.x(steps), &[], deviation);
            penalties += problem.penalty(steps, (trial.x(steps), &[]), bounds);
            (trial.cost, trial.merit) = (cost, cost + penalties);
            Ok(trial.merit.is_finite())
        };
        linearize_behind(foresight, &mut roll_out)
    }

    /// Puts the plant at the initial state of the trial; false if there is none.
    fn start_trial(&mut self, length: f64) -> bool {
        if self.problem.free.is_none() {
            return self.plant.restore(&self.start).is_ok();
        }
        let d = self.problem.model.dimensions();
        let states = self.problem.states;
        let mut x = vec![0.0; states];
        self.problem.retract(self.current.x(0), &self.dx[..states], length, &mut x);
        let (q, rest) = x.split_at(d.coordinates());
        let (p, v) = rest.split_at(d.dynamic);
        let mut q = q.to_vec();
        if let Some(free) = &self.problem.free
            && d.constraints > 0
            && self.dx[..d.coordinates()].iter().any(|x| *x != 0.0)
        {
            match self.plant.project(q, &free.entries[..d.coordinates()]) {
                Ok(projected) => q = projected,
                Err(_) => return false,
            }
        }
        let (p, v) = (p.to_vec(), v.to_vec());
        if self.plant.initialize(&Initial::Momentum { q, p, v }).is_err() {
            return false;
        }
        self.plant.set_step_index(self.first_step);
        self.trial_start = self.plant.snapshot();
        true
    }
}

/// `out −= m v`, skipping zeros of `v`.
fn subtract_product(m: &DMatrix<f64>, v: &[f64], out: &mut [f64]) {
    for (column, v) in m.as_slice().chunks_exact(out.len().max(1)).zip(v) {
        if *v != 0.0 {
            out.iter_mut().zip(column).for_each(|(out, m)| *out -= m * v);
        }
    }
}

fn check_options(options: &Options) -> Result<(), OptimizeError> {
    let fraction = |value: f64| value > 0.0 && value < 1.0;
    let finite = |value: f64| value >= 0.0 && value.is_finite();
    let tolerance = options.tolerance.unwrap_or(0.0);
    let checks = [
        ("alpha", options.alpha, fraction(options.alpha), "between 0 and 1"),
        ("beta", options.beta, fraction(options.beta), "between 0 and 1"),
        ("tolerance", tolerance, finite(tolerance), "finite and not less than zero"),
        (
            "bound_tolerance",
            options.bound_tolerance,
            finite(options.bound_tolerance) && options.bound_tolerance > 0.0,
            "finite and greater than zero",
        ),
        (
            "max_iterations",
            f64::from(options.max_iterations),
            options.max_iterations > 0,
            "greater than zero",
        ),
    ];
    match checks.into_iter().find(|(_, _, good, _)| !good) {
        Some((name, value, _, range)) => Err(OptimizeError::Option { name, value, range }),
        None => Ok(()),
    }
}

/// What tests look at.
#[cfg(test)]
impl Optimizer {
    pub(super) fn set_multipliers(&mut self, value: f64) {
        self.multipliers.fill(value);
        self.current.merit = self.merit(&self.current);
    }

    /// First and second derivative of the cost along the direction of a method; none if its model has no
    /// minimum.
    pub(super) fn direction(&mut self, method: Method) -> Option<(f64, f64)> {
        let go_on: Go<'_> = &mut || true;
        self.find_gradient(go_on).unwrap();
        let Direction::Found { derivative } = self.descend(method, go_on).unwrap() else {
            return None;
        };
        self.projects_by_descent = self.is_projection(method);
        self.find_gains(go_on).unwrap();
        self.find_adjoint(go_on).unwrap();
        let steps = self.problem.steps;
        let bounds = (&self.multipliers[..], self.penalty);
        let vector =
            |rows: &[f64], k: usize, n: usize| DVector::from_column_slice(&rows[k * n..][..n]);
        let mut curvature = 0.0;
        for k in 0..steps {
            let (problem, current) = (&self.problem, &self.current);
            let dx = vector(&self.dx, k, problem.states);
            let du = vector(&self.du, k, problem.inputs);
            let Scratch {
                linearizations, adjoint, deviation, weights, zero_multipliers: zero, ..
            } = &mut self.scratch;
            let contraction = &mut self.workers[0].contraction;
            let z = adjoint[k + 1].as_slice();
            contraction.contract(&problem.model, &linearizations[k], z, zero).unwrap();
            let Contraction { xx, xu, uu, .. } = contraction;
            let mut second = Second { xx: xx.clone(), xu: xu.clone(), uu: uu.clone() };
            let at = (k, current.x(k), current.u(k));
            direction::add_stage_weights(problem, at, bounds, deviation, weights, &mut second);
            curvature += dx.dot(&(&second.xx * &dx)) + du.dot(&(&second.uu * &du));
            curvature += 2.0 * dx.dot(&(&second.xu * &du));
        }
        self.final_weights(Method::Newton);
        let dx = vector(&self.dx, steps, self.problem.states);
        curvature += dx.dot(&(&self.scratch.weights.xx * &dx));
        Some((derivative, curvature))
    }

    pub(super) fn size_of_direction(&self) -> f64 {
        self.dx.iter().chain(&self.du).fold(0.0, |m: f64, x| m.max(x.abs()))
    }

    /// Cost of the projection of the trajectory moved along the direction.
    pub(super) fn merit_at(&mut self, length: f64) -> Option<f64> {
        let runs = self.try_step(length, f64::INFINITY, &mut || true).unwrap();
        runs.then_some(self.trial.merit)
    }
}
