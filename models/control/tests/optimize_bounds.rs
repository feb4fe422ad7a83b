//! Searches with bounded inputs: each ends at an optimum, whatever the limit and the tolerance, as an
//! adjoint of the tests' own says.

use std::f64::consts::PI;

use crate::common::{builtin, plant};
use nalgebra::{DMatrix, DVector};
use plantd_control::optimize::{
    Bound, Bounds, Fallback, Method, Optimizer, Options, Progress, Status, Stuck, TrajectoryCost,
};
use plantd_control::{Momentum, Weights};
use plantd_models::{Initial, Linearization, Plant, Scene};

/// Two links in a vertical plane, with a torque at each joint.
const ARM: &str = r#"
    format = 1
    name = "arm"
    time_step_s = 0.02
    gravity = [0.0, 0.0, -9.8]
    damping = 0.1
    [[frames]]
    name = "upper"
    joint = { type = "revolute", axis = [0.0, 1.0, 0.0], coordinate = "shoulder" }
    body = { mass = 2.0, center_of_mass = [0.0, 0.0, -0.25], inertia = [0.05, 0.05, 0.01] }
    [[frames]]
    name = "lower"
    parent = "upper"
    translation = [0.0, 0.0, -0.5]
    joint = { type = "revolute", axis = [0.0, 1.0, 0.0], coordinate = "elbow" }
    body = { mass = 1.0, center_of_mass = [0.0, 0.0, -0.2], inertia = [0.02, 0.02, 0.005] }
    [[inputs]]
    name = "shoulder_torque"
    coordinate = "shoulder"
    [[inputs]]
    name = "elbow_torque"
    coordinate = "elbow"
"#;

/// A motion from a state to another one, with limits of the inputs.
struct Reach {
    plant: Plant,
    steps: usize,
    cost: TrajectoryCost,
    guess: DMatrix<f64>,
    /// Largest magnitude of each input where nothing limits it.
    most: Vec<f64>,
}

impl Reach {
    fn new(mut plant: Plant, start: &[f64], goal: &[f64], steps: usize, weights: Weights) -> Self {
        let n = plant.model().dimensions().coordinates();
        let (q, p) = start.split_at(n);
        plant.initialize(&Initial::Momentum { q: q.to_vec(), p: p.to_vec(), v: vec![] }).unwrap();
        let mut reach = Self::at(plant, goal, steps, weights);
        let mut search = reach.search(&Bounds::default(), Options::default());
        run(&mut search);
        assert_eq!(search.status(), Status::Converged);
        reach.most = search.inputs().column_iter().map(|u| u.amax()).collect();
        reach
    }

    /// From where the plant is, without knowing what inputs it takes.
    fn at(plant: Plant, goal: &[f64], steps: usize, weights: Weights) -> Self {
        let inputs = plant.model().dimensions().input();
        let cost = TrajectoryCost {
            x: DMatrix::from_fn(steps + 1, goal.len(), |_, i| goal[i]),
            u: DMatrix::zeros(steps, inputs),
            weights: weights.into(),
            momentum: Momentum::State,
        };
        let guess = DMatrix::zeros(steps, inputs);
        Self { plant, steps, cost, guess, most: vec![f64::INFINITY; inputs] }
    }

    /// A cart that goes home by a metre without swinging its pole.
    fn cart() -> Self {
        let weights = weights(&[10.0, 10.0, 0.1, 0.1], &[0.01], &[100.0, 100.0, 10.0, 10.0]);
        let plant = plant(&builtin("cart-pole"), |_| {});
        Self::new(plant, &[1.0, 0.0, 0.0, 0.0], &[0.0; 4], 150, weights)
    }

    fn arm() -> Self {
        let weights = weights(&[20.0, 20.0, 0.5, 0.5], &[0.05; 2], &[200.0, 200.0, 20.0, 20.0]);
        let plant = plant(&Scene::from_toml(ARM).unwrap(), |_| {});
        Self::new(plant, &[0.2, 0.3, 0.0, 0.0], &[1.2, -0.7, 0.0, 0.0], 80, weights)
    }

    /// Limits of all inputs at a part of what they are without.
    fn limits(&self, part: f64) -> Vec<f64> {
        self.most.iter().map(|most| part * most).collect()
    }

    fn search(&self, bounds: &Bounds, options: Options) -> Optimizer {
        let (plant, cost, guess) = (self.plant.clone(), self.cost.clone(), self.guess.clone());
        Optimizer::new(plant, guess, cost, bounds, None, options).unwrap()
    }

    /// Derivatives of the cost by the inputs, with the motion that follows from them: a row per step.
    fn slopes(&self, search: &Optimizer) -> DMatrix<f64> {
        let (x, u) = (search.states(), search.inputs());
        let mut plant = self.plant.clone();
        let mut out = Linearization::new(plant.model());
        let mut maps = Vec::new();
        for k in 0..self.steps {
            assert_eq!(plant.state().x(), x.row(k).iter().copied().collect::<Vec<_>>());
            let input: Vec<f64> = u.row(k).iter().copied().collect();
            plant.step_and_linearize(&input, &mut out).unwrap();
            maps.push((out.a(), out.b()));
        }
        let stage = self.cost.weights.stage(0);
        let error = |k: usize| (x.row(k) - self.cost.x.row(k)).transpose();
        let mut z = self.cost.weights.q_final() * error(self.steps);
        let mut slopes = DMatrix::zeros(self.steps, self.most.len());
        for (k, (a, b)) in maps.iter().enumerate().rev() {
            let slope = stage.r() * u.row(k).transpose() + b.tr_mul(&z);
            slopes.set_row(k, &slope.transpose());
            z = stage.q() * error(k) + a.tr_mul(&z);
        }
        slopes
    }

    /// How far a search's end is from the conditions of an optimum.
    fn conditions(&self, search: &Optimizer, limits: &[f64]) -> Conditions {
        let (u, slopes) = (search.inputs(), self.slopes(search));
        let multipliers = search.checkpoint().bound_multipliers;
        let mut found = Conditions::default();
        for (j, limit) in limits.iter().enumerate() {
            let ends = &multipliers[2 * j * self.steps..][..2 * self.steps];
            let (lower, upper) = ends.split_at(self.steps);
            for k in 0..self.steps {
                let most = |a: &mut f64, b: f64| *a = a.max(b);
                assert!(lower[k] >= 0.0 && upper[k] >= 0.0);
                most(&mut found.scale, slopes[(k, j)].abs());
                most(&mut found.slope, (slopes[(k, j)] + upper[k] - lower[k]).abs());
                most(&mut found.excess, u[(k, j)].abs() - limit);
                most(&mut found.product, upper[k] * (limit - u[(k, j)]).abs() / limit);
                most(&mut found.product, lower[k] * (limit + u[(k, j)]).abs() / limit);
                found.active += usize::from(upper[k] + lower[k] > 0.0);
            }
        }
        found
    }
}

/// Residuals of the conditions of Karush, Kuhn and Tucker.
#[derive(Debug, Default)]
struct Conditions {
    /// Largest slope of the cost: the unit of the next two.
    scale: f64,
    /// Slope of the Lagrangian.
    slope: f64,
    /// A multiplier times the distance of its input from the bound, in units of that.
    product: f64,
    /// Out of bounds.
    excess: f64,
    /// Multipliers that are not zero.
    active: usize,
}

fn weights(q: &[f64], r: &[f64], q_final: &[f64]) -> Weights {
    let diagonal = |d: &[f64]| DMatrix::from_diagonal(&DVector::from_column_slice(d));
    Weights::new(diagonal(q), diagonal(r), Some(diagonal(q_final))).unwrap()
}

fn run(search: &mut Optimizer) -> Vec<Progress> {
    let mut rows = Vec::new();
    while search.status() == Status::Running {
        rows.push(search.iterate(&mut || true).unwrap());
    }
    rows
}

fn within(limits: &[f64]) -> Bounds {
    let bound =
        |(index, limit): (usize, &f64)| Bound { index, min: Some(-limit), max: Some(*limit) };
    Bounds { inputs: limits.iter().enumerate().map(bound).collect(), ..Bounds::default() }
}

/// Parts of the largest inputs.
fn parts(count: u32) -> impl Iterator<Item = f64> {
    (0..count).map(move |i| 0.3 + 0.65 * f64::from(i) / f64::from(count - 1))
}

/// Default options and tolerances of the directional derivative.
const TOLERANCES: [Option<f64>; 8] =
    [None, Some(1e-3), Some(1e-4), Some(1e-5), Some(1e-6), Some(1e-7), Some(1e-8), Some(1e-9)];

/// From a limit that binds most of the time to one that hardly binds.
fn each_limit_is_an_optimum(reach: &Reach, count: u32) {
    for part in parts(count) {
        let limits = reach.limits(part);
        for tolerance in TOLERANCES {
            let options = Options { tolerance, ..Options::default() };
            let mut search = reach.search(&within(&limits), options);
            let rows = run(&mut search);
            let name = format!("{part:.2} of the inputs, tolerance {tolerance:?}");
            assert_eq!(search.status(), Status::Converged, "{name}: {rows:#?}");
            let found = reach.conditions(&search, &limits);
            assert!(found.active > 0 && found.excess <= 1e-6, "{name}: {found:?}");
            assert!(found.slope <= 1e-4 * found.scale, "{name}: {found:?}");
            assert!(found.product <= 1e-4 * found.scale, "{name}: {found:?}");
            // Multipliers are renewed where a step has shown what they do, and not but there.
            let stays = |pair: &[Progress]| pair.iter().all(|row| row.step_length == 0.0);
            assert!(!rows.windows(2).any(stays), "{name}: {rows:#?}");
            assert!(search.checkpoint().penalty < 1e4, "{name}");
        }
    }
}

#[test]
fn limits_of_a_force() {
    each_limit_is_an_optimum(&Reach::cart(), 14);
}

#[test]
fn limits_of_torques() {
    each_limit_is_an_optimum(&Reach::arm(), 6);
}

/// Closer than the cost, a sum of some hundreds, can tell.
#[test]
fn limits_are_met_as_closely_as_asked() {
    for reach in [Reach::cart(), Reach::arm()] {
        for part in parts(4) {
            let limits = reach.limits(part);
            let options =
                Options { bound_tolerance: 1e-9, tolerance: Some(0.0), ..Options::default() };
            let mut search = reach.search(&within(&limits), options);
            let rows = run(&mut search);
            assert_eq!(search.status(), Status::Converged, "{part}: {rows:#?}");
            let found = reach.conditions(&search, &limits);
            assert!(found.excess <= 1e-9, "{part}: {found:?}");
            assert!(found.slope <= 1e-6 * found.scale, "{part}: {found:?}");
        }
    }
}

#[test]
fn a_search_with_limits_is_resumed_bit_for_bit_from_anywhere() {
    let reach = Reach::cart();
    let bounds = within(&reach.limits(0.4));
    let mut whole = reach.search(&bounds, Options::default());
    let (mut checkpoints, mut rows) = (Vec::new(), Vec::new());
    while whole.status() == Status::Running {
        checkpoints.push(whole.checkpoint());
        rows.push(whole.iterate(&mut || true).unwrap());
    }
    for (at, checkpoint) in checkpoints.iter().enumerate() {
        let (plant, cost) = (reach.plant.clone(), reach.cost.clone());
        let options = Options::default();
        let mut resumed =
            Optimizer::resume(plant, cost, &bounds, None, options, checkpoint).unwrap();
        assert_eq!(run(&mut resumed), rows[at..], "from {at}");
        assert_eq!(resumed.checkpoint(), whole.checkpoint());
        assert_eq!(resumed.states(), whole.states());
    }
}

/// A direction of Newton's method along which no step descends is not the end.
#[test]
fn a_direction_without_a_step_gives_way_to_the_next_method() {
    let mut plant = plant(&builtin("cart-pole"), |settings| settings.time_step_s = 0.025);
    plant.initialize(&Initial::OperatingPoint("hanging".to_owned())).unwrap();
    let weights = weights(&[0.1, 1.0, 0.01, 0.01], &[1e-3], &[100.0; 4]);
    let mut reach = Reach::at(plant, &[0.0, PI, 0.0, 0.0], 120, weights);
    reach.guess = DMatrix::from_fn(120, 1, |k, _| 0.3 * (0.1 * k as f64).sin());
    let mut found = 0;
    // On the way up Newton's model is hardly convex, and its directions are long.
    for max_backtracks in 0..6 {
        let options = Options { max_backtracks, max_iterations: 60, ..Options::default() };
        for row in run(&mut reach.search(&within(&[75.0]), options)) {
            let falls_back = matches!(row.fallback, Some(Fallback::NoStep { .. }));
            if falls_back && row.step_length > 0.0 {
                assert!(row.method != Method::Newton && row.cost < row.cost_before, "{row:?}");
                found += 1;
            }
        }
    }
    assert!(found > 0);
}

fn stuck(search: &mut Optimizer) -> (Stuck, String) {
    run(search);
    match search.status() {
        Status::Stuck(stuck) => (stuck, stuck.to_string()),
        other => panic!("{other:?}"),
    }
}

/// What a message advises makes the search converge.
#[test]
fn a_search_that_stops_early_says_what_helps() {
    let reach = Reach::cart();
    let bounds = within(&reach.limits(0.5));
    let few = Options { max_iterations: 6, ..Options::default() };
    let mut search = reach.search(&bounds, few);
    let (stopped, text) = stuck(&mut search);
    let Stuck::MaxIterations { bounds: Some(state), .. } = stopped else { panic!("{text}") };
    assert!(state.error > state.tolerance && state.tolerance == 1e-6, "{text}");
    assert!(text.contains("bound_tolerance") && text.contains("go on from the checkpoint"));
    let (plant, cost, options) = (reach.plant.clone(), reach.cost.clone(), Options::default());
    let checkpoint = search.checkpoint();
    let mut resumed = Optimizer::resume(plant, cost, &bounds, None, options, &checkpoint).unwrap();
    run(&mut resumed);
    assert_eq!(resumed.status(), Status::Converged);

    // A rule that no quadratic cost can meet.
    let strict = Options { alpha: 0.99, max_backtracks: 0, ..Options::default() };
    let (stopped, text) = stuck(&mut reach.search(&bounds, strict.clone()));
    let Stuck::NoDescent { derivative, bounds: Some(state), .. } = stopped else {
        panic!("{text}")
    };
    assert!(state.error == 0.0 && text.contains("a tolerance above"), "{text}");
    let tolerance = Some(1.01 * derivative.abs());
    let mut search = reach.search(&bounds, Options { tolerance, ..strict.clone() });
    run(&mut search);
    assert_eq!(search.status(), Status::Converged);

    // No tolerance makes an optimum of what is out of bounds.
    let mut outside = Reach::cart();
    outside.guess.fill(30.0);
    let (stopped, text) = stuck(&mut outside.search(&bounds, strict));
    assert!(matches!(stopped, Stuck::NoDescent { .. }), "{text}");
    assert!(text.contains("begin with a guess that meets it"), "{text}");
    assert!(!text.contains("a tolerance above"), "{text}");

    // It cannot be home in time with this force.
    let home = Bound { index: 0, min: Some(0.0), max: Some(0.0) };
    let bounds = Bounds { final_state: vec![home], ..within(&reach.limits(0.2)) };
    let (stopped, text) = stuck(&mut reach.search(&bounds, Options::default()));
    let Stuck::BoundsNotMet(state) = stopped else { panic!("{text}") };
    assert!(state.violation > 0.1 && state.penalty > 1e5, "{text}");
    assert!(text.contains("widen the bounds"), "{text}");
}
