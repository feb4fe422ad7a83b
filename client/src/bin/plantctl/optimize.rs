//! Trajectory optimisation from a problem file, and references from tables.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use plantd_client::{Client, MatrixExt as _, Refusal, WeightsExt as _, diagonal, full, v1};
use serde::Deserialize;

use crate::args::{Method, Weights};
use crate::commands::{Output, read_text};
use crate::{json, text};

/// Files that `optimize` reads and writes.
pub(crate) struct Files {
    pub(crate) problem: PathBuf,
    pub(crate) save: Option<PathBuf>,
    pub(crate) resume: Option<PathBuf>,
    pub(crate) guess: Option<PathBuf>,
}

/// A problem as a person writes it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Problem {
    model: String,
    steps: usize,
    #[serde(default)]
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
    options: Options,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Initial {
    at: Option<String>,
    q: Option<Vec<f64>>,
    p: Vec<f64>,
    v: Vec<f64>,
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
    x: Vec<Vec<f64>>,
    #[serde(default)]
    u: Vec<Vec<f64>>,
    #[serde(default)]
    changes: Vec<Change>,
}

/// Another desired state from a step on.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Change {
    step: usize,
    x: Vec<f64>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Guess {
    u: Vec<Vec<f64>>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Bounds {
    state: BTreeMap<String, [f64; 2]>,
    input: BTreeMap<String, [f64; 2]>,
    final_state: BTreeMap<String, [f64; 2]>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct FreeInitial {
    entries: Vec<String>,
    weight: Option<Weight>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Options {
    method: Option<Method>,
    first_method: Option<Method>,
    first_iterations: u32,
    max_iterations: u32,
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
#[serde(untagged)]
enum Weight {
    Diagonal(Vec<f64>),
    Full(Vec<Vec<f64>>),
}

impl Weight {
    fn message(&self, name: &str) -> Result<v1::Weight> {
        Ok(match self {
            Self::Diagonal(values) => diagonal(values.as_slice()),
            Self::Full(rows) => full(matrix(name, rows)?),
        })
    }
}

fn matrix(name: &str, rows: &[Vec<f64>]) -> Result<v1::Matrix> {
    let cols = rows.first().map_or(0, Vec::len);
    ensure!(rows.iter().all(|row| row.len() == cols), "{name}: rows differ in length");
    Ok(v1::Matrix::from_rows(rows))
}

/// Rows for `steps` steps, of which the last given one holds on.
fn held(name: &str, rows: &[Vec<f64>], steps: usize) -> Result<Vec<Vec<f64>>> {
    let last = rows.last().with_context(|| format!("{name}: a row is needed"))?;
    ensure!(rows.len() <= steps, "{name}: {} rows for {steps}", rows.len());
    let mut rows = rows.to_vec();
    rows.resize(steps, last.clone());
    Ok(rows)
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
    fn parse(text: &str) -> Result<Self> {
        if text.trim_start().starts_with('{') {
            return Ok(serde_json::from_str(text)?);
        }
        Ok(toml::from_str(text)?)
    }

    fn cost(&self) -> Result<v1::TrajectoryCost> {
        let cost = &self.cost;
        let mut x = held("cost.x", &cost.x, self.steps + 1)?;
        for Change { step, x: desired } in &cost.changes {
            ensure!(*step <= self.steps, "cost.changes: there is no step {step}");
            x[*step..].fill(desired.clone());
        }
        let mut weights =
            plantd_client::weights(cost.q.message("cost.q")?, cost.r.message("cost.r")?);
        if let Some(q_final) = &cost.q_final {
            weights = weights.with_final(q_final.message("cost.q_final")?);
        }
        if let Some(s) = &cost.s {
            weights = weights.with_cross(matrix("cost.s", s)?);
        }
        if cost.projected_momentum {
            weights = weights.on_projected_momentum();
        }
        let u = match cost.u.as_slice() {
            [] => None,
            rows => Some(matrix("cost.u", &held("cost.u", rows, self.steps)?)?),
        };
        Ok(v1::TrajectoryCost {
            x: Some(matrix("cost.x", &x)?),
            u,
            weights: Some(weights),
            stages: Vec::new(),
        })
    }

    fn options(&self) -> Result<v1::OptimizationOptions> {
        let given = &self.options;
        let method = |method: Option<Method>| {
            method.map_or(v1::DescentMethod::Unspecified, v1::DescentMethod::from).into()
        };
        let projection = match &given.projection {
            None => None,
            Some(Projection { q, r }) => Some(plantd_client::weights(
                q.message("options.projection.q")?,
                r.message("options.projection.r")?,
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
        let split = if self.paper { v1::ForceSplit::Paper } else { v1::ForceSplit::Unspecified };
        let precision = if self.fast { v1::Precision::Fast } else { v1::Precision::Unspecified };
        v1::PlantSettings {
            time_step_s: self.time_step_s,
            force_split: split.into(),
            order: self.order,
            substeps: self.substeps,
            halvings: self.halvings,
            precision: precision.into(),
            ..Default::default()
        }
    }

    /// Where the search begins: the file's inputs, from its initial state.
    async fn first_guess(&self, client: &Client) -> Result<v1::Trajectory> {
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
        let mut held_u = Vec::new();
        if let Initial { at: None, q: Some(q), p, v } = &self.initial {
            let filled = |given: &[f64], rest: &[f64]| match given {
                [] => vec![0.0; rest.len()],
                given => given.to_vec(),
            };
            state.p = filled(p, &state.p);
            state.v = filled(v, &state.v);
            state.q = q.clone();
        }
        if self.guess.u.is_empty() {
            let model = client.get_model(&self.model).await?;
            held_u.resize(model.inputs.len(), 0.0);
            held_u.extend_from_slice(state.q.get(state.p.len()..).unwrap_or_default());
        }
        let rows = if self.guess.u.is_empty() { vec![held_u] } else { self.guess.u.clone() };
        let u = held("guess.u", &rows, self.steps)?;
        Ok(v1::Trajectory { initial: Some(state), u: Some(matrix("guess.u", &u)?) })
    }
}

/// Runs a search and prints its iterations.
pub(crate) async fn optimize(
    client: &Client,
    output: Output,
    files: Files,
    method: Option<Method>,
    iterations: Option<u32>,
) -> Result<()> {
    let text = read_text(&files.problem)?;
    let mut problem = Problem::parse(&text).with_context(|| files.problem.display().to_string())?;
    problem.options.method = method.or(problem.options.method);
    problem.options.max_iterations = iterations.unwrap_or(problem.options.max_iterations);
    let resume = match &files.resume {
        Some(file) => Some(read_result(file)?.checkpoint.context("no checkpoint in the file")?),
        None => None,
    };
    let guess = match &files.guess {
        Some(file) => read_result(file)?.checkpoint.and_then(|c| c.trajectory),
        None if resume.is_some() => None,
        None => Some(problem.first_guess(client).await?),
    };
    let free_initial = match &problem.free_initial {
        None => None,
        Some(FreeInitial { entries, weight }) => Some(v1::FreeInitialState {
            entries: entries.clone(),
            weight: match weight {
                Some(weight) => Some(weight.message("free_initial.weight")?),
                None => None,
            },
        }),
    };
    let request = v1::OptimizeTrajectoryRequest {
        model: problem.model.clone(),
        settings: Some(problem.settings()),
        cost: Some(problem.cost()?),
        guess,
        resume,
        bounds: Some(v1::TrajectoryBounds {
            state: bounds(&problem.bounds.state),
            input: bounds(&problem.bounds.input),
            final_state: bounds(&problem.bounds.final_state),
        }),
        free_initial,
        options: Some(problem.options()?),
    };
    let result = search(client, output, request).await?;
    if let Some(file) = &files.save {
        let text = format!("{}\n", json::message("OptimizationResult", &result));
        std::fs::write(file, text).with_context(|| format!("cannot write {}", file.display()))?;
    }
    match result.converged {
        true => Ok(()),
        false => Err(SearchStopped::new(result, files.save.as_deref()).into()),
    }
}

/// A search that ended before it converged.
#[derive(Debug, thiserror::Error)]
#[error("the search stopped before it converged: {refusal}\n{help}")]
pub(crate) struct SearchStopped {
    pub(crate) refusal: Refusal,
    help: String,
}

impl SearchStopped {
    fn new(result: v1::OptimizationResult, saved: Option<&Path>) -> Self {
        let failure = result.failure.unwrap_or_default();
        let mut help = match failure.reason.as_str() {
            "MAX_ITERATIONS" => "more iterations (`--iterations`) may help".to_owned(),
            _ => "another guess (`--guess`), method (`--method`) or tolerance may help".to_owned(),
        };
        let _ = match saved {
            Some(file) => {
                let file = file.display();
                write!(help, "; what was found is in {file}: `--resume {file}` goes on with it")
            }
            None => write!(
                help,
                "; `--save FILE` keeps what was found, `--resume FILE` goes on with it"
            ),
        };
        Self { refusal: failure.into(), help }
    }
}

async fn search(
    client: &Client,
    output: Output,
    request: v1::OptimizeTrajectoryRequest,
) -> Result<v1::OptimizationResult> {
    use v1::optimize_trajectory_response::Response;
    let mut messages = client.optimize_trajectory(request).await?;
    let mut is_first = true;
    while let Some(message) = messages.next().await? {
        let as_json = || json::message("OptimizeTrajectoryResponse", &message);
        match &message.response {
            Some(Response::Progress(progress)) => output.print(as_json, || {
                let head = if is_first { text::ITERATIONS } else { "" };
                head.to_owned() + &text::iteration(progress)
            })?,
            Some(Response::Result(result)) => {
                output.print(as_json, || text::optimum(result))?;
                return Ok(result.clone());
            }
            None => {}
        }
        is_first = false;
    }
    Err(plantd_client::Error::StreamClosed.into())
}

/// A result from its file; a checkpoint counts as a result that holds it.
pub(crate) fn read_result(file: &Path) -> Result<v1::OptimizationResult> {
    let text = read_text(file)?;
    let result = json::read("OptimizationResult", &text);
    let checkpoint = || json::read("OptimizationCheckpoint", &text);
    let read = result.or_else(|error| match checkpoint() {
        Ok(checkpoint) => {
            Ok(v1::OptimizationResult { checkpoint: Some(checkpoint), ..Default::default() })
        }
        Err(_) => Err(error),
    });
    read.with_context(|| format!("{} holds no result of a search", file.display()))
}

/// Projects the configurations of a table and prints the motion as one.
pub(crate) async fn project_reference(
    client: &Client,
    output: Output,
    mut request: v1::ProjectReferenceRequest,
    (reference, inputs): (&Path, Option<&Path>),
    weights: &Weights,
) -> Result<()> {
    use v1::project_reference_response::Response;
    request.q = Some(read_table(reference)?);
    request.u = inputs.map(read_table).transpose()?;
    let model = client.get_model(&request.model).await?;
    request.projection = Some(weights.for_model(&model));
    let mut messages = client.project_reference(request).await?;
    let (x, u) = (text::state_names(&model), text::input_names(&model));
    while let Some(message) = messages.next().await? {
        let as_json = || json::message("ProjectReferenceResponse", &message);
        match &message.response {
            Some(Response::Report(report)) => {
                if !output.json {
                    eprint!("{}", text::reference(report));
                }
                let u = u.iter().map(|name| format!("u({name})"));
                let head: Vec<_> = x.iter().cloned().chain(u).collect();
                output.print(as_json, || format!("{}\n", head.join(",")))?;
            }
            Some(Response::Step(step)) => output.print(as_json, || {
                // The last state has no input.
                let u = step.u_reference.iter().map(f64::to_string);
                let u = u.chain(std::iter::repeat(String::new())).take(u_len(&model));
                let row: Vec<_> = step.x_reference.iter().map(f64::to_string).chain(u).collect();
                let mut line = row.join(",");
                let _ = writeln!(line);
                line
            })?,
            None => {}
        }
    }
    Ok(())
}

fn u_len(model: &v1::Model) -> usize {
    text::input_names(model).len()
}

/// Comma-separated numbers, a row per line; a first line that is none is a head.
fn read_table(file: &Path) -> Result<v1::Matrix> {
    table(&read_text(file)?).with_context(|| file.display().to_string())
}

pub(crate) fn table(text: &str) -> Result<v1::Matrix> {
    let mut rows: Vec<Vec<f64>> = Vec::new();
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    for (index, (number, line)) in lines.enumerate() {
        let cells = line.split(',').map(str::trim);
        let row: Result<Vec<f64>, _> = cells.map(str::parse).collect();
        match row {
            Ok(row) => {
                let cols = rows.first().map_or(row.len(), Vec::len);
                ensure!(row.len() == cols, "line {}: {} cells, not {cols}", number + 1, row.len());
                rows.push(row);
            }
            Err(_) if index == 0 => {}
            Err(_) => anyhow::bail!("line {}: not numbers", number + 1),
        }
    }
    Ok(v1::Matrix::from_rows(&rows))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_problem_in_the_help_is_one() {
        let help = crate::args::PROBLEM;
        let (_, text) = help.split_once(":\n\n").unwrap();
        let problem = Problem::parse(text).unwrap();
        let cost = problem.cost().unwrap();
        let x = cost.x.unwrap();
        assert_eq!((x.rows, x.cols, cost.u.unwrap().rows), (101, 2, 100));
        assert_eq!((x.at(49, 0), x.at(50, 0), x.at(100, 0)), (0.0, x.at(50, 0), x.at(50, 0)));
        assert_eq!(x.at(50, 0), std::f64::consts::PI);
        let options = problem.options().unwrap();
        assert_eq!(options.first_method(), v1::DescentMethod::QuasiNewton);
        assert_eq!(options.first_iterations, 4);
        assert_eq!(bounds(&problem.bounds.input)[0].max, Some(5.0));
        let settings = problem.settings();
        assert_eq!((settings.order, settings.substeps, settings.halvings), (2, 1, Some(8)));
    }

    #[test]
    fn a_problem_names_its_faults() {
        let least = "model = \"m\"\nsteps = 2\n[cost]\nq = [1]\nr = [[1.0]]\n";
        let cost = |rest: &str| Problem::parse(&format!("{least}{rest}")).unwrap().cost();
        assert!(cost("x = [[0.0]]").is_ok());
        for (rest, part) in [
            ("x = []", "cost.x: a row is needed"),
            ("x = [[0.0], [1.0], [2.0], [3.0]]", "cost.x: 4 rows for 3"),
            ("x = [[0.0], [1.0, 2.0]]", "cost.x: rows differ"),
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

    #[test]
    fn a_table_may_have_a_head() {
        let with_head = table("theta, phi\n1,2\n\n3,-4e0\n").unwrap();
        assert_eq!((with_head.rows, with_head.data), (2, vec![1.0, 2.0, 3.0, -4.0]));
        assert!(table("1,2\n3\n").unwrap_err().to_string().contains("line 2"));
        assert!(table("1,2\na,b\n").unwrap_err().to_string().contains("line 2"));
    }
}
