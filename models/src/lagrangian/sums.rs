//! Sums along a tree: what joints pass on to those that they carry, or to their parents.
//!
//! Of each joint the numbers that are summed up stand in a row, so that one addition does for eight of them; there
//! are up to nine. From joints side by side to rows and back they are turned. A sum that the next joint takes stays
//! in registers: through memory each joint would wait for the one before.

use plantd_math::scalar::{Scalar, Wide};
use plantd_math::spatial::Vec3;

use crate::model::tree::{Tree, WORLD};

/// Nine numbers of each joint.
#[derive(Clone, Debug, Default)]
pub(crate) struct Sums<S: Scalar> {
    rows: Vec<S::Row>,
    ninths: Vec<S::Several>,
}

/// Where joints begin that are side by side.
#[inline(always)]
pub(crate) fn firsts<S: Scalar>(tree: &Tree) -> impl Iterator<Item = usize> + use<S> {
    (0..tree.joints.len()).step_by(S::BESIDE)
}

impl<S: Scalar> Sums<S> {
    pub(crate) fn new(joints: usize) -> Self {
        Self {
            rows: vec![S::Row::default(); joints.next_multiple_of(S::BESIDE)],
            ninths: vec![S::Several::default(); joints.div_ceil(S::BESIDE)],
        }
    }

    /// Sets the first eight numbers of the joints that begin with `i`.
    #[inline(always)]
    pub(crate) fn put<W: Wide<S>>(&mut self, i: usize, numbers: [W; 8]) {
        W::spread(numbers, &mut self.rows[i..i + S::BESIDE]);
    }

    /// Sets all nine, of three vectors.
    #[inline(always)]
    pub(crate) fn put_vectors<W: Wide<S>>(&mut self, i: usize, [a, b, c]: [Vec3<W>; 3]) {
        self.put(i, [a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1]]);
        c[2].store(&mut self.ninths[i / S::BESIDE]);
    }

    /// The first eight sums of the joints that begin with `i`.
    #[inline(always)]
    pub(crate) fn take<W: Wide<S>>(&self, i: usize) -> [W; 8] {
        W::collect(&self.rows[i..i + S::BESIDE])
    }

    /// All nine.
    #[inline(always)]
    pub(crate) fn take_vectors<W: Wide<S>>(&self, i: usize) -> [Vec3<W>; 3] {
        let [p, q, r, s, t, u, x, y] = self.take(i);
        [Vec3([p, q, r]), Vec3([s, t, u]), Vec3([x, y, W::load(&self.ninths[i / S::BESIDE])])]
    }

    /// The first eight of each joint become those of another one, or zero.
    #[inline(always)]
    pub(crate) fn copy_from<W: Wide<S>>(&mut self, others: &Self, of: impl Fn(usize) -> usize) {
        let zero = W::row(&S::Row::default());
        for (i, row) in self.rows.iter_mut().enumerate() {
            let other = match of(i) {
                WORLD => zero,
                other => W::row(&others.rows[other]),
            };
            W::put_row(other, row);
        }
    }

    /// Each joint gets what its parent has; `NINTH`: also of the ninth numbers.
    #[inline(always)]
    pub(crate) fn descend<W: Wide<S>, const NINTH: bool>(&mut self, tree: &Tree) {
        let rows = &mut self.rows[..];
        let Some(first) = rows.first() else { return };
        let (mut last, mut last_ninth) = (W::row(first), S::ZERO);
        for (i, joint) in tree.joints.iter().enumerate() {
            let mut sum = W::row(&rows[i]);
            let is_next = joint.parent.wrapping_add(1) == i;
            if joint.parent != WORLD {
                let above = if is_next { last } else { W::row(&rows[joint.parent]) };
                sum = W::sum(above, sum);
                W::put_row(sum, &mut rows[i]);
            }
            last = sum;
            if NINTH {
                let mut sum = ninth::<S>(&self.ninths, i);
                if joint.parent != WORLD {
                    let above =
                        if is_next { last_ninth } else { ninth::<S>(&self.ninths, joint.parent) };
                    sum = above + sum;
                    sum.put(&mut self.ninths[i / S::BESIDE], i % S::BESIDE);
                }
                last_ninth = sum;
            }
        }
    }

    /// Each joint gets what its children have; `NINTH`: also of the ninth numbers.
    #[inline(always)]
    pub(crate) fn ascend<W: Wide<S>, const NINTH: bool>(&mut self, tree: &Tree) {
        let rows = &mut self.rows[..];
        let Some(first) = rows.first() else { return };
        let (mut below, mut below_ninth, mut is_followed) = (W::row(first), S::ZERO, false);
        for (i, joint) in tree.joints.iter().enumerate().rev() {
            let mut sum = W::row(&rows[i]);
            if is_followed {
                sum = W::sum(sum, below);
                W::put_row(sum, &mut rows[i]);
            }
            below = sum;
            if NINTH {
                let mut sum = ninth::<S>(&self.ninths, i);
                if is_followed {
                    sum += below_ninth;
                    sum.put(&mut self.ninths[i / S::BESIDE], i % S::BESIDE);
                }
                below_ninth = sum;
            }
            is_followed = joint.parent.wrapping_add(1) == i && i > 0;
            if joint.parent != WORLD && !is_followed {
                let parent = joint.parent;
                let all = W::sum(W::row(&rows[parent]), below);
                W::put_row(all, &mut rows[parent]);
                if NINTH {
                    let all = ninth::<S>(&self.ninths, parent) + below_ninth;
                    all.put(&mut self.ninths[parent / S::BESIDE], parent % S::BESIDE);
                }
            }
        }
    }
}

#[inline(always)]
fn ninth<S: Scalar>(ninths: &[S::Several], i: usize) -> S {
    S::one(&ninths[i / S::BESIDE], i % S::BESIDE)
}
