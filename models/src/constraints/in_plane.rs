//! Constraints of a planar mechanism at one end of a step as wrenches on the bodies that they tie together:
//! `Dh` without its entries, O(n).
//!
//! A wrench `(n, f)` is about the joint of its body, as in [`crate::lagrangian::planar`].

use plantd_math::spatial::Vec3;

use crate::lagrangian::kinematics::Poses;
use crate::model::loop_plan::Loops;
use crate::model::mechanism::{AlongAxis, ConstraintKind, Model, PointPair};
use crate::model::planar_tree::PlanarJoint;
use crate::model::tree::{JointKind, Tree, WORLD};

/// Joints and wrenches at a configuration.
#[derive(Clone, Debug)]
pub(crate) struct InPlane {
    /// How each joint slides; zero for hinges.
    pub(crate) slide: Vec<[f64; 2]>,
    /// From the parent joint; zero at the root.
    pub(crate) edge: Vec<[f64; 2]>,
    /// Of each equation, on both of its bodies.
    pub(crate) wrenches: Vec<[[f64; 3]; 2]>,
    /// Of the world, and of each joint's body, within a pass.
    flows: Vec<[f64; 3]>,
    reaches: Vec<Reach>,
}

/// How far coordinates of about their round-off move a body.
#[derive(Clone, Copy, Debug, Default)]
struct Reach {
    /// `Σ |q|` of the hinges that carry it.
    turned: f64,
    /// Length of the path to the root.
    length: f64,
    /// Bound on `Σ |q ∂p/∂q|` for the point at its joint.
    moved: f64,
}

impl Reach {
    /// Of a point beyond.
    fn beyond(self, distance: f64) -> Self {
        let Self { turned, length, moved } = self;
        Self { turned, length: length + distance, moved: moved + turned * distance }
    }

    /// Without what moves a body that carries it.
    fn within(self, above: Self) -> f64 {
        (self.moved - above.beyond(self.length - above.length).moved).max(0.0)
    }
}

impl InPlane {
    pub(crate) fn new(loops: &Loops) -> Self {
        let joints = loops.in_closure.len();
        Self {
            slide: vec![[0.0; 2]; joints],
            edge: vec![[0.0; 2]; joints],
            wrenches: vec![[[0.0; 3]; 2]; loops.equations.len()],
            flows: vec![[0.0; 3]; joints + 1],
            reaches: vec![Reach::default(); joints + 1],
        }
    }

    /// Takes everything from poses; writes the change of each equation by round-off of the coordinates.
    pub(crate) fn place(
        &mut self,
        model: &Model,
        loops: &Loops,
        joints: &[PlanarJoint],
        poses: &Poses,
        q: &[f64],
        round_off: &mut [f64],
    ) {
        let tree = &model.closure;
        let local = |v: Vec3| [loops.plane.0[0].dot(v), loops.plane.0[1].dot(v)];
        for (i, &at) in loops.in_closure.iter().enumerate() {
            let Some(joint) = tree.joints.get(at) else { continue };
            let mut reach = self.reaches[joints[i].parent];
            if joint.parent != WORLD {
                self.edge[i] = local(poses.position[at] - poses.position[joint.parent]);
                reach = reach.beyond(length(self.edge[i]));
            }
            if joint.kind == JointKind::Prismatic {
                self.slide[i] = local(poses.axis(tree, at));
                reach.moved += q[i].abs();
            } else {
                reach.turned += q[i].abs();
            }
            self.reaches[i + 1] = reach;
        }
        for (equation, wrenches) in loops.equations.iter().zip(&mut self.wrenches) {
            let c = equation.constraint;
            let Some(points) = model.constraints[c].points_in_plane() else { continue };
            let force = match &model.constraints[c].kind {
                ConstraintKind::Axis(AlongAxis { axis, .. }) => {
                    let [x, y, _] = loops.plane.0;
                    [x[*axis], y[*axis]]
                }
                _ => local(points.separation(tree, poses).difference.scaled(2.0)),
            };
            let arms = arms(points, tree, poses).map(local);
            let [[ax, ay], [bx, by]] = arms;
            let [fx, fy] = force;
            *wrenches = [[ax * fy - ay * fx, fx, fy], [by * fx - bx * fy, -fx, -fy]];
            let body = |body: Option<usize>| self.reaches[body.map_or(0, |body| body + 1)];
            let above = body(equation.ancestor);
            let moved: f64 = (equation.bodies.iter().zip(arms))
                .map(|(at, arm)| body(*at).beyond(length(arm)).within(above))
                .sum();
            round_off[c] = f64::EPSILON * moved * length(force);
        }
    }

    /// `out_i −= Σ_c Dh[c, i] λ_c`, from the leaves to the root.
    pub(crate) fn subtract_impulses(
        &mut self,
        loops: &Loops,
        joints: &[PlanarJoint],
        multipliers: &[f64],
        out: &mut [f64],
    ) {
        self.flows.fill([0.0; 3]);
        for (equation, wrenches) in loops.equations.iter().zip(&self.wrenches) {
            let lambda = multipliers[equation.constraint];
            for (body, wrench) in equation.bodies.iter().zip(wrenches) {
                if let Some(body) = body {
                    let flow = &mut self.flows[body + 1];
                    flow.iter_mut().zip(wrench).for_each(|(sum, part)| *sum += lambda * part);
                }
            }
        }
        for (i, joint) in joints.iter().enumerate().rev() {
            let [n, fx, fy] = self.flows[i + 1];
            let ([dx, dy], [ex, ey]) = (self.slide[i], self.edge[i]);
            out[i] -= joint.body.turn * n + (dx * fx + dy * fy);
            let above = &mut self.flows[joint.parent];
            above[0] += n + (ex * fy - ey * fx);
            above[1] += fx;
            above[2] += fy;
        }
    }
}

fn length(v: [f64; 2]) -> f64 {
    v[0].abs() + v[1].abs()
}

/// Both points from the joints of their bodies.
fn arms(points: &PointPair, tree: &Tree, poses: &Poses) -> [Vec3; 2] {
    [&points.a, &points.b].map(|end| match tree.joints.get(end.joint) {
        Some(_) => poses.rotation[end.joint].apply(end.point),
        None => Vec3::ZERO,
    })
}
