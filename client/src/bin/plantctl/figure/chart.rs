//! Signals over time as a picture (SVG) that stands alone.

use std::fmt::Write as _;

use crate::figure::axis::{Axis, thinned};
use crate::output::markup::escaped;
use crate::output::text::short;

/// A named signal over time.
#[derive(Clone, Debug)]
pub(crate) struct Curve {
    pub(crate) name: String,
    /// Its unit; empty where it is not known.
    pub(crate) unit: String,
    pub(crate) time_s: Vec<f64>,
    pub(crate) values: Vec<f64>,
}

impl Curve {
    /// Name and unit.
    pub(crate) fn title(&self) -> String {
        let comma = if self.unit.is_empty() { "" } else { ", " };
        format!("{}{comma}{}", self.name, self.unit)
    }
}

const WIDTH: f64 = 860.0;
/// Height of a panel without its times.
const HEIGHT: f64 = 260.0;
/// Room for numbers, and for names.
const LEFT: f64 = 76.0;
const RIGHT: f64 = 16.0;
const TOP: f64 = 34.0;
const BOTTOM: f64 = 40.0;
/// Told apart by people who do not see all colours, and on paper by their lightness.
const COLORS: [&str; 6] = ["#005aa0", "#cc5500", "#2a8a57", "#8a4fb0", "#8c6d00", "#555555"];

/// The curves, those of one unit in one panel; the size of the picture, and the picture.
pub(crate) fn svg(curves: &[Curve]) -> ((u32, u32), String) {
    let mut panels: Vec<Vec<&Curve>> = Vec::new();
    for curve in curves {
        match panels.iter_mut().find(|panel| panel[0].unit == curve.unit) {
            Some(panel) => panel.push(curve),
            None => panels.push(vec![curve]),
        }
    }
    let times = Axis::over(curves.iter().flat_map(|curve| &curve.time_s).copied());
    let height = panels.len() as f64 * HEIGHT + BOTTOM - 16.0;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{height}\" \
         viewBox=\"0 0 {WIDTH} {height}\" font-family=\"system-ui, sans-serif\" font-size=\"13\">\n\
         <rect width=\"{WIDTH}\" height=\"{height}\" fill=\"white\"/>\n"
    );
    for (i, panel) in panels.iter().enumerate() {
        let is_last = i + 1 == panels.len();
        let _ = writeln!(svg, "<g transform=\"translate(0 {})\">", i as f64 * HEIGHT);
        draw(&mut svg, panel, &times, is_last);
        svg.push_str("</g>\n");
    }
    ((WIDTH as u32, height as u32), svg + "</svg>\n")
}

fn draw(svg: &mut String, panel: &[&Curve], times: &Axis, is_last: bool) {
    let bottom = HEIGHT - 16.0;
    let values = Axis::over(panel.iter().flat_map(|curve| &curve.values).copied()).padded();
    let x = |t: f64| LEFT + times.fraction(t) * (WIDTH - LEFT - RIGHT);
    let y = |v: f64| TOP + (1.0 - values.fraction(v)) * (bottom - TOP);
    let edge = WIDTH - RIGHT;
    for mark in values.marks() {
        let y = y(mark);
        let _ = writeln!(
            svg,
            "<path d=\"M{LEFT} {y:.1}H{edge}\" stroke=\"#ddd\"/><text x=\"{:.1}\" y=\"{:.1}\" \
             text-anchor=\"end\">{}</text>",
            LEFT - 8.0,
            y + 4.0,
            short(mark)
        );
    }
    for mark in times.marks() {
        let x = x(mark);
        let _ = writeln!(svg, "<path d=\"M{x:.1} {TOP}V{bottom}\" stroke=\"#ddd\"/>");
        if is_last {
            let y = bottom + 18.0;
            let label = short(mark);
            let _ =
                writeln!(svg, "<text x=\"{x:.1}\" y=\"{y}\" text-anchor=\"middle\">{label}</text>");
        }
    }
    if is_last {
        let (x, y) = (0.5 * (LEFT + edge), bottom + 36.0);
        let _ = writeln!(svg, "<text x=\"{x}\" y=\"{y}\" text-anchor=\"middle\">time, s</text>");
    }
    let mut left = LEFT;
    for (curve, color) in panel.iter().zip(COLORS.iter().cycle()) {
        let mut path = String::new();
        let mut last = None;
        for k in thinned(&curve.values) {
            let (t, v) = (curve.time_s[k], curve.values[k]);
            // The pen is lifted where there is no number, and where time goes back.
            if v.is_finite() {
                let pen = if last.is_some_and(|last| last <= t) { 'L' } else { 'M' };
                let _ = write!(path, "{pen}{:.1} {:.1}", x(t), y(v));
            }
            last = v.is_finite().then_some(t);
        }
        let _ = writeln!(
            svg,
            "<path d=\"{path}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"2\" \
             stroke-linejoin=\"round\"/>"
        );
        let title = escaped(&curve.title());
        let y = TOP - 14.0;
        let _ = writeln!(
            svg,
            "<path d=\"M{left:.1} {y}h18\" stroke=\"{color}\" stroke-width=\"3\"/>\
             <text x=\"{:.1}\" y=\"{}\">{title}</text>",
            left + 24.0,
            y + 4.0
        );
        left += 44.0 + 7.5 * curve.title().chars().count() as f64;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signals_of_one_unit_share_a_panel() {
        let curve = |name: &str, unit: &str| Curve {
            name: name.to_owned(),
            unit: unit.to_owned(),
            time_s: vec![0.0, 1.0, 2.0],
            values: vec![0.0, f64::NAN, 2.0],
        };
        let curves = [curve("q.a", "rad"), curve("u.<b>", "N"), curve("q.c", "rad")];
        let ((_, height), svg) = svg(&curves);
        assert_eq!(svg.matches("<g ").count(), 2);
        assert_eq!(f64::from(height), 2.0 * HEIGHT + BOTTOM - 16.0);
        assert!(svg.contains("u.&lt;b&gt;, N") && !svg.contains("NaN"));
    }
}
