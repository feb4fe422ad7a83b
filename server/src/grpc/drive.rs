//! The stream of `PlantService.Drive`: lockstep, one answer per input.
//!
//! The step runs in the task that reads the request and writes the answer, without a queue or a
//! thread in between: that is what keeps the round trip short.

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use futures::Stream;
use plantd_models::Linearization;
use plantd_proto::v1;
use tokio::runtime::{Handle, RuntimeFlavor};
use tokio_util::sync::WaitForCancellationFutureOwned;
use tonic::{Code, Status, Streaming};
use v1::drive_request::Request as Message;
use v1::drive_response::Response as Answer;

use super::observe::with_limit_details;
use super::plant::plant_info;
use crate::convert;
use crate::hub::Hub;
use crate::limits::LimitExceeded;
use crate::session::{DriveError, DriverKind, Lease};
use crate::status::Fault;

/// Answers in a row after which the stream lets others on its thread run.
const BURST_MAX: u32 = 32;
/// Work of a control period above which it may take milliseconds, and runs beside the other tasks of its
/// thread.
const INLINE_WORK_MAX: usize = 64;

/// The answers of one Drive stream.
pub struct DriveStream {
    hub: Arc<Hub>,
    requests: Streaming<v1::DriveRequest>,
    ending: Pin<Box<WaitForCancellationFutureOwned>>,
    phase: Phase,
    burst: u32,
}

enum Phase {
    /// Waits for `open`.
    Opening,
    /// Holds the lease.
    Driving(Box<Driving>),
    /// Has ended; the lease is given up.
    Ended,
}

struct Driving {
    lease: Lease,
    deleted: Pin<Box<WaitForCancellationFutureOwned>>,
    linearization: Option<Linearization>,
    /// A step takes so little time that nobody minds waiting for it.
    is_short: bool,
}

impl DriveStream {
    /// A stream that waits for its first message.
    pub fn new(hub: Arc<Hub>, requests: Streaming<v1::DriveRequest>) -> Self {
        let ending = Box::pin(hub.ending.clone().cancelled_owned());
        Self { hub, requests, ending, phase: Phase::Opening, burst: 0 }
    }

    fn answer(&mut self, request: v1::DriveRequest) -> Result<v1::DriveResponse, Fault> {
        let response = match (&mut self.phase, request.request) {
            (Phase::Opening, Some(Message::Open(open))) => {
                let driving = Driving::open(&self.hub, &open)?;
                let plant = Some(plant_info(driving.lease.session()));
                self.phase = Phase::Driving(Box::new(driving));
                Answer::Opened(v1::DriveOpened { plant })
            }
            (Phase::Driving(driving), Some(Message::Input(input))) => driving.step(input)?,
            (Phase::Opening, _) => return Err(protocol("the first message must be `open`")),
            (_, Some(Message::Open(_))) => return Err(protocol("the stream is open already")),
            (_, _) => return Err(protocol("the message is empty")),
        };
        Ok(v1::DriveResponse { response: Some(response) })
    }

    /// The reason to end the stream while it waits for the client.
    fn poll_end(&mut self, context: &mut Context<'_>) -> Poll<Fault> {
        if self.ending.as_mut().poll(context).is_ready() {
            return Poll::Ready(Fault::shutting_down());
        }
        if let Phase::Driving(driving) = &mut self.phase
            && driving.deleted.as_mut().poll(context).is_ready()
        {
            return Poll::Ready(Fault::plant_deleted(driving.lease.session().id()));
        }
        Poll::Pending
    }
}

/// Runs a long computation on this thread, while the runtime moves its other tasks to another one.
fn beside_other_tasks<R>(compute: impl FnOnce() -> R) -> R {
    match Handle::current().runtime_flavor() {
        RuntimeFlavor::MultiThread => tokio::task::block_in_place(compute),
        _ => compute(),
    }
}

fn protocol(message: &str) -> Fault {
    Fault::new(Code::InvalidArgument, "PROTOCOL", message)
}

impl Driving {
    fn open(hub: &Hub, open: &v1::DriveOpen) -> Result<Self, Fault> {
        let session = hub.session(&open.id)?;
        let dimensions = session.model().dimensions();
        if open.linearization {
            let numbers = convert::linearization_numbers(dimensions);
            let (name, limit) = ("reply_numbers", hub.limits.reply_numbers);
            LimitExceeded::check(name, limit, "numbers in a linearization", numbers)?;
        }
        let lease = session.acquire(DriverKind::Drive)?;
        let linearization = open.linearization.then(|| Linearization::new(session.model()));
        let work = convert::period_work(&session.mechanics().settings, dimensions);
        let is_short = work <= INLINE_WORK_MAX;
        Ok(Self { deleted: Box::pin(session.closed()), lease, linearization, is_short })
    }

    /// A step; its own failures are answers, those of the stream are errors.
    fn step(&mut self, input: v1::DriveInput) -> Result<Answer, Fault> {
        let v1::DriveInput { sequence, u } = input;
        let (lease, linearization) = (&mut self.lease, &mut self.linearization);
        let is_short = self.is_short;
        let mut advance = || {
            lease.step_and(&u, linearization.as_mut(), |core| v1::DriveStep {
                sequence,
                state: Some(convert::plant_state(core.plant())),
                report: Some(convert::report(core.report())),
                linearization: None,
                u: core.applied_input().map(<[f64]>::to_vec).unwrap_or_default(),
                outputs: core.outputs(),
            })
        };
        let outcome = if is_short { advance() } else { beside_other_tasks(advance) };
        let mut step = match outcome {
            Ok(step) => step,
            Err(DriveError::Step(error)) => {
                let failure = Some(Fault::from(error).into());
                return Ok(Answer::Failure(v1::DriveFailure { sequence, failure }));
            }
            Err(error) => return Err(Fault::from_drive(error, self.lease.session().id())),
        };
        if let Some(linearization) = &self.linearization {
            let from = step.state.as_ref().map_or(0, |state| state.step - 1);
            step.linearization = Some(convert::linearization(from, linearization));
        }
        Ok(Answer::Step(step))
    }
}

impl Stream for DriveStream {
    type Item = Result<v1::DriveResponse, Status>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let this = &mut *self;
        if matches!(this.phase, Phase::Ended) {
            return Poll::Ready(None);
        }
        if this.burst >= BURST_MAX {
            this.burst = 0;
            // A client that sends faster than the plant steps must not keep the thread, nor miss
            // that the stream shall end.
            if let Poll::Ready(fault) = this.poll_end(context) {
                this.phase = Phase::Ended;
                return Poll::Ready(Some(Err(fault.into())));
            }
            context.waker().wake_by_ref();
            return Poll::Pending;
        }
        let item = match Pin::new(&mut this.requests).poll_next(context) {
            Poll::Pending => {
                this.burst = 0;
                let Poll::Ready(fault) = this.poll_end(context) else { return Poll::Pending };
                Some(Err(fault.into()))
            }
            Poll::Ready(None) => None,
            Poll::Ready(Some(Err(status))) => {
                Some(Err(with_limit_details(status, &this.hub.limits)))
            }
            Poll::Ready(Some(Ok(request))) => {
                this.burst += 1;
                Some(this.answer(request).map_err(Status::from))
            }
        };
        if !matches!(item, Some(Ok(_))) {
            this.phase = Phase::Ended;
        }
        Poll::Ready(item)
    }
}
