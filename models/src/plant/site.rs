//! Sites: frames with a point, where they are, and what a push at them does.
//!
//! A wrench `w = (f, n)` in world axes, with `f` at the point of a site, exerts on the joints `j` that carry
//! it the generalized force `J(q)ᵀ w`:
//!
//! ```text
//! revolute, axis of a ball joint    a_j · (n + (x − o_j) × f)
//! prismatic                         a_j · f
//! screw                             a_j · (n + (x − o_j) × f) + pitch a_j · f
//! ```
//!
//! with the joint's axis `a_j` through `o_j`, and the point `x`.

use plantd_math::rotation::Quaternion;
use plantd_math::spatial::{Mat3, Vec3};
use plantd_math::trigonometry::sin_cos_of;

use crate::integrator::report::StepError;
use crate::integrator::state::add;
use crate::model::mechanism::Model;
use crate::model::site::Site;
use crate::model::tree::{Joint, JointKind};
use crate::plant::facade::Plant;

/// Where a site is, in world axes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pose {
    /// Its point, m.
    pub position: [f64; 3],
    /// Rotation vector of its frame, rad: axis times angle, at most half a turn.
    pub rotation: [f64; 3],
}

impl Plant {
    /// Where a site is at the present configuration. Costs a sine, a cosine and 60 flops for each joint
    /// above it; allocates nothing.
    pub fn pose(&self, site: &Site) -> Pose {
        let (rotation, position) = self.walk(site, |_, _, _| {});
        let axes = rotation.times(&site.rotation);
        Pose { position: position.0, rotation: Quaternion::of_matrix(&axes).log().0 }
    }

    /// Adds the generalized force `J(q)ᵀ w` of a force (N) at the point of a site and a torque (N·m), both
    /// in world axes, to `out`, one entry for each dynamic coordinate. Costs two walks to the site;
    /// allocates nothing.
    ///
    /// # Panics
    ///
    /// If `out` does not have nd entries.
    pub fn add_wrench(&self, site: &Site, force: [f64; 3], torque: [f64; 3], out: &mut [f64]) {
        assert_eq!(out.len(), self.model.dimensions.dynamic, "entries of the generalized force");
        let (force, torque) = (Vec3(force), Vec3(torque));
        let (_, point) = self.walk(site, |_, _, _| {});
        self.walk(site, |joint, axis, origin| {
            let Some(out) = out.get_mut(joint.coordinate) else { return };
            let moment = || axis.dot(torque + (point - origin).cross(force));
            *out += match joint.kind {
                JointKind::Revolute | JointKind::Ball(_) => moment(),
                JointKind::Prismatic => axis.dot(force),
                JointKind::Screw(pitch) => moment() + pitch * axis.dot(force),
            };
        });
    }

    /// Takes a step, by `advance`, after an impulse has been added to the momentum: `p + impulse`, by a
    /// compensated sum. A wrench `w` over a step is the impulse `h J(q)ᵀ w` ([`Plant::add_wrench`]), which
    /// is the wrench to first order in `h`, and exact as an impulse at the beginning of the step. If
    /// `advance` fails, the momentum is what it was, to the last bit. Allocates nothing.
    ///
    /// # Panics
    ///
    /// If `impulse` does not have nd entries.
    pub fn with_impulse<T>(
        &mut self,
        impulse: &[f64],
        advance: impl FnOnce(&mut Self) -> Result<T, StepError>,
    ) -> Result<T, StepError> {
        let (state, before) = (&mut self.state, &mut self.period.before_impulse);
        assert_eq!(impulse.len(), state.p.len(), "entries of the impulse");
        for (before, (p, low)) in before.iter_mut().zip(state.p.iter().zip(&state.p_low)) {
            *before = [*p, *low];
        }
        add(&mut state.p, &mut state.p_low, impulse);
        let outcome = advance(self);
        if outcome.is_err() {
            for (i, [p, low]) in self.period.before_impulse.iter().enumerate() {
                (self.state.p[i], self.state.p_low[i]) = (*p, *low);
            }
        }
        outcome
    }

    /// Rotation of the last joint and position of the point; calls `visit` with each joint, its axis
    /// and a point of that.
    fn walk(&self, site: &Site, mut visit: impl FnMut(&Joint, Vec3, Vec3)) -> (Mat3, Vec3) {
        let (mut rotation, mut origin) = (Mat3::IDENTITY, Vec3::ZERO);
        for joint in &site.joints {
            let q = self.state.q[joint.coordinate];
            origin += rotation.apply(joint.translation);
            rotation = rotation.times(&joint.rotation);
            match joint.kind {
                JointKind::Revolute => rotation = turned_about_z(&rotation, q),
                JointKind::Prismatic => origin += rotation.0[2] * q,
                JointKind::Screw(pitch) => {
                    rotation = turned_about_z(&rotation, q);
                    origin += rotation.0[2] * (q * pitch);
                }
                JointKind::Ball(entry) => {
                    if entry == 0 {
                        let orientation = self.state.orientations[joint.orientation].matrix();
                        rotation = rotation.times(&orientation);
                    }
                    let Mat3([x, y, z]) = rotation;
                    rotation = Mat3([y, z, x]);
                }
            }
            visit(joint, rotation.0[2], origin);
        }
        (rotation, origin + rotation.apply(site.point))
    }
}

impl Model {
    /// The site at a point of a frame, in the frame's axes; `world` is a frame, too. `None` if there is no
    /// such frame. Allocates.
    pub fn site(&self, frame: &str, at: [f64; 3]) -> Option<Site> {
        crate::compile::scene::site(&self.scene, frame, at)
    }
}

fn turned_about_z(frame: &Mat3, angle: f64) -> Mat3 {
    let Mat3([x, y, z]) = *frame;
    let (s, c) = sin_cos_of(angle);
    Mat3([x * c + y * s, y * c - x * s, z])
}
