//! Springs: potentials `V` that add `−V_q` to `L_q` and `−V_qq` to `L_qq`.
//!
//! One file each, with its formulas. A new one is such a file, a variant of [`Spring`], and a variant of
//! the scene's springs; what it leaves out does not compile, and a coordinate that it does not name as
//! coupled stops the first model that has one.

pub(crate) mod coordinate_spring;
pub(crate) mod coordinate_stop;
pub(crate) mod linear_spring;
pub(crate) mod path_spring;
pub(crate) mod point_spring;
pub(crate) mod spline_spring;

use crate::lagrangian::kinematics::{Place, Poses};
use crate::math::elimination::SymbolicElimination;
use crate::math::scalar::Scalar;
use crate::math::tree_lu::TreeLu;
use crate::model::mechanism::{Potentials, Spring};
use crate::model::tree::Tree;

/// A potential `V(q)`.
pub(crate) trait Potential {
    /// Whether it reads poses: then planar models have to evaluate them.
    const NEEDS_POSES: bool;

    /// The coordinates that it couples with each other; a coordinate may come more than once.
    fn couples(&self) -> Vec<usize>;

    /// `V`, J.
    fn energy<S: Scalar>(&self, at: Place<'_, S>) -> S;

    /// Adds `−V_q` to `l_q` (dynamic coordinates).
    fn add_gradient<S: Scalar>(&self, at: Place<'_, S>, l_q: &mut [S]);

    /// Calls `entry(i, j, V_ij)` for ordered pairs of coordinates, dynamic and prescribed; a pair may
    /// come more than once, and its values add.
    fn for_each_second_derivative<S: Scalar>(
        &self,
        at: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    );

    /// Whether it may couple coordinates that are not on one path to the root, or prescribed ones.
    fn couples_branches(&self) -> bool {
        Self::NEEDS_POSES || self.couples().len() > 1
    }
}

impl Spring {
    /// Whether it may couple coordinates that are not on one path to the root, or prescribed ones.
    pub(crate) fn couples_branches(&self) -> bool {
        match self {
            Self::Coordinate(spring) => spring.couples_branches(),
            Self::Point(spring) => spring.couples_branches(),
            Self::Spline(spring) => spring.couples_branches(),
            Self::Path(spring) => spring.couples_branches(),
            Self::Linear(spring) => spring.couples_branches(),
            Self::Stop(stop) => stop.couples_branches(),
        }
    }

    /// The coordinates that it couples with each other.
    pub(crate) fn couples(&self) -> Vec<usize> {
        match self {
            Self::Coordinate(spring) => spring.couples(),
            Self::Point(spring) => spring.couples(),
            Self::Spline(spring) => spring.couples(),
            Self::Path(spring) => spring.couples(),
            Self::Linear(spring) => spring.couples(),
            Self::Stop(stop) => stop.couples(),
        }
    }

    fn energy<S: Scalar>(&self, at: Place<'_, S>) -> S {
        match self {
            Self::Coordinate(spring) => spring.energy(at),
            Self::Point(spring) => spring.energy(at),
            Self::Spline(spring) => spring.energy(at),
            Self::Path(spring) => spring.energy(at),
            Self::Linear(spring) => spring.energy(at),
            Self::Stop(stop) => stop.energy(at),
        }
    }

    #[inline(always)]
    fn add_gradient<S: Scalar>(&self, at: Place<'_, S>, l_q: &mut [S]) {
        match self {
            Self::Coordinate(spring) => spring.add_gradient(at, l_q),
            Self::Point(spring) => spring.add_gradient(at, l_q),
            Self::Spline(spring) => spring.add_gradient(at, l_q),
            Self::Path(spring) => spring.add_gradient(at, l_q),
            Self::Linear(spring) => spring.add_gradient(at, l_q),
            Self::Stop(stop) => stop.add_gradient(at, l_q),
        }
    }

    #[inline(always)]
    fn for_each_second_derivative<S: Scalar>(
        &self,
        at: Place<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        match self {
            Self::Coordinate(spring) => spring.for_each_second_derivative(at, entry),
            Self::Point(spring) => spring.for_each_second_derivative(at, entry),
            Self::Spline(spring) => spring.for_each_second_derivative(at, entry),
            Self::Path(spring) => spring.for_each_second_derivative(at, entry),
            Self::Linear(spring) => spring.for_each_second_derivative(at, entry),
            Self::Stop(stop) => stop.for_each_second_derivative(at, entry),
        }
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
    let at = Place { tree, poses, q };
    potentials.springs.iter().for_each(|spring| spring.add_gradient(at, l_q));
}

/// Potential energy of all springs, J.
pub(crate) fn potential<S: Scalar>(
    potentials: &Potentials,
    tree: &Tree,
    poses: &Poses<S>,
    q: &[S],
) -> S {
    let at = Place { tree, poses, q };
    potentials.springs.iter().fold(S::ZERO, |sum, spring| sum + spring.energy(at))
}

/// Calls `entry(i, j, V_ij)` for ordered pairs of coordinates of each spring, as
/// [`Potential::for_each_second_derivative`] does.
pub(crate) fn for_each_second_derivative<S: Scalar>(
    potentials: &Potentials,
    tree: &Tree,
    poses: &Poses<S>,
    q: &[S],
    mut entry: impl FnMut(usize, usize, S),
) {
    let at = Place { tree, poses, q };
    for spring in &potentials.springs {
        spring.for_each_second_derivative(at, &mut entry);
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
                "format = 1\ngravity = [0.0, 0.0, 0.0]\nname = \"bead\"\n[[frames]]\nname = \"x\"\njoint = {{ type = \"prismatic\", axis = [1.0, 0.0, 0.0] }}\n[[frames]]\nname = \"y\"\nparent = \"x\"\njoint = {{ type = \"prismatic\", axis = [0.0, 1.0, 0.0] }}\nbody = {{ mass = 1.0 }}\n[[springs]]\nstiffness = 7.0\n{spring}\n"
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
