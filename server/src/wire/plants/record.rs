//! A plant as a record from which it is made again, by the next server or by another one.
//!
//! Records come from strangers, too: what is in them is checked like any request, and a plant that cannot be made
//! whole leaves nothing behind.

use std::collections::HashMap;
use std::sync::Arc;

use plantd_models::{Initial, Model, Snapshot, Spare};
use plantd_proto::v1;

use crate::core::identity::build;
use crate::core::plant::view::PlantSnapshot;
use crate::core::session::shared::Session;
use crate::core::workers::pool::Abandoned;
use crate::wire::message::{checks, models, settings, start};
use crate::wire::models::model::compile;
use crate::wire::plants::feedback::set_feedback;
use crate::wire::plants::run::{protect, run};
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// What becomes of a part of a plant that cannot be made again: the plant does without it, or is not made.
pub(crate) type Lose = Arc<dyn Fn(&'static str, RpcError) -> Result<(), RpcError> + Send + Sync>;

/// Adds to the record of a session what it is made from: the model in force, and that of its start if it is another.
pub(crate) fn add_models(
    record: &mut v1::PlantRecord,
    hub: &Hub,
    session: &Session,
    in_force: &Model,
) {
    let name = session.model_name();
    let entry = hub.catalog.get(name).ok();
    let message = |model: &Model| {
        let name = entry.as_ref().map_or("", |_| name);
        let builtin = entry.as_ref().is_some_and(|entry| entry.builtin);
        v1::Model { plan: String::new(), ..models::model(name, builtin, model, true) }
    };
    let start = session.model();
    record.model = Some(message(in_force));
    record.start_model = (start.digest() != in_force.digest()).then(|| message(start));
    record.build = build();
}

/// Refuses a plant that would not go on bit for bit.
pub(crate) fn check_build(record: &v1::PlantRecord) -> Result<(), RpcError> {
    let (of_record, of_server) = (&record.build, build());
    if *of_record == of_server {
        return Ok(());
    }
    let message = format!(
        "the plant is of build `{of_record}`, this server of `{of_server}`: its motion would have other \
         round-off; `any_build` takes it all the same"
    );
    let refused = RpcError::precondition("OTHER_BUILD", "record", message);
    Err(refused.with("record", of_record).with("server", of_server))
}

/// The plant is made whole, or not at all.
pub(crate) fn whole() -> Lose {
    Arc::new(|_, fault| Err(fault))
}

/// What is missing is told in the log: without some of what belongs to it, a plant is still worth having.
pub(crate) fn lossy(id: &str) -> Lose {
    let id = id.to_owned();
    Arc::new(move |what, fault| {
        tracing::warn!(plant = id, error = sentence(fault), "{what}");
        Ok(())
    })
}

pub(crate) fn sentence(fault: RpcError) -> String {
    tonic::Status::from(fault).message().to_owned()
}

/// A record that makes no plant.
pub(crate) fn unusable(problem: String) -> RpcError {
    RpcError::field("record", problem)
}

/// Makes the plant of a record, under an id.
pub(crate) async fn make(
    hub: &Arc<Hub>,
    id: String,
    record: v1::PlantRecord,
    lose: Lose,
) -> Result<Arc<Session>, RpcError> {
    let feedback = record.feedback.clone();
    let info = record.plant.as_ref().and_then(|plant| plant.feedback.clone());
    let here = Arc::clone(hub);
    let first = move |_: &Abandoned| Made::new(&here, id, record, lose);
    let made = hub.attendants.resume(first).await?;
    let (session, lose) = (Arc::clone(&made.session), Arc::clone(&made.lose));
    let (open_link, uploaded) = (made.open_link, made.uploaded.clone());
    let completed = async {
        let here = Arc::clone(hub);
        let made = hub.attendants.resume(move |_: &Abandoned| made.with_channels(&here)).await?;
        resume_feedback(hub, &session, feedback, info, &lose).await?;
        let here = Arc::clone(hub);
        hub.attendants.resume(move |_: &Abandoned| made.complete(&here)).await
    };
    if let Err(fault) = completed.await {
        hub.delete(session.id()).await?;
        forget(hub, uploaded);
        return Err(fault);
    }
    if open_link && let Err(fault) = hub.open_link(Arc::clone(&session)).await {
        let status = tonic::Status::from(fault);
        let (plant, error) = (session.id(), status.message());
        tracing::warn!(plant, error, "shared-memory link not opened");
    }
    Ok(session)
}

/// Removes a model that was uploaded for a plant that could not be made.
fn forget(hub: &Hub, uploaded: Option<String>) {
    if let Some(name) = uploaded {
        // Whoever has removed it meanwhile has done what was to be done.
        let _ = hub.catalog.remove(&name);
    }
}

/// A plant that is there, and what it still lacks.
struct Made {
    session: Arc<Session>,
    snapshot: PlantSnapshot,
    safety: v1::SafetyInfo,
    faults: Vec<v1::SavedFault>,
    fault_count: u64,
    run: Option<v1::RunInfo>,
    open_link: bool,
    channels: Option<v1::Channels>,
    /// The model, if it was not there before.
    uploaded: Option<String>,
    lose: Lose,
}

impl Made {
    /// The plant with its model and its numbers.
    fn new(hub: &Hub, id: String, record: v1::PlantRecord, lose: Lose) -> Result<Self, RpcError> {
        let v1::PlantRecord { plant, model, start_model, start_settings, channels, .. } = record;
        let snapshot = PlantSnapshot::from_bytes(&record.snapshot)?;
        let info = plant.ok_or_else(|| unusable("has no plant in it".to_owned()))?;
        let model = model.ok_or_else(|| unusable("has no model in it".to_owned()))?;
        checks::check_name("id", &id)?;
        let in_force = Arc::new(scene(hub, &model)?);
        let start_model = match &start_model {
            Some(model) => Arc::new(scene(hub, model)?),
            None => Arc::clone(&in_force),
        };
        let (start_model, is_new) = match hub.catalog.get(&info.model) {
            Ok(entry) if entry.model.digest() == start_model.digest() => (entry.model, false),
            Err(_) if !model.name.is_empty() => {
                checks::check_name("record.plant.model", &info.model)?;
                (start_model, true)
            }
            _ => (start_model, false),
        };
        let spare = |model: &Arc<Model>, settings| {
            let settings = settings::settings(settings, model, &hub.limits)?;
            Spare::new(Arc::clone(model), settings).map_err(|error| unusable(error.to_string()))
        };
        let start = Snapshot::from_bytes(&record.start_snapshot)?;
        let start = spare(&start_model, start_settings)?.restore(&start)?;
        let is_changed = in_force.digest() != start_model.digest();
        let in_force = if is_changed { in_force } else { start_model };
        let present = spare(&in_force, info.settings)?;
        let present = if record.faults.iter().any(is_change) {
            // The snapshot may be of a changed plant: until that is there, the plant rests nearby.
            let nearby = || start::initial_configuration(&in_force);
            let q = info.state.as_ref().map_or_else(nearby, |state| state.q.clone());
            let nearby = Initial::Projection { q, hold: Vec::new() };
            present.start(&nearby).map_err(|error| unusable(error.to_string()))?
        } else {
            present.restore(&snapshot.plant)?
        };
        let accuracy = info.accuracy.map(settings::accuracy_of);
        let expires = settings::expires(info.expires_s)?;
        let uploaded = is_new.then(|| info.model.clone());
        if let Some(name) = &uploaded {
            hub.catalog.insert(name, Arc::clone(start.model()))?;
        }
        let session = hub
            .insert(id, info.model, start, accuracy, expires)
            .inspect_err(|_| forget(hub, uploaded.clone()))?;
        let changed = info.parameters.into_iter().map(|p| (p.path, p.value)).collect();
        session.resume(present, changed);
        Ok(Self {
            session,
            snapshot,
            safety: info.safety.unwrap_or_default(),
            faults: record.faults,
            fault_count: record.fault_count,
            run: info.run,
            open_link: info.link_open,
            channels,
            uploaded,
            lose,
        })
    }

    /// Gives it its channels.
    fn with_channels(mut self, hub: &Hub) -> Result<Self, RpcError> {
        if let Some(channels) = self.channels.take()
            && let Err(fault) = self.session.set_channels(channels, &hub.limits)
        {
            (self.lose)("its channels are not restored", fault)?;
            self.snapshot.channels = None;
        }
        Ok(self)
    }

    /// Gives it its watchdogs, its faults and its state, and lets it run as it did.
    fn complete(mut self, hub: &Hub) -> Result<(), RpcError> {
        let session = &self.session;
        let v1::SafetyInfo { watchdogs, on_step_failure, frozen } =
            std::mem::take(&mut self.safety);
        let count = watchdogs.len();
        if let Err(fault) = protect(session, watchdogs, on_step_failure) {
            (self.lose)("its watchdogs are not restored", fault)?;
        }
        let faults = std::mem::take(&mut self.faults);
        let resumed = check_count(&faults, self.fault_count)
            .and_then(|()| session.resume_faults(faults, self.fault_count, &hub.limits));
        if let Err(fault) = resumed {
            (self.lose)("its faults are not restored", fault)?;
            self.snapshot.channels = None;
        }
        session.restore(self.snapshot.clone())?;
        if let Some(info) = self.run.take()
            && let Err(fault) = resume_run(hub, session, info)
        {
            (self.lose)("the plant does not run by itself", fault)?;
        }
        if let Some(trip) = frozen {
            if trip.watchdog as usize >= count {
                return Err(unusable("names a watchdog that the plant has not".to_owned()));
            }
            session.resume_frozen(trip);
        }
        Ok(())
    }
}

/// Lets a plant run that ran by itself; one that was paused stands still in lockstep.
fn resume_run(hub: &Hub, session: &Arc<Session>, info: v1::RunInfo) -> Result<(), RpcError> {
    if !info.running {
        session.pause();
        return Ok(());
    }
    let id = session.id().to_owned();
    run(hub, v1::RunRequest { id, settings: info.settings, steps: info.steps_left, wait: false })?;
    Ok(())
}

/// Puts the feedback in force that the plant had.
async fn resume_feedback(
    hub: &Arc<Hub>,
    session: &Arc<Session>,
    request: Option<v1::SetFeedbackRequest>,
    info: Option<v1::FeedbackInfo>,
    lose: &Lose,
) -> Result<(), RpcError> {
    let Some(info) = info else { return Ok(()) };
    let what = "its feedback is not restored";
    let Some(request) = request else {
        return lose(what, unusable("has a feedback of another time step".to_owned()));
    };
    let request = v1::SetFeedbackRequest { id: session.id().to_owned(), ..request };
    match set_feedback(hub, request).await {
        Ok(_) => {
            if let Some(step) = info.tripped_at_step {
                session.resume_trip(step, &info.tripped_by);
            }
            Ok(())
        }
        Err(fault) => lose(what, fault),
    }
}

fn is_change(saved: &v1::SavedFault) -> bool {
    let kind = saved.fault.as_ref().and_then(|fault| fault.kind.as_ref());
    matches!(kind, Some(v1::fault_spec::Kind::Parameters(_)))
}

/// Faults are counted from 1, and the next one has a number too.
fn check_count(faults: &[v1::SavedFault], count: u64) -> Result<(), RpcError> {
    let is_good = |fault: &v1::SavedFault| (1..=count).contains(&fault.id);
    match count < u64::MAX && faults.iter().all(is_good) {
        true => Ok(()),
        false => Err(unusable("numbers faults that it does not count".to_owned())),
    }
}

fn scene(hub: &Hub, model: &v1::Model) -> Result<Model, RpcError> {
    let format = v1::SceneFormat::Toml.into();
    let compiled = compile(&model.scene_toml, format, &HashMap::new(), &hub.limits)?;
    Ok(compiled.map_err(|error| unusable(error.to_string()))?.0)
}
