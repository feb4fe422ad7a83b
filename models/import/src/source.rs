//! Texts, where their lines are, and what they include.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::ops::Range;

use roxmltree::{Document, Node};

use plantd_models::scene::MAX_TEXT_BYTES;

use crate::report::Problem;
use crate::xml::{self, Lines};

/// Files that include one another at most.
const FILES_DEEP: usize = 32;

/// Reads a file that a text includes, or from which it takes inertia: its path as it stands there to its bytes,
/// or why not.
pub type Files<'f> = dyn FnMut(&str) -> Result<Vec<u8>, String> + 'f;

/// A file that is text.
fn text_of(files: &mut Files<'_>, name: &str) -> Result<String, String> {
    String::from_utf8(files(name)?).map_err(|_| "it is no UTF-8".to_owned())
}

/// A text, with the texts that it includes in their places.
pub(crate) struct Source<'t> {
    pub(crate) text: Cow<'t, str>,
    files: Vec<File<'t>>,
    pieces: Vec<Piece>,
}

struct File<'t> {
    /// Empty for the text that includes the others.
    name: String,
    text: Cow<'t, str>,
    lines: Lines,
}

/// A part of the whole, from `start` on, is that of a file from `offset` on.
struct Piece {
    start: usize,
    file: usize,
    offset: usize,
}

impl<'t> Source<'t> {
    /// A text alone.
    pub(crate) fn single(text: &'t str) -> Self {
        let text = Cow::Borrowed(text);
        let file = File { name: String::new(), lines: Lines::of(&text), text: text.clone() };
        Self { text, files: vec![file], pieces: vec![Piece { start: 0, file: 0, offset: 0 }] }
    }

    /// A text in which each `include` element is replaced by what is in the root of its `file`, as MJCF has it:
    /// each file once, searched beside the text and then beside the file that includes it.
    pub(crate) fn with_includes(
        text: &'t str,
        files: &mut Files<'_>,
    ) -> Result<Self, Vec<Problem>> {
        let mut whole = Self { pieces: Vec::new(), ..Self::single(text) };
        let mut joined = String::new();
        let mut seen = BTreeSet::new();
        let all = 0..text.len();
        whole.splice(&mut joined, &mut seen, files, &[0], all)?;
        whole.text = Cow::Owned(joined);
        Ok(whole)
    }

    /// Appends a range of the last of `nested` files, with what it includes.
    fn splice(
        &mut self,
        joined: &mut String,
        seen: &mut BTreeSet<String>,
        files: &mut Files<'_>,
        nested: &[usize],
        range: Range<usize>,
    ) -> Result<(), Vec<Problem>> {
        let file = nested[nested.len() - 1];
        let text = self.files[file].text.clone();
        let includes =
            includes(&xml::open(&text).map_err(|problems| self.in_file(file, problems))?);
        let mut from = range.start;
        for (at, name) in includes {
            self.append(joined, file, from..at.start);
            from = at.end;
            let fail = |message| Err(vec![self.problem(file, at.start, message)]);
            let Some(name) = name else { return fail("`include` has no attribute `file`".into()) };
            if nested.len() > FILES_DEEP {
                return fail(format!("more than {FILES_DEEP} files include one another"));
            }
            let beside = self.files[file].name.rsplit_once('/').map(|(folder, _)| folder);
            let beside = beside.map(|folder| format!("{folder}/{name}"));
            let found = text_of(files, &name).map(|text| (name.clone(), text)).or_else(|error| {
                let again = beside.ok_or(error.clone())?;
                text_of(files, &again).map(|text| (again, text)).map_err(|_| error)
            });
            let (name, text) = match found {
                Ok(found) => found,
                Err(error) => return fail(format!("`{name}` cannot be included: {error}")),
            };
            if !seen.insert(name.clone()) {
                return fail(format!("`{name}` is included twice; once is allowed"));
            }
            if joined.len() + text.len() > MAX_TEXT_BYTES {
                return fail(format!(
                    "with `{name}` the text has more than {MAX_TEXT_BYTES} bytes"
                ));
            }
            let next = self.files.len();
            self.files.push(File { name, lines: Lines::of(&text), text: Cow::Owned(text) });
            let inside = self.inside(next)?;
            self.splice(joined, seen, files, &[nested, &[next]].concat(), inside)?;
        }
        self.append(joined, file, from..range.end);
        Ok(())
    }

    /// What is in the root of a file.
    fn inside(&self, file: usize) -> Result<Range<usize>, Vec<Problem>> {
        let document =
            xml::open(&self.files[file].text).map_err(|problems| self.in_file(file, problems))?;
        let root = document.root_element();
        Ok(match (root.first_child(), root.last_child()) {
            (Some(first), Some(last)) => first.range().start..last.range().end,
            _ => 0..0,
        })
    }

    fn append(&mut self, joined: &mut String, file: usize, range: Range<usize>) {
        self.pieces.push(Piece { start: joined.len(), file, offset: range.start });
        joined.push_str(&self.files[file].text[range]);
    }

    fn in_file(&self, file: usize, problems: Vec<Problem>) -> Vec<Problem> {
        let name = &self.files[file].name;
        problems.into_iter().map(|problem| Problem { file: name.clone(), ..problem }).collect()
    }

    fn problem(&self, file: usize, byte: usize, message: String) -> Problem {
        let File { name, text, lines } = &self.files[file];
        let (line, column) = lines.place(text, byte);
        Problem { file: name.clone(), line, column, message }
    }

    /// What is wrong at a place of the whole.
    pub(crate) fn problem_at(&self, byte: usize, message: String) -> Problem {
        let piece = self.pieces.partition_point(|piece| piece.start <= byte).saturating_sub(1);
        let Piece { start, file, offset } = self.pieces[piece];
        self.problem(file, offset + (byte - start), message)
    }
}

/// Where a text includes others, and which.
fn includes(document: &Document<'_>) -> Vec<(Range<usize>, Option<String>)> {
    let all = document.descendants().filter(|node| node.has_tag_name("include"));
    let file = |node: &Node<'_, '_>| node.attribute("file").map(str::to_owned);
    all.map(|node| (node.range(), file(&node))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn whole(files: &[(&str, &str)]) -> Result<String, String> {
        let mut read = |path: &str| {
            let found = files.iter().find(|(name, _)| *name == path);
            found
                .map(|(_, text)| text.as_bytes().to_vec())
                .ok_or("there is no such file".to_owned())
        };
        let source = Source::with_includes(files[0].1, &mut read);
        source.map(|source| source.text.into_owned()).map_err(|problems| problems[0].to_string())
    }

    #[test]
    fn files_stand_where_they_are_included() {
        let main = ("", r#"<m>1<include file="a/b.xml"/>2</m>"#);
        let b = ("a/b.xml", "<?xml version=\"1.0\"?><x>\n3<include file=\"c.xml\"/>4</x>");
        let c = ("a/c.xml", "<x><y/></x>");
        assert_eq!(whole(&[main, b, c]).unwrap(), "<m>1\n3<y/>42</m>");
        assert_eq!(
            whole(&[main, b]).unwrap_err(),
            "a/b.xml:2:2: `c.xml` cannot be included: there is no such file"
        );
        let circle = ("a/c.xml", r#"<x><include file="a/b.xml"/></x>"#);
        assert_eq!(
            whole(&[main, b, circle]).unwrap_err(),
            "a/c.xml:1:4: `a/b.xml` is included twice; once is allowed"
        );
        let torn = ("a/c.xml", "<x>\n</y></x>");
        let error = whole(&[main, b, torn]).unwrap_err();
        assert!(error.starts_with("a/c.xml:2:"), "{error}");
    }

    #[test]
    fn places_are_those_of_the_files() {
        let main = "<m>\n<include file=\"b\"/><ü/></m>";
        let mut read = |_: &str| Ok(b"<x>\n\n  <z/></x>".to_vec());
        let source = Source::with_includes(main, &mut read).unwrap();
        let document = Document::parse(&source.text).unwrap();
        let place = |name: &str| {
            let node = document.descendants().find(|node| node.has_tag_name(name)).unwrap();
            source.problem_at(node.range().start, String::new()).to_string()
        };
        assert_eq!(place("m"), "1:1: ");
        assert_eq!(place("z"), "b:3:3: ");
        assert_eq!(place("ü"), "2:20: ");
    }
}
