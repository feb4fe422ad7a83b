//! Feedback laws that come as gains: collected beforehand.

use std::borrow::Cow;

use plantd_proto::v1;

use crate::error::{Error, Result};
use crate::link::driver::StateView;
use crate::messages::{GainExt as _, LawState, check};

/// A feedback law: a [`Gain`](v1::Gain), a [`GainSchedule`] or a [`Follower`](crate::Follower).
pub trait Law {
    /// Whether it is for such a plant, as far as it knows what it is for.
    ///
    /// # Errors
    /// As [`GainExt::suits`](crate::GainExt::suits).
    fn check_plant(&self, plant: &v1::PlantInfo) -> Result<()>;
    /// Its input at a state; a [`Follower`](crate::Follower) may wait for the gain of the step.
    ///
    /// # Errors
    /// As [`GainExt::control`](crate::GainExt::control), and what keeps a follower from its gain.
    fn input_at(&self, state: &v1::State) -> impl Future<Output = Result<Vec<f64>>> + Send;
}

impl Law for v1::Gain {
    fn check_plant(&self, plant: &v1::PlantInfo) -> Result<()> {
        self.suits(plant)
    }

    async fn input_at(&self, state: &v1::State) -> Result<Vec<f64>> {
        self.control(state)
    }
}

impl Law for GainSchedule {
    fn check_plant(&self, plant: &v1::PlantInfo) -> Result<()> {
        // They may be of different origin.
        self.gains.iter().try_for_each(|gain| gain.suits(plant))
    }

    async fn input_at(&self, state: &v1::State) -> Result<Vec<f64>> {
        self.input(state)
    }
}

impl LawState for StateView<'_> {
    fn step_index(&self) -> u64 {
        self.step
    }

    fn state_vector(&self) -> Cow<'_, [f64]> {
        Cow::Borrowed(self.x)
    }

    fn time_step_s(&self) -> Option<f64> {
        Some(self.time_step_s)
    }
}

/// `gain`'s input at `state`, about another reference state if one is given.
pub(crate) fn input_of(
    gain: &v1::Gain,
    state: &impl LawState,
    about: Option<&[f64]>,
) -> Result<Vec<f64>> {
    match about {
        None => gain.control(state),
        Some(x_reference) => {
            v1::Gain { x_reference: x_reference.to_vec(), ..gain.clone() }.control(state)
        }
    }
}

/// Time-varying gains as a feedback law: those of `SolveTrajectoryLqr` or of `ProjectReference`, or
/// gains of one's own.
///
/// ```no_run
/// use plantd_client::{Client, GainSchedule, v1};
///
/// # async fn track(client: Client, request: v1::SolveTrajectoryLqrRequest) -> plantd_client::Result<()> {
/// let answers = client.solve_trajectory_lqr(request).await?.collect().await?;
/// let law = GainSchedule::from_gains(answers.into_iter().filter_map(|answer| answer.gain))?;
/// let mut driver = client.drive("pendulum").await?;
/// let mut state = driver.plant().state.clone().expect("a plant has a state");
/// for _ in law.gains() {
///     state = driver.step(&law.input(&state)?).await?.state.expect("a step has a state");
/// }
/// # Ok(())
/// # }
/// ```
///
/// Before the first gain's step that gain holds about its own reference; after the last one the last
/// gain holds, about the final state if the gains end with one.
#[derive(Clone, Debug, PartialEq)]
pub struct GainSchedule {
    /// In the order of their steps, none without `k`.
    gains: Vec<v1::Gain>,
    final_state: Option<Vec<f64>>,
}

impl GainSchedule {
    /// A schedule of gains in the order of their steps; the last may hold only the final reference
    /// state, as `SolveTrajectoryLqr` sends it.
    ///
    /// # Errors
    /// [`Error::Gains`] if there is none, if steps do not increase or if sizes do not fit.
    pub fn from_gains(gains: impl IntoIterator<Item = v1::Gain>) -> Result<Self> {
        let mut gains: Vec<_> = gains.into_iter().collect();
        let final_state = match gains.last() {
            Some(last) if last.k.is_none() => gains.pop().map(|last| last.x_reference),
            _ => None,
        };
        let first = gains.first().ok_or(Error::Gains("there is no gain with `k`"))?;
        let (states, inputs) = (first.x_reference.len(), first.u_reference.len());
        for gain in &gains {
            if gain.k.is_none() {
                return Err(Error::Gains("only the last one may be without `k`"));
            }
            check(gain).map_err(|_| Error::Gains("`k` does not fit the references"))?;
            if (gain.x_reference.len(), gain.u_reference.len()) != (states, inputs) {
                return Err(Error::Gains("their references differ in length"));
            }
        }
        if final_state.as_ref().is_some_and(|x| x.len() != states) {
            return Err(Error::Gains("the final state differs in length from the references"));
        }
        if gains.windows(2).any(|pair| pair[0].step >= pair[1].step) {
            return Err(Error::Gains("their steps do not increase"));
        }
        Ok(Self { gains, final_state })
    }

    /// Moves the gains in time, so that the first one is that of this step of a plant.
    #[must_use]
    pub fn starting_at(mut self, step: u64) -> Self {
        let first = self.gains[0].step;
        for gain in &mut self.gains {
            gain.step = gain.step - first + step;
        }
        self
    }

    /// The gains, without the message that holds only the final state.
    pub fn gains(&self) -> &[v1::Gain] {
        &self.gains
    }

    /// The gain that holds at a step.
    pub fn gain_at(&self, step: u64) -> &v1::Gain {
        let after = self.gains.partition_point(|gain| gain.step <= step);
        &self.gains[after.saturating_sub(1)]
    }

    /// The input `u_reference + feedforward − K (x − x_reference)` at a state.
    ///
    /// # Errors
    /// As [`GainExt::control`](crate::GainExt::control).
    pub fn input(&self, state: &impl LawState) -> Result<Vec<f64>> {
        let step = state.step_index();
        let last = self.gains[self.gains.len() - 1].step;
        let about = self.final_state.as_deref().filter(|_| step > last);
        input_of(self.gain_at(step), state, about)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::messages::MatrixExt as _;

    pub(crate) fn gain(step: u64, k: f64, reference: f64) -> v1::Gain {
        v1::Gain {
            step,
            k: Some(v1::Matrix::from_rows(&[[k, 0.0]])),
            x_reference: vec![reference, 0.0],
            u_reference: vec![0.0],
            ..Default::default()
        }
    }

    pub(crate) fn end_state(step: u64, reference: f64) -> v1::Gain {
        v1::Gain { step, x_reference: vec![reference, 0.0], ..Default::default() }
    }

    pub(crate) fn state(step: u64, q: f64) -> v1::State {
        v1::State { step, q: vec![q], p: vec![0.0], ..Default::default() }
    }

    #[test]
    fn a_schedule_holds_its_ends() {
        let gains = [gain(0, 1.0, 0.0), gain(1, 2.0, 1.0), end_state(2, 5.0)];
        let law = GainSchedule::from_gains(gains).unwrap().starting_at(7);
        let at = |step, q| law.input(&state(step, q)).unwrap()[0];
        assert_eq!(at(0, 1.0), -1.0);
        assert_eq!(at(7, 1.0), -1.0);
        assert_eq!(at(8, 2.0), -2.0);
        assert_eq!(at(9, 6.0), -2.0);
        assert_eq!(at(1000, 5.0), 0.0);
        assert_eq!(law.gains().len(), 2);
    }

    #[test]
    fn a_schedule_says_what_is_wrong_with_its_gains() {
        for (gains, part) in [
            (vec![], "no gain"),
            (vec![end_state(0, 0.0), gain(1, 1.0, 0.0)], "only the last"),
            (vec![gain(1, 1.0, 0.0), gain(1, 1.0, 0.0)], "increase"),
            (vec![v1::Gain { u_reference: vec![], ..gain(0, 1.0, 0.0) }], "fit"),
            (
                vec![gain(0, 1.0, 0.0), v1::Gain { x_reference: vec![], ..end_state(1, 0.0) }],
                "final state",
            ),
        ] {
            let error = GainSchedule::from_gains(gains).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
        let law = GainSchedule::from_gains([gain(0, 1.0, 0.0)]).unwrap();
        let short = v1::State::default();
        assert!(matches!(law.input(&short), Err(Error::StateLength { expected: 2, actual: 0 })));
    }
}
