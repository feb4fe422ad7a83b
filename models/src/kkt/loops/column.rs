//! Right-hand sides of fronts, alone or several side by side.

use plantd_math::rows::{Block, LANES};

/// What a right-hand side is made of: a number, or several side by side.
pub(super) trait Column: Copy {
    const ZERO: Self;
    fn plus(self, other: Self) -> Self;
    fn times(self, factor: f64) -> Self;
    /// `Σ row_k x_k`; both lengths are whole blocks.
    fn sum(row: &[f64], x: &[Self]) -> Self;
}

impl Column for f64 {
    const ZERO: Self = 0.0;

    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        self + other
    }

    #[inline(always)]
    fn times(self, factor: f64) -> Self {
        self * factor
    }

    #[inline(always)]
    fn sum(row: &[f64], x: &[f64]) -> f64 {
        let mut sums = [0.0; LANES];
        for (row, x) in row.as_chunks::<LANES>().0.iter().zip(x.as_chunks::<LANES>().0) {
            for ((sum, row), x) in sums.iter_mut().zip(row).zip(x) {
                *sum += row * x;
            }
        }
        let [a, b, c, d, e, f, g, h] = sums;
        ((a + e) + (b + f)) + ((c + g) + (d + h))
    }
}

impl Column for Block {
    const ZERO: Self = Block::ZERO;

    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        Block::plus(self, other)
    }

    #[inline(always)]
    fn times(self, factor: f64) -> Self {
        Block::times(self, factor)
    }

    #[inline(always)]
    fn sum(row: &[f64], x: &[Block]) -> Block {
        let [mut a, mut b, mut c, mut d] = [Block::ZERO; 4];
        for (row, x) in row.as_chunks::<4>().0.iter().zip(x.as_chunks::<4>().0) {
            a = a.plus(x[0].times(row[0]));
            b = b.plus(x[1].times(row[1]));
            c = c.plus(x[2].times(row[2]));
            d = d.plus(x[3].times(row[3]));
        }
        a.plus(b).plus(c.plus(d))
    }
}
