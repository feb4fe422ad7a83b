//! The shared-memory segments of a domain, and the files of its processes that died.

use std::collections::HashSet;
use std::fs::{self, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use super::error::DomainError;
use super::header::LAYOUT_VERSION;

/// Where the system keeps shared memory.
pub const SHARED_MEMORY_DIRECTORY: &str = "/dev/shm";

/// End of the name of the segment that iceoryx2 numbers the members of a domain with.
const NUMBERING_SUFFIX: &str = ".global_mgmt";

/// Start of the names of all files of a domain: `plantd<layout version>_<domain>_`.
pub(super) fn prefix(domain: &str) -> String {
    format!("plantd{LAYOUT_VERSION}_{domain}_")
}

/// Length of [`prefix`].
pub(super) const fn prefix_length(domain: usize) -> usize {
    "plantd5_".len() + domain + 1
}

/// The segments of a domain.
pub(super) fn list(domain: &str) -> Vec<PathBuf> {
    let prefix = prefix(domain);
    let entries = fs::read_dir(SHARED_MEMORY_DIRECTORY).into_iter().flatten().flatten();
    let names = entries.map(|entry| entry.file_name());
    let own = names.filter(|name| name.as_encoded_bytes().starts_with(prefix.as_bytes()));
    own.map(|name| Path::new(SHARED_MEMORY_DIRECTORY).join(name)).collect()
}

/// Removes the segments of a domain.
pub(super) fn remove_all(domain: &str) {
    for path in list(domain) {
        // What another user has put there cannot be removed, and is in nobody's way.
        let _ = fs::remove_file(path);
    }
}

/// Names and sizes of the segments of a domain that all members use, or that process `pid` has made for
/// services and ports: not for a connection of two.
pub(super) fn made_by(domain: &str, pid: u32) -> Vec<(String, u64)> {
    let named = |path: PathBuf| {
        let name = path.file_name()?.to_str()?.to_owned();
        let size = fs::metadata(&path).ok()?.len();
        let makers = pids(&name, &prefix(domain));
        (makers.is_empty() || makers == [pid]).then_some((name, size))
    };
    list(domain).into_iter().filter_map(named).collect()
}

/// Whether a segment is used by all members of a domain.
pub(super) fn is_common(name: &str) -> bool {
    name.ends_with(NUMBERING_SUFFIX)
}

/// Fails with the name of the file when one of these segments is not this user's alone, or has another
/// size: mapping one that is or can be cut off kills the process, and waiting for an empty one to grow
/// takes for ever. What else another user has put under names of the domain is not used.
pub(super) fn check(expected: &[(String, u64)]) -> Result<(), DomainError> {
    let uid = rustix::process::getuid().as_raw();
    for (name, expected) in expected {
        let path = Path::new(SHARED_MEMORY_DIRECTORY).join(name);
        // What killed drivers have kept of a closed link may be listed as well, and goes in time.
        let Ok(metadata) = fs::symlink_metadata(&path) else { continue };
        let size = metadata.len();
        let is_private =
            metadata.is_file() && metadata.uid() == uid && metadata.mode() & 0o077 == 0;
        if !is_private {
            return Err(DomainError::SegmentNotPrivate { path, uid });
        }
        if size != *expected {
            return Err(DomainError::SegmentSize { path, size, expected: *expected });
        }
    }
    Ok(())
}

/// Puts a copy that only this user can open in the place of the segment that numbers the members:
/// iceoryx2 gives it to everybody, and whoever has it open can cut it off. It is mapped only while a
/// member joins, and only the server has.
pub(super) fn take_numbering(domain: &str) -> io::Result<()> {
    for path in list(domain) {
        if !path.as_os_str().as_encoded_bytes().ends_with(NUMBERING_SUFFIX.as_bytes()) {
            continue;
        }
        let copy = path.with_extension("copy");
        let bytes = fs::read(&path)?;
        OpenOptions::new()
            .create_new(true)
            .write(true)
            .mode(0o600)
            .open(&copy)?
            .write_all(&bytes)?;
        fs::rename(copy, path)?;
    }
    Ok(())
}

/// The segments of a domain without content.
pub(super) fn empty(domain: &str) -> Vec<PathBuf> {
    let is_empty = |path: &PathBuf| fs::metadata(path).is_ok_and(|metadata| metadata.len() == 0);
    list(domain).into_iter().filter(is_empty).collect()
}

/// Removes those of these segments whose makers are not among the `living`: the library waits for ever
/// for one that is empty to grow.
pub(super) fn remove_unfinished(domain: &str, empty: &[PathBuf], living: &[u32]) {
    for path in empty.iter().filter(|path| is_left(path, &prefix(domain), living)) {
        // Its owner may have been faster.
        let _ = fs::remove_file(path);
    }
}

/// Whether somebody who has made a file is not among the `living`.
fn is_left(path: &Path, prefix: &str, living: &[u32]) -> bool {
    let name = path.file_name().map(|name| name.to_string_lossy());
    name.is_some_and(|name| pids(&name, prefix).iter().any(|pid| !living.contains(pid)))
}

/// Files of a domain whose makers are gone, seen at the last look.
#[derive(Debug, Default)]
pub struct Leftovers(HashSet<PathBuf>);

impl Leftovers {
    /// Looks for files of a domain whose makers are not among the `living`, and removes those that were
    /// there at the last look too: what belongs to a whole member, the library has removed meanwhile.
    /// Returns how many were removed.
    pub(super) fn remove(&mut self, domain: &str, directory: &Path, living: &[u32]) -> usize {
        let prefix = prefix(domain);
        let read = |path: &Path| fs::read_dir(path).into_iter().flatten().flatten();
        let own = [directory.to_owned(), directory.join("nodes")];
        let own = own.iter().flat_map(|path| read(path)).map(|entry| entry.path());
        let all = own.chain(list(domain));
        let found: HashSet<_> = all.filter(|path| is_left(path, &prefix, living)).collect();
        let stale = found.iter().filter(|path| self.0.contains(*path));
        let removed = stale.filter(|path| remove(path)).count();
        self.0 = found;
        removed
    }
}

/// Removes a file, or a directory with all that is in it.
fn remove(path: &Path) -> bool {
    match path.is_dir() {
        true => fs::remove_dir_all(path).is_ok(),
        false => fs::remove_file(path).is_ok(),
    }
}

/// Process ids in the numbers that a file of iceoryx2 is named with: each is, from its lowest bit on,
/// seconds, nanoseconds, process id and a count, 32 bits each.
fn pids(name: &str, prefix: &str) -> Vec<u32> {
    let name = name.strip_prefix(prefix).unwrap_or(name);
    let numbers = name.split(['_', '.']).filter(|part| (10..40).contains(&part.len()));
    numbers.filter_map(|part| Some((part.parse::<u128>().ok()? >> 64) as u32)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_tell_who_made_a_file() {
        let prefix = prefix("0a1b2c");
        assert_eq!(prefix.len(), prefix_length(6));
        let own = 28313_u128 << 64 | 1 << 96 | 4675;
        let other = 77_u128 << 64 | 12;
        let hash = "0354a209029e7d094a819e2d4030ea331e6caaf0";
        assert_eq!(pids(&format!("{prefix}{hash}_{own}.data"), &prefix), [28313]);
        let connection = format!("{prefix}{hash}_{own}_{other}.connection");
        assert_eq!(pids(&connection, &prefix), [28313, 77]);
        assert_eq!(pids(&format!("{prefix}{own}.node_monitor_owner_lock"), &prefix), [28313]);
        assert_eq!(pids(&own.to_string(), &prefix), [28313]);
        let service = format!("{prefix}{hash}.service");
        for name in [service.as_str(), "services", "4711.member"] {
            assert_eq!(pids(name, &prefix), [] as [u32; 0], "{name}");
        }
    }
}
