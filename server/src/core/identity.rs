//! Which server this is among others: its name, where it is reached, of which build it is, and whether it takes
//! anything new.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, OnceLock};
use std::time::Duration;

use plantd_math::simd;
use tokio_util::sync::CancellationToken;

use crate::core::mutex::lock;
use crate::core::tenant::Tenant;

/// Longest time that a server can be told to drain, s: a day.
pub const DRAIN_MAX_S: f64 = 86_400.0;

/// Plants whose new address is remembered; the first ones are forgotten.
const MOVED_MAX: usize = 10_000;

/// Which server this is.
#[derive(Debug)]
pub struct Identity {
    name: String,
    address: OnceLock<String>,
}

impl Identity {
    /// A server of that name, which cannot be reached yet.
    pub fn new(name: String) -> Self {
        Self { name, address: OnceLock::new() }
    }

    /// Its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Where clients reach it; empty where they do not.
    pub fn address(&self) -> &str {
        self.address.get().map_or("", String::as_str)
    }

    /// Says where it is reached, once.
    pub fn announce(&self, address: String) {
        let _ = self.address.set(address);
    }
}

/// The build of which the bits of motions are: version, digest of the sources, and the width of the registers that the
/// processor has.
pub fn build() -> String {
    let registers = match () {
        () if simd::has(simd::AVX512) => "avx512",
        () if simd::has(simd::AVX2) => "avx2",
        () => "portable",
    };
    let (version, arch) = (env!("CARGO_PKG_VERSION"), std::env::consts::ARCH);
    format!("{version} {} {arch} {registers}", env!("PLANTD_SOURCES"))
}

/// The end of a server, once it is decided.
#[derive(Debug, Default)]
pub struct Drain {
    has_begun: AtomicBool,
    requested: CancellationToken,
    limit: OnceLock<Duration>,
}

impl Drain {
    /// Begins it: from now on nothing new is taken. The first time that is given holds.
    pub fn request(&self, limit: Option<Duration>) {
        if let Some(limit) = limit {
            let _ = self.limit.set(limit);
        }
        self.begin();
        self.requested.cancel();
    }

    /// From now on nothing new is taken.
    pub fn begin(&self) {
        self.has_begun.store(true, Ordering::Release);
    }

    /// Nothing new is taken.
    pub fn has_begun(&self) -> bool {
        self.has_begun.load(Ordering::Acquire)
    }

    /// Completes when somebody asks for the server's end.
    pub async fn requested(&self) {
        self.requested.cancelled().await;
    }

    /// The time that was given with the request.
    pub fn limit(&self) -> Option<Duration> {
        self.limit.get().copied()
    }
}

/// Plants that have gone to other servers, each with whose it was and the address of its new one.
#[derive(Debug, Default)]
pub struct Moved {
    plants: Mutex<Book>,
}

#[derive(Debug, Default)]
struct Book {
    addresses: BTreeMap<String, (Tenant, String)>,
    /// Ids, the first one that has gone first.
    order: VecDeque<String>,
}

impl Moved {
    /// Notes where a plant of a tenant has gone.
    pub fn note(&self, tenant: Tenant, id: &str, address: &str) {
        let mut book = lock(&self.plants);
        if book.addresses.insert(id.to_owned(), (tenant, address.to_owned())).is_some() {
            return;
        }
        book.order.push_back(id.to_owned());
        if book.order.len() > MOVED_MAX
            && let Some(first) = book.order.pop_front()
        {
            book.addresses.remove(&first);
        }
    }

    /// Forgets it: the id is that of another plant.
    pub fn forget(&self, id: &str) {
        let mut book = lock(&self.plants);
        if book.addresses.remove(id).is_some() {
            book.order.retain(|other| other != id);
        }
    }

    /// Where a plant has gone, and whose it was.
    pub fn address(&self, id: &str) -> Option<(Tenant, String)> {
        lock(&self.plants).addresses.get(id).cloned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_has_moved_is_remembered_until_there_are_too_many() {
        let moved = Moved::default();
        let address = |id: &str| moved.address(id).map(|(_, address)| address);
        for k in 0..=MOVED_MAX {
            moved.note(Tenant::NONE, &format!("p{k}"), "http://a:1");
        }
        assert_eq!(address("p0"), None);
        assert_eq!(address("p1").as_deref(), Some("http://a:1"));
        moved.note(Tenant::NONE, "p1", "http://b:1");
        assert_eq!(address("p1").as_deref(), Some("http://b:1"));
        moved.forget("p1");
        assert_eq!(address("p1"), None);
        let book = lock(&moved.plants);
        assert_eq!(book.addresses.len(), book.order.len());
    }

    #[test]
    fn the_build_names_version_sources_and_processor() {
        let build = build();
        let words: Vec<&str> = build.split(' ').collect();
        assert_eq!(words.len(), 4, "{build}");
        assert_eq!((words[0], words[2]), (env!("CARGO_PKG_VERSION"), std::env::consts::ARCH));
        assert!(u64::from_str_radix(words[1], 16).is_ok(), "{build}");
    }
}
