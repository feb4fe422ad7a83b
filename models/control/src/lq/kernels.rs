//! Loops over columns, short and unrolled.

use plantd_math::gemm::LANES;

/// `target += a ∘ b`, as far as `a` goes.
#[inline(always)]
pub(super) fn add_products(target: &mut [f64], a: &[f64], b: &[f64]) {
    in_blocks(target, a, b, |target, a, b| *target += a * b);
}

/// `target = a + b`, as far as `a` goes.
#[inline(always)]
pub(super) fn set_sums(target: &mut [f64], a: &[f64], b: &[f64]) {
    in_blocks(target, a, b, |target, a, b| *target = a + b);
}

/// Whole blocks first: such loops are short here, and what compilers unroll is longer.
#[inline(always)]
fn in_blocks(target: &mut [f64], a: &[f64], b: &[f64], act: impl Fn(&mut f64, f64, f64)) {
    let (target, target_rest) = target[..a.len()].as_chunks_mut::<LANES>();
    let (b, b_rest) = b[..a.len()].as_chunks::<LANES>();
    let (a, a_rest) = a.as_chunks::<LANES>();
    for ((target, a), b) in target.iter_mut().zip(a).zip(b) {
        (0..LANES).for_each(|i| act(&mut target[i], a[i], b[i]));
    }
    for ((target, a), b) in target_rest.iter_mut().zip(a_rest).zip(b_rest) {
        act(target, *a, *b);
    }
}

/// `target −= factor · source`.
#[inline(always)]
pub(super) fn subtract(target: &mut [f64], factor: f64, source: &[f64]) {
    for (target, source) in target.iter_mut().zip(source) {
        *target -= factor * source;
    }
}

/// `target *= factor`.
#[inline(always)]
pub(super) fn scale(target: &mut [f64], factor: f64) {
    for target in target {
        *target *= factor;
    }
}
