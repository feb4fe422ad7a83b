//! Numbers on the command line.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};

use anyhow::{Result, bail};
use plantd_client::v1;
use plantd_scene::UnknownName;
use schemars::JsonSchema;
use serde::Deserialize;

/// Comma-separated numbers.
#[derive(Clone, Debug)]
pub(crate) struct Numbers(pub(crate) Vec<f64>);

/// A diagonal weight; one number stands for all entries.
fn diagonal(values: &[f64], count: usize) -> v1::Weight {
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

/// A vector: all its numbers, or some of them by their names.
#[derive(Clone, Debug, Deserialize)]
#[serde(from = "Entries")]
pub(crate) enum Vector {
    All(Vec<f64>),
    Named(Vec<Assignment>),
}

/// A vector in a file: a list of all numbers, or a table of some by their names.
#[derive(Deserialize, JsonSchema)]
#[serde(untagged, expecting = "a list of numbers, or a table of numbers by their names, is needed")]
enum Entries {
    All(Vec<f64>),
    Named(BTreeMap<String, f64>),
}

impl From<Entries> for Vector {
    fn from(entries: Entries) -> Self {
        match entries {
            Entries::All(numbers) => Self::All(numbers),
            Entries::Named(named) => Self::Named(
                named.into_iter().map(|(name, value)| Assignment(name, value)).collect(),
            ),
        }
    }
}

impl JsonSchema for Vector {
    fn schema_name() -> Cow<'static, str> {
        "Vector".into()
    }

    fn json_schema(generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
        Entries::json_schema(generator)
    }
}

/// Reads comma-separated numbers, or `name=value` with commas between.
pub(crate) fn vector(text: &str) -> Result<Vector, String> {
    match text.contains('=') {
        true => text.split(',').map(assignment).collect::<Result<_, _>>().map(Vector::Named),
        false => Ok(Vector::All(numbers(text)?.0)),
    }
}

impl Vector {
    pub(crate) fn is_named(&self) -> bool {
        matches!(self, Self::Named(_))
    }

    /// All its numbers: those of entries that are not named are those of `rest`. What is given without names is for
    /// the server to judge. A name may have the vector's before it, `q.theta`.
    pub(crate) fn over<N: AsRef<str>>(
        &self,
        what: &str,
        names: &[N],
        rest: &[f64],
    ) -> Result<Vec<f64>> {
        let named = match self {
            Self::All(numbers) => return Ok(numbers.clone()),
            Self::Named(named) => named,
        };
        let mut all = rest.to_vec();
        all.resize(names.len(), 0.0);
        for Assignment(given, value) in named {
            let bare = given.strip_prefix(what).and_then(|rest| rest.strip_prefix('.'));
            let is_meant = |name: &N| name.as_ref() == given || Some(name.as_ref()) == bare;
            match names.iter().position(is_meant) {
                Some(index) => all[index] = *value,
                None => bail!("{what}: there is no {}", UnknownName::among(given, names)),
            }
        }
        Ok(all)
    }

    /// A diagonal weight: one number stands for all entries, and entries that are not named have `rest`.
    pub(crate) fn diagonal<N: AsRef<str>>(
        &self,
        what: &str,
        names: &[N],
        rest: f64,
    ) -> Result<v1::Weight> {
        let values = self.over(what, names, &vec![rest; names.len()])?;
        Ok(diagonal(&values, names.len()))
    }
}

/// The numbers of an option; none if it was not given. Entries that are not named are zero.
pub(crate) fn given<N: AsRef<str>>(
    vector: Option<&Vector>,
    what: &str,
    names: &[N],
) -> Result<Vec<f64>> {
    vector.map_or_else(|| Ok(Vec::new()), |vector| vector.over(what, names, &[]))
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
        assert!(vector("a=1,b").unwrap_err().contains("`=`"));
    }

    #[test]
    fn entries_have_names() {
        let names = ["x", "theta"];
        let over = |text: &str| vector(text).unwrap().over("q", &names, &[5.0, 6.0]);
        assert_eq!(over("1,2,3").unwrap(), [1.0, 2.0, 3.0]);
        assert_eq!(over("theta=0.5").unwrap(), [5.0, 0.5]);
        assert_eq!(over("q.theta=0.5, x=-1").unwrap(), [-1.0, 0.5]);
        let error = over("tetha=1").unwrap_err().to_string();
        assert_eq!(error, "q: there is no `tetha`; did you mean `theta`?");
    }
}
