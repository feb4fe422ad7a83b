//! Directions against differences of the projected cost.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use plantd_models::{ForceSplit, Model, Plant, Scene, Settings, builtin};

use crate::optimize::options::{Method, Options};
use crate::optimize::search::Optimizer;
use crate::optimize::specification::{Bound, Bounds, FreeInitialState, TrajectoryCost};
use crate::weights::{Momentum, StageWeights, TrajectoryWeights, Weights};

const STEPS: usize = 12;

fn wave(i: usize, j: usize, phase: f64) -> f64 {
    (1.3 * i as f64 + 2.7 * j as f64 + phase).sin()
}

/// Symmetric, and positive definite.
fn definite(n: usize, phase: f64) -> DMatrix<f64> {
    let m = DMatrix::from_fn(n, n, |i, j| 0.3 * wave(i, j, phase));
    &m * m.transpose() + DMatrix::identity(n, n)
}

/// A motion with inputs that wave, and a cost with all terms, different at each step.
struct Case {
    model: Arc<Model>,
    split: ForceSplit,
    bounds: Bounds,
    free: Option<FreeInitialState>,
    multipliers: f64,
    projection: Option<Weights>,
    momentum: Momentum,
    /// The desired motion is the one at hand, and the cost bends it by linear terms of the input alone.
    is_reached: bool,
}

impl Case {
    fn new(model: Arc<Model>, split: ForceSplit) -> Self {
        let (bounds, free) = (Bounds::default(), None);
        let (multipliers, projection, momentum) = (0.0, None, Momentum::State);
        let is_reached = false;
        Self { model, split, bounds, free, multipliers, projection, momentum, is_reached }
    }

    fn search(&self) -> Optimizer {
        let model = &self.model;
        let d = model.dimensions();
        let (n, m) = (d.state(), d.input());
        let settings = Settings { force_split: self.split, ..Settings::new(model) };
        let plant = Plant::new(Arc::clone(model), settings).unwrap();
        let mut held = vec![0.0; m];
        plant.hold_input(&mut held);
        let guess = DMatrix::from_fn(STEPS, m, |k, j| {
            let size = if j < d.inputs { 0.5 } else { 1e-3 };
            held[j] + size * (wave(k, j, 0.0) - wave(0, j, 0.0))
        });
        let stage = |k: usize| {
            let (q, r) = (definite(n, k as f64), definite(m, 0.5 + k as f64));
            let s = DMatrix::from_fn(n, m, |i, j| 0.05 * wave(i, j, k as f64));
            let size = if self.is_reached { 0.0 } else { 1.0 };
            let x_linear = DVector::from_fn(n, |i, _| size * wave(i, k, 1.0));
            let u_linear = DVector::from_fn(m, |i, _| wave(i, k, 2.0));
            StageWeights::symmetric(q, r, Some(s), Some(x_linear), Some(u_linear)).unwrap()
        };
        let weights =
            TrajectoryWeights::per_step((0..STEPS).map(stage).collect(), definite(n, 0.1)).unwrap();
        let start = plant.state().x();
        let mut x = DMatrix::from_fn(STEPS + 1, n, |k, i| start[i] + 0.2 * wave(k, i, 0.7));
        let mut u = DMatrix::from_fn(STEPS, m, |k, j| held[j] + 0.1 * wave(k, j, 0.3));
        if self.is_reached {
            let mut plant = plant.clone();
            for k in 0..=STEPS {
                x.row_mut(k).copy_from_slice(&plant.state().x());
                if k < STEPS {
                    let input: Vec<f64> = guess.row(k).iter().copied().collect();
                    plant.step(&input).unwrap();
                }
            }
            u.copy_from(&guess);
        }
        let cost = TrajectoryCost { x, u, weights, momentum: self.momentum };
        let options = Options { projection: self.projection.clone(), ..Options::default() };
        let mut search =
            Optimizer::new(plant, guess, cost, &self.bounds, self.free.clone(), options).unwrap();
        search.set_multipliers(self.multipliers);
        search
    }

    fn name(&self) -> String {
        format!("{}, {:?}", self.model.scene().name, self.split)
    }

    /// The derivative along the direction of each method, and the second one along that of Newton.
    /// Whether there was the latter; of free starts, the former.
    fn check(&self) -> bool {
        let mut search = self.search();
        let name = self.name();
        let (mut was_newton, mut differentiated) = (false, false);
        for method in [Method::Steepest, Method::QuasiNewton, Method::Newton] {
            let Some((slope, curvature)) = search.direction(method) else {
                // Not convex far from a minimum: that is what the others are for.
                assert!(method == Method::Newton, "{name}: {method:?}");
                continue;
            };
            // The size of the direction sets the length of differences.
            let delta = 2e-3 / search.size_of_direction();
            let costs = (-3..=3).map(|i| search.merit_at(f64::from(i) * delta));
            let Some(costs) = costs.collect::<Option<Vec<f64>>>() else {
                // A free start in a place where constraints leave nowhere to go.
                assert!(self.free.is_some(), "{name}: {method:?}");
                continue;
            };
            differentiated = true;
            let first = [-1.0 / 60.0, 0.15, -0.75, 0.0, 0.75, -0.15, 1.0 / 60.0];
            let second = [1.0 / 90.0, -0.15, 1.5, -49.0 / 18.0, 1.5, -0.15, 1.0 / 90.0];
            let sum =
                |weights: [f64; 7]| costs.iter().zip(weights).map(|(c, w)| c * w).sum::<f64>();
            let (found, bent) = (sum(first) / delta, sum(second) / (delta * delta));
            let noise = 1e-14 * costs[3].abs();
            let allowed = 1e-6 * slope.abs() + noise / delta;
            assert!((found - slope).abs() <= allowed, "{name} {method:?}: {found} {slope}");
            let bent_bounds =
                self.bounds != Bounds::default() && !self.model.orientations().is_empty();
            let leaves_out_curvature = self.momentum == Momentum::Projected && !self.is_reached;
            let exact = method == Method::Newton
                && self.free.is_none()
                && !bent_bounds
                && !leaves_out_curvature;
            was_newton |= exact;
            let allowed = 1e-5 * curvature.abs() + 30.0 * noise / (delta * delta);
            if exact {
                assert!((bent - curvature).abs() <= allowed, "{name}: {bent} {curvature}");
            }
        }
        if self.free.is_some() { differentiated } else { was_newton }
    }
}

fn scene(name: &str) -> Arc<Model> {
    Arc::new(Model::compile(&builtin::scene(name).unwrap()).unwrap())
}

/// Models of all elements, and some built-in ones.
fn models() -> Vec<Arc<Model>> {
    let builtin =
        ["pendulum", "cart-pole", "double-pendulum", "four-bar", "scissor-4", "marionette"];
    let elements = concat!(env!("CARGO_MANIFEST_DIR"), "/../scenes/elements");
    let elements = std::fs::read_dir(elements).unwrap().map(|file| {
        let text = std::fs::read_to_string(file.unwrap().path()).unwrap();
        Arc::new(Model::compile(&Scene::from_toml(&text).unwrap()).unwrap())
    });
    elements.chain(builtin.map(scene)).collect()
}

#[test]
fn derivatives_of_the_projected_cost_along_the_directions() {
    let mut newton = 0;
    let models = models();
    for model in &models {
        for split in [ForceSplit::Symmetric, ForceSplit::Paper] {
            let d = model.dimensions();
            let ones = [d.state(), d.input()].map(|n| vec![1.0; n]);
            for projection in [None, Some(Weights::diagonal(&ones[0], &ones[1]).unwrap())] {
                let case = Case { projection, ..Case::new(Arc::clone(model), split) };
                newton += usize::from(case.check());
            }
        }
    }
    assert!(newton > 2 * models.len(), "{newton} of {}", 4 * models.len());
}

/// Second derivatives leave out the curvature of the projected momentum alone, which does not count where
/// the desired motion is reached.
#[test]
fn derivatives_with_the_projected_momentum() {
    let (mut newton, mut free) = (0, 0);
    let mut models = models();
    models.retain(|model| model.dimensions().constraints > 0);
    for model in &models {
        let d = model.dimensions();
        let start = Plant::new(Arc::clone(model), Settings::new(model)).unwrap().state().x();
        // Violated throughout, of the state's own momentum.
        let momentum = d.momentum().start;
        let bound = Bound { index: momentum, min: None, max: Some(start[momentum] - 20.0) };
        let bounded = Bounds { states: vec![bound], ..Bounds::default() };
        for (is_reached, bounds) in
            [(false, Bounds::default()), (true, Bounds::default()), (true, bounded)]
        {
            let case = Case::new(Arc::clone(model), ForceSplit::Symmetric);
            let momentum = Momentum::Projected;
            newton += usize::from(Case { momentum, is_reached, bounds, ..case }.check());
        }
        let mut case = Case::new(Arc::clone(model), ForceSplit::Symmetric);
        case.momentum = Momentum::Projected;
        case.free = Some(FreeInitialState { entries: vec![], weight: None });
        free += usize::from(case.check());
    }
    let count = models.len();
    assert!(count > 8 && newton > count && 2 * free > count, "{newton} {free} of {count}");
}

#[test]
fn derivatives_with_bounds() {
    let mut newton = 0;
    let models = models();
    for model in &models {
        let mut case = Case::new(Arc::clone(model), ForceSplit::Symmetric);
        let start = Plant::new(Arc::clone(model), Settings::new(model)).unwrap().state().x();
        let bound = |index, min, max| Bound { index, min, max };
        // Violated throughout, slack throughout, and an equation: away from every kink.
        let last = start.len() - 1;
        case.bounds.states =
            vec![bound(0, None, Some(start[0] - 2.0)), bound(last, Some(start[last] - 20.0), None)];
        case.bounds.final_state = vec![bound(0, Some(start[0] + 0.1), Some(start[0] + 0.1))];
        if model.dimensions().input() > 0 {
            case.bounds.inputs = vec![bound(0, Some(10.0), Some(20.0))];
        }
        case.multipliers = 0.3;
        newton += usize::from(case.check());
    }
    assert!(newton > models.len() / 3, "{newton} of {}", models.len());
}

#[test]
fn derivatives_with_a_free_initial_state() {
    let (mut cases, mut differentiated) = (0, 0);
    for model in models() {
        let states = model.dimensions().state();
        for entries in [vec![], (0..states).filter(|i| i % 3 != 0).collect()] {
            let mut case = Case::new(Arc::clone(&model), ForceSplit::Symmetric);
            case.free = Some(FreeInitialState { entries, weight: Some(definite(states, 0.2)) });
            differentiated += usize::from(case.check());
            cases += 1;
        }
    }
    assert!(10 * differentiated > 9 * cases, "{differentiated} of {cases}");
}
