//! Brings states from loops to those who watch.
//!
//! A loop wakes nobody. This thread knows when steps are due, looks a moment later, and hands on what it
//! finds; while nobody watches a running plant, it sleeps.

use std::sync::{Arc, Mutex};

use plantd_proto::link::monotonic_ns;

use crate::core::mutex::lock;
use crate::core::publish::feed::Feed;
use crate::core::realtime::alarm::Alarm;
use crate::core::realtime::live::Live;
use crate::core::realtime::settings::Pace;

/// How long after a step is due it is looked for: about as long as a short step takes, ns.
const AFTER_DUE_NS: u64 = 20_000;
/// When to look again for a step that is not there yet, or for one of a free-running plant, ns.
const AGAIN_NS: u64 = 100_000;
const AGAIN_FREE_NS: u64 = 1_000_000;
/// Longest sleep while a plant is watched, and while none is, ns.
const SLEEP_MAX_NS: u64 = 5_000_000;
const IDLE_MAX_NS: u64 = 500_000_000;

/// What it has of a plant that runs.
#[derive(Clone)]
pub(crate) struct Pumped {
    /// Whom it hands steps on to.
    pub(crate) feed: Arc<Feed>,
    /// When steps are due.
    pub(crate) live: Arc<Live>,
    /// Who decides when the plant takes them.
    pub(crate) pace: Pace,
}

/// The thread's end for those who add plants to it.
pub(crate) struct Pump {
    plants: Arc<Mutex<Vec<Pumped>>>,
    alarm: Alarm,
}

impl Pump {
    pub(super) fn start() -> std::io::Result<Self> {
        let pump = Self { plants: Arc::default(), alarm: Alarm::default() };
        let worker = Self { plants: Arc::clone(&pump.plants), alarm: pump.alarm.clone() };
        std::thread::Builder::new().name("pump".to_owned()).spawn(move || worker.run())?;
        Ok(pump)
    }

    /// From now on the plant runs.
    pub(crate) fn add(&self, plant: Pumped) {
        let mut plants = lock(&self.plants);
        match plants.iter_mut().find(|other| Arc::ptr_eq(&other.feed, &plant.feed)) {
            Some(present) => *present = plant,
            None => plants.push(plant),
        }
        drop(plants);
        self.alarm.ring();
    }

    /// Somebody began to watch a plant that runs.
    pub(crate) fn ring(&self) {
        self.alarm.ring();
    }

    /// Runs until the server's loops are gone.
    fn run(self) {
        while Arc::strong_count(&self.plants) > 1 {
            self.alarm.take();
            let plants = {
                let mut plants = lock(&self.plants);
                plants.retain(|plant| plant.feed.relay.is_busy());
                plants.clone()
            };
            let now_ns = monotonic_ns();
            let next_ns = plants.iter().map(|plant| hand_on(plant, now_ns)).min();
            drop(plants);
            self.alarm.sleep_until(next_ns.unwrap_or(now_ns + IDLE_MAX_NS));
        }
    }
}

/// Hands on what is there; when to look again.
fn hand_on(plant: &Pumped, now_ns: u64) -> u64 {
    plant.feed.hand_on();
    if plant.feed.watchers.count() == 0 {
        return now_ns + IDLE_MAX_NS;
    }
    let again_ns = if plant.pace == Pace::Paced { AGAIN_NS } else { AGAIN_FREE_NS };
    plant.live.look_ns(now_ns, AFTER_DUE_NS, again_ns).min(now_ns + SLEEP_MAX_NS)
}
