//! Impulses, jumps and noise.

use std::f64::consts::PI;

use plantd_models::{HALVINGS_MAX, Scene, StepError};

use crate::case::Case;
use crate::geometry::Geometry;
use crate::numbers::Numbers;
use crate::plants::{self, Method, energy, hold, moving, step};

pub(crate) fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for torque in [1e2, 1e4, 6e4, 7e4, 1e6, 1e12] {
        let criterion = "a step of 10 ms from rest, in 2ᵐ equal parts where it is halved, solves v = h(u − g sin \
                         θ)/2 + p of the pendulum in each to 64 ε; or it is refused, and turns by more than \
                         half a turn in the shortest parts";
        let name = format!("impulsive torque of {torque:e} N m");
        cases.push(Case::new(name, criterion, move |_, finding| {
            for halvings in [0, HALVINGS_MAX] {
                let method = Method { halvings, ..0.01.into() };
                let mut plant = moving(&plants::scene("pendulum"), method, &[0.0], &[0.0])?;
                let before = plant.snapshot().to_bytes();
                match plant.step(&[torque]) {
                    Ok(report) => {
                        let (angle, _) = pushed_pendulum(torque, report.halvings);
                        let error = (plant.q()[0] - angle).abs() / angle;
                        finding.at_most(
                            &format!("error in {} parts", 1 << report.halvings),
                            error,
                            64.0 * f64::EPSILON,
                        );
                    }
                    Err(error) => {
                        let same = plant.snapshot().to_bytes() == before;
                        finding.must(same, || "state changed".to_owned());
                        let (_, turn) = pushed_pendulum(torque, halvings);
                        let too_fast = matches!(error, StepError::TooFast { .. });
                        finding
                            .must(too_fast && turn > PI, || format!("turns by {turn:.2}: {error}"));
                        finding.note(format!("refused with {halvings} halvings: {error}"));
                    }
                }
            }
            Ok(())
        }));
    }
    for jump in [1e-3, 1e-2, 0.1, 1.0] {
        let criterion = "a hand of the marionette jumps in one step of 10 ms and back 10 steps later: accepted \
                         steps violate no constraint by more than 1e-12; a refused one names the error \
                         and changes no byte, and the motion goes on without the jump unless it \
                         turns a body by more than half a turn in a step";
        let name = format!("prescribed jump of {jump} m");
        cases.push(Case::new(name, criterion, move |_, finding| {
            let mut plant = plants::plant(&plants::scene("marionette"), 0.01)?;
            let geometry = Geometry::new(plant.model());
            let d = plant.model().dimensions();
            let still = hold(&plant);
            let (mut violation, mut refusals, mut turn) = (0.0_f64, 0, 0.0_f64);
            for k in 0..200 {
                let mut u = still.clone();
                if (20..30).contains(&k) {
                    u[d.inputs] += jump;
                }
                let before = plant.snapshot().to_bytes();
                let from = plant.q()[..d.dynamic].to_vec();
                if let Err(error) = plant.step(&u) {
                    finding.must(plant.snapshot().to_bytes() == before, || "state changed".into());
                    refusals += 1;
                    if refusals == 1 {
                        finding.note(format!("step {k} refused: {error}"));
                    }
                    let go_on = hold(&plant);
                    if refusals > 10 || plant.step(&go_on).is_err() {
                        finding.must(turn > PI, || format!("does not go on after step {k}"));
                        finding.note(format!("turns by {turn:.2} before step {k}, refused"));
                        break;
                    }
                }
                turn = from.iter().zip(plant.q()).fold(0.0, |turn, (a, b)| turn.max((b - a).abs()));
                violation = violation.max(geometry.violation(plant.q()));
            }
            finding.at_most("violation", violation, 1e-12);
            Ok(())
        }));
    }
    for (name, size) in [
        ("pendulum", 3.0_f64),
        ("cart-pole", 5.0),
        ("chain-8", 0.5),
        ("four-bar", 3.0),
        ("marionette", 5e-4),
    ] {
        let criterion = "10⁶ steps (10⁴ in the short form) of white noise, damped: none refused, violation \
                         ≤ 1e-12, largest energy of the second half ≤ twice that of the first";
        cases.push(Case::new(format!("noise: {name}"), criterion, move |setup, finding| {
            let scene = Scene { damping: 0.2, ..plants::scene(name) };
            let long = if name == "marionette" { 200_000 } else { 1_000_000 };
            let steps = setup.pick(10_000, long);
            let mut plant = plants::plant(&scene, scene.time_step_s.min(0.01))?;
            let geometry = Geometry::new(plant.model());
            let (d, still) = (plant.model().dimensions(), hold(&plant));
            let lowest = energy(&mut plant);
            let mut random = Numbers::new(setup.seed);
            let (mut violation, mut halves) = (0.0_f64, [0.0_f64; 2]);
            let mut u = still.clone();
            for k in 0..steps {
                for (i, (u, still)) in u.iter_mut().zip(&still).enumerate() {
                    let reach = if i < d.inputs { size } else { size.min(5e-4) };
                    *u = still + random.between(-reach, reach);
                }
                step(&mut plant, &u)?;
                violation = violation.max(geometry.violation(plant.q()));
                let half = &mut halves[usize::from(2 * k >= steps)];
                *half = half.max((energy(&mut plant) - lowest).abs());
            }
            finding.at_most("violation", violation, 1e-12);
            finding.at_most("energy", halves[1], 2.0 * halves[0]);
            finding.linearization(&plant, &u, setup.seed);
            Ok(())
        }));
    }
    cases
}

/// Midpoint steps of the pendulum from rest over 10 ms, in parts: where it ends, and its largest turn in
/// one of them.
fn pushed_pendulum(torque: f64, halvings: u32) -> (f64, f64) {
    let parts = 1 << halvings;
    let h = 0.01 / f64::from(parts);
    let (mut q, mut p, mut largest) = (0.0, 0.0, 0.0_f64);
    for _ in 0..parts {
        let mut x = h * p;
        (0..100).for_each(|_| x = h * (p + 0.5 * h * (torque - 9.8 * f64::sin(q + 0.5 * x))));
        p += h * (torque - 9.8 * f64::sin(q + 0.5 * x));
        q += x;
        largest = largest.max(x.abs());
    }
    (q, largest)
}
