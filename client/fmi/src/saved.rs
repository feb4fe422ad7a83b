//! States of instances: snapshots with what else was set.
//!
//! Encoding, little-endian: magic `PLNTFMU1`, digest of the instantiation token (u64), phase (u8), start time
//! and stop time (f64; NaN for none), the numbers of the scene that were set and those that the mechanism has,
//! start values of q and of the velocity, inputs (f64 each), which start values and inputs were set (u8 each),
//! whether a snapshot follows (u8), the snapshot, and the FNV-1a hash (u64) of all that.

use std::sync::Arc;

use plantd_models::{Plant, Snapshot, Spare, fnv1a};

use crate::blueprint::Blueprint;
use crate::error::FmuError;
use crate::simulation::{Phase, Settled, Simulation};

const MAGIC: &[u8; 8] = b"PLNTFMU1";
const PHASES: [Phase; 4] =
    [Phase::Instantiated, Phase::Initialization, Phase::Step, Phase::Terminated];

/// A state of an instance.
#[derive(Clone)]
pub(crate) struct Saved {
    settled: Settled,
    snapshot: Option<Snapshot>,
}

impl Simulation {
    pub(crate) fn save(&self) -> Saved {
        let snapshot = self.plant.as_ref().map(Plant::snapshot);
        Saved { settled: self.settled.clone(), snapshot }
    }

    /// Takes over a state of an instance of the same FMU.
    pub(crate) fn restore(&mut self, saved: &Saved) -> Result<(), FmuError> {
        let mut fresh = None;
        match (&saved.snapshot, &mut self.plant) {
            (None, _) => self.plant = None,
            (Some(snapshot), Some(plant))
                if Arc::ptr_eq(&self.settled.model, &saved.settled.model) =>
            {
                plant.restore(snapshot)?;
            }
            (Some(_), _) => fresh = saved.plant(&self.blueprint)?,
        }
        if fresh.is_some() {
            self.plant = fresh;
        }
        self.settled = saved.settled.clone();
        self.forget_known();
        Ok(())
    }
}

impl Saved {
    fn plant(&self, blueprint: &Blueprint) -> Result<Option<Plant>, FmuError> {
        let Some(snapshot) = &self.snapshot else { return Ok(None) };
        let spare = Spare::new(Arc::clone(&self.settled.model), blueprint.settings)?;
        Ok(Some(spare.restore(snapshot)?))
    }

    pub(crate) fn to_bytes(&self, blueprint: &Blueprint) -> Vec<u8> {
        let s = &self.settled;
        let mut bytes = Vec::from(MAGIC);
        bytes.extend(fnv1a(blueprint.token.as_bytes()).to_le_bytes());
        bytes.extend(PHASES.iter().position(|phase| *phase == s.phase).map(|index| index as u8));
        let times = [s.start_s, s.stop_s.unwrap_or(f64::NAN)];
        for numbers in [&times[..], &s.numbers, &s.taken, &s.q, &s.velocity, &s.input] {
            bytes.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
        }
        bytes.extend(s.held.iter().chain(&s.given).map(|flag| u8::from(*flag)));
        bytes.push(u8::from(self.snapshot.is_some()));
        bytes.extend(self.snapshot.iter().flat_map(Snapshot::to_bytes));
        bytes.extend(fnv1a(&bytes).to_le_bytes());
        bytes
    }

    /// Decodes a state of an instance of the same FMU. Compiles a model if parameters were changed.
    pub(crate) fn from_bytes(bytes: &[u8], blueprint: &Blueprint) -> Result<Self, FmuError> {
        let split = bytes.len().checked_sub(8).ok_or(FmuError::NotAState("cut short"))?;
        let (body, hash) = bytes.split_at(split);
        let mut rest = body.strip_prefix(MAGIC).ok_or(FmuError::NotAState("wrong magic number"))?;
        if fnv1a(body).to_le_bytes() != hash {
            return Err(FmuError::NotAState("checksum does not match"));
        }
        let rest = &mut rest;
        if take(rest)? != fnv1a(blueprint.token.as_bytes()).to_le_bytes() {
            return Err(FmuError::NotAState("it is of another FMU"));
        }
        let [phase] = take(rest)?;
        let phase = PHASES.get(usize::from(phase)).ok_or(FmuError::NotAState("unknown phase"))?;
        let times = floats(rest, 2)?;
        let numbers = floats(rest, blueprint.numbers.len())?;
        let taken = floats(rest, blueprint.numbers.len())?;
        let q = floats(rest, blueprint.start.q.len())?;
        let velocity = floats(rest, blueprint.start.velocity.len())?;
        let input = floats(rest, blueprint.start.input.len())?;
        let held = flags(rest, q.len())?;
        let given = flags(rest, input.len())?;
        let [has_snapshot] = take(rest)?;
        let model = blueprint.model_with(&taken)?;
        let snapshot = (has_snapshot != 0).then(|| Snapshot::from_bytes(rest)).transpose()?;
        let (phase, start_s) = (*phase, times[0]);
        let stop_s = Some(times[1]).filter(|stop_s| !stop_s.is_nan());
        let settled = Settled {
            phase,
            start_s,
            stop_s,
            numbers,
            taken,
            model,
            q,
            velocity,
            held,
            input,
            given,
        };
        let saved = Self { settled, snapshot };
        // Whether the snapshot is one of the mechanism.
        saved.plant(blueprint)?;
        Ok(saved)
    }
}

/// The next bytes of those that are still to be read.
fn take<const N: usize>(rest: &mut &[u8]) -> Result<[u8; N], FmuError> {
    let (head, tail) = rest.split_first_chunk().ok_or(FmuError::NotAState("cut short"))?;
    *rest = tail;
    Ok(*head)
}

fn floats(rest: &mut &[u8], count: usize) -> Result<Vec<f64>, FmuError> {
    (0..count).map(|_| take(rest).map(f64::from_le_bytes)).collect()
}

fn flags(rest: &mut &[u8], count: usize) -> Result<Vec<bool>, FmuError> {
    (0..count).map(|_| take::<1>(rest).map(|[flag]| flag != 0)).collect()
}
