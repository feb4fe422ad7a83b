//! Random numbers that a seed repeats, and what is done with inputs to make new ones.

/// Words at which parsers of ours turn off; numbers that are hard to hold.
const WORDS: [&str; 30] = [
    "0",
    "-1",
    "1e308",
    "-1e-320",
    "NaN",
    "inf",
    "18446744073709551616",
    "-9223372036854775808",
    "0x7f",
    "[]",
    "{}",
    "[[",
    "]]",
    "=",
    "\"",
    "'''",
    "\n",
    "\t",
    "\u{0}",
    "\u{feff}",
    "\u{10ffff}",
    "true",
    "<a>",
    "</a>",
    "<!--",
    "&lt;",
    "&#x0;",
    "name",
    "../",
    "\r\n",
];

/// SplitMix64.
pub(crate) struct Rng(u64);

impl Rng {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Below `end`, which is not 0.
    pub(crate) fn below(&mut self, end: usize) -> usize {
        (self.next() % end as u64) as usize
    }

    /// Once in so many times.
    pub(crate) fn once_in(&mut self, times: usize) -> bool {
        self.below(times) == 0
    }

    pub(crate) fn of<'a, T>(&mut self, items: &'a [T]) -> &'a T {
        &items[self.below(items.len())]
    }

    /// A number as people would not choose it.
    pub(crate) fn number(&mut self) -> f64 {
        const HARD: [f64; 12] = [
            0.0,
            -0.0,
            1.0,
            -1.0,
            1e-3,
            1e3,
            1e300,
            -1e300,
            1e-310,
            f64::NAN,
            f64::INFINITY,
            f64::NEG_INFINITY,
        ];
        match self.below(4) {
            0 => *self.of(&HARD),
            1 => f64::from_bits(self.next()),
            _ => (self.below(2001) as f64 - 1000.0) * 1e-3,
        }
    }

    /// A whole number, most often a small one.
    pub(crate) fn integer(&mut self) -> u64 {
        match self.below(6) {
            0 => self.next(),
            1 => u64::MAX >> self.below(64),
            _ => self.below(20) as u64,
        }
    }
}

/// Parts of a text that belong together: its lines, or its tags.
fn parts(bytes: &[u8]) -> Vec<&[u8]> {
    let end = if bytes.trim_ascii_start().starts_with(b"<") { b'>' } else { b'\n' };
    bytes.split_inclusive(|byte| *byte == end).collect()
}

/// An input of parts of two others.
fn splice(rng: &mut Rng, one: &[u8], other: &[u8]) -> Vec<u8> {
    let (one, other) = (parts(one), parts(other));
    if one.is_empty() || other.is_empty() {
        return one.concat();
    }
    let (at, from) = (rng.below(one.len() + 1), rng.below(other.len()));
    let count = 1 + rng.below((other.len() - from).min(8));
    let skipped = rng.below(3).min(one.len() - at);
    [&one[..at], &other[from..from + count], &one[at + skipped..]].concat().concat()
}

/// Changes one thing.
fn change(rng: &mut Rng, bytes: &mut Vec<u8>) {
    let at = rng.below(bytes.len() + 1);
    let len = (1 + rng.below(16)).min(bytes.len() - at);
    match rng.below(9) {
        0 if len > 0 => bytes[at] ^= 1 << rng.below(8),
        1 if len > 0 => bytes[at] = rng.next() as u8,
        2 => drop(bytes.drain(at..at + len)),
        3 => {
            let copy = bytes[at..at + len].to_vec();
            let to = rng.below(bytes.len() + 1);
            bytes.splice(to..to, copy);
        }
        4 => drop(bytes.splice(at..at + len, rng.of(&WORDS).bytes())),
        5 => {
            // A number of the text becomes another one.
            let digits = |byte: &u8| byte.is_ascii_digit() || b".-+e".contains(byte);
            if let Some(start) = bytes[at..].iter().position(u8::is_ascii_digit) {
                let start = at + start;
                let count = bytes[start..].iter().take_while(|byte| digits(byte)).count();
                let number = match rng.below(3) {
                    0 => rng.integer().to_string(),
                    _ => rng.number().to_string(),
                };
                bytes.splice(start..start + count, number.into_bytes());
            }
        }
        6 => bytes.truncate(at),
        7 if len >= 8 => bytes[at..at + 8].copy_from_slice(&rng.integer().to_le_bytes()),
        _ => {
            let ours = parts(bytes).iter().map(|part| part.to_vec()).collect::<Vec<_>>();
            if ours.len() > 1 {
                let (from, to) = (rng.below(ours.len()), rng.below(ours.len()));
                let mut ours = ours;
                if rng.once_in(2) {
                    ours.swap(from, to)
                } else {
                    drop(ours.remove(from))
                }
                *bytes = ours.concat();
            }
        }
    }
}

/// A new input of known ones, of at most so many bytes.
pub(crate) fn mutated(rng: &mut Rng, seeds: &[Vec<u8>], bytes_max: usize) -> Vec<u8> {
    let mut bytes = rng.of(seeds).clone();
    if rng.once_in(3) {
        let other = rng.of(seeds);
        bytes = splice(rng, &bytes, other);
    }
    for _ in 0..1 + rng.below(6) {
        change(rng, &mut bytes);
    }
    bytes.truncate(bytes_max);
    bytes
}
