//! The projection by a regulator of its own.

use std::ops::ControlFlow;

use nalgebra::{DMatrix, DVector};

use crate::lq::recursion::LqRecursion;
use crate::optimize::error::OptimizeError;
use crate::optimize::linearizer::Linearizer;
use crate::optimize::question::Question;
use crate::optimize::trajectory::Trajectory;
use crate::weights::Weights;

/// A time-varying regulator about the current motion.
#[derive(Debug)]
pub(super) struct Projection {
    pub(super) weights: Weights,
    /// `K[k]`.
    pub(super) gains: Vec<DMatrix<f64>>,
    /// Whether they, and the maps, are those of the current motion.
    is_current: bool,
    recursion: LqRecursion,
    offset: DVector<f64>,
}

impl Projection {
    pub(super) fn new(weights: Weights, steps: usize) -> Self {
        let (states, inputs) = (weights.states(), weights.inputs());
        Self {
            weights,
            gains: vec![DMatrix::zeros(inputs, states); steps],
            is_current: false,
            recursion: LqRecursion::new(states, inputs),
            offset: DVector::zeros(inputs),
        }
    }

    /// The motion is another one, or the maps are.
    pub(super) fn forget(&mut self) {
        self.is_current = false;
    }

    /// Finds the gains, where they are not those of the current motion.
    pub(super) fn find_gains(
        &mut self,
        linearizer: &mut Linearizer,
        motion: &Trajectory,
        go_on: Question<'_>,
    ) -> Result<(), OptimizeError> {
        if self.is_current {
            return Ok(());
        }
        let Self { weights, gains, recursion, offset, .. } = self;
        recursion.begin(weights.q_final(), None);
        let stopped = linearizer.visit_backwards(motion, go_on, |k, map, _| {
            let gain = &mut gains[k];
            let found = recursion.step(map, weights.stage().stage(), gain, offset);
            Ok(match found {
                Ok(()) if gain.iter().all(|entry| entry.is_finite()) => ControlFlow::Continue(()),
                _ => ControlFlow::Break(()),
            })
        })?;
        if let Some(step) = stopped {
            return Err(OptimizeError::Projection { step });
        }
        self.is_current = true;
        Ok(())
    }
}
