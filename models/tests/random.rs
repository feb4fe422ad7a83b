//! Thousands of random scenes of every kind of joint, spring, force and constraint: derivatives of
//! first and second order along random directions, the symplectic form, momenta, energy.

use std::sync::Arc;

use crate::common::Numbers;
use crate::common::random_scene::{Kind, scene};
use nalgebra::{DMatrix, DVector, Vector3};
use plantd_models::{
    Continuous, ContinuousPoint, Contraction, ForceSplit, Initial, Linearization, Model, Plant,
    Scene, Settings,
};

/// A plant of a random scene in motion, with the input of its next step; none where the scene makes no
/// sense (two ends of a spring on one body) or stands at a singular point.
fn moving(seed: u64, kind: Kind, split: ForceSplit) -> Option<(Plant, Vec<f64>)> {
    let text = scene(seed, kind);
    let model = Arc::new(Model::compile(&Scene::from_toml(&text).unwrap()).ok()?);
    let settings = Settings { time_step_s: 0.005, force_split: split, ..Settings::new(&model) };
    let mut plant = Plant::new(model.clone(), settings).ok()?;
    let d = model.dimensions();
    let mut random = Numbers::new(!seed);
    let v: Vec<f64> = (0..d.coordinates())
        .map(|i| if i < d.dynamic { random.between(-1.0, 1.0) } else { 0.0 })
        .collect();
    let q = plant.q().to_vec();
    plant.initialize(&Initial::Velocity { q, v }).ok()?;
    let mut u = Vec::new();
    for k in 0..4 {
        let forces = (0..d.inputs).map(|i| (f64::from(k) + i as f64).sin());
        let change: Vec<f64> = (0..d.coordinates())
            .map(
                |i| if i < d.dynamic { 0.0 } else { 0.004 * (i as f64 + 0.3 * f64::from(k)).cos() },
            )
            .collect();
        let next = model.retract(plant.q(), &change);
        u = forces.chain(next[d.dynamic..].iter().copied()).collect();
        if k < 3 {
            plant.step(&u).ok()?;
        }
    }
    let report = plant.clone().step(&u).ok()?;
    let regular =
        report.constraint_reciprocal_condition > 1e-3 && report.redundant_constraints == 0;
    regular.then_some((plant, u))
}

/// Sixth-order central difference.
fn slope(delta: f64, mut along: impl FnMut(f64) -> DVector<f64>) -> DVector<f64> {
    let stencil = [(1.0, 3.0 / 4.0), (2.0, -3.0 / 20.0), (3.0, 1.0 / 60.0)];
    stencil
        .into_iter()
        .map(|(k, weight)| (along(k * delta) - along(-k * delta)) * (weight / delta))
        .reduce(|a, b| a + b)
        .unwrap()
}

/// A random displacement of state and input that keeps the constraints.
struct Direction {
    q: Vec<f64>,
    p: Vec<f64>,
    u: Vec<f64>,
}

impl Direction {
    fn new(plant: &Plant, seed: u64) -> Self {
        let d = plant.model().dimensions();
        let mut random = Numbers::new(seed ^ 0x5eed);
        let mut some = |n: usize, size: f64| -> Vec<f64> {
            (0..n).map(|_| random.between(-size, size)).collect()
        };
        let constrained = d.constraints > 0;
        Self {
            q: some(d.coordinates(), if constrained { 0.0 } else { 1.0 }),
            p: some(d.dynamic, 0.3),
            u: some(d.input(), 1.0),
        }
    }

    fn state(&self) -> DVector<f64> {
        let rest = vec![0.0; self.q.len() - self.p.len()];
        DVector::from_vec([&self.q[..], &self.p, &rest].concat())
    }

    fn input(&self) -> DVector<f64> {
        DVector::from_row_slice(&self.u)
    }

    /// Puts a plant where it is after `s` along the direction, and returns the input there.
    fn go(&self, plant: &mut Plant, from: &Plant, u: &[f64], s: f64) -> Vec<f64> {
        let model = from.model();
        let d = model.dimensions();
        let scaled: Vec<f64> = self.q.iter().map(|x| s * x).collect();
        let q = model.retract(from.q(), &scaled);
        let p = from.p().iter().zip(&self.p).map(|(p, x)| p + s * x).collect();
        plant.initialize(&Initial::Momentum { q, p, v: from.v().to_vec() }).unwrap();
        let mut end = from.q().to_vec();
        end[d.dynamic..].copy_from_slice(&u[d.inputs..]);
        let mut change = vec![0.0; d.coordinates()];
        for (change, x) in change[d.dynamic..].iter_mut().zip(&self.u[d.inputs..]) {
            *change = s * x;
        }
        let end = model.retract(&end, &change);
        let forces = u[..d.inputs].iter().zip(&self.u).map(|(u, x)| u + s * x);
        forces.chain(end[d.dynamic..].iter().copied()).collect()
    }
}

/// Checks one scene; whether there was one.
fn derivatives(seed: u64, split: ForceSplit) -> bool {
    let Some((plant, u)) = moving(seed, Kind::Any, split) else { return false };
    let model = plant.model().clone();
    let (d, direction) = (model.dimensions(), Direction::new(&plant, seed));
    let mut moved = plant.clone();
    let mut end = plant.clone();
    // From the same rounded state as the displaced ones.
    let same = direction.go(&mut end, &plant, &u, 0.0);
    let mut first = Linearization::new(&model);
    end.step_and_linearize(&same, &mut first).unwrap();
    let (dx, du) = (direction.state(), direction.input());
    let multipliers = first.multipliers_x() * &dx + first.multipliers_u() * &du;
    let x = first.a() * &dx + first.b() * &du;
    let n = d.coordinates();
    // What prescribed coordinates and their velocities do is not in question.
    let predicted: Vec<f64> =
        [&x.as_slice()[..d.dynamic], &x.as_slice()[n..n + d.dynamic], multipliers.as_slice()]
            .concat();
    let mut differences = |delta: f64| {
        slope(delta, |s| {
            let u = direction.go(&mut moved, &plant, &u, s);
            moved.step(&u).unwrap_or_else(|e| panic!("{seed}: {e}"));
            let q = model.difference(end.q(), moved.q());
            DVector::from_vec([&q[..d.dynamic], moved.p(), moved.multipliers()].concat())
        })
    };
    let predicted = DVector::from_vec(predicted);
    let ranges = [0..d.dynamic, d.dynamic..2 * d.dynamic, 2 * d.dynamic..predicted.len()];
    // Where motion is rough, differences need a shorter step.
    let errors = [4e-4, 5e-5, 8e-6].map(|delta| {
        let found = differences(delta);
        let error = |range: &std::ops::Range<usize>| {
            let part = |v: &DVector<f64>| v.rows(range.start, range.len()).into_owned();
            let (found, predicted) = (part(&found), part(&predicted));
            if found.is_empty() {
                0.0
            } else {
                (&found - predicted).amax() / found.amax().max(1e-2)
            }
        };
        ranges.iter().map(error).fold(0.0, f64::max)
    });
    assert!(
        errors.iter().any(|error| *error < 2e-7),
        "{seed} {split:?}: {errors:?}\n{}",
        scene(seed, Kind::Any)
    );
    second_derivatives(seed, &plant, &u, &direction);
    true
}

/// `dᵀ (Σ z_i ∂²f_i) d` against the change of `zᵀ ∂f d` along `d`.
fn second_derivatives(seed: u64, plant: &Plant, u: &[f64], direction: &Direction) {
    let model = plant.model().clone();
    let d = model.dimensions();
    let mut random = Numbers::new(seed ^ 0xad);
    let z: Vec<f64> = (0..d.state()).map(|_| random.between(-1.0, 1.0)).collect();
    let w: Vec<f64> = (0..d.constraints).map(|_| random.between(-1.0, 1.0)).collect();
    let (mut first, mut second) = (Linearization::new(&model), Contraction::new(&model));
    let mut moved = plant.clone();
    let same = direction.go(&mut moved, plant, u, 0.0);
    moved.contract_second_order(&same, &z, &w, &mut first, &mut second).unwrap();
    let (dx, du) = (direction.state(), direction.input());
    let curvature = (dx.transpose() * &second.xx * &dx)[0]
        + 2.0 * (dx.transpose() * &second.xu * &du)[0]
        + (du.transpose() * &second.uu * &du)[0];
    let (z, w) = (DVector::from_vec(z), DVector::from_vec(w));
    let mut differences = |delta: f64| {
        slope(delta, |s| {
            let u = direction.go(&mut moved, plant, u, s);
            moved.linearize(&u, &mut first).unwrap_or_else(|e| panic!("{seed}: {e}"));
            let x = first.a() * &dx + first.b() * &du;
            let multipliers = first.multipliers_x() * &dx + first.multipliers_u() * &du;
            DVector::from_element(1, z.dot(&x) + w.dot(&multipliers))
        })[0]
    };
    let found = [5e-4, 6e-5, 8e-6].map(&mut differences);
    let size = first.a().amax().max(first.multipliers_u().amax()).max(1.0);
    let allowed = 5e-7 * size.max(curvature.abs());
    assert!(
        found.iter().any(|found| (curvature - found).abs() < allowed),
        "{seed}: {curvature} {found:?}\n{}",
        scene(seed, Kind::Any)
    );
}

#[test]
fn derivatives_of_random_scenes() {
    let made = (0..4000).filter(|seed| {
        derivatives(*seed, if seed % 3 == 0 { ForceSplit::Paper } else { ForceSplit::Symmetric })
    });
    let made = made.count();
    assert!(made > 2000, "{made}");
}

/// `δq ∧ δp` is kept for displacements that keep the constraints; in the body axes of ball joints the
/// form is `[−[p], 1; −1, 0]`.
#[test]
fn conservative_scenes_are_symplectic() {
    let mut made = 0;
    for seed in 0..1200 {
        let Some((mut plant, u)) = moving(seed, Kind::Conservative, ForceSplit::Symmetric) else {
            continue;
        };
        let model = plant.model().clone();
        let (d, n) = (model.dimensions(), model.dimensions().coordinates());
        let balls: Vec<usize> =
            (0..d.dynamic).filter(|i| model.coordinates()[*i].name.ends_with("_rx")).collect();
        let form = |p: &[f64]| {
            let nd = d.dynamic;
            let mut form = DMatrix::zeros(2 * nd, 2 * nd);
            for i in 0..nd {
                form[(i, nd + i)] = 1.0;
                form[(nd + i, i)] = -1.0;
            }
            for &i in &balls {
                let p = Vector3::new(p[i], p[i + 1], p[i + 2]);
                form.view_mut((i, i), (3, 3)).copy_from(&-p.cross_matrix());
            }
            form
        };
        let jacobian = plant.constraint_jacobian().columns(0, d.dynamic).into_owned();
        let mut kept = DMatrix::identity(d.dynamic, d.dynamic);
        if d.constraints > 0 {
            kept -= jacobian.clone().pseudo_inverse(1e-10).unwrap() * jacobian;
        }
        let mut first = Linearization::new(&model);
        let before = form(plant.p());
        plant.step_and_linearize(&u, &mut first).unwrap();
        let after = form(plant.p());
        let a = first.a();
        let rows: Vec<usize> = (0..d.dynamic).chain(n..n + d.dynamic).collect();
        let a = a.select_rows(&rows).select_columns(&rows);
        let mut tangent = DMatrix::identity(2 * d.dynamic, 2 * d.dynamic);
        tangent.view_mut((0, 0), (d.dynamic, d.dynamic)).copy_from(&kept);
        let a = a * &tangent;
        let defect = a.transpose() * after * &a - tangent.transpose() * before * &tangent;
        let size = a.amax().powi(2).max(1.0);
        assert!(
            defect.amax() < 1e-11 * size,
            "{seed}: {:e}\n{}",
            defect.amax(),
            scene(seed, Kind::Conservative)
        );
        made += 1;
    }
    assert!(made > 700, "{made}");
}

#[test]
fn floating_scenes_keep_their_momenta() {
    let mut made = 0;
    for seed in 0..600 {
        let Some((mut plant, u)) = moving(seed, Kind::Floating, ForceSplit::Symmetric) else {
            continue;
        };
        let momenta = |plant: &mut Plant| {
            let d = plant.diagnose();
            (Vector3::from(d.linear_momentum), Vector3::from(d.angular_momentum))
        };
        let (linear, angular) = momenta(&mut plant);
        for _ in 0..20 {
            if plant.step(&u).is_err() {
                break;
            }
        }
        let (p, l) = momenta(&mut plant);
        let size = 1.0 + linear.norm() + angular.norm();
        let drift = (p - linear).norm().max((l - angular).norm());
        assert!(drift < 1e-11 * size, "{seed}: {drift:e}\n{}", scene(seed, Kind::Floating));
        made += 1;
    }
    assert!(made > 200, "{made}");
}

/// Without forces the continuous dynamics keep the energy.
#[test]
fn conservative_scenes_keep_their_energy() {
    let mut made = 0;
    for seed in 0..600 {
        let Some((mut plant, _)) = moving(seed, Kind::Conservative, ForceSplit::Symmetric) else {
            continue;
        };
        let model = plant.model().clone();
        if model.dimensions().prescribed > 0 || model.dimensions().constraints > 0 {
            continue;
        }
        let (q, v) = (plant.q().to_vec(), plant.velocity());
        let at = ContinuousPoint { q: q.clone(), v: v.clone(), ..ContinuousPoint::default() };
        let Ok(found) = Continuous::new(model.clone()).evaluate(&at) else { continue };
        let size = plant.energy().kinetic_j.abs() + plant.energy().potential_j.abs() + 1.0;
        let power = slope(1e-3, |s| {
            let turned: Vec<f64> =
                v.iter().zip(&found.acceleration).map(|(v, a)| s * v + 0.5 * s * s * a).collect();
            let v = v.iter().zip(&found.acceleration).map(|(v, a)| v + s * a).collect();
            let q = model.retract(&q, &turned);
            let mut energy = f64::NAN;
            if plant.initialize(&Initial::Velocity { q, v }).is_ok() {
                let e = plant.energy();
                energy = e.kinetic_j + e.potential_j;
            }
            DVector::from_element(1, energy)
        })[0];
        assert!(power.abs() < 1e-7 * size, "{seed}: {power}\n{}", scene(seed, Kind::Conservative));
        made += 1;
    }
    assert!(made > 100, "{made}");
}
