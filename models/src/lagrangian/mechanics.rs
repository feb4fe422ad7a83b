//! The Lagrangian of joint trees at a configuration and velocity, without springs: in the plane where the
//! scene allows it, else in space.

use plantd_math::scalar::{LanesOf, Scalar, Truths};
use plantd_math::spatial::Mat3;
use plantd_math::tree_lu::TreeLu;

use crate::lagrangian::arrangement::Planar;
use crate::lagrangian::curvature::{Curvature, Entry, SecondDerivatives};
use crate::lagrangian::instant::Instant;
use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::momenta::Momenta;
use crate::lagrangian::planar::{PlanarTree, Slopes};
use crate::model::mechanism::Model;
use crate::model::tree::JointKind;

/// What its derivatives are found from.
#[derive(Clone, Debug)]
pub(crate) struct Mechanics<S: Planar = f64> {
    /// In place of all others, where the scene is planar.
    pub(crate) planar: Option<Box<PlanarTree<S>>>,
    pub(crate) poses: Poses<S>,
    pub(crate) momenta: Momenta<S>,
    pub(crate) curvature: Curvature<S>,
}

/// Second derivatives that are put aside, of plants side by side.
#[derive(Clone, Debug)]
pub(crate) struct Kept<S: Scalar> {
    curvature: Curvature<S>,
    slopes: Vec<Slopes<S>>,
}

impl<S: Planar> Kept<S> {
    pub(crate) fn new(model: &Model) -> Self {
        let planar = model.planar.as_ref().map_or(0, |joints| joints.len());
        let slopes = vec![Slopes::default(); planar];
        Self { curvature: Curvature::new(&model.dynamics, model.gravity), slopes }
    }
}

impl<const N: usize> Mechanics<LanesOf<N>> {
    /// Puts the second derivatives aside.
    pub(crate) fn put_aside(&mut self, kept: &mut Kept<LanesOf<N>>) {
        match &mut self.planar {
            Some(tree) => tree.put_aside(&mut kept.slopes),
            None => std::mem::swap(&mut self.curvature, &mut kept.curvature),
        }
    }

    /// Takes those that were put aside for the lanes that are said.
    #[inline(always)]
    pub(crate) fn take_where(&mut self, lanes: Truths<N>, kept: &Kept<LanesOf<N>>) {
        match &mut self.planar {
            Some(tree) => tree.take_where(lanes, &kept.slopes),
            None => self.curvature.take_where(lanes, &kept.curvature),
        }
    }
}

impl<S: Planar> Mechanics<S> {
    pub(crate) fn new(model: &Model) -> Self {
        Self {
            planar: model.planar.as_ref().map(|joints| Box::new(PlanarTree::new(joints))),
            poses: Poses::new(&model.dynamics),
            momenta: Momenta::new(&model.dynamics),
            curvature: Curvature::new(&model.dynamics, model.gravity),
        }
    }

    /// Writes `L_q` and `L_v` of the dynamic coordinates.
    #[inline(always)]
    pub(crate) fn gradient(
        &mut self,
        model: &Model,
        q: &[S],
        orientations: &[Mat3<S>],
        velocity: &[S],
        [l_q, l_v]: [&mut [S]; 2],
    ) {
        if let (Some(planar), Some(joints)) = (&mut self.planar, &model.planar) {
            planar.gradient(joints, q, velocity, l_q, l_v);
        } else {
            let (tree, gravity) = (&model.dynamics, model.gravity);
            self.poses.evaluate(tree, q, orientations);
            self.momenta.gradient(tree, &self.poses, velocity, gravity, l_q, l_v);
        }
    }

    /// Prepares second derivatives at the last gradient, for [`Mechanics::pair`].
    pub(crate) fn differentiate(&mut self, model: &Model) {
        match (&mut self.planar, &model.planar) {
            (Some(planar), Some(joints)) => planar.differentiate(joints),
            _ => self.curvature.evaluate(&model.dynamics, &self.poses, &self.momenta),
        }
    }

    /// Prepares second derivatives in space, where those of the scene are in a plane. `l_q` and `l_v` are room.
    pub(crate) fn differentiate_in_space(
        &mut self,
        model: &Model,
        [q, velocity]: [&[S]; 2],
        orientations: &[Mat3<S>],
        [l_q, l_v]: [&mut [S]; 2],
    ) {
        let (tree, gravity) = (&model.dynamics, model.gravity);
        self.poses.evaluate(tree, q, orientations);
        self.momenta.gradient(tree, &self.poses, velocity, gravity, l_q, l_v);
        self.curvature.evaluate(tree, &self.poses, &self.momenta);
    }

    /// Writes the Jacobian of the residual by the increment at the last gradient, without springs and forces,
    /// entry by entry.
    pub(crate) fn fill_newton_matrix(&mut self, model: &Model, step: f64, matrix: &mut TreeLu<S>) {
        self.differentiate(model);
        if let (Some(planar), Some(joints)) = (&self.planar, &model.planar) {
            planar.fill_newton_matrix(joints, &model.pairs, step, matrix);
        } else {
            self.curvature.fill_newton_matrix(&model.pairs, step, matrix);
        }
    }

    /// What forces depend on, at the last gradient.
    pub(crate) fn instant<'a>(
        &'a self,
        model: &'a Model,
        q: &'a [S],
        velocity: &'a [S],
        inputs: &'a [S],
    ) -> Instant<'a, S> {
        let (poses, momenta) = (&self.poses, &self.momenta);
        Instant { tree: &model.dynamics, poses, momenta, q, velocity, inputs }
    }

    /// Second derivatives for a pair of joints on one path to the root.
    #[inline(always)]
    pub(crate) fn pair(
        &self,
        model: &Model,
        ancestor: usize,
        descendant: usize,
    ) -> SecondDerivatives<S> {
        match (&self.planar, &model.planar) {
            (Some(planar), Some(joints)) => planar.pair(joints, ancestor, descendant),
            _ => self.curvature.pair(ancestor, descendant),
        }
    }

    /// Second derivatives in the rows of the dynamic coordinates, at the last [`Mechanics::differentiate`]:
    /// row, column, and what stands there. Entries that it does not name are zero; those on the diagonal
    /// and between the axes of a ball joint come twice or more, and the last one counts.
    #[inline(always)]
    pub(crate) fn for_each_second_derivative(
        &self,
        model: &Model,
        mut take: impl FnMut(usize, usize, Entry<S>),
    ) {
        for pair in &model.pairs {
            let second = self.pair(model, pair.ancestor as usize, pair.descendant as usize);
            for (row, column, entry) in second.entries(pair.row as usize, pair.column as usize) {
                take(row, column, entry);
            }
        }
        let coordinate = |joint: usize| model.dynamics.joints[joint].coordinate;
        for pair in &model.mixed_pairs {
            let second = self.pair(model, pair.ancestor, pair.descendant);
            let entries = second.entries(coordinate(pair.ancestor), coordinate(pair.descendant));
            let is_below = entries[0].0 >= model.dimensions.dynamic;
            let (row, column, entry) = entries[usize::from(is_below)];
            take(row, column, entry);
        }
        // The axes of a ball joint turn with it.
        let joints = &model.dynamics.joints[..];
        let joints = if model.orientations.is_empty() { &[] } else { joints };
        for (first, joint) in joints.iter().enumerate() {
            if joint.kind != JointKind::Ball(0) || joint.coordinate >= model.dimensions.dynamic {
                continue;
            }
            let within = self.curvature.within_ball(first);
            let i = joint.coordinate;
            for (a, b) in (0..9).map(|entry| (entry / 3, entry % 3)) {
                let (qq, vv) = (within.tau_z.0[b][a], within.m_v.0[b][a]);
                let (qv, vq) = (within.tau_v.0[b][a], within.tau_v.0[a][b]);
                take(i + a, i + b, Entry { qq, qv, vq, vv });
            }
        }
    }
}
