//! Row operations on row-major matrices whose rows are padded to whole blocks.

use std::ops::{Add, Deref, DerefMut};

use crate::unrolled;

/// Rows are padded to a multiple of this, and worked on in blocks of it.
pub const LANES: usize = 8;

/// A block of numbers side by side, so that compilers use whole registers.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
pub struct Block(pub [f64; LANES]);

impl Block {
    /// All zero.
    pub const ZERO: Self = Self([0.0; LANES]);

    /// The sum, number by number.
    #[inline(always)]
    pub fn plus(self, o: Self) -> Self {
        let mut sum = self.0;
        unrolled!(8, i < LANES, { sum[i] += o.0[i] });
        Self(sum)
    }

    /// All numbers times a factor.
    #[inline(always)]
    pub fn times(self, factor: f64) -> Self {
        let mut product = self.0;
        unrolled!(8, i < LANES, { product[i] *= factor });
        Self(product)
    }
}

/// The sum of halves, of their halves, and of what is left.
#[inline(always)]
pub(crate) fn sum_of_eight<S: Copy + Add<Output = S>>(numbers: [S; 8]) -> S {
    let half = |i: usize| numbers[i] + numbers[i + 4];
    let quarter = |i: usize| half(i) + half(i + 2);
    quarter(0) + quarter(1)
}

/// Rows that begin with a cache line, so that no block lies in two.
#[derive(Clone, Debug, Default)]
pub struct AlignedRows(Vec<Block>);

impl AlignedRows {
    /// So many numbers, which are whole blocks, all zero.
    pub fn zeros(len: usize) -> Self {
        Self(vec![Block::ZERO; len.div_ceil(LANES)])
    }
}

impl Deref for AlignedRows {
    type Target = [f64];

    #[inline(always)]
    fn deref(&self) -> &[f64] {
        // SAFETY: a block is eight numbers, and nothing else.
        unsafe { std::slice::from_raw_parts(self.0.as_ptr().cast(), self.0.len() * LANES) }
    }
}

impl DerefMut for AlignedRows {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut [f64] {
        // SAFETY: a block is eight numbers, and nothing else.
        unsafe { std::slice::from_raw_parts_mut(self.0.as_mut_ptr().cast(), self.0.len() * LANES) }
    }
}

/// `a · b`, in sums side by side.
#[inline(always)]
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (a, rest_a) = a.as_chunks::<LANES>();
    let (b, rest_b) = b.as_chunks::<LANES>();
    let mut sums = [0.0; LANES];
    for (a, b) in a.iter().zip(b) {
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += a * b;
        }
    }
    let rest: f64 = rest_a.iter().zip(rest_b).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f64>() + rest
}

/// The length of a padded row.
pub fn padded(width: usize) -> usize {
    width.next_multiple_of(LANES)
}

/// The length of long rows of which blocks of columns are written: not an even number of cache lines, lest
/// the rows share a few places in caches.
pub fn spread(length: usize) -> usize {
    const LONG: usize = 256;
    if length >= LONG && length.is_multiple_of(2 * LANES) { length + LANES } else { length }
}

/// A row of the source and the factor with which it is added.
pub type Term = (f64, usize);

/// `target += Σ factor · source[row]`, over whole blocks of `target`.
///
/// On a processor with AVX2 the same operations run in wider registers: the bits are the same.
#[inline]
pub fn add_rows(target: &mut [f64], source: &[f64], stride: usize, terms: &[Term]) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        unsafe { add_rows_avx2(target, source, stride, terms) };
        return;
    }
    add_rows_portable(target, source, stride, terms);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn add_rows_avx2(target: &mut [f64], source: &[f64], stride: usize, terms: &[Term]) {
    add_rows_portable(target, source, stride, terms);
}

/// Up to four blocks at a time stay in registers while all terms are added to them: as many sums as
/// hide the latency of an addition.
#[inline(always)]
pub fn add_rows_portable(target: &mut [f64], source: &[f64], stride: usize, terms: &[Term]) {
    if terms.is_empty() {
        return;
    }
    let (wide, rest) = target.as_chunks_mut::<{ 4 * LANES }>();
    let mut column = 0;
    for block in wide {
        add_block(block, source, stride, column, terms);
        column += 4 * LANES;
    }
    let (pairs, rest) = rest.as_chunks_mut::<{ 2 * LANES }>();
    for block in pairs {
        add_block(block, source, stride, column, terms);
        column += 2 * LANES;
    }
    for block in rest.as_chunks_mut::<LANES>().0 {
        add_block(block, source, stride, column, terms);
        column += LANES;
    }
}

#[inline(always)]
fn add_block<const N: usize>(
    block: &mut [f64; N],
    source: &[f64],
    stride: usize,
    column: usize,
    terms: &[Term],
) {
    let mut sum = *block;
    for &(factor, row) in terms {
        let entries = &source[row * stride + column..][..N];
        for (s, entry) in sum.iter_mut().zip(entries) {
            *s += factor * entry;
        }
    }
    *block = sum;
}

/// `target += Σ factors[row] · source[row]` for the factors that are not zero; `terms` is room for them.
pub fn add_product(
    target: &mut [f64],
    source: &[f64],
    stride: usize,
    factors: impl Iterator<Item = f64>,
    terms: &mut Vec<Term>,
) {
    terms.clear();
    // From within, factors of two kinds are gone through one kind after the other.
    non_zero(factors).for_each(|term| terms.push(term));
    add_rows(target, source, stride, terms);
}

/// The entries that are not zero, with their indices.
pub fn non_zero(entries: impl Iterator<Item = f64>) -> impl Iterator<Item = Term> {
    entries.enumerate().filter(|(_, entry)| *entry != 0.0).map(|(i, entry)| (entry, i))
}
