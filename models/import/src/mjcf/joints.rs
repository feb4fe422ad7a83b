//! Joints of bodies.

use nalgebra::{Unit, Vector3};
use roxmltree::Node;

use crate::document::Reader;
use crate::mjcf::classes::{SWITCH, Settings};
use crate::mjcf::settings::TINY;
use crate::mjcf::tree::{Joint, JointKind, Place, Walk, named};
use crate::report::Kind;

impl<'a> Walk<'_, 'a, '_> {
    /// Reads a joint of a body.
    pub(super) fn joint(&mut self, body: usize, node: Node<'a, 'a>, place: &Place) {
        let is_free = node.has_tag_name("freejoint");
        let settings = if is_free {
            Settings::alone(node)
        } else {
            self.classes.settings(self.reader, node, place.class, "joint")
        };
        let compiler = self.compiler(node);
        let reader = &mut *self.reader;
        const KINDS: [&str; 4] = ["free", "ball", "slide", "hinge"];
        let kind = match settings.keyword(reader, "type", &KINDS) {
            _ if is_free => JointKind::Free,
            Some(0) => JointKind::Free,
            Some(1) => JointKind::Ball,
            Some(2) => JointKind::Slide,
            _ => JointKind::Hinge,
        };
        let first = self.tree.bodies[body].joints.first().map(|j| self.tree.joints[*j].kind);
        if kind == JointKind::Free && self.tree.bodies[body].parent.is_some() {
            reader.fail(node, "a free joint in a body whose parent is not the world");
        }
        if first == Some(JointKind::Free) || (first.is_some() && kind == JointKind::Free) {
            reader.fail(node, "a free joint beside another joint of the body");
        }
        let align = settings.keyword(reader, "align", &SWITCH).unwrap_or(2);
        if kind == JointKind::Free && (align == 1 || (align == 2 && compiler.aligns)) {
            let message = "`align`: the body's frame would become that of its principal axes; write it so, or switch it off";
            reader.refuse(node, message);
        }
        let single = kind.is_single();
        let angle =
            |angle: f64| if kind == JointKind::Slide { angle } else { compiler.radians(angle) };
        let axis = settings.numbers::<3>(reader, "axis").filter(|_| single);
        let axis = place.frame.rotation * Vector3::from(axis.unwrap_or([0.0, 0.0, 1.0]));
        let axis = Unit::try_new(axis, TINY).unwrap_or_else(|| {
            reader.fail(node, "`axis` of `joint` has no direction");
            Vector3::z_axis()
        });
        let anchor = settings.numbers::<3>(reader, "pos").unwrap_or_default();
        let anchor = (place.frame * nalgebra::Point3::from(anchor)).coords;
        let value = |reader: &mut Reader<'_>, name: &str| {
            settings.number(reader, name).filter(|_| single).map_or(0.0, angle)
        };
        let limits = if single {
            settings.range(reader, "range", "limited", compiler.limits_by_range)
        } else {
            let range = settings.numbers::<2>(reader, "range").unwrap_or_default();
            let is_limited = settings.keyword(reader, "limited", &SWITCH) != Some(0);
            if kind == JointKind::Ball && is_limited && range != [0.0; 2] {
                let message = "`range` of a ball joint: an orientation has no limits here";
                reader.note(Kind::Approximated, node, message);
            }
            None
        };
        if settings
            .range(reader, "actuatorfrcrange", "actuatorfrclimited", compiler.limits_by_range)
            .is_some()
        {
            let message = "`actuatorfrcrange`: forces of actuators are not cut off; clients keep to the limits of inputs";
            reader.note(Kind::Approximated, node, message);
        }
        if settings.is_true(reader, "actuatorgravcomp") {
            reader.note(
                Kind::NoEffect,
                node,
                "`actuatorgravcomp`: what lifts a body counts as work from outside",
            );
        }
        let spring_damper =
            settings.numbers::<2>(reader, "springdamper").filter(|pair| *pair != [0.0; 2]);
        if spring_damper.is_some_and(|pair| pair.iter().any(|x| *x <= 0.0)) {
            reader.fail(node, "`springdamper` of `joint` must be two numbers greater than 0");
        }
        let joint = Joint {
            node,
            name: named(settings.node().attribute("name").unwrap_or_default(), place),
            kind,
            body,
            anchor: if kind == JointKind::Free { Vector3::zeros() } else { anchor },
            axis,
            reference: value(reader, "ref"),
            rest: value(reader, "springref"),
            limits: limits.map(|limits| limits.map(angle)),
            stiffness: settings.first_numbers(reader, "stiffness"),
            damping: settings.first_numbers(reader, "damping"),
            spring_damper,
            armature: settings.amount(reader, "armature"),
            friction: settings.amount(reader, "frictionloss"),
        };
        let index = self.tree.joints.len();
        self.register(1, node, &joint.name, index);
        self.tree.bodies[body].joints.push(index);
        self.tree.joints.push(joint);
    }
}
