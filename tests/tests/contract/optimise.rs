//! Trajectory optimisation and references from outside.

use std::f64::consts::PI;

use plantd_client::{Answers, Client, Code, MatrixExt as _, StateExt as _, v1};
use v1::optimize_trajectory_response::Response as Message;
use v1::project_reference_response::Response as Projected;

use crate::support::*;

const STEPS: usize = 60;

fn zeros(rows: usize, cols: usize) -> v1::Matrix {
    v1::Matrix { rows: rows as u32, cols: cols as u32, data: vec![0.0; rows * cols] }
}

/// From hanging to standing upright.
fn swing_up() -> v1::OptimizeTrajectoryRequest {
    let desired = |k: usize| [if k > STEPS / 2 { PI } else { 0.0 }, 0.0];
    let desired: Vec<_> = (0..=STEPS).map(desired).collect();
    let weights = v1::LqrWeights {
        q: Some(plantd_client::diagonal([100.0, 1.0])),
        r: Some(plantd_client::diagonal([10.0])),
        ..Default::default()
    };
    v1::OptimizeTrajectoryRequest {
        model: "pendulum".to_owned(),
        cost: Some(v1::TrajectoryCost {
            x: Some(v1::Matrix::from_rows(&desired)),
            weights: Some(weights),
            ..Default::default()
        }),
        guess: Some(v1::Trajectory {
            initial: Some(v1::State { q: vec![0.0], p: vec![0.0], ..Default::default() }),
            u: Some(zeros(STEPS, 1)),
        }),
        options: Some(v1::OptimizationOptions { checkpoint_every: 3, ..Default::default() }),
        ..Default::default()
    }
}

/// A search that takes for ever: many steps, a tolerance that is never met.
fn endless(steps: usize) -> v1::OptimizeTrajectoryRequest {
    let mut request = swing_up();
    request.model = "chain-8".to_owned();
    request.cost = Some(v1::TrajectoryCost {
        x: Some(zeros(steps + 1, 16)),
        weights: Some(unit_weights(16, 1)),
        ..Default::default()
    });
    request.guess = Some(v1::Trajectory { initial: None, u: Some(zeros(steps, 1)) });
    request.options = Some(v1::OptimizationOptions {
        method: v1::DescentMethod::Steepest.into(),
        max_iterations: 100_000,
        tolerance: 1e-300,
        ..Default::default()
    });
    request
}

async fn run(
    client: &Client,
    request: v1::OptimizeTrajectoryRequest,
) -> (Vec<v1::OptimizationProgress>, v1::OptimizationResult) {
    let answers = client.optimize_trajectory(request).await.unwrap().collect().await.unwrap();
    let (mut progress, mut result) = (Vec::new(), None);
    for answer in answers {
        assert!(result.is_none(), "the result comes last");
        match answer.response.unwrap() {
            Message::Progress(message) => progress.push(message),
            Message::Result(message) => result = Some(message),
        }
    }
    (progress, result.expect("a result"))
}

async fn first<T>(stream: plantd_client::Result<Answers<T>>) -> plantd_client::Result<Option<T>> {
    soon(stream?.next()).await
}

#[tokio::test]
async fn a_search_reports_each_iteration_and_finds_a_motion_of_the_plant() {
    let (_server, client) = server().await;
    let (progress, result) = run(&client, swing_up()).await;
    assert!(result.converged && result.failure.is_none(), "{:?}", result.failure);
    assert!(progress.len() > 3);
    for (k, message) in progress.iter().enumerate() {
        assert_eq!(message.iteration as usize, k);
        assert!(message.cost <= message.cost_before && message.directional_derivative < 0.0);
        assert_eq!(message.checkpoint.is_some(), (k + 1) % 3 == 0);
    }
    for pair in progress.windows(2) {
        assert_eq!(pair[0].cost, pair[1].cost_before);
    }
    assert_eq!(result.cost, progress.last().unwrap().cost);

    // The states are those that the inputs lead to, and they cost what is said.
    let checkpoint = result.checkpoint.unwrap();
    let found = checkpoint.trajectory.unwrap();
    for state in [found.initial.as_ref(), checkpoint.initial_reference.as_ref()] {
        assert_has_velocity(&client, &swing_up().model, state.unwrap()).await;
    }
    let case = v1::RolloutCase {
        initial: Some(v1::InitialState {
            form: Some(v1::initial_state::Form::Momentum(v1::initial_state::Momentum {
                q: vec![0.0],
                p: vec![0.0],
                v: vec![],
            })),
        }),
        u: found.u.clone(),
        hold: 0,
        ..Default::default()
    };
    let request = v1::RolloutRequest {
        model: "pendulum".to_owned(),
        cases: vec![case],
        every: 1,
        ..Default::default()
    };
    let rollout = client.rollout(request).await.unwrap().collect().await.unwrap().remove(0);
    let x = result.x.unwrap();
    for (k, state) in rollout.states.iter().enumerate() {
        assert_eq!(state.x(), [x.at(k + 1, 0), x.at(k + 1, 1)], "step {}", k + 1);
    }
    let u = found.u.unwrap();
    let desired = swing_up().cost.unwrap().x.unwrap();
    let square = |k: usize, i: usize| (x.at(k, i) - desired.at(k, i)).powi(2);
    let states: f64 = (0..=STEPS).map(|k| 50.0 * square(k, 0) + 0.5 * square(k, 1)).sum();
    let inputs: f64 = (0..STEPS).map(|k| 5.0 * u.at(k, 0).powi(2)).sum();
    let cost = states + inputs;
    assert!((result.cost - cost).abs() < 1e-9 * cost, "{} {cost}", result.cost);
    assert!((x.at(STEPS, 0) - PI).abs() < 0.1, "it stands at the end");
}

#[tokio::test]
async fn a_search_goes_on_bit_for_bit_where_it_was_left() {
    let (_server, client) = server().await;
    let (progress, whole) = run(&client, swing_up()).await;
    let checkpoint = progress[2].checkpoint.clone().unwrap();
    assert_eq!(checkpoint.iterations, 3);
    let resumed =
        v1::OptimizeTrajectoryRequest { guess: None, resume: Some(checkpoint), ..swing_up() };
    let (rest, result) = run(&client, resumed).await;
    assert_eq!(rest, progress[3..]);
    assert_eq!(result, whole);

    // One that was stopped by its number of iterations says so, and can be gone on with.
    let mut short = swing_up();
    short.options = Some(v1::OptimizationOptions { max_iterations: 3, ..Default::default() });
    let (few, stopped) = run(&client, short).await;
    assert_eq!(few.len(), 3);
    let failure = stopped.failure.unwrap();
    assert_eq!((failure.reason.as_str(), stopped.converged), ("MAX_ITERATIONS", false));
    assert!(failure.message.contains("iterations"), "{}", failure.message);
    let resumed =
        v1::OptimizeTrajectoryRequest { guess: None, resume: stopped.checkpoint, ..swing_up() };
    assert_eq!(run(&client, resumed).await.1, whole);
}

/// A cart that goes home by a metre, with a force of 11 N at most where it would take 25 N.
fn home() -> v1::OptimizeTrajectoryRequest {
    let steps = 150;
    let weights = v1::LqrWeights {
        q: Some(plantd_client::diagonal([10.0, 10.0, 0.1, 0.1])),
        r: Some(plantd_client::diagonal([0.01])),
        q_final: Some(plantd_client::diagonal([100.0, 100.0, 10.0, 10.0])),
        ..Default::default()
    };
    let initial = v1::State { q: vec![1.0, 0.0], p: vec![0.0; 2], ..Default::default() };
    let limit = v1::Bound { entry: "force".to_owned(), min: Some(-11.0), max: Some(11.0) };
    v1::OptimizeTrajectoryRequest {
        model: "cart-pole".to_owned(),
        cost: Some(v1::TrajectoryCost {
            x: Some(zeros(steps + 1, 4)),
            weights: Some(weights),
            ..Default::default()
        }),
        guess: Some(v1::Trajectory { initial: Some(initial), u: Some(zeros(steps, 1)) }),
        bounds: Some(v1::TrajectoryBounds { input: vec![limit], ..Default::default() }),
        ..Default::default()
    }
}

#[tokio::test]
async fn a_limit_of_a_force_is_met_with_default_options_and_whatever_the_tolerance() {
    let (_server, client) = server().await;
    for tolerance in [0.0, 1e-3, 1e-9] {
        let options = v1::OptimizationOptions { tolerance, ..Default::default() };
        let request = v1::OptimizeTrajectoryRequest { options: Some(options), ..home() };
        let (_, result) = run(&client, request).await;
        assert!(result.converged && result.bound_violation <= 1e-6, "{:?}", result.failure);
    }

    // From any checkpoint the search goes on bit for bit, in the midst of renewing multipliers, too.
    let options = v1::OptimizationOptions { checkpoint_every: 1, ..Default::default() };
    let request = v1::OptimizeTrajectoryRequest { options: Some(options.clone()), ..home() };
    let (progress, whole) = run(&client, request).await;
    for (k, message) in progress.iter().enumerate().take(progress.len() - 1) {
        let resumed = v1::OptimizeTrajectoryRequest {
            guess: None,
            resume: message.checkpoint.clone(),
            options: Some(options.clone()),
            ..home()
        };
        let (rest, result) = run(&client, resumed).await;
        assert!(rest == progress[k + 1..] && result == whole, "from {k}");
    }

    // What stops early says how far the bounds are.
    let few = v1::OptimizationOptions { max_iterations: 6, ..Default::default() };
    let (_, stopped) =
        run(&client, v1::OptimizeTrajectoryRequest { options: Some(few), ..home() }).await;
    let failure = stopped.failure.unwrap();
    assert_eq!(failure.reason, "MAX_ITERATIONS");
    assert!(failure.message.contains("bound_tolerance 1e-6"), "{}", failure.message);
}

/// Limits of the model are bounds, unless others are given.
#[tokio::test]
async fn limits_of_a_model_bound_its_motions() {
    let (_server, client) = server().await;
    let model = client.get_model("cart-pole").await.unwrap();
    let limited = model
        .scene_toml
        .replace("name = \"cart-pole\"", "name = \"limited\"")
        .replace("name = \"force\"", "name = \"force\"\nlimits = [-11.0, 11.0]");
    client.create_model(limited).await.unwrap();
    let (_, by_hand) = run(&client, home()).await;
    let with = |input: Vec<v1::Bound>| v1::OptimizeTrajectoryRequest {
        model: "limited".to_owned(),
        bounds: Some(v1::TrajectoryBounds { input, model_limits: true, ..Default::default() }),
        ..home()
    };
    let (_, by_limits) = run(&client, with(Vec::new())).await;
    assert_eq!((by_limits.x, by_limits.cost), (by_hand.x, by_hand.cost));
    let wide = v1::Bound { entry: "force".to_owned(), min: Some(-15.0), max: Some(15.0) };
    let (_, given) = run(&client, with(vec![wide])).await;
    let u = given.checkpoint.unwrap().trajectory.unwrap().u.unwrap();
    let largest = u.data.iter().fold(0.0, |most: f64, u| most.max(u.abs()));
    assert!((largest - 15.0).abs() < 1e-5, "{largest}");
}

#[tokio::test]
async fn bounds_and_a_free_initial_state_are_named_like_the_plants_entries() {
    let (_server, client) = server().await;
    let bound = |entry: &str, min, max| v1::Bound { entry: entry.to_owned(), min, max };
    let mut request = swing_up();
    request.bounds = Some(v1::TrajectoryBounds {
        state: vec![],
        input: vec![bound("tau", Some(-8.0), Some(8.0))],
        final_state: vec![
            bound("theta", Some(PI), Some(PI)),
            bound("p(theta)", Some(0.0), Some(0.0)),
        ],
        ..Default::default()
    });
    request.free_initial = Some(v1::FreeInitialState {
        entries: vec!["p(theta)".to_owned()],
        weight: Some(plantd_client::diagonal([0.0, 1.0])),
    });
    request.options = Some(v1::OptimizationOptions { bound_tolerance: 1e-5, ..Default::default() });
    let (_, result) = run(&client, request).await;
    assert!(result.converged, "{:?}", result.failure);
    assert!(result.bound_violation <= 1e-5);
    let found = result.checkpoint.unwrap().trajectory.unwrap();
    let initial = found.initial.unwrap();
    assert!(initial.q == [0.0] && initial.p != [0.0], "{initial:?}");
    assert!(found.u.unwrap().data.iter().all(|u| u.abs() <= 8.0 + 1e-5));
    let x = result.x.unwrap();
    assert!((x.at(STEPS, 0) - PI).abs() <= 1e-5 && x.at(STEPS, 1).abs() <= 1e-5);
}

#[tokio::test]
async fn a_bad_problem_is_refused_by_field() {
    let limits = "horizon=100,optimization_iterations=500,trajectory_numbers=30000";
    let (_server, client) = server_with(&["--limit", limits]).await;
    let bound = |entry: &str, min, max| v1::Bound { entry: entry.to_owned(), min, max };
    let change = |change: fn(&mut v1::OptimizeTrajectoryRequest)| {
        let mut request = swing_up();
        change(&mut request);
        request
    };
    let options = |options| v1::OptimizeTrajectoryRequest { options: Some(options), ..swing_up() };
    let bounds = |bounds| v1::OptimizeTrajectoryRequest { bounds: Some(bounds), ..swing_up() };
    type Options = v1::OptimizationOptions;
    type Bounds = v1::TrajectoryBounds;
    for (request, field) in [
        (change(|r| r.guess = None), "guess"),
        (change(|r| r.resume = Some(v1::OptimizationCheckpoint::default())), "resume"),
        (
            change(|r| {
                r.guess = None;
                r.resume = Some(v1::OptimizationCheckpoint::default());
            }),
            "resume.trajectory",
        ),
        (change(|r| r.guess.as_mut().unwrap().u = None), "guess.u"),
        (change(|r| r.guess.as_mut().unwrap().u = Some(zeros(STEPS, 2))), "guess.u.cols"),
        (
            change(|r| r.guess.as_mut().unwrap().initial.as_mut().unwrap().q = vec![]),
            "guess.initial.q",
        ),
        (change(|r| r.cost = None), "cost"),
        (change(|r| r.cost.as_mut().unwrap().x = None), "cost.x"),
        (change(|r| r.cost.as_mut().unwrap().x = Some(zeros(STEPS, 2))), "cost.x"),
        (change(|r| r.cost.as_mut().unwrap().u = Some(zeros(STEPS, 2))), "cost.u"),
        (change(|r| r.cost.as_mut().unwrap().weights = None), "cost.weights.q"),
        (change(|r| r.cost.as_mut().unwrap().stages = vec![Default::default()]), "cost.stages"),
        (options(Options { method: 9, ..Default::default() }), "options.method"),
        (options(Options { first_method: 9, ..Default::default() }), "options.first_method"),
        (options(Options { beta: 2.0, ..Default::default() }), "options.beta"),
        (options(Options { alpha: -1.0, ..Default::default() }), "options.alpha"),
        (
            options(Options { projection: Some(Default::default()), ..Default::default() }),
            "options.projection.q",
        ),
        (
            bounds(Bounds { state: vec![bound("phi", None, Some(1.0))], ..Default::default() }),
            "bounds.state[0].entry",
        ),
        (
            bounds(Bounds { input: vec![bound("theta", None, Some(1.0))], ..Default::default() }),
            "bounds.input[0].entry",
        ),
        (
            bounds(Bounds {
                final_state: vec![bound("theta", Some(1.0), Some(0.0))],
                ..Default::default()
            }),
            "bounds.final_state[0]",
        ),
        (
            change(|r| {
                let entries = vec!["phi".to_owned()];
                r.free_initial = Some(v1::FreeInitialState { entries, weight: None });
            }),
            "free_initial.entries[0]",
        ),
    ] {
        assert_bad_field(first(client.optimize_trajectory(request).await).await, field);
    }
    let mut crooked = swing_up();
    let weights = crooked.cost.as_mut().unwrap().weights.as_mut().unwrap();
    weights.q = Some(plantd_client::full(v1::Matrix::from_rows(&[[1.0, 2.0], [0.0, 1.0]])));
    let refused = first(client.optimize_trajectory(crooked).await).await;
    assert_refused(refused, Code::InvalidArgument, "INVALID_WEIGHT", "cost.weights.q");
    let limited = async |request| {
        let error = first(client.optimize_trajectory(request).await).await.unwrap_err();
        assert_eq!(error.reason(), "LIMIT_EXCEEDED");
        error.to_string()
    };
    let many = options(Options { max_iterations: 501, ..Default::default() });
    assert!(limited(many).await.contains("optimization_iterations"));
    let many = options(Options { max_backtracks: 1001, ..Default::default() });
    assert!(limited(many).await.contains("optimization_backtracks"));
    let long = |steps| v1::OptimizeTrajectoryRequest { options: None, ..endless(steps) };
    assert!(limited(long(90)).await.contains("trajectory_numbers"));
    assert!(limited(long(101)).await.contains("horizon"));
    let unknown = v1::OptimizeTrajectoryRequest { model: "nothing".to_owned(), ..swing_up() };
    assert_not_found(first(client.optimize_trajectory(unknown).await).await, "MODEL_NOT_FOUND");
}

fn lqr() -> v1::SolveLqrRequest {
    v1::SolveLqrRequest {
        model: "cart-pole".to_owned(),
        point: Some(plantd_client::operating_point("upright")),
        weights: Some(unit_weights(4, 1)),
        ..Default::default()
    }
}

/// What the system lets a nice thread be at most.
const NICEST: i64 = 19;

/// Nice values of a process's workers for long computations, and of its other threads.
fn nice_values(pid: u32) -> (Vec<i64>, Vec<i64>) {
    let (mut workers, mut others) = (Vec::new(), Vec::new());
    for thread in std::fs::read_dir(format!("/proc/{pid}/task")).unwrap() {
        // A thread that has ended meanwhile has no file any more.
        let Ok(text) = std::fs::read_to_string(thread.unwrap().path().join("stat")) else {
            continue;
        };
        let (name, fields) = text.rsplit_once(')').unwrap();
        let nice = fields.split_whitespace().nth(19 - 3).unwrap().parse().unwrap();
        let is_worker = name.contains("(worker-");
        if is_worker { &mut workers } else { &mut others }.push(nice);
    }
    (workers, others)
}

/// With all workers and more taken by searches that do not end, every step of a plant is answered and
/// its motion is the same, a regulator is solved, and the searches all go on.
#[tokio::test(flavor = "multi_thread")]
async fn searches_disturb_neither_plants_nor_short_calls() {
    let (server, client) = server_with(&["--workers", "1"]).await;
    let drive = async |id: &str| {
        let request = v1::CreatePlantRequest {
            id: id.to_owned(),
            model: "pendulum".to_owned(),
            ..Default::default()
        };
        client.create_plant(request).await.unwrap();
        let mut driver = client.drive(id).await.unwrap();
        let mut states = Vec::new();
        for k in 0..2000 {
            let step = soon(driver.step(&[(0.01 * f64::from(k)).sin()])).await.unwrap();
            assert_eq!(step.state.as_ref().unwrap().step, k as u64 + 1);
            states.push(bits(&step.state.unwrap()));
        }
        states
    };
    let alone = drive("alone").await;
    let mut searches = Vec::new();
    for _ in 0..3 {
        let mut search = client.optimize_trajectory(endless(200)).await.unwrap();
        soon(search.next()).await.unwrap().unwrap();
        searches.push(search);
    }
    let (workers, others) = nice_values(server.pid());
    let (_, usual) = nice_values(std::process::id());
    assert!(!workers.is_empty() && workers.iter().all(|nice| *nice == NICEST), "{workers:?}");
    assert!(!others.is_empty() && others.iter().all(|nice| *nice == usual[0]), "{others:?}");
    assert!(drive("beside").await == alone, "the motion is the same bit for bit");
    soon(client.solve_lqr(lqr())).await.unwrap();
    let hold = v1::StepRequest { id: "beside".to_owned(), hold: 1000, ..Default::default() };
    soon(client.step(hold)).await.unwrap();
    for search in &mut searches {
        let message = soon(search.next()).await.unwrap().unwrap();
        assert!(matches!(message.response, Some(Message::Progress(_))));
    }
}

/// The place of a search that nobody waits for is free at once.
#[tokio::test(flavor = "multi_thread")]
async fn a_search_ends_with_its_call() {
    let limits = ["--workers", "1", "--limit", "trajectory_solves=1"];
    let (server, client) = server_with(&limits).await;
    let mut search = client.optimize_trajectory(endless(400)).await.unwrap();
    soon(search.next()).await.unwrap().unwrap();
    let full = first(client.optimize_trajectory(swing_up()).await).await.unwrap_err();
    assert_eq!(full.reason(), "LIMIT_EXCEEDED");
    assert!(full.to_string().contains("trajectory_solves"), "{full}");
    drop(search);
    let result = soon(async {
        loop {
            match client.optimize_trajectory(swing_up()).await {
                Ok(search) => break search.collect().await,
                Err(error) if error.reason() == "LIMIT_EXCEEDED" => {
                    tokio::time::sleep(std::time::Duration::from_millis(5)).await;
                }
                Err(error) => panic!("{error}"),
            }
        }
    });
    result.await.unwrap();

    // A shutdown ends one as well.
    let mut search = client.optimize_trajectory(endless(400)).await.unwrap();
    soon(search.next()).await.unwrap().unwrap();
    let mut server = server;
    let stopped = tokio::task::spawn_blocking(move || server.stop().unwrap());
    let end = loop {
        match soon(search.next()).await {
            Ok(Some(_)) => {}
            Ok(None) => break None,
            Err(error) => break Some(error),
        }
    };
    assert!(end.is_some(), "the stream does not end as if it were complete");
    assert!(stopped.await.unwrap().success());
}

/// Configurations of the cart-pole under a force that swings it.
async fn motion(client: &Client) -> Vec<[f64; 2]> {
    let u: Vec<_> = (0..40).map(|k| [20.0 * (0.2 * f64::from(k)).sin()]).collect();
    let u = v1::Matrix::from_rows(&u);
    let case = v1::RolloutCase { initial: None, u: Some(u), hold: 0, ..Default::default() };
    let request = v1::RolloutRequest {
        model: "cart-pole".to_owned(),
        cases: vec![case],
        every: 1,
        ..Default::default()
    };
    let states = client.rollout(request).await.unwrap().collect().await.unwrap().remove(0).states;
    let mut q = vec![[0.0, 0.7]];
    q.extend(states.iter().map(|state| [state.q[0], state.q[1]]));
    q
}

/// A state has the velocity that a plant in it shows.
async fn assert_has_velocity(client: &Client, model: &str, state: &v1::State) {
    let v1::State { q, p, v, .. } = state.clone();
    let form = v1::initial_state::Form::Momentum(v1::initial_state::Momentum { q, p, v });
    let request = v1::CreatePlantRequest {
        model: model.to_owned(),
        initial: Some(v1::InitialState { form: Some(form) }),
        ..Default::default()
    };
    let plant = client.create_plant(request).await.unwrap();
    assert_eq!(state.velocity, plant.state.unwrap().velocity);
    client.delete_plant(plant.id).await.unwrap();
}

async fn project(
    client: &Client,
    request: v1::ProjectReferenceRequest,
) -> plantd_client::Result<(v1::ReferenceReport, Vec<v1::Gain>)> {
    let answers = client.project_reference(request.clone()).await?.collect().await?;
    let mut answers = answers.into_iter().map(|answer| answer.response.unwrap());
    let Some(Projected::Report(report)) = answers.next() else { panic!("the report comes first") };
    let initial = report.trajectory.as_ref().and_then(|t| t.initial.as_ref()).unwrap();
    assert_has_velocity(client, &request.model, initial).await;
    let step = |answer| match answer {
        Projected::Step(gain) => gain,
        Projected::Report(_) => panic!("there is one report"),
    };
    Ok((report, answers.map(step).collect()))
}

#[tokio::test]
async fn a_reference_that_is_a_motion_is_found_again_with_its_regulator() {
    let (_server, client) = server().await;
    let q = motion(&client).await;
    let request = v1::ProjectReferenceRequest {
        model: "cart-pole".to_owned(),
        q: Some(v1::Matrix::from_rows(&q)),
        weights: Some(unit_weights(4, 1)),
        strict: true,
        ..Default::default()
    };
    let (report, steps) = project(&client, request.clone()).await.unwrap();
    assert!(report.feasible, "{report:?}");
    assert!(report.deviation < 1e-9, "{}", report.deviation);
    assert_eq!(steps.len(), 41);
    let request_lqr = v1::SolveTrajectoryLqrRequest {
        model: "cart-pole".to_owned(),
        trajectory: report.trajectory,
        weights: Some(unit_weights(4, 1)),
        ..Default::default()
    };
    let solved = client.solve_trajectory_lqr(request_lqr).await.unwrap().collect().await.unwrap();
    for (step, solved) in steps.iter().zip(solved) {
        assert_eq!(Some(step), solved.gain.as_ref());
    }

    // Without weights there are steps without gains.
    let bare = v1::ProjectReferenceRequest { weights: None, ..request };
    let (_, bare) = project(&client, bare).await.unwrap();
    assert!(bare.iter().all(|step| step.k.is_none()));
    assert_eq!(bare[7].x_reference, steps[7].x_reference);
}

#[tokio::test]
async fn a_reference_that_is_no_motion_is_projected_or_refused() {
    let (_server, client) = server().await;
    let mut q = motion(&client).await;
    for (k, row) in q.iter_mut().enumerate() {
        row[1] += 0.02 * (0.5 * k as f64).sin();
    }
    let request = v1::ProjectReferenceRequest {
        model: "cart-pole".to_owned(),
        q: Some(v1::Matrix::from_rows(&q)),
        ..Default::default()
    };
    let (report, steps) = project(&client, request.clone()).await.unwrap();
    assert!(!report.feasible && report.unexplained_acceleration > 1.0, "{report:?}");
    assert!(["x", "theta"].contains(&report.unexplained_coordinate.as_str()));
    let deviation = steps
        .iter()
        .zip(&q)
        .flat_map(|(step, q)| (0..2).map(|i| (step.x_reference[i] - q[i]).abs()))
        .fold(0.0, f64::max);
    assert!((deviation - report.deviation).abs() < 1e-12, "{deviation} {}", report.deviation);

    let strict = v1::ProjectReferenceRequest { strict: true, ..request.clone() };
    let error = project(&client, strict).await.unwrap_err();
    let expected = (Some(Code::FailedPrecondition), "INFEASIBLE_REFERENCE");
    assert_eq!((error.code(), error.reason()), expected);
    assert!(error.to_string().contains(&report.unexplained_coordinate), "{error}");
    let lax = v1::ProjectReferenceRequest { strict: true, tolerance: 1e3, ..request.clone() };
    assert!(project(&client, lax).await.unwrap().0.feasible);

    type Request = v1::ProjectReferenceRequest;
    for (request, field) in [
        (Request { q: None, ..request.clone() }, "q"),
        (Request { q: Some(zeros(1, 2)), ..request.clone() }, "q"),
        (Request { q: Some(zeros(9, 3)), ..request.clone() }, "q"),
        (Request { u: Some(zeros(7, 1)), ..request.clone() }, "u"),
        (Request { tolerance: -1.0, ..request.clone() }, "tolerance"),
        (Request { constraints: 9, ..request.clone() }, "constraints"),
        (Request { projection: Some(Default::default()), ..request.clone() }, "projection.q"),
        (Request { weights: Some(Default::default()), ..request.clone() }, "weights.q"),
    ] {
        assert_bad_field(project(&client, request).await, field);
    }
}
