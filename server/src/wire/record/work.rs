//! What the thread of a recording does, away from the plant.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use mcap::McapError;
use plantd_models::Plant;
use plantd_models::parameters::Parameters;
use plantd_proto::link::monotonic_ns;
use plantd_proto::v1::{self, MarkReason, RecordingStatus};

use crate::core::channels::timeline::Announced;
use crate::core::plant::event::EventReader;
use crate::core::plant::mark::{Mark, MarkReason as Marked};
use crate::core::plant::tap::Tap;
use crate::core::publish::frame::Frame;
use crate::core::publish::ring::Reader;
use crate::core::session::shared::Session;
use crate::wire::message::run_info::event_message;
use crate::wire::record::file::{PlayClock, Times, Writer};
use crate::wire::record::message::{all_parameters, fill, first_frame, plant_record};
use crate::wire::record::picture::Picture;
use crate::wire::record::progress::{Options, Shared, sentence, unix_ns};

/// How often the ring is looked at.
const POLL_INTERVAL: Duration = Duration::from_millis(5);
/// How often what was written is handed to the system.
const FLUSH_INTERVAL: Duration = Duration::from_millis(500);
/// Least time between two snapshots, where disturbances ask for many.
const SNAPSHOT_INTERVAL_MIN: Duration = Duration::from_millis(50);
/// Part of the ring that may wait to be written while pictures are drawn. From a half on, plants that are
/// stepped one by one wait.
const BEHIND_PART: u64 = 4;

/// Counts what goes into a file.
struct Counted {
    file: File,
    bytes: Arc<AtomicU64>,
}

impl Write for Counted {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.file.write(bytes)?;
        self.bytes.fetch_add(written as u64, Ordering::Relaxed);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// What the thread has.
pub(super) struct Work {
    session: Arc<Session>,
    tap: Arc<Tap>,
    reader: Reader,
    events: EventReader,
    writer: Writer<BufWriter<Counted>>,
    options: Options,
    shared: Arc<Shared>,
    clock: Clock,
    play: PlayClock,
    picture: Picture,
    frame: Frame,
    record: v1::StepRecord,
    /// Step from which the next frame follows; none where it follows from nothing.
    at: Option<u64>,
    /// The model's digest and the time step there.
    mechanics: (u64, f64),
    /// What faults may make of the parameters.
    announced: Announced,
    /// Numbers that faults have changed, as they are without these changes.
    unchanged: Parameters,
    lost: u64,
    steps: u64,
    last_snapshot: Instant,
    /// Steps were written since.
    has_moved: bool,
}

impl Work {
    pub(super) fn new(
        session: &Arc<Session>,
        tap: &Arc<Tap>,
        mark: &Mark,
        mut plant: Plant,
        file: File,
        options: Options,
        shared: &Arc<Shared>,
    ) -> Result<Self, McapError> {
        let mut first = plant_record(session, mark, &mut plant);
        let frame = first_frame(&mut plant);
        let mut picture = Picture::new(plant);
        first.drawing = picture.drawing().cloned();
        let mut play = PlayClock::default();
        let times = play.at(mark.time_s);
        let counted = Counted { file, bytes: Arc::clone(&shared.bytes) };
        let mut writer = Writer::new(BufWriter::new(counted), &first, times)?;
        picture.write_shapes(&mut writer, times)?;
        picture.write(&frame, &mut writer, times)?;
        Ok(Self {
            session: Arc::clone(session),
            tap: Arc::clone(tap),
            reader: Reader::from(Arc::clone(&tap.ring), mark.at),
            events: session.events().reader(session.events().next_number()),
            writer,
            options,
            shared: Arc::clone(shared),
            clock: Clock::new(),
            play,
            picture,
            frame,
            record: v1::StepRecord::default(),
            at: Some(mark.step),
            mechanics: (mark.model.digest(), mark.time_step_s),
            announced: mark.announced.clone(),
            unchanged: (*mark.announced.unchanged).clone(),
            lost: 0,
            steps: 0,
            last_snapshot: Instant::now(),
            has_moved: false,
        })
    }

    /// Writes until the recording is to end, or cannot go on.
    pub(super) fn run(mut self) {
        let outcome = self.record();
        let Self { session, tap, reader, writer, shared, options, .. } = self;
        // The ring goes with its last reader.
        drop(reader);
        session.close_tap(&tap, 2);
        let finished = outcome.and_then(|why| {
            let file = writer.finish()?.into_inner().map_err(|error| error.into_error())?;
            file.file.sync_all()?;
            Ok(why)
        });
        let why = finished.unwrap_or_else(|error| Some(sentence(&error)));
        let mut info = shared.info();
        info.status = match why {
            None => RecordingStatus::Done.into(),
            Some(_) => RecordingStatus::Failed.into(),
        };
        let (steps, lost) = (info.steps, info.lost);
        let name = options.name;
        match &why {
            None => tracing::info!(recording = name, steps, lost, "recording ended"),
            Some(why) => tracing::error!(recording = name, steps, lost, why, "recording failed"),
        }
        info.failure = why.unwrap_or_default();
    }

    /// Writes until the recording is to end; says why it ends before its time.
    fn record(&mut self) -> Result<Option<String>, McapError> {
        let (mut flushed, mut flushed_steps) = (Instant::now(), 0);
        loop {
            // Looked at first: what was there by then is written below.
            let is_ending =
                self.shared.is_ending.load(Ordering::Acquire) || self.session.is_closed();
            if self.is_snapshot_due() {
                self.session.checkpoint();
                self.last_snapshot = Instant::now();
                self.has_moved = false;
            }
            self.drain()?;
            self.drain_events()?;
            {
                let mut info = self.shared.info();
                (info.steps, info.lost) = (self.steps, self.reader.lost());
            }
            if is_ending {
                return Ok(None);
            }
            let bytes = self.shared.bytes.load(Ordering::Relaxed);
            if self.options.share.is_used_up(bytes) {
                let sentence = "its tenant's recordings have as many bytes as they may, the limit \
                                `tenant.recording_bytes`";
                return Ok(Some(sentence.to_owned()));
            }
            if bytes > self.options.bytes_max {
                let max = self.options.bytes_max;
                return Ok(Some(format!("it has {max} bytes, the limit `recording_bytes`")));
            }
            if flushed.elapsed() >= FLUSH_INTERVAL && flushed_steps != self.steps {
                self.writer.flush()?;
                (flushed, flushed_steps) = (Instant::now(), self.steps);
            }
            thread::park_timeout(POLL_INTERVAL);
        }
    }

    fn is_snapshot_due(&self) -> bool {
        let interval = match self.at {
            Some(_) => self.options.checkpoint_interval,
            None => SNAPSHOT_INTERVAL_MIN,
        };
        (self.has_moved || self.at.is_none()) && self.last_snapshot.elapsed() >= interval
    }

    /// Writes what there is.
    fn drain(&mut self) -> Result<(), McapError> {
        // No more than there is now: who ends a recording shall not wait for a plant that runs.
        let until = self.tap.ring.written();
        while let Some((n, record)) = self.reader.read_next() {
            self.frame.read(record);
            self.take(n)?;
            if n + 1 >= until {
                break;
            }
        }
        // Marks after lost steps wait for the step that comes next.
        if self.reader.lost() == self.lost {
            while let Some(mark) = self.tap.mark_before(until) {
                self.mark(&mark)?;
            }
        }
        Ok(())
    }

    /// Writes what has happened besides steps.
    fn drain_events(&mut self) -> Result<(), McapError> {
        while let Some((number, event)) = self.events.read_next() {
            let message = event_message(number, &event, self.session.model());
            self.writer.event(&message, self.play.now())?;
        }
        Ok(())
    }

    /// Writes the step in `frame`, the ring's record `n`, and what was before it.
    fn take(&mut self, n: u64) -> Result<(), McapError> {
        let is_lost = self.reader.lost() > self.lost;
        if is_lost {
            self.break_off(MarkReason::Gap)?;
        }
        while let Some(mark) = self.tap.mark_before(n) {
            // From one among lost steps nothing follows.
            if !is_lost || mark.at == n {
                self.mark(&mark)?;
            }
        }
        self.tap.set_read(n + 1);
        self.step()
    }

    fn mark(&mut self, mark: &Mark) -> Result<(), McapError> {
        let lost = self.take_lost();
        let changed = mark.announced.unchanged.iter().map(|(path, number)| (path.clone(), *number));
        self.unchanged.extend(changed);
        self.announced = mark.announced.clone();
        let message = v1::MarkRecord {
            reason: reason(mark.reason).into(),
            step: mark.step,
            snapshot: mark.snapshot.to_bytes(),
            parameters: all_parameters(&self.unchanged, &mark.parameters),
            time_step_s: mark.time_step_s,
            lost,
        };
        let times = self.play.at(mark.time_s);
        self.writer.mark(&message, times)?;
        self.at = Some(mark.step);
        self.mechanics = (mark.model.digest(), mark.time_step_s);
        if mark.reason != Marked::Checkpoint {
            self.picture.begin();
        }
        self.picture.enter(&mark.model, &mut self.writer, times)
    }

    /// Writes the step in `frame`.
    fn step(&mut self) -> Result<(), McapError> {
        let step = self.frame.state.step;
        if self.at == Some(step) {
            // A watchdog has put the plant into another state after the step: the mark tells it.
            return Ok(());
        }
        if let Some(at) = self.at {
            if step == at + 1 && self.knows_mechanics()? {
                self.at = Some(step);
            } else {
                self.break_off(MarkReason::Disturbance)?;
            }
        }
        let times = self.play.at(self.frame.time_s);
        fill(&mut self.record, &self.frame);
        self.record.utc_ns = self.clock.now_ns(self.frame.timing.ended_ns) as i64;
        self.writer.step(&self.record, times)?;
        self.steps += 1;
        self.has_moved = true;
        self.show(times)
    }

    /// Draws the step in `frame`, if that is due and the recorder is not behind.
    fn show(&mut self, times: Times) -> Result<(), McapError> {
        let waiting = self.tap.ring.written().saturating_sub(self.reader.position());
        let is_behind = waiting > self.tap.ring.capacity() as u64 / BEHIND_PART;
        if is_behind || !self.picture.is_due(&self.frame) {
            return Ok(());
        }
        self.picture.write(&self.frame, &mut self.writer, times)
    }

    /// Whether the mechanics of the step in `frame` are those that stand in the file; writes a mark before
    /// it when a fault has changed the parameters.
    fn knows_mechanics(&mut self) -> Result<bool, McapError> {
        let (digest, time_step_s) = (self.frame.model_digest, self.frame.time_step_s);
        if self.mechanics == (digest, time_step_s) {
            return Ok(true);
        }
        let model = self.announced.models.iter().find(|(model, _)| model.digest() == digest);
        let Some((model, parameters)) = model.filter(|_| time_step_s == self.mechanics.1) else {
            return Ok(false);
        };
        self.mechanics.0 = digest;
        let message = v1::MarkRecord {
            reason: MarkReason::Parameters.into(),
            step: self.frame.state.step - 1,
            parameters: all_parameters(&self.unchanged, parameters),
            time_step_s,
            ..Default::default()
        };
        let times = self.play.at(self.frame.time_s - time_step_s);
        self.writer.mark(&message, times)?;
        self.picture.enter(model, &mut self.writer, times)?;
        Ok(true)
    }

    /// Notes that the step in `frame` does not follow from what was written.
    fn break_off(&mut self, reason: MarkReason) -> Result<(), McapError> {
        let lost = self.take_lost();
        let step = self.frame.state.step.saturating_sub(1);
        let message = v1::MarkRecord { reason: reason.into(), step, lost, ..Default::default() };
        let times = self.play.at(self.frame.time_s);
        self.at = None;
        self.picture.begin();
        self.writer.mark(&message, times)
    }

    /// Steps lost since the last call.
    fn take_lost(&mut self) -> u64 {
        let lost = self.reader.lost() - self.lost;
        self.lost += lost;
        lost
    }
}

/// Why there is a mark, as a message says it.
fn reason(reason: Marked) -> MarkReason {
    match reason {
        Marked::Checkpoint => MarkReason::Checkpoint,
        Marked::Reset => MarkReason::Reset,
        Marked::Parameters => MarkReason::Parameters,
    }
}

/// The wall clock, which does not go back here.
struct Clock {
    /// Wall clock less monotonic clock, ns.
    offset_ns: u64,
    last_ns: u64,
}

impl Clock {
    fn new() -> Self {
        let offset_ns = unix_ns(SystemTime::now()).saturating_sub(monotonic_ns());
        Self { offset_ns, last_ns: 0 }
    }

    /// The wall clock at a time of the monotonic one; 0 means now.
    fn now_ns(&mut self, monotonic: u64) -> u64 {
        let monotonic = if monotonic == 0 { monotonic_ns() } else { monotonic };
        self.last_ns = self.last_ns.max(self.offset_ns.saturating_add(monotonic));
        self.last_ns
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::sync::Mutex;
    use std::sync::atomic::AtomicBool;

    use plantd_models::{Model, Plant, builtin};
    use prost::Message as _;

    use super::*;
    use crate::core::driver::DriverKind;
    use crate::core::metrics::registry::Metrics;
    use crate::core::realtime::loops::RealTime;
    use crate::core::realtime::settings::RealTimeSettings;
    use crate::core::room::Room;
    use crate::core::session::creation::Origin;
    use crate::wire::record::progress::Share;

    pub(in crate::wire::record) fn session() -> Arc<Session> {
        let model = Arc::new(Model::compile(&builtin::scene("pendulum").unwrap()).unwrap());
        let settings = plantd_models::Settings::new(&model);
        let plant = Plant::new(model, settings).unwrap();
        let metrics = Arc::new(Metrics::default());
        let realtime = RealTime::new(RealTimeSettings::default(), &metrics);
        Session::new(Origin::new("p", "pendulum"), plant, metrics, realtime)
    }

    pub(in crate::wire::record) fn options() -> Options {
        let checkpoint_interval = Duration::from_secs(3600);
        let room = Room::new("tenant.recording_bytes", "bytes", u64::MAX);
        let own = Arc::new(Mutex::new(room.reserve(0).unwrap()));
        let in_progress = room.reserve(0).unwrap();
        let share = Share { room, own, bytes_max: u64::MAX };
        Options {
            name: "r".to_owned(),
            checkpoint_interval,
            bytes_max: u64::MAX,
            share,
            _in_progress: in_progress,
        }
    }

    /// A recorder whose thread is this one.
    fn recorder(session: &Arc<Session>, file: &File) -> Work {
        let (tap, mark, plant) = session.open_tap().unwrap();
        let info = Mutex::new(v1::Recording::default());
        let shared = Shared { is_ending: AtomicBool::new(true), bytes: Arc::default(), info };
        let file = file.try_clone().unwrap();
        Work::new(session, &tap, &mark, plant, file, options(), &Arc::new(shared)).unwrap()
    }

    /// Steps as a plant that runs by itself takes them: without waiting for anybody.
    fn run(session: &Session, steps: usize) {
        session.with_core(move |core| {
            for _ in 0..steps {
                core.step(&[0.1], None).unwrap();
                core.write_ring();
            }
        });
    }

    /// Topics of a file with the steps of their messages, and the marks.
    fn entries(path: &std::path::Path) -> (Vec<u64>, Vec<v1::MarkRecord>) {
        let bytes = std::fs::read(path).unwrap();
        let (mut steps, mut marks) = (Vec::new(), Vec::new());
        for message in mcap::MessageStream::new(&bytes).unwrap() {
            let message = message.unwrap();
            match message.channel.topic.as_str() {
                "/step" => {
                    let step = v1::StepRecord::decode(&*message.data).unwrap();
                    steps.push(step.state.unwrap().step);
                }
                "/mark" => marks.push(v1::MarkRecord::decode(&*message.data).unwrap()),
                _ => {}
            }
        }
        (steps, marks)
    }

    #[test]
    fn a_plant_that_does_not_wait_loses_steps_and_the_file_says_so() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("r.mcap");
        let file = File::create(&path).unwrap();
        let session = session();
        let mut recorder = recorder(&session, &file);
        let capacity = recorder.tap.ring.capacity();
        run(&session, 10);
        recorder.drain().unwrap();
        run(&session, 2 * capacity);
        recorder.drain().unwrap();
        assert!(recorder.at.is_none());
        session.checkpoint();
        run(&session, 5);
        recorder.drain().unwrap();
        let lost = recorder.lost;
        let total = (10 + 2 * capacity + 5) as u64;
        assert_eq!(recorder.steps + lost, total);
        assert!(lost >= capacity as u64, "{lost}");
        recorder.run();
        let (steps, marks) = entries(&path);
        assert_eq!(steps.len() as u64 + lost, total);
        assert_eq!(steps[..10], (1..=10).collect::<Vec<_>>());
        assert_eq!((steps[10], *steps.last().unwrap()), (11 + lost, total));
        let gap = v1::MarkRecord {
            reason: MarkReason::Gap.into(),
            step: 10 + lost,
            lost,
            ..Default::default()
        };
        assert_eq!(marks[0], gap);
        assert_eq!((marks[1].reason(), marks[1].step), (MarkReason::Checkpoint, total - 5));
        assert!(!marks[1].snapshot.is_empty() && marks.len() == 2);
    }

    #[test]
    fn marks_among_lost_steps_are_lost_with_them() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("r.mcap");
        let session = session();
        let recorder = recorder(&session, &File::create(&path).unwrap());
        let capacity = recorder.tap.ring.capacity();
        session.checkpoint();
        run(&session, 10);
        session.checkpoint();
        run(&session, 2 * capacity);
        let total = 10 + 2 * capacity as u64;
        // What is there is written, with a checkpoint at its end.
        session.checkpoint();
        recorder.run();
        let (steps, marks) = entries(&path);
        let lost = total - steps.len() as u64;
        assert_eq!(*steps.last().unwrap(), total);
        let marks: Vec<_> =
            marks.iter().map(|mark| (mark.reason(), mark.step, mark.lost)).collect();
        let (gap, checkpoint) = (MarkReason::Gap, MarkReason::Checkpoint);
        assert_eq!(marks, [(gap, lost, lost), (checkpoint, total, 0)]);
    }

    #[test]
    fn nobody_waits_twice_for_a_recorder_that_stands_still() {
        let session = session();
        let directory = tempfile::tempdir().unwrap();
        let mut recorder = recorder(&session, &File::create(directory.path().join("r")).unwrap());
        let capacity = recorder.tap.ring.capacity();
        run(&session, capacity);
        assert!(session.with_core(|core| core.records.full_tap().is_some()));
        recorder.tap.wait();
        assert!(session.with_core(|core| core.records.full_tap().is_none()));
        // It goes on, and is waited for again.
        recorder.drain().unwrap();
        assert!(session.with_core(|core| core.records.full_tap().is_none()));
        run(&session, capacity);
        assert!(session.with_core(|core| core.records.full_tap().is_some()));
    }

    #[test]
    fn marks_stand_between_the_steps_where_they_happened() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("r.mcap");
        let session = session();
        let recorder = recorder(&session, &File::create(&path).unwrap());
        let mut lease = session.acquire(DriverKind::Step).unwrap();
        for _ in 0..3 {
            lease.step(&[0.2]).unwrap();
        }
        lease.reset().unwrap();
        lease.step(&[0.3]).unwrap();
        let limits = crate::core::limits::Limits::default();
        session.change_parameters(&[("gravity[1]".to_owned(), -1.0)], None, &limits).unwrap();
        lease.reset().unwrap();
        lease.step(&[0.3]).unwrap();
        recorder.run();
        let (steps, marks) = entries(&path);
        assert_eq!(steps, [1, 2, 3, 1, 1]);
        let marks: Vec<_> = marks.iter().map(|mark| (mark.reason(), mark.step)).collect();
        let (reset, parameters) = (MarkReason::Reset, MarkReason::Parameters);
        assert_eq!(marks, [(reset, 0), (parameters, 1), (reset, 0)]);
    }
}
