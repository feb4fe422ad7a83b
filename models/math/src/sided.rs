//! Lists of vectors that lie side by side: the first numbers of several of them, then their second ones.
//!
//! What is computed alike for all entries of a list is computed for [`Wide::COUNT`] of them at once; what goes
//! from one to the next, such as sums along a tree, takes and puts them one by one.

use crate::scalar::{Scalar, Wide};
use crate::spatial::{Force, Mat3, Motion, Pose, Sym3, Vec3};

/// A vector, a matrix, or several of these, made of numbers `P`.
pub trait Composite<P: Copy>: Copy {
    /// The same of other numbers.
    type Of<T: Copy>: Composite<T>;
    /// What is made of each number.
    fn map<T: Copy>(&self, f: impl FnMut(&P) -> T) -> Self::Of<T>;
    /// Changes each number by that of another one.
    fn zip<T: Copy>(&mut self, other: Self::Of<T>, f: impl FnMut(&mut P, T));
}

impl<P: Copy> Composite<P> for Vec3<P> {
    type Of<T: Copy> = Vec3<T>;
    #[inline(always)]
    fn map<T: Copy>(&self, mut f: impl FnMut(&P) -> T) -> Vec3<T> {
        Vec3([f(&self.0[0]), f(&self.0[1]), f(&self.0[2])])
    }
    #[inline(always)]
    fn zip<T: Copy>(&mut self, other: Vec3<T>, mut f: impl FnMut(&mut P, T)) {
        for (own, other) in self.0.iter_mut().zip(other.0) {
            f(own, other);
        }
    }
}

impl<P: Copy> Composite<P> for Mat3<P> {
    type Of<T: Copy> = Mat3<T>;
    #[inline(always)]
    fn map<T: Copy>(&self, mut f: impl FnMut(&P) -> T) -> Mat3<T> {
        Mat3([self.0[0].map(&mut f), self.0[1].map(&mut f), self.0[2].map(&mut f)])
    }
    #[inline(always)]
    fn zip<T: Copy>(&mut self, other: Mat3<T>, mut f: impl FnMut(&mut P, T)) {
        for (own, other) in self.0.iter_mut().zip(other.0) {
            own.zip(other, &mut f);
        }
    }
}

/// Of the parts that are named.
macro_rules! composed {
    ($($name:ident { $($part:ident)+ })+) => {$(
        impl<P: Copy> Composite<P> for $name<P> {
            type Of<T: Copy> = $name<T>;
            #[inline(always)]
            fn map<T: Copy>(&self, mut f: impl FnMut(&P) -> T) -> $name<T> {
                $name { $($part: self.$part.map(&mut f)),+ }
            }
            #[inline(always)]
            fn zip<T: Copy>(&mut self, other: $name<T>, mut f: impl FnMut(&mut P, T)) {
                $(self.$part.zip(other.$part, &mut f);)+
            }
        }
    )+};
}

composed! {
    Motion { w v }
    Force { n f }
    Pose { x y z at }
}

impl<P: Copy> Composite<P> for Sym3<P> {
    type Of<T: Copy> = Sym3<T>;
    #[inline(always)]
    fn map<T: Copy>(&self, mut f: impl FnMut(&P) -> T) -> Sym3<T> {
        let Self { xx, yy, zz, xy, xz, yz } = self;
        Sym3 { xx: f(xx), yy: f(yy), zz: f(zz), xy: f(xy), xz: f(xz), yz: f(yz) }
    }
    #[inline(always)]
    fn zip<T: Copy>(&mut self, other: Sym3<T>, mut f: impl FnMut(&mut P, T)) {
        let Self { xx, yy, zz, xy, xz, yz } = self;
        f(xx, other.xx);
        f(yy, other.yy);
        f(zz, other.zz);
        f(xy, other.xy);
        f(xz, other.xz);
        f(yz, other.yz);
    }
}

/// A list of vectors that lie side by side; `V` are those of [`Scalar::Several`] numbers.
#[derive(Clone, Debug, Default)]
pub struct Sided<V>(pub Vec<V>);

impl<V: Copy + Default> Sided<V> {
    /// So many, all zero.
    pub fn zeros<S: Scalar>(count: usize) -> Self
    where
        V: Composite<S::Several>,
    {
        Self(vec![V::default(); count.div_ceil(S::BESIDE)])
    }
}

impl<V: Copy> Sided<V> {
    /// One of them.
    #[inline(always)]
    pub fn get<S: Scalar>(&self, i: usize) -> V::Of<S>
    where
        V: Composite<S::Several>,
    {
        self.0[i / S::BESIDE].map(|several| S::one(several, i % S::BESIDE))
    }

    /// Several, the first of which is `i`.
    #[inline(always)]
    pub fn wide<S: Scalar, W: Wide<S>>(&self, i: usize) -> V::Of<W>
    where
        V: Composite<S::Several>,
    {
        self.0[i / S::BESIDE].map(|several| W::load(several, i % S::BESIDE))
    }

    /// Replaces several, the first of which is `i`.
    #[inline(always)]
    pub fn store<S: Scalar, W: Wide<S>>(&mut self, i: usize, wide: V::Of<W>)
    where
        V: Composite<S::Several>,
    {
        self.0[i / S::BESIDE].zip(wide, |several, wide: W| wide.store(several, i % S::BESIDE));
    }

    /// Replaces one of them.
    #[inline(always)]
    pub fn put<S: Scalar>(&mut self, i: usize, one: V::Of<S>)
    where
        V: Composite<S::Several>,
    {
        self.0[i / S::BESIDE].zip(one, |several, number: S| number.put(several, i % S::BESIDE));
    }
}
