//! Faulty scenes as data: what is changed in a good scene, and where the problems must be.

use crate::builtin;
use crate::validate::*;

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
    check_in(GOOD, from, to, expected)
}

/// Replaces `from` by `to` in any good scene, as [`check`] does in one.
fn check_in(good: &str, from: &str, to: &str, expected: &[&str]) -> Option<String> {
    assert_eq!(good.matches(from).count(), 1, "`{from}` must occur once");
    let scene = Scene::from_toml(&good.replace(from, to)).unwrap_or_else(|e| panic!("`{to}`: {e}"));
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

/// The scene of an element.
fn element(name: &str) -> String {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../scenes/elements");
    std::fs::read_to_string(format!("{folder}/{name}.toml")).unwrap()
}

#[test]
fn faults_of_elements_are_found_where_they_are() {
    let cases: &[(&str, &str, &str, &[&str])] = &[
        // Splines.
        ("spline-spring", "\"lever\"\nknots", "\"level\"\nknots", &["springs[0].coordinate"]),
        (
            "spline-spring",
            "x = 0.0, value = 0.0",
            "x = -0.4, value = nan",
            &["springs[0].knots[2].x", "springs[0].knots[2].value"],
        ),
        ("spline-spring", "curvature = 0.0", "curvature = inf", &["springs[0].knots[2].curvature"]),
        ("spline-spring", "x = 0.6", "x = nan", &["springs[0].knots[4].x"]),
        (
            "spline-spring",
            "x = 0.6, value = -0.5",
            "x = 0.4000000000000001, value = 1e300",
            &["springs[0].knots"],
        ),
        // Paths.
        (
            "path-spring",
            "stiffness = 20.0\nrest_length = 0.8",
            "stiffness = -20.0\nrest_length = -0.8",
            &["springs[0].stiffness", "springs[0].rest_length"],
        ),
        (
            "path-spring",
            "{ frame = \"distal\", at = [0.3, 0.0, 0.05] }",
            "{ frame = \"nail\", at = [nan, 0.0, 0.05] }",
            &["springs[0].points[3].at[0]", "springs[0].points[3].frame"],
        ),
        (
            "path-spring",
            "{ frame = \"distal\", at = [0.3, 0.0, 0.05] }",
            "{ frame = \"distal\", at = [0.1, 0.02, 0.06] }",
            &["springs[0].points[3]"],
        ),
        ("path-length", "length = 3.0", "length = 0.0", &["constraints[0].length"]),
        ("path-length", "length = 3.0", "length = \"weight\"", &["constraints[0].length"]),
        (
            "path-length",
            "    { frame = \"weight\" },\n    { frame = \"world\" },\n    { frame = \"world\", at = [1.0, 0.0, 0.0] },\n",
            "",
            &["constraints[0].points"],
        ),
        // Planes.
        (
            "point-on-plane",
            "normal = [0.0, 2.0, 0.0]",
            "normal = [0.0, 0.0, 0.0]",
            &["constraints[0].plane.normal"],
        ),
        (
            "point-on-plane",
            "plane = { frame = \"door\"",
            "plane = { frame = \"arm\", at = [nan, 0.0, 0.0]",
            &["constraints[0].plane.at[0]", "constraints[0]"],
        ),
        (
            "point-on-plane",
            "point = { frame = \"arm\"",
            "point = { frame = \"leg\"",
            &["constraints[0].point.frame"],
        ),
        // Frames.
        ("orientation", "a = \"bob\"", "a = \"wheel\"", &["constraints[0]"]),
        ("orientation", "b = \"wheel\"", "b = \"well\"", &["constraints[0].b"]),
        ("weld", "a = \"tip\"", "a = \"top\"", &["constraints[0].a"]),
        (
            "path-length",
            "type = \"path_length\"\nname = \"rope\"\npoints = [\n    { frame = \"weight\" },\n    { frame = \"world\" },\n    { frame = \"world\", at = [1.0, 0.0, 0.0] },\n    { frame = \"bob\" },\n]\nlength = 3.0\n",
            "type = \"orientation\"\nname = \"level\"\na = \"world\"\nb = \"bob\"\n",
            &["constraints[0]"],
        ),
        // Couplings.
        (
            "coupling",
            "{ coordinate = \"wheel\", coefficients = [3.0] }",
            "{ coordinate = \"pinion\", coefficients = [] }",
            &["constraints[0].terms[1].coordinate", "constraints[0].terms[1].coefficients"],
        ),
        (
            "coupling",
            "{ coordinate = \"wheel\", coefficients = [3.0] }",
            "{ coordinate = \"well\", coefficients = [nan] }",
            &["constraints[0].terms[1].coordinate", "constraints[0].terms[1].coefficients[0]"],
        ),
        // Sums of coordinates.
        (
            "linear-spring",
            "coefficient = -1.0",
            "coefficient = 0.0",
            &["springs[0].terms[1].coefficient"],
        ),
        (
            "linear-spring",
            "coefficient = -1.0",
            "coefficient = nan",
            &["springs[0].terms[1].coefficient"],
        ),
        ("linear-spring", "stiffness = 8.0", "stiffness = -8.0", &["springs[0].stiffness"]),
        ("linear-spring", "rest = 0.1", "rest = inf", &["springs[0].rest"]),
        (
            "linear-spring",
            "coordinate = \"right\", coeff",
            "coordinate = \"left\", coeff",
            &["springs[0].terms[1].coordinate"],
        ),
        (
            "linear-damper",
            "coordinate = \"right\", coeff",
            "coordinate = \"wing\", coeff",
            &["forces[0].terms[1].coordinate"],
        ),
        ("linear-damper", "damping = 0.7", "damping = nan", &["forces[0].damping"]),
        (
            "linear-damper",
            "terms = [{ coordinate = \"left\", coefficient = 1.0 }, { coordinate = \"right\", coefficient = 0.5 }]",
            "terms = []",
            &["forces[0].terms"],
        ),
        ("coupling", "constant = -0.1", "constant = inf", &["constraints[1].constant"]),
        ("hoist", "{ coordinate = \"fan\", coefficients = [1.0, 0.1] },", "", &["constraints[1]"]),
        (
            "hoist",
            "name = \"motor\"\nkind = \"prescribed\"",
            "name = \"motor\"",
            &["coordinates[3].name"],
        ),
    ];
    let faults = cases.iter();
    let wrong = faults
        .filter_map(|(name, from, to, expected)| check_in(&element(name), from, to, expected));
    let wrong: Vec<_> = wrong.collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn paths_couplings_and_splines_have_limits() {
    let mut scene = Scene::from_toml(&element("path-length")).unwrap();
    let Constraint::PathLength { points, .. } = &mut scene.constraints[0] else { panic!() };
    *points = points.iter().cycle().take(MAX_PATH_POINTS + 1).cloned().collect();
    assert!(scene.validate()[0].message.contains("points of paths"));
    let mut scene = Scene::from_toml(&element("coupling")).unwrap();
    let Constraint::Coupling { terms, .. } = &mut scene.constraints[0] else { panic!() };
    let term = terms[0].clone();
    *terms = vec![term; MAX_COUPLING_TERMS + 1];
    assert!(scene.validate()[0].message.contains("terms of couplings"));
    let mut scene = Scene::from_toml(&element("spline-spring")).unwrap();
    let Spring::Spline { knots, .. } = &mut scene.springs[0] else { panic!() };
    *knots = vec![knots[0]; crate::limits::MAX_KNOTS + 1];
    assert_eq!(scene.validate()[0].path, "springs[0].knots");
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
    let error = crate::scene::SceneError { problems }.to_string();
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

/// Adds text to the good scene; tells if the problems are not at `expected`.
fn check_added(text: &str, expected: &[&str]) -> Option<String> {
    let scene = Scene::from_toml(&format!("{GOOD}\n{text}"));
    let problems = scene.unwrap_or_else(|e| panic!("`{text}`: {e}")).validate();
    let paths: Vec<_> = problems.iter().map(|p| p.path.as_str()).collect();
    (paths != expected).then(|| format!("`{text}`: {problems:#?}"))
}

#[test]
fn faults_of_forces_are_found_where_they_are() {
    let thrust = "[[inputs]]\nname = \"thrust\"\n[[forces]]\ntype = \"thruster\"\nframe = \"hand\"";
    let cases: &[(&str, &[&str])] = &[
        ("type = \"body_wrench\"\nframe = \"hand\"\nforce = [1, 0, \"torque\"]", &[]),
        ("type = \"body_wrench\"\nframe = \"foot\"\nforce = [1, 0, 0]", &["forces[0].frame"]),
        ("type = \"spatial_wrench\"\nframe = \"rail\"\nforce = [1, 0, 0]", &["forces[0].frame"]),
        ("type = \"hybrid_wrench\"\nframe = \"world\"\nforce = [1, 0, 0]", &["forces[0].frame"]),
        ("type = \"hybrid_wrench\"\nframe = \"hand\"\ntorque = [0, 0.0, 0]", &["forces[0]"]),
        (
            "type = \"hybrid_wrench\"\nframe = \"hand\"\nforce = [0, nan, 0]\ntorque = [0, 0, \"tork\"]",
            &["forces[0].force[1]", "forces[0].torque[2]"],
        ),
        (
            "type = \"two_point_damper\"\na = { frame = \"hand\" }\nb = { frame = \"rail\" }\ndamping = -1.0",
            &["forces[0].damping"],
        ),
        (
            "type = \"two_point_damper\"\na = { frame = \"hand\" }\nb = { frame = \"arm\" }\ndamping = 1.0",
            &["forces[0]"],
        ),
        (
            "type = \"two_point_damper\"\na = { frame = \"rail\" }\nb = { frame = \"world\" }\ndamping = 1.0",
            &["forces[0]"],
        ),
        (
            "type = \"drag\"\nframe = \"hand\"\nat = [0, inf, 0]\ncoefficient = nan",
            &["forces[0].at[1]", "forces[0].coefficient"],
        ),
        (
            "type = \"coordinate_drag\"\ncoordinate = \"rail\"\ncoefficient = -1.0",
            &["forces[0].coordinate", "forces[0].coefficient"],
        ),
        (
            "type = \"friction\"\ncoordinate = \"knee\"\nforce = -1.0\nvelocity = 0.0",
            &["forces[0].coordinate", "forces[0].force", "forces[0].velocity"],
        ),
    ];
    let mut wrong: Vec<_> = cases
        .iter()
        .filter_map(|(text, expected)| check_added(&format!("[[forces]]\n{text}"), expected))
        .collect();
    let thrusters: &[(&str, &[&str])] = &[
        ("axis = [1, 0, 0]\ninput = \"thrust\"", &[]),
        ("axis = [0, 0, 0]\ninput = \"thrust\"", &["forces[0].axis"]),
        ("axis = [1, 0, 0]\ninput = \"thrust\"\ngain = 0.0", &["forces[0].gain"]),
        ("axis = [1, 0, 0]\ninput = \"trust\"", &["inputs[1]", "forces[0].input"]),
    ];
    wrong.extend(
        thrusters
            .iter()
            .filter_map(|(text, expected)| check_added(&format!("{thrust}\n{text}"), expected)),
    );
    let geared = thrust.replace("\"thrust\"", "\"thrust\"\ngain = 2.0");
    let geared = format!("{geared}\naxis = [1, 0, 0]\ninput = \"thrust\"");
    wrong.extend(check_added(&geared, &["inputs[1].gain"]));
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn faults_of_signals_are_found_where_they_are() {
    let sinusoid = "type = \"sinusoid\"\namplitude = 0.5\nfrequency_hz = 1.0";
    let table = "drives = \"torque\"\ntype = \"table\"";
    let cases = [
        (format!("drives = \"torque\"\n{sinusoid}"), &[][..]),
        (format!("drives = \"rope\"\n{sinusoid}\noffset = 1.0"), &[]),
        (format!("drives = \"rope\"\n{sinusoid}"), &["signals[0]"]),
        (format!("drives = \"elbow\"\n{sinusoid}"), &["signals[0].drives"]),
        (format!("drives = \"knee\"\n{sinusoid}"), &["signals[0].drives"]),
        (
            format!("drives = \"torque\"\n{sinusoid}\nphase_rad = nan\noffset = inf"),
            &["signals[0].phase_rad", "signals[0].offset"],
        ),
        (
            "drives = \"rail\"\ntype = \"constant\"\nvalue = 1.0\n[[signals]]\ndrives = \"rail\"\ntype = \"constant\"\nvalue = 2.0".to_owned(),
            &["signals[1].drives"],
        ),
        (
            "drives = \"torque\"\ntype = \"chirp\"\namplitude = 1.0\nstart_hz = -1.0\nend_hz = 1.0\nduration_s = 0.0".to_owned(),
            &["signals[0].start_hz", "signals[0].duration_s"],
        ),
        (
            "drives = \"torque\"\ntype = \"spline\"\nknots = [{ x = 1.0, value = nan }, { x = 1.0, value = 2.0 }]".to_owned(),
            &["signals[0].knots[0].value", "signals[0].knots[1].x"],
        ),
        (format!("{table}\ntimes_s = []\nvalues = []"), &["signals[0].times_s"]),
        (format!("{table}\ntimes_s = [0]\nvalues = [1]"), &[]),
        (format!("{table}\ntimes_s = [0]\nvalues = [1]\nrepeat = true"), &["signals[0].times_s"]),
        (format!("{table}\ntimes_s = [0, 1, 1]\nvalues = [1, 2, 3]"), &["signals[0].times_s[2]"]),
        (
            format!("{table}\ntimes_s = [0, nan]\nvalues = [1]"),
            &["signals[0].times_s[1]", "signals[0].values"],
        ),
    ];
    let wrong: Vec<_> = cases
        .iter()
        .filter_map(|(text, expected)| check_added(&format!("[[signals]]\n{text}"), expected))
        .collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    let mut scene = builtin::scene("pendulum").unwrap();
    let signal = "drives = \"torque\"\ntype = \"table\"\ntimes_s = []\nvalues = []";
    let mut signal: Signal = toml::from_str(signal).unwrap();
    let Signal::Table { times_s, .. } = &mut signal else { panic!() };
    *times_s = (0..=MAX_SIGNAL_POINTS).map(|k| k as f64).collect();
    scene.signals.push(signal);
    assert_eq!(scene.validate()[0].path, "signals");
}

/// A scene with what real robots have.
const ROBOT: &str = r#"
format = 1
name = "robot"
gravity = [0.0, 0.0, 0.0]
[[frames]]
name = "arm"
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
body = { mass = 1.0, inertia = [0.1, 0.1, 0.1] }
visuals = [{ shape = { type = "sphere", radius = 0.1 }, color = [0.1, 0.2, 0.3, 1.0] }]
[[frames]]
name = "hand"
parent = "arm"
joint = { type = "ball" }
body = { mass = 1.0, inertia = [0.1, 0.1, 0.1] }
[[armatures]]
terms = [{ coordinate = "arm", coefficient = 3.0 }]
armature = 0.125
[[springs]]
type = "orientation"
frame = "hand"
stiffness = 6.0
rest = { rpy = [0.1, 0.0, 0.0] }
[[forces]]
type = "friction"
terms = [{ coordinate = "arm", coefficient = 2.0 }]
force = 1.0
velocity = 0.1
[[forces]]
type = "coordinate_drag"
coordinate = "arm"
cubic = 1.0
[[coordinates]]
name = "arm"
armature = 0.25
limits = [-1.0, 2.0]
[[inputs]]
name = "torque"
terms = [{ coordinate = "arm", gain = 0.75 }]
limits = [-3.0, 3.0]
[[inputs]]
name = "tendon"
points = [{ frame = "world" }, { frame = "arm", at = [0.5, 0.0, 0.0] }]
[[inputs]]
name = "target"
[[springs]]
type = "stop"
coordinate = "arm"
stiffness = 50.0
[[forces]]
type = "servo"
coordinate = "arm"
input = "target"
stiffness = 8.0
[[forces]]
type = "path_damper"
points = [{ frame = "world" }, { frame = "arm", at = [0.25, 0.0, 0.0] }]
damping = 2.5
"#;

#[test]
fn faults_of_elements_of_robots_are_found() {
    assert_eq!(Scene::from_toml(ROBOT).unwrap().validate(), []);
    let cases: &[(&str, &str, &[&str])] = &[
        ("gravity = [0.0, 0.0, 0.0]\n", "", &["gravity"]),
        ("armature = 0.25", "armature = -0.25", &["coordinates[0].armature"]),
        ("armature = 0.125", "armature = nan", &["armatures[0].armature"]),
        ("coefficient = 3.0", "coefficient = 0.0", &["armatures[0].terms[0].coefficient"]),
        (
            "\"arm\", coefficient = 3.0",
            "\"hand_rx\", coefficient = 3.0",
            &["armatures[0].terms[0].coordinate"],
        ),
        ("frame = \"hand\"", "frame = \"arm\"", &["springs[0].frame"]),
        ("frame = \"hand\"", "frame = \"world\"", &["springs[0].frame"]),
        ("stiffness = 6.0", "stiffness = -6.0", &["springs[0].stiffness"]),
        ("rpy = [0.1,", "rpy = [nan,", &["springs[0].rest.rpy[0]"]),
        ("force = 1.0\n", "force = 1.0\ncoordinate = \"arm\"\n", &["forces[0]"]),
        ("force = 1.0\n", "force = -1.0\n", &["forces[0].force"]),
        ("cubic = 1.0", "cubic = -1.0", &["forces[1].cubic"]),
        (
            "[[coordinates]]",
            "[[coordinates]]\nname = \"hand_rx\"\nkind = \"prescribed\"\n[[coordinates]]\nname = \"hand_ry\"\nkind = \"prescribed\"\n[[coordinates]]\nname = \"hand_rz\"\nkind = \"prescribed\"\n[[coordinates]]",
            &["springs[0].frame"],
        ),
        ("limits = [-1.0, 2.0]", "limits = [2.0, -1.0]", &["coordinates[0].limits"]),
        ("limits = [-1.0, 2.0]", "limits = [-inf, 2.0]", &["coordinates[0].limits[0]"]),
        ("limits = [-1.0, 2.0]", "", &["springs[1].range"]),
        ("limits = [-3.0, 3.0]", "limits = [3.0, 3.0]", &["inputs[0].limits"]),
        ("gain = 0.75", "gain = 0.0", &["inputs[0].terms[0].gain"]),
        (
            "[{ coordinate = \"arm\", gain",
            "[{ coordinate = \"leg\", gain",
            &["inputs[0].terms[0].coordinate"],
        ),
        ("name = \"torque\"", "name = \"torque\"\ncoordinate = \"arm\"", &["inputs[0]"]),
        ("name = \"torque\"", "name = \"torque\"\ngain = 2.0", &["inputs[0].gain"]),
        ("at = [0.5, 0.0, 0.0]", "at = [0.5, nan, 0.0]", &["inputs[1].points[1].at[1]"]),
        (
            "{ frame = \"arm\", at = [0.5, 0.0, 0.0] }",
            "{ frame = \"world\", at = [1, 1, 1] }",
            &["inputs[1].points"],
        ),
        ("radius = 0.1", "radius = 0.0", &["frames[0].visuals[0].shape.radius"]),
        ("[0.1, 0.2, 0.3, 1.0]", "[0.1, 0.2, 0.3, 1.5]", &["frames[0].visuals[0].color[3]"]),
        ("stiffness = 50.0", "stiffness = -50.0", &["springs[1].stiffness"]),
        ("stiffness = 50.0", "", &["springs[1]"]),
        ("stiffness = 50.0", "settling_depth = 0.1", &["springs[1]"]),
        (
            "stiffness = 50.0",
            "settling_depth = 0.1\nsettling_time_s = 0.0",
            &["springs[1].settling_time_s"],
        ),
        ("stiffness = 50.0", "stiffness = 50.0\ntransition = 0.0", &["springs[1].transition"]),
        ("stiffness = 50.0", "stiffness = 50.0\nrange = [1.0, nan]", &["springs[1].range[1]"]),
        ("coordinate = \"arm\"\ninput", "input", &["forces[2]"]),
        ("input = \"target\"", "input = \"aim\"", &["inputs[2]", "forces[2].input"]),
        ("stiffness = 8.0", "stiffness = -8.0", &["forces[2].stiffness"]),
        ("damping = 2.5", "damping = -2.5", &["forces[3].damping"]),
        ("at = [0.25, 0.0, 0.0]", "at = [0.25, inf, 0.0]", &["forces[3].points[1].at[1]"]),
    ];
    let wrong: Vec<_> = cases
        .iter()
        .filter_map(|(from, to, expected)| check_in(ROBOT, from, to, expected))
        .collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
