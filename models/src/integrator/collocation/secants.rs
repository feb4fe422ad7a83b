//! Corrections that learn from those before (Anderson, J. ACM 12, 1965).
//!
//! With the changes `ΔY` of past rounds and those of the corrections `f` that they led to, `ΔF`, the next is
//!
//! ```text
//! f − (ΔY + ΔF) γ        γ: |f − ΔF γ| least
//! ```
//!
//! which is Newton's method as far as the past rounds know the Jacobian.

use plantd_math::simd::wide;

/// Rounds that count.
const DEPTH: usize = 16;
/// Of a column of `ΔF`, what must be left beside the others, squared.
const LEFT: f64 = 1e-12;

/// The past rounds of a step.
#[derive(Clone, Debug)]
pub(crate) struct Secants {
    size: usize,
    /// Rounds seen.
    seen: usize,
    /// `ΔY + ΔF` and `ΔF` of each round in its turn, one after the other.
    moved: Vec<f64>,
    changed: Vec<f64>,
    /// The last correction, and the step that was made of it.
    last: Vec<f64>,
    step: Vec<f64>,
    /// `ΔFᵀ ΔF`.
    products: [[f64; DEPTH]; DEPTH],
}

#[inline(always)]
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (a, b) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    let mut sums = [0.0; 8];
    for (a, b) in a.0.iter().zip(b.0) {
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += a * b;
        }
    }
    let rest: f64 = a.1.iter().zip(b.1).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f64>() + rest
}

impl Secants {
    pub(crate) fn new(size: usize) -> Self {
        let zeros = |len: usize| vec![0.0; len];
        Self {
            size,
            seen: 0,
            moved: zeros(DEPTH * size),
            changed: zeros(DEPTH * size),
            last: zeros(size),
            step: zeros(size),
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
            self.note(correction);
            let known = self.seen.min(DEPTH);
            if known > 0 {
                let weights = self.weights(known, correction);
                for (moved, weight) in self.moved.chunks_exact(self.size).zip(weights) {
                    if weight != 0.0 {
                        correction.iter_mut().zip(moved).for_each(|(c, m)| *c -= weight * m);
                    }
                }
            }
            self.step.copy_from_slice(correction);
            self.seen += 1;
        })
    }

    /// What the last step has made of the correction.
    #[inline(always)]
    fn note(&mut self, correction: &[f64]) {
        let (size, known) = (self.size, self.seen.min(DEPTH));
        if known > 0 {
            let own = (self.seen - 1) % DEPTH;
            let changed = &mut self.changed[own * size..][..size];
            let moved = &mut self.moved[own * size..][..size];
            let before = correction.iter().zip(self.last.iter().zip(&self.step));
            for ((correction, (last, step)), (changed, moved)) in
                before.zip(changed.iter_mut().zip(moved))
            {
                *changed = correction - last;
                *moved = step + *changed;
            }
            let changed = &self.changed[own * size..][..size];
            for k in 0..known {
                let product = dot(changed, &self.changed[k * size..][..size]);
                (self.products[own][k], self.products[k][own]) = (product, product);
            }
        }
        self.last.copy_from_slice(correction);
    }

    /// `γ`, by the normal equations, newest rounds first; those that say nothing new have none.
    #[inline(always)]
    fn weights(&self, known: usize, correction: &[f64]) -> [f64; DEPTH] {
        let newest = self.seen - 1;
        let place = |k: usize| (newest - k) % DEPTH;
        let mut matrix = [[0.0; DEPTH]; DEPTH];
        let [mut right, mut whole, mut inverse, mut weights] = [[0.0; DEPTH]; 4];
        for i in 0..known {
            for (j, entry) in matrix[i].iter_mut().enumerate().take(known).skip(i) {
                *entry = self.products[place(i)][place(j)];
            }
            whole[i] = matrix[i][i];
            right[i] = dot(&self.changed[place(i) * self.size..][..self.size], correction);
        }
        // L D Lᵀ, by the rows of Lᵀ; a column that depends on those before is left out.
        for k in (0..known).filter(|k| whole[*k] > 0.0) {
            if matrix[k][k] <= LEFT * whole[k] {
                continue;
            }
            let row = matrix[k];
            inverse[k] = 1.0 / row[k];
            for i in k + 1..known {
                let factor = row[i] * inverse[k];
                for (entry, above) in matrix[i].iter_mut().zip(row).take(known).skip(i) {
                    *entry -= factor * above;
                }
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
