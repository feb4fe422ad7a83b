//! Times steps and linearizations of mechanisms with ball joints: floating robots and trees of balls, and the
//! same robots on a base of three slides and three hinges.
//!
//! `cargo run --release -p plantd-models --example floating [MECHANISM ..]`
//!
//! A row has the microseconds of CPU time of a step, of a step with its linearization, and of both with A and
//! B as matrices: the least of several passes, by turns. `--write FOLDER` writes the mechanisms as scenes.
//!
//! `--errors` prints, for each mechanism, the milliseconds of CPU time in which a second of motion is simulated to
//! errors of 1e-4, 1e-6, 1e-8 and 1e-10 (rad, m), and with which order and how many steps: the fastest of all
//! orders and of steps from a fourth to a 512th of a second. Errors are those against the finest steps.
//! `--errors-fast` does so where steps are solved to eleven digits.

use std::error::Error;
use std::path::Path;
use std::sync::Arc;

use plantd_models::scene::{Body, Coordinate, Frame, Input, Joint};
use plantd_models::{Initial, Linearization, Model, Plant, Precision, Scene, Settings, Snapshot};

const STEPS: usize = 200;
const PASSES: usize = 30;

const NAMES: &[&str] = &[
    "quadruped",
    "quadruped-on-hinges",
    "humanoid",
    "humanoid-on-hinges",
    "balls-7",
    "balls-15",
    "ball-chain-8",
];

fn main() -> Result<(), Box<dyn Error>> {
    let mut wanted: Vec<String> = std::env::args().skip(1).collect();
    if let [flag, folder] = &wanted[..]
        && flag == "--write"
    {
        for name in NAMES {
            let text = scene(name).ok_or("no such mechanism")?.to_toml();
            std::fs::write(Path::new(folder).join(format!("{name}.toml")), text)?;
        }
        return Ok(());
    }
    let precision = match wanted.first().map(String::as_str) {
        Some("--errors") => Some(Precision::Exact),
        Some("--errors-fast") => Some(Precision::Fast),
        _ => None,
    };
    if precision.is_some() {
        wanted.remove(0);
    }
    if wanted.is_empty() {
        wanted = NAMES.iter().map(|name| (*name).to_owned()).collect();
    }
    if let Some(precision) = precision {
        println!("{:<22} ms of CPU time (order, steps) to 1e-4, 1e-6, 1e-8, 1e-10", "");
        for name in &wanted {
            print_errors(name, &scene(name).ok_or("no such mechanism")?, precision)?;
        }
        return Ok(());
    }
    let mut motions = Vec::new();
    for name in &wanted {
        motions.push(Motion::new(&scene(name).ok_or("no such mechanism")?)?);
    }
    let mut least = vec![[f64::INFINITY; 3]; motions.len()];
    for _ in 0..PASSES {
        for (motion, least) in motions.iter_mut().zip(&mut least) {
            for (what, least) in least.iter_mut().enumerate() {
                *least = least.min(motion.pass(what)?);
            }
        }
    }
    println!(
        "{:<22} {:>8} {:>8} {:>12} {:>10} {:>12}",
        "", "freedoms", "step/µs", "+ linear/µs", "formed/µs", "iterations"
    );
    for ((name, motion), [step, linear, formed]) in wanted.iter().zip(&motions).zip(least) {
        println!(
            "{name:<22} {:>8} {step:>8.2} {linear:>12.2} {formed:>10.2} {:>12.2}",
            motion.plant.model().dimensions().dynamic,
            motion.iterations as f64 / motion.steps as f64
        );
    }
    Ok(())
}

/// Prints a row of times to errors.
fn print_errors(name: &str, scene: &Scene, precision: Precision) -> Result<(), Box<dyn Error>> {
    let model = Arc::new(Model::compile(scene)?);
    let run = |order: u32, steps: u32, precision: Precision| -> Option<(Vec<f64>, f64)> {
        let time_step_s = 1.0 / f64::from(steps);
        let usual = Settings::new(&model);
        let settings = Settings { order, time_step_s, precision, halvings: 0, ..usual };
        let mut plant = Plant::new(Arc::clone(&model), settings).ok()?;
        let q: Vec<f64> = model.coordinates().iter().map(|c| c.initial).collect();
        let v = (0..q.len()).map(|i| 2.0 * (1.7 * i as f64).sin()).collect();
        plant.initialize(&Initial::Velocity { q, v }).ok()?;
        let input = vec![0.0; model.dimensions().input()];
        let begin = cpu_time_s();
        for _ in 0..steps {
            plant.step(&input).ok()?;
        }
        Some((plant.q().to_vec(), cpu_time_s() - begin))
    };
    let (reference, _) = run(8, 1000, Precision::Exact).ok_or("no reference")?;
    let mut fastest = [(f64::INFINITY, 0, 0); 4];
    for order in [2, 4, 6, 8, 12, 16] {
        for steps in [4, 6, 8, 11, 16, 23, 32, 45, 64, 91, 128, 181, 256, 362, 512] {
            let Some((q, mut time)) = run(order, steps, precision) else { continue };
            for _ in 0..3 {
                let again = run(order, steps, precision);
                time = again.map_or(time, |(_, again)| time.min(again));
            }
            let difference = model.difference(&reference, &q);
            let error = difference.iter().fold(0.0_f64, |m, x| m.max(x.abs()));
            for (fastest, tolerance) in fastest.iter_mut().zip([1e-4, 1e-6, 1e-8, 1e-10]) {
                if error <= tolerance && time < fastest.0 {
                    *fastest = (time, order, steps);
                }
            }
        }
    }
    print!("{name:<22}");
    for (time, order, steps) in fastest {
        print!(" {:>9.3} ({order:>2}, {steps:>3})", 1e3 * time);
    }
    println!();
    Ok(())
}

/// A plant that moves.
struct Motion {
    plant: Plant,
    start: Snapshot,
    input: Vec<f64>,
    out: Linearization,
    iterations: u64,
    steps: u64,
}

impl Motion {
    fn new(scene: &Scene) -> Result<Self, Box<dyn Error>> {
        let model = Arc::new(Model::compile(scene)?);
        let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model))?;
        let n = model.dimensions().dynamic;
        let q = model.coordinates().iter().map(|c| c.initial).collect();
        let v = (0..n).map(|i| 0.5 * (1.7 * i as f64).sin()).collect();
        plant.initialize(&Initial::Velocity { q, v })?;
        let input = vec![0.0; model.dimensions().input()];
        plant.step(&input)?;
        let start = plant.snapshot();
        let out = Linearization::new(&model);
        Ok(Self { plant, start, input, out, iterations: 0, steps: 0 })
    }

    /// Mean microseconds of a step, with its linearization, with its matrices.
    fn pass(&mut self, what: usize) -> Result<f64, Box<dyn Error>> {
        self.plant.restore(&self.start)?;
        let begin = cpu_time_s();
        for _ in 0..STEPS {
            let report = match what {
                0 => self.plant.step(&self.input)?,
                _ => self.plant.step_and_linearize(&self.input, &mut self.out)?,
            };
            if what == 2 {
                std::hint::black_box((self.out.a(), self.out.b()));
            }
            self.iterations += u64::from(report.iterations);
            self.steps += 1;
        }
        Ok((cpu_time_s() - begin) * 1e6 / STEPS as f64)
    }
}

/// CPU time of this thread: other programs on the machine do not count.
fn cpu_time_s() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

/// A robot or tree by its name.
fn scene(name: &str) -> Option<Scene> {
    let (kind, size) = name.rsplit_once('-').unwrap_or((name, ""));
    let count: Option<usize> = size.parse().ok();
    let mut robot = Robot::default();
    match (kind, count) {
        ("balls", Some(n)) => {
            for i in 0..n {
                let at = if i == 0 { [0.0; 3] } else { [0.2 * side(i), 0.05, -0.2] };
                let parent = if i == 0 { None } else { Some((i - 1) / 2) };
                robot.body(parent, at, Joint::Ball { coordinate: None }, 1.0);
            }
        }
        ("ball-chain", Some(n)) => {
            for i in 0..n {
                let at = if i == 0 { [0.0; 3] } else { [0.0, 0.0, -0.3] };
                robot.body(i.checked_sub(1), at, Joint::Ball { coordinate: None }, 1.0);
            }
        }
        _ => robot.build(name)?,
    }
    Some(robot.scene(name))
}

fn side(i: usize) -> f64 {
    if i.is_multiple_of(2) { 1.0 } else { -1.0 }
}

/// Bodies one by one.
#[derive(Default)]
struct Robot {
    frames: Vec<Frame>,
    inputs: Vec<Input>,
    coordinates: Vec<Coordinate>,
}

impl Robot {
    /// Adds a body that moves on a joint, and returns its index.
    fn body(&mut self, parent: Option<usize>, at: [f64; 3], joint: Joint, mass: f64) -> usize {
        let i = self.frames.len();
        let inertia = [0.012, 0.010, 0.006].map(|inertia| inertia * mass).to_vec();
        let center_of_mass = [0.01, 0.005 * side(i), -0.1];
        let has_axis = matches!(joint, Joint::Revolute { .. });
        self.frames.push(Frame {
            name: format!("b{i}"),
            parent: parent.map_or("world".to_owned(), |parent| format!("b{parent}")),
            translation: at,
            joint: Some(joint),
            body: (mass > 0.0).then(|| Body { mass, center_of_mass, inertia, ..Body::default() }),
            ..Frame::default()
        });
        if has_axis {
            let name = format!("b{i}");
            let initial = 0.3 * (1.3 * i as f64).sin();
            self.coordinates.push(Coordinate {
                name: name.clone(),
                initial,
                ..Coordinate::default()
            });
            let name_of_input = format!("torque{i}");
            self.inputs.push(Input {
                name: name_of_input,
                coordinate: Some(name),
                ..Input::default()
            });
        }
        i
    }

    /// A chain of hinges about axes by turns, 0.2 m apart.
    fn limb(&mut self, mut parent: usize, at: [f64; 3], axes: &str, mass: f64) -> usize {
        for (k, axis) in axes.chars().enumerate() {
            let at = if k == 0 { at } else { [0.0, 0.0, -0.2] };
            parent = self.body(Some(parent), at, hinge(axis), mass);
        }
        parent
    }

    fn build(&mut self, name: &str) -> Option<()> {
        let (name, on_hinges) = match name.strip_suffix("-on-hinges") {
            Some(name) => (name, true),
            None => (name, false),
        };
        let mass = if name == "quadruped" { 5.0 } else { 8.0 };
        let base = if on_hinges {
            let mut parent = None;
            for axis in 0..3 {
                let mut direction = [0.0; 3];
                direction[axis] = 1.0;
                let joint = Joint::Prismatic { axis: direction, coordinate: None };
                parent = Some(self.body(parent, [0.0; 3], joint, 0.0));
            }
            for axis in ['z', 'y', 'x'] {
                let mass = if axis == 'x' { mass } else { 0.0 };
                parent = Some(self.body(parent, [0.0; 3], hinge(axis), mass));
            }
            parent?
        } else {
            self.body(None, [0.0; 3], Joint::Free { coordinate: None }, mass)
        };
        match name {
            "quadruped" => {
                for leg in 0..4 {
                    let x = if leg < 2 { 0.2 } else { -0.2 };
                    self.limb(base, [x, 0.1 * side(leg), 0.0], "xyy", 0.7);
                }
            }
            "humanoid" => {
                let torso = self.limb(base, [0.0, 0.0, 0.1], "zxy", 3.0);
                for s in 0..2 {
                    self.limb(base, [0.0, 0.1 * side(s), -0.1], "yxzyyx", 1.5);
                }
                for s in 0..2 {
                    self.limb(torso, [0.0, 0.2 * side(s), 0.3], "yxzyxyz", 0.8);
                }
            }
            _ => return None,
        }
        Some(())
    }

    fn scene(self, name: &str) -> Scene {
        let Self { frames, inputs, coordinates } = self;
        Scene {
            format: 1,
            name: name.to_owned(),
            time_step_s: 0.002,
            gravity: Some([0.0, 0.0, -9.81]),
            frames,
            inputs,
            coordinates,
            ..Scene::default()
        }
    }
}

fn hinge(axis: char) -> Joint {
    let axis = match axis {
        'x' => [1.0, 0.0, 0.0],
        'y' => [0.0, 1.0, 0.0],
        _ => [0.0, 0.0, 1.0],
    };
    Joint::Revolute { axis, coordinate: None }
}
