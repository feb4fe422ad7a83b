//! The marionette experiment of the paper, in process: reference motion, linearization along it,
//! time-varying LQR, then the perturbed run with and without feedback. Its numbers come from the
//! paper's reference implementation (`tests/reference`).

use std::f64::consts::PI;
use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use plantd_control::{
    FiniteHorizon, Sample, Tangent, Values, Weights, controllability_rank, finite_horizon,
    finite_horizon_on_manifold, infinite_horizon, infinite_horizon_on_manifold,
};
use plantd_models::{ForceSplit, Initial, Linearization, Model, Plant, Settings, builtin};
use serde_json::Value;

const TIME_STEP_S: f64 = 0.01;
const STEPS: usize = 1001;

fn golden() -> Value {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/reference/golden/marionette_closed_loop.json");
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn numbers(value: &Value) -> Vec<f64> {
    serde_json::from_value(value.clone()).unwrap()
}

fn marionette() -> Plant {
    let model = Model::compile(&builtin::scene("marionette").unwrap()).unwrap();
    let settings = Settings {
        time_step_s: TIME_STEP_S,
        force_split: ForceSplit::Paper,
        ..Settings::new(&model)
    };
    Plant::new(Arc::new(model), settings).unwrap()
}

/// The reference: states, inputs, linearizations and tangent spaces along it.
struct Reference {
    plant: Plant,
    states: Vec<DVector<f64>>,
    inputs: Vec<Vec<f64>>,
    samples: Vec<Sample>,
    tangents: Vec<Tangent>,
}

impl Reference {
    fn new() -> Self {
        let mut plant = marionette();
        let model = plant.model().clone();
        let dynamic = model.dimensions().dynamic;
        let q: Vec<f64> = model.coordinates().iter().map(|c| c.initial).collect();
        let inputs = inputs(&model);
        plant.initialize(&Initial::TwoConfigurations { q0: q.clone(), q1: q }).unwrap();
        let mut linearization = Linearization::new(&model);
        let (mut states, mut samples, mut tangents) = (vec![], vec![], vec![]);
        for u in &inputs {
            states.push(x(&plant));
            tangents.push(Tangent::new(&plant.constraint_jacobian(), dynamic));
            plant.step_and_linearize(u, &mut linearization).unwrap();
            samples.push(Sample { a: linearization.a(), b: linearization.b() });
        }
        states.push(x(&plant));
        tangents.push(Tangent::new(&plant.constraint_jacobian(), dynamic));
        Self { plant, states, inputs, samples, tangents }
    }

    /// The state that the first input, held, leads to: where the runs start.
    fn perturbed(&mut self) -> DVector<f64> {
        self.start(&self.states[0].clone());
        for _ in 0..STEPS {
            self.plant.step(&self.inputs[0]).unwrap();
        }
        x(&self.plant)
    }

    fn start(&mut self, x: &DVector<f64>) {
        let dimensions = self.plant.model().dimensions();
        let (q, rest) = x.as_slice().split_at(dimensions.coordinates());
        let (p, v) = rest.split_at(dimensions.dynamic);
        let initial = Initial::Momentum { q: q.to_vec(), p: p.to_vec(), v: v.to_vec() };
        self.plant.initialize(&initial).unwrap();
    }

    /// `‖q − q_ref‖` of the dynamic coordinates at each step of a run from `start`.
    fn errors(&mut self, start: &DVector<f64>, gains: Option<&[DMatrix<f64>]>) -> Vec<f64> {
        self.start(start);
        let dynamic = self.plant.model().dimensions().dynamic;
        let mut errors = vec![];
        for k in 0..=STEPS {
            let error = x(&self.plant) - &self.states[k];
            errors.push(error.rows(0, dynamic).norm());
            if k < STEPS {
                let mut u = DVector::from_column_slice(&self.inputs[k]);
                if let Some(gains) = gains {
                    u -= &gains[k] * error;
                }
                self.plant.step(u.as_slice()).unwrap();
            }
        }
        errors
    }
}

fn x(plant: &Plant) -> DVector<f64> {
    DVector::from_vec(plant.state().x())
}

fn inputs(model: &Model) -> Vec<Vec<f64>> {
    let dynamic = model.dimensions().dynamic;
    let held: Vec<f64> = model.coordinates()[dynamic..].iter().map(|c| c.initial).collect();
    let column = |name: &str| {
        let index = model.coordinates().iter().position(|c| c.name == name);
        index.unwrap_or_else(|| panic!("no coordinate {name}")) - dynamic
    };
    let moving = [
        ("left_leg_string_length", -1.0),
        ("right_leg_string_length", 1.0),
        ("left_arm_string_length", 1.0),
        ("right_arm_string_length", -1.0),
    ];
    let mut rows = vec![held; STEPS];
    for (name, sign) in moving {
        let column = column(name);
        for (k, row) in rows.iter_mut().enumerate() {
            row[column] += sign * 0.1 * (0.6 * PI * k as f64 * TIME_STEP_S).sin();
        }
    }
    rows
}

/// 100 for configurations, 1 for momenta, velocities and inputs.
fn weights(model: &Model) -> Weights {
    let dimensions = model.dimensions();
    let mut q = vec![100.0; dimensions.coordinates()];
    q.resize(dimensions.state(), 1.0);
    Weights::diagonal(&q, &vec![1.0; dimensions.input()]).unwrap()
}

fn assert_close(name: &str, actual: f64, expected: f64, tolerance: f64) {
    let error = (actual / expected - 1.0).abs();
    println!("{name}: {actual:.15}, reference {expected:.15}, relative difference {error:.1e}");
    assert!(error < tolerance, "{name}: {actual} is not {expected}");
}

#[test]
fn the_experiment_reproduces_in_its_plain_form() {
    let golden = golden();
    let number = |key: &str| golden[key].as_f64().unwrap();
    let mut reference = Reference::new();
    for (k, sample) in reference.samples.iter().enumerate() {
        let (a, b) = (&golden["A_frobenius"][k], &golden["B_frobenius"][k]);
        assert!((sample.a.norm() / a.as_f64().unwrap() - 1.0).abs() < 1e-9, "A of step {k}");
        assert!((sample.b.norm() / b.as_f64().unwrap() - 1.0).abs() < 1e-9, "B of step {k}");
    }
    let weights = weights(reference.plant.model());
    let FiniteHorizon { gains, value, .. } =
        finite_horizon(&reference.samples, &weights.into(), Values::Drop).unwrap();
    assert_close("first gain", gains[0].norm(), number("K0_frobenius"), 1e-10);
    assert_close("first value", value.norm(), number("P0_frobenius"), 1e-10);

    let start = reference.perturbed();
    let expected = DVector::from_vec(numbers(&golden["x0_perturbed"]));
    println!("perturbed state: largest difference {:.1e}", (&start - &expected).amax());
    assert!((&start - &expected).amax() < 1e-8);
    let open: f64 = reference.errors(&start, None).iter().sum();
    let closed: f64 = reference.errors(&start, Some(&gains)).iter().sum();
    assert_close("open loop", open, number("open_loop_error_sum"), 1e-9);
    assert_close("closed loop", closed, number("closed_loop_error_sum"), 1e-9);
}

/// `A` and `B` lead from tangent space to tangent space, gauge momentum changes nothing, and gains
/// solved on the manifold steer as well as those of the plain form without seeing gauge.
#[test]
fn the_manifold_is_invariant_and_its_gains_steer() {
    let mut reference = Reference::new();
    let dimensions = reference.plant.model().dimensions();
    let (nd, nq) = (dimensions.dynamic, dimensions.coordinates());
    let free = nd - dimensions.constraints;
    for k in (0..STEPS).step_by(100) {
        let Reference { samples, tangents, .. } = &reference;
        let (Sample { a, b }, start, end) = (&samples[k], &tangents[k], &tangents[k + 1]);
        // Configuration, momentum, velocities of prescribed coordinates.
        let expected = (free + dimensions.prescribed) + free + dimensions.prescribed;
        assert_eq!(start.dimension(), expected);
        // Momentum may leave its representatives by gauge; configuration may not leave its tangent.
        let off_manifold = |m: &DMatrix<f64>| {
            (m - end.basis() * end.reduce(m)).rows(0, nq).amax() / m.rows(0, nq).amax()
        };
        assert!(off_manifold(&(a * start.basis())) < 1e-12, "A of step {k}");
        assert!(off_manifold(b) < 1e-12, "B of step {k}");
        let gauge = gauge(&mut reference, k);
        let a = &reference.samples[k].a;
        assert!((a * &gauge).norm() < 1e-12 * a.norm() * gauge.norm(), "gauge of step {k}");
    }

    let weights = weights(reference.plant.model());
    let regulator = finite_horizon_on_manifold(
        &reference.samples,
        &reference.tangents,
        &weights.into(),
        Values::Drop,
    )
    .unwrap();
    let gauge = gauge(&mut reference, 0);
    let seen = (&regulator.gains[0] * &gauge).norm() / gauge.norm();
    assert!(seen < 1e-12 * regulator.gains[0].norm());
    let start = reference.perturbed();
    let open: f64 = reference.errors(&start, None).iter().sum();
    let closed: f64 = reference.errors(&start, Some(&regulator.gains)).iter().sum();
    println!("open loop {open}, closed loop on the manifold {closed}");
    assert!(closed < 0.4 * open);
}

/// `(0, Dh_dᵀ, 0)` at the state of step `k`: momentum that the multipliers absorb.
fn gauge(reference: &mut Reference, k: usize) -> DMatrix<f64> {
    let dimensions = reference.plant.model().dimensions();
    let (nd, nq) = (dimensions.dynamic, dimensions.coordinates());
    reference.start(&reference.states[k].clone());
    let dh = reference.plant.constraint_jacobian();
    let mut gauge = DMatrix::zeros(dimensions.state(), dimensions.constraints);
    gauge.rows_mut(nq, nd).copy_from(&dh.columns(0, nd).transpose());
    gauge
}

/// The four-bar linkage has one degree of freedom of three coordinates: held by its crank torque,
/// regulated on the manifold, it comes back from a displacement of the crank.
#[test]
fn a_linkage_is_regulated_on_its_manifold() {
    let model = Arc::new(Model::compile(&builtin::scene("four-bar").unwrap()).unwrap());
    let mut plant = Plant::new(model.clone(), Settings::new(&model)).unwrap();
    let mut linearization = Linearization::new(&model);
    let hold = holding_torque(&mut plant, &mut linearization);

    let tangent = Tangent::new(&plant.constraint_jacobian(), model.dimensions().dynamic);
    assert_eq!(tangent.dimension(), 2);
    let (a, b) = (linearization.a(), linearization.b());
    let reduced = (tangent.reduce(&a) * tangent.basis(), tangent.reduce(&b));
    assert_eq!(controllability_rank(&reduced.0, &reduced.1), 2);

    // The same cost on the tangent space, none elsewhere: then the full problem agrees.
    let cost = tangent.basis() * tangent.basis().transpose() * 100.0;
    let weights = Weights::new(cost, DMatrix::identity(1, 1), None).unwrap();
    let regulator = infinite_horizon_on_manifold(&a, &b, &tangent, &weights).unwrap();
    let full = infinite_horizon(&a, &b, &weights).unwrap();
    let difference = (&full.gain - &regulator.gain) * tangent.basis();
    assert!(difference.norm() < 1e-9 * regulator.gain.norm(), "{:e}", difference.norm());
    assert!((full.spectral_radius - regulator.spectral_radius).abs() < 1e-9);

    let at_rest = x(&plant);
    let mut displaced = plant.q().to_vec();
    displaced[0] += 0.1;
    plant
        .initialize(&Initial::Projection { q: displaced, hold: vec!["crank".to_owned()] })
        .unwrap();
    let off = |plant: &Plant| (plant.q()[0] - at_rest[0]).abs();
    assert!(off(&plant) > 0.09);
    for _ in 0..2000 {
        let u = hold - (&regulator.gain * (x(&plant) - &at_rest))[0];
        plant.step(&[u]).unwrap();
    }
    assert!(off(&plant) < 1e-8, "{:e} rad off after 20 s", off(&plant));
}

/// The crank torque that holds the linkage where it is, by Newton's method on the displacement of
/// one step from rest; leaves the linearization there.
fn holding_torque(plant: &mut Plant, linearization: &mut Linearization) -> f64 {
    let mut torque = 0.0;
    for _ in 0..8 {
        plant.initialize(&Initial::Scene).unwrap();
        let before = plant.q()[0];
        plant.step_and_linearize(&[torque], linearization).unwrap();
        torque -= (plant.q()[0] - before) / linearization.b()[(0, 0)];
    }
    plant.initialize(&Initial::Scene).unwrap();
    plant.linearize(&[torque], linearization).unwrap();
    torque
}
