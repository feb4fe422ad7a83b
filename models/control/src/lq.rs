//! One stage of the linear-quadratic problem, backwards: the kernel under regulators and trajectory
//! optimisation.
//!
//! ```text
//! Γ = R + BᵀPB = L Lᵀ        X = AᵀPB + S        Y = X L⁻ᵀ        y = L⁻¹ (Bᵀb + u_linear)
//! K = L⁻ᵀ Yᵀ                 offset = L⁻ᵀ y
//! P ← Q + AᵀPA − Y Yᵀ        b ← x_linear + Aᵀb − Y y
//! ```
//!
//! With `M = [B A]` everything comes from `G = MᵀPM`: its blocks are `BᵀPB`, `AᵀPB` and `AᵀPA`. A
//! discrete map has rows that say little (the next prescribed coordinate is the input, its velocity is
//! a difference quotient) and columns that are zero (velocities of prescribed coordinates). A [`Map`]
//! leaves them out: products run over the other rows and columns, a row of a few entries is
//! added entry by entry, and where a zero column leaves `P` as the weight is, its zeros are not
//! multiplied either. Of symmetric results the lower triangle is computed.

pub(crate) mod condition;
mod cost_to_go;
mod kernels;
mod large;
pub(crate) mod recursion;
mod small;
pub(crate) mod stage;
#[cfg(test)]
mod tests;
