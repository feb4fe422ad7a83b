//! Kinematics of frames and the terms of the equation of motion, of models and of plants.

use plantd_client::{Client, Code, MatrixExt as _, v1};

use crate::support::*;

fn of_model(model: &str, q: &[f64], v: &[f64]) -> v1::MechanicalState {
    let (model, q, v) = (model.to_owned(), q.to_vec(), v.to_vec());
    v1::MechanicalState { model, q, v, ..Default::default() }
}

fn of_plant(id: &str) -> v1::MechanicalState {
    v1::MechanicalState { plant: id.to_owned(), ..Default::default() }
}

fn frames(state: v1::MechanicalState) -> v1::KinematicsRequest {
    v1::KinematicsRequest { state: Some(state), jacobians: true, ..Default::default() }
}

fn terms(state: v1::MechanicalState) -> v1::DynamicsRequest {
    v1::DynamicsRequest { state: Some(state), ..Default::default() }
}

#[track_caller]
fn close(found: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len());
    for (x, y) in found.iter().zip(expected) {
        assert!((x - y).abs() <= tolerance * (1.0 + y.abs()), "{found:?} instead of {expected:?}");
    }
}

/// Two rods of 1 m in the plane of x and z, hanging down at zero.
#[tokio::test]
async fn frames_points_and_mass_in_closed_form() {
    let (_server, client) = server().await;
    let (a, b, va, vb) = (0.4_f64, -1.1_f64, 0.9, -1.7);
    let mut request = frames(of_model("double-pendulum", &[a, b], &[va, vb]));
    request.frames = vec!["forearm".to_owned(), "world".to_owned()];
    let point =
        |frame: &str, at: &[f64]| v1::FramePoint { frame: frame.to_owned(), at: at.to_vec() };
    request.points = vec![point("forearm", &[0.0, 0.0, -1.0]), point("upper_arm", &[])];
    let answer = client.kinematics(request).await.unwrap();
    assert_eq!(answer.coordinates, ["shoulder", "elbow"]);
    assert_eq!((&answer.q[..], &answer.v[..]), (&[a, b][..], &[va, vb][..]));
    let (elbow, rate) = ([-a.sin(), 0.0, -a.cos()], [-a.cos(), 0.0, a.sin()]);
    let frame = &answer.frames[0];
    assert_eq!(frame.frame, "forearm");
    close(&frame.position, &elbow, 1e-14);
    close(&frame.linear_velocity, &rate.map(|x| x * va), 1e-14);
    close(&frame.angular_velocity, &[0.0, va + vb, 0.0], 1e-14);
    let half: f64 = 0.5 * (a + b);
    close(&frame.orientation, &[half.cos(), 0.0, half.sin(), 0.0], 1e-14);
    let jacobian = frame.jacobian.as_ref().unwrap();
    assert_eq!((jacobian.rows, jacobian.cols), (6, 2));
    let motion = [&frame.linear_velocity[..], &frame.angular_velocity].concat();
    close(&jacobian.times(&[va, vb]), &motion, 1e-14);
    assert!(answer.frames[1].jacobian.as_ref().unwrap().data.iter().all(|x| *x == 0.0));

    let c = a + b;
    let (bob, bob_rate) = ([elbow[0] - c.sin(), 0.0, elbow[2] - c.cos()], va + vb);
    close(&answer.points[0].position, &bob, 1e-14);
    let velocity = [rate[0] * va - c.cos() * bob_rate, 0.0, rate[2] * va + c.sin() * bob_rate];
    close(&answer.points[0].velocity, &velocity, 1e-14);
    let by_elbow = answer.points[0].jacobian.as_ref().unwrap();
    assert_eq!((by_elbow.rows, by_elbow.cols), (3, 2));
    close(&[0, 1, 2].map(|k| by_elbow.at(k, 1)), &[-c.cos(), 0.0, c.sin()], 1e-14);
    close(&answer.points[1].position, &[0.0; 3], 1e-15);

    let center = answer.center_of_mass.unwrap();
    close(&[center.mass_kg], &[2.0], 1e-15);
    close(&center.position, &[0, 1, 2].map(|k| 0.5 * (elbow[k] + bob[k])), 1e-14);
    let found = center.jacobian.unwrap().times(&[va, vb]);
    close(&found, &center.velocity, 1e-14);
    close(&found, &[0, 1, 2].map(|k| 0.5 * (rate[k] * va + velocity[k])), 1e-14);

    // All frames in the scene's order, no Jacobians, where the scene begins.
    let plain =
        v1::KinematicsRequest { jacobians: false, ..frames(of_model("marionette", &[], &[])) };
    let answer = client.kinematics(plain).await.unwrap();
    assert!(answer.frames.len() > 10 && answer.frames.iter().all(|f| f.jacobian.is_none()));
    assert!(answer.v.iter().all(|v| *v == 0.0) && answer.points.is_empty());
}

#[tokio::test]
async fn the_equation_of_motion_balances() {
    let (_server, client) = server().await;
    let (a, b, va, vb) = (0.4_f64, -1.1_f64, 0.9, -1.7);
    let request = v1::DynamicsRequest {
        inputs: vec![0.3, -0.2],
        acceleration: vec![2.0, -3.0],
        ..terms(of_model("double-pendulum", &[a, b], &[va, vb]))
    };
    let answer = client.dynamics(request).await.unwrap();
    let (cos, sin, g) = (b.cos(), b.sin(), 9.8);
    let mass = [3.0 + 2.0 * cos, 1.0 + cos, 1.0 + cos, 1.0];
    close(&answer.mass_matrix.unwrap().data, &mass, 1e-14);
    let gravity = [g * (2.0 * a.sin() + (a + b).sin()), g * (a + b).sin()];
    close(&answer.gravity, &gravity, 1e-14);
    let bias = [gravity[0] - sin * vb * (2.0 * va + vb), gravity[1] + sin * va * va];
    close(&answer.bias, &bias, 1e-14);
    assert_eq!((&answer.passive[..], &answer.input[..]), (&[0.0; 2][..], &[0.3, -0.2][..]));
    let force = answer.inverse.unwrap().force;
    let lacking = [
        mass[0] * 2.0 - mass[1] * 3.0 + bias[0] - 0.3,
        mass[2] * 2.0 - mass[3] * 3.0 + bias[1] + 0.2,
    ];
    close(&force, &lacking, 1e-13);
    assert!(answer.forward.is_none());
    let request = v1::DynamicsRequest {
        inputs: vec![0.3 + force[0], -0.2 + force[1]],
        forward: true,
        ..terms(of_model("double-pendulum", &[a, b], &[va, vb]))
    };
    let answer = client.dynamics(request).await.unwrap();
    close(&answer.forward.unwrap().acceleration, &[2.0, -3.0], 1e-12);
    assert!(answer.inverse.is_none());
}

/// On a plant in motion that has other parameters than its model, and stays as it is.
#[tokio::test]
async fn plants_are_looked_at_and_stay() {
    let (_server, client) = server().await;
    let id = plant(&client, "four-bar").await.id;
    let parameter = v1::Parameter { path: "gravity[2]".to_owned(), value: -3.0 };
    let request = v1::SetParametersRequest {
        id: id.clone(),
        parameters: vec![parameter],
        ..Default::default()
    };
    client.set_parameters(request).await.unwrap();
    let u = Some(v1::Matrix::from_rows(&[[0.4]; 8]));
    let step = v1::StepRequest { id: id.clone(), u, ..Default::default() };
    let state = client.step(step).await.unwrap().states.remove(0);
    let before = client.snapshot(&id).await.unwrap();

    let diagnosed = client
        .diagnose(v1::DiagnoseRequest { id: id.clone(), ..Default::default() })
        .await
        .unwrap();
    let answer = client.kinematics(frames(of_plant(&id))).await.unwrap();
    assert_eq!(answer.q, state.q);
    let center = answer.center_of_mass.unwrap();
    close(&center.position, &diagnosed.center_of_mass, 1e-13);
    let momentum: Vec<f64> = center.velocity.iter().map(|v| v * center.mass_kg).collect();
    close(&momentum, &diagnosed.linear_momentum, 1e-12);

    let request = v1::DynamicsRequest { forward: true, ..terms(of_plant(&id)) };
    let answer = client.dynamics(request).await.unwrap();
    assert_eq!((&answer.inputs[..], answer.q.len(), answer.constraints.len()), (&[0.4][..], 3, 2));
    let (energy, known) = (answer.energy.unwrap(), diagnosed.energy.unwrap());
    close(&[energy.kinetic_j, energy.potential_j], &[known.kinetic_j, known.potential_j], 1e-13);
    let forward = answer.forward.unwrap();
    let dh = answer.constraint_jacobian.unwrap();
    let inertial = answer.mass_matrix.unwrap().times(&forward.acceleration);
    for (i, inertial) in inertial.iter().enumerate() {
        let taken: f64 = (0..2).map(|c| dh.at(c, i) * forward.multipliers[c]).sum();
        let right = answer.passive[i] + answer.input[i] - taken;
        close(&[inertial + answer.bias[i]], &[right], 1e-10);
    }
    let back =
        v1::DynamicsRequest { acceleration: forward.acceleration.clone(), ..terms(of_plant(&id)) };
    let inverse = client.dynamics(back).await.unwrap().inverse.unwrap();
    close(&inverse.force, &[0.0; 3], 1e-9);
    close(&inverse.multipliers, &forward.multipliers, 1e-10);
    close(&inverse.constraint_acceleration, &[0.0; 2], 1e-9);
    // Its gravity is the changed one.
    let of_the_model = client.dynamics(terms(of_model("four-bar", &state.q, &[]))).await.unwrap();
    let scaled: Vec<f64> = of_the_model.gravity.iter().map(|x| x * 3.0 / 9.8).collect();
    close(&answer.gravity, &scaled, 1e-12);

    // At rest elsewhere; and what is refused changes nothing either.
    let elsewhere = v1::MechanicalState { q: vec![0.1, 0.2, 0.3], ..of_plant(&id) };
    let answer = client.kinematics(frames(elsewhere)).await.unwrap();
    assert_eq!((answer.q, answer.v), (vec![0.1, 0.2, 0.3], vec![0.0; 3]));
    let bad = v1::MechanicalState { v: vec![0.0; 2], ..of_plant(&id) };
    assert_bad_field(client.dynamics(terms(bad)).await, "state.v");
    assert_eq!(client.snapshot(&id).await.unwrap(), before);
}

#[tokio::test]
async fn bad_requests_name_their_field() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let here = || of_model("cart-pole", &[], &[]);
    let state = |change: &dyn Fn(&mut v1::MechanicalState)| {
        let mut state = here();
        change(&mut state);
        frames(state)
    };
    let changed = |change: &dyn Fn(&mut v1::KinematicsRequest)| {
        let mut request = frames(here());
        change(&mut request);
        request
    };
    let point =
        |frame: &str, at: &[f64]| vec![v1::FramePoint { frame: frame.to_owned(), at: at.to_vec() }];
    for (request, field) in [
        (changed(&|r| r.state = None), "state"),
        (state(&|s| s.plant = id.clone()), "state.model"),
        (state(&|s| s.operating_point = "sideways".to_owned()), "state.operating_point"),
        (state(&|s| s.q = vec![0.0]), "state.q"),
        (state(&|s| s.v = vec![0.0, f64::NAN]), "state.v[1]"),
        (changed(&|r| r.frames = vec!["pole".to_owned(), "tail".to_owned()]), "frames[1]"),
        (changed(&|r| r.points = point("tail", &[])), "points[0].frame"),
        (changed(&|r| r.points = point("pole", &[0.0; 2])), "points[0].at"),
        (changed(&|r| r.points = point("pole", &[f64::MAX; 3])), "points[0].at"),
    ] {
        assert_bad_field(client.kinematics(request).await, field);
    }
    let changed = |change: &dyn Fn(&mut v1::DynamicsRequest)| {
        let mut request = terms(here());
        change(&mut request);
        request
    };
    for (request, field) in [
        (changed(&|r| r.inputs = vec![0.0; 2]), "inputs"),
        (changed(&|r| r.acceleration = vec![0.0; 3]), "acceleration"),
        (changed(&|r| r.acceleration = vec![f64::INFINITY, 0.0]), "acceleration[0]"),
        (changed(&|r| r.prescribed_acceleration = vec![0.0]), "prescribed_acceleration"),
    ] {
        assert_bad_field(client.dynamics(request).await, field);
    }
    let none = client.dynamics(terms(of_model("none", &[], &[]))).await;
    assert_not_found(none, "MODEL_NOT_FOUND");
    assert_not_found(client.kinematics(frames(of_plant("none"))).await, "PLANT_NOT_FOUND");
    let huge = client.dynamics(terms(of_model("cart-pole", &[], &[1e200; 2]))).await;
    assert_eq!(huge.unwrap_err().reason(), "MOTION_NOT_FINITE");
    // Terms are there where the accelerations are not.
    let pole = of_model("spherical-pendulum", &[0.3, std::f64::consts::FRAC_PI_2], &[]);
    client.dynamics(terms(pole.clone())).await.unwrap();
    let refused = client.dynamics(v1::DynamicsRequest { forward: true, ..terms(pole) }).await;
    assert_eq!(refused.unwrap_err().reason(), "SINGULAR");
    assert_limited(&client).await;
}

async fn assert_limited(client: &Client) {
    for frames in [700, 100_000] {
        let request =
            v1::KinematicsRequest { frames: vec!["world".to_owned(); frames], ..frames_of_chain() };
        let refused = client.kinematics(request).await;
        assert!(refused.as_ref().unwrap_err().to_string().contains("reply_numbers"));
        assert_refused(refused, Code::ResourceExhausted, "LIMIT_EXCEEDED", "");
    }
    client.kinematics(frames_of_chain()).await.unwrap();
    let refused = client.dynamics(terms(of_model("chain-700", &[], &[]))).await;
    assert_refused(refused, Code::ResourceExhausted, "LIMIT_EXCEEDED", "");
    client.dynamics(terms(of_model("chain-100", &[], &[]))).await.unwrap();
}

fn frames_of_chain() -> v1::KinematicsRequest {
    frames(of_model("chain-100", &[], &[]))
}
