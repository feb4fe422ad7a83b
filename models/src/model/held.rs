//! Limbs whose ends are held, and how the Newton matrix is eliminated without them.

use std::ops::Range;

use plantd_math::elimination::SymbolicElimination;

/// The limbs of a mechanism all of whose constraints hold limbs.
#[derive(Clone, Debug)]
pub(crate) struct Held {
    pub(crate) limbs: Vec<HeldLimb>,
    /// Of the other coordinates, in their places; those of limbs stand alone.
    pub(crate) rest: SymbolicElimination,
    /// Inertia of the other coordinates; zero of those of limbs.
    pub(crate) inertia: Vec<f64>,
}

/// The last coordinates of a chain, and as many equations that no coordinates but these and those above them
/// change.
#[derive(Clone, Debug)]
pub(crate) struct HeldLimb {
    pub(crate) coordinates: Range<usize>,
    pub(crate) equations: Range<usize>,
    /// The coordinates above, the highest first.
    pub(crate) above: Vec<usize>,
    /// It is the first and the last in a row of limbs that hang from the same ones.
    pub(crate) is_first: bool,
    pub(crate) is_last: bool,
}
