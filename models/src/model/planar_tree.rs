//! Joint trees that move in planes: all that turns in a tree turns about parallel axes, all that slides
//! does so across them. Their mechanics is that of vectors of three numbers, not of six.

use std::ops::Deref;

use plantd_math::scalar::Lanes;
use plantd_math::spatial::{Mat3, Vec3};

use crate::model::tree::{JointKind, Rotational, Tree, WORLD};

/// Sine of the angle below which two axes are meant to be parallel.
pub(crate) const PARALLEL: f64 = 1e-8;
/// The same of axes that are: what rounding leaves of a rotation.
const ROUND_OFF: f64 = 1e-15;

/// What is fixed to a joint, in the axes of its tree's plane at the configuration zero: of one joint, or of
/// several side by side.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Body<C = f64> {
    /// How far it turns in the plane for a unit of its coordinate: 1, −1, or 0 for a slider.
    pub(crate) turn: C,
    /// How far it slides; zero for a hinge.
    pub(crate) slide: [C; 2],
    /// From the parent joint to this one.
    pub(crate) offset: [C; 2],
    /// From the joint to the centre of mass.
    pub(crate) center: [C; 2],
    pub(crate) mass: C,
    /// About the centre of mass and the normal of the plane.
    pub(crate) inertia: C,
    /// Mass of the joint's subtree.
    pub(crate) subtree_mass: C,
    /// Gravity in the plane; zero without.
    pub(crate) gravity: [C; 2],
}

/// A joint with everything that is fixed to it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlanarJoint {
    /// Index of the parent joint plus one; 0 for the world.
    pub(crate) parent: usize,
    /// Index of the coordinate.
    pub(crate) coordinate: usize,
    pub(crate) body: Body,
    /// Joints below this one: they follow it in the list.
    pub(crate) descendants: usize,
    /// Whether the next joint in the list is a child, and whether there are others.
    pub(crate) is_followed: bool,
    pub(crate) has_branches: bool,
    /// The evaluation's origin moves to this joint, as in [`Tree`].
    pub(crate) anchor: bool,
}

/// The joints of trees in planes, parents before children.
#[derive(Clone, Debug)]
pub(crate) struct PlanarJoints {
    joints: Vec<PlanarJoint>,
    /// Four joints side by side; what is beyond the last one weighs nothing.
    pub(crate) fours: Vec<Body<Lanes>>,
    /// Whether the joints are in the order of their coordinates.
    pub(crate) are_in_order: bool,
    /// Whether some are sliders.
    pub(crate) have_sliders: bool,
    /// Axes of the plane in the world, its normal last, where all trees have the same.
    pub(crate) plane: Option<Mat3>,
}

impl Deref for PlanarJoints {
    type Target = [PlanarJoint];

    fn deref(&self) -> &[PlanarJoint] {
        &self.joints
    }
}

impl PlanarJoints {
    fn new(mut joints: Vec<PlanarJoint>, plane: Option<Mat3>) -> Self {
        for i in (0..joints.len()).rev() {
            if let Some(parent) = joints[i].parent.checked_sub(1) {
                joints[parent].descendants += joints[i].descendants + 1;
                let (is_next, above) = (parent + 1 == i, &mut joints[parent]);
                above.is_followed |= is_next;
                above.has_branches |= !is_next;
            }
        }
        let fours = joints.chunks(Lanes::COUNT).map(side_by_side).collect();
        let are_in_order = joints.iter().enumerate().all(|(i, joint)| joint.coordinate == i);
        let have_sliders = joints.iter().any(|joint| joint.body.turn == 0.0);
        Self { joints, fours, are_in_order, have_sliders, plane }
    }
}

impl PlanarJoints {
    /// Whether each joint hangs on the one before it, in the order of their coordinates, and the origin stays where it is.
    pub(crate) fn are_in_a_row(&self) -> bool {
        let mut joints = self.joints.iter().enumerate();
        self.are_in_order && joints.all(|(i, joint)| joint.parent == i && !joint.anchor)
    }
}

/// The bodies of a few joints, side by side.
fn side_by_side(joints: &[PlanarJoint]) -> Body<Lanes> {
    let lanes = |number: &dyn Fn(&Body) -> f64| {
        let mut lanes = Lanes::default();
        lanes.0.iter_mut().zip(joints).for_each(|(lane, joint)| *lane = number(&joint.body));
        lanes
    };
    let vector =
        |vector: &dyn Fn(&Body) -> [f64; 2]| [0, 1].map(|k| lanes(&|body| vector(body)[k]));
    Body {
        turn: lanes(&|body| body.turn),
        slide: vector(&|body| body.slide),
        offset: vector(&|body| body.offset),
        center: vector(&|body| body.center),
        mass: lanes(&|body| body.mass),
        inertia: lanes(&|body| body.inertia),
        subtree_mass: lanes(&|body| body.subtree_mass),
        gravity: vector(&|body| body.gravity),
    }
}

/// Axes of a tree's plane in the world, its normal last, and the pose of a joint at the configuration
/// zero.
#[derive(Clone, Copy)]
struct Zero {
    plane: Mat3,
    rotation: Mat3,
}

/// The joints of a tree in their planes, one plane for each root; `None` if some tree has none.
pub(crate) fn planar(tree: &Tree, gravity: Option<Vec3>) -> Option<PlanarJoints> {
    let mut zero: Vec<Zero> = Vec::with_capacity(tree.joints.len());
    let mut joints: Vec<PlanarJoint> = Vec::with_capacity(tree.joints.len());
    for (i, joint) in tree.joints.iter().enumerate() {
        let above = (joint.parent != WORLD).then(|| zero[joint.parent]);
        let rotation = above.map_or(joint.rotation, |above| above.rotation.times(&joint.rotation));
        let plane = match above {
            Some(above) => above.plane,
            None => plane_of(tree, i)?,
        };
        let local = |v: Vec3| {
            let v = plane.apply_transposed(v);
            ([v[0], v[1]], v[2])
        };
        let (along, across) = local(rotation.0[2]);
        let is_across = along.iter().all(|x| x.abs() <= PARALLEL);
        let (turn, slide) = match joint.kind {
            JointKind::Revolute if is_across => (across.signum(), [0.0; 2]),
            JointKind::Prismatic if across.abs() <= PARALLEL => (0.0, along),
            _ => return None,
        };
        let offset =
            above.map_or([0.0; 2], |above| local(above.rotation.apply(joint.translation)).0);
        let normal = rotation.apply_transposed(plane.0[2]);
        let inertia = match &joint.body.inertia {
            Rotational::None | Rotational::Point => 0.0,
            Rotational::Isotropic(inertia) => *inertia,
            Rotational::Full(tensor) => normal.dot(tensor.apply(normal)),
        };
        joints.push(PlanarJoint {
            parent: if joint.parent == WORLD { 0 } else { joint.parent + 1 },
            coordinate: joint.coordinate,
            body: Body {
                turn,
                slide,
                offset,
                center: local(rotation.apply(joint.body.center)).0,
                mass: joint.body.mass,
                inertia,
                subtree_mass: joint.subtree_mass,
                gravity: gravity.map_or([0.0; 2], |g| local(g).0),
            },
            descendants: 0,
            is_followed: false,
            has_branches: false,
            anchor: joint.anchor,
        });
        zero.push(Zero { plane, rotation });
    }
    let plane = zero.first().map(|first| first.plane);
    let is_one = zero.iter().all(|zero| Some(zero.plane) == plane);
    Some(PlanarJoints::new(joints, plane.filter(|_| is_one)))
}

/// The plane across the first hinge of the tree with this root.
fn plane_of(tree: &Tree, root: usize) -> Option<Mat3> {
    first_hinge(tree, root).map(Mat3::with_z_along)
}

/// The axis of the first hinge of the tree with this root, at the configuration zero.
fn first_hinge(tree: &Tree, root: usize) -> Option<Vec3> {
    let hinge = (root..tree.joints.len())
        .find(|&i| tree.joints[i].root == root && tree.joints[i].kind == JointKind::Revolute)?;
    let mut rotation = Mat3::IDENTITY;
    for joint in tree.path(hinge) {
        rotation = rotation.times(&tree.joints[joint].rotation);
    }
    Some(rotation.0[2])
}

/// An axis that is not quite in the plane of its tree, or across it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Crooked {
    pub(crate) joint: usize,
    /// What it is meant to be, in the joint's frame.
    pub(crate) axis: Vec3,
    /// Sine of the angle between both.
    pub(crate) off: f64,
}

/// The axes that keep a tree from being planar where all are off by less than [`PARALLEL`]; none where some joint
/// moves otherwise. A normal that is nearly an axis of the world is meant to be that.
pub(crate) fn crooked(tree: &Tree) -> Vec<Crooked> {
    let mut zero: Vec<(Mat3, Vec3)> = Vec::with_capacity(tree.joints.len());
    let mut crooked = Vec::new();
    for (joint, at) in tree.joints.iter().enumerate() {
        let (rotation, normal) = if at.parent == WORLD {
            let Some(axis) = first_hinge(tree, joint) else { return Vec::new() };
            let is_meant = |unit: &Vec3| axis.cross(*unit).norm() <= PARALLEL;
            (at.rotation, Mat3::IDENTITY.0.into_iter().find(is_meant).unwrap_or(axis))
        } else {
            let (above, normal) = zero[at.parent];
            (above.times(&at.rotation), normal)
        };
        zero.push((rotation, normal));
        let axis = rotation.0[2];
        let along = axis.dot(normal);
        let (off, meant) = match at.kind {
            JointKind::Revolute => (axis.cross(normal).norm(), normal * along.signum()),
            JointKind::Prismatic => (along.abs(), axis - normal * along),
            _ => return Vec::new(),
        };
        if !(off <= PARALLEL) {
            return Vec::new();
        }
        if off > ROUND_OFF {
            let axis = rotation.apply_transposed(meant * (1.0 / meant.norm()));
            crooked.push(Crooked { joint, axis, off });
        }
    }
    crooked
}
