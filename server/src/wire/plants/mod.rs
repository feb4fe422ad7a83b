//! The services of plants: steps, streams, channels, recordings; and plants that survive their server.

pub(crate) mod change;
pub mod channels;
pub(crate) mod commands;
pub(crate) mod computed;
pub mod drive;
pub(crate) mod feedback;
pub(crate) mod hold;
pub mod plant;
pub mod recordings;
pub(crate) mod run;
pub mod state;
pub(crate) mod step_many;
pub mod watch;
