//! What actuators add to the mechanics whatever they are told: the inertia of their rotors, and their friction.

use plantd_models::scene::{Armature, Force};
use roxmltree::Node;

use crate::mjcf::build::Build;
use crate::mjcf::tendons::{Course, Tendons, Term, linear};

/// Kinds of actuators that are taken, all of the same law.
pub(super) const TAKEN: [&str; 5] = ["general", "motor", "position", "velocity", "damper"];

/// A rotor behind a gear.
#[derive(Clone, Copy, Debug, Default)]
struct Rotor {
    armature: f64,
    /// Of powers of `|v|`, from 0.
    damping: [f64; 3],
    /// Square of the gear.
    ratio: f64,
}

impl<'a> Build<'_, 'a, '_> {
    /// Rotors of all actuators.
    pub(super) fn carry(&mut self, tendons: &Tendons<'a>) {
        for (node, ending) in self.elements("actuator") {
            self.ending = ending;
            if TAKEN.contains(&node.tag_name().name()) {
                self.carry_one(node, tendons);
            }
        }
        self.ending.clear();
    }

    fn carry_one(&mut self, node: Node<'a, 'a>, tendons: &Tendons<'a>) {
        let rotor = self.rotor(node);
        if rotor.armature == 0.0 && rotor.damping == [0.0; 3] {
            return;
        }
        if rotor.armature < 0.0 || rotor.damping.iter().any(|d| *d < 0.0) {
            let message = "`armature` and `damping` of an actuator must not be negative";
            return self.reader.refuse(node, message);
        }
        let target = ["joint", "jointinparent"].into_iter().find(|name| node.has_attribute(*name));
        if let Some(target) = target {
            let found = |build: &Self, name: &str| build.tree.joint(name);
            let Some(j) = self.find(node, target, "joint", found) else { return };
            let is_single = self.tree.joints[j].kind.is_single();
            // Gears do not count where there is an orientation.
            let rotor = if is_single { rotor } else { Rotor { ratio: 1.0, ..rotor } };
            for coordinate in self.coordinates[j].clone() {
                self.turn_with(node, &[Term { joint: j, coordinate, coefficient: 1.0 }], rotor);
            }
        } else if node.has_attribute("tendon") {
            let found = |_: &Self, name: &str| tendons.named(name).map(|tendon| &tendon.course);
            match self.find(node, "tendon", "tendon", found) {
                Some(Some(Course::Sum(terms))) => self.turn_with(node, terms, rotor),
                Some(Some(Course::Path(_))) => {
                    let message =
                        "`armature` and `damping` of an actuator along a path: give them to joints";
                    self.reader.refuse(node, message);
                }
                _ => {}
            }
        } else {
            let message = "`armature` and `damping` of an actuator must act on a joint or a tendon";
            self.reader.fail(node, message);
        }
    }

    fn rotor(&mut self, node: Node<'a, 'a>) -> Rotor {
        let class = self
            .classes
            .named(self.reader, node, "class")
            .unwrap_or_else(|| self.classes.root(self.reader, node));
        let mut all = self.classes.chain(class, |name| TAKEN.contains(&name));
        all.push(node);
        let (mut rotor, mut gear) = (Rotor::default(), [1.0; 6]);
        for node in all {
            rotor.armature = self.reader.number_or(node, "armature", rotor.armature);
            for (name, numbers) in [("damping", &mut rotor.damping[..]), ("gear", &mut gear[..])] {
                if let Some(text) = node.attribute(name) {
                    let own = self.reader.all_numbers(node, name, text);
                    numbers.iter_mut().zip(own).for_each(|(number, own)| *number = own);
                }
            }
        }
        rotor.ratio = gear[0] * gear[0];
        rotor
    }

    fn turn_with(&mut self, node: Node<'a, 'a>, terms: &[Term], rotor: Rotor) {
        let Rotor { armature, damping, ratio } = rotor;
        self.add_armature(terms, ratio * armature);
        if self.physics.has("damper") {
            self.add_damper(node, terms, damping.map(|d| ratio * d));
        }
    }

    /// Inertia that turns or slides with a sum of coordinates.
    pub(super) fn add_armature(&mut self, terms: &[Term], armature: f64) {
        if armature == 0.0 {
            return;
        }
        self.reader.exact("armature");
        if let [Term { coordinate, coefficient, .. }] = terms {
            self.draft.setting(coordinate).armature += armature * coefficient * coefficient;
        } else {
            self.draft.scene.armatures.push(Armature { terms: linear(terms), armature });
        }
    }

    /// A force `−(d₁ + d₂ |s| + d₃ s²) s` against the rate `s` of a sum of coordinates.
    pub(super) fn add_damper(&mut self, node: Node<'a, 'a>, terms: &[Term], d: [f64; 3]) {
        let [first, second, third] = d;
        if let [Term { coordinate, coefficient, .. }] = terms {
            let c = coefficient.abs();
            self.draft.damp(self.reader, coordinate, first * c * c);
            let (coordinate, coefficient, cubic) =
                (coordinate.clone(), second * c.powi(3), third * c.powi(4));
            if coefficient != 0.0 || cubic != 0.0 {
                self.reader.exact("damping with powers of the velocity");
                let drag = Force::CoordinateDrag { coordinate, coefficient, cubic };
                self.draft.scene.forces.push(drag);
            }
            return;
        }
        if [second, third] != [0.0; 2] {
            let message = "`damping` with several numbers on a sum of joints: it is in proportion to the velocity here";
            return self.reader.refuse(node, message);
        }
        if first > 0.0 {
            self.reader.exact("damper of a tendon");
            let terms = linear(terms);
            let damper = Force::LinearDamper { terms, damping: first, input: None };
            self.draft.scene.forces.push(damper);
        }
    }
}
