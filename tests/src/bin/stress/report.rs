//! The table as Markdown, and plots as SVG.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context as _, Result, anyhow};
use plotters::prelude::*;

use crate::case::{Line, Outcome};

const SIZE: (u32, u32) = (860, 480);
/// Told apart also without colours, by their order in the legend.
const COLORS: [RGBColor; 7] = [
    RGBColor(0, 90, 160),
    RGBColor(204, 85, 0),
    RGBColor(0, 130, 80),
    RGBColor(150, 60, 150),
    RGBColor(110, 110, 110),
    RGBColor(180, 150, 0),
    RGBColor(0, 150, 170),
];
/// Below every relative error.
const LEAST: f64 = 1e-18;

/// Writes all of it into a folder.
pub(crate) fn write(out: &Path, outcomes: &[Outcome]) -> Result<()> {
    let table = out.join("stress.md");
    std::fs::write(&table, markdown(outcomes))
        .with_context(|| format!("cannot write {}", table.display()))?;
    let lines = |plot: &str| -> Vec<&Line> {
        let lines = outcomes.iter().flat_map(|outcome| &outcome.finding.lines);
        lines.filter(|line| line.plot == plot && !line.points.is_empty()).collect()
    };
    let derivatives: Vec<Line> = [
        ("found", (|error| error.found) as fn(crate::derivatives::Error) -> f64),
        ("resolved by differences", |error| error.resolved),
    ]
    .into_iter()
    .map(|(name, of)| Line {
        plot: "derivatives",
        name: name.to_owned(),
        points: (outcomes.iter().filter_map(|outcome| outcome.finding.derivatives).enumerate())
            .map(|(i, error)| (i as f64 + 1.0, of(error)))
            .collect(),
    })
    .collect();
    let plots = [
        Plot {
            file: "energy.svg",
            title: "Distance of the modified energy from its start, midpoint rule",
            x: "steps",
            y: "of the largest kinetic energy",
            lines: lines("energy"),
            dots: true,
            legend: SeriesLabelPosition::UpperLeft,
        },
        Plot {
            file: "energy-orders.svg",
            title: "Distance of the energy from its start, higher orders",
            x: "steps",
            y: "of the largest kinetic energy",
            lines: lines("energy-orders"),
            dots: true,
            legend: SeriesLabelPosition::LowerLeft,
        },
        Plot {
            file: "refused.svg",
            title: "Random scenes of which a step was refused",
            x: "time step, s",
            y: "fraction",
            lines: lines("refused"),
            dots: false,
            legend: SeriesLabelPosition::LowerRight,
        },
        Plot {
            file: "derivatives.svg",
            title: "Error of A and B, relative",
            x: "case",
            y: "found, and resolved",
            lines: derivatives.iter().filter(|line| !line.points.is_empty()).collect(),
            dots: true,
            legend: SeriesLabelPosition::LowerRight,
        },
    ];
    plots.iter().filter(|plot| !plot.lines.is_empty()).try_for_each(|plot| {
        let path = out.join(plot.file);
        plot.draw(&path).map_err(|error| anyhow!("cannot draw {}: {error}", path.display()))
    })
}

fn markdown(outcomes: &[Outcome]) -> String {
    let mut text = String::from(
        "| case | order, substeps | verdict | found | A, B: error, resolved | CPU s |\n| --- | --- | --- | --- | --- | --- |\n",
    );
    for outcome in outcomes {
        let derivatives = outcome
            .finding
            .derivatives
            .map_or(String::new(), |error| format!("{:.0e}, {:.0e}", error.found, error.resolved));
        let (order, substeps) = outcome.finding.method.unwrap_or((2, 1));
        let found = outcome.finding.text.replace('|', "\\|");
        let _ = writeln!(
            text,
            "| {} | {order}, {substeps} | {} | {found} | {derivatives} | {:.1} |",
            outcome.name,
            outcome.verdict.text(),
            outcome.cpu_s
        );
    }
    let mut criterion = "";
    text.push_str("\nWhat they must satisfy:\n\n");
    for outcome in outcomes {
        if outcome.criterion != criterion {
            criterion = &outcome.criterion;
            let _ = writeln!(text, "- {} and alike: {criterion}.", outcome.name);
        }
    }
    text
}

struct Plot<'a> {
    file: &'a str,
    title: &'a str,
    x: &'a str,
    y: &'a str,
    lines: Vec<&'a Line>,
    /// Single points, on a logarithmic ordinate.
    dots: bool,
    legend: SeriesLabelPosition,
}

impl Plot<'_> {
    fn draw(&self, path: &Path) -> Result<(), Box<dyn std::error::Error>> {
        let points = || self.lines.iter().flat_map(|line| &line.points);
        let range = |of: fn(&(f64, f64)) -> f64| {
            let values = || points().map(of).filter(|value| *value > 0.0);
            let least = values().fold(f64::INFINITY, f64::min).max(LEAST);
            let most = values().fold(0.0, f64::max).max(10.0 * least);
            0.8 * least..1.6 * most
        };
        let area = SVGBackend::new(path, SIZE).into_drawing_area();
        area.fill(&WHITE)?;
        let y = if self.dots { range(|point| point.1) } else { 1e-3..1.6 };
        let mut chart = ChartBuilder::on(&area)
            .margin(16)
            .caption(self.title, ("sans-serif", 20))
            .x_label_area_size(44)
            .y_label_area_size(72)
            .build_cartesian_2d(range(|point| point.0).log_scale(), y.log_scale())?;
        chart
            .configure_mesh()
            .x_desc(self.x)
            .y_desc(self.y)
            .x_label_formatter(&|x| format!("{x:e}"))
            .y_label_formatter(&|y| format!("{y:.0e}"))
            .label_style(("sans-serif", 14))
            .axis_desc_style(("sans-serif", 15))
            .light_line_style(TRANSPARENT)
            .bold_line_style(BLACK.mix(0.12))
            .draw()?;
        for (line, color) in self.lines.iter().zip(COLORS.iter().cycle()) {
            let points = || line.points.iter().map(|(x, y)| (*x, y.max(LEAST)));
            let series = if self.dots {
                let dots = points().map(|point| Circle::new(point, 2, color.filled()));
                chart.draw_series(dots)?
            } else {
                chart.draw_series(LineSeries::new(points(), color.stroke_width(2)))?
            };
            series.label(&line.name).legend(move |(x, y)| {
                PathElement::new([(x, y), (x + 22, y)], color.stroke_width(2))
            });
        }
        chart
            .configure_series_labels()
            .position(self.legend.clone())
            .background_style(WHITE.mix(0.85))
            .label_font(("sans-serif", 14))
            .draw()?;
        area.present()?;
        Ok(())
    }
}
