//! Inverse kinematics: targets of frames as constraints.

use plantd_scene::{Axis, Constraint, Frame, Point, Rotation, SceneError};

use crate::model::mechanism::Model;

/// Where a frame shall be, in world axes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Target {
    /// Name of the frame.
    pub frame: String,
    /// A point of it, in its axes, m.
    pub at: [f64; 3],
    /// Where that point shall be, m; anywhere if not given.
    pub position: Option<[f64; 3]>,
    /// How the frame shall be turned: unit quaternion `w, x, y, z`; in any way if not given.
    pub orientation: Option<[f64; 4]>,
}

impl Model {
    /// The same mechanism, held at targets: each is a constraint more, after those of the scene.
    ///
    /// With it a configuration at the targets is one on the constraints, near a guess
    /// ([`Initial::Projection`](crate::Initial)), or the one of least energy among all at the targets
    /// ([`Model::settle`]). Coordinates and inputs are the same in both models. Costs a compilation.
    ///
    /// ```
    /// use plantd_models::{Initial, Model, Plant, Settings, Target, builtin};
    /// use std::sync::Arc;
    ///
    /// let arm = Model::compile(&builtin::scene("double-pendulum").unwrap())?;
    /// let hand = arm.scene().frames.last().unwrap().name.clone();
    /// let position = Some([0.9, -0.4, 0.0]);
    /// let held = Arc::new(arm.held_at(&[Target { frame: hand, position, ..Target::default() }])?);
    /// # let _ = held;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    ///
    /// What is wrong with a target, at `targets[i]`: no such frame, no dynamic coordinate that moves it, a
    /// number that is not finite.
    pub fn held_at(&self, targets: &[Target]) -> Result<Self, SceneError> {
        let mut scene = self.scene.clone();
        let is_taken = |name: &String| {
            scene.frames.iter().any(|frame| frame.name.starts_with(name))
                || scene.constraints.iter().any(|known| known.name().starts_with(name))
        };
        let names = (0..).map(|i| format!("target{i}-"));
        let stem = names.into_iter().find(|name| !is_taken(name)).unwrap_or_default();
        let mut owners = Vec::new();
        for (i, target) in targets.iter().enumerate() {
            let name = format!("{stem}{i}");
            if let Some(position) = target.position {
                owners.push(i);
                scene.constraints.push(Constraint::PointToPoint {
                    name: format!("{name}-position"),
                    a: Point { frame: target.frame.clone(), at: target.at },
                    b: Point { frame: "world".to_owned(), at: position },
                    axes: vec![Axis::X, Axis::Y, Axis::Z],
                });
            }
            if let Some(orientation) = target.orientation {
                owners.push(i);
                let axes = format!("{name}-axes");
                let rotation = Some(Rotation::Quaternion(orientation));
                scene.frames.push(Frame {
                    name: axes.clone(),
                    parent: "world".to_owned(),
                    rotation,
                    ..Frame::default()
                });
                scene.constraints.push(Constraint::Orientation {
                    name: format!("{name}-orientation"),
                    a: target.frame.clone(),
                    b: axes,
                });
            }
        }
        let own = self.scene.constraints.len();
        Self::compile(&scene).map_err(|mut error| {
            for problem in &mut error.problems {
                let place = problem.path.strip_prefix("constraints[");
                let index = place.and_then(|rest| rest.split(']').next()?.parse::<usize>().ok());
                if let Some(owner) = index.and_then(|index| owners.get(index.checked_sub(own)?)) {
                    problem.path = format!("targets[{owner}]");
                } else if problem.path.starts_with("frames[") {
                    problem.path = "targets".to_owned();
                }
            }
            error
        })
    }
}
