//! Why a step failed, in the names of the scene.

use nalgebra::{DMatrix, SVD};

use crate::constraints::closure::Closure;
use crate::constraints::conditioning::{
    MOST_EQUATIONS, SUSPECT, VIOLATED, gram, reciprocal_condition,
};
use crate::constraints::projection::Reached;
use crate::integrator::report::StepError;
use crate::integrator::workspace::StepContext;
use crate::model::mechanism::Model;

impl Model {
    /// Names of the equations that take part in the near-singularity of `matrix`, the rows and
    /// columns of which belong to the independent equations.
    fn names_of_singular(&self, matrix: DMatrix<f64>) -> Vec<String> {
        if matrix.is_empty() || !matrix.iter().all(|x| x.is_finite()) {
            return Vec::new();
        }
        let svd = SVD::new(matrix, true, false);
        let (Some(u), Some(smallest)) =
            (svd.u, svd.singular_values.iter().copied().reduce(f64::min))
        else {
            return Vec::new();
        };
        let cut = (10.0 * smallest).max(1e-3 * SUSPECT * svd.singular_values.max());
        let mut takes_part = vec![false; self.constraint_rank()];
        for (k, _) in svd.singular_values.iter().enumerate().filter(|(_, s)| **s <= cut) {
            for (c, part) in u.column(k).iter().enumerate() {
                takes_part[c] |= part.abs() > 0.1;
            }
        }
        let independent = self.conditioning.independent.iter().zip(takes_part);
        independent.filter(|(_, is)| *is).map(|(c, _)| self.constraint_names[*c].clone()).collect()
    }

    /// The error of a singular `S`, row-major as it was factored: `names` come from its smallest
    /// singular values.
    pub(crate) fn singular_constraints(
        &self,
        schur: &[f64],
        reciprocal_condition: f64,
    ) -> StepError {
        let nc = self.dimensions.constraints;
        let (chosen, weight) = (&self.conditioning.independent, &self.conditioning.weight);
        if chosen.len() > MOST_EQUATIONS {
            return StepError::SingularConstraints {
                constraints: Vec::new(),
                reciprocal_condition,
            };
        }
        let matrix = DMatrix::from_fn(chosen.len(), chosen.len(), |i, j| {
            let (i, j) = (chosen[i], chosen[j]);
            weight[i] * schur[i * nc + j] * weight[j]
        });
        let constraints = self.names_of_singular(matrix);
        StepError::SingularConstraints { constraints, reciprocal_condition }
    }

    /// Why a step to the prescribed positions in `q_end` could not be solved, where the constraints are the reason.
    pub(crate) fn explain(
        &self,
        error: StepError,
        StepContext { settings, state, .. }: StepContext<'_>,
        q_end: &[f64],
    ) -> StepError {
        let unsolved =
            matches!(error, StepError::NotConverged { .. } | StepError::NotFinite { .. });
        if !unsolved || !(1..=MOST_EQUATIONS).contains(&self.dimensions.constraints) {
            return error;
        }
        let mut closure = Closure::new(self);
        let conditioning = &self.conditioning;
        let [regular, gram] = [&conditioning.regular, &state.q]
            .map(|q| gram(&conditioning.rows(self, &mut closure, q), &conditioning.independent));
        let regular = reciprocal_condition(&regular);
        let reciprocal_condition = reciprocal_condition(&gram);
        if reciprocal_condition < SUSPECT * regular {
            let constraints = self.names_of_singular(gram);
            return StepError::SingularConstraints { constraints, reciprocal_condition };
        }
        // Is there a configuration that satisfies the constraints at the end of the step?
        let mut q = state.q.clone();
        q[self.dimensions.dynamic..].copy_from_slice(&q_end[self.dimensions.dynamic..]);
        // Where it begins they may be violated by as much as steps leave.
        let enough = VIOLATED.max(settings.precision.residual());
        match conditioning.approach(self, &mut closure, &mut q, enough) {
            Reached::Violated => {
                let relative = |c: usize| (closure.value[c] / closure.round_off[c]).abs();
                let names = self.constraint_names.iter().enumerate();
                let constraints =
                    names.filter(|(c, _)| relative(*c) > enough).map(|(_, n)| n.clone()).collect();
                let violation = closure.value.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
                StepError::InconsistentConstraints { constraints, violation }
            }
            Reached::Satisfied | Reached::Lost => error,
        }
    }
}
