//! The report of a step as a message, and in the header of the link; its fields are listed in
//! `core::publish::report`.

use plantd_models::StepReport;
use plantd_proto::link::Header;
use plantd_proto::v1;

use crate::core::publish::report::with_report_fields;

macro_rules! on_the_wire {
    (() counts: $($count:ident),+; numbers: $($number:ident),+;) => {
        /// A report as a message.
        pub fn report_message(report: &StepReport) -> v1::StepReport {
            v1::StepReport { $($count: report.$count,)+ $($number: report.$number,)+ }
        }

        /// A header with a report.
        pub(crate) fn with_report(header: Header, report: &StepReport) -> Header {
            Header { $($count: report.$count,)+ $($number: report.$number,)+ ..header }
        }
    };
}

with_report_fields!(on_the_wire);
