//! The latest input of a driver, on its way to a loop that waits for nobody.
//!
//! A triple buffer: the driver fills one, the loop reads one, the third changes hands by an atomic
//! exchange. Neither side waits for the other, and the loop always gets a whole input, the newest.
//! Drivers wait for each other, which happens when one takes over from another.

use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

const INDEX: u8 = 0b011;
/// The buffer in the middle is newer than the one that the loop has.
const FRESH: u8 = 0b100;

/// Where a driver's inputs arrive.
#[derive(Debug)]
pub struct InputSlot {
    buffers: [Buffer; 3],
    /// Index of the buffer that nobody has, and whether it is fresh.
    middle: AtomicU8,
    /// Index of the driver's buffer. One driver may come while another one goes.
    back: Mutex<u8>,
    /// Index of the loop's buffer; used by the loop alone.
    front: AtomicU8,
}

#[derive(Debug)]
struct Buffer {
    lease: AtomicU64,
    sequence: AtomicU64,
    arrived_ns: AtomicU64,
    u: Box<[AtomicU64]>,
}

/// What goes with an input.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Arrival {
    /// Number of the lease under which it came.
    pub lease: u64,
    /// The driver's sequence number.
    pub sequence: u64,
    /// When it came, ns on the system's monotonic clock.
    pub arrived_ns: u64,
}

impl InputSlot {
    /// An empty slot for inputs of so many entries.
    pub fn new(entries: usize) -> Self {
        let buffer = || Buffer {
            lease: AtomicU64::new(0),
            sequence: AtomicU64::new(0),
            arrived_ns: AtomicU64::new(0),
            u: (0..entries).map(|_| AtomicU64::new(0)).collect(),
        };
        Self {
            buffers: [buffer(), buffer(), buffer()],
            back: Mutex::new(0),
            middle: AtomicU8::new(1),
            front: AtomicU8::new(2),
        }
    }

    /// Puts an input there in place of the one before.
    pub fn put(&self, arrival: Arrival, u: &[f64]) {
        let mut back = self.back.lock().unwrap_or_else(PoisonError::into_inner);
        let buffer = &self.buffers[usize::from(*back)];
        buffer.lease.store(arrival.lease, Ordering::Relaxed);
        buffer.sequence.store(arrival.sequence, Ordering::Relaxed);
        buffer.arrived_ns.store(arrival.arrived_ns, Ordering::Relaxed);
        for (word, value) in buffer.u.iter().zip(u) {
            word.store(value.to_bits(), Ordering::Relaxed);
        }
        *back = self.middle.swap(*back | FRESH, Ordering::AcqRel) & INDEX;
    }

    /// Copies the newest input into `u`, if one has come since the last call. One loop at a time.
    pub fn take(&self, u: &mut [f64]) -> Option<Arrival> {
        if self.middle.load(Ordering::Relaxed) & FRESH == 0 {
            return None;
        }
        let front = self.front.load(Ordering::Relaxed);
        let fresh = self.middle.swap(front, Ordering::AcqRel) & INDEX;
        self.front.store(fresh, Ordering::Relaxed);
        let buffer = &self.buffers[usize::from(fresh)];
        for (value, word) in u.iter_mut().zip(&buffer.u) {
            *value = f64::from_bits(word.load(Ordering::Relaxed));
        }
        Some(Arrival {
            lease: buffer.lease.load(Ordering::Relaxed),
            sequence: buffer.sequence.load(Ordering::Relaxed),
            arrived_ns: buffer.arrived_ns.load(Ordering::Relaxed),
        })
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[test]
    fn the_latest_input_wins_and_is_fresh_once() {
        let slot = InputSlot::new(2);
        let mut u = [0.0; 2];
        assert_eq!(slot.take(&mut u), None);
        for k in 1..=3 {
            slot.put(
                Arrival { lease: 1, sequence: k, arrived_ns: 10 * k },
                &[k as f64, -(k as f64)],
            );
        }
        assert_eq!(slot.take(&mut u), Some(Arrival { lease: 1, sequence: 3, arrived_ns: 30 }));
        assert_eq!(u, [3.0, -3.0]);
        assert_eq!(slot.take(&mut u), None);
        slot.put(Arrival { lease: 1, sequence: 4, arrived_ns: 40 }, &[4.0, -4.0]);
        assert_eq!(slot.take(&mut u).map(|arrival| arrival.sequence), Some(4));
    }

    /// Inputs of a driver that floods are whole, and their numbers go up.
    #[test]
    fn no_input_is_torn() {
        const INPUTS: u64 = 200_000;
        let slot = Arc::new(InputSlot::new(16));
        let driver = {
            let slot = Arc::clone(&slot);
            std::thread::spawn(move || {
                for k in 1..=INPUTS {
                    slot.put(Arrival { lease: k, sequence: k, arrived_ns: k }, &[k as f64; 16]);
                }
            })
        };
        let (mut last, mut u) = (0, [0.0; 16]);
        while last < INPUTS {
            let Some(arrival) = slot.take(&mut u) else {
                std::thread::yield_now();
                continue;
            };
            assert!(arrival.sequence > last, "{} after {last}", arrival.sequence);
            assert_eq!([arrival.lease, arrival.arrived_ns], [arrival.sequence; 2]);
            assert_eq!(u, [arrival.sequence as f64; 16]);
            last = arrival.sequence;
        }
        driver.join().unwrap();
    }
}
