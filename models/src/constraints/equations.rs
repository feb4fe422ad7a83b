//! Equations of constraints, one file each: `h`, its gradient, its second derivatives.
//!
//! A new one is such a file, a variant of [`ConstraintKind`], and a variant of the scene's constraints; what it
//! leaves out does not compile.

mod along_axis;
mod coupling;
mod path_length;
mod point_distance;
mod product;

use plantd_math::scalar::Scalar;

use crate::lagrangian::kinematics::{Place, Poses};
use crate::lagrangian::vectors::Distance;
use crate::model::mechanism::{Constraint, ConstraintKind, Length, PointPair};
use crate::model::tree::Tree;

/// An equation `h(q) = 0`.
pub(crate) trait Equation {
    /// The coordinates that it depends on, but for a prescribed length; a coordinate may come more than once.
    fn coordinates(&self) -> Vec<usize>;

    /// How many equations are found at once: this one, and those after it that are about the same points.
    #[inline(always)]
    fn count(&self) -> usize {
        1
    }

    /// Writes `h` of the equations that are found at once; returns the magnitude of what was added for each.
    fn value<S: Scalar>(&self, at: Place<'_, S>, values: &mut [S]) -> S::Magnitude;

    /// Writes their `h_i` into rows of the Jacobian, which are zero; others follow.
    fn differentiate<S: Scalar>(&self, at: Place<'_, S>, rows: &mut [S]);

    /// Calls `entry(i, j, h_ij)` for ordered pairs of coordinates; a pair may come more than once, and its values
    /// add.
    fn for_each_second_derivative<S: Scalar>(
        &self,
        at: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    );
}

impl ConstraintKind {
    /// The coordinates that it depends on, but for a prescribed length.
    pub(crate) fn coordinates(&self) -> Vec<usize> {
        match self {
            Self::Distance(equation) => equation.coordinates(),
            Self::Axis(equation) => equation.coordinates(),
            Self::Product(equation) => equation.coordinates(),
            Self::PathLength(equation) => equation.coordinates(),
            Self::Coupling(equation) => equation.coordinates(),
        }
    }
}

impl Constraint {
    #[inline]
    pub(crate) fn count(&self) -> usize {
        match &self.kind {
            ConstraintKind::Distance(equation) => equation.count(),
            ConstraintKind::Axis(equation) => equation.count(),
            ConstraintKind::Product(equation) => equation.count(),
            ConstraintKind::PathLength(equation) => equation.count(),
            ConstraintKind::Coupling(equation) => equation.count(),
        }
    }

    #[inline]
    pub(crate) fn value<S: Scalar>(&self, at: Place<'_, S>, values: &mut [S]) -> S::Magnitude {
        match &self.kind {
            ConstraintKind::Distance(equation) => equation.value(at, values),
            ConstraintKind::Axis(equation) => equation.value(at, values),
            ConstraintKind::Product(equation) => equation.value(at, values),
            ConstraintKind::PathLength(equation) => equation.value(at, values),
            ConstraintKind::Coupling(equation) => equation.value(at, values),
        }
    }

    #[inline]
    pub(crate) fn differentiate<S: Scalar>(&self, at: Place<'_, S>, rows: &mut [S]) {
        match &self.kind {
            ConstraintKind::Distance(equation) => equation.differentiate(at, rows),
            ConstraintKind::Axis(equation) => equation.differentiate(at, rows),
            ConstraintKind::Product(equation) => equation.differentiate(at, rows),
            ConstraintKind::PathLength(equation) => equation.differentiate(at, rows),
            ConstraintKind::Coupling(equation) => equation.differentiate(at, rows),
        }
    }

    pub(crate) fn for_each_second_derivative<S: Scalar>(
        &self,
        at: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        match &self.kind {
            ConstraintKind::Distance(equation) => equation.for_each_second_derivative(at, entry),
            ConstraintKind::Axis(equation) => equation.for_each_second_derivative(at, entry),
            ConstraintKind::Product(equation) => equation.for_each_second_derivative(at, entry),
            ConstraintKind::PathLength(equation) => equation.for_each_second_derivative(at, entry),
            ConstraintKind::Coupling(equation) => equation.for_each_second_derivative(at, entry),
        }
    }

    /// The points that an equation of loops is about.
    pub(crate) fn points_in_plane(&self) -> Option<&PointPair> {
        match &self.kind {
            ConstraintKind::Distance(equation) => {
                matches!(equation.length, Length::Fixed(_)).then_some(&equation.points)
            }
            ConstraintKind::Axis(equation) => Some(&equation.points),
            _ => None,
        }
    }

    /// Whether a segment of its path has no length, and so no direction.
    pub(crate) fn has_empty_segment(&self, tree: &Tree, poses: &Poses) -> bool {
        let ConstraintKind::PathLength(path) = &self.kind else { return false };
        path.segments.iter().any(|segment| {
            let segment = Distance::new(segment, tree, poses);
            segment.length <= f64::EPSILON * segment.magnitude()
        })
    }
}

impl Length {
    #[inline(always)]
    fn at<S: Scalar>(self, q: &[S]) -> S {
        match self {
            Self::Fixed(length) => S::constant(length),
            Self::Driven(coordinate) => q[coordinate],
        }
    }
}
