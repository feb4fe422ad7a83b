//! Second derivatives at the stages.

use plantd_math::scalar::Side;

use crate::integrator::workspace::Workspace;
use crate::lagrangian::arrangement::Planar;
use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::mechanics::Mechanics;
use crate::model::mechanism::Model;

/// Derivatives of `L` and of the forces: rows of dynamic coordinates, n columns unless said, row-major,
/// and for each entry those of all stages.
#[derive(Clone, Debug, Default)]
pub(crate) struct Hessian {
    /// Numbers for each entry.
    width: usize,
    /// `L_qq + f_q`.
    pub(crate) qq: Vec<f64>,
    /// `L_qv + f_v`.
    pub(crate) qv: Vec<f64>,
    /// `L_vq`.
    pub(crate) vq: Vec<f64>,
    /// `L_vv`.
    pub(crate) vv: Vec<f64>,
    /// `f_u`, ni columns.
    pub(crate) qu: Vec<f64>,
}

impl Hessian {
    pub(super) fn new(model: &Model, width: usize) -> Self {
        let d = model.dimensions;
        let zeros = || vec![0.0; d.dynamic * d.coordinates() * width];
        let qu = vec![0.0; d.dynamic * d.inputs * width];
        Self { width, qq: zeros(), qv: zeros(), vq: zeros(), vv: zeros(), qu }
    }

    /// Takes the derivatives at the last gradient, of the stages from one on.
    pub(super) fn take<S: Planar + Side>(
        &mut self,
        model: &Model,
        mechanics: &mut Mechanics<S>,
        stage: usize,
    ) {
        let d = model.dimensions;
        let (n, width) = (d.coordinates(), self.width);
        mechanics.differentiate(model);
        let Self { qq, qv, vq, vv, qu, .. } = self;
        let place = |row: usize, column: usize| (row * n + column) * width + stage;
        mechanics.for_each_second_derivative(model, |row, column, entry| {
            let at = place(row, column);
            entry.qq.store(&mut qq[at..]);
            entry.qv.store(&mut qv[at..]);
            entry.vq.store(&mut vq[at..]);
            entry.vv.store(&mut vv[at..]);
        });
        for (i, c) in model.damping.iter().enumerate() {
            let entry = &mut qv[place(i, i)..];
            (S::load(entry) - *c).store(entry);
        }
        for input in &model.coordinate_inputs {
            let at = (input.coordinate * d.inputs + input.input) * width + stage;
            S::ZERO.store(&mut qu[at..]);
        }
        for input in &model.coordinate_inputs {
            let entry = &mut qu[(input.coordinate * d.inputs + input.input) * width + stage..];
            (S::load(entry) + input.gain).store(entry);
        }
    }

    /// Adds springs and armatures, of the stages from one on.
    pub(super) fn add_springs<S: Side>(
        &mut self,
        model: &Model,
        poses: &Poses<S>,
        q: &[S],
        stage: usize,
    ) {
        let d = model.dimensions;
        let (n, width) = (d.coordinates(), self.width);
        let Self { qq, vv, .. } = self;
        model.for_each_spring_derivative(poses, q, |i, j, k| {
            if i < d.dynamic {
                let entry = &mut qq[(i * n + j) * width + stage..];
                (S::load(entry) - k).store(entry);
            }
        });
        for a in model.armature.entries() {
            let entry = &mut vv[(a.row * n + a.column) * width + stage..];
            (S::load(entry) + a.inertia).store(entry);
        }
    }

    /// Adds springs and forces at the last evaluation of the workspace, of one stage.
    pub(super) fn add_forces(&mut self, model: &Model, workspace: &Workspace, stage: usize) {
        let d = model.dimensions;
        let (n, nd, width) = (d.coordinates(), d.dynamic, self.width);
        if model.potentials.any {
            self.add_springs(model, &workspace.mid.mechanics.poses, &workspace.mid.q, stage);
        }
        let Self { qq, qv, qu, .. } = self;
        if let Some(forces) = &model.forces {
            let instant = workspace.mid.instant(model);
            forces.for_each_derivative(&instant, |i, j, by_q, by_v| {
                if i < nd {
                    qq[(i * n + j) * width + stage] += by_q;
                    qv[(i * n + j) * width + stage] += by_v;
                }
            });
            forces.for_each_input_derivative(&instant, |i, k, by_u| {
                if i < nd {
                    qu[(i * d.inputs + k) * width + stage] += by_u;
                }
            });
        }
    }

    /// Forgets what [`Hessian::take`] does not replace.
    pub(super) fn clear(&mut self, model: &Model) {
        if model.potentials.couple_branches || model.forces.is_some() {
            let Self { qq, qv, vq, vv, qu, .. } = self;
            for entries in [qq, qv, vq, vv, qu] {
                entries.fill(0.0);
            }
        }
    }
}
