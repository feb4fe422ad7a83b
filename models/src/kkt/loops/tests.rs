//! Loops against dense matrices of the constraints.

use std::sync::Arc;

use nalgebra::DMatrix;
use plantd_math::rows::padded;
use plantd_math::simd::narrowly;
use plantd_scene::{Force, Scene, builtin};

use crate::integrator::report::StepError;
use crate::integrator::settings::Settings;
use crate::integrator::workspace::{StepContext, Workspace};
use crate::kkt::loops::{Closures, Derivatives, Mechanism, Scales};
use crate::kkt::planar::Diagonals;
use crate::kkt::system::{Factors, Recursion};
use crate::lagrangian::generators::MatrixKind;
use crate::lagrangian::planar::PlanarTree;
use crate::linearization::linearize::Linearization;
use crate::linearization::second_order::contraction::Contraction;
use crate::linearization::second_order::tensors::SecondOrder;
use crate::model::mechanism::{Model, Solver};
use crate::plant::facade::Plant;
use crate::plant::initial::Initial;

/// A body on a hinge about y, or on a slider along x.
struct Body {
    parent: Option<usize>,
    at: [f64; 2],
    initial: f64,
    slides: bool,
}

/// A mechanism in the plane of x and z, written as a scene that its initial configuration satisfies.
#[derive(Default)]
struct Sketch {
    bodies: Vec<Body>,
    /// Angle and position of each body.
    poses: Vec<(f64, [f64; 2])>,
    constraints: String,
}

fn turned(angle: f64, [x, z]: [f64; 2]) -> [f64; 2] {
    let (s, c) = angle.sin_cos();
    [c * x + s * z, c * z - s * x]
}

impl Sketch {
    fn add(&mut self, parent: Option<usize>, at: [f64; 2], initial: f64, slides: bool) -> usize {
        let (angle, [x, z]) = parent.map_or((0.0, [0.0; 2]), |parent| self.poses[parent]);
        let along = if slides { initial } else { 0.0 };
        let [dx, dz] = turned(angle, [at[0] + along, at[1]]);
        let turn = if slides { 0.0 } else { initial };
        self.poses.push((angle + turn, [x + dx, z + dz]));
        self.bodies.push(Body { parent, at, initial, slides });
        self.bodies.len() - 1
    }

    /// Links of 0.3 m, the last one of them.
    fn chain(&mut self, mut parent: Option<usize>, first: [f64; 2], angles: &[f64]) -> usize {
        for (k, angle) in angles.iter().enumerate() {
            let at = if k == 0 { first } else { [0.0, -0.3] };
            parent = Some(self.add(parent, at, *angle, false));
        }
        parent.unwrap()
    }

    fn point(&self, body: usize, at: [f64; 2]) -> [f64; 2] {
        let (angle, [x, z]) = self.poses[body];
        let [dx, dz] = turned(angle, at);
        [x + dx, z + dz]
    }

    /// The point of another body, or of the world, at a point in the world.
    fn there(&self, body: Option<usize>, [x, z]: [f64; 2]) -> String {
        let Some(body) = body else {
            return format!("{{ frame = \"world\", at = [{x:?}, 0.0, {z:?}] }}");
        };
        let (angle, [ox, oz]) = self.poses[body];
        let [x, z] = turned(-angle, [x - ox, z - oz]);
        format!("{{ frame = \"b{body}\", at = [{x:?}, 0.0, {z:?}] }}")
    }

    fn pin(&mut self, a: usize, at: [f64; 2], b: Option<usize>) {
        let point = self.point(a, at);
        let (name, a, b) =
            (self.constraints.len(), self.there(Some(a), point), self.there(b, point));
        self.constraints += &format!(
            "[[constraints]]\ntype = \"point_to_point\"\nname = \"c{name}\"\na = {a}\nb = {b}\n\
             axes = [\"x\", \"z\"]\n"
        );
    }

    fn rod(&mut self, a: usize, b: usize) {
        let ([ax, az], [bx, bz]) = (self.point(a, [0.0, -0.2]), self.point(b, [0.0, -0.1]));
        let length = (ax - bx).hypot(az - bz);
        let (name, a, b) =
            (self.constraints.len(), self.there(Some(a), [ax, az]), self.there(Some(b), [bx, bz]));
        self.constraints += &format!(
            "[[constraints]]\ntype = \"distance\"\nname = \"c{name}\"\na = {a}\nb = {b}\n\
             length = {length:?}\n"
        );
    }

    fn scene(&self, name: &str) -> Scene {
        let mut text = format!(
            "format = 1\nname = \"{name}\"\ntime_step_s = 0.005\ngravity = [0.0, 0.0, -9.81]\n\
             damping = 0.01\n"
        );
        for (i, body) in self.bodies.iter().enumerate() {
            let parent = body.parent.map_or("world".to_owned(), |parent| format!("b{parent}"));
            let joint = if body.slides {
                "type = \"prismatic\", axis = [1.0, 0.0, 0.0]"
            } else {
                "type = \"revolute\", axis = [0.0, 1.0, 0.0]"
            };
            let [x, z] = body.at;
            text += &format!(
                "[[frames]]\nname = \"b{i}\"\nparent = \"{parent}\"\ntranslation = [{x:?}, 0.0, {z:?}]\n\
                 joint = {{ {joint} }}\nbody = {{ mass = {:?}, center_of_mass = [0.02, 0.0, -0.15], \
                 inertia = [0.01, 0.01, 0.0] }}\n\
                 [[coordinates]]\nname = \"b{i}\"\ninitial = {:?}\n",
                1.0 + 0.1 * i as f64,
                body.initial,
            );
        }
        text += "[[inputs]]\nname = \"force\"\ncoordinate = \"b0\"\n";
        text += &self.constraints;
        Scene::from_toml(&text).unwrap()
    }
}

/// Pinned at both ends.
fn rope() -> Scene {
    let mut sketch = Sketch::default();
    let angles: Vec<f64> = (0..24).map(|k| if k == 0 { -1.2 } else { 0.1 }).collect();
    let end = sketch.chain(None, [0.0, 0.0], &angles);
    sketch.pin(end, [0.0, -0.3], None);
    sketch.scene("rope")
}

/// Two chains with rods between them, and a chain that hangs from one.
fn rungs() -> Scene {
    let mut sketch = Sketch::default();
    let angles = [0.2, -0.1, 0.15, -0.2, 0.1, 0.05, -0.1, 0.2, -0.05, 0.1];
    sketch.chain(None, [0.0, 0.0], &angles);
    sketch.chain(None, [0.7, 0.1], &angles.map(|angle| 0.1 - angle));
    sketch.chain(Some(14), [0.1, -0.2], &[0.3, 0.2, -0.4]);
    for k in [3, 6, 9] {
        sketch.rod(k, k + 10);
    }
    sketch.scene("rungs")
}

/// A loop within another, one across branches, one in a branch of its own, and branches without.
fn nested() -> Scene {
    let mut sketch = Sketch::default();
    let cart = sketch.add(None, [0.0, 0.0], 0.2, true);
    let end = sketch.chain(
        Some(cart),
        [0.0, -0.1],
        &[0.4, 0.3, -0.5, 0.7, 0.6, -0.4, 0.5, 0.8, -0.3, 0.6, 0.5, 0.4],
    );
    sketch.pin(end, [0.0, -0.3], Some(4));
    sketch.pin(10, [0.1, -0.1], Some(6));
    let branch = sketch.chain(Some(2), [0.1, 0.0], &[-0.5, 0.3, 0.6, -0.2, 0.4]);
    sketch.rod(branch, 3);
    let slider = sketch.add(Some(branch), [0.0, -0.3], 0.1, true);
    let low = sketch.chain(Some(slider), [0.0, 0.0], &[0.5, -0.7, 0.4]);
    sketch.pin(low, [0.1, -0.3], Some(branch - 1));
    sketch.chain(Some(1), [-0.1, 0.0], &[0.2, 0.3, 0.1, -0.2]);
    sketch.chain(Some(5), [-0.1, 0.0], &[0.2, 0.3]);
    sketch.scene("nested")
}

fn scenes() -> Vec<Scene> {
    let mut scenes = vec![rope(), rungs(), nested()];
    let mut built_in =
        ["scissor-2", "scissor-3", "scissor-8"].map(|name| builtin::scene(name).unwrap());
    // With friction and stops.
    for coordinate in built_in[1].coordinates.clone() {
        built_in[1].forces.push(Force::Friction {
            coordinate: Some(coordinate.name),
            terms: Vec::new(),
            points: Vec::new(),
            force: 0.1,
            velocity: 0.2,
        });
    }
    assert!(!built_in[1].forces.is_empty());
    scenes.extend(built_in);
    scenes
}

/// With loops, and without.
fn both(scene: &Scene) -> [Arc<Model>; 2] {
    let [mut model, mut dense] = [0; 2].map(|_| Model::compile(scene).unwrap());
    let loops =
        model.loops_within(f64::INFINITY).unwrap_or_else(|| panic!("{} has loops", scene.name));
    model.take_loops(loops);
    (dense.loops, dense.solver) = (None, Solver::Tree);
    [Arc::new(model), Arc::new(dense)]
}

fn plant(model: &Arc<Model>) -> Plant {
    let mut plant = Plant::new(model.clone(), Settings::new(model)).unwrap();
    plant.initialize(&Initial::Scene).unwrap();
    plant
}

fn assert_near(a: &[f64], b: &[f64], tolerance: f64, what: &str) {
    let size = b.iter().fold(0.0_f64, |m, x| m.max(x.abs()));
    assert_eq!(a.len(), b.len());
    for (i, (a, b)) in a.iter().zip(b).enumerate() {
        assert!((a - b).abs() <= tolerance * size, "{what} {i}: {a} {b} of {size}");
    }
}

#[test]
fn loops_move_and_linearize_as_with_dense_matrices() {
    for scene in scenes() {
        let [model, dense] = both(&scene);
        let (mut fast, mut slow) = (plant(&model), plant(&dense));
        let [mut a, mut b] = [&model, &dense].map(|model| Linearization::new(model));
        let u: Vec<f64> = (0..model.dimensions().input()).map(|i| 0.3 + i as f64).collect();
        for _ in 0..20 {
            slow.restore(&fast.snapshot()).unwrap();
            let report = fast.step_and_linearize(&u, &mut a).unwrap();
            assert!(
                [&fast, &slow].map(|p| p.workspace.kkt.factored.valid)
                    == [Factors::Recursion, Factors::Tree]
            );
            assert!(report.constraint_reciprocal_condition > 1e-9);
            slow.step_and_linearize(&u, &mut b).unwrap();
            let name = &scene.name;
            assert_near(fast.q(), slow.q(), 1e-12, name);
            assert_near(fast.p(), slow.p(), 1e-9, name);
            assert_near(fast.multipliers(), slow.multipliers(), 1e-9, name);
            let blocks = |l: &Linearization| [l.a(), l.b(), l.multipliers_x(), l.multipliers_u()];
            for (fast, slow) in blocks(&a).iter().zip(&blocks(&b)) {
                assert_near(fast.as_slice(), slow.as_slice(), 1e-8, name);
            }
        }
    }
}

/// Steps and linearizations where no pivot counts as sound: all equations are taken together.
#[test]
fn dense_matrices_stand_in_for_loops() {
    for scene in scenes() {
        let [model, dense] = both(&scene);
        let mut model = Arc::into_inner(model).unwrap();
        model.conditioning.inertia.iter_mut().for_each(|inertia| *inertia *= 1e9);
        let (mut refused, mut slow) = (plant(&Arc::new(model)), plant(&dense));
        let [mut a, mut b] = [&dense, &dense].map(|model| Linearization::new(model));
        let u = vec![0.4; dense.dimensions().input()];
        for _ in 0..10 {
            refused.step(&u).unwrap();
            slow.step(&u).unwrap();
            assert_eq!(refused.workspace.kkt.factored.valid, Factors::Tree);
            assert_near(refused.q(), slow.q(), 1e-9, &scene.name);
        }
        refused.linearize(&u, &mut a).unwrap();
        slow.linearize(&u, &mut b).unwrap();
        assert_near(a.a().as_slice(), b.a().as_slice(), 1e-6, &scene.name);
    }
}

#[test]
fn second_order_is_that_of_dense_matrices() {
    for scene in [rungs(), builtin::scene("scissor-4").unwrap()] {
        let found = both(&scene).map(|model| {
            let mut plant = plant(&model);
            let u = vec![0.5; model.dimensions().input()];
            plant.step(&u).unwrap();
            plant.step(&u).unwrap();
            let d = model.dimensions();
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
            (contraction.xx, full)
        });
        let [(fast, fast_full), (slow, slow_full)] = found;
        assert_near(fast.as_slice(), slow.as_slice(), 1e-7, &scene.name);
        assert_near(fast_full.as_slice(), slow_full.as_slice(), 1e-7, &scene.name);
        assert_near(fast.as_slice(), fast_full.as_slice(), 1e-7, &scene.name);
    }
}

/// What a linearization leaves in the workspace changes no bit of the steps after it.
#[test]
fn linearizing_leaves_the_motion_alone() {
    for scene in scenes() {
        let [model, _] = both(&scene);
        let (mut one, mut other) = (plant(&model), plant(&model));
        let mut out = Linearization::new(&model);
        let u = vec![0.2; model.dimensions().input()];
        for _ in 0..10 {
            one.step(&u).unwrap();
            other.step_and_linearize(&u, &mut out).unwrap();
            assert_eq!(one.state(), other.state(), "{}", scene.name);
        }
    }
}

/// The velocity that belongs to a momentum.
#[test]
fn the_first_guess_is_that_of_dense_matrices() {
    for scene in scenes() {
        let [fast, slow] = both(&scene).map(|model| {
            let mut plant = plant(&model);
            let u = vec![0.2; model.dimensions().input()];
            for _ in 0..5 {
                plant.step(&u).unwrap();
            }
            let Plant { settings, state, workspace, .. } = &mut plant;
            workspace.prepare(StepContext { model: &model, settings, state, u: &u });
            workspace.ballistic(&model, settings, state);
            assert_eq!(workspace.kkt.factored.valid == Factors::Recursion, model.loops.is_some());
            workspace.step.increment.clone()
        });
        assert_near(&fast, &slow, 1e-9, &scene.name);
    }
}

/// Wrenches stand for the Jacobian.
#[test]
fn impulses_are_those_of_the_jacobian() {
    for scene in scenes() {
        let [model, _] = both(&scene);
        let mut plant = plant(&model);
        plant.step(&vec![0.2; model.dimensions().input()]).unwrap();
        plant.step(&vec![0.5; model.dimensions().input()]).unwrap();
        let Plant { state, workspace, .. } = &mut plant;
        workspace.prepare_start(&model, state);
        let d = model.dimensions();
        let multipliers: Vec<f64> = (0..d.constraints).map(|i| (i as f64 + 0.5).cos()).collect();
        let [mut by_wrenches, mut by_entries] = [0; 2].map(|_| vec![0.0; d.dynamic]);
        workspace.constraints.start.subtract_pushes(&model, &multipliers, &mut by_wrenches);
        workspace.constraints.start.subtract_impulses(&model, &multipliers, &mut by_entries);
        assert_near(&by_wrenches, &by_entries, 1e-13, &scene.name);
    }
}

#[test]
fn wider_registers_give_the_same_bits() {
    for scene in scenes() {
        let [model, _] = both(&scene);
        let mut plant = plant(&model);
        let mut out = Linearization::new(&model);
        plant.step(&vec![0.2; model.dimensions().input()]).unwrap();
        plant.linearize(&vec![0.2; model.dimensions().input()], &mut out).unwrap();
        let Workspace { mid, constraints, kkt, tangents, .. } = &mut plant.workspace;
        let (mechanics, start, end) = (&mid.mechanics, &constraints.start, &constraints.end);
        let constraint_hessian = &tangents.constraint_hessian;
        let tree = mechanics.planar.as_deref().and_then(PlanarTree::many).unwrap();
        let (loops, joints) = (model.loops.as_ref().unwrap(), model.planar.as_ref().unwrap());
        let at = Mechanism {
            loops,
            joints,
            tree,
            start: start.in_plane.as_ref().unwrap(),
            end: end.in_plane.as_ref().unwrap(),
        };
        let d = model.dimensions();
        let numbers: Vec<f64> = (0..d.dynamic).map(|i| (i as f64).sin()).collect();
        let diagonal = Diagonals {
            residual: numbers.clone(),
            by_start: numbers.clone(),
            by_increment: numbers.clone(),
        };
        let closures = Closures { jacobian: &end.jacobian, hessian: constraint_hessian };
        let conditioning = &model.conditioning;
        let scales = Scales { inertia: &conditioning.inertia, weight: &conditioning.weight };
        let Recursion::Loops(fronts) = &kkt.factored.recursion else { panic!("no fronts") };
        let mut wide = fronts.clone();
        let mut narrow = wide.clone();
        wide.factor(at, &numbers, scales, 0.01, MatrixKind::Newton);
        narrowly(|| narrow.factor(at, &numbers, scales, 0.01, MatrixKind::Newton));
        assert_eq!(wide.factored.factors, narrow.factored.factors);
        let [mut x, mut narrow_x] = [0; 2].map(|_| numbers.clone());
        let [mut lambda, mut narrow_lambda] = [0; 2].map(|_| vec![0.3; d.constraints]);
        wide.solve(loops, &mut x, &mut lambda);
        narrowly(|| narrow.solve(loops, &mut narrow_x, &mut narrow_lambda));
        assert_eq!((x, lambda), (narrow_x, narrow_lambda));
        let results = [(wide, true), (narrow, false)].map(|(mut matrix, is_wide)| {
            let stride = padded(2 * d.dynamic);
            let [mut increment, mut momentum] = [0; 2].map(|_| vec![0.0; d.dynamic * stride]);
            let mut multipliers = vec![0.0; d.constraints * stride];
            let out = Derivatives {
                increment: &mut increment,
                momentum: &mut momentum,
                multipliers: &mut multipliers,
                stride,
            };
            if is_wide {
                matrix.linearize(at, &diagonal, &closures, out);
            } else {
                narrowly(|| matrix.linearize(at, &diagonal, &closures, out));
            }
            (increment, momentum, multipliers)
        });
        assert!(results[0].0.iter().any(|x| *x != 0.0));
        assert!(results[0] == results[1], "{}", scene.name);
    }
}

/// A ladder's fronts do not grow with it; a chain of joints has one body in its front.
#[test]
fn fronts_stay_small() {
    let most = |scene: &Scene| {
        let [model, _] = both(scene);
        model.loops.as_ref().unwrap().plan.fronts.iter().copied().max().unwrap()
    };
    let scissor = |n: usize| builtin::scene(&format!("scissor-{n}")).unwrap();
    assert_eq!(most(&scissor(4)), 14);
    assert_eq!(most(&scissor(40)), 14);
    assert_eq!(most(&rope()), 8);
}

/// Rods between far parts of a chain make fronts grow: dense matrices are less work.
#[test]
fn fronts_that_grow_are_given_up() {
    let mut sketch = Sketch::default();
    let angles: Vec<f64> = (0..120).map(|k| 0.9 * (1.7 * k as f64).sin()).collect();
    sketch.chain(None, [0.0, 0.0], &angles);
    for k in 0..40 {
        sketch.rod(k, 60 + (k * 37) % 60);
    }
    let model = Model::compile(&sketch.scene("tangle")).unwrap();
    assert!(model.loops.is_none());
}

/// Where loops cannot be taken one by one, all equations are taken together, and named if they are singular.
#[test]
fn singular_loops_are_named() {
    let mut sketch = Sketch::default();
    // Four bars in one line.
    let end = sketch.chain(None, [0.0, 0.0], &[0.0; 6]);
    sketch.pin(end, [0.0, -0.3], None);
    let model = Arc::new(Model::compile(&sketch.scene("line")).unwrap());
    assert!(model.loops.is_none());
    let [model, _] = both(&rope());
    let mut plant = plant(&model);
    let d = model.dimensions();
    let q = vec![0.0; d.coordinates()];
    let workspace = &mut plant.workspace;
    for closure in [&mut workspace.constraints.start, &mut workspace.constraints.end] {
        closure.evaluate(&model, &q, &[]);
        closure.differentiate(&model, &q);
        closure.place_in_plane(&model, &q);
    }
    let refused = workspace.factor(&model, &plant.settings, &plant.state);
    assert!(matches!(refused, Err(StepError::SingularConstraints { .. })), "{refused:?}");
}
