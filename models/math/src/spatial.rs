//! Vectors, rotations, twists, wrenches and inertias in three dimensions.
//!
//! Spatial vectors list the angular part first and use world axes. A twist is the velocity field of
//! a rigid body given at the origin of an evaluation, a wrench is a force or momentum about it.

use std::ops::{Add, AddAssign, Index, Mul, Neg, Sub};

use crate::scalar::{Scalar, operators};

/// A vector in three dimensions.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Vec3<S = f64>(pub [S; 3]);

impl<S: Scalar> Vec3<S> {
    /// The zero vector.
    pub const ZERO: Self = Self([S::ZERO; 3]);
    /// A constant vector.
    #[inline(always)]
    pub fn lift(v: Vec3) -> Self {
        Self([S::constant(v.0[0]), S::constant(v.0[1]), S::constant(v.0[2])])
    }

    /// `a · b`.
    #[inline(always)]
    pub fn dot(self, o: Self) -> S {
        self.0[0] * o.0[0] + self.0[1] * o.0[1] + self.0[2] * o.0[2]
    }

    /// `a × b`.
    #[inline(always)]
    pub fn cross(self, o: Self) -> Self {
        let (a, b) = (self.0, o.0);
        Self([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
    }

    /// `self * s` for a constant `s`.
    #[inline(always)]
    pub fn scaled(self, s: f64) -> Self {
        Self([self.0[0] * s, self.0[1] * s, self.0[2] * s])
    }

    /// The length, `√(a · a)`.
    #[inline(always)]
    pub fn norm(self) -> S {
        self.dot(self).sqrt()
    }
}

impl<S: Scalar> Index<usize> for Vec3<S> {
    type Output = S;
    #[inline(always)]
    fn index(&self, i: usize) -> &S {
        &self.0[i]
    }
}

operators! { [S: Scalar] Vec3<S>;
    Neg neg(a) { Self([-a[0], -a[1], -a[2]]) }
    Add add(a, b: Self) { Self([a[0] + b[0], a[1] + b[1], a[2] + b[2]]) }
    Sub sub(a, b: Self) { Self([a[0] - b[0], a[1] - b[1], a[2] - b[2]]) }
    Mul mul(a, b: S) { Self([a[0] * b, a[1] * b, a[2] * b]) }
    AddAssign add_assign(mut a, b) { *a + b }
}

/// A 3 by 3 matrix, as its columns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mat3<S = f64>(pub [Vec3<S>; 3]);

impl<S: Scalar> Default for Mat3<S> {
    fn default() -> Self {
        Self::IDENTITY
    }
}

impl<S: Scalar> Mat3<S> {
    /// The identity.
    pub const IDENTITY: Self = Self([
        Vec3([S::ONE, S::ZERO, S::ZERO]),
        Vec3([S::ZERO, S::ONE, S::ZERO]),
        Vec3([S::ZERO, S::ZERO, S::ONE]),
    ]);

    /// The zero matrix.
    pub const ZERO: Self = Self([Vec3::ZERO; 3]);

    /// `self * s`.
    #[inline(always)]
    pub fn scaled(&self, s: S) -> Self {
        Self([self.0[0] * s, self.0[1] * s, self.0[2] * s])
    }

    /// `self + o`.
    #[inline(always)]
    pub fn plus(&self, o: &Self) -> Self {
        Self([self.0[0] + o.0[0], self.0[1] + o.0[1], self.0[2] + o.0[2]])
    }

    /// `self − o`.
    #[inline(always)]
    pub fn minus(&self, o: &Self) -> Self {
        Self([self.0[0] - o.0[0], self.0[1] - o.0[1], self.0[2] - o.0[2]])
    }

    /// A constant matrix.
    #[inline(always)]
    pub fn lift(m: Mat3) -> Self {
        Self([Vec3::lift(m.0[0]), Vec3::lift(m.0[1]), Vec3::lift(m.0[2])])
    }

    /// From its rows.
    #[inline(always)]
    pub fn from_rows(r: [[S; 3]; 3]) -> Self {
        Self([0, 1, 2].map(|j| Vec3([r[0][j], r[1][j], r[2][j]])))
    }

    /// `Mᵀ`.
    #[inline(always)]
    pub fn transpose(self) -> Self {
        Self::from_rows(self.0.map(|column| column.0))
    }

    /// `self * v`.
    #[inline(always)]
    pub fn apply(&self, v: Vec3<S>) -> Vec3<S> {
        self.0[0] * v[0] + self.0[1] * v[1] + self.0[2] * v[2]
    }

    /// `selfᵀ * v`.
    #[inline(always)]
    pub fn apply_transposed(&self, v: Vec3<S>) -> Vec3<S> {
        Vec3([self.0[0].dot(v), self.0[1].dot(v), self.0[2].dot(v)])
    }

    /// An entry of `self * oᵀ`.
    #[inline(always)]
    fn entry_of_product(&self, o: &Self, i: usize, j: usize) -> S {
        self.0[0][i] * o.0[0][j] + self.0[1][i] * o.0[1][j] + self.0[2][i] * o.0[2][j]
    }

    /// `self * o`.
    #[inline(always)]
    pub fn times(&self, o: &Self) -> Self {
        Self([self.apply(o.0[0]), self.apply(o.0[1]), self.apply(o.0[2])])
    }
}

impl Mat3 {
    /// A rotation that takes the z axis to the unit vector `axis`; exact for the coordinate axes.
    pub fn with_z_along(axis: Vec3) -> Self {
        let helper = if axis[0].abs() < 0.9 { Self::IDENTITY.0[0] } else { Self::IDENTITY.0[1] };
        let y = axis.cross(helper);
        let y = y * (1.0 / y.norm());
        Self([y.cross(axis), y, axis])
    }
}

/// A symmetric 3 by 3 matrix.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sym3<S = f64> {
    /// Entry (x, x).
    pub xx: S,
    /// Entry (y, y).
    pub yy: S,
    /// Entry (z, z).
    pub zz: S,
    /// Entries (x, y) and (y, x).
    pub xy: S,
    /// Entries (x, z) and (z, x).
    pub xz: S,
    /// Entries (y, z) and (z, y).
    pub yz: S,
}

impl<S: Scalar> Sym3<S> {
    /// A constant matrix.
    #[inline(always)]
    pub fn lift(m: Sym3) -> Self {
        let [xx, yy, zz, xy, xz, yz] = [m.xx, m.yy, m.zz, m.xy, m.xz, m.yz].map(S::constant);
        Self { xx, yy, zz, xy, xz, yz }
    }

    /// `M v`.
    #[inline(always)]
    pub fn apply(&self, v: Vec3<S>) -> Vec3<S> {
        Vec3([
            self.xx * v[0] + self.xy * v[1] + self.xz * v[2],
            self.xy * v[0] + self.yy * v[1] + self.yz * v[2],
            self.xz * v[0] + self.yz * v[1] + self.zz * v[2],
        ])
    }

    /// The sum.
    #[inline(always)]
    pub fn add(&self, o: &Self) -> Self {
        Self {
            xx: self.xx + o.xx,
            yy: self.yy + o.yy,
            zz: self.zz + o.zz,
            xy: self.xy + o.xy,
            xz: self.xz + o.xz,
            yz: self.yz + o.yz,
        }
    }

    /// `r * self * rᵀ`.
    #[inline(always)]
    pub fn rotated(&self, r: &Mat3<S>) -> Self {
        let t = Mat3([
            r.0[0] * self.xx + r.0[1] * self.xy + r.0[2] * self.xz,
            r.0[0] * self.xy + r.0[1] * self.yy + r.0[2] * self.yz,
            r.0[0] * self.xz + r.0[1] * self.yz + r.0[2] * self.zz,
        ]);
        Self {
            xx: t.entry_of_product(r, 0, 0),
            yy: t.entry_of_product(r, 1, 1),
            zz: t.entry_of_product(r, 2, 2),
            xy: t.entry_of_product(r, 0, 1),
            xz: t.entry_of_product(r, 0, 2),
            yz: t.entry_of_product(r, 1, 2),
        }
    }

    /// `mass (|c|² 1 − c cᵀ)`: the inertia about the origin of a point mass at `c`.
    #[inline(always)]
    pub fn of_point(mass: S, c: Vec3<S>) -> Self {
        let (x, y, z) = (c[0] * mass, c[1] * mass, c[2] * mass);
        let (xx, yy, zz) = (x * c[0], y * c[1], z * c[2]);
        Self {
            xx: yy + zz,
            yy: xx + zz,
            zz: xx + yy,
            xy: -(x * c[1]),
            xz: -(x * c[2]),
            yz: -(y * c[2]),
        }
    }
}

/// A twist: angular velocity and the velocity of the body's point at the origin.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Motion<S = f64> {
    /// Angular velocity.
    pub w: Vec3<S>,
    /// Velocity of the point at the origin.
    pub v: Vec3<S>,
}

impl<S: Scalar> Motion<S> {
    /// `self + s o`.
    #[inline(always)]
    pub fn add_scaled(self, s: S, o: Self) -> Self {
        Self { w: self.w + o.w * s, v: self.v + o.v * s }
    }

    /// `s self`.
    #[inline(always)]
    pub fn scaled(self, s: S) -> Self {
        Self { w: self.w * s, v: self.v * s }
    }

    /// Velocity of the body's point at `x`, which is measured from the origin.
    #[inline(always)]
    pub fn at(self, x: Vec3<S>) -> Vec3<S> {
        self.v + self.w.cross(x)
    }

    /// The difference.
    #[inline(always)]
    pub fn minus(self, o: Self) -> Self {
        Self { w: self.w - o.w, v: self.v - o.v }
    }

    /// Motion cross product `self × o`.
    #[inline(always)]
    pub fn cross(self, o: Self) -> Self {
        Self { w: self.w.cross(o.w), v: self.w.cross(o.v) + self.v.cross(o.w) }
    }

    /// Force cross product `self ×* f`.
    #[inline(always)]
    pub fn cross_force(self, f: Force<S>) -> Force<S> {
        Force { n: self.w.cross(f.n) + self.v.cross(f.f), f: self.w.cross(f.f) }
    }

    /// Power.
    #[inline(always)]
    pub fn dot(self, f: Force<S>) -> S {
        self.w.dot(f.n) + self.v.dot(f.f)
    }
}

/// A wrench or a momentum: moment about the origin and force.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Force<S = f64> {
    /// Moment about the origin.
    pub n: Vec3<S>,
    /// Force.
    pub f: Vec3<S>,
}

impl<S: Scalar> Force<S> {
    /// The sum.
    #[inline(always)]
    pub fn plus(self, o: Self) -> Self {
        Self { n: self.n + o.n, f: self.f + o.f }
    }

    /// `self + s o`.
    #[inline(always)]
    pub fn add_scaled(self, s: S, o: Self) -> Self {
        Self { n: self.n + o.n * s, f: self.f + o.f * s }
    }
}

/// A rigid-body inertia about the origin: mass, first moment `m c`, and the inertia tensor.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Inertia<S = f64> {
    /// Mass.
    pub mass: S,
    /// First moment of mass: mass times the centre of mass.
    pub moment: Vec3<S>,
    /// Inertia tensor about the origin.
    pub tensor: Sym3<S>,
}

impl<S: Scalar> Inertia<S> {
    /// Momentum of a body that moves with `motion`.
    #[inline(always)]
    pub fn momentum(&self, motion: Motion<S>) -> Force<S> {
        Force {
            n: self.tensor.apply(motion.w) + self.moment.cross(motion.v),
            f: motion.v * self.mass - self.moment.cross(motion.w),
        }
    }
}

/// A pose: the columns of its rotation, and where it is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pose<S = f64> {
    /// First column.
    pub x: Vec3<S>,
    /// Second column.
    pub y: Vec3<S>,
    /// Third column.
    pub z: Vec3<S>,
    /// Position.
    pub at: Vec3<S>,
}

impl<S: Scalar> Pose<S> {
    /// Its rotation.
    #[inline(always)]
    pub fn rotation(&self) -> Mat3<S> {
        Mat3([self.x, self.y, self.z])
    }
}

/// The three numbers that begin at `i`: those of a ball joint.
#[inline(always)]
pub fn three<S: Scalar>(values: &[S], i: usize) -> Vec3<S> {
    Vec3([values[i], values[i + 1], values[i + 2]])
}
