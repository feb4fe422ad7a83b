//! What is read of a document, and what is said about it.

use std::collections::BTreeMap;

use roxmltree::Node;

use crate::report::{Kind, Note, PROBLEMS_MAX, Problem, Report};
use crate::source::Source;
use crate::table::{Element, NO_CONTACT, Treatment};

/// Notes that are told at most.
const NOTES_MAX: usize = 1000;

/// Collects what is to be said of a document.
pub(crate) struct Reader<'a> {
    source: &'a Source<'a>,
    is_lenient: bool,
    pub(crate) report: Report,
    problems: Vec<Problem>,
    /// Where each note stands.
    known: BTreeMap<(Kind, String), usize>,
}

impl<'a> Reader<'a> {
    pub(crate) fn new(source: &'a Source<'a>, is_lenient: bool) -> Self {
        Self {
            source,
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

    /// Whose a node is, of the model itself or one that it attaches.
    pub(crate) fn model_of(&self, node: Node<'_, '_>) -> usize {
        self.source.model_at(node.range().start)
    }

    /// Folders of these models, relative to that of the first.
    pub(crate) fn models(&self) -> &'a [String] {
        &self.source.models
    }

    pub(crate) fn has_failed(&self) -> bool {
        !self.problems.is_empty()
    }

    /// Says what is wrong.
    pub(crate) fn fail(&mut self, node: Node<'_, '_>, message: impl Into<String>) {
        self.fail_at(node.range().start, message.into());
    }

    fn fail_at(&mut self, byte: usize, message: String) {
        if self.problems.len() < PROBLEMS_MAX {
            self.problems.push(self.source.problem_at(byte, message));
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
            self.known.insert((kind, message.clone()), self.report.notes.len());
            let Problem { file, line, column, message } = self.source.problem_at(byte, message);
            self.report.notes.push(Note { kind, file, line, column, message, count: 1 });
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
                let what = format!("attribute `{name}` of `{}`", element.name);
                self.treat(element.attribute(name), attribute.range().start, &what);
            }
            for child in node.children().filter(Node::is_element) {
                let name = child.tag_name().name();
                if child.tag_name().namespace().is_some() {
                    self.fail(child, format!("`{name}` belongs to another language; if this is xacro, expand it first: `xacro FILE > robot.urdf`"));
                    continue;
                }
                let what = format!("`{name}` in `{}`", element.name);
                self.treat(element.treatment(name), child.range().start, &what);
                open.extend(element.child(name).map(|known| (child, known)));
            }
        }
    }

    fn treat(&mut self, treatment: Option<Treatment>, byte: usize, what: &str) {
        match treatment {
            Some(Treatment::Read) => {}
            Some(Treatment::NoEffect(why)) => {
                self.note_at(Kind::NoEffect, byte, format!("{what}: {why}"));
            }
            Some(Treatment::Contact) => {
                self.note_at(Kind::Contact, byte, format!("{what}: {NO_CONTACT}"));
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
        match node.attribute(name) {
            Some(text) => self.numbers::<1>(node, name, text)[0],
            None => {
                self.required(node, name);
                0.0
            }
        }
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
        let numbers = list(text, N).and_then(|numbers| numbers.try_into().ok());
        numbers.unwrap_or_else(|| {
            let allowed = if N == 1 { "a".to_owned() } else { N.to_string() };
            self.fail_number(node, name, text, &allowed, N);
            [0.0; N]
        })
    }

    /// One to so many finite numbers, which take the places of the first of others.
    pub(crate) fn first_numbers<const N: usize>(
        &mut self,
        node: Node<'_, '_>,
        name: &str,
        text: &str,
        others: &mut [f64; N],
    ) {
        match list(text, N).filter(|numbers| !numbers.is_empty()) {
            Some(numbers) => others[..numbers.len()].copy_from_slice(&numbers),
            None => self.fail_number(node, name, text, &format!("1 to {N}"), N),
        }
    }

    /// Any count of finite numbers.
    pub(crate) fn all_numbers(&mut self, node: Node<'_, '_>, name: &str, text: &str) -> Vec<f64> {
        list(text, usize::MAX).unwrap_or_else(|| {
            self.fail_number(node, name, text, "any count of", 2);
            Vec::new()
        })
    }

    fn fail_number(
        &mut self,
        node: Node<'_, '_>,
        name: &str,
        text: &str,
        how_many: &str,
        n: usize,
    ) {
        let (of, shown) = (node.tag_name().name(), shown(text));
        let plural = if n == 1 { "" } else { "s" };
        let message =
            format!("`{name}` of `{of}` is `{shown}`; must be {how_many} finite number{plural}");
        self.fail(node, message);
    }

    /// One of the words that are allowed, by its place among them; the first where it is none of them.
    pub(crate) fn keyword(
        &mut self,
        node: Node<'_, '_>,
        name: &str,
        text: &str,
        allowed: &[&str],
    ) -> usize {
        allowed.iter().position(|word| *word == text.trim()).unwrap_or_else(|| {
            let (of, shown, allowed) = (node.tag_name().name(), shown(text), allowed.join("`, `"));
            let message = format!("`{name}` of `{of}` is `{shown}`; must be one of `{allowed}`");
            self.fail(node, message);
            0
        })
    }
}

/// Finite numbers apart by white space, at most so many.
pub(crate) fn list(text: &str, most: usize) -> Option<Vec<f64>> {
    let finite = |word: &str| word.parse::<f64>().ok().filter(|number| number.is_finite());
    let numbers: Option<Vec<f64>> =
        text.split_ascii_whitespace().take(most.saturating_add(1)).map(finite).collect();
    numbers.filter(|numbers| numbers.len() <= most)
}

/// The beginning of a text.
fn shown(text: &str) -> String {
    text.chars().take(60).collect()
}
