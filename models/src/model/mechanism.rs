//! Models: compiled scenes.

use plantd_math::elimination::SymbolicElimination;
use plantd_math::spatial::{Force, Mat3, Vec3};
use plantd_math::spline::Spline;
use plantd_scene::{CoordinateKind, Problem, Scene};

use crate::model::conditioning::Conditioning;
use crate::model::held::Held;
use crate::model::loop_plan::Loops;
use crate::model::planar_tree::PlanarJoints;
use crate::model::signal::{Signal, Target};
use crate::model::tree::{Attachment, Tree};

/// A compiled scene: immutable, shared by all plants made from it.
#[derive(Debug)]
pub struct Model {
    pub(crate) scene: Scene,
    pub(crate) warnings: Vec<Problem>,
    pub(crate) dimensions: Dimensions,
    pub(crate) coordinates: Vec<Coordinate>,
    /// First of the three coordinates of each orientation (ball joint).
    pub(crate) orientations: Vec<usize>,
    pub(crate) constraint_names: Vec<String>,
    pub(crate) operating_points: Vec<OperatingPoint>,
    pub(crate) digest: u64,
    /// Joints that carry inertia or springs: what a step walks at the midpoint.
    pub(crate) dynamics: Tree,
    /// [`Self::dynamics`] as a planar tree, where it is one and nothing needs its poses in space.
    pub(crate) planar: Option<PlanarJoints>,
    /// Axes that were turned to make it one, and the largest angle.
    pub(crate) straightened: (usize, f64),
    /// Its loops, where they are eliminated with it.
    pub(crate) loops: Option<Loops>,
    /// Its limbs whose ends are held, where they are eliminated first.
    pub(crate) held: Option<Held>,
    /// How a step solves for corrections.
    pub(crate) solver: Solver,
    /// `None` without gravity.
    pub(crate) gravity: Option<Vec3>,
    /// Damping of each dynamic coordinate; empty without damping.
    pub(crate) damping: Vec<f64>,
    /// Forces of inputs on coordinates.
    pub(crate) coordinate_inputs: Vec<CoordinateInput>,
    /// Forces other than those of springs, damping and inputs on coordinates; `None` without any.
    pub(crate) forces: Option<Forces>,
    pub(crate) signals: Vec<Signal>,
    pub(crate) potentials: Potentials,
    pub(crate) armature: Armatures,
    /// Joints that points of constraints depend on: what a step walks at its ends.
    pub(crate) closure: Tree,
    pub(crate) constraints: Vec<Constraint>,
    pub(crate) alignments: Vec<Alignment>,
    pub(crate) elimination: SymbolicElimination,
    /// Ancestor and descendant pairs of dynamic coordinates, with their place in the factorization.
    pub(crate) pairs: Vec<Pair>,
    /// Ancestor and descendant pairs of which exactly one is prescribed.
    pub(crate) mixed_pairs: Vec<MixedPair>,
    /// What acts on bodies across each joint. `None` where elements act across one joint from different bodies.
    pub(crate) acting: Option<Vec<Acting>>,
    /// Whether what acts between bodies, but for that from the world, is taken as
    /// [ties](crate::lagrangian::ties): where generators alone do not have all of it.
    pub(crate) has_ties: bool,
    /// How many rows ties and armatures of sums have beside generators.
    pub(crate) tied_rows: usize,
    /// How many entries [`Model::input_pattern`] has.
    pub(crate) impulses: usize,
    /// Whether the end of steps is foreseen with the springs and forces that it has beside
    /// [simple ones](Model::has_simple_elements), and with these, too, where it has ball joints.
    pub(crate) foresees_elements: bool,
    /// What pivots are compared with.
    pub(crate) conditioning: Conditioning,
    pub(crate) initial_violations: Vec<Violation>,
}

/// An equation of a constraint that a configuration violates.
#[derive(Clone, Debug, PartialEq)]
pub struct Violation {
    /// Name of the equation.
    pub constraint: String,
    /// Its value `h(q)`.
    pub value: f64,
}

/// How a step solves with its Newton matrix.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Solver {
    /// Entry by entry along the elimination tree: O(n·depth²) once, O(n·depth) for each correction.
    Tree,
    /// The same of all but limbs whose ends are held, which are eliminated with the constraints.
    Held,
    /// By the vectors that generate the entries: O(n). In planes, or in space.
    Planar,
    Spatial,
    /// By generators in planes, together with the constraints, front by front.
    Loops,
}

/// What of the [elements between bodies](crate::lagrangian::fields) acts across a joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Acting {
    Nothing,
    /// Something, from the world or from a body farther up than what the joint hangs from.
    Through,
    /// Something, from the body that the joint hangs from.
    Ends,
}

impl Acting {
    /// Whether something does.
    pub(crate) fn is_any(self) -> bool {
        self != Self::Nothing
    }
}

/// How many blocks the vectors of joints in space have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Blocks {
    /// Those of bodies.
    One,
    /// And of what acts on bodies from the world or from bodies above.
    Two,
    /// And of what does so from bodies above, and follows velocities.
    Three,
}

impl Solver {
    /// Coordinates from which on generators are faster in planes.
    const MANY: usize = 4;
    /// Stored entries a row, on average, above which they are in space. By generators a step took of the time
    /// that it took entry by entry:
    ///
    /// ```text
    /// tree-N, of 2.4, 3.3, 4.1 and 5.1 entries a row      7: 1.13   15: 1.12   30: 1.06   63: 1.02
    /// arm of 7 hinges, of 4 entries                       0.93
    /// humanoid on a fixed base, of 5 entries              0.85
    /// ```
    ///
    /// Many axes one below the other are for generators. Where not much is at stake, entries it is: plants
    /// that are solved entry by entry can go side by side.
    ///
    /// It is as many where something acts across joints, from the world or from bodies above, and vectors of these are
    /// twice as long:
    ///
    /// ```text
    /// quadruped with a push or a spring on a foot, of 6.5 entries     0.65, 0.62
    /// rope of 24, 32, 64 and 128 with a spring                        0.58, 0.47, 0.22, 0.10
    /// the same, between two of its bodies                             1.04, 0.86, 0.46, 0.19
    /// ```
    const DEEP: usize = 6;
    /// The same for joints whose vectors are three times as long: a rope of 24, 32, 64 and 128 with a damper between two
    /// of its bodies took 1.47, 1.21, 0.67 and 0.27.
    const DEEP_WITH_RATES: usize = 18;

    /// Whether generators are faster in space, where vectors of so many joints are three times as long, and so many
    /// equations, and rows of ties, are solved with them.
    pub(crate) fn is_deep(
        elimination: &SymbolicElimination,
        with_rates: usize,
        equations: usize,
    ) -> bool {
        let rows = elimination.rows();
        let more = with_rates * (Self::DEEP_WITH_RATES - Self::DEEP) + rows * equations / 2;
        elimination.entries() > Self::DEEP * rows + more
    }

    /// The fastest one for a model without loops and limbs that are held.
    pub(crate) fn of(model: &Model) -> Self {
        let d = model.dimensions;
        if model.is_generated_in_space() {
            let with_rates = if model.blocks() == Blocks::Three { model.acted_on() } else { 0 };
            let is_deep =
                Self::is_deep(&model.elimination, with_rates, d.constraints + model.tied_rows);
            return if is_deep { Self::Spatial } else { Self::Tree };
        }
        let is_free = d.constraints == 0 && d.prescribed == 0 && model.joints_are_in_order();
        if model.planar.is_some() && is_free && d.dynamic >= Self::MANY {
            Self::Planar
        } else {
            Self::Tree
        }
    }
}

/// Two dynamic joints on one path to the root, or one joint twice.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pair {
    /// Joint in `dynamics`.
    pub(crate) ancestor: u32,
    /// Joint in `dynamics`.
    pub(crate) descendant: u32,
    /// Coordinate of the ancestor.
    pub(crate) row: u32,
    /// Coordinate of the descendant.
    pub(crate) column: u32,
    /// Place in the factorization.
    pub(crate) slot: u32,
}

/// A pair of joints of the dynamics tree of which exactly one is prescribed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MixedPair {
    pub(crate) ancestor: usize,
    pub(crate) descendant: usize,
}

/// The springs.
#[derive(Clone, Debug, Default)]
pub(crate) struct Potentials {
    /// Ordered by kind.
    pub(crate) springs: Vec<Spring>,
    /// There is one, or an armature: something adds to the Lagrangian of the bodies.
    pub(crate) any: bool,
    /// Some spring may couple coordinates that are not on one path to the root, or prescribed ones.
    pub(crate) couple_branches: bool,
}

/// A spring.
#[derive(Clone, Debug)]
pub(crate) enum Spring {
    Coordinate(CoordinateSpring),
    Point(PointSpring),
    Spline(SplineSpring),
    Path(PathSpring),
    Linear(LinearSpring),
    Stop(CoordinateStop),
    Orientation(OrientationSpring),
}

impl Spring {
    /// What kinds are called, in the order in which they are evaluated.
    const KINDS: [&'static str; 7] =
        ["coordinate", "two-point", "spline", "path", "linear", "stop", "orientation"];

    /// Place of its kind among [`Self::KINDS`].
    pub(crate) fn kind(&self) -> usize {
        match self {
            Self::Coordinate(_) => 0,
            Self::Point(_) => 1,
            Self::Spline(_) => 2,
            Self::Path(_) => 3,
            Self::Linear(_) => 4,
            Self::Stop(_) => 5,
            Self::Orientation(_) => 6,
        }
    }
}

impl Spring {
    /// Whether it acts on one coordinate, or on a body from the world or from one above it, across one joint or more.
    pub(crate) fn is_generated(&self) -> bool {
        match self {
            Self::Coordinate(_) | Self::Spline(_) | Self::Stop(_) | Self::Orientation(_) => true,
            Self::Point(spring) => spring.ends.span().is_some(),
            Self::Linear(_) => !self.couples_branches(),
            Self::Path(spring) => span(&spring.segments).is_some(),
        }
    }

    /// Whether its force is a linear function of coordinates.
    pub(crate) fn is_linear(&self) -> bool {
        matches!(self, Self::Coordinate(_) | Self::Linear(_))
    }

    /// The one joint that it acts on, as something between points.
    pub(crate) fn mover(&self) -> Option<Mover> {
        match self {
            Self::Point(spring) => spring.ends.mover,
            Self::Path(spring) => mover(&spring.segments),
            _ => None,
        }
    }
}

impl Potentials {
    /// How many there are of each kind.
    pub(crate) fn counts(&self) -> String {
        let count = |kind: usize| self.springs.iter().filter(|s| s.kind() == kind).count();
        let counts = Spring::KINDS.iter().enumerate();
        counts.map(|(kind, name)| format!("{} {name}", count(kind))).collect::<Vec<_>>().join(", ")
    }
}

/// The armatures of a model.
#[derive(Clone, Debug, Default)]
pub(crate) struct Armatures {
    /// Of single dynamic coordinates, none of them twice: the coordinate, and kg or kg·m².
    pub(crate) own: Vec<(usize, f64)>,
    pub(crate) sums: Vec<SumArmature>,
}

/// That of a sum of several dynamic coordinates, none of them of a ball joint.
#[derive(Clone, Debug)]
pub(crate) struct SumArmature {
    pub(crate) terms: Vec<(usize, f64)>,
    /// `a`, kg or kg·m² as the coefficients make it.
    pub(crate) inertia: f64,
}

/// `f = gain u` on a coordinate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct CoordinateInput {
    pub(crate) input: usize,
    pub(crate) coordinate: usize,
    pub(crate) gain: f64,
}

/// Forces that are evaluated at the midpoint of a step.
#[derive(Clone, Debug, Default)]
pub(crate) struct Forces {
    pub(crate) wrenches: Vec<Wrench>,
    pub(crate) point_forces: Vec<PointForce>,
    pub(crate) coordinate_forces: Vec<CoordinateForce>,
    pub(crate) linear_dampers: Vec<LinearDamper>,
    pub(crate) path_forces: Vec<PathForce>,
}

impl Forces {
    /// How many of them may couple coordinates.
    pub(crate) fn coupling(&self) -> usize {
        let Self { wrenches, point_forces, linear_dampers, path_forces, .. } = self;
        wrenches.len() + point_forces.len() + linear_dampers.len() + path_forces.len()
    }

    /// Whether they are more than forces on single coordinates, none of them of a ball joint.
    pub(crate) fn need_poses(&self) -> bool {
        self.coupling() > 0 || self.act_on_balls()
    }

    /// Whether some act across one ball joint, or on a component of its velocity.
    pub(crate) fn act_on_balls(&self) -> bool {
        let points = self.point_forces.iter().map(|force| force.ends.mover);
        let paths = self.path_forces.iter().map(|force| mover(&force.segments));
        self.coordinate_forces.iter().any(|force| force.ball.is_some())
            || points.chain(paths).any(|mover| matches!(mover, Some(Mover::Ball(_))))
    }
}

/// The first coordinate of the ball joint that a coordinate belongs to, with those of all ball joints.
pub(crate) fn ball_of(orientations: &[usize], coordinate: usize) -> Option<usize> {
    orientations.iter().copied().find(|first| (*first..first + 3).contains(&coordinate))
}

/// A wrench on a joint that carries a body.
#[derive(Clone, Debug)]
pub(crate) struct Wrench {
    pub(crate) kind: WrenchKind,
    /// The joint and a point of it; for a wrench that moves or turns with the joint, where it acts.
    pub(crate) at: Attachment,
    /// The joint and those above it, root first.
    pub(crate) path: Vec<usize>,
    /// Constant part; in the joint's axes if it turns with the joint, else in world axes.
    pub(crate) constant: Force,
    /// Inputs, and the wrench of a unit of each.
    pub(crate) inputs: Vec<(usize, Force)>,
}

/// How a wrench moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum WrenchKind {
    /// With the joint, at its point.
    Body,
    /// Not at all: about the world's origin.
    Spatial,
    /// Its point moves with the joint, its axes are those of the world.
    Hybrid,
}

/// A force between two points that follows from their separation and its rate.
#[derive(Clone, Debug)]
pub(crate) struct PointForce {
    pub(crate) ends: PointPair,
    pub(crate) law: PointLaw,
}

/// The force on the first point of a pair, `d = a − b`.
#[derive(Clone, Copy, Debug)]
pub(crate) enum PointLaw {
    /// `F = −c e (e·ḋ)`, `e = d/|d|`.
    Damper(f64),
    /// `F = −c |ḋ| ḋ`.
    Drag(f64),
}

/// A force on a coordinate that follows from its velocity, and of a stop from its position.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CoordinateForce {
    pub(crate) coordinate: usize,
    /// The orientation that it is a component of, and which one.
    pub(crate) ball: Option<(usize, usize)>,
    pub(crate) law: CoordinateLaw,
}

/// The force on a coordinate of velocity `v`.
#[derive(Clone, Copy, Debug)]
pub(crate) enum CoordinateLaw {
    /// `f = −(c + d |v|) |v| v`, `[c, d]`.
    Drag([f64; 2]),
    /// `f = −force tanh(v / velocity)`.
    Friction { force: f64, velocity: f64 },
    /// `f = −c(q) v`, the damper of a stop.
    Stop(Stop),
    /// `f` alone.
    Constant(f64),
}

/// A one-sided spring and damper at the ends of a range.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stop {
    pub(crate) range: [f64; 2],
    pub(crate) stiffness: f64,
    pub(crate) damping: f64,
    /// Depth at which stiffness and damping are whole.
    pub(crate) transition: f64,
}

/// The spring of a stop of a coordinate.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CoordinateStop {
    pub(crate) coordinate: usize,
    pub(crate) stop: Stop,
}

/// A force along a path: `f_i = (Σ g u − c L̇) L_i`.
#[derive(Clone, Debug)]
pub(crate) struct PathForce {
    /// One alone, where nothing but inputs acts along it.
    pub(crate) segments: Vec<PointPair>,
    /// Inputs `u` and their `g`.
    pub(crate) inputs: Vec<(usize, f64)>,
    pub(crate) resistance: Resistance,
}

/// The resistance `c` of a path to a change of its length.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Resistance {
    Constant(f64),
    /// That of the damper of a stop.
    Stop(Stop),
    /// `c L̇ = force tanh(L̇ / velocity)`.
    Friction {
        force: f64,
        velocity: f64,
    },
}

/// `V = ½ k (q − rest)²`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CoordinateSpring {
    pub(crate) coordinate: usize,
    pub(crate) stiffness: f64,
    pub(crate) rest: f64,
}

/// `V = ½ k (|a − b| − rest)²`.
#[derive(Clone, Debug)]
pub(crate) struct PointSpring {
    pub(crate) ends: PointPair,
    pub(crate) stiffness: f64,
    pub(crate) rest_length: f64,
}

/// `V = −∫ force dq`.
#[derive(Clone, Debug)]
pub(crate) struct SplineSpring {
    pub(crate) coordinate: usize,
    pub(crate) force: Spline,
}

/// `V(L)`, `L` the sum of the lengths of the segments.
#[derive(Clone, Debug)]
pub(crate) struct PathSpring {
    pub(crate) segments: Vec<PointPair>,
    pub(crate) law: PathLaw,
}

/// The potential of a path of length `L`.
#[derive(Clone, Copy, Debug)]
pub(crate) enum PathLaw {
    /// `V = ½ k (L − rest)²`.
    Spring {
        stiffness: f64,
        rest_length: f64,
    },
    Stop(Stop),
}

/// `V = ½ k (Σ c_i q_i − rest)²`.
#[derive(Clone, Debug)]
pub(crate) struct LinearSpring {
    /// Coordinates `i` and their `c_i`.
    pub(crate) terms: Vec<(usize, f64)>,
    pub(crate) stiffness: f64,
    pub(crate) rest: f64,
}

/// `V = ½ k |log(rest⁻¹ R)|²` with the rotation `R` of a ball joint.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OrientationSpring {
    /// First of the three joints of the ball joint, in `dynamics`.
    pub(crate) joint: usize,
    /// First of its coordinates.
    pub(crate) coordinate: usize,
    pub(crate) stiffness: f64,
    /// The inverse of its rotation at rest.
    pub(crate) back: Mat3,
}

/// A force against the rate `s = Σ c_j v_j` of a sum of coordinates.
#[derive(Clone, Debug)]
pub(crate) struct LinearDamper {
    /// Coordinates `i` and their `c_i`.
    pub(crate) terms: Vec<(usize, f64)>,
    pub(crate) law: LinearLaw,
}

/// What it is.
#[derive(Clone, Copy, Debug)]
pub(crate) enum LinearLaw {
    /// `f_i = −d u c_i s`, `u` an input, or 1.
    Damper { damping: f64, input: Option<usize> },
    /// `f_i = −force c_i tanh(s / velocity)`.
    Friction { force: f64, velocity: f64 },
}

/// The one joint that moves points against each other, where no other does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mover {
    /// A hinge, a slide or a screw, by its coordinate.
    Axis(usize),
    /// A ball joint, by its orientation.
    Ball(usize),
}

/// The one that moves all points of a path.
pub(crate) fn mover(segments: &[PointPair]) -> Option<Mover> {
    in_common(segments, |ends| ends.mover)
}

/// A body, and another one above it or the world.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Span {
    /// The joint that carries the body.
    pub(crate) body: usize,
    /// The one that carries what is above, or `WORLD`.
    pub(crate) base: usize,
}

/// The one that all segments of a path are between whose lengths change.
pub(crate) fn span(segments: &[PointPair]) -> Option<Span> {
    in_common(segments, PointPair::span)
}

/// What is the same of all segments of a path whose lengths change.
fn in_common<T: PartialEq>(
    segments: &[PointPair],
    of: impl Fn(&PointPair) -> Option<T>,
) -> Option<T> {
    let mut all = segments.iter().filter(|ends| !ends.path.is_empty()).map(of);
    let first = all.next()??;
    all.all(|own| own.as_ref() == Some(&first)).then_some(first)
}

/// Two points and the joints that move one against the other.
#[derive(Clone, Debug)]
pub(crate) struct PointPair {
    pub(crate) a: Attachment,
    pub(crate) b: Attachment,
    /// Joints on the path between the points, ancestors before descendants. Joints that carry both
    /// points change neither their distance nor what else turns with both bodies, and drop out; but
    /// where a world axis is involved, those of them that turn come first.
    pub(crate) path: Vec<PathJoint>,
    /// The joint on the path, where there is one alone.
    pub(crate) mover: Option<Mover>,
}

impl PointPair {
    /// The end that all joints between the points carry, where the other one is fixed to the world or a body above.
    pub(crate) fn moving_end(&self) -> Option<(&Attachment, Carries)> {
        let [first, last] = [self.path.first()?, self.path.last()?];
        match first.carries {
            carries if carries != last.carries => None,
            Carries::A => Some((&self.a, Carries::A)),
            Carries::B => Some((&self.b, Carries::B)),
            Carries::Both => None,
        }
    }

    /// The two bodies, where one is above the other.
    pub(crate) fn span(&self) -> Option<Span> {
        let (end, carries) = self.moving_end()?;
        let base = if carries == Carries::A { &self.b } else { &self.a };
        Some(Span { body: end.joint, base: base.joint })
    }

    /// Coordinates of the joints between the points.
    pub(crate) fn coordinates(&self) -> impl Iterator<Item = usize> {
        self.path.iter().map(|joint| joint.coordinate)
    }
}

/// A joint on the path between two points.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PathJoint {
    pub(crate) joint: usize,
    pub(crate) coordinate: usize,
    pub(crate) carries: Carries,
}

/// Which of two points a joint carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Carries {
    A,
    B,
    Both,
}

/// One constraint equation.
#[derive(Clone, Debug)]
pub(crate) struct Constraint {
    pub(crate) kind: ConstraintKind,
    /// Coordinates that it depends on, but for a prescribed length; dynamic ones first.
    pub(crate) coordinates: Vec<usize>,
    /// How many of them are dynamic.
    pub(crate) dynamic: usize,
}

impl Constraint {
    /// Dynamic coordinates that the equation depends on.
    #[inline(always)]
    pub(crate) fn dynamic_coordinates(&self) -> &[usize] {
        &self.coordinates[..self.dynamic]
    }
}

/// What a constraint equation says; one file each in `constraints/equations`.
#[derive(Clone, Debug)]
pub(crate) enum ConstraintKind {
    Distance(PointDistance),
    Axis(AlongAxis),
    Product(Product),
    PathLength(PathLength),
    Coupling(Coupling),
}

/// `|d|² − length² = 0`.
#[derive(Clone, Debug)]
pub(crate) struct PointDistance {
    pub(crate) points: PointPair,
    pub(crate) length: Length,
}

/// `d · axis = 0`.
#[derive(Clone, Debug)]
pub(crate) struct AlongAxis {
    pub(crate) points: PointPair,
    /// A world axis.
    pub(crate) axis: usize,
    /// Axes of the equations after this one that are about the same points.
    pub(crate) others: Vec<usize>,
}

/// `Σ |d_s| − length = 0` over the segments of a path.
#[derive(Clone, Debug)]
pub(crate) struct PathLength {
    pub(crate) segments: Vec<PointPair>,
    pub(crate) length: Length,
}

/// `Σ_j Σ_k c_jk q_j^k + constant = 0`.
#[derive(Clone, Debug)]
pub(crate) struct Coupling {
    pub(crate) terms: Vec<Polynomial>,
    pub(crate) constant: f64,
}

/// A length.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Length {
    Fixed(f64),
    /// A prescribed coordinate.
    Driven(usize),
}

/// `u · w`, two vectors that belong to two points and the bodies that carry them; as an equation it is zero.
#[derive(Clone, Debug)]
pub(crate) struct Product {
    pub(crate) points: PointPair,
    pub(crate) u: Vector,
    pub(crate) w: Vector,
}

/// A vector that belongs to two points.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Vector {
    /// `a − b`.
    Difference,
    /// Fixed in the frame of the joint that carries `a`.
    WithA(Vec3),
    /// Fixed in the frame of the joint that carries `b`.
    WithB(Vec3),
}

/// `Σ_k c_k q^k`, powers from 1.
#[derive(Clone, Debug)]
pub(crate) struct Polynomial {
    pub(crate) coordinate: usize,
    pub(crate) coefficients: Vec<f64>,
}

/// Two frames that constraints keep aligned.
#[derive(Clone, Debug)]
pub(crate) struct Alignment {
    /// Name of the constraint.
    pub(crate) name: String,
    /// `x_a·x_b, y_a·y_b, z_a·z_b`.
    pub(crate) axes: [Product; 3],
}

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
    /// Where the momentum stands in `x`.
    pub fn momentum(&self) -> std::ops::Range<usize> {
        self.coordinates()..self.coordinates() + self.dynamic
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
    /// Lower and upper limit, m or rad, if the scene gives any; nothing enforces them.
    pub limits: Option<[f64; 2]>,
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
    /// Whether steps may go by vectors of the joints in space: where they generate the whole Newton matrix, and it is
    /// no tree in a plane, which is solved there.
    pub(crate) fn is_generated_in_space(&self) -> bool {
        self.planar.is_none() && self.is_generated()
    }

    /// Whether vectors of the joints generate the whole Newton matrix, but for [rows](Self::tied_rows) of ties.
    pub(crate) fn is_generated(&self) -> bool {
        self.acting.is_some() && self.joints_are_in_order()
    }

    /// Whether springs, armatures or forces may have entries in the Newton matrix where bodies have none.
    pub(crate) fn couples_more_than_bodies(&self) -> bool {
        self.potentials.couple_branches || self.forces.is_some()
    }

    /// Whether each dynamic coordinate has a joint that moves bodies, in their order. Prescribed ones may have none:
    /// lengths, and joints that carry nothing but points.
    fn joints_are_in_order(&self) -> bool {
        let coordinates = self.dynamics.joints.iter().map(|joint| joint.coordinate);
        let nd = self.dimensions.dynamic;
        coordinates.filter(|i| *i < nd).eq(0..nd)
    }

    /// The scene it was compiled from.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// What the scene has in it that is odd, and that it said to take all the same.
    pub fn warnings(&self) -> &[Problem] {
        &self.warnings
    }

    /// Sizes.
    pub fn dimensions(&self) -> Dimensions {
        self.dimensions
    }

    /// Coordinates: dynamic ones in depth-first order, then prescribed ones as listed.
    pub fn coordinates(&self) -> &[Coordinate] {
        &self.coordinates
    }

    /// Names of the constraint equations, in the order of the multipliers; for example `elbow.x`.
    pub fn constraint_names(&self) -> &[String] {
        &self.constraint_names
    }

    /// Operating points, first one `initial`: the initial configuration without input forces.
    pub fn operating_points(&self) -> &[OperatingPoint] {
        &self.operating_points
    }

    /// Equations that the scene's initial configuration violates by more than a millionth of the lengths
    /// involved: with any, that configuration is only a guess, and a plant has to start elsewhere.
    pub fn initial_violations(&self) -> &[Violation] {
        &self.initial_violations
    }

    /// First of the three coordinates of each orientation (ball joint): a rotation vector.
    pub fn orientations(&self) -> &[usize] {
        &self.orientations
    }

    /// Index of a coordinate.
    pub fn coordinate_index(&self, name: &str) -> Option<usize> {
        self.coordinates.iter().position(|c| c.name == name)
    }

    /// A hash of everything that the motion depends on; equal for equal scenes.
    pub fn digest(&self) -> u64 {
        self.digest
    }

    /// Entries of `u` that signals replace.
    pub(crate) fn replaced_inputs(&self) -> impl Iterator<Item = usize> {
        self.signals.iter().filter_map(|signal| match signal.target {
            Target::Input(_) => None,
            Target::Prescribed(k) => Some(self.dimensions.inputs + k),
        })
    }

    /// Dynamic coordinates and the inputs that act on them: inputs on coordinates, then inputs of
    /// forces, in the order of [`Forces::for_each_input_derivative`]; some come more than once. What acts on
    /// one axis of a ball joint changes the rows of all three.
    pub(crate) fn input_pattern(&self) -> impl Iterator<Item = (usize, usize)> {
        let dynamic = self.dimensions.dynamic;
        let on_coordinates = self.coordinate_inputs.iter().map(|i| (i.coordinate, i.input));
        let wrenches = self.forces.iter().flat_map(|forces| &forces.wrenches);
        let of_forces = wrenches.flat_map(move |wrench| {
            wrench.inputs.iter().flat_map(move |&(input, _)| {
                wrench.path.iter().map(move |&j| (self.dynamics.joints[j].coordinate, input))
            })
        });
        let along_paths = self.forces.iter().flat_map(|forces| &forces.path_forces);
        let of_paths = along_paths.flat_map(|path| {
            path.inputs.iter().flat_map(|&(input, _)| {
                let coordinates = path.segments.iter().flat_map(PointPair::coordinates);
                coordinates.map(move |coordinate| (coordinate, input))
            })
        });
        let of_forces =
            of_forces.chain(of_paths).filter(move |(coordinate, _)| *coordinate < dynamic);
        on_coordinates.chain(of_forces).flat_map(|(coordinate, input)| {
            let rows = match ball_of(&self.orientations, coordinate) {
                Some(first) => first..first + 3,
                None => coordinate..coordinate + 1,
            };
            rows.map(move |row| (row, input))
        })
    }

    /// Equations of constraints that are independent at the scene's initial configuration.
    pub(crate) fn constraint_rank(&self) -> usize {
        self.conditioning.independent.len()
    }

    pub(crate) fn take_loops(&mut self, loops: Loops) {
        self.loops = Some(loops);
        self.solver = Solver::Loops;
    }
}
