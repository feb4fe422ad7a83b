//! Control against independent means, seen from outside. The package is that of `models/tests`.

mod analysis;
#[allow(dead_code, reason = "tests of the mechanics use the rest")]
#[path = "../../tests/common/mod.rs"]
mod common;
mod kalman;
mod optimize;
mod optimize_bounds;
mod optimize_problems;
mod oracle;
mod projected_costs;
mod reference;
mod riccati;
