//! Times time-varying regulators: that of the marionette along the paper's experiment (1001 steps, 80
//! states, 18 inputs), and one of the size of the pendulum's optimisation (100 steps, 2 states, 1 input).
//!
//! `cargo run --release -p plantd-control --example riccati_speed [FILE]`
//!
//! Each figure is the least CPU time of several solutions, gains and conditions included. With a file
//! name the marionette's matrices are written there, for numpy to solve the same problem in the same
//! run:
//!
//! ```text
//! python3 tests/oracles/riccati_speed.py FILE
//! ```

use std::error::Error;
use std::f64::consts::PI;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::sync::Arc;

use nalgebra::DMatrix;
use plantd_control::{
    FiniteHorizon, Sample, Tangent, TrajectoryWeights, Values, Weights, finite_horizon,
    finite_horizon_on_manifold,
};
use plantd_models::{ForceSplit, Initial, Linearization, Model, Plant, Settings, builtin};
use rustix::time::{ClockId, clock_gettime};

const TIME_STEP_S: f64 = 0.01;
const STEPS: usize = 1001;
const PASSES: usize = 9;

fn main() -> Result<(), Box<dyn Error>> {
    let model = Arc::new(Model::compile(&builtin::scene("marionette").ok_or("no such scene")?)?);
    let d = model.dimensions();
    let (samples, tangents) = reference(&model)?;
    let mut q = vec![100.0; d.coordinates()];
    q.resize(d.state(), 1.0);
    let weights = TrajectoryWeights::from(Weights::diagonal(&q, &vec![1.0; d.input()])?);
    if let Some(path) = std::env::args().nth(1) {
        write(&path, &samples, &q)?;
    }
    let full = report("marionette", || Ok(finite_horizon(&samples, &weights, Values::Drop)?))?;
    println!("  norm of the first gain {:.12}", full.gains[0].norm());
    let on_manifold =
        || Ok(finite_horizon_on_manifold(&samples, &tangents, &weights, Values::Drop)?);
    report("marionette, on its manifold", on_manifold)?;

    let sample = Sample {
        a: DMatrix::from_row_slice(2, 2, &[0.953, 0.0977, -0.933, 0.953]),
        b: DMatrix::from_column_slice(2, 1, &[0.00977, 0.0953]),
    };
    let small = vec![sample; 100];
    let weights = TrajectoryWeights::from(Weights::diagonal(&[1000.0, 1.0], &[50.0])?);
    report("pendulum, 100 steps", || Ok(finite_horizon(&small, &weights, Values::Drop)?))?;
    Ok(())
}

fn report(
    name: &str,
    mut solve: impl FnMut() -> Result<FiniteHorizon, Box<dyn Error>>,
) -> Result<FiniteHorizon, Box<dyn Error>> {
    let mut solution = solve()?;
    let mut least = f64::INFINITY;
    for _ in 0..PASSES {
        let start = cpu_time_s();
        solution = solve()?;
        least = least.min(cpu_time_s() - start);
    }
    let per_step = 1e6 * least / solution.gains.len() as f64;
    println!("{name}: {:.3} ms, {per_step:.2} µs per step", 1e3 * least);
    Ok(solution)
}

fn cpu_time_s() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

/// Linearizations and tangent spaces along the paper's experiment: limbs on strings whose lengths go
/// up and down.
fn reference(model: &Arc<Model>) -> Result<(Vec<Sample>, Vec<Tangent>), Box<dyn Error>> {
    let settings = Settings {
        time_step_s: TIME_STEP_S,
        force_split: ForceSplit::Paper,
        ..Settings::new(model)
    };
    let mut plant = Plant::new(model.clone(), settings)?;
    let dynamic = model.dimensions().dynamic;
    let q: Vec<f64> = model.coordinates().iter().map(|c| c.initial).collect();
    plant.initialize(&Initial::TwoConfigurations { q0: q.clone(), q1: q.clone() })?;
    let mut linearization = Linearization::new(model);
    let (mut samples, mut tangents) = (Vec::new(), Vec::new());
    for k in 0..STEPS {
        let mut u = q[dynamic..].to_vec();
        for (name, sign) in
            [("left_leg", -1.0), ("right_leg", 1.0), ("left_arm", 1.0), ("right_arm", -1.0)]
        {
            let name = format!("{name}_string_length");
            let index = model.coordinate_index(&name).ok_or("no such coordinate")?;
            u[index - dynamic] += sign * 0.1 * (0.6 * PI * k as f64 * TIME_STEP_S).sin();
        }
        tangents.push(Tangent::new(&plant.constraint_jacobian(), dynamic));
        plant.step_and_linearize(&u, &mut linearization)?;
        samples.push(Sample { a: linearization.a(), b: linearization.b() });
    }
    tangents.push(Tangent::new(&plant.constraint_jacobian(), dynamic));
    Ok((samples, tangents))
}

/// Steps, states, inputs, the diagonal of Q, then A and B of each step, row by row, as doubles.
fn write(path: &str, samples: &[Sample], q: &[f64]) -> std::io::Result<()> {
    let mut file = BufWriter::new(File::create(path)?);
    let inputs = samples.first().map_or(0, |sample| sample.b.ncols());
    let sizes = [samples.len() as f64, q.len() as f64, inputs as f64];
    let mut put = |number: &f64| file.write_all(&number.to_le_bytes());
    sizes.iter().chain(q).try_for_each(&mut put)?;
    for sample in samples {
        // Columns of the transpose are rows.
        sample.a.transpose().iter().chain(sample.b.transpose().iter()).try_for_each(&mut put)?;
    }
    file.flush()
}
