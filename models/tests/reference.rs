//! References from outside: what is a motion of the plant is found to be one, what is not is named.

mod common;

use common::{builtin, plant, waving_input};
use nalgebra::DMatrix;
use plantd_models::reference::{check_reference, project};
use plantd_models::{ForceSplit, Plant};

/// Configurations and inputs of a motion under waving inputs.
struct Motion {
    start: Plant,
    q: DMatrix<f64>,
    u: DMatrix<f64>,
}

impl Motion {
    fn new(name: &str, split: ForceSplit, steps: usize) -> Self {
        let mut plant = plant(&builtin(name), |s| s.force_split = split);
        let d = plant.model().dimensions();
        let start = plant.clone();
        let mut q = DMatrix::zeros(steps + 1, d.coordinates());
        let mut u = DMatrix::zeros(steps, d.input());
        for k in 0..=steps {
            q.row_mut(k).copy_from_slice(plant.q());
            if k < steps {
                let input = waving_input(&plant, k as u64 + 1);
                plant.step(&input).unwrap();
                u.row_mut(k).copy_from_slice(&input);
            }
        }
        Self { start, q, u }
    }
}

const SCENES: [&str; 6] =
    ["pendulum", "cart-pole", "double-pendulum", "four-bar", "scissor-4", "marionette"];

#[test]
fn a_motion_is_feasible_with_its_own_inputs() {
    for name in SCENES {
        for split in [ForceSplit::Symmetric, ForceSplit::Paper] {
            let steps = if name == "marionette" { 60 } else { 200 };
            let motion = Motion::new(name, split, steps);
            let found = check_reference(&motion.start, &motion.q, Some(&motion.u)).unwrap();
            assert!(found.is_feasible(1e-9), "{name} {split:?}: {found:?}");
            assert_eq!(found.inputs, motion.u);

            // Without them they are found, but for what configurations alone leave open: the first
            // one, and with the symmetric split a part that alternates.
            let found = check_reference(&motion.start, &motion.q, None).unwrap();
            assert!(found.is_feasible(1e-9), "{name} {split:?}: {found:?}");
            let gap = (&found.inputs - &motion.u).rows(1, steps - 1).into_owned();
            match split {
                ForceSplit::Paper => assert!(gap.amax() < 1e-8, "{name}: {}", gap.amax()),
                ForceSplit::Symmetric => {
                    for k in 1..gap.nrows() {
                        let sum = gap.row(k) + gap.row(k - 1);
                        assert!(sum.amax() < 1e-8, "{name}: {}", sum.amax());
                    }
                    assert!(gap.amax() < 1e-3, "{name}: {}", gap.amax());
                }
            }

            // The motion that follows it is the motion itself.
            let projected = project(&motion.start, &motion.q, &found, None, true).unwrap();
            assert!(projected.deviation < 1e-9, "{name} {split:?}: {}", projected.deviation);
        }
    }
}
