//! A scenario made ready: what all its cases share.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};
use plantd_client::{Client, MatrixExt as _, StateExt as _, WeightsExt as _, operating_point, v1};

use crate::contract::{json, names};
use crate::input::files::{parse_table, read_result};
use crate::input::settings::Settings;
use crate::input::weights::diagonals;
use crate::scenario::columns::Columns;
use crate::scenario::file::{Case, Controller, Event, Inputs, Lqr, Plant, Reference, Scenario};
use crate::trial::server::TestServer;
use plantd_expect::Expression;

/// Part of a time step by which a time may miss a step and still mean it.
const STEP_ROUNDING: f64 = 1e-6;

/// A scenario with all that its cases share.
pub(crate) struct PreparedScenario {
    pub(crate) file: PathBuf,
    pub(crate) name: String,
    pub(crate) scenario: Scenario,
    pub(crate) model: v1::Model,
    pub(crate) columns: Columns,
    pub(crate) reference: Option<ReferenceMotion>,
    pub(crate) channels: Option<v1::Channels>,
    pub(crate) faults: Vec<Vec<v1::FaultSpec>>,
    /// Rows of inputs, as far as they are given; the last one holds on.
    pub(crate) inputs: Vec<Vec<Option<f64>>>,
    pub(crate) policy: Option<v1::InputPolicy>,
    pub(crate) uses_energy: bool,
    pub(crate) steps: u64,
}

/// A reference: one state and input, or those of every step.
pub(crate) struct ReferenceMotion {
    x: Vec<Vec<f64>>,
    u: Vec<Vec<f64>>,
    trajectory: Option<v1::Trajectory>,
}

impl ReferenceMotion {
    /// State at a step, and the input of the step that leads there.
    pub(crate) fn at(&self, step: u64) -> (&[f64], &[f64]) {
        let row = |rows: &'_ [Vec<f64>], k: u64| {
            let k = usize::try_from(k).unwrap_or(usize::MAX);
            rows.len().checked_sub(1).map(|last| k.min(last))
        };
        let x = row(&self.x, step).map_or(&[][..], |k| &self.x[k]);
        let u = row(&self.u, step.saturating_sub(1)).map_or(&[][..], |k| &self.u[k]);
        (x, u)
    }
}

impl PreparedScenario {
    /// Makes the model known to the server and reads what the scenario refers to.
    pub(crate) async fn new(
        server: &TestServer,
        file: PathBuf,
        scenario: Scenario,
    ) -> Result<Self> {
        let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let name = scenario.name.clone().unwrap_or(stem);
        let folder = file.parent().unwrap_or(Path::new(""));
        let model = model(&server.client, &scenario.plant, folder).await?;
        let time_step_s = scenario.plant.time_step_s.unwrap_or(model.time_step_s);
        let steps = scenario.steps(time_step_s)?;
        let reference = match &scenario.reference {
            None => None,
            Some(reference) => Some(motion(server, &scenario, &model, reference, folder).await?),
        };
        let all = || scenario.expect.iter().flat_map(|e| e.expressions()).chain(&scenario.plot);
        let uses_energy = all().any(Expression::uses_energy);
        let channels = match scenario.channels.is_empty() {
            true => None,
            false => Some(message("Channels", &scenario.channels).context("channels")?),
        };
        let outputs = channels.as_ref().map(output_names).unwrap_or_default();
        let columns = Columns::new(&model, &outputs, reference.is_some(), uses_energy);
        let nothing = columns.empty();
        for (i, expectation) in scenario.expect.iter().enumerate() {
            for expression in expectation.expressions() {
                let known = expression.values(&nothing).map_err(anyhow::Error::msg);
                known.with_context(|| format!("expect[{i}].{}", expectation.key()))?;
            }
        }
        for (i, expression) in scenario.plot.iter().enumerate() {
            let known = expression.values(&nothing).map_err(anyhow::Error::msg);
            known.with_context(|| format!("plot[{i}]"))?;
        }
        let faults = scenario.events.iter().enumerate().map(|(i, event)| {
            fault_specs(event, &model, time_step_s).with_context(|| format!("events[{i}]"))
        });
        let mut faults: Vec<_> = faults.collect::<Result<_>>()?;
        let mut inputs = Vec::new();
        match &scenario.controller {
            Controller::Inputs(given) if scenario.is_stepped() => {
                inputs = input_rows(given, &model, folder)?;
            }
            Controller::Inputs(Inputs { constant, .. }) => {
                // Nobody drives a plant that runs by itself: the forces act from the beginning.
                let event = Event { inputs: constant.clone(), ..Event::default() };
                let forces = fault_specs(&event, &model, time_step_s);
                faults.push(forces.context("controller.inputs.constant")?);
            }
            _ => {}
        }
        let policy = match scenario.input_policy.is_empty() {
            true => None,
            false => Some(message("InputPolicy", &scenario.input_policy).context("input_policy")?),
        };
        Ok(Self {
            file,
            name,
            scenario,
            model,
            columns,
            reference,
            channels,
            faults,
            inputs,
            policy,
            uses_energy,
            steps,
        })
    }

    pub(crate) fn folder(&self) -> &Path {
        // The current folder has no name.
        self.file.parent().filter(|path| *path != Path::new("")).unwrap_or(Path::new("."))
    }
}

/// The model: one of the server's, or made from the scene.
async fn model(client: &Client, plant: &Plant, folder: &Path) -> Result<v1::Model> {
    let Some(scene) = &plant.scene else {
        let name = plant.model.clone().unwrap_or_default();
        return client.get_model(name).await.context("plant.model");
    };
    let path = folder.join(scene);
    let text = std::fs::read_to_string(&path)
        .with_context(|| format!("plant.scene: cannot read {}", path.display()))?;
    // The same scene has the same name, whoever uploads it and how often.
    let digest = text.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    });
    let name = format!("test-{digest:016x}");
    let request = v1::CreateModelRequest { name: name.clone(), scene: text, ..Default::default() };
    match client.create_model_as(request).await {
        Err(error) if error.code() == Some(plantd_client::Code::AlreadyExists) => {
            client.get_model(name).await.context("plant.scene")
        }
        answer => answer.with_context(|| format!("plant.scene: {}", path.display())),
    }
}

/// How the plant is stepped.
pub(crate) fn settings(plant: &Plant) -> v1::PlantSettings {
    let settings = Settings {
        dt: plant.time_step_s,
        paper: plant.paper,
        order: plant.order,
        substeps: plant.substeps,
        halvings: plant.halvings,
        fast: plant.fast,
        ..Settings::default()
    };
    settings.into()
}

/// Step with which an event begins.
pub(crate) fn first_step(event: &Event, time_step_s: f64) -> u64 {
    (event.at_s / time_step_s - STEP_ROUNDING).ceil().max(0.0) as u64
}

/// A message of the contract from its fields as the file has them.
fn message<M: prost::Message + Default>(name: &str, fields: &toml::Table) -> Result<M> {
    json::read_value(name, serde_json::to_value(fields)?)
}

/// Names of the numbers that output channels deliver.
fn output_names(channels: &v1::Channels) -> Vec<String> {
    use v1::output_channel::Source;
    let names = |output: &v1::OutputChannel| {
        let suffixes: &[&str] = match output.source {
            Some(Source::Position(_)) => &[".x", ".y", ".z"],
            Some(Source::Orientation(_)) => &[".rx", ".ry", ".rz"],
            _ => &[""],
        };
        suffixes.iter().map(|suffix| format!("{}{suffix}", output.name)).collect::<Vec<_>>()
    };
    channels.outputs.iter().flat_map(names).collect()
}

/// What an event lets go wrong.
fn fault_specs(event: &Event, model: &v1::Model, time_step_s: f64) -> Result<Vec<v1::FaultSpec>> {
    use v1::fault_spec::{Kind, Start, Target};
    let mut faults = Vec::new();
    for (name, value) in &event.inputs {
        ensure!(model.inputs.contains(name), "inputs: {}", no_input(name, model));
        faults.push(v1::FaultSpec {
            target: Some(Target::Input(name.clone())),
            kind: Some(Kind::Offset(v1::Offset { value: *value })),
            ..Default::default()
        });
    }
    if !event.fault.is_empty() {
        faults.push(message("FaultSpec", &event.fault).context("fault")?);
    }
    for fault in &mut faults {
        fault.start = Some(Start::StartStep(first_step(event, time_step_s)));
        fault.duration_s = event.for_s.unwrap_or(0.0);
    }
    Ok(faults)
}

/// The reference, state by state.
async fn motion(
    server: &TestServer,
    scenario: &Scenario,
    model: &v1::Model,
    reference: &Reference,
    folder: &Path,
) -> Result<ReferenceMotion> {
    match reference {
        Reference::At(point) => {
            let request = v1::LinearizeRequest {
                model: model.name.clone(),
                settings: Some(settings(&scenario.plant)),
                point: Some(operating_point(point)),
            };
            let answer = server.client.linearize(request).await.context("reference.at")?;
            let x = answer.state.context("a linearization without a state")?.x();
            Ok(ReferenceMotion { x: vec![x], u: vec![answer.u], trajectory: None })
        }
        Reference::Trajectory(file) => {
            let result = read_result(&folder.join(file)).context("reference.trajectory")?;
            let trajectory = result.checkpoint.and_then(|checkpoint| checkpoint.trajectory);
            let trajectory =
                trajectory.context("reference.trajectory: no trajectory in the file")?;
            let x = result.x.context("reference.trajectory: no states in the file")?;
            let rows =
                |matrix: &v1::Matrix| matrix.rows_iter().map(<[f64]>::to_vec).collect::<Vec<_>>();
            let u = trajectory.u.as_ref().map(rows).unwrap_or_default();
            let entries = 2 * model.coordinates.len();
            ensure!(
                x.cols as usize == entries,
                "reference.trajectory: states of {} entries; the model has {entries}",
                x.cols
            );
            Ok(ReferenceMotion { x: rows(&x), u, trajectory: Some(trajectory) })
        }
    }
}

/// The regulator about the reference.
pub(crate) async fn feedback(
    client: &Client,
    scenario: &Scenario,
    model: &v1::Model,
    reference: &ReferenceMotion,
    lqr: &Lqr,
    id: &str,
) -> Result<v1::SetFeedbackRequest> {
    use v1::set_feedback_request::Reference as Form;
    let mut weights = diagonals(&lqr.q, &lqr.r, model)?;
    if lqr.projected_momentum {
        weights = weights.on_projected_momentum();
    }
    let form = match (&reference.trajectory, &scenario.reference) {
        (Some(trajectory), _) => Form::Trajectory(trajectory.clone()),
        (None, Some(Reference::At(point))) if lqr.adapts => Form::Point(operating_point(point)),
        (None, Some(Reference::At(point))) => {
            let request = v1::SolveLqrRequest {
                model: model.name.clone(),
                settings: Some(settings(&scenario.plant)),
                point: Some(operating_point(point)),
                weights: Some(weights.clone()),
                ..Default::default()
            };
            let gain = client.solve_lqr(request).await?.gain;
            Form::Gain(gain.context("an LQR without a gain")?)
        }
        _ => bail!("there is no reference"),
    };
    Ok(v1::SetFeedbackRequest {
        id: id.to_owned(),
        reference: Some(form),
        weights: Some(weights),
        mode: v1::FeedbackMode::Replace.into(),
        ..Default::default()
    })
}

/// The initial state with the case's entries.
pub(crate) fn initial_state(
    state: &v1::State,
    model: &v1::Model,
    case: &Case,
    project: bool,
) -> Result<v1::initial_state::Form> {
    use v1::initial_state::{Form, Momentum, Projection, Velocity};
    let all: Vec<_> = model.coordinates.iter().map(|c| c.name.as_str()).collect();
    let dynamic = &all[..state.p.len()];
    let set = |key: &str, values: &mut [f64], names: &[&str], given: &BTreeMap<String, f64>| {
        for (name, value) in given {
            let Some(i) = names.iter().position(|n| n == name) else {
                bail!("{key}: there is no coordinate `{name}`; there are {}", names.join(", "));
            };
            values[i] = *value;
        }
        Ok(())
    };
    let mut q = state.q.clone();
    set("q", &mut q, &all, &case.q)?;
    if project {
        return Ok(Form::Projection(Projection { q, hold: case.q.keys().cloned().collect() }));
    }
    if !case.p.is_empty() {
        let mut p = state.p.clone();
        set("p", &mut p, dynamic, &case.p)?;
        return Ok(Form::Momentum(Momentum { q, p, v: state.v.clone() }));
    }
    let mut v = vec![0.0; all.len()];
    set("v", &mut v, &all, &case.v)?;
    Ok(Form::Velocity(Velocity { q, v }))
}

/// Inputs step by step, as far as they are given.
fn input_rows(inputs: &Inputs, model: &v1::Model, folder: &Path) -> Result<Vec<Vec<Option<f64>>>> {
    let names = names::input(model);
    let index = |key: &str, name: &str| {
        let index = names.iter().position(|n| *n == name);
        index.with_context(|| format!("controller.inputs.{key}: {}", no_input(name, model)))
    };
    let mut constant = vec![None; names.len()];
    for (name, value) in &inputs.constant {
        constant[index("constant", name)?] = Some(*value);
    }
    let Some(table) = &inputs.table else { return Ok(vec![constant]) };
    let path = folder.join(table);
    let key = || format!("controller.inputs.table: {}", path.display());
    let text = std::fs::read_to_string(&path).with_context(key)?;
    let head = text.lines().next().unwrap_or_default();
    let columns: Vec<_> =
        head.split(',').map(|name| index("table", name.trim())).collect::<Result<_>>()?;
    let matrix = parse_table(&text).with_context(key)?;
    ensure!(matrix.rows > 0, "{}: a row is needed", key());
    ensure!(matrix.cols as usize == columns.len(), "{}: the head has other columns", key());
    let row = |values: &[f64]| {
        let mut u = constant.clone();
        columns.iter().zip(values).for_each(|(&i, value)| u[i] = Some(*value));
        u
    };
    Ok(matrix.rows_iter().map(row).collect())
}

fn no_input(name: &str, model: &v1::Model) -> String {
    format!("there is no input `{name}`; there are {}", model.inputs.join(", "))
}
