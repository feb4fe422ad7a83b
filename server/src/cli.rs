//! The command line of `plantd`.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};

use crate::config::{Config, ConfigError, Listen, LogFormat};
use crate::core::modes::Mode;
use crate::core::priority::Priority;

/// Simulated plants for real-time controllers.
#[derive(Debug, Parser)]
#[command(name = "plantd", version, about, args_override_self = true)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Serve until SIGTERM or SIGINT.
    ///
    /// Flags win over environment variables, those over the configuration file; of two flags the last wins.
    #[command(after_help = "Examples:\n  \
        plantd serve\n  \
        plantd serve --unix /run/plantd/plantd.sock\n  \
        plantd serve --config /etc/plantd/plantd.toml --limit plants=10")]
    Serve(Box<Settings>),
    /// Show the limits in force, with the names by which they can be set.
    Limits(Box<Settings>),
}

/// Flags and environment variables over a configuration file.
#[derive(Debug, Default, Args)]
pub struct Settings {
    /// Configuration file, TOML.
    #[arg(long, env = "PLANTD_CONFIG", value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Name of this server among others; that of the machine if not given.
    #[arg(long, env = "PLANTD_NAME")]
    pub name: Option<String>,
    /// Address by which clients reach it; where it listens if not given.
    #[arg(long, env = "PLANTD_ADVERTISE", value_name = "ADDRESS")]
    pub advertise: Option<String>,
    /// gRPC over TCP; port 0 takes any free one; `off` for none.
    #[arg(long, env = "PLANTD_GRPC", value_name = "ADDRESS:PORT")]
    pub grpc: Option<Listen>,
    /// gRPC over a unix-domain socket.
    #[arg(long, env = "PLANTD_UNIX", value_name = "PATH")]
    pub unix: Option<PathBuf>,
    /// Mode of that socket, octal: who may connect.
    #[arg(long, env = "PLANTD_UNIX_MODE", value_name = "MODE")]
    pub unix_mode: Option<Mode>,
    /// Mode of saved plants and recordings, octal.
    #[arg(long, env = "PLANTD_FILE_MODE", value_name = "MODE")]
    pub file_mode: Option<Mode>,
    /// Prometheus metrics over HTTP; `off` for none.
    #[arg(long, env = "PLANTD_METRICS", value_name = "ADDRESS:PORT")]
    pub metrics: Option<Listen>,
    /// Origin of pages that may call, such as `https://panel.example`; may be repeated.
    #[arg(
        long = "allow-origin",
        env = "PLANTD_ALLOWED_ORIGINS",
        value_name = "ORIGIN",
        value_delimiter = ','
    )]
    pub allowed_origins: Vec<String>,
    /// Host name under which the server may be called; may be repeated.
    #[arg(
        long = "allow-host",
        env = "PLANTD_ALLOWED_HOSTS",
        value_name = "NAME",
        value_delimiter = ','
    )]
    pub allowed_hosts: Vec<String>,
    /// Listen beyond the loopback interface without TLS or without asking who calls.
    #[arg(
        long,
        env = "PLANTD_INSECURE",
        num_args = 0..=1,
        require_equals = true,
        default_missing_value = "true",
        value_parser = clap::builder::BoolishValueParser::new()
    )]
    pub insecure: Option<bool>,
    /// The page that shows the plants, on the port of gRPC.
    #[arg(long, env = "PLANTD_VIEW")]
    pub view: Option<Switch>,
    /// Shared-memory links.
    #[arg(long, env = "PLANTD_LINK")]
    pub link: Option<Switch>,
    /// Root path of the shared-memory domain.
    #[arg(long, env = "PLANTD_LINK_ROOT", value_name = "PATH")]
    pub link_root: Option<PathBuf>,
    /// Directory of scenes to load as models.
    #[arg(long, env = "PLANTD_SCENES", value_name = "DIRECTORY")]
    pub scenes: Option<PathBuf>,
    /// Directory in which plants survive the server, or an object store that servers share: `s3://bucket/folder`.
    #[arg(long, env = "PLANTD_STATE_DIRECTORY", value_name = "DIRECTORY|URL")]
    pub state_directory: Option<PathBuf>,
    /// Seconds between two savings of the plants that change; 0 means only at the end.
    #[arg(long, env = "PLANTD_STATE_INTERVAL_S", value_name = "SECONDS")]
    pub state_interval_s: Option<f64>,
    /// Directory of recordings.
    #[arg(long, env = "PLANTD_RECORDINGS", value_name = "DIRECTORY")]
    pub recordings: Option<PathBuf>,
    /// File to write the addresses into, as JSON, once the server serves.
    #[arg(long, env = "PLANTD_READY_FILE", value_name = "FILE")]
    pub ready_file: Option<PathBuf>,
    /// Threads that serve connections; 0 means one for each processor.
    #[arg(long, env = "PLANTD_THREADS", value_name = "COUNT")]
    pub threads: Option<usize>,
    /// Workers for long computations; 0 means one for each processor.
    #[arg(long, env = "PLANTD_WORKERS", value_name = "COUNT")]
    pub workers: Option<usize>,
    /// Scheduling priority of those workers.
    #[arg(long, env = "PLANTD_WORKER_PRIORITY")]
    pub worker_priority: Option<Priority>,
    /// Threads of one search for a trajectory; 0 means one for each processor.
    #[arg(long, env = "PLANTD_SEARCH_THREADS", value_name = "COUNT")]
    pub search_threads: Option<usize>,
    /// Seconds for open calls to end at shutdown.
    #[arg(long, env = "PLANTD_SHUTDOWN_GRACE_S", value_name = "SECONDS")]
    pub shutdown_grace_s: Option<f64>,
    /// Longest time to serve on after SIGTERM: while plants are driven, and for balancers to look elsewhere.
    #[arg(long, env = "PLANTD_DRAIN_S", value_name = "SECONDS")]
    pub drain_s: Option<f64>,
    /// What is logged, like RUST_LOG: `info`, `plantd_server=debug`.
    #[arg(long, env = "PLANTD_LOG", value_name = "FILTER")]
    pub log: Option<String>,
    /// Notation of log lines.
    #[arg(long, env = "PLANTD_LOG_FORMAT")]
    pub log_format: Option<LogFormat>,
    /// Set a limit; may be repeated.
    #[arg(
        long = "limit",
        env = "PLANTD_LIMITS",
        value_name = "NAME=VALUE",
        value_parser = limit_setting,
        value_delimiter = ','
    )]
    pub limits: Vec<(String, u64)>,
    /// End when standard input does: with the process at its other end, however that ends.
    #[arg(long)]
    pub until_stdin_ends: bool,
    /// Print the configuration in force, as TOML, and end.
    #[arg(long)]
    pub print_config: bool,
}

/// On or off.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Switch {
    /// On.
    On,
    /// Off.
    Off,
}

fn limit_setting(text: &str) -> Result<(String, u64), String> {
    let (name, value) = text.split_once('=').ok_or("NAME=VALUE is needed")?;
    let value = value.parse().map_err(|_| format!("`{value}` is not a whole number"))?;
    Ok((name.to_owned(), value))
}

impl Settings {
    /// The configuration in force.
    pub fn resolve(self) -> Result<Config, ConfigError> {
        let mut config = match &self.config {
            Some(path) => Config::from_file(path)?,
            None => Config::default(),
        };
        replace(&mut config.grpc, self.grpc);
        replace(&mut config.metrics, self.metrics);
        replace(&mut config.unix_mode, self.unix_mode);
        replace(&mut config.file_mode, self.file_mode);
        replace(&mut config.threads, self.threads);
        replace(&mut config.workers, self.workers);
        replace(&mut config.worker_priority, self.worker_priority);
        replace(&mut config.search_threads, self.search_threads);
        replace(&mut config.shutdown_grace_s, self.shutdown_grace_s);
        replace(&mut config.drain_s, self.drain_s);
        replace(&mut config.state_interval_s, self.state_interval_s);
        replace(&mut config.log.filter, self.log);
        replace(&mut config.log.format, self.log_format);
        replace(&mut config.insecure, self.insecure);
        replace(&mut config.view, self.view.map(|switch| switch == Switch::On));
        replace(&mut config.link.enabled, self.link.map(|switch| switch == Switch::On));
        config.name = self.name.or(config.name);
        config.advertise = self.advertise.or(config.advertise);
        config.unix = self.unix.or(config.unix);
        config.link.root = self.link_root.or(config.link.root);
        config.scenes = self.scenes.or(config.scenes);
        config.state_directory = self.state_directory.or(config.state_directory);
        config.recordings = self.recordings.or(config.recordings);
        config.ready_file = self.ready_file.or(config.ready_file);
        config.allowed_origins.extend(self.allowed_origins);
        config.allowed_hosts.extend(self.allowed_hosts);
        for (name, value) in &self.limits {
            config.limits.set(name, *value)?;
        }
        config.check()?;
        Ok(config)
    }
}

fn replace<T>(target: &mut T, value: Option<T>) {
    if let Some(value) = value {
        *target = value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(arguments: &[&str]) -> Settings {
        let arguments = ["plantd", "serve"].iter().chain(arguments);
        match Cli::try_parse_from(arguments).unwrap().command {
            Command::Serve(settings) => *settings,
            Command::Limits(_) => unreachable!("`serve` was given"),
        }
    }

    #[test]
    fn flags_win_over_the_file() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("plantd.toml");
        std::fs::write(&path, "metrics = \"127.0.0.1:1\"\nworkers = 3\n[limits]\nplants = 4")
            .unwrap();
        let path = path.to_str().unwrap();
        let config =
            settings(&["--config", path, "--metrics", "off", "--limit", "models=5"]).resolve();
        let config = config.unwrap();
        assert_eq!((config.metrics, config.workers), (Listen::Off, 3));
        assert_eq!((config.limits.plants, config.limits.models), (4, 5));
    }

    #[test]
    fn a_wrong_limit_is_refused_by_name() {
        let error = settings(&["--limit", "plant=5"]).resolve().unwrap_err().to_string();
        assert!(error.contains("`plant`"), "{error}");
    }

    #[test]
    fn the_command_line_is_well_formed() {
        use clap::CommandFactory as _;
        Cli::command().debug_assert();
    }
}
