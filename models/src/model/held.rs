//! Limbs whose ends are held, and how the Newton matrix is eliminated without them.

use std::ops::Range;

use plantd_math::elimination::SymbolicElimination;

/// The limbs of a mechanism all of whose constraints hold limbs.
#[derive(Clone, Debug)]
pub(crate) struct Held {
    pub(crate) limbs: Vec<HeldLimb>,
    /// Of the other coordinates, in their places; those of limbs stand alone.
    pub(crate) rest: SymbolicElimination,
    /// Entries of `K` that are in the rest, too.
    pub(crate) kept: Vec<Run>,
    /// Inertia of the other coordinates; zero of those of limbs.
    pub(crate) inertia: Vec<f64>,
}

/// Entries that follow each other in `K` and in the rest.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Run {
    pub(crate) from: usize,
    pub(crate) to: usize,
    pub(crate) len: usize,
}

/// The last coordinates of a chain, and as many equations that hold its end.
#[derive(Clone, Debug)]
pub(crate) struct HeldLimb {
    pub(crate) coordinates: Range<usize>,
    pub(crate) equations: Range<usize>,
    /// The other coordinates that the limb has to do with: those above it, the highest first, and those that move
    /// the place where it is held.
    pub(crate) border: Vec<usize>,
    /// How many of them are above it.
    pub(crate) above: usize,
    /// Of each two coordinates of the border the place in the rest, row after row: of those in the upper triangle by
    /// the later one, the diagonal included.
    pub(crate) places: Vec<usize>,
    /// It is the first and the last in a row of limbs with the same border.
    pub(crate) is_first: bool,
    pub(crate) is_last: bool,
}
