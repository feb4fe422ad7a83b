//! The linear system of a step, `[K −A0ᵀ; A1 0]`, factored and solved.
//!
//! [`system`] is the one door: it factors, solves, and falls back. Behind it any scene has a tree LU of `K` with
//! the Schur complement of its constraints ([`schur`]); [`planar`] and [`space`] eliminate trees in O(n), to which
//! [`tied`] adds what acts between branches, and [`pushes`] constraints in linearizations, [`closing`] both in products
//! with these, and
//! [`loops`] planar mechanisms together with their constraints, front by front, [`held`] limbs with the equations
//! that hold their ends.

pub(crate) mod closing;
pub(crate) mod held;
pub(crate) mod loops;
pub(crate) mod planar;
pub(crate) mod pushes;
pub(crate) mod schur;
pub(crate) mod space;
pub(crate) mod system;
pub(crate) mod tied;
