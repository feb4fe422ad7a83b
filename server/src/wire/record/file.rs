//! The file of a recording: MCAP with the messages of `recording.proto`, and their descriptors.

use std::collections::BTreeMap;
use std::io::Write;

use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{McapError, WriteOptions};
use plantd_proto::foxglove::{FrameTransforms, SceneUpdate};
use plantd_proto::{FILE_DESCRIPTOR_SET, foxglove, v1};
use prost::Message;

use crate::wire::record::schema::descriptors;
use crate::wire::record::signals;

/// Bytes after which a chunk is written. What was not written is lost when the server is killed.
const CHUNK_BYTES: u64 = 1 << 18;

const PLANT: &str = "plantd.v1.PlantRecord";
const STEP: &str = "plantd.v1.StepRecord";
const MARK: &str = "plantd.v1.MarkRecord";
const EVENT: &str = "plantd.v1.Event";

/// Writes a recording.
pub(super) struct Writer<W: Write> {
    mcap: mcap::Writer<NoSeek<W>>,
    step: Topic,
    mark: Topic,
    event: Topic,
    transforms: Topic,
    scene: Topic,
    lines: Topic,
    signals: Topic,
    buffer: Vec<u8>,
}

/// A channel of the file.
struct Topic {
    id: u16,
    sequence: u32,
}

/// When a message came about.
#[derive(Clone, Copy)]
pub(super) struct Times {
    /// By which players play: the plant's time, which goes on where the plant goes back, ns.
    pub(super) play_ns: u64,
    /// The plant's time, s.
    pub(super) plant_s: f64,
}

/// The time by which players play.
#[derive(Default)]
pub(super) struct PlayClock {
    /// What the plant has gone back, ns.
    offset_ns: u64,
    last_ns: u64,
    last_s: f64,
}

impl PlayClock {
    /// Round-off of the plant's time, ns.
    const ROUNDING_NS: u64 = 1000;

    /// The times at a time of the plant, s.
    pub(super) fn at(&mut self, plant_s: f64) -> Times {
        let mut play_ns = (plant_s * 1e9).round() as u64 + self.offset_ns;
        if play_ns + Self::ROUNDING_NS < self.last_ns {
            self.offset_ns += self.last_ns - play_ns;
        }
        play_ns = play_ns.max(self.last_ns);
        (self.last_ns, self.last_s) = (play_ns, plant_s);
        Times { play_ns, plant_s }
    }

    /// The times of what was last written: where the plant is, also when it was put elsewhere and no step has
    /// followed yet.
    pub(super) fn now(&self) -> Times {
        Times { play_ns: self.last_ns, plant_s: self.last_s }
    }
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
        let mut topic = |topic: &str, message: &str, data: &[u8]| {
            let schema = mcap.add_schema(message, "protobuf", data)?;
            let id = mcap.add_channel(schema, topic, "protobuf", &BTreeMap::new())?;
            Ok::<_, McapError>(Topic { id, sequence: 0 })
        };
        let ours = |message: &str| descriptors(FILE_DESCRIPTOR_SET, message);
        let players = |message: &str| descriptors(foxglove::FILE_DESCRIPTOR_SET, message);
        let default = v1::Model::default();
        let model = plant.model.as_ref().unwrap_or(&default);
        let (frames, update) = ("foxglove.FrameTransforms", "foxglove.SceneUpdate");
        let mut first = topic("/plant", PLANT, &ours(PLANT))?;
        let mut writer = Self {
            step: topic("/step", STEP, &ours(STEP))?,
            mark: topic("/mark", MARK, &ours(MARK))?,
            event: topic("/event", EVENT, &ours(EVENT))?,
            transforms: topic("/tf", frames, &players(frames))?,
            scene: topic("/scene", update, &players(update))?,
            lines: topic("/lines", update, &players(update))?,
            signals: topic(
                "/signals",
                signals::NAME,
                &signals::descriptors(model, &plant.outputs),
            )?,
            mcap,
            buffer: Vec::new(),
        };
        write(&mut writer.mcap, &mut first, &mut writer.buffer, plant, times)?;
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

    /// Writes where frames are.
    pub(super) fn transforms(
        &mut self,
        transforms: &FrameTransforms,
        times: Times,
    ) -> Result<(), McapError> {
        write(&mut self.mcap, &mut self.transforms, &mut self.buffer, transforms, times)
    }

    /// Writes shapes.
    pub(super) fn scene(&mut self, scene: &SceneUpdate, times: Times) -> Result<(), McapError> {
        write(&mut self.mcap, &mut self.scene, &mut self.buffer, scene, times)
    }

    /// Writes lines and arrows.
    pub(super) fn lines(&mut self, lines: &SceneUpdate, times: Times) -> Result<(), McapError> {
        write(&mut self.mcap, &mut self.lines, &mut self.buffer, lines, times)
    }

    /// Writes signals, which are encoded.
    pub(super) fn signals(&mut self, signals: &[u8], times: Times) -> Result<(), McapError> {
        write_bytes(&mut self.mcap, &mut self.signals, signals, times)
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
    write_bytes(mcap, topic, buffer, times)
}

fn write_bytes<W: Write>(
    mcap: &mut mcap::Writer<NoSeek<W>>,
    topic: &mut Topic,
    message: &[u8],
    times: Times,
) -> Result<(), McapError> {
    topic.sequence = topic.sequence.wrapping_add(1);
    let header = MessageHeader {
        channel_id: topic.id,
        sequence: topic.sequence,
        log_time: times.play_ns,
        publish_time: (times.plant_s * 1e9).round() as u64,
    };
    mcap.write_to_known_channel(&header, message)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn players_go_on_where_a_plant_goes_back() {
        let mut clock = PlayClock::default();
        let at =
            [0.0, 0.1, 0.2, 0.199_999_999_9, 0.0, 0.1, 0.05, 0.15].map(|s| clock.at(s).play_ns);
        let ms = [0, 100, 200, 200, 200, 300, 300, 400];
        assert_eq!(at, ms.map(|ms| ms * 1_000_000));
    }
}
