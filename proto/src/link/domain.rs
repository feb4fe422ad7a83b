//! The iceoryx2 domain of one start of a server, and the services of links in it.

use std::collections::HashSet;
use std::fs::File;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use iceoryx2::prelude::{
    AttributeVerifier, Config, FileName, LogLevel, Node, NodeBuilder, NodeName,
    SemanticString as _, ServiceName, SignalHandlingMode, ipc, set_log_level_from_env_or,
};
use iceoryx2::service::attribute::{AttributeKey, AttributeValue};
use iceoryx2::service::builder::{event, publish_subscribe};
use iceoryx2::service::port_factory;

use super::error::DomainError;
use super::header::{Header, LAYOUT_VERSION, SCHEMA_HASH};
use super::root::{Root, host_pid};
use super::segments::{self, Leftovers, SHARED_MEMORY_DIRECTORY};

/// Shared memory that must be free before a link is opened, beside what its messages need, bytes:
/// writing to shared memory that is full kills the process.
const SHARED_MEMORY_FREE_MIN: u64 = 8 << 20;

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

/// The domain of one start of a server: an iceoryx2 configuration of its own, which nobody can know
/// beforehand and nobody uses again. What happens to its files ends with it.
#[derive(Debug)]
pub struct Domain {
    config: Config,
    root: Root,
    name: String,
    /// The lock that says that this process lives: of the domain's directory, or of a member.
    hold: Option<File>,
}

/// Root path when none is given: `$XDG_RUNTIME_DIR/plantd`, or `/tmp/plantd-<uid>` without it.
pub fn default_root() -> PathBuf {
    match std::env::var_os("XDG_RUNTIME_DIR").filter(|dir| Path::new(dir).is_absolute()) {
        Some(dir) => Path::new(&dir).join("plantd"),
        None => PathBuf::from(format!("/tmp/plantd-{}", rustix::process::getuid().as_raw())),
    }
}

impl Domain {
    /// A new domain under `root`, for a server. The root is made (mode 0700) when it does not exist, and
    /// domains in it without living processes are removed.
    pub fn create(root: &Path) -> Result<Self, DomainError> {
        let root = Root::create(root)?;
        let (name, hold) = root.make_domain()?;
        Self::new(root, name, hold)
    }

    /// The domain in which the link of a plant is open, for a driver. Nothing of it is mapped before the
    /// segments of the link are found to be whole, and this user's alone.
    pub fn find(root: &Path, plant: &str) -> Result<Self, DomainError> {
        check_plant_id(plant)?;
        let root = Root::open(root)?;
        let link = root.read_link(plant)?;
        let is_open = |domain: &str| root.is_served(domain);
        let link = link.filter(|link| !link.segments.is_empty() && is_open(&link.domain));
        let Some(link) = link else {
            let (plant, root) = (plant.to_owned(), root.path().to_owned());
            return Err(DomainError::NotOpen { plant, root });
        };
        let hold = root.enter(&link.domain)?;
        segments::check(&link.segments)?;
        Self::new(root, link.domain, hold)
    }

    fn new(root: Root, name: String, hold: File) -> Result<Self, DomainError> {
        let mut config = Config::default();
        let directory = root.directory(&name);
        let path = iceoryx2::prelude::Path::new(directory.as_os_str().as_encoded_bytes())
            .map_err(transport("path of the domain"))?;
        config.global.set_root_path(&path);
        config.global.prefix = FileName::new(segments::prefix(&name).as_bytes())
            .map_err(transport("prefix of the domain"))?;
        // Only the server's housekeeping cleans up: one that is killed while it does ends the domain.
        config.global.node.cleanup_dead_nodes_on_creation = false;
        config.global.node.cleanup_dead_nodes_on_destruction = false;
        config.global.service.cleanup_dead_nodes_on_open = false;
        Ok(Self { config, root, name, hold: Some(hold) })
    }

    /// Root path.
    pub fn root(&self) -> &Path {
        self.root.path()
    }

    /// Start of the name of every file of this domain, in its directory and in
    /// [`SHARED_MEMORY_DIRECTORY`]: `plantd<layout version>_<domain>_`.
    pub fn prefix(&self) -> String {
        segments::prefix(&self.name)
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

    /// Joins the domain.
    pub fn join(self, name: &str) -> Result<LinkNode, DomainError> {
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
        Ok(LinkNode { node: Some(node), domain: self })
    }

    /// Joins the domain as its server, before anybody else can.
    pub fn found(self, name: &str) -> Result<LinkNode, DomainError> {
        let node = self.join(name)?;
        segments::take_numbering(&node.domain.name)
            .map_err(transport("closing the domain to other users"))?;
        Ok(node)
    }
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
    /// The domain.
    pub fn domain(&self) -> &Domain {
        &self.domain
    }

    /// Claims the link of a plant, and creates its services or joins those that drivers have kept alive
    /// since the link was closed. Drivers find it when it is [`published`](Self::publish).
    pub fn create_services(&self, plant: &str) -> Result<LinkServices, DomainError> {
        check_plant_id(plant)?;
        self.domain.root.write_link(plant, &self.domain.name, &[])?;
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
        let not_open = || DomainError::NotOpen {
            plant: plant.to_owned(),
            root: self.domain.root().to_owned(),
        };
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

    /// Tells drivers that the link of a plant is open.
    pub fn publish(&self, plant: &str) -> Result<(), DomainError> {
        let Domain { root, name, .. } = &self.domain;
        let others = root.other_links(plant, name);
        let others: HashSet<_> = others.iter().flat_map(|link| &link.segments).collect();
        let mut segments = segments::made_by(name, host_pid());
        segments.retain(|own| segments::is_common(&own.0) || !others.contains(own));
        root.write_link(plant, name, &segments)
    }

    /// Tells drivers that the link of a plant is not open, or no longer.
    pub fn withdraw(&self, plant: &str) -> Result<(), DomainError> {
        self.domain.root.remove_link(plant, &self.domain.name)
    }

    /// Whether the server of the domain lives.
    pub fn is_served(&self) -> bool {
        self.domain.root.is_served(&self.domain.name)
    }

    /// Whether the link of a plant is in the domain of another server now.
    pub fn is_elsewhere(&self, plant: &str) -> bool {
        let link = self.domain.root.read_link(plant);
        link.is_ok_and(|link| link.is_some_and(|link| link.domain != self.domain.name))
    }

    /// Removes what dead members of the domain have left behind, and domains without living processes;
    /// takes milliseconds. Returns how much was removed.
    pub fn clean_up(&self, leftovers: &mut Leftovers) -> u64 {
        let Domain { root, name, .. } = &self.domain;
        let empty = segments::empty(name);
        let mut living = root.members(name);
        living.push(host_pid());
        segments::remove_unfinished(name, &empty, &living);
        // The library may panic here when members come and go at the same time (eclipse-iceoryx
        // issue 1880); what was not removed is removed the next time.
        let removed = catch_unwind(AssertUnwindSafe(|| self.node().try_cleanup_dead_nodes()))
            .map_or(0, |state| state.cleanups);
        let files = leftovers.remove(name, &root.directory(name), &living);
        // What cannot be removed now is looked at again the next time.
        let domains = root.remove_dead().unwrap_or(0);
        removed + (files + domains) as u64
    }

    fn node(&self) -> &Node<ipc::Service> {
        self.node.as_ref().expect("the node is there until the drop")
    }
}

impl Drop for LinkNode {
    /// The last one to leave a domain without server removes it.
    fn drop(&mut self) {
        let node = self.node.take();
        // What a node that panics while it is dropped leaves behind goes with the domain.
        let _ = catch_unwind(AssertUnwindSafe(move || drop(node)));
        drop(self.domain.hold.take());
        // Should it fail, the next server does it.
        let _ = self.domain.root.remove_dead();
    }
}

/// `plantd/<layout version>/<plant>/<direction>`.
fn service_name(plant: &str, direction: &str) -> Result<ServiceName, DomainError> {
    check_plant_id(plant)?;
    ServiceName::new(&format!("plantd/{LAYOUT_VERSION}/{plant}/{direction}"))
        .map_err(transport("name of a service"))
}

fn check_plant_id(plant: &str) -> Result<(), DomainError> {
    let valid = |c: u8| c.is_ascii_lowercase() || c.is_ascii_digit() || c == b'-';
    if plant.is_empty() || plant.len() > 63 || !plant.bytes().all(valid) {
        return Err(DomainError::PlantId { plant: plant.to_owned() });
    }
    Ok(())
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
    use super::*;

    #[test]
    fn a_service_name_takes_only_a_plant_id() {
        assert!(service_name("a-1", "input").is_ok());
        for bad in ["", "A", "a/b", "a b", "ä", &"x".repeat(64)] {
            assert!(matches!(service_name(bad, "input"), Err(DomainError::PlantId { .. })));
        }
    }
}
