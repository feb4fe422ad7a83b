//! Sums of two numbers with what rounding takes from them.

use crate::scalar::Scalar;

/// The sum of two numbers, and what rounding took from it.
#[inline(always)]
pub fn two_sum<S: Scalar>(a: S, b: S) -> (S, S) {
    let sum = a + b;
    let b_in_sum = sum - a;
    (sum, (a - (sum - b_in_sum)) + (b - b_in_sum))
}
