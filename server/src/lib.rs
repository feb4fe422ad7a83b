//! The plantd server: plant sessions and the services of `plantd.v1`.
//!
//! ```text
//!  serve, daemon, cli, config: a process
//!            |
//!  wire: requests in, messages out; shared memory; recordings; saved plants
//!            |
//!  core: session (one plant, one lease, many watchers), channels, loops, feedback, workers
//! ```
//!
//! From the ground up, each folder knows only those before it: `core` (its own files), `core/metrics`, `publish`,
//! `workers`, `channels`, `feedback`, `plant`, `realtime`, `session`; `wire` (its own files), `wire/edge`,
//! `message`, `link`, `record`, `shared`, `models`, `control`, `plants`; the files beside this one.
//!
//! [`serve::run`] is the whole server; [`daemon`] makes a process of it.

pub mod cli;
pub mod config;
pub mod core;
pub mod daemon;
pub mod listen;
mod memory;
mod scenes;
pub mod serve;
#[cfg(feature = "otlp")]
mod telemetry;
pub mod tls;
pub mod wire;
