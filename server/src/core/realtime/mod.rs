//! Plants that run by themselves: by the wall clock, or as fast as possible.
//!
//! ```text
//!  driver ── slot (latest input wins) ──►  loop: due? ─► input ─► step ─► ring ── pump ──► watchers,
//!                                          │   one thread, many plants     │               driver
//!                        commands ── alarm ┘   (between two steps)         └── recorder
//! ```
//!
//! A loop owns the cores of its plants. It makes no system call but for the clock and its own sleep,
//! takes no lock and allocates nothing: inputs come through a triple buffer, states leave through a ring,
//! and what others want done with a core is done between two steps. `REALTIME.md` says what that is
//! worth on a given machine.

pub mod alarm;
pub mod clock;
pub mod input;
pub mod live;
pub mod loops;
pub(crate) mod permissions;
pub(crate) mod permit;
pub(crate) mod pump;
pub mod runner;
pub(crate) mod scheduler;
pub mod settings;
pub mod slot;
