//! Drawings and poses.

use plantd_models::drawing::{
    Arrow, ArrowKind, Drawing, Form, Frame, Line, LineKind, Poses, Shape,
};
use plantd_proto::v1;
use v1::drawn_shape::Shape as ShapeForm;

/// A drawing; `url` says where the server has a file of a mesh, if it does.
pub fn drawing(drawing: &Drawing, url: impl Fn(&str) -> Option<String>) -> v1::Drawing {
    v1::Drawing {
        frames: drawing.frames().map(|one| frame(one, &url)).collect(),
        lines: drawing.lines().iter().map(line).collect(),
        arrows: drawing.arrows().iter().map(arrow).collect(),
        size_m: drawing.size_m(),
        gravity: drawing.gravity().to_vec(),
    }
}

/// Where everything is.
pub fn poses(poses: &Poses) -> v1::Poses {
    v1::Poses {
        frames: poses.frames.as_flattened().to_vec(),
        points: poses.points.as_flattened().to_vec(),
        arrows: poses.arrows.as_flattened().to_vec(),
    }
}

fn frame(frame: &Frame, url: impl Fn(&str) -> Option<String>) -> v1::DrawnFrame {
    let Frame { name, parent, mass_kg, shapes } = frame;
    v1::DrawnFrame {
        name: name.clone(),
        parent: parent.clone(),
        mass_kg: *mass_kg,
        shapes: shapes.iter().map(|one| shape(one, &url)).collect(),
    }
}

fn shape(shape: &Shape, url: impl Fn(&str) -> Option<String>) -> v1::DrawnShape {
    let form = match &shape.form {
        Form::Box(size) => ShapeForm::Box(v1::DrawnBox { size: size.to_vec() }),
        Form::Ellipsoid(size) => ShapeForm::Ellipsoid(v1::DrawnBox { size: size.to_vec() }),
        Form::Capsule { radius, length } => {
            ShapeForm::Capsule(v1::DrawnRound { radius: *radius, length: *length })
        }
        Form::Cylinder { radius, length } => {
            ShapeForm::Cylinder(v1::DrawnRound { radius: *radius, length: *length })
        }
        Form::Mesh { file, scale } => ShapeForm::Mesh(v1::DrawnMesh {
            url: url(file).unwrap_or_default(),
            file: file.clone(),
            scale: scale.to_vec(),
        }),
    };
    v1::DrawnShape {
        shape: Some(form),
        position: shape.position.to_vec(),
        orientation: shape.orientation.to_vec(),
        color: shape.color.iter().flatten().map(|part| *part as f32).collect(),
        stands_for_inertia: shape.stands_for_inertia,
    }
}

fn line(line: &Line) -> v1::DrawnLine {
    let kind = match line.kind {
        LineKind::Link => v1::LineKind::Link,
        LineKind::Spring => v1::LineKind::Spring,
        LineKind::Constraint => v1::LineKind::Constraint,
        LineKind::Path => v1::LineKind::Path,
    };
    v1::DrawnLine { kind: kind.into(), name: line.name.clone(), points: line.points as u32 }
}

fn arrow(arrow: &Arrow) -> v1::DrawnArrow {
    let kind = match arrow.kind {
        ArrowKind::Input => v1::ArrowKind::Input,
        ArrowKind::Constraint => v1::ArrowKind::Constraint,
    };
    v1::DrawnArrow { kind: kind.into(), name: arrow.name.clone(), torque: arrow.torque }
}
