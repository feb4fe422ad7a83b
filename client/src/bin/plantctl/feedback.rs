//! Feedbacks of plants, and their gains.

use anyhow::{Context as _, Result};
use plantd_client::{Client, operating_point, present_state, v1};
use serde_json::json;

use crate::args::{Feedback, Reference};
use crate::commands::{Output, next_or_interrupt, plant, space};
use crate::optimize::read_result;
use crate::{json, text};

/// `feedback set` and `feedback clear`.
pub(crate) async fn run(client: &Client, output: Output, command: Feedback) -> Result<()> {
    let (id, reference, weights, full, mode, first_step, guard) = match command {
        Feedback::Clear { id } => {
            let had = plant(client, &id).await?.feedback;
            client.clear_feedback(&id).await?;
            if had.is_none() {
                output.nothing_to_do(&format!("plant `{id}` has no feedback"));
            }
            return Ok(output.done(json!({ "cleared": { "plant": id } }))?);
        }
        Feedback::Set { id, reference, weights, full, mode, first_step, guard } => {
            (id, reference, weights, full, mode, first_step, guard)
        }
    };
    use v1::set_feedback_request::Reference as Form;
    let form = match reference {
        Reference { trajectory: Some(file), .. } => {
            let checkpoint = read_result(&file)?.checkpoint.unwrap_or_default();
            Form::Trajectory(checkpoint.trajectory.context("no trajectory in the file")?)
        }
        Reference { at: Some(name), .. } => Form::Point(operating_point(name)),
        Reference { .. } => Form::Point(present_state(&id)),
    };
    let model = model_of(client, &id).await?;
    let request = v1::SetFeedbackRequest {
        id,
        weights: Some(weights.for_model(&model)),
        constraints: space(full).into(),
        mode: v1::FeedbackMode::from(mode).into(),
        first_step,
        guard,
        reference: Some(form),
        ..Default::default()
    };
    let feedback = client.set_feedback(request).await?;
    let as_json = || json::message("FeedbackInfo", &feedback);
    Ok(output.print(as_json, || text::feedback(&feedback))?)
}

/// Prints the stream of a plant's gains.
pub(crate) async fn gains(
    client: &Client,
    output: Output,
    id: String,
    count: Option<u64>,
) -> Result<()> {
    let model = model_of(client, &id).await?;
    let mut messages = client.watch_gains(id).await?;
    let mut seen = 0;
    while count.is_none_or(|count| seen < count) {
        let Some(message) = next_or_interrupt(&mut messages).await? else { break };
        output.print(
            || json::message("WatchGainsResponse", &message),
            || text::watched_gain(&message, &model),
        )?;
        seen += 1;
    }
    Ok(())
}

async fn model_of(client: &Client, id: &str) -> Result<v1::Model> {
    Ok(client.get_model(plant(client, id).await?.model).await?)
}
