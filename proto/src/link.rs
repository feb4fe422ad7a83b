//! The shared-memory link: how a driver on the same machine steps a plant without gRPC.
//!
//! Each start of a server has a [`Domain`] of its own under the server's root path, and a plant's open
//! link four iceoryx2 services in it, named after the plant's id:
//!
//! | name | pattern | from | to |
//! | --- | --- | --- | --- |
//! | `plantd/5/<plant>/input` | publish-subscribe | drivers | server |
//! | `plantd/5/<plant>/input` | event | drivers | server |
//! | `plantd/5/<plant>/state` | publish-subscribe | server | drivers |
//! | `plantd/5/<plant>/state` | event | server | drivers |
//!
//! The `5` is [`LAYOUT_VERSION`]. A message is one [`Header`] (the user header of the sample) and a
//! slice of `f64`: the input `u` one way, `(q, p, v, multipliers, velocity, outputs, lost)` the other way.
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
//! # Where a link is
//!
//! The file `<root>/<plant>.link` names the domain: six hexadecimal digits, a directory of that name under
//! the root, and the prefix `plantd5_<domain>_` of the segments in shared memory. Further lines give the
//! sizes of the segments that the server has made for it. The root belongs to one user and is closed to
//! others, and so are the segments; both is looked at before a segment is mapped. What other users put
//! into shared memory under names of the domain is not used: they cannot know the names that will be.
//!
//! A process of the same user can do all that the server can, end it too. If it cuts off a segment that
//! is mapped, the next access kills the process (SIGBUS), driver or server; if it overwrites one, the
//! library may panic, which ends the link and not the server, or read beyond the segment.
//!
//! # Who dies
//!
//! The server keeps a lock (`flock`) of the domain's directory, and each driver one of a file in it. The
//! kernel takes the locks from a process that dies, at any place of what it was doing. A domain without
//! locks is removed whole: by the last one who leaves it in good order, or when the next server starts.
//! So nothing that a killed server has left, half made or broken, is ever opened by another one. What
//! killed drivers leave in the domain of a living server, its housekeeping removes.
//!
//! A driver whose server has died makes a new connection; it finds the next server by the link file. A
//! server with a state directory opens the links again that were open when the last one was killed or
//! ended; without one there are no plants, and so no links.
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
mod error;
mod header;
mod process;
mod root;
mod segments;

pub use domain::{Bell, Channel, Direction, Domain, LinkNode, LinkServices, default_root};
pub use endpoint::{Endpoint, Message, Wait};
pub use error::DomainError;
pub use header::{
    Code, Field, HEADER_FIELDS, Header, Holder, Kind, LAYOUT_VERSION, LIVE, LIVE_INPUT_LATE,
    LIVE_INPUT_SAFE, MAGIC, POLL_FOREVER_NS, SCHEMA_HASH,
};
pub use process::{ProcessIdentity, monotonic_ns, random_instance};
pub use segments::{Leftovers, SHARED_MEMORY_DIRECTORY};
