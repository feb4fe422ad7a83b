//! Second derivatives of the Lagrangian: four dot products for each ancestor and descendant, O(n·depth).
//!
//! ```text
//! leaf to root:  F_j = I^c_j J_j      P_j = J_j ×* H_j + I^c_j J̇_j      I^c: inertia of the subtree
//! i above j:     ∂²L/∂v_i∂v_j = J_i·F_j      ∂²L/∂v_i∂q_j = J_i·P_j      ∂²L/∂q_i∂v_j = J̇_i·F_j
//!                ∂²L/∂q_i∂q_j = J̇_i·P_j + w_i·(f_j × g)      w_i: angular part of J_i, f_j: force part of F_j
//! ```

use plantd_math::scalar::{Compared, Scalar, in_registers};
use plantd_math::spatial::{Force, Inertia, Mat3, Motion, Sym3, Vec3};
use plantd_math::tree_lu::TreeLu;

use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::momenta::Momenta;
use crate::model::mechanism::Pair;
use crate::model::tree::{Rotational, Tree, WORLD};

/// Generators of the second derivatives.
#[derive(Clone, Debug)]
pub(crate) struct Curvature<S = f64> {
    tensor: Vec<Sym3<S>>,
    /// `F`.
    pub(crate) force: Vec<Force<S>>,
    /// `P`.
    pub(crate) rate: Vec<Force<S>>,
}

/// Second derivatives of `L` for one pair of joints.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SecondDerivatives<S = f64> {
    pub(crate) qq: S,
    /// `∂²L/∂v_ancestor ∂q_descendant`.
    pub(crate) v_above_q_below: S,
    /// `∂²L/∂q_ancestor ∂v_descendant`.
    pub(crate) q_above_v_below: S,
    pub(crate) vv: S,
}

/// Derivatives of torque `τ` and momentum `m` of a ball joint by its own turn `ζ` and velocity `v`;
/// `m_ζ = τ_vᵀ`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Within<S = f64> {
    pub(crate) tau_z: Mat3<S>,
    pub(crate) tau_v: Mat3<S>,
    pub(crate) m_v: Mat3<S>,
}

/// Second derivatives of `L` by two coordinates, in their row and column of the matrices.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Entry<S> {
    pub(crate) qq: S,
    pub(crate) qv: S,
    pub(crate) vq: S,
    pub(crate) vv: S,
}

impl<S: Copy> SecondDerivatives<S> {
    /// What stands at (ancestor, descendant) and at (descendant, ancestor).
    #[inline(always)]
    pub(crate) fn entries(
        self,
        ancestor: usize,
        descendant: usize,
    ) -> [(usize, usize, Entry<S>); 2] {
        let Self { qq, vv, q_above_v_below: above, v_above_q_below: below } = self;
        [
            (ancestor, descendant, Entry { qq, qv: above, vq: below, vv }),
            (descendant, ancestor, Entry { qq, qv: below, vq: above, vv }),
        ]
    }
}

impl<S: Scalar> Curvature<S> {
    pub(crate) fn new(tree: &Tree) -> Self {
        let n = tree.joints.len();
        Self {
            tensor: vec![Sym3::default(); n],
            force: vec![Force::default(); n],
            rate: vec![Force::default(); n],
        }
    }

    /// Computes the generators from poses and momenta of the same configuration and velocity.
    #[inline(never)]
    pub(crate) fn evaluate(&mut self, tree: &Tree, poses: &Poses<S>, momenta: &Momenta<S>) {
        in_registers!(S, {
            let tensors = &mut self.tensor[..];
            let (forces, rates) = (&mut self.force[..], &mut self.rate[..]);
            for (i, joint) in tree.joints.iter().enumerate() {
                let rotation = &poses.rotation[i];
                let spin = match &joint.body.inertia {
                    Rotational::None => {
                        tensors[i] = Sym3::default();
                        continue;
                    }
                    Rotational::Point => Sym3::default(),
                    Rotational::Isotropic(i) => {
                        Sym3::lift(Sym3 { xx: *i, yy: *i, zz: *i, ..Sym3::default() })
                    }
                    Rotational::Full(tensor) => Sym3::lift(*tensor).rotated(rotation),
                };
                let center = poses.position[i] + rotation.apply(Vec3::lift(joint.body.center));
                tensors[i] = spin.add(&Sym3::of_point(joint.body.mass, center));
            }
            for (i, joint) in tree.joints.iter().enumerate().rev() {
                if joint.parent != WORLD {
                    tensors[joint.parent] = tensors[joint.parent].add(&tensors[i]);
                }
                let composite = Inertia {
                    mass: joint.subtree_mass,
                    moment: momenta.moment[i],
                    tensor: tensors[i],
                };
                let axis = momenta.axis[i];
                forces[i] = composite.momentum(axis);
                rates[i] = axis
                    .cross_force(momenta.momentum[i])
                    .plus(composite.momentum(momenta.axis_rate[i]));
            }
        })
    }

    /// Second derivatives of a pair of joints on one path to the root.
    #[inline(always)]
    pub(crate) fn pair(
        &self,
        momenta: &Momenta<S>,
        gravity: Option<Vec3>,
        ancestor: usize,
        descendant: usize,
    ) -> SecondDerivatives<S> {
        let (axis, axis_rate) = (momenta.axis[ancestor], momenta.axis_rate[ancestor]);
        let (force, rate) = (self.force[descendant], self.rate[descendant]);
        let weight = gravity.map_or(S::ZERO, |g| axis.w.dot(force.f.cross(Vec3::lift(g))));
        SecondDerivatives {
            qq: axis_rate.dot(rate) + weight,
            v_above_q_below: axis.dot(rate),
            q_above_v_below: axis_rate.dot(force),
            vv: self.inertia_between(momenta, ancestor, descendant),
        }
    }

    /// The entry of the mass matrix `L_vv` for a pair of joints on one path to the root.
    #[inline(always)]
    fn inertia_between(&self, momenta: &Momenta<S>, ancestor: usize, descendant: usize) -> S {
        momenta.axis[ancestor].dot(self.force[descendant])
    }

    /// Derivatives between the axes of one ball joint, the first of which is `first`. They turn with the
    /// joint: what [`Curvature::pair`] says holds for different joints only.
    #[inline(always)]
    pub(crate) fn within_ball(
        &self,
        momenta: &Momenta<S>,
        gravity: Option<Vec3>,
        first: usize,
    ) -> Within<S> {
        let axes = [first, first + 1, first + 2];
        let [mut tau_z, mut tau_v, mut m_v] = [Mat3::ZERO; 3];
        for (a, &row) in axes.iter().enumerate() {
            let (rate, slope, force) = (momenta.axis_rate[row], self.rate[row], self.force[row]);
            let weight = gravity.map_or(Vec3::ZERO, |g| force.f.cross(Vec3::lift(g)));
            for (b, &column) in axes.iter().enumerate() {
                let axis = momenta.axis[column];
                tau_z.0[b].0[a] = momenta.axis_rate[column].dot(slope) + axis.w.dot(weight);
                tau_v.0[b].0[a] = rate.dot(self.force[column]);
                m_v.0[b].0[a] = axis.dot(force);
            }
        }
        Within { tau_z, tau_v, m_v }
    }
}

impl<S: Compared> Curvature<S> {
    /// Takes the generators of others where that is said.
    #[inline(always)]
    pub(crate) fn take_where(&mut self, truth: S::Truth, others: &Self) {
        let choose = |own: &mut Force<S>, other: &Force<S>| {
            for (own, other) in [(&mut own.n, &other.n), (&mut own.f, &other.f)] {
                for (own, other) in own.0.iter_mut().zip(&other.0) {
                    *own = S::choose(truth, *other, *own);
                }
            }
        };
        self.force.iter_mut().zip(&others.force).for_each(|(own, other)| choose(own, other));
        self.rate.iter_mut().zip(&others.rate).for_each(|(own, other)| choose(own, other));
    }

    /// Writes the Jacobian of the residual by the increment, without springs and forces:
    /// `K = ¼h L_qq + ½ L_qv − ½ L_vq − L_vv/h`.
    ///
    /// Both entries of a pair come from `½h J̇ ∓ J` of the ancestor and `½P ± F/h` of the descendant.
    #[inline(never)]
    pub(crate) fn fill_newton_matrix(
        &self,
        pairs: &[Pair],
        momenta: &Momenta<S>,
        gravity: Option<Vec3>,
        step: f64,
        matrix: &mut TreeLu<S>,
    ) {
        in_registers!(S, {
            let [half, middle, inverse, same, back] =
                [0.5 * step, 0.5, 1.0 / step, 1.0, -1.0].map(S::constant);
            let (mut plus, mut minus) = (Force::default(), Force::default());
            let mut weight = Vec3::ZERO;
            for pair in pairs.iter().rev() {
                let (i, j) = (pair.ancestor as usize, pair.descendant as usize);
                if i == j {
                    // Pairs come grouped by descendant, and backwards the descendant itself comes first.
                    let (f, p) = (self.force[j], self.rate[j]);
                    plus = Force::default().add_scaled(middle, p).add_scaled(inverse, f);
                    minus = Force::default().add_scaled(middle, p).add_scaled(-inverse, f);
                    weight = gravity
                        .map_or(Vec3::ZERO, |g| f.f.cross(Vec3::lift(g)).scaled(0.25 * step));
                }
                let (axis, axis_rate) = (momenta.axis[i], momenta.axis_rate[i]);
                let gravity_term = axis.w.dot(weight);
                let scaled = Motion { w: axis_rate.w * half, v: axis_rate.v * half };
                matrix.upper[pair.slot as usize] =
                    scaled.add_scaled(back, axis).dot(plus) + gravity_term;
                matrix.lower[pair.slot as usize] =
                    scaled.add_scaled(same, axis).dot(minus) + gravity_term;
            }
        })
    }
}

impl Curvature {
    /// Writes the mass matrix `L_vv` of the dynamic coordinates.
    pub(crate) fn fill_mass_matrix(&self, pairs: &[Pair], momenta: &Momenta, matrix: &mut TreeLu) {
        for pair in pairs {
            let (ancestor, descendant) = (pair.ancestor as usize, pair.descendant as usize);
            let entry = self.inertia_between(momenta, ancestor, descendant);
            matrix.upper[pair.slot as usize] = entry;
            matrix.lower[pair.slot as usize] = entry;
        }
    }
}
