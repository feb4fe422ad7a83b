//! The direction of an iteration: linearizations, the gradient, and the linear-quadratic problem, shared
//! among threads where that pays.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;

use nalgebra::{DMatrix, DVector};

use super::{Direction, Go, Optimizer, Scratch, Second, Worker, ask, subtract_product};
use crate::control::lq::Map;
use crate::control::lq::stage::Stage;
use crate::control::tangent_basis;
use crate::optimize::problem::{self, Deviation, Problem, dot};
use crate::optimize::trajectory::Trajectory;
use crate::optimize::{Fallback, Method, OptimizeError};
use crate::plant::known::KnownStep;
use crate::{Contraction, Linearization, Plant, StepError};

/// Curvature, relative to the largest, that a free initial state is given where projected momenta leave it
/// none.
const LEAST_CURVATURE: f64 = 1e-10;

/// What a recursion finds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Law {
    /// The gains of a projection of its own.
    Projection,
    /// The law of the descent.
    Descent(Method),
}

impl Optimizer {
    /// The gains of the projection, where they are not those of the descent.
    pub(super) fn find_gains(&mut self, go_on: Go<'_>) -> Result<(), OptimizeError> {
        let Some(projection) = self.projection.as_ref().filter(|_| !self.has_gains) else {
            return Ok(());
        };
        self.scratch.recursion.begin(projection.q_final(), None);
        if let Some(step) = self.recur(Law::Projection, go_on)? {
            return Err(OptimizeError::Projection { step });
        }
        self.has_gains = true;
        Ok(())
    }

    /// A recursion; the step at which it has no minimum. Linearizes where that was not done yet: the
    /// block before the one that is used.
    fn recur(&mut self, law: Law, go_on: Go<'_>) -> Result<Option<usize>, OptimizeError> {
        let bounds = (&self.multipliers[..], self.penalty);
        let Self {
            problem, workers, current, maps, gains, by_x, by_u, scratch, projection, ..
        } = self;
        let (descent_gains, descent_offsets) = (&mut self.descent_gains, &mut self.descent_offsets);
        let Scratch {
            linearizations,
            contraction,
            second,
            recursion,
            deviation,
            weights,
            identity,
            offset,
            zero_multipliers,
            ..
        } = scratch;
        let first_step = self.first_step;
        let mut not_convex = None;
        for (made, used) in blocks(problem.steps, problem.states) {
            if !go_on() {
                return Err(OptimizeError::Cancelled);
            }
            let block = made.start / block_length(problem.states);
            let made = if self.linearized[block] { made.start..made.start } else { made };
            let (head, tail) = maps.split_at_mut(used.start);
            let keeps = !linearizations.is_empty();
            let split = if keeps { used.start } else { 0 };
            let (linearized_head, linearized) = linearizations.split_at_mut(split);
            let mut kept = linearized_head[if keeps { made.clone() } else { 0..0 }].iter_mut();
            let jobs = made.clone().zip(&mut head[made]).map(|(k, map)| (k, (map, kept.next())));
            let job = |worker: &mut Worker, k, (map, kept): LinearizeJob<'_>| {
                worker.linearize(&known(current, k, first_step), map, kept)
            };
            let consume = || {
                for k in used.clone().rev() {
                    ask(k, go_on)?;
                    let map = &tail[k - used.start];
                    if k > used.start {
                        tail[k - used.start - 1].prefetch();
                    }
                    let at = (k, current.x(k), current.u(k));
                    let linear = (Some(&by_x[k]), Some(&by_u[k]));
                    let (stage, gain, offset) = match (law, &*projection) {
                        (Law::Projection, Some(weights)) => {
                            (weights.stage().stage(), &mut gains[k], &mut *offset)
                        }
                        (Law::Projection, None) => return Ok(()),
                        (Law::Descent(method), _) => {
                            let stage = if method == Method::Newton {
                                let (z, first) = (recursion.linear(), &linearized[k - used.start]);
                                contraction
                                    .contract(&problem.model, first, z.as_slice(), zero_multipliers)
                                    .map_err(|error| OptimizeError::Linearization {
                                        step: k,
                                        error,
                                    })?;
                                second.take(contraction);
                                add_stage_weights(problem, at, bounds, deviation, weights, second);
                                second.stage()
                            } else {
                                stage_weights(
                                    problem, method, at, bounds, deviation, weights, identity,
                                )
                            };
                            let (x_linear, u_linear) = linear;
                            let stage = Stage { x_linear, u_linear, ..stage };
                            (stage, &mut descent_gains[k], &mut descent_offsets[k])
                        }
                    };
                    let found = recursion.step(map, stage, gain, offset);
                    let is_finite = || gain.iter().all(|entry| entry.is_finite());
                    if found.is_err() || law == Law::Projection && !is_finite() {
                        not_convex = Some(k);
                        break;
                    }
                }
                Ok(())
            };
            share_work(workers, jobs.collect(), job, consume)?;
            self.linearized[block] = true;
            if not_convex.is_some() {
                break;
            }
        }
        Ok(not_convex)
    }

    /// Gradient of the cost with penalties.
    pub(super) fn find_gradient(&mut self, go_on: Go<'_>) -> Result<(), OptimizeError> {
        let Self { problem, current, by_x, by_u, scratch, .. } = self;
        let bounds = (&self.multipliers[..], self.penalty);
        let steps = problem.steps;
        for (k, by_x) in by_x.iter_mut().enumerate() {
            ask(k, go_on)?;
            let x = current.x(k);
            let u = if k < steps { current.u(k) } else { &[] };
            problem.evaluate(k, x, u, &mut scratch.deviation);
            problem.gradient(k, (x, u), &mut scratch.deviation, bounds, by_x, by_u.get_mut(k));
        }
        if let Some(weight) = problem.free.as_ref().and_then(|free| free.weight.as_ref()) {
            let reference = self.reference.x();
            problem.difference(&reference, current.x(0), &mut scratch.error);
            let change = DVector::from_column_slice(&scratch.error);
            let mut slope = weight * change;
            for &i in problem.model.orientations() {
                let map = problem::chart(&scratch.error, i);
                let turned = map.apply_transposed(crate::plant::balls::three(slope.as_slice(), i));
                slope.rows_mut(i, 3).copy_from_slice(&turned.0);
            }
            by_x[0] += slope;
        }
        Ok(())
    }

    /// The adjoint along the projection, `z[k] = l_x − Kᵀ l_u + (A − BK)ᵀ z[k+1]`.
    pub(super) fn find_adjoint(&mut self, go_on: Go<'_>) -> Result<(), OptimizeError> {
        let gains = if self.projection.is_some() { &self.gains } else { &self.descent_gains };
        let Self { problem, by_x, by_u, maps, .. } = self;
        let Scratch { adjoint, offset, packed, .. } = &mut self.scratch;
        adjoint[problem.steps].copy_from(&by_x[problem.steps]);
        for k in (0..problem.steps).rev() {
            ask(k, go_on)?;
            let (head, tail) = adjoint.split_at_mut(k + 1);
            let (z, next) = (&mut head[k], &tail[0]);
            // l_x + Aᵀ z[k+1] − Kᵀ (l_u + Bᵀ z[k+1]).
            z.copy_from(&by_x[k]);
            offset.copy_from(&by_u[k]);
            let (by_x, by_u) = (z.as_mut_slice(), offset.as_mut_slice());
            maps[k].add_pulled_back(next.as_slice(), packed, by_x, by_u);
            z.gemv_tr(-1.0, &gains[k], offset, 1.0);
        }
        Ok(())
    }

    /// The direction of the method asked for, or of the one that it falls back to, with its directional
    /// derivative; or the step at which not even steepest descent has one.
    #[allow(clippy::type_complexity, reason = "three answers of one question")]
    pub(super) fn find_direction(
        &mut self,
        asked: Method,
        go_on: Go<'_>,
    ) -> Result<(Method, Option<Fallback>, Result<f64, usize>), OptimizeError> {
        let (mut method, mut fallback) = (asked, None);
        loop {
            let last = self.problem.steps - 1;
            let reason = match self.descend(method, go_on)? {
                // Beyond the last step there is no map to make up for the weights.
                Direction::NotConvex { step } if method == Method::QuasiNewton && step == last => {
                    return Ok((method, fallback, Err(step)));
                }
                // At a minimum, round-off gives it either sign.
                Direction::Found { derivative } if derivative <= self.round_off() => {
                    return Ok((method, fallback, Ok(derivative.min(0.0))));
                }
                Direction::Found { derivative } => Fallback::Ascent { derivative },
                Direction::NotConvex { step } => Fallback::NotConvex { step },
            };
            method = match (method, reason) {
                (Method::Newton, _) => Method::QuasiNewton,
                (Method::QuasiNewton, _) => Method::Steepest,
                (Method::Steepest, Fallback::NotConvex { step }) => {
                    return Ok((method, fallback, Err(step)));
                }
                (Method::Steepest, _) => return Ok((method, fallback, Err(0))),
            };
            fallback = Some(fallback.unwrap_or(reason));
        }
    }

    /// Solves the linear-quadratic problem of a method.
    pub(super) fn descend(
        &mut self,
        method: Method,
        go_on: Go<'_>,
    ) -> Result<Direction, OptimizeError> {
        let steps = self.problem.steps;
        let contracts = method == Method::Newton && self.projection.is_some();
        if contracts {
            self.find_gains(go_on)?;
            self.find_adjoint(go_on)?;
        }
        self.final_weights(method);
        self.scratch.recursion.begin(&self.scratch.weights.xx, Some(&self.by_x[steps]));
        let not_convex = if contracts {
            self.contract_and_recur(go_on)?
        } else {
            self.recur(Law::Descent(method), go_on)?
        };
        if let Some(step) = not_convex {
            return Ok(Direction::NotConvex { step });
        }
        if !self.find_initial_change() {
            return Ok(Direction::NotConvex { step: 0 });
        }
        Ok(Direction::Found { derivative: self.roll_direction(go_on)? })
    }

    /// The recursion with second derivatives of the map along the adjoint, which are contracted block by
    /// block.
    pub(super) fn contract_and_recur(
        &mut self,
        go_on: Go<'_>,
    ) -> Result<Option<usize>, OptimizeError> {
        let bounds = (&self.multipliers[..], self.penalty);
        let Self { problem, workers, current, maps, by_x, by_u, scratch, .. } = self;
        let (descent_gains, descent_offsets) = (&mut self.descent_gains, &mut self.descent_offsets);
        let Scratch {
            linearizations,
            contractions,
            recursion,
            deviation,
            weights,
            adjoint,
            zero_multipliers,
            ..
        } = scratch;
        let [mut made_now, mut made_before] = contractions.each_mut();
        let (model, linearizations, adjoint) = (&*problem.model, &*linearizations, &*adjoint);
        let zero_multipliers = &*zero_multipliers;
        let mut not_convex = None;
        for (made, used) in blocks(problem.steps, problem.states) {
            if !go_on() {
                return Err(OptimizeError::Cancelled);
            }
            let jobs = made.zip(&mut *made_now).collect();
            let job = |worker: &mut Worker, k: usize, slot: &mut Second| {
                let (contraction, z) = (&mut worker.contraction, adjoint[k + 1].as_slice());
                contraction.contract(model, &linearizations[k], z, zero_multipliers)?;
                slot.take(contraction);
                Ok(())
            };
            let consume = || {
                for k in used.clone().rev() {
                    ask(k, go_on)?;
                    let second = &mut made_before[k - used.start];
                    let at = (k, current.x(k), current.u(k));
                    add_stage_weights(problem, at, bounds, deviation, weights, second);
                    let (x_linear, u_linear) = (Some(&by_x[k]), Some(&by_u[k]));
                    let stage = Stage { x_linear, u_linear, ..second.stage() };
                    let (gain, offset) = (&mut descent_gains[k], &mut descent_offsets[k]);
                    if recursion.step(&maps[k], stage, gain, offset).is_err() {
                        not_convex = Some(k);
                        break;
                    }
                }
                Ok(())
            };
            share_work(workers, jobs, job, consume)?;
            if not_convex.is_some() {
                break;
            }
            std::mem::swap(&mut made_now, &mut made_before);
        }
        Ok(not_convex)
    }

    /// Writes the second derivatives of the final cost.
    pub(super) fn final_weights(&mut self, method: Method) {
        let Self { problem, current, scratch, .. } = self;
        let Scratch { weights: Second { xx: q, xu: s, .. }, deviation, identity, .. } = scratch;
        let (steps, x) = (problem.steps, current.x(problem.steps));
        if method == Method::Steepest {
            q.copy_from(&identity.xx);
        } else {
            q.copy_from(problem.q_final());
            if problem.is_curved() {
                problem.evaluate(steps, x, &[], deviation);
                s.fill(0.0);
                problem.pull_back(steps, deviation, q, s);
                if method == Method::Newton {
                    problem.add_chart_curvature(deviation, q);
                }
            }
        }
        let bounds = (&self.multipliers[..], self.penalty);
        problem.add_penalty_curvature(steps, (x, &[]), bounds, q, None);
    }

    /// Writes the best change of the initial state into `dx[0]`; false if there is none.
    pub(super) fn find_initial_change(&mut self) -> bool {
        let states = self.problem.states;
        let change = &mut self.dx[..states];
        change.fill(0.0);
        let Some(free) = &self.problem.free else { return true };
        let d = self.problem.model.dimensions();
        if self.plant.restore(&self.start).is_err() {
            return false;
        }
        let basis =
            free_directions(&free.entries, &self.plant.constraint_jacobian(), d.coordinates());
        if basis.ncols() == 0 {
            return true;
        }
        let mut value = self.scratch.recursion.value();
        if let Some(weight) = &free.weight {
            let mut deviation = self.problem.deviation();
            let reference = self.reference.x();
            self.problem.difference(&reference, self.current.x(0), &mut deviation.x);
            let mut weight = weight.clone();
            let cross = &mut self.scratch.weights.xu;
            self.problem.turn_weights(&deviation, &mut weight, cross);
            value += weight;
        }
        let mut reduced = basis.transpose() * (value * &basis);
        if self.problem.projects() {
            // What a momentum has along `Dh_dᵀ` costs nothing.
            let least = LEAST_CURVATURE * reduced.diagonal().amax();
            (0..reduced.nrows()).for_each(|i| reduced[(i, i)] += least);
        }
        let slope = basis.tr_mul(self.scratch.recursion.linear());
        let Some(factor) = reduced.cholesky() else { return false };
        let step = -(&basis * factor.solve(&slope));
        change.copy_from_slice(step.as_slice());
        true
    }

    /// Runs the law of the descent through the linearized map; returns the directional derivative.
    pub(super) fn roll_direction(&mut self, go_on: Go<'_>) -> Result<f64, OptimizeError> {
        let Self { problem, maps, by_x, by_u, dx, du, descent_gains, descent_offsets, .. } = self;
        let packed = &mut self.scratch.packed;
        let (states, inputs) = (problem.states, problem.inputs);
        let mut derivative = dot(by_x[0].as_slice(), &dx[..states]);
        for k in 0..problem.steps {
            ask(k, go_on)?;
            let (head, tail) = dx.split_at_mut((k + 1) * states);
            let (x, next) = (&head[k * states..], &mut tail[..states]);
            let u = &mut du[k * inputs..][..inputs];
            for (u, offset) in u.iter_mut().zip(descent_offsets[k].iter()) {
                *u = -offset;
            }
            subtract_product(&descent_gains[k], x, u);
            maps[k].apply(x, u, packed, next);
            derivative += dot(by_u[k].as_slice(), u) + dot(by_x[k + 1].as_slice(), next);
        }
        Ok(derivative)
    }
}

impl Worker {
    pub(super) fn new(plant: &Plant) -> Self {
        Self {
            linearization: Linearization::new(plant.model()),
            contraction: Contraction::new(plant.model()),
            plant: plant.clone(),
        }
    }

    /// Linearizes a step; where room is given, into that.
    fn linearize(
        &mut self,
        step: &KnownStep<'_>,
        map: &mut Map,
        kept: Option<&mut Linearization>,
    ) -> Result<(), StepError> {
        let out = kept.unwrap_or(&mut self.linearization);
        self.plant.linearize_known(step, out)?;
        out.write_map(map);
        Ok(())
    }
}

/// Where helpers linearize a trial.
pub(super) struct Foresight<'a> {
    pub(super) helpers: &'a mut [Worker],
    pub(super) maps: &'a mut [Map],
    pub(super) linearizations: &'a mut [Linearization],
    pub(super) first_step: u64,
    /// Steps of a block, and which blocks are done.
    pub(super) length: usize,
    pub(super) done: &'a mut [bool],
}

/// A roll-out that says after each step how many it took, and shows the motion.
type RollOut<'a> =
    &'a mut dyn FnMut(&mut dyn FnMut(usize, &Trajectory)) -> Result<bool, OptimizeError>;

/// Rolls a trial out, and has helpers linearize the blocks behind it meanwhile, the last first; marks
/// those that they did.
pub(super) fn linearize_behind(
    foresight: Foresight<'_>,
    roll_out: RollOut<'_>,
) -> Result<bool, OptimizeError> {
    let Foresight { helpers, maps, linearizations, first_step, length, done } = foresight;
    if helpers.is_empty() {
        return roll_out(&mut |_, _| {});
    }
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let mut queues = Vec::with_capacity(helpers.len());
        let mut threads = Vec::with_capacity(helpers.len());
        for worker in helpers {
            let (queue, blocks) = mpsc::channel::<Block<'_>>();
            let is_over = &is_over;
            queues.push(queue);
            threads.push(scope.spawn(move || {
                let (mut waiting, mut done) = (Vec::new(), Vec::new());
                while !is_over.load(Ordering::Relaxed) {
                    if waiting.is_empty() {
                        match blocks.recv() {
                            Ok(block) => waiting.push(block),
                            Err(_) => break,
                        }
                    }
                    waiting.extend(blocks.try_iter());
                    let Some(Block { number, first, motion, maps, kept }) = waiting.pop() else {
                        break;
                    };
                    let mut kept = kept.iter_mut();
                    let first_step = first_step.saturating_add(first as u64);
                    let mut steps = maps.iter_mut().enumerate();
                    let linearized = steps.all(|(k, map)| {
                        let step = known(&motion, k, first_step);
                        worker.linearize(&step, map, kept.next()).is_ok()
                    });
                    if linearized {
                        done.push(number);
                    }
                }
                done
            }));
        }
        let mut maps = maps.chunks_mut(length).enumerate();
        let mut kept = linearizations.chunks_mut(length);
        let (mut first, mut next) = (0, maps.next());
        let rolled_out = roll_out(&mut |steps, trial| {
            let Some((number, _)) = next.as_ref().filter(|(_, maps)| first + maps.len() == steps)
            else {
                return;
            };
            let queue = &queues[number % queues.len()];
            if let Some((number, maps)) = next.take() {
                let motion = trial.part(first..steps);
                let kept = kept.next().unwrap_or_default();
                // A helper that is gone leaves its blocks to the next iteration.
                let _ = queue.send(Block { number, first, motion, maps, kept });
            }
            (first, next) = (steps, maps.next());
        });
        is_over.store(true, Ordering::Relaxed);
        drop(queues);
        for thread in threads {
            match thread.join() {
                Ok(numbers) => numbers.into_iter().for_each(|number| done[number] = true),
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        rolled_out
    })
}

/// A block of a trial.
struct Block<'a> {
    number: usize,
    first: usize,
    motion: Trajectory,
    maps: &'a mut [Map],
    kept: &'a mut [Linearization],
}

/// The map to write, and the linearization to keep.
type LinearizeJob<'a> = (&'a mut Map, Option<&'a mut Linearization>);

/// Steps of a block: enough for threads to share, few enough for caches and for questions.
pub(super) fn block_length(states: usize) -> usize {
    (2048 / states.max(1)).clamp(4, 64)
}

/// Blocks of steps from the last to the first: the one to be made, and the one made before, which is used
/// meanwhile.
fn blocks(steps: usize, states: usize) -> impl Iterator<Item = (Range<usize>, Range<usize>)> {
    let length = block_length(states);
    let count = steps.div_ceil(length);
    let block = move |i: usize| (i * length).min(steps)..((i + 1) * length).min(steps);
    (0..=count).rev().map(move |i| (if i == 0 { 0..0 } else { block(i - 1) }, block(i)))
}

/// Does the jobs of steps: helpers do while this thread does `consume`, or this one before if there are none.
fn share_work<J: Send>(
    workers: &mut [Worker],
    jobs: Vec<(usize, J)>,
    job: impl Fn(&mut Worker, usize, J) -> Result<(), StepError> + Sync,
    consume: impl FnOnce() -> Result<(), OptimizeError>,
) -> Result<(), OptimizeError> {
    let do_all = |worker: &mut Worker, jobs: Vec<(usize, J)>| {
        jobs.into_iter().try_for_each(|(step, what)| {
            job(worker, step, what).map_err(|error| OptimizeError::Linearization { step, error })
        })
    };
    let Some((own, helpers)) = workers.split_first_mut() else { return consume() };
    if helpers.is_empty() {
        do_all(own, jobs)?;
        return consume();
    }
    let share = jobs.len().div_ceil(helpers.len()).max(1);
    let mut jobs = jobs.into_iter();
    std::thread::scope(|scope| {
        let mut threads = Vec::with_capacity(helpers.len());
        for worker in helpers {
            let part: Vec<_> = jobs.by_ref().take(share).collect();
            if !part.is_empty() {
                threads.push(scope.spawn(|| do_all(worker, part)));
            }
        }
        let consumed = consume();
        // All are joined, and the first failure counts, whichever thread was faster.
        let mut made = Ok(());
        for thread in threads {
            match thread.join() {
                Ok(result) => made = made.and(result),
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        made?;
        consumed
    })
}

/// Second derivatives of a step without those of the map; of the weights themselves where nothing is to be
/// added.
fn stage_weights<'a>(
    problem: &'a Problem,
    method: Method,
    (k, x, u): (usize, &[f64], &[f64]),
    bounds: (&[f64], f64),
    deviation: &mut Deviation,
    own: &'a mut Second,
    identity: &'a Second,
) -> Stage<'a> {
    let is_curved = problem.is_curved();
    let is_plain = !problem.has_bounds() && (!is_curved || method == Method::Steepest);
    let stage = problem.stage(k);
    if is_plain && method == Method::Steepest {
        return Stage { q: &identity.xx, r: &identity.uu, s: None, x_linear: None, u_linear: None };
    }
    if is_plain {
        return stage.stage();
    }
    let Second { xx: q, xu: s, uu: r } = own;
    let mut has_cross = false;
    if method == Method::Steepest {
        q.copy_from(&identity.xx);
        r.copy_from(&identity.uu);
    } else {
        has_cross = copy_weights(problem, k, (&mut *q, &mut *s, &mut *r));
        if is_curved {
            problem.evaluate(k, x, u, deviation);
            problem.pull_back(k, deviation, q, s);
        }
    }
    problem.add_penalty_curvature(k, (x, u), bounds, q, Some(&mut *r));
    Stage { q, r, s: if has_cross { Some(s) } else { None }, x_linear: None, u_linear: None }
}

/// Adds the second derivatives of the cost of a step to those of the map.
pub(super) fn add_stage_weights(
    problem: &Problem,
    (k, x, u): (usize, &[f64], &[f64]),
    bounds: (&[f64], f64),
    deviation: &mut Deviation,
    own: &mut Second,
    second: &mut Second,
) {
    let stage = problem.stage(k);
    if !problem.is_curved() {
        second.xx += stage.q();
        if let Some(s) = stage.s() {
            second.xu += s;
        }
    } else {
        copy_weights(problem, k, (&mut own.xx, &mut own.xu, &mut own.uu));
        problem.evaluate(k, x, u, deviation);
        problem.pull_back(k, deviation, &mut own.xx, &mut own.xu);
        problem.add_chart_curvature(deviation, &mut own.xx);
        second.xx += &own.xx;
        second.xu += &own.xu;
    }
    second.uu += stage.r();
    problem.add_penalty_curvature(k, (x, u), bounds, &mut second.xx, Some(&mut second.uu));
}

/// Copies the weights of step `k`; true if there is a cross term.
fn copy_weights(
    problem: &Problem,
    k: usize,
    (q, s, r): (&mut DMatrix<f64>, &mut DMatrix<f64>, &mut DMatrix<f64>),
) -> bool {
    let stage = problem.stage(k);
    q.copy_from(stage.q());
    r.copy_from(stage.r());
    match stage.s() {
        Some(cross) => s.copy_from(cross),
        None => s.fill(0.0),
    }
    stage.s().is_some()
}

/// Step `k` of a trajectory.
fn known(trajectory: &Trajectory, k: usize, first_step: u64) -> KnownStep<'_> {
    let n = trajectory.coordinates;
    KnownStep {
        index: first_step.saturating_add(k as u64),
        q0: &trajectory.x(k)[..n],
        p0: Some(&trajectory.x(k)[n..]),
        q1: &trajectory.x(k + 1)[..n],
        multipliers: trajectory.multipliers(k),
        u: trajectory.u(k),
    }
}

/// Directions of `x` along free entries that keep the constraints, as orthonormal columns.
fn free_directions(entries: &[bool], jacobian: &DMatrix<f64>, n: usize) -> DMatrix<f64> {
    let of = |range: std::ops::Range<usize>| range.filter(|i| entries[*i]).collect::<Vec<_>>();
    let (configuration, others) = (of(0..n), of(n..entries.len()));
    let mut columns = DMatrix::zeros(jacobian.nrows(), configuration.len());
    for (to, &from) in configuration.iter().enumerate() {
        columns.set_column(to, &jacobian.column(from));
    }
    let tangent = tangent_basis(&columns);
    let mut basis = DMatrix::zeros(entries.len(), tangent.ncols() + others.len());
    for (row, &entry) in configuration.iter().enumerate() {
        basis.view_mut((entry, 0), (1, tangent.ncols())).copy_from(&tangent.row(row));
    }
    for (column, &entry) in others.iter().enumerate() {
        basis[(entry, tangent.ncols() + column)] = 1.0;
    }
    basis
}
