//! Scenes as text: TOML, JSON, and the JSON Schema.

use crate::limits::MAX_TEXT_BYTES;
use crate::number_or_name::SEPARATOR;
use crate::scene::{Problem, Scene, SceneError};
use crate::words::in_plain_words;

impl Scene {
    /// Reads TOML.
    pub fn from_toml(text: &str) -> Result<Self, SceneError> {
        check_size(text)?;
        let deserializer =
            toml::Deserializer::parse(text).map_err(|e| toml_error(String::new(), &e, text))?;
        serde_path_to_error::deserialize(deserializer).map_err(|e| {
            let path = path_of(e.path());
            within(&path, e.inner().message()).unwrap_or_else(|| toml_error(path, e.inner(), text))
        })
    }

    /// Reads JSON.
    pub fn from_json(text: &str) -> Result<Self, SceneError> {
        check_size(text)?;
        let mut deserializer = serde_json::Deserializer::from_str(text);
        let scene = serde_path_to_error::deserialize(&mut deserializer).map_err(|e| {
            let (path, message) = (path_of(e.path()), e.inner().to_string());
            let position = format!(" at line {} column {}", e.inner().line(), e.inner().column());
            let alone = message.strip_suffix(&position).unwrap_or(&message);
            within(&path, alone)
                .unwrap_or_else(|| single(path, format!("{}{position}", in_plain_words(alone))))
        })?;
        deserializer.end().map_err(|e| single(String::new(), e.to_string()))?;
        Ok(scene)
    }

    /// Reads JSON if the first character that is not white space is `{`, else TOML.
    pub fn from_text(text: &str) -> Result<Self, SceneError> {
        if text.trim_start().starts_with('{') {
            Self::from_json(text)
        } else {
            Self::from_toml(text)
        }
    }

    /// Writes TOML, which reads back as an equal scene.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("a scene has string keys and no values that TOML lacks")
    }

    /// The JSON Schema of the format.
    pub fn json_schema() -> serde_json::Value {
        schemars::schema_for!(Scene).to_value()
    }
}

fn check_size(text: &str) -> Result<(), SceneError> {
    if text.len() <= MAX_TEXT_BYTES {
        return Ok(());
    }
    let message = format!("the text has {} bytes; at most {MAX_TEXT_BYTES} are read", text.len());
    Err(single(String::new(), message))
}

fn single(path: String, message: String) -> SceneError {
    SceneError { problems: vec![Problem { path, message }] }
}

/// The path as a person writes it; empty for the scene itself.
fn path_of(path: &serde_path_to_error::Path) -> String {
    if path.iter().next().is_none() { String::new() } else { path.to_string() }
}

/// The error of a message that says where in the element at `path` it belongs. The position that goes with
/// it is the element's, and is left out.
fn within(path: &str, message: &str) -> Option<SceneError> {
    let (field, message) = message.strip_prefix(SEPARATOR)?.split_once(SEPARATOR)?;
    Some(single(format!("{path}.{field}"), in_plain_words(message)))
}

fn toml_error(path: String, error: &toml::de::Error, text: &str) -> SceneError {
    let message = match error.span() {
        Some(span) => {
            let (line, column) = line_and_column(text, span.start);
            format!("{} at line {line} column {column}", in_plain_words(error.message()))
        }
        None => in_plain_words(error.message()),
    };
    single(path, message)
}

/// Counted from 1, columns in characters.
fn line_and_column(text: &str, byte: usize) -> (usize, usize) {
    let before = &text.as_bytes()[..byte.min(text.len())];
    let line = before.iter().filter(|&&b| b == b'\n').count() + 1;
    let start = before.iter().rposition(|&b| b == b'\n').map_or(0, |i| i + 1);
    (line, String::from_utf8_lossy(&before[start..]).chars().count() + 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::builtin;

    #[test]
    fn every_builtin_scene_survives_toml_and_json() {
        for name in builtin::NAMES {
            let scene = builtin::scene(name).unwrap();
            assert_eq!(Scene::from_text(&scene.to_toml()).unwrap(), scene, "{name}");
            let json = serde_json::to_string_pretty(&scene).unwrap();
            assert_eq!(Scene::from_text(&json).unwrap(), scene, "{name}");
        }
    }

    #[test]
    fn syntax_and_type_errors_carry_path_and_position() {
        let good = "format = 1\nname = \"a\"\n[[frames]]\nname = \"arm\"\n";
        Scene::from_toml(good).unwrap();
        let cases: &[(&str, &str, &str)] = &[
            ("format = ", "", "line 1 column 10"),
            ("format = 1\nname = 3\nframes = []", "name", "line 2 column 8"),
            ("format = -1\nname = \"a\"\nframes = []", "format", "line 1 column 10"),
            (&format!("{good}mass = 1.0"), "frames[0].mass", "there is no key `mass`"),
            (
                &format!("{good}body = {{ mass = \"1\" }}"),
                "frames[0].body.mass",
                "line 5 column 17",
            ),
            (
                &format!("{good}joint = {{ type = \"bowl\" }}"),
                "frames[0].joint.type",
                "there is no `bowl`",
            ),
            (
                &format!(
                    "{good}[[forces]]\ntype = \"body_wrench\"\nframe = \"arm\"\ntorque = [0, \"tau\", true]"
                ),
                "forces[0].torque[2]",
                "boolean `true` is given; a number, the name of an input, or a table of input and gain is needed",
            ),
            (
                &format!(
                    "{good}[[forces]]\ntype = \"hybrid_wrench\"\nframe = \"arm\"\nforce = [0, 1]"
                ),
                "forces[0].force",
                "a list of 3 is needed",
            ),
            (
                &format!(
                    "{good}[[constraints]]\ntype = \"distance\"\nname = \"rod\"\na = {{ frame = \"arm\" }}\nb = {{ frame = \"world\" }}\nlength = [1.0]"
                ),
                "constraints[0].length",
                "a number of metres or the name of a prescribed coordinate is needed",
            ),
            (
                &format!("{good}joint = {{ type = \"revolute\", axis = [1, 0] }}"),
                "frames[0].joint",
                "a list of 3 is needed",
            ),
            ("format = 1\nname = \"a\"", "", "`frames` is missing"),
            (
                "{\"format\": 1, \"name\": \"a\", \"frames\": [], \"forces\": [\n{\"type\": \"spatial_wrench\", \"frame\": \"a\", \"force\": [0, [], 1]}]}",
                "forces[0].force[1]",
                "a list is given; a number, the name of an input, or a table of input and gain is needed",
            ),
            (
                "{\"format\": 1, \"name\": \"a\", \"frames\": [], \"forces\": [\n{\"type\": \"spatial_wrench\", \"frame\": \"a\", \"force\": [0, {\"input\": \"u\"}, 1]}]}",
                "forces[0].force[1]",
                "`gain` is missing",
            ),
            ("{\"format\": 1, \"name\": 3, \"frames\": []}", "name", "line 1 column 23"),
            ("{\"format\": 1, \"name\": \"a\", \"frames\": []} x", "", "trailing characters"),
            (
                "{\"format\": 1, \"name\": \"a\", \"frames\": [], \"time_step_s\": 1e999}",
                "time_step_s",
                "out of range",
            ),
            (&format!("format = {}", "[".repeat(100_000)), "", "at line 1"),
            (
                &format!("{{\"frames\": {}", "[".repeat(100_000)),
                "frames[0][0]",
                "a string is needed",
            ),
        ];
        let mut wrong = Vec::new();
        for (text, path, message) in cases {
            let error = Scene::from_text(text).unwrap_err();
            let [problem] = &error.problems[..] else { panic!("{error}") };
            if problem.path != *path || !problem.message.contains(message) {
                wrong.push(format!("{problem:?} instead of `{path}`: `{message}`"));
            }
        }
        assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    }

    #[test]
    fn oversized_text_is_refused_unread() {
        let error = Scene::from_text(&" ".repeat(MAX_TEXT_BYTES + 1)).unwrap_err();
        assert!(error.to_string().contains("at most"), "{error}");
    }

    /// `PLANTD_BLESS=1` rewrites the committed schema.
    #[test]
    fn committed_schema_is_current() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../scenes/scene.schema.json");
        let current = serde_json::to_string_pretty(&Scene::json_schema()).unwrap() + "\n";
        if std::env::var_os("PLANTD_BLESS").is_some() {
            std::fs::write(path, &current).unwrap();
        }
        assert_eq!(std::fs::read_to_string(path).unwrap(), current, "run with PLANTD_BLESS=1");
    }
}
