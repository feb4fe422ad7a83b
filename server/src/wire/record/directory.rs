//! The recordings in a directory.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use plantd_proto::v1::{self, RecordingStatus};
use tokio::sync::Semaphore;
use tonic::Code;

use crate::core::limits::{LimitExceeded, Limits};
use crate::core::modes::Mode;
use crate::core::session::shared::Session;
use crate::wire::message::checks::check_name;
use crate::wire::record::progress::{Options, sentence};
use crate::wire::record::recorder::{Recorder, StartError};
use crate::wire::status::RpcError;

const EXTENSION: &str = "mcap";
/// Time between snapshots unless another one is asked for, s.
const CHECKPOINT_INTERVAL_S: f64 = 5.0;
/// Longest and shortest time that can be asked for, s.
const CHECKPOINT_INTERVAL_RANGE_S: (f64, f64) = (0.1, 86_400.0);

/// Calls that may wait for the disk at a time.
const WAITING_MAX: usize = 8;

/// The recordings in a directory.
pub struct Recordings {
    directory: PathBuf,
    mode: Mode,
    limits: Limits,
    /// Those that this server has begun; none while it begins. Nobody waits for the disk with this in hand.
    own: Mutex<BTreeMap<String, Option<Arc<Recorder>>>>,
    /// Permits to wait for the disk: one that does not answer holds no more threads than these.
    permits: Arc<Semaphore>,
}

impl Recordings {
    /// The recordings in a directory, made if there is none; the mode is that of its files.
    pub fn open(directory: &Path, mode: Mode, limits: Limits) -> io::Result<Self> {
        mode.create_directory(directory)?;
        let permits = Arc::new(Semaphore::new(WAITING_MAX));
        Ok(Self { directory: directory.to_owned(), mode, limits, own: Mutex::default(), permits })
    }

    /// Does something for which the disk is waited for, on a thread that may wait.
    pub async fn wait<R: Send + 'static>(
        &self,
        job: impl FnOnce() -> Result<R, RpcError> + Send + 'static,
    ) -> Result<R, RpcError> {
        let permit = Arc::clone(&self.permits).acquire_owned().await;
        let work = move || {
            let _permit = permit;
            job()
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
        let started = self.begin(session, &name, Duration::from_secs_f64(interval_s));
        let mut own = self.own();
        match started {
            Ok(recorder) => {
                let info = recorder.info();
                own.insert(name, Some(Arc::new(recorder)));
                Ok(info)
            }
            Err(fault) => {
                own.remove(&name);
                own.extend(former.map(|former| (name, former)));
                Err(fault)
            }
        }
    }

    fn begin(
        &self,
        session: &Arc<Session>,
        name: &str,
        checkpoint_interval: Duration,
    ) -> Result<Recorder, RpcError> {
        let count = self.files().map_err(|error| failed(&error))?.len() + 1;
        LimitExceeded::check("recordings", self.limits.recordings, "recordings", count)?;
        let path = self.path(name);
        let file = self.mode.create_new(&path).map_err(|error| match error.kind() {
            io::ErrorKind::AlreadyExists => RpcError::recording_exists(name),
            _ => failed(&error),
        })?;
        let (name, bytes_max) = (name.to_owned(), self.limits.recording_bytes);
        let options = Options { name, checkpoint_interval, bytes_max };
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
        check_name("name", name)?;
        match self.recorder(name) {
            Some(recorder) => {
                recorder.stop();
                Ok(recorder.info())
            }
            None => self.left(name),
        }
    }

    /// Ends all of them.
    pub fn stop_all(&self) {
        let all: Vec<_> = self.own().values().flatten().map(Arc::clone).collect();
        Recorder::stop_all(&all);
    }

    /// Up to `size` recordings after the one named `after`, and whether there are more.
    pub fn page(&self, after: &str, size: usize) -> Result<(Vec<v1::Recording>, bool), RpcError> {
        let mut names = self.files().map_err(|error| failed(&error))?;
        names.retain(|name| name.as_str() > after);
        names.sort();
        let has_more = names.len() > size;
        names.truncate(size);
        let info = |name: &String| match self.recorder(name) {
            Some(recorder) => Ok(recorder.info()),
            None => self.left(name),
        };
        // One that was deleted since is left out.
        Ok((names.iter().filter_map(|name| info(name).ok()).collect(), has_more))
    }

    /// The file of a recording, and its present length.
    pub fn file(&self, name: &str) -> Result<(File, u64), RpcError> {
        check_name("name", name)?;
        let open = || {
            let file = File::open(self.path(name))?;
            let length = file.metadata()?.len();
            Ok((file, length))
        };
        open().map_err(|error: io::Error| not_found_or_failed(name, &error))
    }

    /// Deletes a recording that is not in progress.
    pub fn delete(&self, name: &str) -> Result<(), RpcError> {
        check_name("name", name)?;
        if self.own().get(name).is_some_and(is_active) {
            return Err(RpcError::recording_active(format!("recording:{name}")));
        }
        fs::remove_file(self.path(name)).map_err(|error| not_found_or_failed(name, &error))?;
        // One of that name may have begun since.
        self.own().retain(|other, recorder| other != name || is_active(recorder));
        Ok(())
    }

    /// One that this server has begun.
    fn recorder(&self, name: &str) -> Option<Arc<Recorder>> {
        self.own().get(name)?.as_ref().map(Arc::clone)
    }

    /// What can be said of a file that another server has left.
    fn left(&self, name: &str) -> Result<v1::Recording, RpcError> {
        let metadata = fs::metadata(self.path(name));
        let bytes = metadata.map_err(|error| not_found_or_failed(name, &error))?.len();
        let status = RecordingStatus::Done.into();
        Ok(v1::Recording { name: name.to_owned(), status, bytes, ..Default::default() })
    }

    /// Names of all recordings. Files with other names belong to somebody else.
    fn files(&self) -> io::Result<Vec<String>> {
        let mut names = Vec::new();
        for entry in fs::read_dir(&self.directory)? {
            let path = entry?.path();
            let stem = path.file_stem().and_then(|stem| stem.to_str());
            if let Some(name) = stem.filter(|name| check_name("name", name).is_ok())
                && path.extension().is_some_and(|kind| kind == EXTENSION)
            {
                names.push(name.to_owned());
            }
        }
        Ok(names)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.directory.join(name).with_extension(EXTENSION)
    }

    fn own(&self) -> MutexGuard<'_, BTreeMap<String, Option<Arc<Recorder>>>> {
        self.own.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// It begins or is in progress.
fn is_active(recorder: &Option<Arc<Recorder>>) -> bool {
    recorder.as_ref().is_none_or(|recorder| recorder.is_active())
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
