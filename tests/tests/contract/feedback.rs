//! Feedback in a plant's own loop, and gains for whoever watches them.

use plantd_client::link::LinkDriver;
use plantd_client::{
    Answers, Client, Code, GainSchedule, MatrixExt as _, StateExt as _, operating_point,
    present_state, v1,
};
use v1::FeedbackMode as Mode;
use v1::set_feedback_request::Reference;

use plantd_tests::links::patient;

use crate::support::*;

const STEPS: usize = 40;

/// Forces that swing the cart-pole a little.
fn reference() -> v1::Trajectory {
    let row = |k: usize| [5.0 * (0.3 * k as f64).sin()];
    let u: Vec<_> = (0..STEPS).map(row).collect();
    v1::Trajectory { initial: None, u: Some(v1::Matrix::from_rows(&u)) }
}

fn along(id: &str, mode: Mode) -> v1::SetFeedbackRequest {
    v1::SetFeedbackRequest {
        id: id.to_owned(),
        reference: Some(Reference::Trajectory(reference())),
        weights: Some(unit_weights(4, 1)),
        mode: mode.into(),
        ..Default::default()
    }
}

fn about(id: &str, point: v1::Point, mode: Mode) -> v1::SetFeedbackRequest {
    v1::SetFeedbackRequest { reference: Some(Reference::Point(point)), ..along(id, mode) }
}

/// A gain that does not say what it was computed for, as those that follow a plant.
fn anonymous(gain: v1::Gain) -> v1::Gain {
    v1::Gain { model: String::new(), time_step_s: 0.0, ..gain }
}

/// What SolveTrajectoryLqr answers for the same reference.
async fn solved(client: &Client) -> Vec<v1::Gain> {
    let request = v1::SolveTrajectoryLqrRequest {
        model: "cart-pole".to_owned(),
        trajectory: Some(reference()),
        weights: Some(unit_weights(4, 1)),
        ..Default::default()
    };
    let stream = client.solve_trajectory_lqr(request).await.unwrap();
    let answers = stream.collect().await.unwrap();
    answers.into_iter().map(|answer| anonymous(answer.gain.unwrap())).collect()
}

async fn next<T: std::fmt::Debug>(stream: &mut Answers<T>) -> T {
    soon(stream.next()).await.unwrap().expect("the stream goes on")
}

async fn info(client: &Client, id: &str) -> v1::PlantInfo {
    client.get_plant(id).await.unwrap().plant.unwrap()
}

/// A cart-pole off its reference.
async fn perturbed(client: &Client, id: &str) {
    let request = v1::CreatePlantRequest {
        id: id.to_owned(),
        model: "cart-pole".to_owned(),
        initial: Some(at_velocity(&[0.1, 0.6], &[0.0, 0.2])),
        open_link: true,
        ..Default::default()
    };
    client.create_plant(request).await.unwrap();
}

/// The server's own loop moves the plant exactly as a client does that applies the same gains, however
/// either of them is driven.
#[tokio::test(flavor = "multi_thread")]
async fn a_law_in_the_loop_is_the_same_motion_as_one_in_the_client() {
    let directory = tempfile::Builder::new().prefix("plantd-").tempdir().unwrap();
    let root = directory.path().join("link");
    let (_server, client) = server_with(&["--link-root", root.to_str().unwrap()]).await;
    let options = patient(root);
    let gains = solved(&client).await;
    let law = GainSchedule::from_gains(gains).unwrap();
    perturbed(&client, "by-client").await;
    let mut driver = client.drive("by-client").await.unwrap();
    let mut state = driver.plant().state.clone().unwrap();
    let (mut expected, mut inputs) = (Vec::new(), Vec::new());
    // Beyond the end the last gain holds, with the final state.
    for _ in 0..STEPS + 10 {
        let u = law.input(&state).unwrap();
        state = driver.step(&u).await.unwrap().state.unwrap();
        expected.push(bits(&state));
        inputs.push(u);
    }

    for id in ["by-drive", "by-step", "by-link"] {
        perturbed(&client, id).await;
        let feedback = client.set_feedback(along(id, Mode::Replace)).await.unwrap();
        assert_eq!((feedback.revision, feedback.first_step), (1, 0));
        assert_eq!((feedback.horizon as usize, feedback.mode), (STEPS, Mode::Replace.into()));
    }
    let mut driver = client.drive("by-drive").await.unwrap();
    for (k, expected) in expected.iter().enumerate() {
        // What the driver sends is not used.
        let u = [1e3 * k as f64];
        let step = driver.step(if k % 2 == 0 { &u } else { &[] }).await.unwrap();
        assert_eq!(&bits(step.state.as_ref().unwrap()), expected, "step {k}, drive");
        assert_eq!(step.u, inputs[k]);
    }
    let request = v1::StepRequest {
        id: "by-step".to_owned(),
        hold: expected.len() as u32,
        all_states: true,
        ..Default::default()
    };
    let answer = client.step(request).await.unwrap();
    assert_eq!(answer.states.iter().map(bits).collect::<Vec<_>>(), expected);
    assert_eq!(&answer.u, inputs.last().unwrap());
    let by_link = tokio::task::spawn_blocking(move || {
        let mut driver = LinkDriver::connect("by-link", options).unwrap();
        let step = |_: usize| {
            let view = driver.step(&[7.0]).unwrap();
            (view.step, view.x.iter().map(|x| x.to_bits()).collect::<Vec<_>>())
        };
        (0..STEPS + 10).map(step).collect::<Vec<_>>()
    });
    let by_link = by_link.await.unwrap();
    // The cart-pole has no constraints, and so no multipliers after x.
    assert_eq!(by_link, expected);
}

#[tokio::test]
async fn the_drivers_forces_add_to_the_law_and_watchers_see_the_sum() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let upright = operating_point("upright");
    let request = v1::CreatePlantRequest {
        id: "upright".to_owned(),
        model: "cart-pole".to_owned(),
        initial: Some(at_velocity(&[0.0, 3.1], &[0.0, 0.0])),
        ..Default::default()
    };
    client.create_plant(request).await.unwrap();
    client.set_feedback(about("upright", upright.clone(), Mode::Add)).await.unwrap();
    client.set_feedback(about(&id, upright, Mode::WatchOnly)).await.unwrap();
    let gain = next(&mut client.watch_gains("upright").await.unwrap()).await.gain.unwrap();
    let watch = v1::WatchRequest {
        id: "upright".to_owned(),
        fields: vec![v1::WatchField::Input.into()],
        ..Default::default()
    };
    let mut watch = client.watch(watch).await.unwrap();
    next(&mut watch).await;
    let mut driver = client.drive("upright").await.unwrap();
    let mut state = driver.plant().state.clone().unwrap();
    for k in 0..300 {
        let disturbance = [(0.1 * f64::from(k)).sin()];
        let law = plantd_client::GainExt::control(&gain, &state).unwrap();
        let step = driver.step(&disturbance).await.unwrap();
        assert_eq!(step.u, [law[0] + disturbance[0]], "step {k}");
        let watched = next(&mut watch).await;
        assert_eq!((watched.step, &watched.u), (state.step + 1, &step.u));
        state = step.state.unwrap();
    }
    assert!((state.q[1] - 3.1).abs() < 0.2, "it stands: {:?}", state.q);

    // A feedback that is only watched has no say.
    let mut driver = client.drive(&id).await.unwrap();
    let step = driver.step(&[0.25]).await.unwrap();
    assert!(step.u.is_empty());
    assert_bad_inputs(&mut driver).await;
    client.clear_feedback("upright").await.unwrap();
    assert!(info(&client, "upright").await.feedback.is_none());
    let cleared = client.watch_gains("upright").await;
    assert_no_feedback(cleared).await;
}

async fn assert_bad_inputs(driver: &mut plantd_client::Driver) {
    for u in [&[][..], &[0.0; 2]] {
        assert_eq!(driver.step(u).await.unwrap_err().reason(), "INPUT_DIMENSION");
    }
}

async fn assert_no_feedback(stream: plantd_client::Result<Answers<v1::WatchGainsResponse>>) {
    let error = match stream {
        Ok(mut stream) => soon(stream.next()).await.unwrap_err(),
        Err(error) => error,
    };
    let expected = (Some(Code::FailedPrecondition), "NO_FEEDBACK");
    assert_eq!((error.code(), error.reason()), expected, "{error}");
}

#[tokio::test]
async fn a_watchdog_takes_over_when_a_bound_is_passed_and_says_so() {
    let (_server, client) = server().await;
    let request = v1::CreatePlantRequest {
        id: "guarded".to_owned(),
        model: "cart-pole".to_owned(),
        initial: Some(v1::InitialState {
            form: Some(v1::initial_state::Form::OperatingPoint("upright".to_owned())),
        }),
        ..Default::default()
    };
    client.create_plant(request).await.unwrap();
    let bound = |entry: &str, min, max| v1::Bound { entry: entry.to_owned(), min, max };
    let guard = vec![bound("p(x)", None, Some(1e9)), bound("theta", Some(-0.05), Some(0.05))];
    let feedback = v1::SetFeedbackRequest {
        guard,
        ..about("guarded", operating_point("upright"), Mode::Guard)
    };
    let feedback = client.set_feedback(feedback).await.unwrap();
    assert_eq!((feedback.tripped_at_step, feedback.tripped_by.as_str()), (None, ""));
    let mut driver = client.drive("guarded").await.unwrap();
    let mut tripped = None;
    let mut state = driver.plant().state.clone().unwrap();
    for k in 0..2000 {
        let left = (state.q[1] - std::f64::consts::PI).abs() > 0.05;
        let step = driver.step(&[20.0]).await.unwrap();
        if tripped.is_none() {
            assert_eq!(step.u.is_empty(), !left, "step {k}");
            tripped = left.then_some(state.step);
        } else {
            assert_eq!(step.u.len(), 1, "the law keeps the plant");
        }
        state = step.state.unwrap();
    }
    assert!((state.q[1] - std::f64::consts::PI).abs() < 0.05, "it is caught: {:?}", state.q);
    let feedback = info(&client, "guarded").await.feedback.unwrap();
    assert!(tripped.is_some_and(|step| step > 0));
    assert_eq!((feedback.tripped_at_step, feedback.tripped_by.as_str()), (tripped, "theta"));
}

#[tokio::test]
async fn gains_of_a_trajectory_come_from_the_present_step_on_and_are_those_of_the_solver() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let solved = solved(&client).await;
    let step = |hold| v1::StepRequest { id: id.clone(), hold, ..Default::default() };
    client.step(step(3)).await.unwrap();
    let request = v1::SetFeedbackRequest { first_step: Some(2), ..along(&id, Mode::WatchOnly) };
    client.set_feedback(request).await.unwrap();
    client.step(step(7)).await.unwrap();
    // Step 10 of the plant is step 8 of the trajectory.
    let mut stream = client.watch_gains(&id).await.unwrap();
    for (k, solved) in solved.iter().enumerate().skip(8) {
        let message = next(&mut stream).await;
        assert_eq!((message.revision, message.dropped), (1, 0));
        assert_eq!((message.first_step, message.horizon as usize), (2, STEPS));
        let expected = v1::Gain { step: k as u64 + 2, ..solved.clone() };
        assert_eq!(message.gain.as_ref(), Some(&expected));
    }
    let last = solved.last().unwrap();
    assert!(last.k.is_none() && last.x_reference.len() == 4, "the final state has come");

    // A new feedback begins at the present step, and its gains come over the same stream.
    client.set_feedback(along(&id, Mode::WatchOnly)).await.unwrap();
    for (k, solved) in solved.iter().enumerate() {
        let message = next(&mut stream).await;
        assert_eq!((message.revision, message.first_step), (2, 10));
        let expected = v1::Gain { step: k as u64 + 10, ..solved.clone() };
        assert_eq!(message.gain.as_ref(), Some(&expected));
    }
    // Long after the end the last gain still holds.
    client.step(step(100)).await.unwrap();
    let mut late = client.watch_gains(&id).await.unwrap();
    assert_eq!(next(&mut late).await.gain.unwrap().step, 10 + STEPS as u64 - 1);
    assert!(next(&mut late).await.gain.unwrap().k.is_none());

    client.clear_feedback(&id).await.unwrap();
    assert_eq!(soon(stream.next()).await.unwrap_err().reason(), "NO_FEEDBACK");
}

fn set(id: &str, path: &str, value: f64, time_step_s: f64) -> v1::SetParametersRequest {
    let parameters = vec![v1::Parameter { path: path.to_owned(), value }];
    v1::SetParametersRequest { id: id.to_owned(), parameters, time_step_s }
}

/// Gains about a point follow the parameters and the time step, stamped with the step from which they
/// hold.
#[tokio::test]
async fn gains_are_computed_anew_when_parameters_change() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    client.set_feedback(about(&id, operating_point("upright"), Mode::WatchOnly)).await.unwrap();
    let mut stream = client.watch_gains(&id).await.unwrap();
    let first = next(&mut stream).await;
    assert_eq!((first.revision, first.horizon, first.dropped), (1, 0, 0));
    let solve = async |time_step_s| {
        let request = v1::SolveLqrRequest {
            model: "cart-pole".to_owned(),
            settings: Some(v1::PlantSettings { time_step_s, ..Default::default() }),
            point: Some(operating_point("upright")),
            weights: Some(unit_weights(4, 1)),
            ..Default::default()
        };
        anonymous(client.solve_lqr(request).await.unwrap().gain.unwrap())
    };
    assert_eq!(first.gain.unwrap(), solve(0.0).await);

    client.step(v1::StepRequest { id: id.clone(), hold: 5, ..Default::default() }).await.unwrap();
    let request =
        v1::SetParametersRequest { time_step_s: 0.02, id: id.clone(), ..Default::default() };
    client.set_parameters(request).await.unwrap();
    let second = next(&mut stream).await;
    assert_eq!((second.revision, second.dropped), (2, 0));
    assert_eq!(second.gain.unwrap(), v1::Gain { step: 5, ..solve(0.02).await });

    let changes = set(&id, "frames[pole].body.mass", 2.0, 0.0);
    client.set_parameters(changes).await.unwrap();
    let third = next(&mut stream).await;
    let heavy = client.get_model("cart-pole").await.unwrap().scene_toml;
    let heavy = heavy.replace("\"cart-pole\"", "\"heavy\"").replace("mass = 1.0", "mass = 2.0");
    client.create_model(heavy).await.unwrap();
    let request = v1::SolveLqrRequest {
        model: "heavy".to_owned(),
        settings: Some(v1::PlantSettings { time_step_s: 0.02, ..Default::default() }),
        point: Some(operating_point("upright")),
        weights: Some(unit_weights(4, 1)),
        ..Default::default()
    };
    let heavy = client.solve_lqr(request).await.unwrap().gain.unwrap();
    assert_eq!((heavy.model.as_str(), heavy.time_step_s), ("heavy", 0.02));
    let heavy = anonymous(heavy);
    assert_eq!(third.gain.unwrap(), v1::Gain { step: 5, ..heavy });
    assert_eq!(info(&client, &id).await.feedback.unwrap().revision, 3);
}

/// Where there are no gains for the new parameters, the old ones stay in force, and everybody is told.
#[tokio::test]
async fn a_failed_computation_leaves_the_gains_in_force_and_says_why() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    client.set_feedback(along(&id, Mode::Replace)).await.unwrap();
    let mut stream = client.watch_gains(&id).await.unwrap();
    for _ in 0..=STEPS {
        assert!(next(&mut stream).await.failure.is_none());
    }
    let request =
        v1::SetParametersRequest { time_step_s: 0.02, id: id.clone(), ..Default::default() };
    client.set_parameters(request).await.unwrap();
    let message = next(&mut stream).await;
    let failure = message.failure.unwrap();
    assert_eq!((failure.reason.as_str(), message.revision), ("TIME_STEP_CHANGED", 1));
    assert!(failure.message.contains("SetFeedback"), "{}", failure.message);
    assert!(message.gain.is_none());
    let feedback = info(&client, &id).await.feedback.unwrap();
    assert_eq!((feedback.revision, feedback.failure), (1, Some(failure)));
    let mut driver = client.drive(&id).await.unwrap();
    assert_eq!(driver.step(&[]).await.unwrap().u.len(), 1, "the law is in force");

    // Back to the time step of the trajectory: gains again.
    let request =
        v1::SetParametersRequest { time_step_s: 0.01, id: id.clone(), ..Default::default() };
    client.set_parameters(request).await.unwrap();
    let message = next(&mut stream).await;
    assert_eq!((message.revision, message.failure), (2, None));
    // Step 1 is where the plant is now.
    assert_eq!(message.gain.unwrap().step, 1);
}

/// A gain that was given stays what it is, whatever changes.
#[tokio::test]
async fn a_gain_as_it_stands() {
    let (_server, client) = server().await;
    let id = plant(&client, "cart-pole").await.id;
    let gain = v1::Gain {
        step: 99,
        k: Some(v1::Matrix::from_rows(&[[1.0, 2.0, 3.0, 4.0]])),
        x_reference: vec![0.1, 0.2, 0.3, 0.4],
        u_reference: vec![0.5],
        feedforward: vec![0.25],
        ..Default::default()
    };
    let request = |gain: v1::Gain| v1::SetFeedbackRequest {
        reference: Some(Reference::Gain(gain)),
        weights: None,
        ..along(&id, Mode::Replace)
    };
    client.set_feedback(request(gain.clone())).await.unwrap();
    let foreign = v1::Gain { model: "double-pendulum".to_owned(), ..gain.clone() };
    assert_bad_field(client.set_feedback(request(foreign)).await, "gain.model");
    let slower = v1::Gain { time_step_s: 0.02, ..gain.clone() };
    assert_bad_field(client.set_feedback(request(slower)).await, "gain.time_step_s");
    let mut stream = client.watch_gains(&id).await.unwrap();
    let message = next(&mut stream).await;
    assert_eq!(message.gain, Some(v1::Gain { step: 0, ..gain.clone() }));
    client.set_parameters(set(&id, "gravity[1]", -1.0, 0.0)).await.unwrap();
    let feedback = info(&client, &id).await;
    assert_eq!((feedback.feedback.unwrap().failure, feedback.parameters.len()), (None, 1));
    let mut driver = client.drive(&id).await.unwrap();
    let x = driver.plant().state.clone().unwrap().x();
    let correction: f64 =
        (0..4).map(|j| gain.k.as_ref().unwrap().at(0, j) * (x[j] - gain.x_reference[j])).sum();
    assert_eq!(driver.step(&[]).await.unwrap().u, [0.5 + 0.25 - correction]);

    let other = |change: fn(&mut v1::Gain)| {
        let mut gain = gain.clone();
        change(&mut gain);
        request(gain)
    };
    for (request, field) in [
        (other(|gain| gain.k = None), "gain.k"),
        (other(|gain| gain.k = Some(v1::Matrix::from_rows(&[[1.0]]))), "gain.k"),
        (other(|gain| gain.x_reference = vec![0.0]), "gain.x_reference"),
        (other(|gain| gain.u_reference = vec![f64::NAN]), "gain.u_reference[0]"),
        (other(|gain| gain.feedforward = vec![0.0; 2]), "gain.feedforward"),
        (other(|gain| gain.rotations = vec![0]), "gain.rotations"),
    ] {
        assert_bad_field(client.set_feedback(request).await, field);
    }
}

#[tokio::test]
async fn a_refused_feedback_leaves_the_one_before() {
    let (_server, client) =
        server_with(&["--limit", "feedback_numbers=1000,watchers_per_plant=1"]).await;
    let id = plant(&client, "cart-pole").await.id;
    assert_no_feedback(client.watch_gains(&id).await).await;
    let upright = || operating_point("upright");
    client.set_feedback(about(&id, upright(), Mode::WatchOnly)).await.unwrap();
    let before = info(&client, &id).await;
    let bound = |entry: &str, min, max| v1::Bound { entry: entry.to_owned(), min, max };
    let guarded = |guard| v1::SetFeedbackRequest { guard, ..about(&id, upright(), Mode::Guard) };
    for (request, field) in [
        (v1::SetFeedbackRequest { reference: None, ..along(&id, Mode::Replace) }, "reference"),
        (v1::SetFeedbackRequest { mode: 17, ..along(&id, Mode::Replace) }, "mode"),
        (v1::SetFeedbackRequest { constraints: 17, ..along(&id, Mode::Replace) }, "constraints"),
        (v1::SetFeedbackRequest { weights: None, ..along(&id, Mode::Replace) }, "weights"),
        (
            v1::SetFeedbackRequest { first_step: Some(1), ..about(&id, upright(), Mode::Replace) },
            "first_step",
        ),
        (guarded(vec![]), "guard"),
        (guarded(vec![bound("phi", None, Some(1.0))]), "guard[0].entry"),
        (guarded(vec![bound("theta", None, None)]), "guard[0]"),
        (guarded(vec![bound("theta", Some(1.0), Some(-1.0))]), "guard[0]"),
        (guarded(vec![bound("theta", Some(f64::NAN), None)]), "guard[0].min"),
        (
            v1::SetFeedbackRequest {
                guard: vec![bound("theta", None, Some(1.0))],
                ..about(&id, upright(), Mode::Replace)
            },
            "guard",
        ),
        (
            v1::SetFeedbackRequest {
                reference: Some(Reference::Trajectory(v1::Trajectory::default())),
                ..along(&id, Mode::Replace)
            },
            "trajectory.u",
        ),
        (about(&id, v1::Point::default(), Mode::Replace), "point"),
        (about(&id, operating_point("sideways"), Mode::Replace), "point.operating_point"),
    ] {
        assert_bad_field(client.set_feedback(request).await, field);
    }
    // Where it is now it falls.
    let falling = client.set_feedback(about(&id, present_state(&id), Mode::Replace)).await;
    assert_eq!(falling.unwrap_err().reason(), "NOT_AN_EQUILIBRIUM");
    let other = plant(&client, "pendulum").await.id;
    let other = client.set_feedback(about(&id, present_state(other), Mode::Replace)).await;
    assert_bad_field(other, "point.plant");
    let mut long = along(&id, Mode::Replace);
    long.reference = Some(Reference::Trajectory(v1::Trajectory {
        initial: None,
        u: Some(v1::Matrix::from_rows(&[[0.0]; 200])),
    }));
    let limited = client.set_feedback(long).await.unwrap_err();
    assert_eq!(limited.reason(), "LIMIT_EXCEEDED");
    assert!(limited.to_string().contains("feedback_numbers"), "{limited}");
    assert_not_found(client.set_feedback(along("nobody", Mode::Replace)).await, "PLANT_NOT_FOUND");
    assert_not_found(client.clear_feedback("nobody").await, "PLANT_NOT_FOUND");
    assert_eq!(info(&client, &id).await, before);

    let mut stream = client.watch_gains(&id).await.unwrap();
    next(&mut stream).await;
    let limited = match client.watch_gains(&id).await {
        Ok(mut stream) => soon(stream.next()).await.map(drop),
        Err(error) => Err(error),
    };
    assert_eq!(limited.unwrap_err().reason(), "LIMIT_EXCEEDED");
    // A deleted plant ends the streams of its gains.
    client.delete_plant(&id).await.unwrap();
    assert_eq!(soon(stream.next()).await.unwrap_err().reason(), "PLANT_DELETED");
}
