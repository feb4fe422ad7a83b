//! Every element and attribute of URDF, and what is done with it.

use crate::table::Element;
use crate::table::Treatment::{Contact, NoEffect, Read, Refused};

const LIMITS: &str = "no limit of this kind is enforced";
const SEEN: &str = "it is only seen";
const OWN: &str = "each joint of the transmission has an input of its own";
const OTHERS: &str = "it speaks to other programs";

const ORIGIN: Element = Element::new("origin", &[(Read, "xyz rpy quat_xyzw")], &[]);

const INERTIAL: Element = Element::new(
    "inertial",
    &[],
    &[
        &ORIGIN,
        &Element::new("mass", &[(Read, "value")], &[]),
        &Element::new("inertia", &[(Read, "ixx ixy ixz iyy iyz izz")], &[]),
    ],
);

const MATERIAL: Element =
    Element::new("material", &[(Read, "name")], &[&Element::new("color", &[(Read, "rgba")], &[])])
        .without(&[(NoEffect(SEEN), "texture")]);

const VISUAL: Element = Element::new(
    "visual",
    &[(NoEffect(SEEN), "name")],
    &[
        &ORIGIN,
        &MATERIAL,
        &Element::new(
            "geometry",
            &[],
            &[
                &Element::new("box", &[(Read, "size")], &[]),
                &Element::new("sphere", &[(Read, "radius")], &[]),
                &Element::new("cylinder", &[(Read, "radius length")], &[]),
                &Element::new("capsule", &[(Read, "radius length")], &[]),
                &Element::new("mesh", &[(Read, "filename scale")], &[]),
            ],
        ),
    ],
);

const LINK: Element =
    Element::new("link", &[(Read, "name"), (NoEffect(OTHERS), "type")], &[&INERTIAL, &VISUAL])
        .without(&[
            (Contact, "collision collision_checking contact self_collision_checking"),
            (NoEffect(OTHERS), "sensor"),
        ]);

const JOINT: Element = Element::new(
    "joint",
    &[(Read, "name type")],
    &[
        &ORIGIN,
        &Element::new("parent", &[(Read, "link")], &[]),
        &Element::new("child", &[(Read, "link")], &[]),
        &Element::new("axis", &[(Read, "xyz")], &[]),
        &Element::new(
            "limit",
            &[
                (Read, "lower upper effort"),
                (NoEffect(LIMITS), "velocity acceleration deceleration jerk"),
            ],
            &[],
        ),
        &Element::new("dynamics", &[(Read, "damping friction")], &[]),
        &Element::new("mimic", &[(Read, "joint multiplier offset")], &[]),
    ],
)
.without(&[
    (NoEffect(LIMITS), "safety_controller"),
    (NoEffect(OTHERS), "calibration"),
    (Refused("write the loop as a constraint of the scene"), "loop_joint"),
]);

const REDUCTION: Element = Element::new("mechanicalReduction", &[], &[]);
const OWN_REDUCTION: (crate::table::Treatment, &str) = (NoEffect(OWN), "mechanicalReduction");

const TRANSMISSION: Element = Element::new(
    "transmission",
    &[(Read, "name type")],
    &[
        &Element::new("type", &[], &[]),
        &Element::new("joint", &[(Read, "name")], &[&REDUCTION])
            .without(&[(NoEffect(OTHERS), "hardwareInterface role offset")]),
        &Element::new("actuator", &[(Read, "name")], &[&REDUCTION])
            .without(&[(NoEffect(OTHERS), "hardwareInterface motorTorqueConstant role")]),
        &REDUCTION,
        &Element::new("flexJoint", &[(Read, "name"), OWN_REDUCTION], &[]),
        &Element::new("rollJoint", &[(Read, "name"), OWN_REDUCTION], &[]),
    ],
)
.without(&[
    (NoEffect(OTHERS), "motorTorqueConstant"),
    (
        NoEffect(OWN),
        "leftActuator rightActuator gap_joint passive_joint use_simulated_gripper_joint",
    ),
]);

const ROS2_CONTROL: Element = Element::new(
    "ros2_control",
    &[(Read, "name"), (NoEffect(OTHERS), "type rw_rate is_async")],
    &[&Element::new(
        "joint",
        &[(Read, "name"), (NoEffect("the joint's own `mimic` counts"), "mimic")],
        &[&Element::new("command_interface", &[(Read, "name")], &[])
            .without(&[(NoEffect(OTHERS), "param"), (NoEffect(LIMITS), "limits")])],
    )
    .without(&[(NoEffect(OTHERS), "state_interface param"), (NoEffect(LIMITS), "limits")])],
)
.without(&[(NoEffect(OTHERS), "hardware sensor gpio transmission")]);

/// The whole format.
pub(super) static ROBOT: Element = Element::new(
    "robot",
    &[(Read, "name version"), (NoEffect(OTHERS), "type")],
    &[&LINK, &JOINT, &TRANSMISSION, &ROS2_CONTROL, &MATERIAL],
)
.without(&[
    (NoEffect(OTHERS), "gazebo sensor"),
    (Contact, "disable_collisions"),
    (Refused("write the state as the scene's initial configuration"), "model_state"),
    (Refused("expand the file first: `xacro FILE > robot.urdf`"), "include"),
]);

#[cfg(test)]
mod tests {
    use super::ROBOT;
    use crate::table::tests::{everything_is_treated, nothing_is_there_twice};

    /// Elements and attributes of the specification of URDF 1.2 and of transmissions (wiki.ros.org/urdf/XML).
    const SPECIFIED: &str = "
robot: name version
robot/link: name
robot/link/inertial/origin: xyz rpy quat_xyzw
robot/link/inertial/mass: value
robot/link/inertial/inertia: ixx ixy ixz iyy iyz izz
robot/link/visual: name
robot/link/visual/origin: xyz rpy
robot/link/visual/geometry/box: size
robot/link/visual/geometry/sphere: radius
robot/link/visual/geometry/cylinder: radius length
robot/link/visual/geometry/capsule: radius length
robot/link/visual/geometry/mesh: filename scale
robot/link/visual/material: name
robot/link/visual/material/color: rgba
robot/link/visual/material/texture: *
robot/link/collision: *
robot/joint: name type
robot/joint/origin: xyz rpy
robot/joint/parent: link
robot/joint/child: link
robot/joint/axis: xyz
robot/joint/calibration: *
robot/joint/dynamics: damping friction
robot/joint/limit: lower upper effort velocity acceleration deceleration jerk
robot/joint/mimic: joint multiplier offset
robot/joint/safety_controller: *
robot/transmission: name
robot/transmission/type:
robot/transmission/joint: name
robot/transmission/joint/hardwareInterface: *
robot/transmission/actuator: name
robot/transmission/actuator/mechanicalReduction:
robot/transmission/actuator/hardwareInterface: *
robot/gazebo: *
robot/sensor: *
robot/material: name
robot/material/color: rgba
robot/model_state: *
";

    #[test]
    fn everything_specified_is_treated() {
        everything_is_treated(&ROBOT, SPECIFIED);
    }

    #[test]
    fn no_name_is_there_twice() {
        nothing_is_there_twice(&ROBOT);
    }
}
