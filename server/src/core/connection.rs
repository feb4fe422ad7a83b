//! Over which connection a call comes: what the server shares out is shared out fairly between them.

tokio::task_local! {
    static CONNECTION: Connection;
}

/// A connection. What the server does by itself has one of its own, the default one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Connection(u64);

impl Connection {
    /// The connection of that number; 0 is the server's own.
    pub(crate) fn numbered(number: u64) -> Self {
        Self(number)
    }

    /// The connection for which the present task works.
    pub fn current() -> Self {
        CONNECTION.try_with(|connection| *connection).unwrap_or_default()
    }

    /// Lets a task work for this connection.
    pub async fn work<F: Future>(self, task: F) -> F::Output {
        CONNECTION.scope(self, task).await
    }

    /// Lets `poll`, a part of a task, work for this connection.
    pub fn scope<R>(self, poll: impl FnOnce() -> R) -> R {
        CONNECTION.sync_scope(self, poll)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// One for tests of what is fair.
    pub(crate) fn connection(number: u64) -> Connection {
        Connection(number)
    }

    #[test]
    fn a_task_knows_for_whom_it_works() {
        assert_eq!(connection(1).scope(Connection::current), connection(1));
        assert_eq!(Connection::current(), Connection::default());
    }
}
