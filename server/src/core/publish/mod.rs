//! What a plant publishes after each step, and how it reaches those who watch.

pub(crate) mod feed;
pub mod frame;
pub(crate) mod relay;
pub(crate) mod report;
pub mod ring;
pub mod subscription;
pub(crate) mod watchers;
