//! What can be seen of a mechanism: what there is, once ([`Drawing`]), and where it is at a state ([`Poses`]).
//!
//! A drawing has no effect on motion. It shows
//!
//! - frames with the shapes that the scene gives them; a body without any as the box of uniform density with its
//!   inertia, a point mass as a ball;
//! - lines: from frames to those that carry them, springs and dampers, rods, strings and ropes, paths;
//! - arrows: inputs that act at a place, and the forces of constraints.
//!
//! ```
//! use plantd_models::drawing::{Drawing, Instant};
//! use plantd_models::{Model, builtin};
//!
//! let model = Model::compile(&builtin::scene("cart-pole").unwrap())?;
//! let drawing = Drawing::new(&model);
//! let names: Vec<_> = drawing.frames().map(|frame| frame.name.as_str()).collect();
//! assert_eq!(names, ["cart", "pole"]);
//!
//! let mut poses = drawing.poses();
//! let (multipliers, time_step_s) = (&[], 0.01);
//! let at = Instant { q: &[0.5, 0.0], velocity: &[], inputs: &[3.0], multipliers, time_step_s };
//! drawing.place(&at, &mut poses);
//! assert_eq!(poses.frames[0], [0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]);
//! assert_eq!(poses.arrows[0], [0.5, 0.0, 0.0, 3.0, 0.0, 0.0]);
//! # Ok::<(), plantd_models::SceneError>(())
//! ```

mod arrows;
mod lines;
mod rig;
mod shapes;

pub use crate::drawing::arrows::{Arrow, ArrowKind, Instant};
pub use crate::drawing::lines::{Line, LineKind};
pub use crate::drawing::shapes::{Form, Frame, Shape};

use plantd_math::rotation::Quaternion;
use plantd_math::spatial::{Mat3, Vec3, three};

use crate::compile::scene::Placement;
use crate::drawing::arrows::Arrows;
use crate::drawing::lines::Lines;
use crate::drawing::rig::Rig;
use crate::drawing::shapes::{Placed, shown, size_balls};
use crate::lagrangian::kinematics::Poses as JointPoses;
use crate::model::mechanism::Model;
use crate::model::tree::{Attachment, WORLD};

/// What a viewer draws of a model: immutable.
#[derive(Clone, Debug)]
pub struct Drawing {
    rig: Rig,
    frames: Vec<Placed>,
    lines: Lines,
    arrows: Arrows,
    /// First coordinate of each ball joint.
    orientations: Vec<usize>,
    size_m: f64,
    gravity: [f64; 3],
    initial: Vec<f64>,
}

/// Where everything in a [`Drawing`] is, in world axes.
#[derive(Clone, Debug)]
pub struct Poses {
    /// Of each frame: position of its origin, m; unit quaternion `w, x, y, z` that turns world axes into its own.
    pub frames: Vec<[f64; 7]>,
    /// Each point of each line, m.
    pub points: Vec<[f64; 3]>,
    /// Of each arrow: where it acts, m; force or torque, N or N·m.
    pub arrows: Vec<[f64; 6]>,
    joints: JointPoses,
    orientations: Vec<Mat3>,
}

impl Drawing {
    /// Compiles the drawing of a model (allocates).
    pub fn new(model: &Model) -> Self {
        let scene = &model.scene;
        let rig = Rig::new(model);
        let frames = shown(scene, &rig);
        let lines = Lines::new(scene, &rig, &frames);
        let mut drawing = Self {
            arrows: Arrows::new(scene, &rig),
            orientations: model.orientations.clone(),
            initial: model.coordinates.iter().map(|c| c.initial).collect(),
            size_m: 1.0,
            gravity: scene.gravity.unwrap_or_default(),
            rig,
            frames,
            lines,
        };
        drawing.size_m = drawing.extent();
        size_balls(&mut drawing.frames, drawing.size_m);
        drawing
    }

    /// Frames that have something to show, in the scene's order.
    pub fn frames(&self) -> impl ExactSizeIterator<Item = &Frame> {
        self.frames.iter().map(|placed| &placed.frame)
    }

    /// Lines.
    pub fn lines(&self) -> &[Line] {
        &self.lines.lines
    }

    /// Arrows.
    pub fn arrows(&self) -> &[Arrow] {
        &self.arrows.arrows
    }

    /// A length of the order of the mechanism's, m: what a camera should see.
    pub fn size_m(&self) -> f64 {
        self.size_m
    }

    /// Acceleration of gravity, m/s²: what a camera takes for down.
    pub fn gravity(&self) -> [f64; 3] {
        self.gravity
    }

    /// How many numbers [`Poses`] are.
    pub fn numbers(&self) -> usize {
        7 * self.frames.len() + 3 * self.lines.points.len() + 6 * self.arrows.arrows.len()
    }

    /// Room for poses; of the initial configuration, without forces (allocates).
    pub fn poses(&self) -> Poses {
        let mut poses = Poses {
            frames: vec![[0.0; 7]; self.frames.len()],
            points: vec![[0.0; 3]; self.lines.points.len()],
            arrows: vec![[0.0; 6]; self.arrows.arrows.len()],
            joints: JointPoses::new(&self.rig.tree),
            orientations: vec![Mat3::IDENTITY; self.orientations.len()],
        };
        self.place_frames(&self.initial, &mut poses);
        for (arrow, at) in poses.arrows.iter_mut().zip(self.arrows.places()) {
            let Vec3([x, y, z]) = self.rig.place(&poses.joints, at);
            *arrow = [x, y, z, 0.0, 0.0, 0.0];
        }
        poses
    }

    /// Writes where everything is at a state. Costs some 60 flops for each joint, and a product or two for each
    /// frame, point and arrow; allocates nothing.
    ///
    /// # Panics
    ///
    /// If the state has fewer entries than the model, or `out` was made for another drawing.
    pub fn place(&self, at: &Instant<'_>, out: &mut Poses) {
        self.place_frames(at.q, out);
        self.arrows.evaluate(&self.rig, &out.joints, at, &mut out.arrows);
    }

    fn place_frames(&self, q: &[f64], out: &mut Poses) {
        let Poses { frames, points, joints, orientations, .. } = out;
        for (orientation, &i) in orientations.iter_mut().zip(&self.orientations) {
            *orientation = Quaternion::exp(three(q, i)).matrix();
        }
        joints.evaluate(&self.rig.tree, q, orientations);
        for (Placed { placement, .. }, out) in self.frames.iter().zip(frames) {
            let Placement { joint, rotation, translation } = *placement;
            let origin = Attachment { joint, point: translation };
            let Vec3([x, y, z]) = self.rig.place(joints, &origin);
            let axes = match joint {
                WORLD => rotation,
                joint => joints.rotation[joint].times(&rotation),
            };
            let Quaternion([w, i, j, k]) = Quaternion::of_matrix(&axes);
            *out = [x, y, z, w, i, j, k];
        }
        for (point, out) in self.lines.points.iter().zip(points) {
            *out = self.rig.place(joints, point).0;
        }
    }

    /// Diagonal of a box that has the initial configuration inside: frames that move, with balls around their
    /// shapes, and ends of lines; 1 if that is a point.
    fn extent(&self) -> f64 {
        let poses = self.poses();
        let moves = |placed: &&Placed| placed.placement.joint != WORLD;
        let any_moves = self.frames.iter().any(|placed| moves(&placed));
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        let mut take = |position: &[f64], reach: f64| {
            for (k, x) in position.iter().enumerate() {
                low[k] = low[k].min(x - reach);
                high[k] = high[k].max(x + reach);
            }
        };
        for placed in self.frames.iter().filter(|placed| moves(placed) || !any_moves) {
            let Placed { frame, placement: Placement { joint, rotation, translation } } = placed;
            let at = |point: Vec3| {
                let point = *translation + rotation.apply(point);
                self.rig.place(&poses.joints, &Attachment { joint: *joint, point }).0
            };
            take(&at(Vec3::ZERO), 0.0);
            frame.shapes.iter().for_each(|shape| take(&at(Vec3(shape.position)), shape.reach()));
        }
        poses.points.iter().for_each(|point| take(point, 0.0));
        let diagonal = Vec3([0, 1, 2].map(|k| high[k] - low[k])).norm();
        if diagonal > 0.0 && diagonal.is_finite() { diagonal } else { 1.0 }
    }
}
