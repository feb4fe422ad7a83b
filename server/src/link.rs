//! The server's side of the shared-memory link: one thread for each open link.
//!
//! A thread makes its ports, owns them, and is the only one that touches them. It steps the plant
//! through a lease, as every other driver does. Cleaning up after dead processes takes milliseconds
//! and file access, so that a thread of its own does it.

mod worker;

use std::collections::HashMap;
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::thread::JoinHandle;
use std::time::Duration;

use plantd_proto::link::{Domain, DomainError, LAYOUT_VERSION, LinkNode, Wait, default_root};

use crate::frame::OUTPUTS_MAX;
use crate::session::Session;
use worker::Worker;

/// How the shared-memory links of a server behave.
#[derive(Clone, Debug)]
pub struct LinkConfig {
    /// Root path of the iceoryx2 domain; made (mode 0700) when it does not exist.
    pub root: PathBuf,
    /// How a link waits for the next input.
    pub wait: Wait,
    /// A driver that sends nothing for this long loses the lease; `None` means never.
    pub idle_timeout: Option<Duration>,
    /// How often resources of dead processes are removed.
    pub clean_up_period: Duration,
}

impl Default for LinkConfig {
    fn default() -> Self {
        Self {
            root: default_root(),
            wait: Wait::default(),
            idle_timeout: None,
            clean_up_period: Duration::from_millis(250),
        }
    }
}

/// How to reach an open link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LinkInfo {
    /// Names of its services, up to the direction.
    pub service: String,
    /// Root path of the iceoryx2 domain.
    pub root: PathBuf,
    /// Version of the layout.
    pub layout_version: u32,
}

/// Why a link could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The shared-memory domain cannot be used.
    #[error(transparent)]
    Domain(#[from] DomainError),
    /// The system gave no thread.
    #[error("no thread for the link: {0}")]
    Thread(#[from] io::Error),
    /// The link's thread ended while it started.
    #[error("the thread of the link of plant `{plant}` failed")]
    Failed {
        /// Plant.
        plant: String,
    },
    /// The plant was deleted, or the server shuts down.
    #[error("plant `{plant}` is being closed")]
    Closing {
        /// Plant.
        plant: String,
    },
}

/// All links of a server.
pub struct LinkHost {
    config: LinkConfig,
    domain: Domain,
    node: Arc<LinkNode>,
    state: Mutex<State>,
}

struct State {
    links: HashMap<String, Thread>,
    /// Cleans up; gone after the shutdown.
    housekeeper: Option<Thread>,
}

/// A running thread that ends soon after it is told so.
struct Thread {
    stop: Arc<AtomicBool>,
    handle: JoinHandle<()>,
}

impl LinkHost {
    /// Joins the domain and removes what a server that was killed has left behind. Takes
    /// milliseconds.
    pub fn new(config: LinkConfig) -> Result<Self, LinkError> {
        let domain = Domain::create(&config.root)?;
        domain.check_shared_memory(0)?;
        let node = Arc::new(domain.join("plantd")?);
        let housekeeper = Some(start_housekeeper(Arc::clone(&node), config.clean_up_period)?);
        let state = Mutex::new(State { links: HashMap::new(), housekeeper });
        Ok(Self { config, domain, node, state })
    }

    /// Opens the link of a plant; one that is open stays open. Blocks for tens of milliseconds.
    pub fn open(&self, session: Arc<Session>) -> Result<LinkInfo, LinkError> {
        let plant = session.id().to_owned();
        let info = LinkInfo {
            service: format!("plantd/{LAYOUT_VERSION}/{plant}"),
            root: self.domain.root().to_owned(),
            layout_version: LAYOUT_VERSION,
        };
        let mut state = self.state();
        if state.housekeeper.is_none() || session.is_closed() {
            return Err(LinkError::Closing { plant });
        }
        if state.links.get(&plant).is_none_or(|link| link.handle.is_finished()) {
            let link = self.start_worker(session)?;
            state.links.insert(plant, link);
        }
        Ok(info)
    }

    /// Closes the link of a plant, if it is open: its driver is told so. Blocks for 0.1 s.
    pub fn close(&self, plant: &str) {
        let link = self.state().links.remove(plant);
        if let Some(link) = link {
            link.stop();
        }
    }

    /// Closes all links and ends the housekeeping. Blocks for a fraction of a second.
    pub fn shutdown(&self) {
        let (links, housekeeper) = {
            let mut state = self.state();
            (std::mem::take(&mut state.links), state.housekeeper.take())
        };
        let threads: Vec<Thread> = links.into_values().chain(housekeeper).collect();
        for thread in &threads {
            thread.stop.store(true, Ordering::Release);
            thread.handle.thread().unpark();
        }
        for thread in threads {
            thread.stop();
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Starts the thread of a link and waits until its ports exist.
    fn start_worker(&self, session: Arc<Session>) -> Result<Thread, LinkError> {
        let plant = session.id().to_owned();
        self.domain
            .check_shared_memory(3 * (session.model().dimensions().state() + OUTPUTS_MAX))?;
        let services = self.node.create_services(&plant)?;
        let stop = Arc::new(AtomicBool::new(false));
        let (report, reported) = mpsc::sync_channel(1);
        let handle = {
            let (config, stop) = (self.config.clone(), Arc::clone(&stop));
            std::thread::Builder::new().name(format!("link-{plant}")).spawn(move || {
                match Worker::new(session, services, &config, stop) {
                    Ok(worker) => {
                        // The receiver waits for this message: sending cannot fail.
                        let _ = report.send(Ok(()));
                        worker.run();
                    }
                    Err(error) => {
                        let _ = report.send(Err(error));
                    }
                }
            })?
        };
        reported.recv().map_err(|_| LinkError::Failed { plant })??;
        Ok(Thread { stop, handle })
    }
}

impl Drop for LinkHost {
    fn drop(&mut self) {
        self.shutdown();
    }
}

impl Thread {
    /// Tells the thread to end and waits for it.
    fn stop(self) {
        self.stop.store(true, Ordering::Release);
        self.handle.thread().unpark();
        if self.handle.join().is_err() {
            tracing::error!("a thread of the shared-memory link has panicked");
        }
    }
}

fn start_housekeeper(node: Arc<LinkNode>, period: Duration) -> Result<Thread, LinkError> {
    let stop = Arc::new(AtomicBool::new(false));
    let handle = {
        let stop = Arc::clone(&stop);
        std::thread::Builder::new().name("link-housekeeper".into()).spawn(move || {
            while !stop.load(Ordering::Acquire) {
                let removed = node.clean_up();
                if removed > 0 {
                    tracing::info!(removed, "removed shared memory of dead processes");
                }
                std::thread::park_timeout(period);
            }
        })?
    };
    Ok(Thread { stop, handle })
}
