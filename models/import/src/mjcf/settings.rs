//! What holds for a whole MJCF: `compiler` and `option`.

use nalgebra::{
    Isometry3, Matrix3, Quaternion, Rotation3, Translation3, Unit, UnitQuaternion, Vector3,
};
use roxmltree::Node;

use crate::document::Reader;
use crate::inertia::Inertia;
use crate::mjcf::classes::Settings;
use crate::options::{EARTH, Options};
use crate::report::Kind;

/// Lengths, m, masses, kg, and volumes, m³, that count as none.
pub(super) const TINY: f64 = 1e-14;

/// How a file is meant.
#[derive(Clone, Debug)]
pub(super) struct Compiler {
    /// Whether angles are in degrees.
    degrees: bool,
    /// Axes of Euler angles, one after the other: small letters turn with the body.
    sequence: String,
    /// Whether a range that is given counts without being switched on.
    pub(super) limits_by_range: bool,
    pub(super) inertia_from_geoms: FromGeoms,
    /// Groups of the geoms that give inertia.
    pub(super) inertia_groups: [f64; 2],
    /// Least mass, kg, and least principal moment, kg·m², of a body.
    pub(super) least: [f64; 2],
    /// Whether an inertia that no body has becomes a sphere's.
    pub(super) balances: bool,
    /// Mass of all bodies together, kg; all are scaled to it.
    pub(super) total_mass: Option<f64>,
    pub(super) meshes: String,
    pub(super) aligns: bool,
}

/// How the model is meant, and each that it attaches.
pub(super) struct Compilers(Vec<Compiler>);

impl Compilers {
    pub(super) fn read(reader: &mut Reader<'_>, root: Node<'_, '_>) -> Self {
        Self((0..reader.models().len()).map(|model| Compiler::read(reader, root, model)).collect())
    }

    /// Of the model itself.
    pub(super) fn main(&self) -> &Compiler {
        &self.0[0]
    }

    /// How an element is meant.
    pub(super) fn of(&self, reader: &Reader<'_>, node: Node<'_, '_>) -> &Compiler {
        &self.0[reader.model_of(node)]
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum FromGeoms {
    Never,
    Always,
    /// Where a body has no `inertial`.
    Else,
}

impl Compiler {
    /// As one of the models says it.
    fn read(reader: &mut Reader<'_>, root: Node<'_, '_>, model: usize) -> Self {
        let mut all = Self {
            degrees: true,
            sequence: "xyz".to_owned(),
            limits_by_range: true,
            inertia_from_geoms: FromGeoms::Else,
            inertia_groups: [0.0, 5.0],
            least: [0.0; 2],
            balances: false,
            total_mass: None,
            meshes: String::new(),
            aligns: false,
        };
        for node in root.children().filter(|node| node.has_tag_name("compiler")) {
            if reader.model_of(node) == model {
                all.take(reader, node);
            }
        }
        let folder = &reader.models()[model];
        if !folder.is_empty() && !all.meshes.starts_with('/') {
            all.meshes = format!("{folder}/{}", all.meshes);
        }
        all
    }

    fn take(&mut self, reader: &mut Reader<'_>, node: Node<'_, '_>) {
        let word = |reader: &mut Reader<'_>, name: &str, allowed: &[&str]| {
            node.attribute(name).map(|text| reader.keyword(node, name, text, allowed))
        };
        if word(reader, "coordinate", &["local", "global"]) == Some(1) {
            reader.fail(node, "`coordinate` of `compiler` must be `local`");
        }
        if let Some(unit) = word(reader, "angle", &["radian", "degree"]) {
            self.degrees = unit == 1;
        }
        if let Some(text) = node.attribute("eulerseq") {
            self.sequence = text.to_owned();
            if text.len() != 3 || !text.bytes().all(|byte| b"xyzXYZ".contains(&byte)) {
                reader.fail(node, "`eulerseq` of `compiler` must be three of x, y, z, X, Y, Z");
                self.sequence = "xyz".to_owned();
            }
        }
        if let Some(how) = word(reader, "inertiafromgeom", &["false", "true", "auto"]) {
            self.inertia_from_geoms = [FromGeoms::Never, FromGeoms::Always, FromGeoms::Else][how];
        }
        self.inertia_groups = reader.vector_or(node, "inertiagrouprange", self.inertia_groups);
        let [mass, moment] = self.least;
        self.least = [
            reader.number_or(node, "boundmass", mass),
            reader.number_or(node, "boundinertia", moment),
        ];
        if node.has_attribute("settotalmass") {
            self.total_mass = Some(reader.number(node, "settotalmass")).filter(|mass| *mass > 0.0);
        }
        let mut flag = |name: &str, value: &mut bool| {
            if let Some(is_set) = word(reader, name, &["false", "true"]) {
                *value = is_set == 1;
            }
        };
        flag("autolimits", &mut self.limits_by_range);
        flag("balanceinertia", &mut self.balances);
        flag("alignfree", &mut self.aligns);
        for folder in ["assetdir", "meshdir"].iter().filter_map(|name| node.attribute(*name)) {
            self.meshes = folder.to_owned();
        }
    }

    /// An angle of the file in rad.
    pub(super) fn radians(&self, angle: f64) -> f64 {
        if self.degrees { angle.to_radians() } else { angle }
    }

    /// `pos` with an orientation in any of its forms.
    pub(super) fn pose(&self, reader: &mut Reader<'_>, of: &Settings<'_>) -> Isometry3<f64> {
        let position = of.numbers::<3>(reader, "pos").unwrap_or_default();
        Isometry3::from_parts(Translation3::from(position), self.orientation(reader, of))
    }

    fn orientation(&self, reader: &mut Reader<'_>, of: &Settings<'_>) -> UnitQuaternion<f64> {
        const FORMS: [&str; 5] = ["quat", "axisangle", "xyaxes", "zaxis", "euler"];
        let identity = UnitQuaternion::identity();
        let Some((node, form, text)) = of.one_of(reader, &FORMS) else { return identity };
        let found = match form {
            "quat" => {
                let [w, x, y, z] = reader.numbers(node, form, text);
                UnitQuaternion::try_new(Quaternion::new(w, x, y, z), TINY)
            }
            "axisangle" => {
                let [x, y, z, angle] = reader.numbers(node, form, text);
                let axis = Unit::try_new(Vector3::new(x, y, z), TINY);
                axis.map(|axis| UnitQuaternion::from_axis_angle(&axis, self.radians(angle)))
            }
            "xyaxes" => {
                let [a, b, c, d, e, f] = reader.numbers(node, form, text);
                axes(Vector3::new(a, b, c), Vector3::new(d, e, f))
            }
            "zaxis" => Unit::try_new(Vector3::from(reader.numbers::<3>(node, form, text)), TINY)
                .map(from_z),
            _ => Some(self.euler(reader.numbers(node, form, text))),
        };
        found.unwrap_or_else(|| {
            reader.fail(node, format!("`{form}` is `{text}`, which gives no direction"));
            identity
        })
    }

    /// Turns about the axes of the sequence, about those that turn along or about fixed ones.
    pub(super) fn euler(&self, angles: [f64; 3]) -> UnitQuaternion<f64> {
        self.sequence.bytes().zip(angles).fold(UnitQuaternion::identity(), |sum, (axis, angle)| {
            let about = match axis.to_ascii_lowercase() {
                b'x' => Vector3::x_axis(),
                b'y' => Vector3::y_axis(),
                _ => Vector3::z_axis(),
            };
            let turn = UnitQuaternion::from_axis_angle(&about, self.radians(angle));
            if axis.is_ascii_lowercase() { sum * turn } else { turn * sum }
        })
    }

    /// A body's inertia within its bounds; `balanceinertia` makes one that no body has a sphere's.
    pub(super) fn bounded(&self, inertia: Inertia) -> Inertia {
        let Inertia { mut mass, center, mut tensor } = inertia;
        let [least_mass, least_moment] = self.least;
        mass = mass.max(least_mass);
        if least_moment > 0.0 {
            let mut principal = tensor.symmetric_eigen();
            principal.eigenvalues.apply(|moment| *moment = moment.max(least_moment));
            tensor = principal.recompose();
        }
        let bounded = Inertia { mass, center, tensor };
        if self.balances && !bounded.is_possible() {
            return Inertia { tensor: Matrix3::identity() * (tensor.trace() / 3.0), ..bounded };
        }
        bounded
    }
}

/// Axes x and y, the latter made square to the former.
fn axes(x: Vector3<f64>, y: Vector3<f64>) -> Option<UnitQuaternion<f64>> {
    let x = x.try_normalize(TINY)?;
    let y = (y - x * x.dot(&y)).try_normalize(TINY)?;
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, y, x.cross(&y)]));
    Some(UnitQuaternion::from_rotation_matrix(&rotation))
}

/// The shortest turn of z onto a direction; about x onto −z.
pub(super) fn from_z(direction: Unit<Vector3<f64>>) -> UnitQuaternion<f64> {
    let across = Vector3::z().cross(&direction);
    let angle = across.norm().atan2(direction.z);
    let axis = Unit::try_new(across, 1e-10).unwrap_or_else(Vector3::x_axis);
    UnitQuaternion::from_axis_angle(&axis, angle)
}

/// What `option` says of the mechanics.
pub(super) struct Physics {
    pub(super) gravity: [f64; 3],
    pub(super) time_step_s: f64,
    off: Vec<&'static str>,
}

/// Parts that `flag` can switch off.
const PARTS: [&str; 9] = [
    "constraint",
    "equality",
    "frictionloss",
    "limit",
    "contact",
    "spring",
    "damper",
    "gravity",
    "actuation",
];

impl Physics {
    /// What the user says goes before what the file says.
    pub(super) fn read(reader: &mut Reader<'_>, root: Node<'_, '_>, options: &Options) -> Self {
        let mut all = Self { gravity: EARTH, time_step_s: 0.002, off: Vec::new() };
        for node in root.children().filter(|node| node.has_tag_name("option")) {
            if reader.model_of(node) != 0 {
                let message = "`option` of what is attached: that of the model itself counts";
                reader.note(Kind::NoEffect, node, message);
                continue;
            }
            all.gravity = reader.vector_or(node, "gravity", all.gravity);
            all.time_step_s = reader.number_or(node, "timestep", all.time_step_s);
            if all.time_step_s <= 0.0 {
                reader.fail(node, "`timestep` of `option` must be greater than 0");
            }
            let medium = ["density", "viscosity"].map(|name| reader.number_or(node, name, 0.0));
            if medium != [0.0; 2] {
                let message = "`density` and `viscosity`: bodies feel no medium; `drag` of a scene is the nearest to it";
                reader.note(Kind::Warning, node, message);
            }
            for flag in node.children().filter(|node| node.has_tag_name("flag")) {
                for part in PARTS {
                    let Some(text) = flag.attribute(part) else { continue };
                    if reader.keyword(flag, part, text, &["enable", "disable"]) == 1 {
                        all.off.push(part);
                    }
                }
            }
        }
        if !all.has("gravity") {
            all.gravity = [0.0; 3];
        }
        all.gravity = options.gravity.unwrap_or(all.gravity);
        all.time_step_s = options.time_step_s.unwrap_or(all.time_step_s);
        all
    }

    /// Whether a part is switched on.
    pub(super) fn has(&self, part: &str) -> bool {
        let off = |part: &str| self.off.contains(&part);
        let is_constraint = ["equality", "frictionloss", "limit", "contact"].contains(&part);
        let is_off = off(part) || (is_constraint && off("constraint"));
        !is_off
    }
}
