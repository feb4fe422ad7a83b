//! The guess with which a step begins: increments of past steps, extrapolated.
//!
//! The polynomial through the last `m` increments predicts `x[k+1] = Σ ∇ʲx[k]`, `j < m`, with the backward
//! differences `∇⁰x[k] = x[k]`, `∇ʲ⁺¹x[k] = ∇ʲx[k] − ∇ʲx[k−1]`. What such a prediction is off by is the
//! difference `∇ᵐx[k+1]`: the differences of an increment tell how good each order has been, and the next
//! step takes the best. A smooth motion is predicted to many digits, and one that is pushed around is not
//! extrapolated far.
//!
//! Steps of uneven length interpolate velocities nearby ([`Trail`]); collocation goes on with its polynomial
//! ([`Stages`]).

use crate::integrator::scheme::{STAGES_MAX, Scheme, Tableau};

/// What the next step is guessed from.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Past {
    Increments(Predictor),
    Trail(Trail),
    Stages(Stages),
}

impl Past {
    pub(crate) fn new(scheme: Scheme, coordinates: usize) -> Self {
        match scheme {
            Scheme::Midpoint => Self::Increments(Predictor::new(coordinates)),
            Scheme::Composition(_) => Self::Trail(Trail::new(coordinates)),
            Scheme::Gauss(stages) => Self::Stages(Stages::new(coordinates, stages)),
        }
    }

    /// Writes the increments of the next step, of length `h`; false if there is nothing to guess from.
    pub(crate) fn predict(&self, h: f64, increments: &mut [f64]) -> bool {
        match self {
            Self::Increments(past) if past.history > 0 => past.predict(increments),
            Self::Trail(past) if past.length > 0 => past.predict(h, increments),
            _ => return false,
        }
        true
    }

    /// Takes note of a step of length `h`. The error of all coordinates is weighed by their `inertia`.
    #[inline(never)]
    pub(crate) fn record(&mut self, h: f64, increments: &[f64], inertia: &[f64]) {
        match self {
            Self::Increments(past) => past.record(increments, inertia),
            Self::Trail(past) => past.record(h, increments),
            Self::Stages(_) => {}
        }
    }

    /// Steps are longer by a factor from now on.
    pub(crate) fn stretch(&mut self, factor: f64) {
        match self {
            Self::Increments(past) => past.stretch(factor),
            Self::Trail(_) => {}
            Self::Stages(past) => past.is_even = false,
        }
    }

    /// Its kind and its counts, for snapshots.
    pub(crate) fn code(&self) -> [u8; 3] {
        match self {
            Self::Increments(past) => [0, past.history, past.order],
            Self::Trail(past) => [1, past.length, 0],
            Self::Stages(past) => {
                [2, u8::from(past.is_known) + 2 * u8::from(past.is_even), past.stages]
            }
        }
    }

    /// The past with that code, without its numbers; `None` if the code
    /// has no meaning. Nothing is allocated before [`Past::make_room`].
    pub(crate) fn from_code(code: [u8; 3]) -> Option<Self> {
        let longest = LENGTH as u8;
        match code {
            [0, history, order] if history <= longest && order <= history => {
                Some(Self::Increments(Predictor { differences: Vec::new(), history, order }))
            }
            [1, length, 0] if length <= longest => {
                Some(Self::Trail(Trail { entries: Vec::new(), length }))
            }
            [2, flags, stages] if flags < 4 && (2..=STAGES_MAX as u8).contains(&stages) => {
                let (is_known, is_even) = (flags & 1 == 1, flags & 2 == 2);
                Some(Self::Stages(Stages { motion: Vec::new(), stages, is_known, is_even }))
            }
            _ => None,
        }
    }

    /// Numbers that it keeps for so many coordinates.
    pub(crate) fn length(&self, coordinates: usize) -> usize {
        match self {
            Self::Increments(_) => LENGTH * coordinates,
            Self::Trail(_) => LENGTH * (1 + coordinates),
            Self::Stages(past) => 2 * usize::from(past.stages) * coordinates,
        }
    }

    /// Makes room for its numbers.
    pub(crate) fn make_room(&mut self, coordinates: usize) {
        let length = self.length(coordinates);
        match self {
            Self::Increments(past) => past.differences.resize(coordinates, [0.0; LENGTH]),
            Self::Trail(past) => past.entries.resize(1 + coordinates, [0.0; LENGTH]),
            Self::Stages(past) => past.motion.resize(length, 0.0),
        }
    }

    /// Whether the other is of the same method and size.
    pub(crate) fn is_like(&self, other: &Self, coordinates: usize) -> bool {
        std::mem::discriminant(self) == std::mem::discriminant(other)
            && self.length(coordinates) == other.length(coordinates)
    }

    /// There is no past to guess from.
    pub(crate) fn forget(&mut self) {
        match self {
            Self::Increments(past) => (past.history, past.order) = (0, 0),
            Self::Trail(past) => past.length = 0,
            Self::Stages(past) => past.is_known = false,
        }
    }

    /// Becomes another past of the same kind and size; allocates nothing.
    pub(crate) fn copy_from(&mut self, other: &Self) {
        match (self, other) {
            (Self::Increments(to), Self::Increments(from)) => {
                to.differences.copy_from_slice(&from.differences);
                (to.history, to.order) = (from.history, from.order);
            }
            (Self::Trail(to), Self::Trail(from)) => {
                to.entries.copy_from_slice(&from.entries);
                to.length = from.length;
            }
            (Self::Stages(to), Self::Stages(from)) => {
                to.motion.copy_from_slice(&from.motion);
                (to.is_known, to.is_even) = (from.is_known, from.is_even);
            }
            (to, from) => *to = from.clone(),
        }
    }

    /// All numbers that it keeps.
    pub(crate) fn numbers(&mut self) -> &mut [f64] {
        match self {
            Self::Increments(past) => past.differences.as_flattened_mut(),
            Self::Trail(past) => past.entries.as_flattened_mut(),
            Self::Stages(past) => &mut past.motion,
        }
    }
}

/// Increments kept.
pub(crate) const LENGTH: usize = 8;

/// Increments of past steps.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Predictor {
    /// `∇⁰x … ∇⁷x` of each coordinate.
    pub(crate) differences: Vec<[f64; LENGTH]>,
    /// Increments seen, up to [`LENGTH`].
    pub(crate) history: u8,
    /// Of the next prediction.
    pub(crate) order: u8,
}

impl Predictor {
    fn new(coordinates: usize) -> Self {
        Self { differences: vec![[0.0; LENGTH]; coordinates], history: 0, order: 0 }
    }

    /// Writes the next increments.
    fn predict(&self, increments: &mut [f64]) {
        for (increment, differences) in increments.iter_mut().zip(&self.differences) {
            *increment = differences[..usize::from(self.order)].iter().sum();
        }
    }

    /// Takes note of increments, and of how well they would have been predicted.
    fn record(&mut self, increments: &[f64], inertia: &[f64]) {
        let mut errors = [0.0; LENGTH];
        for ((differences, increment), weight) in
            self.differences.iter_mut().zip(increments).zip(inertia)
        {
            let mut difference = *increment;
            for (kept, error) in differences.iter_mut().zip(&mut errors) {
                *error += difference * difference * weight;
                (*kept, difference) = (difference, difference - *kept);
            }
        }
        // Of the differences, as many mean something as there were increments before.
        let known = usize::from(self.history).clamp(1, LENGTH - 1);
        let mut order = 1;
        for m in 2..=known {
            if errors[m] < errors[order] {
                order = m;
            }
        }
        self.order = order as u8;
        self.history = (self.history + 1).min(LENGTH as u8);
    }

    /// The last increment, longer by a factor, is all that is known.
    fn stretch(&mut self, factor: f64) {
        for differences in &mut self.differences {
            differences[0] *= factor;
        }
        self.history = self.history.min(1);
        self.order = self.order.min(1);
    }
}

/// Velocities at most, of which a guess is made.
const NODES: usize = 5;
/// Velocities closer in time than this, relative to the step, count as one.
const APART: f64 = 0.1;

/// Velocities at the middles of past steps, which may be of any length, forward and backward: a guess is
/// the polynomial through those nearest in time.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Trail {
    /// The last first: the time, relative to the present, and the velocities.
    entries: Vec<[f64; LENGTH]>,
    pub(crate) length: u8,
}

impl Trail {
    fn new(coordinates: usize) -> Self {
        Self { entries: vec![[0.0; LENGTH]; 1 + coordinates], length: 0 }
    }

    /// Which velocities the polynomial goes through at a time, and their weights.
    fn weights(&self, time: f64, step: f64) -> [f64; LENGTH] {
        let times = &self.entries[0];
        let mut left: [bool; LENGTH] = [true; LENGTH];
        let mut chosen = [0; NODES];
        let mut count = 0;
        while count < NODES {
            let candidates = (0..usize::from(self.length)).filter(|k| left[*k]);
            let distance = |k: &usize| (times[*k] - time).abs();
            let Some(next) = candidates.min_by(|a, b| distance(a).total_cmp(&distance(b))) else {
                break;
            };
            left[next] = false;
            let is_apart = |k: &usize| (times[*k] - times[next]).abs() > APART * step.abs();
            if chosen[..count].iter().all(is_apart) {
                chosen[count] = next;
                count += 1;
            }
        }
        let mut weights = [0.0; LENGTH];
        for &k in &chosen[..count] {
            let others = chosen[..count].iter().filter(|j| **j != k);
            weights[k] = others.map(|j| (time - times[*j]) / (times[k] - times[*j])).product();
        }
        weights
    }

    fn predict(&self, h: f64, increments: &mut [f64]) {
        let weights = self.weights(0.5 * h, h);
        for (increment, velocities) in increments.iter_mut().zip(&self.entries[1..]) {
            let velocity: f64 = velocities.iter().zip(&weights).map(|(v, w)| v * w).sum();
            *increment = h * velocity;
        }
    }

    fn record(&mut self, h: f64, increments: &[f64]) {
        for entry in &mut self.entries {
            entry.copy_within(..LENGTH - 1, 1);
        }
        let (times, velocities) = self.entries.split_at_mut(1);
        times[0][0] = 0.5 * h;
        times[0].iter_mut().for_each(|time| *time -= h);
        for (velocities, increment) in velocities.iter_mut().zip(increments) {
            velocities[0] = increment / h;
        }
        self.length = (self.length + 1).min(LENGTH as u8);
    }
}

/// What a collocation method had at the stages of its last step.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Stages {
    /// Velocities stage by stage, then forces.
    motion: Vec<f64>,
    stages: u8,
    pub(crate) is_known: bool,
    /// Whether the next step is as long.
    pub(crate) is_even: bool,
}

impl Stages {
    fn new(coordinates: usize, stages: usize) -> Self {
        let motion = vec![0.0; 2 * coordinates * stages];
        Self { motion, stages: stages as u8, is_known: false, is_even: true }
    }

    /// Writes what the next step has at its stages; false if there is nothing to guess from.
    pub(crate) fn predict(&self, tableau: &Tableau, motion: &mut [f64]) -> bool {
        let stages = tableau.nodes.len();
        let count = motion.len() / (2 * stages);
        for half in 0..2 {
            for a in 0..count {
                let entry = |j: usize| (half * stages + j) * count + a;
                let last = if self.is_even { 0.0 } else { self.motion[entry(stages - 1)] };
                let mut next = [last; STAGES_MAX];
                if self.is_even {
                    for (j, column) in tableau.onward.chunks_exact(stages).enumerate() {
                        let past = self.motion[entry(j)];
                        for (next, weight) in next.iter_mut().zip(column) {
                            *next += weight * past;
                        }
                    }
                }
                for (i, next) in next[..stages].iter().enumerate() {
                    motion[entry(i)] = *next;
                }
            }
        }
        self.is_known
    }

    pub(crate) fn record(&mut self, motion: &[f64]) {
        self.motion.copy_from_slice(motion);
        (self.is_known, self.is_even) = (true, true);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Predictions and increments of a motion, one coordinate.
    fn run(motion: impl Fn(f64) -> f64, steps: usize) -> Vec<(f64, f64, u8)> {
        let mut predictor = Predictor::new(1);
        let step = |k| {
            let mut predicted = [0.0];
            predictor.predict(&mut predicted);
            let order = predictor.order;
            predictor.record(&[motion(k as f64)], &[1.0]);
            (predicted[0], motion(k as f64), order)
        };
        (0..steps).map(step).collect()
    }

    #[test]
    fn a_polynomial_is_predicted_exactly() {
        for (predicted, actual, _) in &run(|t| 3.0 - t + 0.5 * t * t - 0.25 * t * t * t, 20)[6..] {
            assert!((predicted - actual).abs() < 1e-9 * actual.abs(), "{predicted} {actual}");
        }
    }

    #[test]
    fn a_smooth_motion_is_predicted_better_by_more_increments() {
        let errors: Vec<f64> =
            run(|t| (0.1 * t).sin(), 30).iter().map(|(p, a, _)| (p - a).abs()).collect();
        assert!(errors[2] > 1e-3 && errors[12..].iter().all(|e| *e < 1e-6), "{errors:?}");
    }

    #[test]
    fn uneven_steps_forward_and_backward_follow_a_polynomial() {
        let velocity = |t: f64| 2.0 - t + 3.0 * t * t - 0.5 * t * t * t;
        let mut trail = Trail::new(1);
        let mut time = 0.3;
        for (k, h) in
            [0.1, 0.17, -0.09, 0.2, 0.11, -0.21, 0.13].into_iter().cycle().take(30).enumerate()
        {
            let mut guess = [0.0];
            trail.predict(h, &mut guess);
            let actual = h * velocity(time + 0.5 * h);
            assert!(k < 6 || (guess[0] - actual).abs() < 1e-10, "{} {actual}", guess[0]);
            trail.record(h, &[actual]);
            time += h;
        }
    }

    #[test]
    fn a_kick_is_forgotten_and_noise_is_not_extrapolated() {
        let kicked = run(|t| if t < 20.0 { 1.0 } else { 2.0 }, 24);
        assert_eq!(kicked[21].0, 2.0, "the step after a kick takes the last increment");
        let noise = run(|t| 1.0 + (t * t * 12.9898).sin(), 40);
        assert!(noise.iter().all(|(predicted, _, _)| predicted.abs() < 20.0));
    }
}
