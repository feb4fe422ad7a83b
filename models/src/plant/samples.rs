//! What tests of elements share: their scenes, configurations, and differences.

use std::path::Path;

use crate::plant::kinematics::Poses;
use crate::scalar::{Dual, Scalar};
use crate::spatial::Mat3;
use crate::tree::Tree;
use crate::{Model, Scene};

/// Models of the scenes of all elements whose configurations are plain numbers.
pub(crate) fn models() -> Vec<Model> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/elements");
    let models = std::fs::read_dir(folder).unwrap().map(|entry| {
        let text = std::fs::read_to_string(entry.unwrap().path()).unwrap();
        Model::compile(&Scene::from_toml(&text).unwrap()).unwrap()
    });
    models.filter(|model| model.orientations.is_empty()).collect()
}

/// A configuration off the initial one, and a direction.
pub(crate) fn configuration(model: &Model, sample: usize) -> (Vec<f64>, Vec<f64>) {
    let wave = |i: usize, phase: f64| (1.7 * i as f64 + 2.9 * sample as f64 + phase).sin();
    let coordinates = model.coordinates().iter().enumerate();
    let q = coordinates.map(|(i, c)| c.initial + 0.3 * wave(i, 0.4)).collect::<Vec<_>>();
    let direction = (0..q.len()).map(|i| wave(i, 2.0)).collect();
    (q, direction)
}

/// `q + direction ε`.
pub(crate) fn along(q: &[f64], direction: &[f64]) -> Vec<Dual> {
    q.iter().zip(direction).map(|(q, d)| Dual::new(*q, *d)).collect()
}

/// Poses at a configuration.
pub(crate) fn poses<S: Scalar>(tree: &Tree, q: &[S]) -> Poses<S> {
    let mut poses = Poses::new(tree);
    poses.evaluate(tree, q, &[] as &[Mat3<S>]);
    poses
}

/// Derivative along a direction, by sixth-order central differences.
pub(crate) fn slope(
    q: &[f64],
    direction: &[f64],
    mut f: impl FnMut(&[f64]) -> Vec<f64>,
) -> Vec<f64> {
    const DELTA: f64 = 2e-3;
    let stencil = [(1.0, 3.0 / 4.0), (2.0, -3.0 / 20.0), (3.0, 1.0 / 60.0)];
    let mut sum = Vec::new();
    for (offset, weight) in stencil {
        for sign in [1.0, -1.0] {
            let moved: Vec<f64> =
                q.iter().zip(direction).map(|(q, d)| q + sign * offset * DELTA * d).collect();
            let values = f(&moved);
            sum.resize(values.len(), 0.0);
            sum.iter_mut().zip(values).for_each(|(s, x)| *s += sign * weight / DELTA * x);
        }
    }
    sum
}

/// The direction of one coordinate.
pub(crate) fn unit(n: usize, i: usize) -> Vec<f64> {
    (0..n).map(|j| if i == j { 1.0 } else { 0.0 }).collect()
}

pub(crate) fn assert_close(what: &str, found: &[f64], expected: &[f64]) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let scale = expected.iter().fold(1.0_f64, |m, x| m.max(x.abs()));
    for (i, (x, y)) in found.iter().zip(expected).enumerate() {
        assert!((x - y).abs() < 1e-9 * scale, "{what} [{i}]: {x} instead of {y}");
    }
}
