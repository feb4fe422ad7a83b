//! Models that an MJCF attaches, put in their places: a body, a frame or all of another file, under names of its
//! own.
//!
//! What is attached keeps its own `compiler` and its own default classes, for which each attachment is a model of
//! its own, [`Source::model_at`]; the rest of its file comes at the end.

use std::ops::Range;

use roxmltree::{Document, Node};

use plantd_models::scene::MAX_TEXT_BYTES;

use crate::report::Problem;
use crate::source::{FILES_DEEP, Files, Source, Text};
use crate::xml;

/// Attachments at most, those within one another counted.
const ATTACHED_MAX: usize = 256;

/// Attributes that name something of the model.
const NAMES: [&str; 33] = [
    "name",
    "class",
    "childclass",
    "joint",
    "joint1",
    "joint2",
    "jointinparent",
    "tendon",
    "tendon1",
    "tendon2",
    "site",
    "site1",
    "site2",
    "refsite",
    "slidersite",
    "cranksite",
    "body",
    "body1",
    "body2",
    "geom",
    "geom1",
    "geom2",
    "sidesite",
    "mesh",
    "material",
    "texture",
    "hfield",
    "target",
    "objname",
    "refname",
    "actuator",
    "skin",
    "flex",
];

/// Another file, and how its names begin.
struct Attached {
    text: Text,
    prefix: String,
}

/// A text with what it includes, and what it attaches, in their places.
pub(crate) fn whole<'t>(text: &'t str, files: &mut Files<'_>) -> Result<Source<'t>, Vec<Problem>> {
    let (mut source, text) = Source::joined(text, files)?;
    let text = expand(&mut source, text, files, 0)?;
    Ok(source.of_text(text))
}

/// The text with what it attaches in place; as it is where it attaches nothing.
fn expand(
    source: &mut Source<'_>,
    text: Text,
    files: &mut Files<'_>,
    depth: usize,
) -> Result<Text, Vec<Problem>> {
    if !text.joined.contains("<attach") {
        return Ok(text);
    }
    // Where it is no XML, who reads it says so.
    let Ok(document) = xml::open(&text.joined) else { return Ok(text) };
    let root = document.root_element();
    let end = root.range().start + text.joined[root.range()].rfind("</").unwrap_or_default();
    let mut out = Text::of(text.model);
    let (mut all, mut at) = (Vec::new(), 0);
    for node in root.descendants().filter(|node| node.has_tag_name("attach")) {
        let fail = |source: &Source<'_>, message: String| {
            vec![source.problem_in(&text, node.range().start, message)]
        };
        let required = |name: &str| {
            node.attribute(name).ok_or_else(|| format!("`attach` has no attribute `{name}`"))
        };
        let [model, prefix] = ["model", "prefix"].map(required);
        let (model, prefix) =
            model.and_then(|model| Ok((model, prefix?))).map_err(|why| fail(source, why))?;
        if source.models.len() > ATTACHED_MAX || depth > FILES_DEEP {
            let message = format!(
                "more than {ATTACHED_MAX} models are attached, or more than {FILES_DEEP} to one another"
            );
            return Err(fail(source, message));
        }
        let file = file_of(source, &text, root, model, files).map_err(|why| fail(source, why))?;
        let read = source.model(&file, files).map_err(|why| fail(source, why))??;
        let read = expand(source, read, files, depth + 1)?;
        let attached = Attached { text: read, prefix: prefix.to_owned() };
        out.copy(&text, at..node.range().start);
        attached.put_part(node, &mut out).map_err(|why| fail(source, why))?;
        at = node.range().end;
        all.push(attached);
        let size: usize = all.iter().map(|attached| attached.text.joined.len()).sum();
        if out.joined.len() + size > MAX_TEXT_BYTES {
            let message =
                format!("with what it attaches the text has more than {MAX_TEXT_BYTES} bytes");
            return Err(fail(source, message));
        }
    }
    out.copy(&text, at..end);
    for attached in &all {
        attached.put_rest(&mut out);
    }
    out.copy(&text, end..text.joined.len());
    Ok(out)
}

/// The file of a model, by the name in `asset` or else by that in the file.
fn file_of(
    source: &Source<'_>,
    text: &Text,
    root: Node<'_, '_>,
    name: &str,
    files: &mut Files<'_>,
) -> Result<String, String> {
    let sections = root.children().filter(|node| node.has_tag_name("asset"));
    let models = sections.flat_map(|node| node.children()).filter(|n| n.has_tag_name("model"));
    let mut known = Vec::new();
    for node in models {
        let Some(file) = node.attribute("file") else {
            return Err("`model` in `asset` has no attribute `file`".to_owned());
        };
        // Beside the file that attaches it.
        let file = match source.models[text.model].as_str() {
            "" => file.to_owned(),
            folder => format!("{folder}/{file}"),
        };
        let own = match node.attribute("name") {
            Some(own) => own.to_owned(),
            None => {
                let (_, text) = source.beside(0, &file, files)?;
                let own = xml::open(&text).ok();
                let own = own.and_then(|d| d.root_element().attribute("model").map(str::to_owned));
                own.unwrap_or_default()
            }
        };
        if own == name {
            return Ok(file);
        }
        known.push(format!("`{own}`"));
    }
    let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
    Err(format!("there is no model `{name}` in `asset`; there is {known}"))
}

impl Attached {
    fn document(&self) -> Option<Document<'_>> {
        xml::open(&self.text.joined).ok()
    }

    /// Writes the body or frame that an `attach` names, or all that is in the world.
    fn put_part(&self, attach: Node<'_, '_>, out: &mut Text) -> Result<(), String> {
        let Some(document) = self.document() else {
            return Err("what is attached is no XML".to_owned());
        };
        let root = document.root_element();
        if !root.has_tag_name("mujoco") {
            let name = root.tag_name().name();
            return Err(format!("the root of what is attached is `{name}`; must be `mujoco`"));
        }
        let worlds = || root.children().filter(|node| node.has_tag_name("worldbody"));
        let part =
            ["body", "frame"].into_iter().find_map(|tag| Some((tag, attach.attribute(tag)?)));
        let Some((tag, name)) = part else {
            for node in worlds().flat_map(|world| world.children()).filter(Node::is_element) {
                self.put(node, out);
            }
            return Ok(());
        };
        let found = worlds()
            .flat_map(|world| world.descendants())
            .find(|node| node.has_tag_name(tag) && node.attribute("name") == Some(name));
        let found =
            found.ok_or_else(|| format!("there is no {tag} `{name}` in what is attached"))?;
        self.put(found, out);
        Ok(())
    }

    /// Writes all but the world; its outermost default class first.
    fn put_rest(&self, out: &mut Text) {
        let Some(document) = self.document() else { return };
        let root = document.root_element();
        let main = format!("<default class=\"{}main\"/>", self.prefix);
        out.insert(&main, &self.text, root.range().start);
        for node in root.children().filter(Node::is_element) {
            if !node.has_tag_name("worldbody") {
                self.put(node, out);
            }
        }
    }

    /// Writes an element with the prefix before all names.
    fn put(&self, element: Node<'_, '_>, out: &mut Text) {
        let Range { start, end } = element.range();
        let mut at = start;
        for node in element.descendants().filter(Node::is_element) {
            let tag = node.tag_name().name();
            if tag == "mesh" && !node.has_attribute("name") && node.has_attribute("file") {
                let file = node.attribute("file").unwrap_or_default();
                let file = file.rsplit(['/', '\\']).next().unwrap_or_default();
                let stem = file.rsplit_once('.').map_or(file, |(stem, _)| stem);
                let here = node.range().start + 1 + tag.len();
                out.copy(&self.text, at..here);
                let stem = stem.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;");
                out.insert(&format!(" name=\"{}{stem}\"", self.prefix), &self.text, here);
                at = here;
            }
            for attribute in node.attributes() {
                let value = attribute.value();
                let is_name = NAMES.contains(&attribute.name()) && !value.is_empty();
                let is_world = value == "world" && attribute.name().starts_with("body");
                if is_name && !is_world {
                    let here = attribute.range_value().start;
                    out.copy(&self.text, at..here);
                    out.insert(&self.prefix, &self.text, here);
                    at = here;
                }
            }
        }
        out.copy(&self.text, at..end);
    }
}
