//! The discrete map differentiated: `A = ∂x[k+1]/∂x[k]`, `B = ∂x[k+1]/∂u[k]`, multipliers, second derivatives.
//!
//! Everything is differentiated by one list of parameters, `θ = (q, p, u, k)` ([`parameters`](crate::integrator::parameters)). Read
//! [`linearize`] first: it has the equations of a step; [`mod@step`] fills their right-hand sides, with ball
//! joints [`turned`], [`chain`] goes on over the steps of a period, [`collocation`] over stages, [`map`] hands
//! it to linear-quadratic problems, [`matrices`] to whoever wants `A` and `B`, [`derivative`] to whoever wants no
//! more than products with them, and [`second_order`] differentiates once more.

pub(crate) mod chain;
pub(crate) mod collocation;
pub(crate) mod derivative;
pub(crate) mod ends;
pub(crate) mod linearize;
pub(crate) mod map;
pub(crate) mod matrices;
pub(crate) mod second_order;
pub(crate) mod step;
pub(crate) mod turned;
