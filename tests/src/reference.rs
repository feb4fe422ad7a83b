//! Reference mechanisms and trajectories (`tests/reference/`), and their conversion to scenes.
//!
//! `tests/reference/README.md` describes the files and their conventions.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::{Context, Result, bail, ensure};
use plantd_models::scene::{
    Axis, Body, Component, Constraint, Coordinate, CoordinateKind, Force, Frame, Input, Joint,
    Length, Point, Rotation, Scene, Spring,
};
use plantd_models::{Initial, Model};
use serde::Deserialize;
use serde::de::DeserializeOwned;

/// A mechanism as its file has it. Fields that nothing here needs are not read.
#[derive(Debug, Deserialize)]
pub struct Mechanism {
    /// Name of the case.
    pub name: String,
    frames: Vec<FrameRecord>,
    /// Configuration variables: dynamic ones, then prescribed ones.
    pub configs: Vec<Config>,
    inputs: Vec<Named>,
    constraints: Vec<ConstraintRecord>,
    potentials: Vec<PotentialRecord>,
    forces: Vec<ForceRecord>,
    /// Time step, s.
    pub dt: f64,
    /// Where the trajectory starts.
    pub initial: Start,
}

#[derive(Debug, Deserialize)]
struct FrameRecord {
    parent: Option<usize>,
    #[serde(rename = "type")]
    kind: String,
    value: Option<f64>,
    config: Option<String>,
    se3_rows: Option<[[f64; 4]; 4]>,
    mass: Option<f64>,
    inertia: Option<[f64; 3]>,
}

/// A configuration variable.
#[derive(Debug, Deserialize)]
pub struct Config {
    /// Name, with spaces and other characters that scenes do not have.
    pub name: String,
    /// Prescribed.
    pub kinematic: bool,
}

#[derive(Debug, Deserialize)]
struct Named {
    name: String,
}

#[derive(Debug, Deserialize)]
#[serde(tag = "type")]
enum ConstraintRecord {
    Distance {
        frame1: usize,
        frame2: usize,
        distance: Option<f64>,
        distance_config: Option<String>,
    },
    PointToPoint1D {
        frame1: usize,
        frame2: usize,
        axis: Axis,
    },
}

#[derive(Debug, Deserialize)]
#[serde(tag = "type")]
enum PotentialRecord {
    Gravity { gravity: [f64; 3] },
    ConfigSpring { config: String, k: f64, q0: f64 },
    LinearSpring { frame1: usize, frame2: usize, k: f64, x0: f64 },
}

#[derive(Debug, Deserialize)]
#[serde(tag = "type")]
enum ForceRecord {
    Damping { default: f64, coefficients: BTreeMap<String, f64> },
    ConfigForce { config: String, input: String },
    LinearDamper { frame1: usize, frame2: usize, c: f64 },
    BodyWrench { frame: usize, wrench: [Component; 6] },
    SpatialWrench { frame: usize, wrench: [Component; 6] },
    HybridWrench { frame: usize, wrench: [Component; 6] },
}

/// Force, then torque; names of inputs as in scenes.
fn wrench(wrench: &[Component; 6]) -> ([Component; 3], [Component; 3]) {
    let [fx, fy, fz, tx, ty, tz] = wrench.clone().map(|component| match component {
        Component::Input(name) => Component::Input(plain(&name)),
        other => other,
    });
    ([fx, fy, fz], [tx, ty, tz])
}

/// Where a trajectory starts.
#[derive(Clone, Debug, Deserialize)]
#[serde(tag = "method", rename_all = "snake_case")]
pub enum Start {
    /// Configuration and momentum.
    State {
        /// Configuration.
        q1: Vec<f64>,
        /// Momentum.
        p1: Vec<f64>,
    },
    /// Two configurations, one time step apart; the trajectory starts at the second.
    Configs {
        /// First.
        q0: Vec<f64>,
        /// Second.
        q1: Vec<f64>,
    },
}

impl Start {
    /// Configuration at the start.
    pub fn q1(&self) -> &[f64] {
        match self {
            Self::State { q1, .. } | Self::Configs { q1, .. } => q1,
        }
    }
}

/// A trajectory and linearizations along it.
#[derive(Debug, Deserialize)]
pub struct Golden {
    /// Time step, s.
    pub dt: f64,
    /// Configurations, one row more than steps.
    pub q: Vec<Vec<f64>>,
    /// Momenta of the dynamic coordinates.
    pub p: Vec<Vec<f64>>,
    /// Velocities of the prescribed coordinates.
    pub kin_velocity_v: Vec<Vec<f64>>,
    /// Constraint impulses of each step.
    pub lambda1: Vec<Vec<f64>>,
    /// Input forces of each step.
    pub u: Vec<Vec<f64>>,
    /// Prescribed configuration at the end of each step.
    pub k2: Vec<Vec<f64>>,
    /// Energy of each state, J.
    pub energy_state: Vec<f64>,
    /// Energy at the midpoint of each step, J.
    pub energy_midpoint: Vec<f64>,
    /// First derivatives of some steps.
    pub linearization: Vec<LinearizationRecord>,
    /// Second derivatives of some of these steps.
    #[serde(default)]
    pub second_order: Vec<SecondOrderRecord>,
    /// Continuous-time dynamics at one point.
    pub continuous: Option<ContinuousRecord>,
}

/// Second derivatives of one step.
#[derive(Debug, Deserialize)]
pub struct SecondOrderRecord {
    /// The step.
    pub k: usize,
    /// Full tensors like `q2_dq1dp1`, or the weights `z` of a contraction with its blocks.
    #[serde(flatten)]
    pub arrays: Arrays,
}

/// Continuous-time dynamics with their derivatives; `f` are the accelerations.
#[derive(Debug, Deserialize)]
#[allow(missing_docs)] // The names are those of the equations.
pub struct ContinuousRecord {
    pub q: Vec<f64>,
    pub dq: Vec<f64>,
    pub u: Vec<f64>,
    pub ddqk: Vec<f64>,
    pub f: Vec<f64>,
    /// Of the opposite sign.
    pub lambda_: Vec<f64>,
    /// First derivatives like `f_ddq`, second derivatives like `f_ddqdq`.
    #[serde(flatten)]
    pub arrays: Arrays,
}

/// Arrays by name, beside notes on how they were made.
#[derive(Debug, Deserialize)]
#[serde(transparent)]
pub struct Arrays(serde_json::Map<String, serde_json::Value>);

impl Arrays {
    /// An array of that name and kind, if there is one.
    pub fn get<T: DeserializeOwned>(&self, name: &str) -> Result<Option<T>> {
        let value = self.0.get(name).cloned();
        value.map(serde_json::from_value).transpose().with_context(|| name.to_owned())
    }
}

/// An array with three indices: first variable, second variable, output.
pub type Tensor = Vec<Vec<Vec<f64>>>;

/// First derivatives of one step; rows are outputs, columns are variables.
#[derive(Debug, Deserialize)]
#[allow(missing_docs)] // The names are those of the equations: d(q2, p2, λ) by (q1, p1, u1, k2).
pub struct LinearizationRecord {
    pub k: usize,
    pub q1: Vec<f64>,
    pub p1: Vec<f64>,
    pub u1: Vec<f64>,
    pub k2: Vec<f64>,
    pub q2: Vec<f64>,
    pub p2: Vec<f64>,
    pub lambda1: Vec<f64>,
    pub q2_dq1: Rows,
    pub q2_dp1: Rows,
    pub q2_du1: Rows,
    pub q2_dk2: Rows,
    pub p2_dq1: Rows,
    pub p2_dp1: Rows,
    pub p2_du1: Rows,
    pub p2_dk2: Rows,
    pub lambda1_dq1: Rows,
    pub lambda1_dp1: Rows,
    pub lambda1_du1: Rows,
    pub lambda1_dk2: Rows,
}

/// A matrix, row by row.
pub type Rows = Vec<Vec<f64>>;

/// The step of the paper's section on the pendulum.
#[derive(Debug, Deserialize)]
#[allow(missing_docs)] // As in the paper.
pub struct PaperStep {
    pub q0: f64,
    pub p0: f64,
    pub u0: f64,
    pub dt: f64,
    pub q1: f64,
    pub p1: f64,
    #[serde(rename = "A")]
    pub a: Rows,
    #[serde(rename = "B")]
    pub b: Rows,
    #[serde(rename = "controllability_C")]
    pub controllability: Rows,
}

/// Reads a file of `tests/reference/`.
pub fn read<T: DeserializeOwned>(name: &str) -> Result<T> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("reference").join(name);
    let text =
        std::fs::read_to_string(&path).with_context(|| format!("reading {}", path.display()))?;
    serde_json::from_str(&text).with_context(|| format!("parsing {}", path.display()))
}

/// Reads a mechanism.
pub fn mechanism(name: &str) -> Result<Mechanism> {
    read(&format!("{name}.json"))
}

/// Reads a trajectory.
pub fn golden(name: &str) -> Result<Golden> {
    read(&format!("golden/{name}.json"))
}

/// A name that scenes allow, one for one: other characters become underscores.
fn plain(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() || c == '-' { c } else { '_' }).collect()
}

fn frame_name(index: usize) -> String {
    if index == 0 { "world".to_owned() } else { format!("frame{index}") }
}

fn origin(frame: usize) -> Point {
    Point { frame: frame_name(frame), at: [0.0; 3] }
}

impl Mechanism {
    /// The same mechanism as a scene: one frame for each frame, one constraint for each equation.
    pub fn scene(&self) -> Result<Scene> {
        let mut scene = Scene {
            format: 1,
            name: self.name.replace('_', "-"),
            description: String::new(),
            time_step_s: self.dt,
            gravity: Some([0.0; 3]),
            damping: 0.0,
            frames: Vec::new(),
            coordinates: self.coordinates(),
            armatures: Vec::new(),
            springs: Vec::new(),
            inputs: Vec::new(),
            forces: Vec::new(),
            signals: Vec::new(),
            constraints: Vec::new(),
            operating_points: Vec::new(),
        };
        for (index, record) in self.frames.iter().enumerate().skip(1) {
            let frame = frame(index, record).with_context(|| format!("frame {index}"))?;
            scene.frames.push(frame);
        }
        for potential in &self.potentials {
            match potential {
                PotentialRecord::Gravity { gravity } => scene.gravity = Some(*gravity),
                PotentialRecord::LinearSpring { frame1, frame2, k, x0 } => {
                    scene.springs.push(Spring::TwoPoint {
                        a: origin(*frame1),
                        b: origin(*frame2),
                        stiffness: *k,
                        rest_length: *x0,
                    })
                }
                PotentialRecord::ConfigSpring { config, k, q0 } => {
                    scene.springs.push(Spring::Coordinate {
                        coordinate: plain(config),
                        stiffness: *k,
                        rest: *q0,
                    })
                }
            }
        }
        self.forces(&mut scene)?;
        for (index, record) in self.constraints.iter().enumerate() {
            scene.constraints.push(constraint(format!("c{index}"), record)?);
        }
        Ok(scene)
    }

    fn coordinates(&self) -> Vec<Coordinate> {
        let coordinate = |(config, initial): (&Config, &f64)| Coordinate {
            name: plain(&config.name),
            kind: if config.kinematic {
                CoordinateKind::Prescribed
            } else {
                CoordinateKind::Dynamic
            },
            initial: *initial,
            ..Coordinate::default()
        };
        self.configs.iter().zip(self.initial.q1()).map(coordinate).collect()
    }

    fn forces(&self, scene: &mut Scene) -> Result<()> {
        let mut driven = BTreeMap::new();
        for force in &self.forces {
            match force {
                ForceRecord::Damping { default, coefficients } => {
                    scene.damping = *default;
                    for (config, damping) in coefficients {
                        let name = plain(config);
                        let coordinate = scene.coordinates.iter_mut().find(|c| c.name == name);
                        coordinate.context("damping of an unknown config")?.damping =
                            Some(*damping);
                    }
                }
                ForceRecord::ConfigForce { config, input } => {
                    ensure!(driven.insert(input, config).is_none(), "input `{input}` acts twice");
                }
                ForceRecord::LinearDamper { frame1, frame2, c } => {
                    let (a, b) = (origin(*frame1), origin(*frame2));
                    scene.forces.push(Force::TwoPointDamper { a, b, damping: *c });
                }
                ForceRecord::BodyWrench { frame, wrench: w } => {
                    let (frame, (force, torque)) = (frame_name(*frame), wrench(w));
                    scene.forces.push(Force::BodyWrench { frame, force, torque });
                }
                ForceRecord::SpatialWrench { frame, wrench: w } => {
                    let (frame, (force, torque)) = (frame_name(*frame), wrench(w));
                    scene.forces.push(Force::SpatialWrench { frame, force, torque });
                }
                ForceRecord::HybridWrench { frame, wrench: w } => {
                    let (frame, (force, torque)) = (frame_name(*frame), wrench(w));
                    scene.forces.push(Force::HybridWrench { frame, force, torque });
                }
            }
        }
        for input in &self.inputs {
            scene.inputs.push(Input {
                name: plain(&input.name),
                coordinate: driven.get(&input.name).map(|config| plain(config)),
                ..Input::default()
            });
        }
        Ok(())
    }

    /// Where a model of [`Self::scene`] has the reference's configuration variables: entry `r` is the
    /// model's index of the reference's variable `r`. Prescribed ones follow dynamic ones in both.
    pub fn order(&self, model: &Model) -> Result<Order> {
        let position = |config: &Config| {
            let name = plain(&config.name);
            let found = model.coordinates().iter().position(|c| c.name == name);
            found.with_context(|| format!("the model has no coordinate `{name}`"))
        };
        Order::new(model, self.configs.iter().map(position).collect::<Result<_>>()?)
    }

    /// The start of the trajectory in the model's order.
    pub fn start(&self, order: &Order) -> Initial {
        match &self.initial {
            Start::State { q1, p1 } => Initial::Momentum {
                q: order.coordinates(q1),
                p: order.dynamic(p1),
                v: vec![0.0; order.prescribed],
            },
            Start::Configs { q0, q1 } => {
                Initial::TwoConfigurations { q0: order.coordinates(q0), q1: order.coordinates(q1) }
            }
        }
    }
}

/// A renumbering of the reference's coordinates into those of a model.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Order {
    /// Index in the model of each coordinate of the reference.
    pub indices: Vec<usize>,
    dynamic: usize,
    prescribed: usize,
}

impl Order {
    /// From the model's index of each coordinate of the reference.
    pub fn new(model: &Model, indices: Vec<usize>) -> Result<Self> {
        let dimensions = model.dimensions();
        let mut sorted = indices.clone();
        sorted.sort_unstable();
        ensure!(
            sorted.into_iter().eq(0..dimensions.coordinates()),
            "{indices:?} does not name each coordinate of the model once"
        );
        let (dynamic, prescribed) = indices.split_at(dimensions.dynamic);
        ensure!(
            dynamic.iter().all(|i| *i < dimensions.dynamic) && prescribed.is_sorted(),
            "dynamic and prescribed coordinates are mixed, or prescribed ones reordered"
        );
        Ok(Self { indices, dynamic: dimensions.dynamic, prescribed: dimensions.prescribed })
    }

    /// The reference's order is the model's.
    pub fn identity(model: &Model) -> Result<Self> {
        Self::new(model, (0..model.dimensions().coordinates()).collect())
    }

    /// Whether it is [`Self::identity`].
    pub fn is_identity(&self) -> bool {
        self.indices.is_sorted()
    }

    /// A reference's configuration in the model's order.
    pub fn coordinates(&self, reference: &[f64]) -> Vec<f64> {
        self.scatter(reference, self.indices.len())
    }

    /// A reference's momentum in the model's order.
    pub fn dynamic(&self, reference: &[f64]) -> Vec<f64> {
        self.scatter(reference, self.dynamic)
    }

    fn scatter(&self, reference: &[f64], count: usize) -> Vec<f64> {
        assert_eq!(reference.len(), count);
        let mut out = vec![0.0; count];
        for (value, index) in reference.iter().zip(&self.indices) {
            out[*index] = *value;
        }
        out
    }
}

fn frame(index: usize, record: &FrameRecord) -> Result<Frame> {
    let mut frame = Frame {
        name: frame_name(index),
        parent: frame_name(record.parent.context("no parent")?),
        ..Frame::default()
    };
    if let (Some(mass), Some(inertia)) = (record.mass, record.inertia) {
        let inertia = if inertia == [0.0; 3] { Vec::new() } else { inertia.to_vec() };
        frame.body = Some(Body { mass, inertia, ..Body::default() });
    }
    if record.kind == "CONST_SE3" {
        let rows = record.se3_rows.context("no matrix")?;
        frame.translation = [rows[0][3], rows[1][3], rows[2][3]];
        frame.rotation =
            Some(Rotation::Matrix([0, 1, 2].map(|i| [rows[i][0], rows[i][1], rows[i][2]])));
        return Ok(frame);
    }
    let (is_rotation, direction) = match record.kind.as_bytes() {
        [kind @ (b'T' | b'R'), direction @ b'X'..=b'Z'] => {
            (*kind == b'R', usize::from(direction - b'X'))
        }
        _ => bail!("unknown type {}", record.kind),
    };
    let along = |x: f64| [0, 1, 2].map(|i| if i == direction { x } else { 0.0 });
    match (&record.config, record.value) {
        (Some(config), None) => {
            let (axis, coordinate) = (along(1.0), Some(plain(config)));
            frame.joint = Some(if is_rotation {
                Joint::Revolute { axis, coordinate }
            } else {
                Joint::Prismatic { axis, coordinate }
            });
        }
        (None, Some(angle)) if is_rotation => frame.rotation = Some(Rotation::Rpy(along(angle))),
        (None, Some(distance)) => frame.translation = along(distance),
        _ => bail!("neither a value nor a config"),
    }
    Ok(frame)
}

fn constraint(name: String, record: &ConstraintRecord) -> Result<Constraint> {
    Ok(match record {
        ConstraintRecord::Distance { frame1, frame2, distance, distance_config } => {
            let length = match (distance, distance_config) {
                (Some(length), None) => Length::Fixed(*length),
                (None, Some(config)) => Length::Coordinate(plain(config)),
                _ => bail!("a distance must be either fixed or a config"),
            };
            Constraint::Distance { name, a: origin(*frame1), b: origin(*frame2), length }
        }
        ConstraintRecord::PointToPoint1D { frame1, frame2, axis } => Constraint::PointToPoint {
            name,
            a: origin(*frame1),
            b: origin(*frame2),
            axes: vec![*axis],
        },
    })
}
