//! Faulty scenes as data: what is changed in a good scene, and where the problems must be.

use super::*;
use crate::builtin;

/// A good scene with one of everything.
const GOOD: &str = r#"
format = 1
name = "good"
time_step_s = 0.01
gravity = [0.0, 0.0, -9.8]
damping = 0.1

[[frames]]
name = "arm"
joint = { type = "revolute", axis = [0.0, 1.0, 0.0], coordinate = "elbow" }
body = { mass = 1.0, center_of_mass = [0.0, 0.0, -1.0], inertia = [0.1, 0.1, 0.0, 0.0, 0.0, 0.0] }

[[frames]]
name = "hand"
parent = "arm"
translation = [0.0, 0.0, -1.0]
rotation = { rpy = [0.1, 0.2, 0.3] }

[[frames]]
name = "rail"
rotation = { quaternion = [1.0, 0.0, 0.0, 0.0] }
joint = { type = "prismatic", axis = [1.0, 0.0, 0.0] }

[[frames]]
name = "weight"
parent = "rail"
rotation = { matrix = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]] }
joint = { type = "prismatic", axis = [0.0, 0.0, 1.0] }
body = { mass = 2.0 }

[[coordinates]]
name = "rail"
kind = "prescribed"

[[coordinates]]
name = "rope"
kind = "prescribed"
initial = 1.0

[[coordinates]]
name = "weight"
damping = 0.5

[[springs]]
type = "two_point"
a = { frame = "hand" }
b = { frame = "world", at = [1.0, 0.0, 0.0] }
stiffness = 3.0
rest_length = 0.5

[[springs]]
type = "coordinate"
coordinate = "elbow"
stiffness = 3.0

[[inputs]]
name = "torque"
coordinate = "elbow"

[[constraints]]
type = "distance"
name = "rope"
a = { frame = "hand" }
b = { frame = "weight" }
length = "rope"

[[operating_points]]
name = "rest"
coordinates = { elbow = 0.0, rope = 1.5 }
inputs = { torque = 1.0 }
"#;

/// Replaces `from`, which must occur once, by `to`; tells if the problems are not at `expected`.
fn check(from: &str, to: &str, expected: &[&str]) -> Option<String> {
    assert_eq!(GOOD.matches(from).count(), 1, "`{from}` must occur once");
    let scene = Scene::from_toml(&GOOD.replace(from, to)).unwrap_or_else(|e| panic!("`{to}`: {e}"));
    let problems = scene.validate();
    let paths: Vec<_> = problems.iter().map(|p| p.path.as_str()).collect();
    let wrong = paths != expected || problems.iter().any(|p| p.message.is_empty());
    wrong.then(|| format!("`{from}` -> `{to}`: {problems:#?}"))
}

#[test]
fn good_scene_has_no_problem() {
    assert_eq!(Scene::from_toml(GOOD).unwrap().validate(), []);
}

#[test]
fn faults_are_found_where_they_are() {
    let cases: &[(&str, &str, &[&str])] = &[
        // Header.
        ("format = 1", "format = 2", &["format"]),
        ("\"good\"", "\"\"", &["name"]),
        ("\"good\"", "\"Good scene\"", &["name"]),
        ("time_step_s = 0.01", "time_step_s = 0.0", &["time_step_s"]),
        ("time_step_s = 0.01", "time_step_s = nan", &["time_step_s"]),
        ("gravity = [0.0, 0.0, -9.8]", "gravity = [0.0, nan, inf]", &["gravity[1]", "gravity[2]"]),
        ("damping = 0.1", "damping = -0.1", &["damping"]),
        // Tree.
        (
            "name = \"hand\"",
            "name = \"world\"",
            &["frames[1].name", "springs[0].a.frame", "constraints[0].a.frame"],
        ),
        (
            "name = \"hand\"",
            "name = \"a hand\"",
            &["frames[1].name", "springs[0].a.frame", "constraints[0].a.frame"],
        ),
        (
            "name = \"hand\"",
            "name = \"arm\"",
            &["frames[1].name", "springs[0].a.frame", "constraints[0].a.frame"],
        ),
        ("parent = \"rail\"", "parent = \"nail\"", &["frames[3].parent"]),
        ("parent = \"rail\"", "parent = \"weight\"", &["frames[3].parent"]),
        ("name = \"arm\"", "name = \"arm\"\nparent = \"hand\"", &["frames[0].parent"]),
        // Placement.
        (
            "translation = [0.0, 0.0, -1.0]",
            "translation = [0.0, -inf, -1.0]",
            &["frames[1].translation[1]"],
        ),
        ("rpy = [0.1, 0.2, 0.3]", "rpy = [0.1, 0.2, nan]", &["frames[1].rotation.rpy[2]"]),
        ("[1.0, 0.0, 0.0, 0.0]", "[1.0, 0.0, 0.1, 0.0]", &["frames[2].rotation.quaternion"]),
        ("[1.0, 0.0, 0.0, 0.0]", "[0.0, 0.0, 0.0, 0.0]", &["frames[2].rotation.quaternion"]),
        ("[1.0, 0.0, 0.0, 0.0]", "[1.0, nan, 0.0, 0.0]", &["frames[2].rotation.quaternion[1]"]),
        ("[[0.0, -1.0, 0.0]", "[[0.0, -1.1, 0.0]", &["frames[3].rotation.matrix"]),
        ("[[0.0, -1.0, 0.0]", "[[0.0, 1.0, 0.0]", &["frames[3].rotation.matrix"]),
        ("[[0.0, -1.0, 0.0]", "[[0.0, inf, 0.0]", &["frames[3].rotation.matrix[0][1]"]),
        // Joints.
        ("axis = [0.0, 0.0, 1.0]", "axis = [0.0, 0.0, 0.0]", &["frames[3].joint.axis"]),
        ("axis = [0.0, 0.0, 1.0]", "axis = [0.0, 0.0, nan]", &["frames[3].joint.axis[2]"]),
        ("axis = [0.0, 0.0, 1.0]", "axis = [1e200, 1e200, 0.0]", &["frames[3].joint.axis"]),
        ("axis = [0.0, 0.0, 1.0]", "axis = [1e-200, 0.0, 0.0]", &["frames[3].joint.axis"]),
        (
            "coordinate = \"elbow\" }",
            "coordinate = \"weight\" }",
            &[
                "frames[3].joint",
                "springs[1].coordinate",
                "inputs[0].coordinate",
                "operating_points[0].coordinates.elbow",
            ],
        ),
        (
            "axis = [0.0, 0.0, 1.0] }",
            "axis = [0.0, 0.0, 1.0], coordinate = \"elbow\" }",
            &["frames[3].joint.coordinate", "coordinates[2].name"],
        ),
        (
            "axis = [0.0, 0.0, 1.0] }",
            "axis = [0.0, 0.0, 1.0], coordinate = \"we!ght\" }",
            &["frames[3].joint.coordinate", "coordinates[2].name"],
        ),
        // Bodies.
        ("mass = 1.0", "mass = -1.0", &["frames[0].body.mass"]),
        ("mass = 2.0", "mass = inf", &["frames[3].body.mass"]),
        ("mass = 2.0", "mass = 0.0", &["frames[3].joint"]),
        ("mass = 2.0", "mass = 0.0, inertia = [1.0, 1.0, 1.0]", &["frames[3].joint"]),
        (
            "center_of_mass = [0.0, 0.0, -1.0]",
            "center_of_mass = [nan, 0.0, -1.0]",
            &["frames[0].body.center_of_mass[0]"],
        ),
        ("[0.1, 0.1, 0.0, 0.0, 0.0, 0.0]", "[0.1, 0.1]", &["frames[0].body.inertia"]),
        ("[0.1, 0.1, 0.0, 0.0, 0.0, 0.0]", "[0.1, nan, 0.0]", &["frames[0].body.inertia[1]"]),
        ("[0.1, 0.1, 0.0, 0.0, 0.0, 0.0]", "[0.1, -0.1, 0.0]", &["frames[0].body.inertia"]),
        ("[0.1, 0.1, 0.0, 0.0, 0.0, 0.0]", "[0.1, 0.2, 0.4]", &["frames[0].body.inertia"]),
        (
            "[0.1, 0.1, 0.0, 0.0, 0.0, 0.0]",
            "[0.1, 0.1, 0.1, 0.2, 0.0, 0.0]",
            &["frames[0].body.inertia"],
        ),
        // Coordinates.
        ("name = \"weight\"\ndamping", "name = \"rail\"\ndamping", &["coordinates[2].name"]),
        ("name = \"weight\"\ndamping", "name = \"wait\"\ndamping", &["coordinates[2].name"]),
        ("damping = 0.5", "damping = -0.5", &["coordinates[2].damping"]),
        ("damping = 0.5", "initial = nan", &["coordinates[2].initial"]),
        ("damping = 0.5", "damping = 0.5\nkind = \"prescribed\"", &["coordinates[2].damping"]),
        ("initial = 1.0", "initial = 0.0", &["coordinates[1].initial"]),
        ("initial = 1.0", "initial = inf", &["coordinates[1].initial"]),
        (
            "kind = \"prescribed\"\ninitial",
            "initial",
            &["coordinates[1].name", "constraints[0].length"],
        ),
        // Springs.
        ("stiffness = 3.0\nrest", "stiffness = -3.0\nrest", &["springs[0].stiffness"]),
        ("rest_length = 0.5", "rest_length = nan", &["springs[0].rest_length"]),
        (
            "{ frame = \"world\", at = [1.0, 0.0, 0.0] }",
            "{ frame = \"word\", at = [inf, 0.0, 0.0] }",
            &["springs[0].b.at[0]", "springs[0].b.frame"],
        ),
        (
            "{ frame = \"world\", at = [1.0, 0.0, 0.0] }",
            "{ frame = \"arm\", at = [1.0, 0.0, 0.0] }",
            &["springs[0]"],
        ),
        (
            "coordinate = \"elbow\"\nstiffness",
            "coordinate = \"knee\"\nstiffness",
            &["springs[1].coordinate"],
        ),
        (
            "coordinate = \"elbow\"\nstiffness = 3.0",
            "coordinate = \"rail\"\nstiffness = 3.0\nrest = inf",
            &["springs[1].rest", "springs[1].coordinate"],
        ),
        // Inputs.
        (
            "name = \"torque\"",
            "name = \"\"",
            &["inputs[0].name", "operating_points[0].inputs.torque"],
        ),
        (
            "name = \"torque\"",
            "name = \"rail\"",
            &["inputs[0].name", "operating_points[0].inputs.torque"],
        ),
        (
            "name = \"torque\"\ncoordinate = \"elbow\"",
            "name = \"torque\"\ncoordinate = \"rail\"",
            &["inputs[0].coordinate"],
        ),
        (
            "name = \"torque\"\ncoordinate = \"elbow\"",
            "name = \"torque\"\ncoordinate = \"knee\"",
            &["inputs[0].coordinate"],
        ),
        ("name = \"torque\"\n", "name = \"torque\"\ngain = 0.0\n", &["inputs[0].gain"]),
        ("name = \"torque\"\n", "name = \"torque\"\ngain = nan\n", &["inputs[0].gain"]),
        // Constraints.
        (
            "length = \"rope\"",
            "length = \"rail\"",
            &["coordinates[0].initial", "coordinates[1].name"],
        ),
        (
            "length = \"rope\"",
            "length = \"weight\"",
            &["coordinates[1].name", "constraints[0].length"],
        ),
        (
            "length = \"rope\"",
            "length = \"string\"",
            &["coordinates[1].name", "constraints[0].length"],
        ),
        ("length = \"rope\"", "length = 0.0", &["coordinates[1].name", "constraints[0].length"]),
        ("length = \"rope\"", "length = nan", &["coordinates[1].name", "constraints[0].length"]),
        ("b = { frame = \"weight\" }", "b = { frame = \"hand\" }", &["constraints[0]"]),
        (
            "b = { frame = \"weight\" }",
            "b = { frame = \"arm\", at = [1.0, 0.0, 0.0] }",
            &["constraints[0]"],
        ),
        ("b = { frame = \"weight\" }", "b = { frame = \"wait\" }", &["constraints[0].b.frame"]),
        // Operating points.
        ("name = \"rest\"", "name = \"initial\"", &["operating_points[0].name"]),
        ("name = \"rest\"", "name = \"at rest\"", &["operating_points[0].name"]),
        ("elbow = 0.0", "elbow = nan", &["operating_points[0].coordinates.elbow"]),
        ("elbow = 0.0", "knee = 0.0", &["operating_points[0].coordinates.knee"]),
        ("rope = 1.5", "rope = -1.5", &["operating_points[0].coordinates.rope"]),
        ("torque = 1.0", "tork = 1.0", &["operating_points[0].inputs.tork"]),
        ("torque = 1.0", "torque = inf", &["operating_points[0].inputs.torque"]),
    ];
    let wrong: Vec<_> =
        cases.iter().filter_map(|(from, to, expected)| check(from, to, expected)).collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn point_to_point_needs_different_axes() {
    let distance = "type = \"distance\"\nname = \"rope\"";
    for axes in ["[]", "[\"x\", \"x\"]", "[\"x\", \"y\", \"z\", \"x\"]"] {
        let pin = format!(
            "type = \"point_to_point\"\nname = \"pin\"\na = {{ frame = \"hand\" }}\nb = {{ frame = \"weight\" }}\naxes = {axes}\n\n[[constraints]]\n{distance}"
        );
        assert_eq!(check(distance, &pin, &["constraints[0].axes"]), None);
    }
}

#[test]
fn duplicate_names_are_found_in_every_list() {
    let mut scene = Scene::from_toml(GOOD).unwrap();
    scene.inputs.push(scene.inputs[0].clone());
    scene.constraints.push(scene.constraints[0].clone());
    scene.operating_points.push(scene.operating_points[0].clone());
    let problems = scene.validate();
    let paths: Vec<_> = problems.iter().map(|p| p.path.as_str()).collect();
    assert_eq!(paths, ["inputs[1].name", "constraints[1].name", "operating_points[1].name"]);
}

#[test]
fn several_faults_are_reported_at_once() {
    let text = GOOD
        .replace("mass = 2.0", "mass = -2.0")
        .replace("\"good\"", "\"Good\"")
        .replace("torque = 1.0", "tork = 1.0");
    let problems = Scene::from_toml(&text).unwrap().validate();
    let error = crate::SceneError { problems }.to_string();
    for path in ["name: ", "frames[3].body.mass: ", "operating_points[0].inputs.tork: "] {
        assert!(error.contains(path), "{error}");
    }
}

#[test]
fn sizes_have_limits() {
    let mut scene = builtin::scene("pendulum").unwrap();
    let mut fixed = scene.frames[0].clone();
    fixed.joint = None;
    scene.frames.extend(
        (0..MAX_FRAMES).map(|i| crate::scene::Frame { name: format!("f{i}"), ..fixed.clone() }),
    );
    assert_eq!(scene.validate()[0].path, "frames");

    let mut scene = builtin::scene("chain-1024").unwrap();
    let mut one_more = scene.frames[0].clone();
    one_more.name = "one_more".to_owned();
    scene.frames.push(one_more);
    let problems = scene.validate();
    assert_eq!(problems.len(), 1);
    assert!(problems[0].message.contains("1025 joints"), "{problems:?}");
}
