//! Files that commands read and write.

use std::collections::HashMap;
use std::io::Read as _;
use std::path::Path;

use anyhow::{Context as _, Result, anyhow, ensure};
use plantd_client::{MatrixExt as _, v1};
use plantd_import::Options;
use plantd_scene::{in_plain_words, line_of};
use serde::de::DeserializeOwned;

use crate::contract::json;

/// A file's text; `-` stands for standard input.
pub(crate) fn read_text(path: &Path) -> Result<String> {
    if path == Path::new("-") {
        let mut text = String::new();
        std::io::stdin().read_to_string(&mut text).context("cannot read standard input")?;
        return Ok(text);
    }
    std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
}

/// The text of a scene or robot with the files that it includes, and the meshes that weigh something, by their
/// paths.
pub(crate) fn read_scene(path: &Path) -> Result<(String, HashMap<String, Vec<u8>>)> {
    let (mut read, mut meshes) = (beside(path), HashMap::new());
    let whole = plantd_import::with_includes(&read_text(path)?, &mut read)
        .with_context(|| format!("{} cannot be read", path.display()))?;
    if plantd_import::is_xml(&whole) {
        let mut keep = |name: &str| {
            let bytes = read(name)?;
            meshes.insert(name.to_owned(), bytes.clone());
            Ok(bytes)
        };
        // What is wrong with it, the server says.
        let _ = plantd_import::import_with_files(&whole, &Options::default(), &mut keep);
    }
    Ok((whole, meshes))
}

/// Reads files that stand where another one is.
pub(crate) fn beside(path: &Path) -> impl FnMut(&str) -> Result<Vec<u8>, String> {
    let folder = path.parent().unwrap_or(Path::new("")).to_owned();
    move |name| std::fs::read(folder.join(name)).map_err(|error| error.to_string())
}

/// Writes a file.
pub(crate) fn write(path: &Path, contents: impl AsRef<[u8]>) -> Result<()> {
    std::fs::write(path, contents).with_context(|| format!("cannot write {}", path.display()))
}

/// Reads a message from TOML or JSON in the field names of the contract.
pub(crate) fn parse_message<M: prost::Message + Default>(name: &str, text: &str) -> Result<M> {
    if text.trim_start().starts_with('{') {
        return json::read(name, text);
    }
    json::read_value(name, serde_json::to_value(from_toml::<toml::Table>(text)?)?)
}

/// Reads TOML that a person has written.
///
/// # Errors
/// What is wrong, in plain words, and the line.
pub(crate) fn from_toml<T: DeserializeOwned>(text: &str) -> Result<T> {
    toml::from_str(text).map_err(|error: toml::de::Error| {
        let line = line_of(text, error.span().map_or(0, |span| span.start));
        anyhow!("line {line}: {}", in_plain_words(error.message()))
    })
}

/// A result from its file; a checkpoint counts as a result that holds it.
pub(crate) fn read_result(file: &Path) -> Result<v1::OptimizationResult> {
    let text = read_text(file)?;
    let result = json::read("OptimizationResult", &text);
    let checkpoint = || json::read("OptimizationCheckpoint", &text);
    let read = result.or_else(|error| match checkpoint() {
        Ok(checkpoint) => {
            Ok(v1::OptimizationResult { checkpoint: Some(checkpoint), ..Default::default() })
        }
        Err(_) => Err(error),
    });
    read.with_context(|| format!("{} holds no result of a search", file.display()))
}

/// Comma-separated numbers, a row per line; a first line that is none is a head.
pub(crate) fn read_table(file: &Path) -> Result<v1::Matrix> {
    parse_table(&read_text(file)?).with_context(|| file.display().to_string())
}

/// The table of a text; see [`read_table`].
pub(crate) fn parse_table(text: &str) -> Result<v1::Matrix> {
    let mut rows: Vec<Vec<f64>> = Vec::new();
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    for (index, (number, line)) in lines.enumerate() {
        let cells = line.split(',').map(str::trim);
        let row: Result<Vec<f64>, _> = cells.map(str::parse).collect();
        match row {
            Ok(row) => {
                let cols = rows.first().map_or(row.len(), Vec::len);
                ensure!(row.len() == cols, "line {}: {} cells, not {cols}", number + 1, row.len());
                rows.push(row);
            }
            Err(_) if index == 0 => {}
            Err(_) => anyhow::bail!("line {}: not numbers", number + 1),
        }
    }
    Ok(v1::Matrix::from_rows(&rows))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn channels_are_read_from_toml_and_json() {
        let toml = "seed = 7\n[[outputs]]\nname = \"angle\"\ncoordinate = \"theta\"\nnoise = 0.1\n\
                    [[inputs]]\ninput = \"tau\"\ndelay_s = 0.02\nhold = \"HOLD_FIRST_ORDER\"";
        let channels: v1::Channels = parse_message("Channels", toml).unwrap();
        assert_eq!((channels.seed, channels.outputs[0].noise), (7, 0.1));
        assert_eq!(channels.inputs[0].hold(), v1::Hold::FirstOrder);
        let text = json::message("Channels", &channels).to_string();
        assert_eq!(parse_message::<v1::Channels>("Channels", &text).unwrap(), channels);
    }

    #[test]
    fn a_table_may_have_a_head() {
        let with_head = parse_table("theta, phi\n1,2\n\n3,-4e0\n").unwrap();
        assert_eq!((with_head.rows, with_head.data), (2, vec![1.0, 2.0, 3.0, -4.0]));
        assert!(parse_table("1,2\n3\n").unwrap_err().to_string().contains("line 2"));
        assert!(parse_table("1,2\na,b\n").unwrap_err().to_string().contains("line 2"));
    }
}
