//! After construction a plant's operations allocate nothing: a counting allocator watches them.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::Arc;

use plantd_control::Momentum;
use plantd_models::drawing::{Drawing, Instant};
use plantd_models::{
    Contraction, ForceSplit, Linearization, Model, Plant, Scene, SecondOrder, Settings, builtin,
};
use plantd_proto::v1;
use plantd_server::core::driver::DriverKind;
use plantd_server::core::feedback::active::{Feedback, GuardBound, Mode};
use plantd_server::core::feedback::law::{Law, Stage};
use plantd_server::core::feedback::regulator::{Constraints, Reference, Spec};
use plantd_server::core::limits::Limits;
use plantd_server::core::metrics::registry::Metrics;
use plantd_server::core::modes;
use plantd_server::core::plant::watchdog::{Quantity, Safety, Watchdog, WatchdogAction};
use plantd_server::core::publish::ring::Reader;
use plantd_server::core::realtime::loops::RealTime;
use plantd_server::core::realtime::settings::{Pace, RealTimeSettings, RunSettings};
use plantd_server::core::room::Room;
use plantd_server::core::session::creation::Origin;
use plantd_server::core::session::shared::Session;
use plantd_server::wire::record::directory::Recordings;

/// Counts the allocations of each thread, so that tests in other threads do not disturb.
struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: every call goes to the system's allocator with the caller's own arguments.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller keeps the contract.
        unsafe { System.alloc(layout) }
    }
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller keeps the contract.
        unsafe { System.alloc_zeroed(layout) }
    }
    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: the caller keeps the contract.
        unsafe { System.realloc(memory, layout, size) }
    }
    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps the contract.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn count() {
    ALLOCATIONS.with(|allocations| allocations.set(allocations.get() + 1));
}

/// Allocations of this thread while `work` runs.
fn allocations(work: impl FnOnce()) -> u64 {
    let before = ALLOCATIONS.with(Cell::get);
    work();
    ALLOCATIONS.with(Cell::get) - before
}

const STEPS: usize = 100;
/// Short enough for the whip of a long chain.
const TIME_STEP_S: f64 = 0.001;

/// Drives a plant with forces that differ from step to step, with and without linearization.
fn drive(plant: &mut Plant, input: &mut [f64], out: &mut Linearization) {
    let forces = plant.model().dimensions().inputs;
    for k in 0..STEPS {
        plant.hold_input(input);
        input[..forces].iter_mut().for_each(|u| *u = 0.05 * (k as f64).sin());
        plant.step(input).expect("a step succeeds");
        plant.linearize(input, out).expect("a linearization succeeds");
        plant.step_and_linearize(input, out).expect("both succeed together");
    }
}

/// Built-in scenes, and those of all elements.
fn scenes() -> Vec<Scene> {
    let families = ["chain-8", "chain-32", "scissor-8", "scissor-16", "balls-7", "walker-4"];
    let names = builtin::NAMES.iter().chain(&families);
    let builtin = names.map(|name| builtin::scene(name).expect("the scene is built in"));
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/scenes/elements");
    let elements = std::fs::read_dir(folder).expect("the folder is there").map(|entry| {
        let path = entry.expect("it can be listed").path();
        let text = std::fs::read_to_string(path).expect("it can be read");
        Scene::from_toml(&text).expect("it is a scene")
    });
    builtin.chain(elements).collect()
}

#[test]
fn operations_of_a_plant_allocate_nothing() {
    for scene in scenes() {
        let name = &scene.name;
        let model = Arc::new(Model::compile(&scene).expect("it compiles"));
        for force_split in [ForceSplit::Symmetric, ForceSplit::Paper] {
            let settings =
                Settings { force_split, time_step_s: TIME_STEP_S, ..Settings::new(&model) };
            let mut plant = Plant::new(Arc::clone(&model), settings).expect("it starts");
            let mut input = vec![0.0; model.dimensions().input()];
            let mut out = Linearization::new(&model);
            // The very first step counts too.
            let count = allocations(|| drive(&mut plant, &mut input, &mut out));
            assert_eq!(count, 0, "allocations of `{name}`, {force_split:?}");
            assert_eq!(plant.step_index(), 2 * STEPS as u64, "`{name}` has moved");
        }
    }
}

/// A viewer gets sixty poses a second of each plant.
#[test]
fn poses_allocate_nothing() {
    for scene in scenes() {
        let model = Arc::new(Model::compile(&scene).expect("it compiles"));
        let plant = Plant::new(Arc::clone(&model), Settings::new(&model)).expect("it starts");
        let (drawing, velocity) = (Drawing::new(&model), vec![0.1; plant.q().len()]);
        let mut poses = drawing.poses();
        let at = Instant {
            q: plant.q(),
            velocity: &velocity,
            inputs: &vec![1.0; model.dimensions().inputs],
            multipliers: plant.multipliers(),
            time_step_s: TIME_STEP_S,
        };
        let count = allocations(|| drawing.place(&at, &mut poses));
        assert_eq!(count, 0, "allocations of `{}`", scene.name);
    }
}

/// Once the plant has made room for their columns, neither form of the second-order linearization does.
#[test]
fn second_order_linearizations_allocate_once() {
    for name in ["pendulum", "four-bar", "marionette"] {
        let scene = builtin::scene(name).expect("the scene is built in");
        let model = Arc::new(Model::compile(&scene).expect("it compiles"));
        let settings = Settings::new(&model);
        let mut plant = Plant::new(Arc::clone(&model), settings).expect("it starts");
        let d = model.dimensions();
        let (z, w) = (vec![1.0; d.state()], vec![1.0; d.constraints]);
        let mut input = vec![0.0; d.input()];
        plant.hold_input(&mut input);
        let mut first = Linearization::new(&model);
        let mut second = SecondOrder::new(&model).expect("it is small");
        let mut contraction = Contraction::new(&model);
        let mut both = || {
            plant.linearize_second_order(&input, &mut first, &mut second).expect("it succeeds");
            plant
                .contract_second_order(&input, &z, &w, &mut first, &mut contraction)
                .expect("it succeeds");
        };
        both();
        assert_eq!(allocations(both), 0, "allocations of `{name}`");
    }
}

/// Neither does a session whose feedback has a say in each step, with a watchdog or without.
#[test]
fn steps_with_feedback_allocate_nothing() {
    let scene = builtin::scene("cart-pole").expect("the scene is built in");
    let model = Arc::new(Model::compile(&scene).expect("it compiles"));
    let d = model.dimensions();
    let room = Room::new("feedback_numbers", "numbers", 1_000_000);
    let stage = |k: usize| Stage {
        k: vec![0.1 * k as f64; d.input() * d.state()],
        x: vec![0.0; d.state()],
        u: vec![1.0; d.input()],
        feedforward: vec![0.5; d.input()],
    };
    let bound = |max: f64| GuardBound { index: 1, name: "theta".to_owned(), min: -max, max };
    for (mode, guard) in [
        (Mode::WatchOnly, vec![]),
        (Mode::Replace, vec![]),
        (Mode::Add, vec![]),
        (Mode::Guard, vec![bound(10.0)]),
        (Mode::Guard, vec![bound(0.1)]),
    ] {
        let plant = Plant::new(Arc::clone(&model), Settings::new(&model)).expect("it starts");
        let session = new_session(plant);
        let spec = Spec {
            reference: Reference::Gain(stage(0)),
            weights: None,
            trajectory_weights: None,
            momentum: Momentum::State,
            constraints: Constraints::Full,
            time_step_s: 0.01,
            given: None,
        };
        let law = Law {
            stages: (0..STEPS / 2).map(stage).collect(),
            end: Some(vec![0.0; d.state()]),
            room: room.reserve(1).expect("there is room"),
        };
        let feedback = Box::new(Feedback::new(Arc::new(spec), law, mode, guard.clone()));
        session.set_feedback(feedback, 0, None);
        let mut lease = session.acquire(DriverKind::Step).expect("nobody has it");
        let mut out = Linearization::new(&model);
        let count = allocations(|| {
            for _ in 0..STEPS {
                lease.step(&[0.2]).expect("a step succeeds");
                lease.step_and_linearize(&[0.2], &mut out).expect("both succeed together");
            }
        });
        assert_eq!(count, 0, "allocations with {mode:?}");
        let has_say = matches!(mode, Mode::Replace | Mode::Add) || guard == [bound(0.1)];
        let was_applied = session.with_core(|core| core.applied_input().is_some());
        assert_eq!(was_applied, has_say, "{mode:?}");
    }
}

/// Nor does one with sensors, actuators and faults of all kinds, on a plant with constraints.
#[test]
fn steps_with_channels_allocate_nothing() {
    use v1::fault_spec::{Kind, Pattern, Target};
    use v1::output_channel::Source;
    let scene = builtin::scene("marionette").expect("the scene is built in");
    let model = Arc::new(Model::compile(&scene).expect("it compiles"));
    let d = model.dimensions();
    let plant = Plant::new(Arc::clone(&model), Settings::new(&model)).expect("it starts");
    let session = new_session(plant);
    let h = Settings::new(&model).time_step_s;
    let (coordinate, string) = (&model.coordinates()[0].name, &model.coordinates()[d.dynamic].name);
    let frame = &scene.frames.last().expect("it has frames").name;
    let point = || v1::FramePoint { frame: frame.clone(), at: vec![0.1, 0.2, 0.3] };
    let sources = [
        Source::Coordinate(coordinate.clone()),
        Source::Velocity(coordinate.clone()),
        Source::Acceleration(coordinate.clone()),
        Source::Position(point()),
        Source::Orientation(frame.clone()),
        Source::ConstraintForce(model.constraint_names()[0].clone()),
        Source::Input(string.clone()),
        Source::Energy(true),
    ];
    let output = |(index, source): (usize, Source)| v1::OutputChannel {
        name: format!("output-{index}"),
        source: Some(source),
        sample_period_s: 2.0 * h,
        latency_s: 3.0 * h,
        noise: 0.1,
        quantum: 0.01,
        drop_out: 0.1,
        ..Default::default()
    };
    let input = v1::InputChannel {
        input: string.clone(),
        delay_s: 2.0 * h,
        max_rate: Some(1.0),
        ..Default::default()
    };
    let channels = v1::Channels {
        outputs: sources.into_iter().enumerate().map(output).collect(),
        inputs: vec![input],
        seed: 1,
    };
    let limits = Limits::default();
    session.set_channels(channels, &limits).expect("they can be declared");
    let blink = Some(Pattern::Intermittent(v1::Intermittent { period_s: 4.0 * h, duty: 0.5 }));
    let inject = |target, kind, pattern| {
        let fault = v1::FaultSpec { target, kind: Some(kind), pattern, ..Default::default() };
        session.inject_fault(fault, &limits).expect("it can be injected");
    };
    let on_output = |name: &str| Some(Target::Output(name.to_owned()));
    inject(Some(Target::Input(string.clone())), Kind::Stuck(true), blink);
    inject(on_output("output-3"), Kind::Delay(v1::ExtraDelay { delay_s: 5.0 * h }), blink);
    inject(on_output("output-0"), Kind::Noise(v1::ExtraNoise { deviation: 1.0 }), None);
    inject(on_output("output-1"), Kind::Loss(v1::PacketLoss { probability: 0.5 }), None);
    let push = v1::Push { point: Some(point()), force: vec![0.1; 3], torque: vec![0.01; 3] };
    inject(None, Kind::Push(push), blink);
    let lighter = v1::Parameter { path: "gravity[1]".to_owned(), value: -1.0 };
    let change = v1::ParameterChange { parameters: vec![lighter] };
    inject(None, Kind::Parameters(change), blink);

    let mut lease = session.acquire(DriverKind::Step).expect("nobody has it");
    let mut u = vec![0.0; d.input()];
    session.copy_plant().hold_input(&mut u);
    let count = allocations(|| {
        for _ in 0..STEPS {
            lease.step(&u).expect("a step succeeds");
        }
    });
    assert_eq!(count, 0);
    assert!(session.faults().iter().all(|fault| fault.beginnings > 0));

    // Nor does a watchdog that puts the plant back after each step.
    let never = Watchdog {
        quantity: Quantity::Energy,
        min: f64::MAX,
        max: f64::INFINITY,
        action: WatchdogAction::Reset,
    };
    let safety = Safety { watchdogs: vec![never], on_step_failure: None };
    session.set_safety(safety).expect("it can be protected");
    let count = allocations(|| {
        for _ in 0..STEPS {
            lease.step(&u).expect("a step succeeds");
        }
    });
    assert_eq!((count, session.step_index()), (0, 0));
}

#[test]
fn a_recorded_step_allocates_nothing() {
    let scene = builtin::scene("cart-pole").expect("a built-in scene");
    let model = Arc::new(Model::compile(&scene).expect("it compiles"));
    let plant = Plant::new(Arc::clone(&model), Settings::new(&model)).expect("a plant");
    let session = new_session(plant);
    let directory = tempfile::tempdir().expect("a directory");
    let (path, mode) = (directory.path(), modes::Mode::PRIVATE);
    let recordings =
        Recordings::open(path, mode, Limits::default(), Arc::default(), None).expect("opened");
    recordings.start(&session, "steps".to_owned(), 0.0).expect("it can be recorded");
    let mut lease = session.acquire(DriverKind::Step).expect("nobody has it");
    // More than the ring holds, so that some steps wait for the recorder.
    let steps = 20_000;
    let count = allocations(|| {
        for _ in 0..steps {
            lease.step(&[0.2]).expect("a step succeeds");
        }
    });
    assert_eq!(count, 0);
    let recording = recordings.stop("steps").expect("it ends");
    assert_eq!((recording.steps, recording.lost), (steps, 0));
}

/// The loop of a paced plant does not either: inputs of a driver, watchdogs, channels and readers of its
/// states included.
#[test]
fn paced_steps_allocate_nothing() {
    let scene = builtin::scene("cart-pole").expect("the scene is built in");
    let model = Arc::new(Model::compile(&scene).expect("it compiles"));
    let plant = Plant::new(Arc::clone(&model), Settings::new(&model)).expect("it starts");
    let session = new_session(plant);
    let dog = |quantity| Watchdog { quantity, min: -1e9, max: 1e9, action: WatchdogAction::Reset };
    let watchdogs = vec![dog(Quantity::Velocity(1)), dog(Quantity::Energy)];
    session.set_safety(Safety { watchdogs, on_step_failure: None }).expect("it can be protected");
    let source = Some(v1::output_channel::Source::Coordinate("theta".to_owned()));
    let sensor = v1::OutputChannel { name: "encoder".to_owned(), source, ..Default::default() };
    let channels = v1::Channels { outputs: vec![sensor], ..Default::default() };
    session.set_channels(channels, &Limits::default()).expect("they can be declared");
    let settings = RunSettings { pace: Pace::Paced, speed: 20.0, ..RunSettings::default() };
    session.run(Some(settings), 0, 1).expect("it runs");
    let mut reader = Reader::new(session.ring());
    let mut lease = session.acquire(DriverKind::Link).expect("nobody has it");
    let of_the_loop =
        || session.with_core(|core| (ALLOCATIONS.with(Cell::get), core.plant().step_index()));
    // The first answer of the loop is on its way when the second one is counted.
    of_the_loop();
    let (before, first) = of_the_loop();
    let (mut read, mut sequence) = (0, 0);
    while read < STEPS {
        while reader.read_next().is_some() {
            read += 1;
        }
        sequence += 1;
        lease.offer(sequence, &[0.1], 1).expect("a good input");
        std::thread::yield_now();
    }
    let (after, last) = of_the_loop();
    assert!(last - first >= 50, "{first} to {last}");
    // What the loop is asked may cost it an allocation; its steps do not.
    assert!(after - before <= 1, "{} allocations in {} steps", after - before, last - first);
    session.pause();
}

/// A session around a plant.
fn new_session(plant: Plant) -> Arc<Session> {
    let metrics = Arc::new(Metrics::default());
    let realtime = RealTime::new(RealTimeSettings::default(), &metrics);
    Session::new(Origin::new("a", "b"), plant, metrics, realtime)
}

#[test]
fn the_counter_counts() {
    let count = allocations(|| drop(std::hint::black_box(vec![1_u8; 16])));
    assert_eq!(count, 1);
}
