//! What stands in a recording, from what the plant has left.

use plantd_models::{Plant, State};
use plantd_proto::v1;

use crate::core::parameters::Parameters;
use crate::core::plant::mark::Mark;
use crate::core::publish::frame::Frame;
use crate::core::session::shared::Session;
use crate::wire::message::report::report_message;
use crate::wire::message::run_info::run_info;
use crate::wire::message::{models, settings, states};

/// The plant at the beginning of a recording.
pub(super) fn plant_record(session: &Session, mark: &Mark, plant: &mut Plant) -> v1::PlantRecord {
    let state = states::plant_state(plant);
    let (model, plan) = (plant.model(), String::new());
    let info = v1::PlantInfo {
        id: session.id().to_owned(),
        model: session.model_name().to_owned(),
        settings: Some(settings::settings_message(plant.settings())),
        state: Some(state),
        accuracy: session.accuracy().map(settings::accuracy),
        parameters: all_parameters(&mark.announced.unchanged, &mark.parameters),
        run: Some(run_info(session)),
        ..Default::default()
    };
    v1::PlantRecord {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        plant: Some(info),
        model_digest: model.digest(),
        model: Some(v1::Model { plan, ..models::model(session.model_name(), false, model, true) }),
        snapshot: mark.snapshot.to_bytes(),
        outputs: session.channels().0.names.clone(),
        ..Default::default()
    }
}

/// The plant at the beginning of a recording, as a frame without a step before it.
pub(super) fn first_frame(plant: &mut Plant) -> Frame {
    let mut input = vec![0.0; plant.model().dimensions().input()];
    plant.hold_input(&mut input);
    let state = State {
        step: plant.step_index(),
        q: plant.q().to_vec(),
        p: plant.p().to_vec(),
        v: plant.v().to_vec(),
        multipliers: plant.multipliers().to_vec(),
    };
    Frame {
        state,
        time_s: plant.time_s(),
        velocity: plant.velocity(),
        input,
        time_step_s: plant.settings().time_step_s,
        model_digest: plant.model().digest(),
        ..Frame::default()
    }
}

/// All numbers that are or were changed.
pub(super) fn all_parameters(unchanged: &Parameters, changed: &Parameters) -> Vec<v1::Parameter> {
    let mut all = unchanged.clone();
    all.extend(changed.iter().map(|(path, number)| (path.clone(), *number)));
    settings::parameters(&all)
}

/// Puts a frame into a message, whose memory is kept.
pub(super) fn fill(record: &mut v1::StepRecord, frame: &Frame) {
    let state = record.state.get_or_insert_default();
    state.step = frame.state.step;
    state.time_s = frame.time_s;
    for (target, source) in [
        (&mut state.q, &frame.state.q),
        (&mut state.p, &frame.state.p),
        (&mut state.v, &frame.state.v),
        (&mut state.multipliers, &frame.state.multipliers),
        (&mut state.velocity, &frame.velocity),
        (&mut record.u, &frame.input),
        (&mut record.driver, &frame.driver_input),
        (&mut record.impulse, &frame.impulse),
    ] {
        target.clone_from(source);
    }
    record.outputs = states::outputs(&frame.outputs, &frame.lost);
    record.report = Some(report_message(&frame.report));
    record.timing = states::step_timing(&frame.timing);
}
