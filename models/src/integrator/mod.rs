//! The variational integrator: one step of the forced, constrained discrete Euler-Lagrange equations.
//!
//! Read [`residual`] first: it has the equations. [`newton`] solves them, from the guess of [`predictor`] and [`push`], at
//! the [`midpoint`], with matrices that [`matrix`] fills and [`crate::kkt`] factors; [`balls`] replaces
//! coordinates of ball joints by orientations. [`collocation`] is the method of higher orders, of which
//! [`scheme`] has the coefficients. [`abreast`] takes steps of several plants side by side, [`few`] those of a few joints.

pub(crate) mod abreast;
pub(crate) mod ball_maps;
pub(crate) mod balls;
pub(crate) mod blocks;
pub(crate) mod collocation;
pub(crate) mod explain;
pub(crate) mod few;
pub(crate) mod foresight;
pub(crate) mod matrix;
pub(crate) mod midpoint;
pub(crate) mod newton;
pub(crate) mod parameters;
pub(crate) mod point;
pub(crate) mod predictor;
pub(crate) mod push;
pub(crate) mod report;
pub(crate) mod residual;
pub(crate) mod response;
pub(crate) mod scheme;
pub(crate) mod settings;
pub(crate) mod state;
pub(crate) mod workspace;
