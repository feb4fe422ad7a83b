//! The types of the standard's C interface.

use std::ffi::{c_char, c_void};

/// What a call came to: `fmi3Status`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub(crate) enum Status {
    Ok = 0,
    /// Part of the enumeration; nothing answers it.
    #[allow(dead_code)]
    Warning = 1,
    /// The step cannot be taken from here; the instance is as it was.
    Discard = 2,
    /// Refused; the instance is as it was.
    Error = 3,
    /// The instance is of no use any more.
    Fatal = 4,
}

/// Handle of an instance, `fmi3Instance`, or of a state of one, `fmi3FMUState`: a number, never followed.
pub(crate) type Handle = *mut c_void;

/// `fmi3InstanceEnvironment`: the importer's own.
pub(crate) type Environment = *mut c_void;

/// Number of a variable.
pub(crate) type ValueReference = u32;

/// `fmi3LogMessageCallback`.
pub(crate) type LogMessage =
    Option<unsafe extern "C" fn(Environment, Status, *const c_char, *const c_char)>;
