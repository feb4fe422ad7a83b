//! Rules that say who the holders of certificates and the users of this machine are: those of the configuration, then
//! those of a file that is read again when it changes.

use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

use serde::Deserialize;

use crate::core::tenant::{Tenants, is_tenant_name};
use crate::wire::edge::admission::Place;
use crate::wire::edge::auth::credential::Principal;
use crate::wire::edge::auth::file::{self, FileError};
use crate::wire::edge::auth::gateway::Said;
use crate::wire::edge::auth::role::Role;
use crate::wire::edge::auth::settings::{ANY_SUBJECT, AuthSettings, CertificateRule, PeerRule};
use crate::wire::edge::certificate::Certificate;

/// By what the other end of a connection is known.
#[derive(Clone, Debug)]
pub(super) enum Identity {
    /// The certificate that it has shown.
    Certificate(Arc<Certificate>),
    /// The user whose process it is.
    User(u32),
}

impl Identity {
    /// That of a connection, if it has one.
    pub(super) fn of(place: &Place) -> Option<Self> {
        let certificate = place.certificate().map(|known| Self::Certificate(Arc::clone(known)));
        certificate.or_else(|| place.uid().map(Self::User))
    }

    /// Until when it counts; none for ever.
    pub(super) fn expires(&self) -> Option<SystemTime> {
        match self {
            Self::Certificate(certificate) => Some(certificate.expires),
            Self::User(_) => None,
        }
    }
}

/// The rules in force; the first that fits counts.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct Rules {
    certificates: Vec<CertificateRule>,
    peers: Vec<PeerRule>,
}

impl Rules {
    /// Those of the configuration, and of its file if there is one.
    pub(super) fn read(settings: &AuthSettings) -> Result<Self, FileError> {
        let mut rules =
            Self { certificates: settings.certificates.clone(), peers: settings.peers.clone() };
        if let Some(path) = &settings.rules {
            let problem = |problem| FileError { what: "rules", path: path.clone(), problem };
            let more = Self::in_file(path).map_err(problem)?;
            rules.certificates.extend(more.certificates);
            rules.peers.extend(more.peers);
        }
        Ok(rules)
    }

    fn in_file(path: &Path) -> Result<Self, String> {
        let rules: Self = file::read(path)?;
        let certificates = rules.certificates.iter().map(|rule| &rule.tenant);
        let mut tenants = certificates.chain(rules.peers.iter().map(|rule| &rule.tenant));
        match tenants.find(|tenant| !is_tenant_name(tenant)) {
            Some(wrong) => Err(format!("`{wrong}` is no name of a tenant")),
            None => Ok(rules),
        }
    }

    /// What is said of whoever has that identity.
    pub(super) fn of(&self, identity: &Identity) -> Option<Rule<'_>> {
        match identity {
            Identity::Certificate(certificate) => self.certificates.iter().find_map(|rule| {
                let is_it = |name: &&String| rule.subject == ANY_SUBJECT || **name == rule.subject;
                let name = certificate.names.iter().find(is_it)?.clone();
                let (tenant, role, is_gateway) = (&rule.tenant, rule.role, rule.gateway);
                Some(Rule { name, tenant, role, is_gateway })
            }),
            Identity::User(uid) => {
                let rule = self.peers.iter().find(|rule| rule.uid == *uid)?;
                let name = rule.name.clone().unwrap_or_else(|| format!("uid {uid}"));
                let (tenant, role, is_gateway) = (&rule.tenant, rule.role, rule.gateway);
                Some(Rule { name, tenant, role, is_gateway })
            }
        }
    }
}

/// What a rule says of whoever is at the other end of a connection.
pub(super) struct Rule<'a> {
    name: String,
    tenant: &'a str,
    role: Role,
    pub(super) is_gateway: bool,
}

impl Rule<'_> {
    /// Who calls: a gateway is nobody itself, and nobody else speaks for others.
    pub(super) fn principal(self, said: Option<&Said>, tenants: &Tenants) -> Option<Principal> {
        let (name, tenant, role) = match said.filter(|_| self.is_gateway) {
            None if self.is_gateway => return None,
            None => (self.name, self.tenant, self.role),
            Some(said) => {
                let tenant = said.tenant.as_deref().unwrap_or(self.tenant);
                (said.name.clone(), tenant, said.role.unwrap_or(self.role).min(self.role))
            }
        };
        let tenant_name = tenant.to_owned();
        Some(Principal { name, tenant: tenants.named(tenant), tenant_name, role })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Rules, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rules.toml");
        std::fs::write(&path, text).unwrap();
        let own = PeerRule {
            uid: 7,
            name: None,
            tenant: "own".to_owned(),
            role: Role::Admin,
            gateway: false,
        };
        let settings =
            AuthSettings { rules: Some(path), peers: vec![own], ..AuthSettings::default() };
        Rules::read(&settings).map_err(|error| error.to_string())
    }

    #[test]
    fn the_configuration_comes_before_the_file() {
        let text = "[[peers]]\nuid = 7\nrole = \"viewer\"\n[[peers]]\nuid = 8\nname = \"eve\"\n\
                    tenant = \"lab\"\nrole = \"driver\"\n\
                    [[certificates]]\nsubject = \"*\"\nrole = \"viewer\"\n";
        let (rules, tenants) = (read(text).unwrap(), Tenants::default());
        let of = |uid| rules.of(&Identity::User(uid))?.principal(None, &tenants);
        assert_eq!(of(7).unwrap().role, Role::Admin);
        let eve = of(8).unwrap();
        assert_eq!((eve.name.as_str(), eve.tenant_name.as_str()), ("eve", "lab"));
        assert_eq!(of(9), None);
        let names = vec!["robot".to_owned()];
        let certificate = Certificate { names, expires: SystemTime::UNIX_EPOCH };
        let robot = Identity::Certificate(Arc::new(certificate));
        assert_eq!(rules.of(&robot).unwrap().principal(None, &tenants).unwrap().name, "robot");
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (text, word) in [
            ("peers = 3", "line 1"),
            ("\n[[peers]]\nuid = 1\nrole = \"king\"", "line 4"),
            ("[[peers]]\nuid = 1\nrole = \"admin\"\ntenant = \"../x\"", "../x"),
            ("other = 1", "other"),
        ] {
            let error = read(text).unwrap_err();
            assert!(error.contains(word) && error.contains("rules.toml"), "{error}");
        }
    }
}
