//! References from outside: what is a motion of the plant is found to be one, what is not is named.

use crate::common::{builtin, plant, waving_input};
use nalgebra::DMatrix;
use plantd_control::reference::{ReferenceError, check_reference, project};
use plantd_models::{ForceSplit, Spare};

/// Configurations and inputs of a motion under waving inputs.
struct Motion {
    start: Spare,
    q: DMatrix<f64>,
    u: DMatrix<f64>,
}

impl Motion {
    fn new(name: &str, split: ForceSplit, steps: usize) -> Self {
        let mut plant = plant(&builtin(name), |s| s.force_split = split);
        let d = plant.model().dimensions();
        let start = Spare::from(plant.clone());
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

#[test]
fn what_is_no_motion_is_told_and_named() {
    let motion = Motion::new("cart-pole", ForceSplit::Symmetric, 100);
    let theta = motion.start.model().coordinate_index("theta").unwrap();

    // The pole swings farther than gravity lets it: no input acts on it.
    let mut wider = motion.q.clone();
    wider.column_mut(theta).scale_mut(1.3);
    let found = check_reference(&motion.start, &wider, None).unwrap();
    assert!(!found.is_feasible(1e-3));
    assert_eq!(found.unexplained_coordinate, "theta");
    assert!(found.unexplained_force > 1e-3 && found.unexplained_step > 0);
    // The plant follows as well as it can.
    let projected = project(&motion.start, &wider, &found, None, false).unwrap();
    assert!(projected.deviation > 1e-3 && projected.deviation < 0.5, "{projected:?}");
    let n = motion.start.model().dimensions().coordinates();
    let q = projected.states.columns(0, n).into_owned();
    let again = check_reference(&motion.start, &q, Some(&projected.inputs)).unwrap();
    assert!(again.is_feasible(1e-8), "{again:?}");

    // A single row that is displaced is found where it is.
    let mut jump = motion.q.clone();
    jump[(40, theta)] += 1e-3;
    let found = check_reference(&motion.start, &jump, Some(&motion.u)).unwrap();
    assert!(found.unexplained_acceleration > 1.0);
    assert!(found.unexplained_step.abs_diff(40) <= 1, "{}", found.unexplained_step);
    assert!(found.unexplained_force_step.abs_diff(40) <= 1, "{}", found.unexplained_force_step);

    // The heavy cart is moved by the largest force, the light pole at the largest acceleration.
    let mut twice = motion.q.clone();
    twice[(20, theta)] += 2e-3;
    twice[(60, 1 - theta)] += 1e-3;
    let found = check_reference(&motion.start, &twice, Some(&motion.u)).unwrap();
    assert_eq!((found.unexplained_step, found.unexplained_coordinate.as_str()), (20, "theta"));
    let force = (found.unexplained_force_step, found.unexplained_force_coordinate.as_str());
    assert_eq!(force, (60, "x"));

    // The cart has its input: any motion of it alone can be had, given the pole's reaction.
    let mut shifted = motion.q.clone();
    shifted.column_mut(1 - theta).add_scalar_mut(0.7);
    let found = check_reference(&motion.start, &shifted, Some(&motion.u)).unwrap();
    assert!(found.is_feasible(1e-8), "the rail is the same everywhere: {found:?}");
}

#[test]
fn violated_constraints_are_named() {
    let motion = Motion::new("four-bar", ForceSplit::Symmetric, 60);
    let mut q = motion.q.clone();
    q[(30, 0)] += 0.01;
    let found = check_reference(&motion.start, &q, None).unwrap();
    assert!(found.constraint_violation > 1e-4);
    assert_eq!(found.constraint_violation_step, 30);
    assert!(motion.start.model().constraint_names().contains(&found.constraint));

    // Inputs that prescribe other positions than the reference has.
    let motion = Motion::new("marionette", ForceSplit::Symmetric, 20);
    let mut u = motion.u.clone();
    u[(10, 3)] += 0.02;
    let found = check_reference(&motion.start, &motion.q, Some(&u)).unwrap();
    assert!((found.constraint_violation - 0.02).abs() < 1e-12);
    assert_eq!(found.constraint_violation_step, 11);
    let nd = motion.start.model().dimensions().dynamic;
    assert_eq!(found.constraint, motion.start.model().coordinates()[nd + 3].name);
}

#[test]
fn faults_of_a_reference_are_named() {
    let motion = Motion::new("pendulum", ForceSplit::Symmetric, 5);
    let refuse = |q: &DMatrix<f64>, u: Option<&DMatrix<f64>>| {
        check_reference(&motion.start, q, u).unwrap_err()
    };
    assert_eq!(refuse(&DMatrix::zeros(1, 1), None), ReferenceError::TooShort { rows: 1 });
    let found = refuse(&DMatrix::zeros(6, 2), None);
    assert!(matches!(found, ReferenceError::Dimension { what: "q", expected_cols: 1, .. }));
    let found = refuse(&motion.q, Some(&DMatrix::zeros(6, 1)));
    assert!(matches!(found, ReferenceError::Dimension { what: "u", expected_rows: 5, .. }));
    let mut q = motion.q.clone();
    q[(3, 0)] = f64::INFINITY;
    assert_eq!(refuse(&q, None), ReferenceError::NotFinite { what: "q", row: 3, col: 0 });
}
