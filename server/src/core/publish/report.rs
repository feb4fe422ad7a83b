//! The fields of a step's report, listed once: the words of the ring, the message and the header of the
//! link are made from this list.

use plantd_models::StepReport;

/// Hands the fields to a macro: first those that count, then those that are numbers.
macro_rules! with_report_fields {
    ($use:ident $($arguments:tt)*) => {
        $use! {
            ($($arguments)*)
            counts: iterations, factorizations, redundant_constraints, steps, halvings;
            numbers: residual, constraint_residual, reciprocal_condition,
                constraint_reciprocal_condition;
        }
    };
}

pub(crate) use with_report_fields;

macro_rules! in_words {
    (() counts: $($count:ident),+; numbers: $($number:ident),+;) => {
        /// The words of a report in the ring.
        pub(crate) fn to_words(report: &StepReport) -> impl Iterator<Item = u64> + use<> {
            [$(u64::from(report.$count),)+ $(report.$number.to_bits(),)+].into_iter()
        }

        /// The report of the next words.
        pub(crate) fn from_words(mut next: impl FnMut() -> u64) -> StepReport {
            StepReport { $($count: next() as u32,)+ $($number: f64::from_bits(next()),)+ }
        }
    };
}

with_report_fields!(in_words);
