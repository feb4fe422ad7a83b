//! The stream of `PlantService.Drive`.
//!
//! In lockstep there is one answer per input. The step runs in the task that reads the request and
//! writes the answer, without a queue or a thread in between: that is what keeps the round trip short.
//! Only steps that take milliseconds are taken by a worker, so that others are not kept waiting.
//! While the plant runs by itself, inputs go into its slot and states come from its watchers' slots.

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use futures::{Stream, StreamExt as _};
use plantd_models::Linearization;
use plantd_proto::link::{monotonic_ns, random_instance};
use plantd_proto::v1;
use tokio::runtime::Handle;
use tokio::time::Sleep;
use tokio_stream::wrappers::WatchStream;
use tokio_util::sync::WaitForCancellationFutureOwned;
use tonic::{Code, Status, Streaming};
use v1::drive_request::Request as Message;
use v1::drive_response::Response as Answer;

use crate::core::driver::DriverKind;
use crate::core::limits::LimitExceeded;
use crate::core::plant::core::Core;
use crate::core::plant::error::DriveError;
use crate::core::publish::subscription::Subscription;
use crate::core::session::lease::Lease;
use crate::core::session::run::RunStatus;
use crate::core::workers::queue::{Admission, Lane};
use crate::wire::edge::observe::with_limit_details;
use crate::wire::message::plant_info::INLINE_INSTRUCTIONS_MAX;
use crate::wire::message::report::report_message;
use crate::wire::message::{settings, states};
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// Answers in a row after which the stream lets others on its thread run.
const BURST_MAX: u32 = 32;
/// How long a step may take for the next one to be taken in the task itself.
const INLINE_STEP_MAX: Duration = Duration::from_millis(2);
/// Longest time for which a lease is kept, s.
const GRACE_MAX_S: f64 = 3600.0;

/// The answers of one Drive stream.
pub struct DriveStream {
    hub: Arc<Hub>,
    requests: Streaming<v1::DriveRequest>,
    ending: Pin<Box<WaitForCancellationFutureOwned>>,
    phase: Phase,
    burst: u32,
}

/// What a worker does for a stream, because it may have to wait for a step.
type Job<T> = Pin<Box<dyn Future<Output = Result<T, RpcError>> + Send>>;

/// The answer to an input, if there is one by now.
type Outcome = Result<Option<Answer>, RpcError>;

enum Phase {
    /// Waits for `open`.
    Waiting,
    /// Takes the lease.
    Opening(Job<(Box<Driving>, v1::DriveOpened)>),
    /// Holds the lease.
    Driving(Box<Driving>),
    /// A worker takes a step, with the lease, which is to be kept when the connection breaks or is not.
    Stepping { step: Job<(Box<Driving>, Outcome)>, is_kept: bool },
    /// Has ended; the lease is given up.
    Ended,
}

struct Driving {
    lease: Lease,
    deleted: Pin<Box<WaitForCancellationFutureOwned>>,
    linearization: Option<Linearization>,
    /// Under which name the lease is kept when the connection breaks, and for how long.
    keep: Option<(String, Duration)>,
    /// The next step may take long, as the last one did; before the first one it is estimated.
    is_slow: bool,
    /// Changes of how the plant is run.
    status: WatchStream<RunStatus>,
    /// An input that waits for its step in lockstep: the plant is paused, or slowed.
    held: Option<Held>,
    states: States,
}

/// The states of the plant while it runs by itself.
enum States {
    None,
    Opening(Job<Subscription>),
    Open(Box<Subscription>),
}

struct Held {
    input: v1::DriveInput,
    /// When the step is due.
    until: Option<Pin<Box<Sleep>>>,
    /// Worth another try.
    is_ready: bool,
}

impl DriveStream {
    /// A stream that waits for its first message.
    pub fn new(hub: Arc<Hub>, requests: Streaming<v1::DriveRequest>) -> Self {
        let ending = Box::pin(hub.ending.clone().cancelled_owned());
        Self { hub, requests, ending, phase: Phase::Waiting, burst: 0 }
    }

    fn answer(&mut self, request: v1::DriveRequest) -> Result<Option<v1::DriveResponse>, RpcError> {
        let response = match (&mut self.phase, request.request) {
            (Phase::Waiting, Some(Message::Open(open))) => {
                let hub = Arc::clone(&self.hub);
                self.phase = Phase::Opening(Box::pin(async move {
                    let opener = Arc::clone(&hub);
                    let job = move |_: &_| {
                        let driving = Driving::open(&opener, &open)?;
                        let opened = driving.opened(&opener);
                        Ok((Box::new(driving), opened))
                    };
                    hub.attendants.resume(job).await
                }));
                return Ok(None);
            }
            (Phase::Driving(driving), Some(Message::Input(input))) => {
                if driving.is_slow && !driving.lease.session().runs_by_itself() {
                    self.begin_step(input);
                    return Ok(None);
                }
                match driving.input(input)? {
                    Some(answer) => answer,
                    None => return Ok(None),
                }
            }
            (Phase::Waiting, _) => return Err(protocol("the first message must be `open`")),
            (_, Some(Message::Open(_))) => return Err(protocol("the stream is open already")),
            (_, _) => return Err(protocol("the message is empty")),
        };
        Ok(Some(v1::DriveResponse { response: Some(response) }))
    }

    /// Lets a worker take a step.
    fn begin_step(&mut self, input: v1::DriveInput) {
        let Phase::Driving(mut driving) = std::mem::replace(&mut self.phase, Phase::Ended) else {
            return;
        };
        let (hub, runtime) = (Arc::clone(&self.hub), Handle::current());
        let is_kept = driving.keep.is_some();
        let step = async move {
            let job = move |_: &_| {
                // An input that has to wait sets a timer.
                let _inside = runtime.enter();
                let outcome = driving.input(input);
                Ok((driving, outcome))
            };
            hub.steppers.start(Admission::Granted, Lane::Long, job).await
        };
        self.phase = Phase::Stepping { step: Box::pin(step), is_kept };
    }

    /// The reason to end the stream while it waits for the client, or a change of how the plant is run:
    /// then there is something to do.
    fn poll_news(&mut self, context: &mut Context<'_>) -> Poll<Option<RpcError>> {
        if self.ending.as_mut().poll(context).is_ready() {
            return Poll::Ready(Some(RpcError::shutting_down()));
        }
        let Phase::Driving(driving) = &mut self.phase else { return Poll::Pending };
        if driving.deleted.as_mut().poll(context).is_ready() {
            return Poll::Ready(Some(RpcError::closed(driving.lease.session())));
        }
        if driving.status.poll_next_unpin(context).is_ready() {
            let revoked = || RpcError::from_drive(DriveError::Revoked, driving.lease.session());
            return Poll::Ready(driving.lease.is_revoked().then(revoked));
        }
        Poll::Pending
    }

    /// The connection broke: keeps the lease for its driver to come back, if that was agreed.
    fn keep_lease(&mut self) {
        let driving: Job<Box<Driving>> = match std::mem::replace(&mut self.phase, Phase::Ended) {
            Phase::Driving(driving) if driving.keep.is_some() => Box::pin(async { Ok(driving) }),
            Phase::Stepping { step, is_kept: true } => Box::pin(async { Ok(step.await?.0) }),
            _ => return,
        };
        // Without a runtime the server ends.
        let Ok(runtime) = Handle::try_current() else { return };
        let ending = self.hub.ending.clone();
        runtime.spawn(async move {
            let Ok(driving) = driving.await else { return };
            let Driving { lease, keep: Some((_, grace)), .. } = *driving else { return };
            let mut status = lease.session().run_status();
            tokio::select! {
                () = tokio::time::sleep(grace) => {}
                () = lease.session().closed() => {}
                () = ending.cancelled() => {}
                // Somebody goes on with it.
                _ = status.wait_for(|_| lease.is_revoked()) => {}
            }
        });
    }

    /// The next message of the client, unless one is still waiting for its step.
    fn poll_request(
        &mut self,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<v1::DriveRequest, Status>>> {
        if let Phase::Opening(_) | Phase::Stepping { .. } = self.phase {
            return Poll::Pending;
        }
        if let Phase::Driving(driving) = &mut self.phase
            && let Some(held) = &mut driving.held
        {
            if let Some(sleep) = &mut held.until {
                std::task::ready!(sleep.as_mut().poll(context));
                held.is_ready = true;
            }
            if !held.is_ready {
                return Poll::Pending;
            }
            let input = driving.held.take().map(|held| Message::Input(held.input));
            return Poll::Ready(Some(Ok(v1::DriveRequest { request: input })));
        }
        Pin::new(&mut self.requests).poll_next(context)
    }
}

impl Drop for DriveStream {
    fn drop(&mut self) {
        self.keep_lease();
    }
}

/// The last step of a plant in lockstep.
fn step_message(core: &mut Core, sequence: u64) -> v1::DriveStep {
    let state = states::shown(&core.published());
    v1::DriveStep {
        sequence,
        clocks: Some(states::clocks(state.time_s, 0)),
        state: Some(state),
        report: Some(report_message(core.report())),
        u: core.applied_input().map(<[f64]>::to_vec).unwrap_or_default(),
        outputs: states::core_outputs(core),
        ..Default::default()
    }
}

fn protocol(message: &str) -> RpcError {
    RpcError::new(Code::InvalidArgument, "PROTOCOL", message)
}

impl Driving {
    fn open(hub: &Hub, open: &v1::DriveOpen) -> Result<Self, RpcError> {
        let session = hub.session(&open.id)?;
        let dimensions = session.model().dimensions();
        if open.linearization {
            let numbers = states::linearization_numbers(dimensions);
            let (name, limit) = ("reply_numbers", hub.limits.reply_numbers);
            LimitExceeded::check(name, limit, "numbers in a linearization", numbers)?;
        }
        if !(0.0..=GRACE_MAX_S).contains(&open.grace_s) {
            let problem = format!("is {}; it must lie between 0 and {GRACE_MAX_S}", open.grace_s);
            return Err(RpcError::field("grace_s", problem));
        }
        let lease = if open.resume.is_empty() {
            session.acquire(DriverKind::Drive)?
        } else {
            session.take_over(&open.resume).ok_or_else(|| {
                let why = format!("the lease of plant `{}` has ended", session.id());
                RpcError::precondition("LEASE_LOST", session.id(), why)
            })?
        };
        let grace = Duration::from_secs_f64(open.grace_s);
        let keep = (!grace.is_zero()).then(|| (format!("{:016x}", random_instance()), grace));
        if let Some((token, _)) = &keep {
            lease.set_name(token.clone());
        }
        let linearization = open.linearization.then(|| Linearization::new(session.model()));
        let settings = session.mechanics().settings;
        let instructions = settings::period_instructions(session.step_instructions(), &settings);
        Ok(Self {
            deleted: Box::pin(session.closed()),
            status: WatchStream::from_changes(session.run_status()),
            lease,
            linearization,
            keep,
            is_slow: instructions > INLINE_INSTRUCTIONS_MAX,
            held: None,
            states: States::None,
        })
    }

    /// What the driver is told first: the plant, and the last step of it. Blocks for as long as a step takes.
    fn opened(&self, hub: &Hub) -> v1::DriveOpened {
        let session = self.lease.session();
        let last = session
            .with_core(|core| (core.plant().step_index() > 0).then(|| step_message(core, 0)));
        v1::DriveOpened {
            plant: Some(hub.plant_info(session)),
            lease_token: self.keep.as_ref().map(|(token, _)| token.clone()).unwrap_or_default(),
            last,
        }
    }

    /// An input; failures of its own are answers, those of the stream are errors. No answer yet when
    /// the plant runs by itself, or the step has to wait.
    fn input(&mut self, input: v1::DriveInput) -> Result<Option<Answer>, RpcError> {
        let sequence = input.sequence;
        let outcome = if self.lease.session().runs_by_itself() {
            self.lease.offer(sequence, &input.u, input.answers_ns).map(|()| None)
        } else {
            self.step(sequence, &input.u).map(Some)
        };
        let until = match outcome {
            Ok(step) => return Ok(step.map(Answer::Step)),
            // How the plant is run may have changed in between.
            Err(DriveError::Paused | DriveError::Running) => None,
            Err(DriveError::NotDue(due_ns)) => {
                let wait = Duration::from_nanos(due_ns.saturating_sub(monotonic_ns()));
                Some(Box::pin(tokio::time::sleep(wait)))
            }
            Err(error @ (DriveError::Step(_) | DriveError::Frozen(_))) => {
                let fault = RpcError::from_drive(error, self.lease.session());
                let failure = Some(fault.into());
                return Ok(Some(Answer::Failure(v1::DriveFailure { sequence, failure })));
            }
            Err(error) => return Err(RpcError::from_drive(error, self.lease.session())),
        };
        self.held = Some(Held { input, until, is_ready: false });
        Ok(None)
    }

    /// A state of the plant's own loop.
    fn poll_state(
        &mut self,
        hub: &Arc<Hub>,
        context: &mut Context<'_>,
    ) -> Poll<Result<Answer, RpcError>> {
        if let States::None = self.states {
            let (hub, session) = (Arc::clone(hub), Arc::clone(self.lease.session()));
            let watchers_max = hub.limits.watchers_per_plant;
            self.states = States::Opening(Box::pin(async move {
                let job = move |_: &_| Ok(session.subscribe(1, 1, watchers_max)?);
                hub.attendants.resume(job).await
            }));
        }
        if let States::Opening(job) = &mut self.states {
            self.states = States::Open(Box::new(std::task::ready!(job.as_mut().poll(context))?));
        }
        let States::Open(states) = &mut self.states else { return Poll::Pending };
        let (frame, dropped) = std::task::ready!(states.poll_next(context));
        Poll::Ready(Ok(Answer::Step(v1::DriveStep {
            sequence: frame.timing.input_sequence,
            state: Some(states::shown(&frame.published())),
            report: Some(report_message(&frame.report)),
            linearization: None,
            u: frame.input.clone(),
            outputs: states::outputs(&frame.outputs, &frame.lost),
            clocks: Some(states::clocks(frame.time_s, frame.timing.ended_ns)),
            timing: states::step_timing(&frame.timing),
            dropped,
        })))
    }

    /// A step in lockstep.
    fn step(&mut self, sequence: u64, u: &[f64]) -> Result<v1::DriveStep, DriveError> {
        let (lease, linearization) = (&mut self.lease, &mut self.linearization);
        let began = Instant::now();
        let step = lease.step_and(u, linearization.as_mut(), |core| step_message(core, sequence));
        // One that failed has taken its time as well.
        self.is_slow = began.elapsed() > INLINE_STEP_MAX;
        let mut step = step?;
        if let Some(linearization) = &self.linearization {
            let from = step.state.as_ref().map_or(0, |state| state.step - 1);
            step.linearization = Some(states::linearization(from, linearization));
        }
        Ok(step)
    }
}

impl Stream for DriveStream {
    type Item = Result<v1::DriveResponse, Status>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let this = &mut *self;
        if matches!(this.phase, Phase::Ended) {
            return Poll::Ready(None);
        }
        let item = loop {
            if this.burst >= BURST_MAX {
                this.burst = 0;
                // A client that sends faster than the plant steps must not keep the thread, nor miss
                // that the stream shall end.
                if let Poll::Ready(Some(fault)) = this.poll_news(context) {
                    break Some(Err(fault.into()));
                }
                context.waker().wake_by_ref();
                return Poll::Pending;
            }
            if let Phase::Opening(job) = &mut this.phase
                && let Poll::Ready(opened) = job.as_mut().poll(context)
            {
                match opened {
                    Ok((driving, opened)) => {
                        this.phase = Phase::Driving(driving);
                        let response = Some(Answer::Opened(opened));
                        break Some(Ok(v1::DriveResponse { response }));
                    }
                    Err(fault) => break Some(Err(fault.into())),
                }
            }
            if let Phase::Stepping { step, .. } = &mut this.phase
                && let Poll::Ready(stepped) = step.as_mut().poll(context)
            {
                let outcome = stepped.and_then(|(driving, outcome)| {
                    this.phase = Phase::Driving(driving);
                    outcome
                });
                match outcome {
                    Ok(None) => {}
                    Ok(response) => break Some(Ok(v1::DriveResponse { response })),
                    Err(fault) => break Some(Err(fault.into())),
                }
            }
            match this.poll_request(context) {
                Poll::Ready(None) => break None,
                Poll::Ready(Some(Err(status))) => {
                    this.keep_lease();
                    break Some(Err(with_limit_details(status, "", &this.hub.limits)));
                }
                Poll::Ready(Some(Ok(request))) => {
                    this.burst += 1;
                    match this.answer(request) {
                        Ok(Some(answer)) => break Some(Ok(answer)),
                        Ok(None) => continue,
                        Err(fault) => break Some(Err(fault.into())),
                    }
                }
                Poll::Pending => {}
            }
            if let Phase::Driving(driving) = &mut this.phase {
                if driving.lease.session().runs_by_itself() {
                    if let Poll::Ready(state) = driving.poll_state(&this.hub, context) {
                        let answer =
                            state.map(|answer| v1::DriveResponse { response: Some(answer) });
                        break Some(answer.map_err(Status::from));
                    }
                } else {
                    driving.states = States::None;
                }
            }
            this.burst = 0;
            match this.poll_news(context) {
                Poll::Pending => return Poll::Pending,
                Poll::Ready(Some(fault)) => break Some(Err(fault.into())),
                // How the plant is run has changed: an input that waits may have its turn.
                Poll::Ready(None) => {
                    if let Phase::Driving(driving) = &mut this.phase
                        && let Some(held) = &mut driving.held
                    {
                        held.is_ready = true;
                    }
                }
            }
        };
        if !matches!(item, Some(Ok(_))) {
            this.phase = Phase::Ended;
        }
        Poll::Ready(item)
    }
}
