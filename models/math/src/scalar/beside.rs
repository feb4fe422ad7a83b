//! Several numbers of a kind side by side in registers: eight reals, or one number of each of several plants.
//!
//! What is computed alike for all entries of a list is written once, for [`Wide`] numbers, and [`Scalar::beside`] does
//! it for as many as the processor has registers for.

use std::fmt::{self, Debug, Formatter};
use std::marker::PhantomData;
use std::ops::{Add, AddAssign, Mul, Neg, Sub, SubAssign};

use crate::eights::{Eight, InEights, in_eights};
use crate::rows::{Block, LANES, sum_of_eight};
use crate::scalar::{Dual, LanesOf, Scalar, nothing_beside, operators};
use crate::simd::{AVX512, has};

/// Numbers side by side in registers. In memory [`Scalar::Several`] lie beside each other: as many, or more.
pub trait Wide<S: Scalar>: Scalar {
    /// How many.
    const COUNT: usize = 1;
    /// From memory, those from a lane on.
    fn load(several: &S::Several, lane: usize) -> Self;
    /// To memory.
    fn store(self, several: &mut S::Several, lane: usize);
    /// Constants from a lane on.
    fn constants(eight: &Block, lane: usize) -> Self;
    /// The first numbers of a list.
    fn first_of(list: &[S]) -> Self;
    /// The same number everywhere.
    fn of_one(number: &S) -> Self;
    /// A row in registers.
    type Line: Copy;
    /// From memory.
    fn row(row: &S::Row) -> Self::Line;
    /// To memory.
    fn put_row(row: Self::Line, to: &mut S::Row);
    /// The sum, number by number.
    fn sum(a: Self::Line, b: Self::Line) -> Self::Line;
    /// All numbers times a factor.
    fn scaled(line: Self::Line, factor: S) -> Self::Line;
    /// The sum of the products of two lines.
    fn dot_of(a: Self::Line, b: Self::Line) -> S;
    /// The sum of the products of two lines, and of two more.
    fn dots(a: [Self::Line; 2], b: [Self::Line; 2]) -> S;
    /// Whether [`Wide::subtract`] takes four numbers in one operation: then lists are whole fours, as many in each.
    const TAKES_FOURS: bool = false;
    /// Subtracts from each number of two lists that of two others, times a factor each.
    fn subtract(factors: [S; 2], sources: [&[S]; 2], targets: [&mut [S]; 2]);
    /// Three numbers that belong together.
    type Triple: Copy;
    /// From memory.
    fn triple(numbers: &[S; 3]) -> Self::Triple;
    /// To memory.
    fn put_triple(triple: Self::Triple, to: &mut [S; 3]);
    /// The sum, number by number.
    fn triple_sum(a: Self::Triple, b: Self::Triple) -> Self::Triple;
    /// All numbers times a factor.
    fn triple_scaled(triple: Self::Triple, factor: S) -> Self::Triple;
    /// All numbers times a constant.
    fn triple_times(triple: Self::Triple, factor: f64) -> Self::Triple;
    /// To rows, of which there are [`Self::COUNT`]: each gets one of all eight.
    fn spread(numbers: [Self; 8], rows: &mut [S::Row]);
    /// The way back.
    fn collect(rows: &[S::Row]) -> [Self; 8];
    /// [`Wide::spread`] to the rows that are named.
    fn spread_to(numbers: [Self; 8], rows: &mut [S::Row], of: &[usize]);
    /// [`Wide::collect`] from the rows that are named.
    fn collect_from(rows: &[S::Row], of: &[usize]) -> [Self; 8];
}

/// What is done with numbers side by side.
pub trait Beside<S: Scalar> {
    /// What comes out.
    type Output;
    /// Does it. Always inlined, as is all that works on these numbers in it.
    fn run<W: Wide<S>>(self) -> Self::Output;
}

/// Numbers that lie alone: nothing is beside them.
macro_rules! alone {
    ([$($generic:tt)*] $type:ty) => {
        impl<$($generic)*> Wide<Self> for $type {
            type Line = [Self; 8];
            #[inline(always)]
            fn subtract(factors: [Self; 2], sources: [&[Self]; 2], targets: [&mut [Self]; 2]) {
                for ((target, source), factor) in targets.into_iter().zip(sources).zip(factors) {
                    for (t, s) in target.iter_mut().zip(source) {
                        *t -= factor * *s;
                    }
                }
            }
            type Triple = [Self; 3];
            #[inline(always)]
            fn triple(numbers: &[Self; 3]) -> [Self; 3] {
                *numbers
            }
            #[inline(always)]
            fn put_triple(triple: [Self; 3], to: &mut [Self; 3]) {
                *to = triple;
            }
            #[inline(always)]
            fn triple_sum([a, b, c]: [Self; 3], [d, e, f]: [Self; 3]) -> [Self; 3] {
                [a + d, b + e, c + f]
            }
            #[inline(always)]
            fn triple_scaled([a, b, c]: [Self; 3], factor: Self) -> [Self; 3] {
                [a * factor, b * factor, c * factor]
            }
            #[inline(always)]
            fn triple_times([a, b, c]: [Self; 3], factor: f64) -> [Self; 3] {
                [a * factor, b * factor, c * factor]
            }
            #[inline(always)]
            fn load(several: &Self, _: usize) -> Self {
                *several
            }
            #[inline(always)]
            fn store(self, several: &mut Self, _: usize) {
                *several = self;
            }
            #[inline(always)]
            fn first_of(list: &[Self]) -> Self {
                list[0]
            }
            #[inline(always)]
            fn constants(eight: &Block, lane: usize) -> Self {
                Self::constant(eight.0[lane])
            }
            #[inline(always)]
            fn of_one(number: &Self) -> Self {
                *number
            }
            #[inline(always)]
            fn row(row: &[Self; 8]) -> [Self; 8] {
                *row
            }
            #[inline(always)]
            fn put_row(row: [Self; 8], to: &mut [Self; 8]) {
                *to = row;
            }
            #[inline(always)]
            fn sum(mut a: [Self; 8], b: [Self; 8]) -> [Self; 8] {
                for (a, b) in a.iter_mut().zip(b) {
                    *a += b;
                }
                a
            }
            #[inline(always)]
            fn scaled(mut line: [Self; 8], factor: Self) -> [Self; 8] {
                for number in &mut line {
                    *number = *number * factor;
                }
                line
            }
            #[inline(always)]
            fn dot_of(a: [Self; 8], b: [Self; 8]) -> Self {
                Self::dot(&a, &b)
            }
            #[inline(always)]
            fn dots([a, b]: [[Self; 8]; 2], [c, d]: [[Self; 8]; 2]) -> Self {
                let mut products = a;
                for (k, product) in products.iter_mut().enumerate() {
                    *product = a[k] * b[k] + c[k] * d[k];
                }
                sum_of_eight(products)
            }
            #[inline(always)]
            fn spread(numbers: [Self; 8], rows: &mut [[Self; 8]]) {
                rows[0] = numbers;
            }
            #[inline(always)]
            fn collect(rows: &[[Self; 8]]) -> [Self; 8] {
                rows[0]
            }
            #[inline(always)]
            fn spread_to(numbers: [Self; 8], rows: &mut [[Self; 8]], of: &[usize]) {
                rows[of[0]] = numbers;
            }
            #[inline(always)]
            fn collect_from(rows: &[[Self; 8]], of: &[usize]) -> [Self; 8] {
                rows[of[0]]
            }
        }
    };
}

alone! { [S: Scalar] Dual<S> }
alone! { [const N: usize] LanesOf<N> }

/// Eight numbers that are computed with as one is, number by number; rows are computed with as `L`.
#[derive(Clone, Copy)]
pub(super) struct Sides<E, L>(E, PhantomData<L>);

impl<E: Eight, L: Eight> Sides<E, L> {
    #[inline(always)]
    fn new(numbers: E) -> Self {
        Self(numbers, PhantomData)
    }

    /// A lane with which registers begin.
    #[inline(always)]
    fn from_lane(lane: usize) -> usize {
        lane & (LANES - E::COUNT)
    }

    #[inline(always)]
    fn of_plants<const N: usize>(numbers: &LanesOf<N>) -> Self {
        Self::new(E::of_list(&numbers.0))
    }

    #[inline(always)]
    fn put_plants<const N: usize>(self, to: &mut LanesOf<N>) {
        self.0.put_list(&mut to.0);
    }

    #[inline(always)]
    fn block(self) -> Block {
        let mut block = Block::ZERO;
        self.0.put(&mut block);
        block
    }

    fn each(self, of: impl Fn(f64) -> f64) -> Self {
        Self::new(E::of(&Block(self.block().0.map(of))))
    }
}

impl<E: Eight, L: Eight> Default for Sides<E, L> {
    #[inline(always)]
    fn default() -> Self {
        Self::new(E::all(0.0))
    }
}

impl<E: Eight, L: Eight> PartialEq for Sides<E, L> {
    fn eq(&self, other: &Self) -> bool {
        self.block().0 == other.block().0
    }
}

impl<E: Eight, L: Eight> Debug for Sides<E, L> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        self.block().fmt(f)
    }
}

operators! { [E: Eight, L: Eight] Sides<E, L>;
    Neg neg(a) { Self::new(E::all(-0.0).minus(a.0)) }
    Add add(a, b: Self) { Self::new(a.0.plus(b.0)) }
    Sub sub(a, b: Self) { Self::new(a.0.minus(b.0)) }
    Mul mul(a, b: Self) { Self::new(a.0.times(b.0)) }
    Add add(a, b: f64) { Self::new(a.0.plus(E::all(b))) }
    Sub sub(a, b: f64) { Self::new(a.0.minus(E::all(b))) }
    Mul mul(a, b: f64) { Self::new(a.0.scaled(b)) }
    AddAssign add_assign(mut a, b) { *a + b }
    SubAssign sub_assign(mut a, b) { *a - b }
}

impl<E: Eight, L: Eight> Scalar for Sides<E, L> {
    nothing_beside! {}
    const ZERO: Self = Self(E::ZERO, PhantomData);
    const ONE: Self = Self(E::ONE, PhantomData);
    const IS_SEVERAL: bool = true;
    #[inline(always)]
    fn beside<T: Beside<Self>>(_: usize, task: T) -> T::Output {
        task.run::<Self>()
    }
    #[inline(always)]
    fn constant(value: f64) -> Self {
        Self::new(E::all(value))
    }
    #[inline(always)]
    fn value(self) -> f64 {
        self.block().0[0]
    }
    fn sin_cos(self) -> (Self, Self) {
        (self.each(|x| x.sin_cos().0), self.each(|x| x.sin_cos().1))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self::new(self.0.sqrt())
    }
    #[inline(always)]
    fn recip(self) -> Self {
        Self::new(E::ONE.over(self.0))
    }
    fn roots(self) -> [Self; 2] {
        [self.sqrt(), self.each(|x| x.roots()[1])]
    }
    type Magnitude = Self;
    #[inline(always)]
    fn magnitude(self) -> Self {
        self.signed(Self::ONE)
    }
    fn tanh(self) -> Self {
        self.each(libm::tanh)
    }
    #[inline(always)]
    fn signed(self, o: Self) -> Self {
        Self::new(self.0.signed(o.0))
    }
}

alone! { [E: Eight, L: Eight] Sides<E, L> }

impl<E: Eight, L: Eight> Wide<f64> for Sides<E, L> {
    const COUNT: usize = E::COUNT;
    #[inline(always)]
    fn load(several: &Block, lane: usize) -> Self {
        Self::new(E::of_list(&several.0[Self::from_lane(lane)..]))
    }
    #[inline(always)]
    fn store(self, several: &mut Block, lane: usize) {
        self.0.put_list(&mut several.0[Self::from_lane(lane)..]);
    }
    #[inline(always)]
    fn constants(eight: &Block, lane: usize) -> Self {
        <Self as Wide<f64>>::load(eight, lane)
    }
    #[inline(always)]
    fn first_of(list: &[f64]) -> Self {
        Self::new(E::of_list(list))
    }
    #[inline(always)]
    fn of_one(number: &f64) -> Self {
        Self::new(E::all(*number))
    }
    type Line = L;
    const TAKES_FOURS: bool = E::COUNT > 1;
    #[inline(always)]
    fn subtract([l, u]: [f64; 2], sources: [&[f64]; 2], targets: [&mut [f64]; 2]) {
        if !<Self as Wide<f64>>::TAKES_FOURS {
            for ((target, source), factor) in targets.into_iter().zip(sources).zip([l, u]) {
                for (t, s) in target.iter_mut().zip(source) {
                    *t -= factor * *s;
                }
            }
            return;
        }
        let (l, u) = (L::Four::all(l), L::Four::all(u));
        let ([p, q], [r, s]) = (targets, sources);
        let first = p.as_chunks_mut::<4>().0.iter_mut().zip(r.as_chunks::<4>().0);
        let second = q.as_chunks_mut::<4>().0.iter_mut().zip(s.as_chunks::<4>().0);
        for ((p, r), (q, s)) in first.zip(second) {
            let product = L::Four::of_list(r).times(l);
            L::Four::of_list(p).minus(product).put_list(p);
            let product = L::Four::of_list(s).times(u);
            L::Four::of_list(q).minus(product).put_list(q);
        }
    }
    type Triple = L::Four;
    #[inline(always)]
    fn triple([x, y, z]: &[f64; 3]) -> L::Four {
        L::Four::of_list(&[*x, *y, *z, 0.0])
    }
    #[inline(always)]
    fn put_triple(triple: L::Four, to: &mut [f64; 3]) {
        let mut four = [0.0; 4];
        triple.put_list(&mut four);
        to.copy_from_slice(&four[..3]);
    }
    #[inline(always)]
    fn triple_sum(a: L::Four, b: L::Four) -> L::Four {
        a.plus(b)
    }
    #[inline(always)]
    fn triple_scaled(triple: L::Four, factor: f64) -> L::Four {
        triple.scaled(factor)
    }
    #[inline(always)]
    fn triple_times(triple: L::Four, factor: f64) -> L::Four {
        triple.scaled(factor)
    }
    #[inline(always)]
    fn row(row: &Block) -> L {
        L::of(row)
    }
    #[inline(always)]
    fn put_row(row: L, to: &mut Block) {
        row.put(to);
    }
    #[inline(always)]
    fn sum(a: L, b: L) -> L {
        a.plus(b)
    }
    #[inline(always)]
    fn scaled(line: L, factor: f64) -> L {
        line.scaled(factor)
    }
    #[inline(always)]
    fn dot_of(a: L, b: L) -> f64 {
        a.dot(b)
    }
    #[inline(always)]
    fn dots([a, b]: [L; 2], [c, d]: [L; 2]) -> f64 {
        a.times(b).plus(c.times(d)).sum()
    }
    #[inline(always)]
    fn spread([a, b, c, d, e, f, g, h]: [Self; 8], rows: &mut [Block]) {
        E::spread([a.0, b.0, c.0, d.0, e.0, f.0, g.0, h.0], rows);
    }
    #[inline(always)]
    fn collect(rows: &[Block]) -> [Self; 8] {
        of_eights(E::collect(rows))
    }
    #[inline(always)]
    fn spread_to([a, b, c, d, e, f, g, h]: [Self; 8], rows: &mut [Block], of: &[usize]) {
        E::spread_to([a.0, b.0, c.0, d.0, e.0, f.0, g.0, h.0], rows, of);
    }
    #[inline(always)]
    fn collect_from(rows: &[Block], of: &[usize]) -> [Self; 8] {
        of_eights(E::collect_from(rows, of))
    }
}

#[inline(always)]
fn of_eights<E: Eight, L: Eight>(eights: [E; 8]) -> [Sides<E, L>; 8] {
    let mut out = [Sides(E::ZERO, PhantomData); 8];
    for (out, own) in out.iter_mut().zip(eights) {
        *out = Sides::new(own);
    }
    out
}

/// Of plants side by side.
impl<E: Eight, L: Eight, const N: usize> Wide<LanesOf<N>> for Sides<E, L> {
    type Line = [Self; 8];
    #[inline(always)]
    fn subtract(
        factors: [LanesOf<N>; 2],
        sources: [&[LanesOf<N>]; 2],
        targets: [&mut [LanesOf<N>]; 2],
    ) {
        for ((target, source), factor) in targets.into_iter().zip(sources).zip(factors) {
            let factor = E::of_list(&factor.0);
            for (t, s) in target.iter_mut().zip(source) {
                let product = factor.times(E::of_list(&s.0));
                E::of_list(&t.0).minus(product).put_list(&mut t.0);
            }
        }
    }
    type Triple = [Self; 3];
    #[inline(always)]
    fn triple([x, y, z]: &[LanesOf<N>; 3]) -> [Self; 3] {
        [Self::of_plants(x), Self::of_plants(y), Self::of_plants(z)]
    }
    #[inline(always)]
    fn put_triple(triple: [Self; 3], to: &mut [LanesOf<N>; 3]) {
        for (own, to) in triple.into_iter().zip(to) {
            own.put_plants(to);
        }
    }
    #[inline(always)]
    fn triple_sum(a: [Self; 3], b: [Self; 3]) -> [Self; 3] {
        <Self as Wide<Self>>::triple_sum(a, b)
    }
    #[inline(always)]
    fn triple_scaled(triple: [Self; 3], factor: LanesOf<N>) -> [Self; 3] {
        <Self as Wide<Self>>::triple_scaled(triple, Self::of_plants(&factor))
    }
    #[inline(always)]
    fn triple_times(triple: [Self; 3], factor: f64) -> [Self; 3] {
        <Self as Wide<Self>>::triple_times(triple, factor)
    }
    #[inline(always)]
    fn load(several: &LanesOf<N>, _: usize) -> Self {
        Self::of_plants(several)
    }
    #[inline(always)]
    fn store(self, several: &mut LanesOf<N>, _: usize) {
        self.put_plants(several);
    }
    #[inline(always)]
    fn first_of(list: &[LanesOf<N>]) -> Self {
        Self::of_plants(&list[0])
    }
    #[inline(always)]
    fn constants(eight: &Block, lane: usize) -> Self {
        Self::constant(eight.0[lane])
    }
    #[inline(always)]
    fn of_one(number: &LanesOf<N>) -> Self {
        Self::of_plants(number)
    }
    #[inline(always)]
    fn row(row: &[LanesOf<N>; 8]) -> [Self; 8] {
        let mut line = [Self::ZERO; 8];
        for (own, number) in line.iter_mut().zip(row) {
            *own = Self::of_plants(number);
        }
        line
    }
    #[inline(always)]
    fn put_row(row: [Self; 8], to: &mut [LanesOf<N>; 8]) {
        for (own, to) in row.into_iter().zip(to) {
            own.put_plants(to);
        }
    }
    #[inline(always)]
    fn sum(a: [Self; 8], b: [Self; 8]) -> [Self; 8] {
        <Self as Wide<Self>>::sum(a, b)
    }
    #[inline(always)]
    fn scaled(line: [Self; 8], factor: LanesOf<N>) -> [Self; 8] {
        <Self as Wide<Self>>::scaled(line, Self::of_plants(&factor))
    }
    #[inline(always)]
    fn dot_of(a: [Self; 8], b: [Self; 8]) -> LanesOf<N> {
        let mut dot = LanesOf::ZERO;
        <Self as Wide<Self>>::dot_of(a, b).put_plants(&mut dot);
        dot
    }
    #[inline(always)]
    fn dots(a: [[Self; 8]; 2], b: [[Self; 8]; 2]) -> LanesOf<N> {
        let mut dots = LanesOf::ZERO;
        <Self as Wide<Self>>::dots(a, b).put_plants(&mut dots);
        dots
    }
    #[inline(always)]
    fn spread(numbers: [Self; 8], rows: &mut [[LanesOf<N>; 8]]) {
        <Self as Wide<LanesOf<N>>>::put_row(numbers, &mut rows[0]);
    }
    #[inline(always)]
    fn collect(rows: &[[LanesOf<N>; 8]]) -> [Self; 8] {
        <Self as Wide<LanesOf<N>>>::row(&rows[0])
    }
    #[inline(always)]
    fn spread_to(numbers: [Self; 8], rows: &mut [[LanesOf<N>; 8]], of: &[usize]) {
        <Self as Wide<LanesOf<N>>>::put_row(numbers, &mut rows[of[0]]);
    }
    #[inline(always)]
    fn collect_from(rows: &[[LanesOf<N>; 8]], of: &[usize]) -> [Self; 8] {
        <Self as Wide<LanesOf<N>>>::row(&rows[of[0]])
    }
}

/// [`Beside`] of plants side by side: eight or four, in registers.
#[inline(always)]
pub(crate) fn in_plants<T: Beside<LanesOf<N>>, const N: usize>(task: T) -> T::Output {
    match N {
        8 => in_eights(InEight(task, PhantomData)),
        4 => in_eights(InFour(task, PhantomData)),
        _ => LanesOf::<N>::in_registers(|| task.run::<LanesOf<N>>()),
    }
}

/// [`Beside`] of reals: of eight where there are registers of as many and more than four numbers, else of four. Two
/// registers for each eight would be more than a processor with AVX2 has at hand.
#[inline(always)]
pub(crate) fn in_sides<T: Beside<f64>>(count: usize, task: T) -> T::Output {
    if count <= FEW || !has(AVX512) {
        in_eights(InFour(task, PhantomData))
    } else {
        in_eights(InEight(task, PhantomData))
    }
}

/// [`Beside`] of one real.
#[inline(always)]
pub(crate) fn in_one<T: Beside<f64>>(task: T) -> T::Output {
    task.run::<Sides<f64, Block>>()
}

/// As many as lie in [`Eight::Four`].
const FEW: usize = 4;

/// [`Beside`] of eight numbers.
struct InEight<S, T>(T, PhantomData<S>);

/// [`Beside`] of four numbers.
struct InFour<S, T>(T, PhantomData<S>);

/// Both, of reals and of plants.
macro_rules! in_eights_of {
    ([$($generic:tt)*] $number:ty) => {
        impl<T: Beside<$number>, $($generic)*> InEights for InEight<$number, T> {
            type Output = T::Output;
            #[inline(always)]
            fn run<E: Eight>(self) -> T::Output {
                self.0.run::<Sides<E, E>>()
            }
        }

        impl<T: Beside<$number>, $($generic)*> InEights for InFour<$number, T> {
            type Output = T::Output;
            #[inline(always)]
            fn run<E: Eight>(self) -> T::Output {
                self.0.run::<Sides<E::Four, E>>()
            }
        }
    };
}

in_eights_of! { [] f64 }
in_eights_of! { [const N: usize] LanesOf<N> }
