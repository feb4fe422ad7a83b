//! Eight numbers side by side, in the registers that a processor has for them.
//!
//! Loops over [`Block`]s are compiled number by number and put together again, which goes wrong where many of them
//! are at work at once: shuffles and spills took most of the time of an elimination. Here each block stays whole.
//! All kinds do the same operations in the same order: the bits are the same.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

use crate::rows::Block;
#[cfg(target_arch = "x86_64")]
use crate::simd::{AVX2, AVX512, has};

/// Eight numbers.
pub trait Eight: Copy {
    /// From memory.
    fn of(block: &Block) -> Self;
    /// To memory.
    fn put(self, block: &mut Block);
    /// The same number eight times.
    fn all(number: f64) -> Self;
    /// The sum, number by number.
    fn plus(self, o: Self) -> Self;
    /// The difference, number by number.
    fn minus(self, o: Self) -> Self;
    /// The product, number by number.
    fn times(self, o: Self) -> Self;
    /// The sum of all: of halves, of their halves, and of what is left.
    fn sum(self) -> f64;
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
            task.run::<Halves>()
        }
        if has(AVX512) {
            // SAFETY: the processor has AVX-512.
            return unsafe { avx512(task) };
        }
        if has(AVX2) {
            // SAFETY: the processor has AVX2.
            return unsafe { avx2(task) };
        }
    }
    task.run::<Block>()
}

impl Eight for Block {
    #[inline(always)]
    fn of(block: &Block) -> Self {
        *block
    }
    #[inline(always)]
    fn put(self, block: &mut Block) {
        *block = self;
    }
    #[inline(always)]
    fn all(number: f64) -> Self {
        Self([number; 8])
    }
    #[inline(always)]
    fn plus(self, o: Self) -> Self {
        Self(std::array::from_fn(|i| self.0[i] + o.0[i]))
    }
    #[inline(always)]
    fn minus(self, o: Self) -> Self {
        Self(std::array::from_fn(|i| self.0[i] - o.0[i]))
    }
    #[inline(always)]
    fn times(self, o: Self) -> Self {
        Self(std::array::from_fn(|i| self.0[i] * o.0[i]))
    }
    #[inline(always)]
    fn sum(self) -> f64 {
        let half = |i: usize| self.0[i] + self.0[i + 4];
        let quarter = |i: usize| half(i) + half(i + 2);
        quarter(0) + quarter(1)
    }
}

/// A register of eight numbers; made within [`in_eights`] alone, where the processor has AVX-512.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy)]
struct Whole(__m512d);

/// Two registers of four numbers; made within [`in_eights`] alone, where the processor has AVX2.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy)]
struct Halves([__m256d; 2]);

#[cfg(target_arch = "x86_64")]
impl Eight for Whole {
    #[inline(always)]
    fn of(block: &Block) -> Self {
        // SAFETY: there are such registers, and a block is aligned to 64 bytes.
        Self(unsafe { _mm512_load_pd(block.0.as_ptr()) })
    }
    #[inline(always)]
    fn put(self, block: &mut Block) {
        // SAFETY: as above.
        unsafe { _mm512_store_pd(block.0.as_mut_ptr(), self.0) }
    }
    #[inline(always)]
    fn all(number: f64) -> Self {
        // SAFETY: there are such registers.
        Self(unsafe { _mm512_set1_pd(number) })
    }
    #[inline(always)]
    fn plus(self, o: Self) -> Self {
        // SAFETY: there are such registers.
        Self(unsafe { _mm512_add_pd(self.0, o.0) })
    }
    #[inline(always)]
    fn minus(self, o: Self) -> Self {
        // SAFETY: there are such registers.
        Self(unsafe { _mm512_sub_pd(self.0, o.0) })
    }
    #[inline(always)]
    fn times(self, o: Self) -> Self {
        // SAFETY: there are such registers.
        Self(unsafe { _mm512_mul_pd(self.0, o.0) })
    }
    #[inline(always)]
    fn sum(self) -> f64 {
        // SAFETY: there are such registers.
        unsafe {
            let halves = [_mm512_castpd512_pd256(self.0), _mm512_extractf64x4_pd::<1>(self.0)];
            sum(_mm256_add_pd(halves[0], halves[1]))
        }
    }
}

#[cfg(target_arch = "x86_64")]
impl Eight for Halves {
    #[inline(always)]
    fn of(block: &Block) -> Self {
        let [low, high] = [0, 4].map(|half| block.0[half..].as_ptr());
        // SAFETY: there are such registers, and halves of a block are aligned to 32 bytes.
        Self(unsafe { [_mm256_load_pd(low), _mm256_load_pd(high)] })
    }
    #[inline(always)]
    fn put(self, block: &mut Block) {
        let (low, high) = block.0.split_at_mut(4);
        // SAFETY: as above.
        unsafe {
            _mm256_store_pd(low.as_mut_ptr(), self.0[0]);
            _mm256_store_pd(high.as_mut_ptr(), self.0[1]);
        }
    }
    #[inline(always)]
    fn all(number: f64) -> Self {
        // SAFETY: there are such registers.
        Self([unsafe { _mm256_set1_pd(number) }; 2])
    }
    #[inline(always)]
    fn plus(self, o: Self) -> Self {
        // SAFETY: there are such registers.
        Self(unsafe { [_mm256_add_pd(self.0[0], o.0[0]), _mm256_add_pd(self.0[1], o.0[1])] })
    }
    #[inline(always)]
    fn minus(self, o: Self) -> Self {
        // SAFETY: there are such registers.
        Self(unsafe { [_mm256_sub_pd(self.0[0], o.0[0]), _mm256_sub_pd(self.0[1], o.0[1])] })
    }
    #[inline(always)]
    fn times(self, o: Self) -> Self {
        // SAFETY: there are such registers.
        Self(unsafe { [_mm256_mul_pd(self.0[0], o.0[0]), _mm256_mul_pd(self.0[1], o.0[1])] })
    }
    #[inline(always)]
    fn sum(self) -> f64 {
        // SAFETY: there are such registers.
        unsafe { sum(_mm256_add_pd(self.0[0], self.0[1])) }
    }
}

/// Of the halves, and of what is left. Needs AVX2.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn sum(four: __m256d) -> f64 {
    // SAFETY: whoever calls has AVX2.
    unsafe {
        let two = _mm_add_pd(_mm256_castpd256_pd128(four), _mm256_extractf128_pd::<1>(four));
        _mm_cvtsd_f64(_mm_add_sd(two, _mm_unpackhi_pd(two, two)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::narrowly;

    /// All that eight numbers can, of two blocks.
    struct All<'a>([&'a Block; 2]);

    impl InEights for All<'_> {
        type Output = [Block; 5];
        #[inline(always)]
        fn run<E: Eight>(self) -> [Block; 5] {
            let [a, b] = self.0.map(|block| E::of(block));
            let mut out = [Block::ZERO; 5];
            a.plus(b).put(&mut out[0]);
            a.minus(b).put(&mut out[1]);
            a.times(b).put(&mut out[2]);
            a.scaled(b.sum()).put(&mut out[3]);
            E::all(a.dot(b)).put(&mut out[4]);
            out
        }
    }

    #[test]
    fn all_registers_give_the_same_bits() {
        let block = |seed: f64| Block(std::array::from_fn(|i| (seed + i as f64).sin() / 3.0));
        let (a, b) = (block(0.3), block(1.7));
        let [wide, narrow] =
            [in_eights(All([&a, &b])), narrowly(|| in_eights(All([&a, &b])))].map(|o| o.map(|b| b.0));
        assert_eq!(wide, narrow);
        for i in 0..8 {
            let [x, y] = [a.0[i], b.0[i]];
            assert_eq!([wide[0][i], wide[1][i], wide[2][i]], [x + y, x - y, x * y]);
        }
        let sum: f64 = a.0.iter().zip(&b.0).map(|(a, b)| a * b).sum();
        assert!((wide[4][3] - sum).abs() < 1e-15);
    }
}
