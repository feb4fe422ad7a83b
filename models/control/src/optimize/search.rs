//! The search, one iteration at a time.

mod ending;
#[cfg(test)]
mod tests;

use nalgebra::DMatrix;
use plantd_models::{Initial, Plant, State};

use crate::optimize::bounds::BoundPenalty;
use crate::optimize::derivatives::CostDerivatives;
use crate::optimize::direction::Direction;
use crate::optimize::error::{OptimizeError, Stuck};
use crate::optimize::linearizer::Linearizer;
use crate::optimize::options::{Method, Options};
use crate::optimize::problem::{Point, Problem};
use crate::optimize::progress::{Checkpoint, Fallback, Progress, Status};
use crate::optimize::projection::Projection;
use crate::optimize::question::Question;
use crate::optimize::specification::{Bounds, FreeInitialState, TrajectoryCost};
use crate::optimize::trajectory::{Trajectory, rows};
use crate::optimize::trials::{Motion, Trials};

/// A search for the trajectory of least cost; see the [module](super).
///
/// ```
/// use std::sync::Arc;
/// use nalgebra::DMatrix;
/// use plantd_control::{Momentum, Weights};
/// use plantd_control::optimize::{Bound, Bounds, Options, Optimizer, Status, TrajectoryCost};
/// use plantd_models::{Model, Plant, Settings, builtin};
///
/// // Move the cart of a hanging pole by 0.2 m within 2 s, with at most 4 N.
/// let model = Arc::new(Model::compile(&builtin::scene("cart-pole").unwrap())?);
/// let settings = Settings { time_step_s: 0.02, ..Settings::new(&model) };
/// let plant = Plant::new(Arc::clone(&model), settings)?;
/// let (n, m) = (model.dimensions().state(), model.dimensions().input());
/// let start = plant.state().x();
/// let cost = TrajectoryCost {
///     x: DMatrix::from_fn(101, n, |_, i| start[i] + if i == 0 { 0.2 } else { 0.0 }),
///     u: DMatrix::zeros(100, m),
///     weights: Weights::diagonal(&vec![10.0; n], &vec![0.1; m])?.into(),
///     momentum: Momentum::State,
/// };
/// let force = Bound { index: 0, min: Some(-4.0), max: Some(4.0) };
/// let bounds = Bounds { inputs: vec![force], ..Bounds::default() };
/// let guess = DMatrix::zeros(100, m);
/// let mut search = Optimizer::new(plant, guess, cost, &bounds, None, Options::default())?;
/// let first_cost = search.cost();
/// while search.status() == Status::Running {
///     search.iterate(&mut || true)?;
/// }
/// assert_eq!(search.status(), Status::Converged);
/// assert!(search.cost() < first_cost && search.inputs().amax() < 4.0 + 1e-6);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Optimizer {
    options: Options,
    problem: Problem,
    bounds: BoundPenalty,
    current: Motion,
    derivatives: CostDerivatives,
    linearizer: Linearizer,
    /// None where the law of the descent projects.
    projection: Option<Projection>,
    direction: Direction,
    trials: Trials,
    course: Course,
}

/// How far a search has come.
#[derive(Clone, Copy, Debug, Default)]
struct Course {
    iterations: u32,
    first_cost: f64,
    /// Shortenings of the last step.
    backtracks: u32,
    /// Directional derivative of the last step since the multipliers were renewed; 0 before the first.
    last_derivative: f64,
    status: Status,
}

/// A quadratic model that has a minimum, with the directional derivative, or why not.
enum Descent {
    Found { derivative: f64 },
    NotConvex { step: usize },
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
        let start = (&initial, initial.clone());
        let mut search = Self::begin(plant, start, &inputs, cost, bounds, free, options)?;
        let trajectory = &mut search.current.trajectory;
        search.course.first_cost = trajectory.cost;
        search.bounds.renewed_error = search.bounds.error(trajectory);
        trajectory.merit = search.bounds.merit(trajectory);
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
        let start = (initial, reference.clone());
        let mut search = Self::begin(plant, start, inputs, cost, bounds, free, options)?;
        let Checkpoint { first_cost, last_derivative, penalty, .. } = *checkpoint;
        let numbers = [first_cost, checkpoint.bound_violation, last_derivative];
        fits(numbers.iter().all(|x| x.is_finite()), "a number is not finite")?;
        fits(penalty.is_finite() && penalty > 0.0, "its penalty is not greater than zero")?;
        let multipliers = &checkpoint.bound_multipliers;
        let count = search.bounds.multipliers.len();
        fits(multipliers.len() == count, "the number of its multipliers")?;
        fits(multipliers.iter().all(|x| x.is_finite()), "a multiplier is not finite")?;
        let Checkpoint { iterations, backtracks, .. } = *checkpoint;
        let course = &mut search.course;
        *course = Course { iterations, first_cost, backtracks, last_derivative, ..*course };
        search.bounds.renewed_error = checkpoint.bound_violation;
        search.bounds.penalty = penalty;
        search.bounds.multipliers.copy_from_slice(multipliers);
        search.current.trajectory.merit = search.bounds.merit(&search.current.trajectory);
        search.end_by_count(0.0);
        Ok(search)
    }

    /// A search at a trajectory, without a past; with the state that the initial one is weighed against.
    fn begin(
        mut plant: Plant,
        (initial, reference): (&State, State),
        inputs: &DMatrix<f64>,
        cost: TrajectoryCost,
        bounds: &Bounds,
        free: Option<FreeInitialState>,
        options: Options,
    ) -> Result<Self, OptimizeError> {
        let d = plant.model().dimensions();
        let (states, width, steps) = (d.state(), d.input(), inputs.nrows());
        if steps == 0 {
            return Err(OptimizeError::NoSteps);
        }
        OptimizeError::check("the guess", inputs, (steps, width))?;
        options.check()?;
        let weights = options.projection.clone();
        let weights = weights.map(|weights| weights.for_system(states, width)).transpose()?;
        let projection = weights.map(|weights| Projection::new(weights, steps));
        let problem = Problem::new(&plant, steps, cost, free, reference)?;
        let bounds = problem.penalize(bounds)?;
        let State { q, p, v, .. } = initial.clone();
        plant.keep_periods_whole();
        plant.initialize(&Initial::Momentum { q, p, v })?;
        plant.set_step_index(initial.step);
        let mut trajectory = Trajectory::new(d, initial.step, steps);
        trajectory.u = rows(inputs);
        let mut current = Motion { trajectory, start: plant.snapshot() };
        let keeps = [Some(options.method), options.first_method].contains(&Some(Method::Newton));
        let linearizer = Linearizer::new(&plant, steps, keeps);
        let mut trials = Trials::new(plant, &problem, &current);
        trials.simulate_guess(&problem, &mut current.trajectory)?;
        Ok(Self {
            derivatives: CostDerivatives::new(&problem),
            direction: Direction::new(&problem, keeps && projection.is_some()),
            options,
            problem,
            bounds,
            current,
            linearizer,
            projection,
            trials,
            course: Course::default(),
        })
    }

    /// Lets `threads` threads share the linearizations and contractions of an iteration, where the model
    /// is large enough to gain from it; 1 at first. Results are the same to the bit for any number.
    pub fn set_threads(&mut self, threads: usize) {
        self.linearizer.set_threads(threads, &self.trials.plant);
    }

    /// Does the work of the threads that [`set_threads`](Self::set_threads) adds inside of `around`, which is called in
    /// each of them and has to do it, once: so that somebody can measure it.
    pub fn set_around(&mut self, around: impl Fn(&mut dyn FnMut()) + Send + Sync + 'static) {
        self.linearizer.set_around(around);
    }

    /// Whether the search goes on.
    pub fn status(&self) -> Status {
        self.course.status
    }

    /// Cost of the trajectory, without penalties.
    pub fn cost(&self) -> f64 {
        self.current.trajectory.cost
    }

    /// Largest violation of a bound.
    pub fn bound_violation(&self) -> f64 {
        self.bounds.violation(&self.current.trajectory)
    }

    /// Row k is `x[k]`: n + 1 rows.
    pub fn states(&self) -> DMatrix<f64> {
        let Problem { steps, states, .. } = self.problem;
        DMatrix::from_row_slice(steps + 1, states, &self.current.trajectory.x)
    }

    /// Row k is `u[k]`: n rows.
    pub fn inputs(&self) -> DMatrix<f64> {
        let Problem { steps, inputs, .. } = self.problem;
        DMatrix::from_row_slice(steps, inputs, &self.current.trajectory.u)
    }

    /// Iterations so far, with those of the search that was resumed.
    pub fn iterations(&self) -> u32 {
        self.course.iterations
    }

    /// Where the search stands.
    pub fn checkpoint(&self) -> Checkpoint {
        Checkpoint {
            initial: self.initial_state(),
            inputs: self.inputs(),
            iterations: self.course.iterations,
            first_cost: self.course.first_cost,
            bound_multipliers: self.bounds.multipliers.clone(),
            penalty: self.bounds.penalty,
            bound_violation: self.bounds.renewed_error,
            initial_reference: self.problem.initial.reference.clone(),
            backtracks: self.course.backtracks,
            last_derivative: self.course.last_derivative,
        }
    }

    /// Initial state of the trajectory.
    pub fn initial_state(&self) -> State {
        self.current.trajectory.initial()
    }

    /// One iteration. `go_on` is asked every few steps of work; where it says no, the iteration ends
    /// with [`OptimizeError::Cancelled`] and the search is as it was before it.
    ///
    /// # Errors
    ///
    /// [`OptimizeError::Linearization`], [`OptimizeError::Projection`], [`OptimizeError::Cancelled`],
    /// and [`OptimizeError::Finished`] when the search has ended.
    pub fn iterate(&mut self, go_on: &mut dyn FnMut() -> bool) -> Result<Progress, OptimizeError> {
        if self.course.status != Status::Running {
            return Err(OptimizeError::Finished);
        }
        self.find_gradient(go_on)?;
        let iteration = self.course.iterations;
        let asked = match self.options.first_method {
            Some(first) if iteration < self.options.first_iterations => first,
            _ => self.options.method,
        };
        let merit = self.current.trajectory.merit;
        let mut progress = Progress {
            iteration,
            cost_before: merit,
            cost: merit,
            directional_derivative: f64::NAN,
            method: asked,
            ..Progress::default()
        };
        self.step_or_end(asked, &mut progress, go_on)?;
        self.course.iterations += 1;
        self.end_by_count(progress.directional_derivative);
        progress.cost = self.current.trajectory.merit;
        progress.bound_violation = self.bound_violation();
        Ok(progress)
    }

    /// A step along the direction of the method asked for, or of the first that has one after it; or what
    /// is to be done where nothing descends.
    fn step_or_end(
        &mut self,
        mut asked: Method,
        progress: &mut Progress,
        go_on: Question<'_>,
    ) -> Result<(), OptimizeError> {
        loop {
            let descent = self.find_direction(asked, progress, go_on)?;
            let method = progress.method;
            let derivative = match descent {
                Descent::Found { derivative } => derivative,
                Descent::NotConvex { step } => {
                    progress.directional_derivative = f64::NAN;
                    self.course.status = Status::Stuck(match method {
                        Method::QuasiNewton => Stuck::WeightsNotConvex { step },
                        _ => Stuck::NotConvex { step },
                    });
                    return Ok(());
                }
            };
            progress.directional_derivative = derivative;
            if self.has_ended(derivative) {
                return Ok(());
            }
            if self.search_along(derivative, progress, go_on)? {
                self.course.last_derivative = derivative.min(-f64::MIN_POSITIVE);
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

    fn find_gradient(&mut self, go_on: Question<'_>) -> Result<(), OptimizeError> {
        let Self { problem, bounds, current, derivatives, .. } = self;
        let point = Point { problem, bounds, motion: &current.trajectory };
        derivatives.find_gradient(point, go_on)
    }

    /// The direction of the method asked for, or of the one that it falls back to, which it notes; or the
    /// step at which not even steepest descent has one.
    fn find_direction(
        &mut self,
        asked: Method,
        progress: &mut Progress,
        go_on: Question<'_>,
    ) -> Result<Descent, OptimizeError> {
        let last = self.problem.steps - 1;
        progress.method = asked;
        loop {
            let method = progress.method;
            let reason = match self.descend(method, go_on)? {
                // Beyond the last step there is no map to make up for the weights.
                descent @ Descent::NotConvex { step }
                    if method == Method::QuasiNewton && step == last =>
                {
                    return Ok(descent);
                }
                // At a minimum, round-off gives it either sign.
                Descent::Found { derivative } if derivative <= self.round_off() => {
                    return Ok(Descent::Found { derivative: derivative.min(0.0) });
                }
                Descent::Found { derivative } => Fallback::Ascent { derivative },
                Descent::NotConvex { step } => Fallback::NotConvex { step },
            };
            progress.method = match (method, reason) {
                (Method::Newton, _) => Method::QuasiNewton,
                (Method::QuasiNewton, _) => Method::Steepest,
                (Method::Steepest, Fallback::NotConvex { step }) => {
                    return Ok(Descent::NotConvex { step });
                }
                (Method::Steepest, _) => return Ok(Descent::NotConvex { step: 0 }),
            };
            progress.fallback = progress.fallback.or(Some(reason));
        }
    }

    /// Solves the linear-quadratic problem of a method.
    fn descend(&mut self, method: Method, go_on: Question<'_>) -> Result<Descent, OptimizeError> {
        let Self {
            problem,
            bounds,
            current,
            derivatives,
            linearizer,
            projection,
            direction,
            trials,
            ..
        } = self;
        let point = Point { problem, bounds, motion: &current.trajectory };
        let stopped = match projection.as_mut().filter(|_| method == Method::Newton) {
            Some(projection) => {
                projection.find_gains(linearizer, point.motion, go_on)?;
                let (maps, gains) = (&linearizer.maps, &projection.gains);
                direction.map_curvature.find_adjoint(derivatives, maps, gains, go_on)?;
                direction.find_law_in_blocks(point, derivatives, linearizer, go_on)?
            }
            None => direction.find_law(point, method, derivatives, linearizer, go_on)?,
        };
        if let Some(step) = stopped {
            return Ok(Descent::NotConvex { step });
        }
        direction.dx[..problem.states].fill(0.0);
        if let Some(entries) = &problem.initial.free {
            let plant = &mut trials.plant;
            let is_found = plant.restore(&current.start).is_ok()
                && direction.find_initial_change(point, entries, &plant.constraint_jacobian());
            if !is_found {
                return Ok(Descent::NotConvex { step: 0 });
            }
        }
        let derivative = direction.roll_out(derivatives, &linearizer.maps, go_on)?;
        Ok(Descent::Found { derivative })
    }

    /// Sees to it that there is a projection for steps along the direction of a method: the law of its
    /// descent, by choice or because the weights are the same, or a law of its own.
    fn find_projection(
        &mut self,
        method: Method,
        go_on: Question<'_>,
    ) -> Result<(), OptimizeError> {
        let Self { problem, bounds, current, derivatives, projection, .. } = self;
        let point = Point { problem, bounds, motion: &current.trajectory };
        self.direction.is_projection = true;
        if let Some(projection) = projection
            && !derivatives.has_weights(point, method, &projection.weights)
        {
            self.direction.is_projection = false;
            projection.find_gains(&mut self.linearizer, point.motion, go_on)?;
        }
        Ok(())
    }

    /// Armijo's rule. True if a step was taken.
    fn search_along(
        &mut self,
        derivative: f64,
        progress: &mut Progress,
        go_on: Question<'_>,
    ) -> Result<bool, OptimizeError> {
        self.find_projection(progress.method, go_on)?;
        let most = self.options.max_backtracks;
        let last = if self.options.near_last_step { self.course.backtracks } else { 0 };
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
                self.trials.swap_kept();
                if !self.try_armijo(backtracks - 1, derivative, go_on)? {
                    self.trials.swap_kept();
                    break;
                }
                backtracks -= 1;
            }
        }
        std::mem::swap(&mut self.current, &mut self.trials.last);
        self.linearizer.forget();
        if let Some(projection) = &mut self.projection {
            projection.forget();
        }
        self.course.backtracks = backtracks;
        (progress.step_length, progress.backtracks) = (self.length(backtracks), backtracks);
        Ok(true)
    }

    fn length(&self, backtracks: u32) -> f64 {
        (0..backtracks).fold(1.0, |length, _| length * self.options.beta)
    }

    /// Whether the trial of a step descends enough.
    fn try_armijo(
        &mut self,
        backtracks: u32,
        derivative: f64,
        go_on: Question<'_>,
    ) -> Result<bool, OptimizeError> {
        let length = self.length(backtracks);
        let descent = self.options.alpha * length * derivative;
        let enough = self.current.trajectory.merit + descent + self.slack(derivative);
        Ok(self.try_step(length, enough, go_on)? && self.trials.last.trajectory.merit < enough)
    }

    /// Projects the trajectory moved by `length` along the direction. False if it does not run, or
    /// costs more than `enough`.
    fn try_step(
        &mut self,
        length: f64,
        enough: f64,
        go_on: Question<'_>,
    ) -> Result<bool, OptimizeError> {
        let Self { problem, bounds, current, projection, direction, trials, .. } = self;
        let step = (&*direction, length);
        if !trials.start(problem, current, step) {
            return Ok(false);
        }
        let gains = match projection {
            Some(projection) if !direction.is_projection => &projection.gains,
            _ => &direction.gains,
        };
        let point = Point { problem, bounds, motion: &current.trajectory };
        trials.roll_out(point, step, gains, enough, go_on)
    }
}
