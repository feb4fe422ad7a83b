//! Sums along a tree: what links pass on to those that they carry, or to their parents.
//!
//! Of each link the numbers that are summed up stand in a row, so that one addition does for eight of them; there
//! are up to nine. From links side by side to rows and back they are turned. A sum that the next link takes stays
//! in registers: through memory each link would wait for the one before.

use plantd_math::scalar::{Scalar, Wide};
use plantd_math::spatial::Vec3;

use crate::model::slots::Slots;
use crate::model::tree::{Tree, WORLD};

/// Nine numbers of each link.
#[derive(Clone, Debug, Default)]
pub(crate) struct Sums<S: Scalar> {
    rows: Vec<S::Row>,
    ninths: Vec<S>,
}

/// Where slots begin that are side by side.
#[inline(always)]
pub(crate) fn firsts<S: Scalar, W: Wide<S>>(
    tree: &Tree,
) -> impl Iterator<Item = usize> + use<S, W> {
    (0..tree.joints.len()).step_by(W::COUNT)
}

/// The same of those that begin with a link.
#[inline(always)]
pub(crate) fn firsts_of_links<S: Scalar, W: Wide<S>>(
    tree: &Tree,
) -> impl Iterator<Item = usize> + use<S, W> {
    (0..tree.slots.parents.len()).step_by(W::COUNT)
}

impl<S: Scalar> Sums<S> {
    pub(crate) fn new(slots: &Slots) -> Self {
        Self {
            rows: vec![S::Row::default(); slots.nothing() + 1],
            ninths: vec![S::ZERO; slots.nothing()],
        }
    }

    /// Sets the first eight numbers of the links that begin with `i`.
    #[inline(always)]
    pub(crate) fn put<W: Wide<S>>(&mut self, i: usize, numbers: [W; 8]) {
        W::spread(numbers, &mut self.rows[i..i + W::COUNT]);
    }

    /// Sets all nine, of three vectors.
    #[inline(always)]
    pub(crate) fn put_vectors<W: Wide<S>>(&mut self, i: usize, [a, b, c]: [Vec3<W>; 3]) {
        self.put(i, [a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1]]);
        let mut several = S::Several::default();
        c[2].store(&mut several, 0);
        for (lane, ninth) in self.ninths[i..i + W::COUNT].iter_mut().enumerate() {
            *ninth = S::one(&several, lane);
        }
    }

    /// The first eight sums of the links that begin with `i`.
    #[inline(always)]
    pub(crate) fn take<W: Wide<S>>(&self, i: usize) -> [W; 8] {
        W::collect(&self.rows[i..i + W::COUNT])
    }

    /// The same of the links that belong to the slots from `i` on; without ball joints they are the slots.
    #[inline(always)]
    pub(crate) fn take_from<W: Wide<S>, const BALLS: bool>(
        &self,
        i: usize,
        links: &[usize],
    ) -> [W; 8] {
        match BALLS {
            true => W::collect_from(&self.rows, &links[i..i + W::COUNT]),
            false => self.take(i),
        }
    }

    /// All nine.
    #[inline(always)]
    pub(crate) fn take_vectors_from<W: Wide<S>, const BALLS: bool>(
        &self,
        i: usize,
        links: &[usize],
    ) -> [Vec3<W>; 3] {
        let [p, q, r, s, t, u, x, y] = self.take_from::<W, BALLS>(i, links);
        let z = if BALLS {
            let links = &links[i..i + W::COUNT];
            let mut several = S::Several::default();
            for (lane, link) in links.iter().enumerate() {
                self.ninths[*link].put(&mut several, lane);
            }
            W::load(&several, 0)
        } else {
            W::first_of(&self.ninths[i..i + W::COUNT])
        };
        [Vec3([p, q, r]), Vec3([s, t, u]), Vec3([x, y, z])]
    }

    /// Each link gets what its parent has, but for ninth numbers.
    #[inline(always)]
    pub(crate) fn descend<W: Wide<S>>(&mut self, parents: &[usize]) {
        let rows = &mut self.rows[..];
        let Some(first) = rows.first() else { return };
        let mut last = W::row(first);
        for (i, &parent) in parents.iter().enumerate() {
            let mut sum = W::row(&rows[i]);
            if parent != WORLD {
                let is_next = parent.wrapping_add(1) == i;
                let above = if is_next { last } else { W::row(&rows[parent]) };
                sum = W::sum(above, sum);
                W::put_row(sum, &mut rows[i]);
            }
            last = sum;
        }
    }

    /// Each link gets what its children have; `NINTH`: also of the ninth numbers.
    #[inline(always)]
    pub(crate) fn ascend<W: Wide<S>, const NINTH: bool>(&mut self, parents: &[usize]) {
        let rows = &mut self.rows[..];
        let Some(first) = rows.first() else { return };
        let (mut below, mut below_ninth, mut is_followed) = (W::row(first), S::ZERO, false);
        for (i, &parent) in parents.iter().enumerate().rev() {
            let mut sum = W::row(&rows[i]);
            if is_followed {
                sum = W::sum(sum, below);
                W::put_row(sum, &mut rows[i]);
            }
            below = sum;
            if NINTH {
                let sum = &mut self.ninths[i];
                if is_followed {
                    *sum += below_ninth;
                }
                below_ninth = *sum;
            }
            is_followed = parent.wrapping_add(1) == i && i > 0;
            if parent != WORLD && !is_followed {
                let all = W::sum(W::row(&rows[parent]), below);
                W::put_row(all, &mut rows[parent]);
                if NINTH {
                    self.ninths[parent] += below_ninth;
                }
            }
        }
    }
}
