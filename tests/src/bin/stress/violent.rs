//! What the software of the paper cannot step: violent motion at ordinary time steps.

use std::f64::consts::FRAC_PI_2;

use anyhow::Result;
use plantd_models::{Initial, Plant, Scene};

use crate::case::{Case, Finding, Setup};
use crate::geometry::Geometry;
use crate::plants::{self, Method, energy, hold, step, well_depth};

pub(crate) fn cases(setup: &Setup) -> Vec<Case> {
    let mut cases = Vec::new();
    let mechanisms = [
        ("chain-32", Method::from(0.01)),
        ("chain-64", 0.01.into()),
        ("chain-32", Method::new(0.01, 2, 8)),
        ("chain-32", Method::new(0.01, 4, 1)),
        ("chain-32", Method::new(0.01, 8, 1)),
        ("chain-64", Method::new(0.01, 6, 1)),
        ("scissor-4", 0.001.into()),
        ("scissor-8", 0.01.into()),
        ("scissor-8", Method::new(0.01, 6, 1)),
        ("scissor-10", 0.01.into()),
        ("scissor-12", 0.01.into()),
    ];
    let coarse =
        Some("so long a step is halved where the motion is fastest, and is another map then");
    let seconds = setup.pick(2.0, 10.0);
    // Halved over and over, higher orders take minutes.
    let is_short =
        |(name, method): &(&str, Method)| method.order == 2 || !name.starts_with("chain");
    for (name, method) in mechanisms.into_iter().filter(|case| setup.long || is_short(case)) {
        let criterion = "every step of 2 s (10 s in the long form) accepted; energy error ≤ 10 % of the well \
                         depth; violation ≤ 1e-12";
        let title = format!("violent: {name} at {} s{}", method.time_step_s, method.name());
        let case = Case::new(title, criterion, move |setup, finding| {
            let steps = (seconds / method.time_step_s) as u64;
            released(name, method, steps, setup, finding)
        });
        let is_whip = method.order == 2 && name.starts_with("chain");
        cases.push(case.known_limit(coarse.filter(|_| is_whip)));
    }
    let long = [
        ("double-pendulum", 2, 100_000, None),
        ("double-pendulum", 8, 100_000, None),
        ("chain-4", 2, 20_000, coarse),
        ("chain-4", 8, 20_000, None),
        ("four-bar", 2, 20_000, None),
        ("four-bar", 8, 20_000, None),
    ];
    for (name, order, steps, limit) in long {
        let method = Method::new(0.01, order, 1);
        let criterion =
            "every step accepted; energy error ≤ 10 % of the well depth; violation ≤ 1e-12";
        let title = format!("violent: {name} at 0.01 s for {steps} steps{}", method.name());
        let case = Case::new(title, criterion, move |setup, finding| {
            released(name, method, steps, setup, finding)
        });
        cases.push(case.known_limit(limit));
    }
    for (method, criterion) in [0.7, 1.0].into_iter().flat_map(|h| {
        [2, 4, 8, 12]
            .map(|order| (Method::new(h, order, 1), "1000 steps from q = 3, p = 1 accepted"))
    }) {
        let title = format!("violent: pendulum at {} s{}", method.time_step_s, method.name());
        cases.push(Case::new(title, criterion, move |setup, finding| {
            finding.method = Some((method.order, method.substeps));
            let mut plant = plants::plant(&plants::scene("pendulum"), method)?;
            let initial = Initial::Momentum { q: vec![3.0], p: vec![1.0], v: Vec::new() };
            plant.initialize(&initial)?;
            let start = energy(&mut plant);
            let (mut worst, mut halved) = (0.0_f64, 0);
            for _ in 0..1000 {
                halved += u32::from(step(&mut plant, &[0.0])?.halvings > 0);
                worst = worst.max((energy(&mut plant) - start).abs());
            }
            let error = worst / (2.0 * 9.8);
            finding.note(format!("{halved} halved, energy error {error:.1e} of the well depth"));
            finding.linearization(&plant, &[0.0], setup.seed);
            Ok(())
        }));
    }
    cases
}

/// From horizontal; scissors and four-bar linkages from their initial configuration.
fn start(scene: &Scene, method: Method) -> Result<Plant> {
    let mut plant = plants::plant(scene, method)?;
    if scene.name.starts_with("chain") || scene.name == "double-pendulum" {
        let mut q = vec![0.0; plant.q().len()];
        q[0] = FRAC_PI_2;
        let v = vec![0.0; q.len()];
        plant.initialize(&Initial::Velocity { q, v })?;
    }
    Ok(plant)
}

fn released(
    name: &str,
    method: Method,
    steps: u64,
    setup: &Setup,
    finding: &mut Finding,
) -> Result<()> {
    let scene = plants::scene(name);
    finding.method = Some((method.order, method.substeps));
    let mut plant = start(&scene, method)?;
    let geometry = Geometry::new(plant.model());
    let depth = match name.split_once('-') {
        Some(("chain" | "double", _)) => well_depth(&scene)?,
        // Its rods once hanging and once upright, crank and coupler in line.
        Some(("four", _)) => 2.0 * 9.8 * (0.5 * 0.25 + 1.2 * (0.5 + 0.6) + 1.0 * 0.5),
        // A stack that opens: each of its links of 1 kg falls by up to the height of all.
        _ => {
            let links = (scene.frames.len() - 1) as f64;
            9.8 * links * 5.0 * links / 2.0
        }
    };
    let (u, first) = (hold(&plant), energy(&mut plant));
    let (mut worst, mut violation) = (0.0_f64, 0.0_f64);
    let (mut halved, mut most) = (0, 0);
    for _ in 0..steps {
        let halvings = step(&mut plant, &u)?.halvings;
        halved += u32::from(halvings > 0);
        most = most.max(halvings);
        worst = worst.max((energy(&mut plant) - first).abs());
        violation = violation.max(geometry.violation(plant.q()));
    }
    finding.note(format!("{halved} of {steps} halved, up to {most} times"));
    finding.at_most("energy error", worst / depth, 0.1);
    finding.at_most("violation", violation, 1e-12);
    if method.order == 2 {
        finding.linearization(&plant, &u, setup.seed);
    }
    Ok(())
}
