//! First and second derivatives of the cost with penalties, along a motion.

use nalgebra::{DMatrix, DVector};
use plantd_math::rotation;
use plantd_math::scalar::Dual;
use plantd_math::spatial::{Vec3, three};
use plantd_models::Contraction;

use crate::lq::stage::Stage;
use crate::matrix::symmetrize;
use crate::optimize::chart::{chart, turn_gradient, turn_rows, turn_weight};
use crate::optimize::error::OptimizeError;
use crate::optimize::options::Method;
use crate::optimize::problem::{Deviation, Point, Problem};
use crate::optimize::question::{Question, ask_at};
use crate::weights::Weights;

/// Second derivatives of one step.
#[derive(Clone, Debug)]
pub(super) struct SecondDerivatives {
    pub(super) xx: DMatrix<f64>,
    pub(super) xu: DMatrix<f64>,
    pub(super) uu: DMatrix<f64>,
}

impl SecondDerivatives {
    pub(super) fn zeros(states: usize, inputs: usize) -> Self {
        Self {
            xx: DMatrix::zeros(states, states),
            xu: DMatrix::zeros(states, inputs),
            uu: DMatrix::zeros(inputs, inputs),
        }
    }

    fn identity(states: usize, inputs: usize) -> Self {
        let (xx, uu) = (DMatrix::identity(states, states), DMatrix::identity(inputs, inputs));
        Self { xx, uu, ..Self::zeros(states, inputs) }
    }

    /// Copies, not swaps: what is always zero in a contraction is never written again.
    pub(super) fn copy_from(&mut self, contraction: &Contraction) {
        self.xx.copy_from(&contraction.xx);
        self.xu.copy_from(&contraction.xu);
        self.uu.copy_from(&contraction.uu);
    }

    /// Copies the weights of step `k`.
    fn copy_weights(&mut self, problem: &Problem, k: usize) {
        let stage = problem.stage(k);
        self.xx.copy_from(stage.q());
        self.uu.copy_from(stage.r());
        match stage.s() {
            Some(cross) => self.xu.copy_from(cross),
            None => self.xu.fill(0.0),
        }
    }
}

/// The derivatives of the cost with penalties along the motion where the gradient was found last.
#[derive(Debug)]
pub(super) struct CostDerivatives {
    /// Gradient.
    pub(super) by_x: Vec<DVector<f64>>,
    pub(super) by_u: Vec<DVector<f64>>,
    /// `∂(p̃ − p)/∂x` of each step; none where the state's own momentum is weighed.
    projections: Vec<DMatrix<f64>>,
    deviation: Deviation,
    /// Of the step at hand, or of the end.
    pub(super) second: SecondDerivatives,
    identity: SecondDerivatives,
}

impl CostDerivatives {
    pub(super) fn new(problem: &Problem) -> Self {
        let (states, inputs, steps) = (problem.states, problem.inputs, problem.steps);
        let count = if problem.projects() { steps + 1 } else { 0 };
        Self {
            by_x: vec![DVector::zeros(states); steps + 1],
            by_u: vec![DVector::zeros(inputs); steps],
            projections: vec![DMatrix::zeros(0, 0); count],
            deviation: problem.deviation(),
            second: SecondDerivatives::zeros(states, inputs),
            identity: SecondDerivatives::identity(states, inputs),
        }
    }

    /// Finds the gradient.
    pub(super) fn find_gradient(
        &mut self,
        point: Point<'_>,
        go_on: Question<'_>,
    ) -> Result<(), OptimizeError> {
        let Point { problem, motion, .. } = point;
        for k in 0..=problem.steps {
            ask_at(k, go_on)?;
            problem.evaluate(k, motion.x(k), motion.u(k), &mut self.deviation);
            self.find_gradient_at(point, k);
        }
        if let Some((change, weight)) = problem.initial_change(motion.x(0)) {
            let mut slope = weight * &change;
            turn_gradient(problem.model.orientations(), change.as_slice(), slope.as_mut_slice());
            self.by_x[0] += slope;
        }
        Ok(())
    }

    /// `l_x` and `l_u` at step `k`, of the deviation there.
    fn find_gradient_at(&mut self, Point { problem, bounds, motion }: Point<'_>, k: usize) {
        let Self { by_x, by_u, projections, deviation, .. } = self;
        let (by_x, mut by_u) = (&mut by_x[k], by_u.get_mut(k));
        by_x.copy_from_slice(&deviation.by_x);
        turn_gradient(problem.model.orientations(), &deviation.x, by_x.as_mut_slice());
        if let Some(plant) = &mut deviation.projector {
            let momentum = problem.model.dimensions().momentum();
            let mut change = plant.projected_momentum_by_state();
            for (i, j) in momentum.clone().enumerate() {
                change[(i, j)] -= 1.0;
            }
            let by_p = by_x.rows_range(momentum).into_owned();
            by_x.gemv_tr(1.0, &change, &by_p, 1.0);
            projections[k] = change;
        }
        if let Some(by_u) = &mut by_u {
            by_u.copy_from_slice(&deviation.by_u);
        }
        bounds.add_gradient(k, (motion.x(k), motion.u(k)), by_x, by_u);
    }

    /// The linear-quadratic model of a step without second derivatives of the map; of the weights
    /// themselves where nothing is to be added.
    pub(super) fn stage<'a>(&'a mut self, point: Point<'a>, k: usize, method: Method) -> Stage<'a> {
        let Point { problem, bounds, motion } = point;
        let (x, u) = (motion.x(k), motion.u(k));
        let is_steepest = method == Method::Steepest;
        let is_plain = bounds.is_empty() && (!problem.is_curved() || is_steepest);
        if !is_plain {
            if is_steepest {
                self.second.xx.copy_from(&self.identity.xx);
                self.second.uu.copy_from(&self.identity.uu);
            } else {
                self.second.copy_weights(problem, k);
                if problem.is_curved() {
                    problem.evaluate(k, x, u, &mut self.deviation);
                    self.pull_back(problem, k);
                }
            }
            let SecondDerivatives { xx, uu, .. } = &mut self.second;
            bounds.add_curvature(k, (x, u), xx, Some(uu));
        }
        let SecondDerivatives { xx, xu, uu } = &self.second;
        let weights = problem.stage(k).stage();
        let quadratic = match (is_plain, is_steepest) {
            (true, false) => weights,
            (true, true) => {
                Stage { q: &self.identity.xx, r: &self.identity.uu, s: None, ..weights }
            }
            (false, _) => {
                let s = weights.s.filter(|_| !is_steepest).map(|_| xu);
                Stage { q: xx, r: uu, s, ..weights }
            }
        };
        Stage { x_linear: Some(&self.by_x[k]), u_linear: Some(&self.by_u[k]), ..quadratic }
    }

    /// The linear-quadratic model of a step, with the second derivatives of the map in `second`.
    pub(super) fn newton_stage<'a>(
        &'a mut self,
        point: Point<'_>,
        k: usize,
        second: &'a mut SecondDerivatives,
    ) -> Stage<'a> {
        self.add_second(point, k, second);
        let SecondDerivatives { xx, xu, uu } = second;
        let (x_linear, u_linear) = (Some(&self.by_x[k]), Some(&self.by_u[k]));
        Stage { q: xx, r: uu, s: Some(xu), x_linear, u_linear }
    }

    /// Adds the second derivatives of the cost of a step to those of the map.
    pub(super) fn add_second(
        &mut self,
        Point { problem, bounds, motion }: Point<'_>,
        k: usize,
        second: &mut SecondDerivatives,
    ) {
        let (stage, x, u) = (problem.stage(k), motion.x(k), motion.u(k));
        if !problem.is_curved() {
            second.xx += stage.q();
            if let Some(s) = stage.s() {
                second.xu += s;
            }
        } else {
            self.second.copy_weights(problem, k);
            problem.evaluate(k, x, u, &mut self.deviation);
            self.pull_back(problem, k);
            self.add_chart_curvature(problem);
            second.xx += &self.second.xx;
            second.xu += &self.second.xu;
        }
        second.uu += stage.r();
        bounds.add_curvature(k, (x, u), &mut second.xx, Some(&mut second.uu));
    }

    /// Second derivatives of the final cost.
    pub(super) fn final_weight(
        &mut self,
        Point { problem, bounds, motion }: Point<'_>,
        method: Method,
    ) -> &DMatrix<f64> {
        let (steps, x) = (problem.steps, motion.x(problem.steps));
        if method == Method::Steepest {
            self.second.xx.copy_from(&self.identity.xx);
        } else {
            self.second.xx.copy_from(problem.q_final());
            if problem.is_curved() {
                problem.evaluate(steps, x, &[], &mut self.deviation);
                self.second.xu.fill(0.0);
                self.pull_back(problem, steps);
                if method == Method::Newton {
                    self.add_chart_curvature(problem);
                }
            }
        }
        bounds.add_curvature(steps, (x, &[]), &mut self.second.xx, None);
        &self.second.xx
    }

    /// Turns weights of step `k` into second derivatives by the tangent space at `x`, where deviation and
    /// gradient were evaluated; without the curvature of what is weighed.
    fn pull_back(&mut self, problem: &Problem, k: usize) {
        let SecondDerivatives { xx: q, xu: s, .. } = &mut self.second;
        turn_weight(problem.model.orientations(), &self.deviation.x, q);
        turn_rows(problem.model.orientations(), &self.deviation.x, s);
        let Some(change) = self.projections.get(k) else { return };
        let momentum = problem.model.dimensions().momentum();
        let columns = q.columns_range(momentum.clone()).into_owned();
        q.gemm(1.0, &columns, change, 1.0);
        let change = change.transpose();
        for matrix in [&mut *q, s] {
            let rows = matrix.rows_range(momentum.clone()).into_owned();
            matrix.gemm(1.0, &change, &rows, 1.0);
        }
        symmetrize(q);
    }

    /// Adds the curvature of the rotation vectors themselves, which the gradient weighs.
    fn add_chart_curvature(&mut self, problem: &Problem) {
        let (Deviation { x, by_x, .. }, q) = (&self.deviation, &mut self.second.xx);
        for &i in problem.model.orientations() {
            let (e, gradient) = (three(x, i), three(by_x, i));
            let map = chart(x, i);
            let mut second = [[0.0; 3]; 3];
            for (a, second) in second.iter_mut().enumerate() {
                let along = map.0[a];
                let moved = Vec3([0, 1, 2].map(|k| Dual::new(e[k], along[k])));
                let change = rotation::momentum_at_start(moved);
                for (b, second) in second.iter_mut().enumerate() {
                    *second = (0..3).map(|k| gradient[k] * change.0[b][k].eps).sum();
                }
            }
            for a in 0..3 {
                for b in 0..3 {
                    q[(i + a, i + b)] += 0.5 * (second[a][b] + second[b][a]);
                }
            }
        }
    }

    /// Whether a method takes second derivatives for those of the cost that are these weights, everywhere.
    pub(super) fn has_weights(&self, point: Point<'_>, method: Method, weights: &Weights) -> bool {
        let Point { problem, bounds, .. } = point;
        match method {
            Method::Steepest => {
                let SecondDerivatives { xx, uu, .. } = &self.identity;
                let stage = weights.stage();
                bounds.is_empty()
                    && (stage.q(), stage.r(), stage.s()) == (xx, uu, None)
                    && weights.q_final() == xx
            }
            Method::QuasiNewton => {
                bounds.is_empty() && !problem.is_curved() && problem.has_weights(weights)
            }
            Method::Newton => false,
        }
    }
}
