//! Factors of steps that are kept for the guess of the next one ([`push`](super::push)).

use crate::integrator::point::Point;
use crate::kkt::system::{Factored, KktSystem};
use crate::model::mechanism::Model;

/// Factors of steps, for guesses.
#[derive(Clone, Debug)]
pub(crate) struct Response {
    /// `−K⁻¹ h (w − w_before)` of this step, as it was guessed.
    pub(crate) pushed: Vec<f64>,
    /// Where this step was factored first.
    pub(crate) point: Point,
    /// Where those factors are.
    pub(super) place: Place,
    pub(crate) first: Factored,
    /// Of another point.
    pub(crate) kept: Factored,
    pub(super) kept_at: Point,
}

/// Where the first factors of a step are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Place {
    /// There are none yet.
    Nowhere,
    /// The system has factored nothing since.
    System,
    First,
}

impl Response {
    pub(crate) fn new(model: &Model) -> Self {
        let point = Point::of(model);
        let factors = || if point.is_empty() { Factored::default() } else { Factored::new(model) };
        let (first, kept) = (factors(), factors());
        let pushed = vec![0.0; if point.is_empty() { 0 } else { model.dimensions.dynamic }];
        Self { pushed, kept_at: point.clone(), point, place: Place::Nowhere, first, kept }
    }

    /// Saves the first factors of the step from the next ones.
    #[inline]
    pub(crate) fn save_first(&mut self, kkt: &mut KktSystem) {
        if self.place == Place::System {
            std::mem::swap(&mut kkt.factored, &mut self.first);
            self.place = Place::First;
        }
    }

    /// The step is done: its first factors are for the guess of the next one.
    pub(crate) fn move_on(&mut self, kkt: &mut KktSystem) {
        match self.place {
            Place::Nowhere => return,
            Place::System => std::mem::swap(&mut kkt.factored, &mut self.kept),
            Place::First => std::mem::swap(&mut self.first, &mut self.kept),
        }
        std::mem::swap(&mut self.kept_at, &mut self.point);
        self.place = Place::Nowhere;
    }
}
