//! `plot`: signals of a recording, in the terminal or as a picture.

use std::collections::BTreeMap;
use std::io::IsTerminal as _;
use std::path::PathBuf;

use anyhow::{Context as _, Result, bail};
use clap::Args;
use plantd_client::{RecordingEntry, RecordingReader, v1};
use serde_json::json;

use crate::contract::names;
use crate::figure::axis::Axis;
use crate::figure::browser;
use crate::figure::chart::{self, Curve};
use crate::figure::terminal;
use crate::output::page::{Page, table};
use crate::scenario::columns::{Columns, Sample};
use crate::server::context::Context;
use plantd_expect::Samples;

/// Columns where the terminal does not say how many it has.
const COLUMNS: usize = 80;
const COLUMNS_MAX: usize = 160;
/// Rows of characters of one, two, or more panels.
const ROWS: [usize; 3] = [16, 9, 6];
/// How like a name must be to be meant; 1 is the same.
const LIKENESS_MIN: f64 = 0.6;

/// Plots signals of a recording over time.
///
/// Signals are q.NAME, p.NAME, velocity.NAME and v.NAME of coordinates, u.NAME of inputs, force.NAME of
/// constraint equations, y.NAME of outputs, and energy.kinetic, .potential and .total; without any, those that there
/// are are listed.
#[derive(Debug, Args)]
pub(crate) struct Plot {
    /// Recording.
    file: PathBuf,
    /// Signals.
    signals: Vec<String>,
    /// Picture instead of characters, those of one unit in one panel: FILE.svg, or FILE.png by a browser.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Browser for PNG: a Chromium or Chrome; the first on the path if not given.
    #[arg(long, value_name = "PROGRAM", env = "CHROME")]
    browser: Option<PathBuf>,
    /// Begin at this time of the plant, s.
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
    from: Option<f64>,
    /// End at this time of the plant, s.
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
    until: Option<f64>,
}

impl Plot {
    pub(crate) fn run(self, context: &Context) -> Result<()> {
        let recording = Recorded::read(self.file)?;
        if self.signals.is_empty() {
            let rows =
                recording.names.iter().map(|(name, unit)| json!({ "name": name, "unit": unit }));
            let json = || json!({ "signals": rows.collect::<Vec<_>>() });
            let row = |(name, unit): &(String, String)| vec![name.clone(), unit.clone()];
            let table = || table(&["signal", "unit"], recording.names.iter().map(row));
            return context.output.print(json, table);
        }
        let range = self.from.unwrap_or(f64::NEG_INFINITY)..=self.until.unwrap_or(f64::INFINITY);
        let curves = self.signals.iter().map(|name| {
            let mut curve = recording.curve(name)?;
            let kept: Vec<_> = curve.time_s.iter().map(|time| range.contains(time)).collect();
            retain(&mut curve.time_s, &kept);
            retain(&mut curve.values, &kept);
            Ok(curve)
        });
        let curves = curves.collect::<Result<Vec<Curve>>>()?;
        if curves.iter().all(|curve| curve.time_s.is_empty()) {
            bail!("there is no step in the range of time that was asked for");
        }
        let Some(path) = self.out else { return show(&curves, context) };
        let (size, svg) = chart::svg(&curves);
        match path.extension().and_then(|extension| extension.to_str()) {
            Some("svg") => std::fs::write(&path, svg)
                .with_context(|| format!("cannot write {}", path.display()))?,
            Some("png") => {
                let browser = browser::find(self.browser.as_deref())
                    .context("a picture as PNG is made by a browser; one as SVG needs nothing")?;
                browser::png_of_svg(&browser, &svg, size, &path)?;
            }
            _ => bail!("{}: plots are written as .svg or .png", path.display()),
        }
        let said = format!("{} curves are drawn in {}", curves.len(), path.display());
        context.output.done(json!({ "file": path, "signals": self.signals }), &said)
    }
}

fn retain(numbers: &mut Vec<f64>, kept: &[bool]) {
    let mut kept = kept.iter();
    numbers.retain(|_| kept.next() == Some(&true));
}

/// Prints a panel for each curve, or the numbers.
fn show(curves: &[Curve], context: &Context) -> Result<()> {
    let json = || {
        let curve = |curve: &Curve| {
            json!({
                "name": curve.name,
                "unit": curve.unit,
                "time_s": curve.time_s,
                "values": curve.values,
            })
        };
        json!({ "curves": curves.iter().map(curve).collect::<Vec<_>>() })
    };
    let text = || {
        let times = Axis::over(curves.iter().flat_map(|curve| &curve.time_s).copied());
        let rows = ROWS[(curves.len() - 1).min(ROWS.len() - 1)];
        let panels = curves.iter().map(|curve| terminal::panel(curve, &times, width(), rows));
        let mut page = Page::from(panels.collect::<Vec<_>>().join("\n"));
        for curve in curves {
            let points = curve.time_s.iter().zip(&curve.values);
            page.data(table(&["time_s", &curve.name], points.map(|(t, y)| vec![*t, *y])));
        }
        page
    };
    context.output.print(json, text)
}

/// Columns of the terminal.
fn width() -> usize {
    let output = std::io::stdout();
    let size = output.is_terminal().then(|| rustix::termios::tcgetwinsize(&output).ok()).flatten();
    let columns = size.map_or(0, |size| usize::from(size.ws_col));
    if columns < 40 { COLUMNS } else { columns.min(COLUMNS_MAX) }
}

type OfEnergy = fn(&v1::Energy) -> f64;
type IsThere = fn(&v1::Coordinate) -> bool;

/// Signals of the energy.
const ENERGIES: [(&str, OfEnergy); 3] = [
    ("energy.kinetic", |energy| energy.kinetic_j),
    ("energy.potential", |energy| energy.potential_j),
    ("energy.total", |energy| energy.kinetic_j + energy.potential_j),
];

/// The steps of a recording as columns.
struct Recorded {
    samples: Samples,
    energies: Vec<(f64, v1::Energy)>,
    /// What can be plotted, with units.
    names: Vec<(String, String)>,
}

impl Recorded {
    fn read(file: PathBuf) -> Result<Self> {
        let mut recording = RecordingReader::open(file)?;
        let record = recording.plant().clone();
        let model = record.model.unwrap_or_default();
        let plant = record.plant.unwrap_or_default();
        let mut time_step_s = plant.settings.map_or(f64::NAN, |settings| settings.time_step_s);
        let columns = Columns::new(&model, &record.outputs, false, false);
        let mut samples = columns.empty();
        let mut push = |state: &v1::State, u: &[f64], y: &[f64], time_step_s| {
            let sample = Sample { state, time_step_s, u, y, energy: None, reference: None };
            columns.push(&mut samples, sample);
        };
        let mut energies = Vec::new();
        if let Some(state) = &plant.state {
            push(state, &[], &[], time_step_s);
        }
        while let Some(entry) = recording.next_entry()? {
            match entry {
                RecordingEntry::Step(step) => {
                    let y = step.outputs.as_ref().map_or(&[][..], |outputs| &outputs.y);
                    push(&step.state.clone().unwrap_or_default(), &step.u, y, time_step_s);
                }
                RecordingEntry::Mark(mark) if mark.time_step_s > 0.0 => {
                    time_step_s = mark.time_step_s;
                }
                RecordingEntry::Energy { time_s, energy } => energies.push((time_s, energy)),
                RecordingEntry::Mark(_) | RecordingEntry::Event(_) => {}
            }
        }
        let mut names = signals(&model, &record.outputs);
        if !energies.is_empty() {
            names.extend(ENERGIES.map(|(name, _)| (name.to_owned(), "J".to_owned())));
        }
        Ok(Self { samples, energies, names })
    }

    /// A signal by its name: `q.theta`, `q(theta)`, or `theta` where only one can be meant.
    fn curve(&self, asked: &str) -> Result<Curve> {
        let written = match asked.split_once('(') {
            Some((quantity, rest)) if rest.ends_with(')') => {
                format!("{quantity}.{}", rest.trim_end_matches(')'))
            }
            _ => asked.to_owned(),
        };
        let end = format!(".{written}");
        let exact = self.names.iter().find(|(name, _)| *name == written);
        let Some((name, unit)) =
            exact.or_else(|| self.names.iter().find(|(n, _)| n.ends_with(&end)))
        else {
            bail!("there is no signal `{asked}`; {}", self.suggestion(&written));
        };
        let (name, unit) = (name.clone(), unit.clone());
        if let Some((_, of)) = ENERGIES.iter().find(|(energy, _)| *energy == name) {
            let (time_s, values) = self.energies.iter().map(|(t, energy)| (*t, of(energy))).unzip();
            return Ok(Curve { name, unit, time_s, values });
        }
        let column = match name.split_once('.') {
            Some((quantity, rest)) => format!("{quantity}({rest})"),
            None => name.clone(),
        };
        let values = self.samples.signal(&column).map_err(anyhow::Error::msg)?;
        let time_s = self.samples.time_s().to_vec();
        Ok(Curve { name, unit, time_s, values })
    }

    /// What may have been meant.
    fn suggestion(&self, asked: &str) -> String {
        let likeness = |name: &str| strsim::jaro(name, asked);
        let names = self.names.iter().map(|(name, _)| (likeness(name), name));
        match names.max_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((likeness, name)) if likeness >= LIKENESS_MIN => format!("did you mean `{name}`?"),
            _ => "without a signal, `plantctl plot FILE` lists those that there are".to_owned(),
        }
    }
}

/// What can be plotted of a model, with units.
fn signals(model: &v1::Model, outputs: &[String]) -> Vec<(String, String)> {
    let mut signals = Vec::new();
    let mut add = |quantity: &str, name: &str, unit: &str| {
        signals.push((format!("{quantity}.{name}"), unit.to_owned()));
    };
    let unit = |coordinate: &v1::Coordinate, of_lengths: &'static str, of_angles: &'static str| {
        match coordinate.unit() {
            v1::Unit::Metre => of_lengths,
            v1::Unit::Radian => of_angles,
            v1::Unit::Unspecified => "",
        }
    };
    let all = &model.coordinates;
    let of_coordinates: [(_, _, _, IsThere); 4] = [
        ("q", "m", "rad", |_| true),
        ("p", "kg m/s", "kg m²/s", |c| !c.prescribed),
        ("velocity", "m/s", "rad/s", |_| true),
        ("v", "m/s", "rad/s", |c| c.prescribed),
    ];
    for (quantity, of_lengths, of_angles, is_there) in of_coordinates {
        for coordinate in all.iter().filter(|c| is_there(c)) {
            add(quantity, &coordinate.name, unit(coordinate, of_lengths, of_angles));
        }
    }
    let forces = forces(&model.scene_toml);
    let by_name: BTreeMap<_, _> = all.iter().map(|c| (c.name.as_str(), c)).collect();
    for input in &model.inputs {
        let on = forces.get(input).and_then(|name| by_name.get(name.as_str()));
        add("u", input, on.map_or("N or N m", |coordinate| unit(coordinate, "N", "N m")));
    }
    for name in names::prescribed(model) {
        add("u", name, by_name.get(name.as_str()).map_or("", |c| unit(c, "m", "rad")));
    }
    model.constraints.iter().for_each(|name| add("force", name, "N or N m"));
    outputs.iter().for_each(|name| add("y", name, ""));
    signals
}

/// The coordinates on which inputs of a scene act, by the inputs' names.
fn forces(scene: &str) -> BTreeMap<String, String> {
    let scene: toml::Table = scene.parse().unwrap_or_default();
    let inputs = scene.get("inputs").and_then(|inputs| inputs.as_array()).into_iter().flatten();
    let text = |input: &toml::Value, key| Some(input.get(key)?.as_str()?.to_owned());
    inputs.filter_map(|input| Some((text(input, "name")?, text(input, "coordinate")?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recorded() -> Recorded {
        let coordinate = |name: &str, prescribed, unit: v1::Unit| v1::Coordinate {
            name: name.to_owned(),
            prescribed,
            unit: unit.into(),
            ..Default::default()
        };
        let model = v1::Model {
            coordinates: vec![
                coordinate("theta", false, v1::Unit::Radian),
                coordinate("lift", true, v1::Unit::Metre),
            ],
            inputs: vec!["tau".to_owned()],
            scene_toml: "[[inputs]]\nname = \"tau\"\ncoordinate = \"theta\"\n".to_owned(),
            ..Default::default()
        };
        let outputs = ["tip.x".to_owned()];
        let columns = Columns::new(&model, &outputs, false, false);
        let mut samples = columns.empty();
        let state = v1::State { q: vec![0.25, 2.0], p: vec![3.0], ..Default::default() };
        let sample = Sample {
            state: &state,
            time_step_s: 0.1,
            u: &[8.0, 8.5],
            y: &[1.5],
            energy: None,
            reference: None,
        };
        columns.push(&mut samples, sample);
        Recorded { samples, energies: Vec::new(), names: signals(&model, &outputs) }
    }

    #[test]
    fn signals_have_their_names_and_units() {
        let recorded = recorded();
        for (asked, title, value) in [
            ("q.theta", "q.theta, rad", 0.25),
            ("theta", "q.theta, rad", 0.25),
            ("q(lift)", "q.lift, m", 2.0),
            ("p.theta", "p.theta, kg m²/s", 3.0),
            ("tau", "u.tau, N m", 8.0),
            ("u.lift", "u.lift, m", 8.5),
            ("y.tip.x", "y.tip.x", 1.5),
        ] {
            let curve = recorded.curve(asked).unwrap();
            assert_eq!((curve.title().as_str(), curve.values[0]), (title, value), "{asked}");
        }
    }

    #[test]
    fn a_slip_gets_the_nearest_name() {
        let error = recorded().curve("q.tehta").unwrap_err().to_string();
        assert_eq!(error, "there is no signal `q.tehta`; did you mean `q.theta`?");
        let error = recorded().curve("zzz").unwrap_err().to_string();
        assert!(error.contains("lists those"), "{error}");
    }
}
