//! One stage of a linear-quadratic problem.

use nalgebra::{DMatrix, DVector};

/// One stage of the cost,
/// `½ xᵀQx + xᵀSu + ½ uᵀRu + x_linearᵀx + u_linearᵀu`. Nothing here need be definite.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stage<'a> {
    /// `Q`, n × n, symmetric.
    pub(crate) q: &'a DMatrix<f64>,
    /// `R`, m × m, symmetric.
    pub(crate) r: &'a DMatrix<f64>,
    /// `S`, n × m; none means zero.
    pub(crate) s: Option<&'a DMatrix<f64>>,
    /// n entries; none means zero.
    pub(crate) x_linear: Option<&'a DVector<f64>>,
    /// m entries; none means zero.
    pub(crate) u_linear: Option<&'a DVector<f64>>,
}

/// `R + BᵀPB` is not positive definite: the stage has no minimum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct NotConvex;
