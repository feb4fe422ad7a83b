//! What stands around all services: who may call, how large messages may be, the pages of plants and metrics.

pub mod admission;
pub mod auth;
pub mod certificate;
pub mod ending;
pub mod gate;
pub(crate) mod methods;
pub mod metrics_http;
pub mod observe;
pub mod page;
pub(crate) mod parts;
pub(crate) mod trace;
pub(crate) mod unfinished;
