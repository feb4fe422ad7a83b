//! Feedback laws `u = u_ref + feedforward − K (x ⊖ x_ref)` in a plant's own loop.
//!
//! A law is computed on a worker and then only read: a step with feedback allocates nothing.

use crate::core::room::Reservation;

/// The law of one step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Stage {
    /// Gain, rows of as many entries as `x` has, one after the other.
    pub k: Vec<f64>,
    /// Reference state.
    pub x: Vec<f64>,
    /// Reference input.
    pub u: Vec<f64>,
    /// Added to it; empty means zero.
    pub feedforward: Vec<f64>,
}

impl Stage {
    /// `u_ref + feedforward − k error`, the terms of each sum from first to last.
    pub(super) fn write_input(&self, error: &[f64], out: &mut [f64]) {
        // A plant without coordinates has no rows to cut.
        for (i, out) in out.iter_mut().enumerate() {
            let row = &self.k[i * error.len()..][..error.len()];
            let correction: f64 = row.iter().zip(error).map(|(k, error)| k * error).sum();
            *out = self.u[i] + self.feedforward.get(i).copied().unwrap_or(0.0) - correction;
        }
    }
}

/// A law about a point, or along a trajectory.
#[derive(Debug)]
pub struct Law {
    /// About a point one, along a trajectory one per step.
    pub stages: Vec<Stage>,
    /// Final state of a trajectory.
    pub end: Option<Vec<f64>>,
    /// Room in memory.
    pub room: Reservation,
}

impl Law {
    /// Steps of the trajectory; 0 about a point.
    pub fn horizon(&self) -> usize {
        if self.end.is_some() { self.stages.len() } else { 0 }
    }

    /// Stage and reference state at so many steps after the beginning. After the end, the last stage
    /// with the final state.
    pub(super) fn at(&self, step: u64) -> (&Stage, &[f64]) {
        let last = self.stages.len() - 1;
        let k = usize::try_from(step).unwrap_or(usize::MAX);
        match &self.end {
            Some(end) if k > last => (&self.stages[last], end),
            _ => (&self.stages[k.min(last)], &self.stages[k.min(last)].x),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::room::Room;

    #[test]
    fn a_trajectory_holds_before_its_beginning_and_after_its_end() {
        let room = Room::new("feedback_numbers", "numbers", 10).reserve(1).unwrap();
        let stage = |x: f64| Stage { x: vec![x], u: vec![0.0], k: vec![1.0], ..Stage::default() };
        let law = Law { stages: vec![stage(0.0), stage(1.0)], end: Some(vec![2.0]), room };
        let reference = |step| law.at(step).1[0];
        assert_eq!([0, 1, 2, 3, u64::MAX].map(reference), [0.0, 1.0, 2.0, 2.0, 2.0]);
        assert_eq!(law.at(7).0, &stage(1.0));
    }

    #[test]
    fn the_law_adds_feedforward_and_subtracts_the_correction() {
        let stage = Stage {
            k: vec![1.0, 2.0, 3.0, 4.0],
            x: vec![0.0; 2],
            u: vec![10.0, 20.0],
            feedforward: vec![0.5, -0.5],
        };
        let mut out = [0.0; 2];
        stage.write_input(&[1.0, -1.0], &mut out);
        assert_eq!(out, [11.5, 20.5]);
        let rigid = Stage { u: vec![10.0, 20.0], ..Stage::default() };
        rigid.write_input(&[], &mut out);
        assert_eq!(out, [10.0, 20.0]);
    }
}
