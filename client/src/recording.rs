//! Recordings as files.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use mcap::McapError;
use mcap::io::MessageReader;
use mcap::sans_io::LinearReaderOptions;
use plantd_proto::v1;
use prost::Message as _;

use crate::error::{Error, Result};

/// Longest record that is read, bytes.
const RECORD_BYTES_MAX: usize = 1 << 30;

/// One entry of a recording.
#[derive(Clone, Debug, PartialEq)]
pub enum RecordingEntry {
    /// A step.
    Step(Box<v1::StepRecord>),
    /// What is between two steps.
    Mark(v1::MarkRecord),
    /// What happened to the plant besides its steps.
    Event(v1::Event),
    /// Energy after a step, at some of the steps; older recordings have none.
    Energy {
        /// The plant's time, s.
        time_s: f64,
        /// The energy.
        energy: v1::Energy,
    },
}

/// What is read of the signals for players.
#[derive(prost::Message)]
struct Signals {
    #[prost(message, optional, tag = "8")]
    energy: Option<SignalsEnergy>,
}

#[derive(prost::Message)]
struct SignalsEnergy {
    #[prost(double, tag = "1")]
    kinetic: f64,
    #[prost(double, tag = "2")]
    potential: f64,
}

/// Reads a recording (MCAP), entry by entry.
///
/// ```no_run
/// use plantd_client::{RecordingEntry, RecordingReader};
///
/// # fn main() -> plantd_client::Result<()> {
/// let mut recording = RecordingReader::open("trial.mcap")?;
/// while let Some(entry) = recording.next_entry()? {
///     if let RecordingEntry::Step(step) = entry {
///         println!("{:?}", step.state.map(|state| state.q));
///     }
/// }
/// # Ok(())
/// # }
/// ```
///
/// One whose writer was killed ends where the file does: see [`RecordingReader::is_cut`].
pub struct RecordingReader {
    path: PathBuf,
    messages: MessageReader<BufReader<File>>,
    plant: v1::PlantRecord,
    is_cut: bool,
}

impl RecordingReader {
    /// Opens a file and reads what was recorded.
    ///
    /// # Errors
    /// [`Error::Recording`] if it cannot be read, or is not a recording.
    pub fn open(path: impl Into<PathBuf>) -> Result<Self> {
        let path = path.into();
        let file = File::open(&path).map_err(|error| problem(&path, error))?;
        // No record is longer than its file: room for one whose length is damaged would be made for nothing.
        let bytes = file.metadata().map_err(|error| problem(&path, error))?.len();
        let limit = usize::try_from(bytes).unwrap_or(usize::MAX).min(RECORD_BYTES_MAX);
        let options = LinearReaderOptions::default()
            .with_validate_chunk_crcs(true)
            .with_record_length_limit(limit);
        let mut messages = MessageReader::new_with_options(BufReader::new(file), options);
        let first = messages.next().ok_or_else(|| problem(&path, "there is nothing in it"))?;
        let first = first.map_err(|error| problem(&path, error))?;
        if first.channel.topic != "/plant" {
            return Err(problem(&path, "it is not a recording of a plant"));
        }
        let plant = v1::PlantRecord::decode(&*first.data).map_err(|error| problem(&path, error))?;
        Ok(Self { path, messages, plant, is_cut: false })
    }

    /// The plant as it was when the recording began.
    pub fn plant(&self) -> &v1::PlantRecord {
        &self.plant
    }

    /// The file ends in the middle, and so did [`RecordingReader::next_entry`].
    pub fn is_cut(&self) -> bool {
        self.is_cut
    }

    /// The next entry; `None` at the end.
    ///
    /// # Errors
    /// [`Error::Recording`] if the file cannot be read, or is damaged.
    pub fn next_entry(&mut self) -> Result<Option<RecordingEntry>> {
        for message in &mut self.messages {
            let message = match message {
                Ok(message) => message,
                Err(
                    McapError::UnexpectedEof
                    | McapError::UnexpectedEoc
                    | McapError::RecordTooLarge { .. }
                    | McapError::ChunkTooLarge(_),
                ) => {
                    self.is_cut = true;
                    return Ok(None);
                }
                Err(error) => return Err(problem(&self.path, error)),
            };
            let bytes = &*message.data;
            let entry = match message.channel.topic.as_str() {
                "/step" => {
                    v1::StepRecord::decode(bytes).map(|step| RecordingEntry::Step(Box::new(step)))
                }
                "/mark" => v1::MarkRecord::decode(bytes).map(RecordingEntry::Mark),
                "/event" => v1::Event::decode(bytes).map(RecordingEntry::Event),
                "/signals" => Signals::decode(bytes).map(|signals| {
                    let SignalsEnergy { kinetic, potential } = signals.energy.unwrap_or_default();
                    let energy = v1::Energy { kinetic_j: kinetic, potential_j: potential };
                    RecordingEntry::Energy { time_s: message.publish_time as f64 * 1e-9, energy }
                }),
                // For players, or of a later version.
                _ => continue,
            };
            return Ok(Some(entry.map_err(|error| problem(&self.path, error))?));
        }
        Ok(None)
    }
}

fn problem(path: &Path, problem: impl ToString) -> Error {
    Error::Recording { path: path.to_owned(), problem: problem.to_string() }
}
