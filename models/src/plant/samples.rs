//! What tests of elements share: their scenes, configurations, and differences.

use std::path::Path;

use crate::plant::balls::orientations;
use crate::plant::kinematics::Poses;
use crate::scalar::{Dual, Scalar};
use crate::spatial::{Mat3, Vec3};
use crate::tree::Tree;
use crate::{Model, Scene, rotation};

/// Models of the scenes of all elements.
pub(crate) fn models() -> Vec<Model> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/elements");
    let models = std::fs::read_dir(folder).unwrap().map(|entry| {
        let text = std::fs::read_to_string(entry.unwrap().path()).unwrap();
        Model::compile(&Scene::from_toml(&text).unwrap()).unwrap()
    });
    models.collect()
}

/// A configuration, with the orientations of ball joints.
pub(crate) struct Configuration<S> {
    pub(crate) q: Vec<S>,
    pub(crate) orientations: Vec<Mat3<S>>,
}

impl<S: Scalar> Configuration<S> {
    /// Poses of the joints of a tree.
    pub(crate) fn poses(&self, tree: &Tree) -> Poses<S> {
        let mut poses = Poses::new(tree);
        poses.evaluate(tree, &self.q, &self.orientations);
        poses
    }
}

/// A configuration off the initial one, and a direction.
pub(crate) fn configuration(model: &Model, sample: usize) -> (Configuration<f64>, Vec<f64>) {
    let wave = |i: usize, phase: f64| (1.7 * i as f64 + 2.9 * sample as f64 + phase).sin();
    let coordinates = model.coordinates().iter().enumerate();
    let q = coordinates.map(|(i, c)| c.initial + 0.3 * wave(i, 0.4)).collect::<Vec<_>>();
    let direction = (0..q.len()).map(|i| wave(i, 2.0)).collect();
    (Configuration { orientations: orientations(model, &q), q }, direction)
}

/// The configuration that lies `change` beyond another.
fn moved<S: Scalar>(model: &Model, at: &Configuration<f64>, change: &[S]) -> Configuration<S> {
    let turned = |(&i, turn): (&usize, &Mat3)| {
        Mat3::lift(*turn).times(&rotation::exp(Vec3([change[i], change[i + 1], change[i + 2]])))
    };
    Configuration {
        q: at.q.iter().zip(change).map(|(q, change)| *change + *q).collect(),
        orientations: model.orientations.iter().zip(&at.orientations).map(turned).collect(),
    }
}

/// `q + direction ε`.
pub(crate) fn along(
    model: &Model,
    at: &Configuration<f64>,
    direction: &[f64],
) -> Configuration<Dual> {
    let change: Vec<_> = direction.iter().map(|d| Dual::new(0.0, *d)).collect();
    moved(model, at, &change)
}

/// Derivative along a direction, by sixth-order central differences.
pub(crate) fn slope(
    model: &Model,
    at: &Configuration<f64>,
    direction: &[f64],
    mut f: impl FnMut(&Configuration<f64>) -> Vec<f64>,
) -> Vec<f64> {
    const DELTA: f64 = 2e-3;
    let stencil = [(1.0, 3.0 / 4.0), (2.0, -3.0 / 20.0), (3.0, 1.0 / 60.0)];
    let mut sum = Vec::new();
    for (offset, weight) in stencil {
        for sign in [1.0, -1.0] {
            let change: Vec<f64> = direction.iter().map(|d| sign * offset * DELTA * d).collect();
            let values = f(&moved(model, at, &change));
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
