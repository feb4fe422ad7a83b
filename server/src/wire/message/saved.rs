//! A session as a message from which it can be made again.

use std::sync::Arc;

use plantd_models::parameters::Parameters;
use plantd_models::{Model, Plant, Snapshot, SnapshotError};
use plantd_proto::v1;
use prost::Message as _;
use v1::set_feedback_request::Reference;

use crate::core::channels::fault::{FaultMemory, Injected};
use crate::core::channels::pipeline::ChannelMemory;
use crate::core::feedback::active::{GuardBound, InForce, Trip};
use crate::core::feedback::regulator::Spec;
use crate::core::plant::view::PlantSnapshot;
use crate::core::session::shared::Session;
use crate::wire::message::declare::origin;
use crate::wire::message::plant_info::{expires_s, feedback_info};
use crate::wire::message::run_info::safety_info;
use crate::wire::message::{settings, states};

impl PlantSnapshot {
    /// Encodes: a plant without channels as itself, else a `ChannelSnapshot`.
    pub fn to_bytes(&self) -> Vec<u8> {
        let plant = self.plant.to_bytes();
        match &self.channels {
            None => plant,
            Some(memory) => {
                let channels = Some(memory_message(memory));
                v1::ChannelSnapshot { plant, channels }.encode_to_vec()
            }
        }
    }

    /// Decodes.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, SnapshotError> {
        match v1::ChannelSnapshot::decode(bytes) {
            Ok(v1::ChannelSnapshot { plant, channels }) if !plant.is_empty() => {
                let channels = channels.map(memory_of);
                Ok(Self { plant: Snapshot::from_bytes(&plant)?, channels })
            }
            _ => Ok(Self { plant: Snapshot::from_bytes(bytes)?, channels: None }),
        }
    }
}

fn memory_message(memory: &ChannelMemory) -> v1::ChannelMemory {
    let fault = |memory: &FaultMemory| {
        let FaultMemory { id, fault, numbers, active, beginnings } = memory.clone();
        v1::FaultMemory { id, fault, numbers, active, beginnings }
    };
    v1::ChannelMemory {
        declared: memory.declared,
        numbers: memory.numbers.clone(),
        faults: memory.faults.iter().map(fault).collect(),
    }
}

fn memory_of(memory: v1::ChannelMemory) -> ChannelMemory {
    let fault = |memory: v1::FaultMemory| {
        let v1::FaultMemory { id, fault, numbers, active, beginnings } = memory;
        FaultMemory { id, fault, numbers, active, beginnings }
    };
    let v1::ChannelMemory { declared, numbers, faults } = memory;
    ChannelMemory { declared, numbers, faults: faults.into_iter().map(fault).collect() }
}

impl Session {
    /// Everything from which the plant can be made again but its models, and the model in force without
    /// what faults change.
    pub fn saved(&self) -> (v1::PlantRecord, Arc<Model>) {
        // No more than copies in the core's hands: a plant may be running.
        let (base, view, snapshot, feedback, channels, fault_count) = self.with_core(move |core| {
            let feedback = core.feedback.as_ref();
            let feedback =
                feedback.map(|f| (Arc::clone(&f.spec), f.in_force(), f.guard.clone(), f.info()));
            let channels = core.channels.as_ref().map(|channels| {
                let faults = channels.faults.iter().map(saved_fault).collect::<Vec<_>>();
                (origin::<v1::Channels>(&channels.declared), faults)
            });
            (core.base(), core.view(), core.snapshot(), feedback, channels, core.faults)
        });
        let rotations = states::rotations(self.model());
        let time_step_s = base.settings.time_step_s;
        let (feedback, feedback_info) = feedback
            .map(|(spec, law, guard, info)| {
                let info = feedback_info(info);
                (feedback_request(&spec, time_step_s, &law, &guard, &info, &rotations), info)
            })
            .unzip();
        let info = v1::PlantInfo {
            id: self.id().to_owned(),
            model: self.model_name().to_owned(),
            settings: Some(settings::settings_message(&base.settings)),
            state: Some(states::shown(&view.frame.published())),
            link_open: self.keeps_link(),
            feedback: feedback_info,
            accuracy: self.accuracy().map(settings::accuracy),
            parameters: settings::parameters(&base.parameters),
            safety: safety_info(&view.safety, view.frozen, self.model()),
            expires_s: expires_s(self),
            ..Default::default()
        };
        let (declared, faults) = channels.unzip();
        let fault = |(id, fault, start_step): (u64, Arc<v1::FaultSpec>, u64)| v1::SavedFault {
            id,
            fault: Some(Arc::unwrap_or_clone(fault)),
            start_step,
        };
        let record = v1::PlantRecord {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            plant: Some(info),
            model_digest: base.model.digest(),
            snapshot: snapshot.to_bytes(),
            start_snapshot: self.start().to_bytes(),
            start_settings: Some(settings::settings_message(&self.start_settings())),
            feedback: feedback.flatten(),
            channels: declared.map(Arc::unwrap_or_clone),
            faults: faults.into_iter().flatten().map(fault).collect(),
            fault_count,
            ..Default::default()
        };
        (record, base.model)
    }

    /// Puts a plant of the session's model in its place, with the numbers that were changed in it.
    pub fn resume(self: &Arc<Self>, plant: Plant, parameters: Parameters) {
        self.with_core(move |core| {
            plant.hold_input(&mut core.last.input);
            core.changed.parameters = Arc::new(parameters);
            core.plant = plant;
        });
    }

    /// Lets the plant stand still where a watchdog had stopped it.
    pub fn resume_frozen(&self, trip: v1::WatchdogTrip) {
        let v1::WatchdogTrip { watchdog, value, step } = trip;
        self.with_core(move |core| core.freeze(watchdog as usize, value, step));
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

fn saved_fault(fault: &Injected) -> (u64, Arc<v1::FaultSpec>, u64) {
    (fault.id, origin(&fault.given), fault.schedule.start)
}

/// The request that puts a feedback's present law in force: about a point as it stands; along a trajectory
/// by computing it again, if it still can be.
fn feedback_request(
    spec: &Spec,
    time_step_s: f64,
    in_force: &InForce,
    guard: &[GuardBound],
    info: &v1::FeedbackInfo,
    rotations: &[u32],
) -> Option<v1::SetFeedbackRequest> {
    if let Some(given) = &spec.given {
        let request = v1::SetFeedbackRequest {
            first_step: Some(info.first_step),
            ..v1::SetFeedbackRequest::clone(&origin(given))
        };
        return (spec.time_step_s == time_step_s).then_some(request);
    }
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

fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}
