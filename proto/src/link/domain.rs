//! The iceoryx2 domain of plantd: one root path and one file-name prefix, apart from every other
//! user of iceoryx2 on the machine.

use std::fs::{self, DirBuilder};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use iceoryx2::prelude::{
    AttributeVerifier, CallbackProgression, Config, FileName, LogLevel, Node, NodeBuilder,
    NodeName, SemanticString as _, ServiceName, SignalHandlingMode, ipc, set_log_level_from_env_or,
};
use iceoryx2::service::attribute::{AttributeKey, AttributeValue};
use iceoryx2::service::builder::{event, publish_subscribe};
use iceoryx2::service::port_factory;

use super::header::{FNV_BASIS, Header, LAYOUT_VERSION, SCHEMA_HASH, fnv1a};

/// Where the system keeps shared memory.
pub const SHARED_MEMORY_DIRECTORY: &str = "/dev/shm";

/// Shared memory that must be free before a link is opened, beside what its messages need, bytes:
/// writing to shared memory that is full kills the process.
const SHARED_MEMORY_FREE_MIN: u64 = 8 << 20;

/// Longest root path, bytes: a socket's path has 107, of which the prefix, a 128-bit number in
/// decimal, a suffix and a separator take the rest.
const ROOT_LENGTH_MAX: usize = 107 - PREFIX_LENGTH - 39 - ".event".len() - 1;

/// Length of [`Domain::prefix`].
const PREFIX_LENGTH: usize = "plantd4_00000000_".len();

/// Drivers, connected or trying to, that one link has room for.
const DRIVERS_MAX: usize = 8;

/// Messages that wait for a slow receiver; more overwrite the oldest.
const BUFFER_SIZE: usize = 8;

/// Messages that a receiver may hold at a time: the one in use and the one just received.
const BORROWED_MAX: usize = 2;

/// Processes that one link has room for: drivers, and servers that follow one another.
const NODES_MAX: usize = DRIVERS_MAX + 4;

/// Publish-subscribe service of a link.
pub type Channel = port_factory::publish_subscribe::PortFactory<ipc::Service, [f64], Header>;
/// Event service of a link.
pub type Bell = port_factory::event::PortFactory<ipc::Service>;

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

/// The iceoryx2 domain of plantd under one root path.
#[derive(Clone, Debug)]
pub struct Domain {
    config: Config,
    root: PathBuf,
}

/// Root path when none is given: `$XDG_RUNTIME_DIR/plantd`, or `/tmp/plantd-<uid>` without it.
pub fn default_root() -> PathBuf {
    match std::env::var_os("XDG_RUNTIME_DIR").filter(|dir| Path::new(dir).is_absolute()) {
        Some(dir) => Path::new(&dir).join("plantd"),
        None => PathBuf::from(format!("/tmp/plantd-{}", rustix::process::getuid().as_raw())),
    }
}

impl Domain {
    /// The domain under `root`, which is made (mode 0700) when it does not exist.
    pub fn create(root: &Path) -> Result<Self, DomainError> {
        let domain = Self::configure(root)?;
        let error = |source| DomainError::Root { path: root.to_owned(), source };
        DirBuilder::new().recursive(true).mode(0o700).create(root).map_err(error)?;
        domain.check_root()?;
        Ok(domain)
    }

    /// The domain under `root`, which must exist.
    pub fn open(root: &Path) -> Result<Self, DomainError> {
        let domain = Self::configure(root)?;
        domain.check_root()?;
        Ok(domain)
    }

    fn configure(root: &Path) -> Result<Self, DomainError> {
        let invalid = || DomainError::RootPath { path: root.to_owned(), max: ROOT_LENGTH_MAX };
        let bytes = root.as_os_str().as_encoded_bytes();
        if !root.is_absolute() || bytes.len() > ROOT_LENGTH_MAX {
            return Err(invalid());
        }
        let mut config = Config::default();
        let path = iceoryx2::prelude::Path::new(bytes).map_err(|_| invalid())?;
        config.global.set_root_path(&path);
        config.global.prefix = FileName::new(prefix(root).as_bytes()).map_err(|_| invalid())?;
        Ok(Self { config, root: root.to_owned() })
    }

    /// A root path that others can write to would let them put their files under our names.
    fn check_root(&self) -> Result<(), DomainError> {
        let path = || self.root.clone();
        let metadata = fs::metadata(&self.root)
            .map_err(|source| DomainError::Root { path: path(), source })?;
        let uid = rustix::process::getuid().as_raw();
        if !metadata.is_dir() || metadata.uid() != uid || metadata.mode() & 0o077 != 0 {
            return Err(DomainError::RootNotPrivate { path: path(), uid });
        }
        Ok(())
    }

    /// Root path.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Start of the name of every file of this domain, in the root path and in
    /// [`SHARED_MEMORY_DIRECTORY`]: `plantd<layout version>_<hash of the root path>_`.
    pub fn prefix(&self) -> String {
        prefix(&self.root)
    }

    /// Fails when [`SHARED_MEMORY_DIRECTORY`] is nearly full, or has no room for a link whose
    /// messages have `len` entries.
    pub fn check_shared_memory(&self, len: usize) -> Result<(), DomainError> {
        let directory = SHARED_MEMORY_DIRECTORY;
        let error =
            |e: rustix::io::Errno| DomainError::Root { path: directory.into(), source: e.into() };
        let status = rustix::fs::statvfs(directory).map_err(error)?;
        let free = status.f_bavail.saturating_mul(status.f_frsize);
        let messages = DRIVERS_MAX * (BUFFER_SIZE + BORROWED_MAX + 2);
        let needed = SHARED_MEMORY_FREE_MIN + (messages * len * size_of::<f64>()) as u64;
        if free < needed {
            return Err(DomainError::SharedMemoryFull { directory, free, needed });
        }
        Ok(())
    }

    /// Joins the domain. Removes what dead processes have left behind.
    pub fn join(&self, name: &str) -> Result<LinkNode, DomainError> {
        // Its own default prints every handled error; ours are typed.
        set_log_level_from_env_or(LogLevel::Fatal);
        let name = NodeName::new(name).map_err(transport("name of the node"))?;
        let builder = NodeBuilder::new()
            .name(&name)
            .config(&self.config)
            .signal_handling_mode(SignalHandlingMode::Disabled);
        let node = catch_unwind(AssertUnwindSafe(|| builder.create::<ipc::Service>()))
            .map_err(|_| transport("joining the domain")("panic inside iceoryx2"))?
            .map_err(transport("joining the domain"))?;
        Ok(LinkNode { node: Some(node), domain: self.clone() })
    }

    /// Removes what iceoryx2 keeps for a domain without members: the counter that its nodes are
    /// numbered with. Whoever joins next begins a new one; numbers stay unique, because they also hold
    /// process id and time.
    fn remove_if_empty(&self) {
        let mut is_empty = true;
        let listed = Node::<ipc::Service>::list(&self.config, |_| {
            is_empty = false;
            CallbackProgression::Stop
        });
        let Ok(entries) = fs::read_dir(SHARED_MEMORY_DIRECTORY) else { return };
        if listed.is_err() || !is_empty {
            return;
        }
        let (prefix, suffix) = (self.prefix(), self.config.global.node.global_mgmt_suffix);
        for entry in entries.flatten() {
            let name = entry.file_name();
            let name = name.as_encoded_bytes();
            if name.starts_with(prefix.as_bytes()) && name.ends_with(suffix.as_bytes()) {
                // Another member that leaves at the same time may have removed it.
                let _ = fs::remove_file(entry.path());
            }
        }
    }
}

/// See [`Domain::prefix`].
fn prefix(root: &Path) -> String {
    let hash = fnv1a(FNV_BASIS, root.as_os_str().as_encoded_bytes());
    format!("plantd{LAYOUT_VERSION}_{:08x}_", (hash >> 32) as u32 ^ hash as u32)
}

/// Wraps an error of iceoryx2.
pub(super) fn transport<E: std::fmt::Debug>(what: &'static str) -> impl Fn(E) -> DomainError {
    move |cause| DomainError::Transport { what, cause: format!("{cause:?}") }
}

/// A member of a domain; ports are made from its services.
#[derive(Debug)]
pub struct LinkNode {
    /// Always there until the drop.
    node: Option<Node<ipc::Service>>,
    domain: Domain,
}

/// The two services of one direction of a link.
#[derive(Debug)]
pub struct Direction {
    /// Messages.
    pub channel: Channel,
    /// Rings when a message was sent to a receiver that sleeps.
    pub bell: Bell,
}

/// The services of one link.
#[derive(Debug)]
pub struct LinkServices {
    /// Drivers to server.
    pub input: Direction,
    /// Server to drivers.
    pub state: Direction,
}

impl LinkNode {
    /// Creates the services of a plant's link, or joins those that drivers have kept alive since
    /// another server died.
    pub fn create_services(&self, plant: &str) -> Result<LinkServices, DomainError> {
        Ok(LinkServices {
            input: self.create_direction(plant, "input", DRIVERS_MAX, 1)?,
            state: self.create_direction(plant, "state", 1, DRIVERS_MAX)?,
        })
    }

    fn create_direction(
        &self,
        plant: &str,
        direction: &str,
        senders: usize,
        receivers: usize,
    ) -> Result<Direction, DomainError> {
        let name = service_name(plant, direction)?;
        let channel = self
            .node()
            .service_builder(&name)
            .publish_subscribe::<[f64]>()
            .user_header::<Header>()
            .max_publishers(senders)
            .max_subscribers(receivers)
            .max_nodes(NODES_MAX)
            .enable_safe_overflow(true)
            .history_size(0)
            .subscriber_max_buffer_size(BUFFER_SIZE)
            .subscriber_max_borrowed_samples(BORROWED_MAX)
            .open_or_create_with_attributes(&required_attributes()?)
            .map_err(transport("creating a publish-subscribe service"))?;
        let bell = self
            .node()
            .service_builder(&name)
            .event()
            .max_notifiers(senders)
            .max_listeners(receivers)
            .max_nodes(NODES_MAX)
            .open_or_create()
            .map_err(transport("creating an event service"))?;
        Ok(Direction { channel, bell })
    }

    /// Opens the services of a plant's link that a server has created.
    pub fn open_services(&self, plant: &str) -> Result<LinkServices, DomainError> {
        Ok(LinkServices {
            input: self.open_direction(plant, "input")?,
            state: self.open_direction(plant, "state")?,
        })
    }

    fn open_direction(&self, plant: &str, direction: &str) -> Result<Direction, DomainError> {
        use event::EventOpenError;
        use publish_subscribe::PublishSubscribeOpenError as OpenError;

        let name = service_name(plant, direction)?;
        let not_open =
            || DomainError::NotOpen { plant: plant.to_owned(), root: self.domain.root.clone() };
        let channel = self
            .node()
            .service_builder(&name)
            .publish_subscribe::<[f64]>()
            .user_header::<Header>()
            .open_with_attributes(&required_attributes()?)
            .map_err(|cause| match cause {
                OpenError::DoesNotExist | OpenError::IsMarkedForDestruction => not_open(),
                OpenError::ExceedsMaxNumberOfNodes => DomainError::TooManyDrivers,
                OpenError::IncompatibleTypes | OpenError::IncompatibleAttributes => {
                    DomainError::OtherLayout { plant: plant.to_owned() }
                }
                cause => transport("opening a publish-subscribe service")(cause),
            })?;
        let bell =
            self.node().service_builder(&name).event().open().map_err(|cause| match cause {
                EventOpenError::DoesNotExist | EventOpenError::IsMarkedForDestruction => not_open(),
                cause => transport("opening an event service")(cause),
            })?;
        Ok(Direction { channel, bell })
    }

    /// Removes what dead members of the domain have left behind; takes milliseconds. Returns how
    /// many were removed.
    pub fn clean_up(&self) -> u64 {
        // The library may panic here when members come and go at the same time (eclipse-iceoryx
        // issue 1880); what was not removed is removed the next time.
        catch_unwind(AssertUnwindSafe(|| self.node().try_cleanup_dead_nodes()))
            .map_or(0, |state| state.cleanups)
    }

    fn node(&self) -> &Node<ipc::Service> {
        self.node.as_ref().expect("the node is there until the drop")
    }
}

impl Drop for LinkNode {
    /// Leaving the domain cleans up after dead members too.
    fn drop(&mut self) {
        let node = self.node.take();
        // A node that panicked while it was dropped is cleaned up by the next member that comes.
        let _ = catch_unwind(AssertUnwindSafe(move || drop(node)));
        self.domain.remove_if_empty();
    }
}

/// `plantd/<layout version>/<plant>/<direction>`.
fn service_name(plant: &str, direction: &str) -> Result<ServiceName, DomainError> {
    let valid = |c: u8| c.is_ascii_lowercase() || c.is_ascii_digit() || c == b'-';
    if plant.is_empty() || plant.len() > 63 || !plant.bytes().all(valid) {
        return Err(DomainError::PlantId { plant: plant.to_owned() });
    }
    ServiceName::new(&format!("plantd/{LAYOUT_VERSION}/{plant}/{direction}"))
        .map_err(transport("name of a service"))
}

/// What both sides demand of a service, and the server defines when it creates one.
fn required_attributes() -> Result<AttributeVerifier, DomainError> {
    let attribute = |verifier: AttributeVerifier, key: &str, text: String| {
        let key = AttributeKey::try_from(key).map_err(transport("attribute"))?;
        let value = AttributeValue::try_from(text.as_str()).map_err(transport("attribute"))?;
        verifier.require(&key, &value).map_err(transport("attribute"))
    };
    let verifier = AttributeVerifier::new();
    let verifier = attribute(verifier, "plantd.layout", LAYOUT_VERSION.to_string())?;
    attribute(verifier, "plantd.schema", format!("{SCHEMA_HASH:016x}"))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn the_root_path_must_be_private_absolute_and_short() {
        let base = std::env::temp_dir().join(format!("plantd-domain-{}", std::process::id()));
        let root = base.join("root");
        let domain = Domain::create(&root).unwrap();
        assert_eq!(domain.prefix().len(), PREFIX_LENGTH);
        fs::set_permissions(&root, fs::Permissions::from_mode(0o755)).unwrap();
        assert!(matches!(Domain::open(&root), Err(DomainError::RootNotPrivate { .. })));
        fs::remove_dir_all(&base).unwrap();
        assert!(matches!(Domain::open(&root), Err(DomainError::Root { .. })));
        assert!(matches!(Domain::open(Path::new("here")), Err(DomainError::RootPath { .. })));
        let long = PathBuf::from(format!("/{}", "x".repeat(ROOT_LENGTH_MAX)));
        assert!(matches!(Domain::create(&long), Err(DomainError::RootPath { .. })));
    }

    #[test]
    fn a_service_name_takes_only_a_plant_id() {
        assert!(service_name("a-1", "input").is_ok());
        for bad in ["", "A", "a/b", "a b", "ä", &"x".repeat(64)] {
            assert!(matches!(service_name(bad, "input"), Err(DomainError::PlantId { .. })));
        }
    }
}
