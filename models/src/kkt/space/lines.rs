//! Vectors of one to three whole blocks of eight numbers.

use plantd_math::eights::Eight;
use plantd_math::rows::Block;

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
        let mut blocks = [first; B];
        if let [_, own, ..] = &mut blocks[..] {
            *own = second;
        }
        if let [_, _, own] = &mut blocks[..] {
            *own = third;
        }
        Self(blocks)
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
        let mut blocks = [E::ZERO; B];
        for (own, block) in blocks.iter_mut().zip(&line.0) {
            *own = E::of(block);
        }
        Self(blocks)
    }

    /// To the first blocks of a line that has more.
    #[inline(always)]
    pub(crate) fn put<const L: usize>(self, line: &mut Line<L>) {
        for (own, block) in self.0.into_iter().zip(&mut line.0) {
            own.put(block);
        }
    }

    #[inline(always)]
    pub(crate) fn plus(mut self, o: Self) -> Self {
        for (own, other) in self.0.iter_mut().zip(o.0) {
            *own = own.plus(other);
        }
        self
    }

    #[inline(always)]
    pub(crate) fn minus(mut self, o: Self) -> Self {
        for (own, other) in self.0.iter_mut().zip(o.0) {
            *own = own.minus(other);
        }
        self
    }

    #[inline(always)]
    pub(crate) fn scaled(mut self, factor: f64) -> Self {
        for own in &mut self.0 {
            *own = own.scaled(factor);
        }
        self
    }

    #[inline(always)]
    pub(crate) fn dot(self, o: Self) -> f64 {
        let mut products = self.0;
        for (own, other) in products.iter_mut().zip(o.0) {
            *own = own.times(other);
        }
        let mut sum = products[0];
        for more in &products[1..] {
            sum = sum.plus(*more);
        }
        sum.sum()
    }
}

/// The sum of lines, each times an entry of `v`.
#[inline(always)]
pub(crate) fn combined<E: Eight, const B: usize, const L: usize>(
    lines: &Lines<E, B>,
    v: &Line<L>,
) -> InLine<E, B> {
    let mut sum = InLine::ZERO;
    for (b, (lines, Block(v))) in lines.iter().zip(&v.0).enumerate() {
        let mut sums = [InLine::ZERO; 4];
        for (k, sum) in sums.iter_mut().enumerate() {
            *sum = lines[k].scaled(v[k]).plus(lines[k + 4].scaled(v[k + 4]));
        }
        let own = sums[0].plus(sums[2]).plus(sums[1].plus(sums[3]));
        sum = if b == 0 { own } else { sum.plus(own) };
    }
    sum
}
