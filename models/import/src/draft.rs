//! A scene in the making.

use std::collections::BTreeMap;

use nalgebra::Isometry3;
use plantd_models::Scene;
use plantd_models::scene::{Coordinate, Force, Frame, Spring};
use roxmltree::Node;

use crate::document::Reader;
use crate::names::{self, Names};
use crate::report::{Kind, Name};

/// Endings of the coordinates of a free joint.
pub(crate) const FREE: [&str; 6] = ["_x", "_y", "_z", "_rx", "_ry", "_rz"];
/// Endings of the coordinates of a ball joint.
pub(crate) const BALL: [&str; 3] = ["_rx", "_ry", "_rz"];

/// A pose as the six coordinates of a free joint: position and rotation vector.
pub(crate) fn as_coordinates(pose: &Isometry3<f64>) -> [f64; 6] {
    let [x, y, z] = pose.translation.vector.into();
    let [rx, ry, rz] = pose.rotation.scaled_axis().into();
    [x, y, z, rx, ry, rz]
}

/// A scene that grows, with names that are free.
pub(crate) struct Draft {
    pub(crate) scene: Scene,
    pub(crate) frames: Names,
    pub(crate) coordinates: Names,
    /// Names of other kinds that are spelled otherwise.
    pub(crate) changed: Vec<Name>,
    /// Settings of coordinates by name, in the order in which they come up.
    settings: BTreeMap<String, usize>,
    /// What stops joints at their limits.
    stops: Option<[f64; 2]>,
}

impl Draft {
    pub(crate) fn new(
        format: &str,
        gravity: [f64; 3],
        time_step_s: f64,
        stops: Option<[f64; 2]>,
    ) -> Self {
        let scene = Scene {
            format: 1,
            description: format!("Imported from {format}."),
            time_step_s,
            gravity: Some(gravity),
            ..Scene::default()
        };
        let (frames, coordinates) =
            (Names::new("frame", &["world"]), Names::new("coordinate", &[]));
        Self { scene, frames, coordinates, changed: Vec::new(), settings: BTreeMap::new(), stops }
    }

    /// Adds a frame of a name that is free.
    pub(crate) fn frame(&mut self, name: &str, frame: Frame) -> String {
        let name = self.frames.add(name, &[""]);
        self.scene.frames.push(Frame { name: name.clone(), ..frame });
        name
    }

    /// The settings of a coordinate, which are there from now on.
    pub(crate) fn setting(&mut self, name: &str) -> &mut Coordinate {
        let coordinates = &mut self.scene.coordinates;
        let at = *self.settings.entry(name.to_owned()).or_insert_with(|| {
            coordinates.push(Coordinate { name: name.to_owned(), ..Coordinate::default() });
            coordinates.len() - 1
        });
        &mut coordinates[at]
    }

    /// Where a coordinate begins.
    pub(crate) fn begin(&mut self, name: &str, initial: f64) {
        if initial != 0.0 {
            self.setting(name).initial = initial;
        }
    }

    pub(crate) fn damp(&mut self, reader: &mut Reader<'_>, name: &str, damping: f64) {
        if damping > 0.0 {
            *self.setting(name).damping.get_or_insert(0.0) += damping;
            reader.exact("damping of a coordinate");
        }
    }

    /// Limits of a coordinate of a joint, which clients know, and a stop there if that is wanted.
    pub(crate) fn limit(
        &mut self,
        reader: &mut Reader<'_>,
        (joint, node): (&str, Node<'_, '_>),
        name: &str,
        limits: [f64; 2],
    ) {
        self.setting(name).limits = Some(limits);
        if let Some([depth, time]) = self.stops {
            reader.exact("limits of a joint with a stop");
            return self.scene.springs.push(Spring::Stop {
                coordinate: Some(name.to_owned()),
                points: Vec::new(),
                range: None,
                stiffness: None,
                damping: None,
                transition: None,
                settling_depth: Some(depth),
                settling_time_s: Some(time),
            });
        }
        let [lower, upper] = limits;
        let message = format!(
            "joint `{joint}` moves past its limits, {lower} and {upper}: clients know them, a `stop` enforces them"
        );
        reader.note(Kind::Approximated, node, message);
    }

    /// Dry friction of a coordinate of a joint, made smooth.
    pub(crate) fn rub(
        &mut self,
        reader: &mut Reader<'_>,
        (joint, node): (&str, Node<'_, '_>),
        name: &str,
        [force, velocity]: [f64; 2],
    ) {
        let message = format!(
            "dry friction of joint `{joint}` is {force} tanh(v / {velocity}): it creeps under load"
        );
        reader.note(Kind::Approximated, node, message);
        let coordinate = Some(name.to_owned());
        let (terms, points) = (Vec::new(), Vec::new());
        let friction = Force::Friction { coordinate, terms, points, force, velocity };
        self.scene.forces.push(friction);
    }

    /// The scene, and in the report the names that it spells otherwise.
    pub(crate) fn finish(mut self, reader: &mut Reader<'_>, name: &str) -> Scene {
        let changed = &mut reader.report.names;
        self.scene.name = names::of_scene(name, changed);
        changed.append(&mut self.frames.changed);
        changed.append(&mut self.coordinates.changed);
        changed.append(&mut self.changed);
        self.scene
    }
}
