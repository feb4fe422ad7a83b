//! The server inside a Python process, `plantd.local`: the services of `plantd.v1` without a socket in between.
//!
//! Calls are those of the contract, so that everything a client can ask for is there, checked and answered by the
//! same code. What closes a loop, `lease::Lease`, goes past the messages: arrays in, arrays out.
//! Whatever waits or computes does so without Python's lock.

mod call;
mod codec;
mod lease;
mod server;

use pyo3::prelude::*;

/// `plantd._native`.
#[pymodule(name = "_native")]
mod native {
    #[pymodule_export]
    use crate::call::Call;
    #[pymodule_export]
    use crate::lease::Lease;
    #[pymodule_export]
    use crate::server::{Refused, Server};
}
