//! The settings of the shared-memory links.

use std::path::PathBuf;
use std::time::Duration;

use plantd_proto::link::{Wait, default_root};

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
