//! Values that are a number or a name, and where among the fields of an element they stand.

use std::fmt;
use std::marker::PhantomData;

use serde::de::{Deserialize, Deserializer, Error, MapAccess, Unexpected, Visitor};

/// Sets a path within an element off from what is wrong there, in the message of an error: the derived code
/// of tagged elements reads them from a copy, and forgets where it is.
pub(super) const SEPARATOR: char = '\u{1f}';

/// Reads a field of a tagged element; errors say which field, and where in it.
pub(super) fn field<'de, T, D>(name: &str, deserializer: D) -> Result<T, D::Error>
where
    T: Deserialize<'de>,
    D: Deserializer<'de>,
{
    serde_path_to_error::deserialize(deserializer).map_err(|error| {
        let path = error.path();
        let within = if path.iter().next().is_none() { String::new() } else { path.to_string() };
        let problem = error.inner();
        D::Error::custom(format_args!("{SEPARATOR}{name}{within}{SEPARATOR}{problem}"))
    })
}

/// A number, or else the name of something.
pub(super) trait NumberOrName: Sized {
    /// What a number makes.
    const NUMBER: fn(f64) -> Self;
    /// What a name makes.
    const NAME: fn(String) -> Self;
    /// What is allowed, in words.
    const ALLOWED: &'static str;

    /// What a table makes, where one is allowed.
    fn table<'de, A: MapAccess<'de>>(table: A) -> Result<Self, A::Error> {
        let _ = table;
        Err(A::Error::invalid_type(Unexpected::Map, &Self::ALLOWED))
    }
}

/// Reads one or the other.
pub(super) fn number_or_name<'de, T, D>(deserializer: D) -> Result<T, D::Error>
where
    T: NumberOrName,
    D: Deserializer<'de>,
{
    deserializer.deserialize_any(Either(PhantomData))
}

struct Either<T>(PhantomData<T>);

impl<'de, T: NumberOrName> Visitor<'de> for Either<T> {
    type Value = T;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(T::ALLOWED)
    }

    fn visit_f64<E: Error>(self, number: f64) -> Result<T, E> {
        Ok(T::NUMBER(number))
    }

    fn visit_i64<E: Error>(self, number: i64) -> Result<T, E> {
        Ok(T::NUMBER(number as f64))
    }

    fn visit_u64<E: Error>(self, number: u64) -> Result<T, E> {
        Ok(T::NUMBER(number as f64))
    }

    fn visit_str<E: Error>(self, name: &str) -> Result<T, E> {
        Ok(T::NAME(name.to_owned()))
    }

    fn visit_map<A: MapAccess<'de>>(self, table: A) -> Result<T, A::Error> {
        T::table(table)
    }
}
