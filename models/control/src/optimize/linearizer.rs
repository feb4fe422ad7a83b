//! The linearized map along a motion, made block by block, shared among threads where that pays.

use std::fmt;
use std::ops::{ControlFlow, Range};
use std::sync::Arc;

use plantd_math::sparse_map::Map;
use plantd_models::{Contraction, KnownStep, Linearization, Plant, StepError};

use crate::optimize::error::OptimizeError;
use crate::optimize::question::{Question, ask, ask_at};
use crate::optimize::trajectory::Trajectory;

/// A step of fewer states is differentiated sooner than a thread starts.
const STATES_FOR_THREADS: usize = 12;

/// What a thread needs of its own to differentiate steps.
#[derive(Debug)]
pub(super) struct Worker {
    plant: Plant,
    linearization: Linearization,
    pub(super) contraction: Contraction,
}

impl Worker {
    fn new(plant: &Plant) -> Self {
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

/// The maps of the steps of a motion, and who makes them.
#[derive(Debug)]
pub(super) struct Linearizer {
    states: usize,
    pub(super) maps: Vec<Map>,
    /// One per step where Newton's method contracts them, else none.
    pub(super) linearizations: Vec<Linearization>,
    /// Block by block, whether the maps belong to the current motion.
    is_current: Vec<bool>,
    /// One per thread; at least one.
    pub(super) workers: Vec<Worker>,
    /// What is done around the work of other threads.
    around: Around,
}

/// The map to write, and the linearization to keep.
type Job<'a> = (&'a mut Map, Option<&'a mut Linearization>);

/// Whether a recursion goes on after a step.
type Verdict = Result<ControlFlow<()>, OptimizeError>;

impl Linearizer {
    /// `keeps` the linearizations.
    pub(super) fn new(plant: &Plant, steps: usize, keeps: bool) -> Self {
        let model = plant.model();
        let states = model.dimensions().state();
        let blocks = steps.div_ceil(block_length(states));
        Self {
            states,
            maps: (0..steps).map(|_| Map::default()).collect(),
            linearizations: vec![Linearization::new(model); if keeps { steps } else { 0 }],
            is_current: vec![false; blocks],
            workers: vec![Worker::new(plant)],
            around: Around(Arc::new(|work| work())),
        }
    }

    /// Lets threads share the work, where the model is large enough to gain from it.
    pub(super) fn set_threads(&mut self, threads: usize, plant: &Plant) {
        let useful = if self.states < STATES_FOR_THREADS { 1 } else { threads.max(1) };
        self.workers.resize_with(useful, || Worker::new(plant));
    }

    /// Does the work of other threads than the caller's inside something, which has to do it once.
    pub(super) fn set_around(&mut self, around: impl Fn(&mut dyn FnMut()) + Send + Sync + 'static) {
        self.around = Around(Arc::new(around));
    }

    /// The motion is another one.
    pub(super) fn forget(&mut self) {
        self.is_current.fill(false);
    }

    /// Visits the maps of the steps from the last to the first; the step at which the visitor breaks off.
    /// Linearizes where that was not done yet: the block before the one that is visited.
    pub(super) fn visit_backwards(
        &mut self,
        motion: &Trajectory,
        go_on: Question<'_>,
        mut visit: impl FnMut(usize, &Map, Option<&Linearization>) -> Verdict,
    ) -> Result<Option<usize>, OptimizeError> {
        let Self { states, maps, linearizations, is_current, workers, around } = self;
        let keeps = !linearizations.is_empty();
        let mut stopped = None;
        for (made, used) in blocks(maps.len(), *states) {
            ask(go_on)?;
            let block = made.start / block_length(*states);
            let made = if is_current[block] { made.start..made.start } else { made };
            let (head, tail) = maps.split_at_mut(used.start);
            let split = if keeps { used.start } else { 0 };
            let (linearized_head, linearized) = linearizations.split_at_mut(split);
            let mut kept = linearized_head[if keeps { made.clone() } else { 0..0 }].iter_mut();
            let jobs = made.clone().zip(&mut head[made]).map(|(k, map)| (k, (map, kept.next())));
            let job = |worker: &mut Worker, k, (map, kept): Job<'_>| {
                worker.linearize(&motion.known(k), map, kept)
            };
            let consume = || {
                for k in used.clone().rev() {
                    ask_at(k, go_on)?;
                    if k > used.start {
                        tail[k - used.start - 1].prefetch();
                    }
                    let place = k - used.start;
                    if visit(k, &tail[place], linearized.get(place))?.is_break() {
                        stopped = Some(k);
                        break;
                    }
                }
                Ok(())
            };
            share_work(workers, around, jobs.collect(), job, consume)?;
            is_current[block] = true;
            if stopped.is_some() {
                break;
            }
        }
        Ok(stopped)
    }

    /// Visits the maps of the steps from the last to the first, each with what a job has made of its
    /// linearization; the step at which the visitor breaks off. `made_now` and `made_before` are room for
    /// blocks. All steps are linearized.
    pub(super) fn visit_contracted<T: Send>(
        &mut self,
        rooms: &mut [Vec<T>; 2],
        go_on: Question<'_>,
        contract: impl Fn(&mut Contraction, usize, &Linearization, &mut T) -> Result<(), StepError>
        + Sync,
        mut visit: impl FnMut(usize, &Map, &mut T) -> Verdict,
    ) -> Result<Option<usize>, OptimizeError> {
        let Self { states, maps, linearizations, workers, around, .. } = self;
        let [mut made_now, mut made_before] = rooms.each_mut();
        let mut stopped = None;
        for (made, used) in blocks(maps.len(), *states) {
            ask(go_on)?;
            let jobs = made.zip(&mut *made_now).collect();
            let job = |worker: &mut Worker, k: usize, room: &mut T| {
                contract(&mut worker.contraction, k, &linearizations[k], room)
            };
            let consume = || {
                for k in used.clone().rev() {
                    ask_at(k, go_on)?;
                    if visit(k, &maps[k], &mut made_before[k - used.start])?.is_break() {
                        stopped = Some(k);
                        break;
                    }
                }
                Ok(())
            };
            share_work(workers, around, jobs, job, consume)?;
            if stopped.is_some() {
                break;
            }
            std::mem::swap(&mut made_now, &mut made_before);
        }
        Ok(stopped)
    }
}

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

/// Takes the work of a thread, which it has to do.
type Wrapper = dyn Fn(&mut dyn FnMut()) + Send + Sync;

/// What is done around the work of a thread.
#[derive(Clone)]
struct Around(Arc<Wrapper>);

impl fmt::Debug for Around {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Around")
    }
}

/// Does the jobs of steps: helpers do while this thread does `consume`, or this one before if there are none.
fn share_work<J: Send>(
    workers: &mut [Worker],
    around: &Around,
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
                threads.push(scope.spawn(move || {
                    let (mut part, mut result) = (Some(part), Ok(()));
                    (around.0)(&mut || {
                        if let Some(part) = part.take() {
                            result = do_all(worker, part);
                        }
                    });
                    result
                }));
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
