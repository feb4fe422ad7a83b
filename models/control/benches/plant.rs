//! `cargo bench -p plantd-control [-- FILTER]`: steps, linearizations, contracted second order, regulators,
//! and many plants of one model on one thread.
//!
//! CPU time of the thread, so that other programs on the machine count little. Compare ratios.

use std::error::Error;
use std::sync::Arc;
use std::time::Duration;

use criterion::measurement::{Measurement, ValueFormatter, WallTime};
use criterion::{BenchmarkId, Criterion, Throughput};
use plantd_control::{Weights, infinite_horizon};
use plantd_models::{Contraction, Linearization, Model, Plant, Settings, Snapshot, builtin};
use rustix::time::{ClockId, clock_gettime};

const SMALL: &[&str] = &[
    "pendulum",
    "spherical-pendulum",
    "four-bar",
    "scissor-8",
    "marionette",
    "chain-1",
    "chain-2",
    "chain-4",
    "chain-8",
    "chain-16",
    "chain-32",
    "tree-7",
    "tree-15",
    "tree-30",
];
const MIDDLE: &[&str] =
    &["chain-64", "chain-128", "tree-63", "tree-127", "scissor-16", "scissor-32", "scissor-64"];
const LARGE: &[&str] =
    &["chain-256", "chain-512", "chain-1024", "tree-255", "tree-511", "tree-1023"];

/// Steps after which a plant starts again.
const PASS: u64 = 50;

fn main() -> Result<(), Box<dyn Error>> {
    let mut criterion = Criterion::default()
        .with_measurement(CpuTime(WallTime))
        .sample_size(10)
        .warm_up_time(Duration::from_millis(100))
        .measurement_time(Duration::from_millis(300))
        .configure_from_args();
    for name in [SMALL, MIDDLE, LARGE].concat() {
        step(&mut criterion, name)?;
    }
    for name in [SMALL, MIDDLE, LARGE].concat() {
        step_and_linearize(&mut criterion, name)?;
    }
    for name in [SMALL, MIDDLE].concat() {
        contract(&mut criterion, name)?;
    }
    for name in ["pendulum", "chain-4", "chain-8", "chain-16", "tree-7", "tree-15"] {
        regulator(&mut criterion, name)?;
    }
    many_plants(&mut criterion)?;
    criterion.final_summary();
    Ok(())
}

type Bencher = Criterion<CpuTime>;

fn step(criterion: &mut Bencher, name: &str) -> Result<(), Box<dyn Error>> {
    let mut motion = Motion::new(name)?;
    criterion.bench_function(&format!("step/{name}"), |bencher| {
        bencher.iter(|| {
            motion.go_on();
            motion.plant.step(&motion.input).expect("a built-in scene steps")
        });
    });
    Ok(())
}

fn step_and_linearize(criterion: &mut Bencher, name: &str) -> Result<(), Box<dyn Error>> {
    let mut motion = Motion::new(name)?;
    let mut out = Linearization::new(motion.plant.model());
    criterion.bench_function(&format!("step_and_linearize/{name}"), |bencher| {
        bencher.iter(|| {
            motion.go_on();
            let report = motion.plant.step_and_linearize(&motion.input, &mut out);
            report.expect("a built-in scene steps")
        });
    });
    Ok(())
}

/// At a state in motion; the step and its first derivatives included.
fn contract(criterion: &mut Bencher, name: &str) -> Result<(), Box<dyn Error>> {
    let mut motion = Motion::new(name)?;
    let d = motion.plant.model().dimensions();
    let mut out = Linearization::new(motion.plant.model());
    let mut contraction = Contraction::new(motion.plant.model());
    let (x, multipliers) = (vec![1.0; d.state()], vec![1.0; d.constraints]);
    for _ in 0..PASS / 2 {
        motion.plant.step(&motion.input)?;
    }
    let Motion { plant, input, .. } = &mut motion;
    criterion.bench_function(&format!("contract_second_order/{name}"), |bencher| {
        bencher.iter(|| {
            let report =
                plant.contract_second_order(input, &x, &multipliers, &mut out, &mut contraction);
            report.expect("a built-in scene steps")
        });
    });
    Ok(())
}

fn regulator(criterion: &mut Bencher, name: &str) -> Result<(), Box<dyn Error>> {
    let mut motion = Motion::new(name)?;
    let d = motion.plant.model().dimensions();
    let mut out = Linearization::new(motion.plant.model());
    motion.plant.linearize(&motion.input, &mut out)?;
    let (a, b) = (out.a(), out.b());
    let weights = Weights::diagonal(&vec![1.0; d.state()], &vec![1.0; d.input()])?;
    criterion.bench_function(&format!("infinite_horizon/{name}"), |bencher| {
        bencher.iter(|| infinite_horizon(&a, &b, &weights).expect("a regulator"));
    });
    Ok(())
}

/// Steps of many plants of one model: each plant's one after another, or all plants side by side.
fn many_plants(criterion: &mut Bencher) -> Result<(), Box<dyn Error>> {
    let mut group = criterion.benchmark_group("many_plants");
    for name in ["pendulum", "chain-8"] {
        for count in [1_u64, 1000] {
            let first = Motion::new(name)?;
            let mut plants = vec![first.plant.clone(); count as usize];
            let Motion { start, input, .. } = first;
            group.throughput(Throughput::Elements(count * PASS));
            let id = BenchmarkId::new(format!("{name}, one after another"), count);
            group.bench_function(id, |bencher| {
                bencher.iter(|| {
                    for plant in &mut plants {
                        plant.restore(&start).expect("it is a state of the plant");
                        for _ in 0..PASS {
                            plant.step(&input).expect("a built-in scene steps");
                        }
                    }
                });
            });
            let id = BenchmarkId::new(format!("{name}, side by side"), count);
            group.bench_function(id, |bencher| {
                bencher.iter(|| {
                    for plant in &mut plants {
                        plant.restore(&start).expect("it is a state of the plant");
                    }
                    for _ in 0..PASS {
                        for plant in &mut plants {
                            plant.step(&input).expect("a built-in scene steps");
                        }
                    }
                });
            });
        }
    }
    group.finish();
    Ok(())
}

/// A plant that starts again after [`PASS`] steps.
struct Motion {
    plant: Plant,
    start: Snapshot,
    input: Vec<f64>,
}

impl Motion {
    fn new(name: &str) -> Result<Self, Box<dyn Error>> {
        let scene = builtin::scene(name).ok_or("no such scene")?;
        let model = Arc::new(Model::compile(&scene)?);
        let plant = Plant::new(Arc::clone(&model), Settings::new(&model))?;
        let mut input = vec![0.0; model.dimensions().input()];
        plant.hold_input(&mut input);
        Ok(Self { start: plant.snapshot(), plant, input })
    }

    fn go_on(&mut self) {
        if self.plant.step_index() == PASS {
            self.plant.restore(&self.start).expect("it is a state of the plant");
        }
    }
}

/// CPU time of this thread.
struct CpuTime(WallTime);

impl Measurement for CpuTime {
    type Intermediate = Duration;
    type Value = Duration;

    fn start(&self) -> Duration {
        let time = clock_gettime(ClockId::ThreadCPUTime);
        Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
    }

    fn end(&self, start: Duration) -> Duration {
        self.start() - start
    }

    fn add(&self, a: &Duration, b: &Duration) -> Duration {
        *a + *b
    }

    fn zero(&self) -> Duration {
        Duration::ZERO
    }

    fn to_f64(&self, value: &Duration) -> f64 {
        value.as_nanos() as f64
    }

    fn formatter(&self) -> &dyn ValueFormatter {
        self.0.formatter()
    }
}
