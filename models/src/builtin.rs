//! Built-in scenes.

use crate::Scene;

/// Names of the built-in scenes. `chain-N` and `scissor-N` stand for whole families.
pub const NAMES: &[&str] = &[
    "pendulum",
    "damped-pendulum",
    "double-pendulum",
    "cart-pole",
    "spherical-pendulum",
    "chain-4",
    "four-bar",
    "scissor-4",
    "marionette",
];

/// The built-in scene of that name; any `chain-N` with 1 ≤ N ≤ 1024 and `scissor-N` with
/// 1 ≤ N ≤ 64 exists.
pub fn scene(_name: &str) -> Option<Scene> {
    unimplemented!()
}
