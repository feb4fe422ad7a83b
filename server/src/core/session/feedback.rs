//! The feedback of a session: put in force between two steps, and told to those who watch gains.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use tokio::sync::watch::Receiver;

use crate::core::feedback::active::{Feedback, FeedbackInfo, InForce};
use crate::core::feedback::law::Law;
use crate::core::feedback::regulator::{RegulatorError, Spec};
use crate::core::limits::LimitExceeded;
use crate::core::plant::core::Core;
use crate::core::plant::view::Mechanics;
use crate::core::session::shared::Session;

impl Session {
    /// Puts a feedback in force. `generation` is that of the mechanics for which its law was computed;
    /// true when it is to be computed anew.
    pub fn set_feedback(
        self: &Arc<Self>,
        mut feedback: Box<Feedback>,
        generation: u64,
        first_step: Option<u64>,
    ) -> (FeedbackInfo, bool) {
        let session = Arc::clone(self);
        let (info, is_outdated, _former) = self.with_core(move |core| {
            core.revision += 1;
            let present = core.plant.step_index();
            feedback.revision = core.revision;
            feedback.since_step = present;
            feedback.first_step = match feedback.law.end {
                Some(_) => first_step.unwrap_or(present),
                None => present,
            };
            let is_outdated = generation != core.changed.generation && !feedback.spec.is_fixed();
            feedback.generation = if is_outdated { generation } else { core.changed.generation };
            let info = feedback.info();
            session.gains.in_force.send_replace(Some(feedback.in_force()));
            let former = core.feedback.replace(feedback);
            session.tell_again(core);
            (info, is_outdated, former)
        });
        (info, is_outdated)
    }

    /// Takes the feedback away; false when there is none.
    pub fn clear_feedback(self: &Arc<Self>) -> bool {
        let session = Arc::clone(self);
        let former = self.with_core(move |core| {
            session.gains.in_force.send_replace(None);
            let former = core.feedback.take();
            if former.is_some() {
                session.tell_again(core);
            }
            former
        });
        former.is_some()
    }

    /// What the feedback's law is to be computed from anew, if its parameters have changed since.
    pub fn outdated_feedback(&self) -> Option<(Arc<Spec>, Mechanics)> {
        self.with_core(|core| {
            let feedback = core.feedback.as_ref()?;
            let is_outdated =
                feedback.generation != core.changed.generation && !feedback.spec.is_fixed();
            is_outdated.then(|| (Arc::clone(&feedback.spec), core.mechanics()))
        })
    }

    /// Puts a law in force that was computed anew; a failure leaves the former one in force and is
    /// shown. What belongs to a feedback that is gone is dropped.
    pub fn renew_feedback(
        self: &Arc<Self>,
        spec: &Arc<Spec>,
        generation: u64,
        outcome: Result<Law, RegulatorError>,
    ) {
        let (session, spec) = (Arc::clone(self), Arc::clone(spec));
        self.with_core(move |core| {
            let Some(feedback) = core.feedback.as_mut().filter(|f| Arc::ptr_eq(&f.spec, &spec))
            else {
                return;
            };
            feedback.generation = generation;
            match outcome {
                Ok(law) => {
                    core.revision += 1;
                    feedback.revision = core.revision;
                    feedback.since_step = core.plant.step_index();
                    feedback.law = Arc::new(law);
                    feedback.failure = None;
                }
                Err(error) => feedback.failure = Some(Arc::new(error)),
            }
            session.gains.in_force.send_replace(Some(feedback.in_force()));
            session.tell_again(core);
        });
    }

    /// Tells watchers the state of a plant at rest once more: its poles and gains are others now. One that runs by
    /// itself tells its next state soon.
    fn tell_again(&self, core: &mut Core) {
        if !core.own_loop.has_core {
            self.publish(core);
        }
    }

    /// The feedback in force. Does not touch the core.
    pub fn feedback_in_force(&self) -> Option<InForce> {
        self.gains.in_force.borrow().clone()
    }

    /// Claims the task of computing the feedback's law anew; false when somebody is at it.
    pub fn begin_recomputing(&self) -> bool {
        !self.gains.is_recomputing.swap(true, Ordering::AcqRel)
    }

    /// Gives that task back.
    pub fn end_recomputing(&self) {
        self.gains.is_recomputing.store(false, Ordering::Release);
    }

    /// Tells of the feedback's law and of each that replaces it.
    pub fn watch_gains(
        self: &Arc<Self>,
        watchers_max: u64,
    ) -> Result<Receiver<Option<InForce>>, LimitExceeded> {
        let (name, what) = ("watchers_per_plant", "watchers of gains");
        let session = Arc::clone(self);
        // In the core's hands counting and subscribing are one.
        self.with_core(move |_| {
            let count = session.gains.in_force.receiver_count() + 1;
            LimitExceeded::check(name, watchers_max, what, count)?;
            Ok(session.gains.in_force.subscribe())
        })
    }
}
