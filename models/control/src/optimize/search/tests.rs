//! What tests look at.

use nalgebra::DVector;

use crate::optimize::options::Method;
use crate::optimize::problem::Point;
use crate::optimize::search::{Descent, Optimizer};

impl Optimizer {
    pub(in crate::optimize) fn set_multipliers(&mut self, value: f64) {
        self.bounds.multipliers.fill(value);
        self.current.trajectory.merit = self.bounds.merit(&self.current.trajectory);
    }

    /// First and second derivative of the cost along the direction of a method; none if its model has no
    /// minimum.
    pub(in crate::optimize) fn direction(&mut self, method: Method) -> Option<(f64, f64)> {
        let go_on: &mut dyn FnMut() -> bool = &mut || true;
        self.find_gradient(go_on).unwrap();
        let Descent::Found { derivative } = self.descend(method, go_on).unwrap() else {
            return None;
        };
        self.find_projection(method, go_on).unwrap();
        let Self { problem, bounds, current, derivatives, linearizer, direction, .. } = self;
        if let Some(projection) = &mut self.projection {
            projection.find_gains(linearizer, &current.trajectory, go_on).unwrap();
        }
        let gains = self.projection.as_ref().map_or(&direction.gains, |own| &own.gains);
        let curvature = &mut direction.map_curvature;
        curvature.find_adjoint(derivatives, &linearizer.maps, gains, go_on).unwrap();
        let point = Point { problem, bounds, motion: &current.trajectory };
        let vector =
            |rows: &[f64], k: usize, n: usize| DVector::from_column_slice(&rows[k * n..][..n]);
        let mut sum = 0.0;
        for k in 0..problem.steps {
            let dx = vector(&direction.dx, k, problem.states);
            let du = vector(&direction.du, k, problem.inputs);
            let (first, z) = (&linearizer.linearizations[k], curvature.adjoint[k + 1].as_slice());
            let zero = &curvature.zero_multipliers;
            curvature.contraction.contract(&problem.model, first, z, zero).unwrap();
            curvature.second.copy_from(&curvature.contraction);
            derivatives.add_second(point, k, &mut curvature.second);
            let second = &curvature.second;
            sum += dx.dot(&(&second.xx * &dx)) + du.dot(&(&second.uu * &du));
            sum += 2.0 * dx.dot(&(&second.xu * &du));
        }
        let dx = vector(&direction.dx, problem.steps, problem.states);
        sum += dx.dot(&(derivatives.final_weight(point, Method::Newton) * &dx));
        Some((derivative, sum))
    }

    pub(in crate::optimize) fn size_of_direction(&self) -> f64 {
        self.direction.dx.iter().chain(&self.direction.du).fold(0.0, |m: f64, x| m.max(x.abs()))
    }

    /// Cost of the projection of the trajectory moved along the direction.
    pub(in crate::optimize) fn merit_at(&mut self, length: f64) -> Option<f64> {
        let runs = self.try_step(length, f64::INFINITY, &mut || true).unwrap();
        runs.then_some(self.trials.last.trajectory.merit)
    }
}
