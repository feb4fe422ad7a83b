//! Keyframes as operating points.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use plantd_models::scene::{MAX_OPERATING_POINTS, OperatingPoint};
use roxmltree::Node;

use crate::draft::as_coordinates;
use crate::mjcf::build::Build;
use crate::mjcf::settings::TINY;
use crate::mjcf::tree::JointKind;
use crate::names::Names;
use crate::report::Kind;

impl<'a> Build<'_, 'a, '_> {
    /// `controls` are the inputs of the actuators in the order of the file; none where an actuator was left out.
    pub(super) fn add_operating_points(&mut self, controls: &[Option<String>]) {
        let mut names = Names::new("operating point", &["initial"]);
        for node in Build::section(self.root, "keyframe") {
            if !node.has_tag_name("key") {
                continue;
            }
            if self.reader.model_of(node) != 0 {
                let message = "a keyframe of what is attached: it is not taken along";
                self.reader.note(Kind::NoEffect, node, message);
                continue;
            }
            if self.draft.scene.operating_points.len() == MAX_OPERATING_POINTS {
                let message = format!("more than {MAX_OPERATING_POINTS} keyframes");
                return self.reader.fail(node, message);
            }
            let name = names.add(node.attribute("name").unwrap_or("key"), &[""]);
            let mut point = OperatingPoint {
                name,
                coordinates: Default::default(),
                inputs: Default::default(),
            };
            self.configure(node, &mut point);
            if let Some(text) = node.attribute("ctrl") {
                let all = self.reader.all_numbers(node, "ctrl", text);
                if all.len() != controls.len() && !controls.is_empty() {
                    let message =
                        format!("`ctrl` has {} numbers; must have {}", all.len(), controls.len());
                    self.reader.fail(node, message);
                }
                let values = controls.iter().zip(all).filter(|(_, value)| *value != 0.0);
                point
                    .inputs
                    .extend(values.filter_map(|(name, value)| Some((name.clone()?, value))));
            }
            self.reader.exact("keyframe as an operating point");
            self.draft.scene.operating_points.push(point);
        }
        self.draft.changed.append(&mut names.changed);
    }

    fn configure(&mut self, node: Node<'a, 'a>, point: &mut OperatingPoint) {
        let Some(text) = node.attribute("qpos") else { return };
        let all = self.reader.all_numbers(node, "qpos", text);
        let size = |kind| match kind {
            JointKind::Free => 7,
            JointKind::Ball => 4,
            JointKind::Slide | JointKind::Hinge => 1,
        };
        let needed: usize = self.tree.joints.iter().map(|joint| size(joint.kind)).sum();
        if all.len() != needed {
            let message = format!("`qpos` has {} numbers; must have {needed}", all.len());
            return self.reader.fail(node, message);
        }
        let mut rest = &all[..];
        for (joint, coordinates) in self.tree.joints.iter().zip(&self.coordinates) {
            let (own, next) = rest.split_at(size(joint.kind));
            rest = next;
            let turn = |q: &[f64]| {
                let turn = UnitQuaternion::try_new(Quaternion::new(q[0], q[1], q[2], q[3]), TINY);
                turn.unwrap_or_default()
            };
            let values = match own {
                [x, y, z, turned @ ..] if joint.kind == JointKind::Free => {
                    let place = Translation3::new(*x, *y, *z);
                    as_coordinates(&Isometry3::from_parts(place, turn(turned))).to_vec()
                }
                own if joint.kind == JointKind::Ball => turn(own).scaled_axis().as_slice().to_vec(),
                own => own.to_vec(),
            };
            point.coordinates.extend(coordinates.iter().cloned().zip(values));
        }
    }
}
