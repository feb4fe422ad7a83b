//! Recordings: what plants do, in files from which it can be done again.
//!
//! ```text
//!  plant ── ring of steps, marks ──► recorder, a thread ──► NAME.mcap
//! ```
//!
//! While a plant is recorded, its steps write into the ring. Those that somebody asks for, one by one, wait
//! where the recorder does not follow; those of a plant that runs by itself do not, and the recorder counts
//! what it has lost and says so in the file. What happens between steps (a reset, changed parameters) comes
//! as marks, each with a snapshot; so do checkpoints, every few seconds. A replay begins at any mark that
//! has one.
//!
//! For players the recorder adds pictures of some steps: where frames and lines are, and signals by their
//! names. They give way where it is behind.

pub mod archive;
pub mod directory;
pub(crate) mod file;
pub(crate) mod folders;
pub(crate) mod message;
pub(crate) mod picture;
pub(crate) mod progress;
pub(crate) mod recorder;
pub(crate) mod scene;
pub(crate) mod schema;
pub(crate) mod signals;
pub(crate) mod work;
