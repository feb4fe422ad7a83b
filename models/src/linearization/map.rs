//! A linearization as the map of a linear-quadratic problem.

use nalgebra::DMatrix;
use plantd_math::sparse_map::Map;

use crate::linearization::linearize::{Linearization, Output};
use crate::linearization::matrices::Layout;

impl Linearization {
    /// Writes `[B A]` without its zeros: rows of dynamic coordinates and momenta are full, those of
    /// prescribed coordinates have an entry or two.
    pub fn write_map(&self, map: &mut Map) {
        let theta = self.parameters();
        let (nd, nk, ni) = (theta.nd, theta.nk, theta.ni);
        let (n, next, inputs) = (theta.n(), theta.inputs(), ni + nk);
        if !self.ends.turnings.is_empty() {
            let (mut a, mut b) = (DMatrix::zeros(2 * n, 2 * n), DMatrix::zeros(2 * n, inputs));
            self.a_into(a.as_mut_slice(), Layout::Columns);
            self.b_into(b.as_mut_slice(), Layout::Columns);
            map.set(&a, &b);
            return;
        }
        map.begin((2 * n, 2 * n, inputs), 0..next, (0..nd).chain(n..n + nd));
        for (part, numbers) in [&self.increment, &self.momentum].into_iter().enumerate() {
            for (i, source) in numbers.chunks_exact(self.stride.max(1)).enumerate() {
                let target = map.row_mut(part * nd + i);
                let output = if part == 0 { Output::Increment(i) } else { Output::Momentum(i) };
                self.write_by_input(output, &mut target[..inputs]);
                target[inputs..][..next].copy_from_slice(&source[..next]);
                if part == 0 {
                    target[inputs + i] += 1.0;
                }
                self.ends.replaced.iter().for_each(|column| target[*column] = 0.0);
            }
        }
        for (first, entry) in [(nd, 1.0), (n + nd, 1.0 / self.ends.time_step_s)] {
            let driven = (0..nk).filter(|k| !self.ends.replaced.contains(&(ni + k)));
            driven.for_each(|k| map.push(first + k, ni + k, entry));
        }
        for k in 0..nk {
            map.push(n + nd + k, inputs + nd + k, -1.0 / self.ends.time_step_s);
        }
    }
}
