//! Forces between two points: `f_i = F(d, ḋ) · ∂d/∂q_i`, `d = a − b`.
//!
//! ```text
//! ∂f_i/∂q_j = F · ∂²d/∂q_i∂q_j + ∂d/∂q_i · (F_d ∂d/∂q_j + F_ḋ ∂ḋ/∂q_j)
//! ∂f_i/∂v_j = ∂d/∂q_i · F_ḋ ∂d/∂q_j
//! ```
//!
//! The rate of a point `x` carried with twist `V` changes with a joint `j` above it by
//! `J_j × (V − V_before)` taken at `x`, plus `w × ∂x/∂q_j`, where `V_before` is the twist before `j`.

use plantd_math::scalar::Scalar;
use plantd_math::spatial::{Motion, Vec3};

use crate::lagrangian::fields::{Field, Take, at_point, change_at_point};
use crate::lagrangian::forces::GeneralizedForce;
use crate::lagrangian::forces::path::{RateBounds, along};
use crate::lagrangian::instant::Instant;
use crate::lagrangian::ties::{Tie, Ties};
use crate::lagrangian::vectors::{Distance, Separation};
use crate::model::mechanism::{Carries, PathJoint, PointForce, PointLaw, PointPair, Span};
use crate::model::tree::WORLD;

/// Points whose squared distance (m²) or speed (m²/s²) is below this coincide or rest: there is no
/// force, and no derivative. Above it three derivatives of a root stay within the range of numbers.
const NOTHING: f64 = 1e-100;

/// The force at one instant.
struct Acting<S: Scalar> {
    law: PointLaw,
    at: Separation<S>,
    rate: Vec3<S>,
    /// Direction of the damper, or zero where its ends coincide.
    direction: Vec3<S>,
    /// Inverse of the length or speed, or zero.
    inverse: S,
    force: Vec3<S>,
}

impl<S: Scalar> Acting<S> {
    fn new(force: &PointForce, at: &Instant<'_, S>) -> Self {
        let separation = force.ends.separation(at.tree, at.poses);
        let twists = [&force.ends.a, &force.ends.b].map(|end| at.twist(end));
        let rate = twists[0].at(separation.a) - twists[1].at(separation.b);
        let of = match force.law {
            PointLaw::Damper(_) => separation.difference,
            PointLaw::Drag(_) => rate,
        };
        let square = of.dot(of);
        let inverse = if square.value() < NOTHING { S::ZERO } else { square.sqrt().recip() };
        let direction = of * inverse;
        let force_on_a = match force.law {
            PointLaw::Damper(c) => direction * (direction.dot(rate) * -c),
            PointLaw::Drag(c) => rate * (direction.dot(rate) * -c),
        };
        Self { law: force.law, at: separation, rate, direction, inverse, force: force_on_a }
    }

    /// `F_d change + F_ḋ rate_change`.
    fn change(&self, change: Vec3<S>, rate_change: Vec3<S>) -> Vec3<S> {
        let along = self.direction;
        match self.law {
            PointLaw::Damper(c) => {
                let turned = (change - along * along.dot(change)) * self.inverse;
                let speed = along.dot(self.rate);
                let speed_change = turned.dot(self.rate) + along.dot(rate_change);
                (turned * speed + along * speed_change).scaled(-c)
            }
            PointLaw::Drag(c) => {
                let speed = along.dot(self.rate);
                (rate_change * speed + self.rate * along.dot(rate_change)).scaled(-c)
            }
        }
    }
}

impl GeneralizedForce for PointForce {
    fn couples(&self) -> Vec<usize> {
        self.ends.coordinates().collect()
    }

    fn add<S: Scalar>(&self, at: &Instant<'_, S>, force: &mut [S]) {
        let acting = Acting::new(self, at);
        for joint in &self.ends.path {
            if let Some(entry) = force.get_mut(joint.coordinate) {
                *entry += acting.force.dot(joint.gradient(at.tree, at.poses, &acting.at));
            }
        }
    }

    fn for_each_derivative<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        entry: &mut impl FnMut(usize, usize, S, S),
    ) {
        let acting = Acting::new(self, at);
        for column in &self.ends.path {
            let gradient = column.gradient(at.tree, at.poses, &acting.at);
            let rate_by_q = self.rate_by_position(at, &acting.at, column, gradient);
            let by_q = acting.change(gradient, rate_by_q);
            let by_v = acting.change(Vec3::ZERO, gradient);
            for row in &self.ends.path {
                let row_gradient = row.gradient(at.tree, at.poses, &acting.at);
                let second = row.second(row_gradient, at.tree, at.poses, (column, gradient));
                entry(
                    row.coordinate,
                    column.coordinate,
                    acting.force.dot(second) + row_gradient.dot(by_q),
                    row_gradient.dot(by_v),
                );
            }
        }
    }

    fn second_derivative(&self, at: &Instant<'_>, extent: [f64; 2]) -> f64 {
        let [moved, faster] = extent;
        match self.law {
            PointLaw::Damper(c) => {
                let steepness = Distance::new(&self.ends, at.tree, at.poses).steepness();
                let segment = std::slice::from_ref(&self.ends);
                let RateBounds { rate, faster, jerk } =
                    RateBounds::new(segment, steepness, at, extent);
                along(steepness, [c * rate, c * faster, c * jerk], moved)
            }
            PointLaw::Drag(c) => {
                let Acting { at: separation, rate, .. } = Acting::new(self, at);
                let lever = self.ends.lever(at.tree, at.poses, &separation);
                let speed: f64 = self.ends.coordinates().map(|i| at.velocity[i].abs()).sum();
                let (rate, change) = (rate.norm(), lever * (moved * speed + faster));
                let jerk = lever * moved * (moved * speed + 2.0 * faster);
                let curve = 4.0 * change * change + 2.0 * rate * jerk;
                let turned = 4.0 * moved * rate * change + (moved * rate).powi(2);
                c * lever * (curve + turned)
            }
        }
    }
}

impl Field for PointForce {
    fn span(&self) -> Option<Span> {
        self.ends.span()
    }

    fn has_rates(&self) -> bool {
        true
    }

    fn exert(&self, at: &Instant<'_>, take: Take<'_>) {
        let Some((end, carries)) = self.ends.moving_end() else { return };
        let acting = Acting::new(self, at);
        let (point, force) = match carries {
            Carries::A => (acting.at.a, acting.force),
            _ => (acting.at.b, -acting.force),
        };
        let velocity = at.twist(end).at(point);
        take(at_point(point, force), &|axis, rate| {
            let moved = axis.at(point);
            let changed = acting.change(moved, rate.at(point) + axis.w.cross(velocity));
            change_at_point([point, force], [moved, changed])
        });
    }
}

impl Tie for PointForce {
    fn segments(&self) -> &[PointPair] {
        std::slice::from_ref(&self.ends)
    }

    fn rows(&self) -> usize {
        3
    }

    fn tie(&self, at: &Instant<'_>, out: &mut Ties) {
        let acting = Acting::new(self, at);
        out.add_separation(&self.ends, at, acting.force, |by, faster| acting.change(by, faster));
    }
}

impl PointForce {
    /// `∂ḋ/∂q` of a joint on the path.
    fn rate_by_position<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        separation: &Separation<S>,
        joint: &PathJoint,
        gradient: Vec3<S>,
    ) -> Vec3<S> {
        let (end, point) = if joint.carries == Carries::A {
            (&self.ends.a, separation.a)
        } else {
            (&self.ends.b, separation.b)
        };
        let carried = at.twist(end);
        let turned =
            at.momenta.axis_of(at.tree, joint.joint).cross(carried.minus(before(at, joint.joint)));
        let turned = turned.at(point);
        let turned = if joint.carries == Carries::A { turned } else { -turned };
        turned + carried.w.cross(gradient)
    }
}

/// Twist of what a joint hangs from; for an axis of a ball joint, what the whole joint hangs from.
fn before<S: Scalar>(at: &Instant<'_, S>, joint: usize) -> Motion<S> {
    let joints = &at.tree.joints;
    match joints[joints[joint].first_axis(joint)].parent {
        WORLD => Motion::default(),
        parent => at.momenta.twist_of(at.tree, parent),
    }
}
