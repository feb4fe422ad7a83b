//! Numbers, vectors, matrices and their factorizations: knows no mechanics.

pub mod dense_inverse;
pub mod eights;
pub mod elimination;
pub mod gemm;
pub mod hash;
pub mod norms;
pub mod null_space;
pub mod pivoted_lu;
pub mod rotation;
pub mod rows;

pub mod scalar;
pub mod sided;
pub mod simd;
pub mod sparse_map;
pub mod spatial;
pub mod spline;
pub mod sums;
pub mod tree_lu;
pub mod trigonometry;
pub mod unrolled;
