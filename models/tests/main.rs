//! The mechanics against independent means, seen from outside.
//!
//! One program, in a package of its own: the mechanics is optimised, its tests need not be, and are built in a fifth of
//! the time.

mod accuracy;
mod closures;
mod collocation;
mod common;
mod continuous;
mod costs;
mod derivatives;
mod diagnose;
mod drawing;
mod elements;
mod fleet;
mod forces;
mod guess;
mod joints;
mod kinematics;
mod motion;
mod periods;
mod random;
mod redundancy;
mod refusals;
mod restored;
mod second_order;
mod settle;
mod signals;
mod singularities;
mod sites;
