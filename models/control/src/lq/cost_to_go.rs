//! The cost to go, `½ xᵀPx + bᵀx`.

use nalgebra::{DMatrix, DVector};
use plantd_math::gemm::{LANES, Scratch};

/// Where `Q + AᵀPA − KᵀΓK` leaves less than this of a diagonal entry, it is computed again as a sum
/// that cancels less.
pub(super) const CANCELLED: f64 = 1e-3;

/// `P` and `b` of `½ xᵀPx + bᵀx`.
#[derive(Debug)]
pub(super) struct CostToGo {
    /// n.
    pub(super) states: usize,
    /// `P` by columns, which begin on cache lines; zeros between them.
    value: Scratch,
    /// `b`, n entries.
    pub(super) linear: DVector<f64>,
}

impl CostToGo {
    /// No cost, of `n` states.
    pub(super) fn zero(n: usize) -> Self {
        let mut cost = Self { states: n, value: Scratch::default(), linear: DVector::zeros(n) };
        cost.set_states(n);
        cost
    }

    /// Takes `P` and `b`; none means zero.
    pub(super) fn set(&mut self, value: &DMatrix<f64>, linear: Option<&DVector<f64>>) {
        let stride = self.set_states(value.nrows());
        for (target, source) in
            self.value.numbers().chunks_exact_mut(stride.max(1)).zip(value.column_iter())
        {
            target[..value.nrows()].copy_from_slice(source.as_slice());
        }
        match linear {
            Some(linear) => self.linear.copy_from(linear),
            None => self.linear.fill(0.0),
        }
    }

    /// Makes `P` one of `n` states, zeros at first if that changes anything; from a column to the next.
    pub(super) fn set_states(&mut self, n: usize) -> usize {
        let stride = n.next_multiple_of(LANES);
        self.value.reserve(stride * n);
        if self.states != n {
            self.states = n;
            self.linear = DVector::zeros(n);
            self.value.numbers().fill(0.0);
        }
        stride
    }

    /// `P`, with its padding.
    pub(super) fn numbers(&self) -> &[f64] {
        self.value.read()
    }

    /// `P`, with its padding, to write.
    pub(super) fn numbers_mut(&mut self) -> &mut [f64] {
        self.value.numbers()
    }
}
