//! Workers for everything that computes longer than a step: threads of the server's own, as many at
//! work as configured, behind a bounded queue, and told to stop when nobody waits for the result any
//! more.
//!
//! ```text
//!  run, resume ──► queue: first come, first served ──► turns, `count` of them ──► threads
//!                    ▲                                   │
//!                    └── a job that has had its time ◄───┘
//! ```
//!
//! Whoever computes has a turn. A job that asks [`Abandoned::check`] now and then, as every long one
//! must, gives its turn to the next in the queue when it has had it for 20 ms, and queues again: however
//! many long computations there are, a short one waits for no more than one such time for each job
//! before it. What a job has begun stays on the stack of its thread meanwhile; there are a few more
//! threads than turns for that.
//!
//! Threads have the priority of their pool ([`crate::priority`]), and so have the threads that a job
//! starts.

use std::collections::VecDeque;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::runtime::{Handle, RuntimeFlavor};
use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;

use crate::limits::LimitExceeded;
use crate::priority::Priority;
use crate::status::Fault;

/// How long a job keeps its turn while others wait for one.
const TURN: Duration = Duration::from_millis(20);

/// Threads for each turn, at most: those that wait for their next turn included.
const THREADS_PER_TURN: usize = 8;

/// Runs a long computation, or a wait, on this thread, while the runtime that it may belong to moves its
/// other tasks to another one.
pub(crate) fn beside_other_tasks<R>(compute: impl FnOnce() -> R) -> R {
    match Handle::try_current().map(|runtime| runtime.runtime_flavor()) {
        Ok(RuntimeFlavor::MultiThread) => tokio::task::block_in_place(compute),
        _ => compute(),
    }
}

/// Told to jobs that nobody waits for; also where a job lets others have their turn.
pub struct Abandoned {
    token: CancellationToken,
    pool: Arc<Pool>,
    turn_began: std::cell::Cell<Instant>,
}

impl fmt::Debug for Abandoned {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Abandoned").field(&self.token.is_cancelled()).finish()
    }
}

impl Abandoned {
    /// Nobody waits for the result; a long job asks this every few milliseconds and ends early. May
    /// wait until other jobs have had their turn: ask it without holding a lock.
    pub fn check(&self) -> Result<(), Fault> {
        if self.token.is_cancelled() {
            return Err(Fault::cancelled());
        }
        if self.turn_began.get().elapsed() >= TURN {
            self.pool.pass_on();
            self.turn_began.set(Instant::now());
        }
        Ok(())
    }
}

/// The pool.
#[derive(Clone)]
pub struct Workers {
    pool: Arc<Pool>,
    /// Ends the threads when the last handle is gone.
    _end: Arc<End>,
}

impl Workers {
    /// A pool in which `count` jobs run at a time, behind a queue of `queued_jobs`.
    pub fn new(name: &'static str, count: usize, queued_jobs: u64, priority: Priority) -> Self {
        let pool = Arc::new(Pool {
            name,
            count: count.max(1),
            queued_jobs,
            priority,
            state: Mutex::default(),
            granted: Condvar::new(),
        });
        let _end = Arc::new(End(Arc::clone(&pool)));
        Self { pool, _end }
    }

    /// Number of jobs that run at a time.
    pub fn count(&self) -> usize {
        self.pool.count
    }

    /// Runs a job. Dropping the returned future tells the job to stop.
    pub async fn run<T: Send + 'static>(
        &self,
        job: impl FnOnce(&Abandoned) -> Result<T, Fault> + Send + 'static,
    ) -> Result<T, Fault> {
        self.start(Admission::Bounded, job).await
    }

    /// Runs the next part of a stream that was admitted: waits however long the queue is. The limit
    /// on streams bounds the queue.
    pub async fn resume<T: Send + 'static>(
        &self,
        job: impl FnOnce(&Abandoned) -> Result<T, Fault> + Send + 'static,
    ) -> Result<T, Fault> {
        self.start(Admission::Granted, job).await
    }

    async fn start<T: Send + 'static>(
        &self,
        admission: Admission,
        job: impl FnOnce(&Abandoned) -> Result<T, Fault> + Send + 'static,
    ) -> Result<T, Fault> {
        let token = CancellationToken::new();
        let (sender, receiver) = oneshot::channel();
        let work = {
            let (token, pool) = (token.clone(), Arc::clone(&self.pool));
            Box::new(move || {
                let turn_began = std::cell::Cell::new(Instant::now());
                // Nobody may wait any more.
                let _ = sender.send(job(&Abandoned { token, pool, turn_began }));
            })
        };
        let id = self.pool.submit(admission, work)?;
        let mut caller = Caller { pool: &self.pool, id, token, waits: true };
        let outcome = receiver.await;
        caller.waits = false;
        outcome.unwrap_or_else(|_| {
            tracing::error!("a computation broke off");
            Err(Fault::internal("a computation broke off"))
        })
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Admission {
    /// Refused when the queue is full.
    Bounded,
    Granted,
}

/// Whoever waits for a job.
struct Caller<'a> {
    pool: &'a Pool,
    id: u64,
    token: CancellationToken,
    waits: bool,
}

impl Drop for Caller<'_> {
    fn drop(&mut self) {
        if self.waits {
            self.token.cancel();
            self.pool.withdraw(self.id);
        }
    }
}

/// Drops the threads of a pool that nobody can reach any more.
struct End(Arc<Pool>);

impl Drop for End {
    fn drop(&mut self) {
        self.0.state().is_ending = true;
        self.0.granted.notify_all();
    }
}

type Work = Box<dyn FnOnce() + Send>;

struct Pool {
    name: &'static str,
    count: usize,
    queued_jobs: u64,
    priority: Priority,
    state: Mutex<State>,
    /// There is granted work, or the pool ends.
    granted: Condvar,
}

#[derive(Default)]
struct State {
    /// What waits for a turn.
    queue: VecDeque<Ticket>,
    /// What has a turn, and waits for a thread.
    granted: VecDeque<Work>,
    /// Turns that are taken.
    taken: usize,
    threads: usize,
    idle: usize,
    last_id: u64,
    is_ending: bool,
}

enum Ticket {
    Begin { id: u64, admission: Admission, work: Work },
    GoOn(Arc<Baton>),
}

/// What a thread waits for that has passed its turn on.
#[derive(Default)]
struct Baton {
    is_here: Mutex<bool>,
    arrived: Condvar,
}

impl Baton {
    fn pass(&self) {
        *lock(&self.is_here) = true;
        self.arrived.notify_one();
    }

    fn wait(&self) {
        let mut is_here = lock(&self.is_here);
        while !*is_here {
            is_here = self.arrived.wait(is_here).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

impl Pool {
    fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Queues work, or begins it at once; returns its number.
    fn submit(self: &Arc<Self>, admission: Admission, work: Work) -> Result<u64, Fault> {
        let mut state = self.state();
        state.last_id += 1;
        let id = state.last_id;
        if state.taken < self.count {
            state.taken += 1;
            self.grant(&mut state, work);
            return Ok(id);
        }
        if admission == Admission::Bounded {
            let is_bounded = |ticket: &&Ticket| {
                matches!(ticket, Ticket::Begin { admission: Admission::Bounded, .. })
            };
            let waiting = state.queue.iter().filter(is_bounded).count() + 1;
            let (name, what) = ("queued_jobs", "jobs wait for a worker");
            LimitExceeded::check(name, self.queued_jobs, what, waiting)?;
        }
        state.queue.push_back(Ticket::Begin { id, admission, work });
        Ok(id)
    }

    /// Takes work that has not begun out of the queue.
    fn withdraw(&self, id: u64) {
        let mut state = self.state();
        let is_it = |ticket: &Ticket| matches!(ticket, Ticket::Begin { id: i, .. } if *i == id);
        let ticket = state.queue.iter().position(is_it).and_then(|i| state.queue.remove(i));
        drop(state);
        // What the job holds is dropped without the lock.
        drop(ticket);
    }

    /// Gives work that has a turn to a thread.
    fn grant(self: &Arc<Self>, state: &mut State, work: Work) {
        state.granted.push_back(work);
        if state.idle >= state.granted.len() {
            self.granted.notify_one();
            return;
        }
        let pool = Arc::clone(self);
        let name = format!("{}-{}", self.name, state.threads);
        match std::thread::Builder::new().name(name).spawn(move || pool.serve()) {
            Ok(_) => state.threads += 1,
            // A thread that is busy takes it when it has done.
            Err(error) => tracing::error!(%error, "no thread for a worker"),
        }
    }

    /// Hands a turn that has become free to the next in the queue.
    fn hand_on(self: &Arc<Self>, state: &mut State) {
        match state.queue.pop_front() {
            None => state.taken -= 1,
            Some(Ticket::GoOn(baton)) => baton.pass(),
            Some(Ticket::Begin { work, .. }) => self.grant(state, work),
        }
    }

    /// Lets the next in the queue compute, and waits for another turn. Returns at once when nobody
    /// waits, or when there is no thread for what waits.
    fn pass_on(self: &Arc<Self>) {
        let mut state = self.state();
        let may_pass = match state.queue.front() {
            None => false,
            Some(Ticket::GoOn(_)) => true,
            Some(Ticket::Begin { .. }) => {
                state.idle > state.granted.len() || state.threads < THREADS_PER_TURN * self.count
            }
        };
        if !may_pass {
            return;
        }
        let baton = Arc::new(Baton::default());
        state.queue.push_back(Ticket::GoOn(Arc::clone(&baton)));
        self.hand_on(&mut state);
        drop(state);
        baton.wait();
    }

    /// What a thread does.
    fn serve(self: Arc<Self>) {
        self.priority.apply(self.name);
        while let Some(work) = self.next_work() {
            // The sender of a result that a panic has dropped tells the caller.
            let _ = catch_unwind(AssertUnwindSafe(work));
            self.hand_on(&mut self.state());
        }
        self.state().threads -= 1;
    }

    /// Work that has a turn; none when the thread is not needed any more.
    fn next_work(&self) -> Option<Work> {
        let mut state = self.state();
        loop {
            if let Some(work) = state.granted.pop_front() {
                return Some(work);
            }
            if state.is_ending || state.idle >= self.count {
                return None;
            }
            state.idle += 1;
            state = self.granted.wait(state).unwrap_or_else(PoisonError::into_inner);
            state.idle -= 1;
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

    use super::*;

    fn workers(count: usize, queued_jobs: u64) -> Workers {
        Workers::new("test", count, queued_jobs, Priority::Idle)
    }

    /// Computes until `stop` is set, asking whether somebody waits.
    fn busy(stop: Arc<AtomicBool>) -> impl FnOnce(&Abandoned) -> Result<(), Fault> {
        move |abandoned| {
            while !stop.load(Ordering::Acquire) {
                abandoned.check()?;
            }
            Ok(())
        }
    }

    #[tokio::test]
    async fn a_job_is_told_when_nobody_waits_for_it() {
        let workers = workers(1, 8);
        let (started, has_started) = oneshot::channel();
        let (stopped, has_stopped) = oneshot::channel();
        let call = tokio::spawn(async move {
            workers
                .run(move |abandoned| {
                    let _ = started.send(());
                    while abandoned.check().is_ok() {
                        std::thread::yield_now();
                    }
                    let _ = stopped.send(());
                    Ok(())
                })
                .await
        });
        has_started.await.unwrap();
        call.abort();
        has_stopped.await.unwrap();
    }

    #[tokio::test]
    async fn the_queue_is_bounded() {
        let workers = workers(1, 1);
        let (started, has_started) = oneshot::channel();
        let (release, wait) = std::sync::mpsc::channel::<()>();
        let busy = tokio::spawn({
            let workers = workers.clone();
            async move {
                workers
                    .run(move |_| {
                        let _ = started.send(());
                        let _ = wait.recv();
                        Ok(())
                    })
                    .await
            }
        });
        has_started.await.unwrap();
        let mut queued = Box::pin(workers.run(|_| Ok(())));
        assert!(futures::poll!(&mut queued).is_pending());
        let refused = workers.run(|_| Ok(())).await.unwrap_err();
        assert_eq!(refused.reason(), "LIMIT_EXCEEDED");
        // What nobody waits for gives its place up.
        drop(queued);
        let mut queued = Box::pin(workers.run(|_| Ok(())));
        assert!(futures::poll!(&mut queued).is_pending());
        // Parts of what was admitted are not counted.
        let mut part = Box::pin(workers.resume(|_| Ok(())));
        assert!(futures::poll!(&mut part).is_pending());
        release.send(()).unwrap();
        queued.await.unwrap();
        part.await.unwrap();
        busy.await.unwrap().unwrap();
    }

    #[tokio::test]
    async fn a_panic_in_a_job_is_an_internal_error() {
        let workers = workers(1, 1);
        let fault = workers.run::<()>(|_| panic!("a defect")).await.unwrap_err();
        assert_eq!(fault.reason(), "INTERNAL");
        workers.run(|_| Ok(())).await.unwrap();
    }

    /// Jobs that would never end let a short one through, and each other.
    #[tokio::test(flavor = "multi_thread")]
    async fn long_jobs_let_others_have_their_turn() {
        const JOBS: usize = 5;
        let workers = workers(2, 64);
        let stop = Arc::new(AtomicBool::new(false));
        let begun = Arc::new(AtomicUsize::new(0));
        let jobs: Vec<_> = (0..JOBS)
            .map(|_| {
                let (workers, stop, begun) =
                    (workers.clone(), Arc::clone(&stop), Arc::clone(&begun));
                tokio::spawn(async move {
                    let work = busy(stop);
                    let job = move |abandoned: &Abandoned| {
                        begun.fetch_add(1, Ordering::AcqRel);
                        work(abandoned)
                    };
                    workers.run(job).await
                })
            })
            .collect();
        while begun.load(Ordering::Acquire) < JOBS {
            tokio::task::yield_now().await;
        }
        for _ in 0..3 {
            workers.run(|_| Ok(())).await.unwrap();
        }
        assert_eq!(workers.pool.state().taken, 2, "no more at a time than turns");
        stop.store(true, Ordering::Release);
        for job in jobs {
            job.await.unwrap().unwrap();
        }
        assert_eq!(workers.pool.state().queue.len(), 0);
    }

    /// With more long jobs than threads, those that have begun keep on, and all end.
    #[tokio::test(flavor = "multi_thread")]
    async fn threads_are_bounded() {
        let workers = workers(1, 64);
        let stop = Arc::new(AtomicBool::new(false));
        let jobs: Vec<_> = (0..20)
            .map(|_| {
                let (workers, work) = (workers.clone(), busy(Arc::clone(&stop)));
                tokio::spawn(async move { workers.run(work).await })
            })
            .collect();
        while workers.pool.state().threads < THREADS_PER_TURN {
            tokio::task::yield_now().await;
        }
        tokio::time::sleep(3 * TURN).await;
        assert_eq!(workers.pool.state().threads, THREADS_PER_TURN);
        stop.store(true, Ordering::Release);
        for job in jobs {
            job.await.unwrap().unwrap();
        }
    }

    #[tokio::test]
    async fn threads_end_with_the_pool() {
        let workers = workers(2, 4);
        workers.run(|_| Ok(())).await.unwrap();
        let pool = Arc::clone(&workers.pool);
        drop(workers);
        while pool.state().threads > 0 {
            std::thread::yield_now();
        }
    }
}
