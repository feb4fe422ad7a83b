//! Numbers, tables and matrices for people.

use std::fmt::Write as _;

use plantd_client::{MatrixExt as _, v1};

/// Most rows or columns of a matrix that are printed; beyond it the middle is left out.
const MATRIX_SHOWN: usize = 12;

/// A table with left-aligned columns, two spaces apart.
pub(crate) fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let width = |col: usize| {
        let cells = rows.iter().map(|row| row[col].chars().count());
        cells.chain([head[col].chars().count()]).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..head.len()).map(width).collect();
    let mut text = String::new();
    let head_row: Vec<String> = head.iter().map(|&cell| cell.to_owned()).collect();
    for row in std::iter::once(&head_row).chain(rows) {
        let mut line = String::new();
        for (cell, width) in row.iter().zip(&widths) {
            let _ = write!(line, "{cell:<width$}  ");
        }
        let _ = writeln!(text, "{}", line.trim_end());
    }
    text
}

/// A matrix under its title, with a name before each row and above each column.
pub(crate) fn matrix(title: &str, matrix: &v1::Matrix, rows: &[String], cols: &[String]) -> String {
    let shown_cols = shown(matrix.cols as usize);
    let mut lines: Vec<Vec<String>> = Vec::new();
    let head = |col: &Option<usize>| col.map_or("…".to_owned(), |c| label(cols, c));
    lines.push(std::iter::once(String::new()).chain(shown_cols.iter().map(head)).collect());
    for row in shown(matrix.rows as usize) {
        let Some(row) = row else {
            lines.push(vec!["…".to_owned(); shown_cols.len() + 1]);
            continue;
        };
        let entry =
            |col: &Option<usize>| col.map_or("…".to_owned(), |c| number(matrix.at(row, c)));
        let name = std::iter::once(label(rows, row));
        lines.push(name.chain(shown_cols.iter().map(entry)).collect());
    }
    let width = |col: usize| lines.iter().map(|line| line[col].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..=shown_cols.len()).map(width).collect();
    let mut text = format!("{title} ({} × {})\n", matrix.rows, matrix.cols);
    for line in &lines {
        let _ = write!(text, "  {:<width$}", line[0], width = widths[0]);
        for (cell, width) in line[1..].iter().zip(&widths[1..]) {
            let _ = write!(text, "  {cell:>width$}");
        }
        text.push('\n');
    }
    text
}

/// Indices to print, `None` standing for those left out.
fn shown(count: usize) -> Vec<Option<usize>> {
    if count <= MATRIX_SHOWN {
        return (0..count).map(Some).collect();
    }
    let half = MATRIX_SHOWN / 2;
    (0..half).map(Some).chain([None]).chain((count - half..count).map(Some)).collect()
}

/// The name of an entry, or its index if it has none.
pub(crate) fn label(names: &[String], index: usize) -> String {
    names.get(index).cloned().unwrap_or_else(|| index.to_string())
}

/// A number with seven significant digits.
pub(crate) fn number(x: f64) -> String {
    let magnitude = x.abs();
    if x == 0.0 {
        "0".to_owned()
    } else if !x.is_finite() {
        x.to_string()
    } else if (1e-4..1e7).contains(&magnitude) {
        let before_point = magnitude.log10().floor() as i32 + 1;
        format!("{x:.*}", (7 - before_point).clamp(0, 10) as usize)
    } else {
        format!("{x:.6e}")
    }
}

/// A number for people: four significant digits where more would only be noise.
pub(crate) fn short(x: f64) -> String {
    if !x.is_finite() {
        return x.to_string();
    }
    let magnitude = x.abs();
    if magnitude != 0.0 && !(1e-3..1e6).contains(&magnitude) {
        return format!("{x:.3e}");
    }
    let text = format!("{x:.4}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// Numbers, comma-separated.
pub(crate) fn numbers(values: &[f64]) -> String {
    values.iter().map(|&x| number(x)).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_keep_seven_digits() {
        for (x, text) in [
            (0.0, "0"),
            (0.95333434, "0.9533343"),
            (-12.5, "-12.50000"),
            (0.000976, "0.0009760000"),
            (1e-9, "1.000000e-9"),
            (123456.0, "123456.0"),
        ] {
            assert_eq!(number(x), text);
        }
    }

    #[test]
    fn a_large_matrix_leaves_out_its_middle() {
        let big = v1::Matrix { rows: 40, cols: 40, data: vec![1.0; 1600] };
        let text = matrix("A", &big, &[], &[]);
        assert!(text.starts_with("A (40 × 40)\n"));
        assert_eq!(text.lines().count(), 2 + MATRIX_SHOWN + 1);
    }

    #[test]
    fn columns_line_up() {
        let rows = [vec!["a".to_owned(), "1".to_owned()], vec!["long".to_owned(), "2".to_owned()]];
        assert_eq!(table(&["n", "v"], &rows), "n     v\na     1\nlong  2\n");
    }
}
