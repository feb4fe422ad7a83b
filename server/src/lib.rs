//! The plantd server: plant sessions and the services of `plantd.v1`.

pub mod link;
pub mod metrics;
pub mod session;
pub mod status;
pub mod watch;
