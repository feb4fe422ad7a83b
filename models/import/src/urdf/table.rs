//! Every element and attribute of URDF, and what is done with it.

use crate::table::Element;
use crate::table::Treatment::{self, NoEffect, Read};

const NAME: (&str, Treatment) = ("name", Read);
const LIMITS: &str = "no limit of this kind is enforced";
const SEEN: &str = "it is only seen";
const CONTACT: &str = "nothing touches anything: contacts are not simulated";
const OWN: &str = "each joint of the transmission has an input of its own";
const OTHERS: &str = "it speaks to other programs";

const ORIGIN: Element =
    Element::read("origin", &[("xyz", Read), ("rpy", Read), ("quat_xyzw", Read)], &[]);

const INERTIAL: Element = Element::read(
    "inertial",
    &[],
    &[
        ORIGIN,
        Element::read("mass", &[("value", Read)], &[]),
        Element::read(
            "inertia",
            &[
                ("ixx", Read),
                ("ixy", Read),
                ("ixz", Read),
                ("iyy", Read),
                ("iyz", Read),
                ("izz", Read),
            ],
            &[],
        ),
    ],
);

const LINK: Element = Element::read(
    "link",
    &[NAME, ("type", NoEffect(OTHERS))],
    &[
        INERTIAL,
        Element::no_effect("visual", SEEN),
        Element::no_effect("collision", CONTACT),
        Element::no_effect("collision_checking", CONTACT),
        Element::no_effect("contact", CONTACT),
        Element::no_effect("self_collision_checking", CONTACT),
        Element::no_effect("sensor", OTHERS),
    ],
);

const JOINT: Element = Element::read(
    "joint",
    &[NAME, ("type", Read)],
    &[
        ORIGIN,
        Element::read("parent", &[("link", Read)], &[]),
        Element::read("child", &[("link", Read)], &[]),
        Element::read("axis", &[("xyz", Read)], &[]),
        Element::read(
            "limit",
            &[
                ("lower", Read),
                ("upper", Read),
                ("effort", Read),
                ("velocity", NoEffect(LIMITS)),
                ("acceleration", NoEffect(LIMITS)),
                ("deceleration", NoEffect(LIMITS)),
                ("jerk", NoEffect(LIMITS)),
            ],
            &[],
        ),
        Element::read("dynamics", &[("damping", Read), ("friction", Read)], &[]),
        Element::read("mimic", &[("joint", Read), ("multiplier", Read), ("offset", Read)], &[]),
        Element::no_effect("safety_controller", LIMITS),
        Element::no_effect("calibration", OTHERS),
        Element::refused("loop_joint", "write the loop as a constraint of the scene"),
    ],
);

const REDUCTION: Element = Element::read("mechanicalReduction", &[], &[]);
const INTERFACE: Element = Element::no_effect("hardwareInterface", OTHERS);

const TRANSMISSION: Element = Element::read(
    "transmission",
    &[NAME, ("type", Read)],
    &[
        Element::read("type", &[], &[]),
        Element::read(
            "joint",
            &[NAME],
            &[
                INTERFACE,
                REDUCTION,
                Element::no_effect("role", OTHERS),
                Element::no_effect("offset", OTHERS),
            ],
        ),
        Element::read(
            "actuator",
            &[NAME],
            &[
                INTERFACE,
                REDUCTION,
                Element::no_effect("motorTorqueConstant", OTHERS),
                Element::no_effect("role", OTHERS),
            ],
        ),
        REDUCTION,
        Element::no_effect("motorTorqueConstant", OTHERS),
        Element::no_effect("leftActuator", OWN),
        Element::no_effect("rightActuator", OWN),
        Element::read("flexJoint", &[NAME, ("mechanicalReduction", NoEffect(OWN))], &[]),
        Element::read("rollJoint", &[NAME, ("mechanicalReduction", NoEffect(OWN))], &[]),
        Element::no_effect("gap_joint", OWN),
        Element::no_effect("passive_joint", OWN),
        Element::no_effect("use_simulated_gripper_joint", OWN),
    ],
);

const COMMAND: Element = Element::read(
    "command_interface",
    &[NAME],
    &[Element::no_effect("param", OTHERS), Element::no_effect("limits", LIMITS)],
);

const ROS2_CONTROL: Element = Element::read(
    "ros2_control",
    &[
        NAME,
        ("type", NoEffect(OTHERS)),
        ("rw_rate", NoEffect(OTHERS)),
        ("is_async", NoEffect(OTHERS)),
    ],
    &[
        Element::no_effect("hardware", OTHERS),
        Element::no_effect("sensor", OTHERS),
        Element::no_effect("gpio", OTHERS),
        Element::no_effect("transmission", OTHERS),
        Element::read(
            "joint",
            &[NAME, ("mimic", NoEffect("the joint's own `mimic` counts"))],
            &[
                COMMAND,
                Element::no_effect("state_interface", OTHERS),
                Element::no_effect("param", OTHERS),
                Element::no_effect("limits", LIMITS),
            ],
        ),
    ],
);

/// The whole format.
pub(super) static ROBOT: Element = Element::read(
    "robot",
    &[NAME, ("version", Read), ("type", NoEffect(OTHERS))],
    &[
        LINK,
        JOINT,
        TRANSMISSION,
        ROS2_CONTROL,
        Element::no_effect("material", SEEN),
        Element::no_effect("gazebo", OTHERS),
        Element::no_effect("sensor", OTHERS),
        Element::no_effect("disable_collisions", CONTACT),
        Element::refused("model_state", "write the state as the scene's initial configuration"),
        Element::refused("include", "expand the file first: `xacro FILE > robot.urdf`"),
    ],
);

#[cfg(test)]
mod tests {
    use super::*;

    /// Elements and attributes of the specification of URDF 1.2 and of transmissions (wiki.ros.org/urdf/XML).
    const SPECIFIED: &[&str] = &[
        "robot@name",
        "robot@version",
        "robot/link@name",
        "robot/link/inertial/origin@xyz",
        "robot/link/inertial/origin@rpy",
        "robot/link/inertial/origin@quat_xyzw",
        "robot/link/inertial/mass@value",
        "robot/link/inertial/inertia@ixx",
        "robot/link/inertial/inertia@ixy",
        "robot/link/inertial/inertia@ixz",
        "robot/link/inertial/inertia@iyy",
        "robot/link/inertial/inertia@iyz",
        "robot/link/inertial/inertia@izz",
        "robot/link/visual",
        "robot/link/collision",
        "robot/joint@name",
        "robot/joint@type",
        "robot/joint/origin@xyz",
        "robot/joint/origin@rpy",
        "robot/joint/parent@link",
        "robot/joint/child@link",
        "robot/joint/axis@xyz",
        "robot/joint/calibration",
        "robot/joint/dynamics@damping",
        "robot/joint/dynamics@friction",
        "robot/joint/limit@lower",
        "robot/joint/limit@upper",
        "robot/joint/limit@effort",
        "robot/joint/limit@velocity",
        "robot/joint/limit@acceleration",
        "robot/joint/limit@deceleration",
        "robot/joint/limit@jerk",
        "robot/joint/mimic@joint",
        "robot/joint/mimic@multiplier",
        "robot/joint/mimic@offset",
        "robot/joint/safety_controller",
        "robot/transmission@name",
        "robot/transmission/type",
        "robot/transmission/joint@name",
        "robot/transmission/joint/hardwareInterface",
        "robot/transmission/actuator@name",
        "robot/transmission/actuator/mechanicalReduction",
        "robot/transmission/actuator/hardwareInterface",
        "robot/gazebo",
        "robot/sensor",
        "robot/material",
        "robot/model_state",
    ];

    #[test]
    fn everything_specified_is_treated() {
        for path in SPECIFIED {
            let (elements, attribute) = path.split_once('@').unwrap_or((path, ""));
            let mut element = &ROBOT;
            for name in elements.split('/').skip(1) {
                let found = element.children.iter().find(|child| child.name == name);
                element = found.unwrap_or_else(|| panic!("{path}: no `{name}`"));
            }
            let knows = |(known, _): &(&str, Treatment)| *known == attribute;
            assert!(attribute.is_empty() || element.attributes.iter().any(knows), "{path}");
        }
    }

    #[test]
    fn no_element_is_there_twice() {
        let mut open = vec![&ROBOT];
        while let Some(element) = open.pop() {
            let mut names: Vec<_> = element.children.iter().map(|child| child.name).collect();
            names.sort_unstable();
            let count = names.len();
            names.dedup();
            assert_eq!(names.len(), count, "{}", element.name);
            open.extend(element.children);
        }
    }
}
