//! What a command tells: lines for people, and tables, which are there for programs as well.

use std::fmt::{self, Write as _};

use anstyle::Style;
use plantd_client::{MatrixExt as _, v1};

use crate::output::text::{label, number};

/// Most rows or columns of a matrix that people are shown; beyond it the middle is left out.
const MATRIX_SHOWN: usize = 12;

/// Heads of tables and titles, on a terminal.
const HEAD: Style = Style::new().bold();

/// What a command tells. What is written to it is for people; tables are for programs, too.
#[derive(Default)]
pub(crate) struct Page {
    parts: Vec<Part>,
}

enum Part {
    Text(String),
    Table(Table),
    /// For programs alone: people are told it in another way.
    Data(Table),
}

impl Page {
    /// Adds a table.
    pub(crate) fn table(&mut self, table: Table) {
        self.parts.push(Part::Table(table));
    }

    /// Adds a table after an empty line.
    pub(crate) fn next_table(&mut self, table: Table) {
        if !self.parts.is_empty() {
            let _ = self.write_char('\n');
        }
        self.table(table);
    }

    /// Adds a table for programs alone.
    pub(crate) fn data(&mut self, table: Table) {
        self.parts.push(Part::Data(table));
    }

    /// Adds another page.
    pub(crate) fn append(&mut self, page: impl Into<Page>) {
        self.parts.extend(page.into().parts);
    }

    /// Whether people are told more than in tables.
    pub(crate) fn has_words(&self) -> bool {
        self.parts.iter().any(|part| matches!(part, Part::Text(text) if !text.is_empty()))
    }

    /// Its tables.
    pub(crate) fn tables(&self) -> impl Iterator<Item = &Table> {
        self.parts.iter().filter_map(|part| match part {
            Part::Table(table) | Part::Data(table) => Some(table),
            Part::Text(_) => None,
        })
    }
}

impl fmt::Write for Page {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        match self.parts.last_mut() {
            Some(Part::Text(last)) => last.push_str(text),
            _ => self.parts.push(Part::Text(text.to_owned())),
        }
        Ok(())
    }
}

impl From<String> for Page {
    fn from(text: String) -> Self {
        Self { parts: vec![Part::Text(text)] }
    }
}

impl From<Table> for Page {
    fn from(table: Table) -> Self {
        Self { parts: vec![Part::Table(table)] }
    }
}

impl FromIterator<Page> for Page {
    fn from_iter<I: IntoIterator<Item = Page>>(pages: I) -> Self {
        Self { parts: pages.into_iter().flat_map(|page| page.parts).collect() }
    }
}

/// As people see it.
impl fmt::Display for Page {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.parts.iter().try_for_each(|part| match part {
            Part::Text(text) => f.write_str(text),
            Part::Table(table) => table.fmt(f),
            Part::Data(_) => Ok(()),
        })
    }
}

/// A cell of a table. Numbers have seven digits for people, and all of them for programs.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Cell {
    Text(String),
    Number(f64),
}

impl From<String> for Cell {
    fn from(text: String) -> Self {
        Self::Text(text)
    }
}

impl From<&str> for Cell {
    fn from(text: &str) -> Self {
        Self::Text(text.to_owned())
    }
}

impl From<f64> for Cell {
    fn from(number: f64) -> Self {
        Self::Number(number)
    }
}

impl From<u64> for Cell {
    fn from(count: u64) -> Self {
        Self::Text(count.to_string())
    }
}

impl Cell {
    fn for_people(&self) -> String {
        match self {
            Self::Text(text) => text.clone(),
            Self::Number(x) => number(*x),
        }
    }

    fn for_programs(&self) -> String {
        match self {
            // What stands for nothing.
            Self::Text(text) if text == "-" => String::new(),
            Self::Text(text) if text.contains([',', '"', '\n', '\r']) => {
                format!("\"{}\"", text.replace('"', "\"\""))
            }
            Self::Text(text) => text.clone(),
            // Rust prints as many digits as bring the number back.
            Self::Number(x) => format!("{x:?}"),
        }
    }
}

/// A table, or a matrix with names of its rows and columns.
#[derive(Clone, Debug)]
pub(crate) struct Table {
    head: Vec<Cell>,
    rows: Vec<Vec<Cell>>,
    /// Numbers to the right under a title, and not more than people can look at.
    is_matrix: bool,
}

/// A table with left-aligned columns, two spaces apart.
pub(crate) fn table<C: Into<Cell>>(head: &[&str], rows: impl IntoIterator<Item = Vec<C>>) -> Table {
    let rows = rows.into_iter().map(|row| row.into_iter().map(Into::into).collect());
    let head = head.iter().map(|&cell| cell.into()).collect();
    Table { head, rows: rows.collect(), is_matrix: false }
}

/// A matrix under its title, with a name before each row and above each column.
pub(crate) fn matrix(title: &str, matrix: &v1::Matrix, rows: &[String], cols: &[String]) -> Table {
    let (row_count, col_count) = (matrix.rows as usize, matrix.cols as usize);
    let head = (0..col_count).map(|col| label(cols, col));
    let row = |row: usize| {
        let numbers = (0..col_count).map(|col| matrix.at(row, col).into());
        std::iter::once(label(rows, row).into()).chain(numbers).collect()
    };
    Table {
        head: std::iter::once(title.to_owned()).chain(head).map(Cell::Text).collect(),
        rows: (0..row_count).map(row).collect(),
        is_matrix: true,
    }
}

impl Table {
    /// The head as a line of comma-separated values.
    pub(crate) fn csv_head(&self) -> String {
        csv_line(&self.head)
    }

    /// The rows as lines of comma-separated values.
    pub(crate) fn csv_rows(&self) -> impl Iterator<Item = String> {
        self.rows.iter().map(|row| csv_line(row))
    }

    fn list(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let text: Vec<Vec<String>> = std::iter::once(&self.head)
            .chain(&self.rows)
            .map(|row| row.iter().map(Cell::for_people).collect())
            .collect();
        let width = |col: usize| text.iter().map(|row| row[col].chars().count()).max().unwrap_or(0);
        let widths: Vec<usize> = (0..self.head.len()).map(width).collect();
        for (index, row) in text.iter().enumerate() {
            let mut line = String::new();
            for (cell, width) in row.iter().zip(&widths) {
                write!(line, "{cell:<width$}  ")?;
            }
            let style = if index == 0 { HEAD } else { Style::new() };
            writeln!(f, "{style}{}{style:#}", line.trim_end())?;
        }
        Ok(())
    }

    fn matrix(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let cols = shown(self.head.len() - 1);
        let mut lines: Vec<Vec<String>> = Vec::new();
        let of = |cells: &[Cell], col: &Option<usize>| {
            col.map_or("…".to_owned(), |col| cells[col + 1].for_people())
        };
        let name = std::iter::once(String::new());
        lines.push(name.chain(cols.iter().map(|col| of(&self.head, col))).collect());
        for row in shown(self.rows.len()) {
            let Some(row) = row.map(|row| &self.rows[row]) else {
                lines.push(vec!["…".to_owned(); cols.len() + 1]);
                continue;
            };
            let name = std::iter::once(row[0].for_people());
            lines.push(name.chain(cols.iter().map(|col| of(row, col))).collect());
        }
        let width = |col: usize| lines.iter().map(|line| line[col].chars().count()).max();
        let widths: Vec<usize> = (0..=cols.len()).map(|col| width(col).unwrap_or(0)).collect();
        let (title, size) = (self.head[0].for_people(), (self.rows.len(), self.head.len() - 1));
        writeln!(f, "{HEAD}{title}{HEAD:#} ({} × {})", size.0, size.1)?;
        for line in &lines {
            write!(f, "  {:<width$}", line[0], width = widths[0])?;
            for (cell, width) in line[1..].iter().zip(&widths[1..]) {
                write!(f, "  {cell:>width$}")?;
            }
            writeln!(f)?;
        }
        Ok(())
    }
}

/// As people see it.
impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.is_matrix { self.matrix(f) } else { self.list(f) }
    }
}

fn csv_line(cells: &[Cell]) -> String {
    cells.iter().map(Cell::for_programs).collect::<Vec<_>>().join(",")
}

/// Indices to print, `None` standing for those left out.
fn shown(count: usize) -> Vec<Option<usize>> {
    if count <= MATRIX_SHOWN {
        return (0..count).map(Some).collect();
    }
    let half = MATRIX_SHOWN / 2;
    (0..half).map(Some).chain([None]).chain((count - half..count).map(Some)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Without what terminals show as colours.
    fn plain(text: &impl ToString) -> String {
        anstream::adapter::strip_str(&text.to_string()).to_string()
    }

    #[test]
    fn a_large_matrix_leaves_out_its_middle_for_people_only() {
        let big = v1::Matrix { rows: 40, cols: 40, data: vec![1.0; 1600] };
        let big = matrix("A", &big, &[], &[]);
        let text = plain(&big);
        assert!(text.starts_with("A (40 × 40)\n"), "{text}");
        assert_eq!(text.lines().count(), 2 + MATRIX_SHOWN + 1);
        assert!(big.csv_head().starts_with("A,0,1,2,") && big.csv_rows().count() == 40);
    }

    #[test]
    fn columns_line_up() {
        let rows = table(&["n", "v"], [vec!["a", "1"], vec!["long", "2"]]);
        assert_eq!(plain(&rows), "n     v\na     1\nlong  2\n");
    }

    #[test]
    fn programs_get_all_digits_and_quotes() {
        let rows = table(&["a", "b", "c"], [vec![Cell::from("x, \"y\""), "-".into(), 0.1.into()]]);
        assert_eq!(rows.csv_rows().next().unwrap(), "\"x, \"\"y\"\"\",,0.1");
        assert_eq!(Page::from(rows).tables().count(), 1);
        assert_eq!(Page::from("words".to_owned()).tables().count(), 0);
    }
}
