//! What is fed with nonsense.

mod calls;
mod files;
mod link;
mod texts;

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};

use crate::mutate::{Rng, mutated};

/// Longest input, bytes.
const BYTES_MAX: usize = 64 << 10;

/// Something that takes bytes from strangers.
pub(crate) trait Target {
    /// A new input.
    fn input(&mut self, rng: &mut Rng) -> Vec<u8>;

    /// Takes it. Whatever it is, this ends soon, and without a panic.
    fn run(&mut self, input: &[u8]);
}

/// Makes a target.
type Open = fn() -> Result<Box<dyn Target>>;

/// Names of all of them, with what makes them.
pub(crate) const TARGETS: [(&str, Open); 10] = [
    ("scene", texts::scene),
    ("urdf", texts::urdf),
    ("mjcf", texts::mjcf),
    ("configuration", texts::configuration),
    ("scenario", texts::scenario),
    ("message", calls::messages),
    ("bytes", calls::bytes),
    ("saved", files::saved),
    ("recording", files::recording),
    ("link", link::link),
];

/// A target whose inputs are mutated seeds.
struct Mutated<F> {
    seeds: Vec<Vec<u8>>,
    take: F,
}

impl<F: FnMut(&[u8])> Target for Mutated<F> {
    fn input(&mut self, rng: &mut Rng) -> Vec<u8> {
        mutated(rng, &self.seeds, BYTES_MAX)
    }

    fn run(&mut self, input: &[u8]) {
        (self.take)(input);
    }
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// Where the inputs are kept on which a target has failed before.
pub(crate) fn corpus(target: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(target)
}

/// Files of folders of the repository with this ending, short ones.
fn seeds(target: &str, folders: &[&str], end: &str) -> Result<Vec<Vec<u8>>> {
    let mut paths = Vec::new();
    for folder in folders.iter().map(|folder| root().join(folder)) {
        let found = folder.read_dir().with_context(|| folder.display().to_string())?.flatten();
        let found = found.map(|entry| entry.path());
        paths.extend(found.filter(|path| path.extension().is_some_and(|found| found == end)));
    }
    let kept = corpus(target).read_dir().into_iter().flatten().flatten();
    paths.extend(kept.map(|entry| entry.path()));
    paths.sort();
    let mut seeds = Vec::new();
    for path in paths {
        let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
        if bytes.len() <= BYTES_MAX / 4 {
            seeds.push(bytes);
        }
    }
    anyhow::ensure!(!seeds.is_empty(), "{target} has no seeds");
    Ok(seeds)
}
