//! What is expected of the signals of a plant over time, and whether it came true: of scenarios (`plantctl test`) and of
//! the cases of rollouts.
//!
//! [`Samples`] are signals by their names; an [`Expression`] computes one from others; an [`Expectation`] says what it
//! should do, and [`judge`] whether it did.

mod expectation;
mod expression;
mod list;
mod number;
mod samples;
mod verdict;

pub use expectation::{
    Count, Eventually, Expectation, Final, NeverExceeds, OvershootBelow, RmsBelow, Settles,
    StaysInside,
};
pub use expression::Expression;
pub use list::{ListError, expectations};
pub use number::short;
pub use samples::{Columns, Names, Reference, Sample, Samples};
pub use verdict::{Break, Curve, Facts, Verdict, judge};
