//! A plant's driver in lockstep, without messages: arrays in, arrays out.

use std::sync::{Arc, Mutex, PoisonError};

use numpy::{PyArray1, PyReadonlyArray1};
use plantd_server::core::driver::DriverKind;
use plantd_server::core::plant::error::DriveError;
use plantd_server::core::publish::frame::Frame;
use plantd_server::core::session::lease;
use plantd_server::wire::status::RpcError;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::sync::MutexExt as _;
use tonic::Status;

use crate::server::{Inner, refused};

/// The right to move a plant, until it is closed.
#[pyclass(frozen, module = "plantd._native")]
pub(crate) struct Lease {
    inner: Arc<Inner>,
    held: Mutex<Option<Held>>,
}

struct Held {
    lease: lease::Lease,
    /// The last step, in memory that is used again.
    frame: Frame,
    has_applied: bool,
}

/// Step, time, q, p, v, multipliers, velocity.
type State<'py> = (u64, f64, [Bound<'py, PyArray1<f64>>; 5]);

/// Iterations, factorizations, residual, that of constraints, reciprocal condition, that of constraints, redundant
/// constraints, steps, halvings.
type Report = (u32, u32, f64, f64, f64, f64, u32, u32, u32);

/// A state; the report; the input if somebody besides the driver had a say in it; what the output channels deliver,
/// and for each of them 1 where it stands for a lost number.
type Step<'py> =
    (State<'py>, Report, Option<Bound<'py, PyArray1<f64>>>, Option<[Bound<'py, PyArray1<f64>>; 2]>);

impl Lease {
    pub(crate) fn take(py: Python<'_>, inner: Arc<Inner>, id: &str) -> PyResult<Self> {
        let taken = py.detach(|| {
            inner.inside(|| {
                let session = inner.hub().session(id)?;
                Ok(session.acquire(DriverKind::Drive)?)
            })
        });
        let lease = taken.map_err(|error: RpcError| refused(&Status::from(error), false))?;
        let held = Held { lease, frame: Frame::default(), has_applied: false };
        Ok(Self { inner, held: Mutex::new(Some(held)) })
    }
}

#[pymethods]
impl Lease {
    /// Takes a step; None where the plant is paused, slowed or runs by itself, so that there is something to wait for.
    fn step<'py>(
        &self,
        py: Python<'py>,
        u: PyReadonlyArray1<'py, f64>,
    ) -> PyResult<Option<Step<'py>>> {
        self.inner.check()?;
        let u = u.as_slice().map_err(|_| PyValueError::new_err("`u` is not contiguous"))?;
        let mut held = self.held.lock_py_attached(py).unwrap_or_else(PoisonError::into_inner);
        let Some(held) = &mut *held else {
            return Err(refused(&Status::cancelled("the driver is closed"), false));
        };
        let Held { lease, frame, has_applied } = held;
        let taken = py.detach(|| {
            lease.step_and(u, None, |core| {
                core.write_frame(frame);
                *has_applied = core.applied_input().is_some();
            })
        });
        match taken {
            Ok(()) => {}
            Err(DriveError::Paused | DriveError::NotDue(_) | DriveError::Running) => {
                return Ok(None);
            }
            Err(error) => {
                let goes_on = matches!(error, DriveError::Step(_) | DriveError::Frozen(_));
                let status = Status::from(RpcError::from_drive(error, lease.session()));
                return Err(refused(&status, goes_on));
            }
        }
        let array = |numbers: &[f64]| PyArray1::from_slice(py, numbers);
        let (state, report) = (&frame.state, &frame.report);
        let parts = [&state.q, &state.p, &state.v, &state.multipliers, &frame.velocity];
        let step = (state.step, frame.time_s, parts.map(|part| array(part)));
        let report = (
            report.iterations,
            report.factorizations,
            report.residual,
            report.constraint_residual,
            report.reciprocal_condition,
            report.constraint_reciprocal_condition,
            report.redundant_constraints,
            report.steps,
            report.halvings,
        );
        let applied = has_applied.then(|| array(&frame.input));
        let has_outputs = !frame.lost.is_empty();
        let outputs = has_outputs.then(|| [&frame.outputs, &frame.lost].map(|part| array(part)));
        Ok(Some((step, report, applied, outputs)))
    }

    /// Gives it up.
    fn close(&self, py: Python<'_>) {
        py.detach(|| self.give_up());
    }
}

impl Lease {
    fn give_up(&self) {
        let held = self.held.lock().unwrap_or_else(PoisonError::into_inner).take();
        self.inner.inside(|| drop(held));
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        self.give_up();
    }
}
