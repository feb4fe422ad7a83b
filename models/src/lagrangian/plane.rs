//! Vectors in the plane.

use std::ops::Mul;

use plantd_math::scalar::Scalar;

/// A vector in the plane.
pub(crate) type Vec2<S = f64> = [S; 2];
/// A twist or a wrench: the angular part first.
pub(crate) type Vec3<S = f64> = [S; 3];

#[inline(always)]
pub(crate) fn cross<A, B: Copy>(a: Vec2<A>, b: Vec2<B>) -> A
where
    A: Scalar + Mul<B, Output = A>,
{
    a[0] * b[1] - a[1] * b[0]
}

#[inline(always)]
pub(crate) fn dot<A, B: Copy>(a: Vec2<A>, b: Vec2<B>) -> A
where
    A: Scalar + Mul<B, Output = A>,
{
    a[0] * b[0] + a[1] * b[1]
}

#[inline(always)]
pub(crate) fn add<S: Scalar>(a: Vec2<S>, b: Vec2<S>) -> Vec2<S> {
    [a[0] + b[0], a[1] + b[1]]
}

#[inline(always)]
pub(crate) fn times<A, B: Copy>(a: Vec2<A>, b: B) -> Vec2<A>
where
    A: Scalar + Mul<B, Output = A>,
{
    [a[0] * b, a[1] * b]
}

/// `ẑ × v`, times `w`.
#[inline(always)]
pub(crate) fn spun<A, B: Copy>(v: Vec2<A>, w: B) -> Vec2<A>
where
    A: Scalar + Mul<B, Output = A>,
{
    [-(v[1] * w), v[0] * w]
}

/// `v` turned by the angle of which sine and cosine are given.
#[inline(always)]
pub(crate) fn turned<A, B: Copy>([s, c]: Vec2<A>, v: Vec2<B>) -> Vec2<A>
where
    A: Scalar + Mul<B, Output = A>,
{
    [c * v[0] - s * v[1], s * v[0] + c * v[1]]
}

/// One turn after the other.
#[inline(always)]
pub(crate) fn combined<S: Scalar>([s, c]: Vec2<S>, [s1, c1]: Vec2<S>) -> Vec2<S> {
    [s * c1 + c * s1, c * c1 - s * s1]
}

#[inline(always)]
pub(crate) fn add4<S: Scalar>(a: [S; 4], b: [S; 4]) -> [S; 4] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]]
}

#[inline(always)]
pub(crate) fn linear<S: Scalar>(v: Vec3<S>) -> Vec2<S> {
    [v[1], v[2]]
}
