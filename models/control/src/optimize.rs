//! Trajectory optimisation by projection-operator Newton.
//!
//! ```text
//! minimise   Σ_{k<n} l(x[k], u[k], k) + l_final(x[n])     over motions  x[k+1] = f(x[k], u[k])
//! l       = ½ dxᵀQ dx + dxᵀS du + ½ duᵀR du + x_linearᵀ dx + u_linearᵀ du
//! l_final = ½ dxᵀ Q_f dx            dx = x ⊖ x_desired[k],  du = u − u_desired[k]
//! ```
//!
//! The method is that of Hauser ("A projection operator approach to the optimization of trajectory
//! functionals", 2002), in discrete time as by Johnson, Schultz and Murphey. About the trajectory
//! `(x̄, ū)` an iteration
//!
//! 1. linearizes the map, `A[k]`, `B[k]`, and finds the gains `K[k]` of a time-varying regulator, the
//!    **projection**: it makes a motion of the plant of any curve `(x̃, ũ)`, by
//!    `u[k] = ũ[k] − K[k] (x[k] ⊖ x̃[k])`;
//! 2. finds the **direction** `(dx, du)` that is best for a quadratic model of the cost under the
//!    linearized map: a linear-quadratic problem with linear terms. Its second derivatives are
//!
//!    | method | second derivatives |
//!    | --- | --- |
//!    | [`Method::Steepest`] | identity |
//!    | [`Method::QuasiNewton`] | of the cost |
//!    | [`Method::Newton`] | of the cost and of the map, `∇²l + Σ z_i ∇²f_i`, with the adjoint `z[k] = l_x − Kᵀ l_u + (A − BK)ᵀ z[k+1]` |
//!
//!    Where the model has no minimum, the direction does not descend or no step along it does, Newton
//!    **falls back** to quasi-Newton, and that to steepest descent; but where the weights leave even the last input
//!    without a minimum (`R + BᵀQ_f B` is not positive definite), the search ends and says so;
//! 3. goes along the direction by Armijo's rule: the longest of the steps `β^m` whose projection
//!    lowers the cost by at least `α β^m` times what the directional derivative promises.
//!
//! The projection may be any regulator: to first order it leaves directions as they are. Unless
//! [`Options::projection`] says otherwise it is the law of step 2: one recursion serves both, the law
//! knows what the cost cares for, so that longer steps are taken, and Newton's adjoint is the linear
//! part of the cost to go. That is differential dynamic programming with directions that are tangent
//! vectors. Johnson, Schultz and Murphey project with identities for weights: more and shorter steps, but
//! an unstable plant is held on its course whatever the cost leaves out.
//!
//! The search has converged when the directional derivative is within the tolerance.
//! Every iterate is a motion of the plant, whatever constraints and prescribed coordinates it has.
//! Newton's method converges quadratically, and away from a minimum it falls back; quasi-Newton does
//! nearly as well where the desired motion can be followed closely, and costs less.
//!
//! **Orientations.** Differences of ball joints are rotation vectors, and directions live in the
//! tangent space: the first derivatives go through the derivative of the logarithm. Quasi-Newton leaves
//! out its second derivative (Gauss-Newton), Newton has it.
//!
//! **Projected momentum.** With constraints the momentum of the state holds a part that depends on the
//! step. With [`Momentum::Projected`](crate::Momentum::Projected) the cost weighs `p̃` in its place
//! ([`Plant::projected_momentum`](plantd_models::Plant::projected_momentum)):
//!
//! ```text
//! dx = (q ⊖ q_d, p̃(x) − p̃(x_d), v − v_d)        l_x = Tᵀ (Q dx + S du + x_linear)        T = ∂(q, p̃, v)/∂x
//! ```
//!
//! The desired state is projected, too, so that a motion of the plant does not deviate from itself; a
//! desired momentum that is projected already stays as it is. Derivatives are exact, second ones `TᵀQT`
//! and `TᵀS`: all methods leave out the curvature of `p̃` (Gauss-Newton), so that Newton's method
//! converges quadratically only where the desired momentum is reached, and descends everywhere as before.
//! Each evaluation of the cost takes a factorization of the mass matrix, each iteration O(n³) per step, and
//! `∂p̃/∂x` of all steps is kept.
//! Bounds, the weight of a free initial state and [`Options::projection`] stay with the state's own
//! momentum; what a free initial momentum has along `Dh_dᵀ` then costs nothing, and stays but for
//! round-off. Without constraints nothing changes.
//!
//! **Bounds** are held by an augmented Lagrangian: each end of each bound at each step has a multiplier
//! `λ` and adds `(max(0, λ + ρ c)² − λ²) / 2ρ` for its excess `c`, whose kink is passed over (semi-smooth
//! Newton). `ρ` is the penalty times the weight of the entry in the cost, or the mean weight where that
//! is zero. When the bounds are not met and the directional derivative is within a hundredth of the
//! penalties' energy `Σ ½ ρ error²` and a millionth of the first cost, the multipliers are renewed,
//! `λ ← max(0, λ + ρ c)`, and the penalty, 10 at first, grows fourfold if the error has not fallen to a
//! half. Between two renewals is at least one step, whatever the tolerance: only then the error says what
//! multipliers and penalty do. Where the promised decrease drowns in the round-off of the cost, steps are
//! taken that do not raise it beyond that, as long as they lessen the directional derivative. The search
//! has converged when besides the directional derivative the error, `max |max(c, −λ/ρ)|`, is within
//! `bound_tolerance`. Bounds of a rotation vector's entries count without their curvature. Equal ends fix
//! an entry, so that bounds of the final state make terminal constraints.
//!
//! **A free initial state** moves along its free entries in the tangent space of the constraints, and
//! is brought back onto them after each step; the curvature of the constraints is left out, so that
//! Newton's method is then a Gauss-Newton method in these directions.
//!
//! ```
//! use std::sync::Arc;
//! use nalgebra::DMatrix;
//! use plantd_control::{Momentum, Weights};
//! use plantd_control::optimize::{Bounds, Options, Optimizer, Status, TrajectoryCost};
//! use plantd_models::{Initial, Model, Plant, Settings, builtin};
//!
//! // Swing the pendulum up within 5 s and hold it there.
//! let model = Arc::new(Model::compile(&builtin::scene("pendulum").unwrap())?);
//! let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model))?;
//! plant.initialize(&Initial::Momentum { q: vec![0.0], p: vec![0.0], v: vec![] })?;
//! let desired = DMatrix::from_fn(101, 2, |k, i| if i == 0 && k >= 50 { 3.14 } else { 0.0 });
//! let weights = Weights::diagonal(&[100.0, 1.0], &[10.0])?;
//! let cost = TrajectoryCost {
//!     x: desired,
//!     u: DMatrix::zeros(100, 1),
//!     weights: weights.into(),
//!     momentum: Momentum::State,
//! };
//! let guess = DMatrix::zeros(100, 1);
//! let mut search =
//!     Optimizer::new(plant, guess, cost, &Bounds::default(), None, Options::default())?;
//! while search.status() == Status::Running {
//!     search.iterate(&mut || true)?;
//! }
//! assert_eq!(search.status(), Status::Converged);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

// In the order of an iteration: `search`, `problem` (the cost), `derivatives` of it, `linearizer` (of the map),
// `projection`, `direction`, `trials`, and `search/ending`.
mod bounds;
mod chart;
mod derivatives;
mod direction;
mod error;
mod linearizer;
mod options;
mod problem;
mod products;
mod progress;
mod projection;
mod question;
mod search;
mod specification;
#[cfg(test)]
mod tests;
mod trajectory;
mod trials;

pub use crate::optimize::error::{BoundFault, BoundState, OptimizeError, Stuck};
pub use crate::optimize::options::{Method, Options};
pub use crate::optimize::progress::{Checkpoint, Fallback, Progress, Status};
pub use crate::optimize::search::Optimizer;
pub use crate::optimize::specification::{Bound, Bounds, FreeInitialState, TrajectoryCost};
