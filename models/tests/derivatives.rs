//! The linearization against sixth-order central differences of the step itself.

use crate::common::linearization::{check, check_with};
use crate::common::{builtin, floating, methods, random_tree};

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
