//! Where a mechanism rests, and what can be said of a state.

use std::collections::HashMap;
use std::f64::consts::PI;

use plantd_client::{Code, MatrixExt as _, v1};
use plantd_models::Scene;

use crate::support::*;

/// A point of 2 kg on a rod of 3 m in Cartesian coordinates, with the constraint written twice.
pub(crate) const TIED_TWICE: &str = r#"
format = 1
name = "tied-twice"
gravity = [0.0, -9.8, 0.0]

[[frames]]
name = "x"
joint = { type = "prismatic", axis = [1.0, 0.0, 0.0] }

[[frames]]
name = "y"
parent = "x"
joint = { type = "prismatic", axis = [0.0, 1.0, 0.0] }
body = { mass = 2.0 }

[[coordinates]]
name = "y"
initial = -3.0

[[constraints]]
type = "distance"
name = "rod"
a = { frame = "world" }
b = { frame = "y" }
length = 3.0

[[constraints]]
type = "distance"
name = "again"
a = { frame = "y" }
b = { frame = "world" }
length = 3.0
"#;

fn settle(model: &str) -> v1::SettleRequest {
    v1::SettleRequest { model: model.to_owned(), ..Default::default() }
}

fn named<const N: usize>(values: [(&str, f64); N]) -> HashMap<String, f64> {
    values.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}

#[tokio::test]
async fn frames_reach_their_targets() {
    let (_server, client) = server().await;
    let frame = client.get_model("double-pendulum").await.unwrap();
    let frame = Scene::from_toml(&frame.scene_toml).unwrap().frames.pop().unwrap();
    let tip = frame.body.unwrap().center_of_mass;
    let point = v1::FramePoint { frame: frame.name, at: tip.to_vec() };
    let at = |position: &[f64]| v1::SettleTarget {
        point: Some(point.clone()),
        position: position.to_vec(),
        orientation: Vec::new(),
    };
    let request = |target: v1::SettleTarget| v1::SettleRequest {
        q: vec![0.3, 0.5],
        goal: v1::SettleGoal::Constraints.into(),
        targets: vec![target],
        ..settle("double-pendulum")
    };
    let kinematics = |q: Vec<f64>| {
        let state =
            v1::MechanicalState { model: "double-pendulum".to_owned(), q, ..Default::default() };
        v1::KinematicsRequest {
            state: Some(state),
            points: vec![point.clone()],
            ..Default::default()
        }
    };
    let there = client.kinematics(kinematics(vec![0.5, 0.9])).await.unwrap();
    let wanted = there.points[0].position.clone();
    let answer = client.settle(request(at(&wanted))).await.unwrap();
    for (found, there) in answer.q.iter().zip([0.5, 0.9]) {
        assert!((found - there).abs() < 1e-9, "{:?}", answer.q);
    }
    for (target, field) in [
        (at(&[9.0, 9.0, 0.0]), "guess"),
        (at(&[0.1, 0.2]), "targets[0].position"),
        (at(&[]), "targets[0]"),
        (v1::SettleTarget { point: None, ..at(&wanted) }, "targets[0]"),
    ] {
        let error = client.settle(request(target)).await.unwrap_err().to_string();
        assert!(error.contains(field), "{field}: {error}");
    }
}

#[tokio::test]
async fn a_pendulum_settles_where_its_torque_holds_it() {
    let (_server, client) = server().await;
    let request = v1::SettleRequest {
        guess: named([("theta", 0.9)]),
        inputs: named([("tau", 4.9)]),
        ..settle("pendulum")
    };
    let answer = client.settle(request).await.unwrap();
    assert!((answer.q[0] - PI / 6.0).abs() < 1e-9, "{:?}", answer.q);
    assert_eq!(answer.u, [4.9]);
    let rest = answer.equilibrium.unwrap();
    assert!(rest.stable && rest.residual < 1e-8);
    assert!((rest.smallest_stiffness - 9.8 * f64::cos(PI / 6.0)).abs() < 1e-6);

    // What settled stays where it is.
    let equilibrium =
        v1::initial_state::Equilibrium { q: vec![0.9], hold: Vec::new(), inputs: vec![4.9] };
    let form = v1::initial_state::Form::Equilibrium(equilibrium);
    let request = v1::CreatePlantRequest {
        model: "pendulum".to_owned(),
        initial: Some(v1::InitialState { form: Some(form) }),
        ..Default::default()
    };
    let plant = client.create_plant(request).await.unwrap();
    let step = v1::StepRequest {
        id: plant.id,
        u: Some(v1::Matrix::from_rows(&[[4.9]; 100])),
        ..Default::default()
    };
    let state = client.step(step).await.unwrap().states.remove(0);
    assert!((state.q[0] - PI / 6.0).abs() < 1e-8, "{}", state.q[0]);
}

#[tokio::test]
async fn held_coordinates_stay_and_constraints_are_satisfied() {
    let (_server, client) = server().await;
    let request = v1::SettleRequest {
        guess: named([("crank", -0.8)]),
        hold: vec!["crank".to_owned()],
        goal: v1::SettleGoal::Constraints.into(),
        ..settle("four-bar")
    };
    let answer = client.settle(request.clone()).await.unwrap();
    assert!(answer.equilibrium.is_none());
    assert_eq!(answer.q[0], -0.8);
    // The coupler's end and the rocker's: pins of the loop, in the plane of x and z.
    let (crank, coupler, rocker) = (answer.q[0], answer.q[0] + answer.q[1], answer.q[2]);
    let x = -0.5 * crank.sin() - 1.2 * coupler.sin();
    let z = -0.5 * crank.cos() - 1.2 * coupler.cos();
    assert!((x - (1.0 - rocker.sin())).abs() < 1e-9 && (z + rocker.cos()).abs() < 1e-9);

    let free = client.settle(settle("four-bar")).await.unwrap();
    let rest = free.equilibrium.unwrap();
    assert!(rest.stable && rest.constraint_forces.len() == 2);
    let held = v1::SettleRequest { goal: v1::SettleGoal::Equilibrium.into(), ..request };
    let held = client.settle(held).await.unwrap().equilibrium.unwrap();
    assert!(rest.potential_j < held.potential_j);
}

#[tokio::test]
async fn what_cannot_settle_says_why() {
    let (_server, client) = server().await;
    let falling = "format = 1\nname = \"falling\"\ngravity = [0, -9.8, 0]\n[[frames]]\n\
        name = \"block\"\njoint = { type = \"prismatic\", axis = [0, 1, 0] }\nbody = { mass = 2 }\n";
    client.create_model(falling).await.unwrap();
    let refused = client.settle(settle("falling")).await;
    assert!(refused.as_ref().unwrap_err().to_string().contains("block"), "{refused:?}");
    assert_refused(refused, Code::InvalidArgument, "NOT_SETTLED", "guess");
    let changed = |change: &dyn Fn(&mut v1::SettleRequest)| {
        let mut request = settle("pendulum");
        change(&mut request);
        request
    };
    for (request, field) in [
        (changed(&|r| r.guess = named([("phi", 0.0)])), "guess[phi]"),
        (changed(&|r| r.guess = named([("theta", f64::NAN)])), "guess[theta]"),
        (changed(&|r| r.inputs = named([("force", 0.0)])), "inputs[force]"),
        (changed(&|r| r.q = vec![0.0; 2]), "q"),
        (changed(&|r| r.hold = vec!["phi".to_owned()]), "guess.hold"),
        (changed(&|r| r.goal = 7), "goal"),
    ] {
        assert_bad_field(client.settle(request).await, field);
    }
    assert_not_found(client.settle(settle("none")).await, "MODEL_NOT_FOUND");
}

/// Numbers that overflow on the way end in an answer all the same.
#[tokio::test]
async fn absurd_guesses_come_to_an_end() {
    let (_server, client) = server().await;
    let sprung = "format = 1\ngravity = [0.0, 0.0, 0.0]\nname = \"sprung\"\n[[frames]]\nname = \"block\"\n\
        joint = { type = \"prismatic\", axis = [1, 0, 0] }\nbody = { mass = 2 }\n\
        [[springs]]\ntype = \"two_point\"\na = { frame = \"world\", at = [0, 1, 0] }\n\
        b = { frame = \"block\" }\nstiffness = 1e200\nrest_length = 0.5\n";
    client.create_model(sprung).await.unwrap();
    for guess in [1e9, 1e120, 1e300, -f64::MAX] {
        for (model, name) in [("sprung", "block"), ("pendulum", "theta"), ("four-bar", "crank")] {
            for goal in [v1::SettleGoal::Equilibrium, v1::SettleGoal::Constraints] {
                let guess = named([(name, guess)]);
                let request = v1::SettleRequest { guess, goal: goal.into(), ..settle(model) };
                if let Err(error) = soon(client.settle(request)).await {
                    assert_eq!(error.code(), Some(Code::InvalidArgument), "{error}");
                }
            }
        }
    }
    let still_there = client.settle(settle("pendulum")).await.unwrap();
    assert!(still_there.q[0].abs() < 1e-9);
}

#[tokio::test]
async fn a_pendulum_is_diagnosed_as_in_the_textbook() {
    let (_server, client) = server().await;
    let (angle, rate) = (0.5, 2.0);
    let initial = Some(at_velocity(&[angle], &[rate]));
    let request =
        v1::DiagnoseRequest { model: "pendulum".to_owned(), initial, ..Default::default() };
    let answer = client.diagnose(request.clone()).await.unwrap();
    let close = |actual: &[f64], expected: [f64; 3]| {
        for (a, e) in actual.iter().zip(expected) {
            assert!((a - e).abs() < 1e-12, "{actual:?} instead of {expected:?}");
        }
    };
    assert_eq!((answer.degrees_of_freedom, answer.constraint_rank), (1, 0));
    close(&answer.center_of_mass, [angle.sin(), -angle.cos(), 0.0]);
    close(&answer.linear_momentum, [rate * angle.cos(), rate * angle.sin(), 0.0]);
    close(&answer.angular_momentum, [0.0, 0.0, rate]);
    assert_eq!((answer.mass_kg, answer.constraint_reciprocal_condition), (1.0, 1.0));
    let energy = answer.energy.unwrap();
    assert!((energy.kinetic_j - 0.5 * rate * rate).abs() < 1e-12);

    let id = plant(&client, "pendulum").await.id;
    let both = v1::DiagnoseRequest { id: id.clone(), ..request };
    assert_bad_field(client.diagnose(both).await, "model");
    let of_plant = v1::DiagnoseRequest { id, ..Default::default() };
    assert_eq!(client.diagnose(of_plant).await.unwrap().step, 0);
    let nobody = v1::DiagnoseRequest::default();
    assert_not_found(client.diagnose(nobody).await, "PLANT_NOT_FOUND");
}

/// The rod pulls with m g = 2 l (sum of the multipliers as forces).
#[tokio::test]
async fn redundant_constraints_are_reported_and_share_their_load() {
    let (_server, client) = server().await;
    client.create_model(TIED_TWICE).await.unwrap();
    let id = plant(&client, "tied-twice").await.id;
    let step = v1::StepRequest { id: id.clone(), hold: 5, ..Default::default() };
    let report = client.step(step).await.unwrap().report.unwrap();
    assert_eq!(report.redundant_constraints, 1);
    assert!(report.constraint_reciprocal_condition > 0.1, "{report:?}");
    let diagnose = v1::DiagnoseRequest { id, ..Default::default() };
    let answer = client.diagnose(diagnose).await.unwrap();
    assert_eq!((answer.degrees_of_freedom, answer.constraint_rank), (1, 1));
    assert_eq!(answer.redundant_constraints.len(), 1);
    let [rod, again] = answer.constraint_forces[..] else { panic!("{answer:?}") };
    assert!((2.0 * 3.0 * (rod + again) - 2.0 * 9.8).abs() < 1e-9);
    assert!((rod - again).abs() < 1e-9, "of least norm");
}

/// A field that is added to the message does not compile here before it is set.
#[tokio::test]
async fn every_setting_of_a_plant_comes_back() {
    let (_server, client) = server().await;
    let of_order_4 = v1::PlantSettings {
        time_step_s: 0.02,
        force_split: v1::ForceSplit::Symmetric.into(),
        max_iterations: 17,
        singular_below: 1e-9,
        order: 4,
        substeps: 3,
        halvings: Some(2),
        precision: v1::Precision::Fast.into(),
        // In place of order and substeps.
        tolerance: 0.0,
    };
    let of_the_paper =
        v1::PlantSettings { force_split: v1::ForceSplit::Paper.into(), order: 2, ..of_order_4 };
    for settings in [of_order_4, of_the_paper].map(Some) {
        let model = "pendulum".to_owned();
        let request = v1::CreatePlantRequest { model, settings, ..Default::default() };
        let created = client.create_plant(request).await.unwrap();
        assert_eq!(created.settings, settings);
        let plant = client.get_plant(&created.id).await.unwrap().plant.unwrap();
        assert_eq!(plant.settings, settings);
    }
}

/// A quarter turn in one step leaves no direction in which the rod could pull.
#[tokio::test]
async fn singular_constraints_are_named() {
    let (_server, client) = server().await;
    let free = TIED_TWICE
        .replace("gravity = [0.0, -9.8, 0.0]", "gravity = [0.0, 0.0, 0.0]")
        .replace("tied-twice", "free");
    client.create_model(free).await.unwrap();
    let turning = |sine: f64, singular_below: f64| v1::CreatePlantRequest {
        model: "free".to_owned(),
        settings: Some(v1::PlantSettings {
            time_step_s: 0.1,
            singular_below,
            halvings: Some(0),
            ..Default::default()
        }),
        initial: Some(at_velocity(&[0.0, -3.0], &[3.0 * sine / 0.1, 0.0])),
        ..Default::default()
    };
    let step = async |request: v1::CreatePlantRequest| {
        let id = client.create_plant(request).await.unwrap().id;
        client.step(v1::StepRequest { id, hold: 1, ..Default::default() }).await
    };
    step(turning(0.9, 0.0)).await.unwrap();
    let refused = step(turning(0.98, 0.5)).await;
    let error = refused.unwrap_err();
    assert_eq!(
        (error.code(), error.reason()),
        (Some(Code::FailedPrecondition), "SINGULAR_CONSTRAINTS")
    );
    assert!(error.to_string().contains("rod"), "{error}");
    for bad in [-1.0, 1.0, f64::NAN] {
        assert_bad_field(client.create_plant(turning(0.1, bad)).await, "settings.singular_below");
    }
}

/// A scene may begin at a guess: only what starts at that very configuration is refused.
#[tokio::test]
async fn what_does_not_start_at_a_guess_is_answered() {
    let (_server, client) = server().await;
    let scene = client.get_model("four-bar").await.unwrap().scene_toml;
    let scene = scene.replace("\"four-bar\"", "\"guess\"").replace("0.27841001304404134", "0.0");
    let validated = client.validate_scene(scene.clone()).await.unwrap();
    assert!(validated.problems.is_empty());
    let model = client.create_model(scene).await.unwrap();
    assert_eq!(validated.model.unwrap().initial_violations, model.initial_violations);
    let violated: Vec<_> = model.initial_violations.iter().map(|v| v.constraint.clone()).collect();
    assert_eq!(violated, ["pin.x", "pin.z"]);
    assert!(model.initial_violations.iter().all(|v| v.value.abs() > 1e-3));

    let request = v1::SettleRequest {
        hold: vec!["crank".to_owned()],
        goal: v1::SettleGoal::Constraints.into(),
        ..settle("guess")
    };
    let q = client.settle(request).await.unwrap().q;
    assert!(client.settle(settle("guess")).await.unwrap().equilibrium.unwrap().stable);

    let create = async |form: Option<v1::initial_state::Form>| {
        let request = v1::CreatePlantRequest {
            model: "guess".to_owned(),
            initial: form.map(|form| v1::InitialState { form: Some(form) }),
            ..Default::default()
        };
        client.create_plant(request).await
    };
    let refused = create(None).await;
    let message = refused.as_ref().unwrap_err().to_string();
    assert!(message.contains("only a guess") && message.contains("projection"), "{message}");
    assert_refused(refused, Code::InvalidArgument, "OFF_CONSTRAINT", "initial");
    let projection =
        v1::initial_state::Projection { q: q.iter().map(|q| q + 0.01).collect(), hold: vec![] };
    create(Some(v1::initial_state::Form::Projection(projection))).await.unwrap();
    let momentum = v1::initial_state::Momentum { q: q.clone(), p: vec![0.0; 3], v: Vec::new() };
    let plant = create(Some(v1::initial_state::Form::Momentum(momentum))).await.unwrap();

    // A fault prepares plants of other parameters, and a change of parameters makes another one.
    let fault = v1::FaultSpec {
        kind: Some(v1::fault_spec::Kind::Parameters(v1::ParameterChange {
            parameters: vec![v1::Parameter {
                path: "frames[rocker].body.mass".to_owned(),
                value: 2.0,
            }],
        })),
        ..Default::default()
    };
    client.inject_fault(&plant.id, fault).await.unwrap();
    let step = v1::StepRequest { id: plant.id.clone(), hold: 3, ..Default::default() };
    client.step(step).await.unwrap();

    let state = v1::State { q: q.clone(), p: vec![0.0; 3], ..Default::default() };
    let here = v1::StateAndInput { state: Some(state.clone()), u: Vec::new() };
    let point = v1::Point { source: Some(v1::point::Source::StateAndInput(here)) };
    let request = v1::LinearizeRequest {
        model: "guess".to_owned(),
        point: Some(point),
        ..Default::default()
    };
    client.linearize(request).await.unwrap();
    let case = |initial| v1::RolloutCase { initial, hold: 5, ..Default::default() };
    let momentum = v1::initial_state::Momentum { q: q.clone(), p: vec![0.0; 3], v: Vec::new() };
    let form = v1::initial_state::Form::Momentum(momentum);
    let request = v1::RolloutRequest {
        model: "guess".to_owned(),
        cases: vec![case(Some(v1::InitialState { form: Some(form) })), case(None)],
        ..Default::default()
    };
    let mut answers = client.rollout(request).await.unwrap().collect().await.unwrap();
    answers.sort_by_key(|answer| answer.case_index);
    assert!(answers[0].failure.is_none(), "{:?}", answers[0].failure);
    let failure = answers[1].failure.as_ref().expect("the second case starts at the guess");
    assert!(failure.message.contains("only a guess"), "{failure:?}");
}
