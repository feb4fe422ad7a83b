//! Workers for everything that computes longer than a step: threads of the server's own, as many at
//! work as configured, behind a bounded queue, and told to stop when nobody waits for the result any
//! more.
//!
//! ```text
//!  start ──► queue: connections and lanes take turns ──► turns, `count` of them ──► threads
//!              ▲                                     │
//!              └──── a job that has had its time ◄───┘
//! ```
//!
//! Whoever computes has a turn. A job that asks [`pool::Abandoned::check`] now and then, as every long one
//! must, gives its turn to the next in the queue when it has had it for 20 ms, and queues again: however
//! many long computations there are, a short one waits for no more than one such time for each connection
//! before it. What a job has begun stays on the stack of its thread meanwhile; there are a few more
//! threads than turns for that. A job in parts (`in_parts`) keeps no thread.
//!
//! A job that keeps its turn for longer, because it waits for a plant or cannot be interrupted, keeps it
//! from its own connection alone: others get a turn besides, and the system shares the processors out.
//!
//! Threads have the priority of their pool ([`crate::core::priority`]), and so have the threads that a job
//! starts.

/// Target of the spans that are traces: of calls and computations.
pub(crate) const SPANS: &str = "plantd::trace";

pub mod pool;
pub(crate) mod queue;
