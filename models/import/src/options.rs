//! What a file of a robot leaves open.

/// What a user decides.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// What holds the robot.
    pub base: Base,
    /// Which joints get an input.
    pub inputs: Inputs,
    /// Acceleration of gravity, world axes, m/s².
    pub gravity: [f64; 3],
    /// Time step that the scene suggests, s.
    pub time_step_s: f64,
    /// Velocity at which 76 % of the dry friction of a joint are reached, m/s or rad/s.
    pub friction_velocity: f64,
    /// What cannot be expressed is left out with a warning, and inertias that no body has are taken as they are.
    pub lenient: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            base: Base::Fixed,
            inputs: Inputs::AsTold,
            gravity: [0.0, 0.0, -9.81],
            time_step_s: 0.001,
            friction_velocity: 0.01,
            lenient: false,
        }
    }
}

/// What holds the root link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Base {
    /// The world.
    #[default]
    Fixed,
    /// Nothing: it has six coordinates.
    Free,
}

/// Which joints get an input, a force or torque along their axis.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Inputs {
    /// Those of transmissions and command interfaces; all if the file has none of these.
    #[default]
    AsTold,
    /// All that move about or along one axis and mimic no other.
    All,
    /// None.
    None,
}
