//! What speaks to clients: the services of `plantd.v1`, the shared-memory link, recordings and saved
//! plants. Requests are checked and translated here; what they ask for is done by [`crate::core`].

pub mod admission;
mod analysis;
pub mod answers;
pub mod channels;
pub mod control;
pub mod convert;
mod derivatives;
pub mod drive;
pub mod ending;
pub(crate) mod feedback;
pub mod gate;
pub mod hub;
mod kalman;
pub mod link;
pub mod metrics_http;
pub mod model;
pub mod names;
pub mod observe;
mod optimize;
mod parts;
pub mod plant;
pub mod record;
pub mod recordings;
mod reference;
mod rollout;
pub(crate) mod run;
mod settle;
pub mod state;
pub mod status;
mod unfinished;
pub mod watch;
