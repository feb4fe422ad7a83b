//! URDF, versions 1.0 to 1.2.

mod build;
mod read;
mod table;
mod visuals;

use plantd_models::Scene;
use roxmltree::Node;

use crate::document::Reader;
use crate::options::Options;

/// The scene of a robot; none where something has failed.
pub(crate) fn scene<'a>(
    reader: &mut Reader<'a>,
    root: Node<'a, 'a>,
    options: &Options,
) -> Option<Scene> {
    reader.check(root, &table::ROBOT);
    let robot = read::robot(reader, root);
    (!reader.has_failed()).then(|| build::scene(reader, &robot, options))
}
