//! Times trajectory optimisations beside the figures of trep, the paper's software, and the phases of an
//! iteration of the marionette.
//!
//! `cargo run --release -p plantd-control --example optimize_speed`
//!
//! CPU time of one thread, the least of a few passes; with two threads, elapsed time. trep's figures were
//! taken on a two-core AMD EPYC virtual machine where the step of the marionette took 10 µs: compare the
//! step printed first.

use std::error::Error;
use std::f64::consts::PI;
use std::sync::Arc;

use nalgebra::DMatrix;
use plantd_control::optimize::{Bounds, Method, Optimizer, Options, Status, TrajectoryCost};
use plantd_control::{Momentum, Sample, Values, Weights, finite_horizon};
use plantd_models::{
    Contraction, ForceSplit, Initial, Linearization, Model, Plant, Settings, builtin,
};

type Outcome<T> = Result<T, Box<dyn Error>>;

fn main() -> Outcome<()> {
    println!("{:<72} {:>10} {:>10} {:>8}", "", "ms", "trep/ms", "ratio");
    let row = |name: &str, ms: f64, trep: Option<f64>| {
        let beside = trep.map_or(String::new(), |t| format!("{t:>10.1} {:>8.0}", t / ms));
        println!("{name:<72} {ms:>10.3} {beside}");
    };
    for (name, method, near_last_step, passes, trep) in [
        ("pendulum, second order", Method::Newton, false, 20, Some(520.0)),
        ("pendulum, first order", Method::Steepest, false, 3, Some(31_700.0)),
        ("pendulum, first order, steps near the last", Method::Steepest, true, 3, Some(31_700.0)),
    ] {
        let mut count = 0;
        let ms = least(passes, || {
            let mut search = pendulum(method, near_last_step)?;
            let begin = cpu_time_s();
            count = 0;
            while search.status() == Status::Running {
                search.iterate(&mut || true)?;
                count += 1;
            }
            Ok(cpu_time_s() - begin)
        })?;
        row(&format!("{name}, {count} iterations"), ms, trep);
    }
    let marionette = Marionette::new()?;
    marionette.phases(row)?;
    for (name, method, threads) in [
        ("quasi-Newton", Method::QuasiNewton, 1),
        ("quasi-Newton", Method::QuasiNewton, 2),
        ("Newton", Method::Newton, 1),
        ("Newton", Method::Newton, 2),
    ] {
        for is_paper in [false, true] {
            let mut name = format!("marionette, {name} iteration, {threads} threads");
            if is_paper {
                name.push_str(", projection of its own");
            }
            let mut fallback = String::new();
            let ms = least(5, || {
                // Near the end, where steps are not shortened; the second iteration, with warm caches.
                let mut search = marionette.search(method, is_paper)?;
                search.set_threads(threads);
                search.iterate(&mut || true)?;
                let clock = if threads == 1 { cpu_time_s } else { elapsed_s };
                let begin = clock();
                let progress = search.iterate(&mut || true)?;
                let time = clock() - begin;
                let tried = |_| format!(" (tried, then {:?})", progress.method);
                fallback = progress.fallback.map_or(String::new(), tried);
                Ok(time)
            })?;
            row(&format!("{name}{fallback}"), ms, Some(1600.0));
        }
    }
    Ok(())
}

/// The swing-up of the paper.
fn pendulum(method: Method, near_last_step: bool) -> Outcome<Optimizer> {
    let model = Arc::new(Model::compile(&builtin::scene("pendulum").ok_or("no scene")?)?);
    let force_split = ForceSplit::Paper;
    let settings = Settings { time_step_s: 0.1, force_split, ..Settings::new(&model) };
    let mut plant = Plant::new(model, settings)?;
    plant.initialize(&Initial::Momentum { q: vec![0.0], p: vec![0.0], v: vec![] })?;
    let cost = TrajectoryCost {
        x: DMatrix::from_fn(101, 2, |k, i| if i == 0 && k >= 50 { PI } else { 0.0 }),
        u: DMatrix::zeros(100, 1),
        weights: Weights::diagonal(&[1000.0, 1.0], &[50.0])?.into(),
        momentum: Momentum::State,
    };
    let options = Options {
        method,
        first_method: Some(Method::QuasiNewton),
        first_iterations: 4,
        max_iterations: 5000,
        tolerance: Some(1e-6),
        near_last_step,
        projection: Some(Weights::diagonal(&[1.0; 2], &[1.0])?),
        ..Options::default()
    };
    let guess = DMatrix::zeros(100, 1);
    Ok(Optimizer::new(plant, guess, cost, &Bounds::default(), None, options)?)
}

/// The optimisation of `tests/reference/golden/marionette_optimization.json`, near its end.
struct Marionette {
    plant: Plant,
    cost: TrajectoryCost,
    inputs: DMatrix<f64>,
}

const STEPS: usize = 1001;

impl Marionette {
    fn new() -> Outcome<Self> {
        let model = Arc::new(Model::compile(&builtin::scene("marionette").ok_or("no scene")?)?);
        let force_split = ForceSplit::Paper;
        let settings = Settings { time_step_s: 0.01, force_split, ..Settings::new(&model) };
        let d = model.dimensions();
        let mut plant = Plant::new(Arc::clone(&model), settings)?;
        let strings = &model.coordinates()[d.dynamic..];
        let rows = |swing: f64| {
            DMatrix::from_fn(STEPS, strings.len(), |k, j| {
                let sign = match strings[j].name.as_str() {
                    "left_leg_string_length" | "right_arm_string_length" => -1.0,
                    "right_leg_string_length" | "left_arm_string_length" => 1.0,
                    _ => 0.0,
                };
                strings[j].initial + swing * sign * (0.6 * PI * 0.01 * k as f64).sin()
            })
        };
        let reference = rows(0.1);
        let q = plant.q().to_vec();
        plant.initialize(&Initial::TwoConfigurations { q0: q.clone(), q1: q.clone() })?;
        let mut x = DMatrix::zeros(STEPS + 1, d.state());
        for k in 0..=STEPS {
            x.view_mut((k, 0), (1, d.coordinates())).copy_from_slice(plant.q());
            if k < STEPS {
                plant.step(reference.row(k).transpose().as_slice())?;
            }
        }
        let (p, v) = (vec![0.0; d.dynamic], vec![0.0; d.prescribed]);
        plant.initialize(&Initial::Momentum { q, p, v })?;
        let mut weights = vec![100.0; d.dynamic];
        weights.resize(d.state(), 1.0);
        let weights = Weights::diagonal(&weights, &vec![0.1; d.input()])?;
        let cost = TrajectoryCost {
            x,
            u: DMatrix::zeros(STEPS, d.input()),
            weights: weights.into(),
            momentum: Momentum::State,
        };
        let mut marionette = Self { plant, cost, inputs: rows(0.0) };
        let mut search = marionette.search(Method::QuasiNewton, false)?;
        for _ in 0..3 {
            search.iterate(&mut || true)?;
        }
        marionette.inputs = search.inputs();
        Ok(marionette)
    }

    /// With a projection of its own, whose weights are the paper's, or with the law of the descent.
    fn search(&self, method: Method, is_paper: bool) -> Outcome<Optimizer> {
        let (plant, cost) = (self.plant.clone(), self.cost.clone());
        let d = plant.model().dimensions();
        let identities = Weights::diagonal(&vec![1.0; d.state()], &vec![1.0; d.input()])?;
        let options = Options {
            method,
            first_method: Some(Method::QuasiNewton),
            first_iterations: 1,
            tolerance: Some(1e-9),
            projection: is_paper.then_some(identities),
            ..Options::default()
        };
        let bounds = Bounds::default();
        Ok(Optimizer::new(plant, self.inputs.clone(), cost, &bounds, None, options)?)
    }

    fn phases(&self, row: impl Fn(&str, f64, Option<f64>)) -> Outcome<()> {
        let model = Arc::clone(self.plant.model());
        let d = model.dimensions();
        let inputs: Vec<Vec<f64>> =
            self.inputs.row_iter().map(|row| row.iter().copied().collect()).collect();
        let run = |linearize: bool| {
            let (mut plant, mut out) = (self.plant.clone(), Linearization::new(&model));
            let begin = cpu_time_s();
            for u in &inputs {
                if linearize {
                    plant.step_and_linearize(u, &mut out)?;
                } else {
                    plant.step(u)?;
                }
            }
            Ok(cpu_time_s() - begin)
        };
        let roll_out = least(5, || run(false))?;
        row("marionette, roll-out of 1001 steps", roll_out, Some(1317.0));
        let both = least(5, || run(true))?;
        row("marionette, linearization along it", both - roll_out, Some(598.0));

        let (mut plant, mut out) = (self.plant.clone(), Linearization::new(&model));
        let mut contraction = Contraction::new(&model);
        let (mut samples, mut contracting) = (Vec::new(), 0.0);
        let z: Vec<f64> = (0..d.state()).map(|i| (i as f64 + 1.0).sin()).collect();
        for u in &inputs {
            plant.step_and_linearize(u, &mut out)?;
            samples.push(Sample { a: out.a(), b: out.b() });
            let begin = cpu_time_s();
            contraction.contract(&model, &out, &z, &vec![0.0; d.constraints])?;
            contracting += cpu_time_s() - begin;
        }
        let weights = Weights::diagonal(&vec![1.0; d.state()], &vec![1.0; d.input()])?.into();
        let regulator = least(3, || {
            let begin = cpu_time_s();
            finite_horizon(&samples, &weights, Values::Drop)?;
            Ok(cpu_time_s() - begin)
        })?;
        row("marionette, regulator along it", regulator, Some(170.0));
        row("marionette, contraction along it", 1e3 * contracting, None);
        Ok(())
    }
}

/// CPU time of this thread: other programs on the machine do not count.
fn cpu_time_s() -> f64 {
    seconds(rustix::time::ClockId::ThreadCPUTime)
}

fn elapsed_s() -> f64 {
    seconds(rustix::time::ClockId::Monotonic)
}

fn seconds(clock: rustix::time::ClockId) -> f64 {
    let time = rustix::time::clock_gettime(clock);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

/// The least of several times, ms.
fn least(passes: usize, mut pass: impl FnMut() -> Outcome<f64>) -> Outcome<f64> {
    let mut best = f64::INFINITY;
    for _ in 0..passes {
        best = best.min(pass()?);
    }
    Ok(1e3 * best)
}
