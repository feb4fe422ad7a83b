//! Springs: potentials `V` that add `−V_q` to `L_q` and `−V_qq` to `L_qq`.
//!
//! ```text
//! coordinate  V = ½ k (q − rest)²       V_i = k (q − rest)         V_ii = k
//! spline      V = −∫ f dq               V_i = −f                   V_ii = −f'
//! two points  V = ½ k (|d| − rest)²     V_i = t d·d_i              V_ij = t (d_i·d_j + d·d_ij) + c (d·d_i)(d·d_j)
//! path        V = ½ k (L − rest)²       V_i = k (L − rest) L_i     V_ij = k L_i L_j + k (L − rest) L_ij
//! ```
//!
//! with `d` from point to point, `t = k (|d| − rest)/|d|`, `c = k rest/|d|³`, and `L` the sum of the
//! lengths of a path's segments. Where two points coincide, a spring with a rest length pulls nowhere;
//! its stiffness there is taken as `k` in all directions.

use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::vectors::{Distance, Separation};
use crate::math::elimination::SymbolicElimination;
use crate::math::scalar::Scalar;
use crate::math::spatial::Vec3;
use crate::math::tree_lu::TreeLu;
use crate::model::mechanism::{PathJoint, PathSpring, PointSpring, Potentials};
use crate::model::tree::Tree;

/// A two-point spring at one configuration.
struct Stretched<S> {
    at: Separation<S>,
    /// `t = V_l / l`.
    tension: S,
    /// `c`.
    bend: S,
}

/// Without rest length nothing is divided by the length, so that all derivatives hold at zero too.
fn stretched<S: Scalar>(spring: &PointSpring, tree: &Tree, poses: &Poses<S>) -> Stretched<S> {
    let at = spring.ends.separation(tree, poses);
    let square = at.difference.dot(at.difference);
    if spring.rest_length == 0.0 || square.value() == 0.0 {
        return Stretched { at, tension: S::constant(spring.stiffness), bend: S::ZERO };
    }
    let length = square.sqrt();
    let inverse = length.recip();
    let tension = (length - spring.rest_length) * inverse * spring.stiffness;
    let bend = inverse * inverse * inverse * (spring.stiffness * spring.rest_length);
    Stretched { at, tension, bend }
}

impl PathSpring {
    /// Its segments at a configuration.
    fn segments<'a, S: Scalar>(
        &'a self,
        tree: &'a Tree,
        poses: &'a Poses<S>,
    ) -> impl Iterator<Item = Distance<'a, S>> {
        self.segments.iter().map(move |ends| Distance::new(ends, tree, poses))
    }

    /// `L − rest`.
    fn stretch<S: Scalar>(&self, tree: &Tree, poses: &Poses<S>) -> S {
        let mut length = S::ZERO;
        for segment in self.segments(tree, poses) {
            length += segment.length;
        }
        length - self.rest_length
    }
}

/// Adds `−V_q` to `l_q` (dynamic coordinates).
#[inline(never)]
pub(crate) fn add_gradient<S: Scalar>(
    potentials: &Potentials,
    tree: &Tree,
    poses: &Poses<S>,
    q: &[S],
    l_q: &mut [S],
) {
    for spring in &potentials.coordinate_springs {
        l_q[spring.coordinate] -= (q[spring.coordinate] - spring.rest) * spring.stiffness;
    }
    for spring in &potentials.point_springs {
        let s = stretched(spring, tree, poses);
        let pull = s.at.difference * s.tension;
        for joint in &spring.ends.path {
            if let Some(entry) = l_q.get_mut(joint.coordinate) {
                *entry -= pull.dot(joint.gradient(tree, poses, &s.at));
            }
        }
    }
    if potentials.has_other_springs() {
        add_other_gradients(potentials, tree, poses, q, l_q);
    }
}

#[inline(never)]
fn add_other_gradients<S: Scalar>(
    potentials: &Potentials,
    tree: &Tree,
    poses: &Poses<S>,
    q: &[S],
    l_q: &mut [S],
) {
    for spring in &potentials.spline_springs {
        l_q[spring.coordinate] += spring.force.value(q[spring.coordinate]);
    }
    for spring in &potentials.path_springs {
        let tension = spring.stretch(tree, poses) * spring.stiffness;
        for segment in spring.segments(tree, poses) {
            segment.for_each_derivative(|i, slope| {
                if let Some(entry) = l_q.get_mut(i) {
                    *entry -= tension * slope;
                }
            });
        }
    }
}

/// Potential energy of all springs, J.
pub(crate) fn potential<S: Scalar>(
    potentials: &Potentials,
    tree: &Tree,
    poses: &Poses<S>,
    q: &[S],
) -> S {
    let energy = |stiffness: f64, stretch: S| stretch * stretch * (0.5 * stiffness);
    let mut sum = S::ZERO;
    for spring in &potentials.coordinate_springs {
        sum += energy(spring.stiffness, q[spring.coordinate] - spring.rest);
    }
    for spring in &potentials.spline_springs {
        sum -= spring.force.integral(q[spring.coordinate]);
    }
    for spring in &potentials.point_springs {
        let at = spring.ends.separation(tree, poses);
        let square = at.difference.dot(at.difference);
        sum += if spring.rest_length == 0.0 {
            square * (0.5 * spring.stiffness)
        } else if square.value() == 0.0 {
            energy(spring.stiffness, S::constant(spring.rest_length))
        } else {
            energy(spring.stiffness, square.sqrt() - spring.rest_length)
        };
    }
    for spring in &potentials.path_springs {
        sum += energy(spring.stiffness, spring.stretch(tree, poses));
    }
    sum
}

/// Calls `entry(i, j, V_ij)` for ordered pairs of coordinates, dynamic and prescribed, of each spring;
/// a pair may come more than once, and its values add.
pub(crate) fn for_each_second_derivative<S: Scalar>(
    potentials: &Potentials,
    tree: &Tree,
    poses: &Poses<S>,
    q: &[S],
    mut entry: impl FnMut(usize, usize, S),
) {
    for spring in &potentials.coordinate_springs {
        entry(spring.coordinate, spring.coordinate, S::constant(spring.stiffness));
    }
    for spring in &potentials.point_springs {
        let s = stretched(spring, tree, poses);
        for (k, row) in spring.ends.path.iter().enumerate() {
            let row_gradient = row.gradient(tree, poses, &s.at);
            let bend = s.bend * s.at.difference.dot(row_gradient);
            for column in &spring.ends.path[..=k] {
                let gradient = column.gradient(tree, poses, &s.at);
                let both = [(row, row_gradient), (column, gradient)];
                let (second, mirrored) = PathJoint::seconds(both, tree, poses);
                let product = gradient.dot(row_gradient);
                let along = bend * s.at.difference.dot(gradient);
                let value =
                    |second: Vec3<S>| s.tension * (product + s.at.difference.dot(second)) + along;
                entry(row.coordinate, column.coordinate, value(second));
                if row.joint != column.joint {
                    entry(column.coordinate, row.coordinate, value(mirrored));
                }
            }
        }
    }
    if potentials.has_other_springs() {
        for_each_other_second_derivative(potentials, tree, poses, q, entry);
    }
}

fn for_each_other_second_derivative<S: Scalar>(
    potentials: &Potentials,
    tree: &Tree,
    poses: &Poses<S>,
    q: &[S],
    mut entry: impl FnMut(usize, usize, S),
) {
    for spring in &potentials.spline_springs {
        let stiffness = -spring.force.slope(q[spring.coordinate]);
        entry(spring.coordinate, spring.coordinate, stiffness);
    }
    for spring in &potentials.path_springs {
        let tension = spring.stretch(tree, poses) * spring.stiffness;
        for segment in spring.segments(tree, poses) {
            segment.for_each_second_derivative(|i, j, second| entry(i, j, tension * second));
            segment.for_each_derivative(|i, row_slope| {
                for other in spring.segments(tree, poses) {
                    other.for_each_derivative(|j, slope| {
                        entry(i, j, row_slope * slope * spring.stiffness);
                    });
                }
            });
        }
    }
}

/// Adds the springs' part `−¼h V_qq` to the Newton matrix.
#[inline(never)]
pub(crate) fn add_to_newton_matrix(
    potentials: &Potentials,
    tree: &Tree,
    poses: &Poses,
    q: &[f64],
    step: f64,
    elimination: &SymbolicElimination,
    matrix: &mut TreeLu,
) {
    for_each_second_derivative(potentials, tree, poses, q, |i, j, value| {
        let dynamic = elimination.len();
        if i < dynamic && j < dynamic {
            matrix.add(elimination, i, j, -0.25 * step * value);
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lagrangian::samples;
    use crate::lagrangian::samples::Configuration;
    use crate::math::scalar::Dual;
    use crate::model::mechanism::Model;

    fn energy<S: Scalar>(model: &Model, at: &Configuration<S>) -> S {
        potential(&model.potentials, &model.dynamics, &at.poses(&model.dynamics), &at.q)
    }

    /// `V_q` of the dynamic coordinates.
    fn gradient<S: Scalar>(model: &Model, at: &Configuration<S>) -> Vec<S> {
        let mut l_q = vec![S::ZERO; model.dimensions.dynamic];
        let poses = at.poses(&model.dynamics);
        add_gradient(&model.potentials, &model.dynamics, &poses, &at.q, &mut l_q);
        l_q.into_iter().map(|x| -x).collect()
    }

    /// `V_qq`, row-major over all coordinates.
    fn hessian<S: Scalar>(model: &Model, at: &Configuration<S>) -> Vec<S> {
        let mut out = vec![S::ZERO; at.q.len() * at.q.len()];
        let poses = at.poses(&model.dynamics);
        for_each_second_derivative(
            &model.potentials,
            &model.dynamics,
            &poses,
            &at.q,
            |i, j, value| {
                out[i * at.q.len() + j] += value;
            },
        );
        out
    }

    /// Scenes of elements, and random ones.
    fn models() -> Vec<Model> {
        let random = samples::random_models(100);
        assert!(random.len() > 25, "a test of little: {} models", random.len());
        samples::models().into_iter().chain(random).collect()
    }

    #[test]
    fn derivatives_agree_with_differences_and_dual_numbers() {
        for model in models().iter().filter(|model| model.potentials.any) {
            let (name, n) = (&model.scene.name, model.dimensions.coordinates());
            for sample in 0..3 {
                let (q, direction) = samples::configuration(model, sample);
                let (slopes, curvature) = (gradient(model, &q), hessian(model, &q));
                for i in 0..model.dimensions.dynamic {
                    let unit = samples::unit(n, i);
                    let found = samples::slope(model, &q, &unit, |q| vec![energy(model, q)]);
                    samples::assert_close(&format!("{name} V_{i}"), &slopes[i..=i], &found);
                }
                for j in 0..n {
                    let found =
                        samples::slope(model, &q, &samples::unit(n, j), |q| gradient(model, q));
                    let column: Vec<f64> = (0..found.len()).map(|i| curvature[i * n + j]).collect();
                    samples::assert_close(&format!("{name} V_i{j}"), &column, &found);
                }
                let dual = samples::along(model, &q, &direction);
                let along = |values: Vec<Dual>| values.iter().map(|x| x.eps).collect::<Vec<_>>();
                let found = samples::slope(model, &q, &direction, |q| hessian(model, q));
                samples::assert_close(name, &along(hessian(model, &dual)), &found);
                let found = samples::slope(model, &q, &direction, |q| gradient(model, q));
                samples::assert_close(name, &along(gradient(model, &dual)), &found);
                let found = samples::slope(model, &q, &direction, |q| vec![energy(model, q)]);
                samples::assert_close(name, &[energy(model, &dual).eps], &found);
            }
        }
    }

    /// A two-point spring without rest length is smooth where its ends meet; with one, and along a path,
    /// everything stays finite.
    #[test]
    fn springs_without_length_are_finite() {
        let text = |spring: &str| {
            format!(
                "format = 1\nname = \"bead\"\n[[frames]]\nname = \"x\"\njoint = {{ type = \"prismatic\", axis = [1.0, 0.0, 0.0] }}\n[[frames]]\nname = \"y\"\nparent = \"x\"\njoint = {{ type = \"prismatic\", axis = [0.0, 1.0, 0.0] }}\nbody = {{ mass = 1.0 }}\n[[springs]]\nstiffness = 7.0\n{spring}\n"
            )
        };
        let two_point = "type = \"two_point\"\na = { frame = \"y\" }\nb = { frame = \"world\" }\n";
        let path = "type = \"path\"\npoints = [{ frame = \"y\" }, { frame = \"world\" }]\n";
        let ends = [two_point, &format!("{two_point}rest_length = 0.5"), path];
        for (case, spring) in ends.iter().enumerate() {
            let model =
                Model::compile(&crate::scene::Scene::from_toml(&text(spring)).unwrap()).unwrap();
            let q = vec![Dual::new(0.0, 1.0), Dual::new(0.0, -2.0)];
            let q = Configuration { q, orientations: Vec::new() };
            let all =
                [vec![energy(&model, &q)], gradient(&model, &q), hessian(&model, &q)].concat();
            assert!(all.iter().all(|x| x.re.is_finite() && x.eps.is_finite()), "{spring}: {all:?}");
            if case == 0 {
                let slopes: Vec<f64> = gradient(&model, &q).iter().map(|x| x.eps).collect();
                assert_eq!(slopes, [7.0, -14.0]);
            }
        }
    }
}
