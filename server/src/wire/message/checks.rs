//! Checks of what requests carry: names, pages, numbers.

use plantd_proto::v1;

use crate::wire::status::RpcError;

/// Checks a name or an id: lower-case letters, digits and hyphens, 1 to 63 of them.
pub fn check_name(field: &'static str, name: &str) -> Result<(), RpcError> {
    let is_allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
    if name.is_empty() || name.len() > 63 || !name.chars().all(is_allowed) {
        return Err(RpcError::field(
            field,
            "must be lower-case letters, digits and hyphens, 1 to 63 of them",
        ));
    }
    Ok(())
}

/// A request's page: how many entries, and the name after which they start.
pub fn page(size: i32, token: &str) -> Result<(usize, &str), RpcError> {
    const DEFAULT: usize = 100;
    const MAX: usize = 1000;
    if !token.is_empty() {
        check_name("page_token", token)?;
    }
    match usize::try_from(size) {
        Ok(0) => Ok((DEFAULT, token)),
        Ok(size) => Ok((size.min(MAX), token)),
        Err(_) => Err(RpcError::field("page_size", "must not be negative")),
    }
}

pub(super) fn check_shape(field: &str, matrix: &v1::Matrix) -> Result<(), RpcError> {
    let expected = u64::from(matrix.rows) * u64::from(matrix.cols);
    if matrix.data.len() as u64 != expected {
        return Err(RpcError::field(
            format!("{field}.data"),
            format!(
                "has {} entries; {} rows of {} are {expected}",
                matrix.data.len(),
                matrix.rows,
                matrix.cols
            ),
        ));
    }
    check_finite(&format!("{field}.data"), &matrix.data)
}

/// Checks a vector's length, and that its entries are finite.
pub fn check_numbers(field: &str, numbers: &[f64], expected: usize) -> Result<(), RpcError> {
    if numbers.len() != expected {
        let problem = format!("has {} entries; {expected} are needed", numbers.len());
        return Err(RpcError::field(field, problem));
    }
    check_finite(field, numbers)
}

/// Checks that numbers are finite.
pub fn check_finite(field: &str, numbers: &[f64]) -> Result<(), RpcError> {
    match numbers.iter().position(|number| !number.is_finite()) {
        Some(index) => {
            Err(RpcError::field(format!("{field}[{index}]"), format!("is {}", numbers[index])))
        }
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_pages() {
        assert!(check_name("id", "a-1").is_ok());
        for name in ["", "A", "a_b", &"a".repeat(64)] {
            assert!(check_name("id", name).is_err(), "{name}");
        }
        assert_eq!(page(0, "").unwrap(), (100, ""));
        assert_eq!(page(i32::MAX, "a").unwrap(), (1000, "a"));
        assert!(page(-1, "").is_err());
    }
}
