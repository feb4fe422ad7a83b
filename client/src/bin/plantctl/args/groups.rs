//! Arguments that several commands have in common, and their values.

use std::path::PathBuf;

use clap::{Args as Group, ValueEnum};
use plantd_client::{WeightsExt as _, v1};

/// What a feedback keeps a plant at.
#[derive(Debug, Group)]
#[group(required = true, multiple = false)]
pub(crate) struct Reference {
    /// Operating point of the plant's scene.
    #[arg(long, value_name = "POINT")]
    pub(crate) at: Option<String>,
    /// Where the plant is now.
    #[arg(long)]
    pub(crate) here: bool,
    /// The trajectory of this file: a result of `optimize --save`.
    #[arg(long, value_name = "FILE")]
    pub(crate) trajectory: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Mode {
    /// Nothing: the gains are for those who watch them.
    WatchOnly,
    /// u = law; what the driver sends is not used.
    Replace,
    /// u = law + what the driver sends.
    Add,
    /// u = law once an entry has left its bounds.
    Guard,
}

impl From<Mode> for v1::FeedbackMode {
    fn from(mode: Mode) -> Self {
        match mode {
            Mode::WatchOnly => Self::WatchOnly,
            Mode::Replace => Self::Replace,
            Mode::Add => Self::Add,
            Mode::Guard => Self::Guard,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Method {
    /// Identity in place of second derivatives.
    Steepest,
    /// Second derivatives of the cost, first derivatives of the map.
    QuasiNewton,
    /// Second derivatives of the cost and of the map.
    Newton,
}

impl From<Method> for v1::DescentMethod {
    fn from(method: Method) -> Self {
        match method {
            Method::Steepest => Self::Steepest,
            Method::QuasiNewton => Self::QuasiNewton,
            Method::Newton => Self::Newton,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Plural {
    Models,
    Plants,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Singular {
    Model,
    Plant,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Field {
    State,
    Report,
    Energy,
    Linearization,
    Gain,
    Input,
    Outputs,
}

impl From<Field> for v1::WatchField {
    fn from(field: Field) -> Self {
        match field {
            Field::State => Self::State,
            Field::Report => Self::Report,
            Field::Energy => Self::Energy,
            Field::Linearization => Self::Linearization,
            Field::Gain => Self::Gain,
            Field::Input => Self::Input,
            Field::Outputs => Self::Outputs,
        }
    }
}

/// How a plant is stepped.
#[derive(Debug, Group)]
pub(crate) struct Settings {
    /// Time step in seconds; the scene's if not given.
    #[arg(long, value_name = "SECONDS")]
    dt: Option<f64>,
    /// Put all forces at the start of a step, as the paper does.
    #[arg(long)]
    paper: bool,
    /// Order of accuracy: 2, 4, 6, 8, or 12 without constraints and ball joints; 2 if not given.
    #[arg(long, value_name = "ORDER")]
    order: Option<u32>,
    /// Steps of the method in a time step.
    #[arg(long, value_name = "N")]
    substeps: Option<u32>,
    /// How often a time step that cannot be solved is halved; 8 if not given.
    #[arg(long, value_name = "N")]
    halvings: Option<u32>,
    /// Stop the solver at eleven digits instead of at round-off.
    #[arg(long)]
    fast: bool,
    /// Newton iterations before a step is given up.
    #[arg(long, value_name = "N")]
    max_iterations: Option<u32>,
    /// Reciprocal condition below which a step is refused.
    #[arg(long, value_name = "NUMBER")]
    singular_below: Option<f64>,
}

impl From<Settings> for v1::PlantSettings {
    fn from(settings: Settings) -> Self {
        let split =
            if settings.paper { v1::ForceSplit::Paper } else { v1::ForceSplit::Unspecified };
        let precision =
            if settings.fast { v1::Precision::Fast } else { v1::Precision::Unspecified };
        Self {
            time_step_s: settings.dt.unwrap_or(0.0),
            force_split: split.into(),
            max_iterations: settings.max_iterations.unwrap_or(0),
            singular_below: settings.singular_below.unwrap_or(0.0),
            order: settings.order.unwrap_or(0),
            substeps: settings.substeps.unwrap_or(0),
            halvings: settings.halvings,
            precision: precision.into(),
            tolerance: 0.0,
        }
    }
}

/// Where a plant starts; the scene's initial configuration at rest if nothing is given.
#[derive(Debug, Group)]
pub(crate) struct Initial {
    /// Operating point of the scene, at rest.
    #[arg(long, value_name = "POINT", conflicts_with_all = ["q", "v", "p"])]
    at: Option<String>,
    /// Configuration, comma-separated, dynamic coordinates first.
    #[arg(long, value_parser = numbers, allow_hyphen_values = true)]
    q: Option<Numbers>,
    /// Velocity, comma-separated; zero if only `--q` is given.
    #[arg(long, requires = "q", conflicts_with = "p", value_parser = numbers, allow_hyphen_values = true)]
    v: Option<Numbers>,
    /// Discrete momentum of the dynamic coordinates, comma-separated.
    #[arg(long, requires = "q", value_parser = numbers, allow_hyphen_values = true)]
    p: Option<Numbers>,
}

impl From<Initial> for Option<v1::InitialState> {
    fn from(initial: Initial) -> Self {
        use v1::initial_state::{Form, Momentum, Velocity};
        let form = match initial {
            Initial { at: Some(point), .. } => Form::OperatingPoint(point),
            Initial { q: Some(q), p: Some(p), .. } => {
                Form::Momentum(Momentum { q: q.0, p: p.0, v: Vec::new() })
            }
            Initial { q: Some(q), v, .. } => {
                let rest = || vec![0.0; q.0.len()];
                let v = v.map_or_else(rest, |v| v.0);
                Form::Velocity(Velocity { q: q.0, v })
            }
            _ => return None,
        };
        Some(v1::InitialState { form: Some(form) })
    }
}

/// A model and a point of its map.
#[derive(Debug, Group)]
pub(crate) struct Point {
    /// Name of a model.
    #[arg(required_unless_present = "plant")]
    pub(crate) model: Option<String>,
    /// Operating point.
    #[arg(long, value_name = "POINT", default_value = "initial")]
    pub(crate) at: String,
    /// Instead: the model, the settings and the present state of this plant.
    #[arg(long, value_name = "ID", conflicts_with_all = ["model", "at", "Settings"])]
    pub(crate) plant: Option<String>,
}

/// Weights of a regulator.
#[derive(Debug, Group)]
pub(crate) struct Weights {
    /// Diagonal of the state weight, comma-separated; one number stands for all.
    #[arg(long = "q", value_name = "Q", value_parser = numbers, default_value = "1")]
    pub(crate) q: Numbers,
    /// Diagonal of the input weight, comma-separated; one number stands for all.
    #[arg(long = "r", value_name = "R", value_parser = numbers, default_value = "1")]
    pub(crate) r: Numbers,
}

impl Weights {
    /// The weights for a model; lengths are for the server to judge.
    pub(crate) fn for_model(&self, model: &v1::Model) -> v1::LqrWeights {
        let prescribed = model.coordinates.iter().filter(|c| c.prescribed).count();
        let states = 2 * model.coordinates.len();
        let inputs = model.inputs.len() + prescribed;
        plantd_client::weights(self.q.diagonal(states), self.r.diagonal(inputs))
    }
}

/// Weights of a regulator that may be on either momentum.
#[derive(Debug, Group)]
pub(crate) struct RegulatorWeights {
    #[command(flatten)]
    weights: Weights,
    /// Weigh the projected momentum in place of the state's own.
    #[arg(long)]
    projected_momentum: bool,
}

impl RegulatorWeights {
    /// The weights for a model; lengths are for the server to judge.
    pub(crate) fn for_model(&self, model: &v1::Model) -> v1::LqrWeights {
        let weights = self.weights.for_model(model);
        if self.projected_momentum { weights.on_projected_momentum() } else { weights }
    }
}

/// Comma-separated numbers.
#[derive(Clone, Debug)]
pub(crate) struct Numbers(pub(crate) Vec<f64>);

impl Numbers {
    /// A diagonal weight; one number stands for all entries.
    pub(crate) fn diagonal(&self, count: usize) -> v1::Weight {
        match self.0.as_slice() {
            [value] => plantd_client::diagonal(vec![*value; count]),
            values => plantd_client::diagonal(values),
        }
    }
}

pub(crate) fn numbers(text: &str) -> Result<Numbers, String> {
    let number = |entry: &str| {
        entry.trim().parse().map_err(|_| format!("`{}` is not a number", entry.trim()))
    };
    text.split(',').map(number).collect::<Result<_, _>>().map(Numbers)
}

/// A named value.
#[derive(Clone, Debug)]
pub(crate) struct Assignment(pub(crate) String, pub(crate) f64);

pub(super) fn assignment(text: &str) -> Result<Assignment, String> {
    let (name, value) = text.split_once('=').ok_or("a name and a value with `=` are needed")?;
    let number = value.trim().parse();
    let number = number.map_err(|_| format!("`{}` is not a number", value.trim()))?;
    Ok(Assignment(name.trim().to_owned(), number))
}

pub(super) fn bound(text: &str) -> Result<v1::Bound, String> {
    let (entry, ends) =
        text.split_once('=').ok_or("an entry and its bounds with `=` are needed")?;
    let (min, max) = ends.split_once(':').ok_or("two ends with `:` between are needed")?;
    let end = |text: &str| match text.trim() {
        "" => Ok(None),
        text => text.parse().map(Some).map_err(|_| format!("`{text}` is not a number")),
    };
    Ok(v1::Bound { entry: entry.trim().to_owned(), min: end(min)?, max: end(max)? })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_end_of_a_bound_may_be_left_out() {
        let both = bound("p(theta)=-1:2").unwrap();
        assert_eq!((both.entry.as_str(), both.min, both.max), ("p(theta)", Some(-1.0), Some(2.0)));
        assert_eq!(bound("theta=:3").unwrap().min, None);
        assert!(bound("theta=3").is_err() && bound("theta=a:3").unwrap_err().contains("`a`"));
    }
}
