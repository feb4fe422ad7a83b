//! What SECURITY.md says of the code itself: how much of it is unsafe, and that the tests exist which it names.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use proc_macro2::{Delimiter, TokenStream, TokenTree};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Rows of the table of SECURITY.md that stands under this heading, cell by cell.
fn table(heading: &str) -> Vec<Vec<String>> {
    let text = std::fs::read_to_string(root().join("SECURITY.md")).expect("a file");
    let part = text.split("\n## ").find(|part| part.starts_with(heading)).expect("the heading");
    let rows = part.lines().filter_map(|line| line.strip_prefix("| ")?.strip_suffix(" |"));
    // The first two are its head.
    rows.skip(2).map(|row| row.split(" | ").map(|cell| cell.trim().to_owned()).collect()).collect()
}

/// Sources under a folder, without what is built or fetched.
fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        let name = path.file_name().and_then(|name| name.to_str()).expect("UTF-8");
        if path.is_dir() && !name.starts_with('.') && !["target", "node_modules"].contains(&name) {
            sources(&path, found);
        } else if path.extension().is_some_and(|end| end == "rs") {
            found.push(path);
        }
    }
}

/// How often code is marked as unsafe; attributes are not counted.
fn count_unsafe(tokens: TokenStream) -> u64 {
    let mut tokens = tokens.into_iter().peekable();
    let mut count = 0;
    while let Some(token) = tokens.next() {
        match token {
            TokenTree::Group(group) => count += count_unsafe(group.stream()),
            TokenTree::Ident(ident) if ident == "unsafe" => {
                let is_attribute = matches!(
                    tokens.peek(),
                    Some(TokenTree::Group(group)) if group.delimiter() == Delimiter::Parenthesis
                );
                count += u64::from(!is_attribute);
            }
            _ => {}
        }
    }
    count
}

/// The folder of the crate to which a source belongs, seen from the top.
fn crate_of(path: &Path) -> String {
    let mut folders = path.ancestors().skip(1);
    let own = folders.find(|folder| folder.join("Cargo.toml").is_file()).expect("a crate");
    own.strip_prefix(root()).expect("it is in the workspace").display().to_string()
}

#[test]
fn what_is_unsafe_stands_in_a_table() {
    let mut paths = Vec::new();
    sources(&root(), &mut paths);
    assert!(paths.len() > 300, "{}", paths.len());
    let mut counts: BTreeMap<String, u64> = BTreeMap::new();
    for path in paths {
        let text = std::fs::read_to_string(&path).expect("a file");
        let tokens: TokenStream = text.parse().expect("it is Rust");
        let count = count_unsafe(tokens);
        if count > 0 {
            *counts.entry(crate_of(&path)).or_default() += count;
        }
    }
    let told = table("Unsafe code");
    let told: BTreeMap<String, u64> = told
        .iter()
        .map(|row| (row[0].trim_matches('`').to_owned(), row[1].parse().expect("a number")))
        .collect();
    assert_eq!(counts, told, "left what there is, right what SECURITY.md says");
}

#[test]
fn the_tests_exist_that_are_named() {
    let mut paths = Vec::new();
    sources(&root(), &mut paths);
    let rows = table("Who could want what");
    assert!(rows.len() > 10);
    let mut count = 0;
    for row in rows {
        let [who, .., named] = &row[..] else { panic!("{row:?}") };
        let is_tested = named.contains("`") || row[2].starts_with("nothing");
        assert!(is_tested, "{who} wants {}, and no test shows that it is kept", row[1]);
        let mut text = String::new();
        for word in named.split('`').skip(1).step_by(2) {
            if word.ends_with(".rs") {
                let path = paths.iter().find(|path| path.ends_with(word));
                let path = path.unwrap_or_else(|| panic!("there is no {word}"));
                text = std::fs::read_to_string(path).expect("a file");
            } else if word.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
                && word.contains('_')
            {
                assert!(text.contains(&format!("fn {word}(")), "{who}: there is no test `{word}`");
                count += 1;
            }
        }
    }
    assert!(count > 20, "{count}");
}
