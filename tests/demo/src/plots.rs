//! Plots of the demo, as SVG.

use std::path::Path;

use anyhow::{Result, anyhow};
use plotters::coord::ranged1d::{AsRangedCoord, ValueFormatter};
use plotters::prelude::*;

use crate::{marionette, pendulum};

const SIZE: (u32, u32) = (860, 440);
/// Angles shown of the pendulum, rad.
const PENDULUM_RANGE: std::ops::Range<f64> = -0.1..0.7;
/// Open loop, closed loop, reference: told apart also without colours.
const OPEN: RGBColor = RGBColor(204, 85, 0);
const CLOSED: RGBColor = RGBColor(0, 90, 160);
const REFERENCE: RGBColor = RGBColor(120, 120, 120);

/// A named line of a plot, sampled each time step.
struct Line<'a> {
    name: &'a str,
    values: &'a [f64],
    color: RGBColor,
    width: u32,
}

/// Draws all plots into `folder`.
pub(crate) fn draw(
    folder: &Path,
    pendulum: &pendulum::Report,
    marionette: &marionette::Report,
) -> Result<()> {
    let line = |name, values, color, width| Line { name, values, color, width };
    let (open, closed) = (&marionette.open_loop, &marionette.closed_loop);
    let end_s = marionette::TIME_STEP_S * open.error_norms.len() as f64;
    let lines = [
        line("open loop", &open.error_norms, OPEN, 2),
        line("closed loop", &closed.error_norms, CLOSED, 2),
    ];
    let range = bounds(&lines);
    Plot {
        title: "Marionette: distance from the reference motion",
        ordinate: "|q − q_ref| of 22 coordinates",
        time_step_s: marionette::TIME_STEP_S,
        end_s,
    }
    .draw(
        &folder.join("marionette-error.svg"),
        (range.start * 0.7..range.end * 1.5).log_scale(),
        &|y| format!("{y:.0e}"),
        &lines,
    )?;

    let lines = [
        line("reference", &marionette.reference_angle, REFERENCE, 1),
        line("open loop", &open.angles, OPEN, 2),
        line("closed loop", &closed.angles, CLOSED, 2),
    ];
    Plot {
        title: "Marionette: angle of the torso",
        ordinate: "torso_rx, rad",
        time_step_s: marionette::TIME_STEP_S,
        end_s,
    }
    .draw(
        &folder.join("marionette-torso.svg"),
        padded(bounds(&lines)),
        &|y| format!("{y:.2}"),
        &lines,
    )?;

    // Until it leaves the plot: from there on it turns over and over.
    let end = pendulum.unregulated.iter().position(|angle| angle.abs() > PENDULUM_RANGE.end);
    let falling = &pendulum.unregulated[..end.unwrap_or(pendulum.unregulated.len())];
    let lines =
        [line("without feedback", falling, OPEN, 2), line("LQR", &pendulum.regulated, CLOSED, 2)];
    Plot {
        title: "Pendulum: regulated upright, pushed at 3 s",
        ordinate: "θ − π, rad",
        time_step_s: pendulum::TIME_STEP_S,
        end_s: pendulum::TIME_STEP_S * pendulum.regulated.len() as f64,
    }
    .draw(
        &folder.join("pendulum.svg"),
        PENDULUM_RANGE,
        &|y| unsigned_zero(format!("{y:.1}")),
        &lines,
    )
}

struct Plot<'a> {
    title: &'a str,
    ordinate: &'a str,
    time_step_s: f64,
    end_s: f64,
}

impl Plot<'_> {
    fn draw<Y>(
        &self,
        path: &Path,
        range: Y,
        label: &dyn Fn(&f64) -> String,
        lines: &[Line<'_>],
    ) -> Result<()>
    where
        Y: AsRangedCoord<Value = f64>,
        Y::CoordDescType: ValueFormatter<f64>,
    {
        self.try_draw(path, range, label, lines)
            .map_err(|error| anyhow!("cannot draw {}: {error}", path.display()))
    }

    fn try_draw<Y>(
        &self,
        path: &Path,
        range: Y,
        label: &dyn Fn(&f64) -> String,
        lines: &[Line<'_>],
    ) -> Result<(), Box<dyn std::error::Error>>
    where
        Y: AsRangedCoord<Value = f64>,
        Y::CoordDescType: ValueFormatter<f64>,
    {
        let area = SVGBackend::new(path, SIZE).into_drawing_area();
        area.fill(&WHITE)?;
        let mut chart = ChartBuilder::on(&area)
            .margin(16)
            .caption(self.title, ("sans-serif", 20))
            .x_label_area_size(44)
            .y_label_area_size(64)
            .build_cartesian_2d(0.0..self.end_s, range)?;
        chart
            .configure_mesh()
            .x_desc("time, s")
            .y_desc(self.ordinate)
            .x_label_formatter(&|x| format!("{x:.0}"))
            .y_label_formatter(&|y| label(y))
            .label_style(("sans-serif", 14))
            .axis_desc_style(("sans-serif", 15))
            .light_line_style(TRANSPARENT)
            .bold_line_style(BLACK.mix(0.12))
            .draw()?;
        for &Line { name, values, color, width } in lines {
            let style = color.stroke_width(width);
            let points = values.iter().enumerate().map(|(k, &y)| (k as f64 * self.time_step_s, y));
            chart
                .draw_series(LineSeries::new(points, style))?
                .label(name)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 22, y)], style));
        }
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::UpperRight)
            .background_style(WHITE.mix(0.85))
            .label_font(("sans-serif", 14))
            .draw()?;
        area.present()?;
        Ok(())
    }
}

/// Ticks miss zero by round-off.
fn unsigned_zero(label: String) -> String {
    if label == "-0.0" { "0.0".to_owned() } else { label }
}

fn bounds(lines: &[Line<'_>]) -> std::ops::Range<f64> {
    let values = || lines.iter().flat_map(|line| line.values).copied();
    values().fold(f64::INFINITY, f64::min)..values().fold(f64::NEG_INFINITY, f64::max)
}

fn padded(range: std::ops::Range<f64>) -> std::ops::Range<f64> {
    let margin = 0.08 * (range.end - range.start);
    range.start - margin..range.end + margin
}
