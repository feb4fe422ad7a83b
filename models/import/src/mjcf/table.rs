//! Every element and attribute of MJCF, and what is done with it.

use crate::table::Element;
use crate::table::Treatment::{self, Contact, NoEffect, Read, Refused};
use crate::table::Treatments;

type Entry = (Treatment, &'static str);

const SEEN: &str = "it is only seen";
const USER: &str = "it speaks to other programs";
const STATES: &str = "clients read the state, and what follows from it, of the plant itself";
const SOLVER: &str = "it sets MuJoCo's own solver";
const SOFT: &str = "it softens what is hard here, or is not enforced";
const TOUCH: &str = "nothing touches anything";
const MEDIUM: &str = "there is no medium";
const NO_STATE: &str = "actuators here have no state of their own";
const SAVED: &str = "save the model from MuJoCo with `mj_saveLastXML`, which writes it out";
const ACTUATOR: &str = "an actuator of this kind has a state or a force law of its own: write a `motor` and close its loop in the controller";
const DEFORMABLE: &str = "nothing bends here: take it out, or write it as bodies and springs";

const ORIENTATION: Entry = (Read, "quat axisangle xyaxes zaxis euler");

const COMPILER: Element = Element::new(
    "compiler",
    &[
        (
            Read,
            "autolimits boundmass boundinertia settotalmass balanceinertia coordinate angle eulerseq inertiafromgeom inertiagrouprange alignfree meshdir assetdir",
        ),
        (
            NoEffect(USER),
            "strippath fitaabb texturedir discardvisual usethread fusestatic saveinertial conflict",
        ),
    ],
    &[],
)
.without(&[(NoEffect(NO_STATE), "lengthrange")]);

const OPTION: Element = Element::new(
    "option",
    &[
        (Read, "timestep gravity wind density viscosity"),
        (
            NoEffect(SOLVER),
            "impratio tolerance ls_tolerance noslip_tolerance ccd_tolerance sleep_tolerance o_margin o_solref o_solimp o_friction integrator cone jacobian solver iterations ls_iterations noslip_iterations ccd_iterations sdf_iterations sdf_initpoints",
        ),
        (NoEffect(STATES), "magnetic"),
        (Refused("take the actuators of the group out"), "actuatorgroupdisable"),
    ],
    &[&Element::new(
        "flag",
        &[
            (
                Read,
                "constraint equality frictionloss limit contact spring damper gravity actuation",
            ),
            (
                NoEffect(SOLVER),
                "clampctrl warmstart filterparent refsafe sensor midphase eulerdamp autoreset nativeccd island multiccd override energy fwdinv invdiscrete sleep diagexact",
            ),
        ],
        &[],
    )],
);

const INERTIAL: Element =
    Element::new("inertial", &[(Read, "pos mass diaginertia fullinertia"), ORIENTATION], &[]);

const JOINT: Element = Element::new(
    "joint",
    &[
        (
            Read,
            "name class type pos axis springdamper limited actuatorfrclimited stiffness range actuatorfrcrange actuatorgravcomp ref springref armature damping frictionloss",
        ),
        (NoEffect(SOFT), "solreflimit solimplimit solreffriction solimpfriction margin"),
        (NoEffect(USER), "group user"),
    ],
    &[],
);

const GEOM: Element = Element::new(
    "geom",
    &[
        (
            Read,
            "name class type group contype conaffinity size mass density shellinertia fromto pos mesh rgba",
        ),
        ORIENTATION,
        (
            NoEffect(TOUCH),
            "condim priority friction solmix solref solimp margin gap surfacevel adhesion",
        ),
        (NoEffect(SEEN), "material hfield fitscale"),
        (NoEffect(MEDIUM), "fluidshape fluidcoef"),
        (NoEffect(USER), "user"),
    ],
    &[],
)
.without(&[(Refused(SAVED), "plugin")]);

const SITE: Element = Element::new(
    "site",
    &[
        (Read, "name class pos fromto"),
        ORIENTATION,
        (NoEffect(SEEN), "type group material size rgba"),
        (NoEffect(USER), "user"),
    ],
    &[],
);

const FREE_JOINT: Element =
    Element::new("freejoint", &[(Read, "name align"), (NoEffect(USER), "group")], &[]);

const ATTACH: Element = Element::new("attach", &[(Read, "model body frame prefix")], &[]);

/// What may be in a body, a frame or a replication.
static CONTENT: [&Element; 9] =
    [&BODY, &FRAME, &REPLICATE, &INERTIAL, &JOINT, &FREE_JOINT, &GEOM, &SITE, &ATTACH];
const NOT_CONTENT: Treatments = &[
    (NoEffect(SEEN), "camera light"),
    (Refused(SAVED), "composite plugin"),
    (Refused(DEFORMABLE), "flexcomp"),
];

static BODY: Element = Element::new(
    "body",
    &[
        (Read, "name childclass pos mocap gravcomp"),
        ORIENTATION,
        (NoEffect(USER), "sleep simple user"),
    ],
    &CONTENT,
)
.without(NOT_CONTENT);

static FRAME: Element =
    Element::new("frame", &[(Read, "name childclass pos"), ORIENTATION], &CONTENT)
        .without(NOT_CONTENT);

static REPLICATE: Element =
    Element::new("replicate", &[(Read, "count offset euler sep childclass")], &CONTENT)
        .without(NOT_CONTENT);

static WORLD: Element = Element::new("worldbody", &[], &CONTENT).without(NOT_CONTENT);

const MESH: Element = Element::new(
    "mesh",
    &[
        (Read, "name class file scale vertex face refpos refquat inertia builtin params"),
        (NoEffect(SEEN), "content_type normal texcoord smoothnormal maxhullvert material"),
    ],
    &[],
)
.without(&[(Refused(SAVED), "plugin")]);

const TENDON_OWN: Entry = (
    Read,
    "name class limited actuatorfrclimited range actuatorfrcrange frictionloss springlength stiffness damping armature",
);
const TENDON_SOFT: Entry =
    (NoEffect(SOFT), "solreflimit solimplimit solreffriction solimpfriction margin");
const TENDON_SEEN: Entry = (NoEffect(SEEN), "group width material rgba");
const TENDON: Treatments = &[TENDON_OWN, TENDON_SOFT, TENDON_SEEN, (NoEffect(USER), "user")];

const EQUALITY_OWN: Entry = (Read, "name class active");
const EQUALITY_SOFT: Entry = (NoEffect(SOFT), "solref solimp");

const ACTUATOR_OWN: Entry = (
    Read,
    "name class ctrlrange ctrllimited forcelimited forcerange gear damping armature delay joint jointinparent tendon slidersite cranksite cranklength site refsite",
);
const ACTUATOR_USER: Entry = (NoEffect(USER), "group user nsample interp lengthrange");
/// Actuators that hold no state, or are told by their attributes that they do.
const GENERAL: Element = Element::new(
    "general",
    &[
        ACTUATOR_OWN,
        (Read, "body dyntype gaintype biastype gainprm biasprm"),
        ACTUATOR_USER,
        (NoEffect(NO_STATE), "actlimited actrange actdim input velrange ffrange dynprm actearly"),
    ],
    &[],
);
const MOTOR: Element = Element::new("motor", &[ACTUATOR_OWN, ACTUATOR_USER], &[]);
const POSITION: Element = Element::new(
    "position",
    &[ACTUATOR_OWN, (Read, "kp kv dampratio timeconst inheritrange"), ACTUATOR_USER],
    &[],
);
const VELOCITY: Element =
    Element::new("velocity", &[ACTUATOR_OWN, (Read, "kv"), ACTUATOR_USER], &[]);
const DAMPER: Element = Element::new("damper", &[ACTUATOR_OWN, (Read, "kv"), ACTUATOR_USER], &[]);
const OTHER_ACTUATORS: &str = "intvelocity orientation pid cylinder muscle adhesion dcmotor";

static DEFAULT: Element = Element::new(
    "default",
    &[(Read, "class")],
    &[
        &DEFAULT,
        &MESH,
        &JOINT,
        &GEOM,
        &SITE,
        &Element::new("equality", &[EQUALITY_OWN, EQUALITY_SOFT], &[]),
        &Element::new("tendon", TENDON, &[]),
        &GENERAL,
        &MOTOR,
        &POSITION,
        &VELOCITY,
        &DAMPER,
    ],
)
.without(&[
    (NoEffect(SEEN), "material camera light"),
    (Contact, "pair"),
    (NoEffect("what it is a default of is refused itself"), OTHER_ACTUATORS),
]);

/// The whole format.
pub(super) static MUJOCO: Element = Element::new(
    "mujoco",
    &[(Read, "model")],
    &[
        &COMPILER,
        &OPTION,
        &DEFAULT,
        &Element::new(
            "asset",
            &[],
            &[
                &MESH,
                &Element::new(
                    "model",
                    &[(Read, "name file"), (NoEffect(SEEN), "content_type")],
                    &[],
                ),
            ],
        )
        .without(&[(NoEffect(SEEN), "hfield skin texture material")]),
        &WORLD,
        &Element::new("contact", &[], &[])
            .without(&[(Contact, "pair"), (NoEffect(TOUCH), "exclude")]),
        &Element::new(
            "tendon",
            &[],
            &[
                &Element::new(
                    "spatial",
                    TENDON,
                    &[
                        &Element::new("site", &[(Read, "site")], &[]),
                        &Element::new("geom", &[(Read, "geom sidesite")], &[]),
                        &Element::new("pulley", &[(Read, "divisor")], &[]),
                    ],
                ),
                &Element::new(
                    "fixed",
                    TENDON,
                    &[&Element::new("joint", &[(Read, "joint coef")], &[])],
                ),
            ],
        ),
        &Element::new(
            "equality",
            &[],
            &[
                &Element::new(
                    "connect",
                    &[EQUALITY_OWN, (Read, "body1 body2 anchor site1 site2"), EQUALITY_SOFT],
                    &[],
                ),
                &Element::new(
                    "weld",
                    &[
                        EQUALITY_OWN,
                        (Read, "body1 body2 relpose anchor site1 site2 torquescale"),
                        EQUALITY_SOFT,
                    ],
                    &[],
                ),
                &Element::new(
                    "joint",
                    &[EQUALITY_OWN, (Read, "joint1 joint2 polycoef"), EQUALITY_SOFT],
                    &[],
                ),
                &Element::new(
                    "tendon",
                    &[EQUALITY_OWN, (Read, "tendon1 tendon2 polycoef"), EQUALITY_SOFT],
                    &[],
                ),
            ],
        )
        .without(&[(Refused(DEFORMABLE), "flex flexvert flexstrain")]),
        &Element::new("actuator", &[], &[&GENERAL, &MOTOR, &POSITION, &VELOCITY, &DAMPER])
            .without(&[(Refused(ACTUATOR), OTHER_ACTUATORS), (Refused(SAVED), "plugin")]),
        &Element::new(
            "keyframe",
            &[],
            &[&Element::new(
                "key",
                &[
                    (Read, "name qpos ctrl"),
                    (
                        NoEffect("an operating point is a configuration at rest"),
                        "time qvel act mpos mquat",
                    ),
                ],
                &[],
            )],
        ),
    ],
)
.without(&[
    (NoEffect(SEEN), "statistic visual"),
    (NoEffect(USER), "size custom"),
    (NoEffect(STATES), "sensor"),
    (NoEffect("what uses a plugin is refused itself"), "extension"),
    (Refused(DEFORMABLE), "deformable"),
]);

#[cfg(test)]
mod tests {
    use super::MUJOCO;
    use crate::table::tests::{everything_is_treated, nothing_is_there_twice};

    /// Elements and attributes of the schema that MuJoCo 4 publishes, `src/xml/mjcf.schema`; a `*` is for
    /// everything in what is left out.
    const SPECIFIED: &str = include_str!("schema.txt");

    #[test]
    fn everything_specified_is_treated() {
        assert!(SPECIFIED.lines().count() > 80);
        everything_is_treated(&MUJOCO, SPECIFIED);
    }

    #[test]
    fn no_name_is_there_twice() {
        nothing_is_there_twice(&MUJOCO);
    }
}
