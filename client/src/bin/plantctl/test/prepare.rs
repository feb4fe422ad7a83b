//! A scenario made ready: what all its cases share.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};
use plantd_client::{
    Client, MatrixExt as _, StateExt as _, WeightsExt as _, diagonal, operating_point, v1,
};

use super::expression::Expression;
use super::run::Place;
use super::samples::Columns;
use super::scenario::{Case, Controller, Event, Inputs, Lqr, Plant, Reference, Scenario};
use crate::contract::json;
use crate::input::files;

/// Part of a time step by which a time may miss a step and still mean it.
const STEP_ROUNDING: f64 = 1e-6;

/// A scenario with all that its cases share.
pub(crate) struct Prepared {
    pub(crate) file: PathBuf,
    pub(crate) name: String,
    pub(crate) scenario: Scenario,
    pub(super) model: v1::Model,
    pub(super) columns: Columns,
    pub(super) reference: Option<Motion>,
    pub(super) channels: Option<v1::Channels>,
    pub(super) faults: Vec<Vec<v1::FaultSpec>>,
    /// Rows of inputs, as far as they are given; the last one holds on.
    pub(super) inputs: Vec<Vec<Option<f64>>>,
    pub(super) policy: Option<v1::InputPolicy>,
    pub(super) uses_energy: bool,
    pub(super) steps: u64,
}

/// A reference: one state and input, or those of every step.
pub(super) struct Motion {
    x: Vec<Vec<f64>>,
    u: Vec<Vec<f64>>,
    trajectory: Option<v1::Trajectory>,
}

impl Motion {
    /// State at a step, and the input of the step that leads there.
    pub(super) fn at(&self, step: u64) -> (&[f64], &[f64]) {
        let row = |rows: &'_ [Vec<f64>], k: u64| {
            let k = usize::try_from(k).unwrap_or(usize::MAX);
            rows.len().checked_sub(1).map(|last| k.min(last))
        };
        let x = row(&self.x, step).map_or(&[][..], |k| &self.x[k]);
        let u = row(&self.u, step.saturating_sub(1)).map_or(&[][..], |k| &self.u[k]);
        (x, u)
    }
}

impl Prepared {
    /// Makes the model known to the server and reads what the scenario refers to.
    pub(crate) async fn new(place: &Place, file: PathBuf, scenario: Scenario) -> Result<Self> {
        let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let name = scenario.name.clone().unwrap_or(stem);
        let folder = file.parent().unwrap_or(Path::new(""));
        let model = model(&place.client, &scenario.plant, folder).await?;
        let time_step_s = scenario.plant.time_step_s.unwrap_or(model.time_step_s);
        let steps = scenario.steps(time_step_s)?;
        let reference = match &scenario.reference {
            None => None,
            Some(reference) => Some(motion(place, &scenario, &model, reference, folder).await?),
        };
        let all = || scenario.expect.iter().flat_map(|e| e.expressions()).chain(&scenario.plot);
        let uses_energy = all().any(Expression::uses_energy);
        let channels = match scenario.channels.is_empty() {
            true => None,
            false => Some(message("Channels", &scenario.channels).context("channels")?),
        };
        let outputs = channels.as_ref().map(outputs).unwrap_or_default();
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
            faults(event, &model, time_step_s).with_context(|| format!("events[{i}]"))
        });
        let mut faults: Vec<_> = faults.collect::<Result<_>>()?;
        let mut inputs = Vec::new();
        match &scenario.controller {
            Controller::Inputs(given) if scenario.is_stepped() => {
                inputs = rows(given, &model, folder)?;
            }
            Controller::Inputs(Inputs { constant, .. }) => {
                // Nobody drives a plant that runs by itself: the forces act from the beginning.
                let event = Event { inputs: constant.clone(), ..Event::default() };
                let forces = self::faults(&event, &model, time_step_s);
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

    pub(super) fn folder(&self) -> &Path {
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

pub(super) fn settings(plant: &Plant) -> v1::PlantSettings {
    let split = if plant.paper { v1::ForceSplit::Paper } else { v1::ForceSplit::Unspecified };
    let precision = if plant.fast { v1::Precision::Fast } else { v1::Precision::Unspecified };
    v1::PlantSettings {
        time_step_s: plant.time_step_s.unwrap_or(0.0),
        force_split: split.into(),
        order: plant.order.unwrap_or(0),
        substeps: plant.substeps.unwrap_or(0),
        halvings: plant.halvings,
        precision: precision.into(),
        ..Default::default()
    }
}

/// Step with which an event begins.
pub(super) fn begins(event: &Event, time_step_s: f64) -> u64 {
    (event.at_s / time_step_s - STEP_ROUNDING).ceil().max(0.0) as u64
}

/// A message of the contract from its fields as the file has them.
fn message<M: prost::Message + Default>(name: &str, fields: &toml::Table) -> Result<M> {
    json::read(name, &serde_json::to_string(fields)?)
}

/// Names of the numbers that output channels deliver.
fn outputs(channels: &v1::Channels) -> Vec<String> {
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
fn faults(event: &Event, model: &v1::Model, time_step_s: f64) -> Result<Vec<v1::FaultSpec>> {
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
        fault.start = Some(Start::StartStep(begins(event, time_step_s)));
        fault.duration_s = event.for_s.unwrap_or(0.0);
    }
    Ok(faults)
}

/// The reference, state by state.
async fn motion(
    place: &Place,
    scenario: &Scenario,
    model: &v1::Model,
    reference: &Reference,
    folder: &Path,
) -> Result<Motion> {
    match reference {
        Reference::At(point) => {
            let request = v1::LinearizeRequest {
                model: model.name.clone(),
                settings: Some(settings(&scenario.plant)),
                point: Some(operating_point(point)),
            };
            let answer = place.client.linearize(request).await.context("reference.at")?;
            let x = answer.state.context("a linearization without a state")?.x();
            Ok(Motion { x: vec![x], u: vec![answer.u], trajectory: None })
        }
        Reference::Trajectory(file) => {
            let result = files::read_result(&folder.join(file)).context("reference.trajectory")?;
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
            Ok(Motion { x: rows(&x), u, trajectory: Some(trajectory) })
        }
    }
}

/// The regulator about the reference.
pub(super) async fn feedback(
    client: &Client,
    scenario: &Scenario,
    model: &v1::Model,
    reference: &Motion,
    lqr: &Lqr,
    id: &str,
) -> Result<v1::SetFeedbackRequest> {
    use v1::set_feedback_request::Reference as Form;
    let states = 2 * model.coordinates.len();
    let prescribed = model.coordinates.iter().filter(|c| c.prescribed).count();
    let weight = |values: &[f64], count: usize| match values {
        [value] => diagonal(vec![*value; count]),
        values => diagonal(values),
    };
    let mut weights = plantd_client::weights(
        weight(&lqr.q, states),
        weight(&lqr.r, model.inputs.len() + prescribed),
    );
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
pub(super) fn changed(
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
fn rows(inputs: &Inputs, model: &v1::Model, folder: &Path) -> Result<Vec<Vec<Option<f64>>>> {
    let prescribed = model.coordinates.iter().filter(|c| c.prescribed).map(|c| &c.name);
    let names: Vec<_> = model.inputs.iter().chain(prescribed).collect();
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
    let matrix = files::table(&text).with_context(key)?;
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
