//! Random numbers without state: a hash of seed, stream and step.
//!
//! What a channel draws in a step depends on nothing else, so that a plant that is reset, restored or
//! replayed meets the same noise, and a channel added or taken away leaves that of the others alone.

use std::f64::consts::TAU;

/// Streams of one channel or fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stream(u64);

impl Stream {
    /// The stream of a name: of a channel or a fault.
    pub(crate) fn of(name: &str) -> Self {
        Self(hash(name.as_bytes()))
    }

    /// One of many streams beside this one.
    pub(crate) fn part(self, index: usize) -> Self {
        Self(mix(self.0 ^ (index as u64 + 1).wrapping_mul(GOLDEN)))
    }

    /// 64 bits of a step.
    fn bits(self, seed: u64, step: u64) -> u64 {
        mix(mix(mix(seed.wrapping_add(GOLDEN)) ^ self.0) ^ step.wrapping_mul(GOLDEN))
    }

    /// Uniform in (0, 1].
    pub(crate) fn uniform(self, seed: u64, step: u64) -> f64 {
        unit(self.bits(seed, step))
    }

    /// Normal, of mean 0 and variance 1 (Box and Muller 1958). The same bits on every target.
    pub(crate) fn normal(self, seed: u64, step: u64) -> f64 {
        let bits = self.bits(seed, step);
        let radius = (-2.0 * libm::log(unit(bits))).sqrt();
        radius * libm::cos(TAU * unit(mix(bits ^ GOLDEN)))
    }
}

/// The 64-bit FNV-1a hash.
pub(crate) fn hash(bytes: &[u8]) -> u64 {
    let byte = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, byte)
}

const GOLDEN: u64 = 0x9E37_79B9_7F4A_7C15;

/// The finalizer of SplitMix64 (Steele, Lea and Flood 2014).
fn mix(bits: u64) -> u64 {
    let z = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// 53 bits as a number in (0, 1].
fn unit(bits: u64) -> f64 {
    ((bits >> 11) + 1) as f64 / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    const COUNT: u64 = 200_000;
    /// Standard deviations by which a statistic may be off.
    const SIGMAS: f64 = 4.0;

    fn normals(seed: u64, stream: Stream) -> Vec<f64> {
        (0..COUNT).map(|step| stream.normal(seed, step)).collect()
    }

    fn moment(values: &[f64], power: i32) -> f64 {
        values.iter().map(|x| x.powi(power)).sum::<f64>() / values.len() as f64
    }

    fn assert_near(found: f64, expected: f64, variance_of_one: f64, what: &str) {
        let sigma = (variance_of_one / COUNT as f64).sqrt();
        assert!((found - expected).abs() < SIGMAS * sigma, "{what}: {found}, not {expected}");
    }

    #[test]
    fn moments_are_those_of_the_normal_distribution() {
        for seed in [0, 1, u64::MAX] {
            let values = normals(seed, Stream::of("angle"));
            // Variances of x, x², x³ and x⁴.
            assert_near(moment(&values, 1), 0.0, 1.0, "mean");
            assert_near(moment(&values, 2), 1.0, 2.0, "variance");
            assert_near(moment(&values, 3), 0.0, 15.0, "skewness");
            assert_near(moment(&values, 4), 3.0, 96.0, "kurtosis");
            let beyond = values.iter().filter(|x| x.abs() > 2.0).count() as f64 / COUNT as f64;
            let p: f64 = 0.045_500_263_896;
            assert_near(beyond, p, p * (1.0 - p), "beyond two sigma");
        }
    }

    #[test]
    fn steps_streams_parts_and_seeds_are_independent() {
        let product =
            |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>() / COUNT as f64;
        let (angle, cart) = (Stream::of("angle"), Stream::of("cart"));
        let values = normals(7, angle);
        for lag in [1, 2, 3, 64] {
            let pairs = product(&values[lag..], &values);
            assert_near(pairs, 0.0, 1.0, "lag");
        }
        for (other, what) in [
            (normals(8, angle), "seeds"),
            (normals(7, cart), "streams"),
            (normals(7, angle.part(0)), "parts"),
        ] {
            assert_near(product(&values, &other), 0.0, 1.0, what);
            let squares = |v: &[f64]| v.iter().map(|x| x * x - 1.0).collect::<Vec<_>>();
            assert_near(product(&squares(&values), &squares(&other)), 0.0, 4.0, what);
        }
    }

    #[test]
    fn uniform_numbers_fill_their_interval() {
        let stream = Stream::of("packet");
        let mut bins = [0.0_f64; 64];
        for step in 0..COUNT {
            let u = stream.uniform(3, step);
            assert!(u > 0.0 && u <= 1.0);
            bins[((u * 64.0) as usize).min(63)] += 1.0;
        }
        let expected = COUNT as f64 / 64.0;
        let chi: f64 = bins.iter().map(|n| (n - expected).powi(2) / expected).sum();
        // 63 degrees of freedom: mean 63, variance 126.
        assert!((chi - 63.0).abs() < SIGMAS * 126.0_f64.sqrt(), "{chi}");
    }
}
