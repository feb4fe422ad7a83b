//! The recordings in a directory. Those of a tenant lie in a folder of its own, see `folders.rs`;
//! names are taken for all tenants together. Where there is an archive, those that have ended go there.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Seek as _};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use plantd_proto::v1::{self, RecordingStatus};
use tokio::sync::Semaphore;
use tonic::Code;

use crate::core::connection::Caller;
use crate::core::limits::{LimitExceeded, Limits};
use crate::core::modes::Mode;
use crate::core::mutex::lock;
use crate::core::room::Reservation;
use crate::core::session::shared::Session;
use crate::core::tenant::{Account, Tenant, Tenants};
use crate::wire::message::checks::check_name;
use crate::wire::record::archive::{Archive, Archived};
use crate::wire::record::folders::{folder_of, folders};
use crate::wire::record::progress::{Options, Share, sentence};
use crate::wire::record::recorder::{Recorder, StartError};
use crate::wire::status::RpcError;

const EXTENSION: &str = "mcap";
/// Time between snapshots unless another one is asked for, s.
const CHECKPOINT_INTERVAL_S: f64 = 5.0;
/// Longest and shortest time that can be asked for, s.
const CHECKPOINT_INTERVAL_RANGE_S: (f64, f64) = (0.1, 86_400.0);

/// Calls that may wait for the disk at a time.
const WAITING_MAX: usize = 8;

/// A recording that this server has begun.
struct Own {
    recorder: Arc<Recorder>,
    /// Its bytes go on to count until it is deleted.
    _share: Share,
}

/// A recording's file.
struct Entry {
    name: String,
    tenant: Tenant,
    path: PathBuf,
}

/// Where a recording is.
enum Found {
    Here(Entry),
    Archived(Tenant, Archived),
}

/// The recordings in a directory.
pub struct Recordings {
    directory: PathBuf,
    mode: Mode,
    limits: Limits,
    tenants: Arc<Tenants>,
    archive: Option<Arc<dyn Archive>>,
    /// Held while one goes to the archive.
    archiving: Mutex<()>,
    /// Those that this server has begun; none while it begins. Nobody waits for the disk with this in hand.
    own: Mutex<BTreeMap<String, Option<Own>>>,
    /// Permits to wait for the disk: one that does not answer holds no more threads than these.
    permits: Arc<Semaphore>,
}

impl Recordings {
    /// The recordings in a directory, made if there is none; the mode is that of its files.
    pub fn open(
        directory: &Path,
        mode: Mode,
        limits: Limits,
        tenants: Arc<Tenants>,
        archive: Option<Arc<dyn Archive>>,
    ) -> io::Result<Self> {
        mode.create_directory(directory)?;
        let permits = Arc::new(Semaphore::new(WAITING_MAX));
        let (directory, own) = (directory.to_owned(), Mutex::default());
        let archiving = Mutex::default();
        Ok(Self { directory, mode, limits, tenants, archive, archiving, own, permits })
    }

    /// Does something for which the disk is waited for, on a thread that may wait.
    pub async fn wait<R: Send + 'static>(
        &self,
        job: impl FnOnce() -> Result<R, RpcError> + Send + 'static,
    ) -> Result<R, RpcError> {
        let permit = Arc::clone(&self.permits).acquire_owned().await;
        let caller = Caller::current();
        let work = move || {
            let _permit = permit;
            caller.scope(job)
        };
        let outcome = tokio::task::spawn_blocking(work).await;
        outcome.unwrap_or_else(|error| Err(RpcError::internal(error.to_string())))
    }

    /// Starts to record a plant. Writes a file: call it on a worker.
    pub fn start(
        &self,
        session: &Arc<Session>,
        name: String,
        checkpoint_interval_s: f64,
    ) -> Result<v1::Recording, RpcError> {
        let name = if name.is_empty() { name_for(session.id()) } else { name };
        check_name("name", &name)?;
        let interval_s = match checkpoint_interval_s {
            0.0 => CHECKPOINT_INTERVAL_S,
            given => given,
        };
        let (low, high) = CHECKPOINT_INTERVAL_RANGE_S;
        if !(low..=high).contains(&interval_s) {
            let problem = format!("is {interval_s}; it must lie between {low} and {high}");
            return Err(RpcError::field("checkpoint_interval_s", problem));
        }
        Caller::note(&name);
        let owner = self.tenants.account(session.owner());
        let in_progress = owner.rooms.active_recordings.reserve(1)?;
        let former = {
            let mut own = self.own();
            let active = own.values().filter(|recorder| is_active(recorder)).count() + 1;
            let (limit, what) = (self.limits.active_recordings, "recordings in progress");
            LimitExceeded::check("active_recordings", limit, what, active)?;
            if own.get(&name).is_some_and(is_active) {
                return Err(RpcError::recording_exists(&name));
            }
            own.insert(name.clone(), None)
        };
        let interval = Duration::from_secs_f64(interval_s);
        let started = self.share(&owner).and_then(|share| {
            Ok((self.begin(session, &name, interval, share.clone(), in_progress)?, share))
        });
        let mut own = self.own();
        match started {
            Ok((recorder, share)) => {
                let info = recorder.info();
                let recorder = Arc::new(recorder);
                own.insert(name, Some(Own { recorder, _share: share }));
                Ok(info)
            }
            Err(fault) => {
                own.remove(&name);
                own.extend(former.map(|former| (name, former)));
                Err(fault)
            }
        }
    }

    /// What the recordings of a tenant may still take.
    fn share(&self, owner: &Account) -> Result<Share, RpcError> {
        let room = Arc::clone(&owner.rooms.recording_bytes);
        let own = Arc::new(Mutex::new(room.reserve(0)?));
        let Some(limit) = owner.limits.recording_bytes else {
            return Ok(Share { room, own, bytes_max: u64::MAX });
        };
        // What former servers have left, which nobody counts yet.
        let files = self.files().map_err(|error| failed(&error))?;
        let begun = self.own();
        let left = files.iter().filter(|file| {
            file.tenant == owner.tenant && begun.get(&file.name).is_none_or(Option::is_none)
        });
        let bytes = |file: &Entry| fs::metadata(&file.path).map_or(0, |metadata| metadata.len());
        let mut left: u64 = left.map(bytes).sum();
        if let Some(archive) = &self.archive {
            let archived = archive.list(owner.tenant).map_err(|error| failed(&error))?;
            left += archived.iter().map(|archived| archived.bytes).sum::<u64>();
        }
        let (name, what) = ("tenant.recording_bytes", "bytes of this tenant's recordings");
        let actual = left.saturating_add(room.used());
        if actual >= limit {
            return Err(LimitExceeded { name, limit, what, actual }.into());
        }
        Ok(Share { room, own, bytes_max: limit - left })
    }

    fn begin(
        &self,
        session: &Arc<Session>,
        name: &str,
        checkpoint_interval: Duration,
        share: Share,
        in_progress: Reservation,
    ) -> Result<Recorder, RpcError> {
        let files = self.files().map_err(|error| failed(&error))?;
        let (limit, count) = (self.limits.recordings, files.len() + 1);
        LimitExceeded::check("recordings", limit, "recordings", count)?;
        let is_archived = match &self.archive {
            Some(archive) => {
                archive.length(session.owner(), name).map_err(|error| failed(&error))?
            }
            None => None,
        };
        if is_archived.is_some() || files.iter().any(|file| file.name == name) {
            return Err(RpcError::recording_exists(name));
        }
        let folder = folder_of(&self.directory, &self.tenants, session.owner());
        self.mode.create_directory(&folder).map_err(|error| failed(&error))?;
        let path = folder.join(name).with_extension(EXTENSION);
        let file = self.mode.create_new(&path).map_err(|error| match error.kind() {
            io::ErrorKind::AlreadyExists => RpcError::recording_exists(name),
            _ => failed(&error),
        })?;
        let (name, bytes_max) = (name.to_owned(), self.limits.recording_bytes);
        let options =
            Options { name, checkpoint_interval, bytes_max, share, _in_progress: in_progress };
        Recorder::start(session, file, options).map_err(|error| {
            // Nothing is in it yet.
            let _ = fs::remove_file(&path);
            match error {
                StartError::Active => RpcError::recording_active(format!("plant:{}", session.id())),
                StartError::File(error) => failed(&sentence(&error)),
            }
        })
    }

    /// Ends a recording and waits for it: call it on a worker.
    pub fn stop(&self, name: &str) -> Result<v1::Recording, RpcError> {
        let file = match self.find(name)? {
            Found::Here(file) => file,
            Found::Archived(_, archived) => return Ok(done(&archived)),
        };
        match self.recorder(name) {
            Some(recorder) => {
                recorder.stop();
                Ok(recorder.info())
            }
            None => left(&file),
        }
    }

    /// Ends all of them.
    pub fn stop_all(&self) {
        let own = self.own();
        let all: Vec<_> = own.values().flatten().map(|own| Arc::clone(&own.recorder)).collect();
        drop(own);
        Recorder::stop_all(&all);
    }

    /// Up to `size` recordings after the one named `after`, and whether there are more.
    pub fn page(&self, after: &str, size: usize) -> Result<(Vec<v1::Recording>, bool), RpcError> {
        let mut files = self.files().map_err(|error| failed(&error))?;
        files.retain(|file| self.tenants.shows(file.tenant));
        let here = files.into_iter().map(|file| (file.name.clone(), Found::Here(file)));
        let archived = self.archived()?;
        let archived = archived
            .into_iter()
            .map(|(tenant, archived)| (archived.name.clone(), Found::Archived(tenant, archived)));
        // One that is on its way into the archive is still here.
        let all: BTreeMap<_, _> = archived.chain(here).collect();
        let mut rest = all.into_iter().filter(|(name, _)| name.as_str() > after);
        let page: Vec<_> = rest.by_ref().take(size).collect();
        let info = |(name, found): (String, Found)| match found {
            Found::Archived(_, archived) => Ok(done(&archived)),
            Found::Here(file) => match self.recorder(&name) {
                Some(recorder) => Ok(recorder.info()),
                None => left(&file),
            },
        };
        let has_more = rest.next().is_some();
        // One that was deleted since is left out.
        Ok((page.into_iter().filter_map(|found| info(found).ok()).collect(), has_more))
    }

    /// What the archive has for the caller.
    fn archived(&self) -> Result<Vec<(Tenant, Archived)>, RpcError> {
        let Some(archive) = &self.archive else { return Ok(Vec::new()) };
        let mut all = Vec::new();
        for tenant in archive.tenants().map_err(|error| failed(&error))? {
            if self.tenants.shows(tenant) {
                let archived = archive.list(tenant).map_err(|error| failed(&error))?;
                all.extend(archived.into_iter().map(|archived| (tenant, archived)));
            }
        }
        Ok(all)
    }

    /// The file of a recording, and its present length. Of an archived one it is a copy, without a name.
    pub fn file(&self, name: &str) -> Result<(File, u64), RpcError> {
        let open = || match self.find(name)? {
            Found::Here(file) => {
                let file =
                    File::open(&file.path).map_err(|error| not_found_or_failed(name, &error))?;
                Ok(file)
            }
            Found::Archived(tenant, _) => {
                self.copy(tenant, name).map_err(|error| not_found_or_failed(name, &error))
            }
        };
        let file = open()?;
        let metadata = file.metadata().map_err(|error| failed(&error))?;
        Ok((file, metadata.len()))
    }

    fn copy(&self, tenant: Tenant, name: &str) -> io::Result<File> {
        let Some(archive) = &self.archive else { return Err(io::ErrorKind::NotFound.into()) };
        let file = tempfile::tempfile_in(&self.directory)?;
        archive.get(tenant, name, &file)?;
        (&file).rewind()?;
        Ok(file)
    }

    /// Deletes a recording that is not in progress.
    pub fn delete(&self, name: &str) -> Result<(), RpcError> {
        let _archiving = lock(&self.archiving);
        let file = match (self.find(name)?, &self.archive) {
            (Found::Here(file), _) => file,
            (Found::Archived(tenant, _), Some(archive)) => {
                return match archive.delete(tenant, name).map_err(|error| failed(&error))? {
                    true => Ok(()),
                    false => Err(RpcError::recording_not_found(name)),
                };
            }
            (Found::Archived(..), None) => return Err(RpcError::recording_not_found(name)),
        };
        if self.own().get(name).is_some_and(is_active) {
            return Err(RpcError::recording_active(format!("recording:{name}")));
        }
        fs::remove_file(&file.path).map_err(|error| not_found_or_failed(name, &error))?;
        // One of that name may have begun since.
        self.own().retain(|other, recorder| other != name || is_active(recorder));
        Ok(())
    }

    /// What has ended goes to an archive.
    pub fn has_archive(&self) -> bool {
        self.archive.is_some()
    }

    /// Brings what has ended into the archive. What cannot be brought stays, and is tried again.
    pub fn archive_ended(&self) {
        let Some(archive) = &self.archive else { return };
        let files = match self.files() {
            Ok(files) => files,
            Err(error) => return tracing::error!(%error, "recordings not archived"),
        };
        for Entry { name, tenant, path } in files {
            let _archiving = lock(&self.archiving);
            if self.own().get(&name).is_some_and(is_active) {
                continue;
            }
            let bring = || {
                let file = File::open(&path)?;
                if archive.length(tenant, &name)?.is_some() {
                    let problem = "one of that name is there already";
                    return Err(io::Error::new(io::ErrorKind::AlreadyExists, problem));
                }
                archive.put(tenant, &name, &file)?;
                fs::remove_file(&path)
            };
            match bring() {
                Ok(()) => {
                    self.own().retain(|other, recorder| *other != name || is_active(recorder));
                    tracing::info!(recording = name, "recording archived");
                }
                // Deleted meanwhile.
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => tracing::error!(recording = name, %error, "recording not archived"),
            }
        }
    }

    /// One that this server has begun.
    fn recorder(&self, name: &str) -> Option<Arc<Recorder>> {
        self.own().get(name)?.as_ref().map(|own| Arc::clone(&own.recorder))
    }

    /// A recording that is there for the caller.
    fn find(&self, name: &str) -> Result<Found, RpcError> {
        check_name("name", name)?;
        Caller::note(name);
        let folders = folders(&self.directory, &self.tenants).map_err(|error| failed(&error))?;
        for (tenant, folder) in folders {
            let path = folder.join(name).with_extension(EXTENSION);
            if self.tenants.shows(tenant) && path.exists() {
                return Ok(Found::Here(Entry { name: name.to_owned(), tenant, path }));
            }
        }
        let Some(archive) = &self.archive else { return Err(RpcError::recording_not_found(name)) };
        for tenant in archive.tenants().map_err(|error| failed(&error))? {
            if self.tenants.shows(tenant)
                && let Some(bytes) = archive.length(tenant, name).map_err(|error| failed(&error))?
            {
                let name = name.to_owned();
                return Ok(Found::Archived(tenant, Archived { name, bytes }));
            }
        }
        Err(RpcError::recording_not_found(name))
    }

    /// All recordings. Files with other names belong to somebody else.
    fn files(&self) -> io::Result<Vec<Entry>> {
        let mut files = Vec::new();
        for (tenant, folder) in folders(&self.directory, &self.tenants)? {
            for entry in fs::read_dir(&folder)? {
                let path = entry?.path();
                let stem = path.file_stem().and_then(|stem| stem.to_str());
                if let Some(name) = stem.filter(|name| check_name("name", name).is_ok())
                    && path.extension().is_some_and(|kind| kind == EXTENSION)
                {
                    let name = name.to_owned();
                    files.push(Entry { name, tenant, path });
                }
            }
        }
        Ok(files)
    }

    fn own(&self) -> MutexGuard<'_, BTreeMap<String, Option<Own>>> {
        self.own.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What can be said of a file that another server has left.
fn left(file: &Entry) -> Result<v1::Recording, RpcError> {
    let name = &file.name;
    let metadata = fs::metadata(&file.path);
    let bytes = metadata.map_err(|error| not_found_or_failed(name, &error))?.len();
    let status = RecordingStatus::Done.into();
    Ok(v1::Recording { name: name.clone(), status, bytes, ..Default::default() })
}

/// What can be said of one in the archive.
fn done(archived: &Archived) -> v1::Recording {
    let Archived { name, bytes } = archived.clone();
    v1::Recording { name, status: RecordingStatus::Done.into(), bytes, ..Default::default() }
}

/// It begins or is in progress.
fn is_active(own: &Option<Own>) -> bool {
    own.as_ref().is_none_or(|own| own.recorder.is_active())
}

/// A name from a plant's id, cut where it would be too long, and the time.
fn name_for(id: &str) -> String {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    format!("{}-{}", &id[..id.len().min(40)], now.as_millis())
}

fn failed(error: &dyn std::fmt::Display) -> RpcError {
    RpcError::new(Code::Unavailable, "RECORDING_FAILED", format!("the recording: {error}"))
}

fn not_found_or_failed(name: &str, error: &io::Error) -> RpcError {
    match error.kind() {
        io::ErrorKind::NotFound => RpcError::recording_not_found(name),
        _ => failed(error),
    }
}
