//! Feedback laws that come as gains: streamed by the server.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use plantd_proto::v1::{self, plant_service_client::PlantServiceClient};
use tokio::runtime::Handle;
use tokio::sync::Notify;
use tokio::task::JoinHandle;

use crate::connection::within;
use crate::credentials::AuthorizedChannel;
use crate::error::{Error, Refusal, Result};
use crate::messages::{GainExt as _, LawState, check};
use crate::schedule::{Law, input_of};
use crate::stream::Answers;

/// Gains of a trajectory that are kept ahead of the step asked for.
const WINDOW: usize = 1024;

/// The feedback law of a plant, applied here with the gains that the server streams.
///
/// ```no_run
/// # use plantd_client::{Client, v1};
/// # async fn follow(client: Client, id: &str) -> plantd_client::Result<()> {
/// let law = client.follow_gains(id).await?;
/// let mut driver = client.drive(id).await?;
/// let mut state = driver.plant().state.clone().unwrap_or_default();
/// loop {
///     let u = law.input(&state).await?;
///     state = driver.step(&u).await?.state.unwrap_or_default();
/// }
/// # }
/// ```
///
/// A task reads the stream. Along a trajectory it keeps the gains of the coming steps, at most 1024
/// of them, and [`input`](Self::input) waits where the gain of its step is not there yet; about an
/// operating point it keeps the latest. When the server computes the gains anew (a new revision),
/// those from before are forgotten. Dropping the follower ends the stream.
#[derive(Debug)]
pub struct Follower {
    shared: Arc<Shared>,
    /// Longest wait for a gain.
    timeout: Duration,
    runtime: Handle,
    task: JoinHandle<()>,
}

#[derive(Debug, Default)]
struct Shared {
    window: Mutex<Window>,
    /// Something has arrived.
    arrived: Notify,
    /// The step asked for has changed.
    asked: Notify,
}

impl Shared {
    fn window(&self) -> MutexGuard<'_, Window> {
        // Nothing that holds the lock can panic half-way.
        self.window.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What a follower knows.
#[derive(Debug, Default)]
struct Window {
    revision: u64,
    dropped: u64,
    first_step: u64,
    /// 0 about an operating point.
    horizon: u64,
    /// In the order of their steps; about an operating point one at most.
    gains: VecDeque<v1::Gain>,
    final_state: Option<Vec<f64>>,
    failure: Option<Refusal>,
    /// Step last asked for.
    step: u64,
    /// The plant has gone back: the stream is to be opened anew.
    is_behind: bool,
    /// Step for which that was done, until it has been answered.
    reopened_for: Option<u64>,
    end: Option<Ended>,
}

#[derive(Clone, Debug)]
enum Ended {
    Refused(Box<Refusal>),
    Closed,
    Protocol(&'static str),
}

impl From<Ended> for Error {
    fn from(end: Ended) -> Self {
        match end {
            Ended::Refused(refusal) => Self::Rpc(refusal),
            Ended::Closed => Self::StreamClosed,
            Ended::Protocol(what) => Self::Protocol(what),
        }
    }
}

impl From<Error> for Ended {
    fn from(error: Error) -> Self {
        match error {
            Error::Rpc(refusal) | Error::Step(refusal) => Self::Refused(refusal),
            Error::Protocol(what) => Self::Protocol(what),
            _ => Self::Closed,
        }
    }
}

impl Window {
    /// Takes in what the server sent.
    fn note(&mut self, message: v1::WatchGainsResponse) -> Result<()> {
        if message.revision != self.revision {
            self.gains.clear();
            self.final_state = None;
            self.revision = message.revision;
        }
        self.dropped = message.dropped;
        self.failure = message.failure.map(Refusal::from);
        self.first_step = message.first_step;
        self.horizon = message.horizon.into();
        let Some(gain) = message.gain else { return Ok(()) };
        check(&gain)?;
        if gain.k.is_none() {
            self.final_state = Some(gain.x_reference);
            return Ok(());
        }
        if self.horizon == 0 || self.gains.back().is_some_and(|last| last.step >= gain.step) {
            self.gains.clear();
        }
        self.gains.push_back(gain);
        self.forget();
        Ok(())
    }

    /// Drops the gains of steps that have gone by.
    fn forget(&mut self) {
        while self.gains.get(1).is_some_and(|next| next.step <= self.step) {
            self.gains.pop_front();
        }
    }

    /// The input at a state, if the gain of its step is there.
    fn input(&mut self, state: &impl LawState) -> Result<Option<Vec<f64>>> {
        self.step = state.step_index();
        self.forget();
        let step = self.step.max(self.first_step);
        let end = self.first_step + self.horizon;
        let Some(gain) = self.gains.front() else { return Ok(None) };
        if self.horizon == 0 || gain.step == step {
            self.reopened_for = None;
            return input_of(gain, state, None).map(Some);
        }
        if gain.step > step {
            if self.reopened_for == Some(self.step) {
                return Err(Error::GainPassed { step, first: gain.step });
            }
            self.is_behind = true;
            return Ok(None);
        }
        match &self.final_state {
            Some(x) if step >= end && gain.step + 1 == end => {
                input_of(gain, state, Some(x)).map(Some)
            }
            _ => Ok(None),
        }
    }

    /// There is room for another gain.
    fn has_room(&self) -> bool {
        self.horizon == 0 || self.gains.len() < WINDOW
    }

    /// Forgets everything but the step asked for.
    fn begin_anew(&mut self) {
        *self = Self { step: self.step, reopened_for: Some(self.step), ..Self::default() };
    }
}

/// Where the gains of a plant come from.
struct Source {
    plants: PlantServiceClient<AuthorizedChannel>,
    id: String,
    /// Longest wait for the stream to open, and for its first message.
    timeout: Duration,
}

impl Source {
    /// Opens the stream; the first message says whether there is a feedback at all.
    async fn open(&mut self) -> Result<(Answers<v1::WatchGainsResponse>, v1::WatchGainsResponse)> {
        let request = v1::WatchGainsRequest { id: self.id.clone() };
        let call = self.plants.watch_gains(request);
        let mut answers = Answers::open(self.timeout, call).await?;
        let first = within(self.timeout, answers.next()).await?;
        Ok((answers, first.ok_or(Error::StreamClosed)?))
    }
}

/// Reads the stream until it ends, and opens it anew when the plant has gone back.
async fn read(
    mut source: Source,
    mut answers: Answers<v1::WatchGainsResponse>,
    shared: &Shared,
) -> Ended {
    loop {
        let asked = shared.asked.notified();
        let (is_behind, has_room) = {
            let window = shared.window();
            (window.is_behind, window.has_room())
        };
        if is_behind {
            let first = match source.open().await {
                Ok((fresh, first)) => {
                    answers = fresh;
                    first
                }
                Err(error) => return error.into(),
            };
            let mut window = shared.window();
            window.begin_anew();
            if let Err(error) = window.note(first) {
                return error.into();
            }
            drop(window);
            shared.arrived.notify_waiters();
            continue;
        }
        if !has_room {
            asked.await;
            continue;
        }
        tokio::select! {
            message = answers.next() => match message {
                Ok(Some(message)) => {
                    if let Err(error) = shared.window().note(message) {
                        return error.into();
                    }
                    shared.arrived.notify_waiters();
                }
                Ok(None) => return Ended::Closed,
                Err(error) => return error.into(),
            },
            () = asked => {}
        }
    }
}

impl Follower {
    /// Opens the stream of a plant's gains and takes its first message in.
    pub(crate) async fn open(
        plants: PlantServiceClient<AuthorizedChannel>,
        id: String,
        timeout: Duration,
    ) -> Result<Self> {
        let mut source = Source { plants, id, timeout };
        let (answers, first) = source.open().await?;
        let shared = Arc::new(Shared::default());
        shared.window().note(first)?;
        let window = shared.clone();
        let task = tokio::spawn(async move {
            let end = read(source, answers, &window).await;
            window.window().end = Some(end);
            window.arrived.notify_waiters();
        });
        Ok(Self { shared, timeout, runtime: Handle::current(), task })
    }

    /// The input `u_reference + feedforward − K (x − x_reference)` at a state of the plant, with the
    /// gain of the state's step.
    ///
    /// # Errors
    /// The error with which the stream ended; along a trajectory only where the gains that came before
    /// do not cover the step. [`Error::StateLength`] and [`Error::GainTimeStep`] if the state is not one of
    /// this plant,
    /// [`Error::GainPassed`] if it is of a step that the plant has left behind, `DEADLINE_EXCEEDED` if
    /// the gain does not come within the connection's request timeout.
    pub async fn input(&self, state: &impl LawState) -> Result<Vec<f64>> {
        if let Some(u) = self.try_input(state)? {
            return Ok(u);
        }
        within(self.timeout, self.wait_for_input(state)).await
    }

    /// The input at a state for a thread outside the runtime, such as one that steps a
    /// [`LinkDriver`](crate::link::LinkDriver); see [`input`](Self::input). The runtime must have
    /// threads of its own.
    ///
    /// # Panics
    /// If it is called on a thread of an asynchronous runtime and the gain is not there yet.
    pub fn blocking_input(&self, state: &impl LawState) -> Result<Vec<f64>> {
        match self.try_input(state)? {
            Some(u) => Ok(u),
            None => self.runtime.block_on(self.input(state)),
        }
    }

    /// The input at a state without waiting; `None` if the gain of the state's step is not there yet.
    pub fn try_input(&self, state: &impl LawState) -> Result<Option<Vec<f64>>> {
        let mut window = self.shared.window();
        let had_room = window.has_room();
        let u = window.input(state)?;
        let end = window.end.clone().filter(|_| u.is_none() || window.horizon == 0);
        let must_wake = window.is_behind || (!had_room && window.has_room());
        drop(window);
        if must_wake {
            self.shared.asked.notify_one();
        }
        match end {
            Some(end) => Err(end.into()),
            None => Ok(u),
        }
    }

    async fn wait_for_input(&self, state: &impl LawState) -> Result<Vec<f64>> {
        loop {
            let arrived = self.shared.arrived.notified();
            tokio::pin!(arrived);
            // Before the look, so that nothing arrives unnoticed in between.
            arrived.as_mut().enable();
            if let Some(u) = self.try_input(state)? {
                return Ok(u);
            }
            arrived.await;
        }
    }

    /// Of which computation the gains are; a new number means that the server has computed them anew.
    pub fn revision(&self) -> u64 {
        self.shared.window().revision
    }

    /// Revisions that were replaced before this follower saw them.
    pub fn dropped(&self) -> u64 {
        self.shared.window().dropped
    }

    /// Why the gains in force are still those of the parameters before, if the server's last
    /// computation failed.
    pub fn failure(&self) -> Option<Refusal> {
        self.shared.window().failure.clone()
    }

    /// Steps of the trajectory; 0 about an operating point.
    pub fn horizon(&self) -> u64 {
        self.shared.window().horizon
    }

    /// The error with which the stream has ended; `None` while it goes on.
    pub fn end(&self) -> Option<Error> {
        self.shared.window().end.clone().map(Error::from)
    }
}

impl Law for Follower {
    /// Compares what the gains say of themselves that have arrived.
    fn check_plant(&self, plant: &v1::PlantInfo) -> Result<()> {
        self.shared.window().gains.front().map_or(Ok(()), |gain| gain.suits(plant))
    }

    async fn input_at(&self, state: &v1::State) -> Result<Vec<f64>> {
        self.input(state).await
    }
}

impl Drop for Follower {
    fn drop(&mut self) {
        self.task.abort();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schedule::tests::{end_state, gain, state};

    fn message(revision: u64, gain: v1::Gain, horizon: u32) -> v1::WatchGainsResponse {
        v1::WatchGainsResponse {
            gain: Some(gain),
            revision,
            first_step: if horizon > 0 { 10 } else { 0 },
            horizon,
            ..Default::default()
        }
    }

    #[test]
    fn a_window_waits_for_the_step_and_forgets_what_has_gone_by() {
        let mut window = Window::default();
        for k in 10..12 {
            window.note(message(1, gain(k, k as f64, 0.0), 3)).unwrap();
        }
        // Before the first step its gain holds.
        assert_eq!(window.input(&state(4, 1.0)).unwrap(), Some(vec![-10.0]));
        assert_eq!(window.input(&state(11, 1.0)).unwrap(), Some(vec![-11.0]));
        assert_eq!(window.gains.len(), 1);
        assert_eq!(window.input(&state(12, 1.0)).unwrap(), None);
        window.note(message(1, gain(12, 12.0, 0.0), 3)).unwrap();
        assert_eq!(window.input(&state(12, 1.0)).unwrap(), Some(vec![-12.0]));
        // The end: only the final state tells about what the last gain holds.
        assert_eq!(window.input(&state(13, 1.0)).unwrap(), None);
        window.note(message(1, end_state(13, 1.0), 3)).unwrap();
        assert_eq!(window.input(&state(40, 1.0)).unwrap(), Some(vec![0.0]));
        // A plant that went back asks for the stream to be opened anew, once.
        assert_eq!(window.input(&state(10, 1.0)).unwrap(), None);
        assert!(window.is_behind);
        window.begin_anew();
        window.note(message(1, gain(12, 12.0, 0.0), 3)).unwrap();
        let passed = window.input(&state(10, 1.0)).unwrap_err();
        assert!(matches!(passed, Error::GainPassed { step: 10, first: 12 }));
        assert!(window.input(&state(12, 1.0)).unwrap().is_some());
    }

    #[test]
    fn a_new_revision_replaces_everything() {
        let mut window = Window::default();
        window.note(message(1, gain(10, 1.0, 0.0), 2)).unwrap();
        window.note(message(2, gain(11, 3.0, 0.0), 2)).unwrap();
        assert_eq!((window.gains.len(), window.revision), (1, 2));
        window.note(message(3, gain(20, 4.0, 0.0), 0)).unwrap();
        window.note(message(4, gain(30, 5.0, 0.0), 0)).unwrap();
        assert_eq!(window.input(&state(25, 1.0)).unwrap(), Some(vec![-5.0]));
        let failed = v1::WatchGainsResponse {
            revision: 4,
            failure: Some(v1::Failure { reason: "NOT_STABILISABLE".into(), ..Default::default() }),
            ..Default::default()
        };
        window.note(failed).unwrap();
        assert_eq!(window.input(&state(26, 1.0)).unwrap(), Some(vec![-5.0]));
        assert_eq!(window.failure.as_ref().unwrap().reason, "NOT_STABILISABLE");
        let odd = v1::Gain { x_reference: vec![0.0], ..gain(31, 1.0, 0.0) };
        assert!(window.note(message(5, odd, 0)).is_err());
    }
}
