//! Meshes: how they show geoms, and what they weigh.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Quaternion, UnitQuaternion};
use plantd_models::scene::Shape;
use roxmltree::Node;

use crate::document::Reader;
use crate::inertia::Inertia;
use crate::mjcf::classes::Classes;
use crate::mjcf::settings::{Compilers, TINY};
use crate::mjcf::solids::{Placement, RULES, Rule, solid};
use crate::source::Files;
use crate::surface::Surface;

/// Meshes by name.
pub(super) struct Meshes<'a>(BTreeMap<&'a str, Mesh>);

struct Mesh {
    origin: Origin,
    placement: Placement,
    rule: Rule,
    /// What it weighs, or why that is not known, once it is asked for.
    solid: Option<Result<Inertia, String>>,
}

/// Where its surface comes from.
enum Origin {
    File(String),
    /// It is written out in the model.
    Written(Result<Surface, String>),
    /// MuJoCo makes it.
    BuiltIn,
}

impl<'a> Meshes<'a> {
    pub(super) fn read(
        reader: &mut Reader<'_>,
        root: Node<'a, 'a>,
        classes: &Classes<'a>,
        compilers: &Compilers,
    ) -> Self {
        let sections = root.children().filter(|node| node.has_tag_name("asset"));
        let meshes = sections.flat_map(|node| node.children());
        let mut all = BTreeMap::new();
        for node in meshes.filter(|node| node.has_tag_name("mesh")) {
            let settings = classes.settings(reader, node, classes.root(reader, node), "mesh");
            let file = node.attribute("file");
            let stem = file.unwrap_or_default().rsplit(['/', '\\']).next().unwrap_or_default();
            let stem = stem.rsplit_once('.').map_or(stem, |(stem, _)| stem);
            let origin = match (file, node.attribute("vertex")) {
                (Some(file), _) => {
                    let folder = compilers.of(reader, node).meshes.trim_end_matches('/');
                    let is_alone = folder.is_empty() || file.starts_with('/');
                    Origin::File(if is_alone {
                        file.to_owned()
                    } else {
                        format!("{folder}/{file}")
                    })
                }
                (None, Some(points)) => Origin::Written(written(reader, node, points)),
                (None, None) => Origin::BuiltIn,
            };
            let [w, x, y, z] = reader.vector_or(node, "refquat", [1.0, 0.0, 0.0, 0.0]);
            let turn = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), TINY);
            let placement = Placement {
                position: reader.vector_or(node, "refpos", [0.0; 3]),
                turn: turn.unwrap_or_default(),
                scale: settings.numbers(reader, "scale").unwrap_or([1.0; 3]),
            };
            let rule =
                settings.keyword(reader, "inertia", &RULES).map_or(Rule::default(), Rule::of);
            let mesh = Mesh { origin, placement, rule, solid: None };
            all.insert(node.attribute("name").unwrap_or(stem), mesh);
        }
        Self(all)
    }

    /// The file that shows a mesh, and where it stands.
    pub(super) fn shape(&self, name: &str) -> Option<(Shape, Isometry3<f64>)> {
        let Mesh { origin, placement, .. } = self.0.get(name)?;
        let Origin::File(file) = origin else { return None };
        let shape = Shape::Mesh { file: file.clone(), scale: placement.scale };
        Some((shape, placement.pose()))
    }

    /// Volume, or area of a shell, as mass, centre and tensor of a mesh; or why they are not known.
    pub(super) fn solid(
        &mut self,
        name: &str,
        files: Option<&mut Files<'_>>,
    ) -> Result<Inertia, String> {
        let Some(mesh) = self.0.get_mut(name) else {
            return Err(format!("there is no mesh `{name}`"));
        };
        let Mesh { origin, placement, rule, solid: known } = mesh;
        let find = || {
            let read;
            let (surface, what) = match origin {
                Origin::File(file) => {
                    let Some(files) = files else {
                        return Err(format!(
                            "the inertia is that of the mesh file `{file}`, which is not here: send it along, read the robot with `plantctl`, or give its body an `inertial`"
                        ));
                    };
                    let found = files(file).and_then(|bytes| Surface::read(file, &bytes));
                    read = found.map_err(|error| format!("mesh file `{file}`: {error}"))?;
                    (&read, format!("mesh file `{file}`"))
                }
                Origin::Written(Ok(surface)) => (&*surface, format!("mesh `{name}`")),
                Origin::Written(Err(error)) => return Err(format!("mesh `{name}`: {error}")),
                Origin::BuiltIn => {
                    return Err(format!(
                        "the inertia of mesh `{name}`, which MuJoCo makes: give its body an `inertial`"
                    ));
                }
            };
            solid(surface, *rule, placement).map_err(|error| format!("{what}: {error}"))
        };
        known.get_or_insert_with(find).clone()
    }
}

/// The surface that a mesh spells out.
fn written(reader: &mut Reader<'_>, node: Node<'_, '_>, points: &str) -> Result<Surface, String> {
    let points = reader.all_numbers(node, "vertex", points);
    let Some(faces) = node.attribute("face") else {
        return Err("its faces are not told: add `face`".to_owned());
    };
    let faces = reader.all_numbers(node, "face", faces);
    Surface::of_lists(&points, &faces)
}
