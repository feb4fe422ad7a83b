//! `H = Σ_c λ_c D²h_c`, the second derivatives of constraints, as products of vectors: O(n) of them.
//!
//! Multipliers pull at points with forces, and turn directions with couples, whose second derivatives are `w_i · t_j` for a
//! joint `i` at or above joint `j` ([`find_torques`](crate::constraints::closure::Closure)). Distances, paths and
//! couplings have products `s y yᵀ` beside; planes and orientations, whose two vectors both move, `s (y zᵀ + z yᵀ)`.

use plantd_math::spatial::Vec3;

use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::vectors::{ProductAt, Separation};
use crate::model::mechanism::{ConstraintKind, Model, PointPair};
use crate::model::tree::Tree;

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
    /// `y`, and each with its `s` and the row that is its `z`: itself, or the one beside it.
    rows: Vec<f64>,
    weights: Vec<f64>,
    partners: Vec<usize>,
    /// How many products there are so far.
    filled: usize,
}

impl Bends {
    /// Room for those of a model.
    pub(crate) fn new(model: &Model) -> Self {
        let n = model.dimensions.coordinates();
        let counts = model.constraints.iter().map(|constraint| match &constraint.kind {
            ConstraintKind::Axis(_) => 0,
            ConstraintKind::Distance(_) => 3,
            ConstraintKind::PathLength(path) => 2 * path.segments.len(),
            ConstraintKind::Coupling(coupling) => coupling.terms.len(),
            ConstraintKind::Product(_) => 4,
        });
        let count = counts.sum();
        Self {
            n,
            joints: vec![Bend::default(); model.closure.joints.len()],
            rows: vec![0.0; n * count],
            weights: vec![0.0; count],
            partners: vec![0; count],
            filled: 0,
        }
    }

    /// How many products there are.
    pub(crate) fn count(&self) -> usize {
        self.weights.len()
    }

    /// `y`, `z` and `s` of products `s y zᵀ`; with each of two different vectors comes the transposed one.
    pub(crate) fn products(&self) -> impl ExactSizeIterator<Item = (&[f64], &[f64], f64)> {
        let partners = self.partners.iter().map(|row| &self.rows[row * self.n..][..self.n]);
        let pairs = self.rows.chunks_exact(self.n).zip(partners);
        pairs.zip(&self.weights).map(|((y, z), weight)| (y, z, *weight))
    }

    pub(super) fn begin(&mut self) {
        self.filled = 0;
    }

    /// Adds a product of how the separation of two points changes along an axis.
    pub(super) fn add_separation(
        &mut self,
        on: (&Tree, &Poses),
        ends: (&PointPair, &Separation),
        axis: Vec3,
        weight: f64,
    ) {
        let row = self.begin_row(weight, self.filled);
        add_separation(row, on, ends, axis);
    }

    /// Adds those of how two vectors change along an axis, both ways.
    pub(super) fn add_vectors(&mut self, of: &ProductAt<'_, f64>, axis: Vec3, weight: f64) {
        let ProductAt { product, tree, poses, ref at, u, w } = *of;
        let first = self.filled;
        for (vector, value, partner) in [(product.u, u, first + 1), (product.w, w, first)] {
            let row = self.begin_row(weight, partner);
            let Some(end) = product.end(vector) else {
                add_separation(row, (tree, poses), (&product.points, at), axis);
                continue;
            };
            for joint in tree.ascend(end.joint) {
                row[tree.joints[joint].coordinate] += axis.dot(poses.turned(tree, joint, value));
            }
        }
    }

    /// Adds to the diagonal.
    pub(super) fn add_own(&mut self, coordinate: usize, value: f64) {
        self.begin_row(value, self.filled)[coordinate] = 1.0;
    }

    /// Takes the product with `x` off `out`. Both may be of dynamic coordinates alone.
    pub(crate) fn subtract_product(&self, sums: &mut Sums<1>, x: &[f64], out: &mut [f64]) {
        self.subtract_transposed(sums, x, out);
        // Of the axes of one ball joint `H` is not symmetric: they turn with it.
        for row in &self.joints {
            let axes = self.joints[row.first..].iter().take_while(|axis| axis.first == row.first);
            if let Some(out) = out.get_mut(row.coordinate) {
                for (axis, x) in axes.zip(x.iter().skip(self.joints[row.first].coordinate)) {
                    *out -= (row.torque.dot(axis.axis) - row.axis.dot(axis.torque)) * x;
                }
            }
        }
    }

    /// The same with the transposed matrix.
    pub(crate) fn subtract_transposed(&self, sums: &mut Sums<1>, x: &[f64], out: &mut [f64]) {
        for (y, z, weight) in self.products() {
            let along: f64 = y.iter().zip(x).map(|(entry, x)| entry * x).sum();
            out.iter_mut().zip(z).for_each(|(out, entry)| *out -= weight * along * entry);
        }
        sums.add_up(&self.joints, |i| [x.get(i).copied().unwrap_or_default()]);
        for (i, [product]) in sums.products(&self.joints) {
            if let Some(out) = out.get_mut(i) {
                *out -= product;
            }
        }
    }

    fn begin_row(&mut self, weight: f64, partner: usize) -> &mut [f64] {
        let row = &mut self.rows[self.filled * self.n..][..self.n];
        row.fill(0.0);
        self.weights[self.filled] = weight;
        self.partners[self.filled] = partner;
        self.filled += 1;
        row
    }
}

/// Adds how the separation of two points changes along an axis.
fn add_separation(
    row: &mut [f64],
    (tree, poses): (&Tree, &Poses),
    (points, at): (&PointPair, &Separation),
    axis: Vec3,
) {
    for (end, point, sign) in [(&points.a, at.a, 1.0), (&points.b, at.b, -1.0)] {
        for joint in tree.ascend(end.joint) {
            let by = poses.point_gradient(tree, joint, point);
            row[tree.joints[joint].coordinate] += sign * axis.dot(by);
        }
    }
}

/// Sums over what is above joints, and below them, of vectors side by side.
#[derive(Clone, Debug)]
pub(crate) struct Sums<const L: usize> {
    above: Vec<Sides<L>>,
    below: Vec<Sides<L>>,
}

/// A vector of each side.
type Sides<const L: usize> = [[f64; L]; 3];

impl<const L: usize> Sums<L> {
    /// Room for so many joints.
    pub(crate) fn new(joints: usize) -> Self {
        let zeros = || vec![[[0.0; L]; 3]; joints];
        Self { above: zeros(), below: zeros() }
    }

    /// Adds up axes and torques, times entries of vectors by coordinate.
    #[inline(always)]
    pub(crate) fn add_up(&mut self, joints: &[Bend], x: impl Fn(usize) -> [f64; L]) {
        let Self { above, below } = self;
        for (j, bend) in joints.iter().enumerate() {
            let x = x(bend.coordinate);
            above[j] = above.get(bend.parent).copied().unwrap_or([[0.0; L]; 3]);
            add_scaled(&mut above[j], bend.axis, &x);
            below[j] = [[0.0; L]; 3];
            add_scaled(&mut below[j], bend.torque, &x);
        }
        for (j, bend) in joints.iter().enumerate().rev() {
            let own = below[j];
            if let Some(parent) = below.get_mut(bend.parent) {
                for (parent, own) in parent.iter_mut().zip(&own) {
                    parent.iter_mut().zip(own).for_each(|(parent, own)| *parent += own);
                }
            }
        }
    }

    /// Entries of `xᵀ H` by coordinate, without its products, of the vectors that were added up.
    #[inline(always)]
    pub(crate) fn products(&self, joints: &[Bend]) -> impl Iterator<Item = (usize, [f64; L])> {
        let Self { above, below } = self;
        joints.iter().map(
            #[inline(always)]
            move |bend| {
                let mut product = dot(&below[bend.first], bend.axis);
                if let Some(above) = above.get(joints[bend.first].parent) {
                    let turned = dot(above, bend.torque);
                    product.iter_mut().zip(turned).for_each(|(product, turned)| *product += turned);
                }
                (bend.coordinate, product)
            },
        )
    }
}

#[inline(always)]
fn add_scaled<const L: usize>(to: &mut Sides<L>, Vec3(vector): Vec3, x: &[f64; L]) {
    for (to, entry) in to.iter_mut().zip(vector) {
        to.iter_mut().zip(x).for_each(|(to, x)| *to += entry * x);
    }
}

#[inline(always)]
fn dot<const L: usize>([x, y, z]: &Sides<L>, Vec3([a, b, c]): Vec3) -> [f64; L] {
    std::array::from_fn(|i| a * x[i] + b * y[i] + c * z[i])
}
