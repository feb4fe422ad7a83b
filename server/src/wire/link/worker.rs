//! The thread of one link.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use iceoryx2::identifiers::UniquePublisherId;
use plantd_models::{StepError, StepReport};
use plantd_proto::link::{
    Code, DomainError, Endpoint, Header, Holder, Kind, LIVE, LinkNode, LinkServices, Message,
    ProcessIdentity, monotonic_ns, random_instance,
};

use crate::core::driver::DriverKind;
use crate::core::plant::error::DriveError;
use crate::core::publish::frame::{Frames, OUTPUTS_MAX, Published, Timing};
use crate::core::session::lease::Lease;
use crate::core::session::shared::Session;
use crate::wire::link::config::LinkConfig;
use crate::wire::message::report::with_report;

/// The kind of a message on which the thread of a link panics.
#[cfg(test)]
pub(super) const PANIC: u32 = 0xdead;

/// How often the thread looks whether it shall end and whether its driver lives, ns.
const CHECK_PERIOD_NS: u64 = 100_000_000;

/// Pause after an error of the transport, so that one that lasts does not take a processor.
const PAUSE_AFTER_ERROR: Duration = Duration::from_millis(10);

/// How long after a step of a plant that runs by itself is due it is looked for, and how soon again, ns.
const AFTER_DUE_NS: u64 = 15_000;
const LOOK_AGAIN_NS: u64 = 50_000;

/// How soon an input of a paused plant is tried again, ns.
const HELD_PERIOD_NS: u64 = 1_000_000;

/// One link and its driver.
pub(super) struct Worker {
    session: Arc<Session>,
    endpoint: Endpoint,
    stop: Arc<AtomicBool>,
    /// What all headers of this link have in common.
    header: Header,
    driver: Option<Driver>,
    idle_timeout_ns: u64,
    next_check_ns: u64,
    /// The input, copied out of memory that the driver can write to.
    input: Vec<f64>,
    has_warned: bool,
}

/// The driver that holds the lease.
struct Driver {
    instance: u64,
    publisher: UniquePublisherId,
    process: ProcessIdentity,
    /// The process can be seen from here: it is not in another pid namespace.
    is_visible: bool,
    sequence: u64,
    last_heard_ns: u64,
    lease: Lease,
    /// When it stops polling for what the server sends.
    poll_end_ns: u64,
    /// An input that waits for its step in lockstep, and when it is tried again, ns.
    held: Option<(Header, u64)>,
    /// The states of the plant while it runs by itself.
    states: Option<Frames>,
}

/// A failure of one input or attachment: goes to the driver, the link goes on.
#[derive(Clone, Copy)]
struct Failure {
    code: Code,
    a: u64,
    b: u64,
    value: f64,
    report: StepReport,
}

impl Worker {
    pub(super) fn new(
        session: Arc<Session>,
        services: LinkServices,
        config: &LinkConfig,
        stop: Arc<AtomicBool>,
    ) -> Result<Self, DomainError> {
        let dimensions = session.model().dimensions();
        let header = Header {
            server: random_instance(),
            time_step_s: session.mechanics().settings.time_step_s,
            model_digest: session.model().digest(),
            dynamic: dimensions.dynamic as u32,
            prescribed: dimensions.prescribed as u32,
            inputs: dimensions.inputs as u32,
            constraints: dimensions.constraints as u32,
            ..Header::new(Kind::State)
        };
        let endpoint = Endpoint::server(services, header.state_len() + OUTPUTS_MAX, config.wait)?;
        Ok(Self {
            session,
            endpoint,
            stop,
            header,
            driver: None,
            idle_timeout_ns: config.idle_timeout.map_or(u64::MAX, |t| t.as_nanos() as u64),
            next_check_ns: 0,
            input: vec![0.0; header.input_len()],
            has_warned: false,
        })
    }

    /// Lets drivers find the link.
    pub(super) fn publish(self, node: &LinkNode) -> Result<Self, DomainError> {
        if let Err(error) = node.publish(self.plant()) {
            self.endpoint.close();
            return Err(error);
        }
        self.session.set_link_open(true);
        tracing::info!(plant = self.plant(), "shared-memory link is open");
        Ok(self)
    }

    pub(super) fn plant(&self) -> &str {
        self.session.id()
    }

    /// Serves drivers until the link is closed or the plant deleted.
    pub(super) fn run(&mut self) {
        while !self.stop.load(Ordering::Acquire) && !self.session.is_closed() {
            let outcome = match self.endpoint.receive(self.next_look_ns()) {
                Ok(Some(message)) => self.handle(&message),
                Ok(None) => Ok(()),
                Err(error) => Err(error),
            };
            let outcome = outcome.and_then(|()| self.attend_driver());
            let outcome = outcome.and_then(|()| {
                if monotonic_ns() < self.next_check_ns {
                    return Ok(());
                }
                self.next_check_ns = monotonic_ns() + CHECK_PERIOD_NS;
                if self.is_driver_silent() {
                    self.check_driver();
                }
                self.endpoint.update()
            });
            if let Err(error) = outcome {
                self.note_transport_error(&error);
            }
        }
    }

    /// Until when there is nothing to do unless a message comes, ns.
    fn next_look_ns(&self) -> u64 {
        let now_ns = monotonic_ns();
        let check_ns = now_ns + CHECK_PERIOD_NS;
        let Some(driver) = &self.driver else { return check_ns };
        if let Some((_, again_ns)) = driver.held {
            return again_ns.min(check_ns);
        }
        if driver.states.is_none() {
            return check_ns;
        }
        let live = self.session.live();
        live.look_ns(now_ns, AFTER_DUE_NS, LOOK_AGAIN_NS).min(check_ns)
    }

    /// Brings the driver what it has not asked for: the answer to an input that had to wait, or the
    /// states of a plant that runs by itself.
    fn attend_driver(&mut self) -> Result<(), DomainError> {
        let Some(driver) = &mut self.driver else { return Ok(()) };
        if driver.lease.is_revoked() {
            let request =
                Header { driver: driver.instance, sequence: driver.sequence, ..self.header };
            self.driver = None;
            return self.refuse(&request, Failure::new(Code::NotAttached));
        }
        if let Some((request, again_ns)) = driver.held
            && again_ns <= monotonic_ns()
        {
            driver.held = None;
            return self.step(&request);
        }
        if !self.session.runs_by_itself() {
            driver.states = None;
            return Ok(());
        }
        let states = driver.states.get_or_insert_with(|| Frames::from(self.session.ring(), 0));
        let Some(frame) = states.read_last() else { return Ok(()) };
        let request = Header {
            driver: driver.instance,
            sequence: frame.timing.input_sequence,
            ..self.header
        };
        let flags = frame.timing.flags & (Timing::LATE | Timing::SAFE);
        let common = Header { code: LIVE | flags as u32, ..self.header };
        let published = frame.published();
        send_state(
            &mut self.endpoint,
            common,
            &request,
            driver.poll_end_ns,
            Kind::State,
            &published,
        )
    }

    /// A dying driver can make a port fail once; the link goes on.
    fn note_transport_error(&mut self, error: &DomainError) {
        if !std::mem::replace(&mut self.has_warned, true) {
            tracing::warn!(plant = self.session.id(), %error, "shared-memory link");
        }
        std::thread::sleep(PAUSE_AFTER_ERROR);
    }

    fn is_driver_silent(&self) -> bool {
        let silent_ns = |driver: &Driver| monotonic_ns().saturating_sub(driver.last_heard_ns);
        self.driver.as_ref().is_some_and(|driver| silent_ns(driver) > CHECK_PERIOD_NS)
    }

    /// Takes the lease back from a driver that died, left, or is idle for too long. Reads files: not
    /// for a driver that is stepping.
    fn check_driver(&mut self) {
        let now_ns = monotonic_ns();
        let Some(driver) = &self.driver else { return };
        let why = if !driver.is_alive(&self.endpoint) {
            "is gone"
        } else if now_ns.saturating_sub(driver.last_heard_ns) > self.idle_timeout_ns {
            "was idle for too long"
        } else {
            return;
        };
        tracing::warn!(plant = self.session.id(), pid = driver.process.pid, why, "lost the driver");
        self.driver = None;
    }

    fn handle(&mut self, message: &Message) -> Result<(), DomainError> {
        let request = *message.user_header();
        #[cfg(test)]
        assert_ne!(request.kind, PANIC, "as a test demands");
        if !request.is_of_this_layout() {
            return self.refuse(&request, Failure::new(Code::Layout));
        }
        match Kind::from_number(request.kind) {
            Some(Kind::Input) => match self.accept_input(&request, message.payload()) {
                Ok(()) => self.step(&request),
                Err(failure) => self.refuse(&request, failure),
            },
            Some(Kind::Attach) => self.attach(&request, message.origin()),
            Some(Kind::Detach) => {
                if self.driver.take_if(|driver| driver.instance == request.driver).is_some() {
                    tracing::info!(plant = self.session.id(), pid = request.pid, "driver left");
                }
                Ok(())
            }
            _ => self.refuse(&request, Failure::new(Code::Kind)),
        }
    }

    /// Gives the lease to a driver, if it is free. One that asks again gets the same answer.
    fn attach(&mut self, request: &Header, sender: UniquePublisherId) -> Result<(), DomainError> {
        let again = self.driver.as_ref().is_some_and(|driver| driver.instance == request.driver);
        if !again {
            // The holder may have died since the last check.
            self.check_driver();
            if let Some(driver) = &self.driver {
                let held = Failure::lease_held(Holder::Link, driver.process.pid);
                return self.refuse(request, held);
            }
            let lease = match self.session.acquire(DriverKind::Link) {
                Ok(lease) => lease,
                Err(held) => return self.refuse(request, Failure::lease_held(holder(held.by), 0)),
            };
            tracing::info!(plant = self.session.id(), pid = request.pid, "driver attached");
            self.driver = Some(Driver::new(request, sender, lease));
        }
        let frame = self.session.frame();
        let (endpoint, common) = (&mut self.endpoint, self.header);
        let (poll_end_ns, published) = (request.poll_end_ns(), frame.published());
        send_state(endpoint, common, request, poll_end_ns, Kind::Attached, &published)
    }

    /// Takes a step with the input that was accepted, or hands it to the plant's own loop.
    fn step(&mut self, request: &Header) -> Result<(), DomainError> {
        let Some(driver) = &mut self.driver else { return Ok(()) };
        let outcome = if self.session.runs_by_itself() {
            // What an input answers stands where messages of the server say when they were sent.
            driver.lease.offer(request.sequence, &self.input, request.detail_a).map(Ok)
        } else {
            let (endpoint, common) = (&mut self.endpoint, self.header);
            let poll_end_ns = request.poll_end_ns();
            driver.lease.step_and(&self.input, None, |core| {
                let published = core.published();
                send_state(endpoint, common, request, poll_end_ns, Kind::State, &published)
            })
        };
        let failure = match outcome {
            Ok(sent) => return sent,
            // How the plant is run may have changed in between.
            Err(DriveError::Paused | DriveError::Running) => {
                driver.held = Some((*request, monotonic_ns() + HELD_PERIOD_NS));
                return Ok(());
            }
            Err(DriveError::NotDue(due_ns)) => {
                driver.held = Some((*request, due_ns));
                return Ok(());
            }
            Err(DriveError::Closed) => Failure::new(Code::PlantDeleted),
            Err(DriveError::Revoked) => Failure::new(Code::NotAttached),
            Err(DriveError::Frozen(trip)) => Failure {
                a: trip.watchdog as u64,
                b: trip.dog.quantity.code() + 1,
                value: trip.value,
                report: StepReport { residual: trip.bound(), ..StepReport::default() },
                ..Failure::new(Code::Watchdog)
            },
            Err(DriveError::Step(error)) => Failure::step(&error, &self.session),
        };
        self.refuse(request, failure)
    }

    /// Copies the input out of the memory that the driver can write to.
    fn accept_input(&mut self, request: &Header, u: &[f64]) -> Result<(), Failure> {
        let driver = self
            .driver
            .as_mut()
            .filter(|d| d.instance == request.driver && request.server == self.header.server)
            .ok_or(Failure::new(Code::NotAttached))?;
        driver.last_heard_ns = monotonic_ns();
        driver.poll_end_ns = request.poll_end_ns();
        // The driver chooses where it begins, also at the end.
        let expected = driver.sequence.wrapping_add(1);
        driver.sequence = request.sequence;
        if request.sequence != expected {
            return Err(Failure { a: expected, ..Failure::new(Code::Sequence) });
        }
        if u.len() != self.input.len() {
            let (a, b) = (self.input.len() as u64, u.len() as u64);
            return Err(Failure { a, b, ..Failure::new(Code::Dimension) });
        }
        self.input.copy_from_slice(u);
        Ok(())
    }

    fn refuse(&mut self, request: &Header, failure: Failure) -> Result<(), DomainError> {
        let header = Header {
            kind: Kind::Failure as u32,
            code: failure.code as u32,
            driver: request.driver,
            sequence: request.sequence,
            detail_a: failure.a,
            detail_b: failure.b,
            detail_value: failure.value,
            ..with_report(self.header, &failure.report)
        };
        self.endpoint.send(header, &[], request.poll_end_ns())
    }

    /// Gives the lease back and tells all drivers that the link ends. Does not panic, whatever state the
    /// ports are in.
    pub(super) fn close(mut self) {
        self.driver = None;
        let code = match self.session.is_closed() {
            true => Code::PlantDeleted,
            false => Code::LinkClosed,
        };
        let header = Header { kind: Kind::Closed as u32, code: code as u32, ..self.header };
        let send = || self.endpoint.send(header, &[], 0);
        let sent = catch_unwind(AssertUnwindSafe(send));
        if let Ok(Err(error)) = sent {
            tracing::debug!(plant = self.session.id(), %error, "shared-memory link, closing");
        }
        self.session.set_link_open(false);
        tracing::info!(plant = self.session.id(), "shared-memory link is closed");
        self.endpoint.close();
    }
}

impl Driver {
    fn new(request: &Header, publisher: UniquePublisherId, lease: Lease) -> Self {
        let process = ProcessIdentity { pid: request.pid, start: request.process_start };
        Self {
            instance: request.driver,
            publisher,
            process,
            is_visible: process.is_running(),
            sequence: 0,
            last_heard_ns: monotonic_ns(),
            lease,
            poll_end_ns: request.poll_end_ns(),
            held: None,
            states: None,
        }
    }

    /// The process lives, and its port was neither closed nor cleaned up.
    fn is_alive(&self, endpoint: &Endpoint) -> bool {
        (!self.is_visible || self.process.is_running()) && endpoint.is_connected(self.publisher)
    }
}

impl Failure {
    fn new(code: Code) -> Self {
        Self { code, a: 0, b: 0, value: 0.0, report: StepReport::default() }
    }

    fn lease_held(by: Holder, pid: u32) -> Self {
        Self { a: by as u64, b: pid.into(), ..Self::new(Code::LeaseHeld) }
    }

    /// The numbers of an error of a step, in the fields that [`Code`] says.
    fn step(error: &StepError, session: &Session) -> Self {
        let solver =
            |iterations, residual| StepReport { iterations, residual, ..StepReport::default() };
        let index_of = |name: &str| session.model().coordinate_index(name).unwrap_or(0) as u64;
        let first_equation = |concerned: &[String]| {
            let names = session.model().constraint_names();
            concerned.first().and_then(|c| names.iter().position(|n| n == c)).unwrap_or(0) as u64
        };
        match *error {
            StepError::Dimension { expected, actual } => {
                Self { a: expected as u64, b: actual as u64, ..Self::new(Code::Dimension) }
            }
            StepError::InputNotFinite { index, value, .. } => {
                Self { a: index as u64, value, ..Self::new(Code::InputNotFinite) }
            }
            StepError::NotConverged { iterations, residual } => {
                Self { report: solver(iterations, residual), ..Self::new(Code::NotConverged) }
            }
            // Of second derivatives, which the link does not have.
            StepError::TooManySteps { .. } => Self::new(Code::NotConverged),
            StepError::NotFinite { iterations } => {
                Self { report: solver(iterations, 0.0), ..Self::new(Code::NotFinite) }
            }
            StepError::Singular { ref coordinate, pivot } => {
                Self { a: index_of(coordinate), value: pivot, ..Self::new(Code::Singular) }
            }
            // The link has no room for names: gRPC tells them.
            StepError::SingularConstraints { ref constraints, reciprocal_condition } => Self {
                a: first_equation(constraints),
                b: constraints.len() as u64,
                value: reciprocal_condition,
                ..Self::new(Code::SingularConstraints)
            },
            StepError::InconsistentConstraints { ref constraints, violation } => Self {
                a: first_equation(constraints),
                b: constraints.len() as u64,
                value: violation,
                ..Self::new(Code::InconsistentConstraints)
            },
            StepError::TooFast { ref coordinate, increment } => {
                Self { a: index_of(coordinate), value: increment, ..Self::new(Code::TooFast) }
            }
        }
    }
}

/// Sends the state of the plant to its driver.
fn send_state(
    endpoint: &mut Endpoint,
    common: Header,
    request: &Header,
    poll_end_ns: u64,
    kind: Kind,
    published: &Published<'_>,
) -> Result<(), DomainError> {
    let header = Header {
        kind: kind as u32,
        driver: request.driver,
        sequence: request.sequence,
        // They may have changed since the link was opened.
        time_step_s: published.time_step_s,
        model_digest: published.model_digest,
        step: published.step,
        time_s: published.time_s,
        outputs: published.outputs.len() as u32,
        output_channels: published.lost.len() as u32,
        ..common
    };
    let header = if kind == Kind::State { with_report(header, &published.report) } else { header };
    let Published { q, p, v, multipliers, velocity, outputs, lost, .. } = *published;
    let parts = [q, p, v, multipliers, velocity, outputs, lost];
    endpoint.send(header, &parts, poll_end_ns)
}

fn holder(by: DriverKind) -> Holder {
    match by {
        DriverKind::Step => Holder::Step,
        DriverKind::Drive => Holder::Drive,
        DriverKind::Link => Holder::Link,
    }
}
