//! Signals: when they act, and on what.

use std::f64::consts::TAU;

use crate::common::{builtin, plant};
use plantd_models::scene::{CoordinateKind, Scene, Signal};
use plantd_models::{Initial, Linearization, Plant, Snapshot};

fn signal(text: &str) -> Signal {
    let scene = format!("format = 1\nname = \"s\"\nframes = []\n[[signals]]\n{text}");
    Scene::from_toml(&scene).unwrap_or_else(|e| panic!("{e}")).signals.remove(0)
}

fn with_signals(mut scene: Scene, texts: &[&str]) -> Scene {
    scene.signals.extend(texts.iter().map(|text| signal(text)));
    scene
}

const SWAY: &str = r#"
drives = "tau"
type = "sinusoid"
amplitude = 0.7
frequency_hz = 1.3
phase_rad = 0.4
offset = 0.1
"#;

fn sway(t: f64) -> f64 {
    0.1 + 0.7 * (TAU * 1.3 * t + 0.4).sin()
}

/// The cart's position prescribed by a signal.
fn driven_cart(texts: &[&str]) -> Scene {
    let mut scene = builtin("cart-pole");
    scene.inputs.clear();
    let slide = "x";
    scene.coordinates.retain(|c| c.name != slide);
    scene.operating_points.clear();
    let text = format!("name = \"{slide}\"\nkind = \"prescribed\"");
    let scene_text = format!("format = 1\nname = \"s\"\nframes = []\n[[coordinates]]\n{text}");
    scene.coordinates.extend(Scene::from_toml(&scene_text).unwrap().coordinates);
    let texts: Vec<_> = texts.iter().map(|t| format!("drives = \"{slide}\"\n{t}")).collect();
    with_signals(scene, &Vec::from_iter(texts.iter().map(String::as_str)))
}

const SHAKE: &str = "type = \"chirp\"\namplitude = 0.2\nstart_hz = 0.5\nend_hz = 2.0\nduration_s = 0.4\noffset = 0.3";

#[test]
fn a_signal_adds_to_an_input_at_the_middle_of_each_step() {
    let scene = builtin("pendulum");
    let mut driven = plant(&with_signals(scene.clone(), &[SWAY]), |_| ());
    let mut by_hand = plant(&scene, |_| ());
    let h = by_hand.settings().time_step_s;
    for k in 0..200 {
        let own = 0.3 * f64::from(k % 7);
        let effective = own + sway((f64::from(k) + 0.5) * h);
        assert!((driven.effective_input(&[own])[0] - effective).abs() < 1e-13);
        driven.step(&[own]).unwrap();
        by_hand.step(&[effective]).unwrap();
        for (x, y) in driven.state().x().iter().zip(by_hand.state().x()) {
            assert!((x - y).abs() < 1e-11, "step {k}: {x} and {y}");
        }
    }
}

#[test]
fn a_signal_replaces_a_prescribed_position_at_the_end_of_each_step() {
    let mut driven = plant(&driven_cart(&[SHAKE]), |_| ());
    let mut scene = driven_cart(&[]);
    let coordinate =
        scene.coordinates.iter_mut().find(|c| c.kind == CoordinateKind::Prescribed).unwrap();
    coordinate.initial = 0.3;
    let mut by_hand = plant(&scene, |_| ());
    assert_eq!(driven.state(), by_hand.state(), "it starts where the signal starts");
    for k in 0..100 {
        let u = driven.effective_input(&[f64::from(k)]);
        let mut held = [0.0];
        driven.hold_input(&mut held);
        assert_eq!(held[..], u[..]);
        driven.step(&[f64::from(k)]).unwrap();
        by_hand.step(&u).unwrap();
        assert_eq!(driven.state(), by_hand.state());
        // 0.5 Hz + 3.75 Hz/s t until 0.4 s, then 2 Hz.
        let t = driven.time_s();
        let phase =
            if t < 0.4 { TAU * (0.5 + 1.875 * t) * t } else { TAU * (0.5 + 2.0 * (t - 0.4)) };
        assert!((driven.q()[1] - (0.3 + 0.2 * phase.sin())).abs() < 1e-12, "{t}");
    }
}

/// As a step does: what a signal replaces has no effect.
#[test]
fn the_linearization_is_that_of_the_effective_input() {
    let mut driven = plant(&driven_cart(&[SHAKE]), |_| ());
    let mut by_hand = plant(&driven_cart(&[]), |_| ());
    for _ in 0..20 {
        driven.step(&[0.0]).unwrap();
    }
    let x = driven.state();
    let initial = Initial::Momentum { q: x.q.clone(), p: x.p.clone(), v: x.v.clone() };
    by_hand.initialize(&initial).unwrap();
    let mut expected = Linearization::new(&by_hand.model().clone());
    by_hand.linearize(&driven.effective_input(&[0.0]), &mut expected).unwrap();
    let mut out = Linearization::new(&driven.model().clone());
    driven.linearize(&[123.0], &mut out).unwrap();
    assert!((out.a() - expected.a()).amax() < 1e-12);
    assert!(expected.b().amax() > 1.0 && out.b().amax() == 0.0);
}

/// Time follows the step index, which snapshots carry.
#[test]
fn signals_continue_bit_for_bit_after_a_snapshot() {
    let scene = with_signals(builtin("pendulum"), &[SWAY, SWAY]);
    let step = |plant: &mut Plant| plant.step(&[0.1]).unwrap();
    let mut first = plant(&scene, |_| ());
    for _ in 0..37 {
        step(&mut first);
    }
    let bytes = first.snapshot().to_bytes();
    let mut second = plant(&scene, |_| ());
    second.restore(&Snapshot::from_bytes(&bytes).unwrap()).unwrap();
    for _ in 0..50 {
        step(&mut first);
        step(&mut second);
        assert_eq!(first.snapshot().to_bytes(), second.snapshot().to_bytes());
    }
    second.initialize(&Initial::Scene).unwrap();
    second.set_step_index(first.step_index());
    assert_eq!(first.effective_input(&[0.0]), second.effective_input(&[0.0]));
    first.initialize(&Initial::Scene).unwrap();
    assert_eq!(first.effective_input(&[0.0]), plant(&scene, |_| ()).effective_input(&[0.0]));
}

/// Numbers that leave the finite range are the input's fault, and named.
#[test]
fn an_effective_input_that_is_not_finite_is_refused() {
    let huge = "drives = \"tau\"\ntype = \"constant\"\nvalue = 1.7e308";
    let mut plant = plant(&with_signals(builtin("pendulum"), &[huge]), |_| ());
    let before = plant.state();
    let error = plant.step(&[1.7e308]).unwrap_err();
    assert!(error.to_string().contains("tau"), "{error}");
    assert_eq!(plant.state(), before);
}
