//! Results on standard output, for people or for programs; what is said about them on standard error.

use std::cell::RefCell;
use std::io::Write as _;
use std::rc::Rc;

use anstyle::{AnsiColor, Style};
use anyhow::Result;
use clap::ValueEnum;
use serde_json::{Value, json};

use crate::contract::json;
use crate::output::failure::NoTable;
use crate::output::page::Page;

/// What went well, on a terminal.
pub(crate) const GOOD: Style = AnsiColor::Green.on_default().bold();
const REMARK: Style = AnsiColor::Yellow.on_default().bold();
/// What went wrong.
pub(crate) const WRONG: Style = AnsiColor::Red.on_default().bold();

/// How results are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// For people: tables and sentences.
    #[default]
    Table,
    /// JSON, in the field names of the contract; streams print one object per line.
    Json,
    /// The tables as comma-separated values, with all digits.
    Csv,
}

/// Where results go.
#[derive(Clone)]
pub(crate) struct Output {
    format: Format,
    is_quiet: bool,
    /// Head of the table that was written last as comma-separated values: a stream has one table.
    last_head: Rc<RefCell<Option<String>>>,
}

impl Output {
    pub(crate) fn new(format: Format, is_quiet: bool) -> Self {
        Self { format, is_quiet, last_head: Rc::default() }
    }

    pub(crate) fn is_json(&self) -> bool {
        self.format == Format::Json
    }

    /// For people: their words may go to a terminal.
    pub(crate) fn is_for_people(&self) -> bool {
        self.format == Format::Table
    }

    /// Prints a result, flushed, so that a reader of a stream gets it at once.
    pub(crate) fn print<P: Into<Page>>(
        &self,
        json: impl FnOnce() -> Value,
        page: impl FnOnce() -> P,
    ) -> Result<()> {
        // Without colours where they are not wanted, or standard output is no terminal.
        let mut out = anstream::stdout().lock();
        match self.format {
            Format::Json => writeln!(out, "{}", json())?,
            Format::Table => write!(out, "{}", page().into())?,
            Format::Csv => self.write_tables(&page().into(), &mut out)?,
        }
        Ok(out.flush()?)
    }

    fn write_tables(&self, page: &Page, out: &mut impl std::io::Write) -> Result<()> {
        let mut last_head = self.last_head.borrow_mut();
        let mut count = 0;
        for table in page.tables() {
            let head = table.csv_head();
            if last_head.as_ref() != Some(&head) {
                let empty_line = if last_head.is_some() { "\n" } else { "" };
                writeln!(out, "{empty_line}{head}")?;
                *last_head = Some(head);
            }
            for row in table.csv_rows() {
                writeln!(out, "{row}")?;
            }
            count += 1;
        }
        // A message of a stream may have nothing to add to the tables before.
        let is_lost = count == 0 && last_head.is_none() && page.has_words();
        if is_lost { Err(NoTable.into()) } else { Ok(()) }
    }

    /// Prints a message of the contract; `name` is its name there.
    pub(crate) fn message<P: Into<Page>>(
        &self,
        name: &str,
        message: &impl prost::Message,
        page: impl FnOnce() -> P,
    ) -> Result<()> {
        self.print(|| json::message(name, message), page)
    }

    /// Says on standard error that there was nothing to do.
    pub(crate) fn nothing_to_do(&self, message: &str) {
        if self.is_json() {
            eprintln!("{}", json!({ "note": { "message": message } }));
        } else {
            anstream::eprintln!("{REMARK}plantctl:{REMARK:#} nothing to do: {message}");
        }
    }

    /// Says in a line on standard error what has been done.
    pub(crate) fn success(&self, sentence: &str) {
        if self.is_for_people() && !self.is_quiet {
            anstream::eprintln!("{GOOD}plantctl:{GOOD:#} {sentence}");
        }
    }

    /// Confirms what has no result of its own.
    pub(crate) fn done(&self, json: Value, sentence: &str) -> Result<()> {
        self.confirm(true, json, sentence)
    }

    /// Confirms what may have changed nothing, of which another line has told.
    pub(crate) fn confirm(&self, has_changed: bool, json: Value, sentence: &str) -> Result<()> {
        if has_changed {
            self.success(sentence);
        }
        if self.is_json() { self.print(|| json, String::new) } else { Ok(()) }
    }
}

/// Says on standard error why a command has failed.
pub(crate) fn complain(error: &anyhow::Error) {
    anstream::eprintln!("{WRONG}plantctl:{WRONG:#} {error:#}");
}
