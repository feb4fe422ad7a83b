//! Mass, centre and tensor of rigid bodies, and their sums.

use nalgebra::{Isometry3, Matrix3, Vector3};
use plantd_models::scene::Body;

/// A rigid body in a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Inertia {
    pub(crate) mass: f64,
    pub(crate) center: Vector3<f64>,
    /// About the centre, in the frame's axes.
    pub(crate) tensor: Matrix3<f64>,
}

/// By how much of the largest moment a triangle of moments may stay open, as in scenes.
const TOLERANCE: f64 = 1e-9;

impl Inertia {
    /// In the frame in which this one stands at `pose`: centre `R c + t`, tensor `R I Rᵀ`.
    pub(crate) fn at(&self, pose: &Isometry3<f64>) -> Self {
        let rotation = pose.rotation.to_rotation_matrix();
        let tensor = rotation * self.tensor * rotation.transpose();
        Self {
            mass: self.mass,
            center: (pose * nalgebra::Point3::from(self.center)).coords,
            tensor,
        }
    }

    /// Of bodies that move as one: `Σ m`, `Σ m c / Σ m`, `Σ I + m (d² − d dᵀ)` with `d` from the common centre.
    pub(crate) fn sum(bodies: impl Iterator<Item = Self>) -> Self {
        let bodies: Vec<Self> = bodies.collect();
        let mass: f64 = bodies.iter().map(|body| body.mass).sum();
        let moment: Vector3<f64> = bodies.iter().map(|body| body.center * body.mass).sum();
        let center = if mass > 0.0 { moment / mass } else { Vector3::zeros() };
        let tensor = bodies
            .iter()
            .map(|body| {
                let d = body.center - center;
                body.tensor
                    + (Matrix3::identity() * d.norm_squared() - d * d.transpose()) * body.mass
            })
            .sum();
        Self { mass, center, tensor }
    }

    /// Whether a body can be so: principal moments `a ≤ b ≤ c` with `a ≥ 0`, `a + b ≥ c`.
    pub(crate) fn is_possible(&self) -> bool {
        let largest = self.tensor.amax();
        if largest == 0.0 {
            return true;
        }
        let mut moments: [f64; 3] = (self.tensor / largest).symmetric_eigenvalues().into();
        moments.sort_by(f64::total_cmp);
        let [a, b, c] = moments;
        a >= -TOLERANCE && a + b >= c * (1.0 - TOLERANCE)
    }

    /// Principal moments, the smallest first, kg·m².
    pub(crate) fn moments(&self) -> [f64; 3] {
        let mut moments: [f64; 3] = self.tensor.symmetric_eigenvalues().into();
        moments.sort_by(f64::total_cmp);
        moments
    }

    /// As a scene writes it.
    pub(crate) fn body(&self, any_inertia: bool) -> Body {
        let i = &self.tensor;
        let [xx, yy, zz] = [i[(0, 0)], i[(1, 1)], i[(2, 2)]];
        let [xy, xz, yz] = [i[(0, 1)], i[(0, 2)], i[(1, 2)]];
        let inertia = if *i == Matrix3::zeros() {
            Vec::new()
        } else if [xy, xz, yz] == [0.0; 3] {
            vec![xx, yy, zz]
        } else {
            vec![xx, yy, zz, xy, xz, yz]
        };
        Body { mass: self.mass, center_of_mass: self.center.into(), inertia, any_inertia }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Translation3;

    fn box_of(mass: f64, [x, y, z]: [f64; 3], center: [f64; 3]) -> Inertia {
        let moment = |a: f64, b: f64| mass / 12.0 * (a * a + b * b);
        let tensor =
            Matrix3::from_diagonal(&Vector3::new(moment(y, z), moment(x, z), moment(x, y)));
        Inertia { mass, center: center.into(), tensor }
    }

    /// Halves of a box are the box, wherever it is seen from.
    #[test]
    fn halves_sum_up_to_the_whole() {
        let whole = box_of(6.0, [0.4, 0.2, 0.1], [0.3, -0.1, 0.5]);
        let halves = [0.2, 0.4].map(|x| box_of(3.0, [0.2, 0.2, 0.1], [x, -0.1, 0.5]));
        let rotation = nalgebra::UnitQuaternion::from_euler_angles(0.3, -0.7, 1.1);
        let pose = Isometry3::from_parts(Translation3::new(1.0, 2.0, -0.5), rotation);
        let sum = Inertia::sum(halves.iter().map(|half| half.at(&pose)));
        let whole = whole.at(&pose);
        assert!((sum.center - whole.center).amax() < 1e-15);
        assert!((sum.tensor - whole.tensor).amax() < 1e-15);
        assert_eq!(sum.mass, 6.0);
    }

    #[test]
    fn a_triangle_of_moments_must_close() {
        let body = |moments: [f64; 3]| Inertia {
            mass: 1.0,
            center: Vector3::zeros(),
            tensor: Matrix3::from_diagonal(&moments.into()),
        };
        assert!(body([1.0, 2.0, 3.0]).is_possible(), "a rod or a plate is flat");
        assert!(!body([1.0, 2.0, 3.1]).is_possible());
        assert!(!body([-1.0, 2.0, 2.0]).is_possible());
        assert!(body([0.0; 3]).is_possible());
    }
}
