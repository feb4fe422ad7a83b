//! Searches against what is known of their ends: closed forms, optimality conditions, themselves.

use std::f64::consts::PI;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::common::{builtin, plant, waving_input};
use nalgebra::{DMatrix, DVector};
use plantd_control::optimize::{
    Bound, BoundFault, BoundState, Bounds, FreeInitialState, Method, OptimizeError, Optimizer,
    Options, Progress, Status, Stuck, TrajectoryCost,
};
use plantd_control::reference::check_reference;
use plantd_control::{
    Momentum, Sample, StageWeights, TrajectoryWeights, Values, Weights, WeightsError,
    finite_horizon,
};
use plantd_models::{Initial, Linearization, Model, Plant, Scene, Settings};

fn run(search: &mut Optimizer) -> Vec<Progress> {
    let mut rows = Vec::new();
    while search.status() == Status::Running {
        rows.push(search.iterate(&mut || true).unwrap());
    }
    rows
}

fn at_rest(name: &str, time_step_s: f64) -> Plant {
    let mut plant = plant(&builtin(name), |s| s.time_step_s = time_step_s);
    plant.initialize(&Initial::OperatingPoint("hanging".to_owned())).unwrap();
    plant
}

/// The same desired state throughout.
fn goal(steps: usize, x: &[f64], q: &[f64], q_final: &[f64], r: &[f64]) -> TrajectoryCost {
    let diagonal = |d: &[f64]| DMatrix::from_diagonal(&DVector::from_column_slice(d));
    let weights = Weights::new(diagonal(q), diagonal(r), Some(diagonal(q_final))).unwrap();
    TrajectoryCost {
        x: DMatrix::from_fn(steps + 1, x.len(), |_, i| x[i]),
        u: DMatrix::zeros(steps, r.len()),
        weights: weights.into(),
        momentum: Momentum::State,
    }
}

/// Small torques that break the symmetry of hanging at rest.
fn nudges(steps: usize, inputs: usize) -> DMatrix<f64> {
    DMatrix::from_fn(steps, inputs, |k, j| 0.3 * (0.1 * k as f64 + j as f64).sin())
}

fn between(index: usize, limit: f64) -> Bound {
    Bound { index, min: Some(-limit), max: Some(limit) }
}

fn fixed(index: usize, value: f64) -> Bound {
    Bound { index, min: Some(value), max: Some(value) }
}

/// A pendulum that swings up within a torque limit.
struct SwingUp {
    plant: Plant,
    steps: usize,
    cost: TrajectoryCost,
}

impl SwingUp {
    fn new() -> Self {
        let steps = 60;
        let cost = goal(steps, &[PI, 0.0], &[1.0, 0.1], &[300.0, 100.0], &[0.5]);
        Self { plant: at_rest("pendulum", 0.05), steps, cost }
    }

    fn search(
        &self,
        bounds: &Bounds,
        free: Option<FreeInitialState>,
        options: Options,
    ) -> Optimizer {
        let guess = nudges(self.steps, 1);
        Optimizer::new(self.plant.clone(), guess, self.cost.clone(), bounds, free, options).unwrap()
    }

    /// Derivatives of the cost by each input, with the motion that follows from it, and by the initial
    /// state.
    fn gradient(&self, search: &Optimizer) -> (Vec<f64>, DVector<f64>) {
        let (x, u) = (search.states(), search.inputs());
        let mut plant = self.plant.clone();
        let initial = search.initial_state();
        let (q, p, v) = (initial.q, initial.p, initial.v);
        plant.initialize(&Initial::Momentum { q, p, v }).unwrap();
        let mut out = Linearization::new(plant.model());
        let mut samples = Vec::new();
        for k in 0..self.steps {
            plant.step_and_linearize(&[u[(k, 0)]], &mut out).unwrap();
            samples.push(Sample { a: out.a(), b: out.b() });
        }
        let stage = self.cost.weights.stage(0);
        let error = |k: usize| (x.row(k) - self.cost.x.row(k)).transpose();
        let mut z = self.cost.weights.q_final() * error(self.steps);
        let mut slopes = vec![0.0; self.steps];
        for k in (0..self.steps).rev() {
            slopes[k] = stage.r()[(0, 0)] * u[(k, 0)] + (samples[k].b.transpose() * &z)[0];
            z = stage.q() * error(k) + samples[k].a.transpose() * z;
        }
        (slopes, z)
    }
}

#[test]
fn a_linear_quadratic_problem_takes_one_step() {
    let text = r#"
        format = 1
        name = "slide"
        time_step_s = 0.05
        gravity = [0.0, 0.0, 0.0]
        damping = 0.3
        [[frames]]
        name = "cart"
        joint = { type = "prismatic", axis = [1.0, 0.0, 0.0], coordinate = "x" }
        body = { mass = 2.0 }
        [[inputs]]
        name = "force"
        coordinate = "x"
        [[springs]]
        type = "coordinate"
        coordinate = "x"
        stiffness = 3.0
        rest = 0.0
    "#;
    let model = Arc::new(Model::compile(&Scene::from_toml(text).unwrap()).unwrap());
    let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
    let start = DVector::from_column_slice(&[1.0, -0.5]);
    plant.initialize(&Initial::Momentum { q: vec![1.0], p: vec![-0.5], v: vec![] }).unwrap();
    let mut out = Linearization::new(&model);
    plant.linearize(&[0.0], &mut out).unwrap();
    let steps = 40;
    let samples = vec![Sample { a: out.a(), b: out.b() }; steps];
    let cost = goal(steps, &[0.0, 0.0], &[2.0, 1.0], &[5.0, 1.0], &[0.1]);
    let best = finite_horizon(&samples, &cost.weights, Values::Drop).unwrap();
    for method in [Method::Newton, Method::QuasiNewton] {
        let options = Options { method, ..Options::default() };
        let (guess, bounds) = (nudges(steps, 1), Bounds::default());
        let mut search =
            Optimizer::new(plant.clone(), guess, cost.clone(), &bounds, None, options).unwrap();
        let rows = run(&mut search);
        assert_eq!((rows.len(), search.status()), (2, Status::Converged));
        assert_eq!((rows[0].step_length, rows[0].fallback), (1.0, None));
        let expected = 0.5 * start.dot(&(&best.value * &start));
        assert!((search.cost() - expected).abs() < 1e-12 * expected);
        let u = search.inputs();
        for k in 0..steps {
            let law = -(&best.gains[k] * search.states().row(k).transpose())[0];
            assert!((u[(k, 0)] - law).abs() < 1e-12, "step {k}");
        }
    }
}

#[test]
fn newton_converges_quadratically() {
    let swing = SwingUp::new();
    let options = Options { tolerance: Some(1e-18), ..Options::default() };
    let mut search = swing.search(&Bounds::default(), None, options);
    let rows = run(&mut search);
    assert_eq!(search.status(), Status::Converged, "{rows:#?}");
    let ends: Vec<f64> = rows.iter().rev().take(6).map(|row| -row.directional_derivative).collect();
    // Down to the round-off of slopes.
    for (after, before) in ends.iter().zip(&ends[1..]) {
        assert!(*after <= 10.0 * before * before + 1e-14, "{ends:?}");
    }
    // Nothing is to be gained anywhere.
    let slopes = swing.gradient(&search).0;
    assert!(slopes.iter().all(|slope| slope.abs() < 1e-6), "{slopes:?}");
    // A warm start has nothing to do.
    let (inputs, cost) = (search.inputs(), swing.cost.clone());
    let options = Options::default();
    let mut again =
        Optimizer::new(swing.plant.clone(), inputs, cost, &Bounds::default(), None, options)
            .unwrap();
    assert_eq!(run(&mut again).len(), 1);
}

#[test]
fn a_torque_limit_holds_and_its_multipliers_are_the_slopes_of_the_cost() {
    let swing = SwingUp::new();
    let unbounded = {
        let mut search = swing.search(&Bounds::default(), None, Options::default());
        run(&mut search);
        search
    };
    let most = unbounded.inputs().amax();
    let limit = 0.7 * most;
    let bounds = Bounds { inputs: vec![between(0, limit)], ..Bounds::default() };
    let options = Options { tolerance: Some(1e-12), ..Options::default() };
    let mut search = swing.search(&bounds, None, options);
    let rows = run(&mut search);
    assert_eq!(search.status(), Status::Converged, "{rows:#?}");
    let u = search.inputs();
    assert!(u.amax() <= limit + 1e-6, "{} of {limit}", u.amax());
    assert!(search.bound_violation() <= 1e-6);
    assert!(search.cost() > unbounded.cost());
    let multipliers = search.checkpoint().bound_multipliers;
    let (lower, upper) = multipliers.split_at(swing.steps);
    let slopes = swing.gradient(&search).0;
    let scale = upper.iter().fold(0.0_f64, |m, x| m.max(*x));
    let mut active = 0;
    for k in 0..swing.steps {
        assert!(lower[k] >= 0.0 && upper[k] >= 0.0);
        assert!((slopes[k] + upper[k] - lower[k]).abs() < 1e-4 * scale, "step {k}: {slopes:?}");
        // A multiplier that is not zero belongs to a bound that is met.
        let slack = (limit - u[(k, 0)]).min(1.0);
        assert!(upper[k] * slack.abs() < 1e-4 * scale, "step {k}: {} {slack}", upper[k]);
        active += usize::from(upper[k] > 1e-3 * scale || lower[k] > 1e-3 * scale);
    }
    assert!(active > 3, "{active} bounds are active");
}

#[test]
fn slack_bounds_change_nothing() {
    let swing = SwingUp::new();
    let free = run(&mut swing.search(&Bounds::default(), None, Options::default()));
    let bounds = Bounds {
        states: vec![between(0, 100.0), between(1, 1000.0)],
        inputs: vec![between(0, 1e4)],
        final_state: vec![between(0, 100.0)],
    };
    let bounded = run(&mut swing.search(&bounds, None, Options::default()));
    assert_eq!(free, bounded);
}

#[test]
fn terminal_constraints_with_a_limit_of_the_force_or_of_the_rail() {
    let steps = 120;
    let plant = at_rest("cart-pole", 0.025);
    let index = |name: &str| plant.model().coordinate_index(name).unwrap();
    let (x, theta) = (index("x"), index("theta"));
    let mut desired = [0.0; 4];
    desired[theta] = PI;
    let cost = goal(steps, &desired, &[0.1, 1.0, 0.01, 0.01], &[10.0; 4], &[1e-3]);
    let end = vec![fixed(x, 0.0), fixed(theta, PI), fixed(2 + x, 0.0), fixed(2 + theta, 0.0)];
    let search = |states: Vec<Bound>, inputs: Vec<Bound>| {
        let bounds = Bounds { states, inputs, final_state: end.clone() };
        let options = Options { max_iterations: 500, ..Options::default() };
        let (guess, plant, cost) = (nudges(steps, 1), plant.clone(), cost.clone());
        let mut search = Optimizer::new(plant, guess, cost, &bounds, None, options).unwrap();
        let rows = run(&mut search);
        assert_eq!(search.status(), Status::Converged, "{:?}", rows.last());
        for (i, desired) in desired.iter().enumerate() {
            let error = search.states()[(steps, i)] - desired;
            assert!(error.abs() < 2e-6, "{i}: {error}");
        }
        search
    };
    let wide = search(vec![], vec![]);
    let force = 0.9 * wide.inputs().amax();
    let narrow = search(vec![], vec![between(0, force)]);
    assert!(narrow.inputs().amax() <= force + 2e-6, "{}", narrow.inputs().amax());
    assert!(narrow.cost() > wide.cost());
    let rail = 0.8 * wide.states().column(x).amax();
    let narrow = search(vec![between(x, rail)], vec![]);
    assert!(narrow.states().column(x).amax() <= rail + 2e-6);
    assert!(narrow.cost() > wide.cost());
}

/// A closed chain that is to follow a motion of its own, with other inputs to begin with.
fn follow(name: &str, steps: usize) -> (Plant, TrajectoryCost, DMatrix<f64>) {
    let mut plant = plant(&builtin(name), |_| {});
    let d = plant.model().dimensions();
    let start = plant.clone();
    let mut held = vec![0.0; d.input()];
    plant.hold_input(&mut held);
    let mut x = DMatrix::zeros(steps + 1, d.state());
    for k in 0..=steps {
        x.row_mut(k).copy_from_slice(&plant.state().x());
        let u = waving_input(&plant, k as u64 + 1);
        plant.step(&u).unwrap();
    }
    let weights = Weights::diagonal(&vec![100.0; d.state()], &vec![0.1; d.input()]).unwrap();
    let u = DMatrix::from_fn(steps, d.input(), |_, j| held[j]);
    let cost =
        TrajectoryCost { x, u: u.clone(), weights: weights.into(), momentum: Momentum::State };
    (start, cost, u)
}

#[test]
fn closed_chains_stay_motions_of_the_plant() {
    for name in ["four-bar", "scissor-4"] {
        let (start, cost, guess) = follow(name, 100);
        let first = start.clone();
        let mut search =
            Optimizer::new(start, guess, cost, &Bounds::default(), None, Options::default())
                .unwrap();
        let first_cost = search.cost();
        let rows = run(&mut search);
        assert_eq!(search.status(), Status::Converged, "{name}: {rows:#?}");
        assert!(search.cost() < 0.9 * first_cost, "{name}: {} of {first_cost}", search.cost());
        let n = first.model().dimensions().coordinates();
        let q = search.states().columns(0, n).into_owned();
        let found = check_reference(&first.clone().into(), &q, Some(&search.inputs())).unwrap();
        assert!(found.is_feasible(1e-8), "{name}: {found:?}");
    }
}

#[test]
fn threads_do_not_change_a_bit() {
    for (name, limit) in [("marionette", 0.11), ("scissor-4", 1e3)] {
        let searches = [1, 2, 3].map(|threads| {
            let (start, cost, guess) = follow(name, 70);
            let options = Options { max_iterations: 6, ..Options::default() };
            let bounds = Bounds { inputs: vec![between(0, limit)], ..Bounds::default() };
            let mut search = Optimizer::new(start, guess, cost, &bounds, None, options).unwrap();
            search.set_threads(threads);
            let helped = Arc::new(AtomicUsize::new(0));
            let count = Arc::clone(&helped);
            search.set_around(move |work| {
                count.fetch_add(1, Ordering::Relaxed);
                work();
            });
            let rows = run(&mut search);
            // Without others nobody has helped.
            assert_eq!(threads > 1, helped.load(Ordering::Relaxed) > 0, "{name}, {threads}");
            (rows, search.states(), search.inputs())
        });
        let newton = searches[0].0.iter().any(|row| row.method == Method::Newton);
        assert!(newton || name == "marionette");
        assert_eq!(searches[0], searches[1]);
        assert_eq!(searches[0], searches[2]);
    }
}

#[test]
fn a_free_initial_state_is_stationary() {
    let swing = SwingUp::new();
    let weight = DMatrix::from_diagonal(&DVector::from_column_slice(&[50.0, 20.0]));
    let free = FreeInitialState { entries: vec![], weight: Some(weight.clone()) };
    let options = Options { tolerance: Some(1e-14), ..Options::default() };
    let mut search = swing.search(&Bounds::default(), Some(free), options.clone());
    run(&mut search);
    assert_eq!(search.status(), Status::Converged);
    let mut fixed = swing.search(&Bounds::default(), None, options.clone());
    run(&mut fixed);
    assert!(search.cost() < fixed.cost());
    let (slopes, by_start) = swing.gradient(&search);
    let x = search.states();
    let moved = (x.row(0) - fixed.states().row(0)).transpose();
    assert!(moved.amax() > 1e-3);
    assert!((by_start + weight * moved).amax() < 1e-5);
    assert!(slopes.iter().all(|slope| slope.abs() < 1e-5));

    // Only the entries that are free move.
    let free = FreeInitialState { entries: vec![1], weight: None };
    let mut search = swing.search(&Bounds::default(), Some(free), options);
    run(&mut search);
    assert_eq!(search.states()[(0, 0)], 0.0);
    assert!(swing.gradient(&search).1[1].abs() < 1e-5);
}

#[test]
fn a_free_initial_state_stays_on_the_constraints() {
    let (start, mut cost, guess) = follow("four-bar", 60);
    // A start that is not the desired one.
    for k in 0..=60 {
        let later = cost.x.row((k + 20).min(60)).into_owned();
        cost.x.row_mut(k).copy_from(&later);
    }
    let first = start.clone();
    let free = FreeInitialState::default();
    let options = Options::default();
    let mut search =
        Optimizer::new(start, guess, cost, &Bounds::default(), Some(free), options).unwrap();
    let rows = run(&mut search);
    assert_eq!(search.status(), Status::Converged, "{rows:#?}");
    let n = first.model().dimensions().coordinates();
    let q = search.states().columns(0, n).into_owned();
    assert!((q.row(0).transpose() - DVector::from_column_slice(first.q())).amax() > 1e-3);
    let found = check_reference(&first.clone().into(), &q, Some(&search.inputs())).unwrap();
    assert!(found.is_feasible(1e-8), "{found:?}");
}

/// A bounded search with a free initial state, of many iterations.
fn long_search(swing: &SwingUp) -> (Bounds, Option<FreeInitialState>, Options) {
    let bounds = Bounds {
        states: vec![Bound { index: 1, min: None, max: Some(4.0) }],
        inputs: vec![between(0, 5.0)],
        final_state: vec![fixed(0, PI)],
    };
    let weight = Some(DMatrix::identity(2, 2) * 30.0);
    let free = Some(FreeInitialState { entries: vec![1], weight });
    let first_method = Some(Method::QuasiNewton);
    let options = Options { first_method, first_iterations: 3, ..Options::default() };
    assert_eq!(swing.plant.model().dimensions().state(), 2);
    (bounds, free, options)
}

#[test]
fn a_search_is_resumed_bit_for_bit() {
    let swing = SwingUp::new();
    let (bounds, free, options) = long_search(&swing);
    let mut whole = swing.search(&bounds, free.clone(), options.clone());
    let mut checkpoints = vec![whole.checkpoint()];
    let mut rows = Vec::new();
    while whole.status() == Status::Running {
        rows.push(whole.iterate(&mut || true).unwrap());
        checkpoints.push(whole.checkpoint());
    }
    assert!(rows.len() > 8, "{rows:#?}");
    for at in [0, 2, 5, rows.len() - 1] {
        let (plant, cost) = (swing.plant.clone(), swing.cost.clone());
        let (free, options) = (free.clone(), options.clone());
        let mut resumed =
            Optimizer::resume(plant, cost, &bounds, free, options, &checkpoints[at]).unwrap();
        assert_eq!(resumed.checkpoint(), checkpoints[at]);
        assert_eq!(run(&mut resumed), rows[at..], "from {at}");
        assert_eq!(resumed.checkpoint(), whole.checkpoint());
        assert_eq!(resumed.states(), whole.states());
        assert_eq!(resumed.status(), whole.status());
    }
}

#[test]
fn a_cancelled_iteration_leaves_no_trace() {
    let swing = SwingUp::new();
    let (bounds, free, options) = long_search(&swing);
    let mut plain = swing.search(&bounds, free.clone(), options.clone());
    let mut disturbed = swing.search(&bounds, free, options);
    for _ in 0..4 {
        let expected = plain.iterate(&mut || true).unwrap();
        let before = disturbed.checkpoint();
        for patience in 0.. {
            let mut left = patience;
            let mut go_on = || {
                left -= 1;
                left >= 0
            };
            match disturbed.iterate(&mut go_on) {
                Ok(progress) => {
                    assert!(patience > 10, "asked {patience} times");
                    assert_eq!(progress, expected);
                    break;
                }
                Err(error) => assert_eq!(error, OptimizeError::Cancelled),
            }
            assert_eq!(disturbed.checkpoint(), before);
            assert_eq!(disturbed.status(), Status::Running);
        }
    }
}

#[test]
fn a_search_that_gets_stuck_says_why() {
    let swing = SwingUp::new();
    let none = Bounds::default();
    let stuck = |search: &mut Optimizer| match run(search) {
        rows if rows.is_empty() => panic!("no iteration"),
        _ => match search.status() {
            Status::Stuck(stuck) => stuck,
            other => panic!("{other:?}"),
        },
    };
    let options = Options { max_iterations: 2, ..Options::default() };
    let mut search = swing.search(&none, None, options);
    assert!(matches!(stuck(&mut search), Stuck::MaxIterations { iterations: 2, .. }));
    assert_eq!(search.iterate(&mut || true), Err(OptimizeError::Finished));

    let options = Options { max_backtracks: 0, alpha: 0.99, ..Options::default() };
    let found = stuck(&mut swing.search(&none, None, options));
    assert!(matches!(found, Stuck::NoDescent { backtracks: 0, .. }), "{found}");

    // An input that pays.
    let mut cost = swing.cost.clone();
    let (q, r) = (DMatrix::identity(2, 2), DMatrix::from_element(1, 1, -50.0));
    let stage = StageWeights::symmetric(q, r, None, None, None).unwrap();
    cost.weights = TrajectoryWeights::constant(stage, None).unwrap();
    let options = Options::default();
    let plant = swing.plant.clone();
    let mut search = Optimizer::new(plant, nudges(60, 1), cost, &none, None, options).unwrap();
    let before = search.cost();
    let found = stuck(&mut search);
    assert_eq!(found, Stuck::WeightsNotConvex { step: 59 });
    assert!(found.to_string().contains("make r positive definite") && search.cost() == before);

    // Nobody is up within three seconds with this torque.
    let bounds = Bounds {
        inputs: vec![between(0, 0.01)],
        final_state: vec![fixed(0, PI)],
        ..Bounds::default()
    };
    let options = Options { max_iterations: 2000, ..Options::default() };
    let found = stuck(&mut swing.search(&bounds, None, options));
    let Stuck::BoundsNotMet(BoundState { violation, .. }) = found else { panic!("{found}") };
    assert!(violation > 0.1, "{violation}");
    assert!(found.to_string().contains("widen the bounds"));
}

/// What makes a good problem a bad one.
type Change<'a> = &'a dyn Fn(&mut TrajectoryCost, &mut Bounds, &mut Options, &mut DMatrix<f64>);

#[test]
fn each_fault_of_a_problem_is_named() {
    let swing = SwingUp::new();
    let refuse = |change: Change<'_>| {
        let (mut cost, mut bounds, mut options) =
            (swing.cost.clone(), Bounds::default(), Options::default());
        let mut guess = nudges(60, 1);
        change(&mut cost, &mut bounds, &mut options, &mut guess);
        Optimizer::new(swing.plant.clone(), guess, cost, &bounds, None, options).unwrap_err()
    };
    let found = refuse(&|_, _, _, guess| *guess = DMatrix::zeros(0, 1));
    assert_eq!(found, OptimizeError::NoSteps);
    let found = refuse(&|_, _, _, guess| *guess = DMatrix::zeros(60, 2));
    assert!(found.to_string().contains("the guess is 60 x 2; 60 x 1 is needed"), "{found}");
    let found = refuse(&|cost, _, _, _| cost.x = DMatrix::zeros(60, 2));
    assert!(found.to_string().contains("the desired x is 60 x 2; 61 x 2"), "{found}");
    let found = refuse(&|cost, _, _, _| cost.u[(7, 0)] = f64::NAN);
    assert_eq!(found, OptimizeError::NotFinite { what: "the desired u", row: 7, col: 0 });
    let found = refuse(&|cost, _, _, _| {
        cost.weights = Weights::diagonal(&[1.0; 3], &[1.0]).unwrap().into();
    });
    assert!(matches!(found, OptimizeError::Weights(WeightsError::Dimension { weight: "q", .. })));
    let found = refuse(&|_, _, options, _| options.beta = 1.0);
    assert!(matches!(found, OptimizeError::Option { name: "beta", .. }));
    let found = refuse(&|_, _, options, _| options.tolerance = Some(f64::NAN));
    assert!(matches!(found, OptimizeError::Option { name: "tolerance", .. }));
    let found = refuse(&|_, _, options, _| {
        options.projection = Some(Weights::diagonal(&[1.0; 2], &[1.0; 2]).unwrap());
    });
    assert!(matches!(found, OptimizeError::Weights(WeightsError::Dimension { weight: "r", .. })));
    let fault = |bound: Bound| match refuse(&|_, bounds, _, _| {
        bounds.states = vec![between(0, 1.0), bound]
    }) {
        OptimizeError::Bound { list: "states", position: 1, fault } => fault,
        other => panic!("{other}"),
    };
    assert_eq!(fault(between(2, 1.0)), BoundFault::Index { index: 2, entries: 2 });
    assert_eq!(fault(Bound::default()), BoundFault::Empty);
    assert_eq!(fault(between(0, -1.0)), BoundFault::Crossed { min: 1.0, max: -1.0 });
    assert!(matches!(fault(between(0, f64::INFINITY)), BoundFault::NotFinite { .. }));
    let found = refuse(&|_, _, _, guess| guess[(5, 0)] = 1e6);
    assert!(matches!(found, OptimizeError::Guess { step: 5, .. }), "{found}");

    let (cost, bounds, options) = (swing.cost.clone(), Bounds::default(), Options::default());
    let free = Some(FreeInitialState { entries: vec![2], weight: None });
    let guess = nudges(60, 1);
    let found =
        Optimizer::new(swing.plant.clone(), guess, cost, &bounds, free, options).unwrap_err();
    assert_eq!(found, OptimizeError::FreeEntry { entry: 2, states: 2 });

    let mut checkpoint = swing.search(&bounds, None, Options::default()).checkpoint();
    checkpoint.bound_multipliers.push(1.0);
    let (plant, cost) = (swing.plant.clone(), swing.cost.clone());
    let found =
        Optimizer::resume(plant, cost, &bounds, None, Options::default(), &checkpoint).unwrap_err();
    assert_eq!(found, OptimizeError::Checkpoint { what: "the number of its multipliers" });
}
