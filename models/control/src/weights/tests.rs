use nalgebra::{DMatrix, DVector};

use crate::weights::error::WeightsError;
use crate::weights::{StageWeights, TrajectoryWeights, Weights};

#[test]
fn each_fault_is_named() {
    let identity = DMatrix::<f64>::identity(2, 2);
    let with = |row: usize, col: usize, value: f64| {
        let mut m = identity.clone();
        m[(row, col)] = value;
        m
    };
    let refused = |q: &DMatrix<f64>, r: &DMatrix<f64>, f: Option<&DMatrix<f64>>| {
        Weights::new(q.clone(), r.clone(), f.cloned()).unwrap_err()
    };
    assert_eq!(
        refused(&DMatrix::zeros(2, 3), &identity, None),
        WeightsError::Dimension {
            weight: "q",
            rows: 2,
            cols: 3,
            expected_rows: 2,
            expected_cols: 2
        }
    );
    assert_eq!(
        refused(&identity, &identity, Some(&DMatrix::zeros(3, 3))),
        WeightsError::Dimension {
            weight: "q_final",
            rows: 3,
            cols: 3,
            expected_rows: 2,
            expected_cols: 2
        }
    );
    assert_eq!(
        refused(&identity, &with(1, 0, f64::NAN), None),
        WeightsError::NotFinite { weight: "r", row: 1, col: 0 }
    );
    assert_eq!(
        refused(&with(0, 1, 0.5), &identity, None),
        WeightsError::NotSymmetric { weight: "q", row: 0, col: 1 }
    );
    assert_eq!(refused(&identity, &with(1, 1, 0.0), None), WeightsError::NotPositiveDefinite);
    assert_eq!(
        refused(&with(1, 1, -1e-3), &identity, None),
        WeightsError::Negative { weight: "q" }
    );
    assert_eq!(
        refused(&identity, &identity, Some(&(-&identity))),
        WeightsError::Negative { weight: "q_final" }
    );
}

#[test]
fn a_singular_state_weight_is_good() {
    let weights = Weights::diagonal(&[1.0, 0.0], &[2.0]).unwrap();
    assert_eq!((weights.states(), weights.inputs()), (2, 1));
    assert_eq!(weights.q_final(), weights.q());
    assert!(Weights::diagonal(&[0.0, 0.0], &[2.0]).is_ok());
}

#[test]
fn sizes_are_compared_with_the_system() {
    let weights = Weights::diagonal(&[1.0, 0.0], &[2.0]).unwrap();
    assert!(weights.clone().for_system(2, 1).is_ok());
    assert_eq!(
        weights.for_system(2, 3),
        Err(WeightsError::Dimension {
            weight: "r",
            rows: 1,
            cols: 1,
            expected_rows: 3,
            expected_cols: 3
        })
    );
}

#[test]
fn a_cross_term_is_judged_together_with_the_others() {
    let weights = Weights::diagonal(&[1.0, 1e-8], &[4.0]).unwrap();
    let cross = |a: f64, b: f64| DMatrix::from_column_slice(2, 1, &[a, b]);
    // (q1 s1; s1 r) and the like lose definiteness at s1² = q1 r.
    assert!(weights.clone().with_cross(cross(1.9999, 0.0)).is_ok());
    assert!(weights.clone().with_cross(cross(0.0, 1.9999e-4)).is_ok());
    for s in [cross(2.0001, 0.0), cross(0.0, 2.0001e-4)] {
        assert_eq!(weights.clone().with_cross(s), Err(WeightsError::CrossTooLarge));
    }
    let blind = Weights::diagonal(&[1.0, 0.0], &[4.0]).unwrap();
    assert_eq!(blind.with_cross(cross(0.0, 1e-9)), Err(WeightsError::CrossTooLarge));
    let error = weights.clone().with_cross(DMatrix::zeros(1, 2)).unwrap_err();
    assert_eq!(error.weight(), "s");
    assert!(matches!(error, WeightsError::Dimension { expected_rows: 2, expected_cols: 1, .. }));
}

#[test]
fn weights_per_step_name_the_step() {
    let stage = |n: usize| {
        StageWeights::new(DMatrix::identity(n, n), DMatrix::identity(1, 1), None, None, None)
            .unwrap()
    };
    let error =
        TrajectoryWeights::per_step(vec![stage(2), stage(3)], DMatrix::zeros(2, 2)).unwrap_err();
    assert_eq!((error.step(), error.weight()), (Some(1), "q"));
    let error = TrajectoryWeights::per_step(vec![stage(2)], DMatrix::zeros(3, 3)).unwrap_err();
    assert_eq!((error.step(), error.weight()), (None, "q_final"));
    assert_eq!(
        TrajectoryWeights::per_step(Vec::new(), DMatrix::zeros(2, 2)),
        Err(WeightsError::NoSteps)
    );
}

#[test]
fn a_step_of_an_optimisation_need_not_be_convex() {
    let (q, r) = (-DMatrix::identity(2, 2), DMatrix::identity(1, 1));
    let linear = DVector::from_element(2, 1.0);
    assert!(!StageWeights::symmetric(q.clone(), r.clone(), None, None, None).unwrap().is_convex());
    assert_eq!(
        StageWeights::new(q.clone(), r.clone(), None, None, None),
        Err(WeightsError::Negative { weight: "q" })
    );
    let error = StageWeights::symmetric(q.clone(), r.clone(), None, None, Some(linear.clone()))
        .unwrap_err();
    assert_eq!(error.weight(), "u_linear");
    let error = StageWeights::symmetric(q, r, None, Some(linear * f64::NAN), None).unwrap_err();
    assert_eq!(error, WeightsError::NotFinite { weight: "x_linear", row: 0, col: 0 });
}
