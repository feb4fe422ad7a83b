//! Frames with their shapes: those that the scene gives them, else what stands for the inertia of their body.
//!
//! A box of mass `m`, of uniform density and with edges `l`, has the principal moments
//! `I_x = m (l_y² + l_z²) / 12` and so on; so of a body with the moments `I`
//!
//! ```text
//! l_x² = 6 (I_y + I_z − I_x) / m
//! ```

use nalgebra::Matrix3;
use plantd_math::rotation::Quaternion;
use plantd_math::spatial::{Mat3, Sym3, Vec3};
use plantd_scene as scene;

use crate::compile::scene::{Placement, full, placed, rotation};
use crate::drawing::rig::Rig;

/// Least edge of a box that stands for inertia, of its longest one: a rod can be seen, too.
const THIN: f64 = 1.0 / 50.0;
/// Radius of the ball of the greatest point mass, of the size of the mechanism.
const BALL: f64 = 1.0 / 25.0;
/// Radius of the least ball, of that of the greatest.
const SMALL: f64 = 0.4;

/// A frame that has something to show.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Name.
    pub name: String,
    /// Name of the frame that carries it; `world` for the outermost.
    pub parent: String,
    /// Mass of its body, kg; 0 without one.
    pub mass_kg: f64,
    /// At least one.
    pub shapes: Vec<Shape>,
}

/// A shape in the axes of its frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    /// What it looks like.
    pub form: Form,
    /// Its origin in the frame, m.
    pub position: [f64; 3],
    /// Its axes in the frame: unit quaternion `w, x, y, z`.
    pub orientation: [f64; 4],
    /// Red, green, blue and opacity, from 0 to 1, if the scene says so.
    pub color: Option<[f64; 4]>,
    /// The scene shows nothing of this body: the shape is the box of uniform density with its inertia, or a ball
    /// for a point mass.
    pub stands_for_inertia: bool,
}

/// What a shape looks like; centred on its own origin, round ones along z.
#[derive(Clone, Debug, PartialEq)]
pub enum Form {
    /// A box with its full lengths along x, y and z, m.
    Box([f64; 3]),
    /// An ellipsoid with its full lengths along x, y and z, m.
    Ellipsoid([f64; 3]),
    /// A cylinder with a half ball on each end, m; of length 0, a ball.
    Capsule {
        /// m.
        radius: f64,
        /// Of the cylinder alone, m.
        length: f64,
    },
    /// A cylinder.
    Cylinder {
        /// m.
        radius: f64,
        /// m.
        length: f64,
    },
    /// A mesh in a file.
    Mesh {
        /// As the scene names it.
        file: String,
        /// Factors along x, y and z.
        scale: [f64; 3],
    },
}

impl Shape {
    /// Radius of a ball about its origin that has it inside; 0 of a mesh, which nobody has read.
    pub(super) fn reach(&self) -> f64 {
        match self.form {
            Form::Box(size) => 0.5 * Vec3(size).norm(),
            Form::Ellipsoid(size) => 0.5 * size.into_iter().fold(0.0, f64::max),
            Form::Capsule { radius, length } => radius + 0.5 * length,
            Form::Cylinder { radius, length } => radius.hypot(0.5 * length),
            Form::Mesh { .. } => 0.0,
        }
    }
}

/// A drawn frame, with where it is fixed.
#[derive(Clone, Debug)]
pub(super) struct Placed {
    pub(super) frame: Frame,
    pub(super) placement: Placement,
}

/// The frames of a scene that have something to show; balls are of size zero yet.
pub(super) fn shown(scene: &scene::Scene, rig: &Rig) -> Vec<Placed> {
    let shown = |frame: &scene::Frame| {
        let mut shapes: Vec<Shape> = frame.visuals.iter().map(visual).collect();
        if shapes.is_empty() {
            shapes.extend(frame.body.as_ref().and_then(standing_for));
        }
        let (name, parent) = (frame.name.clone(), frame.parent.clone());
        let mass_kg = frame.body.as_ref().map_or(0.0, |body| body.mass);
        let placement = rig.frame(&name);
        let frame = Frame { name, parent, mass_kg, shapes };
        (!frame.shapes.is_empty()).then_some(Placed { frame, placement })
    };
    scene.frames.iter().filter_map(shown).collect()
}

/// Gives the balls of point masses their sizes, in a mechanism of some size: volumes are as masses.
pub(super) fn size_balls(frames: &mut [Placed], size_m: f64) {
    let is_ball = |shape: &Shape| {
        shape.stands_for_inertia && matches!(shape.form, Form::Capsule { radius: 0.0, .. })
    };
    let with_ball = |placed: &&mut Placed| placed.frame.shapes.iter().any(is_ball);
    let masses = frames.iter_mut().filter(with_ball).map(|placed| placed.frame.mass_kg);
    let greatest = masses.fold(0.0, f64::max);
    for Placed { frame, .. } in frames {
        let part = if greatest > 0.0 { (frame.mass_kg / greatest).cbrt() } else { 1.0 };
        for shape in frame.shapes.iter_mut().filter(|shape| is_ball(shape)) {
            shape.form = Form::Capsule { radius: BALL * size_m * part.max(SMALL), length: 0.0 };
        }
    }
}

fn visual(visual: &scene::Visual) -> Shape {
    let form = match &visual.shape {
        scene::Shape::Box { size } => Form::Box(*size),
        scene::Shape::Ellipsoid { radii } => Form::Ellipsoid(radii.map(|radius| 2.0 * radius)),
        scene::Shape::Sphere { radius } => Form::Capsule { radius: *radius, length: 0.0 },
        scene::Shape::Capsule { radius, length } => {
            Form::Capsule { radius: *radius, length: *length }
        }
        scene::Shape::Cylinder { radius, length } => {
            Form::Cylinder { radius: *radius, length: *length }
        }
        scene::Shape::Mesh { file, scale } => Form::Mesh { file: file.clone(), scale: *scale },
    };
    Shape {
        form,
        position: visual.translation,
        orientation: Quaternion::of_matrix(&rotation(visual.rotation.as_ref())).0,
        color: visual.color,
        stands_for_inertia: false,
    }
}

/// What stands for the inertia of a body; none if it has neither mass nor inertia.
fn standing_for(body: &scene::Body) -> Option<Shape> {
    let tensor = full(&placed(body, &Placement::HERE).inertia);
    if body.mass <= 0.0 && tensor == Sym3::default() {
        return None;
    }
    let (form, axes) = equal_box(body.mass, &tensor)
        .map_or((Form::Capsule { radius: 0.0, length: 0.0 }, Mat3::IDENTITY), |(size, axes)| {
            (Form::Box(size), axes)
        });
    Some(Shape {
        form,
        position: body.center_of_mass,
        orientation: Quaternion::of_matrix(&axes).0,
        color: None,
        stands_for_inertia: true,
    })
}

/// The edges of the box with a mass and an inertia, and its axes; none without extent.
fn equal_box(mass: f64, tensor: &Sym3) -> Option<([f64; 3], Mat3)> {
    let Sym3 { xx, yy, zz, xy, xz, yz } = *tensor;
    let (moments, axes) = if [xy, xz, yz] == [0.0; 3] {
        ([xx, yy, zz], Mat3::IDENTITY)
    } else {
        let eigen = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz).symmetric_eigen();
        let column = |i: usize| Vec3(eigen.eigenvectors.column(i).into_owned().into());
        let (x, y) = (column(0), column(1));
        (eigen.eigenvalues.into(), Mat3([x, y, x.cross(y)]))
    };
    let sum: f64 = moments.iter().sum();
    let edges = moments.map(|moment: f64| (6.0 * (sum - 2.0 * moment) / mass).max(0.0).sqrt());
    let longest = edges.into_iter().fold(0.0, f64::max);
    let is_box = mass > 0.0 && longest > 0.0 && longest.is_finite();
    is_box.then(|| (edges.map(|edge| edge.max(THIN * longest)), axes))
}
