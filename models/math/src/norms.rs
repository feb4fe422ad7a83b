//! Largest magnitudes, by which residuals are measured.

use crate::scalar::Compared;

/// The larger of two numbers; a NaN wins, so that it is never taken for converged.
///
/// Both are taken without their signs, and bits of such numbers are in their order.
#[inline(always)]
pub fn larger(a: f64, b: f64) -> f64 {
    f64::from_bits(a.abs().to_bits().max(b.abs().to_bits()))
}

/// The largest magnitude of some numbers; NaN if one is not finite.
#[inline]
pub fn largest(numbers: &[f64]) -> f64 {
    // Four sums side by side cost a pendulum a twentieth of its step.
    if numbers.len() >= 4 {
        return largest_of_many(numbers);
    }
    let (mut most, mut sum) = (0.0, 0.0);
    for number in numbers {
        most = greater(number.abs(), most);
        sum += number.abs();
    }
    if sum < f64::INFINITY { most } else { f64::NAN }
}

/// [`largest`] of each of several lists side by side.
#[inline(always)]
pub fn largest_of_each<S: Compared>(numbers: &[S]) -> S {
    let (mut most, mut sum) = (S::ZERO, S::ZERO);
    for number in numbers {
        let size = number.abs();
        most = S::choose(most.less(size), size, most);
        sum += size;
    }
    S::choose(sum.less(S::constant(f64::INFINITY)), most, S::constant(f64::NAN))
}

/// The greater of two numbers; the second, if the first is none. `f64::max` takes three instructions more.
#[inline(always)]
fn greater(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

fn largest_of_many(numbers: &[f64]) -> f64 {
    let (blocks, rest) = numbers.as_chunks::<4>();
    let (mut most, mut sum) = ([0.0_f64; 4], [0.0_f64; 4]);
    let mut see = |i: usize, number: f64| {
        most[i] = greater(number.abs(), most[i]);
        sum[i] += number.abs();
    };
    for block in blocks {
        for (i, number) in block.iter().enumerate() {
            see(i, *number);
        }
    }
    rest.iter().for_each(|number| see(0, *number));
    let most = most.into_iter().fold(0.0, greater);
    if sum.into_iter().sum::<f64>() < f64::INFINITY { most } else { f64::NAN }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_number_is_found_and_nothing_infinite_passes() {
        for len in 0..10 {
            let mut numbers: Vec<f64> = (0..len).map(|i| -0.5 * f64::from(i)).collect();
            assert_eq!(largest(&numbers), 0.5 * f64::from((len - 1).max(0)));
            for place in 0..numbers.len() {
                let kept = numbers[place];
                for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
                    numbers[place] = bad;
                    assert!(largest(&numbers).is_nan(), "{len} {place}");
                }
                numbers[place] = kept;
            }
        }
    }
}
