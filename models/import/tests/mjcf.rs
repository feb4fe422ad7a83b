//! MJCF against formulas that are written out here, and files that are wrong.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector, Isometry3, Matrix3, Quaternion, UnitQuaternion, Vector3};
use plantd_import::{Inputs, Kind, Options, import, import_with_files};
use plantd_models::scene::{Component, Constraint, CoordinateKind, Force, Shape, Spring};
use plantd_models::{Continuous, ContinuousPoint, Initial, Model, Plant, Scene, Settings};

/// A base with a slide and a hinge beside its origin, both from classes, a forearm with its inertia from shapes,
/// and a tip on a ball joint. Angles in degrees, Euler angles about z, then y, then x.
const ARM: &str = r#"<mujoco model="Arm 2">
  <compiler angle="degree" eulerseq="zyx"/>
  <option timestep="0.004" gravity="0 0.5 -9"/>
  <default>
    <joint pos="0.1 0 0.05" damping="0.3"/>
    <default class="rail"><joint type="slide" axis="2 0 1" ref="0.2" armature="0.7"/></default>
    <geom density="500"/>
  </default>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="base" pos="0.1 0.2 0.3" euler="30 -20 10" childclass="rail">
      <joint name="rail"/>
      <joint name="turn" class="main" axis="0 1 1" ref="40" range="-90 90"/>
      <inertial pos="0.05 0 0.1" mass="2" fullinertia="0.02 0.03 0.025 0.002 -0.003 0.001"/>
      <frame pos="0 0.1 0" axisangle="1 1 0 25">
        <body name="forearm" pos="0.3 0 0">
          <joint name="elbow" class="main" axis="0 0 1"/>
          <geom type="box" size="0.1 0.02 0.03" pos="0.1 0 0"/>
          <geom size="0.05" pos="0.2 0 0.1" mass="0.4"/>
          <site name="hand" pos="0.2 0 0" xyaxes="0 1 0 -1 0 0"/>
          <body name="tip" pos="0.2 0.1 0" zaxis="1 1 1">
            <joint name="wrist" type="ball" class="main" pos="0 0 0.02"/>
            <inertial pos="0 0 0.1" mass="0.3" diaginertia="0.001 0.002 0.0015" quat="0.8 0.6 0 0"/>
          </body>
        </body>
      </frame>
    </body>
  </worldbody>
</mujoco>"#;

fn turn(axis: [f64; 3], degrees: f64) -> Isometry3<f64> {
    let axis = nalgebra::Unit::new_normalize(Vector3::from(axis));
    still(UnitQuaternion::from_axis_angle(&axis, degrees.to_radians()))
}

/// A turn without a shift.
fn still(turn: UnitQuaternion<f64>) -> Isometry3<f64> {
    Isometry3::from_parts(Default::default(), turn)
}

fn shift(by: [f64; 3]) -> Isometry3<f64> {
    Isometry3::translation(by[0], by[1], by[2])
}

fn about(anchor: [f64; 3], motion: Isometry3<f64>) -> Isometry3<f64> {
    shift(anchor) * motion * shift(anchor.map(|x| -x))
}

/// Poses of the three bodies of [`ARM`]; the last three of `q` are a turn in the tip's own axes, away from `wrist`.
fn poses(q: &[f64], wrist: UnitQuaternion<f64>) -> [Isometry3<f64>; 3] {
    let anchor = [0.1, 0.0, 0.05];
    let rail = Vector3::new(2.0, 0.0, 1.0).normalize() * (q[0] - 0.2);
    let base = shift([0.1, 0.2, 0.3])
        * turn([0.0, 0.0, 1.0], 30.0)
        * turn([0.0, 1.0, 0.0], -20.0)
        * turn([1.0, 0.0, 0.0], 10.0)
        * shift(rail.into())
        * about(anchor, turn([0.0, 1.0, 1.0], q[1].to_degrees() - 40.0));
    let frame = shift([0.0, 0.1, 0.0]) * turn([1.0, 1.0, 0.0], 25.0);
    let elbow = about(anchor, turn([0.0, 0.0, 1.0], q[2].to_degrees()));
    let forearm = base * frame * shift([0.3, 0.0, 0.0]) * elbow;
    // The shortest way from z to (1, 1, 1) is a turn about (−1, 1, 0).
    let tilt = turn([-1.0, 1.0, 0.0], (1.0 / 3.0_f64.sqrt()).acos().to_degrees());
    let spin = wrist * UnitQuaternion::from_scaled_axis(Vector3::from_column_slice(&q[3..6]));
    let tip = forearm * shift([0.2, 0.1, 0.0]) * tilt * about([0.0, 0.0, 0.02], still(spin));
    [base, forearm, tip]
}

/// Mass, centre and tensor of the bodies; those of the forearm are sums over its shapes.
fn bodies() -> [(f64, Vector3<f64>, Matrix3<f64>); 3] {
    let box_mass = 500.0 * 0.2 * 0.04 * 0.06;
    let (box_center, ball_center) = (Vector3::new(0.1, 0.0, 0.0), Vector3::new(0.2, 0.0, 0.1));
    let mass = box_mass + 0.4;
    let center = (box_center * box_mass + ball_center * 0.4) / mass;
    let [x, y, z] = [0.2_f64, 0.04, 0.06].map(|edge| edge * edge * box_mass / 12.0);
    let away = |at: Vector3<f64>, m: f64| {
        let d = at - center;
        (Matrix3::identity() * d.norm_squared() - d * d.transpose()) * m
    };
    let forearm = Matrix3::from_diagonal(&Vector3::new(y + z, x + z, x + y))
        + Matrix3::identity() * (0.4 * 0.4 * 0.05 * 0.05)
        + away(box_center, box_mass)
        + away(ball_center, 0.4);
    let quat = UnitQuaternion::from_quaternion(Quaternion::new(0.8, 0.6, 0.0, 0.0));
    let r = quat.to_rotation_matrix().into_inner();
    let tip = r * Matrix3::from_diagonal(&Vector3::new(0.001, 0.002, 0.0015)) * r.transpose();
    let base = Matrix3::new(0.02, 0.002, -0.003, 0.002, 0.03, 0.001, -0.003, 0.001, 0.025);
    [
        (2.0, Vector3::new(0.05, 0.0, 0.1), base),
        (mass, center, forearm),
        (0.3, Vector3::new(0.0, 0.0, 0.1), tip),
    ]
}

/// `Σ m JvᵀJv + Jwᵀ R I Rᵀ Jw` and `Σ m g Jv` with Jacobians by central differences.
fn by_hand(q: &[f64], wrist: UnitQuaternion<f64>) -> (DMatrix<f64>, DVector<f64>) {
    let step = 1e-5;
    let at = |k: usize, by: f64| {
        let mut q = q.to_vec();
        q[k] += by;
        poses(&q, wrist)
    };
    let gravity = Vector3::new(0.0, 0.5, -9.0);
    let (mut mass, mut weight) = (DMatrix::zeros(6, 6), DVector::zeros(6));
    for (i, (m, center, tensor)) in bodies().into_iter().enumerate() {
        let (mut linear, mut angular) = (DMatrix::zeros(3, 6), DMatrix::zeros(3, 6));
        for k in 0..6 {
            let (ahead, back) = (at(k, step)[i], at(k, -step)[i]);
            let c = |pose: &Isometry3<f64>| (pose * nalgebra::Point3::from(center)).coords;
            linear.set_column(k, &((c(&ahead) - c(&back)) / (2.0 * step)));
            let spin = (ahead.rotation * back.rotation.inverse()).scaled_axis() / (2.0 * step);
            angular.set_column(k, &spin);
        }
        let r = poses(q, wrist)[i].rotation.to_rotation_matrix().into_inner();
        let world = r * tensor * r.transpose();
        let world = DMatrix::from_fn(3, 3, |i, j| world[(i, j)]);
        mass += linear.transpose() * &linear * m + angular.transpose() * world * &angular;
        weight += linear.transpose() * DVector::from_column_slice(gravity.as_slice()) * m;
    }
    // The rail's armature.
    mass[(0, 0)] += 0.7;
    (mass, weight)
}

fn model(scene: &Scene) -> Arc<Model> {
    Arc::new(Model::compile(scene).unwrap_or_else(|error| panic!("{error}")))
}

/// Accelerations of the dynamic coordinates.
fn accelerations(scene: &Scene, q: &[f64], v: &[f64], inputs: &[f64]) -> DVector<f64> {
    let point = ContinuousPoint {
        q: q.to_vec(),
        v: v.to_vec(),
        inputs: inputs.to_vec(),
        prescribed_acceleration: Vec::new(),
    };
    let found = Continuous::new(model(scene)).evaluate(&point).unwrap();
    DVector::from_vec(found.acceleration)
}

#[test]
fn the_mechanics_is_the_sum_over_bodies() {
    let robot = import(ARM, &Options::default()).unwrap();
    let scene = &robot.scene;
    assert_eq!((scene.name.as_str(), scene.time_step_s), ("arm-2", 0.004));
    let model = model(scene);
    let names: Vec<_> = model.coordinates().iter().map(|c| c.name.as_str()).collect();
    assert_eq!(names, ["rail", "turn", "elbow", "wrist_rx", "wrist_ry", "wrist_rz"]);
    let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model)).unwrap();
    let start: Vec<_> = model.coordinates().iter().map(|c| c.initial).collect();
    assert_eq!(start, [0.2, 40.0_f64.to_radians(), 0.0, 0.0, 0.0, 0.0], "references");
    for (q, spin) in [
        ([0.2, 40.0_f64.to_radians(), 0.0], [0.0; 3]),
        ([-0.1, 0.4, 1.1], [0.3, -0.8, 0.5]),
        ([0.5, -1.2, -0.6], [-1.5, 0.2, 2.0]),
    ] {
        let wrist = UnitQuaternion::from_scaled_axis(Vector3::from(spin));
        let own = [q, spin].concat();
        let hand = [q, [0.0; 3]].concat();
        let (mass, weight) = by_hand(&hand, wrist);
        let columns: Vec<_> = (0..6)
            .map(|k| {
                let mut v = vec![0.0; 6];
                v[k] = 1.0;
                plant.initialize(&Initial::Velocity { q: own.clone(), v }).unwrap();
                DVector::from_vec(plant.p().to_vec())
            })
            .collect();
        let found = DMatrix::from_columns(&columns);
        assert!((&found - &mass).amax() < 1e-9, "{found} instead of {mass}");
        let force = &found * accelerations(scene, &own, &[0.0; 6], &[]);
        assert!((&force - &weight).amax() < 1e-8, "{force} instead of {weight}");
        for (name, pose) in ["base", "forearm", "tip"].iter().zip(poses(&hand, wrist)) {
            let site = plant.pose(&model.site(name, [0.0; 3]).unwrap());
            assert!((Vector3::from(site.position) - pose.translation.vector).amax() < 1e-14);
            let found = UnitQuaternion::from_scaled_axis(Vector3::from(site.rotation));
            assert!(found.angle_to(&pose.rotation) < 1e-7, "{name}");
        }
    }
}

#[test]
fn what_is_not_mechanics_is_told() {
    let robot = import(ARM, &Options::default()).unwrap();
    let notes = &robot.report.notes;
    assert_eq!(notes[0].kind, Kind::Contact, "the report begins with contacts");
    assert_eq!((notes[0].line, notes[0].column), (10, 5));
    assert!(notes[0].message.starts_with("3 shapes may touch"), "{}", notes[0].message);
    assert!(notes[1].message.starts_with("joint `turn` moves past its limits"));
    let turn = robot.scene.coordinates.iter().find(|c| c.name == "turn").unwrap();
    let right = std::f64::consts::FRAC_PI_2;
    assert_eq!((turn.limits, turn.damping), (Some([-right, right]), Some(0.3)));
    assert_eq!(Scene::from_toml(&robot.scene.to_toml()).unwrap(), robot.scene);
    let forearm = robot.scene.frames.iter().find(|frame| frame.name == "forearm").unwrap();
    assert_eq!(forearm.visuals[0].shape, Shape::Box { size: [0.2, 0.04, 0.06] });
    let told = ARM.replace("<geom density", "<geom friction=\"1\" colour=\"red\" density");
    let notes = import(&told, &Options::default()).unwrap().report.to_string();
    assert!(notes.contains("attribute `colour` of `geom` is none of the format: left out"));
    let options =
        Options { gravity: Some([0.0; 3]), time_step_s: Some(0.01), ..Options::default() };
    let scene = import(ARM, &options).unwrap().scene;
    assert_eq!((scene.gravity, scene.time_step_s), (Some([0.0; 3]), 0.01));
}

/// A model around a body on a hinge about y, of inertia 2 kg·m², and a second one on a slide of 3 kg.
fn with(inner: &str) -> String {
    format!(
        r#"<mujoco><compiler angle="radian"/><option gravity="0 0 0"/><worldbody>
  <body name="wheel"><joint name="hinge" axis="0 1 0" ref="0.1"/>
    <inertial pos="0 0 0" mass="1" diaginertia="2 2 2"/><site name="rim" pos="0 0 1"/></body>
  <body name="sled" pos="0 3 0"><joint name="slide" type="slide" axis="1 0 0"/>
    <inertial pos="0 0 0" mass="3" diaginertia="1 1 1"/><site name="hook"/></body>
  <site name="post" pos="2 3 0"/>
</worldbody>{inner}</mujoco>"#
    )
}

/// Generalized forces on hinge and slide.
fn forces(inner: &str, q: [f64; 2], v: [f64; 2], u: &[f64]) -> [f64; 2] {
    let robot =
        import(&with(inner), &Options::default()).unwrap_or_else(|e| panic!("{inner}: {e}"));
    let a = accelerations(&robot.scene, &q, &v, u);
    [2.0 * a[0], 3.0 * a[1]]
}

fn close(found: [f64; 2], expected: [f64; 2], what: &str) {
    let error = found.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(error < 1e-12, "{what}: {found:?} instead of {expected:?}");
}

#[test]
fn actuators_follow_their_laws() {
    let (q, v, u) = ([0.4, -0.3], [0.7, 0.9], 1.3);
    let cases = [
        ("<motor joint='hinge' gear='5'/>", [5.0 * u, 0.0]),
        (
            "<position joint='slide' kp='20' kv='3' gear='2'/>",
            [0.0, 2.0 * (20.0 * (u - 2.0 * q[1]) - 3.0 * 2.0 * v[1])],
        ),
        ("<velocity joint='hinge' kv='4'/>", [4.0 * (u - v[0]), 0.0]),
        (
            "<general joint='slide' gainprm='7' biastype='affine' biasprm='0.5 -6 -0.2'/>",
            [0.0, 7.0 * u + 0.5 - 6.0 * q[1] - 0.2 * v[1]],
        ),
        ("<general joint='slide' gainprm='7' biasprm='0.5 -6 -0.2'/>", [0.0, 7.0 * u]),
        // I = 2 kg·m² behind a gear of 3: 2 ζ √(kp I / gear²).
        ("<position joint='hinge' kp='20' dampratio='0.5' gear='3'/>", {
            let damping = 2.0 * 0.5 * (20.0_f64 * 2.0 / 9.0).sqrt();
            [3.0 * (20.0 * (u - 3.0 * q[0]) - damping * 3.0 * v[0]), 0.0]
        }),
        ("<motor tendon='sum' gear='3'/>", [3.0 * 2.0 * u, 3.0 * -0.5 * u]),
        ("<position tendon='sum' kp='6'/>", {
            let f = 6.0 * (u - (2.0 * q[0] - 0.5 * q[1]));
            [2.0 * f, -0.5 * f]
        }),
        // Pushes the hook along the line from the post, which is at x = 2.
        ("<motor tendon='rope' gear='2'/>", [0.0, -2.0 * u]),
        ("<position tendon='rope' kp='5' kv='1'/>", {
            let length = 2.0 - q[1];
            [0.0, -(5.0 * (u - length) + v[1])]
        }),
        // The rim turns with the wheel, and its x axis with it: a force of 4 at a lever of 1, and a torque of 0.5.
        ("<motor site='rim' gear='4 0 9 0 0.5 0'/>", [4.5 * u, 0.0]),
    ];
    let tendons = "<tendon><fixed name='sum'><joint joint='hinge' coef='2'/><joint joint='slide' coef='-0.5'/></fixed>
        <spatial name='rope'><site site='hook'/><site site='post'/></spatial></tendon>";
    for (actuator, expected) in cases {
        let inner = format!("{tendons}<actuator>{actuator}</actuator>");
        close(forces(&inner, q, v, &[u]), expected, actuator);
    }
}

#[test]
fn defaults_of_actuators_hold_for_all_kinds() {
    let inner =
        "<default><motor gear='3' ctrlrange='-1 1'/><default class='strong'><general gear='8'/>
          <position kp='50'/></default></default>
        <actuator><motor name='a' joint='hinge'/><motor name='b' class='strong' joint='hinge'/>
          <position name='c' class='strong' joint='hinge' ctrllimited='false'/>
          <motor name='d' joint='hinge' forcerange='-2 6'/></actuator>";
    let scene = import(&with(inner), &Options::default()).unwrap().scene;
    let gains: Vec<_> = scene.inputs.iter().map(|input| (input.gain, input.limits)).collect();
    let unit = Some([-1.0, 1.0]);
    assert_eq!(gains, [(3.0, unit), (8.0, unit), (1.0, None), (3.0, unit)]);
    let [Force::Servo { gain, stiffness, .. }] = &scene.forces[..] else { panic!("{scene:?}") };
    assert_eq!((*gain, *stiffness), (8.0 * 50.0, 64.0 * 50.0));
    // What a class says of one kind is not forgotten where an inner one speaks of another.
    let laws = "<default><position kp='50' kv='2'/><default class='weak'><motor gear='1'/>
          </default></default>
        <actuator><position class='weak' joint='hinge'/><velocity class='weak' joint='hinge'/>
          <general class='weak' joint='hinge'/></actuator>";
    let scene = import(&with(laws), &Options::default()).unwrap().scene;
    let law = |force: &Force| match force {
        Force::Servo { gain, stiffness, damping, .. } => [*gain, *stiffness, *damping],
        other => panic!("{other:?}"),
    };
    let found: Vec<_> = scene.forces.iter().map(law).collect();
    assert_eq!(found, [[50.0, 50.0, 2.0], [1.0, 0.0, 1.0]]);
    let all = Options { inputs: Inputs::All, ..Options::default() };
    let inputs = import(&with(inner), &all).unwrap().scene.inputs;
    let inputs: Vec<_> = inputs.iter().map(|input| &*input.name).collect();
    assert_eq!(inputs, ["hinge_drive", "slide_drive"]);
}

#[test]
fn joints_and_tendons_resist() {
    let (q, v) = ([0.4, -0.3], [0.7, 0.9]);
    let joint = |attributes: &str| {
        let text = with("").replace("name=\"slide\"", &format!("name=\"slide\" {attributes}"));
        let scene = import(&text, &Options::default()).unwrap().scene;
        let a = accelerations(&scene, &q, &v, &[]);
        3.0 * a[1]
    };
    let x = q[1] - 0.2;
    let cases = [
        ("stiffness='4' springref='0.2'", -4.0 * x),
        ("stiffness='4 -2' springref='0.2'", -(4.0 * x - 2.0 * x * x)),
        ("stiffness='4 -2 3' springref='0.2'", -(4.0 * x - 2.0 * x * x + 3.0 * x.powi(3))),
        ("damping='2 0.5'", -(2.0 * v[1] + 0.5 * v[1] * v[1])),
        ("damping='2 0.5 3'", -(2.0 * v[1] + 0.5 * v[1] * v[1] + 3.0 * v[1].powi(3))),
        // I = 3: k = I / (τ ζ)², d = 2 I / τ.
        ("springdamper='0.5 2'", -(3.0 / 1.0 * q[1] + 6.0 / 0.5 * v[1])),
    ];
    for (attributes, expected) in cases {
        assert!(
            (joint(attributes) - expected).abs() < 1e-11,
            "{attributes}: {}",
            joint(attributes)
        );
    }
    let fixed = |attributes: &str| {
        format!(
            "<tendon><fixed {attributes}><joint joint='hinge' coef='2'/><joint joint='slide' coef='1'/></fixed></tendon>"
        )
    };
    let (length, rate) = (2.0 * q[0] + q[1], 2.0 * v[0] + v[1]);
    for (attributes, force) in [
        ("stiffness='3' springlength='0.1'", -3.0 * (length - 0.1)),
        // The spring is at rest where joints have their spring references, which are zero.
        ("stiffness='3'", -3.0 * length),
        ("damping='0.4'", -0.4 * rate),
    ] {
        close(forces(&fixed(attributes), q, v, &[]), [2.0 * force, force], attributes);
    }
    let rope = |attributes: &str| {
        format!(
            "<tendon><spatial {attributes}><site site='hook'/><site site='post'/></spatial></tendon>"
        )
    };
    let length = 2.0 - q[1];
    close(
        forces(&rope("stiffness='7'"), q, v, &[]),
        [0.0, 7.0 * (length - 2.0)],
        "at rest in the file",
    );
    close(
        forces(&rope("stiffness='7' springlength='1.5'"), q, v, &[]),
        [0.0, 7.0 * (length - 1.5)],
        "a given length",
    );
    let slack =
        import(&with(&rope("stiffness='7' springlength='0 1.5'")), &Options::default()).unwrap();
    assert!(matches!(&slack.scene.springs[..], [Spring::Stop { range: Some([0.0, 1.5]), .. }]));
}

/// A tackle halves the force of its second branch: `L = (2 − x) + |rim − post| / 2`.
#[test]
fn pulleys_divide() {
    let tackle = |attributes: &str| {
        format!(
            "<tendon><spatial name='t' {attributes}><site site='hook'/><site site='post'/><pulley divisor='2'/>
             <site site='beam'/><site site='rim'/></spatial></tendon>"
        )
    };
    let text = |inner: &str| {
        with(inner).replace(
            "<site name=\"post\"",
            "<site name=\"beam\" pos=\"3 0 0\"/><site name=\"post\"",
        )
    };
    // The rim turns about y by hinge − 0.1 from (0, 0, 1).
    let far = |hinge: f64| {
        let (sin, cos) = (hinge - 0.1).sin_cos();
        (3.0 - sin).hypot(cos)
    };
    let (q, v, u) = ([0.4, -0.3], [0.7, 0.9], 1.3);
    let slope = (far(q[0] + 1e-6) - far(q[0] - 1e-6)) / 2e-6;
    let (length, rate) = (2.0 - q[1] + far(q[0]) / 2.0, -v[1] + slope * v[0] / 2.0);
    let cases = [
        (tackle("stiffness='7' springlength='1.2'"), vec![], -7.0 * (length - 1.2)),
        (tackle("damping='0.8'"), vec![], -0.8 * rate),
        (tackle("") + "<actuator><motor tendon='t' gear='2'/></actuator>", vec![u], 2.0 * u),
        (
            tackle("") + "<actuator><position tendon='t' kp='5'/></actuator>",
            vec![u],
            5.0 * (u - length),
        ),
    ];
    for (inner, inputs, force) in cases {
        let scene = import(&text(&inner), &Options::default()).unwrap().scene;
        let a = accelerations(&scene, &q, &v, &inputs);
        let found = [2.0 * a[0], 3.0 * a[1]];
        let expected = [force * slope / 2.0, -force];
        let error = (found[0] - expected[0]).abs().max((found[1] - expected[1]).abs());
        assert!(error < 1e-8, "{inner}: {found:?} instead of {expected:?}");
    }
}

/// What holds by an equality: the value of the constraint there.
#[test]
fn equalities_hold() {
    let value = |inner: &str, q: [f64; 2]| -> f64 {
        let scene = import(&with(inner), &Options::default()).unwrap().scene;
        let [Constraint::Coupling { terms, constant, .. }] = &scene.constraints[..] else {
            panic!("{:?}", scene.constraints)
        };
        let term = |term: &plantd_models::scene::CouplingTerm| {
            let x = if term.coordinate == "hinge" { q[0] } else { q[1] };
            term.coefficients.iter().rev().fold(0.0, |sum, c| (sum + c) * x)
        };
        terms.iter().map(term).sum::<f64>() + constant
    };
    let joint = "<equality><joint joint1='slide' joint2='hinge' polycoef='0.2 2 -0.3 0.05 0.7'/></equality>";
    for hinge in [-0.8, 0.1, 1.2] {
        let x: f64 = hinge - 0.1;
        let slide = 0.2 + 2.0 * x - 0.3 * x * x + 0.05 * x.powi(3) + 0.7 * x.powi(4);
        assert!(value(joint, [hinge, slide]).abs() < 1e-14);
        assert!(value(joint, [hinge, slide + 0.1]).abs() > 1e-2);
    }
    let alone = "<equality><joint joint1='hinge' polycoef='0.3'/></equality>";
    assert!(value(alone, [0.4, 0.0]).abs() < 1e-15, "the reference is 0.1");
    let tendon = "<tendon><fixed name='t'><joint joint='hinge' coef='2'/><joint joint='slide' coef='1'/></fixed></tendon>
        <equality><tendon tendon1='t' polycoef='0.5'/></equality>";
    assert!(value(tendon, [0.3, 0.1]).abs() < 1e-15, "2 · 0.3 + 0.1 = 2 · 0.1 + 0.5");
    let place = |inner: &str| {
        let scene = import(&with(inner), &Options::default()).unwrap().scene;
        model(&scene);
        scene.constraints[0].clone()
    };
    let connect =
        place("<equality><connect body1='sled' body2='wheel' anchor='0 0 0.5'/></equality>");
    let Constraint::PointToPoint { a, b, .. } = connect else { panic!("{connect:?}") };
    assert_eq!((a.frame.as_str(), a.at), ("sled", [0.0, 0.0, 0.5]));
    // The wheel stands unturned where its hinge is at its reference, whatever that is.
    assert_eq!((b.frame.as_str(), b.at), ("wheel", [0.0, 3.0, 0.5]));
    let sites = place("<equality><connect site1='rim' site2='post'/></equality>");
    let Constraint::PointToPoint { a, b, .. } = sites else { panic!("{sites:?}") };
    assert_eq!((a.at, b.frame.as_str(), b.at), ([0.0, 0.0, 1.0], "world", [2.0, 3.0, 0.0]));
    let weld = import(
        &with("<equality><weld body1='wheel' body2='sled'/></equality>"),
        &Options::default(),
    );
    let weld = model(&weld.unwrap().scene);
    assert!(weld.initial_violations().is_empty(), "a weld holds what it finds");
}

#[test]
fn free_bodies_mocap_and_keyframes() {
    let text = r#"<mujoco><option gravity="0 0 -10"/><worldbody>
      <body name="target" mocap="true" pos="1 0 0" quat="0.6 0.8 0 0"><geom size="0.1"/></body>
      <body name="drone" pos="0 0 2" euler="0 0 90" gravcomp="0.25"><freejoint/>
        <geom type="box" size="0.1 0.1 0.1" mass="2"/>
        <body name="eye" pos="0 0 0.2"><joint name="gimbal" type="ball"/><geom size="0.05" mass="0.5"/></body></body>
    </worldbody><actuator><motor name="lift" site="none"/></actuator>
    <keyframe><key name="up" qpos="0 0 5 0.6 0 0 0.8 1 0 0 0" ctrl="3"/></keyframe></mujoco>"#;
    let text = text.replace(r#"site="none""#, r#"joint="gimbal" gear="0 0 2""#);
    let scene = import(&text, &Options::default()).unwrap().scene;
    let compiled = model(&scene);
    let initial = |name: &str| {
        let found = compiled.coordinates().iter().find(|c| c.name == name);
        found.unwrap_or_else(|| panic!("no {name}")).clone()
    };
    assert_eq!((initial("drone_z").initial, initial("target_x").initial), (2.0, 1.0));
    assert_eq!(initial("target_x").kind, CoordinateKind::Prescribed);
    let quarter = std::f64::consts::FRAC_PI_2;
    assert!((initial("drone_rz").initial - quarter).abs() < 1e-15);
    let key = &scene.operating_points[0];
    let spin = key.coordinates["drone_rz"];
    assert!((spin - 2.0 * 0.8_f64.atan2(0.6)).abs() < 1e-15, "2 atan2(0.8, 0.6), not {spin}");
    assert_eq!((key.coordinates["drone_z"], key.inputs["lift"]), (5.0, 3.0));
    // A quarter of the drone's weight is taken off.
    let [Force::HybridWrench { force, .. }] = &scene.forces[..] else {
        panic!("{:?}", scene.forces)
    };
    assert_eq!(force[2], Component::Constant(0.25 * 2.0 * 10.0));
    assert_eq!(scene.inputs[0].terms[0].coordinate, "gimbal_rz");
}

#[test]
fn bodies_are_replicated_bounded_and_scaled() {
    let text = r#"<mujoco><compiler angle="radian" settotalmass="8" boundmass="0.5" boundinertia="0.01"/>
      <worldbody><replicate count="2" offset="0 1 0" euler="0 0 0.5" sep="-">
        <replicate count="11" offset="1 0 0"><body name="b" pos="0.5 0 0"><joint name="j" type="slide"/>
          <geom size="0.01"/></body></replicate></replicate></worldbody></mujoco>"#;
    let scene = import(text, &Options::default()).unwrap().scene;
    assert_eq!(scene.frames.len(), 22);
    assert_eq!(scene.frames[13].name, "b02-1");
    // Within the second of two, which stands 1 along y and is turned by 0.5, the third of eleven.
    let (sin, cos) = 0.5_f64.sin_cos();
    let [x, y, _] = scene.frames[13].translation;
    assert!((x - 2.5 * cos).abs() < 1e-14 && (y - 1.0 - 2.5 * sin).abs() < 1e-14, "{x} {y}");
    let body = scene.frames[13].body.as_ref().unwrap();
    assert!((body.mass - 8.0 / 22.0).abs() < 1e-15, "each has the least mass, then all are scaled");
    assert!((body.inertia[0] - 0.01 * 8.0 / 11.0).abs() < 1e-15);
}

#[test]
fn files_are_included() {
    let main = r#"<mujoco><include file="parts/leg.xml"/></mujoco>"#;
    let leg = "<mujocoinclude>\n<worldbody><body name='leg'><joint name='hip'/>\n<geom size='x'/></body></worldbody></mujocoinclude>";
    let mut files = |name: &str| match name {
        "parts/leg.xml" => Ok(leg.into()),
        _ => Err("there is no such file".to_owned()),
    };
    let error = import_with_files(main, &Options::default(), &mut files).unwrap_err();
    assert_eq!(
        error.to_string(),
        "parts/leg.xml:3:1: `size` of `geom` is `x`; must be 1 to 3 finite numbers\n\
         parts/leg.xml:3:1: `size` of a sphere must be one number greater than 0"
    );
    let mut good = |_: &str| Ok(leg.replace('x', "0.1").into_bytes());
    let robot = import_with_files(main, &Options::default(), &mut good).unwrap();
    assert_eq!(robot.scene.frames[0].name, "leg");
    let lenient = Options { lenient: true, ..Options::default() };
    let deep = ARM.replace("<frame ", "<include file=\"a.xml\"/><frame ");
    for (text, place) in [(main, "1:9: "), (&deep, "15:7: ")] {
        let alone = import(text, &lenient).unwrap_err().to_string();
        assert!(alone.starts_with(&format!("{place}`include`")), "{alone}");
    }
}

/// The inertia behind a damping ratio is that of the other coordinates let go, `1 / (c M⁻¹ cᵀ)`.
#[test]
fn damping_ratios_take_the_inertia_of_what_moves() {
    let text = r#"<mujoco><option gravity="0 0 0"/><worldbody><body>
      <joint name="a" type="slide" axis="1 0 0"/><inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/>
      <body><joint name="b" type="slide" axis="1 0 0"/><inertial pos="0 0 0" mass="3" diaginertia="1 1 1"/></body>
    </body></worldbody><tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="b" coef="2"/></fixed></tendon>
    <actuator><position joint="a" kp="8" dampratio="0.5"/><position tendon="t" kp="8" dampratio="0.5"/></actuator></mujoco>"#;
    let scene = import(text, &Options::default()).unwrap().scene;
    // M = [5 3; 3 3], M⁻¹ = [1/2 −1/2; −1/2 5/6].
    let along = [0.5, 0.5 - 2.0 + 4.0 * 5.0 / 6.0];
    for (force, rate) in scene.forces.iter().zip(along) {
        let Force::Servo { damping, .. } = force else { panic!("{force:?}") };
        let expected = 2.0 * 0.5 * (8.0_f64 / rate).sqrt();
        assert!((damping - expected).abs() < 1e-12, "{damping} instead of {expected}");
    }
}

/// `−kv u L̇` behind a gear, and what a tendon over one joint has of its own.
#[test]
fn brakes_and_loads_of_single_joints() {
    let text = with(
        r#"<tendon><fixed name="t" armature="0.5" frictionloss="3"><joint joint="hinge" coef="-2"/></fixed></tendon>
        <actuator><damper name="brake" joint="hinge" kv="0.4" gear="3"/>
          <general name="same" joint="hinge" gaintype="affine" gainprm="0 0 -0.4" gear="3"/></actuator>"#,
    );
    let scene = import(&text, &Options::default()).unwrap().scene;
    let dampers = scene.forces.iter().filter_map(|force| match force {
        Force::LinearDamper { terms, damping, input } => Some((terms, *damping, input.as_deref())),
        _ => None,
    });
    let dampers: Vec<_> = dampers.collect();
    assert_eq!(dampers.len(), 2, "{:?}", scene.forces);
    for ((terms, damping, input), name) in dampers.into_iter().zip(["brake", "same"]) {
        assert_eq!((terms[0].coordinate.as_str(), terms[0].coefficient), ("hinge", 1.0));
        assert!((damping - 3.6).abs() < 1e-12 && input == Some(name), "{damping} {input:?}");
    }
    let friction = scene.forces.iter().find_map(|force| match force {
        Force::Friction { coordinate, force: 6.0, velocity, .. } => {
            Some((coordinate.as_deref().unwrap(), *velocity))
        }
        _ => None,
    });
    assert_eq!(friction, Some(("hinge", 0.005)));
    let bare = import(&with(""), &Options::default()).unwrap().scene;
    let armature = |scene: &plantd_models::Scene| {
        scene.coordinates.iter().find(|c| c.name == "hinge").map_or(0.0, |c| c.armature)
    };
    assert!((armature(&scene) - armature(&bare) - 2.0).abs() < 1e-12);
    let both =
        with("<actuator><general joint='hinge' gaintype='affine' gainprm='1 0 -1'/></actuator>");
    assert!(problems(&both).concat().contains("drives and brakes"));
}

fn problems(text: &str) -> Vec<String> {
    let error = import(text, &Options::default()).expect_err(text);
    error.problems.iter().map(ToString::to_string).collect()
}

#[test]
fn what_is_wrong_is_named_with_its_place() {
    let change = |from: &str, to: &str| {
        assert!(ARM.contains(from), "{from}");
        ARM.replace(from, to)
    };
    let acts = |actuator: &str| with(&format!("<actuator>{actuator}</actuator>"));
    let cases = [
        (change("eulerseq=\"zyx\"", "eulerseq=\"zyw\""), "2:3: `eulerseq`"),
        (change("angle=\"degree\"", "angle=\"grad\""), "2:3: `angle` of `compiler` is `grad`"),
        (change("timestep=\"0.004\"", "timestep=\"0\""), "3:3: `timestep`"),
        (change("class=\"rail\"><joint", "class=\"main\"><joint"), "there are two classes `main`"),
        (change("childclass=\"rail\"", "childclass=\"rails\""), "11:5: there is no class `rails`"),
        (change("axis=\"0 1 1\"", "axis=\"0 0 0\""), "13:7: `axis` of `joint` has no direction"),
        (change("range=\"-90 90\"", "range=\"90 -90\""), "`range` of `joint` is 90 to -90"),
        (
            change("fullinertia=\"0.02", "fullinertia=\"0.2"),
            "14:7: no body has the inertia of `base`",
        ),
        (change("mass=\"2\"", "mass=\"nan\""), "14:7: `mass` of `inertial` is `nan`"),
        (change("mass=\"2\"", "mass=\"1e999\""), "must be a finite number"),
        (change("size=\"0.05\"", "size=\"-0.05\""), "`size` of a sphere"),
        (change("xyaxes=\"0 1 0 -1 0 0\"", "xyaxes=\"0 1 0 0 1 0\""), "gives no direction"),
        (change("zaxis=\"1 1 1\"", "zaxis=\"1 1 1\" euler=\"0 0 1\""), "one of them is allowed"),
        (change("name=\"elbow\"", "name=\"turn\""), "there are two joints `turn`"),
        (change("name=\"forearm\"", "name=\"base\""), "there are two bodies `base`"),
        (
            change("type=\"ball\" class", "type=\"free\" class"),
            "a free joint in a body whose parent",
        ),
        (
            change("type=\"box\" size=\"0.1 0.02 0.03\"", "type=\"mesh\" mesh=\"m\""),
            "there is no mesh `m`",
        ),
        (acts("<motor joint='hing'/>"), "there is no joint `hing`"),
        (acts("<motor/>"), "acts on nothing"),
        (acts("<muscle joint='hinge'/>"), "`muscle` in `actuator`"),
        (acts("<general joint='hinge' dyntype='filter'/>"), "an actuator with a state"),
        (acts("<position joint='hinge' timeconst='0.1'/>"), "an actuator with a state"),
        (acts("<motor site='rim' refsite='post'/>"), "between two sites"),
        (acts("<position joint='hinge' kp='-3'/>"), "pushes away"),
        (with("<tendon><spatial><site site='hook'/></spatial></tendon>"), "two sites or more"),
        (
            with(
                "<tendon><fixed stiffness='1 2'><joint joint='hinge' coef='1'/><joint joint='slide' coef='1'/></fixed></tendon>",
            ),
            "`stiffness` of tendon",
        ),
        (with("<equality><weld body1='weel'/></equality>"), "there is no body `weel`"),
        (with("<equality><flex flex='f'/></equality>"), "`flex` in `equality`"),
        (with("<deformable/>"), "`deformable` in `mujoco`"),
        (with("<keyframe><key qpos='1 2 3'/></keyframe>"), "`qpos` has 3 numbers; must have 2"),
        (change("<frame ", "<composite type=\"cable\"/><frame "), "`composite` in `body`"),
        (change("</mujoco>", ""), "not XML"),
    ];
    for (text, message) in cases {
        let problems = problems(&text);
        assert!(problems.iter().any(|p| p.contains(message)), "{message}: {problems:?}");
    }
}

/// What stands on the world never moves, so nobody asks what it weighs.
#[test]
fn meshes_weigh_where_bodies_move() {
    let robot = |joint: &str| {
        format!(
            "<mujoco><compiler meshdir='parts'/><asset><mesh name='m' file='a.obj' scale='2 2 2'/></asset>
             <worldbody><body><geom type='mesh' mesh='m'/>{joint}
             <body><joint/><geom size='0.1'/></body></body></worldbody></mujoco>"
        )
    };
    assert!(import(&robot(""), &Options::default()).is_ok(), "nobody asks what does not move");
    let told = problems(&robot("<joint/>")).concat();
    assert!(told.contains("2:31: the inertia is that of the mesh file `parts/a.obj`"), "{told}");
    // A tetrahedron of a volume of 8/6, and what is asked for.
    let mut asked = Vec::new();
    let mut files = |name: &str| {
        asked.push(name.to_owned());
        Ok(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n".to_vec())
    };
    let twice = robot("<joint/><geom type='mesh' mesh='m' pos='0 0 1' mass='3'/>");
    let found = import_with_files(&twice, &Options::default(), &mut files).unwrap();
    assert_eq!(asked, ["parts/a.obj"], "each file is read once");
    let body = found.scene.frames[0].body.as_ref().unwrap();
    assert!((body.mass - (8000.0 / 6.0 + 3.0)).abs() < 1e-9, "{body:?}");
    assert!((body.center_of_mass[0] - 0.5).abs() < 1e-9, "{body:?}");
    let mut none = |_: &str| Err("no such file".to_owned());
    let refused = import_with_files(&robot("<joint/>"), &Options::default(), &mut none);
    let refused = refused.unwrap_err().to_string();
    assert!(refused.contains("mesh file `parts/a.obj`: no such file"), "{refused}");
}

/// Meshes that the model spells out, by all rules, and what is no surface.
#[test]
fn meshes_may_be_written_out() {
    let robot = |mesh: &str, geom: &str| {
        format!(
            "<mujoco><asset><mesh name='m' vertex='0 0 0 1 0 0 0 1 0 0 0 1' {mesh}/></asset>
             <worldbody><body><joint/><geom type='mesh' mesh='m' {geom}/></body></worldbody></mujoco>"
        )
    };
    let faces = "face='0 2 1 0 1 3 0 3 2 1 2 3'";
    for rule in ["", "inertia='legacy'", "inertia='exact'", "inertia='convex'"] {
        let scene =
            import(&robot(&format!("{faces} {rule}"), ""), &Options::default()).unwrap().scene;
        let mass = scene.frames[0].body.as_ref().unwrap().mass;
        assert!((mass - 1000.0 / 6.0).abs() < 1e-7, "{rule}: {mass}");
    }
    for (mesh, geom, part) in [
        ("", "", "add `face`"),
        ("face='0 1'", "", "three numbers"),
        ("face='0 1 7'", "", "point 7"),
        ("face='0 1 2'", "", "no volume"),
        ("face='0 1 2 0 1 3 0 3 2 1 2 3' inertia='exact'", "", "`exact` needs a closed surface"),
        (faces, "shellinertia='true'", "of its shell"),
        (&format!("{faces} inertia='solid'"), "", "must be one of"),
    ] {
        let told = problems(&robot(mesh, geom)).concat();
        assert!(told.contains(part), "{part}: {told}");
    }
    let fitted = robot(faces, "").replace("type='mesh'", "type='box'");
    assert!(problems(&fitted).concat().contains("fitted to a mesh"));
}

#[test]
fn what_is_refused_is_left_out_by_those_who_want_that() {
    let text = with(
        "<actuator><muscle joint='hinge'/><motor name='m' joint='hinge'/></actuator>
      <keyframe><key name='k' ctrl='1 2'/></keyframe>",
    );
    let robot = import(&text, &Options { lenient: true, ..Options::default() }).unwrap();
    robot.check().unwrap();
    assert_eq!(robot.scene.inputs.len(), 1);
    assert_eq!(robot.scene.operating_points[0].inputs["m"], 2.0, "controls keep their places");
    assert!(robot.report.notes.iter().any(|note| note.kind == Kind::Warning));
}

/// Whatever is torn off, left out or written in place of a value is an error or a scene.
#[test]
fn nothing_panics() {
    let rest = with(
        "<default><position kp='20' kv='1'/></default>
        <tendon><fixed name='t' stiffness='3' range='-1 1'><joint joint='hinge' coef='2'/></fixed>
          <spatial name='rope' springlength='0 1' stiffness='4'><site site='hook'/><site site='post'/></spatial></tendon>
        <equality><joint joint1='hinge' joint2='slide' polycoef='0 1 2'/><weld body1='sled' relpose='0 0 0 1 0 0 0'/>
          <connect body1='wheel' anchor='0 0 1'/><tendon tendon1='t' tendon2='rope'/></equality>
        <actuator><motor tendon='rope' gear='2'/><position joint='hinge' forcerange='-1 1' dampratio='1'/>
          <general site='rim' gear='1 2 3 4 5 6' ctrlrange='0 1'/></actuator>
        <keyframe><key qpos='1 2' ctrl='1 2 3'/></keyframe>",
    );
    let lenient = Options { lenient: true, ..Options::default() };
    let read = |text: &str| {
        if let Ok(robot) = import(text, &lenient) {
            let _ = robot.check();
        }
    };
    for text in [ARM, &rest] {
        read(text);
        (0..text.len())
            .filter(|end| text.is_char_boundary(*end))
            .for_each(|end| read(&text[..end]));
        let quotes: Vec<_> = text.match_indices(['"', '\'']).map(|(at, _)| at).collect();
        let long = "1 ".repeat(1000);
        let values = [
            "", "0", "-1", "1e308", "-1e308", "5e-324", "nan", "0 0 0 0", "1 1", &long, "wheel",
            "true",
        ];
        for ends in quotes.chunks_exact(2) {
            for value in values {
                read(&format!("{}{value}{}", &text[..=ends[0]], &text[ends[1]..]));
            }
        }
    }
}

/// Files that would grow end soon, with an error.
#[test]
fn nothing_grows_without_bound() {
    let nested = |depth: usize| {
        let open = "<replicate count='4000'>".repeat(depth);
        format!(
            "<mujoco><worldbody>{open}<body/>{}</worldbody></mujoco>",
            "</replicate>".repeat(depth)
        )
    };
    assert!(problems(&nested(5))[0].contains("more than 4096 bodies"));
    let sites = nested(3).replace("<body/>", "<site/>");
    assert!(problems(&sites)[0].contains("geoms, sites and copies"));
    let empty = nested(200).replace("<body/>", "");
    assert!(
        problems(&empty)[0].contains("geoms, sites and copies"),
        "what holds nothing is counted, too"
    );
    let deep = format!("<mujoco><worldbody>{}", "<body>".repeat(100_000));
    assert!(problems(&deep)[0].contains("stand in one another"));
    let entities = "<!DOCTYPE m [<!ENTITY a \"aa\"><!ENTITY b \"&a;&a;\">]><mujoco model=\"&b;\"/>";
    assert!(problems(entities)[0].contains("DTD"));
    let many =
        "<mujoco><worldbody><replicate count='1000000'><body/></replicate></worldbody></mujoco>";
    assert_eq!(problems(many), ["1:20: `count` of `replicate` is 1000000; must be 1 to 4096"]);
    let flat = format!("<mujoco><worldbody>{}</worldbody></mujoco>", "<body/>".repeat(100_000));
    assert!(problems(&flat)[0].contains("more than 4096 bodies"));
    let classes = format!("<mujoco>{}", "<default class='a'>".repeat(100_000));
    assert!(problems(&classes)[0].contains("stand in one another"));
    let numbers = "0 ".repeat(1 << 20);
    let long =
        format!("<mujoco><worldbody><body><joint axis='{numbers}'/></body></worldbody></mujoco>");
    assert!(problems(&long)[0].contains("must be 3 finite numbers"));
    for number in ["nan", "inf", "-inf", "1e999", "0x10", "1,5", "١", ""] {
        let text = format!(
            "<mujoco>\n <worldbody><body><inertial pos='0 0 0' mass='{number}'/></body></worldbody></mujoco>"
        );
        let told = problems(&text);
        assert!(told[0].starts_with("2:19: `mass` of `inertial`"), "{number}: {told:?}");
    }
    // Finite, and yet no mechanism: the scene says so.
    let huge = "<mujoco><worldbody><body><joint/><geom size='1e200'/></body></worldbody></mujoco>";
    match import(huge, &Options::default()) {
        Ok(robot) => assert!(robot.check().is_err()),
        Err(error) => assert!(error.to_string().starts_with("1:"), "{error}"),
    }
    let mut ring = |name: &str| {
        let next = if name == "a.xml" { "b.xml" } else { "a.xml" };
        Ok(format!("<mujoco>\n<include file='{next}'/></mujoco>").into_bytes())
    };
    let main = "<mujoco><include file='a.xml'/></mujoco>";
    let error = import_with_files(main, &Options::default(), &mut ring).unwrap_err().to_string();
    assert!(error.starts_with("b.xml:2:1: ") && error.contains("included twice"), "{error}");
    let mut forever =
        |name: &str| Ok(format!("<mujoco><include file='{name}x'/></mujoco>").into_bytes());
    let error = import_with_files(main, &Options::default(), &mut forever).unwrap_err().to_string();
    assert!(error.contains("more than 32 files include one another"), "{error}");
    let mut torn = |_: &str| Ok(b"<mujoco>\n  <worldbody>".to_vec());
    let error = import_with_files(main, &Options::default(), &mut torn).unwrap_err().to_string();
    assert!(error.starts_with("a.xml:1:1: not XML"), "{error}");
    let mut binary = |_: &str| Ok(vec![0xff, 0xfe]);
    let error = import_with_files(main, &Options::default(), &mut binary).unwrap_err().to_string();
    assert!(error.contains("`a.xml` cannot be read: it is no UTF-8"), "{error}");
    let mut itself = |_: &str| Ok(b"<mujoco><include file='a'/></mujoco>".to_vec());
    let main = "<mujoco><include file='a'/></mujoco>";
    let error = import_with_files(main, &Options::default(), &mut itself).unwrap_err();
    assert!(error.to_string().contains("included twice"), "{error}");
}
