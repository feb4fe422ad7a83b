//! What a file of a robot leaves open.

use std::collections::BTreeMap;

/// What a user decides.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// What holds the robot.
    pub base: Base,
    /// Which joints get an input.
    pub inputs: Inputs,
    /// Acceleration of gravity, world axes, m/s²; if not given that of the file, and [`EARTH`] where it has none.
    pub gravity: Option<[f64; 3]>,
    /// Time step that the scene suggests, s; if not given that of the file, and 0.001 where it has none.
    pub time_step_s: Option<f64>,
    /// Velocity at which 76 % of the dry friction of a joint are reached, m/s or rad/s.
    pub friction_velocity: f64,
    /// Stops at the limits of joints: depth, m or rad, and time, s, in which a joint settles that is held there
    /// (`settling_depth` and `settling_time_s` of a `stop`). Without it limits are only known to clients.
    pub stops: Option<[f64; 2]>,
    /// Folders of packages by name, which take the place of `package://NAME` in paths of meshes.
    pub packages: BTreeMap<String, String>,
    /// What cannot be expressed is left out with a warning, and inertias that no body has are taken as they are.
    pub lenient: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            base: Base::Fixed,
            inputs: Inputs::AsTold,
            gravity: None,
            time_step_s: None,
            friction_velocity: 0.01,
            stops: None,
            packages: BTreeMap::new(),
            lenient: false,
        }
    }
}

impl Options {
    /// A path with its package's folder, if that is given.
    pub(crate) fn path(&self, path: &str) -> String {
        let parts = path.strip_prefix("package://").and_then(|rest| rest.split_once('/'));
        let found = parts.and_then(|(name, rest)| Some((self.packages.get(name)?, rest)));
        let in_folder =
            found.map(|(folder, rest)| format!("{}/{rest}", folder.trim_end_matches('/')));
        in_folder.unwrap_or_else(|| path.to_owned())
    }
}

/// Acceleration of gravity where nobody says otherwise, m/s².
pub const EARTH: [f64; 3] = [0.0, 0.0, -9.81];

/// What holds the root link of a URDF. An MJCF says itself which of its bodies are free.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Base {
    /// The world.
    #[default]
    Fixed,
    /// Nothing: it has six coordinates.
    Free,
}

/// What gets an input.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Inputs {
    /// The joints of a URDF that transmissions and command interfaces name, or all if the file has none of
    /// these; the actuators of an MJCF.
    #[default]
    AsTold,
    /// All joints that move about or along one axis and mimic no other, and nothing else.
    All,
    /// None.
    None,
}
