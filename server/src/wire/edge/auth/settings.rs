//! What the configuration says of identities.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::core::tenant::is_tenant_name;
use crate::wire::edge::auth::role::Role;

/// The tenant of those of whom nothing else is said.
pub const DEFAULT_TENANT: &str = "default";

/// Stands for any name in a rule for certificates.
pub const ANY_SUBJECT: &str = "*";

/// The table `[auth]`. Without it nobody is asked who they are, and everybody may do everything.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AuthSettings {
    /// File of bearer tokens, which `plantctl token` writes; read again when it changes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tokens: Option<PathBuf>,
    /// File of further rules, the lists `certificates` and `peers`; read again when it changes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rules: Option<PathBuf>,
    /// Who the holders of client certificates are; the first rule that fits counts.
    pub certificates: Vec<CertificateRule>,
    /// Who the users are whose processes connect to the unix-domain socket; the first rule that fits counts.
    pub peers: Vec<PeerRule>,
}

/// Who the holder of a certificate is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CertificateRule {
    /// Common name of the subject, or one of its alternative names (DNS, URI, e-mail); `*` for any.
    pub subject: String,
    /// Whose plants they use.
    #[serde(default = "default_tenant")]
    pub tenant: String,
    /// What they may do.
    pub role: Role,
    /// They are a gateway, which says in headers for whom it calls. Then `tenant` is that of callers of whom it names
    /// none, and `role` the highest that it can give.
    #[serde(default)]
    pub gateway: bool,
}

/// Who a user of this machine is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PeerRule {
    /// Number of the user.
    pub uid: u32,
    /// How the user is called in the log; `uid NUMBER` if not given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Whose plants they use.
    #[serde(default = "default_tenant")]
    pub tenant: String,
    /// What they may do.
    pub role: Role,
    /// They are a gateway, which says in headers for whom it calls. Then `tenant` is that of callers of whom it names
    /// none, and `role` the highest that it can give.
    #[serde(default)]
    pub gateway: bool,
}

fn default_tenant() -> String {
    DEFAULT_TENANT.to_owned()
}

impl AuthSettings {
    /// The first tenant whose name is none.
    pub fn wrong_tenant(&self) -> Option<&str> {
        let certificates = self.certificates.iter().map(|rule| rule.tenant.as_str());
        let mut names = certificates.chain(self.peers.iter().map(|rule| rule.tenant.as_str()));
        names.find(|name| !is_tenant_name(name))
    }
}
