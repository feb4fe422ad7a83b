//! The kinds of drivers of a plant.

/// Who may step a plant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DriverKind {
    /// A unary call that holds the lease while it runs.
    Step,
    /// A `Drive` stream.
    Drive,
    /// A driver over shared memory.
    Link,
}

impl DriverKind {
    /// The name in `PlantInfo.driver` and in metrics.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Step => "step",
            Self::Drive => "drive",
            Self::Link => "link",
        }
    }

    pub(crate) fn code(self) -> u8 {
        match self {
            Self::Step => 1,
            Self::Drive => 2,
            Self::Link => 3,
        }
    }

    /// The kind with that number, 0 for none.
    pub fn from_code(code: u8) -> Option<Self> {
        match code {
            1 => Some(Self::Step),
            2 => Some(Self::Drive),
            3 => Some(Self::Link),
            _ => None,
        }
    }
}
