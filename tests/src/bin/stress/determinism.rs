//! The same inputs give the same bits.

use anyhow::{Result, anyhow};
use plantd_models::{Linearization, Plant, Scene, Snapshot};

use crate::case::{Case, Setup};
use crate::numbers::Numbers;
use crate::plants::{self, Method};
use crate::random_scene::{self, Kind};

pub(crate) fn cases() -> Vec<Case> {
    let criterion = "bytes of snapshots are equal over two runs, over 4 threads at once, over restores from \
                     bytes into new plants, and with linearizations on the way";
    let method = |order, substeps| Method::new(2e-3, order, substeps);
    [
        ("double-pendulum", method(2, 1)),
        // Released from horizontal, it whips too violently for longer steps.
        ("chain-32", Method::new(2e-4, 2, 1)),
        ("tree-30", method(2, 1)),
        ("four-bar", method(2, 1)),
        ("scissor-4", method(2, 1)),
        ("scissor-16", method(2, 1)),
        ("marionette", method(2, 1)),
        ("random", method(2, 1)),
        ("chain-8", method(8, 1)),
        ("tree-7", method(12, 3)),
        ("four-bar", method(6, 2)),
        ("marionette", method(4, 1)),
    ]
    .into_iter()
    .map(|(name, method)| {
        let title = format!("determinism: {name}{}", method.name());
        Case::new(title, criterion, move |setup, finding| {
            finding.method = Some((method.order, method.substeps));
            let steps = setup.pick(1_000, 10_000);
            let scenes = scenes(name, method, setup, steps);
            finding.must(!scenes.is_empty(), || "none runs".to_owned());
            finding.note(format!("{} scenes, {steps} steps", scenes.len()));
            for (scene, plain) in scenes {
                let threads: Vec<Result<Vec<u8>>> = std::thread::scope(|scope| {
                    let start = |_| scope.spawn(|| run(&scene, method, steps, Way::Plain));
                    let handles: Vec<_> = (0..4).map(start).collect();
                    let join = |handle: std::thread::ScopedJoinHandle<'_, _>| {
                        handle.join().unwrap_or_else(|_| Err(anyhow!("panicked")))
                    };
                    handles.into_iter().map(join).collect()
                });
                for end in threads {
                    finding.must(end? == plain, || "threads differ".to_owned());
                }
                for way in [Way::Restored, Way::Linearized] {
                    let end = run(&scene, method, steps, way)?;
                    finding.must(end == plain, || format!("{way:?} differs"));
                }
                if name != "random" {
                    finding.note(format!("digest {:016x}", fnv1a(&plain)));
                }
            }
            Ok(())
        })
    })
    .collect()
}

/// Scenes with the bytes at the end of a plain run.
fn scenes(name: &str, method: Method, setup: &Setup, steps: u64) -> Vec<(Scene, Vec<u8>)> {
    let named = match name {
        "random" => (0..200)
            .filter_map(|i| {
                let text = random_scene::scene(setup.seed * 1_000_000 + i, Kind::Any);
                Scene::from_toml(&text).ok()
            })
            .collect(),
        _ => vec![plants::scene(name)],
    };
    let ended = |scene: Scene| run(&scene, method, steps, Way::Plain).ok().map(|end| (scene, end));
    named.into_iter().filter_map(ended).take(setup.pick(5, 50)).collect()
}

/// What else happens on the way.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Way {
    Plain,
    /// A new plant goes on from bytes now and then.
    Restored,
    Linearized,
}

fn run(scene: &Scene, method: Method, steps: u64, way: Way) -> Result<Vec<u8>> {
    let time_step_s = scene.time_step_s.min(method.time_step_s);
    let method = Method { time_step_s, ..method };
    let mut plant = plants::plant(scene, method)?;
    let d = plant.model().dimensions();
    let mut out = Linearization::new(&plant.model().clone());
    let mut random = Numbers::new(7);
    let still = plants::hold(&plant);
    let mut u = still.clone();
    for k in 0..steps {
        for (i, u) in u.iter_mut().enumerate() {
            let size = if i < d.inputs { 0.2 } else { 1e-4 };
            *u = still[i] + random.between(-size, size);
        }
        if way == Way::Restored && k % 97 == 13 {
            let bytes = plant.snapshot().to_bytes();
            plant = plants::plant(scene, method)?;
            plant.restore(&Snapshot::from_bytes(&bytes)?)?;
        }
        match way {
            Way::Linearized if k % 5 == 2 => plant.step_and_linearize(&u, &mut out).map(drop)?,
            _ => step(&mut plant, &u)?,
        }
    }
    Ok(plant.snapshot().to_bytes())
}

fn step(plant: &mut Plant, u: &[f64]) -> Result<()> {
    plants::step(plant, u).map(drop)
}

/// FNV-1a hash.
fn fnv1a(bytes: &[u8]) -> u64 {
    let prime = 0x0100_0000_01b3;
    bytes
        .iter()
        .fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(prime))
}
