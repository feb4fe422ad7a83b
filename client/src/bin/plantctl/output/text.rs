//! Numbers for people.

pub(crate) use plantd_expect::short;

/// The name of an entry, or its index if it has none.
pub(crate) fn label(names: &[String], index: usize) -> String {
    names.get(index).cloned().unwrap_or_else(|| index.to_string())
}

/// A number with seven significant digits.
pub(crate) fn number(x: f64) -> String {
    let magnitude = x.abs();
    if x == 0.0 {
        "0".to_owned()
    } else if !x.is_finite() {
        x.to_string()
    } else if (1e-4..1e7).contains(&magnitude) {
        let before_point = magnitude.log10().floor() as i32 + 1;
        format!("{x:.*}", (7 - before_point).clamp(0, 10) as usize)
    } else {
        format!("{x:.6e}")
    }
}

/// Numbers, comma-separated.
pub(crate) fn numbers(values: &[f64]) -> String {
    values.iter().map(|&x| number(x)).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_keep_seven_digits() {
        for (x, text) in [
            (0.0, "0"),
            (0.95333434, "0.9533343"),
            (-12.5, "-12.50000"),
            (0.000976, "0.0009760000"),
            (1e-9, "1.000000e-9"),
            (123456.0, "123456.0"),
        ] {
            assert_eq!(number(x), text);
        }
    }
}
