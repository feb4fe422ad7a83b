//! Which input a loop applies when its driver is late, silent or gone.

use crate::core::publish::frame::Timing;
use crate::core::realtime::slot::{Arrival, InputSlot};

/// What a loop does without a valid input.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum InputAction {
    /// The last input acts on.
    #[default]
    Hold,
    /// The safe input acts at once.
    Safe,
    /// The input goes to the safe one along a straight line, in so many seconds of plant time.
    Ramp {
        /// Its duration, s.
        duration_s: f64,
    },
    /// The plant stands still.
    Stop,
}

/// What is to be done without a valid input.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct InputPolicy {
    /// An input is valid for this long, s of plant time; 0 means for ever.
    pub timeout_s: f64,
    /// What to do when there is none.
    pub action: InputAction,
    /// The safe input: forces, then next prescribed positions; empty for no forces and prescribed
    /// coordinates that stay where they are.
    pub safe: Vec<f64>,
    /// Once it acts, the safe input acts until the plant is run anew; otherwise until the next input.
    pub latch: bool,
}

/// The input of a loop, step by step. Allocates nothing after its construction.
#[derive(Debug)]
pub(super) struct LoopInput {
    policy: InputPolicy,
    /// What the loop applies.
    u: Vec<f64>,
    /// What it applied when the input was lost.
    lost_at: Vec<f64>,
    /// Room for what the slot has.
    fresh: Vec<f64>,
    /// Number of input forces; prescribed positions come after them.
    forces: usize,
    last: Arrival,
    /// Steps since the last input came; `None` while there is none.
    age_steps: Option<u64>,
    /// Steps since the safe input acts.
    lost_steps: Option<u64>,
}

/// What became of the input in a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Change {
    None,
    /// The safe input begins to act.
    Lost,
    /// The driver's input acts again.
    Back,
    /// The plant is to stand still.
    Stop,
}

impl LoopInput {
    /// `u` is what acts before the next input comes; `is_valid` when it is a driver's.
    pub(super) fn new(policy: InputPolicy, u: Vec<f64>, forces: usize, is_valid: bool) -> Self {
        let (lost_at, fresh) = (u.clone(), u.clone());
        let (last, age_steps) = (Arrival::default(), is_valid.then_some(0));
        Self { policy, u, lost_at, fresh, forces, last, age_steps, lost_steps: None }
    }

    /// The input of the step.
    pub(super) fn u(&self) -> &[f64] {
        &self.u
    }

    /// Looks for a new input under the lease of that number, 0 for none, and decides what acts in the
    /// step that begins `now_ns`.
    pub(super) fn next(
        &mut self,
        slot: &InputSlot,
        lease: u64,
        now_ns: u64,
        time_step_s: f64,
        timing: &mut Timing,
    ) -> Change {
        let is_latched = self.policy.latch && self.lost_steps.is_some();
        let arrival = slot.take(&mut self.fresh).filter(|a| lease != 0 && a.lease == lease);
        let arrival = arrival.filter(|_| !is_latched);
        let was_lost = self.lost_steps.is_some();
        timing.flags = 0;
        let change = match arrival {
            Some(arrival) => {
                self.u.copy_from_slice(&self.fresh);
                self.last = arrival;
                self.age_steps = Some(0);
                self.lost_steps = None;
                if was_lost { Change::Back } else { Change::None }
            }
            None => {
                timing.flags |= Timing::LATE;
                self.age_steps = self.age_steps.filter(|_| lease != 0).map(|age| age + 1);
                let is_valid =
                    self.age_steps.is_some_and(|age| !self.is_outdated(age, time_step_s));
                if is_valid && !is_latched { Change::None } else { self.go_without(time_step_s) }
            }
        };
        if self.lost_steps.is_some() {
            timing.flags |= Timing::SAFE;
        }
        // The number of another driver's input says nothing to this one.
        let last = if self.last.lease == lease { self.last } else { Arrival::default() };
        timing.input_sequence = last.sequence;
        timing.input_age_ns = match last.arrived_ns {
            0 => 0,
            arrived_ns => now_ns.saturating_sub(arrived_ns),
        };
        change
    }

    /// Time since the last input came, s of plant time.
    pub(super) fn age_s(&self, time_step_s: f64) -> f64 {
        self.age_steps.map_or(0.0, |steps| steps as f64 * time_step_s)
    }

    fn is_outdated(&self, age_steps: u64, time_step_s: f64) -> bool {
        // Half a step of tolerance: a timeout of whole steps is meant exactly.
        let limit_s = self.policy.timeout_s + 0.5 * time_step_s;
        self.policy.timeout_s > 0.0 && age_steps as f64 * time_step_s > limit_s
    }

    /// One more step without a valid input.
    fn go_without(&mut self, time_step_s: f64) -> Change {
        let step = self.lost_steps.map_or(1, |steps| steps + 1);
        if step == 1 {
            self.lost_at.copy_from_slice(&self.u);
        }
        self.lost_steps = Some(step);
        match self.policy.action {
            InputAction::Hold => {}
            InputAction::Safe => self.blend(1.0),
            InputAction::Ramp { duration_s } => {
                let steps = (duration_s / time_step_s).round().max(1.0);
                self.blend((step as f64 / steps).min(1.0));
            }
            InputAction::Stop => return Change::Stop,
        }
        if step == 1 { Change::Lost } else { Change::None }
    }

    /// So much of the way from the input that was lost to the safe one.
    fn blend(&mut self, part: f64) {
        for (i, (u, lost_at)) in self.u.iter_mut().zip(&self.lost_at).enumerate() {
            let rest = if i < self.forces { 0.0 } else { *lost_at };
            let safe = self.policy.safe.get(i).copied().unwrap_or(rest);
            *u = if part < 1.0 { lost_at + part * (safe - lost_at) } else { safe };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP_S: f64 = 0.01;

    /// A loop of one force and one prescribed coordinate, held at 5.
    struct Loop {
        slot: InputSlot,
        input: LoopInput,
        sequence: u64,
        lease: u64,
    }

    impl Loop {
        fn new(policy: InputPolicy) -> Self {
            let input = LoopInput::new(policy, vec![0.0, 5.0], 1, false);
            Self { slot: InputSlot::new(2), input, sequence: 0, lease: 1 }
        }

        fn put(&mut self, u: [f64; 2]) {
            self.sequence += 1;
            let (lease, sequence) = (self.lease, self.sequence);
            self.slot.put(Arrival { lease, sequence, arrived_ns: 1_000 * sequence }, &u);
        }

        fn step(&mut self) -> (Vec<f64>, Change, Timing) {
            let mut timing = Timing::default();
            let lease = self.lease;
            let change = self.input.next(&self.slot, lease, 1_000_000, STEP_S, &mut timing);
            (self.input.u().to_vec(), change, timing)
        }

        fn steps(&mut self, count: usize) -> Vec<f64> {
            (0..count).map(|_| self.step().0[0]).collect()
        }
    }

    #[test]
    fn without_a_timeout_a_late_input_is_held_for_ever() {
        let mut plant = Loop::new(InputPolicy::default());
        plant.put([2.0, 6.0]);
        let (u, change, timing) = plant.step();
        assert_eq!((u, change, timing.flags), (vec![2.0, 6.0], Change::None, 0));
        assert_eq!((timing.input_sequence, timing.input_age_ns), (1, 999_000));
        for _ in 0..1000 {
            let (u, change, timing) = plant.step();
            assert_eq!((u, change, timing.flags), (vec![2.0, 6.0], Change::None, Timing::LATE));
        }
    }

    #[test]
    fn after_the_timeout_the_safe_input_acts_until_the_next_one_comes() {
        let policy =
            InputPolicy { timeout_s: 0.03, action: InputAction::Safe, ..InputPolicy::default() };
        let mut plant = Loop::new(policy);
        plant.put([2.0, 6.0]);
        assert_eq!(plant.steps(4), [2.0, 2.0, 2.0, 2.0]);
        let (u, change, timing) = plant.step();
        // Forces vanish, prescribed coordinates stay.
        assert_eq!((u, change), (vec![0.0, 6.0], Change::Lost));
        assert_eq!(timing.flags, Timing::LATE | Timing::SAFE);
        assert_eq!(plant.step().1, Change::None);
        plant.put([3.0, 7.0]);
        let (u, change, timing) = plant.step();
        assert_eq!((u, change, timing.flags), (vec![3.0, 7.0], Change::Back, 0));
    }

    #[test]
    fn a_latched_policy_stays_safe() {
        let policy = InputPolicy {
            timeout_s: 0.01,
            action: InputAction::Safe,
            safe: vec![-1.0],
            latch: true,
        };
        let mut plant = Loop::new(policy);
        plant.put([2.0, 6.0]);
        assert_eq!(plant.steps(3), [2.0, 2.0, -1.0]);
        plant.put([3.0, 6.0]);
        assert_eq!(plant.steps(2), [-1.0, -1.0]);
    }

    #[test]
    fn a_ramp_is_straight_and_ends_at_the_safe_input() {
        let action = InputAction::Ramp { duration_s: 0.04 };
        let policy = InputPolicy { timeout_s: 0.01, action, safe: vec![6.0, 1.0], latch: false };
        let mut plant = Loop::new(policy);
        plant.put([2.0, 5.0]);
        assert_eq!(plant.steps(7), [2.0, 2.0, 3.0, 4.0, 5.0, 6.0, 6.0]);
        assert_eq!(plant.input.u(), [6.0, 1.0]);
    }

    #[test]
    fn a_driver_that_leaves_is_an_input_that_is_lost() {
        let mut plant = Loop::new(InputPolicy { action: InputAction::Safe, ..Default::default() });
        plant.put([2.0, 6.0]);
        assert_eq!(plant.steps(2), [2.0, 2.0]);
        plant.put([9.0, 9.0]);
        plant.lease = 0;
        let (u, change, _) = plant.step();
        assert_eq!((u, change), (vec![0.0, 6.0], Change::Lost));
        // What one driver left in the slot is not the next one's.
        plant.lease = 1;
        plant.put([9.0, 9.0]);
        plant.lease = 2;
        assert_eq!(plant.step().0, [0.0, 6.0]);
        plant.put([4.0, 6.0]);
        assert_eq!(plant.step().1, Change::Back);
    }

    #[test]
    fn before_the_first_input_the_plant_is_held_and_may_be_stopped() {
        let mut plant = Loop::new(InputPolicy::default());
        let (u, change, timing) = plant.step();
        assert_eq!((u, change), (vec![0.0, 5.0], Change::Lost));
        assert_eq!(timing.flags, Timing::LATE | Timing::SAFE);
        let mut plant = Loop::new(InputPolicy { action: InputAction::Stop, ..Default::default() });
        assert_eq!(plant.step().1, Change::Stop);
    }
}
