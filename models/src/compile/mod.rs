//! From scene to model: what a person wrote becomes what a step computes with.
//!
//! Read [`scene`] first: it resolves names, merges fixed joints, lumps bodies, and puts the model together
//! from [`springs`] and [`forces`]. [`pattern`] says which coordinates are coupled, [`loops`] in which order
//! joints and closing equations are eliminated, [`held`] limbs whose ends are held, [`singular`] refuses what moves without resistance, and
//! [`inertia`] what no body weighs; [`settling`] finds the stiffness of stops.
//! [`explain`] and [`cost`] tell people what came out.

pub(crate) mod cost;
mod explain;
pub(crate) mod forces;
mod held;
mod inertia;
pub(crate) mod loops;
mod pattern;
pub(crate) mod scene;
mod settling;
mod singular;
mod springs;
