//! A signal over time as a picture (SVG).

use std::fmt::Write as _;

use crate::figure::axis::{Axis, thinned};
use crate::output::markup::escaped;
use crate::output::text::short;
use plantd_expect::Curve;

const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 220.0;
/// Room for numbers.
const LEFT: f64 = 64.0;
const BOTTOM: f64 = 24.0;
const TOP: f64 = 8.0;
const RIGHT: f64 = 16.0;

/// A signal over time with its bounds, and where it broke them.
pub(crate) fn svg(time_s: &[f64], curve: &Curve, broken: Option<(f64, f64)>) -> String {
    let shown = thinned(&curve.values);
    let times = Axis::over(time_s.iter().copied());
    let until_s = curve.until_s.min(times.high);
    let counts = |k: &usize| time_s[*k] >= curve.from_s - 1e-9 && time_s[*k] <= until_s + 1e-9;
    let bounded: Vec<usize> = shown.iter().copied().filter(counts).collect();
    let bounds = [&curve.low, &curve.high];
    let of_bounds = bounded.iter().flat_map(|&k| bounds.map(|bound| bound[k]));
    let values = Axis::over(shown.iter().map(|&k| curve.values[k]).chain(of_bounds)).padded();
    let x = |t: f64| LEFT + times.fraction(t) * (WIDTH - LEFT - RIGHT);
    let y = |v: f64| TOP + (1.0 - values.fraction(v)) * (HEIGHT - BOTTOM - TOP);
    let mut svg = format!(
        "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{0}\"><title>{0}</title>",
        escaped(&curve.name)
    );
    for mark in values.marks() {
        let y = y(mark);
        let _ = write!(
            svg,
            "<path class=\"grid\" d=\"M{LEFT} {y:.1}H{:.1}\"/><text x=\"{:.1}\" y=\"{:.1}\" \
             text-anchor=\"end\">{}</text>",
            WIDTH - RIGHT,
            LEFT - 6.0,
            y + 4.0,
            short(mark)
        );
    }
    for (i, mark) in times.marks().into_iter().enumerate() {
        let (x, unit) = (x(mark), if i == 0 { " s" } else { "" });
        let _ = write!(
            svg,
            "<path class=\"grid\" d=\"M{x:.1} {TOP}V{:.1}\"/><text x=\"{x:.1}\" y=\"{:.1}\" \
             text-anchor=\"middle\">{}{unit}</text>",
            HEIGHT - BOTTOM,
            HEIGHT - 8.0,
            short(mark)
        );
    }
    let path = |points: &mut dyn Iterator<Item = (f64, f64)>| {
        let mut path = String::new();
        let mut is_down = false;
        for (t, v) in points {
            // The pen is lifted where there is no number.
            if !v.is_finite() {
                is_down = false;
                continue;
            }
            let _ = write!(path, "{}{:.1} {:.1}", if is_down { 'L' } else { 'M' }, x(t), y(v));
            is_down = true;
        }
        path
    };
    if bounds.iter().any(|bound| bounded.iter().any(|&k| bound[k].is_finite())) {
        // Open sides reach to the edge.
        let edge = |k: usize, bound: &[f64]| bound[k].clamp(values.low, values.high);
        let above = bounded.iter().map(|&k| (time_s[k], edge(k, &curve.high)));
        let below = bounded.iter().rev().map(|&k| (time_s[k], edge(k, &curve.low)));
        let _ = write!(svg, "<path class=\"band\" d=\"{}Z\"/>", path(&mut above.chain(below)));
        for bound in bounds {
            let line = path(&mut bounded.iter().map(|&k| (time_s[k], bound[k])));
            let _ = write!(svg, "<path class=\"bound\" d=\"{line}\"/>");
        }
    }
    let line = path(&mut shown.iter().map(|&k| (time_s[k], curve.values[k])));
    let _ = write!(svg, "<path class=\"curve\" d=\"{line}\"/>");
    if let Some((t, v)) = broken.filter(|(_, v)| v.is_finite()) {
        let (x, y) = (x(t), y(v));
        let _ = write!(svg, "<circle class=\"break\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"5\"/>");
    }
    svg + "</svg>"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_with_gaps_has_no_number_that_is_none() {
        let curve = Curve {
            name: "a".to_owned(),
            values: vec![0.0, f64::NAN, f64::INFINITY, 1.0],
            low: vec![f64::NEG_INFINITY; 4],
            high: vec![0.5; 4],
            from_s: 0.0,
            until_s: f64::INFINITY,
        };
        let svg = svg(&[0.0, 1.0, 2.0, 3.0], &curve, Some((3.0, 1.0)));
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        assert!(svg.contains("class=\"band\"") && svg.contains("<circle"));
    }
}
