//! What is known while a scene is made.

use nalgebra::Isometry3;
use plantd_models::scene::Point;
use roxmltree::Node;

use crate::document::Reader;
use crate::draft::Draft;
use crate::mjcf::classes::Classes;
use crate::mjcf::settings::{Compilers, Physics};
use crate::mjcf::start::Mobility;
use crate::mjcf::tree::Tree;
use crate::names::Names;
use crate::options::Options;
use crate::report::Kind;

/// Makes the scene.
pub(super) struct Build<'r, 'a, 'd> {
    pub(super) reader: &'r mut Reader<'d>,
    pub(super) root: Node<'a, 'a>,
    pub(super) classes: &'r Classes<'a>,
    pub(super) compilers: &'r Compilers,
    pub(super) physics: &'r Physics,
    pub(super) tree: &'r Tree<'a>,
    pub(super) options: &'r Options,
    pub(super) draft: Draft,
    /// Names of the frames of bodies.
    pub(super) frames: Vec<String>,
    /// Names of the coordinates of joints.
    pub(super) coordinates: Vec<Vec<String>>,
    /// Names of the frames that have the joints.
    pub(super) carriers: Vec<String>,
    /// Where bodies stand in the file.
    pub(super) home: Vec<Isometry3<f64>>,
    pub(super) inputs: Names,
    /// Once it is asked for.
    pub(super) mobility: Option<Option<Mobility>>,
}

impl Build<'_, '_, '_> {
    /// The frame of a body, or the world.
    pub(super) fn frame(&self, body: Option<usize>) -> String {
        body.map_or_else(|| "world".to_owned(), |body| self.frames[body].clone())
    }

    /// Where a body stands in the file.
    pub(super) fn home(&self, body: Option<usize>) -> Isometry3<f64> {
        body.map_or_else(Isometry3::identity, |body| self.home[body])
    }

    pub(super) fn point(&self, body: Option<usize>, at: [f64; 3]) -> Point {
        Point { frame: self.frame(body), at }
    }

    /// The children of all sections of a name.
    pub(super) fn section<'n>(root: Node<'n, 'n>, name: &'static str) -> Vec<Node<'n, 'n>> {
        let sections = root.children().filter(move |node| node.has_tag_name(name));
        sections.flat_map(|node| node.children().filter(Node::is_element)).collect()
    }

    /// What an attribute names, among what there is of its kind.
    pub(super) fn find<T>(
        &mut self,
        node: Node<'_, '_>,
        attribute: &str,
        what: &str,
        found: impl Fn(&Self, &str) -> Option<T>,
    ) -> Option<T> {
        let name = self.reader.required(node, attribute);
        let found = found(self, name);
        if found.is_none() && self.tree.is_copied(name) {
            let message = format!(
                "`{name}` is replicated, and what refers to it is not copied along: write the copies out"
            );
            self.reader.refuse(node, message);
        } else if found.is_none() && self.reader.model_of(node) != 0 {
            let message = format!("`{name}` is not attached along; what refers to it is left out");
            self.reader.note(Kind::NoEffect, node, message);
        } else if found.is_none() && !name.is_empty() {
            self.reader.fail(node, format!("there is no {what} `{name}`"));
        }
        found
    }

    /// How coordinates answer to forces in the configuration of the file; none where the mass matrix is not
    /// positive definite. Asked for once all bodies stand.
    pub(super) fn mobility(&mut self) -> Option<&Mobility> {
        let scene = &self.draft.scene;
        self.mobility.get_or_insert_with(|| Mobility::of(scene)).as_ref()
    }
}
