//! The shared-memory link: how a driver on the same machine steps a plant without gRPC.
//!
//! Each open plant has four iceoryx2 services of the same [`Domain`], named after the plant's id:
//!
//! | name | pattern | from | to |
//! | --- | --- | --- | --- |
//! | `plantd/4/<plant>/input` | publish-subscribe | drivers | server |
//! | `plantd/4/<plant>/input` | event | drivers | server |
//! | `plantd/4/<plant>/state` | publish-subscribe | server | drivers |
//! | `plantd/4/<plant>/state` | event | server | drivers |
//!
//! The `4` is [`LAYOUT_VERSION`]. A message is one [`Header`] (the user header of the sample) and a
//! slice of `f64`: the input `u` one way, `(q, p, v, multipliers, outputs, lost)` the other way.
//!
//! # Conversation
//!
//! 1. The driver sends [`Kind::Attach`] with a random `driver` number of its own, its process id and
//!    its process's start time. The server takes the plant's lease and answers [`Kind::Attached`]
//!    with its own random `server` number and the current state, or [`Kind::Failure`] with
//!    [`Code::LeaseHeld`].
//! 2. For each step the driver sends one [`Kind::Input`] with `sequence` one higher than the last
//!    (the first is 1), and waits for [`Kind::State`] or [`Kind::Failure`] with the same `sequence`.
//!    A failed step leaves the plant as it was, and the conversation goes on.
//! 3. The driver sends [`Kind::Detach`], or dies: the server notices and takes the lease back.
//!
//! While the plant runs by itself (`Run` of `PlantService`), inputs and states go their own ways: an input
//! is not answered, the latest acts from the plant's next step on; each state is sent as a
//! [`Kind::State`] with [`LIVE`] set in `code`, the latest wins. A paused plant in lockstep answers an
//! input when it goes on.
//!
//! The server broadcasts; a driver ignores what carries another `driver` number than its own, except
//! [`Kind::Closed`].
//!
//! # Waking up
//!
//! Each message says how long its sender will poll for what comes next (`stamp_ns + poll_ns`, on the
//! system's monotonic clock); after that it sleeps on its event listener. Who has *sent* a message
//! looks at the clock, and notifies if the receiver's polling time is over. A receiver polls once
//! more after its time is over, before it sleeps. So no wake-up is lost, and two polling parties
//! exchange no events.

mod domain;
mod endpoint;
mod header;
mod process;

pub use domain::{
    Bell, Channel, Direction, Domain, DomainError, LinkNode, LinkServices, SHARED_MEMORY_DIRECTORY,
    default_root,
};
pub use endpoint::{Endpoint, Message, Wait};
pub use header::{
    Code, Field, HEADER_FIELDS, Header, Holder, Kind, LAYOUT_VERSION, LIVE, LIVE_INPUT_LATE,
    LIVE_INPUT_SAFE, MAGIC, POLL_FOREVER_NS, SCHEMA_HASH,
};
pub use process::{ProcessIdentity, monotonic_ns, random_instance};
