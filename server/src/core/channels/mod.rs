//! Channels: sensors, actuators and faults between a plant and whoever drives it.
//!
//! A step runs `driver or feedback ─► actuators ─► faults of inputs, pushes ─► plant ─► sensors ─► faults of
//! outputs`. A plant without channels and faults has none of this. After construction nothing allocates.
//!
//! All is counted in steps of the plant, and random numbers follow from seed, name and step (`noise`).
//! Where a plant begins, is reset or restored, everything on its way has the value that it has there.

pub(crate) mod actuator;
pub mod fault;
pub(crate) mod noise;
pub mod pipeline;
pub(crate) mod sensor;
pub(crate) mod timeline;
