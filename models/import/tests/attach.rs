//! Models that an MJCF attaches: each under its own names, classes and units.

use std::collections::BTreeMap;

use plantd_import::{Import, ImportError, Kind, Options, import, import_with_files};
use plantd_models::scene::Spring;

/// An arm of two hinges in radians, beside another body.
const ARM: &str = r#"<mujoco model="arm"><compiler angle="radian" meshdir="parts"/><option gravity="0 0 -3"/>
  <default><joint damping="0.5"/><motor gear="7"/><default class="soft"><joint stiffness="3"/></default></default>
  <asset><mesh file="claw.stl"/></asset>
  <worldbody>
    <body name="upper" pos="1 0 0"><joint name="shoulder" axis="0 1 0" range="-1 1" ref="0.2"/>
      <inertial pos="0.1 0 0" mass="1" diaginertia="1 2 2.5"/><geom type="mesh" mesh="claw" mass="0" contype="0" conaffinity="0"/>
      <frame name="wrist" pos="0 0 1"><body name="fore" childclass="soft"><joint name="elbow"/>
        <inertial pos="0.1 0 0" mass="1" diaginertia="1 2 2.5"/></body></frame></body>
    <body name="other"><joint name="lid"/><inertial pos="0.1 0 0" mass="1" diaginertia="1 2 2.5"/></body>
  </worldbody>
  <tendon><fixed name="both" stiffness="2"><joint joint="shoulder" coef="1"/><joint joint="elbow" coef="2"/></fixed>
    <fixed name="far" stiffness="5"><joint joint="lid" coef="1"/><joint joint="elbow" coef="1"/></fixed></tendon>
  <equality><joint joint1="shoulder" joint2="elbow" name="gear"/></equality>
  <actuator><motor name="drive" joint="shoulder"/><motor name="raise" joint="lid"/></actuator>
  <keyframe><key name="home" qpos="0.1 0.2 0.3"/></keyframe></mujoco>"#;

fn attached(attach: &str, rest: &str) -> Result<Import, ImportError> {
    let text = format!(
        r#"<mujoco model="torso"><default><joint armature="5" stiffness="1"/></default><asset><model name="A" file="arms/arm.xml"/></asset>
  <worldbody><body name="base" pos="0 0 1"><joint name="z" type="slide"/>
    <inertial pos="0 0 0" mass="1" diaginertia="1 2 2.5"/>{attach}</body></worldbody>{rest}</mujoco>"#
    );
    let nested = r#"<mujoco model="pair"><asset><model file="arms/arm.xml"/></asset><worldbody>
      <body name="mount"><joint name="turn" axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia="1 2 2.5"/>
        <attach model="arm" body="upper" prefix="in_"/></body></worldbody></mujoco>"#;
    let circle = r#"<mujoco model="circle"><asset><model name="c" file="circle.xml"/></asset><worldbody><body name="b">
      <attach model="c" body="b" prefix="x"/></body></worldbody></mujoco>"#;
    let files = BTreeMap::from([
        ("arms/arm.xml", ARM),
        ("pair.xml", nested),
        ("circle.xml", circle),
        ("robot.xml", "<robot name='r'/>"),
    ]);
    let mut find = |name: &str| {
        files.get(name).map(|t| t.as_bytes().to_vec()).ok_or_else(|| "it is not here".to_owned())
    };
    import_with_files(&text, &Options::default(), &mut find)
}

fn names(import: &Import) -> Vec<String> {
    let model = plantd_models::Model::compile(&import.scene).unwrap_or_else(|e| panic!("{e}"));
    model.coordinates().iter().map(|c| c.name.clone()).collect()
}

#[test]
fn a_body_comes_with_its_names_classes_and_units() {
    let both = "<attach model='A' body='upper' prefix='l_'/><frame pos='0 1 0' euler='0 0 90'><attach model='A' body='upper' prefix='r_'/></frame>";
    let actuator = "<actuator><motor name='own' joint='r_elbow'/></actuator>";
    let robot = attached(both, actuator).unwrap_or_else(|e| panic!("{e}"));
    let scene = &robot.scene;
    assert_eq!(names(&robot), ["z", "l_shoulder", "l_elbow", "r_shoulder", "r_elbow"]);
    let coordinate = |name: &str| scene.coordinates.iter().find(|c| c.name == name).unwrap();
    let shoulder = coordinate("l_shoulder");
    assert_eq!((shoulder.initial, shoulder.damping, shoulder.armature), (0.2, Some(0.5), 0.0));
    assert_eq!(shoulder.limits, Some([-1.0, 1.0]), "in radians");
    assert_eq!(coordinate("z").armature, 5.0);
    let frame = |name: &str| scene.frames.iter().find(|f| f.name == name).unwrap();
    assert!((frame("r_upper").translation[1] - 2.0).abs() < 1e-14, "the frame is turned");
    let stiffness = |name: &str| {
        scene.springs.iter().find_map(|spring| match spring {
            Spring::Coordinate { coordinate, stiffness, .. } if coordinate == name => {
                Some(*stiffness)
            }
            _ => None,
        })
    };
    let found = ["z", "l_shoulder", "l_elbow", "r_elbow"].map(stiffness);
    assert_eq!(found, [Some(1.0), None, Some(3.0), Some(3.0)]);
    let inputs: Vec<_> = scene.inputs.iter().map(|i| (i.name.as_str(), i.gain)).collect();
    assert_eq!(inputs, [("own", 1.0), ("l_drive", 7.0), ("r_drive", 7.0)]);
    let sums = scene.springs.iter().filter(|s| matches!(s, Spring::LinearSpring { .. })).count();
    assert_eq!((sums, scene.constraints.len()), (2, 2), "what needs `lid` is left out");
    assert_eq!(scene.gravity, Some([0.0, 0.0, -9.81]));
    let meshes = plantd_import::meshes::of_scene(scene);
    assert_eq!(meshes, ["arms/parts/claw.stl"]);
    let told = robot.report.to_string();
    for part in
        ["`l_lid` is not attached along", "`option` of what is attached", "a keyframe of what"]
    {
        assert!(told.contains(part), "{part}: {told}");
    }
    let limit = robot.report.notes.iter().find(|n| n.message.starts_with("joint `l_shoulder`"));
    let limit = limit.unwrap();
    assert_eq!((limit.kind, &*limit.file, limit.line), (Kind::Approximated, "arms/arm.xml", 5));
}

#[test]
fn all_of_a_model_a_frame_and_models_within_models() {
    let all = attached("<attach model='A' prefix='a_'/>", "").unwrap();
    assert_eq!(names(&all), ["z", "a_shoulder", "a_elbow", "a_lid"]);
    let frame = attached("<attach model='A' frame='wrist' prefix='w_'/>", "").unwrap();
    assert_eq!(names(&frame), ["z", "w_elbow"]);
    let fore = frame.scene.frames.iter().find(|f| f.name == "w_fore").unwrap();
    assert_eq!(fore.translation, [0.0, 0.0, 1.0]);
    let pair = "<asset><model name='p' file='pair.xml'/></asset>";
    let nested = attached("<attach model='p' body='mount' prefix='out_'/>", pair).unwrap();
    assert_eq!(names(&nested), ["z", "out_turn", "out_in_shoulder", "out_in_elbow"]);
    assert_eq!(nested.scene.inputs[0].gain, 7.0, "its classes are those of its own");
}

#[test]
fn what_cannot_be_attached_is_named_with_its_place() {
    let models = "<asset><model name='c' file='circle.xml'/><model name='r' file='robot.xml'/><model name='n' file='none.xml'/></asset>";
    for (attach, expected) in [
        ("<attach model='A' body='uper' prefix=''/>", "3:59: there is no body `uper`"),
        ("<attach model='A' body='upper'/>", "`attach` has no attribute `prefix`"),
        (
            "<attach model='B' prefix=''/>",
            "there is no model `B` in `asset`; there is `A`, `c`, `r`",
        ),
        ("<attach model='n' prefix=''/>", "`none.xml` cannot be read: it is not here"),
        ("<attach model='r' prefix=''/>", "the root of what is attached is `robot`"),
        ("<attach model='c' body='b' prefix=''/>", "or more than 32 to one another"),
        (
            "<attach model='A' body='upper' prefix=''/><attach model='A' body='upper' prefix=''/>",
            "there are two bodies `upper`",
        ),
    ] {
        let error = attached(attach, models).expect_err(attach).to_string();
        assert!(error.contains(expected), "{attach}: {error}");
    }
    let alone = import(
        "<mujoco><worldbody><attach model='A' prefix=''/></worldbody></mujoco>",
        &Options::default(),
    );
    assert!(alone.unwrap_err().to_string().contains("1:20: `attach`: read the file with"));
}

/// What refers to replicated things is copied along, after all that is not, copy by copy.
#[test]
fn what_refers_to_copies_is_copied_along() {
    let text = r#"<mujoco><worldbody>
      <body name="c"><joint name="cj"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>
      <replicate count="2" offset="0 1 0" sep="-"><body name="b"><joint name="j"/><joint name="k" type="slide"/>
        <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></replicate></worldbody>
      <tendon><fixed name="t" stiffness="3"><joint joint="j" coef="1"/><joint joint="cj" coef="2"/></fixed></tendon>
      <equality><joint joint1="j" joint2="k" name="e"/><joint joint1="j" joint2="cj" name="f"/></equality>
      <actuator><motor name="x" joint="cj"/><motor name="m" joint="j" armature="0.5"/><motor tendon="t"/><motor name="y" joint="k-1"/></actuator></mujoco>"#;
    let robot = import(text, &Options::default()).unwrap_or_else(|e| panic!("{e}"));
    let scene = &robot.scene;
    let inputs: Vec<_> = scene.inputs.iter().map(|input| input.name.as_str()).collect();
    assert_eq!(inputs, ["x", "y", "m-0", "input_4", "m-1", "input_6"]);
    let driven: Vec<_> = scene.inputs.iter().map(|input| input.coordinate.as_deref()).collect();
    assert_eq!(driven, [Some("cj"), Some("k-1"), Some("j-0"), None, Some("j-1"), None]);
    assert_eq!(scene.inputs[5].terms[0].coordinate, "j-1");
    let constraints: Vec<_> = scene.constraints.iter().map(|c| c.name()).collect();
    assert_eq!(constraints, ["e-0", "e-1"]);
    assert!(robot.report.to_string().contains("MuJoCo leaves it out"));
    assert_eq!(scene.springs.len(), 2);
    let rotors = scene.coordinates.iter().filter(|c| c.armature == 0.5).count();
    assert_eq!(rotors, 2);
    let two = text.replace(
        "</worldbody>",
        r#"<replicate count="3"><body><joint name="o"/>
        <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></replicate></worldbody>"#,
    );
    let two = two.replace(r#"joint="cj" coef"#, r#"joint="o" coef"#);
    let error = import(&two, &Options::default()).unwrap_err().to_string();
    assert!(error.contains("copies of two replications"), "{error}");
}
