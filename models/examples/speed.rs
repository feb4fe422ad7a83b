//! Times steps, linearizations, full second-order linearizations and their contractions of the built-in
//! scenes, beside the figures of trep, the paper's software, where there are some.
//!
//! `cargo run --release -p plantd-models --example speed [SCENE ..]`
//!
//! Each figure is the median over several passes of the mean CPU time over one pass of a moving plant,
//! so compare ratios and rerun before quoting one. trep's figures were taken on a two-core AMD EPYC
//! virtual machine.

use std::error::Error;
use std::f64::consts::PI;
use std::sync::Arc;

use plantd_models::{
    Contraction, ForceSplit, Linearization, Model, Plant, SecondOrder, Settings, Snapshot, builtin,
};

const STEPS: usize = 200;
const PASSES: usize = 25;

/// The same for second-order linearizations, which are taken at every so many steps.
const SECOND_PASSES: usize = 5;
const SPACING: usize = 10;

/// Scene, time step in seconds, and trep's step, first and second derivatives in microseconds.
type Row = (&'static str, f64, Option<[f64; 3]>);

const SCENES: &[Row] = &[
    ("pendulum", 0.1, Some([6.3, 0.86, 1.65])),
    ("double-pendulum", 0.01, None),
    ("cart-pole", 0.01, None),
    ("chain-8", 0.01, Some([133.0, 33.0, 214.0])),
    ("chain-32", 0.0025, None),
    ("four-bar", 0.01, None),
    ("scissor-8", 0.01, Some([536.0, 239.0, 3295.0])),
    ("scissor-32", 0.01, None),
    ("marionette", 0.01, Some([1317.0, 598.0, 21_008.0])),
];

fn main() -> Result<(), Box<dyn Error>> {
    println!(
        "{:<16} {:>10} {:>14} {:>14} {:>14} {:>12} {:>11} {:>11} {:>11}",
        "scene",
        "step/µs",
        "+ linearize/µs",
        "+ second/µs",
        "+ contract/µs",
        "iterations",
        "trep/step",
        "trep/linear",
        "trep/second"
    );
    let wanted: Vec<String> = std::env::args().skip(1).collect();
    let is_wanted = |name: &str| wanted.is_empty() || wanted.iter().any(|wanted| wanted == name);
    for (name, time_step_s, trep) in SCENES.iter().filter(|row| is_wanted(row.0)) {
        let scene = builtin::scene(name).ok_or("no such scene")?;
        let mut motion = Motion::new(Arc::new(Model::compile(&scene)?), *time_step_s)?;
        let step = median(PASSES, || motion.pass(false))?;
        let both = median(PASSES, || motion.pass(true))?;
        let second = median(SECOND_PASSES, || motion.second_pass(Form::Full))? - both;
        let contraction = median(SECOND_PASSES, || motion.second_pass(Form::Contracted))? - both;
        let linearize = both - step;
        let ratios = trep.map_or_else(Default::default, |trep| {
            let own = [step, linearize, second];
            [0, 1, 2].map(|i| format!("{:.0}", trep[i] / own[i]))
        });
        println!(
            "{name:<16} {step:>10.2} {linearize:>14.2} {second:>14.2} {contraction:>14.2} {:>12.2} \
             {:>11} {:>11} {:>11}",
            motion.iterations as f64 / motion.steps as f64,
            ratios[0],
            ratios[1],
            ratios[2],
        );
    }
    Ok(())
}

/// Which second-order linearization.
#[derive(Clone, Copy)]
enum Form {
    Full,
    Contracted,
}

/// A plant with the inputs that keep it moving.
struct Motion {
    plant: Plant,
    start: Snapshot,
    inputs: Vec<Vec<f64>>,
    out: Linearization,
    second: SecondOrder,
    contraction: Contraction,
    iterations: u64,
    steps: u64,
}

impl Motion {
    fn new(model: Arc<Model>, time_step_s: f64) -> Result<Self, Box<dyn Error>> {
        let force_split = ForceSplit::Paper;
        let settings = Settings { force_split, time_step_s, ..Settings::new(&model) };
        let plant = Plant::new(Arc::clone(&model), settings)?;
        let mut hold = vec![0.0; model.dimensions().input()];
        plant.hold_input(&mut hold);
        let lengths: Vec<(usize, f64)> = model.coordinates()[model.dimensions().dynamic..]
            .iter()
            .enumerate()
            .filter_map(|(k, c)| Some((model.dimensions().inputs + k, swing(&c.name)?)))
            .collect();
        let inputs = (0..STEPS)
            .map(|k| {
                let mut u = hold.clone();
                let time = k as f64 * settings.time_step_s;
                for (index, amplitude) in &lengths {
                    u[*index] += amplitude * (0.6 * PI * time).sin();
                }
                u
            })
            .collect();
        let start = plant.snapshot();
        Ok(Self {
            plant,
            start,
            inputs,
            out: Linearization::new(&model),
            second: SecondOrder::new(&model)?,
            contraction: Contraction::new(&model),
            iterations: 0,
            steps: 0,
        })
    }

    /// Mean time of a step in microseconds.
    fn pass(&mut self, linearize: bool) -> Result<f64, Box<dyn Error>> {
        self.plant.restore(&self.start)?;
        let begin = cpu_time_s();
        for u in &self.inputs {
            let report = if linearize {
                self.plant.step_and_linearize(u, &mut self.out)?
            } else {
                self.plant.step(u)?
            };
            self.iterations += u64::from(report.iterations);
            self.steps += 1;
        }
        Ok((cpu_time_s() - begin) * 1e6 / self.inputs.len() as f64)
    }
}

impl Motion {
    /// Mean time of a step with a second-order linearization in microseconds.
    fn second_pass(&mut self, form: Form) -> Result<f64, Box<dyn Error>> {
        self.plant.restore(&self.start)?;
        let d = self.plant.model().dimensions();
        let z: Vec<f64> = (0..d.state()).map(|i| (i as f64 + 1.0).sin()).collect();
        let w = vec![1.0; d.constraints];
        let (mut total, mut count) = (0.0, 0);
        for (k, u) in self.inputs.iter().enumerate() {
            if k % SPACING == 0 {
                let begin = cpu_time_s();
                let (plant, first) = (&mut self.plant, &mut self.out);
                match form {
                    Form::Full => plant.linearize_second_order(u, first, &mut self.second)?,
                    Form::Contracted => {
                        plant.contract_second_order(u, &z, &w, first, &mut self.contraction)?
                    }
                };
                total += cpu_time_s() - begin;
                count += 1;
            }
            self.plant.step(u)?;
        }
        Ok(total * 1e6 / f64::from(count))
    }
}

/// CPU time of this thread: other programs on the machine do not count.
fn cpu_time_s() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

/// How far the string of that name is pulled and let go, m: the paper's reference motion.
fn swing(name: &str) -> Option<f64> {
    match name {
        "left_leg_string_length" | "right_arm_string_length" => Some(-0.1),
        "right_leg_string_length" | "left_arm_string_length" => Some(0.1),
        _ => None,
    }
}

fn median(
    passes: usize,
    mut pass: impl FnMut() -> Result<f64, Box<dyn Error>>,
) -> Result<f64, Box<dyn Error>> {
    let mut times = (0..passes).map(|_| pass()).collect::<Result<Vec<_>, _>>()?;
    times.sort_by(f64::total_cmp);
    Ok(times[passes / 2])
}
