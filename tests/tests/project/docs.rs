//! The documents stay true: examples are the files they claim to be, and links lead somewhere.

use std::path::{Path, PathBuf};
use std::process::Command;

const DOCUMENTS: &[&str] = &[
    "README.md",
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "docs/control.md",
    "docs/deployment.md",
    "docs/figures.md",
    "docs/limits.md",
    "docs/recording.md",
    "docs/robots.md",
    "docs/several.md",
    "docs/theory.md",
    "docs/tutorial.md",
    "docs/view.md",
    "client/python/README.md",
    "client/TESTING.md",
    "client/FMI.md",
    "client/c/README.md",
    "models/ACCURACY.md",
    "models/scenes/ELEMENTS.md",
    "server/REALTIME.md",
    "tests/peers/README.md",
    "tests/peers/SURVIVAL.md",
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn read(path: &str) -> String {
    let path = root().join(path);
    std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

#[test]
fn examples_in_documents_are_files_that_are_tested() {
    for (document, language, file) in [
        ("README.md", "python", "client/python/examples/balance.py"),
        ("docs/control.md", "python", "client/python/examples/swing_up.py"),
    ] {
        let block = format!("```{language}\n{}\n```", read(file).trim());
        assert!(read(document).contains(&block), "{document} does not show {file} as it is");
    }
}

#[test]
fn the_readme_is_one_page() {
    assert!(read("README.md").lines().count() <= 130, "README.md has more than 130 lines");
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
fn the_site_has_every_document() {
    let summary = read("docs/SUMMARY.md");
    for document in DOCUMENTS {
        let path = document.strip_prefix("docs/").map_or(format!("../{document}"), str::to_owned);
        assert!(summary.contains(&format!("]({path})")), "docs/SUMMARY.md has no {document}");
    }
}

#[test]
fn the_code_map_covers_every_file() {
    let text = read("ARCHITECTURE.md");
    let map = text.split("## Code map").nth(1).and_then(|rest| rest.split("\n## ").next());
    let rows = map
        .expect("a code map")
        .lines()
        .filter_map(|line| line.strip_prefix("| `")?.split(" |").next());
    let is_path = |part: &&str| part.starts_with(|first: char| first.is_ascii_lowercase());
    let paths: Vec<&str> = rows.flat_map(|cell| cell.split('`').filter(is_path)).collect();
    for path in &paths {
        assert!(root().join(path).is_dir(), "ARCHITECTURE.md: `{path}` is no folder");
    }
    let listed = Command::new("git").arg("ls-files").current_dir(root()).output().expect("git");
    let files = String::from_utf8(listed.stdout).expect("UTF-8");
    let missed = files.lines().filter(|file| file.contains('/') && !file.starts_with('.'));
    let missed: Vec<_> = missed
        .filter(|file| !paths.iter().any(|path| file.starts_with(&format!("{path}/"))))
        .collect();
    assert!(
        files.lines().count() > 100 && missed.is_empty(),
        "no row of the code map covers {missed:?}"
    );
    // The rooms of the mechanics have rows of their own.
    let models = root().join("models/src");
    for entry in std::fs::read_dir(models).expect("a folder") {
        let entry = entry.expect("an entry");
        let name = format!("models/src/{}", entry.file_name().to_string_lossy());
        let has_row = paths.contains(&name.as_str()) || !entry.path().is_dir();
        assert!(has_row, "ARCHITECTURE.md: no row for {name}");
    }
}

#[test]
fn files_that_documents_name_exist() {
    for document in
        ["ARCHITECTURE.md", "CONTRIBUTING.md", "models/ACCURACY.md", "server/REALTIME.md"]
    {
        let text = read(document);
        // Within the text of a crate its files go by their path from its sources.
        let folders = [
            "",
            "models/src",
            "models/control/src",
            "models/import/src",
            "server/src",
            "client/src",
            "proto/src",
        ];
        let is_path = |name: &&str| {
            let is_file =
                [".rs", ".toml", ".md", ".py", ".h"].iter().any(|end| name.ends_with(end));
            is_file && name.contains('/') && !name.contains([' ', '*', '<'])
        };
        for path in text.split('`').skip(1).step_by(2).filter(is_path) {
            let exists = folders.iter().any(|folder| root().join(folder).join(path).exists());
            assert!(exists, "{document}: `{path}` does not exist");
        }
    }
}
