//! A restored plant goes on bit for bit, whatever it and the one it was taken from did before: random
//! mechanisms of every kind, with every way to step.

use std::sync::Arc;

use crate::common::random_scene::{self, Kind};
use crate::common::{MOVED_BALL, PUSHES, builtin, methods, pulled_rope};
use plantd_models::{Initial, Linearization, Model, Plant, Precision, Scene, Settings, Snapshot};
use plantd_scene::{Coordinate, CoordinateKind, Force};

/// Steps after a snapshot.
const STEPS: u32 = 20;

/// Numbers of a step: where it ends, what it reports, and its linearization.
type Bits = (Vec<u8>, String, Vec<u64>);

/// An input that waves, slow enough for what is prescribed.
fn input(plant: &Plant) -> Vec<f64> {
    let (model, d) = (plant.model(), plant.model().dimensions());
    let phase = |i: usize| (0.1 * plant.step_index() as f64 + i as f64).sin();
    let change: Vec<f64> =
        (0..d.coordinates()).map(|i| if i < d.dynamic { 0.0 } else { 0.002 * phase(i) }).collect();
    let next = model.retract(plant.q(), &change);
    (0..d.inputs).map(|i| 0.5 * phase(i)).chain(next[d.dynamic..].iter().copied()).collect()
}

/// Takes a step in a way that depends on its number; `None` where there is no step.
fn go_on(plant: &mut Plant, out: &mut Linearization) -> Option<Bits> {
    let u = input(plant);
    let (report, is_linearized) = match plant.step_index() % 5 {
        3 => (plant.step_and_linearize(&u, out).ok()?, true),
        4 => {
            plant.linearize(&u, out).ok()?;
            (plant.step(&u).ok()?, true)
        }
        _ => (plant.step(&u).ok()?, false),
    };
    let mut numbers = Vec::new();
    if is_linearized {
        numbers.extend(out.a().iter().chain(out.b().iter()).map(|x| x.to_bits()));
    }
    Some((plant.snapshot().to_bytes(), format!("{report:?}"), numbers))
}

/// Restores a snapshot into a plant that has done something else; false where the motion ends early.
fn restored_goes_on(plant: &mut Plant, what: &str) -> bool {
    let mut out = Linearization::new(plant.model());
    let mut other = plant.clone();
    for k in 0..12 {
        if go_on(plant, &mut out).is_none() {
            return false;
        }
        if k % 4 == 1 {
            // What only looks leaves no trace.
            plant.energy();
            plant.diagnose();
        }
        if k % 4 != 1 {
            continue;
        }
        let bytes = plant.snapshot().to_bytes();
        other.restore(&Snapshot::from_bytes(&bytes).unwrap()).unwrap();
        let mut first = plant.clone();
        let mut other_out = Linearization::new(plant.model());
        for j in 0..STEPS {
            let [a, b] = [go_on(&mut first, &mut out), go_on(&mut other, &mut other_out)];
            assert!(a == b, "{what}: another step {j} after snapshot {k}");
            if a.is_none() {
                return k > 1;
            }
        }
    }
    true
}

/// The scene at rest, or moving at random where it can.
fn starts(scene: &Scene, settings: Settings) -> Option<Plant> {
    let model = Arc::new(Model::compile(scene).ok()?);
    let mut plant = Plant::new(model, settings).ok()?;
    let d = plant.model().dimensions();
    let velocity = |i: usize| if i < d.dynamic { (1.0 + 7.0 * i as f64).sin() } else { 0.0 };
    let v = (0..d.coordinates()).map(velocity).collect();
    let start = Initial::Velocity { q: plant.q().to_vec(), v };
    plant.initialize(&start).ok()?;
    Some(plant)
}

#[test]
fn random_mechanisms_go_on_bit_for_bit() {
    let mut counted = 0;
    for seed in 0..48 {
        let text = random_scene::scene(seed, [Kind::Any, Kind::Conservative][seed as usize % 2]);
        let scene = Scene::from_toml(&text).unwrap();
        let Ok(model) = Model::compile(&scene) else { continue };
        let usual = Settings::new(&model);
        for (w, (order, substeps)) in [(2, 1), (2, 3), (4, 1), (8, 1)].into_iter().enumerate() {
            // Not all of them at each mechanism: it is theirs together that counts.
            if order > 2 && !(seed + w as u64).is_multiple_of(4) {
                continue;
            }
            for precision in [Precision::Exact, Precision::Fast, Precision::Coarse] {
                let time_step_s = [1e-3, 5e-3][seed as usize / 2 % 2];
                let settings = Settings { order, substeps, precision, time_step_s, ..usual };
                if let Some(mut plant) = starts(&scene, settings) {
                    let what = format!("seed {seed}, {settings:?}");
                    counted += u32::from(restored_goes_on(&mut plant, &what));
                }
            }
        }
    }
    assert!(counted >= 100, "{counted}");
}

#[test]
fn built_in_scenes_go_on_bit_for_bit() {
    for name in ["cart-pole", "chain-4", "four-bar", "scissor-4", "marionette"] {
        let scene = builtin(name);
        for settings in methods(&scene) {
            if name == "marionette" && (settings.order, settings.substeps) != (2, 1) {
                continue;
            }
            for precision in [Precision::Exact, Precision::Fast, Precision::Coarse] {
                for time_step_s in [settings.time_step_s, 0.1 * settings.time_step_s] {
                    let settings = Settings { precision, time_step_s, ..settings };
                    let mut plant = starts(&scene, settings).unwrap();
                    let _ = restored_goes_on(&mut plant, &format!("{name}, {settings:?}"));
                }
            }
        }
    }
}

/// Chains that go by generators in space: moved at the support and on the way, and with friction at each joint.
#[test]
fn chains_that_are_moved_go_on_bit_for_bit() {
    for with_friction in [false, true] {
        let mut scene = builtin("chain-20");
        for link in ["link0", "link7"] {
            scene.coordinates.retain(|coordinate| coordinate.name != link);
            scene.coordinates.push(Coordinate {
                name: link.to_owned(),
                kind: CoordinateKind::Prescribed,
                ..Coordinate::default()
            });
        }
        scene.inputs[0].coordinate = Some("link3".to_owned());
        for i in (1..20).filter(|i| with_friction && *i != 7) {
            scene.forces.push(Force::Friction {
                coordinate: Some(format!("link{i}")),
                terms: Vec::new(),
                points: Vec::new(),
                force: 0.05,
                velocity: 0.1,
            });
        }
        let model = Model::compile(&scene).unwrap();
        assert!(model.plan().contains("by generators, 20 joints"), "{}", model.plan());
        for precision in [Precision::Exact, Precision::Fast, Precision::Coarse] {
            let settings = Settings { precision, ..Settings::new(&model) };
            let mut plant = starts(&scene, settings).unwrap();
            assert!(restored_goes_on(&mut plant, &format!("{settings:?}")));
        }
    }
}

/// The same with what acts on bodies from the world.
#[test]
fn ropes_that_are_pulled_go_on_bit_for_bit() {
    for scene in ["", PUSHES, MOVED_BALL].map(pulled_rope) {
        let settings = Settings::new(&Model::compile(&scene).unwrap());
        let mut plant = starts(&scene, settings).unwrap();
        assert!(restored_goes_on(&mut plant, "pulled rope"));
    }
}
