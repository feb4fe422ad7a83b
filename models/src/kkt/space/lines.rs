//! Vectors of one to three whole blocks of eight numbers.

use plantd_math::eights::Eight;
use plantd_math::rows::Block;
use plantd_math::unrolled;

/// In memory.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Line<const B: usize>(pub(crate) [Block; B]);

/// In registers.
#[derive(Clone, Copy)]
pub(crate) struct InLine<E, const B: usize>(pub(crate) [E; B]);

/// A line for each number of another one.
pub(crate) type Lines<E, const B: usize> = [[InLine<E, B>; 8]; B];

impl<const B: usize> Default for Line<B> {
    fn default() -> Self {
        Self::ZERO
    }
}

impl<const B: usize> Line<B> {
    pub(crate) const ZERO: Self = Self([Block::ZERO; B]);
}

impl<E: Eight, const B: usize> InLine<E, B> {
    pub(crate) const ZERO: Self = Self([E::ZERO; B]);

    /// Of a first block and, where there are more, a second and a third.
    #[inline(always)]
    pub(crate) fn new(first: E, second: E, third: E) -> Self {
        let mut all = Self::ZERO;
        unrolled!(3, b < B, { all.0[b] = [first, second, third][b] });
        all
    }

    /// To a line, whose other blocks become zero.
    #[inline(always)]
    pub(crate) fn put_alone<const L: usize>(self, line: &mut Line<L>) {
        if L > B {
            *line = Line::ZERO;
        }
        self.put(line);
    }

    /// Its first block alone.
    #[inline(always)]
    pub(crate) fn ended(self) -> Self {
        Self::new(self.0[0], E::ZERO, E::ZERO)
    }

    /// The first blocks of a line that has more.
    #[inline(always)]
    pub(crate) fn of<const L: usize>(line: &Line<L>) -> Self {
        let mut all = Self::ZERO;
        unrolled!(3, b < B, { all.0[b] = E::of(&line.0[b]) });
        all
    }

    /// To the first blocks of a line that has more.
    #[inline(always)]
    pub(crate) fn put<const L: usize>(self, line: &mut Line<L>) {
        unrolled!(3, b < B, { self.0[b].put(&mut line.0[b]) });
    }

    #[inline(always)]
    pub(crate) fn plus(mut self, o: Self) -> Self {
        unrolled!(3, b < B, { self.0[b] = self.0[b].plus(o.0[b]) });
        self
    }

    #[inline(always)]
    pub(crate) fn minus(mut self, o: Self) -> Self {
        unrolled!(3, b < B, { self.0[b] = self.0[b].minus(o.0[b]) });
        self
    }

    #[inline(always)]
    pub(crate) fn scaled(mut self, factor: f64) -> Self {
        unrolled!(3, b < B, { self.0[b] = self.0[b].scaled(factor) });
        self
    }

    #[inline(always)]
    pub(crate) fn dot(self, o: Self) -> f64 {
        let mut sum = self.0[0].times(o.0[0]);
        unrolled!(3, b < B, {
            if b > 0 {
                sum = sum.plus(self.0[b].times(o.0[b]));
            }
        });
        sum.sum()
    }
}

/// The sum of lines, each times an entry of `v`.
#[inline(always)]
pub(crate) fn combined<E: Eight, const B: usize, const L: usize>(
    lines: &Lines<E, B>,
    v: &Line<L>,
) -> InLine<E, B> {
    if B == 1 {
        return sum_of(lines, v);
    }
    // Written out wherever it is used, this was most of the kernels, and most of their compilation.
    E::apart(
        #[inline(always)]
        || sum_of(lines, v),
    )
}

#[inline(always)]
fn sum_of<E: Eight, const B: usize, const L: usize>(
    lines: &Lines<E, B>,
    v: &Line<L>,
) -> InLine<E, B> {
    let mut sum = InLine::ZERO;
    unrolled!(3, b < B, {
        let of = (&lines[b], &v.0[b]);
        let own = two(of, 0).plus(two(of, 2)).plus(two(of, 1).plus(two(of, 3)));
        sum = if b == 0 { own } else { sum.plus(own) };
    });
    sum
}

/// Two of them. A closure that is called so often would not be inlined, and then has no registers of the processor's.
#[inline(always)]
fn two<E: Eight, const B: usize>(
    (lines, Block(v)): (&[InLine<E, B>; 8], &Block),
    k: usize,
) -> InLine<E, B> {
    lines[k].scaled(v[k]).plus(lines[k + 4].scaled(v[k + 4]))
}
