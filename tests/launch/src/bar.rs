//! A bar of packages done; where no person looks, a line now and then.

use std::collections::BTreeSet;
use std::io::{IsTerminal as _, Write as _};
use std::time::Duration;

/// Characters of the bar.
const WIDTH: usize = 40;
/// Time between two lines where no person looks.
const LINE_INTERVAL: Duration = Duration::from_secs(20);

/// How far a build is.
pub(crate) struct Bar {
    done: BTreeSet<String>,
    total: usize,
    is_terminal: bool,
    /// When the last line was written.
    said: Duration,
}

impl Bar {
    pub(crate) fn new(total: usize) -> Self {
        let is_terminal = std::io::stderr().is_terminal();
        Self { done: BTreeSet::new(), total, is_terminal, said: Duration::ZERO }
    }

    /// A package is done, or a part of it.
    pub(crate) fn done(&mut self, package: String) {
        self.done.insert(package);
        self.total = self.total.max(self.done.len());
    }

    /// Shows how far it is after this time.
    pub(crate) fn draw(&mut self, elapsed: Duration) {
        let (done, total) = (self.done.len(), self.total);
        let counts = format!("{done:>3} of {total} crates, {}", clock(elapsed));
        if self.is_terminal {
            let full = WIDTH * done / total.max(1);
            let (full, empty) = ("=".repeat(full), " ".repeat(WIDTH - full));
            eprint!("\r\x1b[K  [{full}{empty}] {counts}");
            let _ = std::io::stderr().flush();
        } else if elapsed >= self.said + LINE_INTERVAL {
            self.said = elapsed;
            eprintln!("  {counts}");
        }
    }

    /// Shows a line above the bar.
    pub(crate) fn say(&self, line: &str) {
        self.clear();
        eprintln!("{line}");
    }

    pub(crate) fn clear(&self) {
        if self.is_terminal {
            eprint!("\r\x1b[K");
        }
    }
}

/// Minutes and seconds.
pub(crate) fn clock(time: Duration) -> String {
    let seconds = time.as_secs();
    match seconds / 60 {
        0 => format!("{:.1} s", time.as_secs_f64()),
        minutes => format!("{minutes} min {:02} s", seconds % 60),
    }
}
