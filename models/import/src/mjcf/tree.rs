//! Bodies of an MJCF with what they carry, frames and replications unfolded.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Matrix3, Translation3, Unit, UnitQuaternion, Vector3};
use plantd_models::scene::{MAX_FRAMES, Rotation, Visual};
use roxmltree::Node;

use crate::document::Reader;
use crate::inertia::Inertia;
use crate::mjcf::assets::Meshes;
use crate::mjcf::classes::{Classes, MAIN, Settings};
use crate::mjcf::settings::{Compiler, Compilers, FromGeoms};
use crate::source::Files;

/// Geoms, sites and copies of replications that are made at most.
const ITEMS_MAX: usize = 1 << 17;

/// All that a model is made of; parents come before children, in the order of the file.
#[derive(Default)]
pub(super) struct Tree<'a> {
    pub(super) bodies: Vec<Body<'a>>,
    pub(super) joints: Vec<Joint<'a>>,
    pub(super) sites: Vec<Site>,
    /// Geoms that touch others, and the first of them.
    pub(super) touching: Option<(Node<'a, 'a>, usize)>,
    /// Bodies, joints and sites by name.
    names: [BTreeMap<String, usize>; 3],
    /// What replications append to names, in the order of the copies.
    copied: [BTreeMap<&'a str, Vec<String>>; 3],
}

pub(super) struct Body<'a> {
    pub(super) node: Node<'a, 'a>,
    pub(super) name: String,
    /// None for the world.
    pub(super) parent: Option<usize>,
    /// In the parent, where all joints are at their references.
    pub(super) pose: Isometry3<f64>,
    pub(super) joints: Vec<usize>,
    pub(super) inertia: Option<Inertia>,
    /// Part of the weight that is taken off.
    pub(super) lift: f64,
    pub(super) is_mocap: bool,
    pub(super) visuals: Vec<Visual>,
    inertial: Option<Node<'a, 'a>>,
    /// Whether its geoms give its inertia, and what they give.
    pub(super) is_weighed: bool,
    pub(super) geoms: Vec<Inertia>,
    /// Those that are meshes.
    pub(super) meshed: Vec<Geom<'a>>,
    /// Where it stands in its parent's element.
    own: Isometry3<f64>,
}

/// A geom whose inertia is that of a mesh.
pub(super) struct Geom<'a> {
    pub(super) node: Node<'a, 'a>,
    /// None where it is a shape that MuJoCo fits to a mesh, or something else that is not known here.
    pub(super) mesh: Option<&'a str>,
    pub(super) pose: Isometry3<f64>,
    pub(super) mass: Option<f64>,
    pub(super) density: f64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum JointKind {
    Free,
    Ball,
    Slide,
    Hinge,
}

impl JointKind {
    /// Whether it moves about or along one axis.
    pub(super) fn is_single(self) -> bool {
        matches!(self, Self::Slide | Self::Hinge)
    }
}

pub(super) struct Joint<'a> {
    pub(super) node: Node<'a, 'a>,
    /// Empty if it has none.
    pub(super) name: String,
    pub(super) kind: JointKind,
    pub(super) body: usize,
    /// Anchor and axis in the body.
    pub(super) anchor: Vector3<f64>,
    pub(super) axis: Unit<Vector3<f64>>,
    /// Value in the configuration in which the model stands in the file.
    pub(super) reference: f64,
    /// Value at which its spring, and those of tendons, are at rest.
    pub(super) rest: f64,
    pub(super) limits: Option<[f64; 2]>,
    /// Of powers of the distance from rest, from 1; of damping those of `|v|`.
    pub(super) stiffness: [f64; 3],
    pub(super) damping: [f64; 3],
    /// Time constant and damping ratio, in place of these two.
    pub(super) spring_damper: Option<[f64; 2]>,
    pub(super) armature: f64,
    pub(super) friction: f64,
}

pub(super) struct Site {
    /// None for the world.
    pub(super) body: Option<usize>,
    pub(super) pose: Isometry3<f64>,
}

impl Tree<'_> {
    pub(super) fn body(&self, name: &str) -> Option<usize> {
        self.names[0].get(name).copied()
    }

    pub(super) fn joint(&self, name: &str) -> Option<usize> {
        self.names[1].get(name).copied()
    }

    pub(super) fn site(&self, name: &str) -> Option<&Site> {
        self.names[2].get(name).map(|site| &self.sites[*site])
    }

    /// What is appended to a name that copies have, and nothing else of their kind: of bodies, joints or sites.
    pub(super) fn endings(&self, kind: usize, name: &str) -> Option<&[String]> {
        let is_alone = self.names[kind].contains_key(name);
        let endings = self.copied[kind].get(name).filter(|_| !is_alone);
        endings.map(Vec::as_slice)
    }

    /// Whether a joint moves a body.
    pub(super) fn is_moved(&self, body: Option<usize>) -> bool {
        let up = |body: &usize| self.bodies[*body].parent;
        std::iter::successors(body, up).any(|body| !self.bodies[body].joints.is_empty())
    }

    /// Where bodies stand in the world while hinges and slides have given values and all other joints are where they
    /// are in the file.
    pub(super) fn poses(&self, value: impl Fn(&Joint<'_>) -> f64) -> Vec<Isometry3<f64>> {
        let mut poses: Vec<Isometry3<f64>> = Vec::new();
        for body in &self.bodies {
            let parent = body.parent.map_or_else(Isometry3::identity, |parent| poses[parent]);
            let joints = body.joints.iter().map(|j| &self.joints[*j]);
            poses.push(joints.fold(parent * body.pose, |pose, joint| {
                let by = value(joint) - joint.reference;
                pose * match joint.kind {
                    JointKind::Slide => Isometry3::from(Translation3::from(joint.axis.scale(by))),
                    JointKind::Hinge => {
                        let turn = UnitQuaternion::from_axis_angle(&joint.axis, by);
                        let anchor = Translation3::from(joint.anchor);
                        anchor * turn * anchor.inverse()
                    }
                    JointKind::Free | JointKind::Ball => Isometry3::identity(),
                }
            }));
        }
        poses
    }
}

/// Reads the bodies.
pub(super) fn read<'a>(
    reader: &mut Reader<'_>,
    root: Node<'a, 'a>,
    classes: &Classes<'a>,
    compilers: &Compilers,
    files: Option<&mut Files<'_>>,
) -> Tree<'a> {
    let meshes = Meshes::read(reader, root, classes, compilers);
    let mut walk = Walk { reader, classes, compilers, meshes, tree: Tree::default(), items: 0 };
    for world in root.children().filter(|node| node.has_tag_name("worldbody")) {
        let place =
            Place { body: None, class: MAIN, frame: Isometry3::identity(), ending: String::new() };
        walk.fill(world, &place);
    }
    walk.weigh_meshes(files);
    for body in 0..walk.tree.bodies.len() {
        walk.settle(body);
    }
    let mut tree = walk.tree;
    if let Some(total) = compilers.main().total_mass {
        let mass: f64 = tree.bodies.iter().filter_map(|body| body.inertia).map(|i| i.mass).sum();
        if mass > 0.0 {
            for inertia in tree.bodies.iter_mut().filter_map(|body| body.inertia.as_mut()) {
                inertia.mass *= total / mass;
                inertia.tensor *= total / mass;
            }
        }
    }
    tree
}

/// Where an element stands.
#[derive(Clone)]
pub(super) struct Place {
    pub(super) body: Option<usize>,
    pub(super) class: usize,
    /// In the body.
    pub(super) frame: Isometry3<f64>,
    /// What replications append to names.
    ending: String,
}

/// A walk over the bodies.
pub(super) struct Walk<'r, 'a, 'd> {
    pub(super) reader: &'r mut Reader<'d>,
    pub(super) classes: &'r Classes<'a>,
    pub(super) compilers: &'r Compilers,
    pub(super) meshes: Meshes<'a>,
    pub(super) tree: Tree<'a>,
    /// Geoms, sites and copies so far.
    pub(super) items: usize,
}

impl<'r, 'a> Walk<'r, 'a, '_> {
    /// How an element is meant.
    pub(super) fn compiler(&self, node: Node<'_, '_>) -> &'r Compiler {
        let compilers = self.compilers;
        compilers.of(self.reader, node)
    }

    /// Reads what is in a body, a frame or a replication.
    fn fill(&mut self, node: Node<'a, 'a>, place: &Place) {
        for child in node.children().filter(Node::is_element) {
            if self.is_full() {
                return;
            }
            let own;
            let mut place = place;
            if self.reader.model_of(child) != self.reader.model_of(node) {
                // What is attached has default classes of its own.
                self.reader.exact("attached model");
                own = Place { class: self.classes.root(self.reader, child), ..place.clone() };
                place = &own;
            }
            match (child.tag_name().name(), place.body) {
                ("inertial", Some(body)) => self.inertial(body, child),
                ("joint" | "freejoint", Some(body)) => self.joint(body, child, place),
                ("inertial" | "joint" | "freejoint", None) => {
                    self.reader.fail(child, "the world has no inertia and no joints");
                }
                ("geom", _) => self.geom(child, place),
                ("site", _) => self.site(child, place),
                ("frame", _) => {
                    let settings = Settings::alone(child);
                    let pose = self.compiler(child).pose(self.reader, &settings);
                    let class = self.class_in(child, place);
                    self.fill(child, &Place { class, frame: place.frame * pose, ..place.clone() });
                }
                ("replicate", _) => self.replicate(child, place),
                ("body", _) => self.body(child, place),
                _ => {}
            }
        }
    }

    fn is_full(&self) -> bool {
        self.items > ITEMS_MAX || self.tree.bodies.len() > MAX_FRAMES
    }

    fn class_in(&mut self, node: Node<'a, 'a>, place: &Place) -> usize {
        self.classes.named(self.reader, node, "childclass").unwrap_or(place.class)
    }

    fn replicate(&mut self, node: Node<'a, 'a>, place: &Place) {
        let count = self.reader.number(node, "count");
        if !(count >= 1.0 && count.fract() == 0.0 && count <= MAX_FRAMES as f64) {
            let message = format!("`count` of `replicate` is {count}; must be 1 to {MAX_FRAMES}");
            return self.reader.fail(node, message);
        }
        let offset = Translation3::from(self.reader.vector_or(node, "offset", [0.0; 3]));
        let euler = self.reader.vector_or::<3>(node, "euler", [0.0; 3]);
        let separator = node.attribute("sep").unwrap_or_default();
        let class = self.class_in(node, place);
        let (digits, mut position) = (count.to_string().len(), Translation3::identity());
        for i in 0..count as usize {
            self.count(node);
            if self.is_full() {
                return;
            }
            let turn = self.compiler(node).euler(euler.map(|angle| angle * i as f64));
            let pose = position * turn;
            let ending = format!("{separator}{i:0digits$}{}", place.ending);
            let frame = place.frame * pose;
            self.fill(node, &Place { class, frame, ending, ..place.clone() });
            position = (pose * offset).translation;
        }
    }

    fn body(&mut self, node: Node<'a, 'a>, place: &Place) {
        let body = self.tree.bodies.len();
        if body == MAX_FRAMES {
            let message = format!("more than {MAX_FRAMES} bodies, the replicated ones counted");
            self.reader.fail(node, message);
        }
        let settings = Settings::alone(node);
        let own = self.compiler(node).pose(self.reader, &settings);
        let name = named(node.attribute("name").unwrap_or_default(), place);
        self.register(0, node, &name, body);
        self.tree.bodies.push(Body {
            node,
            name,
            parent: place.body,
            pose: place.frame * own,
            joints: Vec::new(),
            inertia: None,
            lift: self.reader.number_or(node, "gravcomp", 0.0),
            is_mocap: settings.is_true(self.reader, "mocap"),
            visuals: Vec::new(),
            inertial: None,
            is_weighed: match self.compiler(node).inertia_from_geoms {
                FromGeoms::Never => false,
                FromGeoms::Always => true,
                FromGeoms::Else => !has_inertial(node),
            },
            geoms: Vec::new(),
            meshed: Vec::new(),
            own,
        });
        let class = self.class_in(node, place);
        let frame = Isometry3::identity();
        self.fill(node, &Place { body: Some(body), class, frame, ending: place.ending.clone() });
        let Body { is_mocap, joints, parent, .. } = &self.tree.bodies[body];
        if *is_mocap && !(joints.is_empty() && parent.is_none()) {
            self.reader.fail(node, "a mocap body has no joints, and the world for a parent");
        }
    }

    fn inertial(&mut self, body: usize, node: Node<'a, 'a>) {
        if self.tree.bodies[body].inertial.replace(node).is_some() {
            self.reader.fail(node, "a second `inertial` in `body`; there may be one");
        }
    }

    /// Adds the inertias of meshes to those of their bodies. They are without effect where nothing moves, but for a
    /// mass that all bodies share.
    fn weigh_meshes(&mut self, mut files: Option<&mut Files<'_>>) {
        for body in 0..self.tree.bodies.len() {
            let meshed = std::mem::take(&mut self.tree.bodies[body].meshed);
            let counts =
                self.compilers.main().total_mass.is_some() || self.tree.is_moved(Some(body));
            for Geom { node, mesh, pose, mass, density } in meshed.into_iter().filter(|_| counts) {
                let Some(mesh) = mesh else {
                    let message = "the inertia of a shape that is fitted to a mesh, or of its shell: give its body an `inertial`";
                    self.reader.refuse(node, message);
                    continue;
                };
                // Lent anew for each.
                let lent = files.as_mut().map(|files| &mut **files as &mut Files<'_>);
                match self.meshes.solid(mesh, lent) {
                    Ok(solid) => {
                        let factor = mass.map_or(density, |mass| mass / solid.mass);
                        let own = Inertia {
                            mass: solid.mass * factor,
                            tensor: solid.tensor * factor,
                            ..solid
                        };
                        self.reader.exact("inertia from a mesh");
                        self.tree.bodies[body].geoms.push(own.at(&pose));
                    }
                    Err(why) => self.reader.refuse(node, why),
                }
            }
        }
    }

    /// The inertia of a body all of whose parts are known.
    fn settle(&mut self, body: usize) {
        let Body { inertial, geoms, node, own, .. } = &mut self.tree.bodies[body];
        let (inertial, geoms, node, own) = (*inertial, std::mem::take(geoms), *node, *own);
        let compiler = self.compiler(node);
        let inertia = if !geoms.is_empty() {
            self.reader.exact("inertia from shapes");
            Some(Inertia::sum(geoms.into_iter()))
        } else if let Some(node) = inertial {
            self.reader.exact("inertia as it is given");
            Some(self.given_inertia(node))
        } else if compiler.least != [0.0; 2] {
            // MuJoCo takes the body's own place in its parent for its centre of mass then.
            let center = own.translation.vector;
            Some(Inertia { mass: 0.0, center, tensor: Matrix3::zeros() })
        } else {
            None
        };
        let inertia = inertia.map(|inertia| compiler.bounded(inertia));
        if let Some(bad) = inertia.filter(|inertia| !inertia.is_possible()) {
            let message = format!(
                "no body has the inertia of `{}`: {:?} kg·m² violate a + b ≥ c; `balanceinertia` mends it",
                self.tree.bodies[body].name,
                bad.moments()
            );
            self.reader.refuse(inertial.unwrap_or(node), message);
        }
        self.tree.bodies[body].inertia = inertia;
    }

    fn given_inertia(&mut self, node: Node<'a, 'a>) -> Inertia {
        let settings = Settings::alone(node);
        self.reader.required(node, "pos");
        let pose = self.compiler(node).pose(self.reader, &settings);
        let mass = self.reader.number(node, "mass");
        if mass < 0.0 {
            self.reader.fail(node, format!("the mass is {mass} kg; must not be negative"));
        }
        let diagonal = settings.numbers::<3>(self.reader, "diaginertia");
        let full = settings.numbers::<6>(self.reader, "fullinertia");
        if full.is_some() && diagonal.is_some() {
            self.reader.fail(node, "`diaginertia` and `fullinertia`; one of them is allowed");
        }
        let tensor = match full {
            Some([xx, yy, zz, xy, xz, yz]) => Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz),
            None => Matrix3::from_diagonal(&diagonal.unwrap_or_default().into()),
        };
        Inertia { mass, center: Vector3::zeros(), tensor }.at(&pose)
    }

    /// Keeps a name, which may be there once among those of a kind.
    pub(super) fn register(&mut self, kind: usize, node: Node<'a, 'a>, name: &str, index: usize) {
        let is_new =
            name.is_empty() || self.tree.names[kind].insert(name.to_owned(), index).is_none();
        let own = node.attribute("name").filter(|own| *own != name);
        if let Some((own, ending)) = own.and_then(|own| Some((own, name.strip_prefix(own)?))) {
            self.tree.copied[kind].entry(own).or_default().push(ending.to_owned());
        }
        if !is_new {
            let kind = ["bodies", "joints", "sites"][kind];
            self.reader.fail(node, format!("there are two {kind} `{name}`"));
        }
    }

    /// Counts what is made, up to the most that may be.
    pub(super) fn count(&mut self, node: Node<'a, 'a>) {
        self.items += 1;
        if self.items == ITEMS_MAX {
            let message = format!(
                "more than {ITEMS_MAX} geoms, sites and copies, the replicated ones counted"
            );
            self.reader.fail(node, message);
        }
    }
}

/// Whether a body says what its inertia is, in a frame of it too.
fn has_inertial(body: Node<'_, '_>) -> bool {
    body.children().any(|child| {
        child.has_tag_name("inertial")
            || (["frame", "replicate"].iter().any(|name| child.has_tag_name(*name))
                && has_inertial(child))
    })
}

/// A name with what replications append.
pub(super) fn named(name: &str, place: &Place) -> String {
    if name.is_empty() { String::new() } else { format!("{name}{}", place.ending) }
}

/// An orientation as a scene writes it.
pub(super) fn rotation(turn: &UnitQuaternion<f64>) -> Option<Rotation> {
    let is_none = turn.imag().amax() < 1e-15;
    (!is_none).then(|| Rotation::Quaternion([turn.w, turn.i, turn.j, turn.k]))
}
