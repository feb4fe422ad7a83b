//! Fleets move each of their plants as it moves by itself, to the last bit.

use std::path::Path;
use std::sync::Arc;

use crate::common::{Numbers, builtin, methods, model, random_tree};
use plantd_math::simd::narrowly;
use plantd_models::{
    Fleet, ForceSplit, Initial, Model, Plant, Precision, Scene, Settings, StepError,
};

/// Of each class that has a way side by side, and of each that has none.
const SCENES: [(&str, bool); 14] = [
    ("pendulum", true),
    ("damped-pendulum", true),
    ("double-pendulum", true),
    ("cart-pole", true),
    ("spherical-pendulum", true),
    ("tree-7", true),
    ("tree-15", true),
    ("chain-4", true),
    ("chain-8", true),
    ("chain-17", true),
    ("four-bar", false),
    ("marionette", false),
    ("balls-3", false),
    ("scissor-2", false),
];

/// Plants of one model, each in its own motion where it can move freely.
fn plants(model: &Arc<Model>, settings: Settings, count: usize, speed: f64) -> Vec<Plant> {
    let mut random = Numbers::new(count as u64);
    let d = model.dimensions();
    let make = |_| {
        let mut plant = Plant::new(Arc::clone(model), settings).unwrap();
        if d.constraints == 0 {
            let mut around = |size: f64, free: usize| -> Vec<f64> {
                let number = |i| if i < free { random.between(-size, size) } else { 0.0 };
                (0..d.coordinates()).map(number).collect()
            };
            let q = model.retract(plant.q(), &around(0.5, d.dynamic));
            let v = around(speed, d.dynamic);
            plant.initialize(&Initial::Velocity { q, v }).unwrap();
        }
        plant
    };
    (0..count).map(make).collect()
}

/// Inputs of all plants: none at first, then ones that jump, then those that hold; prescribed coordinates creep.
fn inputs(plants: &[Plant], step: usize, size: f64, random: &mut Numbers, u: &mut [f64]) {
    let d = plants[0].model().dimensions();
    for (plant, u) in plants.iter().zip(u.chunks_exact_mut(d.input().max(1))) {
        for (i, u) in u.iter_mut().enumerate() {
            match step / 25 % 3 {
                _ if i >= d.inputs => *u = plant.q()[d.dynamic + i - d.inputs] + 1e-4,
                0 => *u = 0.0,
                1 => *u = random.between(-size, size),
                _ => {}
            }
        }
    }
}

/// Steps a fleet beside its plants by themselves, and compares results and states.
fn compare(model: &Arc<Model>, settings: Settings, count: usize, speed: f64, what: &str) -> Fleet {
    let mut alone = plants(model, settings, count, speed);
    let mut fleet = Fleet::new(alone.clone());
    let mut u = vec![0.0; count * model.dimensions().input()];
    let mut random = Numbers::new(7);
    for step in 0..90 {
        inputs(&alone, step, 2.0, &mut random, &mut u);
        let width = model.dimensions().input();
        let results = fleet.step(&u).to_vec();
        for (k, plant) in alone.iter_mut().enumerate() {
            let result = plant.step(&u[k * width..][..width]);
            assert_eq!(results[k], result, "{what}: plant {k} of {count}, step {step}");
            let (mut q, mut p) = (plant.q().to_vec(), plant.p().to_vec());
            fleet.write_state(k, &mut q, &mut p);
            assert!(q == plant.q() && p == plant.p(), "{what}: plant {k} of {count}, step {step}");
        }
        if step % 30 == 17 {
            for (k, plant) in alone.iter().enumerate() {
                let bytes = fleet.plant(k).snapshot().to_bytes();
                assert!(bytes == plant.snapshot().to_bytes(), "{what}: plant {k}, step {step}");
            }
        }
    }
    fleet
}

fn usual(model: &Model) -> Settings {
    Settings { time_step_s: 0.002, ..Settings::new(model) }
}

#[test]
fn plants_move_as_they_do_by_themselves() {
    for (name, is_side_by_side) in SCENES {
        let model = model(&builtin(name));
        for count in [1, 2, 3, 4, 5, 8, 11, 13] {
            let fleet = compare(&model, usual(&model), count, 1.0, name);
            assert_eq!(fleet.is_side_by_side(), is_side_by_side && count > 1, "{name}");
            assert_eq!(fleet.len(), count);
        }
    }
}

/// Linear springs and dry friction of joints go side by side, in space and in planes, few joints and many; what branches
/// does not.
#[test]
fn and_so_do_those_with_springs_and_friction() {
    for name in ["pendulum", "double-pendulum", "chain-8", "tree-15", "spherical-pendulum"] {
        let scene = builtin(name);
        let names: Vec<String> = {
            let model = model(&scene);
            model.coordinates().iter().map(|coordinate| coordinate.name.clone()).collect()
        };
        let each = |more: &dyn Fn(&str) -> String| names.iter().map(|name| more(name)).collect();
        let springs: String = each(&|name| {
            format!(
                "[[springs]]\ntype = \"coordinate\"\ncoordinate = \"{name}\"\nstiffness = 2.5\nrest = 0.2\n"
            )
        });
        let friction: String = each(&|name| {
            format!(
                "[[forces]]\ntype = \"friction\"\ncoordinate = \"{name}\"\nforce = 0.3\nvelocity = 0.2\n"
            )
        });
        let drag: String = each(&|name| {
            format!(
                "[[forces]]\ntype = \"coordinate_drag\"\ncoordinate = \"{name}\"\ncoefficient = 0.1\n"
            )
        });
        for (more, is_side_by_side) in [
            (springs.clone(), true),
            (friction.clone(), true),
            (springs + &friction, true),
            (drag, false),
        ] {
            let model = model(&Scene::from_toml(&(scene.to_toml() + &more)).unwrap());
            for count in [5, 9] {
                let fleet = compare(&model, usual(&model), count, 1.0, name);
                assert_eq!(fleet.is_side_by_side(), is_side_by_side, "{name}{more}");
            }
        }
    }
}

#[test]
fn and_so_do_those_with_each_element() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenes/elements");
    let mut side_by_side = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let model = model(&Scene::from_toml(&std::fs::read_to_string(&path).unwrap()).unwrap());
        let fleet = compare(&model, usual(&model), 5, 0.3, &path.display().to_string());
        side_by_side += usize::from(fleet.is_side_by_side());
    }
    assert!(side_by_side >= 5, "{side_by_side}");
}

#[test]
fn and_so_do_those_of_random_trees() {
    let mut side_by_side = 0;
    for seed in 0..60 {
        let scene = random_tree(seed);
        let bare = Scene { springs: Vec::new(), forces: Vec::new(), ..scene.clone() };
        for (scene, count) in [(&scene, 5), (&bare, 9)] {
            let Ok(model) = Model::compile(scene) else { continue };
            let model = Arc::new(model);
            let fleet = compare(&model, usual(&model), count, 1.0, &scene.name);
            side_by_side += usize::from(fleet.is_side_by_side());
        }
    }
    assert!(side_by_side > 10, "{side_by_side}");
}

#[test]
fn in_every_way_to_step() {
    for name in ["pendulum", "tree-7", "chain-8"] {
        let scene = builtin(name);
        let model = model(&scene);
        for settings in methods(&scene) {
            let settings = Settings { time_step_s: 0.002, ..settings };
            compare(&model, settings, 5, 1.0, name);
        }
        for precision in [Precision::Exact, Precision::Fast, Precision::Coarse] {
            for force_split in [ForceSplit::Symmetric, ForceSplit::Paper] {
                let settings = Settings { precision, force_split, ..usual(&model) };
                compare(&model, settings, 9, 1.0, name);
            }
        }
    }
}

#[test]
fn in_registers_of_any_width() {
    for name in ["double-pendulum", "chain-8", "tree-7"] {
        let model = model(&builtin(name));
        let mut wide = compare(&model, usual(&model), 11, 1.0, name);
        let mut narrow = narrowly(|| compare(&model, usual(&model), 11, 1.0, name));
        for k in 0..wide.len() {
            assert_eq!(wide.plant(k).state(), narrow.plant(k).state(), "{name}");
        }
    }
}

/// Motions so fast that some periods have to be halved, or fail: those beside them go on.
#[test]
fn plants_that_stumble_do_so_alone() {
    let [mut halved, mut failed, mut taken] = [0; 3];
    for name in ["pendulum", "double-pendulum", "chain-5", "tree-7", "spherical-pendulum"] {
        let model = model(&builtin(name));
        for halvings in [0, 3] {
            let settings = Settings { time_step_s: 0.03, halvings, ..Settings::new(&model) };
            let mut alone = plants(&model, settings, 11, 25.0);
            let mut fleet = Fleet::new(alone.clone());
            let width = model.dimensions().input();
            let mut random = Numbers::new(3);
            let mut u = vec![0.0; 11 * width];
            for step in 0..60 {
                u.iter_mut().for_each(|u| *u = random.between(-20.0, 20.0));
                for (step_of, value) in [(20, f64::NAN), (30, 1e200), (40, f64::INFINITY)] {
                    if step == step_of && width > 0 {
                        u[4 * width] = value;
                    }
                }
                let results = fleet.step(&u).to_vec();
                for (k, plant) in alone.iter_mut().enumerate() {
                    let before = plant.state();
                    let result = plant.step(&u[k * width..][..width]);
                    // As text: a NaN is not equal to itself.
                    let texts = [&results[k], &result].map(|result| format!("{result:?}"));
                    assert_eq!(texts[0], texts[1], "{name}: plant {k}, step {step}");
                    match result {
                        Ok(report) => {
                            halved += usize::from(report.halvings > 0);
                            taken += 1;
                        }
                        Err(StepError::Dimension { .. }) => unreachable!("{name}"),
                        Err(_) => {
                            failed += 1;
                            assert_eq!(fleet.plant(k).state(), before, "{name}: it stays");
                        }
                    }
                    let (bytes, other) = (plant.snapshot(), fleet.plant(k).snapshot());
                    assert!(bytes == other, "{name}: plant {k}, step {step}");
                }
            }
        }
    }
    assert!(halved > 20 && failed > 20 && taken > 1000, "{halved} {failed} {taken}");
}

/// Plants may rest, be moved elsewhere, and go on.
#[test]
fn plants_rest_and_are_changed() {
    for name in ["pendulum", "tree-7", "chain-8", "four-bar"] {
        let model = model(&builtin(name));
        let mut alone = plants(&model, usual(&model), 10, 1.0);
        let elsewhere = plants(&model, usual(&model), 3, 2.0);
        let mut fleet = Fleet::new(alone.clone());
        let width = model.dimensions().input();
        let mut random = Numbers::new(11);
        let mut rests = [false; 10];
        for step in 0..80 {
            for (k, rests) in rests.iter_mut().enumerate() {
                *rests = if step < 40 { (step / 7 + k) % 3 == 0 } else { k < step / 8 };
                fleet.rest(k, *rests);
            }
            if step % 9 == 5 {
                let k = step % 10;
                let snapshot = elsewhere[step % 3].snapshot();
                alone[k].restore(&snapshot).unwrap();
                fleet.plant_mut(k).restore(&snapshot).unwrap();
            }
            let mut u = vec![0.0; 10 * width];
            inputs(&alone, 25 + step % 25, 1.0, &mut random, &mut u);
            fleet.step(&u);
            for (k, plant) in alone.iter_mut().enumerate() {
                if !rests[k] {
                    plant.step(&u[k * width..][..width]).unwrap();
                }
                let same = plant.snapshot() == fleet.plant(k).snapshot();
                assert!(same, "{name}: plant {k}, step {step}");
            }
        }
        for (plant, other) in alone.iter().zip(fleet.into_plants()) {
            assert!(plant.snapshot() == other.snapshot(), "{name}");
        }
    }
}
