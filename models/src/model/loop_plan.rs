//! Loops in planes, and the plan of their elimination.

use plantd_math::spatial::Mat3;

/// Rows of a body in a front.
pub(crate) const BODY: usize = 6;

/// The loops of a planar mechanism.
#[derive(Clone, Debug)]
pub(crate) struct Loops {
    pub(crate) plan: Plan,
    pub(crate) equations: Vec<Equation>,
    /// Axes of the plane in the world, its normal last.
    pub(crate) plane: Mat3,
    /// Each joint in the tree of the constraints; [`WORLD`] for those that move none.
    pub(crate) in_closure: Vec<usize>,
}

/// An equation that closes a loop.
#[derive(Clone, Debug)]
pub(crate) struct Equation {
    /// Index of the constraint.
    pub(crate) constraint: usize,
    pub(crate) bodies: [Option<usize>; 2],
    /// The last joint that carries both bodies.
    pub(crate) ancestor: Option<usize>,
}

/// The order.
#[derive(Clone, Debug, Default)]
pub(crate) struct Plan {
    pub(crate) steps: Vec<Step>,
    /// Rows of each front.
    pub(crate) fronts: Vec<usize>,
}

/// One joint is eliminated, and after it the equations that this closes.
#[derive(Clone, Debug)]
pub(crate) struct Step {
    pub(crate) joint: usize,
    pub(crate) front: usize,
    /// Rows in use.
    pub(crate) rows: usize,
    /// First row of the joint's body.
    pub(crate) place: usize,
    pub(crate) above: Above,
    /// Fronts that end here.
    pub(crate) absorbed: Vec<Absorbed>,
    pub(crate) opened: Vec<Opened>,
    /// Equations, and their rows.
    pub(crate) closed: Vec<(usize, usize)>,
}

impl Step {
    pub(crate) fn work(&self) -> f64 {
        (self.rows * (self.rows * (1 + self.closed.len()) + 20)) as f64
    }
}

/// Where the body of the parent is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Above {
    /// Nowhere: it is the world.
    World,
    /// It takes the place of the joint.
    Here,
    /// In the front already.
    At(usize),
}

/// A front becomes part of another one.
#[derive(Clone, Debug)]
pub(crate) struct Absorbed {
    pub(crate) front: usize,
    /// Rows, from and to.
    pub(crate) rows: Vec<(usize, usize)>,
}

/// An equation that a joint of the step is the first to move.
#[derive(Clone, Debug)]
pub(crate) struct Opened {
    pub(crate) equation: usize,
    pub(crate) place: usize,
    /// First rows of its two bodies; the world has none.
    pub(crate) bodies: [Option<usize>; 2],
}
