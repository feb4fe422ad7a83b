//! Shapes that show links.

use std::collections::BTreeMap;

use plantd_models::scene::{MAX_FILE_BYTES, Shape, Visual};
use roxmltree::Node;

use crate::document::{Reader, list};
use crate::options::Options;
use crate::report::Kind;
use crate::urdf::read::{origin, rotation};

/// Colours of materials by name.
pub(super) struct Colors<'a>(BTreeMap<&'a str, [f64; 4]>);

impl<'a> Colors<'a> {
    /// Those of the whole robot.
    pub(super) fn read(robot: Node<'a, 'a>) -> Self {
        let mut all = BTreeMap::new();
        for material in robot.descendants().filter(|node| node.has_tag_name("material")) {
            if let (Some(name), Some(color)) = (material.attribute("name"), color(material)) {
                all.entry(name).or_insert(color);
            }
        }
        Self(all)
    }
}

fn color(material: Node<'_, '_>) -> Option<[f64; 4]> {
    let color = material.children().find(|child| child.has_tag_name("color"))?;
    numbers(color, "rgba").map(|rgba| rgba.map(|part| part.clamp(0.0, 1.0)))
}

/// Numbers that are good, or none.
fn numbers<const N: usize>(node: Node<'_, '_>, name: &str) -> Option<[f64; N]> {
    list(node.attribute(name)?, N)?.try_into().ok()
}

/// The shapes of a link. What cannot be shown is no error: it does not move anything.
pub(super) fn visuals<'a>(
    reader: &mut Reader<'_>,
    link: Node<'a, 'a>,
    colors: &Colors<'a>,
    options: &Options,
) -> Vec<Visual> {
    let mut all = Vec::new();
    for node in link.children().filter(|node| node.has_tag_name("visual")) {
        let at = origin(reader, node);
        let material = node.children().find(|child| child.has_tag_name("material"));
        let own = material.and_then(color);
        let named = material.and_then(|material| material.attribute("name"));
        let color = own.or_else(|| colors.0.get(named?).copied());
        let geometry = node.children().find(|child| child.has_tag_name("geometry"));
        let Some(shape) = geometry.and_then(|geometry| shape(geometry, options)) else {
            reader.note(Kind::NoEffect, node, "`visual` without a shape that can be shown");
            continue;
        };
        all.push(Visual { shape, translation: at.xyz, rotation: rotation(&at), color });
    }
    all
}

fn shape(geometry: Node<'_, '_>, options: &Options) -> Option<Shape> {
    let node = geometry.children().find(Node::is_element)?;
    let length = |name: &str| {
        let [length] = numbers(node, name)?;
        (length > 0.0).then_some(length)
    };
    Some(match node.tag_name().name() {
        "box" => {
            let size = numbers(node, "size")?;
            size.iter().all(|edge| *edge > 0.0).then_some(Shape::Box { size })?
        }
        "sphere" => Shape::Sphere { radius: length("radius")? },
        "cylinder" => Shape::Cylinder { radius: length("radius")?, length: length("length")? },
        "capsule" => Shape::Capsule { radius: length("radius")?, length: length("length")? },
        "mesh" => {
            let file = options.path(node.attribute("filename")?);
            let scale =
                if node.has_attribute("scale") { numbers(node, "scale")? } else { [1.0; 3] };
            let is_shown = (1..=MAX_FILE_BYTES).contains(&file.len()) && !scale.contains(&0.0);
            is_shown.then_some(Shape::Mesh { file, scale })?
        }
        _ => return None,
    })
}
