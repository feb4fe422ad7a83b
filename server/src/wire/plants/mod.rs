//! The services of plants: steps, streams, channels, recordings; and plants that survive their server.

pub mod adopt;
pub(crate) mod change;
pub mod channels;
pub(crate) mod commands;
pub(crate) mod computed;
pub mod drive;
pub(crate) mod feedback;
pub(crate) mod hold;
pub mod plant;
pub(crate) mod record;
pub mod recordings;
pub(crate) mod run;
pub mod server;
pub mod state;
pub(crate) mod step_many;
pub(crate) mod travel;
pub mod watch;
