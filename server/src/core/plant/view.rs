//! What is shown of a plant, and what it needs to go on.

use std::sync::Arc;

use plantd_models::parameters::Parameters;
use plantd_models::{Model, Settings, Snapshot};

use crate::core::channels::pipeline::ChannelMemory;
use crate::core::feedback::active::FeedbackInfo;
use crate::core::plant::watchdog::{Safety, Trip};
use crate::core::publish::frame::Frame;

/// Everything that a session's plant needs to go on bit for bit.
#[derive(Clone, Debug, PartialEq)]
pub struct PlantSnapshot {
    /// The plant.
    pub plant: Snapshot,
    /// What is under way in its channels and faults, if it has any.
    pub channels: Option<ChannelMemory>,
}

/// A model with settings, and which of a plant's it is: the number goes up with each change.
#[derive(Clone)]
pub struct Mechanics {
    /// The model.
    pub model: Arc<Model>,
    /// The settings.
    pub settings: Settings,
    /// Number of changes that led to them.
    pub generation: u64,
}

/// A plant as it is, to be shown.
pub struct View {
    /// State and last step.
    pub frame: Frame,
    /// Settings in force.
    pub settings: Settings,
    /// Feedback.
    pub feedback: Option<FeedbackInfo>,
    /// Numbers of the scene that were changed.
    pub parameters: Arc<Parameters>,
    /// What protects it.
    pub safety: Safety,
    /// The bound because of which it stands still.
    pub frozen: Option<Trip>,
}
