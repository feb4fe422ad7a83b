//! MJCF, as MuJoCo 4 reads it.

mod actuators;
mod assets;
mod build;
mod classes;
mod equalities;
mod frames;
mod geoms;
mod hull;
mod joints;
mod keyframes;
mod rope;
mod rotors;
mod settings;
mod shapes;
mod solids;
mod start;
mod table;
mod tendons;
mod tree;

use std::collections::BTreeMap;

use plantd_models::Scene;
use roxmltree::Node;

use crate::document::Reader;
use crate::draft::Draft;
use crate::mjcf::build::Build;
use crate::mjcf::classes::Classes;
use crate::mjcf::settings::{Compilers, Physics};
use crate::mjcf::tendons::Tendons;
use crate::names::Names;
use crate::options::{Base, Inputs, Options};
use crate::report::Kind;
use crate::source::Files;
use crate::table::NO_CONTACT;

/// The scene of a model; none where something has failed.
pub(crate) fn scene<'a>(
    reader: &mut Reader<'a>,
    root: Node<'a, 'a>,
    options: &Options,
    files: Option<&mut Files<'_>>,
) -> Option<Scene> {
    // Wherever they stand; those whose files are at hand are not here any more.
    for node in root.descendants() {
        if let Some(tag) = ["include", "attach"].into_iter().find(|tag| node.has_tag_name(*tag)) {
            let message = format!(
                "`{tag}`: read the file with `plantctl import`, where the other files are, or send them along"
            );
            reader.fail(node, message);
        }
    }
    reader.check(root, &table::MUJOCO);
    if options.base == Base::Free {
        let message = "an MJCF says itself which of its bodies are free";
        reader.note(Kind::NoEffect, root, message);
    }
    let classes = Classes::read(reader, root);
    let compilers = Compilers::read(reader, root);
    let physics = Physics::read(reader, root, options);
    let tree = tree::read(reader, root, &classes, &compilers, files);
    if reader.has_failed() {
        return None;
    }
    let mut build = Build {
        root,
        classes: &classes,
        compilers: &compilers,
        physics: &physics,
        options,
        draft: Draft::new("MJCF", physics.gravity, physics.time_step_s, options.stops),
        frames: Vec::new(),
        coordinates: vec![Vec::new(); tree.joints.len()],
        carriers: vec![String::new(); tree.joints.len()],
        home: tree.poses(|joint| joint.reference),
        tree: &tree,
        inputs: Names::new("input", &[]),
        copied_tendons: BTreeMap::new(),
        ending: String::new(),
        mobility: None,
        reader,
    };
    build.place_bodies();
    let tendons = Tendons::read(&mut build);
    // All inertia first, from which springs and dampers may follow.
    build.load(&tendons);
    build.carry(&tendons);
    build.adjust_springs();
    build.stretch(&tendons);
    build.constrain(&tendons);
    let controls = match options.inputs {
        Inputs::AsTold => build.actuate(&tendons),
        Inputs::All => {
            build.drive_all();
            Vec::new()
        }
        Inputs::None => Vec::new(),
    };
    build.add_operating_points(&controls);
    if let Some((node, count)) = tree.touching.filter(|_| physics.has("contact")) {
        let message = format!("{count} shapes may touch: {NO_CONTACT}");
        build.reader.note(Kind::Contact, node, message);
    }
    Some(build.draft.finish(build.reader, root.attribute("model").unwrap_or("robot")))
}
