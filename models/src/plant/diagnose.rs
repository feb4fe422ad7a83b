//! What can be said of a plant where it is.

use nalgebra::DMatrix;

use crate::lagrangian::energy::Energy;
use crate::plant::facade::Plant;

/// What can be said of a plant at its state. Momenta are those of the velocity that belongs to the
/// projected momentum; bodies fixed to the world do not count.
#[derive(Clone, Debug, PartialEq)]
pub struct Diagnostics {
    /// Ways to move: dynamic coordinates less the rank of the constraints.
    pub degrees_of_freedom: usize,
    /// Equations of constraints that are independent at the configuration.
    pub constraint_rank: usize,
    /// Names of the equations that depend on equations before them.
    pub redundant_constraints: Vec<String>,
    /// Energy.
    pub energy: Energy,
    /// Linear momentum in world axes, N·s.
    pub linear_momentum: [f64; 3],
    /// Angular momentum about the world's origin, N·m·s.
    pub angular_momentum: [f64; 3],
    /// Centre of mass in the world, m; the origin if nothing has mass.
    pub center_of_mass: [f64; 3],
    /// Mass of all moving bodies, kg.
    pub mass_kg: f64,
    /// Multipliers of the last step as forces `λ/h`: `Dhᵀ λ/h` are the generalized forces that the
    /// constraints take away. nc.
    pub constraint_forces: Vec<f64>,
    /// Estimate of the reciprocal condition of the mass matrix, by pivots relative to the largest
    /// inertia of their coordinates; at most 1.
    pub mass_matrix_reciprocal_condition: f64,
    /// Estimate of the reciprocal condition of `Dh M⁻¹ Dhᵀ` without redundant equations; at most 1.
    pub constraint_reciprocal_condition: f64,
}

impl Plant {
    /// Diagnoses the state (allocates).
    pub fn diagnose(&mut self) -> Diagnostics {
        let model = self.model.clone();
        let d = model.dimensions;
        let mass_matrix_reciprocal_condition = self.workspace.find_velocity(&model, &self.state);
        let constraint_reciprocal_condition =
            self.workspace.kkt.schur.lu.reciprocal_condition(model.constraint_rank(), 1.0);
        let redundant_constraints = model.redundant_equations(&self.state.q);
        let constraint_rank = d.constraints - redundant_constraints.len();
        // Leaves poses and momenta at the velocity.
        let energy = self.energy();
        let (poses, momenta) =
            (&self.workspace.mid.mechanics.poses, &self.workspace.mid.mechanics.momenta);
        let totals = momenta.totals(&model.dynamics, poses);
        let h = self.settings.time_step_s;
        Diagnostics {
            degrees_of_freedom: d.dynamic.saturating_sub(constraint_rank),
            constraint_rank,
            redundant_constraints,
            energy,
            linear_momentum: totals.momentum.f.0,
            angular_momentum: totals.momentum.n.0,
            center_of_mass: totals.center().0,
            mass_kg: totals.mass,
            constraint_forces: self.state.multipliers.iter().map(|lambda| lambda / h).collect(),
            mass_matrix_reciprocal_condition,
            constraint_reciprocal_condition,
        }
    }

    /// The Newton matrix `M[k+1] = D2D1 Ld(q0, q1) + D2F⁻` of the dynamic coordinates for a step from
    /// `q0` to `q1`, nd + nk each, without input forces (allocates). For ball joints it is the one that
    /// the solver uses, which leaves out terms of the order of their turn.
    ///
    /// # Panics
    ///
    /// If a configuration has another length.
    pub fn newton_matrix(&mut self, q0: &[f64], q1: &[f64]) -> DMatrix<f64> {
        let model = self.model.clone();
        let (n, nd) = (model.dimensions.coordinates(), model.dimensions.dynamic);
        assert!(q0.len() == n && q1.len() == n, "configurations have {n} entries");
        self.evaluate_between(q0, q1, &vec![0.0; self.model.dimensions.inputs]);
        let workspace = &mut self.workspace;
        workspace.fill_newton_matrix(&model, &self.settings);
        let elimination = &model.elimination;
        let mut matrix = DMatrix::zeros(nd, nd);
        for row in 0..nd {
            for (slot, ancestor) in elimination.entries_of(row) {
                matrix[(row, ancestor)] = workspace.kkt.factored.tree.lower[slot];
                // The diagonal is kept in the upper triangle alone.
                matrix[(ancestor, row)] = workspace.kkt.factored.tree.upper[slot];
            }
        }
        matrix
    }
}
