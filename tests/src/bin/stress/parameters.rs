//! Ratios of masses and lengths, and similarity.

use std::f64::consts::{FRAC_PI_2, PI};

use anyhow::Result;
use plantd_models::scene::Constraint;
use plantd_models::{Plant, Scene};

use crate::case::{Case, Finding, Setup};
use crate::plants::{self, apart, coast, energy_error, hold, moving, parse, well_depth};

/// Point masses on two massless rods.
fn double_pendulum(masses: [f64; 2], lengths: [f64; 2]) -> Result<Scene> {
    let ([m1, m2], [l1, l2]) = (masses, lengths);
    parse(&format!(
        r#"
gravity = [0.0, 0.0, -9.81]
[[frames]]
name = "upper"
joint = {{ type = "revolute", axis = [0.0, 1.0, 0.0] }}
body = {{ mass = {m1:?}, center_of_mass = [0.0, 0.0, {:?}] }}
[[frames]]
name = "lower"
parent = "upper"
translation = [0.0, 0.0, {:?}]
joint = {{ type = "revolute", axis = [0.0, 1.0, 0.0] }}
body = {{ mass = {m2:?}, center_of_mass = [0.0, 0.0, {:?}] }}
[[inputs]]
name = "torque"
coordinate = "upper"
"#,
        -l1, -l1, -l2
    ))
}

pub(crate) fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for exponent in [-8, -6, -4, -2, 2, 4, 6, 8] {
        let criterion = "10⁴ steps of 1 ms; energy error ≤ 1 % of the well depth";
        let name = format!("mass ratio 1e{exponent} in a double pendulum");
        let limit = "a light link that a heavy one whips round turns too far in the shortest steps";
        let case = Case::new(name, criterion, move |setup, finding| {
            let scene = double_pendulum([1.0, 10_f64.powi(exponent)], [1.0, 1.0])?;
            released(&scene, 1e-3, setup, finding)
        });
        cases.push(case.known_limit((exponent >= 4).then_some(limit)));
    }
    for exponent in [-6, -3, 3, 6] {
        let criterion = "10⁴ steps of a hundredth of the faster pendulum's period; energy error ≤ 1 % of \
                         the well depth";
        let name = format!("length ratio 1e{exponent} in a double pendulum");
        let limit =
            "round-off of the long link's momentum is more than the short one's can be solved to";
        let case = Case::new(name, criterion, move |setup, finding| {
            let length = 10_f64.powi(exponent);
            let scene = double_pendulum([1.0, 1.0], [1.0, length])?;
            let period = 2.0 * PI * (length.min(1.0) / 9.81).sqrt();
            released(&scene, period / 100.0, setup, finding)
        });
        cases.push(case.known_limit((exponent == 6).then_some(limit)));
    }
    for (name, scale) in [("lengths", [4.0, 1.0]), ("masses", [1.0, 8.0])] {
        for exponent in [-10, -3, 3, 10] {
            let criterion = "dynamically similar mechanisms move alike: angles after 300 steps differ by \
                             ≤ 1e-12 rad";
            let factor = [scale[0], scale[1]].map(|s: f64| s.powi(exponent));
            let name = format!("{name} times {:.0e}", factor[0] * factor[1]);
            cases.push(Case::new(name, criterion, move |_, finding| similarity(factor, finding)));
        }
    }
    cases
}

/// Released from horizontal.
fn released(scene: &Scene, time_step_s: f64, setup: &Setup, finding: &mut Finding) -> Result<()> {
    let mut plant = moving(scene, time_step_s, &[FRAC_PI_2, 0.0], &[0.0, 0.0])?;
    let error = energy_error(&mut plant, 10_000)?;
    finding.at_most("energy error", error / well_depth(scene)?, 1e-2);
    let u = hold(&plant);
    finding.linearization(&plant, &u, setup.seed);
    Ok(())
}

/// With lengths times `s²`, times times `s` and masses times a power of two no digit changes.
fn similarity([length, mass]: [f64; 2], finding: &mut Finding) -> Result<()> {
    let mut same_bits = true;
    for name in ["pendulum", "double-pendulum", "chain-4", "four-bar"] {
        let scene = plants::scene(name);
        let mut scaled = scene.clone();
        for frame in &mut scaled.frames {
            frame.translation.iter_mut().for_each(|x| *x *= length);
            if let Some(body) = &mut frame.body {
                body.mass *= mass;
                body.center_of_mass.iter_mut().for_each(|x| *x *= length);
                body.inertia.iter_mut().for_each(|x| *x *= mass * length * length);
            }
        }
        for constraint in &mut scaled.constraints {
            if let Constraint::PointToPoint { a, b, .. } = constraint {
                a.at.iter_mut().chain(&mut b.at).for_each(|x| *x *= length);
            }
        }
        let run = |scene: &Scene, time_step_s: f64| -> Result<Plant> {
            let mut plant = plants::plant(scene, time_step_s)?;
            coast(&mut plant, 300)?;
            Ok(plant)
        };
        let h = scene.time_step_s.min(0.01);
        let (plain, scaled) = (run(&scene, h)?, run(&scaled, h * length.sqrt())?);
        finding.at_most(name, apart(plain.q(), scaled.q()), 1e-12);
        same_bits &= plain.q() == scaled.q();
    }
    finding.note(if same_bits { "same bits" } else { "not the same bits" });
    Ok(())
}
