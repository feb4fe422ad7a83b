//! Where a step was factored: what a state has of it, so that the factors can be made again.

use crate::model::mechanism::{Dimensions, Model};

/// The point where a step was factored: its length, forces of inputs, increments, angles, velocities of
/// prescribed coordinates, orientations; with constraints coordinates and orientations at the start and at the end.
/// In a state its `w` comes last.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Point {
    /// Empty where no input pushes, or what is pushed is more than bodies and limbs whose ends are held.
    pub(crate) numbers: Vec<f64>,
    /// Whether it has the start and the end.
    pub(crate) has_ends: bool,
}

/// The parts of a point.
pub(crate) struct Parts<'a> {
    pub(crate) force: &'a [f64],
    pub(crate) increment: &'a [f64],
    pub(crate) angles: &'a [f64],
    pub(crate) prescribed: &'a [f64],
    pub(crate) orientations: &'a [f64],
    /// Coordinates and orientations at the start and at the end.
    pub(crate) ends: [[&'a [f64]; 2]; 2],
    pub(crate) weighed: &'a [f64],
}

impl Point {
    /// Numbers of a point in a state, with so many dynamic and prescribed coordinates and orientations.
    pub(crate) fn length([nd, nk, orientations]: [usize; 3], has_ends: bool) -> usize {
        let ends = if has_ends { 2 * (nd + nk + 9 * orientations) } else { 0 };
        1 + 4 * nd + 2 * nk + 9 * orientations + ends
    }

    pub(crate) fn zeros(length: usize, has_ends: bool) -> Self {
        Self { numbers: vec![0.0; length], has_ends }
    }

    /// Of the plants of a model.
    pub(crate) fn of(model: &Model) -> Self {
        let Dimensions { dynamic, prescribed, .. } = model.dimensions;
        let has_ends = model.held.is_some();
        let is_known = model.planar.is_none() && (model.constraints.is_empty() || has_ends);
        // Snapshots of models with springs have none.
        let is_bare = model.is_of_bodies() && model.potentials.springs.is_empty();
        let pushes = is_known && is_bare && !model.coordinate_inputs.is_empty();
        let length = Self::length([dynamic, prescribed, model.orientations.len()], has_ends);
        if pushes { Self::zeros(length, has_ends) } else { Self::default() }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.numbers.is_empty()
    }

    /// There was no step.
    pub(crate) fn forget(&mut self) {
        self.numbers.iter_mut().take(1).for_each(|h| *h = 0.0);
    }

    /// Whether there was a step.
    pub(crate) fn is_known(&self) -> bool {
        self.numbers.first().is_some_and(|h| *h != 0.0)
    }

    /// Whether it is of a step of that length.
    pub(crate) fn is_of_length(&self, h: f64) -> bool {
        self.numbers.first() == Some(&h)
    }

    /// Whether the factors are the same.
    pub(crate) fn is_factored_as(&self, other: &Self, nd: usize) -> bool {
        let end = self.numbers.len().saturating_sub(nd);
        self.numbers[..end] == other.numbers[..end]
    }

    pub(crate) fn parts(&self, nd: usize, n: usize) -> Parts<'_> {
        let (_, rest) = self.numbers.split_at(1);
        let (force, rest) = rest.split_at(nd);
        let (increment, rest) = rest.split_at(nd);
        let (angles, rest) = rest.split_at(n);
        let (prescribed, rest) = rest.split_at(n - nd);
        let (mut orientations, weighed) = rest.split_at(rest.len() - nd);
        let mut ends = [[&[][..]; 2]; 2];
        if self.has_ends {
            let count = (orientations.len() - 2 * n) / 3;
            let (own, mut rest) = orientations.split_at(count);
            orientations = own;
            for [q, turned] in &mut ends {
                (*q, rest) = rest.split_at(n);
                (*turned, rest) = rest.split_at(count);
            }
        }
        Parts { force, increment, angles, prescribed, orientations, ends, weighed }
    }

    /// Becomes another point of the same size; allocates nothing.
    pub(crate) fn copy_from(&mut self, other: &Self) {
        self.numbers.clone_from(&other.numbers);
    }

    /// Becomes the point of the step that was taken.
    pub(crate) fn follow(&mut self, next: &Self) {
        if !self.is_empty() {
            self.numbers.copy_from_slice(&next.numbers);
        }
    }
}
