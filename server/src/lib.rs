//! The plantd server: plant sessions and the services of `plantd.v1`.
//!
//! ```text
//!  grpc/* (requests in, messages out)        link/* (shared memory)
//!            |                                     |
//!            +------------ session: one plant, one lease, many watchers
//!            |                  |
//!         workers          watch: latest frame wins, per watcher
//! ```
//!
//! [`serve::run`] is the whole server; [`daemon`] makes a process of it.

pub mod admission;
pub mod catalog;
pub mod channels;
pub mod cli;
pub mod config;
pub mod connection;
pub mod convert;
pub mod daemon;
pub mod feedback;
pub mod frame;
pub mod grpc;
pub mod hub;
pub mod limits;
pub mod link;
pub mod listen;
mod memory;
pub mod metrics;
pub mod metrics_http;
pub mod modes;
pub mod names;
pub mod parameters;
pub mod priority;
pub mod realtime;
pub mod record;
pub mod regulator;
pub mod ring;
pub mod serve;
pub mod session;
pub mod state;
pub mod status;
pub mod watch;
pub mod workers;
