//! The file of a recording: MCAP with the messages of `recording.proto`, and their descriptors.

use std::collections::BTreeMap;
use std::io::Write;

use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{McapError, WriteOptions};
use plantd_proto::v1;
use prost::Message;

use crate::wire::record::schema::descriptors;

/// Bytes after which a chunk is written. What was not written is lost when the server is killed.
const CHUNK_BYTES: u64 = 1 << 18;

/// Writes a recording.
pub(super) struct Writer<W: Write> {
    mcap: mcap::Writer<NoSeek<W>>,
    step: Topic,
    mark: Topic,
    event: Topic,
    buffer: Vec<u8>,
}

/// A channel of the file.
struct Topic {
    id: u16,
    sequence: u32,
}

/// When a message was written, and when it came about.
#[derive(Clone, Copy)]
pub(super) struct Times {
    /// Wall clock, ns since 1970.
    pub(super) log_ns: u64,
    /// The plant's time, s.
    pub(super) plant_s: f64,
}

impl<W: Write> Writer<W> {
    /// Begins a file with the plant that is recorded.
    pub(super) fn new(file: W, plant: &v1::PlantRecord, times: Times) -> Result<Self, McapError> {
        let mut mcap = WriteOptions::new()
            .library(concat!("plantd ", env!("CARGO_PKG_VERSION")))
            .chunk_size(Some(CHUNK_BYTES))
            // A chunk is written when it is complete, so that a file which ends anywhere can be read.
            .disable_seeking(true)
            .create(NoSeek::new(file))?;
        mcap.write_metadata(&Metadata { name: "plantd".to_owned(), metadata: metadata(plant) })?;
        let (mut step, mut mark, mut event, mut first) = (0, 0, 0, 0);
        for (id, topic, message) in [
            (&mut first, "/plant", "PlantRecord"),
            (&mut step, "/step", "StepRecord"),
            (&mut mark, "/mark", "MarkRecord"),
            (&mut event, "/event", "Event"),
        ] {
            let (name, data) = (format!("plantd.v1.{message}"), descriptors(message));
            let schema = mcap.add_schema(&name, "protobuf", &data)?;
            *id = mcap.add_channel(schema, topic, "protobuf", &BTreeMap::new())?;
        }
        let topic = |id| Topic { id, sequence: 0 };
        let mut writer = Self {
            mcap,
            step: topic(step),
            mark: topic(mark),
            event: topic(event),
            buffer: Vec::new(),
        };
        write(&mut writer.mcap, &mut topic(first), &mut writer.buffer, plant, times)?;
        writer.flush()?;
        Ok(writer)
    }

    /// Writes a step.
    pub(super) fn step(&mut self, step: &v1::StepRecord, times: Times) -> Result<(), McapError> {
        write(&mut self.mcap, &mut self.step, &mut self.buffer, step, times)
    }

    /// Writes a mark.
    pub(super) fn mark(&mut self, mark: &v1::MarkRecord, times: Times) -> Result<(), McapError> {
        write(&mut self.mcap, &mut self.mark, &mut self.buffer, mark, times)
    }

    /// Writes an event.
    pub(super) fn event(&mut self, event: &v1::Event, times: Times) -> Result<(), McapError> {
        write(&mut self.mcap, &mut self.event, &mut self.buffer, event, times)
    }

    /// Hands what was written to the system: it stays when the server is killed.
    pub(super) fn flush(&mut self) -> Result<(), McapError> {
        self.mcap.flush()
    }

    /// Completes the file.
    pub(super) fn finish(mut self) -> Result<W, McapError> {
        self.mcap.finish()?;
        Ok(self.mcap.into_inner().into_inner())
    }
}

fn write<W: Write>(
    mcap: &mut mcap::Writer<NoSeek<W>>,
    topic: &mut Topic,
    buffer: &mut Vec<u8>,
    message: &impl Message,
    times: Times,
) -> Result<(), McapError> {
    buffer.clear();
    // A vector grows as needed.
    let _ = message.encode(buffer);
    topic.sequence = topic.sequence.wrapping_add(1);
    let header = MessageHeader {
        channel_id: topic.id,
        sequence: topic.sequence,
        log_time: times.log_ns,
        publish_time: (times.plant_s * 1e9) as u64,
    };
    mcap.write_to_known_channel(&header, buffer)
}

/// What is shown of a file without knowing its messages.
fn metadata(record: &v1::PlantRecord) -> BTreeMap<String, String> {
    let (plant, model) = (record.plant.clone().unwrap_or_default(), record.model.as_ref());
    let time_step_s = plant.settings.map_or(0.0, |settings| settings.time_step_s);
    let coordinates = model.map_or(&[][..], |model| &model.coordinates);
    let names: Vec<_> = coordinates.iter().map(|c| c.name.as_str()).collect();
    [
        ("plantd_version", record.version.clone()),
        ("plant", plant.id),
        ("model", plant.model),
        ("model_digest", format!("{:016x}", record.model_digest)),
        ("time_step_s", time_step_s.to_string()),
        ("coordinates", names.join(",")),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into()
}
