//! A bounded ring of records from one writer to any number of readers.
//!
//! The writer never waits, allocates or makes a system call: it overwrites the oldest record. A reader
//! that is overtaken counts what it has lost. Each slot carries a version, odd while it is written
//! (a sequence lock); the words themselves are atomic, so that a reader that is overtaken while it
//! copies sees that its copy is void, and nothing worse.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering, fence};

/// Records that the ring of a plant keeps: a quarter of a second at 1 kHz.
pub(crate) const RING_RECORDS: usize = 256;

/// A ring of records of up to so many words each.
#[derive(Debug)]
pub struct Ring {
    slots: Box<[Slot]>,
    /// Number of the next record.
    written: AtomicU64,
}

#[derive(Debug)]
struct Slot {
    /// `2 n + 1` while record `n` is written, `2 n + 2` when it is there.
    version: AtomicU64,
    words: Box<[AtomicU64]>,
}

impl Ring {
    /// A ring with room for `records` of `words` words of 64 bits each; both at least 1.
    pub fn new(records: usize, words: usize) -> Self {
        let word = |_| AtomicU64::new(0);
        let slot =
            |_| Slot { version: AtomicU64::new(0), words: (0..words.max(1)).map(word).collect() };
        Self { slots: (0..records.max(1)).map(slot).collect(), written: AtomicU64::new(0) }
    }

    /// Gives the first record this number. Before anybody reads or writes.
    pub(crate) fn begin_at(&self, first: u64) {
        self.written.store(first, Ordering::Release);
    }

    /// Number of records that it keeps.
    pub fn capacity(&self) -> usize {
        self.slots.len()
    }

    /// Number of the next record.
    pub fn written(&self) -> u64 {
        self.written.load(Ordering::Acquire)
    }

    /// Writes a record. One writer at a time: the owner of the core. Words that do not fit are cut off.
    pub fn write(&self, record: impl IntoIterator<Item = u64>) {
        let n = self.written.load(Ordering::Relaxed);
        let slot = self.slot(n);
        slot.version.store(2 * n + 1, Ordering::Relaxed);
        // The words come after the odd version.
        fence(Ordering::Release);
        for (word, value) in slot.words.iter().zip(record) {
            word.store(value, Ordering::Relaxed);
        }
        slot.version.store(2 * n + 2, Ordering::Release);
        self.written.store(n + 1, Ordering::Release);
    }

    /// Copies record `n` into `out`; false when it has been overwritten, or is not written yet.
    fn read(&self, n: u64, out: &mut Vec<u64>) -> bool {
        let slot = self.slot(n);
        if slot.version.load(Ordering::Acquire) != 2 * n + 2 {
            return false;
        }
        out.clear();
        out.extend(slot.words.iter().map(|word| word.load(Ordering::Relaxed)));
        // The words come before the second look at the version.
        fence(Ordering::Acquire);
        slot.version.load(Ordering::Relaxed) == 2 * n + 2
    }

    fn slot(&self, n: u64) -> &Slot {
        &self.slots[(n % self.slots.len() as u64) as usize]
    }
}

/// A reader's place in a ring.
#[derive(Debug)]
pub struct Reader {
    ring: Arc<Ring>,
    next: u64,
    lost: u64,
    record: Vec<u64>,
}

impl Reader {
    /// A reader of what is written from now on.
    pub fn new(ring: Arc<Ring>) -> Self {
        let next = ring.written();
        Self::from(ring, next)
    }

    /// A reader of record `next` and what comes after it.
    pub fn from(ring: Arc<Ring>, next: u64) -> Self {
        let record = Vec::with_capacity(ring.slots[0].words.len());
        Self { ring, next, lost: 0, record }
    }

    /// Number of the record that is read next, if it is not overwritten by then.
    pub fn position(&self) -> u64 {
        self.next
    }

    /// The next record and its number, if there is one. Skips what has been overwritten.
    pub fn read_next(&mut self) -> Option<(u64, &[u64])> {
        self.read_before(u64::MAX)
    }

    /// The next record before `end`, and its number.
    pub fn read_before(&mut self, end: u64) -> Option<(u64, &[u64])> {
        loop {
            if self.next >= self.ring.written().min(end) {
                return None;
            }
            let n = self.next;
            if self.ring.read(n, &mut self.record) {
                self.next += 1;
                return Some((n, &self.record));
            }
            // The oldest record may be overwritten at any moment: leave some room.
            let kept = self.ring.capacity() as u64;
            let safe = self.ring.written().saturating_sub(kept - kept / 8);
            let to = safe.max(n + 1);
            self.lost += to - n;
            self.next = to;
        }
    }

    /// Goes to the last record, which is the next to be read; what is skipped is not counted as lost.
    pub fn skip_to_last(&mut self) {
        self.next = self.next.max(self.ring.written().saturating_sub(1));
    }

    /// Number of records that were overwritten before they were read.
    pub fn lost(&self) -> u64 {
        self.lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_come_in_order_and_overwritten_ones_are_counted() {
        let ring = Arc::new(Ring::new(8, 2));
        let mut reader = Reader::new(Arc::clone(&ring));
        assert_eq!(reader.read_next(), None);
        for k in 0..5 {
            ring.write([k, 10 * k, 99]);
        }
        for k in 0..5 {
            assert_eq!(reader.read_next(), Some((k, &[k, 10 * k][..])));
        }
        assert_eq!(reader.read_next(), None);
        assert_eq!(reader.lost(), 0);
        for k in 5..105 {
            ring.write([k, 10 * k]);
        }
        let mut seen = 0;
        while let Some((n, record)) = reader.read_next() {
            assert_eq!(record, [n, 10 * n]);
            seen += 1;
        }
        assert!((1..=8).contains(&seen));
        assert_eq!(reader.lost() + seen, 100);
    }

    #[test]
    fn a_late_reader_begins_where_it_is_told() {
        let ring = Arc::new(Ring::new(8, 1));
        (0..5).for_each(|k| ring.write([k]));
        let mut reader = Reader::from(Arc::clone(&ring), 3);
        assert_eq!(reader.read_next(), Some((3, &[3][..])));
        let mut reader = Reader::from(ring, 0);
        reader.skip_to_last();
        assert_eq!(reader.read_next(), Some((4, &[4][..])));
        assert_eq!(reader.lost(), 0);
    }

    /// A reader beside a writer that does not wait: every record that it gets is whole, and read and
    /// lost records add up.
    #[test]
    fn no_record_is_torn() {
        const RECORDS: u64 = 200_000;
        let ring = Arc::new(Ring::new(16, 32));
        let mut reader = Reader::new(Arc::clone(&ring));
        let writer = {
            let ring = Arc::clone(&ring);
            std::thread::spawn(move || (0..RECORDS).for_each(|k| ring.write([k; 32])))
        };
        let mut seen = 0;
        loop {
            let is_over = writer.is_finished();
            while let Some((n, record)) = reader.read_next() {
                assert!(record.iter().all(|word| *word == n), "record {n}: {record:?}");
                seen += 1;
            }
            if is_over {
                break;
            }
        }
        writer.join().unwrap();
        assert_eq!(seen + reader.lost(), RECORDS);
    }
}
