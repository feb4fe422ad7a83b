//! Corrections that learn from those before (Anderson, J. ACM 12, 1965).
//!
//! With the changes `ΔY` of past rounds and those of the corrections `f` that they led to, `ΔF`, the next is
//!
//! ```text
//! f − (ΔY + ΔF) γ        γ: |f − ΔF γ| least
//! ```
//!
//! which is Newton's method as far as the past rounds know the Jacobian.

use plantd_math::rows::dot;
use plantd_math::simd::wide;

/// Rounds that count.
const DEPTH: usize = 16;
/// Of a column of `ΔF`, what must be left beside the others, squared.
const LEFT: f64 = 1e-12;

/// The past rounds of a step.
#[derive(Clone, Debug)]
pub(crate) struct Secants {
    /// Rounds seen.
    seen: usize,
    /// `ΔY + ΔF` of each round in its turn, one after the other.
    moved: Vec<f64>,
    /// `ΔF` of all rounds, number by number.
    changed: Vec<[[f64; 8]; DEPTH / 8]>,
    /// The last correction, the step that was made of it, and its change.
    last: Vec<f64>,
    step: Vec<f64>,
    change: Vec<f64>,
    /// `ΔFᵀ ΔF`.
    products: [[f64; DEPTH]; DEPTH],
}

impl Secants {
    pub(crate) fn new(size: usize) -> Self {
        let zeros = |len: usize| vec![0.0; len];
        Self {
            seen: 0,
            moved: zeros(DEPTH * size),
            changed: vec![[[0.0; 8]; DEPTH / 8]; size],
            last: zeros(size),
            step: zeros(size),
            change: zeros(size),
            products: [[0.0; DEPTH]; DEPTH],
        }
    }

    /// Another step begins.
    pub(crate) fn forget(&mut self) {
        self.seen = 0;
    }

    /// Replaces a correction by a better one.
    pub(crate) fn improve(&mut self, correction: &mut [f64]) {
        wide!({
            let known = self.seen.min(DEPTH);
            if known == 0 {
                self.last.copy_from_slice(correction);
            } else {
                let right = self.note(known, correction);
                let weights = self.weights(known, right);
                for (moved, weight) in self.moved.chunks_exact(correction.len()).zip(weights) {
                    if weight != 0.0 {
                        correction.iter_mut().zip(moved).for_each(|(c, m)| *c -= weight * m);
                    }
                }
            }
            self.step.copy_from_slice(correction);
            self.seen += 1;
        })
    }

    /// Takes note of what the last step has made of the correction; returns `ΔFᵀ f`.
    #[inline(always)]
    fn note(&mut self, known: usize, correction: &[f64]) -> [f64; DEPTH] {
        let (size, own) = (correction.len(), (self.seen - 1) % DEPTH);
        let moved = &mut self.moved[own * size..][..size];
        let before = self.last.iter_mut().zip(&self.step);
        let after = self.change.iter_mut().zip(moved);
        for ((new, (last, step)), (change, moved)) in correction.iter().zip(before).zip(after) {
            *change = new - *last;
            *moved = step + *change;
            *last = *new;
        }
        let [mut products, mut right] = match known {
            ..=8 => self.take_products::<1>(own, correction),
            _ => self.take_products::<{ DEPTH / 8 }>(own, correction),
        };
        products[own] = dot(&self.change, &self.change);
        right[own] = dot(&self.change, correction);
        self.products[own] = products;
        for (row, product) in self.products.iter_mut().zip(products) {
            row[own] = product;
        }
        right
    }

    /// The products of all `ΔF` with the last one, which is put to them, and with the correction; of its own with
    /// itself they are those of what was in its place.
    #[inline(always)]
    fn take_products<const BLOCKS: usize>(
        &mut self,
        own: usize,
        correction: &[f64],
    ) -> [[f64; DEPTH]; 2] {
        let mut sums = [[[0.0; 8]; DEPTH / 8]; 2];
        for ((row, change), new) in self.changed.iter_mut().zip(&self.change).zip(correction) {
            for b in 0..BLOCKS {
                for lane in 0..8 {
                    sums[0][b][lane] += row[b][lane] * change;
                    sums[1][b][lane] += row[b][lane] * new;
                }
            }
            row[own / 8][own % 8] = *change;
        }
        let [products, right] = &sums;
        let mut all = [[0.0; DEPTH]; 2];
        all[0].copy_from_slice(products.as_flattened());
        all[1].copy_from_slice(right.as_flattened());
        all
    }

    /// `γ`, by the normal equations, newest rounds first; those that say nothing new have none.
    #[inline(always)]
    fn weights(&self, known: usize, products: [f64; DEPTH]) -> [f64; DEPTH] {
        let newest = self.seen - 1;
        let place = |k: usize| (newest - k) % DEPTH;
        let mut matrix = [[0.0; DEPTH]; DEPTH];
        let [mut right, mut whole, mut inverse, mut weights] = [[0.0; DEPTH]; 4];
        for i in 0..known {
            let row = &self.products[place(i)];
            for (j, entry) in matrix[i].iter_mut().enumerate().take(known) {
                *entry = row[place(j)];
            }
            whole[i] = matrix[i][i];
            right[i] = products[place(i)];
        }
        // L D Lᵀ, by the rows of Lᵀ; a column that depends on those before is left out.
        for k in 0..known {
            let row = matrix[k];
            // Not where it is not a number.
            if !(row[k] > LEFT * whole[k]) {
                continue;
            }
            inverse[k] = 1.0 / row[k];
            for i in k + 1..known {
                let factor = row[i] * inverse[k];
                matrix[i].iter_mut().zip(row).for_each(|(entry, above)| *entry -= factor * above);
                right[i] -= factor * right[k];
            }
        }
        for i in (0..known).rev() {
            let rest: f64 = (i + 1..known).map(|j| matrix[i][j] * weights[place(j)]).sum();
            weights[place(i)] = (right[i] - rest) * inverse[i];
        }
        weights
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of `n` linear equations the solution is found in `n + 1` rounds, where plain corrections diverge.
    #[test]
    fn linear_equations_are_solved_in_as_many_rounds() {
        let matrix = [[0.3, -1.4, 0.2], [1.1, 0.2, -0.6], [0.1, 0.5, 0.9]];
        let (mut x, mut secants) = ([0.0; 3], Secants::new(3));
        let correction =
            |x: &[f64; 3]| -> [f64; 3] { std::array::from_fn(|i| 1.0 - x[i] + dot(&matrix[i], x)) };
        for _ in 0..4 {
            let mut step = correction(&x);
            secants.improve(&mut step);
            x.iter_mut().zip(step).for_each(|(x, step)| *x += step);
        }
        let left = correction(&x).into_iter().fold(0.0, |m: f64, r| m.max(r.abs()));
        assert!(left < 1e-12, "{left:e}");
    }
}
