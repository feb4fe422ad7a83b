//! Energy over long runs.
//!
//! The points of a variational integrator lie on a motion of a modified system, whose energy
//!
//! ```text
//! H̃ = p·q̇ − L̃,      ∫ L̃ dt from t[k] to t[k+1] = L_d(q[k], q[k+1])
//! ```
//!
//! is constant but for terms exponentially small in `1/h`. The motion passes through the points and
//! through the sums of `L_d` smoothly, so that central differences of both give `H̃` to high order, for
//! regular and for chaotic motion alike. What is left is round-off, and any drift shows at that level.
//! Methods of higher order are given steps at which the error of their energy itself is about as small.

use anyhow::Result;
use plantd_models::{Plant, Scene};

use crate::case::{Case, Finding, Line, Setup};
use crate::plants::{self, Method, energy, hold, largest, step};

/// Points to either side that a difference takes: order 12.
const SIDE: usize = 6;
/// Bursts in the plot.
const PLOTTED: usize = 100;
/// Points of a burst at which the modified energy is found.
const BURST: usize = 64;

struct Long {
    name: &'static str,
    scene: fn() -> Result<Scene>,
    /// None means the initial configuration of the scene.
    q: &'static [f64],
    /// Size of the velocities.
    speed: f64,
    /// Time step, order, substeps.
    method: (f64, u32, u32),
    short: u64,
    long: u64,
}

const SPHERICAL: &str = r#"
gravity = [0.0, 0.0, -9.81]
[[frames]]
name = "rod"
joint = { type = "ball" }
body = { mass = 1.0, center_of_mass = [0.0, 0.0, -1.0], inertia = [0.01, 0.01, 0.01] }
[[coordinates]]
name = "rod_rx"
initial = 0.8
"#;

const RUNS: [Long; 13] = [
    Long {
        name: "pendulum",
        scene: || Ok(plants::scene("pendulum")),
        q: &[1.5],
        speed: 0.0,
        method: (1e-3, 2, 1),
        short: 1_000_000,
        long: 100_000_000,
    },
    Long {
        name: "double pendulum",
        scene: || Ok(plants::scene("double-pendulum")),
        q: &[1.5, 1.0],
        speed: 0.0,
        method: (1e-3, 2, 1),
        short: 1_000_000,
        long: 100_000_000,
    },
    Long {
        name: "spherical pendulum on a ball joint",
        scene: || plants::parse(SPHERICAL),
        q: &[],
        speed: 1.5,
        method: (2e-3, 2, 1),
        short: 1_000_000,
        long: 100_000_000,
    },
    Long {
        name: "chain of 4 rods",
        scene: || Ok(plants::scene("chain-4")),
        q: &[1.5, 0.0, 0.0, 0.0],
        speed: 0.0,
        method: (5e-4, 2, 1),
        short: 1_000_000,
        long: 100_000_000,
    },
    Long {
        name: "four-bar linkage",
        scene: || Ok(plants::scene("four-bar")),
        q: &[],
        speed: 0.0,
        method: (2e-3, 2, 1),
        short: 500_000,
        long: 100_000_000,
    },
    Long {
        name: "marionette with still hands",
        scene: || Ok(plants::undamped("marionette")),
        q: &[],
        speed: 0.3,
        method: (2e-3, 2, 1),
        short: 20_000,
        long: 1_000_000,
    },
    Long {
        name: "pendulum, order 4",
        scene: || Ok(plants::scene("pendulum")),
        q: &[1.5],
        speed: 0.0,
        method: (1e-3, 4, 1),
        short: 300_000,
        long: 10_000_000,
    },
    Long {
        name: "pendulum, order 8",
        scene: || Ok(plants::scene("pendulum")),
        q: &[1.5],
        speed: 0.0,
        method: (2e-2, 8, 1),
        short: 300_000,
        long: 10_000_000,
    },
    Long {
        name: "pendulum, order 12",
        scene: || Ok(plants::scene("pendulum")),
        q: &[1.5],
        speed: 0.0,
        method: (5e-2, 12, 1),
        short: 100_000,
        long: 10_000_000,
    },
    Long {
        name: "double pendulum, order 12",
        scene: || Ok(plants::scene("double-pendulum")),
        q: &[1.5, 1.0],
        speed: 0.0,
        method: (1e-2, 12, 1),
        short: 50_000,
        long: 10_000_000,
    },
    Long {
        name: "chain of 4 rods, order 6 in 4 substeps",
        scene: || Ok(plants::scene("chain-4")),
        // From 0.8 rad it begins to whip after half a million steps, and truncation shows.
        q: &[0.4, 0.0, 0.0, 0.0],
        speed: 0.0,
        method: (4e-3, 6, 4),
        short: 20_000,
        long: 1_000_000,
    },
    Long {
        name: "spherical pendulum on a ball joint, order 8",
        scene: || plants::parse(SPHERICAL),
        q: &[],
        speed: 1.5,
        method: (2e-2, 8, 1),
        short: 20_000,
        long: 1_000_000,
    },
    Long {
        name: "four-bar linkage, order 8",
        scene: || Ok(plants::scene("four-bar")),
        q: &[],
        speed: 0.0,
        method: (5e-3, 8, 1),
        short: 20_000,
        long: 1_000_000,
    },
];

pub(crate) fn cases() -> Vec<Case> {
    let criterion = "drift of the energy (of the modified one at order 2) by a line through it ≤ 32 ε |Δv|₁ |p|∞ √steps, the walk \
                     of a momentum solved to round-off, + 3 standard errors of the line; \
                     median oscillation of the energy in the second half ≤ 1.5 of the first";
    RUNS.iter()
        .map(|run| {
            let limit = match run.name {
                name if name.starts_with("four-bar") => {
                    Some("round-off of constraints is not a walk: about 2e-19 of the energy a step")
                }
                "chain of 4 rods" => Some(
                    "impulses do not see corrections of less than two units of round-off: about 2e-19 of \
                     the energy a step where it whips",
                ),
                name if name.ends_with("ball joint, order 8") => {
                    Some("about 4e-20 of the energy in each of the 17 steps of a period")
                }
                _ => None,
            };
            Case::new(format!("energy: {}", run.name), criterion, move |setup, finding| {
                long_run(run, setup, finding)
            })
            .known_limit(limit)
        })
        .collect()
}

fn long_run(run: &Long, setup: &Setup, finding: &mut Finding) -> Result<()> {
    let scene = (run.scene)()?;
    let (time_step_s, order, substeps) = run.method;
    let method = Method::new(time_step_s, order, substeps);
    finding.method = Some((order, substeps));
    let mut plant = if run.q.is_empty() {
        plants::pushed(&scene, method, run.speed)?
    } else {
        plants::moving(&scene, method, run.q, &vec![0.0; run.q.len()])?
    };
    let u = hold(&plant);
    let steps = setup.pick(run.short, run.long);
    let bursts = setup.pick(100, 400);
    let mut seen = Vec::new();
    for _ in 0..bursts {
        seen.push(Burst::take(&mut plant, &u)?);
        for _ in 0..(steps / bursts).saturating_sub((BURST + 2 * SIDE) as u64) {
            step(&mut plant, &u)?;
        }
    }
    finding.linearization(&plant, &u, setup.seed);
    let size = seen.iter().map(|burst| burst.kinetic).fold(0.0, f64::max);
    let (first, second) = seen.split_at(seen.len() / 2);
    // The median: chaotic motion has rare large swings.
    // At higher order what swings may be round-off.
    let least = if order > 2 { 1e-13 } else { 0.0 };
    let swing = |bursts: &[Burst]| {
        let mut swings: Vec<f64> = bursts.iter().map(|burst| burst.oscillation / size).collect();
        swings.sort_by(f64::total_cmp);
        swings[swings.len() / 2]
    };
    let fit = Fit::new(&seen);
    let walk = {
        let squares = seen.iter().map(|burst| burst.round_off.powi(2)).sum::<f64>();
        (squares / seen.len() as f64 * steps as f64).sqrt()
    };
    finding.note(format!("{steps:.0e} steps", steps = steps as f64));
    finding.at_most("drift", fit.drift.abs() / size, (32.0 * walk + 3.0 * fit.error) / size);
    finding.at_most("oscillation", swing(second), (1.5 * swing(first)).max(least));
    let origin = seen[0].modified;
    finding.lines.push(Line {
        plot: if order == 2 { "energy" } else { "energy-orders" },
        name: run.name.to_owned(),
        points: seen
            .iter()
            .skip(1)
            .step_by(seen.len() / PLOTTED)
            .map(|b| (b.step, (b.modified - origin).abs() / size))
            .collect(),
    });
    Ok(())
}

/// A few steps at which everything is measured.
struct Burst {
    step: f64,
    /// Mean of the modified energy.
    modified: f64,
    /// Largest distance of the energy from the modified one.
    oscillation: f64,
    /// Largest kinetic energy.
    kinetic: f64,
    /// Energy that round-off of the momentum moves in a step.
    round_off: f64,
}

/// Weights of `x[k + j] − x[k − j]` in `h x'`, j from 1.
fn weights() -> [f64; SIDE] {
    let mut ratio = 1.0;
    std::array::from_fn(|i| {
        let (j, m) = ((i + 1) as f64, SIDE as f64);
        ratio *= (m - j + 1.0) / (m + j);
        if i % 2 == 0 { ratio / j } else { -ratio / j }
    })
}

impl Burst {
    fn take(plant: &mut Plant, u: &[f64]) -> Result<Self> {
        let (model, h) = (plant.model().clone(), plant.settings().time_step_s);
        let d = model.dimensions();
        let first = plant.step_index();
        // The sums of other methods' Lagrangians are not to be had, but their energy hardly swings.
        let is_midpoint = plant.settings().order == 2 && plant.settings().substeps == 1;
        let (mut q, mut p) = (vec![plant.q().to_vec()], vec![plant.p().to_vec()]);
        let (mut actions, mut velocities) = (Vec::new(), Vec::new());
        let mut energies = vec![energy(plant)];
        let mut kinetic = 0.0_f64;
        for k in 0..BURST + 2 * SIDE - 1 {
            step(plant, u)?;
            let turn = model.difference(&q[k], plant.q());
            let half: Vec<f64> = turn.iter().map(|x| 0.5 * x).collect();
            let v: Vec<f64> = turn.iter().map(|x| x / h).collect();
            let middle = plant.energy_at(&model.retract(&q[k], &half), &v)?;
            actions.push(h * (middle.kinetic_j - middle.potential_j));
            kinetic = kinetic.max(middle.kinetic_j);
            velocities.push(v);
            q.push(plant.q().to_vec());
            p.push(plant.p().to_vec());
            energies.push(energy(plant));
        }
        let (mut sum, mut oscillation, mut round_off) = (0.0, 0.0_f64, 0.0);
        for k in SIDE..SIDE + BURST {
            let (mut rate, mut action) = (vec![0.0; d.dynamic], 0.0);
            for (weight, j) in weights().into_iter().zip(1..) {
                let (ahead, behind) =
                    (model.difference(&q[k], &q[k + j]), model.difference(&q[k], &q[k - j]));
                for (rate, (a, b)) in rate.iter_mut().zip(ahead.iter().zip(&behind)) {
                    *rate += weight * (a - b);
                }
                action += weight * actions[k - j..k + j].iter().sum::<f64>();
            }
            let product: f64 = rate.iter().zip(&p[k]).map(|(v, p)| v * p).sum();
            let modified = if is_midpoint { (product - action) / h } else { energies[k] };
            sum += modified;
            let from = if is_midpoint { modified } else { energies[SIDE] };
            oscillation = oscillation.max((energies[k] - from).abs());
            let change: f64 =
                velocities[k].iter().zip(&velocities[k - 1]).map(|(a, b)| (a - b).abs()).sum();
            round_off += f64::EPSILON * change * largest(&p[k]);
        }
        let count = BURST as f64;
        let (modified, round_off) = (sum / count, round_off / count);
        Ok(Self { step: first as f64, modified, oscillation, kinetic, round_off })
    }
}

/// A line through the modified energies.
struct Fit {
    /// Its rise over the run.
    drift: f64,
    /// Standard error of the rise.
    error: f64,
}

impl Fit {
    fn new(bursts: &[Burst]) -> Self {
        let count = bursts.len() as f64;
        let mean = |of: fn(&Burst) -> f64| bursts.iter().map(of).sum::<f64>() / count;
        let (at, value) = (mean(|b| b.step), mean(|b| b.modified));
        let spread: f64 = bursts.iter().map(|b| (b.step - at).powi(2)).sum();
        let slope =
            bursts.iter().map(|b| (b.step - at) * (b.modified - value)).sum::<f64>() / spread;
        let rest: f64 =
            bursts.iter().map(|b| (b.modified - value - slope * (b.step - at)).powi(2)).sum();
        let length = bursts.last().map_or(0.0, |b| b.step) - bursts.first().map_or(0.0, |b| b.step);
        Self { drift: slope * length, error: (rest / (count - 2.0) / spread).sqrt() * length }
    }
}
