//! The recursion, one stage after the other, with the kernel that fits their size.

use nalgebra::{DMatrix, DVector};
use plantd_math::gemm::LANES;
use plantd_math::sparse_map::Map;

use crate::lq::condition::reciprocal_condition;
use crate::lq::cost_to_go::CostToGo;
use crate::lq::large::LargeKernel;
use crate::lq::small;
use crate::lq::small::SMALL;
use crate::lq::stage::{NotConvex, Stage};

/// The recursion with the cost to go `½ xᵀPx + bᵀx` that it has reached.
#[derive(Debug)]
pub(crate) struct LqRecursion {
    cost: CostToGo,
    /// Lower triangular factor of the last `Γ`.
    factor: DMatrix<f64>,
    large: LargeKernel,
}

impl LqRecursion {
    /// Room for `n` states and `m` inputs; begins with zero cost.
    pub(crate) fn new(n: usize, m: usize) -> Self {
        let (cost, factor) = (CostToGo::zero(n), DMatrix::identity(m, m));
        Self { cost, factor, large: LargeKernel::default() }
    }

    /// Begins at the end of the horizon, with `P = value` and `b = linear` (none means zero).
    pub(crate) fn begin(&mut self, value: &DMatrix<f64>, linear: Option<&DVector<f64>>) {
        self.cost.set(value, linear);
    }

    /// `P`, n × n, symmetric.
    pub(crate) fn value(&self) -> DMatrix<f64> {
        let (n, numbers) = (self.cost.states, self.cost.numbers());
        DMatrix::from_fn(n, n, |i, j| numbers[n.next_multiple_of(LANES) * j + i])
    }

    /// Whether all of `P` is finite.
    pub(crate) fn is_finite(&self) -> bool {
        self.cost.numbers().iter().all(|entry| entry.is_finite())
    }

    /// `b`, n entries.
    pub(crate) fn linear(&self) -> &DVector<f64> {
        &self.cost.linear
    }

    /// Reciprocal condition, in the 1-norm, of the last step's `Γ`; 1 before the first. About `2m³`
    /// flops.
    pub(crate) fn reciprocal_condition(&self) -> f64 {
        reciprocal_condition(&self.factor)
    }

    /// One stage back, through the map `x[k+1] = A x + B u`: the law that is best there,
    /// `u = −gain x − offset`, with `Γ = R + BᵀPB`, `gain = Γ⁻¹(BᵀPA + Sᵀ)`,
    /// `offset = Γ⁻¹(Bᵀb + u_linear)`. On failure the cost to go is that of the stage before.
    ///
    /// Allocates nothing after the first step with the same numbers of states and inputs, unless `S`
    /// has entries of states that `A` leaves out. `A` may lead from one number of states to another.
    pub(crate) fn step(
        &mut self,
        map: &Map,
        stage: Stage<'_>,
        gain: &mut DMatrix<f64>,
        offset: &mut DVector<f64>,
    ) -> Result<(), NotConvex> {
        let Map { next, states: n, inputs: m, .. } = *map;
        assert!(self.cost.states == next, "A and B fit P");
        assert!(stage.q.shape() == (n, n) && stage.r.shape() == (m, m), "Q and R fit A and B");
        assert!(stage.s.is_none_or(|s| s.shape() == (n, m)), "S fits Q and R");
        assert!(gain.shape() == (m, n) && offset.len() == m, "room for the law");
        if self.factor.nrows() != m {
            self.factor = DMatrix::identity(m, m);
        }
        let Self { cost, factor, large } = self;
        if next > SMALL || n > SMALL || m > SMALL {
            if stage.s.is_some_and(|s| reaches_beyond(s, &map.active)) {
                return large.step(&map.with_all_states(), stage, cost, factor, gain, offset);
            }
            return large.step(map, stage, cost, factor, gain, offset);
        }
        match (next, n, m) {
            (2, 2, 1) => small::step::<2>((2, 2, 1), map, stage, cost, factor, gain, offset),
            (4, 4, 1) => small::step::<4>((4, 4, 1), map, stage, cost, factor, gain, offset),
            sizes => small::step::<SMALL>(sizes, map, stage, cost, factor, gain, offset),
        }
    }
}

/// Whether `S` has entries of states that are not active.
fn reaches_beyond(s: &DMatrix<f64>, active: &[usize]) -> bool {
    let mut rest = active;
    (0..s.nrows()).any(|state| match rest.split_first() {
        Some((first, others)) if *first == state => {
            rest = others;
            false
        }
        _ => s.row(state).iter().any(|entry| *entry != 0.0),
    })
}
