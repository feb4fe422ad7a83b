//! The Lagrangian `L(q, v) = T(q, v) − V(q)` of a tree of rigid bodies, and generalized forces `f(q, v, u)`.
//!
//! [`mechanics`] gives `L_q` and `L_v` of one model, in space from [`kinematics`], [`momenta`] and
//! [`curvature`], which add up along the tree by [`sums`], in planes from [`planar`]; [`derivatives`] has the second derivatives and those of forces as
//! matrices. Each potential is a file in [`potentials`], each force a file in [`forces`].

pub(crate) mod armature;
pub(crate) mod arrangement;
pub(crate) mod curvature;
pub(crate) mod derivatives;
pub(crate) mod energy;
pub(crate) mod fields;
pub(crate) mod forces;
pub(crate) mod generators;
pub(crate) mod instant;
pub(crate) mod kinematics;
pub(crate) mod mechanics;
pub(crate) mod momenta;
pub(crate) mod nudge;
pub(crate) mod planar;
pub(crate) mod plane;
pub(crate) mod potentials;
#[cfg(test)]
pub(crate) mod samples;
pub(crate) mod stop;
pub(crate) mod sums;
pub(crate) mod ties;
pub(crate) mod turning;
pub(crate) mod vectors;
