//! Meshes that show geoms.

use std::collections::BTreeMap;

use plantd_models::scene::Shape;
use roxmltree::Node;

use crate::document::Reader;
use crate::mjcf::classes::{Classes, MAIN};

/// Meshes by name.
pub(super) struct Meshes<'a>(BTreeMap<&'a str, Shape>);

impl<'a> Meshes<'a> {
    pub(super) fn read(
        reader: &mut Reader<'_>,
        root: Node<'a, 'a>,
        classes: &Classes<'a>,
        folder: &str,
    ) -> Self {
        let sections = root.children().filter(|node| node.has_tag_name("asset"));
        let meshes = sections.flat_map(|node| node.children());
        let mut all = BTreeMap::new();
        for node in meshes.filter(|node| node.has_tag_name("mesh")) {
            let settings = classes.settings(reader, node, MAIN, "mesh");
            let Some(file) = node.attribute("file") else { continue };
            let stem = file.rsplit(['/', '\\']).next().unwrap_or(file);
            let stem = stem.rsplit_once('.').map_or(stem, |(stem, _)| stem);
            let scale = settings.numbers(reader, "scale").unwrap_or([1.0; 3]);
            let folder = folder.trim_end_matches('/');
            let is_alone = folder.is_empty() || file.starts_with('/');
            let file = if is_alone { file.to_owned() } else { format!("{folder}/{file}") };
            let name = node.attribute("name").unwrap_or(stem);
            all.insert(name, Shape::Mesh { file, scale });
        }
        Self(all)
    }

    pub(super) fn shape(&self, name: &str) -> Option<Shape> {
        self.0.get(name).cloned()
    }
}
