//! The root path of links: whose domains are in it, which of them live, and in which one a plant's
//! link is.
//!
//! | path under the root | what it is | who holds its lock (`flock`) |
//! | --- | --- | --- |
//! | the root itself | | exclusively, for a moment, who adds or removes one of the following |
//! | `<domain>/` | files of one start of a server; six hexadecimal digits | exclusively, its server |
//! | `<domain>/<pid>.member` | a process of the domain beside the server | shared, each of its drivers |
//! | `<plant>.link` | the domain with the plant's link, and its segments | |
//!
//! The kernel lets go of the locks of a process that dies, however it dies. So a domain whose directory
//! and members nobody has locked is a dead one, and is removed whole.

use std::fs::{self, DirBuilder, File, OpenOptions, TryLockError};
use std::io::{self, Read as _, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::error::DomainError;
use super::process::random_instance;
use super::segments;

/// Digits of a domain's name.
const NAME_LENGTH: usize = 6;

/// Longest root path, bytes: a socket's path has 107, of which the domain's directory, the prefix, a
/// 128-bit number in decimal, a suffix and two separators take the rest.
const ROOT_LENGTH_MAX: usize =
    107 - (NAME_LENGTH + 1) - segments::prefix_length(NAME_LENGTH) - 39 - ".event".len() - 1;

/// Longest wait for the lock of the root, which others hold for milliseconds.
const LOCK_WAIT_MAX: Duration = Duration::from_secs(5);

/// Names that are tried for a new domain; one in sixteen millions is taken.
const NAMES_TRIED: usize = 16;

const LINK_SUFFIX: &str = ".link";
const MEMBER_SUFFIX: &str = ".member";
/// A link file that is not complete; renamed when it is.
const UNFINISHED_SUFFIX: &str = ".link.new";

/// Longest link file that is read, bytes.
const LINK_FILE_MAX: u64 = 64 << 10;

/// A root path that belongs to this user alone.
#[derive(Clone, Debug)]
pub(super) struct Root {
    path: PathBuf,
}

/// What a link file says.
#[derive(Debug)]
pub(super) struct LinkFile {
    /// Name of the domain.
    pub(super) domain: String,
    /// Segments that the server has made for the link, and their sizes in bytes; empty until the link
    /// is open.
    pub(super) segments: Vec<(String, u64)>,
}

impl Root {
    /// The root at `path`, which is made (mode 0700) when it does not exist.
    pub(super) fn create(path: &Path) -> Result<Self, DomainError> {
        let root = Self::configure(path)?;
        let made = DirBuilder::new().recursive(true).mode(0o700).create(&root.path);
        made.map_err(root.failed())?;
        check_private(&root.path)?;
        Ok(root)
    }

    /// The root at `path`, which must exist.
    pub(super) fn open(path: &Path) -> Result<Self, DomainError> {
        let root = Self::configure(path)?;
        check_private(&root.path)?;
        Ok(root)
    }

    fn configure(path: &Path) -> Result<Self, DomainError> {
        // With a separator at its end the path of a symbolic link means what it points to.
        let path: PathBuf = path.components().collect();
        let length = path.as_os_str().len();
        if !path.is_absolute() || path.to_str().is_none() || length > ROOT_LENGTH_MAX {
            return Err(DomainError::RootPath { path, max: ROOT_LENGTH_MAX });
        }
        Ok(Self { path })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Directory of a domain.
    pub(super) fn directory(&self, domain: &str) -> PathBuf {
        self.path.join(domain)
    }

    fn failed(&self) -> impl Fn(io::Error) -> DomainError {
        let path = self.path.clone();
        move |source| DomainError::Root { path: path.clone(), source }
    }

    /// Keeps others from adding or removing domains and link files until the result is dropped.
    fn lock(&self) -> Result<File, DomainError> {
        let directory = File::open(&self.path).map_err(self.failed())?;
        let started = Instant::now();
        loop {
            match directory.try_lock() {
                Ok(()) => return Ok(directory),
                Err(TryLockError::Error(source)) => return Err(self.failed()(source)),
                Err(TryLockError::WouldBlock) if started.elapsed() > LOCK_WAIT_MAX => {
                    return Err(DomainError::RootLocked { path: self.path.clone() });
                }
                Err(TryLockError::WouldBlock) => std::thread::sleep(Duration::from_millis(1)),
            }
        }
    }

    /// Makes a domain; it lives as long as the lock that is returned with its name. Removes dead ones.
    pub(super) fn make_domain(&self) -> Result<(String, File), DomainError> {
        let _lock = self.lock()?;
        self.remove_dead_locked();
        for _ in 0..NAMES_TRIED {
            let name = format!("{:06x}", random_instance() & 0xff_ffff);
            if !segments::list(&name).is_empty() {
                continue;
            }
            let path = self.directory(&name);
            match DirBuilder::new().mode(0o700).create(&path) {
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => continue,
                made => made.map_err(self.failed())?,
            }
            let directory = File::open(&path).map_err(self.failed())?;
            directory.lock().map_err(self.failed())?;
            return Ok((name, directory));
        }
        Err(self.failed()(io::ErrorKind::AlreadyExists.into()))
    }

    /// Whether the server of a domain lives.
    pub(super) fn is_served(&self, domain: &str) -> bool {
        let Ok(directory) = File::open(self.directory(domain)) else { return false };
        matches!(directory.try_lock_shared(), Err(TryLockError::WouldBlock))
    }

    /// Makes this process a member of a domain until the result is dropped.
    pub(super) fn enter(&self, domain: &str) -> Result<File, DomainError> {
        let path = self.directory(domain).join(format!("{}{MEMBER_SUFFIX}", host_pid()));
        let mut options = OpenOptions::new();
        options.create(true).truncate(false).write(true).mode(0o600);
        loop {
            let failed = |source| DomainError::Root { path: path.clone(), source };
            let file = options.open(&path).map_err(failed)?;
            file.lock_shared().map_err(failed)?;
            // It may have been removed between the two, as that of a process that has gone.
            if is_at(&file, &path) {
                return Ok(file);
            }
        }
    }

    /// Process ids of the members of a domain. Forgets those that have gone.
    pub(super) fn members(&self, domain: &str) -> Vec<u32> {
        let files = entries(&self.directory(domain));
        let is_alive = |path: &Path| {
            let Ok(file) = File::open(path) else { return false };
            match file.try_lock() {
                Err(TryLockError::WouldBlock) => true,
                // While it is locked, nobody else removes it, and nobody takes it for his own.
                Ok(()) => !is_at(&file, path) || fs::remove_file(path).is_err(),
                Err(TryLockError::Error(_)) => true,
            }
        };
        let pid = |path: &Path| {
            path.file_name()?.to_str()?.strip_suffix(MEMBER_SUFFIX)?.parse::<u32>().ok()
        };
        files
            .iter()
            .filter_map(|path| Some((path, pid(path)?)))
            .filter(|(path, _)| is_alive(path))
            .map(|(_, pid)| pid)
            .collect()
    }

    /// Notes that a plant's link is, or will be, in a domain: with no segments as long as it is not
    /// open.
    pub(super) fn write_link(
        &self,
        plant: &str,
        domain: &str,
        segments: &[(String, u64)],
    ) -> Result<(), DomainError> {
        let _lock = self.lock()?;
        if let Ok(Some(link)) = self.read_link(plant)
            && link.domain != domain
            && self.is_served(&link.domain)
        {
            return Err(DomainError::ServedElsewhere);
        }
        let lines = segments.iter().map(|(name, size)| format!("{size} {name}\n"));
        let text = format!("{domain}\n{}", lines.collect::<String>());
        let unfinished = self.path.join(format!("{plant}{UNFINISHED_SUFFIX}"));
        let mut options = OpenOptions::new();
        options.create(true).truncate(true).write(true).mode(0o600);
        let mut file = options.open(&unfinished).map_err(self.failed())?;
        file.write_all(text.as_bytes()).map_err(self.failed())?;
        fs::rename(&unfinished, self.link_path(plant)).map_err(self.failed())
    }

    /// Removes a plant's link file, if it names this domain.
    pub(super) fn remove_link(&self, plant: &str, domain: &str) -> Result<(), DomainError> {
        let _lock = self.lock()?;
        match self.read_link(plant)? {
            Some(link) if link.domain == domain => {
                fs::remove_file(self.link_path(plant)).map_err(self.failed())
            }
            _ => Ok(()),
        }
    }

    /// The link file of a plant, if there is one.
    pub(super) fn read_link(&self, plant: &str) -> Result<Option<LinkFile>, DomainError> {
        let path = self.link_path(plant);
        let failed = |source| DomainError::Root { path: path.clone(), source };
        let file = match File::open(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            file => file.map_err(failed)?,
        };
        let mut text = String::new();
        file.take(LINK_FILE_MAX).read_to_string(&mut text).map_err(failed)?;
        Ok(LinkFile::parse(&text))
    }

    /// The link files of other plants in a domain.
    pub(super) fn other_links(&self, plant: &str, domain: &str) -> Vec<LinkFile> {
        let name = |path: &PathBuf| {
            Some(path.file_name()?.to_str()?.strip_suffix(LINK_SUFFIX)?.to_owned())
        };
        let entries = entries(&self.path);
        let plants = entries.iter().filter_map(name).filter(|other| other != plant);
        let links = plants.filter_map(|other| self.read_link(&other).ok().flatten());
        links.filter(|link| link.domain == domain).collect()
    }

    fn link_path(&self, plant: &str) -> PathBuf {
        self.path.join(format!("{plant}{LINK_SUFFIX}"))
    }

    /// Removes the domains whose processes are all gone, and what names them. Returns how many.
    pub(super) fn remove_dead(&self) -> Result<usize, DomainError> {
        // Most of the time there is nothing to do, and the lock is left alone.
        if entries(&self.path).iter().all(|path| !self.is_dead(path)) {
            return Ok(0);
        }
        let _lock = self.lock()?;
        Ok(self.remove_dead_locked())
    }

    fn remove_dead_locked(&self) -> usize {
        let mut removed = 0;
        for path in entries(&self.path) {
            if !self.is_dead(&path) {
                continue;
            }
            if path.is_dir() {
                // The segments first: the directory is what tells of them.
                domain_name(&path).iter().for_each(|name| segments::remove_all(name));
                removed += usize::from(fs::remove_dir_all(&path).is_ok());
            } else {
                // It may have gone meanwhile.
                let _ = fs::remove_file(&path);
            }
        }
        removed
    }

    /// Whether something in the root belongs to a domain without processes. The files of links are of
    /// no use without their server.
    fn is_dead(&self, path: &Path) -> bool {
        if let Some(domain) = domain_name(path) {
            return !self.is_served(domain) && self.members(domain).is_empty();
        }
        let Some(name) = path.file_name().and_then(|name| name.to_str()) else { return false };
        if let Some(plant) = name.strip_suffix(LINK_SUFFIX) {
            let link = self.read_link(plant);
            return link.is_ok_and(|link| link.is_none_or(|link| !self.is_served(&link.domain)));
        }
        // Written and renamed under the lock of the root: seen without it, it may be in the making.
        name.ends_with(UNFINISHED_SUFFIX)
    }
}

impl LinkFile {
    fn parse(text: &str) -> Option<Self> {
        let mut lines = text.lines();
        let domain = domain_name(Path::new(lines.next()?))?.to_owned();
        let segment = |line: &str| {
            let (size, name) = line.split_once(' ')?;
            Some((name.to_owned(), size.parse().ok()?))
        };
        Some(Self { domain, segments: lines.map_while(segment).collect() })
    }
}

/// A directory that others can write to would let them put their files under our names.
fn check_private(path: &Path) -> Result<(), DomainError> {
    let failed = |source| DomainError::Root { path: path.to_owned(), source };
    let metadata = fs::symlink_metadata(path).map_err(failed)?;
    if metadata.is_symlink() {
        return Err(DomainError::RootIsSymbolicLink { path: path.to_owned() });
    }
    let uid = rustix::process::getuid().as_raw();
    if !metadata.is_dir() || metadata.uid() != uid || metadata.mode() & 0o077 != 0 {
        return Err(DomainError::RootNotPrivate { path: path.to_owned(), uid });
    }
    Ok(())
}

/// Whether a path names this file, and not another one or none.
fn is_at(file: &File, path: &Path) -> bool {
    let (Ok(own), Ok(found)) = (file.metadata(), fs::metadata(path)) else { return false };
    (own.dev(), own.ino()) == (found.dev(), found.ino())
}

/// The name of a domain, if the last part of the path is one.
fn domain_name(path: &Path) -> Option<&str> {
    let name = path.file_name()?.to_str()?;
    let is_name = name.len() == NAME_LENGTH && name.bytes().all(|c| c.is_ascii_hexdigit());
    is_name.then_some(name)
}

/// What is in a directory; nothing if it is not there.
fn entries(directory: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(directory).into_iter().flatten();
    entries.flatten().map(|entry| entry.path()).collect()
}

/// Process id of this process as iceoryx2 puts it into its names: that of the outermost pid namespace
/// that can be seen.
pub(super) fn host_pid() -> u32 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("NSpid:"));
    let pid = line.and_then(|pids| pids.split_ascii_whitespace().next()?.parse().ok());
    pid.unwrap_or_else(std::process::id)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::{PermissionsExt as _, symlink};

    use super::*;

    fn temporary(name: &str) -> PathBuf {
        std::env::temp_dir().join(format!("plantd-{name}-{}", std::process::id()))
    }

    #[test]
    fn the_root_path_must_be_private_absolute_short_and_no_symbolic_link() {
        let base = temporary("root");
        let path = base.join("root");
        Root::create(&path).unwrap();
        symlink(&path, base.join("link")).unwrap();
        for link in ["link", "link/"] {
            for opened in [Root::create(&base.join(link)), Root::open(&base.join(link))] {
                let error = opened.unwrap_err();
                assert!(matches!(error, DomainError::RootIsSymbolicLink { .. }), "{error}");
            }
        }
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        assert!(matches!(Root::open(&path), Err(DomainError::RootNotPrivate { .. })));
        fs::remove_dir_all(&base).unwrap();
        assert!(matches!(Root::open(&path), Err(DomainError::Root { .. })));
        assert!(matches!(Root::open(Path::new("here")), Err(DomainError::RootPath { .. })));
        let long = PathBuf::from(format!("/{}", "x".repeat(ROOT_LENGTH_MAX)));
        assert!(matches!(Root::create(&long), Err(DomainError::RootPath { .. })));
    }

    #[test]
    fn a_domain_lives_as_long_as_its_server_or_a_member() {
        let path = temporary("lives");
        let root = Root::create(&path).unwrap();
        let (name, server) = root.make_domain().unwrap();
        assert!(root.is_served(&name));
        root.write_link("plant", &name, &[("segment".to_owned(), 3)]).unwrap();
        let member = root.enter(&name).unwrap();
        assert_eq!(root.members(&name), [host_pid()]);
        assert_eq!(root.remove_dead().unwrap(), 0);
        drop(server);
        assert!(!root.is_served(&name));
        assert_eq!(root.remove_dead().unwrap(), 0);
        // A link without its server is none.
        assert!(root.read_link("plant").unwrap().is_none());
        drop(member);
        assert_eq!(root.remove_dead().unwrap(), 1);
        assert_eq!(entries(&path), [] as [PathBuf; 0]);
        fs::remove_dir(&path).unwrap();
    }

    #[test]
    fn a_link_belongs_to_one_living_server() {
        let path = temporary("owner");
        let root = Root::create(&path).unwrap();
        let (first, lock) = root.make_domain().unwrap();
        let (second, _lock) = root.make_domain().unwrap();
        let segments = [("a".to_owned(), 3), ("b".to_owned(), 5)];
        root.write_link("plant", &first, &segments).unwrap();
        let link = root.read_link("plant").unwrap().unwrap();
        assert_eq!((link.domain, &link.segments[..]), (first.clone(), &segments[..]));
        let refused = root.write_link("plant", &second, &[]).unwrap_err();
        assert!(matches!(refused, DomainError::ServedElsewhere), "{refused}");
        root.remove_link("plant", &second).unwrap();
        assert!(root.read_link("plant").unwrap().is_some());
        drop(lock);
        root.write_link("plant", &second, &[]).unwrap();
        root.remove_link("plant", &second).unwrap();
        assert!(root.read_link("plant").unwrap().is_none());
        fs::remove_dir_all(&path).unwrap();
    }
}
