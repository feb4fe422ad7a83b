//! Joint trees that move in planes: all that turns in a tree turns about parallel axes, all that slides
//! does so across them. Their mechanics is that of vectors of three numbers, not of six.

use crate::spatial::{Mat3, Vec3};
use crate::tree::{JointKind, Rotational, Tree, WORLD};

/// Sine of the angle below which two axes count as parallel: what rounding leaves of a rotation.
const PARALLEL: f64 = 1e-15;

/// A joint with everything that is fixed to it, in the axes of its tree's plane at the configuration zero.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlanarJoint {
    /// Index of the parent joint plus one; 0 for the world.
    pub(crate) parent: usize,
    /// Index of the coordinate.
    pub(crate) coordinate: usize,
    /// How far it turns in the plane for a unit of its coordinate: 1, −1, or 0 for a slider.
    pub(crate) turn: f64,
    /// How far it slides; zero for a hinge.
    pub(crate) slide: [f64; 2],
    /// From the parent joint to this one.
    pub(crate) offset: [f64; 2],
    /// From the joint to the centre of mass.
    pub(crate) center: [f64; 2],
    pub(crate) mass: f64,
    /// About the centre of mass and the normal of the plane.
    pub(crate) inertia: f64,
    /// Mass of the joint's subtree.
    pub(crate) subtree_mass: f64,
    /// Gravity in the plane; zero without.
    pub(crate) gravity: [f64; 2],
    /// Joints below this one: they follow it in the list.
    pub(crate) descendants: usize,
    /// The evaluation's origin moves to this joint, as in [`Tree`].
    pub(crate) anchor: bool,
}

/// Axes of a tree's plane in the world, its normal last, and the pose of a joint at the configuration
/// zero.
#[derive(Clone, Copy)]
struct Zero {
    plane: Mat3,
    rotation: Mat3,
}

/// The joints of a tree in their planes, one plane for each root; `None` if some tree has none.
pub(crate) fn planar(tree: &Tree, gravity: Option<Vec3>) -> Option<Vec<PlanarJoint>> {
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
            turn,
            slide,
            offset,
            center: local(rotation.apply(joint.body.center)).0,
            mass: joint.body.mass,
            inertia,
            subtree_mass: joint.subtree_mass,
            gravity: gravity.map_or([0.0; 2], |g| local(g).0),
            descendants: 0,
            anchor: joint.anchor,
        });
        zero.push(Zero { plane, rotation });
    }
    for i in (0..joints.len()).rev() {
        if let Some(parent) = joints[i].parent.checked_sub(1) {
            joints[parent].descendants += joints[i].descendants + 1;
        }
    }
    Some(joints)
}

/// The plane across the first hinge of the tree with this root.
fn plane_of(tree: &Tree, root: usize) -> Option<Mat3> {
    let hinge = (root..tree.joints.len())
        .find(|&i| tree.joints[i].root == root && tree.joints[i].kind == JointKind::Revolute)?;
    let mut rotation = Mat3::IDENTITY;
    for joint in tree.path(hinge) {
        rotation = rotation.times(&tree.joints[joint].rotation);
    }
    Some(Mat3::with_z_along(rotation.0[2]))
}
