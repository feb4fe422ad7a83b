//! Springs and dampers of any stiffness.

use anyhow::Result;
use plantd_models::{ForceSplit, Initial, Plant, Settings};

use crate::case::{Case, Finding, Setup};
use crate::plants::{self, Method, energy_error, largest, moving, parse, step};

pub(crate) fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for omega_h in [1e-2_f64, 1.0, 1e2, 1e4] {
        let criterion = "10⁴ steps against the closed form cos(2k atan(ωh/2)); error ≤ 16 ε steps";
        let name = format!("spring with ω h = {omega_h:e}");
        cases.push(Case::new(name, criterion, move |setup, finding| {
            const STEPS: u32 = 10_000;
            let (h, omega) = (0.01, omega_h / 0.01);
            let scene = parse(&format!(
                "[[frames]]\nname = \"mass\"\njoint = {{ type = \"prismatic\", axis = [1.0, 0.0, 0.0] }}\nbody = {{ mass = 1.0 }}\n[[springs]]\ntype = \"coordinate\"\ncoordinate = \"mass\"\nstiffness = {:?}\n",
                omega * omega
            ))?;
            let mut plant = moving(&scene, Method::from(h).unhalved(), &[1.0], &[0.0])?;
            let phase = 2.0 * (0.5 * omega_h).atan();
            let mut worst = 0.0_f64;
            for k in 1..=STEPS {
                step(&mut plant, &[])?;
                let turn = f64::from(k) * phase;
                let errors = [plant.q()[0] - turn.cos(), plant.p()[0] / omega + turn.sin()];
                worst = worst.max(largest(&errors));
            }
            finding.at_most("error", worst, 16.0 * f64::EPSILON * f64::from(STEPS));
            finding.linearization(&plant, &[], setup.seed);
            Ok(())
        }));
    }
    for (stretch, omega_h) in
        [(0.0, 1.0), (0.0, 10.0), (0.0, 1e2), (0.0, 1e4), (0.02, 1.0), (0.02, 1e2), (0.02, 1e4)]
    {
        let criterion = if stretch == 0.0 {
            "10 s at 10 ms; the angle stays within 2e-3 rad (or 45 times the spring's static give) of \
             the rigid pendulum's"
        } else {
            "10 s at 10 ms; energy error ≤ 10 % of what is in spring and pendulum"
        };
        let name = format!("elastic pendulum, ω h = {omega_h:e}, stretched {stretch}");
        cases.push(Case::new(name, criterion, move |setup, finding| {
            elastic_pendulum(omega_h, stretch, setup, finding)
        }));
    }
    for z in [1e-2, 1.0, 2.0, 1e2, 1e4, 1e8] {
        let criterion = "20 steps against ((1 − (1−a)z)/(1 + az))ᵏ for both splits; error ≤ 8 ε steps of \
                         the first momentum";
        let name = format!("damping with h c/m = {z:e}");
        cases.push(Case::new(name, criterion, move |setup, finding| {
            const STEPS: i32 = 20;
            let h = 0.01;
            let scene = parse(&format!(
                "damping = {:?}\n[[frames]]\nname = \"mass\"\njoint = {{ type = \"prismatic\", axis = [1.0, 0.0, 0.0] }}\nbody = {{ mass = 1.0 }}\n",
                z / h
            ))?;
            for (split, a) in [(ForceSplit::Symmetric, 0.5), (ForceSplit::Paper, 1.0)] {
                let plant = plants::plant(&scene, h)?;
                let settings = Settings { force_split: split, ..*plant.settings() };
                let mut plant = Plant::new(plant.model().clone(), settings)?;
                plant.initialize(&Initial::Momentum { q: vec![0.0], p: vec![1.0], v: vec![] })?;
                let factor = (1.0 - (1.0 - a) * z) / (1.0 + a * z);
                let mut worst = 0.0_f64;
                for k in 1..=STEPS {
                    step(&mut plant, &[])?;
                    worst = worst.max((plant.p()[0] - factor.powi(k)).abs());
                }
                let bound = 8.0 * f64::EPSILON * f64::from(STEPS);
                finding.at_most(&format!("{split:?}"), worst, bound);
                finding.linearization(&plant, &[], setup.seed);
            }
            Ok(())
        }));
    }
    cases
}

fn elastic_pendulum(
    omega_h: f64,
    stretch: f64,
    setup: &Setup,
    finding: &mut Finding,
) -> Result<()> {
    let h: f64 = 0.01;
    let stiffness = (omega_h / h).powi(2);
    let rod = |joint: &str, spring: &str| {
        parse(&format!(
            "gravity = [0.0, 0.0, -9.81]\n[[frames]]\nname = \"rod\"\njoint = {{ type = \"revolute\", axis = [0.0, 1.0, 0.0] }}\n{joint}\n{spring}"
        ))
    };
    let elastic = rod(
        "[[frames]]\nname = \"bob\"\nparent = \"rod\"\njoint = { type = \"prismatic\", axis = [0.0, 0.0, -1.0] }\nbody = { mass = 1.0 }",
        &format!(
            "[[springs]]\ntype = \"coordinate\"\ncoordinate = \"bob\"\nstiffness = {stiffness:?}\nrest = 1.0\n"
        ),
    )?;
    let rigid = rod("body = { mass = 1.0, center_of_mass = [0.0, 0.0, -1.0] }", "")?;
    let angle = 1.0_f64;
    let still = 1.0 + 9.81 * angle.cos() / stiffness;
    let mut plant = moving(&elastic, h, &[angle, still + stretch], &[0.0, 0.0])?;
    if stretch > 0.0 {
        let size = 0.5 * stiffness * stretch * stretch + 2.0 * 9.81;
        let error = energy_error(&mut plant, 1000)?;
        finding.at_most("energy error", error / size, 0.1);
    } else {
        let mut rigid = moving(&rigid, h, &[angle], &[0.0])?;
        let mut worst = 0.0_f64;
        for _ in 0..1000 {
            step(&mut plant, &[])?;
            step(&mut rigid, &[])?;
            worst = worst.max((plant.q()[0] - rigid.q()[0]).abs());
        }
        // Ten seconds are about 30 rad of phase, and a period lengthens by half of the give.
        let give = 9.81 / stiffness;
        finding.at_most("angle", worst, 2e-3_f64.max(3.0 * 30.0 * 0.5 * give));
    }
    finding.linearization(&plant, &[], setup.seed);
    Ok(())
}
