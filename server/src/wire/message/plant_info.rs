//! A plant and its feedback as messages.

use std::sync::Arc;
use std::time::Duration;

use plantd_proto::v1;

use crate::core::driver::DriverKind;
use crate::core::feedback::active::{FeedbackInfo, Mode};
use crate::core::feedback::regulator::RegulatorError;
use crate::core::plant::view::View;
use crate::core::session::shared::Session;
use crate::wire::message::run_info::{run_info, safety_info};
use crate::wire::message::{settings, states};
use crate::wire::status::RpcError;

/// Instructions of a step up to which a Step call begins at once instead of on a worker: about 0.3 ms.
pub(crate) const INLINE_INSTRUCTIONS_MAX: f64 = 1e6;
/// How long it goes on there: not much longer than the way to a worker and back.
pub(crate) const INLINE_TIME_MAX: Duration = Duration::from_micros(300);

/// A plant as a message; which server has it says [`Hub::info`](crate::wire::shared::hub::Hub::info).
pub(crate) fn plant_info(session: &Session, view: View) -> v1::PlantInfo {
    v1::PlantInfo {
        id: session.id().to_owned(),
        model: session.model_name().to_owned(),
        settings: Some(settings::settings_message(&view.settings)),
        state: Some(states::shown(&view.frame.published())),
        driver: session.driver().map_or("", DriverKind::as_str).to_owned(),
        link_open: session.link_open(),
        feedback: view.feedback.map(feedback_info),
        accuracy: session.accuracy().map(settings::accuracy),
        run: Some(run_info(session)),
        parameters: settings::parameters(&view.parameters),
        safety: safety_info(&view.safety, view.frozen, session.model()),
        expires_s: expires_s(session),
        ..Default::default()
    }
}

/// Seconds without use after which the plant is deleted; 0 for never.
pub(crate) fn expires_s(session: &Session) -> f64 {
    session.life().expires().map_or(0.0, |expires| expires.as_secs_f64())
}

/// What a client is told of a feedback.
pub(crate) fn feedback_info(info: FeedbackInfo) -> v1::FeedbackInfo {
    let FeedbackInfo { mode, revision, first_step, horizon, tripped, failure } = info;
    let mode = match mode {
        Mode::WatchOnly => v1::FeedbackMode::WatchOnly,
        Mode::Replace => v1::FeedbackMode::Replace,
        Mode::Add => v1::FeedbackMode::Add,
        Mode::Guard => v1::FeedbackMode::Guard,
    };
    let (tripped_at_step, tripped_by) = tripped.unzip();
    v1::FeedbackInfo {
        mode: mode.into(),
        revision,
        first_step,
        horizon: horizon as u32,
        tripped_at_step,
        tripped_by: tripped_by.unwrap_or_default(),
        failure: failure.map(failure_message),
    }
}

pub(crate) fn failure_message(error: Arc<RegulatorError>) -> v1::Failure {
    RpcError::from(Arc::unwrap_or_clone(error)).into()
}
