//! Plants that go to other servers: ExportPlant there, CreatePlant with the record here, DeletePlant with the new
//! address there.

use std::sync::Arc;

use plantd_proto::v1;

use crate::core::session::shared::Session;
use crate::wire::message::run_info::run_info;
use crate::wire::names::is_address;
use crate::wire::plants::record;
use crate::wire::plants::state::claim;
use crate::wire::shared::hub::Hub;
use crate::wire::shared::state::{sealed, unsealed};
use crate::wire::status::RpcError;

/// Answers an ExportPlant call. Blocks for as long as a step takes: call it on a worker.
pub(crate) fn export(
    hub: &Hub,
    request: &v1::ExportPlantRequest,
) -> Result<v1::ExportPlantResponse, RpcError> {
    let session = hub.session(&request.id)?;
    let (mut run, before) = run_at_a_step(&session);
    if request.pause {
        session.pause();
    }
    let (mut record, model) = session.saved();
    let step = record.plant.as_ref().and_then(|plant| plant.state.as_ref()).map_or(0, |s| s.step);
    if run.steps_left > 0 {
        let taken = step.saturating_sub(before);
        run.steps_left = run.steps_left.saturating_sub(taken);
        // The last of them is taken: it stands still, as it would have.
        run.running &= run.steps_left > 0;
    }
    if let Some(plant) = &mut record.plant {
        plant.run = Some(run.clone());
    }
    record::add_models(&mut record, hub, &session, &model);
    Ok(v1::ExportPlantResponse { record: sealed(&record), step, run: Some(run) })
}

/// How a plant is run, and the step at which that was true.
fn run_at_a_step(session: &Session) -> (v1::RunInfo, u64) {
    loop {
        let before = session.step_index();
        let run = run_info(session);
        if run.steps_left == 0 || session.step_index() == before {
            return (run, before);
        }
    }
}

/// Makes the plant of a record.
pub(crate) async fn import(
    hub: &Arc<Hub>,
    request: v1::CreatePlantRequest,
) -> Result<Arc<Session>, RpcError> {
    let v1::CreatePlantRequest { id, record, any_build, .. } = &request;
    for (field, is_given) in [
        ("model", !request.model.is_empty()),
        ("settings", request.settings.is_some()),
        ("initial", request.initial.is_some()),
        ("open_link", request.open_link),
        ("expires_s", request.expires_s != 0.0),
    ] {
        if is_given {
            return Err(RpcError::field(field, "is what the record says"));
        }
    }
    let record = unsealed(record).map_err(record::unusable)?;
    let own = record.plant.as_ref().map_or("", |plant| plant.id.as_str());
    let id = if id.is_empty() { own.to_owned() } else { id.clone() };
    hub.check_new_plant(&id)?;
    if !any_build {
        record::check_build(&record)?;
    }
    let whole = record::whole();
    let session = record::make(hub, id, record, whole).await?;
    // Whoever has it in the store these servers share does not any more.
    claim(hub, &session, true).await?;
    tracing::info!(plant = session.id(), step = session.step_index(), "plant received");
    Ok(session)
}

/// Ends a plant, which may go on elsewhere, and may have to be at a step.
pub(crate) async fn delete(
    hub: &Arc<Hub>,
    id: &str,
    moved_to: String,
    step: Option<u64>,
) -> Result<(), RpcError> {
    let session = match hub.session(id) {
        // The store that the servers share has said so first.
        Err(fault)
            if fault.reason() == "PLANT_ELSEWHERE"
                && fault.detail("address") == Some(&moved_to[..]) =>
        {
            return Ok(());
        }
        session => session?,
    };
    if !moved_to.is_empty() && !is_address(&moved_to) {
        let problem = "is no address such as http://host:port, https://host:port or unix:/path";
        return Err(RpcError::field("moved_to", problem));
    }
    let close = {
        let (session, moved_to) = (Arc::clone(&session), moved_to.clone());
        move |at: u64| {
            if step.is_some_and(|step| step != at) {
                return Err(at);
            }
            if !moved_to.is_empty() {
                session.note_move(moved_to);
            }
            Ok(session.close())
        }
    };
    // In the core's hands no step falls in between.
    let job = {
        let session = Arc::clone(&session);
        move |_: &_| Ok(session.with_core(|core| close(core.plant().step_index())))
    };
    match hub.attendants.resume(job).await? {
        Ok(true) => hub.clear_away(session).await,
        Ok(false) if session.moved_to() == Some(&moved_to) => Ok(()),
        Ok(false) => Err(RpcError::closed(&session)),
        Err(at) => {
            let message = format!("plant `{id}` is at step {at} by now");
            Err(RpcError::precondition("MOVED_ON", id, message).with("step", at))
        }
    }
}
