//! The header of every message of the link.

use iceoryx2::prelude::ZeroCopySend;

/// Version of the layout and of the conversation. Part of the services' names.
pub const LAYOUT_VERSION: u32 = 5;

/// First field of every header: `plnt` in ASCII, little-endian.
pub const MAGIC: u32 = u32::from_le_bytes(*b"plnt");

/// In `code` of a `State`: the plant runs by itself, and the message answers no input. `sequence` is that
/// of the input in force.
pub const LIVE: u32 = 1 << 31;

/// In `code` of such a `State`: no new input had come since the step before.
pub const LIVE_INPUT_LATE: u32 = 1;

/// In `code` of such a `State`: there was no valid input, and what the plant's policy says was in force.
pub const LIVE_INPUT_SAFE: u32 = 2;

/// `poll_ns` of a party that never sleeps.
pub const POLL_FOREVER_NS: u64 = u64::MAX;

/// One field of the header, for bindings and their tests.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Field {
    /// Name.
    pub name: &'static str,
    /// Type, as Rust writes it: `u32`, `u64` or `f64`.
    pub kind: &'static str,
    /// Offset from the start of the header, bytes.
    pub offset: usize,
}

/// Declares the header together with the table of its fields, so that they cannot disagree.
macro_rules! header {
    ($(#[$outer:meta])* pub struct $name:ident { $($(#[$inner:meta])* pub $field:ident: $kind:ty,)* }) => {
        $(#[$outer])*
        pub struct $name { $($(#[$inner])* pub $field: $kind,)* }

        /// The fields of [`Header`] in order.
        pub const HEADER_FIELDS: &[Field] = &[$(Field {
            name: stringify!($field),
            kind: stringify!($kind),
            offset: std::mem::offset_of!($name, $field),
        },)*];
    };
}

header! {
    /// The header of every message, native byte order.
    ///
    /// Fields that a kind of message does not use are zero.
    #[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
    #[repr(C)]
    #[type_name("PlantdLinkHeader5")]
    pub struct Header {
        /// [`MAGIC`].
        pub magic: u32,
        /// [`LAYOUT_VERSION`].
        pub layout_version: u32,
        /// [`SCHEMA_HASH`].
        pub schema_hash: u64,
        /// Random number of the server's side of the link: changes when the server restarts and
        /// when the link is reopened. Zero in `Attach`.
        pub server: u64,
        /// Random number of the driver that the message comes from or goes to; never zero, except
        /// in `Closed`.
        pub driver: u64,
        /// Number of the input, repeated in its answer. Zero in messages that are no input and
        /// answer none.
        pub sequence: u64,
        /// Steps since the plant was created or reset.
        pub step: u64,
        /// Plant time, s.
        pub time_s: f64,
        /// Time step of the plant, s.
        pub time_step_s: f64,
        /// Digest of the plant's model: equal digests mean equal motion.
        pub model_digest: u64,
        /// When the message was sent on the system's monotonic clock, ns.
        pub stamp_ns: u64,
        /// How long from `stamp_ns` on the sender polls for what comes next, ns;
        /// [`POLL_FOREVER_NS`] means that it never sleeps.
        pub poll_ns: u64,
        /// When the sender's process started, clock ticks since boot (field 22 of
        /// `/proc/<pid>/stat`); with `pid` it names a process for good.
        pub process_start: u64,
        /// Process id of the sender.
        pub pid: u32,
        /// What the message is: a [`Kind`].
        pub kind: u32,
        /// Why a `Failure` or `Closed`: a [`Code`]. Of a `State`: zero in lockstep, otherwise [`LIVE`]
        /// and what is to be said of the input. Zero in other messages.
        pub code: u32,
        /// Dynamic coordinates of the plant, nd.
        pub dynamic: u32,
        /// Prescribed coordinates, nk.
        pub prescribed: u32,
        /// Inputs, ni.
        pub inputs: u32,
        /// Constraint equations, nc.
        pub constraints: u32,
        /// Residual evaluations of the step.
        pub iterations: u32,
        /// Factorizations of the step.
        pub factorizations: u32,
        /// Constraint equations that follow from others.
        pub redundant_constraints: u32,
        /// Steps of the method in the time step.
        pub steps: u32,
        /// How often the time step was halved.
        pub halvings: u32,
        /// Numbers of the plant's output channels, ny.
        pub outputs: u32,
        /// Output channels, with a flag each.
        pub output_channels: u32,
        /// Final residual of the step in units of its own round-off.
        pub residual: f64,
        /// Largest constraint violation in units of its own round-off.
        pub constraint_residual: f64,
        /// Estimate of the reciprocal condition of the Newton matrix, at most 1.
        pub reciprocal_condition: f64,
        /// Estimate of the reciprocal condition of the constraints without redundant ones; 1 without constraints.
        pub constraint_reciprocal_condition: f64,
        /// First detail of a failure, see [`Code`]. Of an `Input`: `stamp_ns` of the state that it
        /// answers, 0 if that is not known.
        pub detail_a: u64,
        /// Second detail of a failure.
        pub detail_b: u64,
        /// Number that goes with a failure.
        pub detail_value: f64,
    }
}

/// Hash of the field table: FNV-1a over `name:type@offset;` of each field.
pub const SCHEMA_HASH: u64 = {
    let mut hash = FNV_BASIS;
    let mut i = 0;
    while i < HEADER_FIELDS.len() {
        let field = HEADER_FIELDS[i];
        hash = fnv1a(hash, field.name.as_bytes());
        hash = fnv1a(hash, b":");
        hash = fnv1a(hash, field.kind.as_bytes());
        hash = fnv1a(hash, b"@");
        hash = fnv1a_decimal(hash, field.offset);
        hash = fnv1a(hash, b";");
        i += 1;
    }
    hash
};

/// Start value of 64-bit FNV-1a.
const FNV_BASIS: u64 = 0xcbf2_9ce4_8422_2325;

/// Continues a 64-bit FNV-1a hash.
const fn fnv1a(mut hash: u64, bytes: &[u8]) -> u64 {
    let mut i = 0;
    while i < bytes.len() {
        hash = (hash ^ bytes[i] as u64).wrapping_mul(0x0000_0100_0000_01b3);
        i += 1;
    }
    hash
}

/// Continues a hash with the decimal digits of a number below 1000.
const fn fnv1a_decimal(hash: u64, number: usize) -> u64 {
    assert!(number < 1000);
    let digits =
        [b'0' + (number / 100) as u8, b'0' + (number / 10 % 10) as u8, b'0' + (number % 10) as u8];
    let (_, digits) = digits.split_at(if number >= 100 {
        0
    } else if number >= 10 {
        1
    } else {
        2
    });
    fnv1a(hash, digits)
}

/// Declares a C-like enum with the conversion from its number.
macro_rules! numbered {
    ($(#[$outer:meta])* pub enum $name:ident { $($(#[$inner:meta])* $variant:ident = $value:literal,)* }) => {
        $(#[$outer])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        #[repr(u32)]
        pub enum $name { $($(#[$inner])* $variant = $value,)* }

        impl $name {
            /// All of them, by name.
            pub const ALL: &[(&'static str, Self)] = &[$((stringify!($variant), Self::$variant),)*];

            /// The one with this number.
            pub const fn from_number(number: u32) -> Option<Self> {
                match number { $($value => Some(Self::$variant),)* _ => None }
            }
        }
    };
}

numbered! {
    /// What a message is.
    pub enum Kind {
        /// Driver: asks for the lease. No payload.
        Attach = 1,
        /// Driver: the input of one step; the payload is `u`, ni + nk entries.
        Input = 2,
        /// Driver: gives the lease back. No payload, no answer.
        Detach = 3,
        /// Server: the lease is the driver's; the payload is the current state.
        Attached = 16,
        /// Server: a step was taken; the payload is the state after it: `q` (nd + nk), `p` (nd),
        /// `v` (nk), `multipliers` (nc), `velocity` of all coordinates (nd + nk), what the output channels
        /// deliver (ny), and for each of these channels 1 where its numbers stand for lost ones, else 0.
        State = 17,
        /// Server: refused or failed, `code` says why; the plant is as it was. No payload.
        Failure = 18,
        /// Server: the link ends, `code` says why. Goes to every driver. No payload.
        Closed = 19,
    }
}

numbered! {
    /// Why something was refused, failed or ended.
    pub enum Code {
        /// The magic number, the layout version or the schema hash is another one.
        Layout = 1,
        /// The kind of the message is unknown, or none that a driver sends.
        Kind = 2,
        /// Somebody else holds the lease: `detail_a` is a [`Holder`], `detail_b` its process id
        /// when it is a link driver.
        LeaseHeld = 3,
        /// The sender does not hold the lease: it never attached, was idle longer than the server
        /// allows, or addressed a server that is no more.
        NotAttached = 4,
        /// An input was lost or repeated: `detail_a` is the sequence number that was expected.
        /// The next one after the number received is accepted.
        Sequence = 5,
        /// The input has `detail_b` entries; `detail_a` are needed.
        Dimension = 6,
        /// Entry `detail_a` of the input is `detail_value`, not a finite number.
        InputNotFinite = 7,
        /// The solver gave up after `iterations` with `residual`.
        NotConverged = 8,
        /// The iteration left the finite numbers after `iterations`.
        NotFinite = 9,
        /// Singular Newton matrix at coordinate `detail_a`; the pivot is `detail_value` of what it
        /// can be.
        Singular = 10,
        /// The plant was deleted.
        PlantDeleted = 11,
        /// The link was closed, or the server shuts down.
        LinkClosed = 12,
        /// Coordinate `detail_a` turned by `detail_value` rad, more than half a turn, in one step.
        TooFast = 13,
        /// Constraint equations lost their independence: `detail_a` is the index of the first
        /// concerned, `detail_b` their number, `detail_value` the reciprocal condition.
        SingularConstraints = 14,
        /// Constraint equations contradict each other: `detail_a` is the index of the first
        /// concerned, `detail_b` their number, `detail_value` the largest violation.
        InconsistentConstraints = 15,
        /// A watchdog holds the plant: `detail_a` is its index, `detail_value` the value of its quantity,
        /// `residual` the bound that it left. `detail_b`, if it is not zero, says which quantity that is: 1
        /// more than the index of a coordinate, a coordinate's velocity, a constraint's force, or the energy,
        /// with 0, 1, 2 or 3 in its upper half.
        Watchdog = 16,
    }
}

numbered! {
    /// Who holds a lease.
    pub enum Holder {
        /// A call of `Step`.
        Step = 1,
        /// A `Drive` stream.
        Drive = 2,
        /// A driver of the shared-memory link.
        Link = 3,
    }
}

impl Header {
    /// A header with the constant fields filled in.
    pub fn new(kind: Kind) -> Self {
        Self {
            magic: MAGIC,
            layout_version: LAYOUT_VERSION,
            schema_hash: SCHEMA_HASH,
            kind: kind as u32,
            ..Self::default()
        }
    }

    /// Whether the constant fields are the ones of this layout.
    pub fn is_of_this_layout(&self) -> bool {
        self.magic == MAGIC
            && self.layout_version == LAYOUT_VERSION
            && self.schema_hash == SCHEMA_HASH
    }

    /// Entries of an input: ni + nk.
    pub fn input_len(&self) -> usize {
        self.inputs as usize + self.prescribed as usize
    }

    /// Entries of a state message: `q`, `p`, `v`, the multipliers, the velocity, the outputs and their flags.
    pub fn state_len(&self) -> usize {
        let coordinates = self.dynamic as usize + self.prescribed as usize;
        let outputs = self.outputs as usize + self.output_channels as usize;
        3 * coordinates + self.constraints as usize + outputs
    }

    /// When the sender stops polling, ns on the system's monotonic clock.
    pub fn poll_end_ns(&self) -> u64 {
        self.stamp_ns.saturating_add(self.poll_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bindings in other languages repeat the layout; this pins it. A change needs a new version.
    #[test]
    fn the_layout_of_version_5_is_pinned() {
        assert_eq!((LAYOUT_VERSION, size_of::<Header>()), (5, 208));
        assert_eq!(align_of::<Header>(), 8);
        assert_eq!(SCHEMA_HASH, 0x8e73_cfd4_5005_6052);
        let (dynamic, prescribed, constraints) = (5, 2, 3);
        let header = Header { dynamic, prescribed, constraints, ..Header::new(Kind::State) };
        let header = Header { outputs: 4, output_channels: 1, ..header };
        assert_eq!(header.state_len(), (7 + 5 + 2) + 3 + 7 + 4 + 1);
    }

    #[test]
    fn the_header_has_no_padding() {
        let mut end = 0;
        for field in HEADER_FIELDS {
            assert_eq!(field.offset, end, "padding before {}", field.name);
            end += if field.kind == "u32" { 4 } else { 8 };
        }
        assert_eq!(end, size_of::<Header>());
    }

    #[test]
    fn numbers_convert_both_ways() {
        for &(_, kind) in Kind::ALL {
            assert_eq!(Kind::from_number(kind as u32), Some(kind));
        }
        for &(_, code) in Code::ALL {
            assert_eq!(Code::from_number(code as u32), Some(code));
        }
        assert_eq!((Kind::from_number(0), Code::from_number(0)), (None, None));
    }

    #[test]
    fn a_header_of_another_version_is_recognised() {
        let good = Header::new(Kind::Input);
        assert!(good.is_of_this_layout());
        assert!(!Header { layout_version: 1, ..good }.is_of_this_layout());
        assert!(!Header { magic: 0, ..good }.is_of_this_layout());
        assert!(!Header { schema_hash: 1, ..good }.is_of_this_layout());
    }
}
