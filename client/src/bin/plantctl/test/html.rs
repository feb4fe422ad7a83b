//! Results as one page with plots, which needs nothing from elsewhere.

use std::fmt::Write as _;

use super::expect::{Curve, Verdict};
use super::junit::escaped;
use super::run::{Outcome, Status};
use super::{Replay, Report, Tested, faults, short, title};

/// Cases that passed and are plotted all the same, of each scenario.
const PASSED_PLOTTED: usize = 10;
/// Points of a curve; a plot is no wider.
const POINTS_MAX: usize = 600;

const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 220.0;
/// Room for numbers.
const LEFT: f64 = 64.0;
const BOTTOM: f64 = 24.0;
const TOP: f64 = 8.0;
const RIGHT: f64 = 16.0;

const STYLE: &str = "\
:root{color-scheme:light dark;--line:#0b62c4;--band:#2e8b57;--bad:#c62828;--grid:#8886}\
body{font:15px/1.5 system-ui,sans-serif;max-width:1000px;margin:2rem auto;padding:0 1rem}\
h1{font-size:1.5rem}h2{font-size:1.15rem;margin:2rem 0 .3rem}\
table{border-collapse:collapse}td,th{padding:.15rem .8rem .15rem 0;text-align:left;vertical-align:top}\
code,pre{font:13px/1.4 ui-monospace,monospace}pre{overflow-x:auto;padding:.6rem;background:#8881;white-space:pre-wrap}\
details{border-left:4px solid #888;padding:.2rem .8rem;margin:.5rem 0}summary{cursor:pointer}\
.passed{border-color:var(--band)}.failed,.error{border-color:var(--bad)}\
b.passed{color:var(--band)}b.failed,b.error{color:var(--bad)}\
svg{max-width:100%;height:auto;display:block;font:11px system-ui,sans-serif}\
svg text{fill:currentColor}figure{margin:.6rem 0}figcaption{font-size:.9rem}\
.grid{stroke:var(--grid);stroke-width:1}.curve{fill:none;stroke:var(--line);stroke-width:1.5;stroke-linejoin:round}\
.band{fill:var(--band);opacity:.16}.bound{fill:none;stroke:var(--band);stroke-width:1;stroke-dasharray:4 3}\
.break{fill:none;stroke:var(--bad);stroke-width:2}";

/// The page.
pub(super) fn page(report: &Report, replay: &Replay<'_>) -> String {
    let [passed, failed, errors] =
        [Status::Passed, Status::Failed, Status::Error].map(|status| report.count(status));
    let verdict = class(report.status());
    let mut html = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
         <title>{passed} passed, {failed} failed, {errors} not run</title>\
         <style>{STYLE}</style></head>\n<body><h1>plantctl test</h1>\n\
         <p><b class=\"{verdict}\">{passed} passed, {failed} failed, {errors} not run</b></p>\n"
    );
    for unusable in &report.unusable {
        let _ = writeln!(
            html,
            "<h2>{}</h2>\n<pre>{}</pre>",
            escaped(&unusable.file.to_string_lossy()),
            escaped(&unusable.error)
        );
    }
    for tested in &report.tested {
        scenario(&mut html, tested, replay);
    }
    html.push_str("</body></html>\n");
    html
}

fn class(status: Status) -> &'static str {
    match status {
        Status::Passed => "passed",
        Status::Failed => "failed",
        Status::Error => "error",
    }
}

fn scenario(html: &mut String, tested: &Tested, replay: &Replay<'_>) {
    let Tested { prepared, outcomes } = tested;
    let file = escaped(&prepared.file.to_string_lossy());
    let _ = writeln!(html, "<h2>{}</h2>\n<p><code>{file}</code>", escaped(&prepared.name));
    let _ = writeln!(html, "{}</p>", escaped(&prepared.scenario.description));
    let mut plotted = 0;
    for outcome in outcomes {
        let status = outcome.status();
        let is_passed = status == Status::Passed;
        plotted += usize::from(is_passed);
        let (class, open) = (class(status), if is_passed { "" } else { " open" });
        let name = escaped(&title(&prepared.name, &outcome.case));
        let _ = writeln!(
            html,
            "<details class=\"{class}\"{open}><summary><b class=\"{class}\">{class}</b> {name}, \
             {} steps in {:.2} s</summary>",
            outcome.steps,
            outcome.elapsed.as_secs_f64()
        );
        for line in faults(outcome) {
            let _ = writeln!(html, "<p>{}</p>", escaped(&line));
        }
        if !is_passed {
            let command = escaped(&replay.command(prepared, outcome));
            let _ = writeln!(html, "<pre>{command}</pre>");
        }
        if is_passed && plotted > PASSED_PLOTTED {
            html.push_str(&table(outcome));
        } else {
            plots(html, outcome);
        }
        if !outcome.output.is_empty() {
            let _ = writeln!(
                html,
                "<details><summary>what the controller wrote</summary><pre>{}</pre></details>",
                escaped(&outcome.output)
            );
        }
        html.push_str("</details>\n");
    }
}

fn words(verdict: &Verdict) -> String {
    let class = class(if verdict.broken.is_some() { Status::Failed } else { Status::Passed });
    format!(
        "<b class=\"{class}\">{class}</b> {}: {}",
        escaped(&verdict.expectation),
        escaped(&verdict.message)
    )
}

fn table(outcome: &Outcome) -> String {
    outcome.verdicts.iter().map(|verdict| format!("<p>{}</p>\n", words(verdict))).collect()
}

fn plots(html: &mut String, outcome: &Outcome) {
    for verdict in &outcome.verdicts {
        let svg = verdict.curve.as_ref().map(|curve| {
            let at = verdict.broken.and_then(|b| b.time_s.zip(b.value));
            svg(&outcome.time_s, curve, at)
        });
        let _ = writeln!(
            html,
            "<figure><figcaption>{}</figcaption>{}</figure>",
            words(verdict),
            svg.unwrap_or_default()
        );
    }
    for curve in &outcome.plots {
        let _ = writeln!(
            html,
            "<figure><figcaption>{}</figcaption>{}</figure>",
            escaped(&curve.name),
            svg(&outcome.time_s, curve, None)
        );
    }
}

/// A range with round marks in it.
struct Axis {
    low: f64,
    high: f64,
    step: f64,
}

impl Axis {
    /// The axis that shows these numbers; those that are not finite do not count.
    fn over(values: impl Iterator<Item = f64>) -> Self {
        let (low, high) = values
            .filter(|x| x.is_finite())
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
        let (low, high) = if low <= high { (low, high) } else { (0.0, 0.0) };
        // Neither a constant nor the round-off of one fills the axis.
        let least = 1e-9 * low.abs().max(high.abs()).max(1e-3);
        let (low, high) = match high - low > least {
            true => (low, high),
            false => (low - least.max(0.5e-3), high + least.max(0.5e-3)),
        };
        let rough = (high - low) / 4.0;
        let decade = 10.0_f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * decade).into_iter().find(|s| *s >= rough);
        Self { low, high, step: step.unwrap_or(rough) }
    }

    fn padded(self) -> Self {
        let pad = 0.05 * (self.high - self.low);
        Self { low: self.low - pad, high: self.high + pad, ..self }
    }

    fn marks(&self) -> Vec<f64> {
        let first = (self.low / self.step).ceil() as i64;
        let last = (self.high / self.step).floor() as i64;
        (first..=last).map(|i| i as f64 * self.step).collect()
    }

    /// Where a number is, from 0 to 1.
    fn fraction(&self, x: f64) -> f64 {
        (x - self.low) / (self.high - self.low)
    }
}

/// A signal over time with its bounds, and where it broke them.
fn svg(time_s: &[f64], curve: &Curve, broken: Option<(f64, f64)>) -> String {
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
    let mut svg = format!("<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" width=\"{WIDTH}\" role=\"img\">");
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
    for mark in times.marks() {
        let x = x(mark);
        let _ = write!(
            svg,
            "<path class=\"grid\" d=\"M{x:.1} {TOP}V{:.1}\"/><text x=\"{x:.1}\" y=\"{:.1}\" \
             text-anchor=\"middle\">{} s</text>",
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

/// Samples that draw the same curve: of each stretch the smallest and the largest.
fn thinned(values: &[f64]) -> Vec<usize> {
    let stretch = values.len().div_ceil(POINTS_MAX / 2).max(1);
    let mut shown = Vec::new();
    for start in (0..values.len()).step_by(stretch) {
        let indices = || start..values.len().min(start + stretch);
        let low = indices().min_by(|&a, &b| values[a].total_cmp(&values[b]));
        let high = indices().max_by(|&a, &b| values[a].total_cmp(&values[b]));
        shown.extend(low);
        shown.extend(high);
    }
    shown.push(values.len().saturating_sub(1));
    shown.sort_unstable();
    shown.dedup();
    shown.retain(|&k| k < values.len());
    shown
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinning_keeps_ends_and_peaks() {
        let mut values: Vec<f64> = (0..10_000).map(|k| (f64::from(k) * 1e-3).sin()).collect();
        values[7_777] = 9.0;
        let shown = thinned(&values);
        assert!(shown.len() <= POINTS_MAX + 2, "{}", shown.len());
        for k in [0, 7_777, 9_999] {
            assert!(shown.contains(&k), "{k}");
        }
        assert!(thinned(&[]).is_empty());
        assert_eq!(thinned(&[1.0, 2.0]), [0, 1]);
    }

    #[test]
    fn an_axis_has_some_round_marks() {
        for (low, high) in [(0.0, 5.0), (-3.3, 1e-3), (1e-9, 2e-9), (3.0, 3.0), (-1e12, 1e12)] {
            let axis = Axis::over([low, high].into_iter());
            let count = axis.marks().len();
            assert!((1..=6).contains(&count), "{low} to {high}: {count}");
            assert!(axis.low <= low && high <= axis.high && axis.high > axis.low);
        }
        assert!(!Axis::over([f64::NAN].into_iter()).marks().is_empty());
    }

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
