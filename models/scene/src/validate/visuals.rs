//! What shows a frame.

use crate::limits::MAX_FILE_BYTES;
use crate::validate::Check;
use crate::visuals::Shape;
use crate::visuals::Visual;

impl Check<'_> {
    pub(super) fn visual(&mut self, path: &str, visual: &Visual) {
        self.finite_all(&format!("{path}.translation"), &visual.translation);
        if let Some(rotation) = &visual.rotation {
            self.rotation(&format!("{path}.rotation"), rotation);
        }
        for (i, &x) in visual.color.iter().flatten().enumerate() {
            if !(0.0..=1.0).contains(&x) {
                self.report(format!("{path}.color[{i}]"), format!("is {x}; must be from 0 to 1"));
            }
        }
        self.shape(&format!("{path}.shape"), &visual.shape);
    }

    fn shape(&mut self, path: &str, shape: &Shape) {
        let mut lengths = |name: &str, values: &[f64]| {
            for (i, &x) in values.iter().enumerate() {
                self.positive(format!("{path}.{name}[{i}]"), x);
            }
        };
        match shape {
            Shape::Box { size } => lengths("size", size),
            Shape::Ellipsoid { radii } => lengths("radii", radii),
            Shape::Sphere { radius } => self.positive(format!("{path}.radius"), *radius),
            Shape::Capsule { radius, length } | Shape::Cylinder { radius, length } => {
                self.positive(format!("{path}.radius"), *radius);
                self.positive(format!("{path}.length"), *length);
            }
            Shape::Mesh { file, scale } => {
                if file.is_empty() || file.len() > MAX_FILE_BYTES {
                    let message = format!("must have 1 to {MAX_FILE_BYTES} bytes");
                    self.report(format!("{path}.file"), message);
                }
                for (i, &x) in scale.iter().enumerate() {
                    self.factor(format!("{path}.scale[{i}]"), x, "mesh");
                }
            }
        }
    }
}
