//! Rotations: orientations as unit quaternions, and the maps between rotations and rotation vectors
//! that a ball joint needs.
//!
//! A ball joint turns in one step by `R[k+1] = R[k] exp(ξ)`, with `ξ` in its own axes. With
//! `t = |ξ|` and `ξ^ x = ξ × x` all maps are polynomials `1 + a ξ^ + b ξ^²` whose coefficients are even
//! functions of `t`: series near zero, so that no direction and no rate is special.

use crate::scalar::Scalar;
use crate::sided::Composite;
use crate::spatial::{Mat3, Vec3};
use crate::sums::two_sum;
use crate::trigonometry::sin_cos_of;

/// An orientation, as a unit quaternion `[w, x, y, z]`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quaternion<S = f64>(pub [S; 4]);

impl Default for Quaternion {
    fn default() -> Self {
        Self([1.0, 0.0, 0.0, 0.0])
    }
}

impl Quaternion {
    /// `exp(v)`: the rotation about the direction of `v` by its length.
    pub fn exp(v: Vec3) -> Self {
        let angle = v.norm();
        let (sine, cosine) = sin_cos_of(0.5 * angle);
        // sin(t/2)/t to round-off where the quotient would be 0/0.
        let scale = if angle < 1e-4 { 0.5 - angle * angle / 48.0 } else { sine / angle };
        Self([cosine, scale * v[0], scale * v[1], scale * v[2]])
    }

    /// Of a rotation matrix: from its largest component, which loses no digits.
    pub fn of_matrix(matrix: &Mat3) -> Self {
        Self(along_quaternion(matrix).0).normalized()
    }

    /// `self · o`, normalised.
    pub fn times(self, o: Self) -> Self {
        Self(product(self.0, o.0)).normalized()
    }

    /// The opposite rotation: the conjugate.
    pub fn inverse(self) -> Self {
        let [w, x, y, z] = self.0;
        Self([w, -x, -y, -z])
    }

    fn normalized(self) -> Self {
        let norm = self.0.iter().map(|c| c * c).sum::<f64>().sqrt();
        Self(self.0.map(|c| c / norm))
    }
}

impl<S: Scalar> Quaternion<S> {
    /// The rotation vector, at most half a turn long; at half a turn one of the two that there are. Nothing branches,
    /// and derivatives are finite everywhere.
    ///
    /// With `sin a` and `cos a` of half the angle, it is the vector of the quaternion times `2a / sin a`; as
    /// `sin a = 8 cos(a/2) cos(a/4) cos(a/8) sin(a/8)`, that takes an arcsine of less than 0.2, whose series is short.
    #[inline(always)]
    pub fn log(self) -> Vec3<S> {
        /// `2 asin(√s) / √s = Σ c_i sⁱ`.
        const fn arcsine() -> [f64; 12] {
            let (mut c, mut binomial, mut i) = ([0.0; 12], 1.0, 0);
            while i < 12 {
                let n = i as f64;
                c[i] = 2.0 * binomial / (2.0 * n + 1.0);
                binomial *= (2.0 * n + 1.0) / (2.0 * n + 2.0);
                i += 1;
            }
            c
        }
        let [w, x, y, z] = self.0;
        let vector = Vec3([x, y, z]);
        let half = |cosine: S| ((cosine + 1.0) * 0.5).sqrt();
        let a = half(w.signed(S::ONE));
        let b = half(a);
        let inverse = (a * b * half(b)).recip();
        let square = vector.dot(vector) * (inverse * inverse) * (1.0 / 64.0);
        vector * (by_halves(square, const { &arcsine() }) * inverse).signed(w)
    }

    /// `(self + low) exp(turn)`, and what rounding took from it: the increment, of which no digits cancel,
    /// is added by compensated sums, so that turns do not drift.
    #[inline(always)]
    pub fn turned(self, low: [S; 4], turn: Vec3<S>) -> (Self, [S; 4]) {
        let change = Turn::new(turn).change();
        let (of_high, of_low) = (product(self.0, change), product(low, change));
        let (mut high, mut next) = (self.0, low);
        for i in 0..4 {
            (high[i], next[i]) = two_sum(self.0[i], of_high[i] + (low[i] + of_low[i]));
        }
        // To length 1: that is no turn.
        let excess = (dot(high, high) - 1.0) * 0.5 + dot(high, next);
        for i in 0..4 {
            next[i] -= excess * high[i];
        }
        (Self(high), next)
    }

    /// The rotation matrix.
    #[inline(always)]
    pub fn matrix(self) -> Mat3<S> {
        let [w, x, y, z] = self.0;
        let (x2, y2, z2) = (x + x, y + y, z + z);
        let ([wx, wy, wz], [xx, xy, xz]) = ([w * x2, w * y2, w * z2], [x * x2, x * y2, x * z2]);
        let [yy, yz, zz] = [y * y2, y * z2, z * z2];
        Mat3([
            Vec3([S::ONE - (yy + zz), xy + wz, xz - wy]),
            Vec3([xy - wz, S::ONE - (xx + zz), yz + wx]),
            Vec3([xz + wy, yz - wx, S::ONE - (xx + yy)]),
        ])
    }
}

#[inline(always)]
fn product<S: Scalar>([a, b, c, d]: [S; 4], [w, x, y, z]: [S; 4]) -> [S; 4] {
    [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
}

/// `Σ c_i sⁱ`: even and odd terms beside each other, so that each waits for half as many. Nothing branches.
#[inline(always)]
fn by_halves<S: Scalar, const N: usize>(s: S, coefficients: &[f64; N]) -> S {
    const { assert!(N.is_multiple_of(2)) };
    let square = s * s;
    let [mut even, mut odd] = [S::ZERO; 2];
    let mut i = N;
    while i > 0 {
        i -= 2;
        even = even * square + coefficients[i];
        odd = odd * square + coefficients[i + 1];
    }
    even + odd * s
}

/// `e_N = 1/N! − s e_N+2`.
#[inline(always)]
fn down<S: Scalar>(s: S, next: S, n: usize) -> S {
    -(next * s) + inverse_factorial(n)
}

/// Squares of angles below this are summed as series.
const SERIES_BELOW: f64 = 1.0;

/// Squares of angles below this are done with the first terms: of them and their slopes no digit is missing.
const FIRST_BELOW: f64 = 1e-3;

/// `Σ c_i sⁱ`.
#[inline]
fn series<S: Scalar, const N: usize>(s: S, coefficients: &[f64; N]) -> S {
    let sum = |coefficients: &[f64]| coefficients.iter().rev().fold(S::ZERO, |sum, c| sum * s + *c);
    if s.value() < FIRST_BELOW { sum(&coefficients[..6]) } else { sum(coefficients) }
}

/// `1/n!`.
const fn inverse_factorial(n: usize) -> f64 {
    let (mut product, mut i) = (1.0, 2);
    while i <= n {
        product *= i as f64;
        i += 1;
    }
    1.0 / product
}

/// `(−1)ⁱ / (2i + N)!`: the first coefficients of `e_N(s) = Σ (−s)ⁱ / (2i + N)!`.
const fn alternating<const N: usize, const TERMS: usize>() -> [f64; TERMS] {
    let (mut c, mut i) = ([0.0; TERMS], 0);
    while i < TERMS {
        let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
        c[i] = sign * inverse_factorial(2 * i + N);
        i += 1;
    }
    c
}

/// `e_N` for `N ≥ 4`, with as many terms as half a turn takes: the next is less than 1e-17 of the first.
#[inline(always)]
fn entire<S: Scalar, const N: usize>(s: S) -> S {
    by_halves(s, const { &alternating::<N, 14>() })
}

/// `e1 = sin t / t`, `e2 = (1 − cos t) / t²` and `e3 = (t − sin t) / t³` for `s = t²`.
#[inline]
fn exponential<S: Scalar>(s: S) -> [S; 3] {
    if s.value() < SERIES_BELOW {
        return [
            series(s, const { &alternating::<1, 10>() }),
            series(s, const { &alternating::<2, 10>() }),
            series(s, const { &alternating::<3, 10>() }),
        ];
    }
    let t = s.sqrt();
    let (sine, cosine) = t.sin_cos();
    let inverse = s.recip();
    let sine_over_t = sine * t.recip();
    [sine_over_t, (S::ONE - cosine) * inverse, (S::ONE - sine_over_t) * inverse]
}

/// `1 + a y^ + b y^²`.
#[inline(always)]
fn polynomial<S: Scalar>(y: Vec3<S>, a: S, b: S) -> Mat3<S> {
    let turn = y * a;
    let (square, along) = (Vec3([y[0] * y[0], y[1] * y[1], y[2] * y[2]]), y * b);
    let [xy, xz, yz] = [along[0] * y[1], along[0] * y[2], along[1] * y[2]];
    let diagonal = |i: usize, j: usize| S::ONE - b * (square[i] + square[j]);
    Mat3([
        Vec3([diagonal(1, 2), xy + turn[2], xz - turn[1]]),
        Vec3([xy - turn[2], diagonal(0, 2), yz + turn[0]]),
        Vec3([xz + turn[1], yz - turn[0], diagonal(0, 1)]),
    ])
}

/// The product of four numbers with four others. A closure would be a call between registers.
#[inline(always)]
fn dot<S: Scalar>(a: [S; 4], b: [S; 4]) -> S {
    (a[0] * b[0] + a[1] * b[1]) + (a[2] * b[2] + a[3] * b[3])
}

/// `δ ↦ δ × v`.
#[inline(always)]
pub fn crossed<S: Scalar>(v: Vec3<S>) -> Mat3<S> {
    Mat3([Vec3([S::ZERO, -v[2], v[1]]), Vec3([v[2], S::ZERO, -v[0]]), Vec3([-v[1], v[0], S::ZERO])])
}

/// `exp(y)` as a matrix.
#[inline]
pub fn exp<S: Scalar>(y: Vec3<S>) -> Mat3<S> {
    let [a, b, _] = exponential(y.dot(y));
    polynomial(y, a, b)
}

/// The rotation vector of a rotation matrix, as [`Quaternion::log`].
pub fn log<S: Scalar>(rotation: &Mat3<S>) -> Vec3<S> {
    Quaternion(quaternion(rotation)).log()
}

/// The unit quaternion of a rotation matrix whose first component is not negative.
fn quaternion<S: Scalar>(rotation: &Mat3<S>) -> [S; 4] {
    let (components, square) = along_quaternion(rotation);
    let half = square.sqrt().recip() * 0.5;
    let sign = if components[0].value() < 0.0 { -half } else { half };
    components.map(|component| component * sign)
}

/// A multiple of the quaternion of a rotation matrix, and its largest component, from which it is found
/// without loss of digits: four times the square of that of the unit quaternion.
fn along_quaternion<S: Scalar>(Mat3([x, y, z]): &Mat3<S>) -> ([S; 4], S) {
    let squares = [
        S::ONE + x[0] + y[1] + z[2],
        S::ONE + x[0] - y[1] - z[2],
        S::ONE - x[0] + y[1] - z[2],
        S::ONE - x[0] - y[1] + z[2],
    ];
    let larger = |m: usize, i: usize| squares[i].value() > squares[m].value();
    let largest = (1..4).fold(0, |m, i| if larger(m, i) { i } else { m });
    let square = squares[largest];
    let (a, b, c) = (y[2] - z[1], z[0] - x[2], x[1] - y[0]);
    let (d, e, f) = (x[1] + y[0], z[0] + x[2], y[2] + z[1]);
    let components = match largest {
        0 => [square, a, b, c],
        1 => [a, square, d, e],
        2 => [b, d, square, f],
        _ => [c, e, f, square],
    };
    (components, square)
}

/// `dexp₋y`: how `exp(y)` turns in its own axes as `y` changes, `exp(−y) d exp(y) = (dexp₋y dy)^`.
#[inline]
pub fn dexp<S: Scalar>(y: Vec3<S>) -> Mat3<S> {
    let [_, b, c] = exponential(y.dot(y));
    polynomial(y, -b, c)
}

/// `N⁻ = 1 + ½ ξ^ + c ξ^²`: takes the momentum at the midpoint to the start; the inverse of
/// [`dexp`]. Its transpose `N⁺` takes it to the end.
#[inline]
pub fn momentum_at_start<S: Scalar>(xi: Vec3<S>) -> Mat3<S> {
    Turn::new(xi).momentum_at_start()
}

/// How a ball joint turns in a step, `ξ`, with the coefficients of all maps that the step needs.
///
/// They are those of half the turn: with `e1 … e5` of `s = |ξ|²/4`,
///
/// ```text
/// k = tan(t/4) / t = e2 / 2e1      c = (1 − (t/2) cot(t/2)) / t² = (e2 − e3) / 4e1
/// ```
///
/// of which no digits cancel; all are singular only at a whole turn. Nothing branches, so it takes several turns side
/// by side.
#[derive(Clone, Copy, Debug, Default)]
pub struct Turn<S = f64> {
    /// `ξ`.
    pub xi: Vec3<S>,
    /// `|ξ|²/4`.
    square: S,
    /// `e1 … e5` of that.
    half: [S; 5],
    c: S,
    k: S,
}

impl<S: Scalar> Turn<S> {
    /// By `ξ`.
    #[inline(always)]
    pub fn new(xi: Vec3<S>) -> Self {
        let square = xi.dot(xi) * 0.25;
        let e4 = entire::<S, 4>(square);
        let e5 = entire::<S, 5>(square);
        let (e2, e3) = (down(square, e4, 2), down(square, e5, 3));
        let e1 = down(square, e3, 1);
        let inverse = e1.recip() * 0.25;
        let (c, k) = ((e2 - e3) * inverse, (e2 + e2) * inverse);
        Self { xi, square, half: [e1, e2, e3, e4, e5], c, k }
    }

    /// `exp(ξ/2)`.
    #[inline(always)]
    pub fn half(&self) -> Mat3<S> {
        polynomial(self.xi * S::constant(0.5), self.half[0], self.half[1])
    }

    /// `dexp₋ξ/2`.
    #[inline(always)]
    pub fn dexp_of_half(&self) -> Mat3<S> {
        polynomial(self.xi * S::constant(0.5), -self.half[1], self.half[2])
    }

    /// `N⁻`, as [`momentum_at_start`].
    #[inline(always)]
    pub fn momentum_at_start(&self) -> Mat3<S> {
        polynomial(self.xi, S::constant(0.5), self.c)
    }

    /// `T⁻ = 1 + k ξ^`: takes a torque at the midpoint to the start. Its transpose `T⁺` takes it to the end.
    #[inline(always)]
    pub fn torque_at_start(&self) -> Mat3<S> {
        polynomial(self.xi, self.k, S::ZERO)
    }

    /// `N⁻ m` without the matrix.
    #[inline(always)]
    pub fn momentum_to_start(&self, m: Vec3<S>) -> Vec3<S> {
        let turned = self.xi.cross(m);
        m + turned.scaled(0.5) + self.xi.cross(turned) * self.c
    }

    /// `T⁻ τ` without the matrix.
    #[inline(always)]
    pub fn torque_to_start(&self, torque: Vec3<S>) -> Vec3<S> {
        torque + self.xi.cross(torque) * self.k
    }

    /// How the maps change with `ξ`.
    #[inline(always)]
    pub fn changes(&self) -> Changes<'_, S> {
        let [c, k] = self.slopes();
        Changes { turn: self, c, k }
    }

    /// `exp(ξ) − 1`, as a quaternion: of no component digits cancel.
    #[inline(always)]
    fn change(&self) -> [S; 4] {
        let [e1, e2, ..] = self.half;
        let Vec3([x, y, z]) = self.xi * (e1 * 0.5);
        [-(self.square * e2), x, y, z]
    }

    /// `c'` and `k'` by `t²`, from `e_n' = ½ (n e_n+2 − e_n+1)`.
    #[inline(always)]
    fn slopes(&self) -> [S; 2] {
        let [e1, e2, e3, e4, e5] = self.half;
        // Twice the slopes of e1, e2, e3.
        let (by_e1, by_e2, by_e3) = (e3 - e2, e4 + e4 - e3, e5 * 3.0 - e4);
        let inverse = e1.recip() * (1.0 / 32.0);
        let c = (by_e2 - by_e3 - by_e1 * (self.c * 4.0)) * inverse;
        let k = (by_e2 - by_e1 * (self.k + self.k)) * (inverse + inverse);
        [c, k]
    }
}

impl<P: Copy> Composite<P> for Turn<P> {
    type Of<T: Copy> = Turn<T>;
    #[inline(always)]
    fn map<T: Copy>(&self, mut f: impl FnMut(&P) -> T) -> Turn<T> {
        let [e1, e2, e3, e4, e5] = &self.half;
        Turn {
            xi: self.xi.map(&mut f),
            square: f(&self.square),
            half: [f(e1), f(e2), f(e3), f(e4), f(e5)],
            c: f(&self.c),
            k: f(&self.k),
        }
    }
    #[inline(always)]
    fn zip<T: Copy>(&mut self, other: Turn<T>, mut f: impl FnMut(&mut P, T)) {
        self.xi.zip(other.xi, &mut f);
        f(&mut self.square, other.square);
        for (own, other) in self.half.iter_mut().zip(other.half) {
            f(own, other);
        }
        f(&mut self.c, other.c);
        f(&mut self.k, other.k);
    }
}

/// How the maps of a ball joint change with its turn, with `c'` and `k'` by `t²`.
#[derive(Clone, Copy, Debug)]
pub struct Changes<'a, S = f64> {
    turn: &'a Turn<S>,
    c: S,
    k: S,
}

impl<S: Scalar> Changes<'_, S> {
    /// Of `N⁻ m`: `½ δ×m + c (δ×(ξ×m) + ξ×(δ×m)) + 2c' (ξ·δ) ξ×(ξ×m)` for a change `δ`.
    #[inline]
    pub fn of_momentum(&self, m: Vec3<S>) -> Mat3<S> {
        let Turn { xi, c, .. } = *self.turn;
        let (turned, along) = (xi.cross(m), xi.dot(m));
        let twice = xi.cross(turned) * (self.c + self.c) - m * (c + c);
        // δ×(ξ×m) + ξ×(δ×m) = ξ (m·δ) + δ (ξ·m) − 2 m (ξ·δ)
        let (mut change, weight, along) = (crossed(m.scaled(0.5)), m * c, along * c);
        for (b, column) in change.0.iter_mut().enumerate() {
            *column += xi * weight[b] + twice * xi[b];
            column.0[b] += along;
        }
        change
    }

    /// Of `T⁻ τ`: `k δ×τ + 2k' (ξ·δ) ξ×τ` for a change `δ`.
    #[inline]
    pub fn of_torque(&self, torque: Vec3<S>) -> Mat3<S> {
        let Turn { xi, k, .. } = *self.turn;
        let twice = xi.cross(torque) * (self.k + self.k);
        let mut change = crossed(torque * k);
        for (b, column) in change.0.iter_mut().enumerate() {
            *column += twice * xi[b];
        }
        change
    }
}

/// Rotation vectors `y` as coordinates of the rotations `exp(y)`, with what their derivatives are made of: the
/// numbers `e_N = Σ (−s)ⁱ / (2i + N)!` of `s = |y|²` for `N ≤ 7`, of which `e_N' = ½ (N e_N+2 − e_N+1)`.
///
/// Nothing branches, so it takes several rotations side by side; to round-off up to half a turn.
#[derive(Clone, Copy, Debug)]
pub struct Chart<S = f64> {
    y: Vec3<S>,
    square: S,
    /// `e_1 … e_7`, from the second entry on.
    e: [S; 8],
}

impl<S: Scalar> Chart<S> {
    /// `y`.
    pub fn vector(&self) -> Vec3<S> {
        self.y
    }

    /// At `y`.
    #[inline(always)]
    pub fn new(y: Vec3<S>) -> Self {
        let square = y.dot(y);
        let e6 = entire::<S, 6>(square);
        let e7 = entire::<S, 7>(square);
        let (e4, e5) = (down(square, e6, 4), down(square, e7, 5));
        let (e2, e3) = (down(square, e4, 2), down(square, e5, 3));
        Self { y, square, e: [S::ZERO, down(square, e3, 1), e2, e3, e4, e5, e6, e7] }
    }

    /// `exp(y)`.
    #[inline(always)]
    pub fn exp(&self) -> Mat3<S> {
        polynomial(self.y, self.e[1], self.e[2])
    }

    /// `D = dexp₋y`, as [`dexp`].
    #[inline(always)]
    pub fn dexp(&self) -> Mat3<S> {
        polynomial(self.y, -self.e[2], self.e[3])
    }

    /// The inverse of `D`.
    #[inline(always)]
    pub fn inverse_dexp(&self) -> Mat3<S> {
        let [_, _, e2, e3, e4, ..] = self.e;
        polynomial(self.y, S::constant(0.5), (e3 - (e4 + e4)) * (e2 + e2).recip())
    }

    /// `e_N'` by `s`.
    #[inline(always)]
    fn slope_of(&self, n: usize) -> S {
        (self.e[n + 2] * n as f64 - self.e[n + 1]) * 0.5
    }

    /// How `D x` changes with `y`.
    #[inline(always)]
    pub fn slope(&self, x: Vec3<S>) -> Mat3<S> {
        self.slope_as(x, -self.e[2], -self.slope_of(2))
    }

    /// How `Dᵀ x` changes with `y`.
    #[inline(always)]
    pub fn transposed_slope(&self, x: Vec3<S>) -> Mat3<S> {
        self.slope_as(x, self.e[2], self.slope_of(2))
    }

    /// How `x + a y×x + e3 y×(y×x)` changes with `y`, where `a` changes by `slope` with `s`.
    #[inline(always)]
    fn slope_as(&self, x: Vec3<S>, a: S, slope: S) -> Mat3<S> {
        let (y, e3) = (self.y, self.e[3]);
        let turned = y.cross(x);
        let along = e3 * y.dot(x);
        let (weight, by_square) = (x * e3, turned * slope + y.cross(turned) * self.slope_of(3));
        let by_square = by_square + by_square - weight - weight;
        let mut change = crossed(x * a);
        for (b, column) in change.0.iter_mut().enumerate() {
            *column += y * weight[b] + by_square * y[b];
            column.0[b] += along;
        }
        change
    }

    /// The second derivatives of `m·D v` by `y`.
    #[inline]
    pub fn curvature(&self, m: Vec3<S>, v: Vec3<S>) -> Mat3<S> {
        let (y, s) = (self.y, self.square);
        let e3 = self.e[3];
        let (b1, c1) = (self.slope_of(2), self.slope_of(3));
        let b2 = self.slope_of(4) - self.slope_of(3) * 0.5;
        let c2 = self.slope_of(5) * 1.5 - self.slope_of(4) * 0.5;
        // m·D v = m·v (1 − e3 s) − e2 y·a + e3 (y·m) (y·v)
        let a = v.cross(m);
        let (mv, ya, ym, yv) = (m.dot(v), y.dot(a), y.dot(m), y.dot(v));
        let product = ym * yv;
        let twice = |x: S| x + x;
        let unit = twice(c1 * product - b1 * ya - (e3 + s * c1) * mv);
        let square = twice(twice(c2 * product - b2 * ya - (twice(c1) + s * c2) * mv));
        let mixed = (m * yv + v * ym) * twice(c1) - a * twice(b1);
        let mut sum = Mat3::IDENTITY.scaled(unit);
        for (b, column) in sum.0.iter_mut().enumerate() {
            *column += y * (square * y[b]) + mixed * y[b] + y * mixed[b];
            *column += (m * v[b] + v * m[b]) * e3;
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scalar::Dual;

    fn vectors() -> impl Iterator<Item = Vec3> {
        let lengths = [0.0, 1e-9, 1e-3, 0.3, 0.99, 1.01, 2.0, 3.1];
        lengths.into_iter().map(|t| Vec3([2.0, -1.0, 0.5]) * (t / 5.25_f64.sqrt()))
    }

    fn distance(a: &Mat3, b: &Mat3) -> f64 {
        (0..3).map(|i| (a.0[i] - b.0[i]).norm()).fold(0.0, f64::max)
    }

    #[test]
    fn quaternions_and_matrices_turn_alike() {
        for v in vectors() {
            let q = Quaternion::exp(v);
            assert!(distance(&q.matrix(), &exp(v)) < 1e-15, "{v:?}");
            assert!((q.log() - v).norm() < 1e-15 * (1.0 + v.norm()), "{v:?}");
            let w = Vec3([0.3, 0.7, -0.2]);
            let product = q.times(Quaternion::exp(w)).matrix();
            assert!(distance(&product, &exp(v).times(&exp(w))) < 1e-15, "{v:?}");
        }
        let more_than_half_a_turn = Vec3([0.0, 0.0, 4.0]);
        let short = Quaternion::exp(more_than_half_a_turn).log();
        assert!((short[2] - (4.0 - std::f64::consts::TAU)).abs() < 1e-15);
    }

    #[test]
    fn the_differential_of_the_exponential() {
        let direction = Vec3([0.4, 0.1, -0.8]);
        for v in vectors() {
            let dual = Vec3([0, 1, 2].map(|i| Dual::new(v[i], direction[i])));
            let turned = exp(dual);
            let rate = Mat3(turned.0.map(|c| Vec3(c.0.map(|x| x.eps))));
            let spin = exp(v).transpose().times(&rate);
            let axis = Vec3([spin.0[1][2], spin.0[2][0], spin.0[0][1]]);
            assert!((axis - dexp(v).apply(direction)).norm() < 1e-14, "{v:?}");
            let identity = dexp(v).times(&momentum_at_start(v));
            assert!(distance(&identity, &Mat3::IDENTITY) < 1e-14, "{v:?}");
            // ½ (1 + exp(−ξ/2)) T⁻ = 1: a torque at the midpoint turns both ends alike.
            let (half, one) = (exp(v * -0.5), Mat3::IDENTITY);
            let mean = Mat3([0, 1, 2].map(|i| (half.0[i] + one.0[i]) * 0.5));
            assert!(distance(&mean.times(&Turn::new(v).torque_at_start()), &one) < 1e-14, "{v:?}");
        }
    }

    /// Next to no turn, on both sides of where the series ends, and next to half a turn.
    #[test]
    fn the_logarithm_and_its_slope() {
        let direction = Vec3([0.4, 0.1, -0.8]);
        let others = [0.34, 0.36, 3.13, std::f64::consts::PI - 1e-9];
        let others = others.map(|t| Vec3([-0.6, 0.8, 0.0]) * t);
        for v in vectors().chain(others) {
            assert!((log(&exp(v)) - v).norm() < 1e-14, "{v:?}");
            // Turned on in its own axes.
            let turned = exp(Vec3(direction.0.map(|x| Dual::new(0.0, x))));
            let found = log(&Mat3::lift(exp(v)).times(&turned));
            let slope = Vec3(found.0.map(|x| x.eps));
            let expected = momentum_at_start(v).apply(direction);
            assert!((slope - expected).norm() < 1e-7, "{v:?}: {slope:?} {expected:?}");
        }
        let half = std::f64::consts::PI;
        for v in
            [[half, 0.0, 0.0], [0.0, half, 0.0], [0.0, 0.0, half], [0.0, -0.6 * half, 0.8 * half]]
        {
            let turned =
                Mat3::lift(exp(Vec3(v))).times(&exp(Vec3([0, 1, 2].map(|_| Dual::new(0.0, 1.0)))));
            let found = log(&turned);
            assert!(found.0.iter().all(|x| x.re.is_finite() && x.eps.is_finite()), "{found:?}");
            let length = Vec3(found.0.map(|x| x.re)).norm();
            assert!((length - half).abs() < 1e-14, "{found:?}");
        }
    }

    #[test]
    fn maps_are_the_same_without_their_matrices() {
        let v = Vec3([0.7, -0.3, 0.5]);
        for xi in vectors() {
            let turn = Turn::new(xi);
            let momentum = turn.momentum_at_start().apply(v) - turn.momentum_to_start(v);
            let torque = turn.torque_at_start().apply(v) - turn.torque_to_start(v);
            assert!(momentum.norm() < 1e-15 && torque.norm() < 1e-15, "{xi:?}");
            assert!(distance(&turn.half(), &exp(xi * 0.5)) < 1e-15, "{xi:?}");
            assert!(distance(&turn.dexp_of_half(), &dexp(xi * 0.5)) < 1e-15, "{xi:?}");
            let Quaternion([w, x, y, z]) = Quaternion::exp(xi);
            for (a, b) in [w - 1.0, x, y, z].into_iter().zip(turn.change()) {
                assert!((a - b).abs() < 2e-16, "{xi:?}");
            }
            let turned = Mat3([0, 1, 2].map(|i| xi.cross(Mat3::IDENTITY.0[i])));
            let squared = turned.times(&turned);
            let [_, b, c] = exponential(xi.dot(xi));
            let dexp_of = Mat3::IDENTITY.minus(&turned.scaled(b)).plus(&squared.scaled(c));
            assert!(distance(&dexp(xi), &dexp_of) < 1e-15, "{xi:?}");
        }
    }

    #[test]
    fn the_changes_of_the_maps_are_their_derivatives() {
        let (v, direction) = (Vec3([0.7, -0.3, 0.5]), Vec3([0.4, 0.1, -0.8]));
        let lifted = Vec3(v.0.map(Dual::constant));
        for xi in vectors() {
            let dual = Vec3([0, 1, 2].map(|i| Dual::new(xi[i], direction[i])));
            let (along, turn) = (Turn::new(dual), Turn::new(xi));
            let changes = turn.changes();
            for (map, change) in [
                (along.momentum_at_start(), changes.of_momentum(v)),
                (along.torque_at_start(), changes.of_torque(v)),
            ] {
                let rate = Vec3(map.apply(lifted).0.map(|x| x.eps));
                assert!((rate - change.apply(direction)).norm() < 1e-14, "{xi:?}");
            }
        }
    }

    #[test]
    fn series_and_closed_forms_meet() {
        let (below, above) = (SERIES_BELOW - 1e-12, SERIES_BELOW + 1e-12);
        for (a, b) in [
            (exponential(below)[0], exponential(above)[0]),
            (exponential(below)[1], exponential(above)[1]),
            (exponential(below)[2], exponential(above)[2]),
        ] {
            assert!((a - b).abs() < 1e-12 * a, "{a} {b}");
        }
    }

    /// The numbers of a turn are the closed forms of their series, to a whole turn and beyond.
    #[test]
    fn numbers_of_turns() {
        for (t, bound) in
            [(1e-5, 1e-16), (0.1, 1e-16), (1.0, 2e-16), (2.0, 1e-15), (3.0, 5e-15), (6.0, 1e-10)]
        {
            let [e1, e2, e3, e4, e5] = Turn::new(Vec3([2.0 * t, 0.0, 0.0])).half;
            let s = t * t;
            let differences = [
                t * e1 - t.sin(),
                s * e2 - (1.0 - t.cos()),
                t * s * e3 - (t - t.sin()),
                s * s * e4 - (0.5 * s - 1.0 + t.cos()),
                t * s * s * e5 - (t * s / 6.0 - t + t.sin()),
            ];
            assert!(differences.iter().all(|d| d.abs() < bound), "{t}: {differences:?}");
        }
    }

    /// Rotations side by side are to the bit what each is by itself.
    #[test]
    fn side_by_side_is_each_by_itself() {
        use crate::scalar::LanesOf;
        let all: Vec<Vec3> = vectors().collect();
        let lanes = |k: usize| LanesOf::<8>(std::array::from_fn(|lane| all[lane].0[k]));
        let start = Quaternion::exp(Vec3([0.3, 0.7, -0.2]));
        let low = [1e-17, -2e-17, 3e-17, 0.0];
        let turn = Vec3([lanes(0), lanes(1), lanes(2)]);
        let wide = Quaternion(start.0.map(LanesOf::constant));
        let (end, end_low) = wide.turned(low.map(LanesOf::constant), turn);
        let (log, matrix) = (end.log(), end.matrix());
        let changes = Turn::new(turn);
        let changes = changes.changes().of_momentum(log);
        for (lane, &xi) in all.iter().enumerate() {
            let (own, own_low) = start.turned(low, xi);
            assert_eq!((own.0, own_low), (end.0.map(|c| c.0[lane]), end_low.map(|c| c.0[lane])));
            assert_eq!(own.log(), log.map(|c| c.0[lane]));
            assert_eq!(own.matrix(), matrix.map(|c| c.0[lane]));
            let own = Turn::new(xi).changes().of_momentum(own.log());
            assert_eq!(own, changes.map(|c| c.0[lane]));
        }
    }

    /// The maps of a chart are those of rotation vectors, and their slopes what dual numbers say.
    #[test]
    fn charts_and_their_slopes() {
        let close = |a: &Mat3, b: &Mat3| distance(a, b) < 3e-14;
        let (x, m) = (Vec3([0.3, 0.7, -0.2]), Vec3([-0.4, 0.1, 0.9]));
        for y in vectors() {
            let chart = Chart::new(y);
            assert!(close(&chart.exp(), &exp(y)) && close(&chart.dexp(), &dexp(y)), "{y:?}");
            assert!(close(&chart.inverse_dexp(), &momentum_at_start(y)), "{y:?}");
            for b in 0..3 {
                let along: Vec3<Dual> =
                    Vec3([0, 1, 2].map(|i| Dual::new(y[i], if i == b { 1.0 } else { 0.0 })));
                let there = Chart::new(along);
                let eps = |v: Vec3<Dual>| Vec3(v.0.map(|c| c.eps));
                let (dx, dtx) = (
                    there.dexp().apply(Vec3::lift(x)),
                    there.dexp().transpose().apply(Vec3::lift(x)),
                );
                assert!((eps(dx) - chart.slope(x).0[b]).norm() < 1e-14, "{y:?}");
                assert!((eps(dtx) - chart.transposed_slope(x).0[b]).norm() < 1e-14, "{y:?}");
                let gradient = there.slope(Vec3::lift(x)).transpose().apply(Vec3::lift(m));
                let found = chart.curvature(m, x).0[b];
                assert!((eps(gradient) - found).norm() < 1e-14, "{y:?}: {found:?}");
            }
        }
    }
}
