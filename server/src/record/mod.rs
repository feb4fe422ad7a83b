//! Recordings: what plants do, in files from which it can be done again.
//!
//! ```text
//!  plant ── ring of steps, marks ──► recorder, a thread ──► NAME.mcap
//! ```
//!
//! While a plant is recorded, its steps write into the ring. Those that somebody asks for, one by one, wait
//! where the recorder does not follow; those of a plant that runs by itself do not, and the recorder counts
//! what it has lost and says so in the file. What happens between steps (a reset, changed parameters) comes
//! as marks, each with a snapshot; so do checkpoints, every few seconds. A replay begins at any mark that
//! has one.

mod file;
mod recorder;
mod schema;

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use plantd_proto::v1::{self, RecordingStatus};
use tonic::Code;

use self::recorder::{Options, Recorder, StartError, sentence};
use crate::convert::check_name;
use crate::limits::{LimitExceeded, Limits};
use crate::session::Session;
use crate::status::Fault;

const EXTENSION: &str = "mcap";
/// Time between snapshots unless another one is asked for, s.
const CHECKPOINT_INTERVAL_S: f64 = 5.0;
/// Longest and shortest time that can be asked for, s.
const CHECKPOINT_INTERVAL_RANGE_S: (f64, f64) = (0.1, 86_400.0);

/// The recordings in a directory.
pub struct Recordings {
    directory: PathBuf,
    limits: Limits,
    /// Those that this server has begun.
    own: Mutex<BTreeMap<String, Arc<Recorder>>>,
}

impl Recordings {
    /// The recordings in a directory, made if there is none.
    pub fn open(directory: &Path, limits: Limits) -> io::Result<Self> {
        fs::create_dir_all(directory)?;
        Ok(Self { directory: directory.to_owned(), limits, own: Mutex::default() })
    }

    /// Starts to record a plant. Writes a file: call it on a worker.
    pub fn start(
        &self,
        session: &Arc<Session>,
        name: String,
        checkpoint_interval_s: f64,
    ) -> Result<v1::Recording, Fault> {
        let name = if name.is_empty() { name_for(session.id()) } else { name };
        check_name("name", &name)?;
        let interval_s = match checkpoint_interval_s {
            0.0 => CHECKPOINT_INTERVAL_S,
            given => given,
        };
        let (low, high) = CHECKPOINT_INTERVAL_RANGE_S;
        if !(low..=high).contains(&interval_s) {
            let problem = format!("is {interval_s}; it must lie between {low} and {high}");
            return Err(Fault::field("checkpoint_interval_s", problem));
        }
        let mut own = self.own();
        let active = own.values().filter(|recorder| recorder.is_active()).count() + 1;
        let (limit, what) = (self.limits.active_recordings, "recordings in progress");
        LimitExceeded::check("active_recordings", limit, what, active)?;
        let count = self.files().map_err(|error| failed(&error))?.len() + 1;
        LimitExceeded::check("recordings", self.limits.recordings, "recordings", count)?;
        let path = self.path(&name);
        let file = File::create_new(&path).map_err(|error| match error.kind() {
            io::ErrorKind::AlreadyExists => Fault::recording_exists(&name),
            _ => failed(&error),
        })?;
        let options = Options {
            name: name.clone(),
            checkpoint_interval: Duration::from_secs_f64(interval_s),
            bytes_max: self.limits.recording_bytes,
        };
        let started = Recorder::start(session, file, options).map_err(|error| {
            // Nothing is in it yet.
            let _ = fs::remove_file(&path);
            match error {
                StartError::Active => Fault::recording_active(format!("plant:{}", session.id())),
                StartError::File(error) => failed(&sentence(&error)),
            }
        });
        let recorder = started?;
        let info = recorder.info();
        own.insert(name, Arc::new(recorder));
        Ok(info)
    }

    /// Ends a recording and waits for it: call it on a worker.
    pub fn stop(&self, name: &str) -> Result<v1::Recording, Fault> {
        check_name("name", name)?;
        let recorder = self.own().get(name).map(Arc::clone);
        match recorder {
            Some(recorder) => {
                recorder.stop();
                Ok(recorder.info())
            }
            None => self.left(name),
        }
    }

    /// Ends all of them.
    pub fn stop_all(&self) {
        let all: Vec<_> = self.own().values().map(Arc::clone).collect();
        for recorder in all {
            recorder.stop();
        }
    }

    /// Up to `size` recordings after the one named `after`, and whether there are more.
    pub fn page(&self, after: &str, size: usize) -> Result<(Vec<v1::Recording>, bool), Fault> {
        let mut names = self.files().map_err(|error| failed(&error))?;
        names.retain(|name| name.as_str() > after);
        names.sort();
        let has_more = names.len() > size;
        names.truncate(size);
        let own = self.own();
        let info = |name: &String| match own.get(name) {
            Some(recorder) => Ok(recorder.info()),
            None => self.left(name),
        };
        // One that was deleted since is left out.
        Ok((names.iter().filter_map(|name| info(name).ok()).collect(), has_more))
    }

    /// The file of a recording, and its present length.
    pub fn file(&self, name: &str) -> Result<(File, u64), Fault> {
        check_name("name", name)?;
        let open = || {
            let file = File::open(self.path(name))?;
            let length = file.metadata()?.len();
            Ok((file, length))
        };
        open().map_err(|error: io::Error| not_found_or_failed(name, &error))
    }

    /// Deletes a recording that is not in progress.
    pub fn delete(&self, name: &str) -> Result<(), Fault> {
        check_name("name", name)?;
        let mut own = self.own();
        if own.get(name).is_some_and(|recorder| recorder.is_active()) {
            return Err(Fault::recording_active(format!("recording:{name}")));
        }
        fs::remove_file(self.path(name)).map_err(|error| not_found_or_failed(name, &error))?;
        own.remove(name);
        Ok(())
    }

    /// What can be said of a file that another server has left.
    fn left(&self, name: &str) -> Result<v1::Recording, Fault> {
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

    fn own(&self) -> MutexGuard<'_, BTreeMap<String, Arc<Recorder>>> {
        self.own.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A name from a plant's id, cut where it would be too long, and the time.
fn name_for(id: &str) -> String {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    format!("{}-{}", &id[..id.len().min(40)], now.as_millis())
}

fn failed(error: &dyn std::fmt::Display) -> Fault {
    Fault::new(Code::Unavailable, "RECORDING_FAILED", format!("the recording: {error}"))
}

fn not_found_or_failed(name: &str, error: &io::Error) -> Fault {
    match error.kind() {
        io::ErrorKind::NotFound => Fault::recording_not_found(name),
        _ => failed(error),
    }
}
