//! Instruction counts, by callgrind: what a scene does not use costs nothing, and what a step costs
//! does not grow unnoticed.
//!
//! Needs valgrind; without it these tests say so and pass.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde::{Deserialize, Serialize};

/// Self cost by function, in instructions, of everything below the measured calls.
struct Profile(BTreeMap<String, u64>);

impl Profile {
    fn total(&self) -> u64 {
        self.0.values().sum()
    }

    /// Instructions of all functions whose name contains one of the patterns.
    fn of(&self, patterns: &[&str]) -> u64 {
        let matches = |name: &String| patterns.iter().any(|pattern| name.contains(pattern));
        self.0.iter().filter(|(name, _)| matches(name)).map(|(_, cost)| cost).sum()
    }
}

/// The stages that a plan leaves out, by the functions that do their work.
const CONSTRAINTS: &[&str] =
    &["constraints::closure::", "math::pivoted_lu::", "kkt::schur::", "SchurComplement::"];
const SPRINGS: &[&str] = &["lagrangian::potentials::"];
const DAMPING: &[&str] = &["lagrangian::forces::add_damping"];
const INPUTS: &[&str] = &["lagrangian::forces::input_forces"];
const FORCES: &[&str] =
    &["Forces::", "forces::wrench::", "forces::point::", "forces::coordinate::"];
const SIGNALS: &[&str] = &["model::signal::", "time_function::"];
const BALLS: &[&str] = &["integrator::balls::", "math::rotation::", "integrator::blocks::"];

/// A pendulum without anything else.
const BARE: &str = r#"
format = 1
name = "bare"
gravity = [0.0, 0.0, -9.81]

[[frames]]
name = "rod"
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
body = { mass = 1.0, center_of_mass = [0.0, 0.0, -1.0] }

[[coordinates]]
name = "rod"
initial = 0.5
"#;

/// What makes it a pendulum with a spring on its coordinate and one to the world.
const SPRINGS_OF_SPRUNG: &str = r#"
[[springs]]
type = "coordinate"
coordinate = "rod"
stiffness = 2.0

[[springs]]
type = "two_point"
a = { frame = "world", at = [1.0, 0.0, 0.0] }
b = { frame = "rod", at = [0.0, 0.0, -1.0] }
stiffness = 3.0
rest_length = 0.5
"#;

/// Another joint, on no other: steps of one joint, and of two in a row, are one function each, in which no stage has a name.
const ASIDE: &str = r#"
[[frames]]
name = "aside"
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
body = { mass = 1.0, center_of_mass = [0.0, 0.0, -1.0] }
"#;

/// What damps it.
const DAMPED: &str = r#"
[[coordinates]]
name = "aside"
damping = 0.5
"#;

#[test]
fn a_scene_runs_no_code_of_what_it_does_not_have() {
    let Some(valgrind) = valgrind() else { return };
    let directory = tempfile::tempdir().expect("a temporary folder");
    let write = |name: &str, text: &str| {
        let path = directory.path().join(name);
        std::fs::write(&path, text).expect("the scene is written");
        path.into_os_string().into_string().expect("a path of text")
    };
    let bare = write("bare.toml", BARE);
    let sprung = write("sprung.toml", &format!("{BARE}{SPRINGS_OF_SPRUNG}"));
    let damped = write("damped.toml", &format!("{BARE}{ASIDE}{DAMPED}"));
    let element = |name: &str| {
        format!("{}/../models/scenes/elements/{name}.toml", env!("CARGO_MANIFEST_DIR"))
    };
    let [ball, drag, signals] = ["ball", "drag", "signals"].map(element);
    let signals = std::fs::read_to_string(signals).expect("a scene");
    let signals = write("signals.toml", &format!("{signals}{ASIDE}"));
    // Scene; has it constraints, springs, damping, inputs, forces, signals, ball joints?
    let (f, t) = (false, true);
    let cases = [
        (bare.as_str(), [f, f, f, f, f, f, f]),
        (sprung.as_str(), [f, t, f, f, f, f, f]),
        ("chain-8", [f, f, f, t, f, f, f]),
        (damped.as_str(), [f, f, t, f, f, f, f]),
        ("four-bar", [t, f, f, t, f, f, f]),
        ("marionette", [t, f, t, f, f, f, f]),
        (&ball, [f, f, f, t, f, f, t]),
        (&drag, [f, f, f, f, t, f, f]),
        (&signals, [f, f, f, t, f, t, f]),
    ];
    for (scene, has) in cases {
        for operation in ["step", "linearize"] {
            let profile = valgrind.profile(scene, operation, 10);
            let stages = [
                ("constraints", CONSTRAINTS),
                ("springs", SPRINGS),
                ("damping", DAMPING),
                ("inputs", INPUTS),
                ("forces", FORCES),
                ("signals", SIGNALS),
                ("ball joints", BALLS),
            ];
            for ((stage, functions), has) in stages.into_iter().zip(has) {
                let cost = profile.of(functions);
                assert_eq!(cost > 0, has, "{scene}, {operation}: {cost} instructions of {stage}");
            }
        }
    }
}

/// What keeps the last digits of a state, the update as a whole, and what refuses solutions that turn too
/// far.
const SAFEGUARDS: &[&str] = &["PreciseState>::move_on", "check_turns"];
/// The part of a step that they may take.
const SAFEGUARDS_SHARE: f64 = 0.02;

#[test]
fn safeguards_take_a_small_part_of_a_step() {
    let Some(valgrind) = valgrind() else { return };
    for (scene, calls) in [("chain-32", 20), ("marionette", 50)] {
        let profile = valgrind.profile(scene, "step", calls);
        for name in SAFEGUARDS {
            assert!(profile.of(&[name]) > 0, "{name} is a function of its own");
        }
        let share = profile.of(SAFEGUARDS) as f64 / profile.total() as f64;
        println!("{scene}: {:.2} %", 100.0 * share);
        assert!(share <= SAFEGUARDS_SHARE, "{scene}: {:.2} %", 100.0 * share);
    }
}

/// Instructions per call by operation.
type Counts = BTreeMap<String, u64>;

/// The committed table. It holds for one compiler and one kind of processor: others say little about
/// a change here.
#[derive(Debug, Serialize, Deserialize)]
struct Table {
    conditions: Conditions,
    scenes: BTreeMap<String, Counts>,
}

#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Conditions {
    rustc: String,
    processor: String,
}

impl Conditions {
    fn here() -> Self {
        let output = Command::new("rustc").arg("--version").output().expect("rustc runs");
        let rustc = String::from_utf8_lossy(&output.stdout).trim().to_owned();
        #[cfg(target_arch = "x86_64")]
        let vectors = if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            " with AVX2 and FMA"
        } else {
            ""
        };
        #[cfg(not(target_arch = "x86_64"))]
        let vectors = "";
        Self { rustc, processor: format!("{}{vectors}", std::env::consts::ARCH) }
    }
}

/// Scene, calls from the initial configuration, operations of `step_count`.
const CASES: &[(&str, u64, &[&str])] = &[
    ("pendulum", 50, ALL),
    ("double-pendulum", 50, ALL),
    ("chain-8", 50, ALL),
    ("chain-16", 50, PLANT),
    ("chain-32", 20, PLANT),
    ("chain-128", 5, PLANT),
    ("tree-30", 20, PLANT),
    ("tree-127", 5, PLANT),
    ("four-bar", 50, PLANT),
    ("scissor-8", 50, PLANT),
    ("scissor-32", 20, PLANT),
    ("marionette", 50, PLANT),
    ("walker-4", 20, PLANT),
    ("balls-7", 20, PLANT),
    ("sprung-rope", 20, PLANT),
    ("damped-rope", 20, PLANT),
    ("marionette", 10, &["riccati"]),
];
/// What is on ropes of 32 hinges in space: vectors of their joints have two blocks, and three.
const ON_ROPES: &[(&str, &str)] = &[
    (
        "sprung-rope",
        r#"
[[springs]]
type = "two_point"
a = { frame = "rod31" }
b = { frame = "world", at = [0.3, 0.2, -3.0] }
stiffness = 2.0
"#,
    ),
    (
        "damped-rope",
        r#"
[[forces]]
type = "two_point_damper"
a = { frame = "rod5", at = [0.02, 0.0, 0.0] }
b = { frame = "rod28", at = [0.0, 0.02, 0.0] }
damping = 0.5
"#,
    ),
];
const PLANT: &[&str] = &["step", "linearize", "step-and-linearize", "contract"];
const ALL: &[&str] = &["step", "linearize", "step-and-linearize", "contract", "riccati", "lqr"];
/// Relative change that goes unnoticed.
const TOLERANCE: f64 = 0.05;
const HEADER: &str = "\
# Instructions per call, counted by callgrind from the initial configuration on; \
riccati: per step of the recursion.
# To renew: CARGO_INCREMENTAL=0 UPDATE_INSTRUCTIONS=1 cargo test -p plantd-tests --test plant callgrind

";

#[test]
fn instructions_per_step_are_those_of_the_table() {
    let Some(valgrind) = valgrind() else { return };
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("instructions.toml");
    let update = std::env::var_os("UPDATE_INSTRUCTIONS").is_some();
    let conditions = Conditions::here();
    if update {
        let scenes = valgrind.counts();
        let table = toml::to_string(&Table { conditions, scenes }).expect("a table is text");
        std::fs::write(path, format!("{HEADER}{table}")).expect("the table is written");
        return;
    }
    let text = std::fs::read_to_string(path).expect("the table is there");
    let committed: Table = toml::from_str(&text).expect("the table is TOML");
    if committed.conditions != conditions {
        eprintln!("skipped: the table is of {:?}, this is {conditions:?}", committed.conditions);
        return;
    }
    let changes = changes(&committed.scenes, &valgrind.counts());
    assert!(
        changes.is_empty(),
        "instruction counts changed; if that is meant, run again with UPDATE_INSTRUCTIONS=1:\n{}",
        changes.join("\n")
    );
}

/// A rope of this name; none of others.
fn rope(name: &str) -> Option<String> {
    let (_, more) = ON_ROPES.iter().find(|(rope, _)| *rope == name)?;
    let mut text = format!("format = 1\nname = \"{name}\"\ngravity = [0.0, 0.0, -9.81]\n");
    for i in 0..32 {
        let (parent, z) = match i {
            0 => ("world".to_owned(), 0.0),
            _ => (format!("rod{}", i - 1), -0.1),
        };
        let axis = ["[1.0, 0.0, 0.0]", "[0.0, 1.0, 0.0]"][i % 2];
        text += &format!(
            "[[frames]]\nname = \"rod{i}\"\nparent = \"{parent}\"\ntranslation = [0.0, 0.0, {z:?}]\n\
             joint = {{ type = \"revolute\", axis = {axis} }}\n\
             body = {{ mass = 0.1, center_of_mass = [0.0, 0.0, -0.05], inertia = [1e-4, 1e-4, 1e-5] }}\n\
             [[coordinates]]\nname = \"rod{i}\"\ninitial = 0.02\n"
        );
    }
    Some(text + more)
}

/// What `plantctl explain` says a step costs, against what it did cost when the table was made.
#[test]
fn estimates_of_cost_are_right_to_a_factor_of_two() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("instructions.toml");
    let text = std::fs::read_to_string(path).expect("the table is there");
    let table: Table = toml::from_str(&text).expect("the table is TOML");
    for (name, counts) in &table.scenes {
        let scene = match rope(name) {
            Some(text) => plantd_models::Scene::from_toml(&text).expect("a scene"),
            None => plantd_models::builtin::scene(name).expect("a built-in scene"),
        };
        let costs = plantd_models::Model::compile(&scene).expect("it compiles").stage_costs();
        let step: f64 = costs.iter().map(|stage| stage.times * stage.instructions).sum();
        let linearization: f64 =
            costs.iter().filter(|s| s.times == 0.0).map(|s| s.instructions).sum();
        let count = |operation: &str| counts[operation] as f64;
        for (what, estimate, actual) in [
            ("step", step, count("step")),
            ("with A and B", step + linearization, count("step-and-linearize")),
        ] {
            let ratio = estimate / actual;
            println!("{name}, {what}: {estimate:.0}, {actual}, {ratio:.2}");
            assert!((0.5..2.0).contains(&ratio), "{name}, {what}: {estimate:.0} for {actual}");
        }
    }
}

/// Describes the counts that differ by more than the tolerance, are new or are gone.
fn changes(then: &BTreeMap<String, Counts>, now: &BTreeMap<String, Counts>) -> Vec<String> {
    let flat = |table: &BTreeMap<String, Counts>| -> BTreeMap<(String, String), u64> {
        let rows = table.iter().flat_map(|(scene, counts)| {
            counts.iter().map(|(what, count)| ((scene.clone(), what.clone()), *count))
        });
        rows.collect()
    };
    let (then, now) = (flat(then), flat(now));
    let keys: BTreeSet<_> = then.keys().chain(now.keys()).collect();
    let changed = |(scene, operation): &(String, String)| {
        let key = (scene.clone(), operation.clone());
        let (Some(&then), Some(&now)) = (then.get(&key), now.get(&key)) else {
            return Some(format!("{scene}, {operation}: only in one of the tables"));
        };
        let change = now as f64 / then as f64 - 1.0;
        let percent = 100.0 * change;
        let line = format!("{scene}, {operation}: {then} -> {now} ({percent:+.1} %)");
        (change.abs() > TOLERANCE).then_some(line)
    };
    keys.into_iter().filter_map(changed).collect()
}

/// Valgrind with the program that it watches.
struct Valgrind {
    program: PathBuf,
}

/// None, and a message, if valgrind is not installed.
fn valgrind() -> Option<Valgrind> {
    let version = Command::new("valgrind").arg("--version").stdout(Stdio::null()).status();
    if !version.is_ok_and(|status| status.success()) {
        eprintln!("skipped: valgrind is not installed");
        return None;
    }
    // Tests compile the mechanics as a release does.
    Some(Valgrind { program: plantd_tests::example("step_count") })
}

impl Valgrind {
    fn profile(&self, scene: &str, operation: &str, calls: u64) -> Profile {
        let directory = tempfile::tempdir().expect("a temporary folder");
        let file = directory.path().join("callgrind.out");
        let mut path = PathBuf::from(scene);
        if let Some(text) = rope(scene) {
            path = directory.path().join("rope.toml");
            std::fs::write(&path, text).expect("the scene is written");
        }
        let output = Command::new("valgrind")
            .args(["--tool=callgrind", "--toggle-collect=measured_call"])
            .args(["--compress-strings=no", "--compress-pos=no"])
            .arg(format!("--callgrind-out-file={}", file.display()))
            .arg(&self.program)
            .arg(path)
            .args([operation, &calls.to_string()])
            .output()
            .expect("valgrind starts");
        let messages = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{scene}, {operation}: {messages}");
        parse(&std::fs::read_to_string(file).expect("callgrind writes its file"))
    }

    /// The counts of all cases, on all processors.
    fn counts(&self) -> BTreeMap<String, Counts> {
        let cases: Vec<_> = CASES
            .iter()
            .flat_map(|(scene, calls, operations)| {
                operations.iter().map(move |o| (*scene, *calls, *o))
            })
            .collect();
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        let count = |first: usize| {
            let own = cases.iter().skip(first).step_by(threads);
            own.map(|&(scene, calls, operation)| {
                let total = self.profile(scene, operation, calls).total();
                (scene, operation, total / calls)
            })
            .collect::<Vec<_>>()
        };
        let mut scenes: BTreeMap<String, Counts> = BTreeMap::new();
        std::thread::scope(|scope| {
            let workers: Vec<_> = (0..threads).map(|i| scope.spawn(move || count(i))).collect();
            for worker in workers {
                for (scene, operation, count) in worker.join().expect("a case is counted") {
                    scenes.entry(scene.to_owned()).or_default().insert(operation.to_owned(), count);
                }
            }
        });
        scenes
    }
}

/// Reads the self cost of every function from a callgrind file with uncompressed names.
fn parse(text: &str) -> Profile {
    let mut costs = BTreeMap::new();
    let mut function = "";
    let mut is_call = false;
    for line in text.lines() {
        if let Some(name) = line.strip_prefix("fn=") {
            function = name;
        } else if line.starts_with("calls=") {
            // The next line has the cost of the called function, which counts it itself.
            is_call = true;
        } else if line.starts_with(|c: char| c.is_ascii_digit()) {
            let cost = line.split(' ').nth(1).and_then(|cost| cost.parse::<u64>().ok());
            if !std::mem::take(&mut is_call) {
                *costs.entry(function.to_owned()).or_default() += cost.unwrap_or(0);
            }
        }
    }
    Profile(costs)
}
