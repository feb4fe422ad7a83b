//! `H = Σ_c λ_c D²h_c`, the second derivatives of constraints, as products of vectors: O(n) of them.
//!
//! Multipliers pull at points with forces, whose second derivatives are `w_i · t_j` for a joint `i` at or above joint `j`
//! ([`find_torques`](crate::constraints::closure::Closure)). Distances, paths and couplings have products `s y yᵀ` beside.

use plantd_math::spatial::Vec3;

use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::vectors::Separation;
use crate::model::mechanism::{ConstraintKind, Model, PointPair};
use crate::model::tree::{Tree, WORLD};

/// What a joint gives.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Bend {
    pub(crate) coordinate: usize,
    pub(crate) parent: usize,
    /// The first axis of the ball joint that it belongs to, or itself.
    pub(crate) first: usize,
    /// `w`, zero of a slide.
    pub(crate) axis: Vec3,
    /// `t`.
    pub(crate) torque: Vec3,
}

/// `H` at one configuration.
#[derive(Clone, Debug)]
pub(crate) struct Bends {
    n: usize,
    /// Joints above others come before them.
    pub(crate) joints: Vec<Bend>,
    /// `y`, and each with its `s`.
    rows: Vec<f64>,
    weights: Vec<f64>,
    /// How many products there are so far.
    filled: usize,
}

impl Bends {
    /// Room for those of a model; `None` where an equation has no such form.
    pub(crate) fn new(model: &Model) -> Option<Self> {
        let n = model.dimensions.coordinates();
        let mut count = 0;
        for constraint in &model.constraints {
            count += match &constraint.kind {
                ConstraintKind::Axis(_) => 0,
                ConstraintKind::Distance(_) => 3,
                ConstraintKind::PathLength(path) => 2 * path.segments.len(),
                ConstraintKind::Coupling(coupling) => coupling.terms.len(),
                ConstraintKind::Product(_) => return None,
            };
        }
        Some(Self {
            n,
            joints: vec![Bend::default(); model.closure.joints.len()],
            rows: vec![0.0; n * count],
            weights: vec![0.0; count],
            filled: 0,
        })
    }

    /// How many products there are.
    pub(crate) fn count(&self) -> usize {
        self.weights.len()
    }

    /// `y`, each with its `s`.
    pub(crate) fn products(&self) -> impl ExactSizeIterator<Item = (&[f64], f64)> {
        self.rows.chunks_exact(self.n).zip(self.weights.iter().copied())
    }

    pub(super) fn begin(&mut self) {
        self.filled = 0;
    }

    /// Adds a product of how the separation of two points changes along an axis.
    pub(super) fn add_separation(
        &mut self,
        (tree, poses): (&Tree, &Poses),
        (points, at): (&PointPair, &Separation),
        axis: Vec3,
        weight: f64,
    ) {
        let row = self.begin_row(weight);
        for (end, point, sign) in [(&points.a, at.a, 1.0), (&points.b, at.b, -1.0)] {
            let mut joint = end.joint;
            while joint != WORLD {
                let by = poses.point_gradient(tree, joint, point);
                row[tree.joints[joint].coordinate] += sign * axis.dot(by);
                joint = tree.joints[joint].parent;
            }
        }
    }

    /// Adds to the diagonal.
    pub(super) fn add_own(&mut self, coordinate: usize, value: f64) {
        self.begin_row(value)[coordinate] = 1.0;
    }

    fn begin_row(&mut self, weight: f64) -> &mut [f64] {
        let row = &mut self.rows[self.filled * self.n..][..self.n];
        row.fill(0.0);
        self.weights[self.filled] = weight;
        self.filled += 1;
        row
    }
}
