//! Methods of every order against the midpoint rule, extrapolated.

use anyhow::Result;

use crate::case::Case;
use crate::plants::{self, Method, apart, coast, largest, pushed};

/// Where the motions are compared, s.
const END_S: f64 = 0.2;

pub(crate) fn cases() -> Vec<Case> {
    let mechanisms: [(&str, &[u32]); 6] = [
        ("pendulum", &[4, 6, 8, 12]),
        ("double-pendulum", &[4, 6, 8, 12]),
        ("chain-4", &[4, 6, 8, 12]),
        ("tree-7", &[4, 8, 12]),
        ("four-bar", &[4, 6, 8]),
        ("marionette", &[4, 6, 8]),
    ];
    let pairs = |(name, orders): (&'static str, &'static [u32])| {
        orders.iter().map(move |order| (name, *order))
    };
    mechanisms
        .into_iter()
        .flat_map(pairs)
        .map(|(name, order)| {
            let criterion = "configuration after 0.2 s against Richardson extrapolation of the midpoint rule: \
                             within 1e-11 at the finest step, and by a line through the errors above 1e-11 \
                             of order p − ½ at least";
            Case::new(format!("order {order}: {name}"), criterion, move |_, finding| {
                finding.method = Some((order, 1));
                let scene = plants::undamped(name);
                let end = |order: u32, steps: u64| -> Result<Vec<f64>> {
                    let method = Method::new(END_S / steps as f64, order, 1).unhalved();
                    let mut plant = pushed(&scene, method, 1.0)?;
                    coast(&mut plant, steps)?;
                    Ok(plant.q().to_vec())
                };
                let reference = extrapolated(|steps| end(2, steps))?;
                let mut errors = Vec::new();
                for steps in [4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 256, 512, 1024] {
                    let Ok(q) = end(order, steps) else { continue };
                    errors.push((steps as f64, apart(&q, &reference) / largest(&reference)));
                }
                let Some((_, finest)) = errors.last() else { anyhow::bail!("no steps succeed") };
                finding.at_most("error", *finest, 1e-11);
                // The finest three above round-off.
                let seen: Vec<_> = errors.iter().filter(|(_, error)| *error > 1e-11).collect();
                match seen.len().checked_sub(3) {
                    Some(first) => {
                        let found = slope(&seen[first..]);
                        let missing = f64::from(order) + found;
                        finding.at_most(&format!("order {:.2}, short by", -found), missing, 0.5);
                    }
                    None => finding.note("too few errors above round-off for a line"),
                }
                Ok(())
            })
        })
        .collect()
}

/// Where the midpoint rule ends with ever shorter steps.
fn extrapolated(end: impl Fn(u64) -> Result<Vec<f64>>) -> Result<Vec<f64>> {
    let mut table: Vec<Vec<f64>> =
        [256, 512, 1024, 2048].map(end).into_iter().collect::<Result<_>>()?;
    for order in 1..table.len() {
        let factor = 4_f64.powi(order as i32);
        for i in 0..table.len() - order {
            table[i] = (table[i].iter().zip(&table[i + 1]))
                .map(|(coarse, fine)| fine + (fine - coarse) / (factor - 1.0))
                .collect();
        }
    }
    Ok(table.swap_remove(0))
}

/// Slope of the line through the logarithms.
fn slope(points: &[&(f64, f64)]) -> f64 {
    let logs: Vec<(f64, f64)> = points.iter().map(|(x, y)| (x.ln(), y.ln())).collect();
    let count = logs.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| logs.iter().map(of).sum::<f64>() / count;
    let (x, y) = (mean(|p| p.0), mean(|p| p.1));
    let spread: f64 = logs.iter().map(|p| (p.0 - x).powi(2)).sum();
    logs.iter().map(|p| (p.0 - x) * (p.1 - y)).sum::<f64>() / spread
}
