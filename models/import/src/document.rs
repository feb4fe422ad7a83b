//! XML with positions, and what is said about it.

use std::collections::BTreeMap;

use roxmltree::{Document, Node, ParsingOptions};

use plantd_models::scene::MAX_TEXT_BYTES;

use crate::report::{Kind, Note, PROBLEMS_MAX, Problem, Report};
use crate::table::{Element, Treatment};

/// Elements, texts and comments that are read at most.
const NODES_MAX: u32 = 1 << 20;
/// Notes that are told at most.
const NOTES_MAX: usize = 1000;
/// Characters of a line that are told apart from bytes.
const LINE_MAX: usize = 1 << 12;
/// Elements in one another at most.
const DEPTH_MAX: usize = 256;

/// Reads XML without document type definitions, so that no entity can grow.
pub(crate) fn open(text: &str) -> Result<Document<'_>, Vec<Problem>> {
    let single = |line, column, message| vec![Problem { line, column, message }];
    if text.len() > MAX_TEXT_BYTES {
        let message =
            format!("the text has {} bytes; at most {MAX_TEXT_BYTES} are read", text.len());
        return Err(single(1, 1, message));
    }
    if let Some(problem) = too_deep(text) {
        return Err(vec![problem]);
    }
    let options = ParsingOptions { allow_dtd: false, nodes_limit: NODES_MAX, ..Default::default() };
    Document::parse_with_options(text, options).map_err(|error| {
        let at = error.pos();
        single(at.row, at.col, format!("not XML that is read here: {error}"))
    })
}

/// The first tag within more than [`DEPTH_MAX`] others. Readers of XML call themselves for each level, and
/// the stack has an end.
fn too_deep(text: &str) -> Option<Problem> {
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
            let (line, column) = position(text, text.len() - rest.len());
            let message = format!("more than {DEPTH_MAX} elements stand in one another");
            return Some(Problem { line, column, message });
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

/// Line and column, counted from 1, columns in characters.
fn position(text: &str, byte: usize) -> (u32, u32) {
    let before = &text[..byte];
    let start = before.rfind('\n').map_or(0, |i| i + 1);
    let line = before.bytes().filter(|b| *b == b'\n').count() + 1;
    (line as u32, text[start..byte].chars().count() as u32 + 1)
}

/// Collects what is to be said of a document.
pub(crate) struct Reader<'a> {
    text: &'a str,
    /// Where lines start.
    lines: Vec<usize>,
    is_lenient: bool,
    pub(crate) report: Report,
    problems: Vec<Problem>,
    /// Where each note stands.
    known: BTreeMap<(Kind, String), usize>,
}

impl<'a> Reader<'a> {
    pub(crate) fn new(document: &'a Document<'_>, is_lenient: bool) -> Self {
        let text = document.input_text();
        let starts = text.bytes().enumerate().filter(|(_, byte)| *byte == b'\n');
        let lines = std::iter::once(0).chain(starts.map(|(i, _)| i + 1)).collect();
        Self {
            text,
            lines,
            is_lenient,
            report: Report::default(),
            problems: Vec::new(),
            known: BTreeMap::new(),
        }
    }

    /// The report, or the problems if there are any.
    pub(crate) fn finish(mut self) -> Result<Report, Vec<Problem>> {
        self.report.notes.sort_by_key(|note| (note.kind, note.line, note.column));
        self.problems.sort_by_key(|problem| (problem.line, problem.column));
        if self.problems.is_empty() { Ok(self.report) } else { Err(self.problems) }
    }

    pub(crate) fn has_failed(&self) -> bool {
        !self.problems.is_empty()
    }

    fn place(&self, byte: usize) -> (u32, u32) {
        let line = self.lines.partition_point(|start| *start <= byte);
        let start = self.lines[line - 1];
        let far = byte - start > LINE_MAX;
        let column = if far { byte - start } else { self.text[start..byte].chars().count() };
        (line as u32, column as u32 + 1)
    }

    /// Says what is wrong.
    pub(crate) fn fail(&mut self, node: Node<'_, '_>, message: impl Into<String>) {
        self.fail_at(node.range().start, message.into());
    }

    fn fail_at(&mut self, byte: usize, message: String) {
        if self.problems.len() < PROBLEMS_MAX {
            let (line, column) = self.place(byte);
            self.problems.push(Problem { line, column, message });
        }
    }

    /// Says what cannot be taken over: a problem, or a warning where the user wants that.
    pub(crate) fn refuse(&mut self, node: Node<'_, '_>, message: impl Into<String>) {
        self.refuse_at(node.range().start, message.into());
    }

    fn refuse_at(&mut self, byte: usize, message: String) {
        if self.is_lenient {
            self.note_at(Kind::Warning, byte, message);
        } else {
            self.fail_at(byte, message);
        }
    }

    /// Says what was not taken as it stands there; the same message once, with a count.
    pub(crate) fn note(&mut self, kind: Kind, node: Node<'_, '_>, message: impl Into<String>) {
        self.note_at(kind, node.range().start, message.into());
    }

    fn note_at(&mut self, kind: Kind, byte: usize, message: String) {
        if let Some(&known) = self.known.get(&(kind, message.clone())) {
            self.report.notes[known].count += 1;
        } else if self.report.notes.len() < NOTES_MAX {
            let (line, column) = self.place(byte);
            self.known.insert((kind, message.clone()), self.report.notes.len());
            self.report.notes.push(Note { kind, line, column, message, count: 1 });
        } else {
            self.report.left_out += 1;
        }
    }

    /// Counts something that was taken exactly.
    pub(crate) fn exact(&mut self, what: &'static str) {
        *self.report.exact.entry(what).or_default() += 1;
    }

    /// Holds each element and attribute below the root against the table of its format.
    pub(crate) fn check(&mut self, root: Node<'a, 'a>, table: &'static Element) {
        let mut open = vec![(root, table)];
        while let Some((node, element)) = open.pop() {
            for attribute in node.attributes() {
                let name = attribute.name();
                let known = element.attributes.iter().find(|(known, _)| *known == name);
                let what = format!("attribute `{name}` of `{}`", element.name);
                let treatment = known.map(|(_, treatment)| *treatment);
                self.treat(treatment, attribute.range().start, &what);
            }
            for child in node.children().filter(Node::is_element) {
                let name = child.tag_name().name();
                if child.tag_name().namespace().is_some() {
                    self.fail(child, format!("`{name}` belongs to another language; if this is xacro, expand it first: `xacro FILE > robot.urdf`"));
                    continue;
                }
                let known = element.children.iter().find(|known| known.name == name);
                let what = format!("`{name}` in `{}`", element.name);
                self.treat(known.map(|known| known.treatment), child.range().start, &what);
                if let Some(known) = known.filter(|known| known.treatment == Treatment::Read) {
                    open.push((child, known));
                }
            }
        }
    }

    fn treat(&mut self, treatment: Option<Treatment>, byte: usize, what: &str) {
        match treatment {
            Some(Treatment::Read) => {}
            Some(Treatment::NoEffect(why)) => {
                self.note_at(Kind::NoEffect, byte, format!("{what}: {why}"));
            }
            Some(Treatment::Refused(what_to_do)) => {
                self.refuse_at(byte, format!("{what}: {what_to_do}"));
            }
            None => {
                let message = format!("{what} is none of the format: left out");
                self.note_at(Kind::Warning, byte, message);
            }
        }
    }

    /// The one child of that name, or none; a second one is a problem.
    pub(crate) fn child<'n>(&mut self, node: Node<'n, 'n>, name: &str) -> Option<Node<'n, 'n>> {
        let mut all = node.children().filter(|child| child.has_tag_name(name));
        let first = all.next();
        if let Some(second) = all.next() {
            let of = node.tag_name().name();
            self.fail(second, format!("a second `{name}` in `{of}`; there may be one"));
        }
        first
    }

    /// An attribute that must be there.
    pub(crate) fn required<'n>(&mut self, node: Node<'n, '_>, name: &str) -> &'n str {
        if let Some(value) = node.attribute(name) {
            return value;
        }
        self.fail(node, format!("`{}` has no attribute `{name}`", node.tag_name().name()));
        ""
    }

    /// A number that must be there.
    pub(crate) fn number(&mut self, node: Node<'_, '_>, name: &str) -> f64 {
        let text = self.required(node, name).to_owned();
        if text.is_empty() { 0.0 } else { self.numbers::<1>(node, name, &text)[0] }
    }

    /// A number, or what stands for it.
    pub(crate) fn number_or(&mut self, node: Node<'_, '_>, name: &str, default: f64) -> f64 {
        self.vector_or(node, name, [default])[0]
    }

    /// Numbers, or what stands for them.
    pub(crate) fn vector_or<const N: usize>(
        &mut self,
        node: Node<'_, '_>,
        name: &str,
        default: [f64; N],
    ) -> [f64; N] {
        node.attribute(name).map_or(default, |text| self.numbers(node, name, text))
    }

    /// So many numbers apart by white space, each finite; zeros where that is not so.
    pub(crate) fn numbers<const N: usize>(
        &mut self,
        node: Node<'_, '_>,
        name: &str,
        text: &str,
    ) -> [f64; N] {
        let mut numbers = [0.0; N];
        let mut words = text.split_ascii_whitespace();
        let mut is_good = true;
        for number in &mut numbers {
            match words.next().and_then(|word| word.parse::<f64>().ok()) {
                Some(value) if value.is_finite() => *number = value,
                _ => is_good = false,
            }
        }
        if is_good && words.next().is_none() {
            return numbers;
        }
        let shown: String = text.chars().take(60).collect();
        let allowed = if N == 1 { "a finite number".into() } else { format!("{N} finite numbers") };
        let of = node.tag_name().name();
        self.fail(node, format!("`{name}` of `{of}` is `{shown}`; must be {allowed}"));
        [0.0; N]
    }
}
