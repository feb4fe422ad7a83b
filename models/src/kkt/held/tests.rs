//! Limbs that are held against dense matrices.

use std::fmt::Write;
use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use plantd_math::simd::narrowly;
use plantd_scene::Scene;

use crate::integrator::settings::Settings;
use crate::integrator::workspace::{StepContext, Workspace};
use crate::kkt::system::{Factors, Recursion};
use crate::lagrangian::samples::prescribe;
use crate::linearization::linearize::Linearization;
use crate::linearization::second_order::contraction::Contraction;
use crate::linearization::second_order::tensors::SecondOrder;
use crate::model::mechanism::{Model, Solver};
use crate::plant::facade::Plant;
use crate::plant::initial::Initial;
use crate::plant::snapshot::Snapshot;

/// A scene in its making: all angles are zero where it begins.
#[derive(Default)]
struct Sketch {
    frames: String,
    constraints: String,
    inputs: String,
    count: usize,
}

impl Sketch {
    /// Bodies one below the other; the place of the last of them.
    fn chain(&mut self, parent: &str, at: [f64; 3], links: &[(&str, [f64; 3])]) -> [f64; 3] {
        let (mut parent, mut at) = (parent.to_owned(), at);
        for (joint, offset) in links {
            let name = format!("f{}", self.count);
            let inertia = 0.01 + 0.002 * (self.count % 3) as f64;
            let body = format!(
                "mass = 0.7, center_of_mass = [0.02, -0.01, -0.1], inertia = [{inertia}, 0.012, 0.008]"
            );
            writeln!(
                self.frames,
                "[[frames]]\nname = \"{name}\"\nparent = \"{parent}\"\ntranslation = {offset:?}\n\
                 joint = {{ {joint} }}\nbody = {{ {body} }}"
            )
            .unwrap();
            if joint.contains("revolute") {
                writeln!(self.inputs, "[[inputs]]\nname = \"u{name}\"\ncoordinate = \"{name}\"")
                    .unwrap();
            }
            at.iter_mut().zip(offset).for_each(|(at, offset)| *at += offset);
            (parent, self.count) = (name, self.count + 1);
        }
        at
    }

    /// Holds the last body at its place: a point of it, or all of it.
    fn hold(&mut self, at: [f64; 3], point: Option<[f64; 3]>) {
        let (name, frame) = (self.count, format!("f{}", self.count - 1));
        let constraint = match point {
            Some(point) => {
                let there = [0, 1, 2].map(|i| at[i] + point[i]);
                format!(
                    "type = \"point_to_point\"\naxes = [\"x\", \"y\", \"z\"]\n\
                     a = {{ frame = \"{frame}\", at = {point:?} }}\n\
                     b = {{ frame = \"world\", at = {there:?} }}"
                )
            }
            None => {
                let place = format!("place{name}");
                writeln!(self.frames, "[[frames]]\nname = \"{place}\"\ntranslation = {at:?}")
                    .unwrap();
                format!("type = \"weld\"\na = \"{place}\"\nb = \"{frame}\"")
            }
        };
        writeln!(self.constraints, "[[constraints]]\nname = \"hold{name}\"\n{constraint}").unwrap();
    }

    /// Holds a point of the last body, which is at a place, at a body that is not turned.
    fn join(&mut self, [own, at]: [[f64; 3]; 2], body: &str, place: [f64; 3]) {
        let (name, frame) = (self.count, format!("f{}", self.count - 1));
        let there = [0, 1, 2].map(|i| at[i] + own[i] - place[i]);
        writeln!(
            self.constraints,
            "[[constraints]]\nname = \"join{name}\"\ntype = \"point_to_point\"\naxes = [\"x\", \"y\", \"z\"]\n\
             a = {{ frame = \"{frame}\", at = {own:?} }}\nb = {{ frame = \"{body}\", at = {there:?} }}"
        )
        .unwrap();
    }

    fn compile(&self, more: &str) -> Model {
        let text = format!(
            "format = 1\nname = \"held\"\ntime_step_s = 0.002\ngravity = [0.3, 0.0, -9.81]\n{more}\n{}{}{}",
            self.frames, self.constraints, self.inputs
        );
        Model::compile(&Scene::from_toml(&text).unwrap()).unwrap()
    }
}

const X: &str = "type = \"revolute\", axis = [1.0, 0.0, 0.0]";
const Y: &str = "type = \"revolute\", axis = [0.0, 1.0, 0.0]";
const Z: &str = "type = \"revolute\", axis = [0.0, 0.0, 1.0]";
const SLIDE: &str = "type = \"prismatic\", axis = [0.0, 0.0, 1.0]";
const FREE: &str = "type = \"free\"";

/// A leg of three hinges, bent by the offset of its knee.
fn leg(side: f64, bend: f64) -> [(&'static str, [f64; 3]); 3] {
    [(X, [0.2, side, 0.0]), (Y, [0.0, 0.3 * side, 0.0]), (Y, [bend, 0.0, -0.25])]
}

/// Points and a whole foot are held, under the base and under a waist of ten coordinates above; an arm is free.
fn humanoid() -> Model {
    let mut sketch = Sketch::default();
    let base = sketch.chain("world", [0.0; 3], &[(FREE, [0.0, 0.0, 1.0])]);
    for side in [0.1, -0.1] {
        let at = sketch.chain("f0", base, &leg(side, 0.1));
        sketch.hold(at, Some([-0.15, 0.02, -0.25]));
    }
    let foot = [
        (Z, [-0.2, 0.1, 0.0]),
        (X, [0.0, 0.02, -0.05]),
        (Y, [0.0, 0.0, -0.05]),
        (Y, [0.1, 0.0, -0.3]),
        (Y, [-0.1, 0.0, -0.3]),
        (X, [0.02, 0.0, -0.05]),
    ];
    let at = sketch.chain("f0", base, &foot);
    sketch.hold(at, None);
    let begin = sketch.count;
    let trunk =
        [(Z, [0.0, 0.0, 0.2]), (Y, [0.0, 0.0, 0.1]), (X, [0.0, 0.0, 0.1]), (SLIDE, [0.0; 3])];
    let at = sketch.chain("f0", base, &trunk);
    let trunk = format!("f{}", begin + 3);
    let hand = sketch.chain(&trunk, at, &leg(0.2, 0.15));
    sketch.hold(hand, Some([-0.1, 0.0, -0.2]));
    sketch.chain(&trunk, at, &leg(-0.2, 0.1));
    sketch.compile("damping = 0.05")
}

/// Without ball joints.
fn carriage(bend: f64) -> Model {
    let mut sketch = Sketch::default();
    let base = [(SLIDE, [0.0, 0.0, 1.0]), (X, [0.0; 3]), (Z, [0.0, 0.05, 0.1])];
    let at = sketch.chain("world", [0.0; 3], &base);
    for side in [0.1, -0.1] {
        let at = sketch.chain("f2", at, &leg(side, bend));
        sketch.hold(at, Some([-bend, 0.02, -0.25]));
    }
    sketch.compile("")
}

/// Where the platform of a parallel robot hangs in the tree.
#[derive(Clone, Copy, Debug)]
enum Platform {
    First,
    Last,
    /// At the end of a leg.
    OnLeg,
}

/// A platform on legs that stand on the ground.
fn parallel(platform: Platform) -> Model {
    let mut sketch = Sketch::default();
    let floats = [(FREE, [0.0, 0.0, 0.8])];
    let on_leg = [
        (X, [0.3, 0.1, 0.0]),
        (Y, [0.0; 3]),
        (SLIDE, [0.0, 0.0, 0.4]),
        ("type = \"ball\"", [0.05, 0.0, 0.4]),
    ];
    let (place, body) = match platform {
        Platform::First => (sketch.chain("world", [0.0; 3], &floats), "f0"),
        Platform::Last => (floats[0].1, "f9"),
        Platform::OnLeg => (sketch.chain("world", [0.0; 3], &on_leg), "f3"),
    };
    for (k, [x, y]) in [[-0.3, 0.2], [-0.2, -0.3], [0.2, -0.2]].into_iter().enumerate() {
        let links = [(X, [x, y, 0.05]), (Y, [0.0, 0.02, 0.0]), (SLIDE, [0.03, 0.0, 0.3])];
        let at = sketch.chain("world", [0.0; 3], &links);
        sketch.join([[0.0, 0.01 * k as f64, 0.4], at], body, place);
    }
    if let Platform::Last = platform {
        sketch.chain("world", [0.0; 3], &floats);
    }
    sketch.compile("damping = 0.02")
}

/// The same with joints that are moved, by their names.
fn driven(model: &Model, names: &[&str]) -> Model {
    let mut scene = model.scene().clone();
    prescribe(&mut scene, names);
    Model::compile(&scene).unwrap()
}

/// All that is eliminated limb by limb; of the first ones a trunk and an arm are moved, a base, and the hip of a leg that
/// carries a platform.
fn models() -> [Model; 8] {
    let [first, last, on_leg] = [Platform::First, Platform::Last, Platform::OnLeg].map(parallel);
    let [humanoid, carriage] = [humanoid(), carriage(0.1)];
    [
        driven(&humanoid, &["f13", "f16", "f21"]),
        driven(&carriage, &["f0"]),
        driven(&on_leg, &["f0"]),
        humanoid,
        carriage,
        first,
        last,
        on_leg,
    ]
}

/// Inputs of a step: motors rest, and what is moved goes to and fro.
fn input(plant: &Plant, k: u32) -> Vec<f64> {
    let model = plant.model();
    let (ni, mut u) = (model.dimensions().inputs, vec![0.0; model.dimensions().input()]);
    for (i, u) in u[ni..].iter_mut().enumerate() {
        let start = model.coordinates()[model.dimensions().dynamic + i].initial;
        *u = start + 0.02 * (0.04 * f64::from(k + 1) * (1.0 + 0.3 * i as f64)).sin();
    }
    u
}

/// With limbs eliminated, and by the tree LU alone; moving.
fn both(model: Model) -> [Plant; 2] {
    let model = Arc::new(model);
    let mut fast = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
    fast.initialize(&Initial::Scene).unwrap();
    for k in 0..3 {
        fast.step(&input(&fast, k)).unwrap();
    }
    let mut slow = fast.clone();
    let Workspace { kkt, response, .. } = &mut slow.workspace;
    for factored in [&mut kkt.factored, &mut response.first, &mut response.kept] {
        factored.recursion = Recursion::None;
    }
    [fast, slow]
}

fn assert_near(a: &[f64], b: &[f64], tolerance: f64, what: &str) {
    let size = b.iter().fold(0.0_f64, |m, x| m.max(x.abs()));
    assert_eq!(a.len(), b.len());
    for (i, (a, b)) in a.iter().zip(b).enumerate() {
        assert!((a - b).abs() <= tolerance * size, "{what} {i}: {a} {b} of {size}");
    }
}

/// `[K A0ᵀ; A1 0]`, entry by entry.
fn dense(workspace: &mut Workspace, model: &Model, settings: &Settings) -> DMatrix<f64> {
    workspace.fill_newton_matrix(model, settings);
    let (nd, nc) = (model.dimensions.dynamic, model.dimensions.constraints);
    let n = model.dimensions.coordinates();
    let (tree, elimination) = (&workspace.kkt.factored.tree, &model.elimination);
    let mut dense = DMatrix::zeros(nd + nc, nd + nc);
    for row in 0..nd {
        for (slot, ancestor) in elimination.entries_of(row) {
            dense[(row, ancestor)] = tree.lower[slot];
            dense[(ancestor, row)] = tree.upper[slot];
        }
        for c in 0..nc {
            dense[(row, nd + c)] = workspace.constraints.start.jacobian[c * n + row];
            dense[(nd + c, row)] = workspace.constraints.end.jacobian[c * n + row];
        }
    }
    dense
}

#[test]
fn a_solution_satisfies_the_dense_system() {
    for model in models() {
        assert_eq!(model.solver, Solver::Held);
        let [mut plant, _] = both(model);
        let u = input(&plant, 3);
        let Plant { model, settings, state, workspace, .. } = &mut plant;
        workspace.solve(StepContext { model, settings, state, u: &u }).unwrap();
        workspace.evaluate(model, settings, state);
        workspace.finish_end(model, state);
        let matrix = dense(workspace, model, settings);
        assert!(workspace.factor_recursion(model, settings).unwrap());
        let (nd, size) = (model.dimensions.dynamic, matrix.nrows());
        let b = DVector::from_fn(size, |i, _| (1.7 * i as f64 + 0.3).sin());
        let exact = matrix.lu().solve(&b).unwrap();
        let mut found = b.clone();
        let (x, lambda) = found.as_mut_slice().split_at_mut(nd);
        workspace.kkt.solve(model, &workspace.constraints.end, x, lambda);
        assert_near(&found.as_slice()[..nd], &exact.as_slice()[..nd], 1e-10, "y");
        assert_near(&found.as_slice()[nd..], &exact.as_slice()[nd..], 1e-10, "λ");
    }
}

#[test]
fn limbs_move_and_linearize_as_by_the_tree() {
    for model in models() {
        let [mut fast, mut slow] = both(model);
        let [mut a, mut b] = [&fast, &slow].map(|plant| Linearization::new(plant.model()));
        for k in 0..30 {
            let u = input(&fast, k + 3);
            slow.restore(&fast.snapshot()).unwrap();
            fast.step_and_linearize(&u, &mut a).unwrap();
            slow.step_and_linearize(&u, &mut b).unwrap();
            let valid = [&fast, &slow].map(|plant| plant.workspace.kkt.factored.valid);
            assert_eq!(valid, [Factors::Recursion, Factors::Tree]);
            assert_near(fast.q(), slow.q(), 1e-13, "q");
            assert_near(fast.p(), slow.p(), 1e-11, "p");
            assert_near(fast.multipliers(), slow.multipliers(), 1e-10, "λ");
            let blocks = |l: &Linearization| [l.a(), l.b(), l.multipliers_x(), l.multipliers_u()];
            for (fast, slow) in blocks(&a).iter().zip(&blocks(&b)) {
                assert_near(fast.as_slice(), slow.as_slice(), 1e-9, "linearization");
            }
        }
    }
}

#[test]
fn second_derivatives_are_those_by_the_tree() {
    let [fast, slow] = both(carriage(0.1)).map(|mut plant| {
        let model = Arc::clone(plant.model());
        let d = model.dimensions();
        let u = vec![0.0; d.input()];
        let z: Vec<f64> = (0..d.state()).map(|i| (i as f64 + 1.0).sin()).collect();
        let w: Vec<f64> = (0..d.constraints).map(|i| (i as f64).cos()).collect();
        let mut first = Linearization::new(&model);
        let mut contraction = Contraction::new(&model);
        plant.contract_second_order(&u, &z, &w, &mut first, &mut contraction).unwrap();
        let mut second = SecondOrder::new(&model).unwrap();
        plant.linearize_second_order(&u, &mut first, &mut second).unwrap();
        let states = z.iter().enumerate().map(|(i, z)| second.xx(i) * *z);
        let multipliers = w.iter().enumerate().map(|(c, w)| second.multiplier_xx(c) * *w);
        let full: DMatrix<f64> = states.chain(multipliers).sum();
        assert_near(contraction.xx.as_slice(), full.as_slice(), 1e-7, "contraction");
        full
    });
    assert_near(fast.as_slice(), slow.as_slice(), 1e-8, "second order");
}

/// What next to straight legs carry is as exact as where all equations are taken together, which they are where
/// legs are straight.
#[test]
fn straight_legs_are_left_to_the_tree() {
    for (bend, expected) in [(0.1, Solver::Held), (3e-3, Solver::Held), (1e-6, Solver::Tree)] {
        let model = carriage(bend);
        assert_eq!(model.solver, expected, "{bend}");
        let [mut fast, mut slow] = both(model);
        let u = vec![0.0; fast.model().dimensions().input()];
        for _ in 0..10 {
            slow.restore(&fast.snapshot()).unwrap();
            let reports = [&mut fast, &mut slow].map(|plant| plant.step(&u).unwrap());
            assert!(reports.iter().all(|report| report.constraint_residual < 10.0));
            assert_near(fast.multipliers(), slow.multipliers(), 1e-9, "λ");
        }
    }
    // A leg that is straightened on the way.
    let model = carriage(3e-3);
    let mut model = Model { solver: Solver::Held, ..model };
    model.conditioning.inertia.iter_mut().for_each(|inertia| *inertia *= 1e9);
    let [mut refused, mut slow] = both(model);
    let u = vec![0.0; slow.model().dimensions().input()];
    refused.step(&u).unwrap();
    slow.step(&u).unwrap();
    assert_eq!(refused.workspace.kkt.factored.valid, Factors::Tree);
    assert_eq!(refused.snapshot(), slow.snapshot());
}

/// Torques that change at each step are guessed, by the factors of the last step or by those that are made again.
#[test]
fn guesses_follow_from_the_state_alone() {
    for model in models() {
        let [mut plant, _] = both(model);
        let (moved, count) = (plant.clone(), plant.model().dimensions().inputs);
        let input = |k: u32| -> Vec<f64> {
            let mut u = input(&moved, k + 3);
            let motors = u[..count].iter_mut().zip(0_u32..);
            motors.for_each(|(u, i)| *u = 0.3 * f64::from(k * k + 7 * i).sin());
            u
        };
        let mut out = Linearization::new(plant.model());
        let mut evaluations = 0;
        for k in 0..40 {
            let u = input(k);
            let bytes = plant.snapshot().to_bytes();
            let mut restored = Plant::new(Arc::clone(plant.model()), *plant.settings()).unwrap();
            restored.restore(&Snapshot::from_bytes(&bytes).unwrap()).unwrap();
            let mut linearized = plant.clone();
            linearized.linearize(&input(k + 3), &mut out).unwrap();
            let report = plant.step(&u).unwrap();
            evaluations += if k < 10 { 0 } else { report.iterations };
            restored.step(&u).unwrap();
            linearized.step_and_linearize(&u, &mut out).unwrap();
            assert_eq!(plant.snapshot(), restored.snapshot(), "{k}");
            assert_eq!(plant.snapshot(), linearized.snapshot(), "{k}");
            if k % 3 == 0 {
                plant = restored;
            } else if k % 3 == 1 {
                plant = linearized;
            }
        }
        assert!(evaluations < 75, "{evaluations}");
    }
}

#[test]
fn wider_registers_give_the_same_bits() {
    for model in models() {
        let [wide, _] = both(model);
        let model = Arc::clone(wide.model());
        let run = |mut plant: Plant| {
            let mut out = Linearization::new(&model);
            for k in 0..5 {
                let u = input(&plant, k + 3);
                plant.step_and_linearize(&u, &mut out).unwrap();
            }
            (plant.snapshot(), out.a(), out.multipliers_x())
        };
        assert!(run(wide.clone()) == narrowly(|| run(wide.clone())));
    }
}

/// A limb must end in the coordinates that its equations need, and no other equation may need them.
#[test]
fn limbs_that_others_need_are_no_limbs() {
    let mut sketch = Sketch::default();
    let base = sketch.chain("world", [0.0; 3], &[(FREE, [0.0, 0.0, 1.0])]);
    let at = sketch.chain("f0", base, &leg(0.1, 0.1));
    sketch.hold(at, Some([-0.15, 0.02, -0.25]));
    assert_eq!(sketch.compile("").solver, Solver::Held);
    sketch.chain("f3", at, &[(Z, [0.0, 0.0, -0.1])]);
    assert_eq!(sketch.compile("").solver, Solver::Tree);
}

/// One end that is held twice, by equations that move different coordinates above it, is no limb: the last
/// coordinate cannot go with both.
#[test]
fn an_end_that_is_held_twice_is_no_limb() {
    let links =
        [(X, [0.0; 3]), (Y, [0.0, 0.0, -0.3]), (X, [0.1, 0.0, -0.3]), (Y, [0.0, 0.1, -0.3])];
    let hold = |sketch: &mut Sketch, frame: &str, length: f64| {
        writeln!(
            sketch.constraints,
            "[[constraints]]\nname = \"to-{frame}\"\ntype = \"distance\"\nlength = {length:?}\n\
             a = {{ frame = \"{frame}\", at = [0.0, 0.0, 0.0] }}\n\
             b = {{ frame = \"f3\", at = [0.0, 0.0, -0.2] }}"
        )
        .unwrap();
    };
    let mut sketch = Sketch::default();
    sketch.chain("world", [0.0; 3], &links);
    hold(&mut sketch, "world", (0.1_f64 * 0.1 + 0.1 * 0.1 + 1.1 * 1.1).sqrt());
    assert_eq!(sketch.compile("").solver, Solver::Held);
    hold(&mut sketch, "f1", (0.1_f64 * 0.1 + 0.1 * 0.1 + 0.8 * 0.8).sqrt());
    let model = Arc::new(sketch.compile(""));
    assert!(model.held.is_none());
    let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
    for _ in 0..20 {
        plant.step(&[0.1, -0.2, 0.1, 0.0]).unwrap();
    }
}
