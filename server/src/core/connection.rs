//! For whom a call is: over which connection it comes, and of which tenant. What the server shares out is shared
//! out fairly between them, and what belongs to another tenant is not there for it.

use std::sync::{Arc, OnceLock};

use crate::core::tenant::Tenant;

tokio::task_local! {
    static CALLER: Caller;
}

/// A connection, and the tenant for whom it is used. What the server does by itself has one of its own, the
/// default one, which sees nothing of any tenant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Connection {
    number: u64,
    tenant: Tenant,
    sight: Sight,
}

/// What somebody may see and change.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Sight {
    /// Look at what belongs to the own tenant.
    #[default]
    Look,
    /// Look at it and change it.
    Own,
    /// Look at and change what belongs to anybody.
    All,
}

impl Connection {
    /// The connection of that number, where nobody is asked who they are; 0 is the server's own.
    pub(crate) fn numbered(number: u64) -> Self {
        Self { number, ..Self::default() }
    }

    /// The connection of that number, used for a tenant.
    pub(crate) fn of_tenant(number: u64, tenant: Tenant, sight: Sight) -> Self {
        Self { number, tenant, sight }
    }

    /// The server at work for a tenant, or for nobody.
    pub(crate) fn server(tenant: Tenant) -> Self {
        Self { number: 0, tenant, sight: Sight::All }
    }

    /// The connection for which the present task works.
    pub fn current() -> Self {
        CALLER.try_with(|caller| caller.connection).unwrap_or_default()
    }

    /// The tenant.
    pub fn tenant(self) -> Tenant {
        self.tenant
    }

    /// It sees what belongs to any tenant.
    pub fn sees_all(self) -> bool {
        self.sight == Sight::All
    }

    /// It may change what it sees.
    pub fn drives(self) -> bool {
        self.sight != Sight::Look
    }

    /// It may know of what belongs to this tenant.
    pub fn sees(self, owner: Tenant) -> bool {
        self.sees_all() || (owner == self.tenant && owner != Tenant::NONE)
    }

    /// Lets a task work for this connection.
    pub async fn work<F: Future>(self, task: F) -> F::Output {
        Caller::from(self).work(task).await
    }

    /// Lets `poll`, a part of a task, work for this connection.
    pub fn scope<R>(self, poll: impl FnOnce() -> R) -> R {
        Caller::from(self).scope(poll)
    }
}

/// A connection with what is to be known of a call once it is over.
#[derive(Clone, Debug, Default)]
pub struct Caller {
    connection: Connection,
    /// What the call is about, where somebody wants to know it.
    subject: Option<Arc<OnceLock<String>>>,
}

impl From<Connection> for Caller {
    fn from(connection: Connection) -> Self {
        Self { connection, subject: None }
    }
}

impl Caller {
    /// A connection whose call is to say what it is about.
    pub(crate) fn asked(connection: Connection, subject: Arc<OnceLock<String>>) -> Self {
        Self { connection, subject: Some(subject) }
    }

    /// For whom the present task works.
    pub fn current() -> Self {
        CALLER.try_with(Self::clone).unwrap_or_default()
    }

    /// The present call is about this plant, model or recording; what is said first counts.
    pub fn note(subject: &str) {
        // Where there is no caller nobody asks.
        let _ = CALLER.try_with(|caller| {
            caller.subject.as_ref().map(|told| told.get_or_init(|| subject.to_owned()).len())
        });
    }

    /// Lets a task work for this caller.
    pub async fn work<F: Future>(self, task: F) -> F::Output {
        CALLER.scope(self, task).await
    }

    /// Lets `poll`, a part of a task, work for this caller.
    pub fn scope<R>(self, poll: impl FnOnce() -> R) -> R {
        CALLER.sync_scope(self, poll)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// One for tests of what is fair.
    pub(crate) fn connection(number: u64) -> Connection {
        Connection::numbered(number)
    }

    #[test]
    fn a_task_knows_for_whom_it_works() {
        assert_eq!(connection(1).scope(Connection::current), connection(1));
        assert_eq!(Connection::current(), Connection::default());
    }

    #[test]
    fn a_call_says_once_what_it_is_about() {
        let subject = Arc::default();
        Caller::note("nobody asks");
        Caller::asked(connection(1), Arc::clone(&subject)).scope(|| {
            Caller::note("first");
            Caller::note("second");
        });
        assert_eq!(subject.get().map(String::as_str), Some("first"));
    }
}
