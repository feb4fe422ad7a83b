//! What happens to a plant besides its steps, in a bounded ring of numbered records.
//!
//! An event is numbers alone, so that a control loop can note it; names are added when it is read.

use std::sync::Arc;

use plantd_proto::link::monotonic_ns;

use crate::core::limits::LimitExceeded;
use crate::core::publish::ring::{Reader, Ring};

/// Events that a plant keeps.
const EVENTS: usize = 256;
const WORDS: usize = 5;

/// Declares the kinds together with their numbers.
macro_rules! kinds {
    ($($(#[$meta:meta])* $name:ident,)*) => {
        /// What happened. `index` and `value` of an [`Event`] are 0 where nothing is said of them.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        #[repr(u32)]
        pub enum EventKind { $($(#[$meta])* $name,)* }

        impl EventKind {
            const ALL: &[Self] = &[$(Self::$name,)*];
        }
    };
}

kinds! {
    /// The plant's own loop began to run it; `value` is the speed, 0 for as fast as possible.
    Started,
    /// It was paused.
    Paused,
    /// The steps that were asked for are taken.
    StepsTaken,
    /// The schedule was given up after steps that took too long; `value` is the time lost, s.
    Slipped,
    /// No input, or none for too long: the safe input acts. `value` is the time since the last one, s.
    InputLost,
    /// An input has come again.
    InputBack,
    /// A driver took the lease; `index` is a `DriverKind`.
    DriverAttached,
    /// A driver gave the lease back, or lost it; `index` is a `DriverKind`.
    DriverLeft,
    /// A watchdog acted; `index` is that of the watchdog, `value` the quantity's.
    Watchdog,
    /// A step was refused or failed; `value` is the residual, if there is one.
    StepFailed,
    /// The plant was put into another state.
    StateSet,
    /// Parameters or the time step were changed; `value` is the time step, s.
    ParametersSet,
    /// A fault began; `index` is its number.
    FaultBegan,
    /// A fault ended; `index` is its number.
    FaultEnded,
    /// Steps ended after the next one was due; `value` is how many since the last such event. At most one
    /// such event comes in a second.
    Overran,
}

/// Something that happened.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Event {
    /// What.
    pub kind: EventKind,
    /// Step of the plant.
    pub step: u64,
    /// To what, depending on the kind.
    pub index: u64,
    /// A quantity, depending on the kind.
    pub value: f64,
    /// When, ns on the system's monotonic clock.
    pub at_ns: u64,
}

/// The events of a plant.
#[derive(Debug)]
pub struct Events {
    ring: Arc<Ring>,
    /// Each watcher has one more.
    watcher: Arc<()>,
}

impl Default for Events {
    fn default() -> Self {
        Self { ring: Arc::new(Ring::new(EVENTS, WORDS)), watcher: Arc::default() }
    }
}

impl Events {
    /// Notes an event. Only the owner of the core does.
    pub fn note(&self, kind: EventKind, step: u64, index: u64, value: f64) {
        self.ring.write([kind as u64, step, index, value.to_bits(), monotonic_ns()]);
    }

    /// A reader from event number `from` on.
    pub fn reader(&self, from: u64) -> EventReader {
        EventReader { reader: Reader::from(Arc::clone(&self.ring), from) }
    }

    /// A place among the watchers, while it is held.
    pub(crate) fn watch(&self, watchers_max: u64) -> Result<Arc<()>, LimitExceeded> {
        let place = Arc::clone(&self.watcher);
        let (name, what) = ("watchers_per_plant", "watchers of events");
        LimitExceeded::check(name, watchers_max, what, Arc::strong_count(&place) - 1)?;
        Ok(place)
    }

    /// Number of the next event.
    pub fn next_number(&self) -> u64 {
        self.ring.written()
    }
}

/// A reader's place among the events of a plant.
#[derive(Debug)]
pub struct EventReader {
    reader: Reader,
}

impl EventReader {
    /// The next event with its number, if there is one.
    pub fn read_next(&mut self) -> Option<(u64, Event)> {
        let (number, words) = self.reader.read_next()?;
        let &[kind, step, index, value, at_ns] = words else { return None };
        let kind = *EventKind::ALL.get(kind as usize)?;
        Some((number, Event { kind, step, index, value: f64::from_bits(value), at_ns }))
    }

    /// Events that were overwritten before they were read.
    pub fn lost(&self) -> u64 {
        self.reader.lost()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_are_numbered_and_can_be_read_again() {
        let events = Events::default();
        events.note(EventKind::Started, 0, 0, 1.0);
        events.note(EventKind::Watchdog, 7, 2, -0.5);
        let mut reader = events.reader(0);
        assert_eq!(reader.read_next().map(|(n, e)| (n, e.kind)), Some((0, EventKind::Started)));
        let (number, event) = reader.read_next().unwrap();
        assert_eq!((number, event.step, event.index, event.value), (1, 7, 2, -0.5));
        assert!(event.at_ns > 0);
        assert_eq!(reader.read_next(), None);
        assert_eq!(events.reader(1).read_next().map(|(n, _)| n), Some(1));
        (0..2 * EVENTS).for_each(|_| events.note(EventKind::Paused, 0, 0, 0.0));
        let mut late = events.reader(0);
        let seen = std::iter::from_fn(|| late.read_next()).count() as u64;
        assert_eq!(seen + late.lost(), events.next_number());
    }

    #[test]
    fn kinds_have_their_numbers() {
        for (number, kind) in EventKind::ALL.iter().enumerate() {
            assert_eq!(*kind as usize, number);
        }
    }
}
