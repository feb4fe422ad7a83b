//! Two vectors at right angles: points on planes, orientations, welds. The derivatives are those of
//! [`ProductAt`].
//!
//! ```text
//! h = u·w
//! ```

use plantd_math::scalar::Scalar;

use crate::constraints::equations::Equation;
use crate::lagrangian::kinematics::{Place, Poses};
use crate::lagrangian::vectors::ProductAt;
use crate::model::mechanism::{Alignment, Product};
use crate::model::tree::Tree;

impl Equation for Product {
    fn coordinates(&self) -> Vec<usize> {
        self.points.coordinates().collect()
    }

    #[inline(always)]
    fn value<S: Scalar>(
        &self,
        Place { tree, poses, .. }: Place<'_, S>,
        values: &mut [S],
    ) -> S::Magnitude {
        let at = ProductAt::new(self, tree, poses);
        values[0] = at.value();
        at.magnitude()
    }

    #[inline(always)]
    fn differentiate<S: Scalar>(&self, Place { tree, poses, .. }: Place<'_, S>, row: &mut [S]) {
        let at = ProductAt::new(self, tree, poses);
        at.for_each_derivative(|i, slope| row[i] += slope);
    }

    fn for_each_second_derivative<S: Scalar>(
        &self,
        Place { tree, poses, .. }: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        ProductAt::new(self, tree, poses).for_each_second_derivative(entry);
    }
}

impl Alignment {
    /// Trace of the rotation between the frames.
    pub(crate) fn trace(&self, tree: &Tree, poses: &Poses) -> f64 {
        self.axes.iter().map(|axis| ProductAt::new(axis, tree, poses).value()).sum()
    }
}
