//! Numbers on the command line.

use std::collections::HashMap;

use plantd_client::v1;

/// Comma-separated numbers.
#[derive(Clone, Debug)]
pub(crate) struct Numbers(pub(crate) Vec<f64>);

impl Numbers {
    /// A diagonal weight; one number stands for all entries.
    pub(crate) fn diagonal(&self, count: usize) -> v1::Weight {
        diagonal(&self.0, count)
    }
}

/// A diagonal weight; one number stands for all entries.
pub(crate) fn diagonal(values: &[f64], count: usize) -> v1::Weight {
    match values {
        [value] => plantd_client::diagonal(vec![*value; count]),
        values => plantd_client::diagonal(values),
    }
}

/// The numbers of an option; none if it was not given.
pub(crate) fn or_empty(given: Option<Numbers>) -> Vec<f64> {
    given.map_or_else(Vec::new, |numbers| numbers.0)
}

/// Reads comma-separated numbers.
pub(crate) fn numbers(text: &str) -> Result<Numbers, String> {
    let number = |entry: &str| {
        entry.trim().parse().map_err(|_| format!("`{}` is not a number", entry.trim()))
    };
    text.split(',').map(number).collect::<Result<_, _>>().map(Numbers)
}

/// A named value.
#[derive(Clone, Debug)]
pub(crate) struct Assignment(pub(crate) String, pub(crate) f64);

/// Reads `name=value`.
pub(crate) fn assignment(text: &str) -> Result<Assignment, String> {
    let (name, value) = text.split_once('=').ok_or("a name and a value with `=` are needed")?;
    let number = value.trim().parse();
    let number = number.map_err(|_| format!("`{}` is not a number", value.trim()))?;
    Ok(Assignment(name.trim().to_owned(), number))
}

/// Named values as the contract has them.
pub(crate) fn by_name(given: Vec<Assignment>) -> HashMap<String, f64> {
    given.into_iter().map(|Assignment(name, value)| (name, value)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_a_number_is_named() {
        assert_eq!(numbers("-1, 2e-3").unwrap().0, [-1.0, 2e-3]);
        assert!(numbers("1,x").unwrap_err().contains("`x`"));
        assert!(assignment("a=x").unwrap_err().contains("`x`") && assignment("a").is_err());
    }
}
