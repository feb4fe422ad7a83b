//! Eight numbers side by side, in the registers that a processor has for them.
//!
//! Loops over [`Block`]s are compiled number by number and put together again, which goes wrong where many of them
//! are at work at once: shuffles and spills took most of the time of an elimination. Here each block stays whole.
//! All kinds do the same operations in the same order: the bits are the same.

#[cfg(target_arch = "x86_64")]
mod registers;

#[cfg(target_arch = "x86_64")]
use crate::eights::registers::{Halves, Low, Pairs, Whole};
use crate::rows::{Block, LANES, sum_of_eight};
#[cfg(target_arch = "x86_64")]
use crate::simd::{AVX2, AVX512, has};
use crate::unrolled;

/// A one in each place.
pub const UNITS: [Block; LANES] = {
    let mut units = [Block::ZERO; LANES];
    let mut i = 0;
    while i < LANES {
        units[i].0[i] = 1.0;
        i += 1;
    }
    units
};

/// Eight numbers.
pub trait Eight: Copy + 'static {
    /// The same, of which the first four are of use.
    type Four: Eight;
    /// As many as are in one register.
    type One: Eight;
    /// How many are of use.
    const COUNT: usize = LANES;
    /// Zeros.
    const ZERO: Self;
    /// Ones.
    const ONE: Self;
    /// From memory.
    #[inline(always)]
    fn of(block: &Block) -> Self {
        Self::of_list(&block.0)
    }
    /// To memory.
    #[inline(always)]
    fn put(self, block: &mut Block) {
        self.put_list(&mut block.0);
    }
    /// From a list of at least as many numbers as are of use.
    fn of_list(list: &[f64]) -> Self;
    /// To a list of at least as many.
    fn put_list(self, list: &mut [f64]);
    /// The same number eight times.
    fn all(number: f64) -> Self;
    /// The sum, number by number.
    fn plus(self, o: Self) -> Self;
    /// The difference, number by number.
    fn minus(self, o: Self) -> Self;
    /// The product, number by number.
    fn times(self, o: Self) -> Self;
    /// The quotient, number by number.
    fn over(self, o: Self) -> Self;
    /// The square root of each number.
    fn sqrt(self) -> Self;
    /// Each number with the sign of another one.
    fn signed(self, o: Self) -> Self;
    /// The sum of all: of halves, of their halves, and of what is left.
    fn sum(self) -> f64;
    /// The first numbers of all, the second ones, and so on.
    fn transposed(rows: [Self; 8]) -> [Self; 8];
    /// To rows: each gets one of all eight.
    #[inline(always)]
    fn spread(numbers: [Self; 8], rows: &mut [Block]) {
        for (own, row) in Self::transposed(numbers).into_iter().zip(rows) {
            own.put(row);
        }
    }
    /// The way back.
    #[inline(always)]
    fn collect(rows: &[Block]) -> [Self; 8] {
        let mut eight = const { [Self::ZERO; 8] };
        for (own, row) in eight.iter_mut().zip(rows) {
            *own = Self::of(row);
        }
        Self::transposed(eight)
    }
    /// [`Eight::spread`] to the rows that are named.
    #[inline(always)]
    fn spread_to(numbers: [Self; 8], rows: &mut [Block], of: &[usize]) {
        let mut eight = const { [Block::ZERO; 8] };
        Self::spread(numbers, &mut eight);
        for (own, row) in eight.into_iter().zip(of) {
            rows[*row] = own;
        }
    }
    /// [`Eight::collect`] from the rows that are named.
    #[inline(always)]
    fn collect_from(rows: &[Block], of: &[usize]) -> [Self; 8] {
        let mut eight = const { [Block::ZERO; 8] };
        for (own, row) in eight.iter_mut().zip(of) {
            *own = rows[*row];
        }
        Self::collect(&eight)
    }
    /// Does something in a function of its own that has these registers: what is large, and done in many places.
    #[inline(always)]
    fn apart<R>(task: impl FnOnce() -> R) -> R {
        #[inline(never)]
        fn own<R>(task: impl FnOnce() -> R) -> R {
            task()
        }
        own(task)
    }
    /// All numbers times a factor.
    #[inline(always)]
    fn scaled(self, factor: f64) -> Self {
        self.times(Self::all(factor))
    }
    /// The sum of the products, number by number.
    #[inline(always)]
    fn dot(self, o: Self) -> f64 {
        self.times(o).sum()
    }
    /// The same, from memory.
    #[inline(always)]
    fn dot_of(a: &Block, b: &Block) -> f64 {
        Self::of(a).dot(Self::of(b))
    }
}

/// What is done with eight numbers at a time.
pub trait InEights {
    /// What comes out.
    type Output;
    /// Does it. Always inlined, as is all that works on these numbers in it.
    fn run<E: Eight>(self) -> Self::Output;
}

/// Does it in the widest registers of the processor.
#[inline(always)]
pub fn in_eights<T: InEights>(task: T) -> T::Output {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx512f")]
        fn avx512<T: InEights>(task: T) -> T::Output {
            task.run::<Whole>()
        }
        #[target_feature(enable = "avx2")]
        fn avx2<T: InEights>(task: T) -> T::Output {
            task.run::<Halves<Low>>()
        }
        if has(AVX512) {
            // SAFETY: the processor has AVX-512.
            return unsafe { avx512(task) };
        }
        if has(AVX2) {
            // SAFETY: the processor has AVX2.
            return unsafe { avx2(task) };
        }
        task.run::<Halves<Pairs>>()
    }
    #[cfg(not(target_arch = "x86_64"))]
    task.run::<Block>()
}

impl Eight for Block {
    type Four = Self;
    type One = Self;
    const ZERO: Self = Self([0.0; 8]);
    const ONE: Self = Self([1.0; 8]);
    #[inline(always)]
    fn of_list(list: &[f64]) -> Self {
        let mut block = Self::ZERO;
        block.0.iter_mut().zip(list).for_each(|(own, number)| *own = *number);
        block
    }
    #[inline(always)]
    fn put_list(self, list: &mut [f64]) {
        list.iter_mut().zip(self.0).for_each(|(number, own)| *number = own);
    }
    #[inline(always)]
    fn all(number: f64) -> Self {
        let mut block = Self::ZERO;
        unrolled!(8, i < 8, { block.0[i] = number });
        block
    }
    #[inline(always)]
    fn plus(mut self, o: Self) -> Self {
        unrolled!(8, i < 8, { self.0[i] += o.0[i] });
        self
    }
    #[inline(always)]
    fn minus(mut self, o: Self) -> Self {
        unrolled!(8, i < 8, { self.0[i] -= o.0[i] });
        self
    }
    #[inline(always)]
    fn times(mut self, o: Self) -> Self {
        unrolled!(8, i < 8, { self.0[i] *= o.0[i] });
        self
    }
    #[inline(always)]
    fn over(mut self, o: Self) -> Self {
        unrolled!(8, i < 8, { self.0[i] /= o.0[i] });
        self
    }
    #[inline(always)]
    fn sqrt(mut self) -> Self {
        unrolled!(8, i < 8, { self.0[i] = self.0[i].sqrt() });
        self
    }
    #[inline(always)]
    fn signed(mut self, o: Self) -> Self {
        unrolled!(8, i < 8, { self.0[i] = self.0[i].copysign(o.0[i]) });
        self
    }
    #[inline(always)]
    fn transposed(rows: [Self; 8]) -> [Self; 8] {
        let mut out = rows;
        unrolled!(8, i < 8, {
            unrolled!(8, k < 8, { out[i].0[k] = rows[k].0[i] });
        });
        out
    }
    #[inline(always)]
    fn sum(self) -> f64 {
        sum_of_eight(self.0)
    }
}

/// The first of eight numbers alone, where the others are of no use.
impl Eight for f64 {
    type Four = Self;
    type One = Self;
    const COUNT: usize = 1;
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;
    #[inline(always)]
    fn of_list(list: &[f64]) -> Self {
        list[0]
    }
    #[inline(always)]
    fn put_list(self, list: &mut [f64]) {
        list[0] = self;
    }
    #[inline(always)]
    fn all(number: f64) -> Self {
        number
    }
    #[inline(always)]
    fn plus(self, o: Self) -> Self {
        self + o
    }
    #[inline(always)]
    fn minus(self, o: Self) -> Self {
        self - o
    }
    #[inline(always)]
    fn times(self, o: Self) -> Self {
        self * o
    }
    #[inline(always)]
    fn over(self, o: Self) -> Self {
        self / o
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.sqrt()
    }
    #[inline(always)]
    fn signed(self, o: Self) -> Self {
        self.copysign(o)
    }
    #[inline(always)]
    fn sum(self) -> f64 {
        self
    }
    #[inline(always)]
    fn transposed([first, ..]: [Self; 8]) -> [Self; 8] {
        [first, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    }
    #[inline(always)]
    fn spread(numbers: [Self; 8], rows: &mut [Block]) {
        rows[0] = Block(numbers);
    }
    #[inline(always)]
    fn collect(rows: &[Block]) -> [Self; 8] {
        rows[0].0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{AVX2, AVX512, PORTABLE, within};

    /// All that eight numbers can, of two blocks.
    struct All<'a>([&'a Block; 2]);

    impl InEights for All<'_> {
        type Output = [Block; 16];
        #[inline(always)]
        fn run<E: Eight>(self) -> [Block; 16] {
            let [a, b] = self.0.map(|block| E::of(block));
            let mut out = [Block::ZERO; 16];
            a.plus(b).put(&mut out[0]);
            a.minus(b).put(&mut out[1]);
            a.times(b).put(&mut out[2]);
            a.scaled(b.sum()).put(&mut out[3]);
            E::all(a.dot(b)).put(&mut out[4]);
            let rows = [0, 1, 2, 3, 4, 5, 6, 7].map(|i| a.plus(b.scaled(f64::from(i))));
            for (own, row) in E::transposed(rows).into_iter().zip(&mut out[5..]) {
                own.put(row);
            }
            a.over(b).put(&mut out[13]);
            b.times(b).sqrt().put(&mut out[14]);
            a.signed(b).put(&mut out[15]);
            out
        }
    }

    #[test]
    fn all_registers_give_the_same_bits() {
        let block = |seed: f64| Block(std::array::from_fn(|i| (seed + i as f64).sin() / 3.0));
        let (a, b) = (block(0.3), block(1.7));
        let all = |registers| within(registers, || in_eights(All([&a, &b])).map(|b| b.0));
        let wide = all(AVX512);
        let by_number = All([&a, &b]).run::<Block>().map(|b| b.0);
        assert_eq!([wide; 3], [all(AVX2), all(PORTABLE), by_number]);
        for i in 0..8 {
            let [x, y] = [a.0[i], b.0[i]];
            assert_eq!([wide[0][i], wide[1][i], wide[2][i]], [x + y, x - y, x * y]);
            assert_eq!(
                [wide[13][i], wide[14][i], wide[15][i]],
                [x / y, (y * y).sqrt(), x.copysign(y)]
            );
            for (k, entry) in wide[5 + i].iter().enumerate() {
                assert_eq!(*entry, x + y * k as f64);
            }
        }
        let sum: f64 = a.0.iter().zip(&b.0).map(|(a, b)| a * b).sum();
        assert!((wide[4][3] - sum).abs() < 1e-15);
    }
}
