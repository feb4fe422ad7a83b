//! What can go wrong with a domain.

use std::io;
use std::path::PathBuf;

use super::header::LAYOUT_VERSION;

/// Why the shared-memory domain cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DomainError {
    /// The root path cannot be made or read.
    #[error("root path `{path}` of the shared-memory link: {source}")]
    Root {
        /// Path.
        path: PathBuf,
        /// Cause.
        source: io::Error,
    },
    /// The root path is somebody else's, or open to others.
    #[error("root path `{path}` must belong to user {uid} and be closed to others (mode 0700)")]
    RootNotPrivate {
        /// Path.
        path: PathBuf,
        /// The user that runs this process.
        uid: u32,
    },
    /// The root path is a symbolic link: what it points to can be changed by others.
    #[error(
        "root path `{path}` of the shared-memory link is a symbolic link; name the directory itself"
    )]
    RootIsSymbolicLink {
        /// Path.
        path: PathBuf,
    },
    /// Another process keeps the root path for itself.
    #[error("root path `{path}` of the shared-memory link is locked by another process")]
    RootLocked {
        /// Path.
        path: PathBuf,
    },
    /// A segment is somebody else's, or open to others.
    #[error(
        "`{path}` must belong to user {uid} and be closed to others (mode 0600); it is not used"
    )]
    SegmentNotPrivate {
        /// Path.
        path: PathBuf,
        /// The user that runs this process.
        uid: u32,
    },
    /// A segment was cut off, extended or removed since the server made it.
    #[error(
        "`{path}` has {size} bytes, not the {expected} that the server has given it; open the link anew"
    )]
    SegmentSize {
        /// Path.
        path: PathBuf,
        /// Size, bytes.
        size: u64,
        /// What the server has made, bytes.
        expected: u64,
    },
    /// The root path is no absolute path that iceoryx2 can use.
    #[error("root path `{path}` must be absolute and at most {max} bytes long")]
    RootPath {
        /// Path.
        path: PathBuf,
        /// Limit.
        max: usize,
    },
    /// Too little shared memory.
    #[error(
        "{directory} has {free} bytes free; the shared-memory link needs {needed} (in a container: raise --shm-size)"
    )]
    SharedMemoryFull {
        /// Where shared memory lives.
        directory: &'static str,
        /// Free bytes.
        free: u64,
        /// Needed bytes.
        needed: u64,
    },
    /// The plant's id cannot be part of a service name.
    #[error("`{plant}` is no plant id: 1 to 63 lower-case letters, digits and hyphens")]
    PlantId {
        /// Id as given.
        plant: String,
    },
    /// No server has opened the link of this plant.
    #[error("plant `{plant}` has no open link under `{root}`")]
    NotOpen {
        /// Plant.
        plant: String,
        /// Root path.
        root: PathBuf,
    },
    /// The services exist with another layout.
    #[error(
        "the link of plant `{plant}` has another layout than version {LAYOUT_VERSION}: server and client are of different versions"
    )]
    OtherLayout {
        /// Plant.
        plant: String,
    },
    /// Another server has opened the link of a plant with this id.
    #[error("another server has opened the link of this plant under the same root path")]
    ServedElsewhere,
    /// The link has no room for another driver.
    #[error("as many drivers as the link has room for are connected to it already")]
    TooManyDrivers,
    /// iceoryx2 failed.
    #[error("shared-memory link, {what}: {cause}")]
    Transport {
        /// What was being done.
        what: &'static str,
        /// iceoryx2's own error.
        cause: String,
    },
}
