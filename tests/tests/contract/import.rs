//! Robots in other formats.

use plantd_client::{Code, v1};

use crate::support::*;

/// A pendulum of 2 kg at half a metre, inertia 0.1 kg·m² about its centre.
pub(crate) const PENDULUM: &str = r#"<robot name="Rod">
  <link name="base"/>
  <joint name="hinge" type="revolute">
    <parent link="base"/> <child link="rod"/> <axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="5" velocity="1"/>
  </joint>
  <link name="rod">
    <inertial>
      <origin xyz="0 0 -0.5"/> <mass value="2"/>
      <inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
</robot>"#;

#[tokio::test]
async fn a_robot_is_uploaded_and_driven() {
    let (_server, client) = server().await;
    for format in [v1::SceneFormat::Unspecified, v1::SceneFormat::Urdf] {
        let request = v1::CreateModelRequest {
            scene: PENDULUM.to_owned(),
            format: format.into(),
            name: format!("rod-{}", format as i32),
            ..Default::default()
        };
        let answer = client.import_model(request).await.unwrap();
        let model = answer.model.unwrap();
        assert_eq!((&*model.coordinates[0].name, &*model.inputs[0]), ("hinge", "hinge_drive"));
        let report = answer.import_report.unwrap();
        assert_eq!(report.exact["revolute joint"], 1);
        let [limit, velocity] = &report.notes[..] else { panic!("{:?}", report.notes) };
        assert_eq!((limit.kind(), limit.line), (v1::ImportKind::Approximated, 3));
        assert_eq!(velocity.kind(), v1::ImportKind::NoEffect);
        assert_eq!(report.exact["effort limit of an input"], 1);
        assert_eq!((&*report.names[0].from, &*report.names[0].to), ("Rod", "rod"));
        // d²q/dt² = −m g l sin q / (I + m l²) + u / (I + m l²)
        let request = v1::EvaluateDynamicsRequest {
            model: model.name,
            q: vec![0.3],
            inputs: vec![1.5],
            ..Default::default()
        };
        let found = client.evaluate_dynamics(request).await.unwrap().acceleration[0];
        let expected = (1.5 - 2.0 * 9.81 * 0.5 * 0.3_f64.sin()) / (0.1 + 2.0 * 0.25);
        assert!((found - expected).abs() < 1e-13, "{found} instead of {expected}");
    }
    let scene = client.validate_scene(PENDULUM).await.unwrap();
    assert!(scene.problems.is_empty() && scene.import_report.is_some());
    let again = client.create_model(scene.model.unwrap().scene_toml).await.unwrap();
    assert_eq!(again.name, "rod", "the scene of a robot is a scene");
}

#[tokio::test]
async fn a_model_in_mjcf_is_uploaded_and_driven() {
    let (_server, client) = server().await;
    let text = r#"<mujoco model="Rod"><worldbody><geom type="plane" size="1 1 1"/>
      <body name="rod"><joint name="hinge" axis="0 1 0" range="-60 60"/>
        <inertial pos="0 0 -0.5" mass="2" diaginertia="0.1 0.1 0.01"/></body></worldbody>
      <actuator><motor name="drive" joint="hinge" gear="3" ctrlrange="-1 1"/></actuator></mujoco>"#;
    for format in [v1::SceneFormat::Unspecified, v1::SceneFormat::Mjcf] {
        let request = v1::CreateModelRequest {
            scene: text.to_owned(),
            format: format.into(),
            name: format!("rod-{}", format as i32),
            ..Default::default()
        };
        let answer = client.import_model(request).await.unwrap();
        let (model, report) = (answer.model.unwrap(), answer.import_report.unwrap());
        assert_eq!((&*model.coordinates[0].name, &*model.inputs[0]), ("hinge", "drive"));
        let kinds: Vec<_> = report.notes.iter().map(v1::ImportNote::kind).collect();
        assert_eq!(kinds, [v1::ImportKind::Contact, v1::ImportKind::Approximated]);
        let request = v1::EvaluateDynamicsRequest {
            model: model.name,
            q: vec![0.3],
            inputs: vec![0.5],
            ..Default::default()
        };
        let found = client.evaluate_dynamics(request).await.unwrap().acceleration[0];
        let expected = (3.0 * 0.5 - 2.0 * 9.81 * 0.5 * 0.3_f64.sin()) / (0.1 + 2.0 * 0.25);
        assert!((found - expected).abs() < 1e-13, "{found} instead of {expected}");
    }
    let answer = client.validate_scene("<mujoco><include file=\"a.xml\"/></mujoco>").await.unwrap();
    assert_eq!(answer.problems[0].path, "1:9");
    assert!(answer.problems[0].message.contains("plantctl import"), "{:?}", answer.problems);
}

/// A block that is described by its mesh alone, and an arm that another file describes: both in `files`.
#[tokio::test]
async fn files_of_a_robot_come_with_it() {
    let (_server, client) = server().await;
    let block = r#"<mujoco model="block"><compiler meshdir="parts"/><asset><mesh name="m" file="block.obj"/><model name="A" file="arm.xml"/></asset>
      <worldbody><body name="block"><joint name="slide" type="slide"/><geom type="mesh" mesh="m" density="500"/>
        <attach model="A" body="arm" prefix="l_"/></body></worldbody></mujoco>"#;
    let arm = r#"<mujoco><compiler angle="radian"/><worldbody><body name="arm"><joint name="hinge" axis="0 1 0" range="-1 1"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>"#;
    // 1 by 2 by 3 m.
    let corners = (0..8).map(|i| format!("v {} {} {}\n", i & 1, i & 2, 3 * (i >> 2)));
    let faces = "f 1 3 4 2\nf 5 6 8 7\nf 1 2 6 5\nf 3 7 8 4\nf 1 5 7 3\nf 2 4 8 6\n";
    let mesh = corners.collect::<String>() + faces;
    let mut request = v1::CreateModelRequest { scene: block.to_owned(), ..Default::default() };
    let refusal = client.import_model(request.clone()).await.unwrap_err().to_string();
    assert!(refusal.contains("read the file with `plantctl import`"), "{refusal}");
    request.files.insert("arm.xml".to_owned(), arm.as_bytes().to_vec());
    let refusal = client.import_model(request.clone()).await.unwrap_err().to_string();
    assert!(refusal.contains("mesh file `parts/block.obj`"), "{refusal}");
    request.files.insert("parts/block.obj".to_owned(), mesh.clone().into_bytes());
    let answer = client.import_model(request.clone()).await.unwrap();
    let model = answer.model.unwrap();
    let names: Vec<_> = model.coordinates.iter().map(|c| c.name.as_str()).collect();
    assert_eq!(names, ["slide", "l_hinge"]);
    let report = answer.import_report.unwrap();
    assert_eq!((report.exact["inertia from a mesh"], report.exact["attached model"]), (1, 1));
    let state = v1::MechanicalState { model: model.name, ..Default::default() };
    let question = v1::DynamicsRequest { state: Some(state), ..Default::default() };
    let mass = client.dynamics(question).await.unwrap().mass_matrix.unwrap();
    assert!((mass.data[0] - 3001.0).abs() < 1e-9, "{:?}", mass.data);
    // Bytes that are no mesh, and none at all.
    for bytes in [b"f 1 2 99\n".to_vec(), Vec::new(), vec![0xff; 1000]] {
        request.name = "torn".to_owned();
        request.files.insert("parts/block.obj".to_owned(), bytes);
        let error = client.import_model(request.clone()).await.unwrap_err();
        assert_eq!(error.code(), Some(Code::InvalidArgument));
        assert!(error.to_string().contains("mesh file `parts/block.obj`"), "{error}");
    }
}

#[tokio::test]
async fn a_faulty_robot_is_refused_with_lines() {
    let (_server, client) = server().await;
    let faulty =
        PENDULUM.replace("value=\"2\"", "value=\"two\"").replace("link=\"base\"", "link=\"bas\"");
    let error = client.create_model(faulty.as_str()).await.unwrap_err();
    assert_eq!(error.code(), Some(Code::InvalidArgument));
    let answer = client.validate_scene(faulty).await.unwrap();
    let found: Vec<_> = answer.problems.iter().map(|p| (&*p.path, &*p.message)).collect();
    assert_eq!(
        found,
        [
            ("4:5", "there is no link `bas`"),
            ("9:32", "`value` of `mass` is `two`; must be a finite number"),
        ]
    );
    assert!(answer.model.is_none() && answer.import_report.is_none());
    let nested = format!("<robot name=\"r\">{}", "<a>".repeat(100_000));
    let answer = client.validate_scene(nested).await.unwrap();
    assert!(answer.problems[0].message.contains("stand in one another"));
    let request = v1::CreateModelRequest {
        scene: PENDULUM.to_owned(),
        format: v1::SceneFormat::Toml.into(),
        ..Default::default()
    };
    assert_eq!(client.import_model(request).await.unwrap_err().code(), Some(Code::InvalidArgument));
}
