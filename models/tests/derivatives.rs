//! The linearization against sixth-order central differences of the step itself.

mod common;

use common::linearization::check;
use common::{builtin, floating, random_tree};

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
