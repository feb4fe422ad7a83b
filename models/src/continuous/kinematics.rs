//! Where the frames of a model are and how they move, and its centre of mass.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::DMatrix;
use plantd_math::rotation::Quaternion;
use plantd_math::spatial::{Force, Inertia, Mat3, Motion, Sym3, Vec3};

use crate::compile::scene::{Placement, frames};
use crate::continuous::{ContinuousError, take};
use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::momenta::Momenta;
use crate::model::manifold::orientations;
use crate::model::mechanism::Model;
use crate::model::tree::{Attachment, Tree, WORLD};

/// A point of a frame; only for the [`Kinematics`] that it is from.
#[derive(Clone, Copy, Debug)]
pub struct FramePoint {
    at: Attachment,
    /// The frame's axes in those of the joint.
    rotation: Mat3,
}

/// A frame with a point of it: where it is and how fast, in world axes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FrameMotion {
    /// Position of the point, m.
    pub position: [f64; 3],
    /// Orientation of the frame: unit quaternion `w, x, y, z`, its largest component positive.
    pub orientation: [f64; 4],
    /// Velocity of the point, m/s.
    pub linear_velocity: [f64; 3],
    /// Angular velocity of the frame, rad/s.
    pub angular_velocity: [f64; 3],
}

/// The centre of mass of all bodies that joints carry, in world axes; all zero if nothing has mass.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CenterOfMass {
    /// m.
    pub position: [f64; 3],
    /// m/s.
    pub velocity: [f64; 3],
    /// Mass that moves, kg.
    pub mass_kg: f64,
}

/// Poses, velocities and Jacobians of the frames of a model, at a configuration and a velocity.
///
/// ```text
/// ẋ = J_x(q) v      ω = J_ω(q) v
/// ```
///
/// Columns are all coordinates, `n = nd + nk`. The configuration is not checked against constraints, nor the
/// velocity against their derivative. Entries of `v` for a ball joint are in its own axes, as everywhere.
///
/// ```
/// use std::sync::Arc;
/// use plantd_models::{Kinematics, Model, builtin};
///
/// let model = Arc::new(Model::compile(&builtin::scene("pendulum").unwrap())?);
/// let mut kinematics = Kinematics::new(model);
/// let frame = kinematics.frames()[0].clone();
/// let bob = kinematics.point(&frame, [0.0, -1.0, 0.0]).unwrap();
/// kinematics.place(&[0.0], &[2.0])?;
/// assert_eq!(kinematics.motion(&bob).linear_velocity, [2.0, 0.0, 0.0]);
/// assert_eq!(kinematics.jacobian(&bob)[(0, 0)], 1.0);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Kinematics {
    model: Arc<Model>,
    /// All joints of the scene, those without mass too.
    tree: Tree,
    names: Vec<String>,
    frames: BTreeMap<String, Placement>,
    q: Vec<f64>,
    v: Vec<f64>,
    poses: Poses,
    momenta: Momenta,
}

impl Kinematics {
    /// The kinematics of a model, at its initial configuration, at rest.
    pub fn new(model: Arc<Model>) -> Self {
        let (tree, placed) = frames(&model.scene);
        let names = placed.iter().map(|(name, _)| name.clone()).collect();
        let world = ("world".to_owned(), Placement::HERE);
        let q: Vec<f64> = model.coordinates.iter().map(|c| c.initial).collect();
        let mut kinematics = Self {
            names,
            frames: placed.into_iter().chain([world]).collect(),
            v: vec![0.0; q.len()],
            q,
            poses: Poses::new(&tree),
            momenta: Momenta::new(&tree),
            tree,
            model,
        };
        kinematics.evaluate();
        kinematics
    }

    /// The model.
    pub fn model(&self) -> &Arc<Model> {
        &self.model
    }

    /// Names of the frames in the scene's order, without `world`.
    pub fn frames(&self) -> &[String] {
        &self.names
    }

    /// The point of a frame at a position in the frame's axes, m; `world` is a frame, too. `None` if there is
    /// no such frame.
    pub fn point(&self, frame: &str, at: [f64; 3]) -> Option<FramePoint> {
        let Placement { joint, rotation, translation } = *self.frames.get(frame)?;
        let point = translation + rotation.apply(Vec3(at));
        Some(FramePoint { at: Attachment { joint, point }, rotation })
    }

    /// Moves to a configuration `q` and a velocity `v`, n entries each. Costs some 150 flops for each joint.
    ///
    /// # Errors
    ///
    /// [`ContinuousError::Dimension`] and [`ContinuousError::NotFinite`] name the vector;
    /// [`ContinuousError::Overflow`] if a frame would be, or move, beyond all numbers. After an error this is
    /// of no use until the next `place` that succeeds.
    pub fn place(&mut self, q: &[f64], v: &[f64]) -> Result<(), ContinuousError> {
        take("q", q, &mut self.q)?;
        take("v", v, &mut self.v)?;
        self.evaluate();
        let finite = |v: &Vec3| v.0.iter().all(|x| x.is_finite());
        let moves = |i: usize| {
            let (twist, momentum) =
                (self.momenta.twist_of(&self.tree, i), self.momenta.momentum_of(&self.tree, i));
            let (Motion { w, v }, Force { f, .. }) = (twist, momentum);
            [w, v, f].iter().all(finite)
        };
        let all_finite = self.poses.position.iter().chain(&self.poses.origin).all(finite)
            && (0..self.tree.joints.len()).all(moves);
        if all_finite { Ok(()) } else { Err(ContinuousError::Overflow) }
    }

    fn evaluate(&mut self) {
        let Self { model, tree, q, v, poses, momenta, .. } = self;
        poses.evaluate(tree, q, &orientations(model, q));
        // Of no coordinate: only what the joints carry is of interest.
        momenta.gradient(tree, poses, v, None, &mut [], &mut []);
    }

    /// Where a point and its frame are, and how they move. Allocates nothing.
    pub fn motion(&self, point: &FramePoint) -> FrameMotion {
        let FramePoint { at, rotation } = point;
        let (position, origin) = self.poses.point(&self.tree, at);
        let (axes, twist) = match at.joint {
            WORLD => (*rotation, Motion::default()),
            joint => (
                self.poses.rotation[joint].times(rotation),
                self.momenta.twist_of(&self.tree, joint),
            ),
        };
        FrameMotion {
            position: (position + origin).0,
            orientation: Quaternion::of_matrix(&axes).0,
            linear_velocity: twist.at(position).0,
            angular_velocity: twist.w.0,
        }
    }

    /// The Jacobian of a point and its frame, 6 by n: linear velocity of the point, then angular velocity, by
    /// `v`, in world axes. Costs some 20 flops for each joint that carries the frame (allocates).
    pub fn jacobian(&self, point: &FramePoint) -> DMatrix<f64> {
        let mut jacobian = DMatrix::zeros(6, self.q.len());
        let (position, _) = self.poses.point(&self.tree, &point.at);
        for joint in self.tree.path(point.at.joint) {
            let linear = self.poses.point_gradient(&self.tree, joint, position);
            let angular = self.momenta.axis_of(&self.tree, joint).w;
            let mut column = jacobian.column_mut(self.tree.joints[joint].coordinate);
            for k in 0..3 {
                column[k] = linear[k];
                column[3 + k] = angular[k];
            }
        }
        jacobian
    }

    /// The centre of mass. Allocates nothing.
    pub fn center_of_mass(&self) -> CenterOfMass {
        let totals = self.momenta.totals(&self.tree, &self.poses);
        let velocity =
            if totals.mass > 0.0 { totals.momentum.f * (1.0 / totals.mass) } else { Vec3::ZERO };
        CenterOfMass { position: totals.center().0, velocity: velocity.0, mass_kg: totals.mass }
    }

    /// The Jacobian of the centre of mass, 3 by n, in world axes; zero if nothing has mass (allocates).
    pub fn center_of_mass_jacobian(&self) -> DMatrix<f64> {
        let mut jacobian = DMatrix::zeros(3, self.q.len());
        let mass = self.center_of_mass().mass_kg;
        for (i, joint) in self.tree.joints.iter().enumerate().filter(|_| mass > 0.0) {
            let (moment, tensor) = (self.momenta.moment_of(&self.tree, i), Sym3::default());
            let carried = Inertia { mass: joint.subtree_mass, moment, tensor };
            let momentum = carried.momentum(self.momenta.axis_of(&self.tree, i));
            for k in 0..3 {
                jacobian[(k, joint.coordinate)] = momentum.f[k] / mass;
            }
        }
        jacobian
    }
}
