//! The linearization of a step against sixth-order central differences of the step itself.

use nalgebra::DVector;
use plantd_models::{Initial, Linearization, Plant, Scene, Settings, State, StepDerivative};

use super::{SPLITS, STENCIL, plant, wave, waving_input};

/// Of the differences, relative to the largest entry of a block: what their own round-off leaves.
const TOLERANCE: f64 = 1e-8;

/// Where a step ends, beyond `from`, with its momentum and multipliers.
fn step(plant: &mut Plant, x: &State, u: &[f64], from: &[f64]) -> [Vec<f64>; 3] {
    let initial = Initial::Momentum { q: x.q.clone(), p: x.p.clone(), v: x.v.clone() };
    plant.initialize(&initial).unwrap();
    plant.step(u).unwrap();
    let beyond = plant.model().difference(from, plant.q());
    [beyond, plant.p().to_vec(), plant.multipliers().to_vec()]
}

/// Derivative at 0 of what `along` makes of a displacement.
fn slope(delta: f64, mut along: impl FnMut(f64) -> [Vec<f64>; 3]) -> [Vec<f64>; 3] {
    let mut sum: [Vec<f64>; 3] = Default::default();
    for (offset, weight) in STENCIL {
        for (sum, value) in sum.iter_mut().zip(along(offset * delta)) {
            sum.resize(value.len(), 0.0);
            sum.iter_mut().zip(value).for_each(|(s, x)| *s += weight / delta * x);
        }
    }
    sum
}

/// One linearization, and what is compared with it.
struct Check {
    plant: Plant,
    x: State,
    u: Vec<f64>,
    /// Configuration at the end of the step.
    end: Vec<f64>,
    out: Linearization,
    name: String,
    /// Of displacements, relative to the usual ones.
    reach: f64,
}

impl Check {
    /// About a state in full motion.
    fn new(scene: &Scene, settings: impl FnOnce(&mut Settings), reach: f64) -> Self {
        let mut plant = plant(scene, settings);
        wave(&mut plant, 20);
        // Signals begin again where a state is given.
        let x = plant.state();
        plant.initialize(&Initial::Momentum { q: x.q, p: x.p, v: x.v }).unwrap();
        let x = plant.state();
        let u = waving_input(&plant, 23);
        let mut out = Linearization::new(&plant.model().clone());
        plant.linearize(&u, &mut out).unwrap();
        assert_eq!(plant.state(), x, "linearize must stay");
        let mut products = StepDerivative::new(&plant.model().clone());
        plant.differentiate(&u, &mut products).unwrap();
        assert_eq!(plant.state(), x, "differentiate must stay");
        plant.step(&u).unwrap();
        let end = plant.q().to_vec();
        let Settings { order, substeps, force_split, .. } = plant.settings();
        let name = format!("{}, {force_split:?}, order {order} x {substeps}", scene.name);
        compare_products(&name, &out, &mut products);
        Self { plant, x, u, end, out, name, reach }
    }

    /// The step with a change of the state, and of the input.
    fn changed(&mut self, column: usize, s: f64) -> [Vec<f64>; 3] {
        let model = self.plant.model().clone();
        let (d, n) = (model.dimensions(), model.dimensions().coordinates());
        let (mut x, mut u) = (self.x.clone(), self.u.clone());
        let mut change = vec![0.0; n];
        match column {
            c if c < n => {
                change[c] = s;
                x.q = model.retract(&x.q, &change);
            }
            c if c < d.state() => *x.p.iter_mut().chain(&mut x.v).nth(c - n).unwrap() += s,
            c if c < d.state() + d.inputs => u[c - d.state()] += s,
            c => {
                change[d.dynamic + c - d.state() - d.inputs] = s;
                let end = model.retract(&self.end, &change);
                u[d.inputs..].copy_from_slice(&end[d.dynamic..]);
            }
        }
        step(&mut self.plant, &x, &u, &self.end)
    }

    /// What the linearization says: the same three vectors for a displacement of `x` and `u`.
    fn predicted(&self, dx: &[f64], du: &[f64]) -> [Vec<f64>; 3] {
        let d = self.plant.model().dimensions();
        let (dx, du) =
            (nalgebra::DVector::from_row_slice(dx), nalgebra::DVector::from_row_slice(du));
        let x = self.out.a() * &dx + self.out.b() * &du;
        let multipliers = self.out.multipliers_x() * dx + self.out.multipliers_u() * du;
        let n = d.coordinates();
        let rows = |range: std::ops::Range<usize>| x.as_slice()[range].to_vec();
        [rows(0..n), rows(n..n + d.dynamic), multipliers.as_slice().to_vec()]
    }

    /// What the round-off of a step is in differences: a small part of the steepest slope.
    fn noise(&self) -> [f64; 3] {
        let d = self.plant.model().dimensions();
        let (a, b, n) = (self.out.a(), self.out.b(), d.coordinates());
        let rows = |from, count| a.rows(from, count).amax().max(b.rows(from, count).amax());
        let multipliers = self.out.multipliers_x().amax().max(self.out.multipliers_u().amax());
        [rows(0, n), rows(n, d.dynamic), multipliers]
            .map(|slope| (1e-11 + 1e-12 * slope) / self.reach)
    }

    fn compare(&self, what: &str, found: [Vec<f64>; 3], predicted: [Vec<f64>; 3], tolerance: f64) {
        let noise = self.noise();
        for (((part, found), predicted), noise) in
            ["q", "p", "λ"].iter().zip(found).zip(predicted).zip(noise)
        {
            let scale = found.iter().fold(0.0_f64, |a, x| a.max(x.abs()));
            for (i, (x, y)) in predicted.iter().zip(&found).enumerate() {
                let error = (x - y).abs();
                let allowed = tolerance * scale + noise;
                let name = &self.name;
                assert!(error <= allowed, "{name}: ∂{part}[{i}]/∂{what} is {x}, differences {y}");
            }
        }
    }

    /// Every column; those of `q` only where displaced configurations are allowed.
    fn columns(&mut self) {
        let d = self.plant.model().dimensions();
        let n = d.coordinates();
        let first = if d.constraints == 0 { 0 } else { n };
        for column in first..d.state() {
            // A momentum is changed by what moves coordinates by two thousandths, whatever the masses.
            let mobility = self.out.a().view((0, column), (n, 1)).amax();
            let delta = self.reach * if column < n { 1e-3 } else { (2e-3 / mobility).min(0.1) };
            let found = slope(delta, |s| self.changed(column, s));
            let mut dx = vec![0.0; d.state()];
            dx[column] = 1.0;
            let predicted = self.predicted(&dx, &vec![0.0; d.input()]);
            self.compare(&format!("x[{column}]"), found, predicted, TOLERANCE);
        }
        for column in 0..d.input() {
            let delta = if column < d.inputs { 1e-1 } else { self.reach * 1e-3 };
            let found = slope(delta, |s| self.changed(d.state() + column, s));
            let mut du = vec![0.0; d.input()];
            du[column] = 1.0;
            let predicted = self.predicted(&vec![0.0; d.state()], &du);
            self.compare(&format!("u[{column}]"), found, predicted, TOLERANCE);
        }
    }

    fn all(&mut self) {
        self.columns();
        if self.plant.model().dimensions().constraints > 0 {
            self.manifold();
        }
    }

    /// Along curves on the constraint manifold, whose own slope is found by the same differences.
    fn manifold(&mut self) {
        let d = self.plant.model().dimensions();
        for direction in 0..d.coordinates() {
            let on_manifold = |check: &mut Self, s: f64| {
                let model = check.plant.model().clone();
                let mut change = vec![0.0; d.coordinates()];
                change[direction] = s;
                let q = model.retract(&check.x.q, &change);
                check.plant.initialize(&Initial::Projection { q, hold: Vec::new() }).unwrap();
                State { q: check.plant.q().to_vec(), ..check.x.clone() }
            };
            let [dq, ..] = slope(1e-3, |s| {
                let moved = on_manifold(self, s).q;
                [self.plant.model().difference(&self.x.q, &moved), Vec::new(), Vec::new()]
            });
            let found = slope(1e-3, |s| {
                let x = on_manifold(self, s);
                step(&mut self.plant, &x, &self.u, &self.end)
            });
            let mut dx = dq;
            dx.resize(d.state(), 0.0);
            let predicted = self.predicted(&dx, &vec![0.0; d.input()]);
            self.compare(&format!("direction {direction}"), found, predicted, 10.0 * TOLERANCE);
        }
    }
}

/// Products with the matrices and with their transposes, without them.
fn compare_products(name: &str, out: &Linearization, products: &mut StepDerivative) {
    let (a, b) = (out.a(), out.b());
    let wave = |count, phase: f64| DVector::from_fn(count, |i, _| (1.3 * i as f64 + phase).sin());
    let (x, u, z) = (wave(a.ncols(), 0.2), wave(b.ncols(), 0.7), wave(a.nrows(), 1.1));
    let close = |what: &str, found: &[f64], expected: DVector<f64>, sizes: DVector<f64>| {
        for (i, (found, expected)) in found.iter().zip(&expected).enumerate() {
            let error = (found - expected).abs();
            assert!(error <= 1e-11 * sizes.amax(), "{name}: {what}[{i}] {found}, {expected}");
        }
    };
    let mut next = vec![f64::NAN; a.nrows()];
    products.push_forward(x.as_slice(), u.as_slice(), &mut next);
    close("A x + B u", &next, &a * &x + &b * &u, a.abs() * x.abs() + b.abs() * u.abs());
    let (mut by_x, mut by_u) = (vec![f64::NAN; a.ncols()], vec![f64::NAN; b.ncols()]);
    products.pull_back(z.as_slice(), &mut by_x, &mut by_u);
    close("Aᵀ z", &by_x, a.tr_mul(&z), a.abs().tr_mul(&z.abs()));
    close("Bᵀ z", &by_u, b.tr_mul(&z), b.abs().tr_mul(&z.abs()));
}

/// Checks every column, for both ways to split forces.
pub(crate) fn check(scene: &Scene) {
    check_within(scene, 1.0);
}

/// The same with smaller displacements, for forces that bend sharply.
pub(crate) fn check_within(scene: &Scene, reach: f64) {
    for split in SPLITS {
        Check::new(scene, |settings| settings.force_split = split, reach).all();
    }
}

/// The same with any settings.
pub(crate) fn check_with(scene: &Scene, settings: impl FnOnce(&mut Settings)) {
    Check::new(scene, settings, 1.0).all();
}
