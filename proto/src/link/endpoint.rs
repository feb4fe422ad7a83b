//! One side of a link: its ports, and when to poll, sleep and notify.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{Ordering, fence};
use std::time::Duration;

use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::port::listener::{Listener, ListenerCreateError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections as _;
use iceoryx2::prelude::{BackpressureStrategy, CallbackProgression, ipc};
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::port_factory::PortFactory as _;

use super::domain::{Channel, Direction, transport};
use super::{DomainError, Header, LinkServices, POLL_FOREVER_NS, ProcessIdentity, monotonic_ns};

/// A received message.
pub type Message = Sample<ipc::Service, [f64], Header>;

/// As often as this a poller lets others run, ns: the one that is waited for may share its processor,
/// and then waits for it. Measured: a pair on one processor loses twice this time in each round trip; on
/// two, a message that comes meanwhile is seen a third of a microsecond later.
const POLL_UNDISTURBED_NS: u64 = 1_000;

/// Shortest sleep, ns: the transport counts in microseconds, and takes zero for ever.
const SLEEP_MIN_NS: u64 = 1_000;

/// How a side waits for what comes next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wait {
    /// Polls for this long after each message that it has sent, then sleeps until the other side
    /// rings. Zero: never polls.
    PollThenSleep(Duration),
    /// Polls all the time: the fastest, and takes a processor while it waits.
    Poll,
}

impl Default for Wait {
    /// Polls for 50 µs: quick while the other side answers quickly, and an idle link costs nothing.
    fn default() -> Self {
        Self::PollThenSleep(Duration::from_micros(50))
    }
}

impl Wait {
    fn poll_ns(self) -> u64 {
        match self {
            Self::PollThenSleep(time) => time.as_nanos().try_into().unwrap_or(POLL_FOREVER_NS),
            Self::Poll => POLL_FOREVER_NS,
        }
    }
}

/// One side of a link. Its ports belong to the thread that made them.
#[derive(Debug)]
pub struct Endpoint {
    publisher: Publisher<ipc::Service, [f64], Header>,
    subscriber: Subscriber<ipc::Service, [f64], Header>,
    notifier: Notifier<ipc::Service>,
    listener: Listener<ipc::Service>,
    /// Memory for the next message: it is made ready while the other side works on the last one.
    spare: Option<SampleMut<ipc::Service, [f64], Header>>,
    incoming: Channel,
    own: ProcessIdentity,
    poll_ns: u64,
    poll_end_ns: u64,
}

impl Endpoint {
    /// The server's side: sends states of at most `state_len` entries.
    pub fn server(
        services: LinkServices,
        state_len: usize,
        wait: Wait,
    ) -> Result<Self, DomainError> {
        Self::new(services.state, services.input, state_len, wait, DomainError::ServedElsewhere)
    }

    /// A driver's side: sends inputs of at most `input_len` entries.
    pub fn driver(
        services: LinkServices,
        input_len: usize,
        wait: Wait,
    ) -> Result<Self, DomainError> {
        Self::new(services.input, services.state, input_len, wait, DomainError::TooManyDrivers)
    }

    /// `full` is the error when there is no room for one more on this side.
    fn new(
        out: Direction,
        back: Direction,
        len: usize,
        wait: Wait,
        full: DomainError,
    ) -> Result<Self, DomainError> {
        // The receiving ports come first: an answer must find them.
        let listener = back.bell.listener_builder().create().map_err(|cause| match cause {
            ListenerCreateError::ExceedsMaxSupportedListeners => full,
            cause => transport("a listener")(cause),
        })?;
        let subscriber =
            back.channel.subscriber_builder().create().map_err(transport("a subscriber"))?;
        let notifier = out.bell.notifier_builder().create().map_err(transport("a notifier"))?;
        let publisher = out
            .channel
            .publisher_builder()
            .initial_max_slice_len(len.max(1))
            .max_loaned_samples(1)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(transport("a publisher"))?;
        let own = ProcessIdentity::own();
        let incoming = back.channel;
        Ok(Self {
            publisher,
            subscriber,
            notifier,
            listener,
            spare: None,
            incoming,
            own,
            poll_ns: wait.poll_ns(),
            poll_end_ns: 0,
        })
    }

    /// Sends the concatenated `parts`, and wakes the receivers when one of them may sleep:
    /// `peer_poll_end_ns` is when the last one stops polling. Fills in who sends, and when.
    pub fn send(
        &mut self,
        mut header: Header,
        parts: &[&[f64]],
        peer_poll_end_ns: u64,
    ) -> Result<(), DomainError> {
        header.pid = self.own.pid;
        header.process_start = self.own.start;
        header.poll_ns = self.poll_ns;
        header.stamp_ns = monotonic_ns();
        self.poll_end_ns = header.poll_end_ns();
        self.send_as_it_is(header, parts, peer_poll_end_ns)
    }

    /// Sends a header as it is, as a program does that does not keep to the protocol.
    pub fn send_as_it_is(
        &mut self,
        header: Header,
        parts: &[&[f64]],
        peer_poll_end_ns: u64,
    ) -> Result<(), DomainError> {
        let len = parts.iter().map(|part| part.len()).sum();
        let mut sample = match self.spare.take() {
            Some(sample) if sample.payload().len() == len => sample,
            // Of another length, it goes back first: one is all there is.
            other => {
                drop(other);
                self.loan(len)?
            }
        };
        let mut rest = sample.payload_mut();
        for part in parts {
            let (head, tail) = rest.split_at_mut(part.len());
            head.copy_from_slice(part);
            rest = tail;
        }
        *sample.user_header_mut() = header;
        sample.send().map_err(transport("sending"))?;
        // The message must be visible before the clock is read: a receiver that has missed it has
        // read a later time from the same clock.
        fence(Ordering::SeqCst);
        if monotonic_ns() >= peer_poll_end_ns {
            self.notifier.notify().map_err(transport("notifying"))?;
        }
        // Without one the next message makes its own.
        self.spare = self.loan(len).ok();
        Ok(())
    }

    fn loan(&self, len: usize) -> Result<SampleMut<ipc::Service, [f64], Header>, DomainError> {
        self.publisher.loan_slice(len).map_err(transport("loaning memory"))
    }

    /// The next message, if there is one.
    pub fn try_receive(&self) -> Result<Option<Message>, DomainError> {
        self.subscriber.receive().map_err(transport("receiving"))
    }

    /// The next message, or nothing when none has come at `deadline_ns`. Polls until the time that
    /// the last message sent has promised, then sleeps.
    pub fn receive(&self, deadline_ns: u64) -> Result<Option<Message>, DomainError> {
        let mut undisturbed_end_ns = monotonic_ns() + POLL_UNDISTURBED_NS;
        loop {
            let now_ns = monotonic_ns();
            fence(Ordering::SeqCst);
            if let Some(message) = self.try_receive()? {
                return Ok(Some(message));
            }
            if now_ns >= deadline_ns {
                return Ok(None);
            }
            if now_ns >= self.poll_end_ns {
                // A signal may end the sleep early: then the loop looks again and goes on.
                let time_ns = (deadline_ns - now_ns).max(SLEEP_MIN_NS);
                let _ = self.listener.timed_wait(|_| {}, Duration::from_nanos(time_ns));
            } else if now_ns < undisturbed_end_ns {
                std::hint::spin_loop();
            } else {
                std::thread::yield_now();
                undisturbed_end_ns = monotonic_ns() + POLL_UNDISTURBED_NS;
            }
        }
    }

    /// Lets go of receivers that are no more, which sending does too.
    pub fn update(&self) -> Result<(), DomainError> {
        self.publisher.update_connections().map_err(transport("updating connections"))
    }

    /// Whether the sender of a message still belongs to the link. A dead one belongs to it until
    /// some member of the domain cleans up.
    pub fn is_connected(&self, sender: UniquePublisherId) -> bool {
        let mut found = false;
        self.incoming.dynamic_config().list_publishers(|publisher| {
            found = publisher.publisher_id == sender;
            if found { CallbackProgression::Stop } else { CallbackProgression::Continue }
        });
        found
    }

    /// Closes the ports one by one: one that panics, as ports on segments that somebody has overwritten
    /// may do, keeps neither the others open nor the caller from going on.
    pub fn close(self) {
        fn close<T>(port: T) {
            let _ = catch_unwind(AssertUnwindSafe(move || drop(port)));
        }
        let Self { publisher, subscriber, notifier, listener, spare, incoming, .. } = self;
        close(spare);
        close(publisher);
        close(notifier);
        close(subscriber);
        close(listener);
        close(incoming);
    }
}
