//! Wrenches: `f_i = J_i · W` for the joints `i` that carry the body.
//!
//! With `W = [n; f]` about the origin of the evaluation, and `x` the point at which it acts,
//!
//! ```text
//! body wrench, turns with the joint    ∂f_i/∂q_j = (J_i × J_j) · W                   i above j
//! spatial wrench, fixed in the world   ∂f_i/∂q_j = (J_j × J_i) · W                   j above i
//! hybrid wrench, moves with its point  ∂f_i/∂q_j = the same + w_i · (∂x/∂q_j × f)
//! ```
//!
//! Two axes of one ball joint: they turn with the joint, so the second line holds for both orders,
//! and the first for none.

use plantd_math::scalar::Scalar;
use plantd_math::spatial::{Force, Vec3};

use crate::lagrangian::fields::{Field, Take};
use crate::lagrangian::forces::GeneralizedForce;
use crate::lagrangian::instant::Instant;
use crate::model::mechanism::{Span, Wrench, WrenchKind};
use crate::model::tree::WORLD;

impl Wrench {
    /// About the origin of the joint's tree, in world axes.
    fn in_world<S: Scalar>(&self, at: &Instant<'_, S>, wrench: Force<S>) -> Force<S> {
        let (point, origin) = at.poses.point(at.tree, &self.at);
        match self.kind {
            WrenchKind::Body => {
                let axes = &at.poses.rotation[self.at.joint];
                let f = axes.apply(wrench.f);
                Force { n: axes.apply(wrench.n) + point.cross(f), f }
            }
            WrenchKind::Spatial => Force { n: wrench.n - origin.cross(wrench.f), f: wrench.f },
            WrenchKind::Hybrid => Force { n: wrench.n + point.cross(wrench.f), f: wrench.f },
        }
    }

    fn total<S: Scalar>(&self, at: &Instant<'_, S>) -> Force<S> {
        let mut total = lift(&self.constant);
        for (input, unit) in &self.inputs {
            total = total.add_scaled(at.inputs[*input], lift(unit));
        }
        self.in_world(at, total)
    }
}

impl GeneralizedForce for Wrench {
    fn couples(&self) -> Vec<usize> {
        Vec::new()
    }

    fn add<S: Scalar>(&self, at: &Instant<'_, S>, force: &mut [S]) {
        let wrench = self.total(at);
        for &joint in &self.path {
            if let Some(entry) = force.get_mut(at.tree.joints[joint].coordinate) {
                *entry += at.momenta.axis_of(at.tree, joint).dot(wrench);
            }
        }
    }

    fn for_each_derivative<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        entry: &mut impl FnMut(usize, usize, S, S),
    ) {
        let wrench = self.total(at);
        let (point, _) = at.poses.point(at.tree, &self.at);
        for &column in &self.path {
            let below = at.momenta.axis_of(at.tree, column);
            let moved = at.poses.point_gradient(at.tree, column, point).cross(wrench.f);
            for &row in &self.path {
                let axis = at.momenta.axis_of(at.tree, row);
                let row_turns = row >= column || at.tree.one_ball(row, column);
                let turned = match self.kind {
                    WrenchKind::Body if row_turns => continue,
                    WrenchKind::Body => axis.cross(below).dot(wrench),
                    _ if row_turns => below.cross(axis).dot(wrench),
                    WrenchKind::Spatial => continue,
                    WrenchKind::Hybrid => S::ZERO,
                };
                let by_q = match self.kind {
                    WrenchKind::Hybrid => turned + axis.w.dot(moved),
                    _ => turned,
                };
                let coordinate = |joint: usize| at.tree.joints[joint].coordinate;
                entry(coordinate(row), coordinate(column), by_q, S::ZERO);
            }
        }
    }

    fn second_derivative(&self, at: &Instant<'_>, [moved, _]: [f64; 2]) -> f64 {
        let wrench = self.total(at);
        let (point, _) = at.poses.point(at.tree, &self.at);
        let levers = self.path.iter().map(|joint| at.poses.point_gradient(at.tree, *joint, point));
        let lever = levers.map(Vec3::norm).fold(0.0, f64::max);
        let torque = (wrench.n - point.cross(wrench.f)).norm();
        4.0 * moved * moved * (torque + 3.0 * lever * wrench.f.norm())
    }

    fn for_each_input_derivative<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        for (input, unit) in &self.inputs {
            let wrench = self.in_world(at, lift(unit));
            for &joint in &self.path {
                let by_u = at.momenta.axis_of(at.tree, joint).dot(wrench);
                entry(at.tree.joints[joint].coordinate, *input, by_u);
            }
        }
    }
}

impl Field for Wrench {
    fn span(&self) -> Option<Span> {
        Some(Span { body: self.at.joint, base: WORLD })
    }

    fn exert(&self, at: &Instant<'_>, take: Take<'_>) {
        let wrench = self.total(at);
        let (point, _) = at.poses.point(at.tree, &self.at);
        take(wrench, &|axis, _| match self.kind {
            WrenchKind::Body => axis.cross_force(wrench),
            WrenchKind::Spatial => Force::default(),
            WrenchKind::Hybrid => Force { n: axis.at(point).cross(wrench.f), f: Vec3::ZERO },
        });
    }
}

fn lift<S: Scalar>(wrench: &Force) -> Force<S> {
    Force { n: Vec3::lift(wrench.n), f: Vec3::lift(wrench.f) }
}
