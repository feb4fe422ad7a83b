//! Registers of x86 processors. Those of AVX are made within [`in_eights`](super::in_eights) and its like alone, which
//! have asked whether the processor has them.

use std::arch::x86_64::*;

use crate::eights::Eight;
use crate::rows::Block;
use crate::unrolled;

/// A register of eight numbers, of AVX-512.
#[derive(Clone, Copy)]
pub(super) struct Whole(__m512d);

/// Eight numbers as two times four.
#[derive(Clone, Copy)]
pub(super) struct Halves<F>([F; 2]);

/// The first four of eight numbers, where the others are of no use: a register of AVX2.
#[derive(Clone, Copy)]
pub(super) struct Low(__m256d);

/// The same in two registers of SSE2, which all x86-64 processors have. Ropes of 32 and 64 joints take 0.55 of the time of
/// a step that they take number by number, as processors of other kinds do it, and with A and B 0.7.
#[derive(Clone, Copy)]
pub(super) struct Pairs([Pair; 2]);

/// One of them.
#[derive(Clone, Copy)]
struct Pair(__m128d);

/// Four numbers.
pub(super) trait Four: Eight {
    /// The first numbers of all, the second ones, and so on.
    fn transposed_four(rows: [Self; 4]) -> [Self; 4];
}

/// What is done number by number in one register.
macro_rules! number_by_number {
    ($numbers:literal, $load:ident, $store:ident, $all:ident, $plus:ident, $minus:ident, $times:ident,
     $over:ident, $sqrt:ident) => {
        const ZERO: Self = Self::constant(0.0);
        const ONE: Self = Self::constant(1.0);
        #[inline(always)]
        fn of_list(list: &[f64]) -> Self {
            // SAFETY: there are such registers, and as many numbers.
            Self(unsafe { $load(list[..$numbers].as_ptr()) })
        }
        #[inline(always)]
        fn put_list(self, list: &mut [f64]) {
            // SAFETY: as above.
            unsafe { $store(list[..$numbers].as_mut_ptr(), self.0) }
        }
        #[inline(always)]
        fn all(number: f64) -> Self {
            // SAFETY: there are such registers.
            Self(unsafe { $all(number) })
        }
        #[inline(always)]
        fn plus(self, o: Self) -> Self {
            // SAFETY: there are such registers.
            Self(unsafe { $plus(self.0, o.0) })
        }
        #[inline(always)]
        fn minus(self, o: Self) -> Self {
            // SAFETY: there are such registers.
            Self(unsafe { $minus(self.0, o.0) })
        }
        #[inline(always)]
        fn times(self, o: Self) -> Self {
            // SAFETY: there are such registers.
            Self(unsafe { $times(self.0, o.0) })
        }
        #[inline(always)]
        fn over(self, o: Self) -> Self {
            // SAFETY: there are such registers.
            Self(unsafe { $over(self.0, o.0) })
        }
        #[inline(always)]
        fn sqrt(self) -> Self {
            // SAFETY: there are such registers.
            Self(unsafe { $sqrt(self.0) })
        }
    };
}

/// A function of its own with a feature of the processor.
macro_rules! apart {
    ($feature:literal) => {
        #[inline(always)]
        fn apart<R>(task: impl FnOnce() -> R) -> R {
            #[inline(never)]
            #[target_feature(enable = $feature)]
            fn own<R>(task: impl FnOnce() -> R) -> R {
                task()
            }
            // SAFETY: there are such registers.
            unsafe { own(task) }
        }
    };
}

/// What is done with each half by itself.
macro_rules! half_by_half {
    ($numbers:literal, $half:ty) => {
        const ZERO: Self = Self([<$half>::ZERO; 2]);
        const ONE: Self = Self([<$half>::ONE; 2]);
        #[inline(always)]
        fn of_list(list: &[f64]) -> Self {
            Self([<$half>::of_list(list), <$half>::of_list(&list[$numbers..])])
        }
        #[inline(always)]
        fn put_list(self, list: &mut [f64]) {
            self.0[0].put_list(list);
            self.0[1].put_list(&mut list[$numbers..]);
        }
        #[inline(always)]
        fn all(number: f64) -> Self {
            Self([<$half>::all(number); 2])
        }
        #[inline(always)]
        fn plus(self, o: Self) -> Self {
            Self([self.0[0].plus(o.0[0]), self.0[1].plus(o.0[1])])
        }
        #[inline(always)]
        fn minus(self, o: Self) -> Self {
            Self([self.0[0].minus(o.0[0]), self.0[1].minus(o.0[1])])
        }
        #[inline(always)]
        fn times(self, o: Self) -> Self {
            Self([self.0[0].times(o.0[0]), self.0[1].times(o.0[1])])
        }
        #[inline(always)]
        fn over(self, o: Self) -> Self {
            Self([self.0[0].over(o.0[0]), self.0[1].over(o.0[1])])
        }
        #[inline(always)]
        fn sqrt(self) -> Self {
            Self([self.0[0].sqrt(), self.0[1].sqrt()])
        }
        #[inline(always)]
        fn signed(self, o: Self) -> Self {
            Self([self.0[0].signed(o.0[0]), self.0[1].signed(o.0[1])])
        }
        #[inline(always)]
        fn sum(self) -> f64 {
            self.0[0].plus(self.0[1]).sum()
        }
    };
}

/// How the first four numbers of some are put into rows, and back.
macro_rules! first_four {
    () => {
        type Four = Self;
        type One = Self;
        const COUNT: usize = 4;
        #[inline(always)]
        fn transposed([a, b, c, d, ..]: [Self; 8]) -> [Self; 8] {
            let [a, b, c, d] = Self::transposed_four([a, b, c, d]);
            [a, b, c, d, Self::ZERO, Self::ZERO, Self::ZERO, Self::ZERO]
        }
        #[inline(always)]
        fn spread([a, b, c, d, e, f, g, h]: [Self; 8], rows: &mut [Block]) {
            let (low, high) =
                (Self::transposed_four([a, b, c, d]), Self::transposed_four([e, f, g, h]));
            for ((low, high), row) in low.into_iter().zip(high).zip(rows) {
                Halves([low, high]).put(row);
            }
        }
        #[inline(always)]
        fn collect(rows: &[Block]) -> [Self; 8] {
            let [a, b, c, d, ..] = rows else { return [Self::ZERO; 8] };
            let of = Halves::<Self>::of;
            let (a, b, c, d) = (of(a).0, of(b).0, of(c).0, of(d).0);
            let [p, q, r, s] = Self::transposed_four([a[0], b[0], c[0], d[0]]);
            let [t, u, v, w] = Self::transposed_four([a[1], b[1], c[1], d[1]]);
            [p, q, r, s, t, u, v, w]
        }
    };
}

impl Whole {
    const fn constant(number: f64) -> Self {
        // SAFETY: eight numbers are what it is.
        Self(unsafe { std::mem::transmute::<[f64; 8], __m512d>([number; 8]) })
    }

    /// The first pairs of all, the second ones, and so on.
    #[inline(always)]
    fn transposed_pairs([a, b, c, d]: [__m512d; 4]) -> [Self; 4] {
        // SAFETY: there are such registers.
        let pairs = unsafe {
            let first = [_mm512_shuffle_f64x2::<0x44>(a, b), _mm512_shuffle_f64x2::<0x44>(c, d)];
            let last = [_mm512_shuffle_f64x2::<0xEE>(a, b), _mm512_shuffle_f64x2::<0xEE>(c, d)];
            [
                _mm512_shuffle_f64x2::<0x88>(first[0], first[1]),
                _mm512_shuffle_f64x2::<0xDD>(first[0], first[1]),
                _mm512_shuffle_f64x2::<0x88>(last[0], last[1]),
                _mm512_shuffle_f64x2::<0xDD>(last[0], last[1]),
            ]
        };
        [Self(pairs[0]), Self(pairs[1]), Self(pairs[2]), Self(pairs[3])]
    }
}

impl Eight for Whole {
    type Four = Low;
    type One = Self;
    apart! { "avx512f" }
    number_by_number! {
        8, _mm512_loadu_pd, _mm512_storeu_pd, _mm512_set1_pd, _mm512_add_pd, _mm512_sub_pd, _mm512_mul_pd,
        _mm512_div_pd, _mm512_sqrt_pd
    }
    #[inline(always)]
    fn signed(self, o: Self) -> Self {
        // SAFETY: there are such registers. Bits of `o` where the mask has some, else its own.
        Self(unsafe {
            let (own, other) = (_mm512_castpd_si512(self.0), _mm512_castpd_si512(o.0));
            let sign = _mm512_set1_epi64(i64::MIN);
            _mm512_castsi512_pd(_mm512_ternarylogic_epi64::<0xD8>(own, other, sign))
        })
    }
    #[inline(always)]
    fn transposed([a, b, c, d, e, f, g, h]: [Self; 8]) -> [Self; 8] {
        // SAFETY: there are such registers.
        let (even, odd) = unsafe {
            let (low, high) = (_mm512_unpacklo_pd, _mm512_unpackhi_pd);
            (
                [low(a.0, b.0), low(c.0, d.0), low(e.0, f.0), low(g.0, h.0)],
                [high(a.0, b.0), high(c.0, d.0), high(e.0, f.0), high(g.0, h.0)],
            )
        };
        let [a, c, e, g] = Self::transposed_pairs(even);
        let [b, d, f, h] = Self::transposed_pairs(odd);
        [a, b, c, d, e, f, g, h]
    }
    #[inline(always)]
    fn sum(self) -> f64 {
        // SAFETY: there are such registers.
        let halves =
            unsafe { [_mm512_castpd512_pd256(self.0), _mm512_extractf64x4_pd::<1>(self.0)] };
        Low(halves[0]).plus(Low(halves[1])).sum()
    }
}

impl Low {
    const fn constant(number: f64) -> Self {
        // SAFETY: four numbers are what it is.
        Self(unsafe { std::mem::transmute::<[f64; 4], __m256d>([number; 4]) })
    }
}

impl Four for Low {
    #[inline(always)]
    fn transposed_four([a, b, c, d]: [Self; 4]) -> [Self; 4] {
        // SAFETY: there are such registers.
        unsafe {
            let [p, q] = [_mm256_unpacklo_pd(a.0, b.0), _mm256_unpackhi_pd(a.0, b.0)];
            let [r, s] = [_mm256_unpacklo_pd(c.0, d.0), _mm256_unpackhi_pd(c.0, d.0)];
            [
                Self(_mm256_permute2f128_pd::<0x20>(p, r)),
                Self(_mm256_permute2f128_pd::<0x20>(q, s)),
                Self(_mm256_permute2f128_pd::<0x31>(p, r)),
                Self(_mm256_permute2f128_pd::<0x31>(q, s)),
            ]
        }
    }
}

impl Eight for Low {
    first_four! {}
    apart! { "avx2" }
    number_by_number! {
        4, _mm256_loadu_pd, _mm256_storeu_pd, _mm256_set1_pd, _mm256_add_pd, _mm256_sub_pd, _mm256_mul_pd,
        _mm256_div_pd, _mm256_sqrt_pd
    }
    #[inline(always)]
    fn signed(self, o: Self) -> Self {
        // SAFETY: there are such registers.
        Self(unsafe {
            let sign = _mm256_set1_pd(-0.0);
            _mm256_or_pd(_mm256_and_pd(sign, o.0), _mm256_andnot_pd(sign, self.0))
        })
    }
    /// The sum of halves, and of what is left.
    #[inline(always)]
    fn sum(self) -> f64 {
        // SAFETY: there are such registers.
        unsafe {
            let high = _mm256_extractf128_pd::<1>(self.0);
            let two = _mm_add_pd(_mm256_castpd256_pd128(self.0), high);
            _mm_cvtsd_f64(_mm_add_sd(two, _mm_unpackhi_pd(two, two)))
        }
    }
}

impl Pair {
    number_by_number! {
        2, _mm_loadu_pd, _mm_storeu_pd, _mm_set1_pd, _mm_add_pd, _mm_sub_pd, _mm_mul_pd, _mm_div_pd, _mm_sqrt_pd
    }

    const fn constant(number: f64) -> Self {
        // SAFETY: two numbers are what it is.
        Self(unsafe { std::mem::transmute::<[f64; 2], __m128d>([number; 2]) })
    }

    #[inline(always)]
    fn signed(self, o: Self) -> Self {
        // SAFETY: there are such registers.
        Self(unsafe {
            let sign = _mm_set1_pd(-0.0);
            _mm_or_pd(_mm_and_pd(sign, o.0), _mm_andnot_pd(sign, self.0))
        })
    }

    /// The first numbers of two, and the second ones.
    #[inline(always)]
    fn transposed([a, b]: [Self; 2]) -> [Self; 2] {
        // SAFETY: there are such registers.
        unsafe { [Self(_mm_unpacklo_pd(a.0, b.0)), Self(_mm_unpackhi_pd(a.0, b.0))] }
    }

    #[inline(always)]
    fn sum(self) -> f64 {
        // SAFETY: there are such registers.
        unsafe { _mm_cvtsd_f64(_mm_add_sd(self.0, _mm_unpackhi_pd(self.0, self.0))) }
    }
}

impl Four for Pairs {
    #[inline(always)]
    fn transposed_four([a, b, c, d]: [Self; 4]) -> [Self; 4] {
        let [p, q] = Pair::transposed([a.0[0], b.0[0]]);
        let [r, s] = Pair::transposed([c.0[0], d.0[0]]);
        let [t, u] = Pair::transposed([a.0[1], b.0[1]]);
        let [v, w] = Pair::transposed([c.0[1], d.0[1]]);
        [Self([p, r]), Self([q, s]), Self([t, v]), Self([u, w])]
    }
}

impl Eight for Pairs {
    first_four! {}
    half_by_half! { 2, Pair }
}

impl<F: Four> Eight for Halves<F> {
    type Four = F;
    type One = F;
    half_by_half! { 4, F }
    #[inline(always)]
    fn apart<R>(task: impl FnOnce() -> R) -> R {
        F::apart(task)
    }
    #[inline(always)]
    fn transposed([a, b, c, d, e, f, g, h]: [Self; 8]) -> [Self; 8] {
        let p = F::transposed_four([a.0[0], b.0[0], c.0[0], d.0[0]]);
        let q = F::transposed_four([e.0[0], f.0[0], g.0[0], h.0[0]]);
        let r = F::transposed_four([a.0[1], b.0[1], c.0[1], d.0[1]]);
        let s = F::transposed_four([e.0[1], f.0[1], g.0[1], h.0[1]]);
        let mut out = [a, b, c, d, e, f, g, h];
        unrolled!(8, i < 4, {
            (out[i], out[i + 4]) = (Self([p[i], q[i]]), Self([r[i], s[i]]));
        });
        out
    }
}
