//! Condition of a positive definite matrix, from its factor.

use nalgebra::DMatrix;

use crate::lq::kernels::subtract;

/// Reciprocal condition, in the 1-norm, of `L Lᵀ`; at most 1.
pub(crate) fn reciprocal_condition(factor: &DMatrix<f64>) -> f64 {
    let m = factor.nrows();
    // Columns of the inverse of L.
    let mut inverse = DMatrix::<f64>::zeros(m, m);
    for j in 0..m {
        inverse[(j, j)] = 1.0;
        for k in j..m {
            let known = inverse[(k, j)] / factor[(k, k)];
            let (source, column) = (factor.as_slice(), inverse.as_mut_slice());
            column[m * j + k] = known;
            subtract(&mut column[m * j..][k + 1..m], known, &source[m * k..][k + 1..m]);
        }
    }
    // Columns of L and of the transposed inverse, whose products are symmetric: half of each.
    let (l, inverse) = (factor.transpose(), inverse);
    let largest = norm_of_product(l.as_slice(), m, |i, _| 0..i + 1);
    let largest_inverse = norm_of_product(inverse.as_slice(), m, |_, j| j..m);
    let product = largest * largest_inverse;
    if product.is_nan() {
        0.0
    } else if product > 1.0 {
        product.recip()
    } else {
        1.0
    }
}

/// 1-norm of `XᵀX`, where the terms of entry i ≤ j lie in a range.
fn norm_of_product(
    x: &[f64],
    m: usize,
    terms: impl Fn(usize, usize) -> std::ops::Range<usize>,
) -> f64 {
    let mut sums = vec![0.0; m];
    for j in 0..m {
        for i in 0..=j {
            let terms = terms(i, j);
            let (left, right) = (&x[m * i..][terms.clone()], &x[m * j..][terms]);
            // Four sums, which do not wait for each other.
            let (left, left_rest) = left.as_chunks::<4>();
            let (right, right_rest) = right.as_chunks::<4>();
            let mut four = [0.0; 4];
            for (left, right) in left.iter().zip(right) {
                for ((sum, l), r) in four.iter_mut().zip(left).zip(right) {
                    *sum += l * r;
                }
            }
            let rest: f64 = left_rest.iter().zip(right_rest).map(|(l, r)| l * r).sum();
            let entry = (four.iter().sum::<f64>() + rest).abs();
            sums[i] += entry;
            if i < j {
                sums[j] += entry;
            }
        }
    }
    sums.into_iter().fold(0.0, f64::max)
}
