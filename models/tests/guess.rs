//! Scenes whose initial configuration is only a guess.

use std::sync::Arc;

use crate::common::builtin;
use plantd_models::{Initial, InitialError, Model, Plant, Settings, SettleRequest, Spare};

/// The four-bar with a coupler that does not meet the rocker.
fn model() -> Arc<Model> {
    let mut scene = builtin("four-bar");
    let coupler = scene.coordinates.iter_mut().find(|c| c.name == "coupler").unwrap();
    coupler.initial = 0.0;
    crate::common::model(&scene)
}

fn initial(model: &Model) -> Vec<f64> {
    model.coordinates().iter().map(|c| c.initial).collect()
}

#[test]
fn the_model_says_by_how_much_each_equation_is_violated() {
    let model = model();
    let q = initial(&model);
    let (crank, coupler, rocker) = (q[0], q[0] + q[1], q[2]);
    // Hinges about y turn (0, 0, −l) to (−l sin, 0, −l cos); the rocker's is 1 m away.
    let x = -0.5 * crank.sin() - 1.2 * coupler.sin() - (1.0 - rocker.sin());
    let z = -0.5 * crank.cos() - 1.2 * coupler.cos() + rocker.cos();
    let found = model.initial_violations();
    assert_eq!(found.len(), 2);
    for (violation, (name, expected)) in found.iter().zip([("pin.x", x), ("pin.z", z)]) {
        assert_eq!(violation.constraint, name);
        assert!((violation.value - expected).abs() < 1e-12, "{violation:?}, {expected}");
    }
    assert_eq!(crate::common::model(&builtin("four-bar")).initial_violations(), []);
}

#[test]
fn only_what_starts_at_the_guess_is_refused() {
    let model = model();
    let settings = Settings::new(&model);
    let start = |initial| Plant::at(Arc::clone(&model), settings, &initial);
    for initial in [Initial::Scene, Initial::OperatingPoint("initial".to_owned())] {
        let error = start(initial).unwrap_err();
        assert!(
            matches!(&error, InitialError::SceneIsGuess { constraint, violation }
                if constraint == "pin.x" && *violation == model.initial_violations()[0].value),
            "{error}"
        );
    }
    let hold = vec!["crank".to_owned()];
    let mut plant = start(Initial::Projection { q: initial(&model), hold }).unwrap();
    assert_eq!(plant.q()[0], -1.2);
    let (q, p) = (plant.q().to_vec(), plant.p().to_vec());
    let explicit = start(Initial::Momentum { q: q.clone(), p, v: vec![] }).unwrap();
    assert_eq!(explicit.snapshot(), plant.snapshot());
    let restored = Spare::new(Arc::clone(&model), settings).unwrap().restore(&plant.snapshot());
    assert_eq!(restored.unwrap().snapshot(), plant.snapshot());
    start(Initial::OperatingPoint("rest".to_owned())).unwrap().step(&[0.0]).unwrap();
    // What is on the constraints is refused as what it is.
    let off = Initial::Momentum { q: initial(&model), p: vec![0.0; 3], v: vec![] };
    assert!(matches!(start(off), Err(InitialError::OffConstraint { .. })));
    let before = plant.snapshot();
    assert!(plant.initialize(&Initial::Scene).is_err());
    assert_eq!(plant.snapshot(), before);

    // The mechanism is the same as that of the scene that starts on its constraints.
    let mut usual = Plant::at(
        crate::common::model(&builtin("four-bar")),
        settings,
        &Initial::Projection { q, hold: vec![] },
    )
    .unwrap();
    for _ in 0..50 {
        let reports = [plant.step(&[1.0]).unwrap(), usual.step(&[1.0]).unwrap()];
        assert_eq!(reports[0].redundant_constraints, 0);
        for (a, b) in plant.q().iter().zip(usual.q()) {
            assert!((a - b).abs() < 1e-11, "{a} {b}");
        }
    }
    let request = SettleRequest { q: initial(&model), ..SettleRequest::default() };
    assert!(model.settle(&request).unwrap().stable);
}

/// Three equal cranks that carry one bar: on its constraints one of the equations says nothing new, off them
/// all of them do.
#[test]
fn redundant_equations_are_found_from_a_guess() {
    let crank = |x: f64| {
        format!(
            "[[frames]]\nname = \"crank{x}\"\ntranslation = [{x}, 0.0, 0.0]\njoint = {{ type = \"revolute\", axis = [0.0, 1.0, 0.0] }}\nbody = {{ mass = 1.0, center_of_mass = [0.0, 0.0, -0.5], inertia = [0.1, 0.1, 0.0] }}\n"
        )
    };
    let pin = |x: f64| {
        format!(
            "[[constraints]]\ntype = \"point_to_point\"\nname = \"pin{x}\"\na = {{ frame = \"bar\", at = [{x}, 0.0, 0.0] }}\nb = {{ frame = \"crank{x}\", at = [0.0, 0.0, -1.0] }}\naxes = [\"x\", \"z\"]\n"
        )
    };
    let bar = "[[frames]]\nname = \"bar\"\nparent = \"crank0\"\ntranslation = [0.0, 0.0, -1.0]\njoint = { type = \"revolute\", axis = [0.0, 1.0, 0.0] }\nbody = { mass = 1.0, center_of_mass = [0.5, 0.0, 0.0], inertia = [0.0, 0.1, 0.1] }\n";
    let initial = |crank2: f64| {
        format!(
            "[[coordinates]]\nname = \"crank0\"\ninitial = 0.4\n[[coordinates]]\nname = \"bar\"\ninitial = -0.4\n[[coordinates]]\nname = \"crank1\"\ninitial = 0.4\n[[coordinates]]\nname = \"crank2\"\ninitial = {crank2}\n"
        )
    };
    let plant = |crank2: f64| {
        let head = "format = 1\nname = \"cranks\"\ngravity = [0.0, 0.0, -9.8]\n";
        let parts = [crank(0.0), bar.to_owned(), crank(1.0), crank(2.0), pin(1.0), pin(2.0)];
        let text = format!("{head}{}{}", parts.concat(), initial(crank2));
        let model = crate::common::model(&plantd_models::Scene::from_toml(&text).unwrap());
        let settings = Settings::new(&model);
        let q = model.coordinates().iter().map(|c| c.initial).collect();
        Plant::at(model, settings, &Initial::Projection { q, hold: vec![] }).unwrap()
    };
    for crank2 in [0.4, 0.6] {
        let mut plant = plant(crank2);
        assert_eq!(plant.model().initial_violations().is_empty(), crank2 == 0.4);
        for _ in 0..20 {
            let report = plant.step(&[]).unwrap_or_else(|e| panic!("{crank2}: {e}"));
            assert_eq!(report.redundant_constraints, 1);
        }
    }
}
