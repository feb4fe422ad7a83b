//! What cargo tells programs.

use std::collections::BTreeSet;
use std::path::PathBuf;

/// Something that was compiled, or was there already.
#[derive(Debug, PartialEq)]
pub(crate) struct Artifact {
    /// Name of its package.
    pub(crate) package: String,
    /// Where it is, if it is a program.
    pub(crate) executable: Option<PathBuf>,
}

impl Artifact {
    /// Reads a line of `--message-format json`; none if it tells of something else.
    pub(crate) fn read(line: &str) -> Option<Self> {
        let is_artifact = text(line, "reason")? == "compiler-artifact";
        let executable = text(line, "executable").map(PathBuf::from);
        is_artifact.then_some(Self { package: text(line, "package_id")?, executable })
    }
}

/// A text of an object, by its key.
fn text(line: &str, key: &str) -> Option<String> {
    let start = line.find(&format!("\"{key}\":\""))? + key.len() + 4;
    let mut text = String::new();
    let mut characters = line[start..].chars();
    loop {
        match characters.next()? {
            '"' => return Some(text),
            // Paths and names have no other escapes than these.
            '\\' => text.push(characters.next()?),
            other => text.push(other),
        }
    }
}

/// Packages in the output of `cargo tree --prefix none`, which names some more than once.
pub(crate) fn count_packages(tree: &str) -> usize {
    let name = |line: &str| {
        let mut words = line.split_whitespace();
        Some((
            words.next()?.to_owned(),
            words.next().filter(|word| word.starts_with('v'))?.to_owned(),
        ))
    };
    tree.lines().filter_map(name).collect::<BTreeSet<_>>().len()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn programs_and_libraries_are_told_apart() {
        let library = r#"{"reason":"compiler-artifact","package_id":"registry+x#libc@0.2.1","target":{"name":"libc"},"executable":null,"fresh":true}"#;
        let expected = Artifact { package: "registry+x#libc@0.2.1".to_owned(), executable: None };
        assert_eq!(Artifact::read(library), Some(expected));
        let program = r#"{"reason":"compiler-artifact","package_id":"path+file:///a#b","executable":"/a \"b\"/demo"}"#;
        let executable = Artifact::read(program).unwrap().executable;
        assert_eq!(executable, Some(PathBuf::from("/a \"b\"/demo")));
        assert_eq!(Artifact::read(r#"{"reason":"build-finished","success":true}"#), None);
    }

    #[test]
    fn packages_are_counted_once() {
        let tree = "a v0.1.0 (/a)\nlibc v0.2.1\nb v1.0.0 (proc-macro)\nlibc v0.2.1 (*)\n\n[build-dependencies]\n";
        assert_eq!(count_packages(tree), 3);
    }
}
