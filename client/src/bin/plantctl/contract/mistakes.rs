//! What is wrong with a message of the contract as a person has written it: the first mistake, by its path.

use plantd_scene::UnknownName;
use prost_reflect::{EnumDescriptor, FieldDescriptor, Kind, MessageDescriptor};
use serde_json::{Map, Value};

/// Looks through what shall be a message.
///
/// # Errors
/// The path of a mistake, what is there, and what may be.
pub(crate) fn check(message: &MessageDescriptor, given: &Value) -> Result<(), String> {
    in_message(message, given, "")
}

fn in_message(message: &MessageDescriptor, given: &Value, path: &str) -> Result<(), String> {
    let given = given.as_object().ok_or_else(|| instead(path, given, "a table"))?;
    // What belongs to no message of the project is read by its own rules.
    if message.package_name() != "plantd.v1" {
        return Ok(());
    }
    for (key, value) in given {
        let by_name = message.get_field_by_name(key);
        let field = by_name.or_else(|| message.get_field_by_json_name(key)).ok_or_else(|| {
            let names: Vec<String> = message.fields().map(|f| f.name().to_owned()).collect();
            format!("{}there is no key {}", prefix(path), UnknownName::among(key, names))
        })?;
        let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
        in_field(&field, value, &path)?;
    }
    only_one(message, given, path)
}

/// Of alternatives one may be given.
fn only_one(
    message: &MessageDescriptor,
    given: &Map<String, Value>,
    path: &str,
) -> Result<(), String> {
    for choice in message.oneofs() {
        let is_given = |field: &FieldDescriptor| given.contains_key(field.name());
        let names: Vec<_> = choice.fields().filter(is_given).map(|f| f.name().to_owned()).collect();
        if names.len() > 1 {
            return Err(format!("{}give one of `{}`", prefix(path), names.join("` and `")));
        }
    }
    Ok(())
}

fn in_field(field: &FieldDescriptor, given: &Value, path: &str) -> Result<(), String> {
    if given.is_null() {
        return Ok(());
    }
    if field.is_map() {
        let kind = field.kind();
        let entry = kind.as_message().ok_or("a map has entries")?;
        let table = given.as_object().ok_or_else(|| instead(path, given, "a table"))?;
        let mut values = table.iter();
        return values.try_for_each(|(key, value)| {
            in_kind(&entry.map_entry_value_field().kind(), value, &format!("{path}.{key}"))
        });
    }
    if field.is_list() {
        let list = given.as_array().ok_or_else(|| instead(path, given, "a list"))?;
        let mut values = list.iter().enumerate();
        return values.try_for_each(|(index, value)| {
            in_kind(&field.kind(), value, &format!("{path}[{index}]"))
        });
    }
    in_kind(&field.kind(), given, path)
}

fn in_kind(kind: &Kind, given: &Value, path: &str) -> Result<(), String> {
    let is_whole = || {
        // Programs write large numbers as text.
        given.is_i64()
            || given.is_u64()
            || given.as_str().is_some_and(|s| s.parse::<i128>().is_ok())
    };
    let (is_good, needed) = match kind {
        Kind::Message(message) => return in_message(message, given, path),
        Kind::Enum(words) => return in_enum(words, given, path),
        Kind::Double | Kind::Float => {
            (given.is_number() || given.as_str().is_some_and(is_no_number), "a number")
        }
        Kind::Bool => (given.is_boolean(), "`true` or `false`"),
        Kind::String => (given.is_string(), "a text"),
        Kind::Bytes => (given.is_string(), "bytes in Base64"),
        Kind::Uint32 | Kind::Uint64 | Kind::Fixed32 | Kind::Fixed64 => {
            let is_negative = given.as_i64().is_some_and(|n| n < 0);
            (is_whole() && !is_negative, "a whole number that is not negative")
        }
        _ => (is_whole(), "a whole number"),
    };
    if is_good { Ok(()) } else { Err(instead(path, given, needed)) }
}

/// What JSON has no numbers for.
fn is_no_number(text: &str) -> bool {
    ["NaN", "Infinity", "-Infinity"].contains(&text)
}

fn in_enum(words: &EnumDescriptor, given: &Value, path: &str) -> Result<(), String> {
    let Some(word) = given.as_str() else {
        return if given.is_i64() { Ok(()) } else { Err(instead(path, given, "a word")) };
    };
    if words.get_value_by_name(word).is_some() {
        return Ok(());
    }
    let allowed = words.values().filter(|value| value.number() != 0);
    let allowed: Vec<String> = allowed.map(|value| value.name().to_owned()).collect();
    Err(format!("{}there is no {}", prefix(path), UnknownName::among(word, allowed)))
}

fn instead(path: &str, given: &Value, needed: &str) -> String {
    let given = match given {
        Value::Null => "nothing".to_owned(),
        Value::Array(list) => format!("a list of {}", list.len()),
        Value::Object(_) => "a table".to_owned(),
        plain => plain.to_string(),
    };
    format!("{}{given} is given; {needed} is needed", prefix(path))
}

fn prefix(path: &str) -> String {
    if path.is_empty() { String::new() } else { format!("{path}: ") }
}
