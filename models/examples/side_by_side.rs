//! Times steps of many plants of one model side by side ([`Fleet`]), beside those of the same plants one after the
//! other, and compares their states bit by bit.
//!
//! `cargo run --release -p plantd-models --example side_by_side [SCENE ..]`
//!
//! CPU time of this thread, by turns in one run, the least of several passes. All inputs change at each step in
//! `rough` motions; in `quiet` ones there are none.

use std::error::Error;
use std::sync::Arc;

use plantd_models::scene::{Body, Force, Frame, Input, Joint, Scene, Spring};
use plantd_models::{Fleet, Initial, Model, Plant, Settings, builtin};

const PLANTS: usize = 64;
const STEPS: usize = 200;
const PASSES: usize = 15;

/// Those with a `+` have springs or dry friction in their joints, too.
const SCENES: [&str; 13] = [
    "pendulum",
    "double-pendulum",
    "cart-pole",
    "chain-8",
    "chain-32",
    "spherical-pendulum",
    "arm-7",
    "arm-7+springs",
    "arm-7+friction",
    "humanoid-30+springs",
    "tree-15",
    "tree-30",
    "humanoid-30",
];

fn main() -> Result<(), Box<dyn Error>> {
    println!(
        "{:<20} {:<6} {:>10} {:>10} {:>6} {:>6} {:>6}",
        "scene", "motion", "alone/µs", "side/µs", "ratio", "iter", "fact"
    );
    let wanted: Vec<String> = std::env::args().skip(1).collect();
    let all: Vec<String> = SCENES.map(str::to_owned).to_vec();
    for name in if wanted.is_empty() { all } else { wanted } {
        for is_rough in [false, true] {
            measure(&name, is_rough)?;
        }
    }
    Ok(())
}

fn measure(name: &str, is_rough: bool) -> Result<(), Box<dyn Error>> {
    let (bare, more) = name.split_once('+').unwrap_or((name, ""));
    let mut scene = robot(bare).or_else(|| builtin::scene(bare)).ok_or("no such scene")?;
    resist(&mut scene, more)?;
    let model = Arc::new(Model::compile(&scene)?);
    let settings = Settings { time_step_s: 0.001, ..Settings::new(&model) };
    let (n, width) = (model.dimensions().coordinates(), model.dimensions().input());
    if is_rough && width == 0 {
        return Ok(());
    }
    let mut start = Vec::new();
    for k in 0..PLANTS {
        let mut plant = Plant::new(Arc::clone(&model), settings)?;
        let wave = |i: usize, rate: f64| (rate * i as f64 + 0.37 * k as f64).sin();
        let q = plant.q().iter().enumerate().map(|(i, q)| q + 0.3 * wave(i, 1.3)).collect();
        let v = (0..n).map(|i| wave(i, 2.1)).collect();
        plant.initialize(&Initial::Velocity { q, v })?;
        start.push(plant);
    }
    let inputs: Vec<f64> = (0..STEPS * PLANTS * width)
        .map(|i| if is_rough { (1.7 * i as f64).sin() } else { 0.0 })
        .collect();
    let [mut alone_us, mut side_us] = [f64::INFINITY; 2];
    let (mut iterations, mut factorizations) = (0, 0);
    for _ in 0..PASSES {
        // One after the other as is best for them: each through all steps, its memory in the nearest cache.
        let mut plants = start.clone();
        let begin = cpu_time_s();
        for (k, plant) in plants.iter_mut().enumerate() {
            for step in 0..STEPS {
                plant.step(&inputs[(step * PLANTS + k) * width..][..width])?;
            }
        }
        alone_us = alone_us.min(cpu_time_s() - begin);
        let mut fleet = Fleet::new(start.clone());
        let begin = cpu_time_s();
        for step in 0..STEPS {
            let results = fleet.step(&inputs[step * PLANTS * width..][..PLANTS * width]);
            for result in results {
                let report = result.as_ref().map_err(Clone::clone)?;
                iterations += report.iterations;
                factorizations += report.factorizations;
            }
        }
        side_us = side_us.min(cpu_time_s() - begin);
        for (k, (plant, other)) in plants.iter().zip(fleet.into_plants()).enumerate() {
            assert!(plant.snapshot() == other.snapshot(), "{name}: plant {k} has other bits");
        }
    }
    let steps = (PLANTS * STEPS) as f64;
    println!(
        "{name:<20} {:<6} {:>10.3} {:>10.3} {:>6.2} {:>6.2} {:>6.2}",
        if is_rough { "rough" } else { "quiet" },
        alone_us * 1e6 / steps,
        side_us * 1e6 / steps,
        alone_us / side_us,
        f64::from(iterations) / steps / PASSES as f64,
        f64::from(factorizations) / steps / PASSES as f64,
    );
    Ok(())
}

/// Gives all joints that an input drives a spring, or dry friction.
fn resist(scene: &mut Scene, by: &str) -> Result<(), Box<dyn Error>> {
    let driven: Vec<String> = scene.inputs.iter().filter_map(|i| i.coordinate.clone()).collect();
    for coordinate in driven {
        match by {
            "" => {}
            "springs" => {
                scene.springs.push(Spring::Coordinate { coordinate, stiffness: 3.0, rest: 0.1 });
            }
            "friction" => scene.forces.push(Force::Friction {
                coordinate: Some(coordinate),
                terms: Vec::new(),
                points: Vec::new(),
                force: 0.1,
                velocity: 0.05,
            }),
            _ => return Err("springs or friction".into()),
        }
    }
    Ok(())
}

/// CPU time of this thread: other programs on the machine do not count.
fn cpu_time_s() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

/// An arm of seven hinges, or a humanoid of thirty on a fixed pelvis, with a motor at each.
fn robot(name: &str) -> Option<Scene> {
    let mut scene = Scene {
        format: 1,
        name: name.to_owned(),
        time_step_s: 0.001,
        gravity: Some([0.0, 0.0, -9.81]),
        ..Scene::default()
    };
    let mut limb = |parent: &str, at: [f64; 3], axes: &str, mass: f64| {
        let mut parent = parent.to_owned();
        for (k, axis) in axes.chars().enumerate() {
            let axis = ['x', 'y', 'z'].map(|other| f64::from(u8::from(axis == other)));
            let coordinate = format!("b{}", scene.frames.len());
            let inertia = [0.012, 0.010, 0.006].map(|inertia| inertia * mass).to_vec();
            let center_of_mass = [0.01, 0.005, -0.1];
            scene.frames.push(Frame {
                name: coordinate.clone(),
                parent,
                translation: if k == 0 { at } else { [0.0, 0.0, -0.2] },
                joint: Some(Joint::Revolute { axis, coordinate: None }),
                body: Some(Body { mass, center_of_mass, inertia, ..Body::default() }),
                ..Frame::default()
            });
            let name = format!("torque-{coordinate}");
            parent = coordinate.clone();
            let coordinate = Some(coordinate);
            scene.inputs.push(Input { name, coordinate, ..Input::default() });
        }
        parent
    };
    match name {
        "arm-7" => {
            limb("world", [0.0; 3], "zyzyzyz", 2.0);
        }
        "humanoid-30" => {
            let torso = limb("world", [0.0, 0.0, 0.1], "zx", 5.0);
            for side in [-1.0, 1.0] {
                limb("world", [0.0, 0.1 * side, -0.1], "yxzyyx", 1.5);
                limb(&torso, [0.0, 0.2 * side, 0.3], "yxzyxyz", 0.8);
            }
            limb(&torso, [0.0, 0.0, 0.4], "zy", 1.0);
        }
        _ => return None,
    }
    Some(scene)
}
