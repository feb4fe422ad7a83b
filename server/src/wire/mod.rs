//! What speaks to clients: the services of `plantd.v1`, the shared-memory link, recordings and saved
//! plants. Requests are checked and translated here; what they ask for is done by [`crate::core`].

pub mod answers;
pub mod control;
pub mod edge;
pub mod link;
pub mod message;
pub(crate) mod model_errors;
pub mod models;
pub mod names;
pub mod plants;
pub mod record;
pub(crate) mod refusals;
pub mod shared;
pub mod status;
