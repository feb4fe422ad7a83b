//! Starts a server, keeps it, and ends it.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context as _, Result};
use futures::{FutureExt as _, future};
use plantd_proto::{FILE_DESCRIPTOR_SET, v1};
use serde::Serialize;
use tokio::net::TcpListener;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;
use tonic::codegen::http;
use tonic::service::{LayerExt as _, Routes};
use tonic::transport::Server;
use tonic::transport::server::Router;
use tonic_health::server::HealthReporter;
use tonic_web::GrpcWebLayer;
use tower::Layer as _;
use tower::layer::util::{Identity, Stack};
use tower::util::MapRequestLayer;
use v1::channel_service_server::ChannelServiceServer;
use v1::control_service_server::ControlServiceServer;
use v1::model_service_server::ModelServiceServer;
use v1::plant_service_server::PlantServiceServer;
use v1::recording_service_server::RecordingServiceServer;
use v1::server_service_server::ServerServiceServer;

use crate::config::{Config, Listen};
use crate::core::connection::Connection;
use crate::core::limits::Limits;
use crate::core::tenant::Tenant;
use crate::listen::{KEEP_ALIVE_INTERVAL, KEEP_ALIVE_TIMEOUT, UnixSocket, bind_tcp};
use crate::memory;
use crate::scenes;
use crate::tls::{TlsFiles, over_tls};
use crate::wire::control::service::ControlService;
use crate::wire::edge::admission::Places;
use crate::wire::edge::auth::door::Door;
use crate::wire::edge::auth::guard::GuardLayer;
use crate::wire::edge::ending::ending_with;
use crate::wire::edge::gate::GateLayer;
use crate::wire::edge::metrics_http;
use crate::wire::edge::observe::{Observe, ObserveLayer};
use crate::wire::edge::page::{FindFile, PageLayer};
use crate::wire::link::host::LinkHost;
use crate::wire::models::kept;
use crate::wire::models::model::ModelService;
use crate::wire::plants::adopt;
use crate::wire::plants::channels::ChannelService;
use crate::wire::plants::plant::PlantService;
use crate::wire::plants::recordings::RecordingService;
use crate::wire::plants::server::ServerService;
use crate::wire::record::archive::Archive;
use crate::wire::record::directory::Recordings;
use crate::wire::shared::hub::Hub;
use crate::wire::shared::state::State;
use crate::wire::shared::state::directory::Directory;
#[cfg(feature = "object-store")]
use crate::wire::shared::state::objects::Objects;
use crate::wire::shared::state::store::Store;

/// Longest wait at the end for a disk that does not answer while plants are saved.
const SAVE_WAIT_MAX: Duration = Duration::from_secs(10);

/// How often a server that drains looks whether plants are driven.
const DRAIN_PERIOD: Duration = Duration::from_millis(20);

/// How often recordings that have ended are looked for, where there is an archive.
const ARCHIVE_PERIOD: Duration = Duration::from_secs(1);

/// How often plants are looked at that are kept for a time.
const EXPIRY_PERIOD: Duration = Duration::from_secs(1);

/// Where a server can be reached.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Addresses {
    /// gRPC over TCP, `http://address:port`.
    pub grpc: Option<String>,
    /// The page that shows the plants, for a browser on this machine: `http://address:port/`.
    pub view: Option<String>,
    /// gRPC over a unix-domain socket, `unix:/path`.
    pub unix: Option<String>,
    /// Metrics, `http://address:port/metrics`.
    pub metrics: Option<String>,
    /// Root path of the shared-memory links.
    pub link_root: Option<PathBuf>,
    /// Id of the server's process.
    pub pid: u32,
}

/// A server that listens.
pub struct RunningServer {
    hub: Arc<Hub>,
    config: Config,
    addresses: Addresses,
    /// Until it was said that the server serves no more: whoever watches it hears that once.
    health: Option<HealthReporter>,
    /// Somebody asks whether the server is healthy, and learns before its end that it is going.
    is_asked_for_health: Arc<AtomicBool>,
    listeners: JoinSet<Result<(), tonic::transport::Error>>,
    /// Cancelled when listeners stop accepting.
    closing: CancellationToken,
    /// Saves plants that change.
    saver: tokio::task::JoinHandle<()>,
    /// Brings recordings that have ended into the archive.
    archiver: tokio::task::JoinHandle<()>,
    /// Gives free memory back to the system.
    memory: tokio::task::JoinHandle<()>,
    /// Deletes plants that nobody uses any more.
    reaper: tokio::task::JoinHandle<()>,
    metrics: Option<tokio::task::JoinHandle<()>>,
    /// Where callers say who they are.
    door: Option<Arc<Door>>,
    /// Looks whether tokens and certificates have changed.
    lookouts: JoinSet<()>,
    /// Removed from the file system when dropped.
    unix: Option<UnixSocket>,
}

/// Serves until `shutdown` completes, then ends calls in good order, within the configured times, which
/// `hurry` cuts short.
pub async fn run(
    config: Config,
    shutdown: impl Future<Output = Shutdown>,
    hurry: impl Future<Output = ()>,
    on_ready: impl FnOnce(&Addresses),
) -> Result<()> {
    let mut server = RunningServer::start(config).await?;
    on_ready(server.addresses());
    let hurry = hurry.shared();
    let hub = Arc::clone(&server.hub);
    tokio::select! {
        shutdown = shutdown => {
            if shutdown == Shutdown::Drained {
                server.drain(hurry.clone()).await;
            }
        }
        () = hub.drain.requested() => server.drain(hurry.clone()).await,
        error = server.listener_failed() => {
            tracing::error!(%error, "a listener failed");
            server.stop().await;
            return Err(error);
        }
    }
    server.stop_within(hurry).await;
    Ok(())
}

/// How a server ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shutdown {
    /// As soon as open calls have ended.
    Prompt,
    /// Nothing new is taken, and what is driven goes on for a while; balancers that ask for its health are told, and
    /// given time to look elsewhere.
    Drained,
}

impl RunningServer {
    /// Starts to serve.
    pub async fn start(config: Config) -> Result<Self> {
        config.check_exposure()?;
        if let Some(exposure) = config.exposure() {
            // Said at every start.
            tracing::warn!(
                "`insecure` is set: whoever reaches the server may do everything. {exposure}"
            );
        }
        let links = config.link.host_config().map(LinkHost::new).transpose();
        let links = links.context("shared-memory links (turn them off with `--link off`)")?;
        let link_root = config.link.host_config().filter(|_| links.is_some()).map(|link| link.root);
        let mut hub = Hub::new(
            config.server_name(),
            config.limits.clone(),
            config.worker_count(),
            config.worker_priority,
            config.realtime.clone(),
            links,
            config.auth.as_ref().map(|_| config.tenants.clone()),
        );
        hub.search_threads = config.search_thread_count();
        let mut archive = None;
        if let Some(path) = &config.state_directory {
            let opened = open_store(path, &config, &hub);
            let (store, shared) =
                opened.with_context(|| format!("plants in {}", path.display()))?;
            (hub.state, archive) = (Some(State::new(store)), shared);
        }
        if let Some(path) = &config.recordings {
            let (limits, tenants) = (config.limits.clone(), Arc::clone(&hub.tenants));
            let recordings = Recordings::open(path, config.file_mode, limits, tenants, archive);
            let recordings =
                recordings.with_context(|| format!("recordings in {}", path.display()));
            hub.recordings = Some(recordings?);
        }
        let hub = Arc::new(hub);
        if hub.shared_store().is_some() {
            let _ = hub.find.set(adopt::finder(&hub));
            let _ = hub.catalog.find.set(kept::finder(&hub));
        }
        if let Some(directory) = &config.scenes {
            // They are there for everybody.
            Connection::server(Tenant::NONE).scope(|| scenes::load(&hub.catalog, directory))?;
        }
        if let Some(state) = &hub.state {
            state.load(&hub).await.context("saved plants")?;
        }
        let tenants = Arc::clone(&hub.tenants);
        let door = config.auth.clone().map(|settings| Door::new(settings, tenants)).transpose()?;
        let door = door.map(Arc::new);
        let mut lookouts = JoinSet::new();
        if let Some(door) = &door {
            lookouts.spawn(Arc::clone(door).look_after());
        }
        let (health, health_service) = tonic_health::server::health_reporter();
        health.set_serving::<ModelServiceServer<ModelService>>().await;
        health.set_serving::<PlantServiceServer<PlantService>>().await;
        health.set_serving::<ControlServiceServer<ControlService>>().await;
        health.set_serving::<ChannelServiceServer<ChannelService>>().await;
        health.set_serving::<RecordingServiceServer<RecordingService>>().await;
        let is_asked_for_health = Arc::new(AtomicBool::new(false));
        let asked = Arc::clone(&is_asked_for_health);
        // Whoever watches it is told at once, and needs no time.
        let note = MapRequestLayer::new(move |request: http::Request<tonic::body::Body>| {
            let is_check = request.uri().path().ends_with("/Check");
            asked.fetch_or(is_check, Ordering::Relaxed);
            request
        });
        let health_service = ending_with(note.named_layer(health_service), hub.ending.clone());
        let mut server = Self {
            is_asked_for_health,
            addresses: Addresses { link_root, pid: std::process::id(), ..Addresses::default() },
            health: Some(health),
            listeners: JoinSet::new(),
            closing: CancellationToken::new(),
            saver: tokio::spawn(save_plants(Arc::clone(&hub), config.state_interval())),
            archiver: tokio::spawn(archive_recordings(Arc::clone(&hub))),
            memory: tokio::spawn(memory::give_back()),
            reaper: tokio::spawn(delete_expired(Arc::clone(&hub))),
            metrics: None,
            door,
            lookouts,
            unix: None,
            hub,
            config,
        };
        let router = server.router()?.add_service(health_service);
        server.listen(router).await?;
        server.announce();
        Ok(server)
    }

    /// Says to the plants where clients reach them.
    fn announce(&self) {
        let Self { config, addresses, hub, .. } = self;
        let by_name = || match config.grpc {
            // Everywhere is no address for others.
            Listen::At(address) if address.ip().is_unspecified() => {
                let (scheme, _) = addresses.grpc.as_ref()?.split_once("://")?;
                let port = addresses.grpc.as_ref()?.rsplit_once(':')?.1;
                Some(format!("{scheme}://{}:{port}", hub.identity.name()))
            }
            _ => addresses.grpc.clone(),
        };
        let listens = || by_name().or_else(|| addresses.unix.clone());
        if let Some(address) = config.advertise.clone().or_else(listens) {
            if let Some(shared) = hub.shared_store() {
                shared.announce(&address);
            }
            hub.identity.announce(address);
        }
    }

    /// Where it can be reached.
    pub fn addresses(&self) -> &Addresses {
        &self.addresses
    }

    /// What the services share.
    pub fn hub(&self) -> &Arc<Hub> {
        &self.hub
    }

    fn router(&self) -> Result<Router<Layers>> {
        let hub = || Arc::clone(&self.hub);
        let limits = &self.hub.limits;
        let reflection = || {
            tonic_reflection::server::Builder::configure()
                .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
                .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
        };
        let ending = || self.hub.ending.clone();
        let streams = u32::try_from(limits.streams_per_connection).unwrap_or(u32::MAX);
        Ok(Server::builder()
            // gRPC-Web comes over HTTP/1.1.
            .accept_http1(true)
            .max_concurrent_streams(streams)
            // A client whose machine is gone is found out; its lease ends.
            .http2_keepalive_interval(Some(KEEP_ALIVE_INTERVAL))
            .http2_keepalive_timeout(Some(KEEP_ALIVE_TIMEOUT))
            .layer(GateLayer::new(self.config.names()))
            .layer(GuardLayer::new(self.door.clone(), Arc::clone(&self.hub.metrics)))
            .layer(PageLayer::new(
                self.config.view.then(|| find_file(hub())),
                self.door.as_ref().map(|_| Arc::clone(&self.hub.metrics)),
            ))
            .layer(GrpcWebLayer::new())
            .layer(ObserveLayer::new(Arc::clone(&self.hub.metrics), limits.clone()))
            .add_routes(self.routes())
            .add_service(ending_with(reflection().build_v1()?, ending()))
            // Older tools know only this one.
            .add_service(ending_with(reflection().build_v1alpha()?, ending())))
    }

    /// The services, for calls that come over no connection.
    pub fn services(&self) -> Services {
        ObserveLayer::new(Arc::clone(&self.hub.metrics), self.hub.limits.clone())
            .layer(self.routes().prepare())
    }

    /// The services of `plantd.v1`.
    fn routes(&self) -> Routes {
        let hub = || Arc::clone(&self.hub);
        let limits = &self.hub.limits;
        let message_bytes = Limits::size(limits.message_bytes);
        let channel_bytes = message_bytes.min(Limits::size(limits.channel_message_bytes));
        let models = ModelServiceServer::new(ModelService::new(hub()));
        let plants = PlantServiceServer::new(PlantService::new(hub()));
        let control = ControlServiceServer::new(ControlService::new(hub()));
        let channels = ChannelServiceServer::new(ChannelService::new(hub()));
        let recordings = RecordingServiceServer::new(RecordingService::new(hub()));
        let server = ServerServiceServer::new(ServerService::new(hub()));
        Routes::new(models.max_decoding_message_size(message_bytes))
            .add_service(plants.max_decoding_message_size(message_bytes))
            .add_service(control.max_decoding_message_size(message_bytes))
            .add_service(channels.max_decoding_message_size(channel_bytes))
            .add_service(recordings.max_decoding_message_size(message_bytes))
            .add_service(server.max_decoding_message_size(message_bytes))
    }

    async fn listen(&mut self, router: Router<Layers>) -> Result<()> {
        let places = Arc::new(Places::new(&self.hub.limits));
        if let Listen::At(address) = self.config.grpc {
            let incoming = bind_tcp(address).with_context(|| format!("gRPC on {address}"))?;
            let address = incoming.local_addr()?;
            let scheme = if self.config.tls.is_some() { "https" } else { "http" };
            self.addresses.grpc = Some(format!("{scheme}://{address}"));
            let view = || format!("{scheme}://{}/", within(address));
            self.addresses.view = self.config.view.then(view);
            let incoming = Arc::clone(&places).admit(incoming);
            let (router, closing) = (router.clone(), self.closing.clone().cancelled_owned());
            match &self.config.tls {
                Some(settings) => {
                    let files = TlsFiles::read(settings.clone())?;
                    self.lookouts.spawn(Arc::clone(&files).look_after());
                    let incoming = over_tls(incoming, files);
                    self.listeners.spawn(router.serve_with_incoming_shutdown(incoming, closing));
                }
                None => {
                    self.listeners.spawn(router.serve_with_incoming_shutdown(incoming, closing));
                }
            }
        }
        if let Some(path) = &self.config.unix {
            let path = std::path::absolute(path)?;
            let (socket, incoming) = UnixSocket::bind(&path, self.config.unix_mode)
                .await
                .with_context(|| format!("gRPC on socket {}", path.display()))?;
            self.addresses.unix = Some(format!("unix:{}", socket.path().display()));
            self.unix = Some(socket);
            let incoming = places.admit(incoming);
            let closing = self.closing.clone().cancelled_owned();
            self.listeners.spawn(router.serve_with_incoming_shutdown(incoming, closing));
        }
        if let Listen::At(address) = self.config.metrics {
            let listener = TcpListener::bind(address)
                .await
                .with_context(|| format!("metrics on {address}"))?;
            self.addresses.metrics = Some(format!("http://{}/metrics", listener.local_addr()?));
            let metrics = Arc::clone(&self.hub.metrics);
            let names = self.config.names().strict();
            self.metrics = Some(tokio::spawn(metrics_http::serve(listener, metrics, names)));
        }
        Ok(())
    }

    /// Completes when a listener ends although nobody asked it to.
    async fn listener_failed(&mut self) -> anyhow::Error {
        match self.listeners.join_next().await {
            Some(Ok(Err(error))) => anyhow::Error::new(error),
            Some(Err(error)) => anyhow::Error::new(error),
            Some(Ok(Ok(()))) => anyhow::anyhow!("a listener ended"),
            None => future::pending().await,
        }
    }

    /// Takes nothing new and says that it is not serving, but serves on: while somebody drives a plant, and so that
    /// balancers send nobody here who would not be let in. Not longer than the configured time, nor after `hurry`.
    pub async fn drain(&mut self, hurry: impl Future<Output = ()>) {
        self.hub.drain.begin();
        self.hub.metrics.draining();
        self.say_not_serving().await;
        let limit = self.hub.drain.limit().unwrap_or(self.config.drain());
        let has_asked = self.is_asked_for_health.load(Ordering::Relaxed);
        let is_needed = || has_asked || self.hub.driven() > 0;
        if limit.is_zero() || !is_needed() {
            return;
        }
        tracing::info!(
            driven = self.hub.driven(),
            "draining for {} s at most",
            limit.as_secs_f64()
        );
        let is_over = async {
            while is_needed() {
                tokio::time::sleep(DRAIN_PERIOD).await;
            }
        };
        tokio::select! {
            () = is_over => {}
            () = tokio::time::sleep(limit) => {}
            () = hurry => {}
        }
    }

    async fn say_not_serving(&mut self) {
        let Some(health) = self.health.take() else { return };
        health.set_not_serving::<ModelServiceServer<ModelService>>().await;
        health.set_not_serving::<PlantServiceServer<PlantService>>().await;
        health.set_not_serving::<ControlServiceServer<ControlService>>().await;
        health.set_not_serving::<ChannelServiceServer<ChannelService>>().await;
        health.set_not_serving::<RecordingServiceServer<RecordingService>>().await;
    }

    /// Ends: no new connections, streams end with UNAVAILABLE, calls may finish within the grace.
    /// What is left then ends with the runtime.
    pub async fn stop(self) {
        self.stop_within(future::pending()).await;
    }

    /// Ends, with a grace that `hurry` cuts short.
    async fn stop_within(mut self, hurry: impl Future<Output = ()>) {
        self.say_not_serving().await;
        self.closing.cancel();
        let hub = Arc::clone(&self.hub);
        let links_closed = tokio::task::spawn_blocking(move || hub.shut_down());
        let calls_ended = async { while self.listeners.join_next().await.is_some() {} };
        let grace = self.config.shutdown_grace();
        let is_over = async {
            tokio::select! {
                () = tokio::time::sleep(grace) => {}
                () = hurry => {}
            }
        };
        let have_ended = tokio::select! {
            biased;
            () = calls_ended => true,
            () = is_over => false,
        };
        if !have_ended {
            tracing::warn!("open calls are cut off");
            self.listeners.abort_all();
        }
        if let Err(error) = links_closed.await {
            tracing::error!(%error, "shared-memory links were not closed");
        }
        self.saver.abort();
        self.archiver.abort();
        self.memory.abort();
        self.reaper.abort();
        self.lookouts.abort_all();
        save_at_the_end(&self.hub).await;
        let archived = tokio::time::timeout(SAVE_WAIT_MAX, archive_once(&self.hub)).await;
        if archived.is_err() {
            tracing::warn!("recordings stay where they are: the object store takes too long");
        }
        if let Some(metrics) = &self.metrics {
            metrics.abort();
        }
    }
}

/// Saves the plants that change, over and over; without an interval never.
async fn save_plants(hub: Arc<Hub>, interval: Duration) {
    if hub.state.is_none() || interval.is_zero() {
        return;
    }
    loop {
        tokio::time::sleep(interval).await;
        save_once(&hub).await;
    }
}

/// Brings recordings that have ended into the archive, over and over.
async fn archive_recordings(hub: Arc<Hub>) {
    if !hub.recordings.as_ref().is_some_and(Recordings::has_archive) {
        return;
    }
    loop {
        tokio::time::sleep(ARCHIVE_PERIOD).await;
        archive_once(&hub).await;
    }
}

async fn archive_once(hub: &Arc<Hub>) {
    let hub = Arc::clone(hub);
    let archive = move || hub.recordings.as_ref().map(Recordings::archive_ended);
    if let Err(error) = tokio::task::spawn_blocking(archive).await {
        tracing::error!(%error, "recordings were not archived");
    }
}

/// Deletes plants that nobody has used for as long as they are to be kept, and counts what waits, over and over.
async fn delete_expired(hub: Arc<Hub>) {
    loop {
        tokio::time::sleep(EXPIRY_PERIOD).await;
        hub.delete_expired().await;
        let pools = [&hub.workers, &hub.attendants, &hub.steppers];
        hub.metrics.set_waiting_jobs(pools.map(|jobs| jobs.workers().waiting()).iter().sum());
    }
}

/// Saves the plants for the next server: as long as it takes, unless the disk does not answer at all.
async fn save_at_the_end(hub: &Arc<Hub>) {
    let Some(state) = &hub.state else { return };
    state.give_up();
    let mut saving = pin!(save_once(hub));
    let mut before = state.progress();
    while tokio::time::timeout(SAVE_WAIT_MAX, &mut saving).await.is_err() {
        let now = state.progress();
        if now == before {
            let plants = now.0;
            tracing::error!(plants, "the store does not answer: these are not saved, or more");
            return;
        }
        before = now;
    }
    state.store.release();
}

async fn save_once(hub: &Arc<Hub>) {
    let hub = Arc::clone(hub);
    let save = move || hub.state.as_ref().map(|state| state.save(&hub));
    if let Err(error) = tokio::task::spawn_blocking(save).await {
        tracing::error!(%error, "plants were not saved");
    }
}

/// The services with the layer that counts calls, for whoever is in this process.
pub type Services = Observe<Routes>;

type Layers = Stack<
    ObserveLayer,
    Stack<GrpcWebLayer, Stack<PageLayer, Stack<GuardLayer, Stack<GateLayer, Identity>>>>,
>;

/// An address under which this machine reaches what listens at one.
fn within(address: SocketAddr) -> SocketAddr {
    let ip = match address.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        ip => ip,
    };
    SocketAddr::new(ip, address.port())
}

/// Where the plants of a server survive it: a directory; or an object store if it is given by a URL, to which recordings
/// that have ended go, too.
fn open_store(path: &Path, config: &Config, hub: &Hub) -> Result<Opened> {
    let tenants = Arc::clone(&hub.tenants);
    let Some(url) = path.to_str().filter(|text| text.contains("://")) else {
        return Ok((Arc::new(Directory::open(path, config.file_mode, tenants)?), None));
    };
    #[cfg(feature = "object-store")]
    {
        use crate::wire::shared::state::store::Shared as _;
        let objects = Arc::new(Objects::open(url, hub.identity.name(), tenants)?);
        if let Some(address) = &config.advertise {
            objects.announce(address);
        }
        Ok((Arc::clone(&objects) as _, Some(objects)))
    }
    #[cfg(not(feature = "object-store"))]
    anyhow::bail!("`{url}` needs a plantd that was built with the feature `object-store`");
}

type Opened = (Arc<dyn Store>, Option<Arc<dyn Archive>>);

/// Finds the files of models for the page.
fn find_file(hub: Arc<Hub>) -> FindFile {
    Arc::new(move |model, path| hub.catalog.files(model)?.get(path))
}
