//! Volumes and inertias of shapes.
//!
//! About the centre of mass, along the shape's own axes; lengths are half lengths, as MJCF has them.

use nalgebra::Vector3;

/// A shape that is filled, or is a shell of even thickness.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Shape {
    Sphere {
        radius: f64,
    },
    /// Along z, `half` without its caps.
    Capsule {
        radius: f64,
        half: f64,
    },
    /// Along z.
    Cylinder {
        radius: f64,
        half: f64,
    },
    Ellipsoid {
        radii: Vector3<f64>,
    },
    Box {
        halves: Vector3<f64>,
    },
}

/// Thickness of the shell of an ellipsoid, m: its inertia is that of a layer.
const LAYER: f64 = 1e-6;

impl Shape {
    /// Volume, m³; of a shell its area, m².
    pub(super) fn volume(&self, is_shell: bool) -> f64 {
        use std::f64::consts::PI;
        match *self {
            Self::Sphere { radius } if is_shell => 4.0 * PI * radius.powi(2),
            Self::Sphere { radius } => 4.0 / 3.0 * PI * radius.powi(3),
            Self::Capsule { radius, half } if is_shell => {
                4.0 * PI * radius.powi(2) + 4.0 * PI * radius * half
            }
            Self::Capsule { radius, half } => {
                4.0 / 3.0 * PI * radius.powi(3) + 2.0 * PI * radius.powi(2) * half
            }
            Self::Cylinder { radius, half } if is_shell => {
                2.0 * PI * radius.powi(2) + 4.0 * PI * radius * half
            }
            Self::Cylinder { radius, half } => 2.0 * PI * radius.powi(2) * half,
            // Thomsen's approximation of the area, good to 1 %.
            Self::Ellipsoid { radii } if is_shell => {
                let power = 1.6075;
                let pairs = [radii.x * radii.y, radii.y * radii.z, radii.z * radii.x];
                let mean = pairs.iter().map(|pair| pair.powf(power)).sum::<f64>() / 3.0;
                4.0 * PI * mean.powf(power.recip())
            }
            Self::Ellipsoid { radii } => 4.0 / 3.0 * PI * radii.product(),
            Self::Box { halves: h } if is_shell => 8.0 * (h.x * h.y + h.y * h.z + h.z * h.x),
            Self::Box { halves } => 8.0 * halves.product(),
        }
    }

    /// Principal moments, kg·m².
    pub(super) fn moments(&self, mass: f64, is_shell: bool) -> Vector3<f64> {
        let round = |across: f64, along: f64| Vector3::new(across, across, along);
        match *self {
            Self::Sphere { radius } => {
                let factor = if is_shell { 2.0 / 3.0 } else { 2.0 / 5.0 };
                Vector3::repeat(factor * mass * radius.powi(2))
            }
            // A tube or rod, and two half spheres whose centres of mass lie 3/8 or 1/2 of the radius beyond its
            // ends.
            Self::Capsule { radius: r, half } => {
                let caps = Self::Sphere { radius: r };
                let caps_mass = mass * caps.volume(is_shell) / self.volume(is_shell);
                let rod = mass - caps_mass;
                let beyond = if is_shell { 0.5 } else { 3.0 / 8.0 } * r;
                let (hull, full) = (if is_shell { 1.0 } else { 0.5 }, half.powi(2) / 3.0);
                let caps_about_center = half.powi(2) + 2.0 * half * beyond;
                round(
                    rod * (hull * r * r / 2.0 + full) + caps_mass * caps_about_center,
                    rod * hull * r * r,
                ) + caps.moments(caps_mass, is_shell)
            }
            Self::Cylinder { radius: r, half } if is_shell => {
                let tube = mass * 2.0 * half / (r + 2.0 * half);
                let lids = mass - tube;
                let across =
                    tube * (r * r / 2.0 + half * half / 3.0) + lids * (r * r / 4.0 + half * half);
                round(across, tube * r * r + lids * r * r / 2.0)
            }
            Self::Cylinder { radius: r, half } => {
                round(mass * (r * r / 4.0 + half * half / 3.0), mass * r * r / 2.0)
            }
            Self::Ellipsoid { radii } if is_shell => {
                let outer = radii.add_scalar(LAYER);
                let layer = outer.product() - radii.product();
                let [inside, outside] = [radii, outer].map(|radii| {
                    let part = mass * radii.product() / layer;
                    Self::Ellipsoid { radii }.moments(part, false)
                });
                outside - inside
            }
            Self::Ellipsoid { radii } => across(&radii) * (mass / 5.0),
            Self::Box { halves } if is_shell => {
                let squares = halves.component_mul(&halves);
                let faces =
                    Vector3::new(halves.y * halves.z, halves.z * halves.x, halves.x * halves.y);
                // Of each pair of faces the second moments along the axes: the normal one is at the distance itself,
                // the others are a third of the squares of the halves.
                let mut second = Vector3::zeros();
                for normal in 0..3 {
                    for axis in 0..3 {
                        let share = if axis == normal { 1.0 } else { 1.0 / 3.0 };
                        second[axis] += mass * faces[normal] / faces.sum() * share * squares[axis];
                    }
                }
                Vector3::repeat(second.sum()) - second
            }
            Self::Box { halves } => across(&halves) * (mass / 3.0),
        }
    }
}

/// `(y² + z², z² + x², x² + y²)`
fn across(v: &Vector3<f64>) -> Vector3<f64> {
    let squares = v.component_mul(v);
    Vector3::repeat(squares.sum()) - squares
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPES: [Shape; 5] = [
        Shape::Sphere { radius: 0.3 },
        Shape::Capsule { radius: 0.2, half: 0.5 },
        Shape::Cylinder { radius: 0.3, half: 0.2 },
        Shape::Ellipsoid { radii: Vector3::new(0.3, 0.4, 0.6) },
        Shape::Box { halves: Vector3::new(0.2, 0.3, 0.45) },
    ];

    fn is_inside(shape: &Shape, p: Vector3<f64>) -> bool {
        let flat = p.xy().norm();
        match *shape {
            Shape::Sphere { radius } => p.norm() < radius,
            Shape::Capsule { radius, half } => {
                let beyond = (p.z.abs() - half).max(0.0);
                flat.hypot(beyond) < radius
            }
            Shape::Cylinder { radius, half } => flat < radius && p.z.abs() < half,
            Shape::Ellipsoid { radii } => p.component_div(&radii).norm() < 1.0,
            Shape::Box { halves } => (0..3).all(|i| p[i].abs() < halves[i]),
        }
    }

    /// Volume and moments are sums over a fine grid.
    #[test]
    fn filled_shapes_are_sums_over_points() {
        let cells = 100;
        for shape in SHAPES {
            let reach = match shape {
                Shape::Sphere { radius } => Vector3::repeat(radius),
                Shape::Capsule { radius, half } => Vector3::new(radius, radius, half + radius),
                Shape::Cylinder { radius, half } => Vector3::new(radius, radius, half),
                Shape::Ellipsoid { radii: reach } | Shape::Box { halves: reach } => reach,
            };
            let at = |i: i32| (f64::from(i) + 0.5) * 2.0 / f64::from(cells) - 1.0;
            let cell = reach.product() * (2.0 / f64::from(cells)).powi(3);
            let (mut volume, mut squares) = (0.0, Vector3::zeros());
            for x in 0..cells {
                for y in 0..cells {
                    for z in 0..cells {
                        let p = Vector3::new(at(x), at(y), at(z)).component_mul(&reach);
                        if is_inside(&shape, p) {
                            volume += cell;
                            squares += p.component_mul(&p) * cell;
                        }
                    }
                }
            }
            let moments = (Vector3::repeat(squares.sum()) - squares) * (2.0 / volume);
            assert!((volume / shape.volume(false) - 1.0).abs() < 2e-3, "{shape:?}");
            let error = (moments - shape.moments(2.0, false)).amax() / moments.amax();
            assert!(error < 2e-3, "{shape:?} {error}");
        }
    }

    /// A shell is what grows when a shape grows by a layer all around: `d(volume)`, `d(I)`.
    #[test]
    fn shells_are_layers() {
        let grown = |shape: &Shape, by: f64| match *shape {
            Shape::Sphere { radius } => Shape::Sphere { radius: radius + by },
            Shape::Capsule { radius, half } => Shape::Capsule { radius: radius + by, half },
            Shape::Cylinder { radius, half } => {
                Shape::Cylinder { radius: radius + by, half: half + by }
            }
            Shape::Ellipsoid { radii } => Shape::Ellipsoid { radii: radii.add_scalar(by) },
            Shape::Box { halves } => Shape::Box { halves: halves.add_scalar(by) },
        };
        for shape in SHAPES {
            let by = 1e-5;
            let [inner, outer] = [grown(&shape, -by), grown(&shape, by)];
            let [less, more] = [&inner, &outer].map(|shape| shape.volume(false));
            let area = (more - less) / (2.0 * by);
            let [inside, outside] = [(&inner, less), (&outer, more)]
                .map(|(shape, volume)| shape.moments(volume / (more - less), false));
            let error = (outside - inside - shape.moments(1.0, true)).amax();
            assert!(error < 1e-4, "{shape:?} {error}");
            // That of an ellipsoid is a layer of another kind, and Thomsen's area is good to 1 %.
            if !matches!(shape, Shape::Ellipsoid { .. }) {
                assert!((area / shape.volume(true) - 1.0).abs() < 1e-8, "{shape:?}");
            }
        }
    }
}
