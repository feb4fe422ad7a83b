//! The second-order linearization against sixth-order central differences of the first-order one, and
//! its contraction against its tensors.

use crate::common::{
    SPLITS, builtin, elements_with_coordinates, floating, methods, plant, random_tree, slope, wave,
    waving_input,
};
use nalgebra::DMatrix;
use plantd_models::scene::{Point, Spring};
use plantd_models::{
    Contraction, ForceSplit, Initial, Linearization, Model, Plant, Scene, SecondOrder, Settings,
    State, StepError,
};

/// Of the differences, relative to the largest entry of an output: what their own round-off leaves.
const TOLERANCE: f64 = 1e-7;

/// `A` and `B` beside each other, the derivatives of the multipliers below.
fn first_derivatives(out: &Linearization) -> DMatrix<f64> {
    let (a, b) = (out.a(), out.b());
    let (rows, columns) = (a.nrows(), a.ncols());
    let (by_x, by_u) = (out.multipliers_x(), out.multipliers_u());
    let mut all = DMatrix::zeros(rows + by_x.nrows(), columns + b.ncols());
    all.view_mut((0, 0), a.shape()).copy_from(&a);
    all.view_mut((0, columns), b.shape()).copy_from(&b);
    all.view_mut((rows, 0), by_x.shape()).copy_from(&by_x);
    all.view_mut((rows, columns), by_u.shape()).copy_from(&by_u);
    all
}

/// The matrix of second derivatives of each output, then of each multiplier, by `(x, u)`.
fn tensors(model: &Model, second: &SecondOrder) -> Vec<DMatrix<f64>> {
    let d = model.dimensions();
    let outputs = (0..d.state()).map(|i| whole(&second.xx(i), &second.xu(i), &second.uu(i)));
    let multipliers = (0..d.constraints).map(|c| {
        whole(&second.multiplier_xx(c), &second.multiplier_xu(c), &second.multiplier_uu(c))
    });
    outputs.chain(multipliers).collect()
}

fn whole(xx: &DMatrix<f64>, xu: &DMatrix<f64>, uu: &DMatrix<f64>) -> DMatrix<f64> {
    let (state, input) = xu.shape();
    let mut all = DMatrix::zeros(state + input, state + input);
    all.view_mut((0, 0), xx.shape()).copy_from(xx);
    all.view_mut((0, state), xu.shape()).copy_from(xu);
    all.view_mut((state, 0), (input, state)).copy_from(&xu.transpose());
    all.view_mut((state, state), uu.shape()).copy_from(uu);
    all
}

/// One second-order linearization, and what is compared with it.
struct Check {
    plant: Plant,
    x: State,
    u: Vec<f64>,
    first: Linearization,
    tensors: Vec<DMatrix<f64>>,
    name: String,
}

impl Check {
    /// About a state in full motion.
    fn new(scene: &Scene, split: ForceSplit) -> Self {
        Self::with(scene, |settings| settings.force_split = split)
    }

    fn with(scene: &Scene, settings: impl FnOnce(&mut Settings)) -> Self {
        let mut plant = plant(scene, settings);
        wave(&mut plant, 20);
        let u = waving_input(&plant, 23);
        Self::at(plant, u)
    }

    fn at(mut plant: Plant, u: Vec<f64>) -> Self {
        // Signals begin again where a state is given.
        let State { q, p, v, .. } = plant.state();
        plant.initialize(&Initial::Momentum { q, p, v }).unwrap();
        let x = plant.state();
        let model = plant.model().clone();
        let mut first = Linearization::new(&model);
        let mut second = SecondOrder::new(&model).unwrap();
        plant.linearize_second_order(&u, &mut first, &mut second).unwrap();
        assert_eq!(plant.state(), x, "a linearization must stay");
        let tensors = tensors(&model, &second);
        let Settings { order, substeps, force_split, .. } = plant.settings();
        let name = format!("{}, {force_split:?}, order {order} x {substeps}", model.scene().name);
        Self { plant, x, u, first, tensors, name }
    }

    fn first_derivatives_at(&mut self, x: &State, u: &[f64]) -> DMatrix<f64> {
        let initial = Initial::Momentum { q: x.q.clone(), p: x.p.clone(), v: x.v.clone() };
        self.plant.initialize(&initial).unwrap();
        let mut out = self.first.clone();
        self.plant.linearize(u, &mut out).unwrap();
        first_derivatives(&out)
    }

    /// Differences of the first derivatives along a direction `(dx, du)`.
    fn compare(&self, what: &str, found: &[f64], direction: &[f64], delta: f64, tolerance: f64) {
        let first = first_derivatives(&self.first);
        let found = DMatrix::from_column_slice(first.nrows(), first.ncols(), found);
        let direction = nalgebra::DVector::from_row_slice(direction);
        for (output, tensor) in self.tensors.iter().enumerate() {
            let predicted = tensor * &direction;
            let found = found.row(output).transpose();
            let noise = 1e-13 / delta * (1.0 + first.row(output).amax());
            let allowed = tolerance * found.amax() + noise;
            let error = (&predicted - &found).amax();
            let name = &self.name;
            assert!(
                error <= allowed,
                "{name}: output {output} along {what}: error {error:e} > {allowed:e}\n\
                 {predicted}{found}"
            );
        }
    }

    /// Along every parameter; along those of `q` only where displaced configurations are allowed.
    fn columns(&mut self) {
        let d = self.plant.model().dimensions();
        let n = d.coordinates();
        let start = if d.constraints == 0 { 0 } else { n };
        for column in start..d.state() + d.input() {
            let delta = match column {
                c if c < n => 1e-3,
                // A momentum is changed by what moves coordinates by two thousandths.
                c if c < d.state() => (2e-3 / self.first.a().view((0, c), (n, 1)).amax()).min(0.1),
                c if c < d.state() + d.inputs => 1e-1,
                _ => 1e-3,
            };
            let found = slope(delta, |s| {
                let (mut x, mut u) = (self.x.clone(), self.u.clone());
                let parts = [&mut x.q[..], &mut x.p, &mut x.v, &mut u];
                *parts.into_iter().flatten().nth(column).unwrap() += s;
                self.first_derivatives_at(&x, &u).as_slice().to_vec()
            });
            let mut direction = vec![0.0; d.state() + d.input()];
            direction[column] = 1.0;
            self.compare(&format!("parameter {column}"), &found, &direction, delta, TOLERANCE);
        }
    }

    /// Along curves on the constraint manifold, whose own slope is found by the same differences.
    fn manifold(&mut self) {
        let d = self.plant.model().dimensions();
        for coordinate in 0..d.coordinates() {
            let on_manifold = |check: &mut Self, s: f64| {
                let mut q = check.x.q.clone();
                q[coordinate] += s;
                check.plant.initialize(&Initial::Projection { q, hold: Vec::new() }).unwrap();
                State { q: check.plant.q().to_vec(), ..check.x.clone() }
            };
            let mut direction = slope(1e-3, |s| on_manifold(self, s).q);
            direction.resize(d.state() + d.input(), 0.0);
            let found = slope(1e-3, |s| {
                let x = on_manifold(self, s);
                let u = self.u.clone();
                self.first_derivatives_at(&x, &u).as_slice().to_vec()
            });
            let what = format!("coordinate {coordinate} and the constraints");
            self.compare(&what, &found, &direction, 1e-3, 10.0 * TOLERANCE);
        }
    }

    fn symmetry(&self) {
        for (output, tensor) in self.tensors.iter().enumerate() {
            assert_eq!(tensor, &tensor.transpose(), "{}: output {output}", self.name);
        }
    }

    /// The contraction is the weighted sum of the tensors.
    fn contraction(&mut self) {
        let model = self.plant.model().clone();
        let d = model.dimensions();
        let mut out = Contraction::new(&model);
        let (x, u) = (self.x.clone(), self.u.clone());
        let initial = Initial::Momentum { q: x.q.clone(), p: x.p.clone(), v: x.v.clone() };
        self.plant.initialize(&initial).unwrap();
        let mut first = self.first.clone();
        let outputs = d.state() + d.constraints;
        // All outputs together, then a few on their own.
        for only in [None, Some(0), Some(d.coordinates()), Some(outputs - 1)] {
            let weight = |i: usize| match only {
                None => (i as f64 + 1.0).sin(),
                Some(output) => f64::from(u8::from(i == output)),
            };
            let weights: Vec<f64> = (0..outputs).map(weight).collect();
            let (z, w) = weights.split_at(d.state());
            self.plant.contract_second_order(&u, z, w, &mut first, &mut out).unwrap();
            let found = whole(&out.xx, &out.xu, &out.uu);
            let mut expected = DMatrix::zeros(found.nrows(), found.ncols());
            let mut size = 0.0;
            for (weight, tensor) in weights.iter().zip(&self.tensors) {
                expected += tensor * *weight;
                size += weight.abs() * tensor.amax();
            }
            let error = (&found - &expected).amax();
            let name = &self.name;
            assert!(error <= 1e-10 * size + 1e-14, "{name}, {only:?}: {error:e} of {size:e}");
        }
    }
}

/// The second-order linearization with any settings.
pub(crate) fn check_with(scene: &Scene, settings: impl FnOnce(&mut Settings)) {
    Check::with(scene, settings).all();
}

fn check(scene: &Scene) {
    for split in SPLITS {
        Check::new(scene, split).all();
    }
}

impl Check {
    fn all(&mut self) {
        self.symmetry();
        self.contraction();
        self.columns();
        if self.plant.model().dimensions().constraints > 0 {
            self.manifold();
        }
    }
}

/// The numbers printed in the paper for one step of the pendulum.
#[test]
fn pendulum_of_the_paper() {
    let mut plant = plant(&builtin("pendulum"), |s| s.force_split = ForceSplit::Paper);
    plant.initialize(&Initial::Momentum { q: vec![0.2], p: vec![0.5], v: vec![] }).unwrap();
    let model = plant.model().clone();
    let mut first = Linearization::new(&model);
    let mut second = SecondOrder::new(&model).unwrap();
    plant.linearize_second_order(&[0.8], &mut first, &mut second).unwrap();
    // qq, qp, qu, pp, pu, uu
    let printed = [
        [1.01210e-2, 5.06048e-4, 5.06048e-5, 2.53024e-5, 2.53024e-6, 2.53024e-7],
        [0.2024192, 1.01210e-2, 1.01210e-3, 5.06048e-4, 5.06048e-5, 5.06048e-6],
    ];
    for (output, printed) in printed.iter().enumerate() {
        let (xx, xu, uu) = (second.xx(output), second.xu(output), second.uu(output));
        let found = [xx[(0, 0)], xx[(0, 1)], xu[(0, 0)], xx[(1, 1)], xu[(1, 0)], uu[(0, 0)]];
        for (found, printed) in found.iter().zip(printed) {
            assert!((found / printed - 1.0).abs() < 5e-6, "{found} instead of {printed}");
        }
    }
}

#[test]
fn unconstrained_builtin_scenes() {
    for name in ["pendulum", "damped-pendulum", "double-pendulum", "cart-pole", "chain-8"] {
        check(&builtin(name));
    }
    check(&builtin("spherical-pendulum"));
}

#[test]
fn closed_loops() {
    check(&builtin("four-bar"));
    check(&builtin("scissor-3"));
}

#[test]
fn marionette_with_driven_strings() {
    check(&builtin("marionette"));
}

#[test]
fn floating_body_with_a_spring_across_its_arms() {
    check(&floating());
}

/// Oblique joints, full inertia tensors, springs across branches, prescribed joints inside.
#[test]
fn random_trees() {
    for seed in 0..24 {
        check(&random_tree(seed));
    }
}

/// Forces of every kind.
#[test]
fn random_trees_with_forces() {
    for seed in 100..108 {
        let mut check = Check::new(&crate::common::forced_tree(seed), ForceSplit::Symmetric);
        check.symmetry();
        check.contraction();
    }
}

/// Higher orders and substeps, with forces, prescribed joints and constraints.
#[test]
fn every_order_and_substeps() {
    let builtins = ["damped-pendulum", "cart-pole", "four-bar"].map(builtin);
    let forces = ["drag", "thruster", "two-point-damper", "spatial-wrench"];
    let mut elements = elements_with_coordinates();
    elements.retain(|scene| forces.contains(&scene.name.as_str()));
    assert_eq!(elements.len(), forces.len());
    let trees = [1, 2].map(random_tree);
    for scene in builtins.into_iter().chain(trees).chain(elements) {
        for settings in methods(&scene) {
            Check::with(&scene, |s| *s = settings).all();
        }
    }
}

#[test]
fn scenes_of_elements() {
    for scene in elements_with_coordinates() {
        check(&scene);
    }
}

/// A spring without a rest length is smooth even where its ends meet: at rest on the anchor.
#[test]
fn spring_whose_ends_meet() {
    let mut scene = builtin("double-pendulum");
    scene.gravity = Some([0.0; 3]);
    scene.coordinates.clear();
    scene.springs.push(Spring::TwoPoint {
        a: Point { frame: "forearm".to_owned(), at: [1.0, 0.0, 0.0] },
        b: Point { frame: "world".to_owned(), at: [1.0, 0.0, -1.0] },
        stiffness: 20.0,
        rest_length: 0.0,
    });
    let inputs = scene.inputs.len();
    Check::at(plant(&scene, |_| ()), vec![0.0; inputs]).columns();
}

#[test]
fn large_models_are_refused_by_size() {
    let model = crate::common::model(&builtin("chain-300"));
    let error = SecondOrder::new(&model).unwrap_err();
    assert!(error.entries > 1 << 27, "{error}");
    let mut plant = plant(&builtin("chain-300"), |_| ());
    let d = model.dimensions();
    let mut u = vec![0.0; d.input()];
    plant.hold_input(&mut u);
    let (mut first, mut out) = (Linearization::new(&model), Contraction::new(&model));
    let z = vec![1.0; d.state()];
    plant.contract_second_order(&u, &z, &[], &mut first, &mut out).unwrap();
}

#[test]
fn weights_of_the_wrong_length_are_refused() {
    let mut plant = plant(&builtin("four-bar"), |_| ());
    let model = plant.model().clone();
    let d = model.dimensions();
    let (mut first, mut out) = (Linearization::new(&model), Contraction::new(&model));
    let mut u = vec![0.0; d.input()];
    plant.hold_input(&mut u);
    let (z, w) = (vec![0.0; d.state()], vec![0.0; d.constraints]);
    for (z, w) in [(&z[1..], &w[..]), (&z[..], &w[1..])] {
        let refused = plant.contract_second_order(&u, z, w, &mut first, &mut out);
        assert!(matches!(refused, Err(StepError::Dimension { .. })), "{refused:?}");
    }
}

#[test]
fn a_linearization_is_contracted_wherever_the_plant_is_meanwhile() {
    for name in ["pendulum", "four-bar", "marionette"] {
        let mut plant = plant(&builtin(name), |_| ());
        let model = plant.model().clone();
        let d = model.dimensions();
        let z: Vec<f64> = (0..d.state()).map(|i| (i as f64).cos()).collect();
        let w: Vec<f64> = (0..d.constraints).map(|c| (c as f64).sin()).collect();
        let mut u = vec![0.0; d.input()];
        plant.hold_input(&mut u);
        let mut first = Linearization::new(&model);
        let (mut there, mut later) = (Contraction::new(&model), Contraction::new(&model));
        plant.contract_second_order(&u, &z, &w, &mut first, &mut there).unwrap();
        let mut first = Linearization::new(&model);
        plant.step_and_linearize(&u, &mut first).unwrap();
        plant.step(&u).unwrap();
        later.contract(&model, &first, &z, &w).unwrap();
        assert_eq!((&there.xx, &there.xu, &there.uu), (&later.xx, &later.xu, &later.uu), "{name}");
        assert!(there.xx.amax() > 0.0, "{name}");
    }
}
