//! Sines and cosines of many angles at once, with the same bits on every processor.
//!
//! An angle is reduced by the nearest multiple of `π/2` to `|r| ≤ π/4`, exactly but for the last bits
//! of `π/2` in three parts (Cody and Waite), and kept as a sum of two numbers. Sine and cosine of `r` are
//! the minimax polynomials of degree 13 and 14 that fdlibm uses, good to less than a unit in the last
//! place. Nothing branches, so that compilers use whole registers.

use std::f64::consts::FRAC_2_PI;

use crate::unrolled;

/// Angles up to this are reduced here; larger ones, and what is not finite, by `libm`.
const LARGEST: f64 = 1e6;

/// `π/2` in parts of 33 bits, and the rest.
const PARTS: [f64; 3] =
    [1.570_796_326_734_125_6, 6.077_100_506_303_966e-11, 2.022_266_248_795_950_6e-21];

/// What rounds a number to an integer when it is added and taken away again: `3·2⁵¹`.
const TO_INTEGER: f64 = 6_755_399_441_055_744.0;

const SINE: [f64; 6] = [
    -0.166_666_666_666_666_32,
    0.008_333_333_333_322_49,
    -0.000_198_412_698_298_579_5,
    2.755_731_370_707_006_8e-6,
    -2.505_076_025_340_686_3e-8,
    1.589_690_995_211_55e-10,
];
const COSINE: [f64; 6] = [
    0.041_666_666_666_666_6,
    -0.001_388_888_888_887_411,
    2.480_158_728_947_673e-5,
    -2.755_731_435_139_066_3e-7,
    2.087_572_321_298_175e-9,
    -1.135_964_755_778_819_5e-11,
];

/// Whole turns up to this are taken off exactly.
const MOST_TURNS: f64 = 1_048_576.0;

/// `angle + more` without its whole turns, rounded once: what the sum of a large angle and a small one
/// loses to rounding is kept. `per_radian` is `1/2π`; with zero, or within half a turn, it is the sum.
#[inline(always)]
pub fn unwound(angle: f64, more: f64, per_radian: f64) -> f64 {
    let [angle, rest] = without_turns(angle, per_radian);
    angle + (more + rest)
}

/// An angle without its whole turns, as a sum of two numbers.
#[inline(always)]
pub fn without_turns(angle: f64, per_radian: f64) -> [f64; 2] {
    let turns = (angle * per_radian + TO_INTEGER) - TO_INTEGER;
    let turns = if turns.abs() <= MOST_TURNS { turns } else { 0.0 };
    // Up to the last line nothing is lost, as in the reduction below.
    let first = angle - turns * (4.0 * PARTS[0]);
    let second = turns * (4.0 * PARTS[1]);
    let difference = first - second;
    let lost = (first - difference) - second;
    [difference, lost - turns * (4.0 * PARTS[2])]
}

/// Writes the sine and the cosine of each angle; about 25 flops each.
#[inline(always)]
pub fn sin_cos(angles: &[f64], out: &mut [[f64; 2]]) {
    let mut all_small = true;
    for (angle, out) in angles.iter().zip(&mut *out) {
        all_small &= angle.abs() <= LARGEST;
        *out = reduced(*angle);
    }
    if !all_small {
        for (angle, out) in angles.iter().zip(out) {
            if !(angle.abs() <= LARGEST) {
                *out = libm::sincos(*angle).into();
            }
        }
    }
}

/// The sines and the cosines of a few angles.
#[inline(always)]
pub fn sin_cos_of_several<const N: usize>(angles: [f64; N]) -> [[f64; N]; 2] {
    let ([mut sines, mut cosines], mut all_small) = ([[0.0; N]; 2], true);
    unrolled!(8, i < N, {
        all_small &= angles[i].abs() <= LARGEST;
        [sines[i], cosines[i]] = reduced(angles[i]);
    });
    if all_small { [sines, cosines] } else { sin_cos_one_by_one(angles) }
}

/// Apart, lest the usual results go through memory.
#[cold]
#[inline(never)]
fn sin_cos_one_by_one<const N: usize>(angles: [f64; N]) -> [[f64; N]; 2] {
    let mut out = [[0.0; N]; 2];
    for (i, angle) in angles.into_iter().enumerate() {
        (out[0][i], out[1][i]) = sin_cos_of(angle);
    }
    out
}

/// The sine and the cosine of one angle.
#[inline(always)]
pub fn sin_cos_of(angle: f64) -> (f64, f64) {
    if angle.abs() <= LARGEST { reduced(angle).into() } else { libm::sincos(angle) }
}

#[inline(always)]
fn reduced(x: f64) -> [f64; 2] {
    let shifted = x * FRAC_2_PI + TO_INTEGER;
    let quarters = shifted - TO_INTEGER;
    // The products with the first two parts are exact.
    let first = x - quarters * PARTS[0];
    let second = quarters * PARTS[1];
    let difference = first - second;
    let rest = quarters * PARTS[2] - ((first - difference) - second);
    let r = difference - rest;
    let low = (difference - r) - rest;

    let z = r * r;
    let w = z * z;
    let tail = SINE[1] + z * (SINE[2] + z * SINE[3]) + z * w * (SINE[4] + z * SINE[5]);
    let cube = z * r;
    let sine = r - ((z * (0.5 * low - cube * tail) - low) - cube * SINE[0]);
    let tail = z * (COSINE[0] + z * (COSINE[1] + z * COSINE[2]))
        + w * w * (COSINE[3] + z * (COSINE[4] + z * COSINE[5]));
    let half = 0.5 * z;
    let whole = 1.0 - half;
    let cosine = whole + (((1.0 - whole) - half) + (z * tail - r * low));

    // The last bits of the sum are those of the integer.
    let quadrant = shifted.to_bits();
    let swapped = (quadrant & 1).wrapping_neg();
    let (s, c) = (sine.to_bits(), cosine.to_bits());
    let (s, c) = ((s & !swapped) | (c & swapped), (c & !swapped) | (s & swapped));
    let sign = |quadrant: u64| (quadrant & 2) << 62;
    [f64::from_bits(s ^ sign(quadrant)), f64::from_bits(c ^ sign(quadrant.wrapping_add(1)))]
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_4;

    use super::*;

    /// Units in the last place between two numbers.
    fn distance(a: f64, b: f64) -> f64 {
        (a - b).abs() / (f64::EPSILON * b.abs().max(f64::MIN_POSITIVE)).max(5e-324)
    }

    #[test]
    fn they_agree_with_the_standard_library_to_the_last_place() {
        let mut angles: Vec<f64> = (0..200_000)
            .map(|i| {
                let i = f64::from(i);
                1e6_f64.powf((0.618 * i).fract()) * (1.7 * i).sin()
            })
            .collect();
        // Where one of them is small, and where the quadrants meet.
        angles.extend((-2000..2000).flat_map(|k| {
            let near = f64::from(k) * FRAC_PI_4;
            [near, near.next_up(), near.next_down(), near + 1e-9]
        }));
        angles.extend([0.0, -0.0, 1e-300, 5e-324, LARGEST, -LARGEST]);
        let mut out = vec![[0.0; 2]; angles.len()];
        sin_cos(&angles, &mut out);
        for (angle, [s, c]) in angles.iter().zip(&out) {
            let (sine, cosine) = angle.sin_cos();
            assert!(distance(*s, sine) <= 1.0, "sin {angle:e}: {s:e}, {sine:e}");
            assert!(distance(*c, cosine) <= 1.0, "cos {angle:e}: {c:e}, {cosine:e}");
        }
        for (angles, out) in angles.as_chunks::<4>().0.iter().zip(out.as_chunks::<4>().0) {
            let [sines, cosines] = sin_cos_of_several(*angles);
            assert_eq!([0, 1, 2, 3].map(|i| [sines[i], cosines[i]]), *out, "four at a time");
        }
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            #[target_feature(enable = "avx2")]
            fn in_wide_registers(angles: &[f64], out: &mut [[f64; 2]]) {
                sin_cos(angles, out);
            }
            let narrow = std::mem::replace(&mut out, vec![[0.0; 2]; angles.len()]);
            // SAFETY: the processor has AVX2.
            unsafe { in_wide_registers(&angles, &mut out) };
            assert_eq!(out, narrow, "the same bits in any register");
        }
    }

    /// Sines of `angle + more` as a whole, by the sum formula.
    #[test]
    fn whole_turns_are_taken_off_without_loss() {
        for i in 0..20_000 {
            let x = f64::from(i);
            let angle = 6e6_f64.powf((0.618 * x).fract()) * (1.7 * x).sin();
            let more = 0.3 * (0.9 * x).sin() * 1e-15_f64.powf((0.37 * x).fract());
            let angle_left = unwound(angle, more, std::f64::consts::FRAC_1_PI / 2.0);
            assert!(angle_left.abs() <= 3.5, "{angle} + {more}: {angle_left}");
            let ((s, c), (sine, cosine)) = (angle.sin_cos(), more.sin_cos());
            let expected = s * cosine + c * sine;
            assert!((angle_left.sin() - expected).abs() <= 6e-16, "{angle} + {more}");
            assert_eq!(unwound(angle, more, 0.0), angle + more);
            let near = (1.7 * x).sin() * 3.1;
            assert_eq!(unwound(near, more, std::f64::consts::FRAC_1_PI / 2.0), near + more);
        }
        assert!(unwound(f64::NAN, 0.0, 0.1).is_nan());
    }

    #[test]
    fn large_angles_and_infinities_are_the_standard_library_s() {
        let angles = [0.3, 1e7, f64::INFINITY, f64::NAN, -1e300];
        let mut out = [[0.0; 2]; 5];
        sin_cos(&angles, &mut out);
        assert_eq!(out[1], <[f64; 2]>::from(1e7_f64.sin_cos()));
        assert_eq!(out[4], <[f64; 2]>::from((-1e300_f64).sin_cos()));
        assert!(out[2][0].is_nan() && out[3][1].is_nan());
        assert_eq!(out[0][0], 0.3_f64.sin());
    }
}
