//! Who somebody is: by what a gateway says of the caller, else by the token of the request, else by the certificate of
//! the connection, else by the user at the other end of the unix-domain socket.

use std::collections::HashMap;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError, RwLock, Weak};
use std::time::{Duration, SystemTime};

use tonic::Code;
use tonic::codegen::http::HeaderMap;
use tonic::codegen::http::header::AUTHORIZATION;

use crate::core::mutex::lock;
use crate::core::room::Reservation;
use crate::core::tenant::{Tenant, Tenants};
use crate::wire::edge::admission::Place;
use crate::wire::edge::auth::credential::{Credential, Over, Pass, Principal};
use crate::wire::edge::auth::file::FileError;
use crate::wire::edge::auth::gateway::{HeaderError, Said};
use crate::wire::edge::auth::role::{Needs, Role, needs, watches};
use crate::wire::edge::auth::rules::{Identity, Rules};
use crate::wire::edge::auth::settings::AuthSettings;
use crate::wire::edge::auth::tokens::Tokens;
use crate::wire::status::RpcError;

/// How often the files of tokens and rules and the time are looked at.
pub const LOOK_PERIOD: Duration = Duration::from_secs(1);

/// Longest token, bytes.
const TOKEN_BYTES_MAX: usize = 512;

/// Most tenants with those that gateways name.
const TENANTS_MAX: usize = 10_000;

/// What a file was when it was read. Another one of the same name differs in one of these.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamp {
    modified: (i64, i64),
    bytes: u64,
    inode: u64,
}

impl Stamp {
    /// That of a file; none where there is no file.
    pub fn of(path: &Path) -> Option<Self> {
        let metadata = std::fs::metadata(path).ok()?;
        let modified = (metadata.mtime(), metadata.mtime_nsec());
        Some(Self { modified, bytes: metadata.len(), inode: metadata.ino() })
    }
}

/// Where everybody who asks for something has to say who they are.
pub struct Door {
    settings: AuthSettings,
    tenants: Arc<Tenants>,
    tokens: RwLock<Tokens>,
    stamp: Mutex<Option<Stamp>>,
    rules: RwLock<Rules>,
    rules_stamp: Mutex<Option<Stamp>>,
    /// Credentials of connections, by the connection's number and what a gateway has said of the caller. They live as
    /// long as the connection, those of a gateway's callers as long as they are used.
    of_connections: Mutex<HashMap<(u64, Option<Said>), Known>>,
}

/// A connection that has made a call.
struct Known {
    credential: Weak<Credential>,
    identity: Identity,
}

impl Known {
    fn credential(&self) -> Option<Arc<Credential>> {
        self.credential.upgrade()
    }
}

/// Why somebody is not let in.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Stranger {
    Nameless,
    BadHeader,
    UnknownToken,
    UnknownCertificate,
    UnknownUser(u32),
    Unnamed,
    WrongGatewayHeader(HeaderError),
    TooManyTenants,
}

/// A call that is not let in.
pub(super) struct Refused {
    /// Of whom, if that is known.
    pub(super) tenant: Tenant,
    /// Why.
    pub(super) error: RpcError,
}

impl From<Stranger> for RpcError {
    fn from(stranger: Stranger) -> Self {
        let (reason, sentence) = match stranger {
            Stranger::Nameless => (
                "NO_CREDENTIALS",
                "the server wants to know who calls: give a token, or a client certificate that it knows".to_owned(),
            ),
            Stranger::BadHeader => (
                "NO_CREDENTIALS",
                "the header `authorization` has to be `Bearer TOKEN`, once".to_owned(),
            ),
            Stranger::UnknownToken => (
                "TOKEN_UNKNOWN",
                "the server does not know this token: it was revoked, or is another server's".to_owned(),
            ),
            Stranger::UnknownCertificate => (
                "CERTIFICATE_UNKNOWN",
                "no rule of the server says who the holder of this certificate is: see `auth.certificates`".to_owned(),
            ),
            Stranger::UnknownUser(uid) => (
                "USER_UNKNOWN",
                format!("no rule of the server says who the user with number {uid} is: see `auth.peers`, or give a token"),
            ),
            Stranger::Unnamed => (
                "NO_CREDENTIALS",
                "the gateway has not said who calls, in the header `plantd-user`".to_owned(),
            ),
            Stranger::WrongGatewayHeader(error) => ("GATEWAY_HEADER", error.to_string()),
            Stranger::TooManyTenants => (
                "GATEWAY_HEADER",
                format!("the gateway's header `plantd-tenant` names another tenant, and there are {TENANTS_MAX} already"),
            ),
        };
        Self::new(Code::Unauthenticated, reason, sentence)
    }
}

impl Door {
    /// A door as the configuration has it.
    pub fn new(settings: AuthSettings, tenants: Arc<Tenants>) -> Result<Self, FileError> {
        let door = Self {
            settings,
            tenants,
            tokens: RwLock::default(),
            stamp: Mutex::default(),
            rules: RwLock::default(),
            rules_stamp: Mutex::default(),
            of_connections: Mutex::default(),
        };
        if let Some(path) = &door.settings.tokens {
            door.read_tokens(path)?;
        }
        door.read_rules()?;
        Ok(door)
    }

    /// Whoever is somebody else by the new rules, or nobody, is let in no more as who they were.
    fn read_rules(&self) -> Result<(), FileError> {
        *lock(&self.rules_stamp) = self.stamp_of_rules();
        let new = Rules::read(&self.settings)?;
        let mut rules = self.rules.write().unwrap_or_else(PoisonError::into_inner);
        *rules = new;
        lock(&self.of_connections).retain(|(_, said), known| {
            let Some(credential) = known.credential() else { return false };
            let rule = rules.of(&known.identity);
            let principal = rule.and_then(|rule| rule.principal(said.as_ref(), &self.tenants));
            let is_same = principal.as_ref() == Some(&credential.principal);
            if !is_same {
                credential.end(Over::Revoked);
            }
            is_same
        });
        Ok(())
    }

    fn stamp_of_rules(&self) -> Option<Stamp> {
        self.settings.rules.as_deref().and_then(Stamp::of)
    }

    fn read_tokens(&self, path: &Path) -> Result<(), FileError> {
        // Before it is read: what is written meanwhile is found the next time.
        let stamp = Stamp::of(path);
        let mut tokens = self.tokens.write().unwrap_or_else(PoisonError::into_inner);
        *lock(&self.stamp) = stamp;
        *tokens = Tokens::read(path, &self.tenants, &tokens)?;
        tracing::info!(path = %path.display(), count = tokens.count(), "tokens read");
        Ok(())
    }

    /// Looks over and over whether the files of tokens and rules have changed, and who has expired.
    pub async fn look_after(self: Arc<Self>) {
        loop {
            tokio::time::sleep(LOOK_PERIOD).await;
            let door = Arc::clone(&self);
            // The disk may not answer.
            let _ = tokio::task::spawn_blocking(move || door.look()).await;
        }
    }

    fn look(&self) {
        if let Some(path) = &self.settings.tokens
            && Stamp::of(path) != *lock(&self.stamp)
            && let Err(error) = self.read_tokens(path)
        {
            tracing::error!(%error, "the tokens that were known before stay in force");
        }
        if self.stamp_of_rules() != *lock(&self.rules_stamp) {
            match self.read_rules() {
                Ok(()) => tracing::info!("rules of identities read"),
                Err(error) => {
                    tracing::error!(%error, "the rules that were known before stay in force")
                }
            }
        }
        let now = SystemTime::now();
        self.tokens.read().unwrap_or_else(PoisonError::into_inner).end_expired(now);
        lock(&self.of_connections).retain(|_, credential| {
            let credential = credential.credential();
            credential.iter().for_each(|credential| credential.end_if_expired(now));
            credential.is_some()
        });
    }

    /// Lets a call in, if its caller may make it; nothing is needed of a call without a pass.
    pub(super) fn admit(
        &self,
        path: &str,
        is_call: bool,
        headers: &HeaderMap,
        place: Option<&Arc<Place>>,
    ) -> Result<Option<Arc<Pass>>, Refused> {
        let role = match needs(path) {
            Needs::Nothing if is_call => return Ok(None),
            Needs::Role(role) if is_call => role,
            _ => Role::Viewer,
        };
        let credential = self
            .identify(headers, place)
            .map_err(|stranger| Refused { tenant: Tenant::NONE, error: stranger.into() })?;
        let tenant = credential.principal.tenant;
        let rooms = self.check(&credential, role, path, is_call);
        let rooms = rooms.map_err(|error| Refused { tenant, error })?;
        let number = place.map_or(0, |place| place.id() + 1);
        let messages = Arc::clone(&self.tenants.account(tenant).rates.messages_per_s);
        Ok(Some(Pass::new(credential, number, messages, rooms)))
    }

    /// Whether somebody may make this call; what it takes of the tenant's room.
    fn check(
        &self,
        credential: &Credential,
        role: Role,
        path: &str,
        is_call: bool,
    ) -> Result<[Option<Reservation>; 2], RpcError> {
        credential.end_if_expired(SystemTime::now());
        if let Some(over) = credential.over() {
            return Err(over.into());
        }
        let Principal { name, tenant, role: own, .. } = &credential.principal;
        if *own < role {
            let (own, role) = (own.as_str(), role.as_str());
            let sentence = format!("`{name}` has the role `{own}`; this needs `{role}`");
            return Err(RpcError::new(Code::PermissionDenied, "ROLE", sentence));
        }
        let account = self.tenants.account(*tenant);
        let stream = is_call.then(|| account.rooms.streams.reserve(1)).transpose()?;
        let is_watcher = is_call && watches(path);
        let watcher = is_watcher.then(|| account.rooms.watchers.reserve(1)).transpose()?;
        Ok([stream, watcher])
    }

    fn identify(
        &self,
        headers: &HeaderMap,
        place: Option<&Arc<Place>>,
    ) -> Result<Arc<Credential>, Stranger> {
        if Said::is_in(headers)
            && let Some(place) = place
            && let Some(identity) = Identity::of(place)
            && self.is_gateway(&identity)
        {
            let said = Said::read(headers).map_err(Stranger::WrongGatewayHeader)?;
            return self.of_connection(place, identity, Some(said));
        }
        let mut values = headers.get_all(AUTHORIZATION).iter();
        if let Some(value) = values.next() {
            let token = bearer(value.as_bytes()).filter(|_| values.next().is_none());
            let token = token.ok_or(Stranger::BadHeader)?;
            let tokens = self.tokens.read().unwrap_or_else(PoisonError::into_inner);
            return tokens.find(token).map(Arc::clone).ok_or(Stranger::UnknownToken);
        }
        let place = place.ok_or(Stranger::Nameless)?;
        let identity = Identity::of(place).ok_or(Stranger::Nameless)?;
        self.of_connection(place, identity, None)
    }

    /// Who calls over a connection.
    fn of_connection(
        &self,
        place: &Place,
        identity: Identity,
        said: Option<Said>,
    ) -> Result<Arc<Credential>, Stranger> {
        let key = (place.id(), said);
        let known = lock(&self.of_connections).get(&key).and_then(Known::credential);
        if let Some(credential) = known {
            return Ok(credential);
        }
        let credential = self.credential(&identity, key.1.as_ref())?;
        if key.1.is_none() {
            let kept: Arc<Credential> = Arc::clone(&credential);
            place.keep(kept);
        }
        let known = Known { credential: Arc::downgrade(&credential), identity };
        lock(&self.of_connections).insert(key, known);
        Ok(credential)
    }

    fn credential(
        &self,
        identity: &Identity,
        said: Option<&Said>,
    ) -> Result<Arc<Credential>, Stranger> {
        let tenant = said.and_then(|said| said.tenant.as_deref());
        if tenant.is_some_and(|tenant| !self.tenants.has_room_for(tenant, TENANTS_MAX)) {
            return Err(Stranger::TooManyTenants);
        }
        let rules = self.rules.read().unwrap_or_else(PoisonError::into_inner);
        let stranger = match identity {
            Identity::Certificate(_) => Stranger::UnknownCertificate,
            Identity::User(uid) => Stranger::UnknownUser(*uid),
        };
        let rule = rules.of(identity).ok_or(stranger)?;
        let principal = rule.principal(said, &self.tenants).ok_or(Stranger::Unnamed)?;
        let expires = [identity.expires(), said.and_then(Said::expires)];
        Ok(Credential::new(principal, expires.into_iter().flatten().min()))
    }

    /// Whether the other end of a connection speaks for others.
    fn is_gateway(&self, identity: &Identity) -> bool {
        let rules = self.rules.read().unwrap_or_else(PoisonError::into_inner);
        rules.of(identity).is_some_and(|rule| rule.is_gateway)
    }
}

/// The token of a header `Bearer TOKEN`.
fn bearer(value: &[u8]) -> Option<&[u8]> {
    let (scheme, token) = value.split_at_checked(b"bearer ".len())?;
    let is_bearer = scheme.eq_ignore_ascii_case(b"bearer ");
    let token = token.trim_ascii();
    (is_bearer && !token.is_empty() && token.len() <= TOKEN_BYTES_MAX).then_some(token)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_header_has_one_bearer_token() {
        assert_eq!(bearer(b"Bearer abc"), Some(&b"abc"[..]));
        assert_eq!(bearer(b"bearer  abc "), Some(&b"abc"[..]));
        for wrong in [&b"Basic abc"[..], b"Bearer", b"Bearer ", b"", b"abc", &[b'x'; 600]] {
            assert_eq!(bearer(wrong), None);
        }
        assert_eq!(bearer(&[&b"Bearer "[..], &[b'x'; 600]].concat()), None);
    }
}
