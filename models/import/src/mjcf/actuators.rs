//! Actuators as inputs, servos and wrenches.

use nalgebra::Vector3;
use plantd_models::scene::{Component, Force, Input, InputTerm, LinearTerm, ScaledInput, Spring};
use roxmltree::Node;

use crate::document::Reader;
use crate::mjcf::build::Build;
use crate::mjcf::classes::{SWITCH, is_on};
use crate::mjcf::frames::frame_at;
use crate::mjcf::rope::Rope;
use crate::mjcf::rotors::TAKEN;
use crate::mjcf::tendons::{Course, Tendons, Term, linear};
use crate::report::Kind;

/// What an actuator acts on.
const TARGETS: [&str; 7] =
    ["joint", "jointinparent", "tendon", "site", "body", "slidersite", "cranksite"];

/// The force `gain u + constant − stiffness L − (damping + brake u) L̇` along a transmission of length `L`.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Law {
    gain: f64,
    constant: f64,
    stiffness: f64,
    damping: f64,
    brake: f64,
}

impl Law {
    const NONE: Self = Self { gain: 0.0, constant: 0.0, stiffness: 0.0, damping: 0.0, brake: 0.0 };

    /// Behind a gear that makes `L` of `gear` times a coordinate.
    fn geared(self, gear: f64) -> Self {
        let Self { gain, constant, stiffness, damping, brake } = self;
        Self {
            gain: gear * gain,
            constant: gear * constant,
            stiffness: gear * gear * stiffness,
            damping: gear * gear * damping,
            brake: gear * gear * brake,
        }
    }

    /// Whether it is a force in proportion to `u` alone.
    fn is_motor(&self) -> bool {
        [self.constant, self.stiffness, self.damping, self.brake] == [0.0; 4]
    }
}

/// What an element and the defaults of its class make of an actuator, taken one after the other.
#[derive(Clone, Debug)]
struct Actuator {
    gain: [f64; 10],
    bias: [f64; 10],
    /// Whether force is `gain u` with a constant gain or one that is in proportion to the velocity; whether what adds
    /// to it is none or affine.
    has_fixed_gain: bool,
    is_brake: bool,
    has_known_bias: bool,
    is_affine: bool,
    has_state: bool,
    gear: [f64; 6],
    control: Range,
    force: Range,
    /// Part of the range of what it acts on that its own has.
    inherits: f64,
    /// Why it cannot be taken over.
    refused: Option<&'static str>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Range {
    ends: [f64; 2],
    /// Its place in [`SWITCH`].
    switch: Option<usize>,
}

impl Range {
    fn take(&mut self, reader: &mut Reader<'_>, node: Node<'_, '_>, range: &str, switch: &str) {
        self.ends = reader.vector_or(node, range, self.ends);
        if let Some(text) = node.attribute(switch) {
            self.switch = Some(reader.keyword(node, switch, text, &SWITCH));
        }
    }

    fn limits(&self, by_range: bool) -> Option<[f64; 2]> {
        let counts = is_on(self.switch, by_range, self.ends);
        (counts && self.ends[0] < self.ends[1]).then_some(self.ends)
    }
}

/// The defaults that say what the force law of an actuator is. Of each class it is the last one alone, and it counts
/// for actuators of its kind; a `general` one has and gives laws of all kinds.
fn laws<'a>(node: Node<'a, 'a>, defaults: &[Node<'a, 'a>]) -> Vec<Node<'a, 'a>> {
    let kind = |node: &Node<'a, 'a>| node.tag_name().name();
    let after = defaults.iter().skip(1).map(Some).chain([None]);
    let is_last = |next: Option<&Node<'a, 'a>>, node: &Node<'a, 'a>| {
        next.is_none_or(|next| next.parent() != node.parent())
    };
    let mut last: Vec<_> = defaults
        .iter()
        .zip(after)
        .filter(|(node, next)| is_last(*next, node))
        .map(|(node, _)| *node)
        .collect();
    let own = match (kind(&node), last.last()) {
        ("general", Some(default)) => kind(default),
        (own, _) => own,
    };
    last.retain(|default| kind(default) == own || kind(default) == "general");
    last
}

fn first(value: f64) -> [f64; 10] {
    let mut all = [0.0; 10];
    all[0] = value;
    all
}

impl Default for Actuator {
    fn default() -> Self {
        Self {
            gain: first(1.0),
            bias: [0.0; 10],
            has_fixed_gain: true,
            is_brake: false,
            has_known_bias: true,
            is_affine: false,
            has_state: false,
            gear: [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            control: Range::default(),
            force: Range::default(),
            inherits: 0.0,
            refused: None,
        }
    }
}

impl Actuator {
    /// Takes what an element says for actuators of all kinds, one that acts or a default.
    fn take(&mut self, reader: &mut Reader<'_>, node: Node<'_, '_>) {
        self.control.take(reader, node, "ctrlrange", "ctrllimited");
        self.force.take(reader, node, "forcerange", "forcelimited");
        if let Some(text) = node.attribute("gear") {
            reader.first_numbers(node, "gear", text, &mut self.gear);
        }
        if reader.number_or(node, "delay", 0.0) != 0.0 {
            self.refused = Some("a `delay` belongs to the channel of the input");
        }
    }

    /// Takes the force law that an element says.
    fn take_law(&mut self, reader: &mut Reader<'_>, node: Node<'_, '_>) {
        for (name, values) in [("gainprm", &mut self.gain), ("biasprm", &mut self.bias)] {
            if let Some(text) = node.attribute(name) {
                reader.first_numbers(node, name, text, values);
            }
        }
        if let Some(kind) = node.attribute("gaintype") {
            self.is_brake = kind == "affine" && self.gain[1] == 0.0 && self.gain[2] <= 0.0;
            self.has_fixed_gain = kind == "fixed" || self.is_brake;
        }
        if let Some(kind) = node.attribute("biastype") {
            (self.has_known_bias, self.is_affine) =
                (matches!(kind, "none" | "affine"), kind == "affine");
        }
        if let Some(kind) = node.attribute("dyntype") {
            self.has_state = kind != "none";
        }
        let mut set = |name: &str, default: f64| reader.number_or(node, name, default);
        match node.tag_name().name() {
            "motor" => {
                self.gain[0] = 1.0;
                self.set_kind(false);
            }
            "position" => {
                let stiffness = set("kp", self.gain[0]);
                (self.gain[0], self.bias[1]) = (stiffness, -stiffness);
                if node.has_attribute("kv") {
                    self.bias[2] = -set("kv", 0.0);
                }
                if node.has_attribute("dampratio") {
                    self.bias[2] = set("dampratio", 0.0);
                }
                self.inherits = set("inheritrange", self.inherits);
                let filter = set("timeconst", 0.0);
                self.set_kind(true);
                self.has_state = filter != 0.0;
            }
            "velocity" => {
                let damping = set("kv", self.gain[0]);
                self.bias = [0.0; 10];
                (self.gain[0], self.bias[2]) = (damping, -damping);
                self.set_kind(true);
            }
            "damper" => {
                let before = if self.is_brake { -self.gain[2] } else { 0.0 };
                let brake = set("kv", before);
                if brake < 0.0 {
                    reader.fail(node, "`kv` of `damper` must not be negative");
                }
                (self.gain, self.bias) = ([0.0; 10], [0.0; 10]);
                self.gain[2] = -brake;
                self.set_kind(false);
                self.is_brake = true;
            }
            _ => {}
        }
    }

    fn set_kind(&mut self, is_affine: bool) {
        (self.has_fixed_gain, self.has_known_bias, self.has_state) = (true, true, false);
        self.is_brake = false;
        self.is_affine = is_affine;
    }
}

impl<'a> Build<'_, 'a, '_> {
    /// An input for each hinge and slide.
    pub(super) fn drive_all(&mut self) {
        let joints = self.tree.joints.iter().zip(&self.coordinates);
        for (_, coordinates) in joints.filter(|(joint, _)| joint.kind.is_single()) {
            let name = self.inputs.add(&format!("{}_drive", coordinates[0]), &[""]);
            let coordinate = Some(coordinates[0].clone());
            self.draft.scene.inputs.push(Input { name, coordinate, ..Input::default() });
        }
    }

    /// Inputs of the actuators in the order of the file; none for those that are left out.
    pub(super) fn actuate(&mut self, tendons: &Tendons<'a>) -> Vec<Option<String>> {
        if !self.physics.has("actuation") {
            let message = "`actuation` is switched off: there are no inputs";
            self.reader.note(Kind::NoEffect, self.root, message);
            return Vec::new();
        }
        let mut controls = Vec::new();
        for (node, ending) in self.elements("actuator") {
            self.ending = ending;
            let is_taken = TAKEN.contains(&node.tag_name().name());
            controls.push(if is_taken { self.add_actuator(node, tendons) } else { None });
        }
        self.ending.clear();
        self.draft.changed.append(&mut self.inputs.changed);
        controls
    }

    fn add_actuator(&mut self, node: Node<'a, 'a>, tendons: &Tendons<'a>) -> Option<String> {
        let class = self
            .classes
            .named(self.reader, node, "class")
            .unwrap_or_else(|| self.classes.root(self.reader, node));
        let mut actuator = Actuator::default();
        let defaults = self.classes.chain(class, |name| TAKEN.contains(&name));
        for default in &defaults {
            actuator.take(self.reader, *default);
        }
        actuator.take(self.reader, node);
        for default in laws(node, &defaults) {
            actuator.take_law(self.reader, default);
        }
        actuator.take_law(self.reader, node);
        let mut targets = TARGETS.iter().filter(|target| node.has_attribute(**target));
        let Some(target) = targets.next() else {
            self.reader
                .fail(node, "an actuator that acts on nothing; name a joint, tendon or site");
            return None;
        };
        let refusal = if actuator.has_state || !actuator.has_fixed_gain || !actuator.has_known_bias
        {
            Some(
                "an actuator with a state, or a force law other than gain · u + affine bias: write a `motor` and close its loop in the controller",
            )
        } else if targets.next().is_some() || node.has_attribute("refsite") {
            Some("an actuator between two sites: write the force as one of the scene")
        } else {
            actuator.refused
        };
        if let Some(why) = refusal {
            self.reader.refuse(node, why);
            return None;
        }
        match *target {
            "joint" | "jointinparent" => self.act_on_joint(node, target, actuator),
            "tendon" => {
                let found = |_: &Self, name: &str| {
                    tendons.named(name).map(|tendon| (&tendon.course, tendon.limits))
                };
                let (course, limits) = self.find(node, target, "tendon", found)?;
                match course.as_ref()? {
                    Course::Sum(terms) => self.act_on_sum(node, actuator, terms, limits),
                    Course::Path(rope) => self.act_along(node, &actuator, rope, limits),
                }
            }
            "site" => self.act_at_site(node, &actuator),
            _ => {
                self.reader.refuse(
                    node,
                    format!("an actuator on a `{target}`: it acts on joints, tendons and sites"),
                );
                None
            }
        }
    }

    fn act_on_joint(
        &mut self,
        node: Node<'a, 'a>,
        target: &str,
        actuator: Actuator,
    ) -> Option<String> {
        let j = self.find(node, target, "joint", |build, name| build.tree.joint(name))?;
        let joint = &self.tree.joints[j];
        let coordinates = self.coordinates[j].clone();
        if joint.kind.is_single() {
            let term = Term { joint: j, coordinate: coordinates[0].clone(), coefficient: 1.0 };
            return self.act_on_sum(node, actuator, &[term], joint.limits);
        }
        let law = self.law(node, &actuator, &[])?;
        if !law.is_motor() || target == "jointinparent" {
            let message =
                "on a joint with an orientation only a `motor` in the axes of the body acts";
            self.reader.refuse(node, message);
            return None;
        }
        // Gears are those of the joint's own velocities: a free joint has its slides first.
        let gears = coordinates.into_iter().zip(actuator.gear);
        let terms: Vec<_> = gears
            .filter(|(_, gear)| *gear != 0.0)
            .map(|(coordinate, gear)| InputTerm { coordinate, gain: gear * law.gain })
            .collect();
        if terms.is_empty() {
            return self.without_force(node);
        }
        Some(self.add_input(node, &actuator, Input { terms, ..Input::default() }, None))
    }

    fn act_on_sum(
        &mut self,
        node: Node<'a, 'a>,
        actuator: Actuator,
        terms: &[Term],
        limits: Option<[f64; 2]>,
    ) -> Option<String> {
        let law = self.law(node, &actuator, terms)?.geared(actuator.gear[0]);
        if law.brake > 0.0 {
            if law != (Law { brake: law.brake, ..Law::NONE }) {
                self.reader.refuse(node, "an actuator that drives and brakes: write one of each");
                return None;
            }
            let input = self.add_input(node, &actuator, Input::default(), limits);
            let damper = Force::LinearDamper {
                terms: linear(terms),
                damping: law.brake,
                input: Some(input.clone()),
            };
            self.draft.scene.forces.push(damper);
            return Some(input);
        }
        if law.is_motor() {
            let gain = |term: &Term| term.coefficient * law.gain;
            let input = match terms {
                [term] => Input {
                    coordinate: Some(term.coordinate.clone()),
                    gain: gain(term),
                    ..Input::default()
                },
                terms => {
                    let term = |term: &Term| InputTerm {
                        coordinate: term.coordinate.clone(),
                        gain: gain(term),
                    };
                    Input { terms: terms.iter().map(term).collect(), ..Input::default() }
                }
            };
            return Some(self.add_input(node, &actuator, input, limits));
        }
        if law.stiffness < 0.0 || law.damping < 0.0 {
            self.reader.refuse(node, "an actuator that pushes away from where it is");
            return None;
        }
        let input = self.add_input(node, &actuator, Input::default(), limits);
        let Law { gain, constant, stiffness, damping, .. } = law;
        let (coordinate, terms): (_, Vec<LinearTerm>) = match terms {
            [term] if term.coefficient == 1.0 => (Some(term.coordinate.clone()), Vec::new()),
            terms => (None, linear(terms)),
        };
        let name = input.clone();
        let servo = Force::Servo { coordinate, terms, input, gain, stiffness, damping, constant };
        self.draft.scene.forces.push(servo);
        Some(name)
    }

    /// Along a path: an input, with a spring and a damper where it is a servo.
    fn act_along(
        &mut self,
        node: Node<'a, 'a>,
        actuator: &Actuator,
        rope: &Rope,
        limits: Option<[f64; 2]>,
    ) -> Option<String> {
        // Along the path, which is so many times as long as the tendon.
        let law = self.law(node, actuator, &[])?.geared(actuator.gear[0] / rope.times);
        let Law { gain, constant, stiffness, damping, brake } = law;
        let rest_length =
            if stiffness == 0.0 { 0.0 } else { constant / stiffness + rope.path_length(0.0) };
        let is_spring = constant == 0.0 || stiffness > 0.0;
        if stiffness < 0.0 || damping < 0.0 || rest_length < 0.0 || !is_spring || brake != 0.0 {
            self.reader.refuse(
                node,
                "an actuator with a constant force, one that pushes away or one that brakes, along a path",
            );
            return None;
        }
        let input = Input { points: rope.points(), gain, ..Input::default() };
        let name = self.add_input(node, actuator, input, limits);
        if stiffness > 0.0 {
            let spring = Spring::Path { points: rope.points(), stiffness, rest_length };
            self.draft.scene.springs.push(spring);
        }
        if damping > 0.0 {
            let damper = Force::PathDamper { points: rope.points(), damping };
            self.draft.scene.forces.push(damper);
        }
        Some(name)
    }

    /// Gears are force and torque in the axes of the site.
    fn act_at_site(&mut self, node: Node<'a, 'a>, actuator: &Actuator) -> Option<String> {
        let found =
            |build: &Self, name: &str| build.tree.site(name).map(|site| (site.body, site.pose));
        let (body, pose) = self.find(node, "site", "site", found)?;
        let law = self.law(node, actuator, &[])?;
        if law.damping != 0.0 || law.constant != 0.0 || law.brake != 0.0 {
            self.reader.refuse(node, "at a site only a `motor` acts");
            return None;
        }
        if actuator.gear == [0.0; 6] || !self.tree.is_moved(body) {
            return self.without_force(node);
        }
        let name = self.add_input(node, actuator, Input::default(), None);
        let at = self.draft.frame(&format!("{name}_site"), frame_at(&self.frame(body), &pose));
        let component = |gear: f64| {
            let (input, gain) = (name.clone(), gear * law.gain);
            if gain == 0.0 {
                Component::default()
            } else {
                Component::Scaled(ScaledInput { input, gain })
            }
        };
        let [force, torque] = [0, 3].map(|from| {
            let gears: [f64; 3] = Vector3::from_column_slice(&actuator.gear[from..from + 3]).into();
            gears.map(component)
        });
        self.draft.scene.forces.push(Force::BodyWrench { frame: at, force, torque });
        Some(name)
    }

    fn without_force(&mut self, node: Node<'a, 'a>) -> Option<String> {
        self.reader.note(Kind::NoEffect, node, "an actuator that moves nothing");
        None
    }

    /// The law of an actuator; none if it never has a force. A damping ratio `ζ` means `2 ζ √(kp I)` with the inertia
    /// `I = 1 / (c M⁻¹ cᵀ)` of what it acts on, in the configuration of the file.
    fn law(&mut self, node: Node<'a, 'a>, actuator: &Actuator, terms: &[Term]) -> Option<Law> {
        let [constant, stiffness, mut damping] = match actuator.bias {
            [constant, by_length, by_rate, ..] if actuator.is_affine => {
                [constant, -by_length, -by_rate]
            }
            _ => [0.0; 3],
        };
        let gain = actuator.gain[0];
        let is_position = actuator.is_affine && gain == stiffness;
        if is_position && damping < 0.0 {
            let ratio = -damping;
            let Some(mobility) = self.mobility() else {
                let message = "`dampratio`: the mass matrix at the start is not positive definite";
                self.reader.fail(node, message);
                return None;
            };
            let gear = actuator.gear[0];
            let terms = terms.iter().map(|term| (&*term.coordinate, gear * term.coefficient));
            let inertia = mobility.along(terms).recip();
            damping = 2.0 * ratio * (gain * inertia).sqrt();
        }
        let brake = if actuator.is_brake { -actuator.gain[2] } else { 0.0 };
        if [gain, brake] == [0.0; 2] || actuator.gear == [0.0; 6] {
            return self.without_force(node).and(None);
        }
        Some(Law { gain, constant, stiffness, damping, brake })
    }

    /// Adds an input of an actuator's name and limits.
    fn add_input(
        &mut self,
        node: Node<'a, 'a>,
        actuator: &Actuator,
        input: Input,
        around: Option<[f64; 2]>,
    ) -> String {
        let default = format!("input_{}", self.draft.scene.inputs.len() + 1);
        let name = self.name_of(node, &default);
        let name = self.inputs.add(&name, &[""]);
        let by_range = self.compilers.of(self.reader, node).limits_by_range;
        let mut limits = actuator.control.limits(by_range);
        if let Some([low, high]) = around.filter(|_| actuator.inherits > 0.0) {
            let (middle, half) = ((low + high) / 2.0, (high - low) / 2.0 * actuator.inherits);
            limits = Some([middle - half, middle + half]);
        }
        if let Some(force) = actuator.force.limits(by_range) {
            let gain = actuator.gain[0];
            let as_control = [force[0] / gain, force[1] / gain];
            let [low, high] = if gain < 0.0 { [as_control[1], as_control[0]] } else { as_control };
            if actuator.is_affine || actuator.is_brake {
                let message =
                    format!("`forcerange` of actuator `{name}`: its force is not cut off");
                self.reader.note(Kind::Approximated, node, message);
            } else {
                let own = limits.unwrap_or([f64::NEG_INFINITY, f64::INFINITY]);
                limits = Some([low.max(own[0]), high.min(own[1])]);
            }
        }
        let limits = limits.filter(|[low, high]| low < high);
        if limits.is_some() {
            self.reader.exact("limits of an input");
        }
        self.reader.exact("actuator as an input");
        self.draft.scene.inputs.push(Input { name: name.clone(), limits, ..input });
        name
    }
}
