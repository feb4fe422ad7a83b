//! URDF, versions 1.0 to 1.2.

mod build;
mod read;
mod table;

use roxmltree::Document;

use crate::document::Reader;
use crate::options::Options;
use crate::report::{Import, Problem};

/// The scene of a document, and what became of the rest of it.
pub(crate) fn import(document: &Document<'_>, options: &Options) -> Result<Import, Vec<Problem>> {
    let mut reader = Reader::new(document, options.lenient);
    let root = document.root_element();
    match root.tag_name().name() {
        "robot" => {}
        "mujoco" => reader.fail(root, "MJCF is not read yet; URDF is"),
        name => reader.fail(root, format!("the root is `{name}`; must be `robot` (URDF)")),
    }
    if !reader.has_failed() {
        reader.check(root, &table::ROBOT);
        let robot = read::robot(&mut reader, root);
        if !reader.has_failed() {
            let scene = build::scene(&mut reader, &robot, options);
            return reader.finish().map(|report| Import { scene, report });
        }
    }
    reader.finish().map(|report| Import { scene: plantd_models::Scene::default(), report })
}
