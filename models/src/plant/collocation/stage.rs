//! Second derivatives at a stage.

use crate::Model;
use crate::plant::newton::Workspace;
use crate::plant::potentials;

/// Derivatives of `L` and of the forces at a stage: rows of dynamic coordinates, n columns unless said,
/// row-major.
#[derive(Clone, Debug)]
pub(crate) struct Hessian {
    /// `L_qq + f_q`.
    pub(super) qq: Vec<f64>,
    /// `L_qv + f_v`.
    pub(super) qv: Vec<f64>,
    /// `L_vq`.
    pub(super) vq: Vec<f64>,
    /// `L_vv`.
    pub(super) vv: Vec<f64>,
    /// `f_u`, ni columns.
    pub(super) qu: Vec<f64>,
}

impl Hessian {
    pub(super) fn new(model: &Model) -> Self {
        let d = model.dimensions;
        let zeros = || vec![0.0; d.dynamic * d.coordinates()];
        let qu = vec![0.0; d.dynamic * d.inputs];
        Self { qq: zeros(), qv: zeros(), vq: zeros(), vv: zeros(), qu }
    }

    /// Takes the derivatives at the last evaluation of the workspace.
    pub(super) fn take(&mut self, model: &Model, workspace: &mut Workspace) {
        let d = model.dimensions;
        let (n, nd) = (d.coordinates(), d.dynamic);
        workspace.differentiate(model);
        let is_dense = model.potentials.couple_branches || model.forces.is_some();
        if is_dense {
            for matrix in [&mut self.qq, &mut self.qv, &mut self.vq, &mut self.vv] {
                matrix.fill(0.0);
            }
        }
        let Self { qq, qv, vq, vv, qu } = self;
        for pair in &model.pairs {
            let (i, j) = (pair.row as usize, pair.column as usize);
            let second = workspace.pair(model, pair.ancestor as usize, pair.descendant as usize);
            let (ij, ji) = (i * n + j, j * n + i);
            (qq[ij], qq[ji]) = (second.qq, second.qq);
            (vv[ij], vv[ji]) = (second.vv, second.vv);
            (qv[ij], qv[ji]) = (second.q_above_v_below, second.v_above_q_below);
            (vq[ij], vq[ji]) = (second.v_above_q_below, second.q_above_v_below);
        }
        for pair in &model.mixed_pairs {
            let second = workspace.pair(model, pair.ancestor, pair.descendant);
            let ancestor = model.dynamics.joints[pair.ancestor].coordinate;
            let descendant = model.dynamics.joints[pair.descendant].coordinate;
            let is_above = ancestor < nd;
            let at = if is_above { ancestor * n + descendant } else { descendant * n + ancestor };
            let (above, below) = (second.q_above_v_below, second.v_above_q_below);
            (qq[at], vv[at]) = (second.qq, second.vv);
            (qv[at], vq[at]) = if is_above { (above, below) } else { (below, above) };
        }
        if model.potentials.any {
            let (tree, poses) = (&model.dynamics, &workspace.poses);
            let q = &workspace.q_mid;
            potentials::for_each_second_derivative(&model.potentials, tree, poses, q, |i, j, k| {
                if i < nd {
                    qq[i * n + j] -= k;
                }
            });
        }
        for (i, c) in model.damping.iter().enumerate() {
            qv[i * n + i] -= c;
        }
        qu.fill(0.0);
        for input in &model.coordinate_inputs {
            qu[input.coordinate * d.inputs + input.input] += input.gain;
        }
        if let Some(forces) = &model.forces {
            let instant = workspace.instant(model);
            forces.for_each_derivative(&instant, |i, j, by_q, by_v| {
                if i < nd {
                    qq[i * n + j] += by_q;
                    qv[i * n + j] += by_v;
                }
            });
            forces.for_each_input_derivative(&instant, |i, k, by_u| {
                if i < nd {
                    qu[i * d.inputs + k] += by_u;
                }
            });
        }
    }
}
