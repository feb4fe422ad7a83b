//! The driver: attaches to a plant, sends inputs, waits for states.

use std::path::PathBuf;
use std::time::Duration;

use iceoryx2::identifiers::UniquePublisherId;
use plantd_proto::link::{
    Code, Domain, DomainError, Endpoint, Header, Kind, LIVE, LinkNode, Message, Wait, default_root,
    monotonic_ns, random_instance,
};

use crate::link::error::{LinkError, from_failure};

/// How often a driver that waits looks whether the server lives, ns.
const CHECK_PERIOD_NS: u64 = 100_000_000;

/// How often an unanswered request to attach is repeated, ns.
const ATTACH_PERIOD_NS: u64 = 50_000_000;

/// Pause between two looks for a link that is not open.
const LOOK_PERIOD: Duration = Duration::from_millis(20);

/// Entries of an input that a first connection has room for; a plant that needs more is connected
/// to once more.
const INPUT_LEN_USUAL: usize = 64;

/// How to connect to a plant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LinkOptions {
    /// Root path of the server's shared-memory domain, as `OpenLink` returns it.
    pub root: PathBuf,
    /// How to wait for the answer to a step.
    pub wait: Wait,
    /// How long to wait for the answer to a step.
    pub timeout: Duration,
    /// How long to wait for the link to be open and the server to answer.
    pub connect_timeout: Duration,
}

impl Default for LinkOptions {
    /// The server's default root path, polling for 50 µs before sleeping, timeouts of 1 s.
    fn default() -> Self {
        Self {
            root: default_root(),
            wait: Wait::default(),
            timeout: Duration::from_secs(1),
            connect_timeout: Duration::from_secs(1),
        }
    }
}

/// Sizes of a plant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkDimensions {
    /// Dynamic coordinates, nd.
    pub dynamic: usize,
    /// Prescribed coordinates, nk.
    pub prescribed: usize,
    /// Inputs, ni.
    pub inputs: usize,
    /// Constraint equations, nc.
    pub constraints: usize,
}

/// A state of the plant and what the solver did to get there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StateView<'a> {
    /// Steps since the plant was created or reset.
    pub step: u64,
    /// Plant time, s.
    pub time_s: f64,
    /// Time step of the plant, s.
    pub time_step_s: f64,
    /// Configuration, nd + nk.
    pub q: &'a [f64],
    /// Momentum, nd.
    pub p: &'a [f64],
    /// Velocity of prescribed coordinates over the last step, nk.
    pub v: &'a [f64],
    /// Constraint impulses, nc.
    pub multipliers: &'a [f64],
    /// Velocity of all coordinates, from the momentum projected onto the constraints, nd + nk, m/s or
    /// rad/s.
    pub velocity: &'a [f64],
    /// `x = (q, p, v)`, 2 nd + 2 nk.
    pub x: &'a [f64],
    /// What the output channels deliver; empty without channels.
    pub outputs: &'a [f64],
    /// For each output channel, 1 where its numbers stand for lost ones, else 0.
    pub lost: &'a [f64],
    /// Residual evaluations.
    pub iterations: u32,
    /// Factorizations of the Newton matrix.
    pub factorizations: u32,
    /// Final residual in units of its own round-off.
    pub residual: f64,
    /// Constraint violation in units of its own round-off.
    pub constraint_residual: f64,
    /// Estimate of the reciprocal condition of the Newton matrix, at most 1.
    pub reciprocal_condition: f64,
    /// Estimate of the reciprocal condition of the constraints, without redundant ones; 1 without
    /// constraints.
    pub constraint_reciprocal_condition: f64,
    /// Constraint equations that follow from others.
    pub redundant_constraints: u32,
    /// Steps of the method in the time step; the counts above are those of all of them.
    pub steps: u32,
    /// How often the time step was halved: 0 unless it could not be solved in longer steps.
    pub halvings: u32,
}

/// A driver of one plant. It holds the plant's lease until it is dropped.
#[derive(Debug)]
pub struct LinkDriver {
    plant: String,
    options: LinkOptions,
    endpoint: Endpoint,
    /// What the driver's own headers have in common: `driver` and `server`.
    header: Header,
    /// Process id of the server.
    server_pid: u32,
    server_port: Option<UniquePublisherId>,
    server_poll_end_ns: u64,
    sequence: u64,
    /// Header of the last state.
    last: Header,
    /// Payload of the last state.
    state: Vec<f64>,
    /// Declared last: the ports go before the membership.
    node: LinkNode,
}

impl LinkDriver {
    /// Connects to a plant whose link is open, and takes its lease. Waits for a server that is just
    /// starting. Takes tens of milliseconds.
    pub fn connect(plant: &str, options: LinkOptions) -> Result<Self, LinkError> {
        let deadline_ns = after(options.connect_timeout);
        let mut room = INPUT_LEN_USUAL;
        loop {
            match Self::connect_with_room(plant, &options, room, deadline_ns) {
                Ok(driver) if driver.last.input_len() <= room => return Ok(driver),
                Ok(driver) => room = driver.last.input_len(),
                // The server has died meanwhile: the next one may be about to start.
                Err(LinkError::Domain(DomainError::NotOpen { .. }))
                    if monotonic_ns() < deadline_ns => {}
                Err(error) => return Err(error),
            }
        }
    }

    /// Connects again, to the same plant with the same options: after [`LinkError::ServerGone`],
    /// [`LinkError::ServerRestarted`], [`LinkError::LeaseLost`] or [`LinkError::Closed`].
    pub fn reconnect(&mut self) -> Result<(), LinkError> {
        *self = Self::connect(&self.plant, self.options.clone())?;
        Ok(())
    }

    /// Takes one step with `u` (ni + nk entries) and returns the state after it.
    ///
    /// When a step fails ([`LinkError::Step`]) the plant stays where it was, and the next call goes
    /// on from there. After [`LinkError::Timeout`] the step may still be taken; the step count of the
    /// next state tells.
    ///
    /// Of a plant that runs by itself it waits for the latest state on which the input acted, so that
    /// the same loop drives both.
    pub fn step(&mut self, u: &[f64]) -> Result<StateView<'_>, LinkError> {
        self.offer(u)?;
        self.wait_for_answer(after(self.options.timeout))?;
        Ok(self.state())
    }

    /// Gives a plant that runs by itself an input, which acts from its next step on, and does not wait.
    pub fn offer(&mut self, u: &[f64]) -> Result<(), LinkError> {
        let expected = self.last.input_len();
        if u.len() != expected {
            return Err(LinkError::Dimension { expected, actual: u.len() });
        }
        self.sequence += 1;
        let header = Header {
            kind: Kind::Input as u32,
            sequence: self.sequence,
            detail_a: self.last.stamp_ns,
            ..self.header
        };
        self.endpoint.send(header, &[u], self.server_poll_end_ns)?;
        Ok(())
    }

    /// Waits for the next state of a plant that runs by itself, whatever input acted: the latest.
    pub fn next_state(&mut self) -> Result<StateView<'_>, LinkError> {
        let seen = self.last.stamp_ns;
        while self.last.stamp_ns == seen || self.last.code & LIVE == 0 {
            self.wait_for(after(self.options.timeout), |answer, _| answer.code & LIVE != 0)?;
        }
        Ok(self.state())
    }

    /// The last state: of the last step, or of the time of the connection.
    pub fn state(&self) -> StateView<'_> {
        let LinkDimensions { dynamic, prescribed, constraints, .. } = self.dimensions();
        let coordinates = dynamic + prescribed;
        let (x, rest) = self.state.split_at(2 * coordinates);
        let (multipliers, rest) = rest.split_at(constraints);
        let (velocity, rest) = rest.split_at(coordinates);
        let (outputs, lost) = rest.split_at(self.last.outputs as usize);
        let (q, momenta) = x.split_at(coordinates);
        let (p, v) = momenta.split_at(dynamic);
        StateView {
            step: self.last.step,
            time_s: self.last.time_s,
            time_step_s: self.last.time_step_s,
            q,
            p,
            v,
            multipliers,
            velocity,
            x,
            outputs,
            lost,
            iterations: self.last.iterations,
            factorizations: self.last.factorizations,
            residual: self.last.residual,
            constraint_residual: self.last.constraint_residual,
            reciprocal_condition: self.last.reciprocal_condition,
            constraint_reciprocal_condition: self.last.constraint_reciprocal_condition,
            redundant_constraints: self.last.redundant_constraints,
            steps: self.last.steps,
            halvings: self.last.halvings,
        }
    }

    /// Sizes of the plant.
    pub fn dimensions(&self) -> LinkDimensions {
        LinkDimensions {
            dynamic: self.last.dynamic as usize,
            prescribed: self.last.prescribed as usize,
            inputs: self.last.inputs as usize,
            constraints: self.last.constraints as usize,
        }
    }

    /// Time step of the plant, s.
    pub fn time_step_s(&self) -> f64 {
        self.last.time_step_s
    }

    /// Digest of the plant's model: equal digests mean equal motion.
    pub fn model_digest(&self) -> u64 {
        self.last.model_digest
    }

    /// Id of the plant.
    pub fn plant(&self) -> &str {
        &self.plant
    }

    fn connect_with_room(
        plant: &str,
        options: &LinkOptions,
        room: usize,
        deadline_ns: u64,
    ) -> Result<Self, LinkError> {
        let (node, endpoint) = open_endpoint(plant, options, room, deadline_ns)?;
        let mut driver = Self {
            plant: plant.to_owned(),
            options: options.clone(),
            endpoint,
            header: Header { driver: random_instance(), ..Header::new(Kind::Attach) },
            server_pid: 0,
            server_port: None,
            server_poll_end_ns: 0,
            sequence: 0,
            last: Header::default(),
            state: Vec::new(),
            node,
        };
        driver.attach(deadline_ns)?;
        Ok(driver)
    }

    /// Asks for the lease until the server answers. The request is repeated, because the answer can
    /// be overwritten by the states of another driver.
    fn attach(&mut self, deadline_ns: u64) -> Result<(), LinkError> {
        loop {
            self.endpoint.send(self.header, &[], 0)?;
            let repeat_ns = (monotonic_ns() + ATTACH_PERIOD_NS).min(deadline_ns);
            while let Some(message) = self.endpoint.receive(repeat_ns)? {
                let answer = *message.user_header();
                if !answer.is_of_this_layout() {
                    return Err(DomainError::OtherLayout { plant: self.plant.clone() }.into());
                }
                if answer.driver != self.header.driver {
                    continue;
                }
                match Kind::from_number(answer.kind) {
                    Some(Kind::Attached) => return self.note_attached(&answer, &message),
                    _ => return Err(from_failure(&answer)),
                }
            }
            if monotonic_ns() >= deadline_ns {
                return Err(LinkError::Timeout { after: self.options.connect_timeout });
            }
            if !self.node.is_served() {
                let (plant, root) = (self.plant.clone(), self.options.root.clone());
                return Err(DomainError::NotOpen { plant, root }.into());
            }
        }
    }

    fn note_attached(&mut self, answer: &Header, message: &Message) -> Result<(), LinkError> {
        self.header.server = answer.server;
        self.server_pid = answer.pid;
        self.server_port = Some(message.origin());
        self.note_state(answer, message.payload())
    }

    fn note_state(&mut self, answer: &Header, payload: &[f64]) -> Result<(), LinkError> {
        self.server_poll_end_ns = answer.poll_end_ns();
        if payload.len() != answer.state_len() {
            return Err(DomainError::OtherLayout { plant: self.plant.clone() }.into());
        }
        self.last = *answer;
        // Allocates where channels were added.
        self.state.resize(payload.len(), 0.0);
        self.state.copy_from_slice(payload);
        Ok(())
    }

    fn wait_for_answer(&mut self, deadline_ns: u64) -> Result<(), LinkError> {
        self.wait_for(deadline_ns, |answer, sequence| answer.sequence == sequence)
    }

    /// Waits for a message that is `wanted`; given are its header and the number of the last input.
    fn wait_for(
        &mut self,
        deadline_ns: u64,
        wanted: impl Fn(&Header, u64) -> bool,
    ) -> Result<(), LinkError> {
        loop {
            let check_ns = (monotonic_ns() + CHECK_PERIOD_NS).min(deadline_ns);
            while let Some(message) = self.endpoint.receive(check_ns)? {
                if self.is_answer(&message, &wanted)? {
                    return Ok(());
                }
            }
            self.check_server()?;
            if monotonic_ns() >= deadline_ns {
                return Err(LinkError::Timeout { after: self.options.timeout });
            }
        }
    }

    /// Whether a message answers the last input. The server's messages reach all drivers, and
    /// answers that came too late are still there.
    fn is_answer(
        &mut self,
        message: &Message,
        wanted: impl Fn(&Header, u64) -> bool,
    ) -> Result<bool, LinkError> {
        let answer = *message.user_header();
        if answer.server != self.header.server {
            return Err(LinkError::ServerRestarted);
        }
        let kind = Kind::from_number(answer.kind);
        if kind == Some(Kind::Closed) {
            let is_deleted = answer.code == Code::PlantDeleted as u32;
            return Err(LinkError::Closed { is_deleted });
        }
        if answer.driver != self.header.driver {
            return Ok(false);
        }
        if kind == Some(Kind::Failure) && answer.sequence == self.sequence {
            self.server_poll_end_ns = answer.poll_end_ns();
            return Err(from_failure(&answer));
        }
        if kind != Some(Kind::State) || !wanted(&answer, self.sequence) {
            return Ok(false);
        }
        self.note_state(&answer, message.payload())?;
        Ok(true)
    }

    /// Off the fast path: nothing has come for a while.
    fn check_server(&self) -> Result<(), LinkError> {
        if self.node.is_elsewhere(&self.plant) {
            return Err(LinkError::ServerRestarted);
        }
        let is_dead = !self.node.is_served();
        if is_dead || !self.server_port.is_some_and(|port| self.endpoint.is_connected(port)) {
            return Err(LinkError::ServerGone { pid: self.server_pid });
        }
        Ok(())
    }
}

impl Drop for LinkDriver {
    fn drop(&mut self) {
        let header = Header { kind: Kind::Detach as u32, ..self.header };
        // When it fails there is no server; one that misses the message sees the port disappear.
        let _ = self.endpoint.send(header, &[], 0);
    }
}

/// Joins the domain and opens the ports, as soon as a server has made them.
fn open_endpoint(
    plant: &str,
    options: &LinkOptions,
    room: usize,
    deadline_ns: u64,
) -> Result<(LinkNode, Endpoint), LinkError> {
    loop {
        let opened = Domain::find(&options.root, plant).and_then(|domain| {
            domain.check_shared_memory(room)?;
            let node = domain.join("plantd-driver")?;
            let endpoint = Endpoint::driver(node.open_services(plant)?, room, options.wait)?;
            Ok((node, endpoint))
        });
        match opened {
            Err(error) if is_not_yet(&error) && monotonic_ns() < deadline_ns => {
                std::thread::sleep(LOOK_PERIOD);
            }
            opened => return Ok(opened?),
        }
    }
}

/// A server that starts, or drivers that come and go at this time, may still make it so.
fn is_not_yet(error: &DomainError) -> bool {
    match error {
        DomainError::NotOpen { .. }
        | DomainError::TooManyDrivers
        | DomainError::SegmentSize { .. } => true,
        DomainError::Root { source, .. } => source.kind() == std::io::ErrorKind::NotFound,
        _ => false,
    }
}

fn after(duration: Duration) -> u64 {
    monotonic_ns().saturating_add(duration.as_nanos().try_into().unwrap_or(u64::MAX))
}
