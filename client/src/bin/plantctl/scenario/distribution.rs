//! Random numbers without a state: a hash of the seed and of what is drawn.

use std::f64::consts::TAU;

use schemars::JsonSchema;
use serde::Deserialize;

/// How a number is drawn.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum Distribution {
    /// Anything from the first number to the second.
    Uniform([f64; 2]),
    /// Mean and standard deviation of a normal distribution.
    Normal([f64; 2]),
}

impl Distribution {
    /// Refuses what cannot be drawn from.
    pub(crate) fn check(self) -> Result<(), String> {
        let (name, [a, b], is_good) = match self {
            Self::Uniform([a, b]) => ("uniform", [a, b], a <= b),
            Self::Normal([a, b]) => ("normal", [a, b], b >= 0.0),
        };
        match is_good && a.is_finite() && b.is_finite() {
            true => Ok(()),
            false => Err(format!("{name} = [{a}, {b}] is no distribution")),
        }
    }

    /// The number of that name.
    pub(crate) fn draw(self, seed: u64, name: &str) -> f64 {
        let key = hash(seed, name);
        match self {
            Self::Uniform([a, b]) => a + (b - a) * uniform(key, 0),
            Self::Normal([mean, deviation]) => {
                // Box and Muller; 1 - u is never zero.
                let radius = (-2.0 * (1.0 - uniform(key, 0)).ln()).sqrt();
                mean + deviation * radius * (TAU * uniform(key, 1)).cos()
            }
        }
    }
}

/// The seed of a case.
pub(crate) fn case_seed(seed: u64, number: u64) -> u64 {
    mix(seed.wrapping_add(mix(number)))
}

fn hash(seed: u64, name: &str) -> u64 {
    name.bytes().fold(mix(seed), |hash, byte| mix(hash ^ u64::from(byte)))
}

/// In [0, 1), of 53 bits.
fn uniform(key: u64, index: u64) -> f64 {
    (mix(key ^ mix(index)) >> 11) as f64 / (1_u64 << 53) as f64
}

/// SplitMix64 (Steele, Lea, Flood 2014): one step of its sequence from `z`.
fn mix(z: u64) -> u64 {
    let z = z.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_generator_is_the_published_one() {
        // The first number of SplitMix64 with the seed 1234567.
        assert_eq!(mix(1_234_567), 6_457_827_717_110_365_317);
    }

    #[test]
    fn moments_are_those_of_the_distributions() {
        let n = 20_000;
        let moments = |distribution: Distribution| {
            let draws: Vec<_> = (0..n).map(|i| distribution.draw(case_seed(3, i), "q.a")).collect();
            let mean = draws.iter().sum::<f64>() / n as f64;
            let variance = draws.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n as f64;
            (mean, variance)
        };
        // Five standard errors of each.
        let root = (n as f64).sqrt();
        let (mean, variance) = moments(Distribution::Uniform([1.0, 3.0]));
        assert!((mean - 2.0).abs() < 5.0 / 3.0_f64.sqrt() / root, "{mean}");
        assert!((variance - 1.0 / 3.0).abs() < 5.0 * (4.0 / 45.0_f64).sqrt() / root, "{variance}");
        let (mean, variance) = moments(Distribution::Normal([-1.0, 2.0]));
        assert!((mean + 1.0).abs() < 5.0 * 2.0 / root, "{mean}");
        assert!((variance - 4.0).abs() < 5.0 * 4.0 * 2.0_f64.sqrt() / root, "{variance}");
    }

    #[test]
    fn names_and_seeds_make_other_numbers() {
        let draw = |seed, name| Distribution::Uniform([0.0, 1.0]).draw(seed, name);
        assert_eq!(draw(1, "q.a"), draw(1, "q.a"));
        assert_ne!(draw(1, "q.a"), draw(2, "q.a"));
        assert_ne!(draw(1, "q.a"), draw(1, "q.b"));
        assert!(Distribution::Normal([0.0, -1.0]).check().is_err());
        assert!(Distribution::Uniform([0.0, f64::NAN]).check().is_err());
    }
}
