//! The documents stay true: examples are the files they claim to be, and links lead somewhere.

use std::path::{Path, PathBuf};

const DOCUMENTS: &[&str] = &[
    "README.md",
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "client/python/README.md",
    "client/TESTING.md",
    "server/REALTIME.md",
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn read(path: &str) -> String {
    let path = root().join(path);
    std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

#[test]
fn examples_in_the_readme_are_files_that_are_tested() {
    let readme = read("README.md");
    for (language, file) in [
        ("python", "client/python/examples/pendulum_lqr.py"),
        ("python", "client/python/examples/swing_up.py"),
        ("toml", "models/scenes/cart-pole.toml"),
    ] {
        let block = format!("```{language}\n{}\n```", read(file).trim());
        assert!(readme.contains(&block), "README.md does not show {file} as it is");
    }
}

#[test]
fn links_between_files_lead_somewhere() {
    for document in DOCUMENTS {
        let text = read(document);
        let folder = root().join(document);
        let folder = folder.parent().expect("a document is in a folder");
        for target in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            let file = target.split('#').next().unwrap_or_default();
            let exists = target.starts_with("https://") || folder.join(file).exists();
            assert!(exists, "{document}: link to {target}");
        }
    }
}

#[test]
fn the_code_map_names_what_exists() {
    let text = read("ARCHITECTURE.md");
    let paths: Vec<&str> = text
        .lines()
        .filter_map(|line| line.strip_prefix("| `")?.split('`').next())
        .filter(|name| name.contains('/'))
        .collect();
    assert!(paths.len() > 10, "the code map has rows");
    for path in paths {
        assert!(root().join(path).exists(), "ARCHITECTURE.md: `{path}` does not exist");
    }
}
