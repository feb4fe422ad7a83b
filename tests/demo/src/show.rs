//! What is to be seen: the marionette dancing and the pendulum being pushed, by the wall clock.

use anyhow::{Context as _, Result};
use plantd_client::{Client, diagonal, operating_point, v1, weights};

use crate::marionette;

/// Ids of the plants.
pub(crate) const MARIONETTE: &str = "marionette";
const PENDULUM: &str = "pendulum";
/// Time step, s.
const TIME_STEP_S: f64 = 0.01;
/// The push: a force across the rod at its end, N, and how often and for how long, s.
const PUSH_N: f64 = 12.0;
const PUSH_EVERY_S: f64 = 4.0;
const PUSH_S: f64 = 0.2;

/// Lets both go on until the process ends or the server does.
pub(crate) async fn control(client: &Client) -> Result<()> {
    push_pendulum(client).await?;
    dance(client).await
}

/// The pendulum upright under a regulator in its own loop, and a push now and then. Nobody drives it.
async fn push_pendulum(client: &Client) -> Result<()> {
    let upright = v1::initial_state::Form::OperatingPoint("upright".to_owned());
    create(client, PENDULUM, Some(upright)).await?;
    client
        .set_feedback(v1::SetFeedbackRequest {
            id: PENDULUM.to_owned(),
            reference: Some(v1::set_feedback_request::Reference::Point(operating_point("upright"))),
            weights: Some(weights(diagonal([10.0, 1.0]), diagonal([1.0]))),
            mode: v1::FeedbackMode::Replace.into(),
            ..Default::default()
        })
        .await?;
    let end = v1::FramePoint { frame: "rod".to_owned(), at: vec![0.0, -1.0, 0.0] };
    let push = v1::Push { point: Some(end), force: vec![PUSH_N, 0.0, 0.0], torque: Vec::new() };
    let intermittent = v1::Intermittent { period_s: PUSH_EVERY_S, duty: PUSH_S / PUSH_EVERY_S };
    let fault = v1::FaultSpec {
        kind: Some(v1::fault_spec::Kind::Push(push)),
        start: Some(v1::fault_spec::Start::StartS(1.0)),
        pattern: Some(v1::fault_spec::Pattern::Intermittent(intermittent)),
        ..Default::default()
    };
    client.inject_fault(PENDULUM, fault).await?;
    run(client, PENDULUM).await
}

/// The marionette on its strings, which this process lengthens and shortens.
async fn dance(client: &Client) -> Result<()> {
    let model = client.get_model(MARIONETTE).await?;
    let strings = marionette::Strings::of(&model)?;
    create(client, MARIONETTE, None).await?;
    run(client, MARIONETTE).await?;
    let mut driver = client.drive(MARIONETTE).await?;
    let mut time_s = 0.0;
    loop {
        // Answered when the input has acted: the plant sets the pace.
        let step = driver.step(&strings.at(time_s + TIME_STEP_S)).await?;
        time_s = step.state.context("no state")?.time_s;
    }
}

async fn create(
    client: &Client,
    id: &str,
    form: Option<v1::initial_state::Form>,
) -> Result<v1::PlantInfo> {
    let request = v1::CreatePlantRequest {
        id: id.to_owned(),
        model: id.to_owned(),
        settings: Some(v1::PlantSettings { time_step_s: TIME_STEP_S, ..Default::default() }),
        initial: form.map(|form| v1::InitialState { form: Some(form) }),
        ..Default::default()
    };
    Ok(client.create_plant(request).await?)
}

async fn run(client: &Client, id: &str) -> Result<()> {
    let settings = v1::RunSettings { pace: v1::Pace::Paced.into(), ..Default::default() };
    let request =
        v1::RunRequest { id: id.to_owned(), settings: Some(settings), ..Default::default() };
    client.run(request).await?;
    Ok(())
}
