//! From scene to model: names resolved, fixed joints merged, bodies lumped, what is not needed
//! dropped.

use std::collections::{BTreeMap, BTreeSet};

use plantd_math::elimination::SymbolicElimination;
use plantd_math::hash::fnv1a;
use plantd_math::rotation::Quaternion;
use plantd_math::spatial::{Mat3, Sym3, Vec3};
use plantd_math::trigonometry::sin_cos_of;
use plantd_scene as scene;
use plantd_scene::{CoordinateKind, Motion, Problem, Scene, SceneError};

use crate::compile::pattern::{couplings, joint_pairs};
use crate::compile::{inertia, pattern, settling};
use crate::model::conditioning::Conditioning;
use crate::model::mechanism::{
    Alignment, AlongAxis, Armatures, Carries, Constraint, ConstraintKind, Coordinate, Coupling,
    Dimensions, Forces, Length, Model, Mover, OperatingPoint, PathJoint, PathLength, PointDistance,
    PointPair, Polynomial, Product, Solver, SumArmature, Vector,
};
use crate::model::planar_tree::{crooked, planar};
use crate::model::site::Site;
use crate::model::tree::{Attachment, Body, Joint, JointKind, Rotational, Tree, WORLD};

impl Model {
    /// Compiles a scene. All errors of the scene are reported at once.
    ///
    /// ```
    /// use plantd_models::{Model, Scene};
    ///
    /// let text = r#"
    ///     format = 1
    ///     name = "swing"
    ///     gravity = [0.0, 0.0, -9.8]
    ///
    ///     [[frames]]
    ///     name = "arm"
    ///     joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
    ///     body = { mass = 1.0, center_of_mass = [0.0, 0.0, -0.5] }
    /// "#;
    /// let mut scene = Scene::from_toml(text)?;
    /// let model = Model::compile(&scene)?;
    /// assert_eq!(model.coordinates()[0].name, "arm");
    /// assert_eq!(model.dimensions().state(), 2);
    ///
    /// scene.frames[0].parent = "ceiling".to_owned();
    /// let error = Model::compile(&scene).unwrap_err();
    /// assert_eq!(error.to_string(), "frames[0].parent: there is no frame `ceiling`; there is `arm`");
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn compile(scene: &Scene) -> Result<Self, SceneError> {
        let problems = scene.validate();
        if !problems.is_empty() {
            return Err(SceneError { problems });
        }
        let [problems, warnings] = inertia::judge(scene);
        if !problems.is_empty() {
            return Err(SceneError { problems });
        }
        let mut model = compile(scene);
        if let Some(stated) = settling::stated(scene, &model) {
            model = Self { scene: scene.clone(), digest: digest(scene), ..compile(&stated) };
        }
        model.warnings = warnings;
        match model.always_singular() {
            None => Ok(model),
            Some(coordinate) => {
                let moves = |frame: &scene::Frame| {
                    frame.motions().iter().any(|(name, _)| name == coordinate)
                };
                let frame = scene.frames.iter().position(moves).unwrap_or_default();
                let path = format!("frames[{frame}].joint");
                let message = format!(
                    "nothing resists coordinate `{coordinate}` in any configuration: no inertia, spring or damping that other coordinates do not meet too"
                );
                Err(SceneError { problems: vec![Problem { path, message }] })
            }
        }
    }
}

/// Compiles a scene that has been validated.
fn compile(scene: &Scene) -> Model {
    assemble(scene, Layout::new(scene))
}

/// The model of a scene of which the layout is known.
fn assemble(scene: &Scene, layout: Layout) -> Model {
    let [dynamics, closure] = layout.needs(scene);
    let (dynamics, in_dynamics) = Tree::pruned(&layout.joints, &dynamics);
    let (closure, in_closure) = Tree::pruned(&layout.joints, &closure);
    let dynamic = layout.dynamic;

    let mut potentials = layout.potentials(scene, &dynamics, &in_dynamics);
    let armature = layout.armature(scene);
    potentials.any |= armature.entries().next().is_some();
    potentials.couple_branches |= !armature.sums.is_empty();
    let equations = layout.equations(scene, &closure, &in_closure);

    let forces = layout.forces(scene, &dynamics, &in_dynamics);
    let couplings = couplings(dynamic, &dynamics, &potentials, &armature, forces.as_ref());
    let elimination = SymbolicElimination::new(&couplings);
    let (pairs, mixed_pairs) = joint_pairs(dynamic, &dynamics, &elimination);

    let damping = layout.damping(scene);
    let gravity = Vec3(scene.gravity.unwrap_or_default());
    let gravity = (gravity != Vec3::ZERO).then_some(gravity);
    let needs_poses = forces.as_ref().is_some_and(Forces::need_poses) || potentials.couple_branches;
    let dimensions = Dimensions {
        dynamic,
        prescribed: layout.coordinates.len() - dynamic,
        inputs: scene.inputs.len(),
        constraints: equations.constraints.len(),
    };
    // Generators in planes know no coordinates that are prescribed, those in space do: a chain of 16 that hangs from a
    // joint that is moved takes 0.75 of the time, one of 64 a quarter.
    let Dimensions { prescribed, constraints, .. } = dimensions;
    let goes_to_space =
        needs_poses || (prescribed > 0 && Solver::is_deep(&elimination, 0, constraints));
    let planar = if goes_to_space { None } else { planar(&dynamics, gravity) };
    let mut model = Model {
        acting: None,
        has_ties: false,
        tied_rows: 0,
        impulses: 0,
        foresees_elements: false,
        conditioning: Conditioning::default(),
        initial_violations: Vec::new(),
        dimensions,
        operating_points: layout.operating_points(scene),
        digest: digest(scene),
        solver: Solver::Tree,
        planar,
        straightened: layout.straightened,
        loops: None,
        held: None,
        gravity,
        damping,
        coordinate_inputs: layout.coordinate_inputs(scene),
        forces,
        signals: layout.signals(scene),
        potentials,
        armature,
        constraints: equations.constraints,
        constraint_names: equations.names,
        alignments: equations.alignments,
        dynamics,
        closure,
        elimination,
        pairs,
        mixed_pairs,
        coordinates: layout.coordinates,
        orientations: layout.orientations,
        scene: scene.clone(),
        warnings: Vec::new(),
    };
    model.impulses = model.input_pattern().count();
    model.find_elements();
    model.foresees_elements = dimensions.constraints == 0
        && model.is_generated_in_space()
        && (!model.has_simple_elements() || !model.orientations.is_empty());
    model.solver = Solver::of(&model);
    model.initial_violations = model.violations_at_start();
    model.conditioning = Conditioning::new(&model);
    model.find_loops();
    model.find_held();
    pattern::check(&model);
    model
}

/// The site at a point of a frame of a scene that compiles.
pub(crate) fn site(scene: &Scene, frame: &str, at: [f64; 3]) -> Option<Site> {
    let layout = Layout::new(scene);
    let placement = layout.frames.get(frame)?;
    let mut joints = Vec::new();
    let mut index = placement.joint;
    while let Some(joint) = layout.joints.get(index) {
        joints.push(joint.clone());
        index = joint.parent;
    }
    joints.reverse();
    let point = layout.fixed(frame, at).point;
    Some(Site { joints, rotation: placement.rotation, point })
}

/// All joints of a scene that compiles, and its frames, in its order, as they are fixed to them.
pub(crate) fn frames(scene: &Scene) -> (Tree, Vec<(String, Placement)>) {
    let layout = Layout::new(scene);
    let (tree, _) = Tree::pruned(&layout.joints, &vec![true; layout.joints.len()]);
    let frames = scene.frames.iter().map(|f| (f.name.clone(), layout.frames[&f.name])).collect();
    (tree, frames)
}

pub(super) fn settings<'a>(scene: &'a Scene, name: &str) -> Option<&'a scene::Coordinate> {
    scene.coordinates.iter().find(|c| c.name == name)
}

/// The coordinate's own, unless a signal drives it.
fn initial(scene: &Scene, name: &str) -> f64 {
    let is_input = scene.inputs.iter().any(|input| input.name == name);
    let signal = scene.signals.iter().find(|signal| signal.drives() == name && !is_input);
    match signal {
        Some(signal) => scene::TimeFunction::new(signal).at(0.0),
        None => settings(scene, name).map_or(0.0, |c| c.initial),
    }
}

/// Where a frame is: fixed in the frame of a joint (or the world).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Placement {
    pub(crate) joint: usize,
    pub(crate) rotation: Mat3,
    pub(crate) translation: Vec3,
}

impl Placement {
    /// At the frame itself.
    pub(crate) const HERE: Self =
        Self { joint: WORLD, rotation: Mat3::IDENTITY, translation: Vec3::ZERO };
}

/// The scene with its names resolved.
#[derive(Default)]
pub(crate) struct Layout {
    pub(crate) joints: Vec<Joint>,
    pub(crate) frames: BTreeMap<String, Placement>,
    pub(crate) coordinates: Vec<Coordinate>,
    pub(crate) dynamic: usize,
    pub(crate) index: BTreeMap<String, usize>,
    pub(crate) inputs: BTreeMap<String, usize>,
    /// First coordinate of each orientation.
    pub(crate) orientations: Vec<usize>,
    /// How many axes were turned into the planes of their trees, and the largest angle.
    straightened: (usize, f64),
}

impl Layout {
    /// Axes that are off the plane of their tree by no more than [`PARALLEL`](crate::model::planar_tree::PARALLEL)
    /// are turned into it, where that makes the whole scene one in planes.
    pub(super) fn new(scene: &Scene) -> Self {
        let written = Self::with_axes(scene, &[]);
        let [dynamics, _] = written.needs(scene);
        let (tree, places) = Tree::pruned(&written.joints, &dynamics);
        let crooked = crooked(&tree);
        if crooked.is_empty() {
            return written;
        }
        let axis = |place: &usize| crooked.iter().find(|c| c.joint == *place).map(|c| c.axis);
        let axes: Vec<Option<Vec3>> = places.iter().map(axis).collect();
        let most = crooked.iter().map(|c| c.off).fold(0.0, f64::max);
        Self { straightened: (crooked.len(), most), ..Self::with_axes(scene, &axes) }
    }

    /// With other axes of some joints, in the frames of the joints as they are written.
    fn with_axes(scene: &Scene, axes: &[Option<Vec3>]) -> Self {
        let mut children: BTreeMap<&str, Vec<&scene::Frame>> = BTreeMap::new();
        for frame in &scene.frames {
            children.entry(&frame.parent).or_default().push(frame);
        }
        let frames = BTreeMap::from([("world".to_owned(), Placement::HERE)]);
        let inputs = scene.inputs.iter().enumerate().map(|(i, input)| (input.name.clone(), i));
        let mut layout = Self { frames, inputs: inputs.collect(), ..Self::default() };
        let mut names = Vec::new();
        let mut stack: Vec<&scene::Frame> =
            children.get("world").map(|c| c.iter().rev().copied().collect()).unwrap_or_default();
        while let Some(frame) = stack.pop() {
            layout.place(frame, &mut names, axes);
            stack.extend(children.get(frame.name.as_str()).into_iter().flatten().rev());
        }
        layout.number(scene, &names);
        layout.lump_subtrees();
        layout
    }

    /// Places one frame, whose parent is placed, and its body.
    fn place(&mut self, frame: &scene::Frame, names: &mut Vec<String>, axes: &[Option<Vec3>]) {
        let parent = self.frames[&frame.parent];
        let mut placement = Placement {
            joint: parent.joint,
            rotation: parent.rotation.times(&rotation(frame.rotation.as_ref())),
            translation: parent.translation + parent.rotation.apply(Vec3(frame.translation)),
        };
        for (name, motion) in frame.motions() {
            let (kind, mut turned) = joint(&motion);
            if let Some(Some(axis)) = axes.get(self.joints.len()) {
                turned = Mat3::with_z_along(turned.apply(*axis));
            }
            if motion == Motion::Ball(0) {
                self.orientations.push(usize::MAX);
            }
            let index = self.joints.len();
            self.joints.push(Joint {
                parent: placement.joint,
                root: if placement.joint == WORLD {
                    index
                } else {
                    self.joints[placement.joint].root
                },
                kind,
                rotation: placement.rotation.times(&turned),
                translation: placement.translation,
                coordinate: usize::MAX,
                orientation: self.orientations.len().wrapping_sub(1),
                body: Body::default(),
                subtree_mass: 0.0,
                anchor: false,
            });
            names.push(name);
            placement =
                Placement { joint: index, rotation: turned.transpose(), translation: Vec3::ZERO };
        }
        if let (Some(body), true) = (&frame.body, placement.joint != WORLD) {
            let joint = &mut self.joints[placement.joint];
            joint.body = lumped(&joint.body, &placed(body, &placement));
        }
        self.frames.insert(frame.name.clone(), placement);
    }

    /// Orders the coordinates: dynamic ones depth first, prescribed ones as listed.
    fn number(&mut self, scene: &Scene, joint_names: &[String]) {
        let kind = |name: &str| settings(scene, name).map_or(CoordinateKind::Dynamic, |c| c.kind);
        let is_dynamic = |name: &&String| kind(name) == CoordinateKind::Dynamic;
        let mut order: Vec<String> = joint_names.iter().filter(is_dynamic).cloned().collect();
        self.dynamic = order.len();
        let listed = scene.coordinates.iter().filter(|c| c.kind == CoordinateKind::Prescribed);
        order.extend(listed.map(|c| c.name.clone()));
        self.index = order.iter().cloned().enumerate().map(|(i, name)| (name, i)).collect();
        for (joint, name) in self.joints.iter_mut().zip(joint_names) {
            joint.coordinate = self.index[name];
            if joint.kind == JointKind::Ball(0) {
                self.orientations[joint.orientation] = joint.coordinate;
            }
        }
        self.coordinates = order
            .into_iter()
            .map(|name| {
                let joint = joint_names.iter().position(|n| *n == name);
                Coordinate {
                    kind: kind(&name),
                    is_angle: joint.is_some_and(|j| self.joints[j].kind != JointKind::Prismatic),
                    initial: initial(scene, &name),
                    limits: settings(scene, &name).and_then(|c| c.limits),
                    name,
                }
            })
            .collect();
    }

    fn lump_subtrees(&mut self) {
        for i in (0..self.joints.len()).rev() {
            self.joints[i].subtree_mass += self.joints[i].body.mass;
            let (mass, parent) = (self.joints[i].subtree_mass, self.joints[i].parent);
            if parent != WORLD {
                self.joints[parent].subtree_mass += mass;
            }
        }
    }

    pub(crate) fn attachment(&self, point: &scene::Point) -> Attachment {
        self.fixed(&point.frame, point.at)
    }

    /// A point fixed in a frame.
    pub(super) fn fixed(&self, frame: &str, at: [f64; 3]) -> Attachment {
        let frame = self.frames[frame];
        Attachment { joint: frame.joint, point: frame.translation + frame.rotation.apply(Vec3(at)) }
    }

    /// A direction fixed in a frame, in the frame of the joint that carries it.
    fn direction(&self, frame: &str, direction: Vec3) -> Vec3 {
        self.frames[frame].rotation.apply(direction)
    }

    /// Armatures of coordinates and of sums.
    fn armature(&self, scene: &Scene) -> Armatures {
        let mut own: BTreeMap<usize, f64> = BTreeMap::new();
        let mut sums = Vec::new();
        for coordinate in scene.coordinates.iter().filter(|c| c.armature > 0.0) {
            *own.entry(self.index[&coordinate.name]).or_default() += coordinate.armature;
        }
        for sum in scene.armatures.iter().filter(|sum| sum.armature > 0.0) {
            let (terms, inertia) = (self.linear(&sum.terms), sum.armature);
            match terms[..] {
                [(i, c)] => *own.entry(i).or_default() += inertia * c * c,
                _ => sums.push(SumArmature { terms, inertia }),
            }
        }
        Armatures { own: own.into_iter().collect(), sums }
    }

    /// Which joints the walks of the dynamics and of the constraints need: a joint is needed where it, or a joint below it, carries what the walk evaluates.
    fn needs(&self, scene: &Scene) -> [Vec<bool>; 2] {
        let has_body = |joint: &Joint| !matches!(joint.body.inertia, Rotational::None);
        let armature: BTreeSet<usize> = self.armature(scene).entries().map(|a| a.row).collect();
        let resists = |joint: &Joint| has_body(joint) || armature.contains(&joint.coordinate);
        let mut dynamics: Vec<bool> = self.joints.iter().map(resists).collect();
        let mut closure = vec![false; self.joints.len()];
        let mark = |needed: &mut Vec<bool>, frame: &str| {
            if let Some(needed) = needed.get_mut(self.frames[frame].joint) {
                *needed = true;
            }
        };
        for point in scene.springs.iter().flat_map(scene::Spring::points) {
            mark(&mut dynamics, &point.frame);
        }
        for spring in &scene.springs {
            if let scene::Spring::Orientation { frame, .. } = spring {
                mark(&mut dynamics, frame);
            }
        }
        for force in &scene.forces {
            force.points().iter().for_each(|point| mark(&mut dynamics, &point.frame));
        }
        for point in scene.inputs.iter().flat_map(|input| &input.points) {
            mark(&mut dynamics, &point.frame);
        }
        for constraint in &scene.constraints {
            let frames = constraint.frames();
            frames.into_iter().for_each(|frame| mark(&mut closure, frame));
        }
        for i in (0..self.joints.len()).rev() {
            let parent = self.joints[i].parent;
            if parent != WORLD {
                dynamics[parent] |= dynamics[i];
                closure[parent] |= closure[i];
            }
        }
        [dynamics, closure]
    }

    fn equations(&self, scene: &Scene, tree: &Tree, index: &[usize]) -> Equations {
        let places = Places { layout: self, tree, index };
        let mut equations = Equations { dynamic: self.dynamic, ..Equations::default() };
        for constraint in &scene.constraints {
            let name = constraint.name();
            match constraint {
                scene::Constraint::Distance { a, b, length, .. } => {
                    let points = places.between(self.attachment(a), self.attachment(b));
                    let length = self.length(length);
                    let kind = ConstraintKind::Distance(PointDistance { points, length });
                    equations.push(name.to_owned(), kind);
                }
                scene::Constraint::PointToPoint { a, b, axes, .. } => {
                    let points = places.between_in_world(self.attachment(a), self.attachment(b));
                    for (k, &axis) in axes.iter().enumerate() {
                        let axis = axis as usize;
                        let points = points.clone();
                        let others = axes[k + 1..].iter().map(|&axis| axis as usize).collect();
                        let kind = ConstraintKind::Axis(AlongAxis { points, axis, others });
                        equations.push(format!("{name}.{}", AXES[axis]), kind);
                    }
                }
                scene::Constraint::PointOnPlane { plane, point, .. } => {
                    let normal = self.direction(&plane.frame, Vec3(plane.normal));
                    let a = self.fixed(&plane.frame, plane.at);
                    let product = Product {
                        points: places.between(a, self.attachment(point)),
                        u: Vector::Difference,
                        w: Vector::WithA(normal),
                    };
                    equations.push(name.to_owned(), ConstraintKind::Product(product));
                }
                scene::Constraint::Orientation { a, b, .. } => {
                    equations.align(name, a, b, &places);
                }
                scene::Constraint::Weld { a, b, .. } => {
                    let points = places.between(self.fixed(a, [0.0; 3]), self.fixed(b, [0.0; 3]));
                    for (letter, axis) in AXES.iter().zip(Mat3::IDENTITY.0) {
                        let product = Product {
                            points: points.clone(),
                            u: Vector::Difference,
                            w: Vector::WithA(self.direction(a, axis)),
                        };
                        let kind = ConstraintKind::Product(product);
                        equations.push(format!("{name}.{letter}"), kind);
                    }
                    equations.align(name, a, b, &places);
                }
                scene::Constraint::Coupling { terms, constant, .. } => {
                    let terms = terms.iter().map(|term| Polynomial {
                        coordinate: self.index[&term.coordinate],
                        coefficients: term.coefficients.clone(),
                    });
                    let (terms, constant) = (terms.collect(), *constant);
                    let kind = ConstraintKind::Coupling(Coupling { terms, constant });
                    equations.push(name.to_owned(), kind);
                }
                scene::Constraint::PathLength { points, length, .. } => {
                    let (segments, length) = (places.segments(points), self.length(length));
                    let kind = ConstraintKind::PathLength(PathLength { segments, length });
                    equations.push(name.to_owned(), kind);
                }
            }
        }
        equations
    }

    fn length(&self, length: &scene::Length) -> Length {
        match length {
            scene::Length::Fixed(length) => Length::Fixed(*length),
            scene::Length::Coordinate(name) => Length::Driven(self.index[name]),
        }
    }

    fn operating_points(&self, scene: &Scene) -> Vec<OperatingPoint> {
        let initial: Vec<f64> = self.coordinates.iter().map(|c| c.initial).collect();
        let at = |name: &str, q: Vec<f64>, inputs: &BTreeMap<String, f64>| {
            let forces =
                scene.inputs.iter().map(|i| inputs.get(&i.name).copied().unwrap_or_default());
            let u = forces.chain(q[self.dynamic..].iter().copied()).collect();
            OperatingPoint { name: name.to_owned(), q, u }
        };
        let mut points = vec![at("initial", initial.clone(), &BTreeMap::new())];
        for point in &scene.operating_points {
            let mut q = initial.clone();
            for (name, value) in &point.coordinates {
                q[self.index[name]] = *value;
            }
            points.push(at(&point.name, q, &point.inputs));
        }
        points
    }
}

const AXES: [&str; 3] = ["x", "y", "z"];

/// Points of the scene in a pruned tree.
pub(crate) struct Places<'a> {
    pub(crate) layout: &'a Layout,
    pub(crate) tree: &'a Tree,
    /// From joints of the layout to those of the tree.
    pub(crate) index: &'a [usize],
}

impl Places<'_> {
    /// A point of the layout in the tree.
    pub(crate) fn resolve(&self, at: Attachment) -> Attachment {
        let joint = if at.joint == WORLD { WORLD } else { self.index[at.joint] };
        Attachment { joint, ..at }
    }

    /// Two points; joints that carry both drop out.
    pub(crate) fn between(&self, a: Attachment, b: Attachment) -> PointPair {
        let mut pair = self.between_in_world(a, b);
        pair.path.retain(|joint| joint.carries != Carries::Both);
        pair.mover = self.mover(&pair.path);
        pair
    }

    fn mover(&self, path: &[PathJoint]) -> Option<Mover> {
        let joint = &self.tree.joints[path.first()?.joint];
        let (mover, axes) = match joint.kind {
            JointKind::Ball(_) => (Mover::Ball(joint.orientation), 3),
            _ => (Mover::Axis(joint.coordinate), 1),
        };
        (path.len() == axes).then_some(mover)
    }

    /// Two points; joints that carry both drop out if they do not turn.
    fn between_in_world(&self, a: Attachment, b: Attachment) -> PointPair {
        let (a, b) = (self.resolve(a), self.resolve(b));
        let (path_a, path_b) = (self.tree.path(a.joint), self.tree.path(b.joint));
        let common = path_a.iter().zip(&path_b).take_while(|(x, y)| x == y).count();
        let entry = |carries| {
            let joints = &self.tree.joints;
            move |&joint: &usize| PathJoint { joint, coordinate: joints[joint].coordinate, carries }
        };
        let turns = |joint: &&usize| self.tree.joints[**joint].kind != JointKind::Prismatic;
        let path = path_a[..common]
            .iter()
            .filter(turns)
            .map(entry(Carries::Both))
            .chain(path_a[common..].iter().map(entry(Carries::A)))
            .chain(path_b[common..].iter().map(entry(Carries::B)))
            .collect();
        PointPair { a, b, path, mover: None }
    }

    /// The segments of a path from point to point.
    pub(crate) fn segments(&self, points: &[scene::Point]) -> Vec<PointPair> {
        let ends = points.windows(2);
        ends.map(|ends| {
            self.between(self.layout.attachment(&ends[0]), self.layout.attachment(&ends[1]))
        })
        .collect()
    }
}

/// The constraint equations so far.
#[derive(Default)]
struct Equations {
    dynamic: usize,
    constraints: Vec<Constraint>,
    names: Vec<String>,
    alignments: Vec<Alignment>,
}

impl Equations {
    fn push(&mut self, name: String, kind: ConstraintKind) {
        let mut seen = BTreeSet::new();
        let (mut coordinates, prescribed): (Vec<usize>, Vec<usize>) = kind
            .coordinates()
            .into_iter()
            .filter(|c| seen.insert(*c))
            .partition(|c| *c < self.dynamic);
        let dynamic = coordinates.len();
        coordinates.extend(prescribed);
        self.constraints.push(Constraint { kind, coordinates, dynamic });
        self.names.push(name);
    }

    /// `y_a·z_b`, `z_a·x_b`, `x_a·y_b`: what a small turn of frame `b` about x, y, z changes.
    fn align(&mut self, name: &str, a: &str, b: &str, places: &Places<'_>) {
        let layout = places.layout;
        let points = places.between(layout.fixed(a, [0.0; 3]), layout.fixed(b, [0.0; 3]));
        let product = |i: usize, j: usize| Product {
            points: points.clone(),
            u: Vector::WithA(layout.direction(a, Mat3::IDENTITY.0[i])),
            w: Vector::WithB(layout.direction(b, Mat3::IDENTITY.0[j])),
        };
        for (letter, (i, j)) in AXES.iter().zip([(1, 2), (2, 0), (0, 1)]) {
            self.push(format!("{name}.r{letter}"), ConstraintKind::Product(product(i, j)));
        }
        let axes = [0, 1, 2].map(|i| product(i, i));
        self.alignments.push(Alignment { name: name.to_owned(), axes });
    }
}

/// The joint of one motion, and the rotation that takes its axis to z.
fn joint(motion: &Motion) -> (JointKind, Mat3) {
    let turned = |axis: &[f64; 3]| {
        let axis = Vec3(*axis);
        Mat3::with_z_along(axis * (1.0 / axis.norm()))
    };
    match motion {
        Motion::Revolute(axis) => (JointKind::Revolute, turned(axis)),
        Motion::Prismatic(axis) => (JointKind::Prismatic, turned(axis)),
        Motion::Screw(axis, pitch) => (JointKind::Screw(*pitch), turned(axis)),
        Motion::Ball(axis) => (JointKind::Ball(*axis), Mat3::IDENTITY),
    }
}

pub(crate) fn rotation(rotation: Option<&scene::Rotation>) -> Mat3 {
    match rotation {
        None => Mat3::IDENTITY,
        Some(scene::Rotation::Matrix(rows)) => Mat3::from_rows(*rows),
        Some(scene::Rotation::Rpy([roll, pitch, yaw])) => {
            about(2, *yaw).times(&about(1, *pitch)).times(&about(0, *roll))
        }
        Some(scene::Rotation::Quaternion(q)) => {
            let norm = q.iter().map(|c| c * c).sum::<f64>().sqrt();
            Quaternion(q.map(|c| c / norm)).matrix()
        }
    }
}

/// A turn about an axis of the frame.
fn about(axis: usize, angle: f64) -> Mat3 {
    let (s, c) = sin_cos_of(angle);
    let (next, last) = ((axis + 1) % 3, (axis + 2) % 3);
    let mut columns = Mat3::IDENTITY.0;
    (columns[next].0[next], columns[next].0[last]) = (c, s);
    (columns[last].0[next], columns[last].0[last]) = (-s, c);
    Mat3(columns)
}

/// A body of the scene in the frame of the joint that carries it.
pub(crate) fn placed(body: &scene::Body, placement: &Placement) -> Body {
    let center = placement.translation + placement.rotation.apply(Vec3(body.center_of_mass));
    let inertia = match body.inertia[..] {
        [xx, yy, zz] => Sym3 { xx, yy, zz, ..Sym3::default() },
        [xx, yy, zz, xy, xz, yz] => Sym3 { xx, yy, zz, xy, xz, yz },
        _ => Sym3::default(),
    };
    let isotropic =
        inertia == Sym3 { xx: inertia.xx, yy: inertia.xx, zz: inertia.xx, ..Sym3::default() };
    let rotated = if isotropic { inertia } else { inertia.rotated(&placement.rotation) };
    Body { mass: body.mass, center, inertia: classified(body.mass, rotated) }
}

/// Two bodies in one frame as one.
fn lumped(a: &Body, b: &Body) -> Body {
    if matches!(a.inertia, Rotational::None) {
        return *b;
    }
    if matches!(b.inertia, Rotational::None) {
        return *a;
    }
    let mass = a.mass + b.mass;
    let center = if mass > 0.0 {
        (a.center * a.mass + b.center * b.mass) * (1.0 / mass)
    } else {
        Vec3::ZERO
    };
    let about_center =
        |body: &Body| full(&body.inertia).add(&Sym3::of_point(body.mass, body.center - center));
    Body { mass, center, inertia: classified(mass, about_center(a).add(&about_center(b))) }
}

pub(crate) fn full(inertia: &Rotational) -> Sym3 {
    match *inertia {
        Rotational::None | Rotational::Point => Sym3::default(),
        Rotational::Isotropic(i) => Sym3 { xx: i, yy: i, zz: i, ..Sym3::default() },
        Rotational::Full(tensor) => tensor,
    }
}

fn classified(mass: f64, tensor: Sym3) -> Rotational {
    if tensor == Sym3::default() {
        if mass == 0.0 { Rotational::None } else { Rotational::Point }
    } else if tensor == full(&Rotational::Isotropic(tensor.xx)) {
        Rotational::Isotropic(tensor.xx)
    } else {
        Rotational::Full(tensor)
    }
}

/// FNV-1a over the scene without what does not move it.
fn digest(scene: &Scene) -> u64 {
    let mut essence =
        Scene { description: String::new(), operating_points: Vec::new(), ..scene.clone() };
    essence.frames.iter_mut().for_each(|frame| frame.visuals.clear());
    let text = serde_json::to_string(&essence).unwrap_or_default();
    fnv1a(text.as_bytes())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::integrator::settings::Settings;
    use crate::model::mechanism::Solver;
    use crate::plant::facade::Plant;
    use plantd_scene::builtin;

    /// A chain of which every second axis is tilted.
    fn tilted(tilt: f64) -> Scene {
        let mut scene = builtin::scene("chain-8").unwrap();
        for (i, frame) in scene.frames.iter_mut().enumerate().filter(|(i, _)| i % 2 == 1) {
            let Some(scene::Joint::Revolute { axis, .. }) = &mut frame.joint else { panic!() };
            *axis = if i % 4 == 1 { [tilt, 1.0, 0.5 * tilt] } else { [0.0, -1.0, tilt] };
        }
        scene
    }

    fn motion(model: Model) -> Vec<f64> {
        let model = Arc::new(model);
        let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
        let u = vec![0.1; model.dimensions.input()];
        for _ in 0..50 {
            plant.step(&u).unwrap();
        }
        [plant.q(), plant.p()].concat()
    }

    /// As it is written, and by the equations in space.
    fn in_space(scene: &Scene) -> Model {
        let mut model = assemble(scene, Layout::with_axes(scene, &[]));
        if model.planar.take().is_some() {
            model.solver = Solver::Spatial;
        }
        model
    }

    #[test]
    fn nearly_parallel_axes_are_parallel() {
        for tilt in [1e-13, 1e-9, 5e-9] {
            let scene = tilted(tilt);
            let model = Model::compile(&scene).unwrap();
            let (axes, most) = model.straightened;
            assert!(model.planar.is_some() && axes == 4 && most <= 1.2 * tilt, "{axes} {most}");
            let plan = model.plan();
            assert!(plan.contains("axes          4 of them turned by up to"), "{plan}");
            let [flat, space] = [motion(model), motion(in_space(&scene))];
            let largest = space.iter().fold(0.0_f64, |most, x| most.max(x.abs()));
            for (a, b) in flat.iter().zip(&space) {
                assert!((a - b).abs() <= (tilt + 1e-12) * largest, "{tilt}: {a} {b}");
            }
        }
    }

    #[test]
    fn axes_are_turned_no_farther_than_stated() {
        // The last is a right angle of imported robots with four digits.
        for tilt in [1.2e-8, 1e-6, 3.7e-6] {
            let model = Model::compile(&tilted(tilt)).unwrap();
            assert!(model.planar.is_none() && model.straightened == (0, 0.0), "{tilt}");
            assert!(!model.plan().contains("turned by"));
        }
        let exact = Model::compile(&tilted(0.0)).unwrap();
        assert!(exact.planar.is_some() && exact.straightened == (0, 0.0));
        // One axis that is tilted keeps all others as they are written.
        let mut scene = tilted(1e-9);
        let Some(scene::Joint::Revolute { axis, .. }) = &mut scene.frames[6].joint else {
            panic!()
        };
        *axis = [1e-6, 1.0, 0.0];
        assert_eq!(Model::compile(&scene).unwrap().straightened, (0, 0.0));
    }

    /// What is fixed to a joint stays where it is; only the axis is another.
    #[test]
    fn slides_are_turned_into_the_plane() {
        let mut scene = builtin::scene("cart-pole").unwrap();
        let slide = scene.frames.iter_mut().find_map(|frame| match &mut frame.joint {
            Some(scene::Joint::Prismatic { axis, .. }) => Some(axis),
            _ => None,
        });
        *slide.unwrap() = [1.0, 0.0, 3e-9];
        let model = Model::compile(&scene).unwrap();
        assert!(model.planar.is_some() && model.straightened.0 == 1, "{:?}", model.straightened);
        let [flat, space] = [motion(model), motion(in_space(&scene))];
        for (a, b) in flat.iter().zip(&space) {
            assert!((a - b).abs() <= 3e-9 * b.abs().max(1.0), "{a} {b}");
        }
    }
}
