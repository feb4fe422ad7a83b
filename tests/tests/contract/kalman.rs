//! Kalman filters, and what regulators tell besides their gains. What is checked are the equations
//! that the answers must satisfy.

use nalgebra::DMatrix;
use plantd_client::{Code, MatrixExt as _, diagonal, operating_point, v1};

use crate::support::*;

fn dense(matrix: &Option<v1::Matrix>) -> DMatrix<f64> {
    let matrix = matrix.as_ref().expect("a matrix");
    DMatrix::from_row_slice(matrix.rows as usize, matrix.cols as usize, &matrix.data)
}

#[track_caller]
fn assert_near(a: &DMatrix<f64>, b: &DMatrix<f64>) {
    assert_eq!(a.shape(), b.shape());
    let scale = a.amax().max(b.amax()).max(1e-300);
    assert!((a - b).amax() < 1e-9 * scale, "{a} is not {b}");
}

fn positions() -> v1::Measurement {
    v1::Measurement { outputs: vec!["x".to_owned(), "theta".to_owned()], ..Default::default() }
}

fn noise() -> v1::NoiseCovariances {
    v1::NoiseCovariances {
        process: Some(diagonal([1e-6, 1e-6, 1e-4, 1e-4])),
        input: Some(diagonal([0.5])),
        measurement: Some(diagonal([1e-4, 2e-4])),
    }
}

fn upright() -> v1::SolveKalmanRequest {
    v1::SolveKalmanRequest {
        model: "cart-pole".to_owned(),
        point: Some(operating_point("upright")),
        measurement: Some(positions()),
        noise: Some(noise()),
        ..Default::default()
    }
}

/// `process + b input bᵀ`.
fn process(b: &DMatrix<f64>) -> DMatrix<f64> {
    let own = DMatrix::from_diagonal(&nalgebra::dvector![1e-6, 1e-6, 1e-4, 1e-4]);
    own + b * 0.5 * b.transpose()
}

fn measurement() -> DMatrix<f64> {
    DMatrix::from_diagonal(&nalgebra::dvector![1e-4, 2e-4])
}

/// A tachometer: what it shows follows from a step of the plant's own, and at rest it shows nothing.
#[tokio::test]
async fn velocities_are_measured_at_rest() {
    let (_server, client) = server().await;
    let mut tachometer = upright();
    let outputs = ["v(theta)", "x"].map(str::to_owned).to_vec();
    tachometer.measurement = Some(v1::Measurement { outputs, ..Default::default() });
    let filter = client.solve_kalman(tachometer.clone()).await.unwrap();
    assert_eq!(filter.outputs, ["v(theta)", "x"]);
    let (c, a) = (dense(&filter.output_x), dense(&filter.linearization.unwrap().a));
    assert!(filter.y_reference[0].abs() < 1e-15 && filter.y_reference[1] == filter.x_reference[0]);
    // Velocities of a step that starts at rest, by momenta: the mean of those at both ends moves the pole.
    let h = 0.01;
    let mean = 0.5 * h * (c.row(0) + c.row(0) * &a);
    let moved = a.row(1) - DMatrix::from_row_slice(1, 4, &[0.0, 1.0, 0.0, 0.0]);
    for momentum in 2..4 {
        let (mean, moved) = (mean[(0, momentum)], moved[(0, momentum)]);
        assert!((mean / moved - 1.0).abs() < 0.01, "{mean} {moved}");
    }
    tachometer.measurement =
        Some(v1::Measurement { outputs: vec!["v(tetha)".to_owned()], ..Default::default() });
    let refused = client.solve_kalman(tachometer).await;
    assert_refused(refused, Code::InvalidArgument, "INVALID_FIELD", "measurement.outputs[0]");
}

#[tokio::test]
async fn a_steady_filter_solves_its_equations() {
    let (_server, client) = server().await;
    let filter = client.solve_kalman(upright()).await.unwrap();
    let linearization = filter.linearization.unwrap();
    let (a, b) = (dense(&linearization.a), dense(&linearization.b));
    let (c, l) = (dense(&filter.output_x), dense(&filter.gain));
    let (p, filtered) = (dense(&filter.predicted_covariance), dense(&filter.filtered_covariance));
    assert_eq!((c.shape(), l.shape()), ((2, 4), (4, 2)));
    assert_eq!(dense(&filter.output_u), DMatrix::zeros(2, 1));
    let innovation = &c * &p * c.transpose() + measurement();
    assert_near(&(&l * &innovation), &(&p * c.transpose()));
    let correction = DMatrix::identity(4, 4) - &l * &c;
    assert_near(&filtered, &(&correction * &p));
    assert_near(&p, &(&a * &filtered * a.transpose() + process(&b)));
    assert_eq!(filter.error_modes.len(), 4);
    let modulus = |z: &v1::Complex| z.real.hypot(z.imaginary);
    assert!(filter.error_modes.iter().all(|mode| modulus(mode) < 1.0));
    assert!(filter.error_modes.is_sorted_by(|a, b| modulus(a) >= modulus(b) - 1e-12));
    let trace: f64 = filter.error_modes.iter().map(|mode| mode.real).sum();
    assert!((trace - (&a * &correction).trace()).abs() < 1e-9);
    assert!(filter.residual < 1e-9 && filter.reciprocal_condition > 0.0);
    assert_eq!(filter.outputs, ["x", "theta"]);
    assert_eq!(filter.y_reference, filter.x_reference[..2]);

    // An output of the input shifts the output of the reference, and not the gain.
    let output_x = Some(v1::Matrix::from_rows(&[[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]));
    let output_u = Some(v1::Matrix::from_rows(&[[1.0], [0.0]]));
    let measurement = Some(v1::Measurement { outputs: vec![], output_x, output_u });
    let same = client.solve_kalman(v1::SolveKalmanRequest { measurement, ..upright() }).await;
    let same = same.unwrap();
    assert_eq!(dense(&same.gain), l);
    assert_eq!(
        (same.output_u.unwrap().data, same.outputs),
        (vec![1.0, 0.0], vec!["y0".to_owned(), "y1".to_owned()])
    );
}

#[tokio::test]
async fn a_filter_along_a_trajectory_is_the_recursion() {
    let (_server, client) = server().await;
    let u: Vec<_> = (0..15).map(|k| [10.0 * (0.3 * f64::from(k)).sin()]).collect();
    let request = v1::SolveTrajectoryKalmanRequest {
        model: "cart-pole".to_owned(),
        trajectory: Some(v1::Trajectory { initial: None, u: Some(v1::Matrix::from_rows(&u)) }),
        measurement: Some(positions()),
        noise: Some(noise()),
        initial_covariance: Some(diagonal([0.1, 0.2, 0.3, 0.4])),
        covariances: true,
        ..Default::default()
    };
    let answers = client.solve_trajectory_kalman(request.clone()).await.unwrap();
    let answers = answers.collect().await.unwrap();
    assert_eq!(answers.len(), 16);
    let c = dense(&answers[0].output_x);
    let mut p = DMatrix::from_diagonal(&nalgebra::dvector![0.1, 0.2, 0.3, 0.4]);
    for (k, answer) in answers.iter().enumerate() {
        assert_eq!(answer.step as usize, k);
        assert_eq!(answer.output_x.is_some(), k == 0);
        assert_eq!(answer.u_reference.len(), usize::from(k < 15));
        assert_eq!(answer.y_reference, answer.x_reference[..2]);
        assert_near(&dense(&answer.predicted_covariance), &p);
        let innovation = &c * &p * c.transpose() + measurement();
        let l = dense(&answer.gain);
        assert_near(&(&l * innovation), &(&p * c.transpose()));
        let filtered = (DMatrix::identity(4, 4) - l * &c) * &p;
        assert_near(&dense(&answer.filtered_covariance), &filtered);
        let Some(linearization) = &answer.linearization else {
            assert_eq!(k, 15);
            continue;
        };
        let (a, b) = (dense(&linearization.a), dense(&linearization.b));
        p = &a * filtered * a.transpose() + process(&b);
    }
    let bare = v1::SolveTrajectoryKalmanRequest { covariances: false, ..request.clone() };
    let bare = client.solve_trajectory_kalman(bare).await.unwrap().collect().await.unwrap();
    assert_eq!(bare[9].gain, answers[9].gain);
    assert!(bare.iter().all(|answer| answer.predicted_covariance.is_none()));

    let negative = Some(diagonal([0.1, -0.2, 0.3, 0.4]));
    let bad = v1::SolveTrajectoryKalmanRequest { initial_covariance: negative, ..request };
    let refused = match client.solve_trajectory_kalman(bad).await {
        Ok(mut answers) => soon(answers.next()).await.map(drop),
        Err(error) => Err(error),
    };
    assert_refused(refused, Code::InvalidArgument, "INVALID_COVARIANCE", "initial_covariance");
}

#[tokio::test]
async fn what_has_no_filter_is_refused() {
    let (_server, client) = server().await;
    // Nothing of the right pendulum, which falls, is measured.
    client.create_model(TWO_PENDULUMS).await.unwrap();
    let blind = v1::SolveKalmanRequest {
        model: "two-pendulums".to_owned(),
        point: Some(operating_point("initial")),
        measurement: Some(v1::Measurement {
            outputs: vec!["left".to_owned()],
            ..Default::default()
        }),
        noise: Some(v1::NoiseCovariances {
            process: Some(diagonal([1.0; 4])),
            input: None,
            measurement: Some(diagonal([1.0])),
        }),
        ..Default::default()
    };
    let error = client.solve_kalman(blind).await.unwrap_err();
    assert_eq!((error.code(), error.reason()), (Some(Code::FailedPrecondition), "NOT_DETECTABLE"));
    let moving = v1::SolveKalmanRequest { point: Some(operating_point("initial")), ..upright() };
    assert_eq!(client.solve_kalman(moving).await.unwrap_err().reason(), "NOT_AN_EQUILIBRIUM");

    let with = |change: fn(&mut v1::NoiseCovariances)| {
        let mut noise = noise();
        change(&mut noise);
        v1::SolveKalmanRequest { noise: Some(noise), ..upright() }
    };
    let reason = "INVALID_COVARIANCE";
    for (request, field) in [
        (with(|noise| noise.measurement = Some(diagonal([1.0, 0.0]))), "noise.measurement"),
        (with(|noise| noise.process = Some(diagonal([-1.0, 0.0, 0.0, 0.0]))), "noise.process"),
        (with(|noise| noise.input = Some(diagonal([-1.0]))), "noise.input"),
    ] {
        let refused = client.solve_kalman(request).await;
        assert_refused(refused, Code::InvalidArgument, reason, field);
    }
    let measured =
        |measurement| v1::SolveKalmanRequest { measurement: Some(measurement), ..upright() };
    for (request, field) in [
        (v1::SolveKalmanRequest { noise: None, ..upright() }, "noise"),
        (with(|noise| noise.measurement = None), "noise.measurement"),
        (with(|noise| noise.process = Some(diagonal([1.0]))), "noise.process.diagonal"),
        (
            measured(v1::Measurement { outputs: vec!["phi".to_owned()], ..Default::default() }),
            "measurement.outputs[0]",
        ),
        (
            measured(v1::Measurement {
                output_u: Some(v1::Matrix::from_rows(&[[1.0]])),
                ..Default::default()
            }),
            "measurement.output_u",
        ),
    ] {
        assert_bad_field(client.solve_kalman(request).await, field);
    }
}

#[tokio::test]
async fn regulators_tell_their_closed_loop_value_and_conditions() {
    let (_server, client) = server().await;
    let cross = v1::Matrix::from_rows(&[[0.1], [0.2], [-0.1], [0.3]]);
    let weights = v1::LqrWeights { s: Some(cross.clone()), ..unit_weights(4, 1) };
    let request = v1::SolveLqrRequest {
        model: "cart-pole".to_owned(),
        point: Some(operating_point("upright")),
        weights: Some(weights.clone()),
        ..Default::default()
    };
    let regulator = client.solve_lqr(request.clone()).await.unwrap();
    let at = v1::LinearizeRequest {
        model: "cart-pole".to_owned(),
        point: Some(operating_point("upright")),
        ..Default::default()
    };
    let linearization = client.linearize(at).await.unwrap().linearization.unwrap();
    let (a, b) = (dense(&linearization.a), dense(&linearization.b));
    let (p, k) = (dense(&regulator.value), dense(&regulator.gain.unwrap().k));
    let s = dense(&Some(cross.clone()));
    let inner = DMatrix::identity(1, 1) + b.transpose() * &p * &b;
    assert_near(&(&inner * &k), &(b.transpose() * &p * &a + s.transpose()));
    let rest = DMatrix::identity(4, 4) + a.transpose() * &p * &a - k.transpose() * &inner * &k;
    assert_near(&p, &rest);
    assert_eq!(regulator.closed_loop.len(), 4);
    let trace: f64 = regulator.closed_loop.iter().map(|z| z.real).sum();
    assert!((trace - (&a - &b * &k).trace()).abs() < 1e-9);
    let largest = &regulator.closed_loop[0];
    assert!((largest.real.hypot(largest.imaginary) - regulator.spectral_radius).abs() < 1e-12);
    assert!((regulator.reciprocal_condition - 1.0).abs() < 1e-12, "of one number");

    let too_large = v1::LqrWeights { s: Some(v1::Matrix::from_rows(&[[9.0]; 4])), ..weights };
    let refused = v1::SolveLqrRequest { weights: Some(too_large), ..request };
    let refused = client.solve_lqr(refused).await;
    assert_refused(refused, Code::InvalidArgument, "INVALID_WEIGHT", "weights.s");

    // Weights of each step with linear terms: the recursion by hand, from the end.
    const STEPS: usize = 6;
    let stage = |k: usize| v1::StageWeights {
        q: Some(diagonal([1.0 + k as f64; 4])),
        r: Some(diagonal([2.0])),
        s: Some(cross.clone()),
        x_linear: vec![0.5, 0.0, 0.0, -0.5],
        u_linear: vec![0.25],
    };
    let u = v1::Matrix::from_rows(&[[3.0]; STEPS]);
    let trajectory = Some(v1::Trajectory { initial: None, u: Some(u) });
    let request = v1::SolveTrajectoryLqrRequest {
        model: "cart-pole".to_owned(),
        trajectory: trajectory.clone(),
        weights: Some(v1::LqrWeights { q_final: Some(diagonal([7.0; 4])), ..Default::default() }),
        stages: (0..STEPS).map(stage).collect(),
        values: true,
        ..Default::default()
    };
    let solved = client.solve_trajectory_lqr(request.clone()).await.unwrap();
    let solved = solved.collect().await.unwrap();
    let model = "cart-pole".to_owned();
    let along = v1::LinearizeTrajectoryRequest { model, trajectory, ..Default::default() };
    let along = client.linearize_trajectory(along).await.unwrap().collect().await.unwrap();
    let mut p = DMatrix::<f64>::identity(4, 4) * 7.0;
    let mut linear = DMatrix::<f64>::zeros(4, 1);
    let last = solved.last().unwrap();
    assert_near(&dense(&last.value), &p);
    assert!(last.value_linear.is_empty() && last.reciprocal_condition == 0.0);
    for k in (0..STEPS).rev() {
        let linearization = along[k].linearization.as_ref().unwrap();
        let (a, b) = (dense(&linearization.a), dense(&linearization.b));
        let inner = DMatrix::identity(1, 1) * 2.0 + b.transpose() * &p * &b;
        let inverse = inner.clone().try_inverse().unwrap();
        let gain = &inverse * (b.transpose() * &p * &a + s.transpose());
        let drive = b.transpose() * &linear + DMatrix::from_element(1, 1, 0.25);
        let forward = -(&inverse * &drive);
        let x_linear = DMatrix::from_column_slice(4, 1, &[0.5, 0.0, 0.0, -0.5]);
        linear = x_linear + a.transpose() * &linear - gain.transpose() * &drive;
        p = DMatrix::<f64>::identity(4, 4) * (1.0 + k as f64) + a.transpose() * &p * &a
            - gain.transpose() * &inner * &gain;
        let answer = &solved[k];
        let found = answer.gain.as_ref().unwrap();
        assert_near(&dense(&found.k), &gain);
        assert_near(&DMatrix::from_column_slice(1, 1, &found.feedforward), &forward);
        assert_near(&dense(&answer.value), &p);
        assert_near(&DMatrix::from_column_slice(4, 1, &answer.value_linear), &linear);
        assert!((answer.reciprocal_condition - 1.0).abs() < 1e-12);
    }
    let few = v1::SolveTrajectoryLqrRequest { stages: vec![stage(0)], ..request.clone() };
    let refused = match client.solve_trajectory_lqr(few).await {
        Ok(mut answers) => soon(answers.next()).await.map(drop),
        Err(error) => Err(error),
    };
    assert_bad_field(refused, "stages");
    let mut crooked = request;
    crooked.stages[4].r = Some(diagonal([-1.0]));
    let refused = match client.solve_trajectory_lqr(crooked).await {
        Ok(mut answers) => soon(answers.next()).await.map(drop),
        Err(error) => Err(error),
    };
    assert_refused(refused, Code::InvalidArgument, "INVALID_WEIGHT", "stages[4].r");
}
