//! Driving a plant: one message per step each way.

use std::time::Duration;

use plantd_proto::v1::{self, plant_service_client::PlantServiceClient};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

use crate::connection::within;
use crate::credentials::AuthorizedChannel;
use crate::error::{Error, Result};
use crate::schedule::Law;

/// Holds the lease of a plant: steps it in lockstep, or gives inputs to one that runs by itself.
///
/// ```no_run
/// # async fn damp(client: plantd_client::Client) -> plantd_client::Result<()> {
/// let mut driver = client.drive("pendulum").await?;
/// let mut torque = 0.0;
/// for _ in 0..1000 {
///     let state = driver.step(&[torque]).await?.state.expect("a step has a state");
///     torque = -0.5 * state.p[0];
/// }
/// driver.close().await
/// # }
/// ```
///
/// The lease ends when the driver is dropped; [`Driver::close`] also waits for the server to have
/// noticed, so that the next driver is sure to be let in.
#[derive(Debug)]
pub struct Driver {
    requests: mpsc::Sender<v1::DriveRequest>,
    responses: tonic::Streaming<v1::DriveResponse>,
    plant: v1::PlantInfo,
    last: Option<v1::DriveStep>,
    lease_token: String,
    sequence: u64,
    /// When the last state was there, on the server's clock.
    answers_ns: u64,
    step_timeout: Duration,
}

impl Driver {
    pub(crate) async fn open(
        mut plants: PlantServiceClient<AuthorizedChannel>,
        open: v1::DriveOpen,
        step_timeout: Duration,
    ) -> Result<Self> {
        // One message is ever under way, so one place is enough.
        let (requests, queue) = mpsc::channel(1);
        let open = v1::drive_request::Request::Open(open);
        requests.try_send(v1::DriveRequest { request: Some(open) }).expect("the queue is empty");
        let call = plants.drive(ReceiverStream::new(queue));
        let mut responses = within(step_timeout, call).await?.into_inner();
        let opened = within(step_timeout, responses.message()).await?;
        let Some(v1::DriveResponse {
            response: Some(v1::drive_response::Response::Opened(opened)),
        }) = opened
        else {
            return Err(Error::Protocol("Drive did not begin with `opened`"));
        };
        let plant = opened.plant.ok_or(Error::Protocol("`opened` without a plant"))?;
        let lease_token = opened.lease_token;
        Ok(Self {
            requests,
            responses,
            plant,
            last: opened.last,
            lease_token,
            sequence: 0,
            answers_ns: 0,
            step_timeout,
        })
    }

    /// The plant as it was when the driver opened it.
    pub fn plant(&self) -> &v1::PlantInfo {
        &self.plant
    }

    /// The last step that the plant had taken then, if it had taken one.
    pub fn last(&self) -> Option<&v1::DriveStep> {
        self.last.as_ref()
    }

    /// Names the lease, to go on with it after the connection broke; empty if no grace was asked for.
    pub fn lease_token(&self) -> &str {
        &self.lease_token
    }

    /// Takes one step with the input `u` (input forces, then next prescribed positions). Of a plant that
    /// runs by itself: waits for the first step on which the input acted, so that the same loop drives
    /// both.
    ///
    /// # Errors
    /// [`Error::Step`] if the step was refused or failed: the plant is where it was and the driver
    /// goes on. Any other error means that the driver has lost the plant.
    pub async fn step(&mut self, u: &[f64]) -> Result<v1::DriveStep> {
        self.sequence += 1;
        self.send(u).await?;
        let answer = answer(&mut self.responses, self.sequence);
        let step = within(self.step_timeout, answer).await?;
        self.answers_ns = step.clocks.map_or(0, |clocks| clocks.monotonic_ns);
        Ok(step)
    }

    /// Takes one step with the input that a law has at the plant's last state: [`step`](Self::step), with a law
    /// that is refused unless it is for this plant.
    ///
    /// ```no_run
    /// # use plantd_client::{Client, v1};
    /// # async fn hold(client: Client, gain: v1::Gain) -> plantd_client::Result<()> {
    /// let mut driver = client.drive("pendulum").await?;
    /// let mut state = driver.plant().state.clone().expect("a plant has a state");
    /// loop {
    ///     state = driver.step_by(&gain, &state).await?.state.expect("a step has a state");
    /// }
    /// # }
    /// ```
    ///
    /// # Errors
    /// Those of [`step`](Self::step). [`Error::GainModel`], [`Error::GainTimeStep`] and [`Error::StateLength`] if
    /// the law was computed for another plant than this one is, as it was when the driver opened it: no step is
    /// taken, and the driver goes on.
    pub async fn step_by(&mut self, law: &impl Law, state: &v1::State) -> Result<v1::DriveStep> {
        law.check_plant(&self.plant)?;
        let u = law.input_at(state).await?;
        self.step(&u).await
    }

    /// Gives a plant that runs by itself an input, which acts from its next step on, and does not wait.
    pub async fn offer(&mut self, u: &[f64]) -> Result<()> {
        self.sequence += 1;
        self.send(u).await
    }

    /// Waits for the next state of a plant that runs by itself: the latest, with the number of those
    /// that were passed over.
    ///
    /// # Errors
    /// [`Error::Step`] if an input was refused. Any other error means that the driver has lost the plant.
    pub async fn next(&mut self) -> Result<v1::DriveStep> {
        let step = within(self.step_timeout, next_state(&mut self.responses)).await?;
        self.answers_ns = step.clocks.map_or(0, |clocks| clocks.monotonic_ns);
        Ok(step)
    }

    async fn send(&mut self, u: &[f64]) -> Result<()> {
        let (sequence, answers_ns) = (self.sequence, self.answers_ns);
        let input = v1::DriveInput { sequence, u: u.to_vec(), answers_ns };
        let request = v1::drive_request::Request::Input(input);
        match self.requests.send(v1::DriveRequest { request: Some(request) }).await {
            Ok(()) => Ok(()),
            // The server has hung up; its last message says why.
            Err(_) => Err(self.ending().await),
        }
    }

    /// Gives the lease back and waits until the server has done so.
    pub async fn close(self) -> Result<()> {
        let Self { requests, mut responses, step_timeout, .. } = self;
        drop(requests);
        within(step_timeout, async {
            while responses.message().await?.is_some() {}
            Ok::<_, Error>(())
        })
        .await
    }

    async fn ending(&mut self) -> Error {
        loop {
            match within(self.step_timeout, self.responses.message()).await {
                Ok(Some(_)) => {}
                Ok(None) => return Error::StreamClosed,
                Err(error) => return error,
            }
        }
    }
}

/// Waits for a state, whatever input acted.
async fn next_state(responses: &mut tonic::Streaming<v1::DriveResponse>) -> Result<v1::DriveStep> {
    use v1::drive_response::Response;
    match responses.message().await?.ok_or(Error::StreamClosed)?.response {
        Some(Response::Step(step)) => Ok(step),
        Some(Response::Failure(v1::DriveFailure { failure, .. })) => {
            let failure = failure.ok_or(Error::Protocol("a failed step without a cause"))?;
            Err(Error::Step(Box::new(failure.into())))
        }
        _ => Err(Error::Protocol("Drive answered what was not asked")),
    }
}

/// Waits for the answer to input `sequence`. Earlier ones belong to steps whose future was dropped.
async fn answer(
    responses: &mut tonic::Streaming<v1::DriveResponse>,
    sequence: u64,
) -> Result<v1::DriveStep> {
    use v1::drive_response::Response;
    loop {
        let message = responses.message().await?.ok_or(Error::StreamClosed)?;
        match message.response {
            Some(Response::Step(step)) if step.sequence == sequence => return Ok(step),
            Some(Response::Failure(v1::DriveFailure { sequence: s, failure })) if s == sequence => {
                let failure = failure.ok_or(Error::Protocol("a failed step without a cause"))?;
                return Err(Error::Step(Box::new(failure.into())));
            }
            Some(Response::Step(v1::DriveStep { sequence: s, .. }))
            | Some(Response::Failure(v1::DriveFailure { sequence: s, .. }))
                if s < sequence => {}
            _ => return Err(Error::Protocol("Drive answered what was not asked")),
        }
    }
}
