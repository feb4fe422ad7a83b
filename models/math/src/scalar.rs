//! Numbers that the mechanics computes with: reals, and reals that carry a derivative.
//!
//! First derivatives are written out; the second-order linearization runs the same code with
//! [`Dual`] numbers, which differentiates it exactly, to round-off.

mod beside;

use std::fmt::Debug;
use std::ops::{Add, AddAssign, BitAnd, BitOr, Div, Mul, Neg, Not, Sub, SubAssign};

use crate::eights::Eight;
use crate::rows::{Block, sum_of_eight};
use crate::simd::{AVX512, has, in_avx512, wide};
use crate::trigonometry;
use crate::unrolled;

pub use beside::{Beside, Wide};
use beside::{in_one, in_plants, in_sides};

/// Operators of a type: by what they make of one or two operands, and of what they put in its place.
macro_rules! operators {
    ($generic:tt $type:ty; $($operator:ident $name:ident $operands:tt $body:tt)+) => {
        $($crate::scalar::operators!(@one $generic $type, $operator $name $operands $body);)+
    };
    (@one [$($generic:tt)*] $type:ty, $operator:ident $name:ident($a:ident) $new:block) => {
        impl<$($generic)*> $operator for $type {
            type Output = Self;
            #[inline(always)]
            fn $name(self) -> Self {
                let $a = self;
                $new
            }
        }
    };
    (@one [$($generic:tt)*] $type:ty, $operator:ident $name:ident($a:ident, $b:ident: $right:ty) $new:block) => {
        impl<$($generic)*> $operator<$right> for $type {
            type Output = Self;
            #[inline(always)]
            fn $name(self, $b: $right) -> Self {
                let $a = self;
                $new
            }
        }
    };
    (@one [$($generic:tt)*] $type:ty, $operator:ident $name:ident(mut $a:ident, $b:ident) $own:block) => {
        impl<$($generic)*> $operator for $type {
            #[inline(always)]
            fn $name(&mut self, $b: Self) {
                let $a = self;
                *$a = $own;
            }
        }
    };
}
pub(crate) use operators;

/// What [`Scalar`] says of numbers side by side, of a type that has none.
macro_rules! nothing_beside {
    () => {
        #[inline(always)]
        fn alone<T: $crate::scalar::Beside<Self>>(task: T) -> T::Output {
            task.run::<Self>()
        }
        type Several = Self;
        type Row = [Self; 8];
        const BESIDE: usize = 1;
        #[inline(always)]
        fn one(several: &Self, _: usize) -> Self {
            *several
        }
        #[inline(always)]
        fn put(self, several: &mut Self, _: usize) {
            *several = self;
        }
        #[inline(always)]
        fn entry(row: &[Self; 8], k: usize) -> Self {
            row[k]
        }
        #[inline(always)]
        fn dot(a: &[Self; 8], b: &[Self; 8]) -> Self {
            let mut products = *a;
            for (product, b) in products.iter_mut().zip(b) {
                *product = *product * *b;
            }
            sum_of_eight(products)
        }
        #[inline(always)]
        fn dot_of_six(a: &[Self; 8], b: &[Self; 8]) -> Self {
            let product = |k: usize| a[k] * b[k];
            let half = |k: usize| product(k) + product(k + 4);
            (half(0) + product(2)) + (half(1) + product(3))
        }
    };
}
pub(crate) use nothing_beside;

/// [`wide!`] in registers as wide as suits a type of numbers ([`Scalar::in_registers`]).
#[macro_export]
macro_rules! in_registers {
    ($number:ty, $body:block) => {
        // A block in a block would be handed on once more.
        if <$number as $crate::scalar::Scalar>::IS_SEVERAL {
            <$number as $crate::scalar::Scalar>::in_registers(
                #[inline(always)]
                move || $body,
            )
        } else {
            $crate::simd::wide!($body)
        }
    };
}
pub use in_registers;

/// A real number, or one that carries derivatives.
pub trait Scalar:
    Copy
    + Debug
    + Default
    + PartialEq
    + 'static
    + Neg<Output = Self>
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Add<f64, Output = Self>
    + Sub<f64, Output = Self>
    + Mul<f64, Output = Self>
    + AddAssign
    + SubAssign
{
    /// The number 0.
    const ZERO: Self;
    /// The number 1.
    const ONE: Self;
    /// A constant: its derivatives are zero.
    fn constant(value: f64) -> Self;
    /// The real part.
    fn value(self) -> f64;
    /// What magnitudes are: reals, as many side by side.
    type Magnitude: Scalar;
    /// The magnitude of the real part.
    fn magnitude(self) -> Self::Magnitude;
    /// Whether it is several numbers side by side: then all code pays in wide registers.
    const IS_SEVERAL: bool = false;
    /// Runs a block in registers that suit these numbers; see [`wide!`].
    #[inline(always)]
    fn in_registers<R>(block: impl FnOnce() -> R) -> R {
        wide!({ block() })
    }
    /// Several of these numbers side by side, in memory, where that is faster: eight reals, or the number itself.
    type Several: Copy + Default + Debug;
    /// How many those are.
    const BESIDE: usize;
    /// Eight numbers that belong together, in memory.
    type Row: Copy + Default + Debug;
    /// One of them.
    fn one(several: &Self::Several, lane: usize) -> Self;
    /// Replaces one of them.
    fn put(self, several: &mut Self::Several, lane: usize);
    /// One of the numbers of a row.
    fn entry(row: &Self::Row, k: usize) -> Self;
    /// The sum of the products of two rows.
    fn dot(a: &Self::Row, b: &Self::Row) -> Self;
    /// The same, where the last two numbers of one of them are zero.
    fn dot_of_six(a: &Self::Row, b: &Self::Row) -> Self;
    /// Does what is done with numbers side by side, so many of which are in a list.
    fn beside<T: Beside<Self>>(count: usize, task: T) -> T::Output;
    /// The same for one number, in the code of the caller.
    fn alone<T: Beside<Self>>(task: T) -> T::Output;
    /// `(sin x, cos x)`.
    fn sin_cos(self) -> (Self, Self);
    /// Writes `sin x` and `cos x` of each.
    #[inline(always)]
    fn sin_cos_of_all(x: &[Self], out: &mut [[Self; 2]]) {
        for (x, out) in x.iter().zip(out) {
            *out = x.sin_cos().into();
        }
    }
    /// `√x`; not differentiable at zero.
    fn sqrt(self) -> Self;
    /// `1 / x`.
    fn recip(self) -> Self;
    /// `√x` and `1 / √x`; both are zero, and constant, where `x` is.
    fn roots(self) -> [Self; 2];
    /// `tanh x`.
    fn tanh(self) -> Self;
    /// With the sign of another number.
    fn signed(self, o: Self) -> Self;
}

impl Scalar for f64 {
    type Several = Block;
    type Row = Block;
    const BESIDE: usize = 8;
    #[inline(always)]
    fn one(several: &Block, lane: usize) -> Self {
        several.0[lane]
    }
    #[inline(always)]
    fn put(self, several: &mut Block, lane: usize) {
        several.0[lane] = self;
    }
    #[inline(always)]
    fn entry(row: &Block, k: usize) -> Self {
        row.0[k]
    }
    #[inline(always)]
    fn dot(a: &Block, b: &Block) -> Self {
        Eight::dot(*a, *b)
    }
    #[inline(always)]
    fn dot_of_six(a: &Block, b: &Block) -> Self {
        Eight::dot(*a, *b)
    }
    #[inline(always)]
    fn beside<T: Beside<Self>>(count: usize, task: T) -> T::Output {
        in_sides(count, task)
    }
    #[inline(always)]
    fn alone<T: Beside<Self>>(task: T) -> T::Output {
        in_one(task)
    }
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;
    #[inline(always)]
    fn constant(value: f64) -> Self {
        value
    }
    #[inline(always)]
    fn value(self) -> f64 {
        self
    }
    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        trigonometry::sin_cos_of(self)
    }
    #[inline(always)]
    fn sin_cos_of_all(x: &[Self], out: &mut [[Self; 2]]) {
        trigonometry::sin_cos(x, out);
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.sqrt()
    }
    #[inline(always)]
    fn recip(self) -> Self {
        self.recip()
    }
    type Magnitude = Self;
    #[inline(always)]
    fn magnitude(self) -> Self {
        self.abs()
    }
    #[inline(always)]
    fn roots(self) -> [Self; 2] {
        let root = self.sqrt();
        [root, if self == 0.0 { 0.0 } else { root.recip() }]
    }
    #[inline(always)]
    fn tanh(self) -> Self {
        libm::tanh(self)
    }
    #[inline(always)]
    fn signed(self, o: Self) -> Self {
        self.copysign(o)
    }
}

/// `re + eps ε` with `ε² = 0`: a value and its derivative along one direction. Nested, it carries
/// mixed derivatives along several.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Dual<S = f64> {
    /// The value.
    pub re: S,
    /// Its derivative along the direction.
    pub eps: S,
}

impl<S: Scalar> Dual<S> {
    /// The number `re + ε eps`.
    #[inline(always)]
    pub fn new(re: S, eps: S) -> Self {
        Self { re, eps }
    }
}

impl<S: Scalar> Scalar for Dual<S> {
    nothing_beside! {}
    #[inline(always)]
    fn beside<T: Beside<Self>>(_: usize, task: T) -> T::Output {
        Self::in_registers(|| task.run::<Self>())
    }
    const ZERO: Self = Self { re: S::ZERO, eps: S::ZERO };
    const ONE: Self = Self { re: S::ONE, eps: S::ZERO };
    #[inline(always)]
    fn constant(value: f64) -> Self {
        Self { re: S::constant(value), eps: S::ZERO }
    }
    #[inline(always)]
    fn value(self) -> f64 {
        self.re.value()
    }
    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        let (s, c) = self.re.sin_cos();
        (Self::new(s, c * self.eps), Self::new(c, -(s * self.eps)))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        let root = self.re.sqrt();
        Self::new(root, self.eps * root.recip() * 0.5)
    }
    type Magnitude = S::Magnitude;
    #[inline(always)]
    fn magnitude(self) -> S::Magnitude {
        self.re.magnitude()
    }
    #[inline(always)]
    fn roots(self) -> [Self; 2] {
        let [root, inverse] = self.re.roots();
        let slope = self.eps * inverse * 0.5;
        [Self::new(root, slope), Self::new(inverse, -(slope * inverse * inverse))]
    }
    #[inline(always)]
    fn recip(self) -> Self {
        let inverse = self.re.recip();
        Self::new(inverse, -(self.eps * inverse * inverse))
    }
    #[inline(always)]
    fn tanh(self) -> Self {
        let t = self.re.tanh();
        Self::new(t, self.eps * (S::ONE - t * t))
    }
    #[inline(always)]
    fn signed(self, o: Self) -> Self {
        let sign = S::ONE.signed(self.re) * S::ONE.signed(o.re);
        Self::new(self.re * sign, self.eps * sign)
    }
}

operators! { [S: Scalar] Dual<S>;
    Neg neg(a) { Self::new(-a.re, -a.eps) }
    Add add(a, b: Self) { Self::new(a.re + b.re, a.eps + b.eps) }
    Sub sub(a, b: Self) { Self::new(a.re - b.re, a.eps - b.eps) }
    Mul mul(a, b: Self) { Self::new(a.re * b.re, a.re * b.eps + a.eps * b.re) }
    Add add(a, b: f64) { Self::new(a.re + b, a.eps) }
    Sub sub(a, b: f64) { Self::new(a.re - b, a.eps) }
    Mul mul(a, b: f64) { Self::new(a.re * b, a.eps * b) }
    AddAssign add_assign(mut a, b) { *a + b }
    SubAssign sub_assign(mut a, b) { *a - b }
}

/// Numbers side by side, for the same computation on each.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(align(32))]
pub struct LanesOf<const N: usize>(pub [f64; N]);

/// Four numbers side by side: a register's worth.
pub type Lanes = LanesOf<4>;

impl<const N: usize> Default for LanesOf<N> {
    fn default() -> Self {
        Self::ZERO
    }
}

impl<const N: usize> LanesOf<N> {
    /// How many numbers stand side by side.
    pub const COUNT: usize = N;

    /// The first numbers of a list; those that it does not have are zero.
    #[inline(always)]
    pub fn load_some(list: &[f64]) -> Self {
        match list.first_chunk() {
            Some(all) => Self(*all),
            None => {
                let mut lanes = [0.0; N];
                lanes.iter_mut().zip(list).for_each(|(lane, x)| *lane = *x);
                Self(lanes)
            }
        }
    }

    /// Replaces the first numbers of a list, as many as there are.
    #[inline(always)]
    pub fn store_some(self, list: &mut [f64]) {
        match list.first_chunk_mut() {
            Some(all) => *all = self.0,
            None => list.iter_mut().zip(self.0).for_each(|(x, lane)| *x = lane),
        }
    }

    /// The largest of the numbers.
    #[inline(always)]
    pub fn largest(self) -> f64 {
        const { assert!(N.is_power_of_two()) };
        let (mut lanes, mut half) = (self.0, N);
        while half > 1 {
            half /= 2;
            for lane in 0..half {
                let other = lanes[lane + half];
                lanes[lane] = if other > lanes[lane] { other } else { lanes[lane] };
            }
        }
        lanes[0]
    }

    #[inline(always)]
    fn each(mut self, f: impl Fn(f64) -> f64) -> Self {
        unrolled!(8, i < N, { self.0[i] = f(self.0[i]) });
        self
    }

    #[inline(always)]
    fn with(mut self, other: Self, f: impl Fn(f64, f64) -> f64) -> Self {
        unrolled!(8, i < N, { self.0[i] = f(self.0[i], other.0[i]) });
        self
    }

    #[inline(always)]
    fn compare(self, other: Self, f: impl Fn(f64, f64) -> bool) -> Truths<N> {
        let mut truths = const { [0; N] };
        unrolled!(8, i < N, {
            truths[i] = if f(self.0[i], other.0[i]) { u64::MAX } else { 0 };
        });
        Truths(truths)
    }
}

impl<const N: usize> Scalar for LanesOf<N> {
    nothing_beside! {}
    #[inline(always)]
    fn beside<T: Beside<Self>>(_: usize, task: T) -> T::Output {
        in_plants(task)
    }
    const ZERO: Self = Self([0.0; N]);
    const ONE: Self = Self([1.0; N]);
    const IS_SEVERAL: bool = true;
    #[inline(always)]
    fn constant(value: f64) -> Self {
        let mut lanes = Self::ZERO;
        unrolled!(8, i < N, { lanes.0[i] = value });
        lanes
    }
    #[inline(always)]
    fn in_registers<R>(block: impl FnOnce() -> R) -> R {
        if N > Lanes::COUNT && has(AVX512) { in_avx512(block) } else { wide!({ block() }) }
    }
    /// Of the first: nothing that branches on it may run on several numbers.
    #[inline(always)]
    fn value(self) -> f64 {
        self.0[0]
    }
    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        let [s, c] = trigonometry::sin_cos_of_several(self.0);
        (Self(s), Self(c))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.each(f64::sqrt)
    }
    #[inline(always)]
    fn recip(self) -> Self {
        self.each(f64::recip)
    }
    #[inline(always)]
    fn roots(self) -> [Self; 2] {
        [self.each(f64::sqrt), self.each(|x| x.roots()[1])]
    }
    type Magnitude = Self;
    #[inline(always)]
    fn magnitude(self) -> Self {
        self.each(f64::abs)
    }
    #[inline(always)]
    fn tanh(self) -> Self {
        self.each(libm::tanh)
    }
    #[inline(always)]
    fn signed(self, o: Self) -> Self {
        self.with(o, f64::copysign)
    }
}

/// Reals, one or several side by side, that are compared and chosen from one by one.
pub trait Compared: Scalar + Div<Output = Self> + Div<f64, Output = Self> {
    /// What comparisons say.
    type Truth: Copy
        + Debug
        + BitAnd<Output = Self::Truth>
        + BitOr<Output = Self::Truth>
        + Not<Output = Self::Truth>;
    /// The same of all.
    fn all(truth: bool) -> Self::Truth;
    /// Whether it is so of one at least.
    fn any(truth: Self::Truth) -> bool;
    /// `self < other`.
    fn less(self, other: Self) -> Self::Truth;
    /// `self <= other`.
    fn at_most(self, other: Self) -> Self::Truth;
    /// One number where it is true, the other where it is not.
    fn choose(truth: Self::Truth, yes: Self, no: Self) -> Self;
    /// The magnitude.
    fn abs(self) -> Self;
    /// The larger one; a NaN is none.
    fn max(self, other: Self) -> Self;
}

impl Compared for f64 {
    type Truth = bool;
    #[inline(always)]
    fn all(truth: bool) -> bool {
        truth
    }
    #[inline(always)]
    fn any(truth: bool) -> bool {
        truth
    }
    #[inline(always)]
    fn less(self, other: Self) -> bool {
        self < other
    }
    #[inline(always)]
    fn at_most(self, other: Self) -> bool {
        self <= other
    }
    #[inline(always)]
    fn choose(truth: bool, yes: Self, no: Self) -> Self {
        if truth { yes } else { no }
    }
    #[inline(always)]
    fn abs(self) -> Self {
        self.abs()
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.max(other)
    }
}

/// What is true of numbers side by side: all bits of one are set, or none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(align(32))]
pub struct Truths<const N: usize>(pub [u64; N]);

impl<const N: usize> Truths<N> {
    /// What is true of one.
    #[inline(always)]
    pub fn of(&self, lane: usize) -> bool {
        self.0[lane] != 0
    }
    #[inline(always)]
    fn with(mut self, other: Self, f: impl Fn(u64, u64) -> u64) -> Self {
        unrolled!(8, i < N, { self.0[i] = f(self.0[i], other.0[i]) });
        self
    }
}

impl<const N: usize> BitAnd for Truths<N> {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        self.with(other, |x, y| x & y)
    }
}

impl<const N: usize> BitOr for Truths<N> {
    type Output = Self;
    #[inline(always)]
    fn bitor(self, other: Self) -> Self {
        self.with(other, |x, y| x | y)
    }
}

impl<const N: usize> Not for Truths<N> {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        self.with(self, |x, _| !x)
    }
}

impl<const N: usize> Compared for LanesOf<N> {
    type Truth = Truths<N>;
    #[inline(always)]
    fn all(truth: bool) -> Truths<N> {
        if truth { const { Truths([u64::MAX; N]) } } else { const { Truths([0; N]) } }
    }
    #[inline(always)]
    fn any(truth: Truths<N>) -> bool {
        truth.0.into_iter().fold(0, |any, one| any | one) != 0
    }
    #[inline(always)]
    fn less(self, other: Self) -> Truths<N> {
        self.compare(other, |x, y| x < y)
    }
    #[inline(always)]
    fn at_most(self, other: Self) -> Truths<N> {
        self.compare(other, |x, y| x <= y)
    }
    #[inline(always)]
    fn choose(truth: Truths<N>, yes: Self, no: Self) -> Self {
        let mut chosen = no;
        unrolled!(8, i < N, {
            let [yes, no] = [yes.0[i].to_bits(), no.0[i].to_bits()];
            chosen.0[i] = f64::from_bits((yes & truth.0[i]) | (no & !truth.0[i]));
        });
        chosen
    }
    #[inline(always)]
    fn abs(self) -> Self {
        self.each(f64::abs)
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.with(other, f64::max)
    }
}

/// One number, or several side by side, of a list.
pub trait Side: Scalar {
    /// The first of the list.
    fn load(list: &[f64]) -> Self;
    /// Replaces the first of the list.
    fn store(self, list: &mut [f64]);
    /// [`trigonometry::unwound`].
    fn unwound(angle: Self, more: Self, per_radian: Self) -> Self;
}

/// Computes the entries of lists from those of other lists of the same length, four at a time, then those
/// that are left. Reading comes before writing, so that compilers need not know that lists do not overlap.
/// A macro, because steps of chains took 12 % longer with a generic function for each entry, and 15 % with a
/// trait of such functions.
#[macro_export]
macro_rules! side_by_side {
    (for ($($x:ident in $from:expr),+ $(,)?) let $local:pat = $value:expr; {
        $($out:ident($to:expr) = $result:expr;)+
    }) => {{
        $(let $x = <[f64]>::as_chunks::<{ $crate::scalar::Lanes::COUNT }>($from);)+
        $(let $out = <[f64]>::as_chunks_mut::<{ $crate::scalar::Lanes::COUNT }>($to);)+
        let (lanes, rest) = [$(($x.0.len(), $x.1.len())),+][0];
        for i in 0..lanes {
            $(let $x = $crate::scalar::LanesOf($x.0[i]);)+
            let $local = $value;
            $($out.0[i] = ($result).0;)+
        }
        for i in 0..rest {
            $(let $x = $x.1[i];)+
            let $local = $value;
            $($out.1[i] = $result;)+
        }
    }};
}
pub use side_by_side;

impl Side for f64 {
    #[inline(always)]
    fn load(list: &[f64]) -> Self {
        list[0]
    }
    #[inline(always)]
    fn store(self, list: &mut [f64]) {
        list[0] = self;
    }
    #[inline(always)]
    fn unwound(angle: Self, more: Self, per_radian: Self) -> Self {
        trigonometry::unwound(angle, more, per_radian)
    }
}

impl<const N: usize> Side for LanesOf<N> {
    #[inline(always)]
    fn load(list: &[f64]) -> Self {
        let mut lanes = [0.0; N];
        lanes.copy_from_slice(&list[..N]);
        Self(lanes)
    }
    #[inline(always)]
    fn store(self, list: &mut [f64]) {
        list[..N].copy_from_slice(&self.0);
    }
    #[inline(always)]
    fn unwound(angle: Self, more: Self, per_radian: Self) -> Self {
        let mut unwound = angle;
        for (i, angle) in unwound.0.iter_mut().enumerate() {
            *angle = trigonometry::unwound(*angle, more.0[i], per_radian.0[i]);
        }
        unwound
    }
}

operators! { [const N: usize] LanesOf<N>;
    Neg neg(a) { a.each(|x| -x) }
    Add add(a, b: Self) { a.with(b, |x, y| x + y) }
    Sub sub(a, b: Self) { a.with(b, |x, y| x - y) }
    Mul mul(a, b: Self) { a.with(b, |x, y| x * y) }
    Add add(a, b: f64) { a.each(|x| x + b) }
    Sub sub(a, b: f64) { a.each(|x| x - b) }
    Mul mul(a, b: f64) { a.each(|x| x * b) }
    Div div(a, b: Self) { a.with(b, |x, y| x / y) }
    Div div(a, b: f64) { a.each(|x| x / b) }
    AddAssign add_assign(mut a, b) { *a + b }
    SubAssign sub_assign(mut a, b) { *a - b }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Second and mixed derivatives of a function of two variables against closed forms.
    #[test]
    fn nested_dual_numbers_carry_mixed_derivatives() {
        fn f<S: Scalar>(x: S, y: S) -> S {
            let (s, c) = (x * y).sin_cos();
            (s + 2.0).sqrt() * (c + 3.0).recip() + x.tanh() * y
        }
        let (x, y) = (0.7, -0.4);
        let g = |x: f64, y: f64| {
            // ∂f/∂x by hand.
            let (s, c) = (x * y).sin_cos();
            let root = (s + 2.0).sqrt();
            y * c / (2.0 * root * (c + 3.0))
                + root * y * s / (c + 3.0).powi(2)
                + y * (1.0 - x.tanh().powi(2))
        };
        let xx = Dual::new(Dual::new(x, 1.0), Dual::new(0.0, 0.0));
        let yy = Dual::new(Dual::new(y, 0.0), Dual::new(1.0, 0.0));
        let value = f(xx, yy);
        assert!((value.re.eps - g(x, y)).abs() < 1e-15);
        let delta = 1e-3;
        let stencil =
            [(-2.0, 1.0 / 12.0), (-1.0, -2.0 / 3.0), (1.0, 2.0 / 3.0), (2.0, -1.0 / 12.0)];
        let mixed: f64 = stencil.iter().map(|(k, w)| w / delta * g(x, y + k * delta)).sum();
        assert!((value.eps.eps - mixed).abs() < 1e-12);
        for (x, sign) in [(0.7, -0.4), (-0.2, 1.5), (-1.0, -0.3)] {
            let signed = Dual::new(x, 1.0).signed(Dual::new(sign, 5.0));
            let slope = if x * sign < 0.0 { -1.0 } else { 1.0 };
            assert_eq!(signed, Dual::new(x.copysign(sign), slope));
        }
    }
}
