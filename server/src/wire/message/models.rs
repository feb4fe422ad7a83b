//! Models.

use plantd_models::scene::{Scene, Signal};
use plantd_models::{Model, Violation};
use plantd_proto::v1;

/// A model as a message; `with_texts` adds the scene and the plan.
pub fn model(name: &str, builtin: bool, model: &Model, with_texts: bool) -> v1::Model {
    let scene = model.scene();
    v1::Model {
        name: name.to_owned(),
        description: scene.description.clone(),
        builtin,
        coordinates: coordinates(model),
        inputs: scene.inputs.iter().map(|input| input.name.clone()).collect(),
        constraints: model.constraint_names().to_vec(),
        operating_points: model.operating_points().iter().map(|p| p.name.clone()).collect(),
        scene_toml: if with_texts { scene.to_toml() } else { String::new() },
        plan: if with_texts { model.plan() } else { String::new() },
        time_step_s: scene.time_step_s,
        signals: signals(model),
        initial_violations: model.initial_violations().iter().map(violation).collect(),
        input_limits: input_limits(scene),
        warnings: model.warnings().iter().map(ToString::to_string).collect(),
    }
}

fn limits([low, high]: [f64; 2]) -> v1::Limits {
    v1::Limits { low, high }
}

fn input_limits(scene: &Scene) -> Vec<v1::InputLimits> {
    let with = |(i, input): (usize, &plantd_models::scene::Input)| {
        let limits = limits(input.limits?);
        Some(v1::InputLimits { u_index: i as u32, limits: Some(limits) })
    };
    scene.inputs.iter().enumerate().filter_map(with).collect()
}

fn violation(violation: &Violation) -> v1::ConstraintViolation {
    let Violation { constraint, value } = violation;
    v1::ConstraintViolation { constraint: constraint.clone(), value: *value }
}

fn signals(model: &Model) -> Vec<v1::Signal> {
    let (scene, dynamic) = (model.scene(), model.dimensions().dynamic);
    let signal = |signal: &Signal| {
        let drives = signal.drives();
        let kind = match signal {
            Signal::Constant { .. } => "constant",
            Signal::Sinusoid { .. } => "sinusoid",
            Signal::Chirp { .. } => "chirp",
            Signal::Spline { .. } => "spline",
            Signal::Table { .. } => "table",
        };
        let input = scene.inputs.iter().position(|input| input.name == drives);
        let prescribed =
            || Some(model.coordinate_index(drives)?.checked_sub(dynamic)? + scene.inputs.len());
        Some(v1::Signal {
            drives: drives.to_owned(),
            u_index: input.or_else(prescribed)? as u32,
            kind: kind.to_owned(),
            replaces: input.is_none(),
        })
    };
    scene.signals.iter().filter_map(signal).collect()
}

fn coordinates(model: &Model) -> Vec<v1::Coordinate> {
    let mut coordinates: Vec<_> = model.coordinates().iter().map(coordinate).collect();
    for &start in model.orientations() {
        let group = coordinates[start].name.trim_end_matches("_rx").to_owned();
        for component in &mut coordinates[start..start + 3] {
            component.rotation_group.clone_from(&group);
        }
    }
    coordinates
}

fn coordinate(coordinate: &plantd_models::Coordinate) -> v1::Coordinate {
    let unit = if coordinate.is_angle { v1::Unit::Radian } else { v1::Unit::Metre };
    v1::Coordinate {
        name: coordinate.name.clone(),
        prescribed: coordinate.kind == plantd_models::scene::CoordinateKind::Prescribed,
        unit: unit.into(),
        initial: coordinate.initial,
        rotation_group: String::new(),
        limits: coordinate.limits.map(limits),
    }
}
