//! Eliminations by generators against dense systems, and motions against those solved entry by entry.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector, Rotation3, UnitQuaternion, Vector3};
use plantd_math::rows::{padded, spread};
use plantd_math::simd::{AVX2, AVX512, PORTABLE, within};
use plantd_math::tree_lu::TreeLu;
use plantd_scene::{CoordinateKind, Scene, builtin};

use crate::integrator::report::StepError;
use crate::integrator::settings::Settings;
use crate::integrator::workspace::{StepContext, Workspace};
use crate::kkt::space::Spatial;
use crate::kkt::space::derivatives::Derivatives;
use crate::kkt::system::{Linearized, Recursion};
use crate::kkt::tied::Tied;
use crate::lagrangian::fields::Fields;
use crate::lagrangian::generators::MatrixKind;
use crate::lagrangian::samples::{prescribe, rubbing};
use crate::linearization::derivative::StepDerivative;
use crate::linearization::linearize::Linearization;
use crate::model::mechanism::{Acting, Forces, Model, Solver};
use crate::plant::facade::Plant;
use crate::plant::initial::Initial;
use crate::plant::site::Pose;

/// A number between −1 and 1 that looks random.
fn wave(i: usize) -> f64 {
    (12.9898 * i as f64 + 0.3).sin()
}

fn compiled(text: &str) -> Model {
    Model::compile(&Scene::from_toml(text).unwrap()).unwrap()
}

/// Two trees that branch: a floating base of massless joints with hinges, sliders and screws below it, and
/// one more. `extra` goes on the scene, `more` on the coordinates.
fn branching(n: usize, extra: &str, more: &str) -> Model {
    let mut text = format!("format = 1\nname = \"branching\"\n{extra}\n");
    let axes = ["[1.0, 0.0, 0.0]", "[0.0, 1.0, 0.0]", "[0.0, 0.0, 1.0]"];
    for i in 0..n {
        let number = |k| wave(17 * i + k);
        let parent = match i {
            0 | 8 => "world".to_owned(),
            1..8 => format!("f{}", i - 1),
            _ => format!("f{}", [i - 1, i - 2, 3 + i / 4][i % 3]),
        };
        let axis = format!("[{}, {}, {}]", number(0), number(1), number(2));
        let joint = match i {
            0..3 => format!("type = \"prismatic\", axis = {}", axes[i]),
            3..6 => format!("type = \"revolute\", axis = {}", axes[i - 3]),
            _ if i % 5 == 1 => format!("type = \"prismatic\", axis = {axis}"),
            _ if i % 5 == 3 => format!("type = \"screw\", pitch = 0.2, axis = {axis}"),
            _ => format!("type = \"revolute\", axis = {axis}"),
        };
        text +=
            &format!("[[frames]]\nname = \"f{i}\"\nparent = \"{parent}\"\njoint = {{ {joint} }}\n");
        if i > 4 {
            let (offset, center) =
                ([number(3), number(4), number(5)], [number(6), number(7), number(8)]);
            text += &format!(
                "translation = {offset:?}\nbody = {{ mass = {}, center_of_mass = {center:?}, inertia = [0.2, 0.3, 0.4, 0.01, 0.02, 0.03] }}\n",
                1.5 + number(9)
            );
        }
    }
    for i in 0..n {
        text += &format!("[[coordinates]]\nname = \"f{i}\"\ninitial = {}\n{more}\n", wave(i));
    }
    for i in (0..n).step_by(3) {
        text += &format!(
            "[[springs]]\ntype = \"coordinate\"\ncoordinate = \"f{i}\"\nstiffness = 30.0\n"
        );
    }
    compiled(&text)
}

/// A rope of 1 m and 1 kg: thin rods hinged about x and y by turns.
fn rope(n: usize, more: &str) -> String {
    let length = 1.0 / n as f64;
    let across = length.powi(3) / 12.0;
    let mut text = format!(
        "format = 1\nname = \"rope\"\ngravity = [0.0, 0.0, -9.8]\ntime_step_s = {}\n",
        0.08 * length
    );
    for i in 0..n {
        let (parent, z) =
            if i == 0 { ("world".to_owned(), 0.0) } else { (format!("f{}", i - 1), -length) };
        let axis = if i % 2 == 0 { "[1.0, 0.0, 0.0]" } else { "[0.0, 1.0, 0.0]" };
        text += &format!(
            "[[frames]]\nname = \"f{i}\"\nparent = \"{parent}\"\ntranslation = [0.0, 0.0, {z}]\n\
             joint = {{ type = \"revolute\", axis = {axis} }}\n\
             body = {{ mass = {length}, center_of_mass = [0.0, 0.0, {}], inertia = [{across}, {across}, {}] }}\n",
            -0.5 * length,
            0.1 * across
        );
    }
    text + more
}

/// Solves by generators, whatever the model is solved by.
fn generate(workspace: &mut Workspace, model: &Model) {
    assert!(model.is_generated_in_space());
    workspace.kkt.factored.recursion = Recursion::Spatial(Box::new(Spatial::new(model)));
    let mut derivatives = Derivatives::new(model);
    derivatives.make_room();
    workspace.kkt.in_space = Some(derivatives);
    let stride = spread(padded(2 * model.dimensions.coordinates()));
    workspace.tangents.make_room_beside_generators(model, stride);
    workspace.kkt.fields = model.has_fields().then(|| Box::new(Fields::new(model)));
    workspace.kkt.tied = (model.tied_rows > 0).then(|| Box::new(Tied::new(model, stride)));
}

/// The matrix that is filled entry by entry.
fn dense(model: &Model, matrix: &TreeLu) -> DMatrix<f64> {
    let n = model.dimensions.dynamic;
    let mut dense = DMatrix::zeros(n, n);
    for row in 0..n {
        for (slot, ancestor) in model.elimination.entries_of(row) {
            dense[(row, ancestor)] = matrix.lower[slot];
            dense[(ancestor, row)] = matrix.upper[slot];
        }
    }
    dense
}

#[test]
fn a_solution_satisfies_the_dense_system() {
    let gravity = "gravity = [1.0, -2.0, -9.0]";
    let without = "gravity = [0.0, 0.0, 0.0]";
    let cases = [
        branching(7, without, ""),
        branching(9, gravity, ""),
        branching(24, without, ""),
        branching(24, gravity, ""),
        branching(40, gravity, "damping = 0.3"),
        compiled(&rope(64, "")),
    ];
    for model in cases {
        let n = model.dimensions.dynamic;
        let settings = Settings { time_step_s: 0.02, ..Settings::new(&model) };
        let mut workspace = Workspace::new(&model);
        generate(&mut workspace, &model);
        for trial in 0..5 {
            for i in 0..n {
                workspace.mid.q[i] = wave(100 * trial + i);
                workspace.mid.angles[i] = workspace.mid.q[i];
                workspace.mid.velocity[i] = 3.0 * wave(1000 + 100 * trial + i);
            }
            workspace.mid.evaluate(&model);
            workspace.fill_newton_matrix(&model, &settings);
            let matrix = dense(&model, &workspace.kkt.factored.tree);
            assert!(workspace.factor_recursion(&model, &settings).unwrap());
            assert_solves(&mut workspace, &model, &matrix);

            let Workspace { mid, kkt, constraints, .. } = &mut workspace;
            let (mechanics, start) = (&mut mid.mechanics, &constraints.start);
            kkt.factored.tree.clear();
            mechanics.curvature.fill_mass_matrix(&model.pairs, &mut kkt.factored.tree);
            let masses = dense(&model, &kkt.factored.tree) * (-1.0 / settings.time_step_s);
            kkt.diagonal.fill(0.0);
            let at = Linearized {
                model: &model,
                mechanics,
                constraints: [start, start],
                time_step_s: settings.time_step_s,
                singular_below: settings.singular_below,
            };
            assert!(kkt.factor_recursion(at, MatrixKind::Mass).unwrap());
            assert_solves(&mut workspace, &model, &masses);
        }
    }
}

/// What generators solve at the last evaluation is the system that is filled entry by entry.
fn assert_generates(plant: &mut Plant) {
    let Plant { model, workspace, settings, .. } = plant;
    workspace.fill_newton_matrix(model, settings);
    let matrix = dense(model, &workspace.kkt.factored.tree);
    assert!(workspace.factor_recursion(model, settings).unwrap());
    assert_solves(workspace, model, &matrix);
    assert_nudges(workspace, model);
}

/// What springs and forces make of a change of the motion by generators is what it is entry by entry.
fn assert_nudges(workspace: &mut Workspace, model: &Model) {
    let nd = model.dimensions.dynamic;
    workspace.nudge.position = (0..nd).map(|i| wave(2 * i)).collect();
    workspace.nudge.velocity = (0..nd).map(|i| wave(3 * i + 1)).collect();
    let change = |workspace: &mut Workspace| {
        workspace.step.impulse.fill(0.0);
        workspace.nudge_elements(model, 0.1);
        DVector::from_column_slice(&workspace.step.impulse)
    };
    let found = change(workspace);
    let recursion = std::mem::replace(&mut workspace.kkt.factored.recursion, Recursion::None);
    let expected = change(workspace);
    workspace.kkt.factored.recursion = recursion;
    let error = (&found - &expected).amax();
    assert!(error <= 1e-12 * expected.amax(), "{error:e} of {:e}", expected.amax());
}

fn assert_solves(workspace: &mut Workspace, model: &Model, matrix: &DMatrix<f64>) {
    let b = DVector::from_fn(matrix.nrows(), |i, _| wave(i + 7));
    let mut x = b.clone();
    workspace.kkt.solve(model, &workspace.constraints.end, x.as_mut_slice(), &mut []);
    let exact = matrix.clone().lu().solve(&b).unwrap();
    let error = (&x - &exact).amax() / exact.amax();
    assert!(error < 1e-9, "{} rows: {error:e}", matrix.nrows());
}

/// Plants of one model that solve by generators and entry by entry, moving.
fn both(model: &Arc<Model>, order: u32) -> [Plant; 2] {
    let settings = Settings { order, ..Settings::new(model) };
    let d = model.dimensions;
    let mut fast = Plant::new(Arc::clone(model), settings).unwrap();
    assert!(order == 2 || model.solver == Solver::Spatial);
    generate(&mut fast.workspace, model);
    let n = d.coordinates();
    let turned = |i: usize| if i < 2 { 0.5 } else { 0.02 * (1.3 * i as f64).sin() };
    let q = (0..n).map(turned).collect();
    let v = (0..n).map(|i| 0.1 * (0.3 * i as f64).cos()).collect();
    if d.constraints == 0 {
        fast.initialize(&Initial::Velocity { q, v }).unwrap();
    }
    let mut slow = fast.clone();
    slow.workspace.kkt.factored.recursion = Recursion::None;
    slow.workspace.kkt.in_space = None;
    [fast, slow]
}

#[test]
fn long_chains_move_as_they_do_entry_by_entry() {
    for n in [64, 128] {
        let [mut fast, mut slow] = both(&Arc::new(compiled(&rope(n, ""))), 2);
        let start = fast.energy();
        let (mut more, mut worst) = (0, 0.0_f64);
        for _ in 0..100 {
            let own = fast.step(&[]).unwrap();
            more += own.iterations as i32 - slow.step(&[]).unwrap().iterations as i32;
            let energy = fast.energy();
            let gained =
                energy.kinetic_j + energy.potential_j - start.kinetic_j - start.potential_j;
            worst = worst.max(gained.abs());
        }
        let apart = fast.q().iter().zip(slow.q()).fold(0.0_f64, |m, (a, b)| m.max((a - b).abs()));
        assert!(apart < 1e-8, "{n}: {apart:e}");
        assert!(worst < 1e-5 * start.potential_j.abs(), "{n}: {worst:e}");
        assert!(more <= 20, "{n}: {more} corrections more");
    }
}

#[test]
fn collocation_and_linearization_are_those_entry_by_entry() {
    let scratched =
        "gravity = [1.0, -2.0, -9.0]\ntime_step_s = 0.002\n".to_owned() + &rubbing("f", 40);
    for (model, order) in [
        (compiled(&rope(64, "")), 4),
        (compiled(&rope(20, "[[inputs]]\nname = \"u\"\ncoordinate = \"f3\"\n")), 2),
        (branching(40, "gravity = [1.0, -2.0, -9.0]\ntime_step_s = 0.002", "damping = 0.3"), 2),
        (branching(40, &scratched, "armature = 0.1"), 2),
    ] {
        let model = Arc::new(model);
        let [mut fast, mut slow] = both(&model, order);
        let u: Vec<f64> = (0..model.dimensions.input()).map(wave).collect();
        let mut linear = [Linearization::new(&model), Linearization::new(&model)];
        for _ in 0..10 {
            fast.step_and_linearize(&u, &mut linear[0]).unwrap();
            slow.step_and_linearize(&u, &mut linear[1]).unwrap();
        }
        let [a, b] = linear.map(|l| l.a());
        assert!((&a - &b).amax() <= 1e-9 * b.amax(), "{:e} {:e}", (&a - &b).amax(), b.amax());
        for (a, b) in fast.q().iter().zip(slow.q()) {
            assert!((a - b).abs() < 1e-10, "{a} {b}");
        }
    }
}

/// What is missing to the symplectic form of a map without forces, relative to its entries.
fn defect(a: &DMatrix<f64>) -> f64 {
    let n = a.nrows() / 2;
    let mut omega = DMatrix::zeros(2 * n, 2 * n);
    (0..n).for_each(|i| (omega[(i, i + n)], omega[(i + n, i)]) = (1.0, -1.0));
    (a.transpose() * &omega * a - &omega).amax() / a.amax().powi(2)
}

/// Sums about one origin lose digits in long chains; the entries of a matrix, and its elimination, lose more.
#[test]
fn derivatives_are_as_symplectic_as_entry_by_entry() {
    for model in [rope(16, ""), rope(64, ""), rope(128, "")].map(|text| compiled(&text)) {
        let model = Arc::new(model);
        let mut linear = [Linearization::new(&model), Linearization::new(&model)];
        let [mut fast, mut slow] = both(&model, 2);
        let mut worst = [0.0_f64; 2];
        for _ in 0..20 {
            slow.restore(&fast.snapshot()).unwrap();
            for ((plant, out), worst) in
                [&mut fast, &mut slow].into_iter().zip(&mut linear).zip(&mut worst)
            {
                plant.step_and_linearize(&[], out).unwrap();
                *worst = worst.max(defect(&out.a()));
            }
        }
        let [own, others] = worst;
        assert!(own <= 1.5 * others, "{own:e} {others:e}");
    }
}

/// A floating hull with limbs of ball joints and hinges, damped, with armatures and inputs.
fn floating() -> Model {
    let mut text = "format = 1\nname = \"floating\"\ngravity = [1.0, -2.0, -9.0]\n\
                    time_step_s = 0.004\ndamping = 0.02\n\
                    [[frames]]\nname = \"hull\"\njoint = { type = \"free\" }\n\
                    body = { mass = 3.0, center_of_mass = [0.1, 0.0, -0.2], inertia = [0.2, 0.3, 0.4, 0.01, 0.02, 0.03] }\n"
        .to_owned();
    for i in 0..9_usize {
        let number = |k| wave(31 * i + k);
        let parent = if i < 3 { "hull".to_owned() } else { format!("f{}", i - 3) };
        let joint = match i % 4 {
            1 => "type = \"revolute\", axis = [0.3, 1.0, -0.2]",
            3 => "type = \"prismatic\", axis = [0.3, 0.2, 1.0]",
            _ => "type = \"ball\"",
        };
        let [at, center] = [0, 3].map(|k| [number(k), number(k + 1), number(k + 2)]);
        text += &format!(
            "[[frames]]\nname = \"f{i}\"\nparent = \"{parent}\"\ntranslation = {at:?}\n\
             joint = {{ {joint} }}\nbody = {{ mass = {}, center_of_mass = {center:?}, inertia = [0.2, 0.3, 0.4] }}\n",
            1.5 + number(7)
        );
    }
    text += "[[coordinates]]\nname = \"f2_ry\"\narmature = 0.3\ndamping = 0.4\n\
             [[inputs]]\nname = \"u\"\ncoordinate = \"f0_rz\"\n";
    compiled(&text)
}

#[test]
fn ball_joints_are_eliminated_with_their_axes() {
    let model = Arc::new(floating());
    let n = model.dimensions.dynamic;
    let [mut fast, mut slow] = both(&model, 2);
    let mut linear = [Linearization::new(&model), Linearization::new(&model)];
    for _ in 0..200 {
        fast.step_and_linearize(&[0.7], &mut linear[0]).unwrap();
        slow.step_and_linearize(&[0.7], &mut linear[1]).unwrap();
    }
    assert!(apart(fast.q(), slow.q()) < 1e-10, "{:e}", apart(fast.q(), slow.q()));
    let [a, b] = linear.map(|l| l.a());
    assert!((&a - &b).amax() <= 1e-9 * b.amax(), "{:e} {:e}", (&a - &b).amax(), b.amax());

    let (workspace, settings) = (&mut fast.workspace, &fast.settings);
    workspace.fill_newton_matrix(&model, settings);
    let matrix = dense(&model, &workspace.kkt.factored.tree);
    assert!(workspace.factor_recursion(&model, settings).unwrap());
    assert_solves(workspace, &model, &matrix);
    let state = fast.state.clone();
    assert!(workspace.find_velocity_by_recursion(&model, settings, &state));
    let velocity = workspace.residual.dynamics.clone();
    workspace.find_velocity(&model, &state);
    let found = apart(&velocity, &workspace.residual.dynamics[..n]);
    assert!(found < 1e-11, "{found:e}");
}

/// Moves a plant by generators and one entry by entry, with what is moved going to and fro, and compares where they are
/// and their last linearizations; returns the first one.
fn move_alike(model: &Arc<Model>, steps: u32) -> Plant {
    let d = model.dimensions;
    let [mut fast, mut slow] = both(model, 2);
    let mut linear = [Linearization::new(model), Linearization::new(model)];
    let mut u = vec![0.4; d.input()];
    let start: Vec<f64> = fast.q()[d.dynamic..].to_vec();
    for k in 0..steps {
        for (i, start) in start.iter().enumerate() {
            u[d.inputs + i] = start + 0.02 * (0.05 * f64::from(k + 1) * (1.0 + wave(i))).sin();
        }
        fast.step_and_linearize(&u, &mut linear[0]).unwrap();
        slow.step_and_linearize(&u, &mut linear[1]).unwrap();
    }
    assert!(apart(fast.q(), slow.q()) < 1e-9, "{:e}", apart(fast.q(), slow.q()));
    for of in [
        Linearization::a,
        Linearization::b,
        Linearization::multipliers_x,
        Linearization::multipliers_u,
    ] {
        let [a, b] = linear.each_ref().map(of);
        assert!((&a - &b).amax() <= 1e-9 * b.amax(), "{:e} {:e}", (&a - &b).amax(), b.amax());
    }
    assert_products(&mut fast, &mut linear[0], &u);
    fast
}

/// Products with a step's derivative are those with its matrices.
fn assert_products(plant: &mut Plant, out: &mut Linearization, u: &[f64]) {
    let mut products = StepDerivative::new(&plant.model().clone());
    plant.linearize(u, out).unwrap();
    plant.solve(u, None).unwrap();
    let Plant { model, settings, state, workspace, period } = plant;
    let u = period.input.of_step(model, state, settings.time_step_s, u, [0.0, 1.0]).unwrap();
    workspace.differentiate(StepContext { model, settings, state, u }, &mut products).unwrap();
    assert!(products.is_there());
    let (a, b) = (out.a(), out.b());
    let waves = |count, phase| DVector::from_fn(count, |i, _| wave(i + phase));
    let (x, u, z) = (waves(a.ncols(), 1), waves(b.ncols(), 2), waves(a.nrows(), 3));
    let close = |found: Vec<f64>, expected: DVector<f64>| {
        let off = (DVector::from_vec(found) - &expected).amax();
        assert!(off <= 1e-10 * expected.amax(), "{off:e} {:e}", expected.amax());
    };
    let mut next = vec![f64::NAN; a.nrows()];
    products.push_forward(x.as_slice(), u.as_slice(), &mut next);
    close(next, &a * &x + &b * &u);
    let (mut by_x, mut by_u) = (vec![f64::NAN; a.ncols()], vec![f64::NAN; b.ncols()]);
    products.pull_back(z.as_slice(), &mut by_x, &mut by_u);
    close(by_x, a.tr_mul(&z));
    close(by_u, b.tr_mul(&z));
}

fn apart(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).fold(0.0_f64, |most, (a, b)| most.max((a - b).abs()))
}

/// The floating hull and a tree that branches, with joints that are moved: at a root, on the way, below a fork and at a
/// leaf.
#[test]
fn joints_that_are_moved_pass_on_what_is_below_them() {
    let moved = |names: &[&str], model: Model| {
        let mut scene = model.scene().clone();
        prescribe(&mut scene, names);
        Model::compile(&scene).unwrap()
    };
    let tree = "gravity = [1.0, -2.0, -9.0]\ntime_step_s = 0.002";
    for model in [
        moved(&["f0"], branching(24, tree, "")),
        moved(&["f2", "f7", "f9", "f23"], branching(24, tree, "damping = 0.3")),
        moved(&["f0", "f5", "f12", "f13", "f29"], branching(40, tree, "")),
        moved(&["f1", "f5", "f7"], floating()),
        moved(&["f4_rx", "f4_ry", "f4_rz", "f7"], floating()),
        moved(&["f2_rx", "f2_ry", "f2_rz", "f8_rx", "f8_ry", "f8_rz"], floating()),
        moved(&["f0", "f40"], compiled(&rope(64, ""))),
    ] {
        let model = Arc::new(model);
        assert!(model.dimensions.prescribed > 0);
        let mut fast = move_alike(&model, 50);
        assert_velocity(&mut fast);
    }
}

/// The velocity that belongs to the momentum, by generators and entry by entry.
fn assert_velocity(plant: &mut Plant) {
    let Plant { model, settings, state, workspace, .. } = plant;
    let nd = model.dimensions.dynamic;
    assert!(workspace.find_velocity_by_recursion(model, settings, state));
    let recursive = workspace.residual.dynamics.clone();
    workspace.find_velocity(model, state);
    let direct = workspace.residual.dynamics.clone();
    // Both belong to the momentum of the state: in a long rope velocities follow from it with fewer digits.
    for velocity in [recursive, direct] {
        let velocity = [&velocity[..nd], &state.v].concat();
        workspace.gradient_at(model, state, &velocity);
        let found = apart(&workspace.mid.l_v, &state.p);
        assert!(found < 1e-13, "{found:e}");
    }
}

/// Springs, dampers and drag between points of two bodies and the world, and wrenches on one of them.
fn fields(bodies: [&str; 2]) -> String {
    let [a, b] = bodies;
    let world = "{ frame = \"world\", at = [0.3, -0.4, 1.5] }";
    let point = |frame: &str, kind: &str, more: &str| {
        format!(
            "type = \"{kind}\"\na = {{ frame = \"{frame}\", at = [0.2, 0.1, -0.3] }}\nb = {world}\n{more}\n"
        )
    };
    let back = |frame: &str, kind: &str, more: &str| {
        format!("type = \"{kind}\"\nb = {{ frame = \"{frame}\" }}\na = {world}\n{more}\n")
    };
    let springs = [
        point(a, "two_point", "stiffness = 20.0\nrest_length = 0.4"),
        back(b, "two_point", "stiffness = 7.0"),
    ];
    let wrench = "force = [0.3, \"thrust\", 0.7]\ntorque = [\"thrust\", -0.3, 0.2]";
    let forces = [
        point(a, "two_point_damper", "damping = 0.8"),
        back(b, "two_point_damper", "damping = 1.1"),
        format!("type = \"drag\"\nframe = \"{b}\"\nat = [0.3, -0.2, 0.1]\ncoefficient = 0.5"),
        format!("type = \"body_wrench\"\nframe = \"{a}\"\n{wrench}"),
        format!("type = \"spatial_wrench\"\nframe = \"{b}\"\n{wrench}"),
        format!("type = \"hybrid_wrench\"\nframe = \"{a}\"\n{wrench}"),
    ];
    let mut text = "[[inputs]]\nname = \"thrust\"\n".to_owned();
    springs.iter().for_each(|spring| text += &format!("[[springs]]\n{spring}\n"));
    forces.iter().for_each(|force| text += &format!("[[forces]]\n{force}\n"));
    text
}

/// A scene and what acts on it from the world; some coordinates are moved.
fn pulled(model: &Model, bodies: [&str; 2], more: &str, moved: &[&str]) -> Model {
    let mut scene = Scene::from_toml(&(model.scene().to_toml() + &fields(bodies) + more)).unwrap();
    prescribe(&mut scene, moved);
    Model::compile(&scene).unwrap()
}

/// What acts on bodies from the world has vectors of two blocks, and springs of ball joints are their own.
#[test]
fn what_acts_from_the_world_is_generated() {
    let tree = "gravity = [1.0, -2.0, -9.0]\ntime_step_s = 0.002";
    let sprung = "[[springs]]\ntype = \"orientation\"\nframe = \"f4\"\nstiffness = 9.0\n";
    for (steps, model) in [
        (50, pulled(&branching(24, tree, ""), ["f23", "f10"], "", &[])),
        (
            50,
            pulled(&branching(24, tree, "damping = 0.3"), ["f21", "f22"], "", &["f2", "f7", "f9"]),
        ),
        (50, pulled(&floating(), ["f8", "f4"], sprung, &[])),
        (50, pulled(&floating(), ["f7", "f6"], sprung, &["f1", "f5", "f7"])),
        (
            50,
            pulled(
                &floating(),
                ["f6", "f8"],
                "",
                &["f2_rx", "f2_ry", "f2_rz", "f4_rx", "f4_ry", "f4_rz"],
            ),
        ),
        (5, pulled(&compiled(&rope(24, "")), ["f23", "f11"], "", &[])),
    ] {
        let model = Arc::new(model);
        assert!(model.has_fields());
        let mut fast = move_alike(&model, steps);
        assert_generates(&mut fast);
    }
}

/// Friction and drag of components of the velocities of ball joints, by themselves and with all else.
#[test]
fn friction_of_ball_joints_is_their_own() {
    let rubbed = "[[forces]]\ntype = \"friction\"\ncoordinate = \"f4_rx\"\nforce = 0.3\nvelocity = 0.5\n\
                  [[forces]]\ntype = \"coordinate_drag\"\ncoordinate = \"f2_ry\"\ncoefficient = 0.4\ncubic = 0.1\n\
                  [[forces]]\ntype = \"friction\"\ncoordinate = \"f5\"\nforce = 0.2\nvelocity = 0.5\n";
    let text = floating().scene().to_toml() + rubbed;
    let spring = "[[springs]]\ntype = \"coordinate\"\ncoordinate = \"f3\"\nstiffness = 9.0\n";
    for model in [
        compiled(&text),
        compiled(&(text + spring)),
        pulled(&floating(), ["f8", "f4"], rubbed, &[]),
        pulled(&floating(), ["f7", "f6"], rubbed, &["f1", "f7"]),
        closed(floating(), Joined::AtPoint, ["f8", "f7", "f6", "world"], rubbed, &[]),
    ] {
        let model = Arc::new(model);
        assert!(model.forces.as_ref().is_some_and(Forces::act_on_balls));
        let mut fast = move_alike(&model, 50);
        if model.dimensions.constraints == 0 {
            assert!(model.foresees_elements);
            assert_generates(&mut fast);
        }
    }
}

/// Springs, dampers and a tendon between points of bodies.
fn between(bodies: &[[&str; 2]]) -> String {
    let mut text = String::new();
    for (k, [a, b]) in bodies.iter().enumerate() {
        let first = format!("{{ frame = \"{a}\", at = [0.2, 0.1, -0.3] }}");
        let last = format!("{{ frame = \"{b}\", at = [-0.1, 0.3, 0.2] }}");
        let points = format!(
            "points = [{first}, {{ frame = \"{a}\", at = [0.1, -0.2, 0.1] }}, {last}, \
             {{ frame = \"{a}\", at = [-0.2, 0.4, 0.3] }}]"
        );
        for element in [
            format!(
                "[[springs]]\ntype = \"two_point\"\na = {first}\nb = {last}\nstiffness = 20.0\nrest_length = 0.4"
            ),
            format!("[[springs]]\ntype = \"path\"\n{points}\nstiffness = 9.0\nrest_length = 0.3"),
            format!(
                "[[forces]]\ntype = \"two_point_damper\"\na = {last}\nb = {first}\ndamping = 0.8"
            ),
            format!("[[forces]]\ntype = \"path_damper\"\n{points}\ndamping = 0.5"),
            format!("[[inputs]]\nname = \"tendon{k}\"\n{points}\ngain = 1.5"),
        ] {
            text += &(element + "\n");
        }
    }
    text
}

/// What acts across one joint is its own, a ball joint or not.
#[test]
fn what_acts_across_a_joint_is_generated() {
    let tree = "gravity = [1.0, -2.0, -9.0]\ntime_step_s = 0.002";
    let hull = [["f0", "hull"], ["f1", "f4"], ["f5", "f2"], ["f4", "f7"], ["f1", "hull"]];
    let rope_of_32 = compiled(&rope(32, &between(&[["f3", "f4"], ["f5", "f4"], ["world", "f0"]])));
    assert_eq!(rope_of_32.solver, Solver::Spatial);
    let of_floating = |moved: &[&str]| {
        let text = floating().scene().to_toml() + &between(&hull);
        let mut scene = Scene::from_toml(&text).unwrap();
        prescribe(&mut scene, moved);
        Model::compile(&scene).unwrap()
    };
    let branches = branching(24, &(tree.to_owned() + "\n"), "").scene().to_toml();
    let parents: Vec<[String; 2]> = {
        let scene = Scene::from_toml(&branches).unwrap();
        let frames = scene.frames.iter().skip(3).step_by(4);
        frames.map(|frame| [frame.name.clone(), frame.parent.clone()]).collect()
    };
    let pairs: Vec<[&str; 2]> = parents.iter().map(|p| p.each_ref().map(|n| n.as_str())).collect();
    for (steps, model) in [
        (5, rope_of_32),
        (50, of_floating(&[])),
        (50, of_floating(&["f3"])),
        (50, compiled(&(branches + &between(&pairs)))),
    ] {
        let model = Arc::new(model);
        assert!(!model.has_fields());
        let mut fast = move_alike(&model, steps);
        assert_generates(&mut fast);
    }
}

/// What acts from a body above, across several joints, ends there; moved joints in between or not.
#[test]
fn what_acts_from_a_body_above_is_generated() {
    let tree = "gravity = [1.0, -2.0, -9.0]\ntime_step_s = 0.002";
    let branches = [["f1", "f4"], ["f7", "f4"], ["f4", "f11"], ["f18", "f7"], ["f10", "world"]];
    let limbs = [["hull", "f3"], ["f4", "hull"], ["f2", "f8"], ["f6", "f3"]];
    let along = [["f3", "f9"], ["f3", "f8"], ["f11", "f9"], ["f20", "f11"], ["world", "f3"]];
    let ball = ["f2_rx", "f2_ry", "f2_rz"];
    for (steps, model) in [
        (50, pulled(&branching(24, tree, ""), ["f1", "f0"], &between(&branches), &[])),
        (
            50,
            pulled(
                &branching(24, tree, "damping = 0.3"),
                ["f1", "f22"],
                &between(&branches),
                &["f1", "f3", "f5", "f9"],
            ),
        ),
        (50, pulled(&floating(), ["hull", "hull"], &between(&limbs), &[])),
        (50, pulled(&floating(), ["hull", "hull"], &between(&limbs), &["f1", "f3", "f5"])),
        (50, pulled(&floating(), ["hull", "f2"], &between(&limbs[..2]), &ball)),
        (5, pulled(&compiled(&rope(24, "")), ["f2", "f3"], &between(&along), &[])),
    ] {
        let model = Arc::new(model);
        assert!(model.acting.as_ref().is_some_and(|acting| acting.contains(&Acting::Ends)));
        let mut fast = move_alike(&model, steps);
        assert_generates(&mut fast);
    }
    // Two tendons along all of a rope, from body to body and from each to the one after the next.
    let pulled_by = |first: usize, by: usize| {
        let points = (first..24).step_by(by);
        let points = points.map(|i| format!("{{ frame = \"f{i}\", at = [0.02, 0.01, -0.01] }}"));
        let points = points.collect::<Vec<_>>().join(", ");
        format!("[[inputs]]\nname = \"tendon{by}\"\npoints = [{points}]\ngain = -0.1\n")
    };
    let model = Arc::new(compiled(&rope(24, &(pulled_by(0, 1) + &pulled_by(1, 2)))));
    assert_generates(&mut move_alike(&model, 5));
    let rope = |pairs: &[[&str; 2]]| compiled(&rope(48, &between(pairs)));
    for apart in [["f3", "f12"], ["f9", "f12"], ["world", "f3"]] {
        assert_eq!(rope(&[["f3", "f9"], apart]).solver, Solver::Spatial);
    }
    for overlapping in [["f5", "f8"], ["f8", "f12"], ["world", "f4"]] {
        assert!(rope(&[["f3", "f9"], overlapping]).has_ties);
    }
}

/// Springs and dampers of sums of coordinates.
fn sums(names: [&str; 4]) -> String {
    let [a, b, c, d] = names;
    let terms = format!(
        "terms = [{{ coordinate = \"{a}\", coefficient = 1.0 }}, {{ coordinate = \"{b}\", coefficient = -0.7 }}, \
         {{ coordinate = \"{c}\", coefficient = 0.4 }}]"
    );
    let others = format!(
        "terms = [{{ coordinate = \"{d}\", coefficient = 0.6 }}, {{ coordinate = \"{a}\", coefficient = 1.2 }}]"
    );
    format!(
        "[[springs]]\ntype = \"linear_spring\"\n{terms}\nstiffness = 12.0\nrest = 0.1\n\
         [[forces]]\ntype = \"linear_damper\"\n{others}\ndamping = 0.3\n"
    )
}

/// What acts between bodies of which none is above the other, what is between overlapping ones, along paths over
/// several bodies, and on sums of coordinates; with joints that are moved, ball joints, and constraints.
#[test]
fn what_acts_between_branches_is_tied() {
    let tree = "gravity = [1.0, -2.0, -9.0]\ntime_step_s = 0.002";
    let branches = [["f18", "f21"], ["f3", "f22"], ["f10", "f7"]];
    let limbs = [["f6", "f8"], ["f4", "f3"], ["hull", "f7"]];
    let tendon = |frames: [&str; 4]| {
        let points =
            frames.map(|f| format!("{{ frame = \"{f}\", at = [0.02, 0.1, -0.05] }}")).join(", ");
        format!(
            "[[springs]]\ntype = \"path\"\npoints = [{points}]\nstiffness = 9.0\nrest_length = 0.3\n\
             [[forces]]\ntype = \"path_damper\"\npoints = [{points}]\ndamping = 0.5\n"
        )
    };
    let ball = ["f2_rx", "f2_ry", "f2_rz"];
    let of_branches = || branching(24, tree, "damping = 0.3");
    let four = ["f3", "f9", "f12", "f20"];
    let of_limbs = between(&limbs) + &tendon(["f6", "hull", "f7", "f8"]);
    for (steps, model) in [
        (50, pulled(&of_branches(), ["f23", "f10"], &sums(four), &[])),
        (
            50,
            pulled(
                &of_branches(),
                ["f23", "f10"],
                &(between(&branches) + &sums(four)),
                &["f3", "f10"],
            ),
        ),
        (
            50,
            pulled(
                &of_branches(),
                ["f1", "f0"],
                &tendon(["f23", "f10", "f16", "world"]),
                &["f1", "f9"],
            ),
        ),
        (50, pulled(&floating(), ["hull", "hull"], &of_limbs, &[])),
        (50, pulled(&floating(), ["f8", "f2"], &of_limbs, &["f1", "f3"])),
        (50, pulled(&floating(), ["hull", "f2"], &of_limbs, &ball)),
        (
            5,
            compiled(&rope(
                24,
                &(between(&[["f3", "f9"], ["f5", "f12"]]) + &tendon(["f1", "f7", "f15", "f23"])),
            )),
        ),
        (50, closed(floating(), Joined::AtPoint, ["f8", "f7", "f6", "world"], &of_limbs, &ball)),
    ] {
        let model = Arc::new(model);
        assert!(model.has_ties && model.tied_rows > 0);
        let mut fast = move_alike(&model, steps);
        if model.dimensions.constraints == 0 {
            assert_generates(&mut fast);
        }
    }
}

/// Armatures of sums of coordinates are rows beside the generators, in masses too: alone, next to what acts across
/// joints, with other ties, with joints that are moved, ball joints, and constraints.
#[test]
fn armatures_of_sums_are_tied() {
    let tree = "gravity = [1.0, -2.0, -9.0]\ntime_step_s = 0.002";
    let rotors = |names: [&str; 4], scale: f64| {
        let [a, b, c, d] = names;
        let sum = |terms: [(&str, f64); 2], armature: f64| {
            let armature = scale * armature;
            let terms = terms
                .map(|(name, c)| format!("{{ coordinate = \"{name}\", coefficient = {c:?} }}"));
            format!("[[armatures]]\narmature = {armature:?}\nterms = [{}]\n", terms.join(", "))
        };
        sum([(a, 1.0), (b, -0.7)], 0.3)
            + &sum([(c, 2.0), (b, 0.4)], 0.05)
            + &sum([(d, 1.0), (a, 1.0)], 0.2)
    };
    let four = ["f3", "f9", "f12", "f20"];
    let branches = || branching(24, tree, "damping = 0.3");
    let limbs = ["f1", "f3", "f5", "f7"];
    let across = between(&[["f3", "f9"], ["f9", "f12"]]);
    // By small inertias of its joints.
    let on_rope = |more: &str| compiled(&rope(24, &(rotors(four, 0.01) + more)));
    for (steps, has_ties, model) in [
        (50, false, compiled(&(branches().scene().to_toml() + &rotors(four, 1.0)))),
        (50, false, pulled(&branches(), ["f23", "f10"], &rotors(four, 1.0), &["f2", "f10"])),
        (50, true, pulled(&branches(), ["f1", "f0"], &(rotors(four, 1.0) + &sums(four)), &["f1"])),
        (50, false, pulled(&floating(), ["hull", "f2"], &rotors(limbs, 1.0), &[])),
        (5, false, on_rope("")),
        (5, false, on_rope(&across)),
        (
            50,
            false,
            closed(
                branches(),
                Joined::AtPoint,
                ["f21", "world", "f17", "f12"],
                &rotors(four, 1.0),
                &["f2"],
            ),
        ),
    ] {
        let model = Arc::new(model);
        assert!(model.has_ties == has_ties && model.tied_rows >= model.armature.sums.len());
        assert_eq!(model.armature.sums.len(), 3);
        let mut fast = move_alike(&model, steps);
        if model.dimensions.constraints == 0 {
            assert_generates(&mut fast);
            assert_velocity(&mut fast);
        }
    }
}

/// How two bodies hang together at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Joined {
    AtPoint,
    InPlane,
    Welded,
    /// To a hook that is moved, and the cable to a reel.
    Dragged,
}

/// A scene with equations that its initial configuration satisfies: a point of a body is joined to another one, two are
/// a distance apart, or a cable runs over three. Some coordinates are moved, and all is by the tree or by generators.
fn closed(model: Model, joined: Joined, frames: [&str; 4], more: &str, moved: &[&str]) -> Model {
    let mut scene = model.scene().clone();
    prescribe(&mut scene, moved);
    let model = Arc::new(Model::compile(&scene).unwrap());
    let plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
    let place = |frame: &str, at: [f64; 3]| {
        let Pose { position, rotation } = plant.pose(&model.site(frame, at).unwrap());
        (Vector3::from(position), Rotation3::new(Vector3::from(rotation)))
    };
    let [a, b, c, d] = frames;
    let ends = [(a, [0.0, 0.0, -0.05]), (c, [0.1, 0.0, 0.0]), (d, [0.0, 0.2, 0.1])];
    let [first, second, third] = ends.map(|(frame, at)| place(frame, at).0);
    let ((base, turned), (_, turned_first)) = (place(b, [0.0; 3]), place(a, [0.0; 3]));
    let there: [f64; 3] = (turned.inverse() * (first - base)).into();
    let relative = UnitQuaternion::from_rotation_matrix(&(turned.inverse() * turned_first));
    let [x, y, z] = relative.imag().into();
    let [p, q, r] = ends.map(|(frame, at)| format!("{{ frame = \"{frame}\", at = {at:?} }}"));
    let join = match joined {
        Joined::AtPoint => format!(
            "type = \"point_to_point\"\naxes = [\"x\", \"y\", \"z\"]\n\
             a = {p}\nb = {{ frame = \"{b}\", at = {there:?} }}"
        ),
        Joined::InPlane => format!(
            "type = \"point_on_plane\"\npoint = {p}\n\
             plane = {{ frame = \"{b}\", at = {there:?}, normal = [0.3, -0.5, 0.8] }}"
        ),
        Joined::Dragged => format!(
            "type = \"point_to_point\"\naxes = [\"x\", \"y\", \"z\"]\n\
             a = {p}\nb = {{ frame = \"hook\" }}\n\
             [[frames]]\nname = \"slide\"\nparent = \"{b}\"\ntranslation = {there:?}\n\
             joint = {{ type = \"prismatic\", axis = [0.2, 1.0, 0.0] }}\n\
             [[frames]]\nname = \"hook\"\nparent = \"slide\"\n\
             joint = {{ type = \"revolute\", axis = [0.0, 0.3, 1.0] }}\n\
             [[coordinates]]\nname = \"slide\"\nkind = \"prescribed\"\n\
             [[coordinates]]\nname = \"hook\"\nkind = \"prescribed\""
        ),
        Joined::Welded => format!(
            "type = \"weld\"\na = \"plate\"\nb = \"seat\"\n\
             [[frames]]\nname = \"plate\"\nparent = \"{a}\"\ntranslation = [0.0, 0.0, -0.05]\n\
             [[frames]]\nname = \"seat\"\nparent = \"{b}\"\ntranslation = {there:?}\n\
             rotation = {{ quaternion = [{:?}, {x:?}, {y:?}, {z:?}] }}",
            relative.w
        ),
    };
    let (rod, cable) = ((second - third).norm(), (first - second).norm() + (second - third).norm());
    let equations = match joined {
        Joined::AtPoint => format!(
            "[[constraints]]\nname = \"rod\"\ntype = \"distance\"\nlength = {rod:?}\na = {q}\nb = {r}\n"
        ),
        Joined::InPlane | Joined::Welded => format!(
            "[[constraints]]\nname = \"cable\"\ntype = \"path_length\"\nlength = {cable:?}\npoints = [{p}, {q}, {r}]\n"
        ),
        Joined::Dragged => format!(
            "[[coordinates]]\nname = \"reel\"\nkind = \"prescribed\"\ninitial = {cable:?}\n\
             [[constraints]]\nname = \"cable\"\ntype = \"path_length\"\nlength = \"reel\"\npoints = [{p}, {q}, {r}]\n"
        ),
    };
    let text =
        model.scene().to_toml() + &equations + "[[constraints]]\nname = \"joined\"\n" + &join;
    let mut model = compiled(&(text + "\n" + more));
    assert!(model.dimensions.constraints > 1 && model.loops.is_none());
    if model.held.take().is_some() {
        model.solver = Solver::Tree;
    }
    model
}

/// Constraints are solved with generators as they are entry by entry: ends of ropes, and loops across branches, with
/// springs and joints that are moved.
#[test]
fn constraints_are_closed_by_generators() {
    let tree = "gravity = [1.0, -2.0, -9.0]\ntime_step_s = 0.002";
    let branches = |more| branching(24, tree, more);
    let ball = ["f2_rx", "f2_ry", "f2_rz", "f5"];
    let mut bent = rope(32, "");
    for i in 0..32 {
        bent += &format!("[[coordinates]]\nname = \"f{i}\"\ninitial = {}\n", 0.1 * wave(i));
    }
    let rope = closed(compiled(&bent), Joined::AtPoint, ["f31", "world", "f20", "f4"], "", &[]);
    assert_eq!(rope.solver, Solver::Spatial);
    let sprung = fields(["f23", "f10"]);
    let (at_point, in_plane, welded) = (Joined::AtPoint, Joined::InPlane, Joined::Welded);
    let dragged = |model, frames, more| closed(model, Joined::Dragged, frames, more, &["f3"]);
    for model in [
        rope,
        closed(branches("damping = 0.3"), at_point, ["f21", "f22", "f17", "world"], "", &[]),
        closed(branches(""), at_point, ["f21", "world", "f17", "f12"], &sprung, &["f2", "f9"]),
        closed(branches(""), in_plane, ["f21", "f12", "f17", "f22"], &sprung, &["f2", "f9"]),
        closed(branches(""), welded, ["f21", "f12", "f17", "f22"], &sprung, &["f2"]),
        closed(compiled(&bent), welded, ["f31", "world", "f20", "f4"], "", &["f3"]),
        dragged(compiled(&bent), ["f31", "world", "f20", "f4"], ""),
        dragged(branches(""), ["f21", "f12", "f17", "f22"], &sprung),
        dragged(floating(), ["f8", "f7", "f6", "world"], ""),
        closed(floating(), welded, ["f8", "f7", "f6", "world"], "", &[]),
        closed(floating(), at_point, ["f8", "f7", "f6", "world"], "", &[]),
        closed(floating(), in_plane, ["f8", "f7", "f6", "world"], "", &[]),
        closed(floating(), at_point, ["f6", "world", "f8", "f7"], "", &ball),
    ] {
        move_alike(&Arc::new(model), 50);
    }
}

/// Steps and linearizations in all registers that the processor has, from the same start: few joints and many, hinges
/// and ball joints, entry by entry and by generators.
#[test]
fn all_registers_give_the_same_motion() {
    let named = |name: &str| Model::compile(&builtin::scene(name).unwrap()).unwrap();
    let rope = compiled(&rope(20, ""));
    let swung = pulled(&rope, ["f19", "f9"], "", &[]);
    let models = [floating(), named("spherical-pendulum"), named("tree-15"), rope, swung];
    for model in models.map(Arc::new) {
        let motion = |registers| {
            within(registers, || {
                let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
                let (q, n) = (plant.state.q.clone(), model.dimensions.coordinates());
                let v = (0..n).map(|i| wave(i + 3)).collect();
                plant.initialize(&Initial::Velocity { q, v }).unwrap();
                let mut linear = Linearization::new(&model);
                let u = vec![0.3; model.dimensions.input()];
                for _ in 0..20 {
                    plant.step_and_linearize(&u, &mut linear).unwrap();
                }
                (plant.state.q.clone(), plant.state.p.clone(), linear.a())
            })
        };
        let widest = motion(AVX512);
        assert!(widest == motion(AVX2) && widest == motion(PORTABLE), "{}", model.plan());
    }
}

#[test]
fn a_vanishing_pivot_is_named() {
    // A hinge that turns nothing but a point on its axis.
    let idle = "[[frames]]\nname = \"idle\"\nparent = \"f19\"\n\
                joint = { type = \"revolute\", axis = [0.0, 0.0, 1.0] }\nbody = { mass = 1.0 }\n";
    let model = Arc::new(compiled(&rope(20, idle)));
    assert_eq!(model.solver, Solver::Spatial);
    let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
    match plant.step(&[]) {
        Err(StepError::Singular { coordinate, pivot }) => {
            assert_eq!(coordinate, "idle");
            assert!(pivot < 1e-13, "{pivot}");
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn generators_are_chosen_where_they_stand_for_the_matrix() {
    let solver = |more: &str| compiled(&rope(32, more)).solver;
    let spring = "[[springs]]\ntype = \"coordinate\"\ncoordinate = \"f3\"\nstiffness = 30.0\n";
    assert_eq!(solver(spring), Solver::Spatial);
    assert!(compiled(&rope(32, "")).plan().contains("by generators, 32 joints"));
    let on_a_sum = "[[springs]]\ntype = \"linear_spring\"\nterms = [{ coordinate = \"f3\", coefficient = 1.0 }, { coordinate = \"f9\", coefficient = 1.0 }]\nstiffness = 30.0\n";
    let ball = "[[frames]]\nname = \"ball\"\nparent = \"f31\"\njoint = { type = \"ball\" }\n\
                body = { mass = 1.0, inertia = [1.0, 1.0, 1.0] }\n";
    assert_eq!(solver(ball), Solver::Spatial);
    let prescribed = "[[coordinates]]\nname = \"f0\"\nkind = \"prescribed\"\n";
    assert_eq!(solver(prescribed), Solver::Spatial);
    // A chain in a plane, but for what moves it.
    let mut chain = builtin::scene("chain-32").unwrap();
    assert_eq!(Model::compile(&chain).unwrap().solver, Solver::Planar);
    chain.inputs.clear();
    chain.coordinates[0].kind = CoordinateKind::Prescribed;
    assert_eq!(Model::compile(&chain).unwrap().solver, Solver::Spatial);
    assert_eq!(solver(on_a_sum), Solver::Spatial);
    for bushy in ["tree-30", "marionette", "spherical-pendulum"] {
        let model = Model::compile(&builtin::scene(bushy).unwrap()).unwrap();
        assert_eq!(model.solver, Solver::Tree, "{bushy}");
    }
}
