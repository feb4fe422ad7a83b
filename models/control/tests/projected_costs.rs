//! Costs on the projected momentum: against differences, motions, and the orders of their accuracy.

use crate::common::{builtin, plant, slope, wave, waving_input};
use nalgebra::{DMatrix, DVector};
use plantd_control::optimize::{Bounds, OptimizeError, Optimizer, Options, Status, TrajectoryCost};
use plantd_control::{
    Momentum, Sample, Tangent, TrajectoryWeights, Values, Weights, WeightsError,
    finite_horizon_on_manifold, infinite_horizon_on_manifold,
};
use plantd_models::{Initial, Linearization, Plant};

/// A motion with inputs that wave, to be followed with inputs that hold still.
struct Follow {
    plant: Plant,
    inputs: DMatrix<f64>,
    guess: DMatrix<f64>,
    cost: TrajectoryCost,
}

impl Follow {
    fn new(name: &str, steps: usize, momentum: Momentum) -> Self {
        let plant = plant(&builtin(name), |_| {});
        let d = plant.model().dimensions();
        let mut held = vec![0.0; d.input()];
        plant.hold_input(&mut held);
        let guess = DMatrix::from_fn(steps, d.input(), |_, j| held[j]);
        let mut moving = plant.clone();
        let mut inputs = guess.clone();
        let mut x = DMatrix::zeros(steps + 1, d.state());
        for k in 0..=steps {
            x.row_mut(k).copy_from_slice(&moving.state().x());
            if k < steps {
                let u = waving_input(&moving, k as u64 + 1);
                moving.step(&u).unwrap();
                inputs.row_mut(k).copy_from_slice(&u);
            }
        }
        let q: Vec<f64> = (0..d.state()).map(|i| 10.0 + (7 * i % 5) as f64).collect();
        let weights = Weights::diagonal(&q, &vec![0.1; d.input()]).unwrap().into();
        let cost = TrajectoryCost { x, u: guess.clone(), weights, momentum };
        Self { plant, inputs, guess, cost }
    }

    fn search(&self, guess: &DMatrix<f64>, options: Options) -> Optimizer {
        let (plant, cost) = (self.plant.clone(), self.cost.clone());
        Optimizer::new(plant, guess.clone(), cost, &Bounds::default(), None, options).unwrap()
    }

    /// The cost of inputs, by its definition.
    fn cost_of(&self, inputs: &DMatrix<f64>) -> f64 {
        let mut plant = self.plant.clone();
        let mut other = self.plant.clone();
        let weights = &self.cost.weights;
        let mut sum = 0.0;
        for k in 0..=inputs.nrows() {
            let desired: Vec<f64> = self.cost.x.row(k).iter().copied().collect();
            let dx = DVector::from_vec(projected(&mut plant)) - state_at(&mut other, &desired);
            if k == inputs.nrows() {
                sum += 0.5 * dx.dot(&(weights.q_final() * &dx));
                continue;
            }
            let (stage, du) = (weights.stage(k), (inputs.row(k) - self.cost.u.row(k)).transpose());
            sum += 0.5 * (dx.dot(&(stage.q() * &dx)) + du.dot(&(stage.r() * &du)));
            let u: Vec<f64> = inputs.row(k).iter().copied().collect();
            plant.step(&u).unwrap();
        }
        sum
    }

    fn gradient(&self, inputs: &DMatrix<f64>) -> DVector<f64> {
        let entries = (0..inputs.len()).map(|i| {
            let along = |s: f64| {
                let mut moved = inputs.clone();
                moved[i] += s;
                vec![self.cost_of(&moved)]
            };
            slope(1e-3, along)[0]
        });
        DVector::from_iterator(inputs.len(), entries)
    }
}

/// `(q, p̃, v)`.
fn projected(plant: &mut Plant) -> Vec<f64> {
    [plant.q().to_vec(), plant.projected_momentum(), plant.v().to_vec()].concat()
}

fn state_at(plant: &mut Plant, x: &[f64]) -> DVector<f64> {
    let d = plant.model().dimensions();
    let (q, rest) = x.split_at(d.coordinates());
    let (p, v) = rest.split_at(d.dynamic);
    let (q, p, v) = (q.to_vec(), p.to_vec(), v.to_vec());
    plant.initialize(&Initial::Momentum { q, p, v }).unwrap();
    DVector::from_vec(projected(plant))
}

fn run(search: &mut Optimizer) {
    while search.status() == Status::Running {
        search.iterate(&mut || true).unwrap();
    }
}

#[test]
fn a_search_ends_where_the_derivative_of_the_cost_vanishes() {
    for name in ["four-bar", "scissor-3"] {
        let follow = Follow::new(name, 40, Momentum::Projected);
        let mut search = follow.search(&follow.guess, Options::default());
        let first = follow.cost_of(&follow.guess);
        assert!((search.cost() - first).abs() < 1e-12 * first, "{name}: {}", search.cost());
        let before = follow.gradient(&follow.guess).amax();
        let tolerance = Some(1e-14 * first);
        search = follow.search(&follow.guess, Options { tolerance, ..Options::default() });
        run(&mut search);
        assert_eq!(search.status(), Status::Converged, "{name}");
        let inputs = search.inputs();
        let (last, after) = (follow.cost_of(&inputs), follow.gradient(&inputs).amax());
        assert!((search.cost() - last).abs() < 1e-11 * last, "{name}: {}", search.cost());
        assert!(last < 0.9 * first && after < 1e-5 * before, "{name}: {after} of {before}");
        // With the state's own momentum it ends elsewhere.
        let own = Follow::new(name, 40, Momentum::State);
        let mut own_search = own.search(&own.guess, Options::default());
        run(&mut own_search);
        assert_eq!(own_search.status(), Status::Converged, "{name}");
        assert!((own_search.inputs() - &inputs).amax() > 1e-3, "{name}");
    }
}

#[test]
fn a_motion_does_not_deviate_from_itself_nor_from_its_projected_momenta() {
    for name in ["four-bar", "marionette"] {
        let mut follow = Follow::new(name, 30, Momentum::Projected);
        follow.cost.u = follow.inputs.clone();
        assert_eq!(follow.search(&follow.inputs, Options::default()).cost(), 0.0, "{name}");
        let cost = follow.search(&follow.guess, Options::default()).cost();
        let mut plant = follow.plant.clone();
        let momentum = plant.model().dimensions().momentum();
        let mut moved = 0.0_f64;
        for mut row in follow.cost.x.row_iter_mut() {
            let x: Vec<f64> = row.iter().copied().collect();
            let y = state_at(&mut plant, &x);
            for i in momentum.clone() {
                moved = moved.max((row[i] - y[i]).abs());
                row[i] = y[i];
            }
        }
        let again = follow.search(&follow.guess, Options::default()).cost();
        assert!(moved > 1e-4, "{name}: {moved}");
        assert!((again - cost).abs() < 1e-11 * cost, "{name}: {again} {cost}");
    }
}

#[test]
fn without_constraints_nothing_changes() {
    for name in ["double-pendulum", "cart-pole"] {
        let ends = [Momentum::State, Momentum::Projected].map(|momentum| {
            let follow = Follow::new(name, 40, momentum);
            let mut search = follow.search(&follow.guess, Options::default());
            let mut rows = Vec::new();
            while search.status() == Status::Running {
                rows.push(search.iterate(&mut || true).unwrap());
            }
            (rows, search.states(), search.inputs())
        });
        assert_eq!(ends[0], ends[1], "{name}");
    }
}

#[test]
fn a_cost_on_the_projected_momentum_is_of_second_order() {
    let cost_of = |momentum: Momentum, steps: usize| {
        let h = 0.4 / steps as f64;
        let plant = plant(&builtin("four-bar"), |s| s.time_step_s = h);
        let d = plant.model().dimensions();
        // The trapezoidal rule for ½ ∫ |p|² dt, from rest.
        let diagonal = |weight: f64| {
            let momentum = d.momentum();
            let entry = |i| if momentum.contains(&i) { weight } else { 0.0 };
            DMatrix::from_diagonal(&DVector::from_fn(d.state(), |i, _| entry(i)))
        };
        let r = DMatrix::identity(d.input(), d.input());
        let weights = Weights::new(diagonal(h), r, Some(diagonal(0.5 * h))).unwrap().into();
        let (x, u) = (DMatrix::zeros(steps + 1, d.state()), DMatrix::zeros(steps, d.input()));
        let cost = TrajectoryCost { x, u: u.clone(), weights, momentum };
        Optimizer::new(plant, u, cost, &Bounds::default(), None, Options::default()).unwrap().cost()
    };
    for (momentum, order) in [(Momentum::State, 1.0), (Momentum::Projected, 2.0)] {
        let [coarse, middle, fine] = [160, 320, 640].map(|steps| cost_of(momentum, steps));
        let found = ((coarse - middle) / (middle - fine)).log2();
        assert!((found - order).abs() < 0.1, "{momentum:?}: order {found}");
    }
}

/// A motion near another that a law holds it to: what it costs with projected momenta, and what the value
/// function of the start says.
fn closed_loop(
    start: &Plant,
    inputs: &DMatrix<f64>,
    gain: impl Fn(usize) -> DMatrix<f64>,
    weights: &Weights,
) -> (f64, DVector<f64>) {
    let (mut reference, mut plant) = (start.clone(), start.clone());
    let mut q = start.q().to_vec();
    q[0] += 1e-6;
    plant.initialize(&Initial::Projection { q, hold: vec!["crank".to_owned()] }).unwrap();
    let p = start.p().iter().enumerate().map(|(i, p)| p + 1e-6 * (i as f64 + 1.0).sin()).collect();
    let (q, v) = (plant.q().to_vec(), plant.v().to_vec());
    plant.initialize(&Initial::Momentum { q, p, v }).unwrap();
    let difference = |a: Vec<f64>, b: Vec<f64>| DVector::from_vec(a) - DVector::from_vec(b);
    let first = difference(plant.state().x(), start.state().x());
    let mut sum = 0.0;
    for k in 0..=inputs.nrows() {
        let dy = difference(projected(&mut plant), projected(&mut reference));
        if k == inputs.nrows() {
            sum += 0.5 * dy.dot(&(weights.q_final() * &dy));
            break;
        }
        let du = -gain(k) * difference(plant.state().x(), reference.state().x());
        sum += 0.5 * (dy.dot(&(weights.q() * &dy)) + du.dot(&(weights.r() * &du)));
        let u: Vec<f64> = inputs.row(k).iter().copied().collect();
        let moved: Vec<f64> = u.iter().zip(du.iter()).map(|(u, du)| u + du).collect();
        reference.step(&u).unwrap();
        plant.step(&moved).unwrap();
    }
    (sum, first)
}

fn weights_of_four_bar() -> Weights {
    Weights::diagonal(&[1.0, 2.0, 3.0, 40.0, 30.0, 20.0], &[0.5]).unwrap()
}

#[test]
fn a_regulator_about_rest_costs_what_its_value_says() {
    let mut start = plant(&builtin("four-bar"), |_| {});
    start.initialize(&Initial::OperatingPoint("rest".to_owned())).unwrap();
    let mut out = Linearization::new(start.model());
    start.linearize(&[0.0], &mut out).unwrap();
    let tangent = Tangent::new(&start.constraint_jacobian(), 3);
    let weights = weights_of_four_bar();
    let pulled = weights.pull_back(&start.projection_by_state()).unwrap();
    let regulator = infinite_horizon_on_manifold(&out.a(), &out.b(), &tangent, &pulled).unwrap();
    let inputs = DMatrix::zeros(4000, 1);
    let (cost, dx) = closed_loop(&start, &inputs, |_| regulator.gain.clone(), &weights);
    let value = 0.5 * dx.dot(&(&regulator.value * &dx));
    assert!((cost - value).abs() < 1e-4 * value, "{cost} {value}");
    let own = infinite_horizon_on_manifold(&out.a(), &out.b(), &tangent, &weights).unwrap();
    let own = 0.5 * dx.dot(&(own.value * &dx));
    assert!((cost - own).abs() > 1e-2 * value, "{cost} {own}");
}

#[test]
fn a_regulator_along_a_motion_costs_what_its_value_says() {
    let mut start = plant(&builtin("four-bar"), |_| {});
    wave(&mut start, 20);
    let steps = 60;
    let inputs = DMatrix::from_fn(steps, 1, |k, _| (0.2 * k as f64).sin());
    let mut moving = start.clone();
    let mut out = Linearization::new(start.model());
    let (mut samples, mut tangents, mut projections) = (Vec::new(), Vec::new(), Vec::new());
    for k in 0..=steps {
        tangents.push(Tangent::new(&moving.constraint_jacobian(), 3));
        projections.push(moving.projection_by_state());
        if k < steps {
            moving.step_and_linearize(&[inputs[(k, 0)]], &mut out).unwrap();
            samples.push(Sample { a: out.a(), b: out.b() });
        }
    }
    let weights = weights_of_four_bar();
    let pulled = TrajectoryWeights::from(&weights).pull_back(&projections).unwrap();
    let solution = finite_horizon_on_manifold(&samples, &tangents, &pulled, Values::Drop).unwrap();
    let (cost, dx) = closed_loop(&start, &inputs, |k| solution.gains[k].clone(), &weights);
    let value = 0.5 * dx.dot(&(&solution.value * &dx));
    assert!((cost - value).abs() < 1e-4 * value, "{cost} {value}");
    let again = pulled.pull_back(&projections[..steps]);
    assert_eq!(again, Err(WeightsError::Steps { weights: steps, steps: steps - 1 }));
    assert_eq!(pulled.pull_back(&[]), Err(WeightsError::NoSteps));
    let error = weights.pull_back(&DMatrix::identity(5, 5)).unwrap_err();
    assert!(matches!(error, WeightsError::Dimension { rows: 5, expected_rows: 6, .. }));
}

#[test]
fn a_desired_momentum_without_a_projection_is_refused() {
    let mut follow = Follow::new("four-bar", 4, Momentum::Projected);
    follow.cost.x[(2, 4)] = f64::MAX;
    let (plant, cost, guess) = (follow.plant, follow.cost, follow.guess);
    let found = Optimizer::new(plant, guess, cost, &Bounds::default(), None, Options::default());
    assert!(matches!(found, Err(OptimizeError::NotFinite { row: 2, .. })), "{found:?}");
}
