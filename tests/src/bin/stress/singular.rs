//! Singular charts, redundant constraints, and branches of configurations.

use std::f64::consts::FRAC_PI_2;

use plantd_models::{Initial, StepError};

use crate::case::Case;
use crate::geometry::Geometry;
use crate::plants::{self, energy, largest, moving, parse, refused, until_refused};

const GIMBAL: &str = r#"
[[frames]]
name = "yaw"
joint = { type = "revolute", axis = [0.0, 0.0, 1.0] }
[[frames]]
name = "pitch"
parent = "yaw"
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
[[frames]]
name = "roll"
parent = "pitch"
joint = { type = "revolute", axis = [1.0, 0.0, 0.0] }
body = { mass = 1.0, inertia = [0.3, 0.4, 0.5] }
"#;

const PARALLELOGRAM: &str = r#"
[[frames]]
name = "crank"
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
body = { mass = 1.0, center_of_mass = [0.0, 0.0, -0.5], inertia = [0.1, 0.1, 0.0] }
[[frames]]
name = "coupler"
parent = "crank"
translation = [0.0, 0.0, -1.0]
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
body = { mass = 1.0, center_of_mass = [1.0, 0.0, 0.0], inertia = [0.3, 0.3, 0.3] }
[[frames]]
name = "rocker"
translation = [2.0, 0.0, RAISED]
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
body = { mass = 1.0, center_of_mass = [0.0, 0.0, -0.5], inertia = [0.1, 0.1, 0.0] }
[[constraints]]
type = "point_to_point"
name = "pin"
a = { frame = "coupler", at = [2.0, 0.0, 0.0] }
b = { frame = "rocker", at = [0.0, 0.0, ROCKER] }
axes = ["x", "z"]
"#;

/// A third crank, in the middle.
const THIRD: &str = r#"
[[frames]]
name = "third"
translation = [1.0, 0.0, 0.0]
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
body = { mass = 1.0, center_of_mass = [0.0, 0.0, -0.5], inertia = [0.1, 0.1, 0.0] }
[[constraints]]
type = "point_to_point"
name = "middle"
a = { frame = "coupler", at = [1.0, 0.0, 0.0] }
b = { frame = "third", at = [0.0, 0.0, LENGTH] }
axes = ["x", "z"]
"#;

/// Why a motion past a singularity may lose its energy.
const UNRESOLVED: &str = "a fixed step does not resolve a passage much shorter than it";

pub(crate) fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for miss in [1e-1, 1e-2, 1e-4, 1e-8, 0.0] {
        let criterion = "a mass on a great circle past the pole of its two hinges, 400 steps of 10 ms at \
                         1 rad/s; energy error ≤ 1 % while steps are accepted; a refused one names the \
                         error and changes no byte";
        let name = format!("pole of two hinges missed by {miss:e}");
        let limit = (miss > 0.0 && miss < 0.1).then_some(UNRESOLVED);
        cases.push(
            Case::new(name, criterion, move |_, finding| {
                let mut scene = plants::scene("spherical-pendulum");
                scene.gravity = Some([0.0; 3]);
                let mut plant = moving(&scene, 0.01, &[0.0, 0.0], &[miss, 1.0])?;
                let (start, mut worst) = (energy(&mut plant), 0.0_f64);
                let end = until_refused(&mut plant, 400, |plant| {
                    worst = worst.max((energy(plant) - start).abs());
                })?;
                finding.at_most("energy error", worst / start, 1e-2);
                refused(finding, "passage", end);
                Ok(())
            })
            .known_limit(limit),
        );
    }
    for off in [1e-2, 1e-5, 1e-8, 1e-12, 0.0] {
        let criterion = "a rigid body on three hinges that start this far from gimbal lock, 300 \
                         steps of 1 ms; momentum about the first hinge kept to 1e-9 and energy to 1 % while \
                         steps are accepted; a refused one names the error and changes no byte";
        let name = format!("gimbal lock at {off:e} rad");
        let limit = (off > 1e-3).then_some(UNRESOLVED);
        cases.push(
            Case::new(name, criterion, move |_, finding| {
                let q = [0.3, FRAC_PI_2 - off, 0.2];
                let mut plant = moving(&parse(GIMBAL)?, 1e-3, &q, &[0.0, 1.0, 0.7])?;
                let (momentum, start) = (plant.p()[0], energy(&mut plant));
                let size = largest(plant.p());
                let (mut turn, mut drift) = (0.0_f64, 0.0_f64);
                let end = until_refused(&mut plant, 300, |plant| {
                    turn = turn.max((plant.p()[0] - momentum).abs());
                    drift = drift.max((energy(plant) - start).abs());
                })?;
                finding.at_most("momentum", turn / size, 1e-9);
                finding.at_most("energy error", drift / start, 1e-2);
                refused(finding, "motion", end);
                Ok(())
            })
            .known_limit(limit),
        );
    }
    for exponent in [2, 4, 6, 8, 10, 12, 14, 16] {
        let criterion = "couplings x + y = 0 and x + (1+δ)y + δz = 0 of sliding masses 1, 2, 3 pulled \
                         alike, 100 steps: violation ≤ 1e-12, and x = g t²/6 within 100 ε/δ for δ ≥ 1e-8; \
                         or refused as singular or inconsistent, and no byte changed";
        let name = format!("nearly redundant couplings, δ = 1e-{exponent}");
        let case = Case::new(name, criterion, move |_, finding| {
            let delta = 10_f64.powi(-exponent);
            let slide = |name: &str, mass: f64| {
                format!(
                    "[[frames]]\nname = \"{name}\"\njoint = {{ type = \"prismatic\", axis = [1.0, 0.0, 0.0] }}\nbody = {{ mass = {mass:?} }}\n"
                )
            };
            let term = |name: &str, factor: f64| {
                format!("{{ coordinate = \"{name}\", coefficients = [{factor:?}] }}")
            };
            let scene = parse(&format!(
                "gravity = [9.81, 0.0, 0.0]\n{}{}{}[[constraints]]\ntype = \"coupling\"\nname = \"one\"\nterms = [{}, {}]\n[[constraints]]\ntype = \"coupling\"\nname = \"two\"\nterms = [{}, {}, {}]\n",
                slide("x", 1.0),
                slide("y", 2.0),
                slide("z", 3.0),
                term("x", 1.0),
                term("y", 1.0),
                term("x", 1.0),
                term("y", 1.0 + delta),
                term("z", delta),
            ))?;
            let mut plant = plants::plant(&scene, 0.01)?;
            let geometry = Geometry::new(plant.model());
            let (mut error, mut violation) = (0.0_f64, 0.0_f64);
            let end = until_refused(&mut plant, 100, |plant| {
                let (x, t) = (plant.q()[0], plant.time_s());
                error = error.max((x - 9.81 * t * t / 6.0).abs());
                violation = violation.max(geometry.violation(plant.q()));
            })?;
            finding.at_most("violation", violation, 1e-12);
            match &end.1 {
                None if delta >= 1e-8 => {
                    finding.at_most("error", error, 100.0 * f64::EPSILON / delta);
                }
                None => finding.note(format!("error {error:.1e}")),
                Some(
                    StepError::SingularConstraints { .. }
                    | StepError::InconsistentConstraints { .. },
                ) => refused(finding, "motion", end),
                Some(error) => finding.must(false, || format!("refused otherwise: {error}")),
            }
            Ok(())
        });
        let limit = "multipliers of nearly redundant equations lose the digits in which they agree";
        cases.push(case.known_limit((6..=12).contains(&exponent).then_some(limit)));
    }
    for misfit in [0.0, 1e-15, 1e-13, 1e-11, 1e-9, 1e-7] {
        let criterion = "a parallelogram with a third crank, longer by this much: accepted steps violate \
                         no constraint by more than 1e-12; without misfit 100 steps turn it evenly, \
                         within 1e-9; a refused one names the error and changes no byte";
        let name = format!("third parallel crank, misfit {misfit:e}");
        cases.push(Case::new(name, criterion, move |_, finding| {
            let text = format!("{PARALLELOGRAM}{THIRD}")
                .replace("ROCKER", "-1.0")
                .replace("RAISED", "0.0")
                .replace("LENGTH", &format!("{:?}", -1.0 - misfit));
            let mut plant =
                moving(&parse(&text)?, 0.01, &[0.5, -0.5, 0.5, 0.5], &[1.0, -1.0, 1.0, 1.0])?;
            let geometry = Geometry::new(plant.model());
            let mut worst = 0.0_f64;
            let end = until_refused(&mut plant, 100, |plant| {
                let violation = geometry.violation(plant.q());
                worst = if violation <= worst { worst } else { violation };
            })?;
            finding.at_most("violation", worst, 1e-12);
            if misfit == 0.0 {
                finding.must(end.1.is_none(), || "redundant constraints were refused".to_owned());
                // Without gravity a parallelogram turns evenly.
                let expected = 0.5 + 0.01 * end.0 as f64;
                finding.at_most("angle", (plant.q()[0] - expected).abs(), 1e-9);
            }
            refused(finding, "motion", end);
            Ok(())
        }));
    }
    for rocker in [1.0, 1.0 + 1e-10, 1.0 + 1e-6, 1.0 + 1e-3, 1.05] {
        let criterion = "a four-bar linkage through its flat configuration, 1000 steps of 10 ms; accepted \
                         steps violate no constraint by more than 1e-12 and keep the energy to 1 %; a \
                         refused one names the error and changes no byte";
        let name = format!("flat four-bar linkage, rocker {rocker}");
        let limit = (rocker > 1.0 && rocker < 1.01).then_some(UNRESOLVED);
        cases.push(
            Case::new(name, criterion, move |_, finding| {
                let text = PARALLELOGRAM
                    .replace("ROCKER", &format!("{:?}", -rocker))
                    .replace("RAISED", &format!("{:?}", rocker - 1.0));
                let scene = parse(&text)?;
                let mut plant = plants::plant(&scene, 0.01)?;
                let hold = vec!["crank".to_owned()];
                plant.initialize(&Initial::Projection { q: vec![0.3, -0.3, 0.3], hold })?;
                let q = plant.q().to_vec();
                plant.initialize(&Initial::Velocity { q, v: vec![1.0, -1.0, 1.0] })?;
                let geometry = Geometry::new(plant.model());
                let start = energy(&mut plant);
                let (mut violation, mut drift) = (0.0_f64, 0.0_f64);
                let mut flat = f64::INFINITY;
                let end = until_refused(&mut plant, 1000, |plant| {
                    violation = violation.max(geometry.violation(plant.q()));
                    drift = drift.max((energy(plant) - start).abs());
                    flat = flat.min(plant.q()[1].sin().abs());
                })?;
                finding.at_most("violation", violation, 1e-12);
                finding.at_most("energy error", drift / start, 1e-2);
                finding.note(format!("nearest to flat {flat:.0e} rad"));
                refused(finding, "passage", end);
                Ok(())
            })
            .known_limit(limit),
        );
    }
    cases
}
