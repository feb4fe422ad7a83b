//! Springs: potentials `V` that add `−V_q` to `L_q` and `−V_qq` to `L_qq`.
//!
//! One file each, with its formulas. A new one is such a file, a variant of [`Spring`], and a variant of
//! the scene's springs; what it leaves out does not compile, and a coordinate that it does not name as
//! coupled stops the first model that has one.

pub(crate) mod coordinate_spring;
pub(crate) mod coordinate_stop;
pub(crate) mod linear_spring;
pub(crate) mod orientation_spring;
pub(crate) mod path_spring;
pub(crate) mod point_spring;
pub(crate) mod spline_spring;

use plantd_math::scalar::Scalar;

use crate::lagrangian::kinematics::{Place, Poses};
use crate::model::mechanism::{Model, Mover, Spring};

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

    /// A bound of `|Σ V_ijk x_j x_k|` near a configuration, where `Σ |x|` is 1.
    fn third_derivative(&self, at: Place<'_, f64>) -> f64;

    /// Whether it may couple coordinates that are not on one path to the root, or prescribed ones.
    fn couples_branches(&self) -> bool {
        Self::NEEDS_POSES || self.couples().len() > 1
    }
}

/// The same expression of a spring of each kind.
macro_rules! of_each_kind {
    ($any:expr, $spring:ident => $value:expr) => {
        match $any {
            Spring::Coordinate($spring) => $value,
            Spring::Point($spring) => $value,
            Spring::Spline($spring) => $value,
            Spring::Path($spring) => $value,
            Spring::Linear($spring) => $value,
            Spring::Stop($spring) => $value,
            Spring::Orientation($spring) => $value,
        }
    };
}

impl Spring {
    /// Whether it may couple coordinates that are not on one path to the root, or prescribed ones.
    pub(crate) fn couples_branches(&self) -> bool {
        of_each_kind!(self, spring => spring.couples_branches())
    }

    /// The coordinates that it couples with each other.
    pub(crate) fn couples(&self) -> Vec<usize> {
        of_each_kind!(self, spring => spring.couples())
    }

    /// [`Potential::for_each_second_derivative`].
    pub(crate) fn for_each_second_derivative<S: Scalar>(
        &self,
        at: Place<'_, S>,
        mut entry: impl FnMut(usize, usize, S),
    ) {
        of_each_kind!(self, spring => spring.for_each_second_derivative(at, &mut entry));
    }
}

impl Model {
    /// Adds `−V_q` of all springs to `l_q` (dynamic coordinates).
    #[inline(never)]
    pub(crate) fn add_spring_gradient<S: Scalar>(&self, poses: &Poses<S>, q: &[S], l_q: &mut [S]) {
        let at = Place { tree: &self.dynamics, poses, q };
        for spring in &self.potentials.springs {
            of_each_kind!(spring, spring => spring.add_gradient(at, l_q));
        }
    }

    /// Potential energy of all springs, J.
    pub(crate) fn spring_energy<S: Scalar>(&self, poses: &Poses<S>, q: &[S]) -> S {
        let at = Place { tree: &self.dynamics, poses, q };
        let energy = |spring: &Spring| of_each_kind!(spring, spring => spring.energy(at));
        self.potentials.springs.iter().fold(S::ZERO, |sum, spring| sum + energy(spring))
    }

    /// The sum of [`Potential::third_derivative`] over all springs.
    pub(crate) fn third_spring_derivative(&self, at: Place<'_, f64>) -> f64 {
        let bound = |spring: &Spring| of_each_kind!(spring, spring => spring.third_derivative(at));
        self.potentials.springs.iter().map(bound).sum()
    }

    /// Calls `entry(i, V_ii)` for the springs of single coordinates, and those across one joint that is no ball joint.
    pub(crate) fn for_each_own_spring_derivative<S: Scalar>(
        &self,
        poses: &Poses<S>,
        q: &[S],
        mut entry: impl FnMut(usize, S),
    ) {
        let at = Place { tree: &self.dynamics, poses, q };
        let mut take = |i: usize, _: usize, value: S| entry(i, value);
        for spring in &self.potentials.springs {
            match spring {
                Spring::Point(_) | Spring::Path(_) => {
                    if let Some(Mover::Axis(_)) = spring.mover() {
                        spring.for_each_second_derivative(at, &mut take);
                    }
                }
                Spring::Orientation(_) => {}
                Spring::Coordinate(own) => own.for_each_second_derivative(at, &mut take),
                Spring::Spline(own) => own.for_each_second_derivative(at, &mut take),
                Spring::Linear(own) if own.terms.len() == 1 => {
                    own.for_each_second_derivative(at, &mut take);
                }
                Spring::Linear(_) => {}
                Spring::Stop(own) => own.for_each_second_derivative(at, &mut take),
            }
        }
    }

    /// [`Potential::for_each_second_derivative`] of each spring.
    pub(crate) fn for_each_spring_derivative<S: Scalar>(
        &self,
        poses: &Poses<S>,
        q: &[S],
        mut entry: impl FnMut(usize, usize, S),
    ) {
        let at = Place { tree: &self.dynamics, poses, q };
        for spring in &self.potentials.springs {
            spring.for_each_second_derivative(at, &mut entry);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lagrangian::samples;
    use crate::lagrangian::samples::Configuration;
    use plantd_math::scalar::Dual;

    fn energy<S: Scalar>(model: &Model, at: &Configuration<S>) -> S {
        model.spring_energy(&at.poses(&model.dynamics), &at.q)
    }

    /// `V_q` of the dynamic coordinates.
    fn gradient<S: Scalar>(model: &Model, at: &Configuration<S>) -> Vec<S> {
        let mut l_q = vec![S::ZERO; model.dimensions.dynamic];
        model.add_spring_gradient(&at.poses(&model.dynamics), &at.q, &mut l_q);
        l_q.into_iter().map(|x| -x).collect()
    }

    /// `V_qq`, row-major over all coordinates.
    fn hessian<S: Scalar>(model: &Model, at: &Configuration<S>) -> Vec<S> {
        let n = at.q.len();
        let mut out = vec![S::ZERO; n * n];
        let poses = at.poses(&model.dynamics);
        model.for_each_spring_derivative(&poses, &at.q, |i, j, value| out[i * n + j] += value);
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

    /// Third derivatives along directions, by dual numbers, are within their bounds, and these are no more than some
    /// hundred times as large.
    #[test]
    fn third_derivatives_are_bounded() {
        let (mut count, mut ratios) = (0, 0.0);
        for model in models().iter().filter(|model| model.potentials.any) {
            let n = model.dimensions.coordinates();
            for sample in 0..5 {
                let (q, direction) = samples::configuration(model, sample);
                let extent: f64 = direction.iter().map(|x| x.abs()).sum();
                let along: Vec<f64> = direction.iter().map(|x| x / extent).collect();
                let slopes = hessian(model, &samples::along(model, &q, &along));
                let turns = slopes.chunks(n).map(|row| {
                    row.iter().zip(&along).map(|(slope, x)| slope.eps * x).sum::<f64>().abs()
                });
                let most = turns.fold(0.0, f64::max);
                let poses = q.poses(&model.dynamics);
                let at = Place { tree: &model.dynamics, poses: &poses, q: &q.q };
                let bound = model.third_spring_derivative(at);
                assert!(most <= bound * (1.0 + 1e-9), "{}: {most} {bound}", model.scene.name);
                if most > 1e-6 && bound.is_finite() {
                    (count, ratios) = (count + 1, ratios + (bound / most).ln());
                }
            }
        }
        let mean = (ratios / f64::from(count)).exp();
        assert!(count > 100 && mean < 1000.0, "{count} {mean}");
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
                Model::compile(&plantd_scene::Scene::from_toml(&text(spring)).unwrap()).unwrap();
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
