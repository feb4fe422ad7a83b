//! The linearization against sixth-order central differences of the step itself.

use crate::common::linearization::{check, check_with, check_within};
use plantd_models::Model;

use crate::common::{
    ACROSS, BRAKES, MOVED_BALL, PUSHES, braced_rope, builtin, floating, methods, pulled_rope,
    random_tree,
};

#[test]
fn unconstrained_builtin_scenes() {
    for name in ["pendulum", "damped-pendulum", "double-pendulum", "cart-pole", "chain-8"] {
        check(&builtin(name));
    }
    check(&builtin("spherical-pendulum"));
}

#[test]
fn closed_loops() {
    check(&builtin("four-bar"));
    check(&builtin("scissor-3"));
}

#[test]
fn marionette_with_driven_strings() {
    check(&builtin("marionette"));
}

#[test]
fn floating_body_with_a_spring_across_its_arms() {
    check(&floating());
}

/// Oblique joints, full inertia tensors, springs across branches, prescribed joints inside.
#[test]
fn random_trees() {
    for seed in 0..24 {
        check(&random_tree(seed));
    }
}

/// What acts from the world on bodies of a long chain and across its joints, with equal halves of forces and with those
/// of the paper.
#[test]
fn ropes_that_are_pulled_from_the_world() {
    for more in ["", PUSHES, MOVED_BALL, ACROSS] {
        let scene = pulled_rope(more);
        let plan = Model::compile(&scene).unwrap().plan();
        assert!(plan.contains("by generators, with what acts at poses"), "{plan}");
        check_within(&scene, 0.3);
    }
    check_with(&pulled_rope(PUSHES), |s| s.order = 4);
}

/// What acts across several joints of a long chain; with dampers it is stepped entry by entry, and only products go by
/// generators.
#[test]
fn ropes_that_are_braced() {
    for (more, is_generated) in [("", true), (MOVED_BALL, true), (BRAKES, false)] {
        let scene = braced_rope(more);
        let plan = Model::compile(&scene).unwrap().plan();
        assert_eq!(plan.contains("by generators, with what acts at poses"), is_generated, "{plan}");
        check_within(&scene, 0.1);
    }
}

/// Higher orders and substeps: collocation with forces, prescribed joints and constraints.
#[test]
fn every_order_and_substeps() {
    let builtins = ["damped-pendulum", "cart-pole", "chain-4", "four-bar"].map(builtin);
    for scene in builtins.into_iter().chain([floating()]).chain((0..4).map(random_tree)) {
        for settings in methods(&scene) {
            check_with(&scene, |s| *s = settings);
        }
    }
    for (order, substeps) in [(2, 2), (4, 1), (6, 1)] {
        check_with(&builtin("marionette"), |s| (s.order, s.substeps) = (order, substeps));
    }
}
