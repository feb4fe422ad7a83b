//! Brings states from loops to those who watch.
//!
//! A loop wakes nobody. This thread knows when steps are due, looks a moment later, and hands on what it
//! finds; while nobody watches a running plant, it sleeps.

use std::collections::HashMap;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};

use plantd_proto::link::monotonic_ns;

use super::alarm::Alarm;
use crate::frame::Frame;
use crate::ring::Reader;
use crate::session::Session;

/// How long after a step is due it is looked for: about as long as a short step takes, ns.
const AFTER_DUE_NS: u64 = 20_000;
/// When to look again for a step that is not there yet, or for one of a free-running plant, ns.
const AGAIN_NS: u64 = 100_000;
const AGAIN_FREE_NS: u64 = 1_000_000;
/// Longest sleep while a plant is watched, ns.
const SLEEP_MAX_NS: u64 = 5_000_000;

/// The thread's end for those who add plants to it.
pub(crate) struct Pump {
    plants: Arc<Mutex<Vec<Arc<Session>>>>,
    alarm: Alarm,
}

impl Pump {
    pub(super) fn start() -> std::io::Result<Self> {
        let (plants, alarm) = (Arc::default(), Alarm::default());
        let worker =
            Worker { plants: Arc::clone(&plants), alarm: alarm.clone(), places: HashMap::new() };
        std::thread::Builder::new().name("pump".to_owned()).spawn(move || worker.run())?;
        Ok(Self { plants, alarm })
    }

    /// From now on the plant runs.
    pub(crate) fn add(&self, session: Arc<Session>) {
        let mut plants = self.plants.lock().unwrap_or_else(PoisonError::into_inner);
        if !plants.iter().any(|other| Arc::ptr_eq(other, &session)) {
            plants.push(session);
        }
        drop(plants);
        self.alarm.ring();
    }

    /// Somebody began to watch a plant that runs.
    pub(crate) fn ring(&self) {
        self.alarm.ring();
    }
}

struct Worker {
    plants: Arc<Mutex<Vec<Arc<Session>>>>,
    alarm: Alarm,
    /// Where it is in the ring of each plant that is watched, by id.
    places: HashMap<String, (Reader, Frame)>,
}

impl Worker {
    /// Runs until the server's loops are gone.
    fn run(mut self) {
        while Arc::strong_count(&self.plants) > 1 {
            self.alarm.take();
            let plants = {
                let mut plants = self.plants.lock().unwrap_or_else(PoisonError::into_inner);
                // The last states of a plant that has stopped are still to be handed on: it goes in the
                // round after.
                plants.retain(|session| session.is_running() || self.has_waiting(session));
                plants.clone()
            };
            let now_ns = monotonic_ns();
            let mut next_ns = now_ns + 100 * SLEEP_MAX_NS;
            self.places.retain(|id, _| plants.iter().any(|session| session.id() == id));
            for session in &plants {
                if session.watchers().count() == 0 {
                    self.places.remove(session.id());
                } else {
                    next_ns = next_ns.min(self.hand_on(session, now_ns));
                }
            }
            drop(plants);
            self.alarm.sleep_until(next_ns);
        }
    }

    fn has_waiting(&self, session: &Session) -> bool {
        self.places.get(session.id()).is_some_and(|(reader, _)| reader.waiting() > 0)
    }

    /// Hands on what is there; when to look again.
    fn hand_on(&mut self, session: &Session, now_ns: u64) -> u64 {
        let place = self.places.entry(session.id().to_owned());
        let (reader, frame) =
            place.or_insert_with(|| (session.read_for_watchers(), Frame::default()));
        let mut has_news = false;
        while let Some((number, record)) = reader.read_next() {
            frame.read(record);
            session.watchers().publish_record(&frame.published(), number);
            has_news = true;
        }
        let due_ns = session.live().due_ns.load(Ordering::Relaxed);
        let is_due = due_ns + AFTER_DUE_NS <= now_ns;
        let next_ns = match session.is_paced() {
            false => now_ns + AGAIN_FREE_NS,
            true if is_due && !has_news => now_ns + AGAIN_NS,
            true => (due_ns + AFTER_DUE_NS).max(now_ns + AFTER_DUE_NS),
        };
        next_ns.min(now_ns + SLEEP_MAX_NS)
    }
}
