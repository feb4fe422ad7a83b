//! By what somebody is known, and until when.

use std::sync::Arc;
use std::sync::OnceLock;
use std::time::SystemTime;

use tokio_util::sync::CancellationToken;
use tonic::Code;

use crate::core::connection::{Caller, Connection};
use crate::core::rate::Rate;
use crate::core::room::Reservation;
use crate::core::tenant::Tenant;
use crate::wire::edge::auth::role::Role;
use crate::wire::status::RpcError;

/// Somebody.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Principal {
    /// Name of the token, subject of the certificate, or name of the user.
    pub name: String,
    /// Whose plants they use.
    pub tenant: Tenant,
    /// The name of that.
    pub tenant_name: String,
    /// What they may do.
    pub role: Role,
}

/// Why a credential is not in force any more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Over {
    /// Its time has passed.
    Expired,
    /// It was taken away, or changed.
    Revoked,
}

/// What somebody is known by: a token, a certificate or a user of this machine.
#[derive(Debug)]
pub struct Credential {
    /// Who it is.
    pub principal: Principal,
    /// When it is over; none for never.
    pub expires: Option<SystemTime>,
    over: OnceLock<Over>,
    /// Cancelled when it is over.
    ending: CancellationToken,
}

impl Credential {
    /// A credential in force.
    pub fn new(principal: Principal, expires: Option<SystemTime>) -> Arc<Self> {
        let (over, ending) = (OnceLock::new(), CancellationToken::new());
        Arc::new(Self { principal, expires, over, ending })
    }

    /// Ends it, and the streams that were opened with it.
    pub fn end(&self, over: Over) {
        if self.over.set(over).is_ok() {
            self.ending.cancel();
        }
    }

    /// Ends it if its time has passed.
    pub fn end_if_expired(&self, now: SystemTime) {
        if self.expires.is_some_and(|expires| expires <= now) {
            self.end(Over::Expired);
        }
    }

    /// Why it is not in force any more, if it is not.
    pub fn over(&self) -> Option<Over> {
        self.over.get().copied()
    }
}

impl From<Over> for RpcError {
    fn from(over: Over) -> Self {
        let (reason, sentence) = match over {
            Over::Expired => (
                "CREDENTIALS_EXPIRED",
                "the token or certificate of this client has expired; ask the server's administrator for another",
            ),
            Over::Revoked => (
                "CREDENTIALS_REVOKED",
                "the token of this client was revoked or changed; ask the server's administrator for another",
            ),
        };
        Self::new(Code::Unauthenticated, reason, sentence)
    }
}

/// A call that was let in.
#[derive(Debug)]
pub struct Pass {
    credential: Arc<Credential>,
    connection: Connection,
    subject: Arc<OnceLock<String>>,
    messages: Arc<Rate>,
    /// Its tenant's room for open calls, and for watchers if it is one.
    _rooms: [Option<Reservation>; 2],
}

impl Pass {
    /// A call of somebody over a connection, by its number.
    pub(super) fn new(
        credential: Arc<Credential>,
        number: u64,
        messages: Arc<Rate>,
        rooms: [Option<Reservation>; 2],
    ) -> Arc<Self> {
        let Principal { tenant, role, .. } = credential.principal;
        let connection = Connection::of_tenant(number, tenant, role.sight());
        let subject = Arc::default();
        Arc::new(Self { credential, connection, subject, messages, _rooms: rooms })
    }

    /// Who calls.
    pub fn principal(&self) -> &Principal {
        &self.credential.principal
    }

    /// How many messages its tenant may send.
    pub fn messages(&self) -> Arc<Rate> {
        Arc::clone(&self.messages)
    }

    /// For whom the call is worked.
    pub fn caller(&self) -> Caller {
        Caller::asked(self.connection, Arc::clone(&self.subject))
    }

    /// What the call was about, if it has said so.
    pub fn subject(&self) -> &str {
        self.subject.get().map_or("", String::as_str)
    }

    /// Why the caller's credential is not in force any more, if it is not.
    pub fn over(&self) -> Option<Over> {
        self.credential.over()
    }

    /// Completes when it is not in force any more.
    pub fn ended(&self) -> impl Future<Output = ()> + Send + 'static {
        self.credential.ending.clone().cancelled_owned()
    }
}
