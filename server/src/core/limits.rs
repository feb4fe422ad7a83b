//! The limits that the server enforces, in one table.
//!
//! A request beyond a limit is refused with RESOURCE_EXHAUSTED, reason `LIMIT_EXCEEDED`, and the
//! limit's name in the error's details. `plantd limits` prints the table with the values in force.

use plantd_models::scene::UnknownName;
use serde::{Deserialize, Serialize};

macro_rules! limits {
    ($($(#[doc = $doc:literal])+ $name:ident = $default:literal in $low:literal ..= $high:literal;)+) => {
        /// The limits. Each can be set in the configuration's `[limits]` table, and by
        /// `--limit NAME=VALUE`.
        #[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct Limits {
            $($(#[doc = $doc])+ pub $name: u64,)+
        }

        impl Default for Limits {
            fn default() -> Self {
                Self { $($name: $default,)+ }
            }
        }

        impl Limits {
            /// All limits with their values and meanings, in order.
            pub fn table(&self) -> Vec<Limit> {
                vec![$(Limit {
                    name: stringify!($name),
                    value: self.$name,
                    low: $low,
                    high: $high,
                    meaning: concat!($($doc,)+).trim(),
                },)+]
            }

            /// Sets a limit by name.
            pub fn set(&mut self, name: &str, value: u64) -> Result<(), LimitError> {
                match name {
                    $(stringify!($name) => self.$name = value,)+
                    _ => {
                        let name = UnknownName::among(name, [$(stringify!($name)),+]);
                        return Err(LimitError::Unknown { name });
                    }
                }
                self.check()
            }
        }
    };
}

limits! {
    /// Connections at a time; silent and idle ones give way to newcomers, which otherwise wait.
    connections = 1024 in 1..=1_000_000;
    /// Connections at a time from one other machine; beyond, its own silent and idle ones give way, or newcomers are closed.
    connections_per_peer = 256 in 1..=1_000_000;
    /// Seconds in which a connection must make its first request.
    first_request_s = 20 in 1..=86_400;
    /// Streams and calls at a time on one connection; more wait in the client.
    streams_per_connection = 256 in 1..=1_000_000;
    /// Bytes of one message to the server.
    message_bytes = 16_777_216 in 4096..=1_073_741_824;
    /// Bytes of one message to the channel service, whose many small parts take much more room than they have bytes.
    channel_message_bytes = 262_144 in 4096..=1_073_741_824;
    /// Cases, stages, parameters, names and the like in one message, however deep: entries of repeated fields other than numbers, each of which may take some hundred bytes in memory.
    message_parts = 131_072 in 1024..=1_000_000_000;
    /// Bytes of messages to the server that are held until they are whole, together.
    unfinished_message_bytes = 268_435_456 in 4096..=1_000_000_000_000;
    /// Seconds for which a message that has begun may stand still, and in which it must come, with one more for each 64 KiB of it.
    message_s = 20 in 1..=86_400;
    /// Bytes of a scene.
    scene_bytes = 4_194_304 in 64..=1_073_741_824;
    /// Frames, armatures, springs, inputs, forces, signals, constraints, coordinate settings or operating points of a scene, each.
    scene_items = 4096 in 1..=1_000_000;
    /// Coordinates of a model.
    coordinates = 1024 in 1..=65_536;
    /// Uploaded models.
    models = 256 in 0..=1_000_000;
    /// Bytes of a file that shows a model; one message brings it.
    model_file_bytes = 16_777_216 in 0..=1_073_741_824;
    /// Files that show one model.
    model_files = 1024 in 0..=1_000_000;
    /// Bytes of the files that show models, of all of them together.
    model_files_bytes = 536_870_912 in 0..=1_000_000_000_000;
    /// Plants.
    plants = 1024 in 0..=1_000_000;
    /// Plants that run by themselves at a time.
    running_plants = 256 in 0..=1_000_000;
    /// Watch streams of one plant, WatchGains streams, and WatchEvents streams, each.
    watchers_per_plant = 64 in 0..=1_000_000;
    /// Numbers held in the queues of all watchers together (8 bytes each).
    watch_numbers = 16_000_000 in 0..=10_000_000_000;
    /// Newton iterations that a plant may ask for.
    max_iterations = 1000 in 1..=1_000_000;
    /// Substeps of a time step that a plant may ask for.
    max_substeps = 256 in 1..=256;
    /// Coordinates times stages of a plant of an order above 2, of which half the order are the stages.
    stage_coordinates = 1024 in 1..=393_216;
    /// Steps of one Step call, or of all plants of a StepMany call together.
    steps_per_call = 100_000 in 1..=1_000_000_000;
    /// Steps of a trajectory, or of one rollout case.
    horizon = 100_000 in 1..=1_000_000_000;
    /// Cases of one Rollout call.
    rollout_cases = 10_000 in 1..=1_000_000;
    /// Numbers in one answer; 400 000 of them fit the 4 MiB that gRPC clients take by default.
    reply_numbers = 400_000 in 1000..=100_000_000;
    /// Numbers held for one trajectory regulator, filter or optimisation (8 bytes each).
    trajectory_numbers = 32_000_000 in 1000..=10_000_000_000;
    /// Trajectory regulators, filters and optimisations that may be held at a time.
    trajectory_solves = 4 in 1..=1000;
    /// Numbers held by the feedbacks of all plants together (8 bytes each).
    feedback_numbers = 64_000_000 in 1000..=10_000_000_000;
    /// Numbers of its scene that may be changed for one plant.
    parameters = 1024 in 0..=1_000_000;
    /// Input and output channels of a plant.
    channels = 256 in 0..=65_536;
    /// Numbers of the outputs of a plant, with a flag for each channel; frames and the shared-memory link have room for them.
    outputs = 256 in 0..=256;
    /// Numbers that channels and faults of a plant keep, above all of what is late (8 bytes each).
    channel_numbers = 1_000_000 in 0..=1_000_000_000;
    /// Faults of a plant; those that are over make room for new ones.
    faults = 256 in 0..=65_536;
    /// Sets of changed parameters, by faults of a plant, that can be in force together; each takes a plant's memory.
    parameter_sets = 32 in 1..=4096;
    /// Iterations of one trajectory optimisation.
    optimization_iterations = 100_000 in 1..=4_000_000_000;
    /// Shortenings of one step of a trajectory optimisation.
    optimization_backtracks = 1000 in 1..=1_000_000;
    /// Frequencies of one Analyze call.
    frequencies = 10_000 in 1..=1_000_000;
    /// Second derivatives of one call, formed or contracted: outputs times pairs of parameters.
    second_order_numbers = 64_000_000 in 1000..=10_000_000_000;
    /// Coordinates of a model whose equilibrium is searched, or whose method is chosen by a tolerance.
    settle_coordinates = 128 in 1..=65_536;
    /// Recordings in the server's directory.
    recordings = 1000 in 0..=1_000_000;
    /// Recordings in progress at a time.
    active_recordings = 64 in 0..=10_000;
    /// Bytes of a recording, which ends there.
    recording_bytes = 17_179_869_184 in 1_048_576..=1_000_000_000_000_000;
    /// Heavy computations that may wait for a worker; beyond, each connection may have one.
    queued_jobs = 256 in 1..=1_000_000;
}

/// One row of the table of limits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limit {
    /// Name in the configuration.
    pub name: &'static str,
    /// Value in force.
    pub value: u64,
    /// Smallest value that can be set.
    pub low: u64,
    /// Largest value that can be set.
    pub high: u64,
    /// What it limits.
    pub meaning: &'static str,
}

/// Why a limit could not be set.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LimitError {
    /// There is no limit of that name.
    #[error("there is no limit {name}; `plantd limits` lists them")]
    Unknown {
        /// The name.
        name: UnknownName,
    },
    /// The value is out of range.
    #[error("limit `{name}` is {value}; it must lie between {low} and {high}")]
    OutOfRange {
        /// Name of the limit.
        name: &'static str,
        /// The value.
        value: u64,
        /// Smallest value allowed.
        low: u64,
        /// Largest value allowed.
        high: u64,
    },
}

/// A request went beyond a limit.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{actual} {what}; limit `{name}` is {limit}")]
pub struct LimitExceeded {
    /// Name of the limit.
    pub name: &'static str,
    /// Its value.
    pub limit: u64,
    /// What was counted, for example `steps`.
    pub what: &'static str,
    /// How much was asked for.
    pub actual: u64,
}

impl LimitExceeded {
    /// Refuses `actual` if it exceeds the limit.
    pub fn check(
        name: &'static str,
        limit: u64,
        what: &'static str,
        actual: usize,
    ) -> Result<(), Self> {
        let actual = u64::try_from(actual).unwrap_or(u64::MAX);
        if actual > limit { Err(Self { name, limit, what, actual }) } else { Ok(()) }
    }
}

impl Limits {
    /// Refuses values that are out of range.
    pub fn check(&self) -> Result<(), LimitError> {
        for Limit { name, value, low, high, .. } in self.table() {
            if !(low..=high).contains(&value) {
                return Err(LimitError::OutOfRange { name, value, low, high });
            }
        }
        Ok(())
    }

    /// A limit as a size in memory.
    pub fn size(value: u64) -> usize {
        usize::try_from(value).unwrap_or(usize::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_in_range_and_every_limit_can_be_set_by_name() {
        let mut limits = Limits::default();
        limits.check().unwrap();
        for limit in Limits::default().table() {
            assert!(!limit.meaning.is_empty());
            limits.set(limit.name, limit.high).unwrap();
        }
        assert!(limits.table().iter().all(|limit| limit.value == limit.high));
    }

    #[test]
    fn wrong_names_and_values_are_refused() {
        let mut limits = Limits::default();
        let error = limits.set("plant", 1).unwrap_err().to_string();
        assert!(error.starts_with("there is no limit `plant`; did you mean `plants`?"), "{error}");
        assert!(matches!(
            limits.set("connections", 0),
            Err(LimitError::OutOfRange { name: "connections", value: 0, .. })
        ));
        assert!(toml::from_str::<Limits>("plant = 1").is_err());
        assert_eq!(toml::from_str::<Limits>("plants = 1").unwrap().plants, 1);
    }
}
