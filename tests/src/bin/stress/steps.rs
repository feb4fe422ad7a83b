//! Large steps, tiny steps, and many links.

use anyhow::Result;
use plantd_models::{Initial, Plant};

use crate::case::{Case, Setup};
use crate::plants::{
    self, apart, coast, energy, energy_error, hold, largest, moving, refused, until_refused,
    well_depth,
};

pub(crate) fn cases(setup: &Setup) -> Vec<Case> {
    let mut cases = Vec::new();
    for time_step_s in [0.05, 0.2, 0.5, 0.63, 1.5, 5.0] {
        let criterion = "pendulum from 3 rad, 1000 steps; energy error ≤ (h/2)² g/l of the well depth while \
                         steps are accepted (of order h², and 1 at the limit 2 √(l/g)); a refused one \
                         names the error and changes no byte";
        let name = format!("pendulum at steps of {time_step_s} s");
        cases.push(Case::new(name, criterion, move |_, finding| {
            let mut plant = moving(&plants::scene("pendulum"), time_step_s, &[3.0], &[0.0])?;
            let (start, mut worst) = (energy(&mut plant), 0.0_f64);
            let end = until_refused(&mut plant, 1000, |plant| {
                worst = worst.max((energy(plant) - start).abs());
            })?;
            finding.at_most("energy error", worst / (2.0 * 9.8), 0.25 * 9.8 * time_step_s.powi(2));
            refused(finding, "motion", end);
            Ok(())
        }));
    }
    for name in ["pendulum", "double-pendulum", "four-bar", "spherical-pendulum"] {
        let criterion = "0.1 s at steps of 1e-7 s (0.01 s in the short form), against Richardson \
                         extrapolation of 200, 400, 800 and 1600 steps; q and p within 1e-12";
        let title = format!("steps of 1e-7 s: {name}");
        cases.push(Case::new(title, criterion, move |setup, finding| {
            let scene = plants::scene(name);
            let steps = setup.pick(100_000, 1_000_000);
            let end_s = 1e-7 * steps as f64;
            let run = |steps: u64| -> Result<Plant> {
                let mut plant = plants::pushed(&scene, end_s / steps as f64, 1.0)?;
                coast(&mut plant, steps)?;
                Ok(plant)
            };
            let fine = run(steps)?;
            let mut table = Vec::new();
            for steps in [200, 400, 800, 1600] {
                let plant = run(steps)?;
                // Momenta of constrained mechanisms have a part that follows from the last step alone.
                let constrained = plant.model().dimensions().constraints > 0;
                let p = if constrained { &[][..] } else { plant.p() };
                table.push([plant.q(), p].concat());
            }
            for order in 1..table.len() {
                for i in 0..table.len() - order {
                    let factor = 4_f64.powi(order as i32);
                    table[i] = (table[i].iter().zip(&table[i + 1]))
                        .map(|(coarse, fine)| fine + (fine - coarse) / (factor - 1.0))
                        .collect();
                }
            }
            let found = [fine.q(), fine.p()].concat();
            finding.at_most("error", apart(&table[0], &found) / largest(&found), 1e-12);
            let u = hold(&fine);
            finding.linearization(&fine, &u, setup.seed);
            Ok(())
        }));
    }
    for links in setup.pick(&[128, 256][..], &[128, 256, 512, 1024]).iter().copied() {
        let criterion = "200 steps of its own; energy error ≤ 1 % of the well depth; hanging at rest it \
                         stays within 1e-12 rad";
        cases.push(Case::new(
            format!("chain of {links} rods"),
            criterion,
            move |setup, finding| {
                let scene = plants::scene(&format!("chain-{links}"));
                let mut plant = plants::plant(&scene, scene.time_step_s)?;
                let error = energy_error(&mut plant, 200)?;
                finding.at_most("energy error", error / well_depth(&scene)?, 1e-2);
                let u = hold(&plant);
                if links <= 256 {
                    finding.linearization(&plant, &u, setup.seed);
                }
                plant.initialize(&Initial::OperatingPoint("hanging".to_owned()))?;
                coast(&mut plant, 200)?;
                finding.at_most("at rest", largest(plant.q()), 1e-12);
                Ok(())
            },
        ));
    }
    cases
}
