//! Drawings and poses as messages that players show: `foxglove.FrameTransforms` and `foxglove.SceneUpdate`.

use plantd_proto::foxglove::line_primitive::Type;
use plantd_proto::foxglove::scene_entity_deletion::Type as Deletion;
use plantd_proto::foxglove::{
    ArrowPrimitive, Color, CubePrimitive, CylinderPrimitive, FrameTransform, FrameTransforms,
    KeyValuePair, LinePrimitive, ModelPrimitive, Point3, Pose, Quaternion, SceneEntity,
    SceneEntityDeletion, SceneUpdate, SpherePrimitive, Vector3,
};
use plantd_proto::v1::{self, drawn_shape::Shape};
use prost_types::Timestamp;

/// Name of the frame in which all others are.
const WORLD: &str = "world";
/// Thickness of lines, pixels.
const LINE_PIXELS: f64 = 3.0;
/// Standard gravity, m/s²: an arrow of the weight of all bodies has a quarter of the drawing's size.
const GRAVITY: f64 = 9.80665;
const OF_SIZE: f64 = 0.25;
/// Longest arrow, and diameters, of the drawing's size.
const LONGEST: f64 = 1.0;
const SHAFT: f64 = 0.012;
const HEAD: f64 = 0.03;

const BODY: Color = Color { r: 0.42, g: 0.56, b: 0.70, a: 1.0 };
const LINK: Color = Color { r: 0.55, g: 0.57, b: 0.60, a: 1.0 };
const SPRING: Color = Color { r: 0.20, g: 0.62, b: 0.36, a: 1.0 };
const CONSTRAINT: Color = Color { r: 0.85, g: 0.53, b: 0.10, a: 1.0 };
const PATH: Color = Color { r: 0.55, g: 0.35, b: 0.75, a: 1.0 };
const INPUT: Color = Color { r: 0.10, g: 0.45, b: 0.90, a: 1.0 };
const REACTION: Color = Color { r: 0.80, g: 0.20, b: 0.15, a: 1.0 };

/// Where frames are in the world.
pub(super) fn transforms(drawing: &v1::Drawing, poses: &v1::Poses, at_ns: u64) -> FrameTransforms {
    let place = |(frame, pose): (&v1::DrawnFrame, &[f64])| FrameTransform {
        timestamp: Some(timestamp(at_ns)),
        parent_frame_id: WORLD.to_owned(),
        child_frame_id: frame.name.clone(),
        translation: Some(vector(&pose[..3])),
        rotation: Some(quaternion(&pose[3..])),
    };
    let frames = drawing.frames.iter().zip(poses.frames.chunks_exact(7));
    FrameTransforms { transforms: frames.map(place).collect() }
}

/// The shapes, each in its frame, in the place of all that was there.
pub(super) fn shapes(drawing: &v1::Drawing, at_ns: u64) -> SceneUpdate {
    let all = SceneEntityDeletion {
        timestamp: Some(timestamp(at_ns)),
        r#type: Deletion::All.into(),
        ..Default::default()
    };
    let entities = drawing.frames.iter().map(|frame| {
        let mut entity = entity(&frame.name, &frame.name, at_ns);
        if frame.mass_kg > 0.0 {
            entity.metadata = vec![fact("mass_kg", frame.mass_kg)];
        }
        frame.shapes.iter().for_each(|shape| add(&mut entity, shape));
        entity
    });
    SceneUpdate { deletions: vec![all], entities: entities.collect() }
}

/// Lines, those of one kind that follow each other in one, and arrows, in the order of the drawing.
pub(super) fn lines(drawing: &v1::Drawing, poses: &v1::Poses, at_ns: u64) -> SceneUpdate {
    let mut entity = entity("lines", WORLD, at_ns);
    let mut points = poses.points.chunks_exact(3);
    let mut last = None;
    for line in &drawing.lines {
        if last != Some(line.kind()) {
            last = Some(line.kind());
            entity.lines.push(segments(line.kind()));
        }
        let points: Vec<_> = points
            .by_ref()
            .take(line.points as usize)
            .map(|at| Point3 { x: at[0], y: at[1], z: at[2] })
            .collect();
        if let Some(segments) = entity.lines.last_mut() {
            segments.points.extend(points.windows(2).flatten());
        }
    }
    let mass = drawing.frames.iter().map(|frame| frame.mass_kg).sum::<f64>();
    let newton = OF_SIZE * drawing.size_m / (mass.max(1e-6) * GRAVITY);
    let newton_metre = newton / drawing.size_m;
    if !drawing.arrows.is_empty() {
        let (per_newton, per_newton_metre) = ("metres_per_newton", "metres_per_newton_metre");
        entity.metadata = vec![fact(per_newton, newton), fact(per_newton_metre, newton_metre)];
    }
    for (arrow, numbers) in drawing.arrows.iter().zip(poses.arrows.chunks_exact(6)) {
        let scale = if arrow.torque { newton_metre } else { newton };
        let color = match arrow.kind() {
            v1::ArrowKind::Input | v1::ArrowKind::Unspecified => INPUT,
            v1::ArrowKind::Constraint => REACTION,
        };
        entity.arrows.push(arrow_at(numbers, scale, drawing.size_m, color));
    }
    SceneUpdate { deletions: Vec::new(), entities: vec![entity] }
}

/// Room for the segments of lines of a kind.
fn segments(kind: v1::LineKind) -> LinePrimitive {
    LinePrimitive {
        r#type: Type::LineList.into(),
        pose: Some(pose(&[], &[])),
        thickness: LINE_PIXELS,
        scale_invariant: true,
        color: Some(match kind {
            v1::LineKind::Link | v1::LineKind::Unspecified => LINK,
            v1::LineKind::Spring => SPRING,
            v1::LineKind::Constraint => CONSTRAINT,
            v1::LineKind::Path => PATH,
        }),
        ..Default::default()
    }
}

/// An arrow from where it acts, as long as it is strong up to a length.
fn arrow_at(numbers: &[f64], scale: f64, size_m: f64, color: Color) -> ArrowPrimitive {
    let (at, force) = numbers.split_at(3);
    let strength = force.iter().map(|f| f * f).sum::<f64>().sqrt();
    let length = (scale * strength).min(LONGEST * size_m);
    let head = length.min(2.0 * HEAD * size_m);
    // The half turn between x and the force turns one into the other.
    let half = match strength > 0.0 {
        true => [force[0] / strength + 1.0, force[1] / strength, force[2] / strength],
        false => [1.0, 0.0, 0.0],
    };
    let norm = half.iter().map(|h| h * h).sum::<f64>().sqrt();
    let turned = match norm > 1e-9 {
        // 1, x and the normal of both: (cos, sin (0, -z, y)) of half the angle.
        true => [half[0] / norm, 0.0, -half[2] / norm, half[1] / norm],
        false => [0.0, 0.0, 0.0, 1.0],
    };
    ArrowPrimitive {
        pose: Some(pose(at, &turned)),
        shaft_length: length - head,
        shaft_diameter: if length > 0.0 { SHAFT * size_m } else { 0.0 },
        head_length: head,
        head_diameter: if length > 0.0 { HEAD * size_m } else { 0.0 },
        color: Some(color),
    }
}

fn add(entity: &mut SceneEntity, shape: &v1::DrawnShape) {
    let color = match shape.color[..] {
        [r, g, b, a] => Color { r: r.into(), g: g.into(), b: b.into(), a: a.into() },
        _ => BODY,
    };
    let (at, axes) = (&shape.position[..], &shape.orientation[..]);
    let (pose, color) = (Some(pose(at, axes)), Some(color));
    match &shape.shape {
        Some(Shape::Box(v1::DrawnBox { size })) => {
            entity.cubes.push(CubePrimitive { pose, size: Some(vector(size)), color });
        }
        Some(Shape::Ellipsoid(v1::DrawnBox { size })) => {
            entity.spheres.push(SpherePrimitive { pose, size: Some(vector(size)), color });
        }
        Some(Shape::Cylinder(round)) => entity.cylinders.push(cylinder(round, pose, color)),
        Some(Shape::Capsule(round)) => {
            let diameter = 2.0 * round.radius;
            let size = Some(Vector3 { x: diameter, y: diameter, z: diameter });
            if round.length > 0.0 {
                entity.cylinders.push(cylinder(round, pose, color));
            }
            let ends: &[f64] = if round.length > 0.0 { &[-0.5, 0.5] } else { &[0.0] };
            for end in ends {
                let middle = along_z(at, axes, end * round.length);
                let pose = Some(self::pose(&middle, axes));
                entity.spheres.push(SpherePrimitive { pose, size, color });
            }
        }
        // Players have no other way to files than addresses.
        Some(Shape::Mesh(mesh)) if mesh.file.contains("://") => {
            let override_color = !shape.color.is_empty();
            let (scale, url) = (Some(vector(&mesh.scale)), mesh.file.clone());
            let model =
                ModelPrimitive { pose, scale, color, override_color, url, ..Default::default() };
            entity.models.push(model);
        }
        Some(Shape::Mesh(_)) | None => {}
    }
}

fn cylinder(round: &v1::DrawnRound, pose: Option<Pose>, color: Option<Color>) -> CylinderPrimitive {
    let diameter = 2.0 * round.radius;
    let size = Some(Vector3 { x: diameter, y: diameter, z: round.length });
    CylinderPrimitive { pose, size, bottom_scale: 1.0, top_scale: 1.0, color }
}

fn entity(id: &str, frame: &str, at_ns: u64) -> SceneEntity {
    SceneEntity {
        timestamp: Some(timestamp(at_ns)),
        frame_id: frame.to_owned(),
        id: id.to_owned(),
        frame_locked: true,
        ..Default::default()
    }
}

fn fact(key: &str, value: f64) -> KeyValuePair {
    KeyValuePair { key: key.to_owned(), value: value.to_string() }
}

/// A point on the z axis of a shape.
fn along_z(at: &[f64], axes: &[f64], z: f64) -> [f64; 3] {
    let (at, Quaternion { x: i, y: j, z: k, w }) = (vector(at), quaternion(axes));
    let axis = [2.0 * (i * k + w * j), 2.0 * (j * k - w * i), 1.0 - 2.0 * (i * i + j * j)];
    [at.x + z * axis[0], at.y + z * axis[1], at.z + z * axis[2]]
}

fn pose(at: &[f64], axes: &[f64]) -> Pose {
    Pose { position: Some(vector(at)), orientation: Some(quaternion(axes)) }
}

fn vector(numbers: &[f64]) -> Vector3 {
    match *numbers {
        [x, y, z] => Vector3 { x, y, z },
        _ => Vector3::default(),
    }
}

/// From w, x, y, z.
fn quaternion(numbers: &[f64]) -> Quaternion {
    match *numbers {
        [w, x, y, z] => Quaternion { x, y, z, w },
        _ => Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 },
    }
}

fn timestamp(ns: u64) -> Timestamp {
    const SECOND: u64 = 1_000_000_000;
    Timestamp { seconds: (ns / SECOND) as i64, nanos: (ns % SECOND) as i32 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// x after a rotation.
    fn turned(q: Quaternion) -> [f64; 3] {
        let Quaternion { x, y, z, w } = q;
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)]
    }

    #[test]
    fn an_arrow_points_where_its_force_does() {
        let directions = [
            [3.0, 0.0, 0.0],
            [-3.0, 0.0, 0.0],
            [0.0, 2.0, 0.0],
            [0.0, 0.0, -1.0],
            [1.0, -2.0, 2.0],
        ];
        for force in directions {
            let numbers = [&[0.1, 0.2, 0.3], &force[..]].concat();
            let arrow = arrow_at(&numbers, 0.01, 1.0, INPUT);
            let Pose { position, orientation } = arrow.pose.unwrap();
            assert_eq!(position.unwrap(), Vector3 { x: 0.1, y: 0.2, z: 0.3 });
            let strength = force.iter().map(|f| f * f).sum::<f64>().sqrt();
            assert!((arrow.shaft_length + arrow.head_length - 0.01 * strength).abs() < 1e-15);
            for (x, f) in turned(orientation.unwrap()).iter().zip(force) {
                assert!((x - f / strength).abs() < 1e-12, "{force:?}");
            }
        }
        let nothing = arrow_at(&[0.0; 6], 0.01, 1.0, INPUT);
        assert_eq!((nothing.shaft_length, nothing.head_length), (0.0, 0.0));
    }

    #[test]
    fn a_capsule_is_a_cylinder_between_balls() {
        let half = 0.5_f64.sqrt();
        let shape = v1::DrawnShape {
            shape: Some(Shape::Capsule(v1::DrawnRound { radius: 0.1, length: 2.0 })),
            position: vec![1.0, 2.0, 3.0],
            // A quarter turn about x takes z to -y.
            orientation: vec![half, half, 0.0, 0.0],
            ..Default::default()
        };
        let mut entity = SceneEntity::default();
        add(&mut entity, &shape);
        let ends: Vec<_> =
            entity.spheres.iter().map(|ball| ball.pose.unwrap().position.unwrap()).collect();
        assert_eq!((entity.cylinders.len(), ends.len()), (1, 2));
        for (end, y) in ends.iter().zip([3.0, 1.0]) {
            assert!((end.y - y).abs() < 1e-12 && (end.z - 3.0).abs() < 1e-12, "{end:?}");
        }
    }
}
