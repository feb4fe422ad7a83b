//! Names as scenes spell them.

use std::collections::BTreeSet;

use plantd_models::scene::MAX_NAME_BYTES;

use crate::report::Name;

/// Names of one kind: ASCII letters, digits, hyphens and underscores, each of them once.
pub(crate) struct Names {
    of: &'static str,
    taken: BTreeSet<String>,
    /// Those that are spelled otherwise.
    pub(crate) changed: Vec<Name>,
}

impl Names {
    pub(crate) fn new(of: &'static str, taken: &[&str]) -> Self {
        let taken = taken.iter().map(|name| (*name).to_owned()).collect();
        Self { of, taken, changed: Vec::new() }
    }

    /// A name like `from` that is free together with what follows it, which is then taken.
    pub(crate) fn add(&mut self, from: &str, endings: &[&str]) -> String {
        let longest = endings.iter().map(|ending| ending.len()).max().unwrap_or_default();
        let plain: String = from.chars().map(|c| if is_plain(c) { c } else { '_' }).collect();
        let plain = if plain.is_empty() { "unnamed".to_owned() } else { plain };
        let mut number = 1;
        let name = loop {
            let suffix = if number == 1 { String::new() } else { format!("_{number}") };
            let room = MAX_NAME_BYTES - longest - suffix.len();
            let name = format!("{}{suffix}", &plain[..plain.len().min(room)]);
            if endings.iter().all(|ending| !self.taken.contains(&format!("{name}{ending}"))) {
                break name;
            }
            number += 1;
        };
        self.taken.extend(endings.iter().map(|ending| format!("{name}{ending}")));
        if name != from {
            self.changed.push(Name { of: self.of, from: from.to_owned(), to: name.clone() });
        }
        name
    }
}

fn is_plain(c: char) -> bool {
    c.is_ascii_alphanumeric() || c == '-' || c == '_'
}

/// The name of a scene: lower-case letters, digits and hyphens.
pub(crate) fn of_scene(from: &str, changed: &mut Vec<Name>) -> String {
    let plain = |c: char| {
        let c = c.to_ascii_lowercase();
        if c.is_ascii_lowercase() || c.is_ascii_digit() { c } else { '-' }
    };
    let name: String = from.chars().map(plain).take(63).collect();
    let trimmed = name.trim_matches('-');
    let name = if trimmed.is_empty() { "robot".to_owned() } else { trimmed.to_owned() };
    if name != from {
        changed.push(Name { of: "scene", from: from.to_owned(), to: name.clone() });
    }
    name
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_plain_and_unique_with_their_endings() {
        let mut names = Names::new("frame", &["world"]);
        let all: Vec<_> = ["left/hand", "left.hand", "left_hand", "world", "ä", ""]
            .map(|from| names.add(from, &[""]))
            .into();
        assert_eq!(all, ["left_hand", "left_hand_2", "left_hand_3", "world_2", "_", "unnamed"]);
        let long = names.add(&"x".repeat(100), &["", "_rx"]);
        assert_eq!(long.len(), MAX_NAME_BYTES - 3);
        assert_eq!(names.add(&"x".repeat(100), &[""]).len(), MAX_NAME_BYTES);
        assert_eq!(names.add("a_x", &[""]), "a_x");
        assert_eq!(names.add("a", &["_x", "_y"]), "a_2", "a_x is taken");
    }

    #[test]
    fn names_of_scenes() {
        let mut changed = Vec::new();
        assert_eq!(of_scene("panda", &mut changed), "panda");
        assert!(changed.is_empty());
        assert_eq!(of_scene("My Robot_2!", &mut changed), "my-robot-2");
        assert_eq!(of_scene("§", &mut changed), "robot");
        assert_eq!(changed.len(), 2);
    }
}
