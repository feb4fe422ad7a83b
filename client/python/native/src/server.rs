//! The server, and calls of one message each way.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::pin::pin;
use std::str::FromStr as _;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use plantd_server::config::{Config, Listen};
use plantd_server::core::priority::Priority;
use plantd_server::serve::{RunningServer, Services};
use plantd_server::wire::shared::hub::Hub;
use pyo3::exceptions::{PyException, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use tokio::runtime::Runtime;
use tonic::client::Grpc;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::{Request, Status};

use crate::call::Call;
use crate::codec::AsBytes;
use crate::lease::Lease;

/// How often a call that waits looks whether Python was interrupted.
const SIGNAL_PERIOD: Duration = Duration::from_millis(50);
/// What computations that nobody waits for any more are given to end.
const LEFTOVERS_MAX: Duration = Duration::from_secs(1);

pyo3::create_exception!(
    plantd,
    Refused,
    PyException,
    "A call that was refused: number of the code, message, details, and whether the plant's driver goes on."
);

/// The exception of a status.
pub(crate) fn refused(status: &Status, goes_on: bool) -> PyErr {
    let (code, message) = (i32::from(status.code()), status.message().to_owned());
    Refused::new_err((code, message, status.details().to_vec(), goes_on))
}

/// A server that only this process can reach.
#[pyclass(frozen, module = "plantd._native")]
pub(crate) struct Server {
    inner: Arc<Inner>,
}

#[pymethods]
impl Server {
    /// Starts it, with limits by name, and with the folder of recordings if there is to be one.
    #[new]
    #[pyo3(signature = (limits, recordings=None))]
    fn new(
        py: Python<'_>,
        limits: BTreeMap<String, u64>,
        recordings: Option<PathBuf>,
    ) -> PyResult<Self> {
        let mut config = Config {
            grpc: Listen::Off,
            metrics: Listen::Off,
            recordings,
            // The process does nothing else, as far as is known here.
            worker_priority: Priority::Normal,
            ..Config::default()
        };
        config.link.enabled = false;
        for (name, value) in &limits {
            let wrong = |error| PyValueError::new_err(format!("`limits`: {error}"));
            config.limits.set(name, *value).map_err(wrong)?;
        }
        let start = || {
            let threads = config.thread_count();
            let mut builder = tokio::runtime::Builder::new_multi_thread();
            let runtime = builder.worker_threads(threads).enable_all().build()?;
            let server = runtime.block_on(RunningServer::start(config))?;
            Ok((runtime, server))
        };
        let started: Result<_, Box<dyn std::error::Error + Send + Sync>> = py.detach(start);
        let unavailable = |error: Box<dyn std::error::Error + Send + Sync>| {
            refused(&Status::unavailable(format!("the server has not started: {error}")), false)
        };
        let (runtime, server) = started.map_err(unavailable)?;
        let inner = Inner {
            services: server.services(),
            hub: Arc::clone(server.hub()),
            server: Mutex::new(Some(server)),
            has_ended: AtomicBool::new(false),
            owner: std::process::id(),
            runtime: Some(runtime),
        };
        Ok(Self { inner: Arc::new(inner) })
    }

    /// Makes a call of one message each way.
    #[pyo3(signature = (path, request, timeout_s=None))]
    fn unary<'py>(
        &self,
        py: Python<'py>,
        path: &str,
        request: &[u8],
        timeout_s: Option<f64>,
    ) -> PyResult<Bound<'py, PyBytes>> {
        let inner = &self.inner;
        inner.check()?;
        let (path, request) = (parse(path)?, Bytes::copy_from_slice(request));
        let mut grpc = inner.grpc();
        let call = async move {
            let call = async {
                let Ok(()) = grpc.ready().await;
                grpc.unary(Request::new(request), path, AsBytes).await
            };
            match timeout_s.and_then(|s| Duration::try_from_secs_f64(s).ok()) {
                Some(limit) => tokio::time::timeout(limit, call).await.unwrap_or_else(|_| {
                    Err(Status::deadline_exceeded("no answer within the client's `timeout`"))
                }),
                None => call.await,
            }
        };
        let answer = inner.wait(py, call)?.map_err(|status| refused(&status, false))?;
        Ok(PyBytes::new(py, answer.get_ref()))
    }

    /// Begins a call with a stream of answers; of requests, too, unless there is but one.
    #[pyo3(signature = (path, request=None))]
    fn stream(&self, py: Python<'_>, path: &str, request: Option<&[u8]>) -> PyResult<Call> {
        self.inner.check()?;
        let request = request.map(Bytes::copy_from_slice);
        Call::begin(py, Arc::clone(&self.inner), parse(path)?, request)
    }

    /// Takes the lease of a plant that is stepped in lockstep.
    fn lease(&self, py: Python<'_>, id: &str) -> PyResult<Lease> {
        self.inner.check()?;
        Lease::take(py, Arc::clone(&self.inner), id)
    }

    /// Ends it.
    fn stop(&self, py: Python<'_>) {
        py.detach(|| self.inner.stop());
    }
}

fn parse(path: &str) -> PyResult<PathAndQuery> {
    PathAndQuery::from_str(path).map_err(|error| PyValueError::new_err(format!("{path}: {error}")))
}

/// What calls and leases share with the server.
pub(crate) struct Inner {
    services: Services,
    hub: Arc<Hub>,
    server: Mutex<Option<RunningServer>>,
    has_ended: AtomicBool,
    /// The process whose threads these are.
    owner: u32,
    /// None only while it is dropped.
    runtime: Option<Runtime>,
}

impl Inner {
    /// Refuses calls after the end, and of a process that was forked off.
    pub(crate) fn check(&self) -> PyResult<()> {
        if self.owner != std::process::id() {
            let why = "the server of `plantd.local` belongs to the process that this one was forked off: \
                       start one here";
            return Err(refused(&Status::unavailable(why), false));
        }
        if self.has_ended.load(Ordering::Acquire) {
            return Err(refused(&Status::cancelled("the client is closed"), false));
        }
        Ok(())
    }

    /// What the services share.
    pub(crate) fn hub(&self) -> &Hub {
        &self.hub
    }

    /// A client of the services.
    pub(crate) fn grpc(&self) -> Grpc<Services> {
        // Answers hold no more than was asked for, and are in this process already.
        Grpc::new(self.services.clone())
            .max_decoding_message_size(usize::MAX)
            .max_encoding_message_size(usize::MAX)
    }

    /// Runs `work` as a part of the runtime.
    pub(crate) fn inside<R>(&self, work: impl FnOnce() -> R) -> R {
        let _inside = self.runtime().enter();
        work()
    }

    fn runtime(&self) -> &Runtime {
        self.runtime.as_ref().expect("it is taken by `drop` alone")
    }

    /// Waits for a future, without Python's lock; Ctrl-C ends the wait.
    pub(crate) fn wait<F>(&self, py: Python<'_>, future: F) -> PyResult<F::Output>
    where
        F: Future + Send,
        F::Output: Send,
    {
        let mut future = pin!(future);
        loop {
            let part = || {
                let some = async { tokio::time::timeout(SIGNAL_PERIOD, future.as_mut()).await };
                self.runtime().block_on(some)
            };
            match py.detach(part) {
                Ok(output) => return Ok(output),
                Err(_) => py.check_signals()?,
            }
        }
    }

    fn stop(&self) {
        self.has_ended.store(true, Ordering::Release);
        if self.owner != std::process::id() {
            return;
        }
        let server = self.server.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(server) = server {
            self.runtime().block_on(server.stop());
        }
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        let Some(runtime) = self.runtime.take() else { return };
        if self.owner == std::process::id() {
            runtime.shutdown_timeout(LEFTOVERS_MAX);
        } else {
            // Its threads are in the other process; nobody can wait for them.
            std::mem::forget(runtime);
        }
    }
}
