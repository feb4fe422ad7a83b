//! What the software of the paper cannot step: violent motion at ordinary time steps.

use std::f64::consts::FRAC_PI_2;

use anyhow::Result;
use plantd_models::{Initial, Plant, Scene};

use crate::case::{Case, Finding, Setup};
use crate::geometry::Geometry;
use crate::plants::{self, apart, coast, energy, hold, step, well_depth};

pub(crate) fn cases(setup: &Setup) -> Vec<Case> {
    let mut cases = Vec::new();
    let mechanisms = [
        ("chain-32", 0.01),
        ("chain-64", 0.01),
        ("scissor-4", 0.001),
        ("scissor-8", 0.01),
        ("scissor-10", 0.01),
        ("scissor-12", 0.01),
    ];
    let seconds = setup.pick(2.0, 10.0);
    for (name, time_step_s) in mechanisms {
        let criterion = "every step of 2 s (10 s in the long form) accepted; energy error ≤ 10 % of the well \
                         depth; violation ≤ 1e-12; at 0.1 s halved steps leave a quarter of the error, \
                         to 25 %";
        let title = format!("violent: {name} at {time_step_s} s");
        cases.push(Case::new(title, criterion, move |setup, finding| {
            let steps = (seconds / time_step_s) as u64;
            released(name, time_step_s, steps, setup, finding)
        }));
    }
    for time_step_s in [0.7, 1.0] {
        let criterion = "1000 steps from q = 3, p = 1 accepted";
        let title = format!("violent: pendulum at {time_step_s} s");
        cases.push(Case::new(title, criterion, move |setup, finding| {
            let mut plant = plants::plant(&plants::scene("pendulum"), time_step_s)?;
            let initial = Initial::Momentum { q: vec![3.0], p: vec![1.0], v: Vec::new() };
            plant.initialize(&initial)?;
            let start = energy(&mut plant);
            let mut worst = 0.0_f64;
            for _ in 0..1000 {
                step(&mut plant, &[0.0])?;
                worst = worst.max((energy(&mut plant) - start).abs());
            }
            finding.note(format!("energy error {:.1e} of the well depth", worst / (2.0 * 9.8)));
            finding.linearization(&plant, &[0.0], setup.seed);
            Ok(())
        }));
    }
    cases
}

/// From horizontal, or from the initial configuration of a scissor.
fn start(scene: &Scene, time_step_s: f64) -> Result<Plant> {
    let mut plant = plants::plant(scene, time_step_s)?;
    if scene.name.starts_with("chain") {
        let mut q = vec![0.0; plant.q().len()];
        q[0] = FRAC_PI_2;
        let v = vec![0.0; q.len()];
        plant.initialize(&Initial::Velocity { q, v })?;
    }
    Ok(plant)
}

fn released(
    name: &str,
    time_step_s: f64,
    steps: u64,
    setup: &Setup,
    finding: &mut Finding,
) -> Result<()> {
    let scene = plants::scene(name);
    let mut plant = start(&scene, time_step_s)?;
    let geometry = Geometry::new(plant.model());
    let depth = match name.split_once('-') {
        Some(("chain", _)) => well_depth(&scene)?,
        // A stack that opens: each of its links of 1 kg falls by up to the height of all.
        _ => {
            let links = (scene.frames.len() - 1) as f64;
            9.8 * links * 5.0 * links / 2.0
        }
    };
    let ends = [1, 2, 4].map(|finer: u64| -> Result<Vec<f64>> {
        let mut plant = start(&scene, time_step_s / finer as f64)?;
        coast(&mut plant, (0.1 / time_step_s).round() as u64 * finer)?;
        Ok(plant.q().to_vec())
    });
    let [coarse, middle, fine] = ends;
    let (coarse, middle, fine) = (coarse?, middle?, fine?);
    let ratio = apart(&coarse, &middle) / apart(&middle, &fine);
    finding.at_most("ratio of errors off 4 by", (ratio - 4.0).abs(), 1.0);
    let (u, first) = (hold(&plant), energy(&mut plant));
    let (mut worst, mut violation) = (0.0_f64, 0.0_f64);
    for _ in 0..steps {
        step(&mut plant, &u)?;
        worst = worst.max((energy(&mut plant) - first).abs());
        violation = violation.max(geometry.violation(plant.q()));
    }
    finding.at_most("energy error", worst / depth, 0.1);
    finding.at_most("violation", violation, 1e-12);
    finding.linearization(&plant, &u, setup.seed);
    Ok(())
}
