//! Axes of plots, and the points that a curve needs.

/// Points of a curve; a plot is no wider.
const POINTS_MAX: usize = 600;

/// A range with round marks in it.
pub(crate) struct Axis {
    pub(crate) low: f64,
    pub(crate) high: f64,
    step: f64,
}

impl Axis {
    /// The axis that shows these numbers; those that are not finite do not count.
    pub(crate) fn over(values: impl Iterator<Item = f64>) -> Self {
        let (low, high) = values
            .filter(|x| x.is_finite())
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
        let (low, high) = if low <= high { (low, high) } else { (0.0, 0.0) };
        // Neither a constant nor the round-off of one fills the axis.
        let least = 1e-9 * low.abs().max(high.abs()).max(1e-3);
        let (low, high) = match high - low > least {
            true => (low, high),
            false => (low - least.max(0.5e-3), high + least.max(0.5e-3)),
        };
        let rough = (high - low) / 4.0;
        let decade = 10.0_f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * decade).into_iter().find(|s| *s >= rough);
        Self { low, high, step: step.unwrap_or(rough) }
    }

    pub(crate) fn padded(self) -> Self {
        let pad = 0.05 * (self.high - self.low);
        Self { low: self.low - pad, high: self.high + pad, ..self }
    }

    pub(crate) fn marks(&self) -> Vec<f64> {
        let first = (self.low / self.step).ceil() as i64;
        let last = (self.high / self.step).floor() as i64;
        (first..=last).map(|i| i as f64 * self.step).collect()
    }

    /// Where a number is, from 0 to 1.
    pub(crate) fn fraction(&self, x: f64) -> f64 {
        (x - self.low) / (self.high - self.low)
    }
}

/// Samples that draw the same curve: of each stretch the smallest and the largest.
pub(crate) fn thinned(values: &[f64]) -> Vec<usize> {
    let stretch = values.len().div_ceil(POINTS_MAX / 2).max(1);
    let mut shown = Vec::new();
    for start in (0..values.len()).step_by(stretch) {
        let indices = || start..values.len().min(start + stretch);
        let low = indices().min_by(|&a, &b| values[a].total_cmp(&values[b]));
        let high = indices().max_by(|&a, &b| values[a].total_cmp(&values[b]));
        shown.extend(low);
        shown.extend(high);
    }
    shown.push(values.len().saturating_sub(1));
    shown.sort_unstable();
    shown.dedup();
    shown.retain(|&k| k < values.len());
    shown
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinning_keeps_ends_and_peaks() {
        let mut values: Vec<f64> = (0..10_000).map(|k| (f64::from(k) * 1e-3).sin()).collect();
        values[7_777] = 9.0;
        let shown = thinned(&values);
        assert!(shown.len() <= POINTS_MAX + 2, "{}", shown.len());
        for k in [0, 7_777, 9_999] {
            assert!(shown.contains(&k), "{k}");
        }
        assert!(thinned(&[]).is_empty());
        assert_eq!(thinned(&[1.0, 2.0]), [0, 1]);
    }

    #[test]
    fn an_axis_has_some_round_marks() {
        for (low, high) in [(0.0, 5.0), (-3.3, 1e-3), (1e-9, 2e-9), (3.0, 3.0), (-1e12, 1e12)] {
            let axis = Axis::over([low, high].into_iter());
            let count = axis.marks().len();
            assert!((1..=6).contains(&count), "{low} to {high}: {count}");
            assert!(axis.low <= low && high <= axis.high && axis.high > axis.low);
        }
        assert!(!Axis::over([f64::NAN].into_iter()).marks().is_empty());
    }
}
