//! A signal over time in characters: a panel of braille dots with its axes.

use std::fmt::Write as _;

use crate::figure::axis::Axis;
use crate::figure::chart::Curve;
use crate::output::text::short;

/// Columns of dots and rows of dots in a character.
const DOTS: (usize, usize) = (2, 4);
/// Characters for the numbers of the ordinate.
const LABELS: usize = 10;

/// The curve in `width` columns and `rows` rows, with two more lines for its name and the times.
pub(crate) fn panel(curve: &Curve, times: &Axis, width: usize, rows: usize) -> String {
    let values = Axis::over(curve.values.iter().copied()).padded();
    let columns = width.saturating_sub(LABELS + 2).max(10);
    let mut dots = Dots::new(columns, rows);
    let (right, bottom) = ((columns * DOTS.0 - 1) as f64, (rows * DOTS.1 - 1) as f64);
    let place = |t: f64, v: f64| (times.fraction(t) * right, (1.0 - values.fraction(v)) * bottom);
    let mut pen: Option<(f64, f64)> = None;
    for (&t, &v) in curve.time_s.iter().zip(&curve.values) {
        // The pen is lifted where there is no number, and where time goes back.
        let to = v.is_finite().then(|| place(t, v));
        if let Some(to) = to {
            dots.line(pen.filter(|from| from.0 <= to.0).unwrap_or(to), to);
        }
        pen = to;
    }
    let mut text = head(curve, width);
    let mut labels = vec![None; rows];
    for mark in values.marks() {
        let row = place(0.0, mark).1.round() as usize / DOTS.1;
        labels[row.min(rows - 1)] = Some(short(mark));
    }
    for (row, label) in labels.iter().enumerate() {
        let edge = if label.is_some() { '┤' } else { '│' };
        let label = label.as_deref().unwrap_or_default();
        let _ = writeln!(text, "{label:>LABELS$} {edge}{}", dots.row(row).trim_end_matches(BLANK));
    }
    text + &abscissa(times, columns)
}

/// Name, unit and range.
fn head(curve: &Curve, width: usize) -> String {
    let finite = || curve.values.iter().copied().filter(|v| v.is_finite());
    let low = finite().fold(f64::INFINITY, f64::min);
    let high = finite().fold(f64::NEG_INFINITY, f64::max);
    let range = match low <= high {
        true => format!("{} to {}", short(low), short(high)),
        false => "no numbers".to_owned(),
    };
    let title = curve.title();
    let gap = width.saturating_sub(title.chars().count() + range.chars().count()).max(2);
    format!("{title}{:gap$}{range}\n", "")
}

/// The line of times with their numbers below it.
fn abscissa(times: &Axis, columns: usize) -> String {
    let mut line = vec!['─'; columns];
    let mut numbers = vec![' '; columns + 8];
    let mut free = 0;
    for mark in times.marks() {
        let at = (times.fraction(mark) * (columns - 1) as f64).round() as usize;
        line[at.min(columns - 1)] = '┬';
        let label = if free == 0 { format!("{} s", short(mark)) } else { short(mark) };
        let count = label.chars().count();
        let start = at.saturating_sub(if free == 0 { 0 } else { count / 2 });
        if start >= free && start + count <= numbers.len() {
            numbers.splice(start..start + count, label.chars());
            free = start + count + 1;
        }
    }
    let (line, numbers): (String, String) = (line.iter().collect(), numbers.iter().collect());
    let blank = " ".repeat(LABELS + 2);
    format!("{} └{line}\n{blank}{}\n", " ".repeat(LABELS), numbers.trim_end())
}

const BLANK: char = '\u{2800}';

/// Dots in braille characters.
struct Dots {
    columns: usize,
    cells: Vec<u8>,
}

impl Dots {
    fn new(columns: usize, rows: usize) -> Self {
        Self { columns, cells: vec![0; columns * rows] }
    }

    fn set(&mut self, x: usize, y: usize) {
        // Dots 1 to 3 and 7 stand in the left column of a character, 4 to 6 and 8 in the right one.
        const BITS: [[u8; 4]; 2] = [[0x01, 0x02, 0x04, 0x40], [0x08, 0x10, 0x20, 0x80]];
        let cell = y / DOTS.1 * self.columns + x / DOTS.0;
        if x / DOTS.0 < self.columns && cell < self.cells.len() {
            self.cells[cell] |= BITS[x % DOTS.0][y % DOTS.1];
        }
    }

    fn line(&mut self, from: (f64, f64), to: (f64, f64)) {
        let (dx, dy) = (to.0 - from.0, to.1 - from.1);
        let steps = dx.abs().max(dy.abs()).ceil().max(1.0);
        for i in 0..=steps as usize {
            let part = i as f64 / steps;
            let (x, y) = (from.0 + part * dx, from.1 + part * dy);
            self.set(x.round() as usize, y.round() as usize);
        }
    }

    fn row(&self, row: usize) -> String {
        let cells = &self.cells[row * self.columns..(row + 1) * self.columns];
        cells
            .iter()
            .map(|&cell| char::from_u32(0x2800 + u32::from(cell)).unwrap_or(BLANK))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(values: Vec<f64>) -> Curve {
        let time_s = (0..values.len()).map(|k| k as f64 * 0.1).collect();
        Curve { name: "q.theta".to_owned(), unit: "rad".to_owned(), time_s, values }
    }

    #[test]
    fn a_rising_line_goes_from_the_lower_left_to_the_upper_right() {
        let curve = curve((0..=100).map(f64::from).collect());
        let times = Axis::over(curve.time_s.iter().copied());
        let text = panel(&curve, &times, 80, 10);
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines.len(), 13, "{text}");
        assert!(lines.iter().all(|line| line.chars().count() <= 80), "{text}");
        assert!(lines[0].starts_with("q.theta, rad") && lines[0].ends_with("0 to 100"), "{text}");
        let dots = |line: &str| {
            let marks = line.chars().enumerate().skip(LABELS + 2).filter(|(_, c)| *c > BLANK);
            marks.map(|(i, _)| i).collect::<Vec<_>>()
        };
        let (top, bottom) = (dots(lines[1]), dots(lines[10]));
        assert!(top.iter().all(|&i| i > 68) && bottom.iter().all(|&i| i < 24), "{text}");
        // Each column has a dot.
        let mut all: Vec<_> = lines[1..11].iter().flat_map(|line| dots(line)).collect();
        all.sort_unstable();
        all.dedup();
        assert_eq!(all, (LABELS + 2..80).collect::<Vec<_>>(), "{text}");
        assert!(lines[12].contains("0 s") && lines[12].contains("10"), "{text}");
    }

    #[test]
    fn where_there_is_no_number_there_is_no_line() {
        let mut values = vec![0.0; 100];
        values[30..60].fill(f64::NAN);
        let curve = curve(values);
        let times = Axis::over(curve.time_s.iter().copied());
        let text = panel(&curve, &times, 80, 3);
        let row = text.lines().find(|line| line.chars().any(|c| c > BLANK)).unwrap();
        assert!(row.contains(&BLANK.to_string().repeat(15)), "{text}");
        let empty = panel(&Curve { values: vec![f64::NAN; 100], ..curve }, &times, 80, 3);
        assert!(empty.contains("no numbers"), "{empty}");
    }
}
