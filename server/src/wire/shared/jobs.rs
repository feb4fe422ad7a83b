//! Workers for calls: computations whose errors go to a client.

use crate::core::workers::pool::{Abandoned, Workers};
use crate::core::workers::queue::{Admission, Lane};
use crate::wire::status::RpcError;

/// A pool of workers, see [`crate::core::workers::pool`].
#[derive(Clone)]
pub struct Jobs {
    workers: Workers,
}

impl Jobs {
    /// Jobs that are done by these workers.
    pub fn new(workers: Workers) -> Self {
        Self { workers }
    }

    /// The workers.
    pub fn workers(&self) -> &Workers {
        &self.workers
    }

    /// Number of jobs that run at a time.
    pub fn count(&self) -> usize {
        self.workers.count()
    }

    /// Runs a job. Dropping the returned future tells the job to stop.
    pub async fn run<T: Send + 'static>(
        &self,
        job: impl FnOnce(&Abandoned) -> Result<T, RpcError> + Send + 'static,
    ) -> Result<T, RpcError> {
        self.workers.run(job).await
    }

    /// Runs the next part of a stream that was admitted, however long the queue is.
    pub async fn resume<T: Send + 'static>(
        &self,
        job: impl FnOnce(&Abandoned) -> Result<T, RpcError> + Send + 'static,
    ) -> Result<T, RpcError> {
        self.workers.resume(job).await
    }

    /// Runs a long job part by part, see [`Workers::in_parts`].
    pub(crate) async fn in_parts<T: Send + 'static>(
        &self,
        admission: Admission,
        part: impl FnMut(&Abandoned) -> Result<Option<T>, RpcError> + Send + 'static,
    ) -> Result<T, RpcError> {
        self.workers.in_parts(admission, part).await
    }

    /// Runs a job that waits in a lane.
    pub(crate) async fn start<T: Send + 'static>(
        &self,
        admission: Admission,
        lane: Lane,
        job: impl FnOnce(&Abandoned) -> Result<T, RpcError> + Send + 'static,
    ) -> Result<T, RpcError> {
        self.workers.start(admission, lane, job).await
    }
}
