//! Inertias in the configuration in which a model stands in the file.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use nalgebra::DMatrix;
use plantd_models::scene::{CoordinateKind, Frame, Input};
use plantd_models::{Continuous, ContinuousPoint, Model, Scene};

/// `M⁻¹` over the dynamic coordinates, armature included.
pub(super) struct Mobility {
    /// Rows of coordinates.
    rows: BTreeMap<String, usize>,
    inverse: DMatrix<f64>,
}

impl Mobility {
    /// How accelerations answer to a force on each dynamic coordinate: a column of `M⁻¹` each.
    pub(super) fn of(scene: &Scene) -> Option<Self> {
        let mut bare = Scene {
            name: "start".to_owned(),
            format: scene.format,
            time_step_s: scene.time_step_s,
            gravity: Some([0.0; 3]),
            frames: scene.frames.clone(),
            coordinates: scene.coordinates.clone(),
            armatures: scene.armatures.clone(),
            ..Scene::default()
        };
        let prescribed = scene.coordinates.iter().filter(|c| c.kind == CoordinateKind::Prescribed);
        let prescribed: BTreeSet<&str> = prescribed.map(|c| c.name.as_str()).collect();
        let names = scene.frames.iter().flat_map(Frame::motions).map(|(name, _)| name);
        let names: Vec<String> = names.filter(|name| !prescribed.contains(&**name)).collect();
        let input = |name: &String| Input {
            name: name.clone(),
            coordinate: Some(name.clone()),
            ..Input::default()
        };
        bare.inputs = names.iter().map(input).collect();
        let model = Arc::new(Model::compile(&bare).ok()?);
        let q: Vec<f64> = model.coordinates().iter().map(|coordinate| coordinate.initial).collect();
        let (all, dynamic) = (q.len(), names.len());
        let point = ContinuousPoint {
            q,
            v: vec![0.0; all],
            inputs: vec![0.0; dynamic],
            prescribed_acceleration: vec![0.0; all - dynamic],
        };
        let order: Option<Vec<usize>> =
            names.iter().map(|name| model.coordinate_index(name)).collect();
        let order = order?;
        let rates = Continuous::new(model).linearize(&point).ok()?.jacobian;
        let inverse = DMatrix::from_fn(dynamic, dynamic, |i, j| rates[(order[i], 2 * all + j)]);
        Some(Self {
            rows: names.into_iter().enumerate().map(|(i, name)| (name, i)).collect(),
            inverse,
        })
    }

    /// How fast a sum of coordinates answers to a force along it, `c M⁻¹ cᵀ`: the inverse of its inertia.
    pub(super) fn along<'n>(&self, terms: impl Iterator<Item = (&'n str, f64)>) -> f64 {
        let rows = terms.filter_map(|(name, factor)| Some((*self.rows.get(name)?, factor)));
        let rows: Vec<_> = rows.collect();
        let pairs = rows.iter().flat_map(|a| rows.iter().map(move |b| (a, b)));
        pairs.map(|(&(i, a), &(j, b))| a * b * self.inverse[(i, j)]).sum()
    }
}
