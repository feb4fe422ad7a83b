//! The problem of a search, as a person writes it.

use std::collections::BTreeMap;

use anyhow::{Context as _, Result, anyhow, ensure};
use clap::ValueEnum;
use plantd_client::{Client, MatrixExt as _, WeightsExt as _, full, v1};
use plantd_scene::in_plain_words;
use serde::Deserialize;

use crate::contract::names;
use crate::input::files::from_toml;
use crate::input::numbers::Vector;
use crate::input::settings::Settings;

/// What a problem may say.
pub(crate) const HELP: &str = "\
The problem, here the swing-up of a pendulum; only model, steps and cost must be there. A list of numbers can also be
a table of some by their names, { theta = 3.14 }: entries that are not named are zero, in `initial` those of the
scene, of a diagonal 1; a diagonal of one number stands for all:

  model = \"pendulum\"
  steps = 100
  time_step_s = 0.1                 # or `dt`; the scene's if not given
  paper = false                     # all forces at the start of a step
  order = 2                         # of accuracy
  substeps = 1                      # steps in a time step
  halvings = 8                      # how often a time step that cannot be solved is halved
  fast = false                      # stop the solver at eleven digits

  [initial]                         # the scene's initial configuration if not given
  q = [0.0]                         # with p and v; or an operating point: at = \"hanging\"

  [cost]                            # 1/2 dx' q dx + dx' s du + 1/2 du' r du
  q = [1000.0, 1.0]                 # a diagonal, or a matrix as a list of rows
  r = [50.0]
  q_final = [1000.0, 1.0]           # q if not given
  projected_momentum = false        # weigh it in place of the state's own
  x = [[0.0, 0.0]]                  # desired states, one row per step; the last one holds on
  u = [[0.0]]                       # desired inputs, the same way; zero if not given
  changes = [{ step = 50, x = { theta = 3.141592653589793 } }]   # other desired states from there on

  [guess]
  u = [[0.0]]                       # inputs, the last row holds on; if not given no forces, and
                                    # prescribed coordinates stay
  [bounds]
  state = { theta = [-4.0, 4.0] }   # inf and -inf for no bound
  input = { tau = [-5.0, 5.0] }
  final_state = { theta = [3.14, 3.15] }
  model_limits = true               # also the limits of the model, where none are given here

  [free_initial]
  entries = [\"theta\"]
  weight = [1.0, 1.0]

  [options]                         # names and defaults of OptimizationOptions in the contract
  first_method = \"quasi-newton\"
  first_iterations = 4
  max_iterations = 50
  projection = { q = [1.0, 1.0], r = [1.0] }";

/// A problem as a person writes it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Problem {
    model: String,
    steps: usize,
    #[serde(default, alias = "dt")]
    time_step_s: f64,
    #[serde(default)]
    paper: bool,
    #[serde(default)]
    order: u32,
    #[serde(default)]
    substeps: u32,
    halvings: Option<u32>,
    #[serde(default)]
    fast: bool,
    #[serde(default)]
    initial: Initial,
    cost: Cost,
    #[serde(default)]
    guess: Guess,
    #[serde(default)]
    bounds: Bounds,
    free_initial: Option<FreeInitial>,
    #[serde(default)]
    pub(crate) options: Options,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Initial {
    at: Option<String>,
    q: Option<Vector>,
    p: Option<Vector>,
    v: Option<Vector>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Cost {
    q: Weight,
    r: Weight,
    q_final: Option<Weight>,
    s: Option<Vec<Vec<f64>>>,
    #[serde(default)]
    projected_momentum: bool,
    x: Vec<Vector>,
    #[serde(default)]
    u: Vec<Vector>,
    #[serde(default)]
    changes: Vec<Change>,
}

/// Another desired state from a step on.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Change {
    step: usize,
    x: Vector,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Guess {
    u: Vec<Vector>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Bounds {
    state: BTreeMap<String, [f64; 2]>,
    input: BTreeMap<String, [f64; 2]>,
    final_state: BTreeMap<String, [f64; 2]>,
    model_limits: bool,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct FreeInitial {
    entries: Vec<String>,
    weight: Option<Weight>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Options {
    pub(crate) method: Option<Method>,
    first_method: Option<Method>,
    first_iterations: u32,
    pub(crate) max_iterations: u32,
    tolerance: f64,
    alpha: f64,
    beta: f64,
    max_backtracks: u32,
    near_last_step: bool,
    projection: Option<Projection>,
    bound_tolerance: f64,
    checkpoint_every: u32,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Projection {
    q: Weight,
    r: Weight,
}

/// A diagonal, or rows.
#[derive(Debug, Deserialize)]
#[serde(
    untagged,
    expecting = "a list of numbers, a table of them by name, or a list of rows is needed"
)]
enum Weight {
    Diagonal(Vector),
    Full(Vec<Vec<f64>>),
}

impl Weight {
    /// The weight of entries with these names.
    fn message<N: AsRef<str>>(&self, what: &str, names: &[N]) -> Result<v1::Weight> {
        match self {
            Self::Diagonal(values) => values.diagonal(what, names, 1.0),
            Self::Full(rows) => Ok(full(matrix(what, rows)?)),
        }
    }
}

fn matrix(name: &str, rows: &[Vec<f64>]) -> Result<v1::Matrix> {
    let cols = rows.first().map_or(0, Vec::len);
    ensure!(rows.iter().all(|row| row.len() == cols), "{name}: rows differ in length");
    Ok(v1::Matrix::from_rows(rows))
}

/// Rows for `steps` steps, of which the last given one holds on.
fn held(what: &str, rows: &[Vector], names: &[String], steps: usize) -> Result<Vec<Vec<f64>>> {
    ensure!(!rows.is_empty(), "{what}: a row is needed");
    ensure!(rows.len() <= steps, "{what}: {} rows for {steps}", rows.len());
    let rows = rows.iter().map(|row| row.over(what, names, &[]));
    let mut rows = rows.collect::<Result<Vec<_>>>()?;
    rows.resize(steps, rows[rows.len() - 1].clone());
    Ok(rows)
}

/// Names of what a problem speaks of.
pub(crate) struct Names {
    state: Vec<String>,
    input: Vec<String>,
}

impl Names {
    /// Those of a model.
    fn of(model: &v1::Model) -> Self {
        Self { state: names::state(model), input: names::input(model) }
    }
}

fn bounds(given: &BTreeMap<String, [f64; 2]>) -> Vec<v1::Bound> {
    let bound = |(entry, [min, max]): (&String, &[f64; 2])| v1::Bound {
        entry: entry.clone(),
        min: (*min != f64::NEG_INFINITY).then_some(*min),
        max: (*max != f64::INFINITY).then_some(*max),
    };
    given.iter().map(bound).collect()
}

impl Problem {
    /// Reads a problem, TOML or JSON.
    pub(crate) fn parse(text: &str) -> Result<Self> {
        if text.trim_start().starts_with('{') {
            let read = serde_json::from_str(text);
            return read.map_err(|error| anyhow!(in_plain_words(&error.to_string())));
        }
        from_toml(text)
    }

    fn cost(&self, names: &Names) -> Result<v1::TrajectoryCost> {
        let Names { state, input } = names;
        let cost = &self.cost;
        let mut x = held("cost.x", &cost.x, state, self.steps + 1)?;
        for Change { step, x: desired } in &cost.changes {
            ensure!(*step <= self.steps, "cost.changes: there is no step {step}");
            x[*step..].fill(desired.over("cost.changes.x", state, &[])?);
        }
        let (q, r) = (cost.q.message("cost.q", state)?, cost.r.message("cost.r", input)?);
        let mut weights = plantd_client::weights(q, r);
        if let Some(q_final) = &cost.q_final {
            weights = weights.with_final(q_final.message("cost.q_final", state)?);
        }
        if let Some(s) = &cost.s {
            weights = weights.with_cross(matrix("cost.s", s)?);
        }
        if cost.projected_momentum {
            weights = weights.on_projected_momentum();
        }
        let u = match cost.u.as_slice() {
            [] => None,
            rows => Some(matrix("cost.u", &held("cost.u", rows, input, self.steps)?)?),
        };
        Ok(v1::TrajectoryCost {
            x: Some(matrix("cost.x", &x)?),
            u,
            weights: Some(weights),
            stages: Vec::new(),
        })
    }

    fn options(&self, names: &Names) -> Result<v1::OptimizationOptions> {
        let given = &self.options;
        let method = |method: Option<Method>| {
            method.map_or(v1::DescentMethod::Unspecified, v1::DescentMethod::from).into()
        };
        let projection = match &given.projection {
            None => None,
            Some(Projection { q, r }) => Some(plantd_client::weights(
                q.message("options.projection.q", &names.state)?,
                r.message("options.projection.r", &names.input)?,
            )),
        };
        Ok(v1::OptimizationOptions {
            method: method(given.method),
            first_method: method(given.first_method),
            first_iterations: given.first_iterations,
            max_iterations: given.max_iterations,
            tolerance: given.tolerance,
            alpha: given.alpha,
            beta: given.beta,
            max_backtracks: given.max_backtracks,
            near_last_step: given.near_last_step,
            projection,
            bound_tolerance: given.bound_tolerance,
            checkpoint_every: given.checkpoint_every,
        })
    }

    fn settings(&self) -> v1::PlantSettings {
        let settings = Settings {
            dt: Some(self.time_step_s),
            paper: self.paper,
            order: Some(self.order),
            substeps: Some(self.substeps),
            halvings: self.halvings,
            fast: self.fast,
            ..Settings::default()
        };
        settings.into()
    }

    /// The model that it is about.
    pub(crate) async fn model(&self, client: &Client) -> Result<v1::Model> {
        Ok(client.get_model(&self.model).await?)
    }

    /// Where the search begins: the file's inputs, from its initial state.
    pub(crate) async fn first_guess(
        &self,
        client: &Client,
        model: &v1::Model,
    ) -> Result<v1::Trajectory> {
        let point = match &self.initial {
            Initial { at: Some(point), .. } => point.clone(),
            Initial { .. } => "initial".to_owned(),
        };
        let request = v1::LinearizeRequest {
            model: self.model.clone(),
            settings: Some(self.settings()),
            point: Some(plantd_client::operating_point(point)),
        };
        let mut state = client.linearize(request).await?.state.context("no state in the answer")?;
        if let Initial { at: None, q: Some(q), p, v } = &self.initial {
            let coordinates = names::coordinates(model);
            let (dynamic, prescribed) = coordinates.split_at(state.p.len());
            let filled = |given: &Option<Vector>, what, names: &[_]| match given {
                None => Ok(vec![0.0; names.len()]),
                Some(given) => given.over(what, names, &[]),
            };
            state.p = filled(p, "initial.p", dynamic)?;
            state.v = filled(v, "initial.v", prescribed)?;
            state.q = q.over("initial.q", &coordinates, &state.q)?;
        }
        let inputs = Names::of(model).input;
        let u = match self.guess.u.as_slice() {
            [] => {
                let mut held = vec![0.0; model.inputs.len()];
                held.extend_from_slice(state.q.get(state.p.len()..).unwrap_or_default());
                vec![held; self.steps]
            }
            rows => held("guess.u", rows, &inputs, self.steps)?,
        };
        Ok(v1::Trajectory { initial: Some(state), u: Some(matrix("guess.u", &u)?) })
    }

    /// The search that the problem asks for, begun with `guess` or gone on with from `resume`.
    pub(crate) fn request(
        &self,
        model: &v1::Model,
        guess: Option<v1::Trajectory>,
        resume: Option<v1::OptimizationCheckpoint>,
    ) -> Result<v1::OptimizeTrajectoryRequest> {
        let names = Names::of(model);
        let free_initial = match &self.free_initial {
            None => None,
            Some(FreeInitial { entries, weight }) => Some(v1::FreeInitialState {
                entries: entries.clone(),
                weight: match weight {
                    Some(weight) => Some(weight.message("free_initial.weight", entries)?),
                    None => None,
                },
            }),
        };
        Ok(v1::OptimizeTrajectoryRequest {
            model: self.model.clone(),
            settings: Some(self.settings()),
            cost: Some(self.cost(&names)?),
            guess,
            resume,
            bounds: Some(v1::TrajectoryBounds {
                state: bounds(&self.bounds.state),
                input: bounds(&self.bounds.input),
                final_state: bounds(&self.bounds.final_state),
                model_limits: self.bounds.model_limits,
            }),
            free_initial,
            options: Some(self.options(&names)?),
        })
    }
}

/// How a direction of descent is found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Deserialize)]
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

#[cfg(test)]
mod tests {
    use super::*;

    fn names() -> Names {
        Names {
            state: ["theta", "p(theta)"].map(str::to_owned).to_vec(),
            input: vec!["tau".to_owned()],
        }
    }

    #[test]
    fn the_problem_in_the_help_is_one() {
        let (_, text) = HELP.split_once(":\n\n").unwrap();
        let problem = Problem::parse(text).unwrap();
        let cost = problem.cost(&names()).unwrap();
        let x = cost.x.unwrap();
        assert_eq!((x.rows, x.cols, cost.u.unwrap().rows), (101, 2, 100));
        assert_eq!((x.at(49, 0), x.at(50, 0), x.at(100, 0)), (0.0, x.at(50, 0), x.at(50, 0)));
        assert_eq!(x.at(50, 0), std::f64::consts::PI);
        let options = problem.options(&names()).unwrap();
        assert_eq!(options.first_method(), v1::DescentMethod::QuasiNewton);
        assert_eq!(options.first_iterations, 4);
        assert_eq!(bounds(&problem.bounds.input)[0].max, Some(5.0));
        let settings = problem.settings();
        assert_eq!((settings.order, settings.substeps, settings.halvings), (2, 1, Some(8)));
    }

    #[test]
    fn a_problem_names_its_errors() {
        let least = "model = \"m\"\nsteps = 2\n[cost]\nq = [1]\nr = [[1.0]]\n";
        let cost = |rest: &str| Problem::parse(&format!("{least}{rest}")).unwrap().cost(&names());
        assert!(cost("x = [[0.0]]").is_ok());
        let named = cost("x = [{ theta = 1.0 }, { \"p(theta)\" = 2.0 }]").unwrap().x.unwrap();
        assert_eq!(named.data, [1.0, 0.0, 0.0, 2.0, 0.0, 2.0]);
        for (rest, part) in [
            ("x = []", "cost.x: a row is needed"),
            ("x = [[0.0], [1.0], [2.0], [3.0]]", "cost.x: 4 rows for 3"),
            ("x = [[0.0], [1.0, 2.0]]", "cost.x: rows differ"),
            ("x = [{ tetha = 1.0 }]", "cost.x: there is no `tetha`; did you mean `theta`?"),
            ("x = [[0.0]]\nchanges = [{ step = 3, x = [1.0] }]", "no step 3"),
        ] {
            let error = cost(rest).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
        let unknown = Problem::parse(&format!("{least}x = [[0.0]]\nweight = 1")).unwrap_err();
        assert!(unknown.to_string().contains("weight"), "{unknown}");
        let one_sided = BTreeMap::from([("a".to_owned(), [f64::NEG_INFINITY, 2.0])]);
        assert_eq!(bounds(&one_sided)[0].min, None);
    }
}
