//! The guess with which a step begins: increments of past steps, extrapolated.
//!
//! The polynomial through the last `m` increments predicts `x[k+1] = Σ ∇ʲx[k]`, `j < m`, with the backward
//! differences `∇⁰x[k] = x[k]`, `∇ʲ⁺¹x[k] = ∇ʲx[k] − ∇ʲx[k−1]`. What such a prediction is off by is the
//! difference `∇ᵐx[k+1]`: the differences of an increment tell how good each order has been, and the next
//! step takes the best. A smooth motion is predicted to many digits, and one that is pushed around is not
//! extrapolated far.

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
    pub(crate) fn new(coordinates: usize) -> Self {
        Self { differences: vec![[0.0; LENGTH]; coordinates], history: 0, order: 0 }
    }

    /// Whether there is a past to extrapolate.
    pub(crate) fn is_ready(&self) -> bool {
        self.history > 0
    }

    /// Writes the next increments.
    pub(crate) fn predict(&self, increments: &mut [f64]) {
        for (increment, differences) in increments.iter_mut().zip(&self.differences) {
            *increment = differences[..usize::from(self.order)].iter().sum();
        }
    }

    /// Takes note of increments, and of how well they would have been predicted: the error of all
    /// coordinates is weighed by their `inertia`.
    pub(crate) fn record(&mut self, increments: &[f64], inertia: &[f64]) {
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
    fn a_kick_is_forgotten_and_noise_is_not_extrapolated() {
        let kicked = run(|t| if t < 20.0 { 1.0 } else { 2.0 }, 24);
        assert_eq!(kicked[21].0, 2.0, "the step after a kick takes the last increment");
        let noise = run(|t| 1.0 + (t * t * 12.9898).sin(), 40);
        assert!(noise.iter().all(|(predicted, _, _)| predicted.abs() < 20.0));
    }
}
