//! XML without document type definitions, of bounded size and depth.

use roxmltree::{Document, ParsingOptions};

use plantd_models::scene::MAX_TEXT_BYTES;

use crate::report::Problem;

/// Elements, texts and comments that are read at most.
const NODES_MAX: u32 = 1 << 20;
/// Elements in one another at most.
const DEPTH_MAX: usize = 256;
/// Characters of a line that are told apart from bytes.
const LINE_MAX: usize = 1 << 12;

/// Where lines start.
pub(crate) struct Lines(Vec<usize>);

impl Lines {
    pub(crate) fn of(text: &str) -> Self {
        let starts = text.bytes().enumerate().filter(|(_, byte)| *byte == b'\n');
        Self(std::iter::once(0).chain(starts.map(|(i, _)| i + 1)).collect())
    }

    /// Line and column, counted from 1, columns in characters.
    pub(crate) fn place(&self, text: &str, byte: usize) -> (u32, u32) {
        let line = self.0.partition_point(|start| *start <= byte);
        let start = self.0[line - 1];
        let far = byte - start > LINE_MAX;
        let column = if far { byte - start } else { text[start..byte].chars().count() };
        (line as u32, column as u32 + 1)
    }
}

/// Reads XML; no entity can grow.
pub(crate) fn open(text: &str) -> Result<Document<'_>, Vec<Problem>> {
    if text.len() > MAX_TEXT_BYTES {
        let message =
            format!("the text has {} bytes; at most {MAX_TEXT_BYTES} are read", text.len());
        return Err(single((1, 1), message));
    }
    if let Some(byte) = too_deep(text) {
        let message = format!("more than {DEPTH_MAX} elements stand in one another");
        return Err(single(Lines::of(text).place(text, byte), message));
    }
    let options = ParsingOptions { allow_dtd: false, nodes_limit: NODES_MAX, ..Default::default() };
    Document::parse_with_options(text, options).map_err(|error| {
        let at = error.pos();
        single((at.row, at.col), format!("not XML that is read here: {error}"))
    })
}

fn single((line, column): (u32, u32), message: String) -> Vec<Problem> {
    vec![Problem { file: String::new(), line, column, message }]
}

/// Where the first tag within more than [`DEPTH_MAX`] others is. Readers of XML call themselves for each level,
/// and the stack has an end.
fn too_deep(text: &str) -> Option<usize> {
    let (mut depth, mut rest) = (0_usize, text);
    while let Some(start) = rest.find('<') {
        rest = &rest[start..];
        let skipped = [("<!--", "-->"), ("<![CDATA[", "]]>"), ("<?", "?>")];
        if let Some((open, close)) = skipped.iter().find(|(open, _)| rest.starts_with(open)) {
            let from = &rest[open.len()..];
            rest = &from[from.find(close)?..];
            continue;
        }
        let end = end_of_tag(rest)?;
        match &rest[1..end] {
            tag if tag.starts_with('/') => depth = depth.saturating_sub(1),
            tag if tag.ends_with('/') || tag.starts_with('!') => {}
            _ => depth += 1,
        }
        if depth > DEPTH_MAX {
            return Some(text.len() - rest.len());
        }
        rest = &rest[end..];
    }
    None
}

/// Where a tag that starts the text ends, its quoted values left out.
fn end_of_tag(text: &str) -> Option<usize> {
    let mut quote = None;
    text.char_indices().find_map(|(i, c)| {
        match (quote, c) {
            (None, '>') => return Some(i),
            (None, '"' | '\'') => quote = Some(c),
            (Some(open), c) if open == c => quote = None,
            _ => {}
        }
        None
    })
}
