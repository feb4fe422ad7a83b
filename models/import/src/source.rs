//! Texts, where their lines are, and what they include.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::ops::Range;

use roxmltree::{Document, Node};

use plantd_models::scene::MAX_TEXT_BYTES;

use crate::report::Problem;
use crate::xml::{self, Lines};

/// Files that include one another at most.
pub(crate) const FILES_DEEP: usize = 32;

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
    /// Folders of the models that it is made of: its own, with none, and those that are attached.
    pub(crate) models: Vec<String>,
}

struct File<'t> {
    /// Empty for the text that includes the others.
    name: String,
    text: Cow<'t, str>,
    lines: Lines,
}

/// A part of the whole, from `start` on, is that of a file from `offset` on, or stands for what is there.
#[derive(Clone, Copy)]
struct Piece {
    start: usize,
    file: usize,
    offset: usize,
    is_inserted: bool,
    model: usize,
}

/// A text that is put together.
#[derive(Default)]
pub(crate) struct Text {
    pub(crate) joined: String,
    pieces: Vec<Piece>,
    /// Whose it is.
    pub(crate) model: usize,
}

impl Text {
    pub(crate) fn of(model: usize) -> Self {
        Self { model, ..Self::default() }
    }

    /// Place among the pieces of a byte.
    fn piece(&self, byte: usize) -> usize {
        self.pieces.partition_point(|piece| piece.start <= byte).saturating_sub(1)
    }

    /// Appends a part of another text.
    pub(crate) fn copy(&mut self, from: &Self, range: Range<usize>) {
        let mut i = from.piece(range.start);
        while let Some(piece) = from.pieces.get(i).filter(|piece| piece.start < range.end) {
            let inside = range.start.saturating_sub(piece.start);
            let offset = if piece.is_inserted { piece.offset } else { piece.offset + inside };
            let start = self.joined.len() + piece.start.saturating_sub(range.start);
            self.pieces.push(Piece { start, offset, ..*piece });
            i += 1;
        }
        self.joined.push_str(&from.joined[range]);
    }

    /// Appends what stands for a byte of another text.
    pub(crate) fn insert(&mut self, text: &str, from: &Self, byte: usize) {
        let piece = from.pieces[from.piece(byte)];
        let inside = if piece.is_inserted { 0 } else { byte - piece.start };
        let (start, offset) = (self.joined.len(), piece.offset + inside);
        self.pieces.push(Piece { start, offset, is_inserted: true, model: from.model, ..piece });
        self.joined.push_str(text);
    }
}

impl<'t> Source<'t> {
    /// A text alone.
    pub(crate) fn single(text: &'t str) -> Self {
        let text = Cow::Borrowed(text);
        let file = File { name: String::new(), lines: Lines::of(&text), text: text.clone() };
        let piece = Piece { start: 0, file: 0, offset: 0, is_inserted: false, model: 0 };
        Self { text, files: vec![file], pieces: vec![piece], models: vec![String::new()] }
    }

    /// A text in which each `include` element is replaced by what is in the root of its `file`, as MJCF has it:
    /// each file once, searched beside the text and then beside the file that includes it.
    pub(crate) fn with_includes(
        text: &'t str,
        files: &mut Files<'_>,
    ) -> Result<Self, Vec<Problem>> {
        let (whole, text) = Self::joined(text, files)?;
        Ok(whole.of_text(text))
    }

    /// The same, with the text still apart.
    pub(crate) fn joined(
        text: &'t str,
        files: &mut Files<'_>,
    ) -> Result<(Self, Text), Vec<Problem>> {
        let mut whole = Self::single(text);
        let (mut out, all) = (Text::of(0), 0..text.len());
        whole.splice(&mut out, &mut BTreeSet::new(), files, &[0], all)?;
        Ok((whole, out))
    }

    /// With a text that is put together of its files.
    pub(crate) fn of_text(self, text: Text) -> Self {
        Self { text: Cow::Owned(text.joined), pieces: text.pieces, ..self }
    }

    /// The text of a model that is attached, with what it includes; or why it cannot be read.
    pub(crate) fn model(
        &mut self,
        name: &str,
        files: &mut Files<'_>,
    ) -> Result<Result<Text, Vec<Problem>>, String> {
        let (name, text) = self.beside(0, name, files)?;
        let folder = name.rsplit_once('/').map_or("", |(folder, _)| folder).to_owned();
        let (file, range) = (self.files.len(), 0..text.len());
        self.files.push(File { name, lines: Lines::of(&text), text: Cow::Owned(text) });
        let mut out = Text::of(self.models.len());
        self.models.push(folder);
        let spliced = self.splice(&mut out, &mut BTreeSet::new(), files, &[file], range);
        Ok(spliced.map(|()| out))
    }

    /// A file beside the text, or beside another file, and its text.
    pub(crate) fn beside(
        &self,
        file: usize,
        name: &str,
        files: &mut Files<'_>,
    ) -> Result<(String, String), String> {
        let beside = self.files[file].name.rsplit_once('/').map(|(folder, _)| folder);
        let beside = beside.map(|folder| format!("{folder}/{name}"));
        let found = text_of(files, name).map(|text| (name.to_owned(), text)).or_else(|error| {
            let again = beside.ok_or(error.clone())?;
            text_of(files, &again).map(|text| (again, text)).map_err(|_| error)
        });
        found.map_err(|error| format!("`{name}` cannot be read: {error}"))
    }

    /// Appends a range of the last of `nested` files, with what it includes.
    fn splice(
        &mut self,
        out: &mut Text,
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
            self.append(out, file, from..at.start);
            from = at.end;
            let fail = |message| Err(vec![self.problem(file, at.start, message)]);
            let Some(name) = name else { return fail("`include` has no attribute `file`".into()) };
            if nested.len() > FILES_DEEP {
                return fail(format!("more than {FILES_DEEP} files include one another"));
            }
            let (name, text) = match self.beside(file, &name, files) {
                Ok(found) => found,
                Err(error) => return fail(error),
            };
            if !seen.insert(name.clone()) {
                return fail(format!("`{name}` is included twice; once is allowed"));
            }
            if out.joined.len() + text.len() > MAX_TEXT_BYTES {
                return fail(format!(
                    "with `{name}` the text has more than {MAX_TEXT_BYTES} bytes"
                ));
            }
            let next = self.files.len();
            self.files.push(File { name, lines: Lines::of(&text), text: Cow::Owned(text) });
            let inside = self.inside(next)?;
            self.splice(out, seen, files, &[nested, &[next]].concat(), inside)?;
        }
        self.append(out, file, from..range.end);
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

    fn append(&self, out: &mut Text, file: usize, range: Range<usize>) {
        let (start, offset, model) = (out.joined.len(), range.start, out.model);
        out.pieces.push(Piece { start, file, offset, is_inserted: false, model });
        out.joined.push_str(&self.files[file].text[range]);
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

    /// What is wrong at a place of a text that is put together.
    pub(crate) fn problem_in(&self, text: &Text, byte: usize, message: String) -> Problem {
        self.problem_of(&text.pieces[text.piece(byte)], byte, message)
    }

    /// What is wrong at a place of the whole.
    pub(crate) fn problem_at(&self, byte: usize, message: String) -> Problem {
        self.problem_of(self.piece_at(byte), byte, message)
    }

    fn problem_of(&self, piece: &Piece, byte: usize, message: String) -> Problem {
        let inside = if piece.is_inserted { 0 } else { byte - piece.start };
        self.problem(piece.file, piece.offset + inside, message)
    }

    fn piece_at(&self, byte: usize) -> &Piece {
        let place = self.pieces.partition_point(|piece| piece.start <= byte).saturating_sub(1);
        &self.pieces[place]
    }

    /// Whose a place of the whole is, among [`Self::models`].
    pub(crate) fn model_at(&self, byte: usize) -> usize {
        if self.models.len() == 1 { 0 } else { self.piece_at(byte).model }
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
            "a/b.xml:2:2: `c.xml` cannot be read: there is no such file"
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
