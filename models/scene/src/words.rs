//! What is said of names that nothing has, and of text that is no scene.

use std::fmt;

/// Names beyond this length are not compared with others.
const COMPARED_BYTES_MAX: usize = 128;
/// Most names that are listed.
const LISTED_MAX: usize = 12;

/// A name that nothing has. Displayed as the name with what to write instead.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnknownName {
    /// The name.
    pub name: String,
    /// `; did you mean ...?`, or the names that there are.
    instead: String,
}

impl UnknownName {
    /// A name that is not among those that there are.
    pub fn among<N: AsRef<str>>(name: &str, names: impl IntoIterator<Item = N>) -> Self {
        let names: Vec<N> = names.into_iter().collect();
        let near = if name.len() <= COMPARED_BYTES_MAX { nearest(name, &names) } else { None };
        let instead = match (near, names.len()) {
            (Some(near), _) => format!("; did you mean `{near}`?"),
            (None, 0) => "; there is none".to_owned(),
            (None, 1) => format!("; there is `{}`", names[0].as_ref()),
            (None, 2..=LISTED_MAX) => {
                let names: Vec<String> =
                    names.iter().map(|name| format!("`{}`", name.as_ref())).collect();
                format!("; there are {}", names.join(", "))
            }
            (None, _) => String::new(),
        };
        Self { name: name.to_owned(), instead }
    }
}

impl fmt::Display for UnknownName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "`{}`{}", self.name, self.instead)
    }
}

/// The name that was probably meant: two fifths of its letters are wrong at most.
fn nearest<'a, N: AsRef<str>>(name: &str, names: &'a [N]) -> Option<&'a str> {
    let lower = name.to_lowercase();
    let distance = |other: &&str| strsim::damerau_levenshtein(&lower, &other.to_lowercase());
    let all = names.iter().map(AsRef::as_ref).filter(|other| other.len() <= COMPARED_BYTES_MAX);
    let near = all.min_by_key(distance)?;
    let bound = (2 * lower.chars().count().max(near.chars().count()) / 5).max(1);
    // Of names of one letter every other one is as near.
    (lower.chars().count() > 1 && distance(&near) <= bound).then_some(near)
}

/// The line, counted from 1, in which a text has its byte `at`.
pub fn line_of(text: &str, at: usize) -> usize {
    text.bytes().take(at).filter(|byte| *byte == b'\n').count() + 1
}

/// The message of a reader of text in the words of a person who writes it: a key or a kind that there is
/// not, one that is missing, and a value of another type. What is none of these stays as it is.
pub fn in_plain_words(message: &str) -> String {
    let message = message.trim_end();
    in_words(message).unwrap_or_else(|| message.to_owned())
}

fn in_words(message: &str) -> Option<String> {
    if let Some(key) = message.strip_prefix("missing field ") {
        return Some(format!("{key} is missing"));
    }
    for (start, what) in [("unknown field `", "key "), ("unknown variant `", "")] {
        let Some(rest) = message.strip_prefix(start) else { continue };
        let (name, expected) = rest.split_once('`')?;
        let names: Vec<&str> = expected.split('`').skip(1).step_by(2).collect();
        return Some(format!("there is no {what}{}", UnknownName::among(name, names)));
    }
    for start in ["invalid type: ", "invalid value: ", "invalid length "] {
        let Some(rest) = message.strip_prefix(start) else { continue };
        let (given, needed) = rest.split_once(", expected ")?;
        let given = match (start, given) {
            ("invalid length ", count) => format!("a list of {count}"),
            (_, "map") => "a table".to_owned(),
            (_, "sequence") => "a list".to_owned(),
            (_, "unit value" | "null") => "nothing".to_owned(),
            (_, given) => given.replace("floating point", "number").replace("integer", "number"),
        };
        let needed = match needed {
            "f64" => "a number",
            "u32" | "u64" | "usize" => "a whole number that is not negative",
            "i32" | "i64" => "a whole number",
            "a sequence" => "a list",
            "a map" => "a table",
            "a boolean" => "`true` or `false`",
            needed if needed.starts_with("struct ") || needed.starts_with("internally tagged") => {
                "a table"
            }
            needed => needed,
        };
        let needed = needed.replace("an array of length", "a list of");
        return Some(format!("{given} is given; {needed} is needed"));
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_told_what_it_was_probably_meant_to_be() {
        let among = |name, names: &[&str]| UnknownName::among(name, names).to_string();
        assert_eq!(
            among("pendulm", &["cart-pole", "pendulum"]),
            "`pendulm`; did you mean `pendulum`?"
        );
        assert_eq!(among("Theta", &["x", "theta"]), "`Theta`; did you mean `theta`?");
        assert_eq!(among("y", &["x", "theta"]), "`y`; there are `x`, `theta`");
        assert_eq!(among("force", &["torque"]), "`force`; there is `torque`");
        assert_eq!(among("a", &[]), "`a`; there is none");
        let many: Vec<String> = (0..99).map(|i| format!("joint_of_leg_{i}")).collect();
        assert_eq!(UnknownName::among("arm", many).to_string(), "`arm`");
        let long = "x".repeat(10_000);
        assert_eq!(UnknownName::among(&long, ["b"]).to_string(), format!("`{long}`; there is `b`"));
    }

    #[test]
    fn messages_of_readers_are_put_in_plain_words() {
        for (message, words) in [
            (
                "unknown field `mas`, expected one of `mass`, `inertia`",
                "there is no key `mas`; did you mean `mass`?",
            ),
            ("unknown field `a`, there are no fields", "there is no key `a`; there is none"),
            (
                "unknown variant `bal`, expected `ball` or `free`",
                "there is no `bal`; did you mean `ball`?",
            ),
            ("missing field `frames`", "`frames` is missing"),
            (
                "invalid type: string \"1\", expected f64",
                "string \"1\" is given; a number is needed",
            ),
            (
                "invalid type: floating point `1.5`, expected u32",
                "number `1.5` is given; a whole number that is not negative is needed",
            ),
            (
                "invalid length 2, expected an array of length 3",
                "a list of 2 is given; a list of 3 is needed",
            ),
            ("expected value at line 1", "expected value at line 1"),
        ] {
            assert_eq!(in_plain_words(message), words);
        }
    }
}
