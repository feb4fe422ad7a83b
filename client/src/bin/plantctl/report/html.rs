//! Results as one page with plots, which needs nothing from elsewhere.

use std::fmt::Write as _;

use crate::output::markup::escaped;
use crate::report::plot::svg;
use crate::report::results::{Replay, Report, ScenarioResult};
use crate::trial::outcome::{Outcome, Status};
use plantd_expect::{Curve, Verdict};

/// Cases that passed, and that did not, of each scenario that are plotted.
const PASSED_PLOTTED: usize = 10;
const BROKEN_PLOTTED: usize = 50;
/// Cases of each scenario that are open at first.
const OPEN_MAX: usize = 5;
const STYLE: &str = include_str!("report.css");

/// The page.
pub(crate) fn page(report: &Report, replay: &Replay<'_>) -> String {
    let counts = [Status::Passed, Status::Failed, Status::Error].map(|status| report.count(status));
    let [passed, failed, errors] = counts;
    let verdict = class(report.status());
    let elapsed_s: f64 = report.outcomes().map(|outcome| outcome.elapsed.as_secs_f64()).sum();
    let mut html = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
         <title>{passed} passed, {failed} failed, {errors} not run</title>\
         <style>{STYLE}</style></head>\n<body><header class=\"{verdict}\"><h1>{}</h1>\n\
         <p>{passed} passed, {failed} failed, {errors} not run, in {elapsed_s:.1} s of running \
         cases; plantctl {}</p></header>\n",
        match report.status() {
            Status::Passed => "Every expectation came true",
            Status::Failed => "Expectations broke",
            Status::Error => "Not everything could be run",
        },
        env!("CARGO_PKG_VERSION"),
    );
    overview(&mut html, report);
    for unusable in &report.unusable {
        let _ = writeln!(
            html,
            "<section><h2>{}</h2>\n<pre>{}</pre></section>",
            escaped(&unusable.file.to_string_lossy()),
            escaped(&unusable.error)
        );
    }
    for (index, tested) in report.tested.iter().enumerate() {
        scenario(&mut html, index, tested, replay);
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

/// A line for each scenario.
fn overview(html: &mut String, report: &Report) {
    html.push_str(
        "<table><thead><tr><th>scenario</th><th>passed</th><th>failed</th><th>not run</th>\
         <th>s</th></tr></thead><tbody>\n",
    );
    for (index, ScenarioResult { prepared, outcomes }) in report.tested.iter().enumerate() {
        let count = |status| outcomes.iter().filter(|o| o.status() == status).count();
        let cell = |status| match count(status) {
            0 => "<td class=\"none\">0</td>".to_owned(),
            count => format!("<td class=\"{}\">{count}</td>", class(status)),
        };
        let elapsed_s: f64 = outcomes.iter().map(|outcome| outcome.elapsed.as_secs_f64()).sum();
        let _ = writeln!(
            html,
            "<tr><td><a href=\"#s{index}\">{}</a></td>{}{}{}<td>{elapsed_s:.1}</td></tr>",
            escaped(&prepared.name),
            cell(Status::Passed),
            cell(Status::Failed),
            cell(Status::Error),
        );
    }
    html.push_str(
        "</tbody></table>\n<p class=\"key\"><svg viewBox=\"0 0 36 12\" width=\"36\" height=\"12\">\
         <path class=\"curve\" d=\"M2 6H34\"/></svg> the signal \
         <svg viewBox=\"0 0 36 12\" width=\"36\" height=\"12\"><path class=\"band\" \
         d=\"M2 1H34V11H2Z\"/><path class=\"bound\" d=\"M2 1H34M2 11H34\"/></svg> where it is \
         expected, and when <svg viewBox=\"0 0 12 12\" width=\"12\" height=\"12\">\
         <circle class=\"break\" cx=\"6\" cy=\"6\" r=\"4.5\"/></svg> where it breaks the \
         expectation</p>\n",
    );
}

fn scenario(html: &mut String, index: usize, tested: &ScenarioResult, replay: &Replay<'_>) {
    let ScenarioResult { prepared, outcomes } = tested;
    let _ = writeln!(
        html,
        "<section id=\"s{index}\"><h2>{}</h2>\n<p>{} <code>{}</code></p>",
        escaped(&prepared.name),
        escaped(&prepared.scenario.description),
        escaped(&prepared.file.to_string_lossy())
    );
    let (mut passed, mut broken) = (0, 0);
    // What broke comes first.
    let mut sorted: Vec<&Outcome> = outcomes.iter().collect();
    sorted.sort_by_key(|outcome| std::cmp::Reverse(outcome.status()));
    for outcome in sorted {
        let status = outcome.status();
        let is_passed = status == Status::Passed;
        passed += usize::from(is_passed);
        broken += usize::from(!is_passed);
        let is_open = !is_passed && broken <= OPEN_MAX;
        let (class, open) = (class(status), if is_open { " open" } else { "" });
        let name = match outcome.case.is_empty() {
            true => escaped(&prepared.name),
            false => escaped(&outcome.case),
        };
        let _ = writeln!(
            html,
            "<details class=\"{class}\"{open}><summary><b class=\"{class}\">{class}</b> {name} \
             <small>{} steps in {:.2} s</small></summary>",
            outcome.steps,
            outcome.elapsed.as_secs_f64()
        );
        for line in outcome.error.iter().chain(&outcome.ended) {
            let _ = writeln!(html, "<p class=\"why\">{}</p>", escaped(line));
        }
        if !is_passed {
            let command = escaped(&replay.command(prepared, outcome));
            let _ = writeln!(html, "<pre>{command}</pre>");
        }
        let has_plots = if is_passed { passed <= PASSED_PLOTTED } else { broken <= BROKEN_PLOTTED };
        figures(html, outcome, has_plots);
        if !outcome.output.is_empty() {
            let _ = writeln!(
                html,
                "<details><summary>what the controller wrote</summary><pre>{}</pre></details>",
                escaped(&outcome.output)
            );
        }
        html.push_str("</details>\n");
    }
    html.push_str("</section>\n");
}

/// What came of each expectation, those that broke first, and the other signals.
fn figures(html: &mut String, outcome: &Outcome, has_plots: bool) {
    let mut verdicts: Vec<&Verdict> = outcome.verdicts.iter().collect();
    verdicts.sort_by_key(|verdict| verdict.broken.is_none());
    html.push_str("<div class=\"figures\">\n");
    let mut figure = |caption: String, curve: Option<&Curve>, at: Option<(f64, f64)>| {
        let svg = curve.filter(|_| has_plots).map(|curve| svg(&outcome.time_s, curve, at));
        let svg = svg.unwrap_or_default();
        let _ = writeln!(html, "<figure><figcaption>{caption}</figcaption>{svg}</figure>");
    };
    for verdict in verdicts {
        let class = class(if verdict.broken.is_some() { Status::Failed } else { Status::Passed });
        let (expectation, message) = (escaped(&verdict.expectation), escaped(&verdict.message));
        let caption = format!("<b class=\"{class}\">{class}</b> {expectation}: {message}");
        let at = verdict.broken.and_then(|broken| broken.time_s.zip(broken.value));
        figure(caption, verdict.curve.as_ref(), at);
    }
    for curve in outcome.plots.iter().filter(|_| has_plots) {
        figure(escaped(&curve.name), Some(curve), None);
    }
    html.push_str("</div>\n");
}
