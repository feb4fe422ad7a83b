//! Models: compiled scenes.

use crate::scene::{CoordinateKind, Scene, SceneError};

/// A compiled scene: immutable, shared by all plants made from it.
#[derive(Debug)]
pub struct Model {}

/// Sizes of a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Dimensions {
    /// Dynamic coordinates, `nd`.
    pub dynamic: usize,
    /// Prescribed coordinates, `nk`.
    pub prescribed: usize,
    /// Generalized-force inputs, `ni`.
    pub inputs: usize,
    /// Constraint equations, `nc`.
    pub constraints: usize,
}

impl Dimensions {
    /// Coordinates, `nd + nk`.
    pub fn coordinates(&self) -> usize {
        self.dynamic + self.prescribed
    }
    /// Entries of `x = (q, p, v)`: `2 nd + 2 nk`.
    pub fn state(&self) -> usize {
        2 * self.coordinates()
    }
    /// Entries of `u = (inputs, next prescribed positions)`: `ni + nk`.
    pub fn input(&self) -> usize {
        self.inputs + self.prescribed
    }
}

/// A coordinate of a model.
#[derive(Clone, Debug, PartialEq)]
pub struct Coordinate {
    /// Name.
    pub name: String,
    /// Dynamic or prescribed.
    pub kind: CoordinateKind,
    /// Angle (rad) or length (m).
    pub is_angle: bool,
    /// Value in the scene's initial configuration.
    pub initial: f64,
}

/// A configuration to hold, with the input that holds it.
#[derive(Clone, Debug, PartialEq)]
pub struct OperatingPoint {
    /// Name.
    pub name: String,
    /// Configuration, `nd + nk`.
    pub q: Vec<f64>,
    /// Input `u`, `ni + nk`: forces, then the prescribed positions of `q`.
    pub u: Vec<f64>,
}

impl Model {
    /// Compiles a scene.
    pub fn compile(_scene: &Scene) -> Result<Self, SceneError> {
        unimplemented!()
    }
    /// The scene it was compiled from.
    pub fn scene(&self) -> &Scene {
        unimplemented!()
    }
    /// Sizes.
    pub fn dimensions(&self) -> Dimensions {
        unimplemented!()
    }
    /// Coordinates: dynamic ones in depth-first order, then prescribed ones as listed.
    pub fn coordinates(&self) -> &[Coordinate] {
        unimplemented!()
    }
    /// Names of the constraint equations, in the order of the multipliers; for example `elbow.x`.
    pub fn constraint_names(&self) -> &[String] {
        unimplemented!()
    }
    /// Operating points, first one `initial`: the initial configuration without input forces.
    pub fn operating_points(&self) -> &[OperatingPoint] {
        unimplemented!()
    }
    /// What a step evaluates and what it skips, for people to read.
    pub fn plan(&self) -> String {
        unimplemented!()
    }
    /// A hash of everything that the motion depends on; equal for equal scenes.
    pub fn digest(&self) -> u64 {
        unimplemented!()
    }
}
