//! What is known while a scene is made.

use std::collections::BTreeMap;

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

/// Elements outside of bodies at most, with those that are copied along.
const ELEMENTS_MAX: usize = 1 << 16;

/// Attributes that name a body, a joint, a site or a tendon, and which of these.
const REFERENCES: [(&str, usize); 17] = [
    ("body", 0),
    ("body1", 0),
    ("body2", 0),
    ("joint", 1),
    ("joint1", 1),
    ("joint2", 1),
    ("jointinparent", 1),
    ("site", 2),
    ("site1", 2),
    ("site2", 2),
    ("refsite", 2),
    ("sidesite", 2),
    ("slidersite", 2),
    ("cranksite", 2),
    ("tendon", 3),
    ("tendon1", 3),
    ("tendon2", 3),
];

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
    /// What replications append to tendons, by name.
    pub(super) copied_tendons: BTreeMap<&'a str, Vec<String>>,
    /// What is appended to the copy that is being read of an element.
    pub(super) ending: String,
    /// Once it is asked for.
    pub(super) mobility: Option<Option<Mobility>>,
}

impl<'a> Build<'_, 'a, '_> {
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

    /// The children of all sections of a name, each with what is appended to its name and to those of what it
    /// refers to: one that refers to replicated things is copied along with them. Copies come last, one after the
    /// other, as in MuJoCo.
    pub(super) fn elements(&mut self, name: &'static str) -> Vec<(Node<'a, 'a>, String)> {
        let mut all = Vec::new();
        let mut copies: Vec<(Vec<String>, Vec<Node<'a, 'a>>)> = Vec::new();
        let mut count = 0;
        for node in Self::section(self.root, name) {
            let endings = match self.endings(node) {
                Ok(endings) => endings,
                Err(true) => {
                    let message = "an equality between what is replicated and what is not: MuJoCo leaves it out";
                    self.reader.note(Kind::NoEffect, node, message);
                    continue;
                }
                Err(false) => {
                    let message = "it refers to copies of two replications: write the copies out";
                    self.reader.refuse(node, message);
                    continue;
                }
            };
            count += endings.len().max(1);
            if count > ELEMENTS_MAX {
                let message =
                    format!("more than {ELEMENTS_MAX} in `{name}`, the copied ones counted");
                self.reader.fail(node, message);
                return all;
            }
            if endings.is_empty() {
                all.push((node, String::new()));
            } else if let Some((_, nodes)) = copies.iter_mut().find(|(known, _)| *known == endings)
            {
                nodes.push(node);
            } else {
                copies.push((endings, vec![node]));
            }
        }
        for (endings, nodes) in copies {
            for ending in endings {
                all.extend(nodes.iter().map(|node| (*node, ending.clone())));
            }
        }
        all
    }

    /// What replications append to the names that an element refers to; nothing where they append nothing. It is
    /// no copy where an equality refers to others too (true), or anything to those of two replications (false).
    fn endings(&self, node: Node<'a, 'a>) -> Result<Vec<String>, bool> {
        let (mut found, mut others): (Option<&[String]>, bool) = (None, false);
        for part in node.descendants().filter(Node::is_element) {
            for (attribute, kind) in REFERENCES {
                let Some(name) = part.attribute(attribute) else { continue };
                let endings = match kind {
                    3 => self.copied_tendons.get(name).map(Vec::as_slice),
                    kind => self.tree.endings(kind, name),
                };
                match (endings, found) {
                    (None, _) => others = true,
                    (Some(endings), Some(found)) if endings != found => return Err(false),
                    (Some(endings), _) => found = Some(endings),
                }
            }
        }
        let is_equality = node.parent().is_some_and(|parent| parent.has_tag_name("equality"));
        match found {
            Some(_) if is_equality && others => Err(true),
            found => Ok(found.unwrap_or_default().to_vec()),
        }
    }

    /// An element's name, with what is appended.
    pub(super) fn name_of(&self, node: Node<'_, '_>, default: &str) -> String {
        match node.attribute("name") {
            Some(name) if !name.is_empty() => format!("{name}{}", self.ending),
            _ => default.to_owned(),
        }
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
        let copy = (!self.ending.is_empty()).then(|| format!("{name}{}", self.ending));
        let found = found(self, name).or_else(|| found(self, &copy?));
        if found.is_none() && self.reader.model_of(node) != 0 {
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
