//! A session as a message from which it can be made again.

use std::sync::Arc;

use plantd_models::{Model, Plant};
use plantd_proto::v1;
use v1::set_feedback_request::Reference;

use super::Session;
use crate::convert;
use crate::feedback::{GuardBound, InForce, Trip};
use crate::parameters::Parameters;

impl Session {
    /// Everything from which the plant can be made again but its models, and the model in force.
    pub fn saved(&self) -> (v1::PlantRecord, Arc<Model>) {
        // No more than copies in the core's hands: a plant may be running.
        let (mechanics, snapshot, state, parameters, feedback, channels) =
            self.with_core(move |core| {
                let feedback = core.feedback.as_ref();
                let feedback = feedback.map(|f| (f.in_force(), f.guard.clone(), f.info()));
                let channels =
                    core.channels.as_ref().map(|channels| Arc::clone(&channels.declared));
                let (mechanics, snapshot) = (core.mechanics(), core.plant.snapshot());
                let parameters = Arc::clone(&core.parameters);
                (mechanics, snapshot, core.state(), parameters, feedback, channels)
            });
        let rotations = convert::rotations(&self.model);
        let (feedback, feedback_info) = feedback
            .map(|(law, guard, info)| (feedback_request(&law, &guard, &info, &rotations), info))
            .unzip();
        let info = v1::PlantInfo {
            id: self.id.clone(),
            model: self.model_name.clone(),
            settings: Some(convert::settings_message(&mechanics.settings)),
            state: Some(convert::state(&state.0, state.1)),
            link_open: self.link_open(),
            feedback: feedback_info,
            accuracy: self.accuracy,
            parameters: convert::parameters(&parameters),
            ..Default::default()
        };
        let record = v1::PlantRecord {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            plant: Some(info),
            model_digest: mechanics.model.digest(),
            snapshot: snapshot.to_bytes(),
            start_snapshot: self.start.to_bytes(),
            start_settings: Some(convert::settings_message(&self.start_settings)),
            feedback: feedback.flatten(),
            channels: channels.map(Arc::unwrap_or_clone),
            ..Default::default()
        };
        (record, mechanics.model)
    }

    /// Puts a plant of the session's model in its place, with the numbers that were changed in it.
    pub fn resume(self: &Arc<Self>, plant: Plant, parameters: Parameters) {
        self.with_core(move |core| {
            plant.hold_input(&mut core.input);
            core.parameters = Arc::new(parameters);
            core.plant = plant;
        });
    }

    /// Notes that the feedback's watchdog had taken over.
    pub fn resume_trip(&self, step: u64, entry: &str) {
        let entry = entry.to_owned();
        self.with_core(move |core| {
            let Some(feedback) = &mut core.feedback else { return };
            let bound = feedback.guard.iter().position(|bound| bound.name == entry);
            feedback.tripped = bound.map(|bound| Trip { step, bound });
        });
    }
}

/// The request that puts a feedback's present law in force as it stands; none for a law along a
/// trajectory.
fn feedback_request(
    in_force: &InForce,
    guard: &[GuardBound],
    info: &v1::FeedbackInfo,
    rotations: &[u32],
) -> Option<v1::SetFeedbackRequest> {
    if in_force.law.end.is_some() {
        return None;
    }
    let finite = |value: f64| value.is_finite().then_some(value);
    let bound = |bound: &GuardBound| v1::Bound {
        entry: bound.name.clone(),
        min: finite(bound.min),
        max: finite(bound.max),
    };
    Some(v1::SetFeedbackRequest {
        reference: Some(Reference::Gain(in_force.gain(0, rotations))),
        mode: info.mode,
        guard: guard.iter().map(bound).collect(),
        ..Default::default()
    })
}
