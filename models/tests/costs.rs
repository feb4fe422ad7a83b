//! What a step is said to do, against what it does.

use std::sync::Arc;

use crate::common::builtin;
use plantd_models::{Model, Plant, Settings};

/// How often stages are done on motions that go on by themselves, to a factor of two: motions differ.
#[test]
fn stages_are_done_as_often_as_estimated() {
    let names = [
        "pendulum",
        "double-pendulum",
        "chain-8",
        "chain-32",
        "four-bar",
        "scissor-8",
        "marionette",
        "tree-30",
        "spherical-pendulum",
        "walker-4",
        "balls-7",
    ];
    for name in names {
        let model = Arc::new(Model::compile(&builtin(name)).unwrap());
        let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
        let (mut evaluations, mut factorizations, steps) = (0, 0, 50);
        let mut u = vec![0.0; model.dimensions().input()];
        for _ in 0..steps {
            plant.hold_input(&mut u);
            let report = plant.step(&u).unwrap();
            evaluations += report.iterations;
            factorizations += report.factorizations;
        }
        let costs = model.stage_costs();
        for (stage, count) in [("evaluation", evaluations), ("factorization", factorizations)] {
            let said = costs.iter().find(|cost| cost.name == stage).unwrap().times;
            let done = f64::from(count) / f64::from(steps);
            // Motions differ.
            assert!((0.5..2.0).contains(&(said / done)), "{name}: {stage} {said}, {done}");
        }
    }
}
