//! The configuration: defaults, then the file, then the environment, then flags; the last one wins.

use std::collections::BTreeMap;
use std::fmt;
use std::net::{Ipv4Addr, SocketAddr, ToSocketAddrs as _};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

use plantd_models::scene::{in_plain_words, line_of};
use plantd_proto::link::Wait;
use serde::{Deserialize, Serialize};

use crate::core::limits::{LimitError, Limits};
use crate::core::modes::Mode;
use crate::core::priority::{Priority, Scheduling};
use crate::core::realtime::settings::RealTimeSettings;
use crate::core::tenant::{ANY_TENANT, TenantSettings, is_tenant_name};
use crate::tls::{ClientCertificates, TlsSettings};
use crate::wire::edge::auth::settings::AuthSettings;
use crate::wire::link::config::LinkConfig;
use crate::wire::names::{Names, host_of, is_address, is_host_name, is_origin};

/// Port of gRPC over TCP unless another one is given.
pub const DEFAULT_PORT: u16 = 50051;

/// Longest time that can be configured, s: a day.
const DURATION_MAX_S: f64 = 86_400.0;

/// Everything that can be configured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Name of this server among others, by which its plants say where they are; the machine's if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Address by which clients reach it: `https://plantd-1.lab:50051`; where it listens if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub advertise: Option<String>,
    /// gRPC over TCP: `address:port` or `name:port`, port 0 for any free one, or `off`.
    pub grpc: Listen,
    /// gRPC over a unix-domain socket at this path; not given means none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unix: Option<PathBuf>,
    /// Mode of that socket, whatever the umask: who may connect.
    pub unix_mode: Mode,
    /// Mode of saved plants and recordings, whatever the umask. Directories that are made for them may be
    /// entered by those who may read the files.
    pub file_mode: Mode,
    /// Metrics at `http://address:port/metrics`, or `off`.
    pub metrics: Listen,
    /// Origins of pages that may call, besides the server's own: `https://panel.example`.
    pub allowed_origins: Vec<String>,
    /// Host names under which it may be called, besides `localhost` and IP addresses.
    pub allowed_hosts: Vec<String>,
    /// Listen beyond the loopback interface without TLS or without asking who calls.
    pub insecure: bool,
    /// The page that shows the plants, at the address of gRPC over TCP.
    pub view: bool,
    /// Directory of scenes (`*.toml`, `*.json`) to load as models at the start, with their meshes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scenes: Option<PathBuf>,
    /// Directory in which plants survive the server, or an object store that servers share, `s3://bucket/folder`; not
    /// given means none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub state_directory: Option<PathBuf>,
    /// Time between two savings of the plants that change, s; 0 means only at the end.
    pub state_interval_s: f64,
    /// Directory of recordings; not given means that nothing can be recorded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recordings: Option<PathBuf>,
    /// File to write the addresses into, as JSON, once the server serves.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ready_file: Option<PathBuf>,
    /// Threads that serve connections; 0 means one for each processor.
    pub threads: usize,
    /// Workers for long computations; 0 means one for each processor.
    pub workers: usize,
    /// Scheduling priority of those workers.
    pub worker_priority: Priority,
    /// Threads that one search for a trajectory takes, its worker among them; 0 means one for each
    /// processor.
    pub search_threads: usize,
    /// Time for open calls to end at shutdown before they are cut off, s.
    pub shutdown_grace_s: f64,
    /// Longest time to serve on after SIGTERM or Drain, with health NOT_SERVING and taking nothing new, s: as
    /// long as somebody drives a plant; all of it where balancers have asked for the server's health.
    pub drain_s: f64,
    /// Logging.
    pub log: LogConfig,
    /// Traces.
    pub telemetry: TelemetrySettings,
    /// TLS of gRPC over TCP; without it nothing is encrypted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls: Option<TlsSettings>,
    /// Who is let in; without it everybody is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub auth: Option<AuthSettings>,
    /// What each tenant may use; `*` stands for those that are not named.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub tenants: BTreeMap<String, TenantSettings>,
    /// Shared-memory links.
    pub link: LinkSettings,
    /// Plants that follow the wall clock.
    pub realtime: RealTimeSettings,
    /// Limits.
    pub limits: Limits,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            name: None,
            advertise: None,
            grpc: Listen::At(SocketAddr::from((Ipv4Addr::LOCALHOST, DEFAULT_PORT))),
            unix: None,
            unix_mode: Mode::GROUP,
            file_mode: Mode::PRIVATE,
            metrics: Listen::Off,
            allowed_origins: Vec::new(),
            allowed_hosts: Vec::new(),
            insecure: false,
            view: true,
            scenes: None,
            state_directory: None,
            state_interval_s: 2.0,
            recordings: None,
            ready_file: None,
            threads: 0,
            workers: 0,
            worker_priority: Priority::default(),
            search_threads: 1,
            shutdown_grace_s: 5.0,
            drain_s: 5.0,
            log: LogConfig::default(),
            telemetry: TelemetrySettings::default(),
            tls: None,
            auth: None,
            tenants: BTreeMap::new(),
            link: LinkSettings::default(),
            realtime: RealTimeSettings::default(),
            limits: Limits::default(),
        }
    }
}

/// A name that DNS would take, too.
fn is_server_name(name: &str) -> bool {
    is_host_name(name) && name.len() <= 253
}

/// Where to listen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Listen {
    /// Nowhere.
    Off,
    /// At this address.
    At(SocketAddr),
}

impl Listen {
    /// Others than this machine can connect.
    pub fn is_beyond_loopback(self) -> bool {
        matches!(self, Self::At(address) if !address.ip().to_canonical().is_loopback())
    }
}

/// Why there is nowhere to listen.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ListenError {
    /// It is no address.
    #[error(
        "`{0}` is neither `off` nor an address like 127.0.0.1:50051, [::]:50051 or localhost:50051"
    )]
    NotAnAddress(String),
    /// Nothing has that name.
    #[error("`{0}` has the name of no machine: {1}")]
    Unknown(String, String),
}

impl FromStr for Listen {
    type Err = ListenError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "off" => Ok(Self::Off),
            _ => match text.parse() {
                Ok(address) => Ok(Self::At(address)),
                Err(_) => by_name(text).map(Self::At),
            },
        }
    }
}

/// The address of `name:port`, of IPv4 where there is one.
fn by_name(text: &str) -> Result<SocketAddr, ListenError> {
    let is_named = text.rsplit_once(':').is_some_and(|(name, port)| {
        !name.is_empty() && !name.contains([':', '/', ' ']) && port.parse::<u16>().is_ok()
    });
    if !is_named {
        return Err(ListenError::NotAnAddress(text.to_owned()));
    }
    let unknown = |problem: String| ListenError::Unknown(text.to_owned(), problem);
    let found = text.to_socket_addrs().map_err(|error| unknown(error.to_string()))?;
    let first = found.min_by_key(|address| !address.is_ipv4());
    first.ok_or_else(|| unknown("it has no address".to_owned()))
}

impl TryFrom<String> for Listen {
    type Error = ListenError;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl From<Listen> for String {
    fn from(listen: Listen) -> Self {
        listen.to_string()
    }
}

impl fmt::Display for Listen {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Off => f.write_str("off"),
            Self::At(address) => address.fmt(f),
        }
    }
}

/// Logging.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LogConfig {
    /// What is logged: a level, or levels of targets: `info`, `plantd_server=debug,info`.
    pub filter: String,
    /// How.
    pub format: LogFormat,
}

impl Default for LogConfig {
    fn default() -> Self {
        Self { filter: "info".to_owned(), format: LogFormat::Text }
    }
}

/// Where traces go.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TelemetrySettings {
    /// Collector of OTLP over gRPC, `http://host:port`; none means no traces. Takes the feature `otlp`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub otlp: Option<String>,
}

/// Notation of log lines.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum LogFormat {
    /// For people.
    Text,
    /// One JSON object a line.
    Json,
}

/// Shared-memory links.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LinkSettings {
    /// Links can be opened.
    pub enabled: bool,
    /// Root path of the iceoryx2 domain; not given means `$XDG_RUNTIME_DIR/plantd` or
    /// `/tmp/plantd-UID`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub root: Option<PathBuf>,
    /// How a link waits for the next input.
    pub wait: LinkWaitMode,
    /// Time for which `poll_then_sleep` polls after each answer, µs.
    pub poll_us: u64,
    /// A driver that sends nothing for this long loses the lease, s; 0 means never.
    pub idle_timeout_s: f64,
}

impl Default for LinkSettings {
    fn default() -> Self {
        Self {
            enabled: true,
            root: None,
            wait: LinkWaitMode::PollThenSleep,
            poll_us: 50,
            idle_timeout_s: 0.0,
        }
    }
}

/// How a link waits for the next input.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LinkWaitMode {
    /// Polls for `poll_us` after each answer, then sleeps until the driver rings.
    PollThenSleep,
    /// Polls all the time: lowest latency, takes a processor for each open link.
    Poll,
}

/// Why there is no configuration. Each is a whole sentence: a cause is told by it, and is no `source`, which
/// would be told once more.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("configuration file `{path}`: {cause}")]
    Read {
        /// Path.
        path: PathBuf,
        /// Cause.
        cause: std::io::Error,
    },
    /// The file is not a configuration.
    #[error("configuration file `{path}`, line {line}: {problem}")]
    Parse {
        /// Path.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong; names the key.
        problem: String,
    },
    /// A value is out of range.
    #[error("{key} is {value}; it must lie between 0 and {max}")]
    OutOfRange {
        /// Key.
        key: &'static str,
        /// Value.
        value: f64,
        /// Largest value allowed.
        max: f64,
    },
    /// A number of a key is out of range.
    #[error("`{key}` is {value}; it must lie between {low} and {high}")]
    NotBetween {
        /// Key.
        key: &'static str,
        /// Value.
        value: u64,
        /// Smallest value.
        low: u64,
        /// Largest value.
        high: u64,
    },
    /// A name of `allowed_origins` or `allowed_hosts` is none.
    #[error("`{key}` has `{value}`; it takes {what}")]
    Name {
        /// Key.
        key: &'static str,
        /// Value.
        value: String,
        /// What is allowed.
        what: &'static str,
    },
    /// A limit is unknown or out of range.
    #[error(transparent)]
    Limit(#[from] LimitError),
    /// A tenant has a name that none can have.
    #[error(
        "`{key}` has `{value}`, which is no name of a tenant: letters, digits and `-_.`, at most 64"
    )]
    Tenant {
        /// Key.
        key: &'static str,
        /// Value.
        value: String,
    },
    /// Clients are asked for certificates of nobody.
    #[error(
        "`tls.client` asks clients for certificates: `tls.client_ca` has to name those who issue them"
    )]
    ClientCa,
    /// Tenants without anybody who says whose call it is.
    #[error("`tenants` has limits, but without `[auth]` nobody is asked whose tenant they are of")]
    TenantsOfNobody,
    /// Others could reach the server, and nothing keeps them out.
    #[error(
        "{what} at {address} can be reached by other machines, {lack}: give it what it lacks, listen on \
         127.0.0.1 or on a unix-domain socket, or write `insecure = true` (`--insecure`) if the network is \
         closed to strangers"
    )]
    Exposed {
        /// What listens.
        what: &'static str,
        /// Where.
        address: SocketAddr,
        /// What is missing.
        lack: &'static str,
    },
    /// Nothing to serve on.
    #[error("gRPC is off and there is no unix socket: the server could not be reached")]
    Nowhere,
}

impl Config {
    /// Reads a file in TOML. Unknown keys are errors.
    pub fn from_file(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|cause| ConfigError::Read { path: path.to_owned(), cause })?;
        toml::from_str(&text).map_err(|error: toml::de::Error| {
            let line = line_of(&text, error.span().map_or(0, |span| span.start));
            let problem = in_plain_words(error.message());
            ConfigError::Parse { path: path.to_owned(), line, problem }
        })
    }

    fn check_identities(&self) -> Result<(), ConfigError> {
        let wrong = |key, value: &str| ConfigError::Tenant { key, value: value.to_owned() };
        let tenants = self.tenants.keys().filter(|name| name.as_str() != ANY_TENANT);
        if let Some(name) = tenants.into_iter().find(|name| !is_tenant_name(name)) {
            return Err(wrong("tenants", name));
        }
        if let Some(name) = self.auth.as_ref().and_then(AuthSettings::wrong_tenant) {
            return Err(wrong("auth", name));
        }
        if self.auth.is_none() && !self.tenants.is_empty() {
            return Err(ConfigError::TenantsOfNobody);
        }
        match &self.tls {
            Some(tls) if tls.client != ClientCertificates::None && tls.client_ca.is_none() => {
                Err(ConfigError::ClientCa)
            }
            _ => Ok(()),
        }
    }

    /// Refuses to be reached by other machines without TLS, or without asking who calls, unless that is written out.
    pub fn check_exposure(&self) -> Result<(), ConfigError> {
        self.exposure().filter(|_| !self.insecure).map_or(Ok(()), Err)
    }

    /// What other machines can reach without TLS, or without being asked who they are.
    pub fn exposure(&self) -> Option<ConfigError> {
        let needs_certificate =
            self.tls.as_ref().is_some_and(|tls| tls.client == ClientCertificates::Required);
        let lack = match (&self.tls, self.auth.is_some() || needs_certificate) {
            (None, false) => Some("without TLS, and asks nobody who they are"),
            (None, true) => Some("without TLS"),
            (Some(_), false) => Some("and asks nobody who they are"),
            (Some(_), true) => None,
        };
        // Metrics at an address of their own have neither; behind the door they are at that of gRPC.
        let metrics = Some("without TLS, and asks nobody who they are");
        for (what, listen, lack) in [("gRPC", self.grpc, lack), ("metrics", self.metrics, metrics)]
        {
            if let Listen::At(address) = listen
                && let Some(lack) = lack
                && listen.is_beyond_loopback()
            {
                return Some(ConfigError::Exposed { what, address, lack });
            }
        }
        None
    }

    /// Refuses values that are out of range.
    pub fn check(&self) -> Result<(), ConfigError> {
        self.limits.check()?;
        self.check_identities()?;
        for (key, value) in [
            ("shutdown_grace_s", self.shutdown_grace_s),
            ("drain_s", self.drain_s),
            ("state_interval_s", self.state_interval_s),
            ("link.idle_timeout_s", self.link.idle_timeout_s),
        ] {
            if !(0.0..=DURATION_MAX_S).contains(&value) {
                return Err(ConfigError::OutOfRange { key, value, max: DURATION_MAX_S });
            }
        }
        let realtime = &self.realtime;
        let priority = match realtime.scheduling {
            Scheduling::Normal => 1,
            Scheduling::Fifo(priority) => priority,
        };
        for (key, value, low, high) in [
            ("search_threads", self.search_threads as u64, 0, 64),
            ("realtime.threads", realtime.threads as u64, 1, 64),
            ("realtime.spin_us", realtime.spin_us, 0, 1000),
            ("realtime.scheduling.fifo", priority.into(), 1, 99),
        ] {
            if !(low..=high).contains(&value) {
                return Err(ConfigError::NotBetween { key, value, low, high });
            }
        }
        self.check_names()?;
        if self.grpc == Listen::Off && self.unix.is_none() {
            return Err(ConfigError::Nowhere);
        }
        Ok(())
    }

    fn check_names(&self) -> Result<(), ConfigError> {
        let wrong =
            |key, value: &String, what| Err(ConfigError::Name { key, value: value.clone(), what });
        if let Some(name) = self.name.as_ref().filter(|name| !is_server_name(name)) {
            return wrong("name", name, "letters, digits and `-_.`, at most 253");
        }
        if let Some(address) = self.advertise.as_ref().filter(|text| !is_address(text)) {
            return wrong(
                "advertise",
                address,
                "http://host:port, https://host:port or unix:/path",
            );
        }
        if let Some(origin) = self.allowed_origins.iter().find(|text| !is_origin(text)) {
            return wrong("allowed_origins", origin, "origins such as `https://panel.example`");
        }
        match self.allowed_hosts.iter().find(|text| !is_host_name(text)) {
            Some(host) => wrong("allowed_hosts", host, "host names without port"),
            None => Ok(()),
        }
    }

    /// The server's name among others.
    pub fn server_name(&self) -> String {
        let of_machine = || std::fs::read_to_string("/proc/sys/kernel/hostname").ok();
        let name = self.name.clone().or_else(|| of_machine().map(|name| name.trim().to_owned()));
        name.filter(|name| is_server_name(name)).unwrap_or_else(|| "plantd".to_owned())
    }

    /// By which names the server may be called.
    pub fn names(&self) -> Names {
        let Self { allowed_hosts: mut hosts, allowed_origins: origins, grpc, .. } = self.clone();
        // Its own, which nobody else's page can have.
        hosts.extend(self.name.clone());
        hosts.extend(self.advertise.as_deref().and_then(host_of).map(str::to_owned));
        Names { hosts, origins, any_host: grpc.is_beyond_loopback() }
    }

    /// Time for open calls to end at shutdown.
    pub fn shutdown_grace(&self) -> Duration {
        Duration::from_secs_f64(self.shutdown_grace_s)
    }

    /// Longest time to serve on after SIGTERM or Drain.
    pub fn drain(&self) -> Duration {
        Duration::from_secs_f64(self.drain_s)
    }

    /// Time between two savings of the plants that change.
    pub fn state_interval(&self) -> Duration {
        Duration::from_secs_f64(self.state_interval_s)
    }

    /// Number of workers.
    pub fn worker_count(&self) -> usize {
        count_or_processors(self.workers)
    }

    /// Number of threads that one search takes.
    pub fn search_thread_count(&self) -> usize {
        count_or_processors(self.search_threads)
    }

    /// Number of threads that serve connections.
    pub fn thread_count(&self) -> usize {
        count_or_processors(self.threads)
    }

    /// The configuration in TOML.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        toml::to_string(self)
    }
}

fn count_or_processors(count: usize) -> usize {
    match count {
        0 => std::thread::available_parallelism().map_or(1, usize::from),
        count => count,
    }
}

impl LinkSettings {
    /// What the links' host takes; none when links are off.
    pub fn host_config(&self) -> Option<LinkConfig> {
        if !self.enabled {
            return None;
        }
        let mut config = LinkConfig::default();
        if let Some(root) = &self.root {
            config.root.clone_from(root);
        }
        config.wait = match self.wait {
            LinkWaitMode::PollThenSleep => Wait::PollThenSleep(Duration::from_micros(self.poll_us)),
            LinkWaitMode::Poll => Wait::Poll,
        };
        config.idle_timeout =
            (self.idle_timeout_s > 0.0).then(|| Duration::from_secs_f64(self.idle_timeout_s));
        Some(config)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_printed_can_be_read_back() {
        let config = Config { unix: Some("/run/plantd.sock".into()), ..Config::default() };
        let text = config.to_toml().unwrap();
        assert_eq!(toml::from_str::<Config>(&text).unwrap(), config);
    }

    #[test]
    fn a_name_of_a_machine_is_an_address() {
        let at = |text: &str| text.parse::<Listen>();
        assert_eq!(at("127.0.0.1:5").unwrap(), at("localhost:5").unwrap());
        assert!(matches!(at("[::1]:5"), Ok(Listen::At(_))) && at("off") == Ok(Listen::Off));
        for wrong in ["localhost", "localhost:", ":5", "http://localhost:5", "a b:5", "a:99999"] {
            assert_eq!(at(wrong), Err(ListenError::NotAnAddress(wrong.to_owned())));
        }
        let unknown = at("no-such-host.invalid:5").unwrap_err().to_string();
        assert!(unknown.contains("`no-such-host.invalid:5`"), "{unknown}");
    }

    #[test]
    fn unknown_keys_are_named() {
        for (text, key) in [
            ("gprc = \"off\"", "gprc"),
            ("[limits]\nplant = 3", "plant"),
            ("[link]\nwait = \"poll\"\nrooot = \"/\"", "rooot"),
        ] {
            let file = tempfile::NamedTempFile::new().unwrap();
            std::fs::write(file.path(), text).unwrap();
            let error = Config::from_file(file.path()).unwrap_err().to_string();
            assert!(error.contains(&format!("there is no key `{key}`")), "{error}");
        }
    }

    #[test]
    fn values_out_of_range_are_refused() {
        let config = |text| toml::from_str::<Config>(text).unwrap();
        assert!(config("").check().is_ok());
        assert!(config("shutdown_grace_s = nan").check().is_err());
        assert!(config("grpc = \"off\"").check().is_err());
        assert!(config("grpc = \"off\"\nunix = \"/s\"").check().is_ok());
        assert!(config("allowed_hosts = [\"plants.lab\"]").check().is_ok());
        assert!(config("allowed_hosts = [\"plants.lab:1\"]").check().is_err());
        assert!(config("allowed_origins = [\"panel.example\"]").check().is_err());
        assert!(config("[limits]\nconnections = 0").check().is_err());
        assert!(config("[realtime]\nthreads = 0").check().is_err());
        assert!(config("[realtime]\nscheduling = { fifo = 100 }").check().is_err());
        assert!(config("[realtime]\nscheduling = { fifo = 80 }\nspin_us = 200").check().is_ok());
        assert!(toml::from_str::<Config>("grpc = \"localhost\"").is_err());
        assert!(config("unix_mode = \"0600\"").check().is_ok());
        let error = toml::from_str::<Config>("file_mode = \"0777\"").unwrap_err().to_string();
        assert!(error.contains("0777") && error.contains("octal"), "{error}");
    }

    #[test]
    fn programs_reach_a_server_beyond_loopback_by_any_name() {
        for (grpc, any_host) in
            [("127.0.0.1:1", false), ("[::1]:1", false), ("off", false), ("0.0.0.0:1", true)]
        {
            let config = Config { grpc: grpc.parse().unwrap(), ..Config::default() };
            assert_eq!(config.names().any_host, any_host, "{grpc}");
        }
    }
}
