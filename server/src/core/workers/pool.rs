//! A pool of workers: who has a turn, on which thread.

use std::cell::Cell;
use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};
use tokio::runtime::{Handle, RuntimeFlavor};
use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;

use crate::core::connection::{Caller, Connection};
use crate::core::limits::LimitExceeded;
use crate::core::mutex::lock;
use crate::core::priority::Priority;
use crate::core::tenant::{Tenant, Tenants};
use crate::core::workers::SPANS;
use crate::core::workers::queue::{Admission, Baton, Lane, May, Queue, Ticket, Work};

/// How long a job keeps its turn while others wait for one.
const TURN: Duration = Duration::from_millis(20);

/// After how long a turn that is not passed on is no longer counted for others; also how often whoever
/// waits looks for such turns.
const TURN_OVERDUE: Duration = Duration::from_millis(40);

/// Threads for each turn, at most: those that wait for their next turn included.
const THREADS_PER_TURN: usize = 32;

/// Threads for each turn of the jobs of one connection, and of one tenant, at most.
const CONNECTION_THREADS_PER_TURN: usize = 8;
const TENANT_THREADS_PER_TURN: usize = 16;

/// Runs a long computation, or a wait, on this thread, while the runtime that it may belong to moves its
/// other tasks to another one.
pub(crate) fn beside_other_tasks<R>(compute: impl FnOnce() -> R) -> R {
    match Handle::try_current().map(|runtime| runtime.runtime_flavor()) {
        Ok(RuntimeFlavor::MultiThread) => tokio::task::block_in_place(compute),
        _ => compute(),
    }
}

/// Processor time of this thread.
fn thread_ms() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 * 1e-6
}

/// Processor time of threads that work for a job besides its own.
#[derive(Debug, Default)]
pub struct Helpers(Mutex<f64>);

impl Helpers {
    /// Does some work of this thread, and counts it.
    pub fn count(&self, work: &mut dyn FnMut()) {
        let before = thread_ms();
        work();
        *lock(&self.0) += thread_ms() - before;
    }

    /// The milliseconds that were counted since the last time.
    pub fn take(&self) -> f64 {
        std::mem::take(&mut *lock(&self.0))
    }
}

/// Why a computation has no result.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WorkError {
    /// Nobody waits for the result any more.
    #[error("the caller has gone away")]
    Cancelled,
    /// Too many computations wait for a worker.
    #[error(transparent)]
    Limit(#[from] LimitExceeded),
    /// The computation has panicked.
    #[error("a computation broke off")]
    BrokeOff,
}

/// Told to jobs that nobody waits for; also where a job lets others have their turn.
pub struct Abandoned {
    token: CancellationToken,
    pool: Arc<Pool>,
    id: u64,
    turn_began: Cell<Instant>,
    helped_ms: Cell<f64>,
}

impl fmt::Debug for Abandoned {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Abandoned").field(&self.token.is_cancelled()).finish()
    }
}

impl Abandoned {
    /// Nobody waits for the result; a long job asks this every few milliseconds and ends early. May
    /// wait until other jobs have had their turn: ask it without holding a lock.
    pub fn check(&self) -> Result<(), WorkError> {
        self.check_caller()?;
        if self.turn_began.get().elapsed() >= TURN {
            self.pool.pass_on(self.id);
            self.turn_began.set(Instant::now());
        }
        Ok(())
    }

    /// For a job in parts: true when this part has taken its time and others wait, an error when nobody
    /// waits for the result. Waits for nothing.
    pub fn part_is_over(&self) -> Result<bool, WorkError> {
        self.check_caller()?;
        if self.turn_began.get().elapsed() < TURN {
            return Ok(false);
        }
        self.turn_began.set(Instant::now());
        Ok(self.pool.keep_turn(self.id))
    }

    /// Counts milliseconds for which threads of the job's own have worked for it.
    pub fn helped(&self, time_ms: f64) {
        self.helped_ms.update(|ms| ms + time_ms);
    }

    fn check_caller(&self) -> Result<(), WorkError> {
        if self.token.is_cancelled() { Err(WorkError::Cancelled) } else { Ok(()) }
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
    /// A pool in which `count` jobs run at a time, behind a queue of `queued_jobs`, for tenants whose time of
    /// workers is bounded.
    pub fn new(
        name: &'static str,
        count: usize,
        queued_jobs: u64,
        priority: Priority,
        tenants: Arc<Tenants>,
    ) -> Self {
        let pool = Arc::new(Pool {
            tenants,
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

    /// Jobs that wait for their first turn.
    pub fn waiting(&self) -> usize {
        lock(&self.pool.state).queue.waiting()
    }

    /// Runs a job. Dropping the returned future tells the job to stop.
    pub async fn run<T: Send + 'static, E: From<WorkError> + Send + 'static>(
        &self,
        job: impl FnOnce(&Abandoned) -> Result<T, E> + Send + 'static,
    ) -> Result<T, E> {
        self.start(Admission::Bounded, Lane::Short, job).await
    }

    /// Runs the next part of a stream that was admitted: waits however long the queue is. The limit
    /// on streams bounds the queue.
    pub async fn resume<T: Send + 'static, E: From<WorkError> + Send + 'static>(
        &self,
        job: impl FnOnce(&Abandoned) -> Result<T, E> + Send + 'static,
    ) -> Result<T, E> {
        self.start(Admission::Granted, Lane::Short, job).await
    }

    /// Runs a long job part by part: `part` returns nothing when there is more to do and
    /// [`Abandoned::part_is_over`]. Between two parts it keeps neither a turn nor a thread.
    pub(crate) async fn in_parts<T: Send + 'static, E: From<WorkError> + Send + 'static>(
        &self,
        admission: Admission,
        part: impl FnMut(&Abandoned) -> Result<Option<T>, E> + Send + 'static,
    ) -> Result<T, E> {
        let (mut admission, mut next) = (admission, part);
        loop {
            let mut part = next;
            let job = move |abandoned: &Abandoned| Ok::<_, E>((part(abandoned)?, part));
            let (outcome, rest) = self.start(admission, Lane::Long, job).await?;
            if let Some(outcome) = outcome {
                return Ok(outcome);
            }
            (admission, next) = (Admission::Granted, rest);
        }
    }

    /// Runs a job that waits in a lane.
    pub(crate) async fn start<T: Send + 'static, E: From<WorkError> + Send + 'static>(
        &self,
        admission: Admission,
        lane: Lane,
        job: impl FnOnce(&Abandoned) -> Result<T, E> + Send + 'static,
    ) -> Result<T, E> {
        let outcome = Arc::new(Mutex::new(None));
        let place = Arc::clone(&outcome);
        let job = Box::new(move |abandoned: &Abandoned| {
            let outcome = job(abandoned);
            *lock(&place) = Some(outcome);
        });
        self.do_job(admission, lane, job).await?;
        let outcome = lock(&outcome).take();
        outcome.unwrap_or_else(|| Err(WorkError::BrokeOff.into()))
    }

    /// [`start`](Self::start) for jobs of all results: what is in here is compiled once.
    async fn do_job(&self, admission: Admission, lane: Lane, job: Job) -> Result<(), WorkError> {
        let account = self.pool.tenants.current();
        if admission == Admission::Bounded {
            account.rates.worker_ms_per_s.check()?;
        }
        let token = CancellationToken::new();
        let (sender, mut receiver) = oneshot::channel();
        let work = {
            let (token, pool) = (token.clone(), Arc::clone(&self.pool));
            let caller = Caller::current();
            let span = tracing::trace_span!(target: SPANS, "job", workers = self.pool.name);
            Box::new(move |id| {
                let turn_began = Cell::new(Instant::now());
                // Nobody may wait any more.
                let abandoned =
                    Abandoned { token, pool, id, turn_began, helped_ms: Cell::new(0.0) };
                let meter = || thread_ms() + abandoned.helped_ms.get();
                account
                    .rates
                    .worker_ms_per_s
                    .spent_by(meter, || span.in_scope(|| caller.scope(|| job(&abandoned))));
                drop(span);
                let _ = sender.send(());
            })
        };
        let id = self.pool.submit(admission, lane, work)?;
        let mut waiting = Waiting { pool: &self.pool, id, token, waits: true };
        let is_done = loop {
            match tokio::time::timeout(TURN_OVERDUE, &mut receiver).await {
                Ok(is_done) => break is_done,
                Err(_) => self.pool.look_after(),
            }
        };
        waiting.waits = false;
        is_done.map_err(|_| {
            tracing::error!("a computation broke off");
            WorkError::BrokeOff
        })
    }
}

/// What a worker does for a caller, who finds the outcome where the job puts it.
type Job = Box<dyn FnOnce(&Abandoned) + Send>;

/// Whoever waits for a job.
struct Waiting<'a> {
    pool: &'a Pool,
    id: u64,
    token: CancellationToken,
    waits: bool,
}

impl Drop for Waiting<'_> {
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

struct Pool {
    tenants: Arc<Tenants>,
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
    queue: Queue,
    /// Jobs that have begun and not ended, by number.
    begun: BTreeMap<u64, Begun>,
    /// What has a turn, and waits for a thread.
    granted: VecDeque<(u64, Work)>,
    threads: usize,
    idle: usize,
    last_id: u64,
    last_look: Option<Instant>,
    is_ending: bool,
}

struct Begun {
    connection: Connection,
    /// Since when it has its turn; none while it waits for the next one.
    turn: Option<Instant>,
}

impl State {
    /// The next in the queue for whom there is a turn.
    fn next(&mut self, pool: &Pool) -> Option<(Connection, Ticket)> {
        let Self { queue, begun, granted, threads, idle, .. } = self;
        let has_thread = *idle > granted.len() || *threads < THREADS_PER_TURN * pool.count;
        let now = Instant::now();
        queue.pop(|connection| {
            let is_counted = |job: &&Begun| {
                let is_new = |since: Instant| now.duration_since(since) < TURN_OVERDUE;
                job.turn.is_some_and(|since| job.connection == connection || is_new(since))
            };
            if begun.values().filter(is_counted).count() >= pool.count {
                return May::Nothing;
            }
            let held = begun.values().filter(|job| job.connection == connection).count();
            let of_tenant = |job: &&Begun| job.connection.tenant() == connection.tenant();
            let tenant_has_thread = connection.tenant() == Tenant::NONE
                || begun.values().filter(of_tenant).count() < TENANT_THREADS_PER_TURN * pool.count;
            let may_begin =
                has_thread && tenant_has_thread && held < CONNECTION_THREADS_PER_TURN * pool.count;
            if may_begin { May::Begin } else { May::GoOn }
        })
    }

    fn set_turn(&mut self, id: u64, turn: Option<Instant>) {
        if let Some(job) = self.begun.get_mut(&id) {
            job.turn = turn;
        }
    }
}

impl Pool {
    fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Queues work, or begins it at once; returns its number. However long the queue is, each connection may have
    /// one job in it.
    fn submit(
        self: &Arc<Self>,
        admission: Admission,
        lane: Lane,
        work: Work,
    ) -> Result<u64, LimitExceeded> {
        let connection = Connection::current();
        let mut state = self.state();
        state.last_id += 1;
        let id = state.last_id;
        state.queue.push(lane, connection, Ticket::Begin { id, admission, work });
        self.hand_out(&mut state);
        if admission == Admission::Bounded && state.queue.holds(id) {
            let (of_connection, of_all) = state.queue.counted(connection);
            let (name, what) = ("queued_jobs", "jobs wait for a worker");
            let is_within = LimitExceeded::check(name, self.queued_jobs, what, of_all);
            if let Err(error) = is_within
                && of_connection > 1
            {
                let refused = state.queue.remove(id);
                drop(state);
                drop(refused);
                return Err(error);
            }
        }
        Ok(id)
    }

    /// Takes work that has not begun out of the queue.
    fn withdraw(&self, id: u64) {
        let ticket = self.state().queue.remove(id);
        // What the job holds is dropped without the lock.
        drop(ticket);
    }

    /// Hands turns out as long as there are some for those who wait.
    fn hand_out(self: &Arc<Self>, state: &mut State) {
        while let Some((connection, ticket)) = state.next(self) {
            self.give_turn(state, connection, ticket);
        }
    }

    fn give_turn(self: &Arc<Self>, state: &mut State, connection: Connection, ticket: Ticket) {
        let turn = Some(Instant::now());
        match ticket {
            Ticket::GoOn { id, baton } => {
                state.set_turn(id, turn);
                baton.pass();
            }
            Ticket::Begin { id, work, .. } => {
                state.begun.insert(id, Begun { connection, turn });
                state.granted.push_back((id, work));
                self.find_thread(state);
            }
        }
    }

    /// Finds a thread for the work that was granted last.
    fn find_thread(self: &Arc<Self>, state: &mut State) {
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

    /// Somebody waits: turns that are overdue may make room for it. Asked by many, done now and then.
    fn look_after(self: &Arc<Self>) {
        let mut state = self.state();
        let now = Instant::now();
        if state.last_look.is_none_or(|last| now.duration_since(last) >= TURN) {
            state.last_look = Some(now);
            self.hand_out(&mut state);
        }
    }

    /// Lets the next in the queue compute, and waits for another turn. Returns at once when there is
    /// nobody, or no thread, to go on instead.
    fn pass_on(self: &Arc<Self>, id: u64) {
        let mut state = self.state();
        state.set_turn(id, None);
        let Some((connection, ticket)) = state.next(self) else {
            state.set_turn(id, Some(Instant::now()));
            return;
        };
        let baton = Arc::new(Baton::default());
        let own = Ticket::GoOn { id, baton: Arc::clone(&baton) };
        let own_connection = state.begun.get(&id).map(|job| job.connection).unwrap_or_default();
        state.queue.push(Lane::Long, own_connection, own);
        self.give_turn(&mut state, connection, ticket);
        self.hand_out(&mut state);
        drop(state);
        baton.wait();
    }

    /// True when somebody waits for a turn; else a job in parts begins another part.
    fn keep_turn(&self, id: u64) -> bool {
        let mut state = self.state();
        let waits = !state.queue.is_empty();
        if !waits {
            state.set_turn(id, Some(Instant::now()));
        }
        waits
    }

    /// What a thread does.
    fn serve(self: Arc<Self>) {
        self.priority.apply(self.name);
        while let Some((id, work)) = self.next_work() {
            // The sender of a result that a panic has dropped tells the caller.
            let _ = catch_unwind(AssertUnwindSafe(|| work(id)));
            let mut state = self.state();
            state.begun.remove(&id);
            self.hand_out(&mut state);
        }
        self.state().threads -= 1;
    }

    /// Work that has a turn; none when the thread is not needed any more.
    fn next_work(&self) -> Option<(u64, Work)> {
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

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

    use super::*;

    fn workers(count: usize, queued_jobs: u64) -> Workers {
        Workers::new("test", count, queued_jobs, Priority::Idle, Arc::default())
    }

    /// Computes until `stop` is set, asking whether somebody waits.
    fn busy(stop: Arc<AtomicBool>) -> impl FnOnce(&Abandoned) -> Result<(), WorkError> {
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
                    Ok::<_, WorkError>(())
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
                        Ok::<_, WorkError>(())
                    })
                    .await
            }
        });
        has_started.await.unwrap();
        let mut queued = Box::pin(workers.run(|_| Ok::<_, WorkError>(())));
        assert!(futures::poll!(&mut queued).is_pending());
        let refused = workers.run(|_| Ok::<_, WorkError>(())).await.unwrap_err();
        assert!(matches!(refused, WorkError::Limit(_)));
        // What nobody waits for gives its place up.
        drop(queued);
        let mut queued = Box::pin(workers.run(|_| Ok::<_, WorkError>(())));
        assert!(futures::poll!(&mut queued).is_pending());
        // Parts of what was admitted are not counted.
        let mut part = Box::pin(workers.resume(|_| Ok::<_, WorkError>(())));
        assert!(futures::poll!(&mut part).is_pending());
        release.send(()).unwrap();
        queued.await.unwrap();
        part.await.unwrap();
        busy.await.unwrap().unwrap();
    }

    #[tokio::test]
    async fn a_panic_in_a_job_is_an_internal_error() {
        let workers = workers(1, 1);
        let fault = workers.run::<(), WorkError>(|_| panic!("a defect")).await.unwrap_err();
        assert_eq!(fault, WorkError::BrokeOff);
        workers.run(|_| Ok::<_, WorkError>(())).await.unwrap();
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
            workers.run(|_| Ok::<_, WorkError>(())).await.unwrap();
        }
        let running = |state: &State| state.begun.values().filter(|job| job.turn.is_some()).count();
        assert!(running(&workers.pool.state()) <= 2, "no more at a time than turns");
        stop.store(true, Ordering::Release);
        for job in jobs {
            job.await.unwrap().unwrap();
        }
        assert!(workers.pool.state().queue.is_empty());
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
        while workers.pool.state().threads < CONNECTION_THREADS_PER_TURN {
            tokio::task::yield_now().await;
        }
        tokio::time::sleep(3 * TURN).await;
        assert_eq!(workers.pool.state().threads, CONNECTION_THREADS_PER_TURN);
        stop.store(true, Ordering::Release);
        for job in jobs {
            job.await.unwrap().unwrap();
        }
    }

    #[tokio::test]
    async fn threads_end_with_the_pool() {
        let workers = workers(2, 4);
        workers.run(|_| Ok::<_, WorkError>(())).await.unwrap();
        let pool = Arc::clone(&workers.pool);
        drop(workers);
        while pool.state().threads > 0 {
            std::thread::yield_now();
        }
    }
}
