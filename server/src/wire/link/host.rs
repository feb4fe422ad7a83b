//! All links of a server.

use std::collections::HashMap;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::thread::JoinHandle;
use std::time::Duration;

use plantd_proto::link::{Domain, DomainError, LAYOUT_VERSION, Leftovers, LinkNode};

use crate::core::publish::frame::OUTPUTS_MAX;
use crate::core::session::shared::Session;
use crate::wire::link::config::LinkConfig;
use crate::wire::link::worker::Worker;

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
    /// The link's thread panicked while it started.
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
    state: Mutex<State>,
}

struct State {
    links: HashMap<String, Thread>,
    /// Cleans up; gone after the shutdown.
    housekeeper: Option<Thread>,
    /// Membership of the domain; gone after the shutdown, and the domain with it.
    node: Option<Arc<LinkNode>>,
}

/// A running thread that ends soon after it is told so.
struct Thread {
    stop: Arc<AtomicBool>,
    handle: JoinHandle<()>,
}

impl LinkHost {
    /// Makes a domain and removes what servers that were killed have left behind. Takes
    /// milliseconds.
    pub fn new(config: LinkConfig) -> Result<Self, LinkError> {
        let domain = Domain::create(&config.root)?;
        domain.check_shared_memory(0)?;
        let node = Arc::new(domain.found("plantd")?);
        let housekeeper = Some(start_housekeeper(Arc::clone(&node), config.clean_up_period)?);
        let state = State { links: HashMap::new(), housekeeper, node: Some(node) };
        Ok(Self { config, state: Mutex::new(state) })
    }

    /// Opens the link of a plant; one that is open stays open. Blocks for tens of milliseconds.
    pub fn open(&self, session: Arc<Session>) -> Result<LinkInfo, LinkError> {
        let plant = session.id().to_owned();
        let info = LinkInfo {
            service: format!("plantd/{LAYOUT_VERSION}/{plant}"),
            root: self.config.root.clone(),
            layout_version: LAYOUT_VERSION,
        };
        let mut state = self.state();
        let Some(node) = state.node.clone().filter(|_| !session.is_closed()) else {
            return Err(LinkError::Closing { plant });
        };
        if !session.link_open() || !state.links.contains_key(&plant) {
            // The thread of one that has failed may not have ended yet.
            if let Some(link) = state.links.remove(&plant) {
                link.stop();
            }
            let link = self.start_worker(session, &node)?;
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

    /// Closes all links, ends the housekeeping and leaves the domain. Blocks for a fraction of a second.
    pub fn shutdown(&self) {
        // Declared first and so dropped last: the domain is left when all threads have ended.
        let (_node, links, housekeeper) = {
            let mut state = self.state();
            (state.node.take(), std::mem::take(&mut state.links), state.housekeeper.take())
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

    /// Starts the thread of a link and waits until drivers can find it.
    fn start_worker(
        &self,
        session: Arc<Session>,
        node: &Arc<LinkNode>,
    ) -> Result<Thread, LinkError> {
        let plant = session.id().to_owned();
        let state_len = 3 * (session.model().dimensions().state() + OUTPUTS_MAX);
        node.domain().check_shared_memory(state_len)?;
        let started = self.spawn_worker(session, node);
        if started.is_err()
            && let Err(error) = node.withdraw(&plant)
        {
            tracing::debug!(plant, %error, "shared-memory link, not opened");
        }
        started
    }

    fn spawn_worker(
        &self,
        session: Arc<Session>,
        node: &Arc<LinkNode>,
    ) -> Result<Thread, LinkError> {
        let plant = session.id().to_owned();
        let services = node.create_services(&plant)?;
        let stop = Arc::new(AtomicBool::new(false));
        let (report, reported) = mpsc::sync_channel(1);
        let handle = {
            let (config, stop) = (self.config.clone(), Arc::clone(&stop));
            let node = Arc::clone(node);
            std::thread::Builder::new().name(format!("link-{plant}")).spawn(move || {
                let made = || Worker::new(session, services, &config, stop);
                let made = catch_unwind(AssertUnwindSafe(made));
                let Ok(made) = made else { return };
                // The receiver waits for this message: sending cannot fail.
                match made.and_then(|worker| worker.publish(&node)) {
                    Ok(worker) => {
                        let _ = report.send(Ok(()));
                        serve(worker, &node);
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

/// Serves a link until it ends. What panics in it, the library on segments that somebody has overwritten
/// for one, ends this link and nothing else.
fn serve(mut worker: Worker, node: &LinkNode) {
    let plant = worker.plant().to_owned();
    if catch_unwind(AssertUnwindSafe(|| worker.run())).is_err() {
        tracing::error!(plant, "the thread of the shared-memory link has panicked; link closed");
    }
    if let Err(error) = node.withdraw(&plant) {
        tracing::warn!(plant, %error, "shared-memory link, closing");
    }
    worker.close();
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
            let mut leftovers = Leftovers::default();
            while !stop.load(Ordering::Acquire) {
                let removed = node.clean_up(&mut leftovers);
                if removed > 0 {
                    tracing::info!(removed, "removed shared memory of dead processes");
                }
                std::thread::park_timeout(period);
            }
        })?
    };
    Ok(Thread { stop, handle })
}

#[cfg(test)]
mod tests {
    use plantd_models::{Model, Plant, Settings, builtin};
    use plantd_proto::link::{Code, Endpoint, Header, Kind, monotonic_ns, random_instance};

    use super::*;
    use crate::core::metrics::registry::Metrics;
    use crate::core::realtime::loops::RealTime;
    use crate::core::realtime::settings::RealTimeSettings;
    use crate::core::session::creation::Origin;
    use crate::wire::link::worker::PANIC;

    fn new_session(id: &str) -> Arc<Session> {
        let model = Arc::new(Model::compile(&builtin::scene("pendulum").unwrap()).unwrap());
        let settings = Settings::new(&model);
        let plant = Plant::new(model, settings).unwrap();
        let metrics = Arc::new(Metrics::default());
        let realtime = RealTime::new(RealTimeSettings::default(), &metrics);
        Session::new(Origin::new(id, "pendulum"), plant, metrics, realtime)
    }

    struct Driver {
        endpoint: Endpoint,
        header: Header,
        /// Declared last: the ports go before the membership.
        _node: LinkNode,
    }

    impl Driver {
        fn attach(root: &std::path::Path, plant: &str) -> Self {
            let node = Domain::find(root, plant).unwrap().join("driver").unwrap();
            let services = node.open_services(plant).unwrap();
            let endpoint =
                Endpoint::driver(services, 1, plantd_proto::link::Wait::default()).unwrap();
            let header = Header { driver: random_instance(), ..Header::new(Kind::Attach) };
            let mut driver = Self { endpoint, header, _node: node };
            driver.header.server = driver.ask(header, &[]).server;
            driver
        }

        fn ask(&mut self, header: Header, payload: &[f64]) -> Header {
            self.endpoint.send(header, &[payload], 0).unwrap();
            let deadline_ns = monotonic_ns() + 10_000_000_000;
            *self.endpoint.receive(deadline_ns).unwrap().expect("an answer").user_header()
        }

        fn step(&mut self, sequence: u64) -> Header {
            self.ask(Header { kind: Kind::Input as u32, sequence, ..self.header }, &[0.0])
        }
    }

    #[test]
    fn a_thread_that_panics_closes_its_link_and_no_other() {
        let directory = tempfile::Builder::new().prefix("plantd-").tempdir().unwrap();
        let root = directory.path().join("link");
        let host =
            LinkHost::new(LinkConfig { root: root.clone(), ..LinkConfig::default() }).unwrap();
        let sessions = ["broken", "whole"].map(new_session);
        for session in &sessions {
            host.open(Arc::clone(session)).unwrap();
        }
        let mut drivers = ["broken", "whole"].map(|plant| Driver::attach(&root, plant));
        for driver in &mut drivers {
            assert_eq!(driver.step(1).kind, Kind::State as u32);
        }
        let told = drivers[0].ask(Header { kind: PANIC, ..drivers[0].header }, &[]);
        assert_eq!((told.kind, told.code), (Kind::Closed as u32, Code::LinkClosed as u32));
        let deadline_ns = monotonic_ns() + 10_000_000_000;
        while sessions[0].link_open() && monotonic_ns() < deadline_ns {
            std::thread::yield_now();
        }
        assert_eq!((sessions[0].link_open(), sessions[0].driver()), (false, None));
        assert!(sessions[1].link_open());
        assert_eq!(drivers[1].step(2).kind, Kind::State as u32);
        // It can be opened again.
        host.open(Arc::clone(&sessions[0])).unwrap();
        let mut again = Driver::attach(&root, "broken");
        assert_eq!(again.step(1).step, 2);
    }
}
