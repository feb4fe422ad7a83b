//! Why a plant is not driven.

use plantd_models::StepError;

use crate::core::plant::watchdog::Trip;

/// Why a lease's operation failed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DriveError {
    /// The plant was deleted.
    #[error("the plant was deleted")]
    Closed,
    /// The step failed; the plant is where it was.
    #[error(transparent)]
    Step(#[from] StepError),
    /// The plant takes its steps in a loop of its own.
    #[error("the plant runs by itself")]
    Running,
    /// The plant is paused, and this driver waits until it may go on.
    #[error("the plant is paused")]
    Paused,
    /// The plant keeps a speed, and the next step is due later, ns on the monotonic clock.
    #[error("the next step is due later")]
    NotDue(u64),
    /// A watchdog holds the plant.
    #[error("a watchdog holds the plant")]
    Frozen(Trip),
    /// The lease was taken away.
    #[error("the lease was taken away")]
    Revoked,
}
