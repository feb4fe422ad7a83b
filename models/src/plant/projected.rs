//! The projected momentum: what the constraints leave of the momentum.
//!
//! The momentum of a state is the paper's. With constraints it is accurate to first order alone, because it
//! holds a part along `Dhᵀ` that depends on the step. What the velocity has is accurate to second order:
//!
//! ```text
//! L_v(q, q̇) + Dh_dᵀ μ = p        Dh q̇ = 0        p̃ = p − Dh_dᵀ μ = L_v(q, q̇)
//! ```
//!
//! and with `H = Σ μ D²h`, its derivative along `(q', p', v')` follows from
//!
//! ```text
//! [ M   Dh_dᵀ ] [q̇_d']   [ p' − (L_vq + H) q' − L_vv,k v' ]
//! [ Dh_d   0  ] [ μ' ] = [ −D²h(q', q̇) − Dh_k v'          ]        p̃' = p' − H q' − Dh_dᵀ μ'
//! ```

use nalgebra::{DMatrix, DVector};

use crate::lagrangian::derivatives::Derivatives;
use crate::lagrangian::kinematics::Place;
use crate::plant::facade::Plant;

/// Eigenvalues of `Dh M⁻¹ Dhᵀ` below this, relative to the largest, belong to redundant equations.
const REDUNDANT: f64 = 1e-11;

impl Plant {
    /// Takes `x = (q, p, v)` as it is, whether it satisfies the constraints or not: for what is evaluated at
    /// states that nobody moves to. [`Plant::initialize`] takes states to go on from.
    ///
    /// # Panics
    ///
    /// If `x` is not 2 nd + 2 nk long.
    pub fn place(&mut self, x: &[f64]) {
        let (q, rest) = x.split_at(self.state.q.len());
        let (p, v) = rest.split_at(self.state.p.len());
        self.place_configuration(q);
        self.state.p.copy_from_slice(p);
        self.state.p_low.fill(0.0);
        self.state.v.copy_from_slice(v);
    }

    /// The derivative of `(q, p̃, v)` by `x = (q, p, v)`, square of `2 nd + 2 nk`: what weights on the
    /// projected momentum are pulled back with (allocates). Costs O(n³).
    pub fn projection_by_state(&mut self) -> DMatrix<f64> {
        let d = self.model.dimensions;
        let mut by_state = DMatrix::identity(d.state(), d.state());
        let momentum = self.projected_momentum_by_state();
        by_state.rows_range_mut(d.momentum()).copy_from(&momentum);
        by_state
    }

    /// The projected momentum `p̃`, nd (allocates). Without constraints it is the momentum.
    pub fn projected_momentum(&mut self) -> Vec<f64> {
        let velocity = self.velocity();
        self.workspace.gradient_at(&self.model, &self.state, &velocity);
        self.workspace.mid.l_v.clone()
    }

    /// The derivative of the projected momentum by `x = (q, p, v)`, nd by `2 nd + 2 nk`: for energies and
    /// costs (allocates). With redundant constraints `μ` has the least norm. Costs O(n³).
    pub fn projected_momentum_by_state(&mut self) -> DMatrix<f64> {
        let velocity = self.velocity();
        let model = self.model.clone();
        let d = model.dimensions;
        let (nd, n, nc) = (d.dynamic, d.coordinates(), d.constraints);
        self.workspace.gradient_at(&model, &self.state, &velocity);
        let excess = DVector::from_iterator(
            nd,
            self.state.p.iter().zip(&self.workspace.mid.l_v).map(|(p, m)| p - m),
        );
        let mut blocks = Derivatives::<f64>::new(&model);
        let orientations = &self.workspace.balls.start;
        blocks.evaluate(&model, (&self.state.q, orientations), &velocity, &vec![0.0; d.inputs]);
        let mut by_state = DMatrix::zeros(nd, 2 * n);
        by_state.view_mut((0, n), (nd, nd)).fill_with_identity();
        if nc == 0 {
            return by_state;
        }
        let dh = self.constraint_jacobian();
        let mass = DMatrix::from_fn(nd, nd, |i, j| blocks.l_vv[i * n + j]);
        let Some(mass) = mass.cholesky() else { return by_state };
        let dh_d = dh.columns(0, nd).into_owned();
        let response = mass.solve(&dh_d.transpose());
        let schur = &dh_d * &response;
        // Eigenvalues of what is not finite are never found.
        if !schur.iter().all(|entry| entry.is_finite()) {
            return by_state;
        }
        let schur = schur.symmetric_eigen();
        let smallest = REDUNDANT * schur.eigenvalues.amax();
        let inverse = schur.eigenvalues.map(|x| if x > smallest { 1.0 / x } else { 0.0 });
        let solve = |right: DMatrix<f64>| {
            let mut along = schur.eigenvectors.tr_mul(&right);
            for (mut row, inverse) in along.row_iter_mut().zip(inverse.iter()) {
                row *= *inverse;
            }
            &schur.eigenvectors * along
        };
        // Dh_dᵀ μ is the excess.
        let mu = solve(DMatrix::from_column_slice(nc, 1, (response.tr_mul(&excess)).as_slice()));

        // Right-hand sides by q, p, v.
        let (mut hessian, mut rate) = (DMatrix::zeros(n, n), DMatrix::zeros(nc, n));
        let closure = &self.workspace.constraints.start;
        for (c, constraint) in model.constraints.iter().enumerate() {
            let at = Place { tree: &model.closure, poses: &closure.poses, q: &self.state.q };
            constraint.for_each_second_derivative(at, &mut |i, j, value| {
                hessian[(i, j)] += mu[c] * value;
                rate[(c, j)] += value * velocity[i];
            });
        }
        let bent = hessian.rows(0, nd).into_owned();
        let by_q = DMatrix::from_fn(nd, n, |i, j| blocks.l_qv[j * n + i]) + &bent;
        let mut right = by_state.clone();
        right.columns_mut(0, n).copy_from(&-by_q);
        let mut closing = DMatrix::zeros(nc, 2 * n);
        closing.columns_mut(0, n).copy_from(&-rate);
        for k in nd..n {
            for i in 0..nd {
                right[(i, n + k)] = -blocks.l_vv[i * n + k];
            }
            closing.column_mut(n + k).copy_from(&-dh.column(k));
        }
        let change = solve(response.tr_mul(&right) - closing);
        by_state.columns_mut(0, n).copy_from(&-bent);
        by_state - dh_d.tr_mul(&change)
    }
}
