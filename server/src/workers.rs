//! Workers for everything that computes longer than a step: as many as cores, behind a bounded
//! queue, and told to stop when nobody waits for the result any more.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

use crate::limits::LimitExceeded;
use crate::status::Fault;

/// Told to jobs that nobody waits for.
#[derive(Clone, Debug)]
pub struct Abandoned(CancellationToken);

impl Abandoned {
    /// Nobody waits for the result; a long job asks this now and then and ends early.
    pub fn check(&self) -> Result<(), Fault> {
        if self.0.is_cancelled() {
            return Err(Fault::new(
                tonic::Code::Cancelled,
                "CANCELLED",
                "the caller has gone away",
            ));
        }
        Ok(())
    }
}

/// The pool.
#[derive(Clone)]
pub struct Workers {
    permits: Arc<Semaphore>,
    waiting: Arc<AtomicUsize>,
    queued_jobs: u64,
    count: usize,
}

impl Workers {
    /// A pool of `count` workers behind a queue of `queued_jobs`.
    pub fn new(count: usize, queued_jobs: u64) -> Self {
        Self {
            permits: Arc::new(Semaphore::new(count)),
            waiting: Arc::new(AtomicUsize::new(0)),
            queued_jobs,
            count,
        }
    }

    /// Number of workers.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Runs a job. Dropping the returned future tells the job to stop.
    pub async fn run<T: Send + 'static>(
        &self,
        job: impl FnOnce(&Abandoned) -> Result<T, Fault> + Send + 'static,
    ) -> Result<T, Fault> {
        let place = Place::take(&self.waiting);
        let (name, what) = ("queued_jobs", "jobs wait for a worker");
        // The workers themselves are no queue: as many jobs as workers never wait.
        let waiting = place.position.saturating_sub(self.permits.available_permits());
        LimitExceeded::check(name, self.queued_jobs, what, waiting)?;
        self.start(Some(place), job).await
    }

    /// Runs the next part of a stream that was admitted: waits however long the queue is. The limit
    /// on streams bounds the queue.
    pub async fn resume<T: Send + 'static>(
        &self,
        job: impl FnOnce(&Abandoned) -> Result<T, Fault> + Send + 'static,
    ) -> Result<T, Fault> {
        self.start(None, job).await
    }

    async fn start<T: Send + 'static>(
        &self,
        place: Option<Place<'_>>,
        job: impl FnOnce(&Abandoned) -> Result<T, Fault> + Send + 'static,
    ) -> Result<T, Fault> {
        let permit = Arc::clone(&self.permits).acquire_owned().await;
        let permit = permit.map_err(|_| Fault::shutting_down())?;
        drop(place);
        let token = CancellationToken::new();
        let abandoned = Abandoned(token.clone());
        let _stop_when_dropped = token.drop_guard();
        tokio::task::spawn_blocking(move || {
            // The permit belongs to the job, not to the caller: an abandoned job still computes.
            let _permit = permit;
            job(&abandoned)
        })
        .await
        .unwrap_or_else(|error| {
            tracing::error!(%error, "a computation broke off");
            Err(Fault::internal("a computation broke off"))
        })
    }
}

/// A place in the queue.
struct Place<'a> {
    waiting: &'a AtomicUsize,
    position: usize,
}

impl<'a> Place<'a> {
    fn take(waiting: &'a AtomicUsize) -> Self {
        let position = waiting.fetch_add(1, Ordering::AcqRel) + 1;
        Self { waiting, position }
    }
}

impl Drop for Place<'_> {
    fn drop(&mut self) {
        self.waiting.fetch_sub(1, Ordering::AcqRel);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_job_is_told_when_nobody_waits_for_it() {
        let workers = Workers::new(1, 8);
        let (started, has_started) = tokio::sync::oneshot::channel();
        let (stopped, has_stopped) = tokio::sync::oneshot::channel();
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
        let workers = Workers::new(1, 1);
        let (started, has_started) = tokio::sync::oneshot::channel();
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
        release.send(()).unwrap();
        queued.await.unwrap();
        busy.await.unwrap().unwrap();
    }

    #[tokio::test]
    async fn a_panic_in_a_job_is_an_internal_error() {
        let workers = Workers::new(1, 1);
        let fault = workers.run::<()>(|_| panic!("a defect")).await.unwrap_err();
        assert_eq!(fault.reason(), "INTERNAL");
        workers.run(|_| Ok(())).await.unwrap();
    }
}
