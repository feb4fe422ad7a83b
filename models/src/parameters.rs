//! Numbers of a scene, by the paths in which its errors are reported: `gravity[1]`,
//! `frames[pole].body.mass`, `springs[0].stiffness`. Entries of lists go by number or by name.
//!
//! ```
//! use plantd_models::parameters::{Parameters, change};
//! use plantd_models::{Model, builtin};
//!
//! let model = Model::compile(&builtin::scene("cart-pole").unwrap())?;
//! let heavier = change(&model, &Parameters::new(), &[("frames[cart].body.mass".to_owned(), 12.0)])?;
//! assert_eq!(heavier.former["frames[cart].body.mass"], 10.0);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

use std::collections::BTreeMap;

use plantd_scene::{Scene, SceneError, UnknownName};
use serde_json::Value;

use crate::model::mechanism::Model;

/// Numbers that differ from those of the model that a plant was made from, by path. A path has one
/// notation here: names where entries have them.
pub type Parameters = BTreeMap<String, f64>;

/// A changed scene, compiled, and what has been changed.
#[derive(Debug)]
pub struct Changed {
    /// The model of the changed scene.
    pub model: Model,
    /// All changes since the plant was made.
    pub parameters: Parameters,
    /// What the numbers were that these changes concern.
    pub former: Parameters,
}

/// Why a change was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ChangeError {
    /// The `index`-th change names no number, or none that may be changed.
    #[error("change {index}: {problem}")]
    Path {
        /// Which of the changes.
        index: usize,
        /// Why.
        problem: String,
    },
    /// The changed scene is refused.
    #[error(transparent)]
    Scene(SceneError),
    /// The changed scene has other coordinates, inputs or constraints.
    #[error("{0}")]
    Structure(String),
}

/// Changes numbers of a model's scene. `before` are the changes that led to this model.
pub fn change(
    model: &Model,
    before: &Parameters,
    changes: &[(String, f64)],
) -> Result<Changed, ChangeError> {
    let mut scene = serde_json::to_value(model.scene())
        .map_err(|error| ChangeError::Structure(error.to_string()))?;
    let (mut parameters, mut former) = (before.clone(), Parameters::new());
    let mut seen = BTreeMap::new();
    for (index, (path, value)) in changes.iter().enumerate() {
        let refuse = |problem: String| ChangeError::Path { index, problem };
        let (canonical, was) = set(&mut scene, path, *value).map_err(refuse)?;
        if let Some(first) = seen.insert(canonical.clone(), index) {
            return Err(refuse(format!("is that of entry {first}: `{canonical}`")));
        }
        former.insert(canonical.clone(), was);
        parameters.insert(canonical, *value);
    }
    let text = scene.to_string();
    let scene = Scene::from_json(&text).map_err(ChangeError::Scene)?;
    let changed = Model::compile(&scene).map_err(ChangeError::Scene)?;
    check_structure(model, &changed).map_err(ChangeError::Structure)?;
    Ok(Changed { model: changed, parameters, former })
}

/// The numbers of a scene that [`change`] can change, by path, in the order of the text. What the text
/// leaves out is not among them.
pub fn numbers(scene: &Scene) -> Vec<(String, f64)> {
    let mut found = Vec::new();
    if let Ok(scene) = serde_json::to_value(scene) {
        collect(&scene, String::new(), &mut found);
    }
    found.retain(|(path, _)| !matches!(path.as_str(), "format" | "time_step_s"));
    found
}

fn collect(place: &Value, path: String, found: &mut Vec<(String, f64)>) {
    match place {
        Value::Number(number) => found.extend(number.as_f64().map(|value| (path, value))),
        Value::Array(list) => {
            for (index, item) in list.iter().enumerate() {
                collect(item, path.clone() + &label(item, index), found);
            }
        }
        Value::Object(table) => {
            for (key, item) in table {
                let dot = if path.is_empty() { "" } else { "." };
                collect(item, format!("{path}{dot}{key}"), found);
            }
        }
        Value::Null | Value::Bool(_) | Value::String(_) => {}
    }
}

/// A change of numbers leaves everything that has a name as it was.
fn check_structure(model: &Model, changed: &Model) -> Result<(), String> {
    let names = |model: &Model| -> Vec<String> {
        let inputs = model.scene().inputs.iter().map(|input| format!("input {}", input.name));
        let constraints = model.constraint_names().iter().map(|name| format!("constraint {name}"));
        let coordinates =
            model.coordinates().iter().map(|c| format!("coordinate {} {:?}", c.name, c.kind));
        coordinates.chain(inputs).chain(constraints).collect()
    };
    let same = names(model) == names(changed)
        && model.dimensions() == changed.dimensions()
        && model.orientations() == changed.orientations();
    if same { Ok(()) } else { Err("change coordinates, inputs or constraints".to_owned()) }
}

/// One step of a path.
#[derive(Debug, PartialEq, Eq)]
enum Segment<'a> {
    Key(&'a str),
    Entry(&'a str),
}

/// Cuts `a[b].c` into its steps.
fn segments(path: &str) -> Result<Vec<Segment<'_>>, String> {
    let malformed = || "is not a path like `gravity[1]` or `frames[pole].body.mass`".to_owned();
    let mut segments = Vec::new();
    let mut rest = path;
    while !rest.is_empty() {
        if let Some(inner) = rest.strip_prefix('[') {
            let (entry, after) = inner.split_once(']').ok_or_else(malformed)?;
            segments.push(Segment::Entry(entry));
            rest = after;
            continue;
        }
        let key = match segments.is_empty() {
            true => rest,
            false => rest.strip_prefix('.').ok_or_else(malformed)?,
        };
        let end = key.find(['.', '[']).unwrap_or(key.len());
        if end == 0 {
            return Err(malformed());
        }
        segments.push(Segment::Key(&key[..end]));
        rest = &key[end..];
    }
    match segments.first() {
        Some(Segment::Key(_)) => Ok(segments),
        _ => Err(malformed()),
    }
}

/// Sets one number; returns its path in the one notation, and what it was. A key that is not there stands for a default
/// of the format; whether there is such a key shows when the scene is read.
fn set(scene: &mut Value, path: &str, value: f64) -> Result<(String, f64), String> {
    if !value.is_finite() {
        return Err(format!("`{path}` is to become {value}"));
    }
    let number = Value::from(value);
    let segments = segments(path)?;
    if matches!(segments[..], [Segment::Key("time_step_s" | "format")]) {
        return Err(format!("`{path}` is not a parameter; `time_step_s` of the request is"));
    }
    let mut canonical = String::new();
    let mut place = scene;
    for (depth, segment) in segments.iter().enumerate() {
        let next = segments.get(depth + 1);
        match segment {
            Segment::Key(key) => {
                let table =
                    place.as_object_mut().ok_or_else(|| format!("`{canonical}` has no keys"))?;
                if !canonical.is_empty() {
                    canonical.push('.');
                }
                canonical.push_str(key);
                if !table.contains_key(*key) {
                    let default = match next {
                        None => Value::from(0.0),
                        // Vectors that are zero are left out.
                        Some(Segment::Entry("0" | "1" | "2")) if depth + 2 == segments.len() => {
                            Value::from(vec![0.0; 3])
                        }
                        Some(_) => {
                            let known = UnknownName::among(key, table.keys());
                            return Err(format!("there is no `{canonical}`: no key {known}"));
                        }
                    };
                    table.insert((*key).to_owned(), default);
                }
                place = table.get_mut(*key).ok_or_else(|| format!("there is no `{canonical}`"))?;
            }
            Segment::Entry(entry) => {
                let list =
                    place.as_array_mut().ok_or_else(|| format!("`{canonical}` is not a list"))?;
                let index = match entry.parse() {
                    Ok(index) => Some(index),
                    Err(_) => list.iter().position(|item| name(item) == Some(entry)),
                };
                let among = match entry.parse::<usize>() {
                    Ok(_) => format!("it has {} entries, from 0 on", list.len()),
                    Err(_) => {
                        let known = list.iter().filter_map(name);
                        format!("no entry {}", UnknownName::among(entry, known))
                    }
                };
                let item = index
                    .and_then(|index: usize| list.get_mut(index))
                    .ok_or_else(|| format!("there is no `{canonical}[{entry}]`: {among}"))?;
                canonical.push_str(&label(item, index.unwrap_or_default()));
                place = item;
            }
        }
    }
    let former = place.as_f64().ok_or_else(|| format!("`{canonical}` is not a number"))?;
    *place = number;
    Ok((canonical, former))
}

/// An entry of a list in the one notation: by its name, unless that looks like a number.
fn label(item: &Value, index: usize) -> String {
    match name(item).filter(|name| name.parse::<usize>().is_err()) {
        Some(name) => format!("[{name}]"),
        None => format!("[{index}]"),
    }
}

fn name(item: &Value) -> Option<&str> {
    item.get("name")?.as_str()
}

#[cfg(test)]
mod tests {
    use super::*;
    use plantd_scene::builtin;

    fn model(name: &str) -> Model {
        Model::compile(&builtin::scene(name).unwrap()).unwrap()
    }

    fn one(model: &Model, path: &str, value: f64) -> Result<Changed, ChangeError> {
        change(model, &Parameters::new(), &[(path.to_owned(), value)])
    }

    #[test]
    fn numbers_are_set_by_number_and_by_name() {
        let model = model("cart-pole");
        let index = model.scene().frames.iter().position(|frame| frame.name == "pole").unwrap();
        let by_name = one(&model, "frames[pole].body.mass", 0.25).unwrap();
        let by_number = one(&model, &format!("frames[{index}].body.mass"), 0.25).unwrap();
        assert_eq!(by_name.model.scene(), by_number.model.scene());
        assert_eq!(by_name.parameters, by_number.parameters);
        assert_eq!(by_name.parameters["frames[pole].body.mass"], 0.25);
        let frame = &by_name.model.scene().frames[index];
        assert_eq!(frame.body.as_ref().unwrap().mass, 0.25);
        let gravity = one(&model, "gravity[1]", -3.7).unwrap();
        assert_eq!(gravity.model.scene().gravity.unwrap()[1], -3.7);
    }

    #[test]
    fn what_the_text_leaves_out_can_be_set() {
        let model = model("pendulum");
        assert_eq!(model.scene().damping, 0.0);
        assert_eq!(one(&model, "damping", 0.5).unwrap().model.scene().damping, 0.5);
        let name = &model.scene().frames[0].name;
        let moved = one(&model, &format!("frames[{name}].translation[2]"), 0.5).unwrap();
        assert_eq!(moved.model.scene().frames[0].translation, [0.0, 0.0, 0.5]);
    }

    #[test]
    fn changes_add_up_and_the_rest_stays() {
        let model = model("cart-pole");
        let first = one(&model, "gravity[1]", -3.7).unwrap();
        let mass = [("frames[pole].body.mass".to_owned(), 0.25)];
        let second = change(&first.model, &first.parameters, &mass).unwrap();
        assert_eq!(second.parameters.len(), 2);
        let back = [
            ("gravity[1]".to_owned(), model.scene().gravity.unwrap()[1]),
            (
                "frames[pole].body.mass".to_owned(),
                model
                    .scene()
                    .frames
                    .iter()
                    .find(|f| f.name == "pole")
                    .unwrap()
                    .body
                    .as_ref()
                    .unwrap()
                    .mass,
            ),
        ];
        let third = change(&second.model, &second.parameters, &back).unwrap();
        assert_eq!(third.model.scene(), model.scene());
        assert_eq!(third.model.digest(), model.digest());
    }

    #[test]
    fn every_number_that_is_listed_can_be_changed_under_its_path() {
        for name in ["cart-pole", "four-bar", "marionette"] {
            let model = model(name);
            let numbers = numbers(model.scene());
            let paths: std::collections::BTreeSet<_> =
                numbers.iter().map(|(path, _)| path).collect();
            assert!(numbers.len() > 5 && paths.len() == numbers.len(), "{name}");
            for (path, value) in &numbers {
                let same = one(&model, path, *value).unwrap();
                assert_eq!(same.former, Parameters::from([(path.clone(), *value)]));
                assert_eq!(same.model.scene(), model.scene());
            }
        }
        let cart_pole = numbers(model("cart-pole").scene());
        assert!(cart_pole.contains(&("frames[pole].body.mass".to_owned(), 1.0)), "{cart_pole:?}");
        assert!(cart_pole.contains(&("gravity[1]".to_owned(), -9.8)), "{cart_pole:?}");
    }

    #[test]
    fn what_is_no_number_is_refused() {
        let model = model("cart-pole");
        for path in [
            "",
            "[0]",
            "gravity[",
            "gravity.x",
            "gravity[3]",
            "gravity",
            "frames[nobody].body.mass",
            "frames[pole].body",
            "frames[pole].name",
            "frames[pole]body",
            "frames[pole]..body",
            "name",
            "format",
            "time_step_s",
            "springs[0].stiffness",
        ] {
            let error = one(&model, path, 1.0).unwrap_err();
            assert!(matches!(error, ChangeError::Path { index: 0, .. }), "{path}: {error:?}");
        }
        for path in ["frames[pole].body.colour", "viscosity"] {
            assert!(matches!(one(&model, path, 1.0), Err(ChangeError::Scene(_))), "{path}");
        }
        assert!(matches!(one(&model, "gravity[1]", f64::NAN), Err(ChangeError::Path { .. })));
        assert!(matches!(one(&model, "frames[pole].body.mass", -1.0), Err(ChangeError::Scene(_))));
        let twice = [("gravity[1]".to_owned(), 1.0), ("gravity[1]".to_owned(), 2.0)];
        let error = change(&model, &Parameters::new(), &twice).unwrap_err();
        assert!(matches!(error, ChangeError::Path { index: 1, .. }));
    }
}
