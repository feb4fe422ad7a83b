//! What a URDF says, with its references resolved.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Matrix3, Quaternion, Translation3, UnitQuaternion, Vector3};
use roxmltree::Node;

use plantd_models::scene::{MAX_FRAMES, Rotation};

use crate::document::Reader;
use crate::inertia::Inertia;
use crate::report::Kind;

/// A robot: a tree of links.
pub(super) struct Robot<'a> {
    pub(super) name: &'a str,
    pub(super) node: Node<'a, 'a>,
    pub(super) links: Vec<Link<'a>>,
    pub(super) joints: Vec<Joint<'a>>,
    /// The link that is no joint's child.
    pub(super) root: usize,
    /// Joints that leave each link, in the order of the file.
    pub(super) leaving: Vec<Vec<usize>>,
    /// Joints that a transmission or command interface names, with the factor of the input; in order.
    pub(super) actuated: Vec<(usize, f64)>,
}

pub(super) struct Link<'a> {
    pub(super) name: &'a str,
    pub(super) node: Node<'a, 'a>,
    pub(super) inertia: Option<Inertia>,
}

pub(super) struct Joint<'a> {
    pub(super) name: &'a str,
    pub(super) node: Node<'a, 'a>,
    pub(super) kind: JointKind,
    pub(super) parent: usize,
    pub(super) child: usize,
    pub(super) origin: Origin,
    /// As it stands there; its length is not zero.
    pub(super) axis: [f64; 3],
    pub(super) damping: f64,
    pub(super) friction: f64,
    /// Of position, m or rad.
    pub(super) limits: Option<[f64; 2]>,
    /// Greatest force or torque, N or N·m.
    pub(super) effort: Option<f64>,
    pub(super) mimic: Option<Mimic>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum JointKind {
    Fixed,
    Revolute,
    Prismatic,
    Planar,
    Spherical,
    Floating,
}

/// `q = multiplier · q_of + offset`.
pub(super) struct Mimic {
    pub(super) of: usize,
    pub(super) multiplier: f64,
    pub(super) offset: f64,
}

/// A pose as it is written.
#[derive(Clone, Copy, Default)]
pub(super) struct Origin {
    pub(super) xyz: [f64; 3],
    pub(super) rotation: Turn,
}

#[derive(Clone, Copy)]
pub(super) enum Turn {
    Rpy([f64; 3]),
    /// `[w, x, y, z]`, of unit length.
    Quaternion([f64; 4]),
}

impl Default for Turn {
    fn default() -> Self {
        Self::Rpy([0.0; 3])
    }
}

impl Origin {
    pub(super) fn pose(&self) -> Isometry3<f64> {
        let rotation = match self.rotation {
            Turn::Rpy([roll, pitch, yaw]) => UnitQuaternion::from_euler_angles(roll, pitch, yaw),
            Turn::Quaternion([w, x, y, z]) => {
                UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))
            }
        };
        Isometry3::from_parts(Translation3::from(Vector3::from(self.xyz)), rotation)
    }
}

/// How an origin is turned, as a scene writes it.
pub(super) fn rotation(origin: &Origin) -> Option<Rotation> {
    match origin.rotation {
        Turn::Rpy([0.0, 0.0, 0.0]) => None,
        Turn::Rpy(angles) => Some(Rotation::Rpy(angles)),
        Turn::Quaternion(quaternion) => Some(Rotation::Quaternion(quaternion)),
    }
}

/// Reads a robot. Where something fails, the result is good for finding more failures only.
pub(super) fn robot<'a>(reader: &mut Reader<'_>, node: Node<'a, 'a>) -> Robot<'a> {
    if !matches!(node.attribute("version"), None | Some("1.0" | "1.1" | "1.2")) {
        reader.fail(node, "`version` of `robot` must be 1.0, 1.1 or 1.2");
    }
    let (links, link_names) = links(reader, node);
    let (joints, joint_names) = joints(reader, node, &link_names);
    let mut robot = Robot {
        name: reader.required(node, "name"),
        node,
        leaving: vec![Vec::new(); links.len()],
        links,
        joints,
        root: 0,
        actuated: Vec::new(),
    };
    if !reader.has_failed() {
        find_tree(reader, &mut robot);
        find_cycles_of_mimics(reader, &robot);
        robot.actuated = actuated(reader, node, &joint_names);
    }
    robot
}

/// Elements of a name, with the places of their own names; the same twice is a problem.
fn named<'a>(
    reader: &mut Reader<'_>,
    node: Node<'a, 'a>,
    element: &str,
) -> (Vec<(&'a str, Node<'a, 'a>)>, BTreeMap<&'a str, usize>) {
    let (mut all, mut places) = (Vec::new(), BTreeMap::new());
    for child in node.children().filter(|child| child.has_tag_name(element)) {
        let name = reader.required(child, "name");
        if places.insert(name, all.len()).is_some() {
            reader.fail(child, format!("there are two {element}s `{name}`"));
        }
        all.push((name, child));
    }
    (all, places)
}

fn links<'a>(
    reader: &mut Reader<'_>,
    node: Node<'a, 'a>,
) -> (Vec<Link<'a>>, BTreeMap<&'a str, usize>) {
    let count = node.children().filter(|child| child.has_tag_name("link")).count();
    if count == 0 || count > MAX_FRAMES {
        reader.fail(node, format!("the robot has {count} links; must have 1 to {MAX_FRAMES}"));
        return Default::default();
    }
    let (all, places) = named(reader, node, "link");
    let mut links = Vec::new();
    for (name, node) in all {
        let inertial = reader.child(node, "inertial");
        let inertia = inertial.and_then(|inertial| inertia(reader, inertial));
        links.push(Link { name, node, inertia });
    }
    (links, places)
}

fn inertia<'a>(reader: &mut Reader<'_>, node: Node<'a, 'a>) -> Option<Inertia> {
    let pose = origin(reader, node).pose();
    let mass = match reader.child(node, "mass") {
        Some(mass) => reader.number(mass, "value"),
        None => {
            reader.fail(node, "`inertial` has no `mass`");
            0.0
        }
    };
    if mass < 0.0 {
        reader.fail(node, format!("the mass is {mass} kg; must not be negative"));
    }
    let tensor = match reader.child(node, "inertia") {
        Some(inertia) => {
            let [xx, yy, zz] = ["ixx", "iyy", "izz"].map(|name| reader.number(inertia, name));
            let mut product = |name| reader.number_or(inertia, name, 0.0);
            let [xy, xz, yz] = [product("ixy"), product("ixz"), product("iyz")];
            Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz)
        }
        None => {
            reader.note(Kind::Approximated, node, "`inertial` has no `inertia`: a point mass");
            Matrix3::zeros()
        }
    };
    reader.exact("mass, centre and inertia of a link");
    let own = Inertia { mass, center: Vector3::zeros(), tensor };
    (mass != 0.0 || tensor != Matrix3::zeros()).then(|| own.at(&pose))
}

/// The pose that an element has in what it belongs to.
pub(super) fn origin<'a>(reader: &mut Reader<'_>, node: Node<'a, 'a>) -> Origin {
    let Some(origin) = reader.child(node, "origin") else { return Origin::default() };
    let xyz = reader.vector_or(origin, "xyz", [0.0; 3]);
    let rpy = reader.vector_or(origin, "rpy", [0.0; 3]);
    let Some(text) = origin.attribute("quat_xyzw") else {
        return Origin { xyz, rotation: Turn::Rpy(rpy) };
    };
    if origin.has_attribute("rpy") {
        reader.fail(origin, "`origin` has `rpy` and `quat_xyzw`; one of them is allowed");
    }
    let quaternion: [f64; 4] = reader.numbers(origin, "quat_xyzw", text);
    let length = quaternion.iter().map(|x| x * x).sum::<f64>().sqrt();
    if !((length - 1.0).abs() < 1e-3) {
        reader.fail(origin, format!("`quat_xyzw` has length {length}; must be 1"));
        return Origin::default();
    }
    let [x, y, z, w] = quaternion.map(|x| x / length);
    Origin { xyz, rotation: Turn::Quaternion([w, x, y, z]) }
}

/// Joints, and where those of each name stand.
fn joints<'a>(
    reader: &mut Reader<'_>,
    node: Node<'a, 'a>,
    links: &BTreeMap<&str, usize>,
) -> (Vec<Joint<'a>>, BTreeMap<&'a str, usize>) {
    let (all, places) = named(reader, node, "joint");
    let mut joints = Vec::new();
    for (name, node) in all {
        let [parent, child] = ["parent", "child"].map(|end| {
            let Some(element) = reader.child(node, end) else {
                reader.fail(node, format!("joint `{name}` has no `{end}`"));
                return 0;
            };
            let link = reader.required(element, "link");
            links.get(link).copied().unwrap_or_else(|| {
                reader.fail(element, format!("there is no link `{link}`"));
                0
            })
        });
        joints.push(Joint { parent, child, ..joint(reader, name, node, &places) });
    }
    (joints, places)
}

fn joint<'a>(
    reader: &mut Reader<'_>,
    name: &'a str,
    node: Node<'a, 'a>,
    places: &BTreeMap<&str, usize>,
) -> Joint<'a> {
    let (kind, what) = match reader.required(node, "type") {
        "fixed" => (JointKind::Fixed, "fixed joint"),
        "revolute" => (JointKind::Revolute, "revolute joint"),
        "continuous" => (JointKind::Revolute, "continuous joint"),
        "prismatic" => (JointKind::Prismatic, "prismatic joint"),
        "planar" => (JointKind::Planar, "planar joint"),
        "spherical" => (JointKind::Spherical, "spherical joint"),
        "floating" => (JointKind::Floating, "floating joint"),
        other => {
            reader.fail(node, format!("joint `{name}` has type `{other}`; must be fixed, revolute, continuous, prismatic, planar, spherical or floating"));
            (JointKind::Fixed, "")
        }
    };
    reader.exact(what);
    let mut axis = [1.0, 0.0, 0.0];
    if let Some(element) = reader.child(node, "axis") {
        axis = reader.vector_or(element, "xyz", axis);
        if axis.iter().all(|x| x.abs() < 1e-9) && kind != JointKind::Fixed {
            reader.fail(element, format!("the axis of joint `{name}` has no direction"));
        }
    }
    let (mut damping, mut friction) = (0.0, 0.0);
    if let Some(dynamics) = reader.child(node, "dynamics") {
        [damping, friction] = ["damping", "friction"].map(|what| {
            let value = reader.number_or(dynamics, what, 0.0);
            if value < 0.0 {
                reader.fail(dynamics, format!("`{what}` is {value}; must not be negative"));
            }
            value
        });
    }
    let (mut limits, mut effort) = (None, None);
    if let Some(limit) = reader.child(node, "limit") {
        let range = ["lower", "upper"].map(|end| reader.number_or(limit, end, 0.0));
        if range[0] > range[1] {
            let [lower, upper] = range;
            reader.fail(limit, format!("`lower` is {lower}, `upper` {upper}; must not be less"));
        }
        let is_limited = range[0] < range[1] && what != "continuous joint";
        limits = is_limited.then_some(range);
        effort = Some(reader.number_or(limit, "effort", 0.0)).filter(|effort| *effort > 0.0);
    }
    let mimic = reader.child(node, "mimic").and_then(|mimic| {
        let of = reader.required(mimic, "joint");
        let multiplier = reader.number_or(mimic, "multiplier", 1.0);
        let offset = reader.number_or(mimic, "offset", 0.0);
        if kind == JointKind::Fixed {
            reader.note(
                Kind::NoEffect,
                mimic,
                "a fixed joint that mimics another: it does not move",
            );
            return None;
        }
        if !matches!(kind, JointKind::Revolute | JointKind::Prismatic) {
            reader.fail(mimic, format!("joint `{name}` mimics; must move about or along one axis"));
            return None;
        }
        let Some(&of) = places.get(of) else {
            reader.fail(mimic, format!("there is no joint `{of}`"));
            return None;
        };
        Some(Mimic { of, multiplier, offset })
    });
    let origin = origin(reader, node);
    Joint {
        name,
        node,
        kind,
        parent: 0,
        child: 0,
        origin,
        axis,
        damping,
        friction,
        limits,
        effort,
        mimic,
    }
}

/// Finds the root and the joints that leave each link; every link hangs from the root in one way.
fn find_tree(reader: &mut Reader<'_>, robot: &mut Robot<'_>) {
    let mut arriving = vec![None; robot.links.len()];
    for (j, &Joint { name, node, parent, child, .. }) in robot.joints.iter().enumerate() {
        if let Some(other) = arriving[child].replace(j) {
            let (link, other) = (robot.links[child].name, &robot.joints[other]);
            reader.fail(node, format!("link `{link}` is a child of joints `{}` and `{name}`; write a loop as a constraint of the scene", other.name));
        }
        robot.leaving[parent].push(j);
    }
    let mut roots = (0..robot.links.len()).filter(|link| arriving[*link].is_none());
    let Some(root) = roots.next() else {
        return reader.fail(robot.node, "every link is the child of a joint: they go in a circle");
    };
    for other in roots {
        let (a, b) = (robot.links[root].name, &robot.links[other]);
        reader.fail(
            b.node,
            format!("links `{a}` and `{}` are both no joint's child; one may be the root", b.name),
        );
    }
    robot.root = root;
    let (mut is_reached, mut open) = (vec![false; robot.links.len()], vec![root]);
    while let Some(link) = open.pop() {
        if !std::mem::replace(&mut is_reached[link], true) {
            open.extend(robot.leaving[link].iter().map(|j| robot.joints[*j].child));
        }
    }
    if !reader.has_failed()
        && let Some(link) = is_reached.iter().position(|reached| !reached)
    {
        let Link { name, node, .. } = robot.links[link];
        reader.fail(node, format!("link `{name}` hangs from itself: its joints go in a circle"));
    }
}

fn find_cycles_of_mimics(reader: &mut Reader<'_>, robot: &Robot<'_>) {
    // 0 not seen, otherwise the walk that has seen it.
    let mut seen = vec![0; robot.joints.len()];
    for start in 0..robot.joints.len() {
        let mut at = start;
        while seen[at] == 0 {
            seen[at] = start + 1;
            let Some(mimic) = &robot.joints[at].mimic else { break };
            let of = &robot.joints[mimic.of];
            if !matches!(of.kind, JointKind::Revolute | JointKind::Prismatic) {
                let (name, of) = (robot.joints[at].name, of.name);
                reader.fail(
                    robot.joints[at].node,
                    format!(
                        "joint `{name}` mimics `{of}`, which does not move about or along one axis"
                    ),
                );
                break;
            }
            at = mimic.of;
            if seen[at] == start + 1 {
                let Joint { name, node, .. } = &robot.joints[at];
                reader.fail(*node, format!("joint `{name}` mimics itself, over others"));
            }
        }
    }
}

/// Joints of transmissions and command interfaces.
fn actuated<'a>(
    reader: &mut Reader<'_>,
    robot: Node<'a, 'a>,
    joints: &BTreeMap<&str, usize>,
) -> Vec<(usize, f64)> {
    let mut actuated: Vec<(usize, f64)> = Vec::new();
    let mut add = |reader: &mut Reader<'_>, node: Node<'a, 'a>, gain: f64| {
        let name = reader.required(node, "name");
        let Some(&joint) = joints.get(name) else {
            return reader.note(Kind::NoEffect, node, "a drive of a joint that is not there");
        };
        if actuated.iter().all(|(other, _)| *other != joint) {
            actuated.push((joint, gain));
        }
    };
    for node in robot.children().filter(|node| node.has_tag_name("transmission")) {
        let kind = reader.child(node, "type").and_then(|kind| kind.text());
        let kind = kind.or(node.attribute("type")).unwrap_or_default().trim();
        if !kind.contains("SimpleTransmission") {
            let message = format!(
                "a transmission of type `{kind}`: each of its joints has an input of its own"
            );
            reader.note(Kind::Approximated, node, message);
        }
        let mut reductions = node.descendants().filter(|n| n.has_tag_name("mechanicalReduction"));
        let gain = match reductions.next() {
            Some(reduction) => {
                let text = reduction.text().unwrap_or_default();
                reader.numbers::<1>(reduction, "mechanicalReduction", text)[0]
            }
            None => 1.0,
        };
        if gain == 0.0 && !reader.has_failed() {
            reader.fail(node, "`mechanicalReduction` is 0; must have a value");
        }
        let is_joint = |child: &Node<'_, '_>| {
            ["joint", "flexJoint", "rollJoint"].iter().any(|name| child.has_tag_name(*name))
        };
        for joint in node.children().filter(is_joint) {
            add(reader, joint, gain);
            reader.exact("transmission");
        }
    }
    for control in robot.children().filter(|node| node.has_tag_name("ros2_control")) {
        for joint in control.children().filter(|child| child.has_tag_name("joint")) {
            if joint.children().any(|child| child.has_tag_name("command_interface")) {
                add(reader, joint, 1.0);
                reader.exact("joint with a command interface");
            }
        }
    }
    actuated
}
