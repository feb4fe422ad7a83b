//! A synchronous driver over shared memory, for processes on the server's machine.
//!
//! ```no_run
//! use plantd_client::link::{LinkDriver, LinkOptions};
//!
//! # fn main() -> Result<(), plantd_client::link::LinkError> {
//! let mut plant = LinkDriver::connect("pendulum", LinkOptions::default())?;
//! for _ in 0..1000 {
//!     let torque = -3.0 * plant.state().q[0] - plant.state().p[0];
//!     plant.step(&[torque])?;
//! }
//! # Ok(())
//! # }
//! ```

pub(crate) mod driver;
mod error;

pub use driver::{LinkDimensions, LinkDriver, LinkOptions, StateView};
pub use error::{Guarded, LeaseHolder, LinkError, StepFailure};
pub use plantd_proto::link::Wait;
