//! Who a call comes from: what the server shares out is shared out fairly between connections.

use std::sync::Arc;

use tonic::codegen::http::Extensions;

use crate::admission::Place;

tokio::task_local! {
    static PEER: Peer;
}

/// The other end of a connection. What the server does by itself has a peer of its own, the default one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Peer(u64);

impl Peer {
    /// The sender of a request.
    pub fn of(extensions: &Extensions) -> Self {
        Self(extensions.get::<Arc<Place>>().map_or(0, |place| place.id() + 1))
    }

    /// The peer for whom the present task works.
    pub fn current() -> Self {
        PEER.try_with(|peer| *peer).unwrap_or_default()
    }

    /// Lets a task work for this peer.
    pub async fn work<F: Future>(self, task: F) -> F::Output {
        PEER.scope(self, task).await
    }

    /// Lets `poll`, a part of a task, work for this peer.
    pub fn scope<R>(self, poll: impl FnOnce() -> R) -> R {
        PEER.sync_scope(self, poll)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A peer for tests of what is fair.
    pub(crate) fn peer(number: u64) -> Peer {
        Peer(number)
    }

    #[test]
    fn a_task_knows_for_whom_it_works() {
        assert_eq!(peer(1).scope(Peer::current), peer(1));
        assert_eq!(Peer::current(), Peer::default());
    }
}
