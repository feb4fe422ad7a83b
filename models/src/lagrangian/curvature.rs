//! Second derivatives of the Lagrangian: four dot products for each ancestor and descendant, O(n·depth).
//!
//! ```text
//! leaf to root:  F_j = I^c_j J_j      P_j = J_j ×* H_j + I^c_j J̇_j      I^c: inertia of the subtree
//! i above j:     ∂²L/∂v_i∂v_j = J_i·F_j      ∂²L/∂v_i∂q_j = J_i·P_j      ∂²L/∂q_i∂v_j = J̇_i·F_j
//!                ∂²L/∂q_i∂q_j = J̇_i·P_j + w_i·(f_j × g)      w_i: angular part of J_i, f_j: force part of F_j
//! ```
//!
//! With `e1`, `e2` and gravity `g = |g| e3` along three right-handed axes these are products of eight numbers:
//!
//! ```text
//! axis = [J  0  0]      rate  = [J̇  w·e1  w·e2]
//! force = [F  0  0]     slope = [P  |g| f·e2  −|g| f·e1]
//! ```

use plantd_math::scalar::{Beside, Compared, LanesOf, Scalar, Truths, Wide};
use plantd_math::spatial::{Inertia, Mat3, Sym3, Vec3};
use plantd_math::tree_lu::TreeLu;

use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::momenta::Momenta;
use crate::lagrangian::sums::{Sums, firsts, firsts_of_links};
use crate::model::mechanism::Pair;
use crate::model::tree::{Rotational, Tree};

/// What the second derivatives are products of, a row for each joint.
#[derive(Clone, Debug)]
pub(crate) struct Curvature<S: Scalar = f64> {
    vertical: Vertical,
    /// Inertia of the subtrees about the origin.
    tensors: Sums<S>,
    pub(crate) axis: Vec<S::Row>,
    pub(crate) rate: Vec<S::Row>,
    pub(crate) force: Vec<S::Row>,
    pub(crate) slope: Vec<S::Row>,
    /// `½h rate ∓ axis`, for the Newton matrix.
    flanks: Vec<[S::Row; 2]>,
}

/// Where gravity points.
#[derive(Clone, Copy, Debug)]
struct Vertical {
    /// `e1` and `e2`.
    horizontal: [Vec3; 2],
    /// `|g|`.
    gravity: f64,
}

impl Vertical {
    fn new(gravity: Option<Vec3>) -> Self {
        let size = gravity.map_or(0.0, Vec3::norm);
        let [e1, e2, _] = match gravity {
            Some(g) => Mat3::with_z_along(g * (1.0 / size)).0,
            None => Mat3::ZERO.0,
        };
        Self { horizontal: [e1, e2], gravity: size }
    }
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

/// What [`Curvature::evaluate`] does.
struct Evaluate<'a, S: Scalar> {
    curvature: &'a mut Curvature<S>,
    tree: &'a Tree,
    poses: &'a Poses<S>,
    momenta: &'a Momenta<S>,
}

impl<S: Scalar> Beside<S> for Evaluate<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run<W: Wide<S>>(self) {
        let Self { curvature, tree, poses, momenta } = self;
        if tree.has_balls {
            curvature.generate::<W, true>(tree, poses, momenta);
        } else {
            curvature.generate::<W, false>(tree, poses, momenta);
        }
    }
}

/// Puts numbers into the rows of joints, which follow each other where there are no ball joints.
#[inline(always)]
fn put_rows<S: Scalar, W: Wide<S>, const BALLS: bool>(
    rows: &mut [S::Row],
    joints: &[usize],
    numbers: [W; 8],
) {
    if BALLS {
        W::spread_to(numbers, rows, joints);
    } else {
        W::spread(numbers, &mut rows[joints[0]..joints[0] + W::COUNT]);
    }
}

#[inline(always)]
fn row<W: Copy>(Vec3([a, b, c]): Vec3<W>, Vec3([d, e, f]): Vec3<W>, [g, h]: [W; 2]) -> [W; 8] {
    [a, b, c, d, e, f, g, h]
}

impl<S: Scalar> Curvature<S> {
    pub(crate) fn new(tree: &Tree, gravity: Option<Vec3>) -> Self {
        let n = tree.joints.len();
        let rows = || vec![S::Row::default(); n.next_multiple_of(S::BESIDE)];
        Self {
            vertical: Vertical::new(gravity),
            tensors: Sums::new(&tree.slots),
            axis: rows(),
            rate: rows(),
            force: rows(),
            slope: rows(),
            flanks: vec![Default::default(); n],
        }
    }

    /// Computes the generators from poses and momenta of the same configuration and velocity.
    #[inline(never)]
    pub(crate) fn evaluate(&mut self, tree: &Tree, poses: &Poses<S>, momenta: &Momenta<S>) {
        S::beside(tree.joints.len(), Evaluate { curvature: self, tree, poses, momenta });
    }

    /// `BALLS`: some joint is a ball joint.
    #[inline(always)]
    fn generate<W: Wide<S>, const BALLS: bool>(
        &mut self,
        tree: &Tree,
        poses: &Poses<S>,
        momenta: &Momenta<S>,
    ) {
        let slots = &tree.slots;
        for i in firsts_of_links::<S, W>(tree) {
            self.place::<W, BALLS>(tree, poses, momenta, i);
        }
        self.tensors.ascend::<W, false>(&slots.parents);
        for i in firsts::<S, W>(tree) {
            let (axis, rate) = (momenta.axis.wide::<S, W>(i), momenta.axis_rate.wide::<S, W>(i));
            let [xx, yy, zz, xy, xz, yz, ..] = self.tensors.take_from::<W, BALLS>(i, &slots.links);
            let composite = Inertia {
                mass: tree.fixed::<S, W>(i).subtree_mass,
                moment: momenta.moment.wide::<S, W>(i),
                tensor: Sym3 { xx, yy, zz, xy, xz, yz },
            };
            let force = composite.momentum(axis);
            let turned = axis.cross_force(momenta.momentum.wide::<S, W>(i));
            let slope = turned.plus(composite.momentum(rate));
            let Vertical { horizontal, gravity } = self.vertical;
            let [e1, e2] = horizontal.map(Vec3::<W>::lift);
            let tilt = [axis.w.dot(e1), axis.w.dot(e2)];
            let weight = [force.f.dot(e2) * gravity, -force.f.dot(e1) * gravity];
            let joints = &slots.joints[i..i + W::COUNT];
            let axis = row(axis.w, axis.v, [W::ZERO; 2]);
            let rate = row(rate.w, rate.v, tilt);
            put_rows::<S, W, BALLS>(&mut self.axis, joints, axis);
            put_rows::<S, W, BALLS>(&mut self.rate, joints, rate);
            let slope = row(slope.n, slope.f, weight);
            let force = row(force.n, force.f, [W::ZERO; 2]);
            put_rows::<S, W, BALLS>(&mut self.force, joints, force);
            put_rows::<S, W, BALLS>(&mut self.slope, joints, slope);
        }
    }

    /// Inertia about the origin of the bodies of the links that begin with `i`.
    #[inline(always)]
    fn place<W: Wide<S>, const BALLS: bool>(
        &mut self,
        tree: &Tree,
        poses: &Poses<S>,
        momenta: &Momenta<S>,
        i: usize,
    ) {
        let rotational = tree.rotational::<S>(i);
        if let Rotational::None = rotational {
            self.tensors.put(i, [W::ZERO; 8]);
            return;
        }
        let fixed = tree.fixed::<S, W>(i);
        let mut tensor = Sym3::of_point(fixed.mass, momenta.center.wide::<S, W>(i));
        match rotational {
            Rotational::None | Rotational::Point => {}
            Rotational::Isotropic(_) => tensor = fixed.inertia.add(&tensor),
            Rotational::Full(_) => {
                let rotation = poses.wide::<W, BALLS>(tree, i).rotation();
                tensor = fixed.inertia.rotated(&rotation).add(&tensor);
            }
        }
        let Sym3 { xx, yy, zz, xy, xz, yz } = tensor;
        self.tensors.put(i, [xx, yy, zz, xy, xz, yz, W::ZERO, W::ZERO]);
    }

    /// Second derivatives of a pair of joints on one path to the root.
    #[inline(always)]
    pub(crate) fn pair(&self, ancestor: usize, descendant: usize) -> SecondDerivatives<S> {
        let (axis, rate) = (&self.axis[ancestor], &self.rate[ancestor]);
        let (force, slope) = (&self.force[descendant], &self.slope[descendant]);
        SecondDerivatives {
            qq: S::dot(rate, slope),
            v_above_q_below: S::dot_of_six(axis, slope),
            q_above_v_below: S::dot_of_six(rate, force),
            vv: S::dot_of_six(axis, force),
        }
    }

    /// Derivatives between the axes of one ball joint, the first of which is `first`. They turn with the
    /// joint: what [`Curvature::pair`] says holds for different joints only.
    #[inline(always)]
    pub(crate) fn within_ball(&self, first: usize) -> Within<S> {
        let axes = [first, first + 1, first + 2];
        let [mut tau_z, mut tau_v, mut m_v] = [Mat3::ZERO; 3];
        for (a, &row) in axes.iter().enumerate() {
            for (b, &column) in axes.iter().enumerate() {
                tau_z.0[b].0[a] = S::dot(&self.rate[column], &self.slope[row]);
                tau_v.0[b].0[a] = S::dot_of_six(&self.rate[row], &self.force[column]);
                m_v.0[b].0[a] = S::dot_of_six(&self.axis[column], &self.force[row]);
            }
        }
        Within { tau_z, tau_v, m_v }
    }
}

impl<const N: usize> Curvature<LanesOf<N>> {
    /// Takes the rows of others where that is said.
    #[inline(always)]
    pub(crate) fn take_where(&mut self, truth: Truths<N>, others: &Self) {
        let Self { axis, rate, force, slope, .. } = others;
        for (own, other) in [&mut self.axis, &mut self.rate, &mut self.force, &mut self.slope]
            .into_iter()
            .zip([axis, rate, force, slope])
        {
            for (own, other) in own.as_flattened_mut().iter_mut().zip(other.as_flattened()) {
                *own = LanesOf::choose(truth, *other, *own);
            }
        }
    }
}

impl<S: Compared> Curvature<S> {
    /// Writes the Jacobian of the residual by the increment, without springs and forces:
    /// `K = ¼h L_qq + ½ L_qv − ½ L_vq − L_vv/h`.
    ///
    /// Both entries of a pair come from `½h rate ∓ axis` of the ancestor and `½ slope ± force/h` of the
    /// descendant.
    #[inline(never)]
    pub(crate) fn fill_newton_matrix(&mut self, pairs: &[Pair], step: f64, matrix: &mut TreeLu<S>) {
        S::beside(self.flanks.len(), Fill { curvature: self, pairs, step, matrix });
    }
}

/// What [`Curvature::fill_newton_matrix`] does.
struct Fill<'a, S: Scalar> {
    curvature: &'a mut Curvature<S>,
    pairs: &'a [Pair],
    step: f64,
    matrix: &'a mut TreeLu<S>,
}

impl<S: Compared> Beside<S> for Fill<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run<W: Wide<S>>(self) {
        let Self { curvature: Curvature { axis, rate, force, slope, flanks, .. }, .. } = self;
        let [half, middle, inverse, minus_one] =
            [0.5 * self.step, 0.5, 1.0 / self.step, -1.0].map(S::constant);
        for (i, [minus, plus]) in flanks.iter_mut().enumerate() {
            let (axis, rate) = (W::row(&axis[i]), W::scaled(W::row(&rate[i]), half));
            W::put_row(W::sum(rate, W::scaled(axis, minus_one)), minus);
            W::put_row(W::sum(rate, axis), plus);
        }
        let Some(last) = flanks.len().checked_sub(1) else { return };
        let mut upper = W::row(&force[last]);
        let mut lower = upper;
        for pair in self.pairs.iter().rev() {
            let (i, j) = (pair.ancestor as usize, pair.descendant as usize);
            if i == j {
                // Pairs come grouped by descendant, and backwards the descendant itself comes first.
                let force = W::scaled(W::row(&force[j]), inverse);
                let slope = W::scaled(W::row(&slope[j]), middle);
                upper = W::sum(slope, force);
                lower = W::sum(slope, W::scaled(force, minus_one));
            }
            let [minus, plus] = &flanks[i];
            self.matrix.upper[pair.slot as usize] = W::dot_of(W::row(minus), upper);
            self.matrix.lower[pair.slot as usize] = W::dot_of(W::row(plus), lower);
        }
    }
}

impl Curvature {
    /// Writes the mass matrix `L_vv` of the dynamic coordinates.
    pub(crate) fn fill_mass_matrix(&self, pairs: &[Pair], matrix: &mut TreeLu) {
        for pair in pairs {
            let (ancestor, descendant) = (pair.ancestor as usize, pair.descendant as usize);
            let entry = f64::dot(&self.axis[ancestor], &self.force[descendant]);
            matrix.upper[pair.slot as usize] = entry;
            matrix.lower[pair.slot as usize] = entry;
        }
    }
}
