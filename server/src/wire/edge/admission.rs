//! Who is let in: places for connections, of which silent and idle ones give way to newcomers.
//!
//! A connection is known from its first request on. One that makes none in time is ended. When all
//! places are taken, a newcomer gets that of the connection that has waited longest without a
//! request; if all are known, that of the one that has been idle for longest; and waits if none is.
//! A connection with an open call keeps its place.

use std::any::Any;
use std::collections::{BTreeMap, HashMap};
use std::io;
use std::net::{IpAddr, Ipv6Addr};
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use futures::task::AtomicWaker;
use futures::{Stream, StreamExt, stream};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpStream, UnixStream};
use tokio::sync::Notify;
use tokio::time::{Sleep, sleep, timeout};
use tonic::transport::server::Connected;

use crate::core::limits::Limits;
use crate::wire::edge::certificate::Certificate;

/// A known connection keeps its place at least this long after its last call: the next one may be
/// on its way.
const IDLE_MIN: Duration = Duration::from_secs(5);
/// How often a newcomer looks again whether somebody has become idle.
const LOOK_AGAIN: Duration = Duration::from_millis(500);
/// Time for file descriptors to come back after a connection could not be accepted.
const ACCEPT_PAUSE: Duration = Duration::from_millis(20);

/// Where a connection comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Peer {
    /// This machine, over a unix-domain socket, which no browser can use.
    Unix,
    /// This machine, over TCP.
    Loopback,
    /// Another machine. Of IPv6 the network of 64 bits, in which a machine chooses its address.
    Remote(IpAddr),
}

impl Peer {
    fn at(address: IpAddr) -> Self {
        match address.to_canonical() {
            address if address.is_loopback() => Self::Loopback,
            IpAddr::V6(address) => {
                let network = address.to_bits() & !u128::from(u64::MAX);
                Self::Remote(Ipv6Addr::from_bits(network).into())
            }
            address => Self::Remote(address),
        }
    }
}

/// A socket that knows its other end.
pub trait HasPeer {
    /// The other end.
    fn peer(&self) -> io::Result<Peer>;

    /// The user whose process the other end is, where the system tells.
    fn uid(&self) -> Option<u32> {
        None
    }
}

impl HasPeer for TcpStream {
    fn peer(&self) -> io::Result<Peer> {
        Ok(Peer::at(self.peer_addr()?.ip()))
    }
}

impl HasPeer for UnixStream {
    fn peer(&self) -> io::Result<Peer> {
        Ok(Peer::Unix)
    }

    fn uid(&self) -> Option<u32> {
        self.peer_cred().ok().map(|credentials| credentials.uid())
    }
}

/// The places for connections.
pub struct Places {
    connections: usize,
    connections_per_peer: usize,
    first_request: Duration,
    start: Instant,
    taken: Mutex<Taken>,
    /// Somebody has left.
    left: Notify,
}

#[derive(Default)]
struct Taken {
    next_id: u64,
    places: BTreeMap<u64, Arc<Place>>,
    of_peer: HashMap<Peer, usize>,
}

/// What came of asking for a place.
enum Answer {
    Admitted(Arc<Place>),
    /// The peer has all the connections that it may have, all of them in use.
    Refused,
    /// All places are taken, all of them in use.
    Full,
}

impl Places {
    /// Places within these limits, and within half of the files that the process may open.
    pub fn new(limits: &Limits) -> Self {
        let mut connections = Limits::size(limits.connections);
        let files = raise_file_limit();
        if connections > files / 2 {
            connections = (files / 2).max(1);
            tracing::warn!(
                "the process may open only {files} files: it takes {connections} connections at a \
                 time instead of {}; raise `ulimit -n` or lower the limit `connections`",
                limits.connections
            );
        }
        Self {
            connections,
            connections_per_peer: Limits::size(limits.connections_per_peer),
            first_request: Duration::from_secs(limits.first_request_s),
            start: Instant::now(),
            taken: Mutex::default(),
            left: Notify::new(),
        }
    }

    /// Accepts the connections that get a place, for ever.
    pub fn admit<S, IO>(
        self: Arc<Self>,
        incoming: S,
    ) -> impl Stream<Item = io::Result<Admitted<IO>>>
    where
        S: Stream<Item = io::Result<IO>> + Unpin,
        IO: HasPeer,
    {
        stream::unfold((self, incoming), |(places, mut incoming)| async {
            loop {
                let Ok(io) = incoming.next().await? else {
                    // Out of file descriptors, most likely.
                    sleep(ACCEPT_PAUSE).await;
                    continue;
                };
                // A connection that has gone already has no peer.
                let Ok(peer) = io.peer() else { continue };
                match places.place(peer).await {
                    Some(place) => {
                        if let Some(uid) = io.uid() {
                            // Nobody else has the place yet.
                            let _ = place.uid.set(uid);
                        }
                        return Some((Ok(places.admitted(io, place)), (places, incoming)));
                    }
                    None => tracing::debug!(?peer, "refused: too many connections of this peer"),
                }
            }
        })
    }

    fn admitted<IO>(self: &Arc<Self>, io: IO, place: Arc<Place>) -> Admitted<IO> {
        let first_request = Some(Box::pin(sleep(self.first_request)));
        Admitted { io, place, places: Arc::clone(self), first_request }
    }

    /// Waits for a place; none if the peer may not have one.
    async fn place(&self, peer: Peer) -> Option<Arc<Place>> {
        loop {
            match self.try_place(peer) {
                Answer::Admitted(place) => return Some(place),
                Answer::Refused => return None,
                // Whether somebody left or the time is over, it looks again.
                Answer::Full => drop(timeout(LOOK_AGAIN, self.left.notified()).await),
            }
        }
    }

    fn try_place(&self, peer: Peer) -> Answer {
        let mut taken = self.lock();
        let of_peer = taken.of_peer.get(&peer).copied().unwrap_or_default();
        let peer_is_full = matches!(peer, Peer::Remote(_)) && of_peer >= self.connections_per_peer;
        if peer_is_full || taken.places.len() >= self.connections {
            let now_ms = self.now_ms();
            let candidates = taken.places.values();
            let gives_way = candidates
                .filter(|place| !peer_is_full || place.peer == peer)
                .filter_map(|place| Some((place.precedence(now_ms)?, place.id)))
                .min();
            match gives_way {
                Some((_, id)) => taken.end(id),
                None if peer_is_full => return Answer::Refused,
                None => return Answer::Full,
            }
        }
        Answer::Admitted(taken.add(peer, self.now_ms(), self.start))
    }

    fn leave(&self, place: &Place) {
        self.lock().remove(place.id);
        self.left.notify_one();
    }

    fn lock(&self) -> MutexGuard<'_, Taken> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn now_ms(&self) -> u64 {
        milliseconds_since(self.start)
    }
}

impl Taken {
    fn add(&mut self, peer: Peer, now_ms: u64, start: Instant) -> Arc<Place> {
        let id = self.next_id;
        self.next_id += 1;
        let place = Arc::new(Place {
            id,
            peer,
            uid: OnceLock::new(),
            certificate: OnceLock::new(),
            kept: OnceLock::new(),
            start,
            is_known: AtomicBool::new(false),
            calls: AtomicUsize::new(0),
            idle_since_ms: AtomicU64::new(now_ms),
            has_ended: AtomicBool::new(false),
            task: AtomicWaker::new(),
        });
        self.places.insert(id, Arc::clone(&place));
        *self.of_peer.entry(peer).or_default() += 1;
        place
    }

    fn end(&mut self, id: u64) {
        if let Some(place) = self.remove(id) {
            tracing::debug!(peer = ?place.peer, "gives way to a newcomer");
            place.end();
        }
    }

    fn remove(&mut self, id: u64) -> Option<Arc<Place>> {
        let place = self.places.remove(&id)?;
        if let Some(count) = self.of_peer.get_mut(&place.peer) {
            *count -= 1;
            if *count == 0 {
                self.of_peer.remove(&place.peer);
            }
        }
        Some(place)
    }
}

fn milliseconds_since(start: Instant) -> u64 {
    u64::try_from(start.elapsed().as_millis()).unwrap_or(u64::MAX)
}

/// Lets the process open as many files as it may; returns how many that is.
fn raise_file_limit() -> usize {
    let mut limit = getrlimit(Resource::Nofile);
    let raised = Rlimit { current: limit.maximum, maximum: limit.maximum };
    if setrlimit(Resource::Nofile, raised).is_ok() {
        limit.current = limit.maximum;
    }
    limit.current.map_or(usize::MAX, Limits::size)
}

/// The place of a connection; requests find it among their extensions.
pub struct Place {
    id: u64,
    peer: Peer,
    uid: OnceLock<u32>,
    certificate: OnceLock<Arc<Certificate>>,
    /// What is to live as long as the connection.
    kept: OnceLock<Arc<dyn Any + Send + Sync>>,
    start: Instant,
    /// It has made a request.
    is_known: AtomicBool,
    /// Calls that are open.
    calls: AtomicUsize,
    /// Since when none has been, counted from `start`.
    idle_since_ms: AtomicU64,
    /// It shall be closed.
    has_ended: AtomicBool,
    /// The task that serves it.
    task: AtomicWaker,
}

impl Place {
    /// Where its connection comes from.
    pub fn peer(&self) -> Peer {
        self.peer
    }

    /// The user whose process is at the other end of a unix-domain socket.
    pub fn uid(&self) -> Option<u32> {
        self.uid.get().copied()
    }

    /// The certificate with which the other end has shown who it is.
    pub fn certificate(&self) -> Option<&Arc<Certificate>> {
        self.certificate.get()
    }

    /// Lets something live as long as the connection: the first that is to.
    pub fn keep(&self, kept: Arc<dyn Any + Send + Sync>) {
        let _ = self.kept.set(kept);
    }

    /// Which of the server's connections this is; no two have the same number.
    pub fn id(&self) -> u64 {
        self.id
    }

    /// A call begins. It is open until the value is dropped.
    pub fn call(self: Arc<Self>) -> OpenCall {
        self.calls.fetch_add(1, Ordering::Relaxed);
        self.is_known.store(true, Ordering::Relaxed);
        OpenCall { place: self }
    }

    /// What gives way first has the least; none for what stays.
    fn precedence(&self, now_ms: u64) -> Option<(bool, u64)> {
        if self.calls.load(Ordering::Relaxed) > 0 {
            return None;
        }
        let is_known = self.is_known.load(Ordering::Relaxed);
        let since_ms = self.idle_since_ms.load(Ordering::Relaxed);
        let is_idle = u128::from(now_ms.saturating_sub(since_ms)) >= IDLE_MIN.as_millis();
        (!is_known || is_idle).then_some((is_known, since_ms))
    }

    fn end(&self) {
        self.has_ended.store(true, Ordering::Release);
        self.task.wake();
    }
}

/// An open call of a connection.
pub struct OpenCall {
    place: Arc<Place>,
}

impl Drop for OpenCall {
    fn drop(&mut self) {
        let place = &self.place;
        place.idle_since_ms.store(milliseconds_since(place.start), Ordering::Relaxed);
        place.calls.fetch_sub(1, Ordering::Relaxed);
    }
}

/// A connection with its place.
pub struct Admitted<IO> {
    io: IO,
    place: Arc<Place>,
    places: Arc<Places>,
    /// When it ends without a request.
    first_request: Option<Pin<Box<Sleep>>>,
}

impl<IO> Admitted<IO> {
    /// The other end has shown who it is. What was said first stands.
    pub fn set_certificate(&self, certificate: Certificate) {
        let _ = self.place.certificate.set(Arc::new(certificate));
    }

    /// What the socket answered, unless the connection has been ended. Whoever has to wait for the
    /// socket is woken by that, too.
    fn while_admitted<T>(
        &mut self,
        context: &mut Context<'_>,
        answer: Poll<io::Result<T>>,
    ) -> Poll<io::Result<T>> {
        if answer.is_pending() {
            self.place.task.register(context.waker());
            self.watch_first_request(context);
        }
        if self.place.has_ended.load(Ordering::Acquire) {
            return Poll::Ready(Err(io::ErrorKind::ConnectionAborted.into()));
        }
        answer
    }

    fn watch_first_request(&mut self, context: &mut Context<'_>) {
        let Some(deadline) = &mut self.first_request else { return };
        if self.place.is_known.load(Ordering::Relaxed) {
            self.first_request = None;
        } else if deadline.as_mut().poll(context).is_ready() {
            tracing::debug!(peer = ?self.place.peer, "ended: no request in time");
            self.place.has_ended.store(true, Ordering::Relaxed);
        }
    }
}

impl<IO> Drop for Admitted<IO> {
    fn drop(&mut self) {
        self.places.leave(&self.place);
    }
}

impl<IO> Connected for Admitted<IO> {
    type ConnectInfo = Arc<Place>;

    fn connect_info(&self) -> Self::ConnectInfo {
        Arc::clone(&self.place)
    }
}

impl<IO: AsyncRead + Unpin> AsyncRead for Admitted<IO> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let answer = Pin::new(&mut self.io).poll_read(context, buffer);
        self.while_admitted(context, answer)
    }
}

impl<IO: AsyncWrite + Unpin> AsyncWrite for Admitted<IO> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let answer = Pin::new(&mut self.io).poll_write(context, bytes);
        self.while_admitted(context, answer)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let answer = Pin::new(&mut self.io).poll_write_vectored(context, slices);
        self.while_admitted(context, answer)
    }

    fn is_write_vectored(&self) -> bool {
        self.io.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let answer = Pin::new(&mut self.io).poll_flush(context);
        self.while_admitted(context, answer)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let answer = Pin::new(&mut self.io).poll_shutdown(context);
        self.while_admitted(context, answer)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REMOTE: &str = "10.0.0.1";

    fn places(limits: &[(&str, u64)]) -> Arc<Places> {
        let mut table = Limits::default();
        for (name, value) in limits {
            table.set(name, *value).unwrap();
        }
        Arc::new(Places::new(&table))
    }

    fn at(address: &str) -> Peer {
        Peer::at(address.parse().unwrap())
    }

    fn taken(places: &Places, peer: Peer) -> Arc<Place> {
        match places.try_place(peer) {
            Answer::Admitted(place) => place,
            _ => panic!("no place for {peer:?}"),
        }
    }

    fn has_ended(place: &Place) -> bool {
        place.has_ended.load(Ordering::Relaxed)
    }

    /// A call that ended long ago.
    fn make_idle(place: &Arc<Place>) {
        drop(Arc::clone(place).call());
        place.idle_since_ms.store(0, Ordering::Relaxed);
    }

    /// Places that have been there for a minute.
    fn old_places(limits: &[(&str, u64)]) -> Arc<Places> {
        let mut places = Arc::into_inner(places(limits)).unwrap();
        places.start -= Duration::from_secs(60);
        Arc::new(places)
    }

    #[test]
    fn the_silent_give_way_first_then_the_idle_and_never_those_with_a_call() {
        let places = old_places(&[("connections", 3)]);
        let [busy, idle, silent] = [Peer::Unix; 3].map(|peer| taken(&places, peer));
        let call = Arc::clone(&busy).call();
        make_idle(&idle);
        let recent = taken(&places, Peer::Loopback);
        assert!(has_ended(&silent) && !has_ended(&idle));
        drop(Arc::clone(&recent).call());
        let last = taken(&places, Peer::Loopback);
        assert!(has_ended(&idle) && !has_ended(&recent) && !has_ended(&busy));
        let _last = Arc::clone(&last).call();
        // One has just ended a call, and may go on.
        assert!(matches!(places.try_place(Peer::Unix), Answer::Full));
        drop(call);
        busy.idle_since_ms.store(0, Ordering::Relaxed);
        taken(&places, Peer::Unix);
        assert!(has_ended(&busy));
    }

    #[test]
    fn another_machine_has_its_share_and_this_one_has_all() {
        let places = old_places(&[("connections_per_peer", 2)]);
        let mine: Vec<_> = (0..10).map(|_| taken(&places, at("127.0.0.1"))).collect();
        let theirs = [taken(&places, at(REMOTE)), taken(&places, at(REMOTE))];
        let _calls = theirs.clone().map(Place::call);
        assert!(matches!(places.try_place(at(REMOTE)), Answer::Refused));
        taken(&places, at("10.0.0.2"));
        places.leave(&theirs[0]);
        let third = taken(&places, at(REMOTE));
        taken(&places, at(REMOTE));
        assert!(has_ended(&third), "its own silent connection gives way");
        assert!(!mine.iter().any(|place| has_ended(place)));
    }

    #[test]
    fn peers_are_machines() {
        assert_eq!(at("::1"), Peer::Loopback);
        assert_eq!(at("127.0.0.2"), Peer::Loopback);
        assert_eq!(at("::ffff:127.0.0.1"), Peer::Loopback);
        assert_eq!(at("::ffff:10.0.0.1"), at(REMOTE));
        assert_eq!(at("2001:db8:1:2:3::1"), at("2001:db8:1:2:ffff::2"));
        assert_ne!(at("2001:db8:1:2::1"), at("2001:db8:1:3::1"));
    }

    impl HasPeer for tokio::io::DuplexStream {
        fn peer(&self) -> io::Result<Peer> {
            Ok(Peer::Unix)
        }
    }

    #[tokio::test]
    async fn a_newcomer_waits_until_somebody_leaves() {
        let connections = stream::iter([(); 2].map(|()| Ok(tokio::io::duplex(1).0)));
        let places = places(&[("connections", 1)]);
        let mut admitted = Box::pin(places.admit(connections));
        let first = admitted.next().await.unwrap().unwrap();
        let _call = first.connect_info().call();
        assert!(futures::poll!(admitted.next()).is_pending());
        drop(first);
        assert!(admitted.next().await.unwrap().is_ok());
    }
}
