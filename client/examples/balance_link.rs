//! Keeps the pendulum upright over shared memory, by a law of its own:
//! `cargo run -p plantd-client --example balance_link -- PLANT ROOT STEPS`.

use std::f64::consts::PI;
use std::path::PathBuf;

use plantd_client::link::{LinkDriver, LinkError, LinkOptions};

/// Torque for each radian off upright, N m; more than gravity's 9.8.
const STIFFNESS: f64 = 40.0;
/// Torque for each unit of momentum, 1/s: with a mass of 1 kg at 1 m nearly critical damping.
const DAMPING: f64 = 10.0;

fn main() -> Result<(), LinkError> {
    let mut arguments = std::env::args().skip(1);
    let mut argument = |name: &str| arguments.next().unwrap_or_else(|| panic!("{name} is missing"));
    let (plant, root) = (argument("PLANT"), PathBuf::from(argument("ROOT")));
    let steps: u64 = argument("STEPS").parse().expect("STEPS is a number");
    let options = LinkOptions { root, ..Default::default() };
    let mut driver = LinkDriver::connect(&plant, options)?;
    for _ in 0..steps {
        let state = driver.state();
        let torque = STIFFNESS * (PI - state.q[0]) - DAMPING * state.p[0];
        driver.step(&[torque])?;
    }
    Ok(())
}
