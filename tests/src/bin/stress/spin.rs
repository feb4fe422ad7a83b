//! Ball and free joints at 10⁴ rad/s.

use nalgebra::{UnitQuaternion, Vector3};
use plantd_models::StepError;

use crate::case::Case;
use crate::plants::{self, Method, coast, energy, hold, moving, parse};

const RATE: f64 = 1e4;

fn body(joint: &str, inertia: [f64; 3]) -> anyhow::Result<plantd_models::Scene> {
    parse(&format!(
        "[[frames]]\nname = \"body\"\njoint = {{ type = \"{joint}\" }}\nbody = {{ mass = 1.0, inertia = {inertia:?} }}\n"
    ))
}

pub(crate) fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for turn in [0.01, 1.0, 3.0, 10.0] {
        let criterion = "10⁴ steps about a principal axis, halved where one turns by more than half a turn; the \
                         orientation is exp(ω t) within 8 ε ω t";
        let name = format!("spin about an axis, {turn} rad per step");
        cases.push(Case::new(name, criterion, move |setup, finding| {
            const STEPS: u64 = 10_000;
            for joint in ["ball", "free"] {
                let scene = body(joint, [0.02, 0.03, 0.045])?;
                let n = if joint == "ball" { 3 } else { 6 };
                let mut v = vec![0.0; n];
                v[n - 1] = RATE;
                let mut plant = moving(&scene, turn / RATE, &vec![0.0; n], &v)?;
                coast(&mut plant, STEPS)?;
                let angle = turn * STEPS as f64;
                let expected = UnitQuaternion::new(Vector3::z() * (angle % std::f64::consts::TAU));
                let found = UnitQuaternion::new(Vector3::from_row_slice(&plant.q()[n - 3..]));
                let error = (found.inverse() * expected).scaled_axis().norm();
                finding.at_most(joint, error, 8.0 * f64::EPSILON * angle);
                finding.linearization(&plant, &[], setup.seed);
            }
            Ok(())
        }));
    }
    let criterion = "without halvings more than half a turn in a step is refused as too fast, and changes no byte";
    cases.push(Case::new("spin beyond half a turn per step", criterion, |_, finding| {
        let scene = body("ball", [0.02, 0.03, 0.045])?;
        let method = Method::from(3.5 / RATE).unhalved();
        let mut plant = moving(&scene, method, &[0.0; 3], &[0.0, 0.0, RATE])?;
        let before = plant.snapshot().to_bytes();
        match plant.step(&[]) {
            Err(error @ StepError::TooFast { .. }) => finding.note(format!("refused: {error}")),
            other => finding.must(false, || format!("{other:?}")),
        }
        finding.must(plant.snapshot().to_bytes() == before, || "state changed".to_owned());
        Ok(())
    }));
    for turn in [0.01, 0.1, 0.5] {
        let criterion = "an asymmetric body tumbles for 10⁵ steps (10⁶ in the long form): angular momentum \
                         kept to 4 ε √steps |p|₁, energy error in the second half ≤ 1.5 of the first and \
                         ≤ the turn per step squared";
        let name = format!("tumbling, {turn} rad per step");
        cases.push(Case::new(name, criterion, move |setup, finding| {
            let steps: u64 = setup.pick(100_000, 1_000_000);
            let scene = body("ball", [0.02, 0.03, 0.045])?;
            let v = [0.3, 0.9, 0.3].map(|x| RATE * x);
            let mut plant = moving(&scene, turn / RATE, &[0.0; 3], &v)?;
            let of =
                |plant: &mut plantd_models::Plant| Vector3::from(plant.diagnose().angular_momentum);
            let (momentum, start) = (of(&mut plant), energy(&mut plant));
            let size = plant.p().iter().map(|p| p.abs()).sum::<f64>();
            let (mut drift, mut halves) = (0.0_f64, [0.0_f64; 2]);
            for k in 0..steps {
                plants::step(&mut plant, &[])?;
                let half = &mut halves[usize::from(2 * k >= steps)];
                *half = half.max((energy(&mut plant) - start).abs());
                if k % 100 == 0 {
                    drift = drift.max((of(&mut plant) - momentum).norm());
                }
            }
            let walk = 4.0 * f64::EPSILON * (steps as f64).sqrt();
            finding.at_most("momentum", drift / size, walk);
            finding.at_most(
                "energy",
                halves[1] / start,
                (1.5 * halves[0] / start).min(turn * turn),
            );
            let u = hold(&plant);
            finding.linearization(&plant, &u, setup.seed);
            Ok(())
        }));
    }
    cases
}
