//! plantd's driver in the comparison with other engines, `tests/peers`.
//!
//! Reads lines `PATH METHOD DT STEPS PASSES`, runs PASSES times STEPS steps of DT seconds from the
//! start of the mechanism in the JSON file PATH, and answers each with the CPU seconds of its thread and
//! the last configuration, or with `error:` and a reason. Methods: `midpoint`, `midpoint-ab` (a step
//! with A and B of all torques, column by column in memory of the driver's), the same with `-rough` (with new
//! torques at each step) or with `-moving` (without the first step of a pass, which
//! finds the velocity that a momentum means), `order-4` to `order-16` (Gauss collocation), `order-4-fast`
//! and so on, `order-4-coarse` (solved to what the precisions `fast` and `coarse` ask for), and `scalar`: the midpoint rule written by hand
//! for a pendulum.

use std::collections::BTreeMap;
use std::error::Error;
use std::io::BufRead;
use std::sync::Arc;

use plantd_models::scene::{
    Axis, Body, Constraint, Coordinate, Frame, Input, Joint, Point, Rotation,
};
use plantd_models::{Initial, Layout, Linearization, Model, Plant, Precision, Scene, Settings};
use serde::Deserialize;

/// A mechanism of `tests/peers/mechanisms.py`.
#[derive(Deserialize)]
struct Mechanism {
    name: String,
    gravity: f64,
    bodies: Vec<Link>,
    q0: Vec<f64>,
    v0: Vec<f64>,
    /// The largest torques of all coordinates, where they change at each step.
    #[serde(default)]
    rough: Vec<f64>,
    loops: Vec<Loop>,
}

#[derive(Deserialize)]
struct Link {
    parent: i64,
    pos: [f64; 3],
    axis: [f64; 3],
    mass: f64,
    com: [f64; 3],
    inertia: Vec<f64>,
    #[serde(default)]
    r#type: String,
    /// Orientation in the parent, w first.
    turn: Option<[f64; 4]>,
}

/// Two points that coincide along some axes.
#[derive(Deserialize)]
struct Loop {
    body_a: i64,
    at_a: [f64; 3],
    body_b: i64,
    at_b: [f64; 3],
    #[serde(default = "in_plane")]
    axes: Vec<Axis>,
}

fn in_plane() -> Vec<Axis> {
    vec![Axis::X, Axis::Z]
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut mechanisms = BTreeMap::new();
    for line in std::io::stdin().lock().lines() {
        match answer(&line?, &mut mechanisms) {
            Ok((seconds, q)) => {
                let q: Vec<String> = q.iter().map(f64::to_string).collect();
                println!("{seconds:e} {}", q.join(" "));
            }
            Err(error) => println!("error: {error}"),
        }
    }
    Ok(())
}

type Mechanisms = BTreeMap<String, (Mechanism, Arc<Model>)>;

/// CPU seconds and the last configuration.
fn answer(line: &str, mechanisms: &mut Mechanisms) -> Result<(f64, Vec<f64>), Box<dyn Error>> {
    let words: Vec<&str> = line.split_whitespace().collect();
    let [path, method, dt, steps, passes] = words[..] else {
        return Err("PATH METHOD DT STEPS PASSES are needed".into());
    };
    if !mechanisms.contains_key(path) {
        let mechanism: Mechanism = serde_json::from_str(&std::fs::read_to_string(path)?)?;
        let model = Arc::new(Model::compile(&scene(&mechanism))?);
        mechanisms.insert(path.to_owned(), (mechanism, model));
    }
    let (mechanism, model) = &mechanisms[path];
    let (dt, steps, passes) = (dt.parse()?, steps.parse()?, passes.parse()?);
    match method {
        "scalar" => Ok(run_scalar(mechanism, dt, steps, passes)),
        _ => run(mechanism, model, method, dt, steps, passes),
    }
}

fn run(
    mechanism: &Mechanism,
    model: &Arc<Model>,
    method: &str,
    time_step_s: f64,
    steps: u64,
    passes: u64,
) -> Result<(f64, Vec<f64>), Box<dyn Error>> {
    let (method, precision) = match method.rsplit_once('-') {
        Some((method, "fast")) => (method, Precision::Fast),
        Some((method, "coarse")) => (method, Precision::Coarse),
        _ => (method, Precision::Exact),
    };
    let (method, order) = match method.strip_prefix("order-") {
        Some(order) => ("midpoint", order.parse()?),
        None => (method, 2),
    };
    let settings = Settings { time_step_s, order, precision, ..Settings::new(model) };
    let mut plant = Plant::new(Arc::clone(model), settings)?;
    let (q, v) = (mechanism.q0.clone(), mechanism.v0.clone());
    plant.initialize(&Initial::Velocity { q, v })?;
    let start = plant.snapshot();
    let d = model.dimensions();
    let mut u = vec![0.0; d.input()];
    let mut out = Linearization::new(model);
    let (mut a, mut b) = (vec![0.0; d.state() * d.state()], vec![0.0; d.state() * d.input()]);
    let (method, rough) = match method.strip_suffix("-rough") {
        Some(method) => (method, &mechanism.rough[mechanism.rough.len().saturating_sub(u.len())..]),
        None => (method, &[][..]),
    };
    let (method, is_moving) = match method.strip_suffix("-moving") {
        Some(method) => (method, true),
        None => (method, false),
    };
    let mut seconds = 0.0;
    for _ in 0..passes {
        let mut begin = cpu_time_s();
        plant.restore(&start)?;
        for k in 0..steps {
            for (i, (u, most)) in u.iter_mut().zip(rough).enumerate() {
                *u = most * rough_number(k as u32, i as u32);
            }
            match method {
                "midpoint" => plant.step(&u)?,
                "midpoint-ab" => {
                    let report = plant.step_and_linearize(&u, &mut out)?;
                    out.a_into(&mut a, Layout::Columns);
                    out.b_into(&mut b, Layout::Columns);
                    std::hint::black_box((&a, &b));
                    report
                }
                _ => return Err("no such method".into()),
            };
            if is_moving && k == 0 {
                begin = cpu_time_s();
            }
        }
        seconds += cpu_time_s() - begin;
    }
    Ok((seconds, plant.q().to_vec()))
}

/// Between -1 and 1: the same in all drivers; see `tests/peers/drivers/driver.h`.
fn rough_number(step: u32, motor: u32) -> f64 {
    let mut x =
        step.wrapping_mul(2_654_435_761).wrapping_add(motor.wrapping_mul(40_503)).wrapping_add(1);
    x = (x ^ (x >> 15)).wrapping_mul(2_246_822_519);
    x = (x ^ (x >> 13)).wrapping_mul(3_266_489_917);
    x ^= x >> 16;
    f64::from(x) * (2.0 / 4_294_967_296.0) - 1.0
}

/// The same map for a pendulum alone: p₀ = (J/h)Δ + ½h mgl sin(q₀ + ½Δ), by Newton to round-off.
fn run_scalar(mechanism: &Mechanism, h: f64, steps: u64, passes: u64) -> (f64, Vec<f64>) {
    let link = &mechanism.bodies[0];
    let length = link.com[2];
    let inertia = link.mass * length * length + link.inertia[1];
    let torque = link.mass * mechanism.gravity * length.abs();
    let begin = cpu_time_s();
    let mut q = 0.0;
    for _ in 0..passes {
        q = mechanism.q0[0];
        let mut p = inertia * mechanism.v0[0];
        let mut increment = h * p / inertia;
        for _ in 0..steps {
            let mut last = f64::INFINITY;
            let sin = loop {
                let (sin, cos) = (q + 0.5 * increment).sin_cos();
                let residual = inertia / h * increment + 0.5 * h * torque * sin - p;
                let correction = residual / (inertia / h + 0.25 * h * torque * cos);
                // Round-off: corrections do not get smaller any more.
                if correction == 0.0 || correction.abs() >= last {
                    break sin;
                }
                increment -= correction;
                last = correction.abs();
            };
            p -= h * torque * sin;
            q += increment;
        }
    }
    (cpu_time_s() - begin, vec![q])
}

fn scene(mechanism: &Mechanism) -> Scene {
    let name = |i: i64| if i < 0 { "world".to_owned() } else { format!("b{i}") };
    let frames = mechanism.bodies.iter().zip(0..).map(|(link, i)| Frame {
        name: name(i),
        parent: name(link.parent),
        translation: link.pos,
        rotation: link.turn.map(Rotation::Quaternion),
        joint: Some(match link.r#type.as_str() {
            "ball" => Joint::Ball { coordinate: None },
            "free" => Joint::Free { coordinate: None },
            "slide" => Joint::Prismatic { axis: link.axis, coordinate: None },
            _ => Joint::Revolute { axis: link.axis, coordinate: None },
        }),
        body: (link.mass > 0.0).then(|| Body {
            mass: link.mass,
            center_of_mass: link.com,
            inertia: link.inertia.clone(),
            any_inertia: true,
        }),
        ..Frame::default()
    });
    let names = mechanism.bodies.iter().zip(0..).flat_map(|(link, i)| {
        let ends: &[&str] = match link.r#type.as_str() {
            "ball" => &["_rx", "_ry", "_rz"],
            "free" => &["_x", "_y", "_z", "_rx", "_ry", "_rz"],
            _ => &[""],
        };
        ends.iter().map(move |end| (format!("b{i}{end}"), ends.len() < 6))
    });
    let names: Vec<(String, bool)> = names.collect();
    let coordinates = names.iter().zip(&mechanism.q0).map(|((name, _), &initial)| Coordinate {
        name: name.clone(),
        initial,
        ..Coordinate::default()
    });
    let driven = names.iter().filter(|(_, is_driven)| *is_driven);
    let inputs = driven.zip(0..).map(|((name, _), i): (_, i32)| Input {
        name: format!("torque{i}"),
        coordinate: Some(name.clone()),
        ..Input::default()
    });
    let point = |body, at| Point { frame: name(body), at };
    let constraints = mechanism.loops.iter().enumerate().map(|(i, l)| Constraint::PointToPoint {
        name: format!("loop{i}"),
        a: point(l.body_a, l.at_a),
        b: point(l.body_b, l.at_b),
        axes: l.axes.clone(),
    });
    Scene {
        format: 1,
        name: mechanism.name.to_lowercase(),
        description: String::new(),
        time_step_s: 0.01,
        gravity: Some([0.0, 0.0, -mechanism.gravity]),
        damping: 0.0,
        frames: frames.collect(),
        coordinates: coordinates.collect(),
        armatures: Vec::new(),
        springs: Vec::new(),
        inputs: inputs.collect(),
        forces: Vec::new(),
        signals: Vec::new(),
        constraints: constraints.collect(),
        operating_points: Vec::new(),
    }
}

/// CPU time of this thread: other programs on the machine do not count.
fn cpu_time_s() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}
