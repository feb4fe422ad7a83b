//! URDF against formulas that are written out here, and files that are wrong.

use std::sync::Arc;

use nalgebra::{DMatrix, Matrix3, Rotation3, Unit, Vector3};
use plantd_import::{Base, ImportError, Inputs, Kind, Note, Options, import};
use plantd_models::scene::{Constraint, Force, Rotation, Shape};
use plantd_models::{Initial, Model, Plant, Scene, Settings};

/// An arm of a hinge, a bracket, a slide along a slanted axis and a wheel; the tensor of the slide's body
/// stands in turned axes.
const ARM: &str = r#"<?xml version="1.0"?>
<robot name="Arm 1"><material name="red"><color rgba="1 0 0 1"/></material>
  <link name="post"><inertial><mass value="9"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
  <joint name="hinge" type="revolute">
    <parent link="post"/> <child link="upper/arm"/>
    <origin xyz="0.1 -0.2 0.3" rpy="0.3 -0.4 0.5"/> <axis xyz="0 2 1"/>
    <limit lower="-1" upper="1" effort="20" velocity="3"/>
    <dynamics damping="0.5" friction="0.2"/>
  </joint>
  <link name="upper/arm">
    <visual><origin xyz="0 0 -0.1" rpy="0 0 1"/><geometry><box size="1 2 3"/></geometry><material name="red"/></visual>
    <inertial>
      <origin xyz="0.05 0.02 -0.1"/> <mass value="1.5"/>
      <inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0.001" ixz="-0.002" iyz="0.003"/>
    </inertial>
  </link>
  <joint name="bolt" type="fixed">
    <parent link="upper/arm"/> <child link="bracket"/> <origin xyz="0 0.1 -0.3" rpy="0 0 1.2"/>
  </joint>
  <link name="bracket"/>
  <joint name="slide" type="prismatic">
    <parent link="bracket"/> <child link="rod"/> <origin quat_xyzw="0.6 0 0 0.8"/> <axis xyz="1 1 0"/>
  </joint>
  <link name="rod">
    <inertial>
      <origin xyz="0.3 0 0" rpy="0.7 0.2 -0.9"/> <mass value="0.8"/>
      <inertia ixx="0.001" iyy="0.02" izz="0.0205" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="wheel" type="continuous"><parent link="rod"/><child link="rim"/></joint>
  <link name="rim"><inertial><mass value="0.4"/><inertia ixx="0.004" iyy="0.002" izz="0.002"/></inertial></link>
</robot>"#;

/// A pose: what a frame is turned by and where it stands.
type Pose = (Matrix3<f64>, Vector3<f64>);

fn rpy(roll: f64, pitch: f64, yaw: f64) -> Matrix3<f64> {
    let about = |axis: Unit<Vector3<f64>>, angle| Rotation3::from_axis_angle(&axis, angle);
    (about(Vector3::z_axis(), yaw)
        * about(Vector3::y_axis(), pitch)
        * about(Vector3::x_axis(), roll))
    .into_inner()
}

fn then((r, t): Pose, (s, u): Pose) -> Pose {
    (r * s, t + r * u)
}

/// The mass matrix of [`ARM`], `Σ m JvᵀJv + Jwᵀ R I Rᵀ Jw`, and the forces of gravity, `−Σ m Jvᵀ g`: a sum over
/// bodies, with the numbers of the file typed once more.
fn by_hand(q: [f64; 3]) -> (DMatrix<f64>, [f64; 3]) {
    let hinge_axis = Unit::new_normalize(Vector3::new(0.0, 2.0, 1.0));
    let slide_axis = Unit::new_normalize(Vector3::new(1.0, 1.0, 0.0));
    let hinge = (rpy(0.3, -0.4, 0.5), Vector3::new(0.1, -0.2, 0.3));
    let turned = Rotation3::from_axis_angle(&hinge_axis, q[0]).into_inner();
    let upper = then(hinge, (turned, Vector3::zeros()));
    let bracket = then(upper, (rpy(0.0, 0.0, 1.2), Vector3::new(0.0, 0.1, -0.3)));
    // The quaternion (0.6, 0, 0, 0.8) turns about x by 2 atan(0.6 / 0.8).
    let slide = then(bracket, (rpy(2.0 * 0.75_f64.atan(), 0.0, 0.0), Vector3::zeros()));
    let rod = then(slide, (Matrix3::identity(), slide_axis.into_inner() * q[1]));
    let rim = then(rod, (rpy(q[2], 0.0, 0.0), Vector3::zeros()));

    let axes = [
        hinge.0 * hinge_axis.into_inner(),
        slide.0 * slide_axis.into_inner(),
        rod.0 * Vector3::x(),
    ];
    let pivots = [hinge.1, slide.1, rod.1];
    let diagonal = |x, y, z| Matrix3::from_diagonal(&Vector3::new(x, y, z));
    let upper_tensor = Matrix3::new(0.02, 0.001, -0.002, 0.001, 0.03, 0.003, -0.002, 0.003, 0.04);
    let bodies: [(f64, Pose, Matrix3<f64>, usize); 3] = [
        (1.5, then(upper, (Matrix3::identity(), Vector3::new(0.05, 0.02, -0.1))), upper_tensor, 1),
        (
            0.8,
            then(rod, (rpy(0.7, 0.2, -0.9), Vector3::new(0.3, 0.0, 0.0))),
            diagonal(0.001, 0.02, 0.0205),
            2,
        ),
        (0.4, rim, diagonal(0.004, 0.002, 0.002), 3),
    ];
    let (mut mass, mut gravity) = (DMatrix::zeros(3, 3), [0.0; 3]);
    for (m, (r, c), tensor, moved_by) in bodies {
        let (mut linear, mut angular) = (DMatrix::zeros(3, 3), DMatrix::zeros(3, 3));
        for k in 0..moved_by {
            if k == 1 {
                linear.column_mut(k).copy_from(&axes[k]);
            } else {
                linear.column_mut(k).copy_from(&axes[k].cross(&(c - pivots[k])));
                angular.column_mut(k).copy_from(&axes[k]);
            }
            gravity[k] += m * 9.81 * linear[(2, k)];
        }
        let world = r * tensor * r.transpose();
        let world = DMatrix::from_fn(3, 3, |i, j| world[(i, j)]);
        mass += linear.transpose() * &linear * m + angular.transpose() * world * &angular;
    }
    (mass, gravity)
}

/// Without what resists, which the sums of [`by_hand`] do not have.
fn free_of_friction(mut scene: Scene) -> Scene {
    scene.coordinates.iter_mut().for_each(|coordinate| coordinate.damping = None);
    scene.forces.clear();
    scene
}

fn plant(scene: &Scene) -> Plant {
    let model = Arc::new(Model::compile(scene).unwrap());
    Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap()
}

/// `M` by columns: the momenta of unit velocities.
fn mass_matrix(plant: &mut Plant, q: &[f64]) -> DMatrix<f64> {
    let columns: Vec<_> = (0..q.len())
        .map(|j| {
            let mut v = vec![0.0; q.len()];
            v[j] = 1.0;
            plant.initialize(&Initial::Velocity { q: q.to_vec(), v }).unwrap();
            nalgebra::DVector::from_vec(plant.p().to_vec())
        })
        .collect();
    DMatrix::from_columns(&columns)
}

#[test]
fn the_mechanics_is_the_sum_over_bodies() {
    let scene = free_of_friction(import(ARM, &Options::default()).unwrap().scene);
    let mut plant = plant(&scene);
    for q in [[0.0; 3], [0.4, -0.3, 1.2], [-2.0, 0.7, 0.1]] {
        let (mass, gravity) = by_hand(q);
        let found = mass_matrix(&mut plant, &q);
        assert!((&found - &mass).amax() < 1e-14, "{found} instead of {mass}");
        // From rest, over a time step h short enough, M Δq = −½h² ∂V/∂q with an error of h².
        plant.initialize(&Initial::Velocity { q: q.to_vec(), v: vec![0.0; 3] }).unwrap();
        plant.step(&[0.0; 3]).unwrap();
        let h = plant.settings().time_step_s;
        let moved =
            nalgebra::DVector::from_iterator(3, plant.q().iter().zip(q).map(|(a, b)| a - b));
        let force = mass * moved * (-2.0 / (h * h));
        for (force, expected) in force.iter().zip(gravity) {
            assert!((force - expected).abs() < 1e-4, "{force} instead of {expected}");
        }
    }
}

#[test]
fn what_is_not_mechanics_is_told() {
    let robot = import(ARM, &Options::default()).unwrap();
    robot.check().unwrap();
    let scene = &robot.scene;
    assert_eq!(scene.name, "arm-1");
    assert_eq!(scene.inputs.len(), 3);
    assert_eq!(scene.inputs[0].coordinate.as_deref(), Some("hinge"));
    assert_eq!(scene.inputs[0].limits, Some([-20.0, 20.0]));
    let hinge = &scene.coordinates[0];
    assert_eq!((hinge.damping, hinge.limits), (Some(0.5), Some([-1.0, 1.0])));
    assert!(matches!(&scene.forces[..], [Force::Friction { force: 0.2, velocity: 0.01, .. }]));
    assert_eq!(Scene::from_toml(&scene.to_toml()).unwrap(), *scene);
    let told: Vec<_> = robot
        .report
        .notes
        .iter()
        .map(|note| (note.kind, note.line, note.message.as_str()))
        .collect();
    let expected = [
        (Kind::Approximated, 4, "joint `hinge` moves past its limits, -1 and 1"),
        (Kind::Approximated, 4, "dry friction of joint `hinge`"),
        (Kind::NoEffect, 3, "a body that is fixed to the world"),
        (Kind::NoEffect, 7, "attribute `velocity` of `limit`"),
    ];
    assert_eq!(told.len(), expected.len(), "{told:?}");
    for ((kind, line, message), (is_kind, at, start)) in told.iter().zip(expected) {
        assert!((*kind, *line) == (is_kind, at) && message.starts_with(start), "{told:?}");
    }
    let names: Vec<_> = robot.report.names.iter().map(|name| (&*name.from, &*name.to)).collect();
    assert_eq!(names, [("Arm 1", "arm-1"), ("upper/arm", "upper_arm")]);
    assert_eq!(robot.report.exact["prismatic joint"], 1);
}

/// A joint that falls onto its stop rests where the stop carries the weight, `k (x − δ / 2) = m g l cos q`.
#[test]
fn joints_stop_at_their_limits() {
    let text = r#"<robot name="flap"><link name="base"/><joint name="hinge" type="revolute">
      <parent link="base"/><child link="flap"/><axis xyz="0 1 0"/><limit lower="-1" upper="0.3" effort="0" velocity="1"/></joint>
      <link name="flap"><inertial><origin xyz="0.2 0 0"/><mass value="1"/>
        <inertia ixx="0.01" iyy="0.01" izz="0.01"/></inertial></link></robot>"#;
    let options = Options { stops: Some([0.02, 0.1]), inputs: Inputs::None, ..Options::default() };
    let robot = import(text, &options).unwrap();
    assert!(
        robot.report.notes.is_empty()
            || robot.report.notes.iter().all(|n| n.kind == Kind::NoEffect)
    );
    let mut plant = plant(&robot.scene);
    for _ in 0..5000 {
        plant.step(&[]).unwrap();
    }
    // A positive turn about y leads down. The inertia about the hinge is 0.05 kg m².
    let (q, stiffness) = (plant.q()[0], 0.05 * (5.834_f64 / 0.1).powi(2));
    let (carried, weight) = (stiffness * (q - 0.3 - 0.01), 9.81 * 0.2 * q.cos());
    assert!((carried / weight - 1.0).abs() < 1e-3, "{carried} for {weight}");
    assert!(plant.velocity()[0].abs() < 1e-6);
}

#[test]
fn links_are_shown() {
    let mesh = "<visual><geometry><mesh filename=\"package://arm/m/rod.stl\" scale=\"2 2 2\"/></geometry></visual>";
    let text =
        ARM.replace("<link name=\"bracket\"/>", &format!("<link name=\"bracket\">{mesh}</link>"));
    let packages = [("arm".to_owned(), "/robots/arm/".to_owned())].into();
    let scene = import(&text, &Options { packages, ..Options::default() }).unwrap().scene;
    let shown = |name: &str| {
        let frame = scene.frames.iter().find(|frame| frame.name == name).unwrap();
        frame.visuals[0].clone()
    };
    let upper = shown("upper_arm");
    assert_eq!(upper.shape, Shape::Box { size: [1.0, 2.0, 3.0] });
    assert_eq!((upper.translation, upper.color), ([0.0, 0.0, -0.1], Some([1.0, 0.0, 0.0, 1.0])));
    assert_eq!(upper.rotation, Some(Rotation::Rpy([0.0, 0.0, 1.0])));
    let file = "/robots/arm/m/rod.stl".to_owned();
    assert_eq!(shown("bracket").shape, Shape::Mesh { file, scale: [2.0; 3] });
    Model::compile(&scene).unwrap();
}

/// A free body falls, and turns as it did.
#[test]
fn a_free_base() {
    let text = r#"<robot name="brick"><link name="brick"><inertial><mass value="2"/>
      <inertia ixx="0.01" iyy="0.02" izz="0.025"/></inertial></link></robot>"#;
    let robot = import(text, &Options { base: Base::Free, ..Options::default() }).unwrap();
    let mut plant = plant(&robot.scene);
    let names: Vec<_> = plant.model().coordinates().iter().map(|c| c.name.clone()).collect();
    assert_eq!(names, ["brick_x", "brick_y", "brick_z", "brick_rx", "brick_ry", "brick_rz"]);
    let mass = mass_matrix(&mut plant, &[0.0; 6]);
    let diagonal = [2.0, 2.0, 2.0, 0.01, 0.02, 0.025];
    assert!((mass - DMatrix::from_diagonal(&diagonal.to_vec().into())).amax() < 1e-15);
    plant.initialize(&Initial::Scene).unwrap();
    (0..100).for_each(|_| _ = plant.step(&[]).unwrap());
    assert!((plant.q()[2] + 0.5 * 9.81 * 0.1 * 0.1).abs() < 1e-12);
    let held = import(text, &Options::default()).unwrap();
    assert!(held.scene.frames[0].joint.is_none() && held.scene.frames[0].body.is_none());
}

/// A planar joint slides along what the shortest turn of z onto its normal makes of x and y.
#[test]
fn planar_and_spherical_joints() {
    let text = r#"<robot name="puck"><link name="world"/>
      <joint name="table" type="planar"><parent link="world"/><child link="puck"/><axis xyz="0 -1 0"/></joint>
      <link name="puck"><inertial><origin xyz="0.1 0 0"/><mass value="3"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
      <joint name="socket" type="spherical"><parent link="puck"/><child link="arm"/></joint>
      <link name="arm"><inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
    </robot>"#;
    let scene = import(text, &Options::default()).unwrap().scene;
    let mut plant = plant(&scene);
    let names: Vec<_> = plant.model().coordinates().iter().map(|c| c.name.clone()).collect();
    assert_eq!(names, ["table_x", "table_y", "table_turn", "socket_rx", "socket_ry", "socket_rz"]);
    plant
        .initialize(&Initial::Velocity { q: vec![0.2, 0.3, 0.0, 0.0, 0.0, 0.0], v: vec![0.0; 6] })
        .unwrap();
    // z turns onto −y about x: x stays, y becomes z.
    let site = plant.model().site("arm", [0.0; 3]).unwrap();
    let at = plant.pose(&site).position;
    assert!(at.iter().zip([0.2, 0.0, 0.3]).all(|(a, b)| (a - b).abs() < 1e-15), "{at:?}");
    let mass = mass_matrix(&mut plant, &[0.0; 6]);
    assert!((mass[(0, 0)] - 4.0).abs() < 1e-15 && (mass[(2, 2)] - 0.23).abs() < 1e-15, "{mass}");
    assert!(scene.inputs.is_empty(), "no joint of one axis");
}

/// A body that floats in the world has the world's coordinates, whatever its origin; one on another body has those
/// of its origin there.
#[test]
fn floating_joints() {
    let text = r#"<robot name="kite"><link name="world"/>
      <joint name="air" type="floating"><parent link="world"/><child link="kite"/><origin xyz="1 2 3" rpy="0 0.4 0"/></joint>
      <link name="kite"><inertial><mass value="3"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
      <joint name="tail" type="floating"><parent link="kite"/><child link="ribbon"/><origin xyz="0 0 -1"/></joint>
      <link name="ribbon"><inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
    </robot>"#;
    let plant = plant(&import(text, &Options::default()).unwrap().scene);
    let q = plant.q().to_vec();
    assert!(q[..6].iter().zip([1.0, 2.0, 3.0, 0.0, 0.4, 0.0]).all(|(a, b)| (a - b).abs() < 1e-15));
    assert_eq!(q[6..], [0.0; 6]);
    let site = plant.model().site("ribbon", [0.0; 3]).unwrap();
    let at = plant.pose(&site).position;
    let expected = [1.0 - 0.4_f64.sin(), 2.0, 3.0 - 0.4_f64.cos()];
    assert!(at.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-15), "{at:?}");
}

/// `follower = −2 middle + 0.1`, `middle = 0.5 leader + 0.2`.
#[test]
fn chains_of_mimics_are_couplings_that_hold_at_the_start() {
    let joint = |name: &str, mimic: &str| {
        format!(
            r#"<joint name="{name}" type="continuous"><parent link="base"/><child link="l_{name}"/>{mimic}</joint>
               <link name="l_{name}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>"#
        )
    };
    let text = format!(
        r#"<robot name="gears"><link name="base"/>{}{}{}</robot>"#,
        joint("follower", r#"<mimic joint="middle" multiplier="-2" offset="0.1"/>"#),
        joint("middle", r#"<mimic joint="leader" multiplier="0.5" offset="0.2"/>"#),
        joint("leader", ""),
    );
    let robot = import(&text, &Options::default()).unwrap();
    let inputs: Vec<_> = robot.scene.inputs.iter().map(|input| input.name.as_str()).collect();
    assert_eq!(inputs, ["leader_drive"]);
    assert!(robot.scene.constraints.iter().all(|c| matches!(c, Constraint::Coupling { .. })));
    let mut plant = plant(&robot.scene);
    for step in 0..200 {
        let [follower, middle, leader] = plant.q().try_into().unwrap();
        assert!((follower + 2.0 * middle - 0.1).abs() < 1e-12, "step {step}");
        assert!((middle - 0.5 * leader - 0.2).abs() < 1e-12, "step {step}");
        plant.step(&[0.3]).unwrap();
    }
    // 1 + 0.25 + 1 kg·m² move with the leader, about x.
    let t = 200.0 * plant.settings().time_step_s;
    assert!((plant.q()[2] - 0.5 * 0.3 / 2.25 * t * t).abs() < 1e-12);
    let circle = text.replace(
        r#"<joint name="leader" type="continuous">"#,
        r#"<joint name="leader" type="continuous"><mimic joint="follower"/>"#,
    );
    assert!(problems(&circle)[0].contains("mimics itself"));
}

#[test]
fn drives_are_those_of_transmissions_and_command_interfaces() {
    let drive = r#"<transmission name="t">
        <type>transmission_interface/SimpleTransmission</type>
        <joint name="wheel"/> <actuator name="motor"><mechanicalReduction>50</mechanicalReduction></actuator>
      </transmission>
      <ros2_control name="c" type="system"><joint name="slide"><command_interface name="effort"/></joint>
        <joint name="hinge"><state_interface name="position"/></joint></ros2_control></robot>"#;
    let text = ARM.replace("</robot>", drive);
    let drives = |inputs| {
        let scene = import(&text, &Options { inputs, ..Options::default() }).unwrap().scene;
        let drives = scene.inputs.into_iter().map(|input| (input.coordinate.unwrap(), input.gain));
        drives.collect::<Vec<_>>()
    };
    assert_eq!(drives(Inputs::AsTold), [("wheel".to_owned(), 50.0), ("slide".to_owned(), 1.0)]);
    assert_eq!(drives(Inputs::All).len(), 3);
    assert!(drives(Inputs::None).is_empty());
    let differential = text.replace("SimpleTransmission", "DifferentialTransmission");
    let notes = import(&differential, &Options::default()).unwrap().report.notes;
    let is_told = |note: &Note| {
        note.kind == Kind::Approximated && note.message.contains("DifferentialTransmission")
    };
    assert!(notes.iter().any(is_told), "{notes:?}");
}

/// Two parts that cannot be bodies alone make one that can; one that cannot be is refused.
#[test]
fn inertias_that_no_body_has() {
    let text = |second: &str| {
        format!(
            r#"<robot name="r"><link name="base"/>
            <joint name="j" type="continuous"><parent link="base"/><child link="a"/></joint>
            <link name="a"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="3"/></inertial></link>
            <joint name="f" type="fixed"><parent link="a"/><child link="b"/><origin xyz="0 0 1"/></joint>
            <link name="b"><inertial><mass value="1"/>{second}</inertial></link></robot>"#
        )
    };
    let good = import(&text(r#"<inertia ixx="1" iyy="1" izz="1"/>"#), &Options::default()).unwrap();
    let bodies: Vec<_> = good.scene.frames.iter().filter_map(|frame| frame.body.as_ref()).collect();
    assert!(bodies.len() == 2 && bodies.iter().all(|body| !body.any_inertia));
    good.check().unwrap();
    // About x through the first centre: 1 kg·m² each, and the second 1 m away.
    let mass = mass_matrix(&mut plant(&good.scene), &[0.0]);
    assert!((mass[(0, 0)] - (1.0 + 1.0 + 1.0)).abs() < 1e-15, "{mass}");
    let bad = text(r#"<inertia ixx="0.1" iyy="0.1" izz="9"/>"#);
    assert!(
        problems(&bad)[0].starts_with("3:13: no body has the inertia of link `a`"),
        "{:?}",
        problems(&bad)
    );
    let taken = import(&bad, &Options { lenient: true, ..Options::default() }).unwrap();
    taken.check().unwrap();
    assert!(taken.scene.frames[1].body.as_ref().unwrap().any_inertia);
    assert_eq!(taken.report.notes[0].kind, Kind::Warning);
}

fn problems(text: &str) -> Vec<String> {
    let ImportError { problems } = import(text, &Options::default()).unwrap_err();
    problems.iter().map(ToString::to_string).collect()
}

#[test]
fn what_is_wrong_is_named_with_its_place() {
    let change = |from: &str, to: &str| {
        assert!(ARM.contains(from), "{from}");
        ARM.replacen(from, to, 1)
    };
    let cases = [
        (change("</robot>", ""), "not XML"),
        (
            change("<robot name=\"Arm 1\">", "<model>").replace("</robot>", "</model>"),
            "the root is `model`",
        ),
        (change("Arm 1\"", "Arm 1\" version=\"2.0\""), "`version`"),
        (change("type=\"revolute\"", "type=\"helical\""), "4:3: joint `hinge` has type `helical`"),
        (change("<child link=\"rod\"/>", "<child link=\"rodd\"/>"), "there is no link `rodd`"),
        (change("<child link=\"rod\"/>", ""), "joint `slide` has no `child`"),
        (change("<child link=\"rod\"/>", "<child link=\"upper/arm\"/>"), "is a child of joints"),
        (change("<parent link=\"post\"/>", "<parent link=\"rim\"/>"), "hangs from itself"),
        (change("name=\"rod\"", "name=\"rim\""), "there are two links `rim`"),
        (
            change("xyz=\"0 2 1\"", "xyz=\"0 2 x\""),
            "6:53: `xyz` of `axis` is `0 2 x`; must be 3 finite numbers",
        ),
        (change("xyz=\"0 2 1\"", "xyz=\"0 0 0\""), "has no direction"),
        (change("value=\"1.5\"", "value=\"nan\""), "must be a finite number"),
        (change("value=\"1.5\"", "value=\"1e999\""), "must be a finite number"),
        (change("value=\"1.5\"", "value=\"-1\""), "must not be negative"),
        (change("<mass value=\"1.5\"/>", ""), "`inertial` has no `mass`"),
        (change("ixx=\"0.02\"", ""), "has no attribute `ixx`"),
        (change("damping=\"0.5\"", "damping=\"-1\""), "must not be negative"),
        (change("lower=\"-1\"", "lower=\"2\""), "`lower` is 2, `upper` 1; must not be less"),
        (change("quat_xyzw=\"0.6 0 0 0.8\"", "quat_xyzw=\"1 1 0 0\""), "must be 1"),
        (change("quat_xyzw", "rpy=\"0 0 1\" quat_xyzw"), "one of them is allowed"),
        (
            change("<robot ", "<robot xmlns:xacro=\"http://ros.org/wiki/xacro\" ")
                .replace("</robot>", "<xacro:macro name=\"m\"/></robot>"),
            "expand it first",
        ),
        (
            change("<link name=\"bracket\"/>", "<link name=\"bracket\"/><link name=\"lost\"/>"),
            "are both no joint's child",
        ),
        (change("<dynamics", "<dynamics damping=\"1\"/><dynamics"), "a second `dynamics`"),
        (
            "<!DOCTYPE r [<!ENTITY a \"aaaa\"><!ENTITY b \"&a;&a;\">]><robot name=\"&b;\"/>"
                .to_owned(),
            "DTD",
        ),
    ];
    for (text, message) in cases {
        let problems = problems(&text);
        assert!(problems.iter().any(|p| p.contains(message)), "{message}: {problems:?}");
    }
    let all = ARM.replace("value=", "values=");
    assert_eq!(problems(&all).len(), 4, "all problems at once");
    let unknown = change("damping=", "dampign=").replace("<visual>", "<spring/><visual>");
    let notes = import(&unknown, &Options::default()).unwrap().report.notes;
    assert!(notes[0].kind == Kind::Warning && notes[0].message.contains("`dampign` of `dynamics`"));
    assert!(notes[1].kind == Kind::Warning && notes[1].message.contains("`spring` in `link`"));
}

/// Truncated anywhere, nested deeply, wide, on one line: an answer, soon.
#[test]
fn hostile_files_cost_little() {
    for end in (0..ARM.len()).filter(|end| ARM.is_char_boundary(*end)) {
        assert!(import(&ARM[..end], &Options::default()).is_err(), "{end}");
    }
    let nested = format!("<robot name=\"r\">{}", "<link name=\"a\">".repeat(100_000));
    assert!(problems(&nested)[0].contains("stand in one another"));
    let wide = format!("<robot name=\"r\">{}</robot>", "<link name=\"a\"/>".repeat(100_000));
    assert!(problems(&wide)[0].contains("100000 links"));
    let strange = format!(
        "<robot name=\"r\"><link name=\"a\"/>{}</robot>",
        (0..100_000).map(|i| format!("<x{i}/>")).collect::<String>()
    );
    let report = import(&strange, &Options::default()).unwrap().report;
    assert_eq!((report.notes.len(), report.left_out), (1000, 99_000));
    let chain: String = (0..4000)
        .map(|i| format!("<link name=\"a.{i}\"/><joint name=\"j\u{e4}{i}\" type=\"fixed\"><parent link=\"a.{i}\"/><child link=\"a.{}\"/></joint>", i + 1))
        .collect();
    let chain = format!("<robot name=\"r\">{chain}<link name=\"a.4000\"/></robot>");
    assert_eq!(import(&chain, &Options::default()).unwrap().scene.frames.len(), 4001);
}
