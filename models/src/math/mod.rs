//! Numbers, vectors, matrices and their factorizations: knows no mechanics.

pub(crate) mod dense_inverse;
pub(crate) mod elimination;
pub(crate) mod gemm;
pub(crate) mod hash;
pub(crate) mod norms;
pub(crate) mod null_space;
pub(crate) mod pivoted_lu;
pub(crate) mod rotation;
pub(crate) mod rows;
#[allow(dead_code, reason = "derivatives of second order use all of it")]
pub(crate) mod scalar;
pub(crate) mod simd;
pub(crate) mod sparse_map;
pub(crate) mod spatial;
pub(crate) mod spline;
pub(crate) mod sums;
pub(crate) mod tree_lu;
pub(crate) mod trigonometry;
