//! Calls one operation of a plant again and again, for a profiler that counts instructions.
//!
//! `step_count SCENE OPERATION COUNT`: SCENE is a built-in scene or a file, OPERATION one of `step`,
//! `linearize`, `step-and-linearize`, `contract` (second order, contracted), `riccati` (one step of a
//! time-varying regulator's recursion) and `lqr` (a regulator of the initial configuration). The calls go
//! through functions that are never inlined and keep their names, so that
//! `valgrind --tool=callgrind --toggle-collect=measured_call` counts them and nothing else.

use std::error::Error;
use std::sync::Arc;

use plantd_control::{
    Sample, TrajectoryWeights, Values, Weights, finite_horizon, infinite_horizon,
};
use plantd_models::{Contraction, Linearization, Model, Plant, Scene, Settings, builtin};

/// A plant with all that its operations need.
struct Measured {
    plant: Plant,
    input: Vec<f64>,
    out: Linearization,
    /// What second derivatives are contracted with.
    adjoint: [Vec<f64>; 2],
    contraction: Contraction,
    samples: Vec<Sample>,
    weights: Weights,
    operation: Operation,
}

#[derive(Clone, Copy)]
enum Operation {
    Step,
    Linearize,
    StepAndLinearize,
    Contract,
    Riccati,
    Lqr,
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scene, operation, count] = &arguments[..] else {
        return Err("usage: step_count SCENE OPERATION COUNT".into());
    };
    let operation = match operation.as_str() {
        "step" => Operation::Step,
        "linearize" => Operation::Linearize,
        "step-and-linearize" => Operation::StepAndLinearize,
        "contract" => Operation::Contract,
        "riccati" => Operation::Riccati,
        "lqr" => Operation::Lqr,
        other => return Err(format!("unknown operation `{other}`").into()),
    };
    let count: u32 = count.parse()?;
    let scene = match builtin::scene(scene) {
        Some(scene) => scene,
        None => Scene::from_text(&std::fs::read_to_string(scene)?)?,
    };
    let model = Arc::new(Model::compile(&scene)?);
    let d = model.dimensions();
    let mut measured = Measured {
        plant: Plant::new(Arc::clone(&model), Settings::new(&model))?,
        input: vec![0.0; d.input()],
        out: Linearization::new(&model),
        adjoint: [vec![1.0; d.state()], vec![1.0; d.constraints]],
        contraction: Contraction::new(&model),
        samples: Vec::new(),
        weights: Weights::diagonal(&vec![1.0; d.state()], &vec![1.0; d.input()])?,
        operation,
    };
    for _ in 0..count {
        let Measured { plant, input, out, samples, .. } = &mut measured;
        plant.hold_input(input);
        match operation {
            Operation::Step | Operation::StepAndLinearize => measured_call(&mut measured)?,
            // These stay where they are: move on, so that calls differ as they do in use.
            Operation::Linearize | Operation::Contract => {
                plant.step(input)?;
                plant.hold_input(input);
                measured_call(&mut measured)?;
            }
            Operation::Riccati | Operation::Lqr => {
                plant.step_and_linearize(input, out)?;
                samples.push(Sample { a: out.a(), b: out.b() });
            }
        }
    }
    match operation {
        Operation::Riccati => measured_call(&mut measured)?,
        Operation::Lqr => {
            for _ in 0..count {
                measured_call(&mut measured)?;
            }
        }
        _ => {}
    }
    Ok(())
}

// SAFETY: no other function of this program has this name.
#[unsafe(no_mangle)]
#[inline(never)]
fn measured_call(measured: &mut Measured) -> Result<(), Box<dyn Error>> {
    let Measured { plant, input, out, adjoint, contraction, samples, weights, operation } =
        measured;
    match operation {
        Operation::Step => {
            plant.step(input)?;
        }
        Operation::Linearize => {
            plant.linearize(input, out)?;
        }
        Operation::StepAndLinearize => {
            plant.step_and_linearize(input, out)?;
        }
        Operation::Contract => {
            let [x, multipliers] = adjoint;
            plant.contract_second_order(input, x, multipliers, out, contraction)?;
        }
        Operation::Riccati => {
            let weights = TrajectoryWeights::from(weights.clone());
            std::hint::black_box(finite_horizon(samples, &weights, Values::Drop)?);
        }
        Operation::Lqr => {
            let Sample { a, b } = &samples[0];
            std::hint::black_box(infinite_horizon(a, b, weights)?);
        }
    }
    Ok(())
}
