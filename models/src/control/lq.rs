//! One stage of the linear-quadratic problem, backwards: the kernel under regulators and trajectory
//! optimisation.

use nalgebra::{DMatrix, DVector};

use super::symmetrize;

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

/// The recursion with the cost to go `½ xᵀPx + bᵀx` that it has reached.
#[derive(Clone, Debug)]
pub(crate) struct LqRecursion {
    value: DMatrix<f64>,
    linear: DVector<f64>,
}

impl LqRecursion {
    /// Room for `n` states and `m` inputs; begins with zero cost.
    pub(crate) fn new(n: usize, _m: usize) -> Self {
        Self { value: DMatrix::zeros(n, n), linear: DVector::zeros(n) }
    }

    /// Begins at the end of the horizon, with `P = value` and `b = linear` (none means zero).
    pub(crate) fn begin(&mut self, value: &DMatrix<f64>, linear: Option<&DVector<f64>>) {
        self.value.copy_from(value);
        match linear {
            Some(linear) => self.linear.copy_from(linear),
            None => self.linear.fill(0.0),
        }
    }

    /// `P`, n × n, symmetric.
    pub(crate) fn value(&self) -> &DMatrix<f64> {
        &self.value
    }

    /// `b`, n entries.
    pub(crate) fn linear(&self) -> &DVector<f64> {
        &self.linear
    }

    /// One stage back, through `x[k+1] = A x + B u`: the law that is best there,
    /// `u = −gain x − offset`, with `Γ = R + BᵀPB`, `gain = Γ⁻¹(BᵀPA + Sᵀ)`,
    /// `offset = Γ⁻¹(Bᵀb + u_linear)`. On failure the cost to go is that of the stage before.
    pub(crate) fn step(
        &mut self,
        a: &DMatrix<f64>,
        b: &DMatrix<f64>,
        stage: Stage<'_>,
        gain: &mut DMatrix<f64>,
        offset: &mut DVector<f64>,
    ) -> Result<(), NotConvex> {
        let bt_p = (&self.value * b).transpose();
        let mut bracket = &bt_p * b + stage.r;
        symmetrize(&mut bracket);
        let mut cross = bt_p * a;
        if let Some(s) = stage.s {
            cross += s.transpose();
        }
        let mut input = b.tr_mul(&self.linear);
        if let Some(u_linear) = stage.u_linear {
            input += u_linear;
        }
        let factor = bracket.cholesky().ok_or(NotConvex)?;
        gain.copy_from(&factor.solve(&cross));
        offset.copy_from(&factor.solve(&input));
        let mut value = stage.q + a.transpose() * (&self.value * a) - cross.transpose() * &*gain;
        symmetrize(&mut value);
        let mut linear = a.tr_mul(&self.linear) - cross.tr_mul(offset);
        if let Some(x_linear) = stage.x_linear {
            linear += x_linear;
        }
        self.value = value;
        self.linear = linear;
        Ok(())
    }
}
