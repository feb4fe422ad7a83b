//! Snapshots: everything that a plant needs to go on bit for bit.
//!
//! Encoding, little-endian: magic `PLNTSNAP`, version (u32), model digest (u64), time step (f64 bits), order
//! and substeps (u32 each), halvings, precision and force split (u8 each), iteration limit (u32), singular
//! threshold (f64 bits), nd, nk, nc, number of orientations (u32 each), step (u64), time origin (f64 bits),
//! halvings of the last period and good ones since (u8 each), what the next step is guessed from (its kind and
//! two of its counts, u8 each), the numbers as f64 bits, and the FNV-1a hash (u64) of all that.

use plantd_math::hash::fnv1a;

use crate::integrator::predictor::Past;
use crate::integrator::settings::{ForceSplit, HALVINGS_MAX, Precision, Settings};
use crate::integrator::state::PreciseState;
use crate::plant::facade::Plant;

const MAGIC: &[u8; 8] = b"PLNTSNAP";
const VERSION: u32 = 7;

/// Everything a plant needs to go on bit for bit.
#[derive(Clone, Debug, PartialEq)]
pub struct Snapshot {
    model_digest: u64,
    settings: Settings,
    state: PreciseState,
}

/// Why a snapshot was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SnapshotError {
    /// Not a snapshot, cut short, or damaged.
    #[error("not a snapshot: {0}")]
    Malformed(&'static str),
    /// Taken from another model, or with other settings.
    #[error("the snapshot was taken with another {0}")]
    Mismatch(&'static str),
}

impl Plant {
    /// Takes a snapshot.
    pub fn snapshot(&self) -> Snapshot {
        let mut state = self.state.clone();
        state.past.tidy();
        Snapshot { model_digest: self.model.digest(), settings: self.settings, state }
    }

    /// Restores a snapshot of a plant of the same model and settings, step count included.
    pub fn restore(&mut self, snapshot: &Snapshot) -> Result<(), SnapshotError> {
        let same_sizes = |a: &PreciseState, b: &PreciseState| {
            a.q.len() == b.q.len()
                && a.p.len() == b.p.len()
                && a.multipliers.len() == b.multipliers.len()
                && a.orientations.len() == b.orientations.len()
                && a.past.is_like(&b.past)
        };
        if snapshot.model_digest != self.model.digest() || !same_sizes(&snapshot.state, &self.state)
        {
            return Err(SnapshotError::Mismatch("model"));
        }
        if snapshot.settings != self.settings {
            return Err(SnapshotError::Mismatch("setting"));
        }
        self.state.clone_from(&snapshot.state);
        self.workspace.forget();
        Ok(())
    }
}

impl PreciseState {
    /// All numbers, in the order of the encoding.
    fn numbers(&mut self) -> impl Iterator<Item = &mut f64> {
        let vectors = [
            &mut self.q,
            &mut self.q_low,
            &mut self.p,
            &mut self.p_low,
            &mut self.v,
            &mut self.multipliers,
        ];
        let turns = self.orientations_low.as_flattened_mut();
        let orientations = self.orientations.iter_mut().flat_map(|q| &mut q.0);
        vectors.into_iter().flatten().chain(turns).chain(self.past.numbers()).chain(orientations)
    }
}

impl Snapshot {
    /// Encodes (versioned, little-endian, with a checksum).
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut state = self.state.clone();
        let mut bytes = Vec::from(MAGIC);
        bytes.extend(VERSION.to_le_bytes());
        bytes.extend(self.model_digest.to_le_bytes());
        bytes.extend(self.settings.time_step_s.to_le_bytes());
        bytes.extend(self.settings.order.to_le_bytes());
        bytes.extend(self.settings.substeps.to_le_bytes());
        bytes.push(self.settings.halvings as u8);
        bytes.push(match self.settings.precision {
            Precision::Exact => 0,
            Precision::Fast => 1,
            Precision::Coarse => 2,
        });
        bytes.push(match self.settings.force_split {
            ForceSplit::Symmetric => 0,
            ForceSplit::Paper => 1,
        });
        bytes.extend(self.settings.max_iterations.to_le_bytes());
        bytes.extend(self.settings.singular_below.to_le_bytes());
        let sizes =
            [state.p.len(), state.v.len(), state.multipliers.len(), state.orientations.len()];
        for size in sizes {
            bytes.extend((size as u32).to_le_bytes());
        }
        bytes.extend(state.step.to_le_bytes());
        bytes.extend(state.time_origin_s.to_le_bytes());
        bytes.extend([state.halvings, state.calm]);
        bytes.extend(state.past.code());
        bytes.extend(state.numbers().flat_map(|value| value.to_le_bytes()));
        bytes.extend(fnv1a(&bytes).to_le_bytes());
        bytes
    }

    /// Decodes. Allocates no more than a small multiple of `bytes.len()`.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, SnapshotError> {
        let malformed = SnapshotError::Malformed;
        let split = bytes.len().checked_sub(8).ok_or(malformed("cut short"))?;
        let (body, hash) = bytes.split_at(split);
        if !body.starts_with(MAGIC) {
            return Err(malformed("wrong magic number"));
        }
        if fnv1a(body).to_le_bytes() != hash {
            return Err(malformed("checksum does not match"));
        }
        let rest = &mut &body[MAGIC.len()..];
        if u32::from_le_bytes(take(rest)?) != VERSION {
            return Err(malformed("unknown version"));
        }
        let model_digest = u64::from_le_bytes(take(rest)?);
        let settings = Settings {
            time_step_s: f64::from_le_bytes(take(rest)?),
            order: u32::from_le_bytes(take(rest)?),
            substeps: u32::from_le_bytes(take(rest)?),
            halvings: u32::from(take::<1>(rest)?[0]),
            precision: match take::<1>(rest)? {
                [0] => Precision::Exact,
                [1] => Precision::Fast,
                [2] => Precision::Coarse,
                _ => return Err(malformed("unknown precision")),
            },
            force_split: match take::<1>(rest)? {
                [0] => ForceSplit::Symmetric,
                [1] => ForceSplit::Paper,
                _ => return Err(malformed("unknown force split")),
            },
            max_iterations: u32::from_le_bytes(take(rest)?),
            singular_below: f64::from_le_bytes(take(rest)?),
        };
        let mut size = || Ok(u32::from_le_bytes(take(rest)?) as usize);
        let (nd, nk, nc, no) = (size()?, size()?, size()?, size()?);
        let step = u64::from_le_bytes(take(rest)?);
        let time_origin_s = f64::from_le_bytes(take(rest)?);
        let [halvings, calm] = take(rest)?;
        let past = Past::from_code(take(rest)?, [nd, nk, no]);
        let (mut past, of_past) = past.ok_or(malformed("unknown kind of past"))?;
        if u32::from(halvings) > HALVINGS_MAX || settings.halvings > HALVINGS_MAX {
            return Err(malformed("a period was halved too often"));
        }
        let sizes = [nd, nk, nc, no];
        let numbers = [4 * nd, 2 * nk, nc, 8 * no, of_past[0], of_past[1]];
        if rest.len() / 8 != numbers.iter().sum::<usize>() || rest.len() % 8 != 0 {
            return Err(malformed("sizes do not match"));
        }
        if !time_origin_s.is_finite() {
            return Err(malformed("a number is not finite"));
        }
        past.make_room(of_past);
        let mut state = PreciseState::zeros(sizes, past);
        (state.step, state.time_origin_s) = (step, time_origin_s);
        (state.halvings, state.calm) = (halvings, calm);
        for value in state.numbers() {
            *value = f64::from_le_bytes(take(rest)?);
            if !value.is_finite() {
                return Err(malformed("a number is not finite"));
            }
        }
        Ok(Self { model_digest, settings, state })
    }
}

/// The next bytes of those that are still to be read.
fn take<const N: usize>(rest: &mut &[u8]) -> Result<[u8; N], SnapshotError> {
    let (head, tail) = rest.split_first_chunk().ok_or(SnapshotError::Malformed("cut short"))?;
    *rest = tail;
    Ok(*head)
}
