//! A recording in progress: its thread, and how it ends.

use std::fs::File;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use mcap::McapError;
use plantd_proto::v1::{self, RecordingStatus};

use crate::core::plant::tap::Tap;
use crate::core::session::shared::Session;
use crate::wire::record::progress::{Options, Shared, unix_ns};
use crate::wire::record::work::Work;

/// Longest wait for a recording to end whose disk does not answer.
const END_WAIT_MAX: Duration = Duration::from_millis(if cfg!(test) { 300 } else { 10_000 });

/// A recording in progress, or one that has ended.
pub(super) struct Recorder {
    session: Weak<Session>,
    shared: Arc<Shared>,
    /// Of a recording in progress: one that has ended keeps no ring.
    tap: Weak<Tap>,
    /// Number of the ring's record with which it begins.
    first: u64,
    /// Breaks off when the thread ends.
    ended: Mutex<Receiver<()>>,
}

/// Why a recording was not started.
pub(super) enum StartError {
    /// The plant is being recorded.
    Active,
    /// The file could not be written.
    File(McapError),
}

impl Recorder {
    /// Starts to record a plant into a file.
    pub(super) fn start(
        session: &Arc<Session>,
        file: File,
        options: Options,
    ) -> Result<Self, StartError> {
        let (tap, mark, plant) = session.open_tap().ok_or(StartError::Active)?;
        let started = SystemTime::now();
        let info = v1::Recording {
            name: options.name.clone(),
            plant: session.id().to_owned(),
            status: RecordingStatus::Active.into(),
            started_unix_ns: unix_ns(started),
            ..Default::default()
        };
        let shared = Arc::new(Shared {
            is_ending: AtomicBool::new(false),
            bytes: Arc::default(),
            info: Mutex::new(info),
        });
        let (ends, ended) = mpsc::channel();
        let outcome =
            Work::new(session, &tap, &mark, plant, file, options, &shared).and_then(|run| {
                let work = move || {
                    let _ends: Sender<()> = ends;
                    run.run();
                };
                let name = format!("record {}", session.id());
                thread::Builder::new().name(name).spawn(work).map_err(McapError::Io)
            });
        match outcome {
            Ok(thread) => {
                tap.set_recorder(thread.thread().clone());
                let (session, tap) = (Arc::downgrade(session), Arc::downgrade(&tap));
                Ok(Self { session, shared, tap, first: mark.at, ended: Mutex::new(ended) })
            }
            Err(error) => {
                session.close_tap(&tap, 2);
                Err(StartError::File(error))
            }
        }
    }

    /// What is to be said of it.
    pub(super) fn info(&self) -> v1::Recording {
        let bytes = self.shared.bytes.load(Ordering::Relaxed);
        v1::Recording { bytes, ..self.shared.info().clone() }
    }

    /// It is in progress.
    pub(super) fn is_active(&self) -> bool {
        self.shared.info().status() == RecordingStatus::Active
    }

    /// Lets it end.
    pub(super) fn begin_to_end(&self) {
        self.shared.is_ending.store(true, Ordering::Release);
        if let Some(tap) = self.tap.upgrade() {
            tap.wake();
        }
    }

    /// Ends it, and waits until the file is complete, or for a disk that does not answer.
    pub(super) fn stop(&self) {
        self.begin_to_end();
        self.wait_until(Instant::now() + END_WAIT_MAX);
    }

    /// Ends all, as [`Recorder::stop`] does.
    pub(super) fn stop_all(recorders: &[Arc<Self>]) {
        recorders.iter().for_each(|recorder| recorder.begin_to_end());
        let deadline = Instant::now() + END_WAIT_MAX;
        recorders.iter().for_each(|recorder| recorder.wait_until(deadline));
    }

    fn wait_until(&self, deadline: Instant) {
        let ended = self.ended.lock().unwrap_or_else(PoisonError::into_inner);
        let left = deadline.saturating_duration_since(Instant::now());
        let why = match ended.recv_timeout(left) {
            Ok(()) | Err(RecvTimeoutError::Disconnected) => "the recorder has panicked",
            Err(RecvTimeoutError::Timeout) => "the disk does not answer",
        };
        let mut info = self.shared.info();
        if info.status() != RecordingStatus::Active {
            return;
        }
        // If the disk answers after all, the thread says how it ended.
        info.status = RecordingStatus::Failed.into();
        why.clone_into(&mut info.failure);
        let tap = self.tap.upgrade();
        info.lost = tap.as_ref().map_or(0, |tap| tap.ring.written() - self.first - info.steps);
        let (recording, lost) = (info.name.clone(), info.lost);
        drop(info);
        tracing::error!(recording, lost, why, "recording given up");
        if let (Some(session), Some(tap)) = (self.session.upgrade(), tap) {
            session.close_tap(&tap, 3);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::driver::DriverKind;
    use crate::wire::record::progress::sentence;
    use crate::wire::record::work::tests::{options, session};

    #[test]
    fn a_disk_that_does_not_answer_holds_up_neither_the_plant_nor_the_end() {
        let session = session();
        // A pipe that nobody empties.
        let (reader, writer) = std::io::pipe().unwrap();
        let file = File::from(std::os::fd::OwnedFd::from(writer));
        let Ok(hung) = Recorder::start(&session, file, options()) else { panic!("no recording") };
        let steps = 4 * hung.tap.upgrade().unwrap().ring.capacity() as u64;
        let mut lease = session.acquire(DriverKind::Step).unwrap();
        for _ in 0..steps {
            lease.step(&[0.1]).unwrap();
        }
        hung.stop();
        let info = hung.info();
        assert_eq!(info.status(), RecordingStatus::Failed);
        assert!(info.failure.contains("does not answer"), "{}", info.failure);
        assert_eq!(info.steps + info.lost, steps);
        assert!(session.with_core(|core| core.records.ring.is_none()));
        // The next one is not its business when it goes on after all.
        let directory = tempfile::tempdir().unwrap();
        let file = File::create(directory.path().join("r.mcap")).unwrap();
        let Ok(next) = Recorder::start(&session, file, options()) else { panic!("no recording") };
        drop(reader);
        hung.ended.lock().unwrap().recv().unwrap_err();
        lease.step(&[0.1]).unwrap();
        next.stop();
        let info = next.info();
        assert_eq!((info.status(), info.steps), (RecordingStatus::Done, 1));
    }

    #[test]
    fn a_full_disk_is_told_and_the_plant_can_be_recorded_again() {
        let session = session();
        let full = File::options().write(true).open("/dev/full").unwrap();
        match Recorder::start(&session, full, options()) {
            Err(StartError::File(error)) => {
                assert!(sentence(&error).contains("No space left"), "{}", sentence(&error));
            }
            _ => panic!("a recording on a full disk"),
        }
        let mut lease = session.acquire(DriverKind::Step).unwrap();
        lease.step(&[0.2]).unwrap();
        assert!(session.with_core(|core| core.records.ring.is_none()));
        let directory = tempfile::tempdir().unwrap();
        let file = File::create(directory.path().join("r.mcap")).unwrap();
        let Ok(recorder) = Recorder::start(&session, file, options()) else {
            panic!("no recording")
        };
        let again = File::create(directory.path().join("s.mcap")).unwrap();
        assert!(matches!(Recorder::start(&session, again, options()), Err(StartError::Active)));
        lease.step(&[0.2]).unwrap();
        recorder.stop();
        let info = recorder.info();
        assert_eq!((info.status(), info.steps), (RecordingStatus::Done, 1));
        assert!(session.with_core(|core| core.records.ring.is_none()));
        // What is known of it stays, its ring does not.
        assert!(recorder.tap.upgrade().is_none());
    }
}
