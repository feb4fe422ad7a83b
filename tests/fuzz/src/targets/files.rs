//! Files that a server finds at its start, and clients read: saved plants, recordings.

use std::fs;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use plantd_client::{RecordingReader, v1};
use plantd_proto::FILE_DESCRIPTOR_SET;
use plantd_server::core::modes::Mode;
use plantd_server::core::tenant::Tenants;
use plantd_server::wire::shared::state::directory::Directory;
use plantd_server::wire::shared::state::{State, with_hash};
use prost::Message as _;
use prost_reflect::{DescriptorPool, DynamicMessage, MessageDescriptor};

use crate::message::random;
use crate::mutate::{Rng, mutated};
use crate::targets::calls::Inside;
use crate::targets::{BYTES_MAX, Target, corpus};

const FOR_EVER: Duration = Duration::MAX;

/// Calls a method that must be there.
fn ask(inside: &Inside, method: &str, request: &impl prost::Message) -> Result<Vec<u8>> {
    let path = format!("/plantd.v1.{method}");
    let answers = inside.call(&path, &request.encode_to_vec(), FOR_EVER).context("an answer")?;
    let answer = answers.concat();
    ensure!(answer.len() >= 5, "{method} has failed");
    Ok(answer[5..].to_vec())
}

/// A plant with channels, a fault, feedback and a watchdog.
fn rich_plant(inside: &Inside) -> Result<()> {
    let id = || "p".to_owned();
    let settings = v1::PlantSettings { time_step_s: 1e-2, ..Default::default() };
    let request = v1::CreatePlantRequest {
        id: id(),
        model: "cart-pole".to_owned(),
        settings: Some(settings),
        ..Default::default()
    };
    ask(inside, "PlantService/CreatePlant", &request)?;
    let request = v1::StepRequest { id: id(), hold: 5, ..Default::default() };
    ask(inside, "PlantService/Step", &request)?;
    Ok(())
}

/// Saved plants: bytes of a message, to which their hash is added.
struct SavedPlants {
    inside: Inside,
    path: PathBuf,
    state: State,
    record: MessageDescriptor,
    seeds: Vec<Vec<u8>>,
}

pub(super) fn saved() -> Result<Box<dyn Target>> {
    let inside = Inside::new()?;
    let path = inside.folder.path().join("saved");
    let directory = Directory::open(&path, Mode::PRIVATE, Arc::new(Tenants::default()))?;
    let state = State::new(Arc::new(directory));
    rich_plant(&inside)?;
    state.save(inside.server.hub());
    let whole = fs::read(path.join("p.plant"))?;
    let mut seeds = vec![whole[..whole.len() - 8].to_vec()];
    for entry in corpus("saved").read_dir().into_iter().flatten().flatten() {
        seeds.push(fs::read(entry.path())?);
    }
    let pool = DescriptorPool::decode(FILE_DESCRIPTOR_SET)?;
    let record = pool.get_message_by_name("plantd.v1.PlantRecord").context("the record")?;
    inside.clear();
    let target = SavedPlants { inside, path, state, record, seeds };
    ensure!(target.loads(&target.seeds[0]) == 1, "the seed is a saved plant");
    Ok(Box::new(target))
}

impl SavedPlants {
    /// Plants that there are after a start with these bytes.
    fn loads(&self, bytes: &[u8]) -> usize {
        let file = with_hash(bytes.to_vec());
        fs::write(self.path.join("p.plant"), file).expect("it is written");
        let hub = self.inside.server.hub();
        let loaded = self.inside.runtime.block_on(self.state.load(hub));
        loaded.expect("what cannot be read is left out");
        let count = hub.page("", 100).0.len();
        self.inside.clear();
        count
    }
}

impl Target for SavedPlants {
    fn input(&mut self, rng: &mut Rng) -> Vec<u8> {
        if rng.once_in(2) {
            return mutated(rng, &self.seeds, BYTES_MAX);
        }
        // Some fields of a whole record become others.
        let seed = rng.of(&self.seeds);
        let Ok(mut message) = DynamicMessage::decode(self.record.clone(), &seed[..]) else {
            return seed.clone();
        };
        let other = random(rng, &self.record, &[]);
        for field in self.record.fields() {
            if other.has_field(&field) && rng.once_in(3) {
                let value = other.get_field(&field).into_owned();
                let _ = message.try_set_field(&field, value);
            }
        }
        message.encode_to_vec()
    }

    fn run(&mut self, input: &[u8]) {
        self.loads(input);
    }
}

/// Recordings, read by clients and listed by servers.
struct Recordings {
    inside: Inside,
    path: PathBuf,
    seeds: Vec<Vec<u8>>,
}

pub(super) fn recording() -> Result<Box<dyn Target>> {
    let inside = Inside::new()?;
    let (id, name) = ("p".to_owned(), "r".to_owned());
    rich_plant(&inside)?;
    let start =
        v1::StartRecordingRequest { id: id.clone(), name: name.clone(), ..Default::default() };
    ask(&inside, "RecordingService/StartRecording", &start)?;
    ask(&inside, "PlantService/Step", &v1::StepRequest { id, hold: 20, ..Default::default() })?;
    ask(&inside, "RecordingService/StopRecording", &v1::StopRecordingRequest { name })?;
    inside.clear();
    let path = inside.folder.path().join("recordings/r.mcap");
    let mut seeds = vec![without_checksums(fs::read(&path)?)];
    for entry in corpus("recording").read_dir().into_iter().flatten().flatten() {
        seeds.push(fs::read(entry.path())?);
    }
    let path = inside.folder.path().join("recordings/other.mcap");
    let target = Recordings { inside, path, seeds };
    ensure!(target.entries(&target.seeds[0]) > 20, "the seed is a recording");
    Ok(Box::new(target))
}

/// A file whose chunks say that they have no checksum, so that what is changed in them is read.
fn without_checksums(mut file: Vec<u8>) -> Vec<u8> {
    const CHUNK: u8 = 6;
    let mut at = 8;
    while at + 9 < file.len() {
        let kind = file[at];
        let length = u64::from_le_bytes(file[at + 1..at + 9].try_into().expect("eight bytes"));
        if kind == CHUNK {
            // After the first and the last time, and the size.
            file[at + 9 + 24..at + 9 + 28].fill(0);
        }
        at = at.saturating_add(9).saturating_add(length as usize);
    }
    file
}

impl Recordings {
    /// Entries that a client reads.
    fn entries(&self, file: &[u8]) -> usize {
        fs::write(&self.path, file).expect("it is written");
        let mut count = 0;
        if let Ok(mut reader) = RecordingReader::open(&self.path) {
            while let Ok(Some(_)) = reader.next_entry() {
                count += 1;
            }
        }
        count
    }
}

impl Target for Recordings {
    fn input(&mut self, rng: &mut Rng) -> Vec<u8> {
        mutated(rng, &self.seeds, BYTES_MAX)
    }

    fn run(&mut self, input: &[u8]) {
        self.entries(input);
        let list = v1::ListRecordingsRequest::default();
        ask(&self.inside, "RecordingService/ListRecordings", &list).expect("a list");
    }
}
