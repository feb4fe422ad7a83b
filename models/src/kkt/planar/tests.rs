//! Planar trees against the same trees in space.

use std::sync::Arc;

use nalgebra::DMatrix;
use plantd_math::rows::padded;
use plantd_math::simd::narrowly;
use plantd_scene::{Coordinate, CoordinateKind, Scene, builtin};

use crate::integrator::settings::{ForceSplit, Settings};
use crate::kkt::planar::Diagonals;
use crate::kkt::system::Recursion;
use crate::lagrangian::planar::PlanarTree;
use crate::lagrangian::samples::{oblique, rubbing, wave};
use crate::linearization::linearize::Linearization;
use crate::model::mechanism::{Model, Solver};
use crate::plant::facade::Plant;
use crate::plant::initial::Initial;

fn assert_close(a: f64, b: f64, scale: f64, what: &str) {
    assert!((a - b).abs() <= 1e-13 * scale, "{what}: {a} {b} of {scale}");
}

#[test]
fn gradients_and_second_derivatives_are_those_in_space() {
    for model in [oblique(12, ""), oblique(3, ""), oblique(12, "kind = \"prescribed\"")] {
        let model = Arc::new(model);
        let joints = model.planar.as_ref().expect("the tree is planar");
        let n = model.dimensions.coordinates();
        let mut spatial = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
        let q: Vec<f64> = (0..n).map(|i| 3.0 * wave(i + 100)).collect();
        let v: Vec<f64> = (0..n).map(|i| 5.0 * wave(i + 200)).collect();
        let nd = model.dimensions.dynamic;
        let mut planar = PlanarTree::new(joints);
        let (mut l_q, mut l_v) = (vec![0.0; nd], vec![0.0; nd]);
        // Twice: nothing is left of the first time.
        for _ in 0..2 {
            planar.gradient(joints, &q, &v, &mut l_q, &mut l_v);
            planar.differentiate(joints);
        }
        let workspace = &mut spatial.workspace;
        workspace.mid.mechanics.poses.evaluate(&model.dynamics, &q, &[]);
        let (mut in_space_q, mut in_space_v) = (vec![0.0; nd], vec![0.0; nd]);
        workspace.mid.mechanics.momenta.gradient(
            &model.dynamics,
            &workspace.mid.mechanics.poses,
            &v,
            model.gravity,
            &mut in_space_q,
            &mut in_space_v,
        );
        workspace.mid.mechanics.curvature.evaluate(
            &model.dynamics,
            &workspace.mid.mechanics.poses,
            &workspace.mid.mechanics.momenta,
        );
        let size = |x: &[f64]| 1.0 + x.iter().fold(0.0_f64, |m, x| m.max(x.abs()));
        for i in 0..nd {
            assert_close(l_q[i], in_space_q[i], size(&in_space_q), "∂L/∂q");
            assert_close(l_v[i], in_space_v[i], size(&in_space_v), "∂L/∂v");
        }
        for descendant in 0..joints.len() {
            for ancestor in model.dynamics.path(descendant) {
                let a = planar.pair(joints, ancestor, descendant);
                let b = workspace.mid.mechanics.curvature.pair(ancestor, descendant);
                let scale = 1e3;
                assert_close(a.qq, b.qq, scale, "qq");
                assert_close(a.v_above_q_below, b.v_above_q_below, scale, "vq");
                assert_close(a.q_above_v_below, b.q_above_v_below, scale, "qv");
                assert_close(a.vv, b.vv, scale, "vv");
            }
        }
    }
}

#[test]
fn trees_that_leave_their_planes_are_not_planar() {
    let tilted = |axis: &str| {
        let text = format!(
            "format = 1\ngravity = [0.0, 0.0, 0.0]\nname = \"t\"\n[[frames]]\nname = \"a\"\njoint = {{ type = \"revolute\", axis = [0.0, 0.0, 1.0] }}\n\
             body = {{ mass = 1.0, center_of_mass = [1.0, 0.0, 0.0], inertia = [0.1, 0.1, 0.1] }}\n\
             [[frames]]\nname = \"b\"\nparent = \"a\"\njoint = {{ {axis} }}\nbody = {{ mass = 1.0, center_of_mass = [1.0, 0.0, 0.5], inertia = [0.1, 0.1, 0.1] }}\n"
        );
        Model::compile(&Scene::from_toml(&text).unwrap()).unwrap().planar.is_some()
    };
    assert!(tilted("type = \"revolute\", axis = [0.0, 0.0, -1.0]"));
    assert!(tilted("type = \"prismatic\", axis = [1.0, 1.0, 0.0]"));
    assert!(!tilted("type = \"revolute\", axis = [0.0, 2e-8, 1.0]"));
    assert!(!tilted("type = \"prismatic\", axis = [1.0, 1.0, 2e-8]"));
    assert!(!tilted("type = \"ball\""));
    assert!(!tilted("type = \"screw\", pitch = 0.1, axis = [0.0, 0.0, 1.0]"));
}

/// A chain with all forces that act on single coordinates.
fn rubbing_chain(n: usize) -> Model {
    let text = builtin::scene(&format!("chain-{n}")).unwrap().to_toml() + &rubbing("link", n);
    Model::compile(&Scene::from_toml(&text).unwrap()).unwrap()
}

/// What is missing to `AᵀΩA = Ω`.
fn defect(a: &DMatrix<f64>) -> f64 {
    let n = a.nrows() / 2;
    let omega = DMatrix::from_fn(2 * n, 2 * n, |i, j| {
        if j == i + n {
            1.0
        } else if i == j + n {
            -1.0
        } else {
            0.0
        }
    });
    (a.transpose() * &omega * a - omega).amax()
}

/// Steps and linearizations by generators against those entry by entry, from the same states.
#[test]
fn generators_stand_for_the_newton_matrix() {
    let chain = |n: usize| Model::compile(&builtin::scene(&format!("chain-{n}")).unwrap()).unwrap();
    for (i, model) in [
        chain(7),
        chain(64),
        oblique(12, ""),
        oblique(13, "damping = 0.3"),
        rubbing_chain(7),
        rubbing_chain(7),
    ]
    .into_iter()
    .enumerate()
    {
        let model = Arc::new(model);
        let force_split = if i == 5 { ForceSplit::Paper } else { ForceSplit::Symmetric };
        let settings = Settings { force_split, ..Settings::new(&model) };
        let mut fast = Plant::new(Arc::clone(&model), settings).unwrap();
        assert!(fast.workspace.kkt.has_recursion(), "{}", model.scene.name);
        let n = model.dimensions.dynamic;
        let q = (0..n).map(|i| 0.3 * wave(i)).collect();
        let v = (0..n).map(|i| 0.1 * wave(i + 50)).collect();
        fast.initialize(&Initial::Velocity { q, v }).unwrap();
        let mut slow = fast.clone();
        slow.workspace.kkt.factored.recursion = Recursion::None;
        let mut by_generators = Linearization::new(&model);
        let mut by_entries = Linearization::new(&model);
        let u: Vec<f64> = (0..model.dimensions.input()).map(wave).collect();
        for _ in 0..10 {
            slow.restore(&fast.snapshot()).unwrap();
            fast.step_and_linearize(&u, &mut by_generators).unwrap();
            slow.step_and_linearize(&u, &mut by_entries).unwrap();
            for (a, b) in [(by_generators.a(), by_entries.a()), (by_generators.b(), by_entries.b())]
            {
                assert!((&a - &b).amax() <= 3e-9 * b.amax(), "{} {}", (a - &b).amax(), b.amax());
            }
            // In long chains sums about each joint keep digits that those about one origin lose.
            if model.damping.is_empty() && model.forces.is_none() {
                let [own, others] = [by_generators.a(), by_entries.a()].map(|a| defect(&a));
                assert!(own <= 2.0 * others + 1e-13, "{own} {others}");
            }
            for (a, b) in fast.q().iter().zip(slow.q()) {
                assert_close(*a, *b, 10.0, "q");
            }
        }
    }
}

#[test]
fn linearizations_have_the_same_bits_in_any_register() {
    for model in [oblique(12, ""), oblique(21, "damping = 0.3")] {
        let model = Arc::new(model);
        let n = model.dimensions.dynamic;
        let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
        plant.step(&vec![0.0; model.dimensions.input()]).unwrap();
        let mechanics = &plant.workspace.mid.mechanics;
        let tree = mechanics.planar.as_deref().and_then(PlanarTree::many).unwrap();
        let (joints, stride) = (model.planar.as_ref().unwrap(), padded(2 * n));
        let numbers: Vec<f64> = (0..n).map(wave).collect();
        let diagonal = Diagonals {
            residual: numbers.clone(),
            by_start: numbers.clone(),
            by_increment: numbers.clone(),
        };
        let Recursion::Planar(recursion) = &plant.workspace.kkt.factored.recursion else {
            panic!()
        };
        let mut wide = recursion.clone();
        let mut narrow = wide.clone();
        let [mut x, mut p, mut narrow_x, mut narrow_p] = [0; 4].map(|_| vec![0.0; n * stride]);
        wide.linearize(tree, joints, &diagonal, &mut x, &mut p, stride);
        narrowly(|| {
            narrow.linearize(tree, joints, &diagonal, &mut narrow_x, &mut narrow_p, stride);
        });
        assert!(x.iter().any(|x| *x != 0.0) && x.iter().chain(&p).all(|x| x.is_finite()));
        assert!(x == narrow_x && p == narrow_p);
    }
}

#[test]
fn a_prescribed_leaf_is_left_to_the_elimination_tree() {
    let mut scene = builtin::scene("chain-6").unwrap();
    scene.coordinates.push(Coordinate {
        name: "link5".to_owned(),
        kind: CoordinateKind::Prescribed,
        ..Coordinate::default()
    });
    let model = Arc::new(Model::compile(&scene).unwrap());
    assert_eq!(model.solver, Solver::Tree);
    let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
    let mut out = Linearization::new(&model);
    plant.step_and_linearize(&[0.0, 0.001], &mut out).unwrap();
    // Without the prescribed position and velocity.
    let (a, place) = (out.a(), |i: usize| if i < 5 { i } else { i + 1 });
    assert!(defect(&DMatrix::from_fn(10, 10, |i, j| a[(place(i), place(j))])) < 1e-10);
}

/// A pointer without mass, which is moved and moves nothing, has columns all the same.
#[test]
fn what_is_moved_and_moves_nothing_leaves_the_derivatives_as_they_are() {
    let chain = builtin::scene("chain-6").unwrap();
    let pointer = "[[frames]]\nname = \"pointer\"\njoint = { type = \"revolute\", axis = [0.0, 1.0, 0.0] }\n\
                   [[coordinates]]\nname = \"pointer\"\nkind = \"prescribed\"\n";
    let with_pointer = Scene::from_toml(&(chain.to_toml() + pointer)).unwrap();
    let [alone, moved] = [chain, with_pointer].map(|scene| {
        let model = Arc::new(Model::compile(&scene).unwrap());
        let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
        let mut out = Linearization::new(&model);
        let mut u = vec![0.1];
        u.resize(model.dimensions.input(), 0.001);
        for _ in 0..3 {
            plant.step_and_linearize(&u, &mut out).unwrap();
        }
        out.a()
    });
    let place = |i: usize| if i < 6 { i } else { i + 1 };
    let same = DMatrix::from_fn(12, 12, |i, j| moved[(place(i), place(j))]);
    assert!((&same - &alone).amax() < 1e-12 * alone.amax(), "{:e}", (same - &alone).amax());
}
