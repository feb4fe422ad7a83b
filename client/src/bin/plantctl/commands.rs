//! What the commands do.

use std::io::{Read as _, Write as _};
use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context as _, Result};
use plantd_client::{Answers, Client, DEFAULT_ADDRESS, MatrixExt as _, v1};
use serde_json::{Value, json};

use crate::args::{
    Args, Assignment, Command, Field, Numbers, Plural, Point, RegulatorWeights, Settings, Singular,
};
use crate::{FAILED, channels, feedback, json, optimize, replay, run, test, text};

/// Runs a command; the code is that of a command which ran.
pub(crate) async fn run(args: Args) -> Result<ExitCode> {
    let output = Output { json: args.json };
    let command = match args.command {
        Command::Test(options) => return test::run(args.address, output, options).await,
        Command::Replay { file } => return replay::replay(args.address, output, &file).await,
        Command::Export { file, csv } => {
            replay::export(output, &file, &csv)?;
            return Ok(ExitCode::SUCCESS);
        }
        command => command,
    };
    let address = args.address.as_deref().unwrap_or(DEFAULT_ADDRESS);
    let client = Client::connect(address).await?;
    match command {
        Command::List { what } => list(&client, output, what).await?,
        Command::Show { what: Singular::Model, name } => {
            let model = client.get_model(name).await?;
            output.print(|| json::message("Model", &model), || text::model(&model))?;
        }
        Command::Show { what: Singular::Plant, name } => show_plant(&client, output, name).await?,
        Command::Upload { scene, name } => {
            let request = v1::CreateModelRequest {
                name: name.unwrap_or_default(),
                scene: read_text(&scene)?,
                ..Default::default()
            };
            let model = client.create_model_as(request).await?;
            output.print(|| json::message("Model", &model), || text::model(&model))?;
        }
        Command::Create { model, id, settings, tolerance, initial, link } => {
            let tolerance = tolerance.unwrap_or(0.0);
            let request = v1::CreatePlantRequest {
                id: id.unwrap_or_default(),
                model,
                settings: Some(v1::PlantSettings { tolerance, ..settings.into() }),
                initial: initial.into(),
                open_link: link,
            };
            let plant = client.create_plant(request).await?;
            output.print(
                || json::message("PlantInfo", &plant),
                || text::plants(std::slice::from_ref(&plant)) + &text::stepping(&plant),
            )?;
        }
        Command::Step { id, u, count, all } => {
            let rows: Vec<_> = u.into_iter().map(|row| row.0).collect();
            step(&client, output, id, &rows, count, all).await?;
        }
        Command::Watch { id, fields, every, coordinates, count, queue, weights } => {
            let request = v1::WatchRequest {
                fields: fields.iter().map(|&f| v1::WatchField::from(f).into()).collect(),
                weights: None,
                id,
                every,
                coordinates,
                queue,
            };
            watch(&client, output, request, &fields, &weights, count).await?;
        }
        Command::Linearize { point, settings } => {
            linearize(&client, output, point, settings).await?;
        }
        Command::Lqr { point, settings, weights, full } => {
            lqr(&client, output, point, settings, &weights, full).await?;
        }
        Command::SecondOrder { point, settings, weights, multiplier_weights } => {
            let numbers = |weights: Option<Numbers>| weights.map_or_else(Vec::new, |w| w.0);
            let is_contracted = weights.is_some() || multiplier_weights.is_some();
            let weights = v1::ContractionWeights {
                x: numbers(weights),
                multipliers: numbers(multiplier_weights),
            };
            let weights = is_contracted.then_some(weights);
            second_order(&client, output, point, settings, weights).await?;
        }
        Command::Dynamics { model, at, q, v, inputs, prescribed_acceleration, order } => {
            let numbers = |given: Option<Numbers>| given.map_or_else(Vec::new, |g| g.0);
            let request = v1::EvaluateDynamicsRequest {
                model,
                operating_point: at,
                q: numbers(q),
                v: numbers(v),
                inputs: numbers(inputs),
                prescribed_acceleration: numbers(prescribed_acceleration),
                order,
            };
            dynamics(&client, output, request).await?;
        }
        Command::Analyze { point, settings, outputs, frequencies, full } => {
            let frequencies_hz = frequencies.map_or_else(Vec::new, |f| f.0);
            let request = v1::AnalyzeRequest { outputs, frequencies_hz, ..Default::default() };
            analyze(&client, output, point, settings, request, full).await?;
        }
        Command::Optimize { problem, save, resume, guess, method, iterations } => {
            let files = optimize::Files { problem, save, resume, guess };
            optimize::optimize(&client, output, files, method, iterations).await?;
        }
        Command::ProjectReference { model, reference, u, settings, weights, tolerance, strict } => {
            let request = v1::ProjectReferenceRequest {
                model,
                settings: Some(settings.into()),
                tolerance,
                strict,
                ..Default::default()
            };
            let files = (reference.as_path(), u.as_deref());
            optimize::project_reference(&client, output, request, files, &weights).await?;
        }
        Command::Kalman { point, settings, outputs, measurement, process, input, full } => {
            let (model, settings, point) = resolve(&client, point, settings).await?;
            let states = 2 * model.coordinates.len();
            let inputs = text::input_names(&model).len();
            let count = if outputs.is_empty() { states } else { outputs.len() };
            let request = v1::SolveKalmanRequest {
                model: model.name.clone(),
                settings: Some(settings),
                point: Some(point),
                measurement: Some(v1::Measurement { outputs, ..Default::default() }),
                noise: Some(v1::NoiseCovariances {
                    process: process.map(|p| p.diagonal(states)),
                    input: input.map(|i| i.diagonal(inputs)),
                    measurement: Some(measurement.diagonal(count)),
                }),
                constraints: space(full).into(),
            };
            let answer = client.solve_kalman(request).await?;
            output.print(
                || json::message("SolveKalmanResponse", &answer),
                || text::kalman(&answer, &model),
            )?;
        }
        Command::SetParameter { id, parameters, dt } => {
            let parameter = |Assignment(path, value)| v1::Parameter { path, value };
            let request = v1::SetParametersRequest {
                id,
                parameters: parameters.into_iter().map(parameter).collect(),
                time_step_s: dt.unwrap_or(0.0),
            };
            let plant = client.set_parameters(request).await?;
            output.print(
                || json::message("PlantInfo", &plant),
                || text::plants(std::slice::from_ref(&plant)) + &text::parameters(&plant),
            )?;
        }
        Command::Channels(command) => channels::run(&client, output, command).await?,
        Command::Run(args) => run::run(&client, output, args).await?,
        Command::Pause { id } => run::pause(&client, output, id).await?,
        Command::Guard { id, bounds } => run::guard(&client, output, id, bounds).await?,
        Command::Timing { id, clear } => run::timing(&client, output, id, clear).await?,
        Command::Events { id, since, count } => {
            run::events(&client, output, id, since, count).await?;
        }
        Command::Fault(command) => channels::fault(&client, output, command).await?,
        Command::Feedback(command) => feedback::run(&client, output, command).await?,
        Command::Gains { id, count } => feedback::gains(&client, output, id, count).await?,
        Command::Settle { model, hold, guess, inputs, constraints, toml } => {
            let goal =
                if constraints { v1::SettleGoal::Constraints } else { v1::SettleGoal::Equilibrium };
            let request = v1::SettleRequest {
                model,
                hold,
                guess: values(guess),
                inputs: values(inputs),
                goal: goal.into(),
                ..Default::default()
            };
            settle(&client, output, request, toml).await?;
        }
        Command::Diagnose { model, at, plant } => {
            let form = v1::initial_state::Form::OperatingPoint(at);
            let request = match plant {
                Some(id) => v1::DiagnoseRequest { id, ..Default::default() },
                None => v1::DiagnoseRequest {
                    model: model.unwrap_or_default(),
                    initial: Some(v1::InitialState { form: Some(form) }),
                    ..Default::default()
                },
            };
            diagnose(&client, output, request).await?;
        }
        Command::Validate { scene } => return validate(&client, output, &scene).await,
        Command::Explain { scene } => return explain(&client, output, &scene).await,
        Command::Reset { id, initial } => {
            let request = v1::ResetRequest { id, initial: initial.into() };
            let state = client.reset_to(request).await?;
            output.print(|| json::message("State", &state), || text::state(&state))?;
        }
        Command::Snapshot { id, file } => {
            let snapshot = client.snapshot(&id).await?;
            std::fs::write(&file, &snapshot)
                .with_context(|| format!("cannot write {}", file.display()))?;
            output.done(json!({ "plant": id, "bytes": snapshot.len() }))?;
        }
        Command::Restore { id, file } => {
            let snapshot =
                std::fs::read(&file).with_context(|| format!("cannot read {}", file.display()))?;
            let state = client.restore(id, snapshot).await?;
            output.print(|| json::message("State", &state), || text::state(&state))?;
        }
        Command::Delete { what: Singular::Plant, name } => {
            client.delete_plant(&name).await?;
            output.done(json!({ "deleted": { "plant": name } }))?;
        }
        Command::Delete { what: Singular::Model, name } => {
            client.delete_model(&name).await?;
            output.done(json!({ "deleted": { "model": name } }))?;
        }
        Command::Record(command) => replay::record(&client, output, command).await?,
        Command::Test(_) | Command::Replay { .. } | Command::Export { .. } => {
            unreachable!("has been run above")
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Where results go.
#[derive(Clone, Copy)]
pub(crate) struct Output {
    pub(crate) json: bool,
}

impl Output {
    /// Prints a result, flushed, so that a reader of a stream gets it at once.
    pub(crate) fn print(
        self,
        json: impl FnOnce() -> Value,
        text: impl FnOnce() -> String,
    ) -> std::io::Result<()> {
        let mut out = std::io::stdout().lock();
        if self.json {
            writeln!(out, "{}", json())?;
        } else {
            out.write_all(text().as_bytes())?;
        }
        out.flush()
    }

    /// Says on standard error that there was nothing to do.
    pub(crate) fn nothing_to_do(self, message: &str) {
        if self.json {
            eprintln!("{}", json!({ "note": { "message": message } }));
        } else {
            eprintln!("plantctl: nothing to do: {message}");
        }
    }

    /// Confirms what has no result of its own; people see that it went well by the silence.
    pub(crate) fn done(self, json: Value) -> std::io::Result<()> {
        self.print(|| json, String::new)
    }
}

async fn list(client: &Client, output: Output, what: Option<Plural>) -> Result<()> {
    let models = match what {
        Some(Plural::Plants) => None,
        _ => Some(client.list_models().await?),
    };
    let plants = match what {
        Some(Plural::Models) => None,
        _ => Some(client.list_plants().await?),
    };
    let as_json = || {
        let mut object = serde_json::Map::new();
        if let Some(models) = &models {
            object.insert("models".to_owned(), json::messages("Model", models));
        }
        if let Some(plants) = &plants {
            object.insert("plants".to_owned(), json::messages("PlantInfo", plants));
        }
        Value::Object(object)
    };
    let as_text = || {
        let tables = [models.as_deref().map(text::models), plants.as_deref().map(text::plants)];
        tables.into_iter().flatten().collect::<Vec<_>>().join("\n")
    };
    Ok(output.print(as_json, as_text)?)
}

async fn show_plant(client: &Client, output: Output, id: String) -> Result<()> {
    let answer = client.get_plant(id).await?;
    let as_text = || {
        let plant = answer.plant.as_ref();
        let state = plant.and_then(|p| p.state.as_ref());
        [
            plant.map(|p| text::plants(std::slice::from_ref(p))),
            plant.map(text::stepping),
            state.map(text::state),
            answer.energy.as_ref().map(text::energy),
            plant.map(text::parameters),
            plant.and_then(|p| p.feedback.as_ref()).map(text::feedback),
            plant.and_then(|p| p.safety.as_ref()).map(text::safety),
        ]
        .into_iter()
        .flatten()
        .collect()
    };
    Ok(output.print(|| json::message("GetPlantResponse", &answer), as_text)?)
}

async fn step(
    client: &Client,
    output: Output,
    id: String,
    rows: &[Vec<f64>],
    count: Option<u32>,
    all: bool,
) -> Result<()> {
    let cols = rows.first().map_or(0, Vec::len);
    anyhow::ensure!(rows.iter().all(|row| row.len() == cols), "the inputs differ in length");
    let given = rows.len() as u32;
    let count = count.unwrap_or(given.max(1));
    anyhow::ensure!(count >= given, "{given} inputs for {count} steps");
    let request = v1::StepRequest {
        id,
        u: Some(v1::Matrix::from_rows(rows)),
        hold: count - given,
        all_states: all,
        ..Default::default()
    };
    let answer = client.step(request).await?;
    let as_text = || {
        let states = answer.states.iter().map(text::state);
        states.chain(answer.report.as_ref().map(text::report)).collect()
    };
    Ok(output.print(|| json::message("StepResponse", &answer), as_text)?)
}

async fn watch(
    client: &Client,
    output: Output,
    mut request: v1::WatchRequest,
    fields: &[Field],
    weights: &RegulatorWeights,
    count: Option<u64>,
) -> Result<()> {
    let named = fields.iter().any(|f| matches!(f, Field::Linearization | Field::Gain));
    let model = if named {
        let plant = plant(client, &request.id).await?;
        client.get_model(plant.model).await?
    } else {
        v1::Model::default()
    };
    if fields.contains(&Field::Gain) {
        request.weights = Some(weights.for_model(&model));
    }
    let mut messages = client.watch(request).await?;
    let mut seen = 0;
    while count.is_none_or(|count| seen < count) {
        let Some(message) = next_or_interrupt(&mut messages).await? else { break };
        output.print(|| json::message("WatchResponse", &message), || watched(&message, &model))?;
        seen += 1;
    }
    Ok(())
}

/// A plant as it is now.
pub(crate) async fn plant(client: &Client, id: &str) -> Result<v1::PlantInfo> {
    client.get_plant(id).await?.plant.context("no plant in the answer")
}

/// The next message; none at the end of the stream, or when Ctrl-C is pressed.
pub(crate) async fn next_or_interrupt<T>(messages: &mut Answers<T>) -> Result<Option<T>> {
    tokio::select! {
        next = messages.next() => Ok(next?),
        _ = tokio::signal::ctrl_c() => Ok(None),
    }
}

/// A message of a watch as text.
fn watched(message: &v1::WatchResponse, model: &v1::Model) -> String {
    let head = match &message.state {
        Some(state) => text::state(state),
        None => format!("step {}\n", message.step),
    };
    let lost = (message.dropped > 0).then(|| format!("  {} messages lost\n", message.dropped));
    let failure = message.failure.as_ref().map(|f| format!("  {}: {}\n", f.reason, f.message));
    let input = (!message.u.is_empty()).then(|| format!("  u: {}\n", text::numbers(&message.u)));
    let parts = [
        Some(head),
        input,
        message.outputs.as_ref().map(channels::outputs),
        message.report.as_ref().map(text::report),
        message.energy.as_ref().map(text::energy),
        message.linearization.as_ref().map(|l| text::linearization(l, model)),
        message.gain.as_ref().map(|g| text::gain(g, model)),
        failure,
        lost,
    ];
    parts.into_iter().flatten().collect()
}

/// The model, the settings and the point that the command line names.
async fn resolve(
    client: &Client,
    point: Point,
    settings: Settings,
) -> Result<(v1::Model, v1::PlantSettings, v1::Point)> {
    let Some(id) = point.plant else {
        let model = client.get_model(point.model.unwrap_or_default()).await?;
        return Ok((model, settings.into(), plantd_client::operating_point(point.at)));
    };
    let plant = plant(client, &id).await?;
    let model = client.get_model(plant.model).await?;
    Ok((model, plant.settings.unwrap_or_default(), plantd_client::present_state(plant.id)))
}

async fn linearize(
    client: &Client,
    output: Output,
    point: Point,
    settings: Settings,
) -> Result<()> {
    let (model, settings, point) = resolve(client, point, settings).await?;
    let request = v1::LinearizeRequest {
        model: model.name.clone(),
        settings: Some(settings),
        point: Some(point),
    };
    let answer = client.linearize(request).await?;
    let as_text = || {
        let rank = answer.controllability_rank;
        let order = 2 * model.coordinates.len();
        let matrices = answer.linearization.as_ref().map(|l| text::linearization(l, &model));
        format!("{}\ncontrollability rank: {rank} of {order}\n", matrices.unwrap_or_default())
    };
    Ok(output.print(|| json::message("LinearizeResponse", &answer), as_text)?)
}

async fn lqr(
    client: &Client,
    output: Output,
    point: Point,
    settings: Settings,
    weights: &RegulatorWeights,
    full: bool,
) -> Result<()> {
    let (model, settings, point) = resolve(client, point, settings).await?;
    let request = v1::SolveLqrRequest {
        model: model.name.clone(),
        settings: Some(settings),
        point: Some(point),
        weights: Some(weights.for_model(&model)),
        constraints: space(full).into(),
    };
    let answer = client.solve_lqr(request).await?;
    let as_text = || {
        let gain = answer.gain.as_ref().map(|g| text::gain(g, &model)).unwrap_or_default();
        format!(
            "{gain}\nspectral radius of the closed loop: {}\nRiccati residual: {}\n",
            text::number(answer.spectral_radius),
            text::number(answer.residual),
        )
    };
    Ok(output.print(|| json::message("SolveLqrResponse", &answer), as_text)?)
}

async fn second_order(
    client: &Client,
    output: Output,
    point: Point,
    settings: Settings,
    weights: Option<v1::ContractionWeights>,
) -> Result<()> {
    let (model, settings, point) = resolve(client, point, settings).await?;
    let request = v1::LinearizeSecondOrderRequest {
        model: model.name.clone(),
        settings: Some(settings),
        point: Some(point),
        weights,
    };
    let answer = client.linearize_second_order(request).await?;
    let as_text = || {
        let tensors = answer.tensors.as_ref().map(|t| text::second_order(t, &model));
        let contraction = answer.contraction.as_ref().map(|c| text::contraction(c, &model));
        tensors.or(contraction).unwrap_or_default()
    };
    Ok(output.print(|| json::message("LinearizeSecondOrderResponse", &answer), as_text)?)
}

async fn dynamics(
    client: &Client,
    output: Output,
    request: v1::EvaluateDynamicsRequest,
) -> Result<()> {
    let model = client.get_model(&request.model).await?;
    let answer = client.evaluate_dynamics(request).await?;
    let as_text = || text::dynamics(&answer, &model);
    Ok(output.print(|| json::message("EvaluateDynamicsResponse", &answer), as_text)?)
}

async fn analyze(
    client: &Client,
    output: Output,
    point: Point,
    settings: Settings,
    request: v1::AnalyzeRequest,
    full: bool,
) -> Result<()> {
    let (model, settings, point) = resolve(client, point, settings).await?;
    let request = v1::AnalyzeRequest {
        model: model.name.clone(),
        settings: Some(settings),
        point: Some(point),
        constraints: space(full).into(),
        ..request
    };
    let answer = client.analyze(request).await?;
    let as_text = || text::analysis(&answer, &model);
    Ok(output.print(|| json::message("AnalyzeResponse", &answer), as_text)?)
}

async fn settle(
    client: &Client,
    output: Output,
    request: v1::SettleRequest,
    toml: bool,
) -> Result<()> {
    let model = client.get_model(&request.model).await?;
    let answer = client.settle(request).await?;
    let as_text = || match toml {
        true => text::operating_point(&answer, &model),
        false => text::settled(&answer, &model),
    };
    Ok(output.print(|| json::message("SettleResponse", &answer), as_text)?)
}

async fn diagnose(client: &Client, output: Output, request: v1::DiagnoseRequest) -> Result<()> {
    let name = if request.id.is_empty() {
        request.model.clone()
    } else {
        plant(client, &request.id).await?.model
    };
    let model = client.get_model(name).await?;
    let answer = client.diagnose(request).await?;
    let as_text = || text::diagnosis(&answer, &model);
    Ok(output.print(|| json::message("DiagnoseResponse", &answer), as_text)?)
}

/// Named values as the contract has them.
fn values(given: Vec<Assignment>) -> std::collections::HashMap<String, f64> {
    given.into_iter().map(|Assignment(name, value)| (name, value)).collect()
}

/// The space on which a constrained model is looked at.
pub(crate) fn space(full: bool) -> v1::ConstraintHandling {
    if full { v1::ConstraintHandling::Full } else { v1::ConstraintHandling::Manifold }
}

async fn validate(client: &Client, output: Output, scene: &Path) -> Result<ExitCode> {
    let answer = client.validate_scene(read_text(scene)?).await?;
    output.print(
        || json::message("ValidateSceneResponse", &answer),
        || match &answer.model {
            Some(model) if answer.problems.is_empty() => text::validated(model),
            _ => problems(&answer.problems),
        },
    )?;
    Ok(verdict(&answer))
}

async fn explain(client: &Client, output: Output, scene: &str) -> Result<ExitCode> {
    let path = Path::new(scene);
    // A file goes before a model of the same name.
    if !path.is_file() && scene != "-" {
        let model = client.get_model(scene).await?;
        output.print(|| json!({ "plan": model.plan }), || ended(&model.plan))?;
        return Ok(ExitCode::SUCCESS);
    }
    let answer = client.validate_scene(read_text(path)?).await?;
    match &answer.model {
        Some(model) => output.print(|| json!({ "plan": model.plan }), || ended(&model.plan))?,
        None => output.print(
            || json::message("ValidateSceneResponse", &answer),
            || problems(&answer.problems),
        )?,
    }
    Ok(verdict(&answer))
}

fn verdict(answer: &v1::ValidateSceneResponse) -> ExitCode {
    if answer.problems.is_empty() { ExitCode::SUCCESS } else { ExitCode::from(FAILED) }
}

fn problems(problems: &[v1::SceneProblem]) -> String {
    problems.iter().map(|p| format!("{}: {}\n", p.path, p.message)).collect()
}

/// The text with a line end.
fn ended(text: &str) -> String {
    format!("{}\n", text.trim_end())
}

/// A file's text; `-` stands for standard input.
pub(crate) fn read_text(path: &Path) -> Result<String> {
    if path == Path::new("-") {
        let mut text = String::new();
        std::io::stdin().read_to_string(&mut text).context("cannot read standard input")?;
        return Ok(text);
    }
    std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
}
