//! Calls one operation of a plant again and again, for a profiler that counts instructions.
//!
//! `step_count SCENE OPERATION COUNT`: SCENE is a built-in scene or a file, OPERATION one of `step`,
//! `linearize`, `step-and-linearize`, `contract`. The calls go through functions that are never inlined and keep
//! their names, so that `valgrind --tool=callgrind --toggle-collect=measured_call` counts them and
//! nothing else.

use std::error::Error;
use std::sync::Arc;

use plantd_models::{
    Contraction, Linearization, Model, Plant, Scene, Settings, StepError, StepReport, builtin,
};

/// A plant with all that its operations need.
struct Measured {
    plant: Plant,
    input: Vec<f64>,
    out: Linearization,
    weights: Weights,
    contraction: Contraction,
    operation: Operation,
}

/// What second derivatives are contracted with.
struct Weights {
    x: Vec<f64>,
    multipliers: Vec<f64>,
}

#[derive(Clone, Copy)]
enum Operation {
    Step,
    Linearize,
    StepAndLinearize,
    Contract,
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scene, operation, count] = &arguments[..] else {
        return Err(
            "usage: step_count SCENE step|linearize|step-and-linearize|contract COUNT".into()
        );
    };
    let operation = match operation.as_str() {
        "step" => Operation::Step,
        "linearize" => Operation::Linearize,
        "step-and-linearize" => Operation::StepAndLinearize,
        "contract" => Operation::Contract,
        other => return Err(format!("unknown operation `{other}`").into()),
    };
    let scene = match builtin::scene(scene) {
        Some(scene) => scene,
        None => Scene::from_text(&std::fs::read_to_string(scene)?)?,
    };
    let model = Arc::new(Model::compile(&scene)?);
    let mut measured = Measured {
        plant: Plant::new(Arc::clone(&model), Settings::new(&model))?,
        input: vec![0.0; model.dimensions().input()],
        out: Linearization::new(&model),
        weights: Weights {
            x: vec![1.0; model.dimensions().state()],
            multipliers: vec![1.0; model.dimensions().constraints],
        },
        contraction: Contraction::new(&model),
        operation,
    };
    for _ in 0..count.parse::<u32>()? {
        // A linearization stays where it is: move on, so that calls differ as they do in use.
        if matches!(operation, Operation::Linearize | Operation::Contract) {
            measured.plant.hold_input(&mut measured.input);
            measured.plant.step(&measured.input)?;
        }
        measured.plant.hold_input(&mut measured.input);
        measured_call(&mut measured)?;
    }
    Ok(())
}

// SAFETY: no other function of this program has this name.
#[unsafe(no_mangle)]
#[inline(never)]
fn measured_call(measured: &mut Measured) -> Result<StepReport, StepError> {
    let Measured { plant, input, out, weights, contraction, operation } = measured;
    match operation {
        Operation::Step => plant.step(input),
        Operation::Linearize => plant.linearize(input, out),
        Operation::StepAndLinearize => plant.step_and_linearize(input, out),
        Operation::Contract => {
            plant.contract_second_order(input, &weights.x, &weights.multipliers, out, contraction)
        }
    }
}
