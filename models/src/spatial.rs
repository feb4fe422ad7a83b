//! Vectors, rotations, twists, wrenches and inertias in three dimensions.
//!
//! Spatial vectors list the angular part first and use world axes. A twist is the velocity field of
//! a rigid body given at the origin of an evaluation, a wrench is a force or momentum about it.

use std::ops::{Add, AddAssign, Index, Mul, Neg, Sub};

/// A vector in three dimensions.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Vec3(pub(crate) [f64; 3]);

impl Vec3 {
    pub(crate) const ZERO: Self = Self([0.0; 3]);

    #[inline(always)]
    pub(crate) fn dot(self, o: Self) -> f64 {
        self.0[0] * o.0[0] + self.0[1] * o.0[1] + self.0[2] * o.0[2]
    }

    #[inline(always)]
    pub(crate) fn cross(self, o: Self) -> Self {
        let (a, b) = (self.0, o.0);
        Self([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
    }

    #[inline(always)]
    pub(crate) fn norm(self) -> f64 {
        self.dot(self).sqrt()
    }
}

impl Index<usize> for Vec3 {
    type Output = f64;
    #[inline(always)]
    fn index(&self, i: usize) -> &f64 {
        &self.0[i]
    }
}

impl Add for Vec3 {
    type Output = Self;
    #[inline(always)]
    fn add(self, o: Self) -> Self {
        Self([self.0[0] + o.0[0], self.0[1] + o.0[1], self.0[2] + o.0[2]])
    }
}

impl AddAssign for Vec3 {
    #[inline(always)]
    fn add_assign(&mut self, o: Self) {
        *self = *self + o;
    }
}

impl Sub for Vec3 {
    type Output = Self;
    #[inline(always)]
    fn sub(self, o: Self) -> Self {
        Self([self.0[0] - o.0[0], self.0[1] - o.0[1], self.0[2] - o.0[2]])
    }
}

impl Neg for Vec3 {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        self * -1.0
    }
}

impl Mul<f64> for Vec3 {
    type Output = Self;
    #[inline(always)]
    fn mul(self, s: f64) -> Self {
        Self([self.0[0] * s, self.0[1] * s, self.0[2] * s])
    }
}

/// A 3 by 3 matrix, as its columns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Mat3(pub(crate) [Vec3; 3]);

impl Default for Mat3 {
    fn default() -> Self {
        Self::IDENTITY
    }
}

impl Mat3 {
    pub(crate) const IDENTITY: Self =
        Self([Vec3([1.0, 0.0, 0.0]), Vec3([0.0, 1.0, 0.0]), Vec3([0.0, 0.0, 1.0])]);

    pub(crate) fn from_rows(r: [[f64; 3]; 3]) -> Self {
        Self([0, 1, 2].map(|j| Vec3([r[0][j], r[1][j], r[2][j]])))
    }

    pub(crate) fn transpose(self) -> Self {
        Self::from_rows(self.0.map(|column| column.0))
    }

    /// `self * v`.
    #[inline(always)]
    pub(crate) fn apply(&self, v: Vec3) -> Vec3 {
        self.0[0] * v[0] + self.0[1] * v[1] + self.0[2] * v[2]
    }

    /// `selfᵀ * v`.
    #[inline(always)]
    pub(crate) fn apply_transposed(&self, v: Vec3) -> Vec3 {
        Vec3([self.0[0].dot(v), self.0[1].dot(v), self.0[2].dot(v)])
    }

    /// `self * o`.
    #[inline(always)]
    pub(crate) fn times(&self, o: &Self) -> Self {
        Self([self.apply(o.0[0]), self.apply(o.0[1]), self.apply(o.0[2])])
    }

    /// A rotation that takes the z axis to the unit vector `axis`; exact for the coordinate axes.
    pub(crate) fn with_z_along(axis: Vec3) -> Self {
        let helper = if axis[0].abs() < 0.9 { Self::IDENTITY.0[0] } else { Self::IDENTITY.0[1] };
        let y = axis.cross(helper);
        let y = y * (1.0 / y.norm());
        Self([y.cross(axis), y, axis])
    }
}

/// A symmetric 3 by 3 matrix.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Sym3 {
    pub(crate) xx: f64,
    pub(crate) yy: f64,
    pub(crate) zz: f64,
    pub(crate) xy: f64,
    pub(crate) xz: f64,
    pub(crate) yz: f64,
}

impl Sym3 {
    #[inline(always)]
    pub(crate) fn apply(&self, v: Vec3) -> Vec3 {
        Vec3([
            self.xx * v[0] + self.xy * v[1] + self.xz * v[2],
            self.xy * v[0] + self.yy * v[1] + self.yz * v[2],
            self.xz * v[0] + self.yz * v[1] + self.zz * v[2],
        ])
    }

    #[inline(always)]
    pub(crate) fn add(&self, o: &Self) -> Self {
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
    pub(crate) fn rotated(&self, r: &Mat3) -> Self {
        let t = Mat3([
            r.0[0] * self.xx + r.0[1] * self.xy + r.0[2] * self.xz,
            r.0[0] * self.xy + r.0[1] * self.yy + r.0[2] * self.yz,
            r.0[0] * self.xz + r.0[1] * self.yz + r.0[2] * self.zz,
        ]);
        let entry = |i: usize, j: usize| {
            t.0[0][i] * r.0[0][j] + t.0[1][i] * r.0[1][j] + t.0[2][i] * r.0[2][j]
        };
        Self {
            xx: entry(0, 0),
            yy: entry(1, 1),
            zz: entry(2, 2),
            xy: entry(0, 1),
            xz: entry(0, 2),
            yz: entry(1, 2),
        }
    }

    /// `mass (|c|² 1 − c cᵀ)`: the inertia about the origin of a point mass at `c`.
    #[inline(always)]
    pub(crate) fn of_point(mass: f64, c: Vec3) -> Self {
        let (x, y, z) = (mass * c[0], mass * c[1], mass * c[2]);
        let (xx, yy, zz) = (x * c[0], y * c[1], z * c[2]);
        Self { xx: yy + zz, yy: xx + zz, zz: xx + yy, xy: -x * c[1], xz: -x * c[2], yz: -y * c[2] }
    }
}

/// A twist: angular velocity and the velocity of the body's point at the origin.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Motion {
    pub(crate) w: Vec3,
    pub(crate) v: Vec3,
}

impl Motion {
    #[inline(always)]
    pub(crate) fn add_scaled(self, s: f64, o: Self) -> Self {
        Self { w: self.w + o.w * s, v: self.v + o.v * s }
    }

    /// Motion cross product `self × o`.
    #[inline(always)]
    pub(crate) fn cross(self, o: Self) -> Self {
        Self { w: self.w.cross(o.w), v: self.w.cross(o.v) + self.v.cross(o.w) }
    }

    /// Force cross product `self ×* f`.
    #[inline(always)]
    pub(crate) fn cross_force(self, f: Force) -> Force {
        Force { n: self.w.cross(f.n) + self.v.cross(f.f), f: self.w.cross(f.f) }
    }

    /// Power.
    #[inline(always)]
    pub(crate) fn dot(self, f: Force) -> f64 {
        self.w.dot(f.n) + self.v.dot(f.f)
    }
}

/// A wrench or a momentum: moment about the origin and force.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Force {
    pub(crate) n: Vec3,
    pub(crate) f: Vec3,
}

impl Force {
    #[inline(always)]
    pub(crate) fn add_scaled(self, s: f64, o: Self) -> Self {
        Self { n: self.n + o.n * s, f: self.f + o.f * s }
    }
}

/// A rigid-body inertia about the origin: mass, first moment `m c`, and the inertia tensor.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Inertia {
    pub(crate) mass: f64,
    pub(crate) moment: Vec3,
    pub(crate) tensor: Sym3,
}

impl Inertia {
    /// Momentum of a body that moves with `motion`.
    #[inline(always)]
    pub(crate) fn momentum(&self, motion: Motion) -> Force {
        Force {
            n: self.tensor.apply(motion.w) + self.moment.cross(motion.v),
            f: motion.v * self.mass - self.moment.cross(motion.w),
        }
    }
}
