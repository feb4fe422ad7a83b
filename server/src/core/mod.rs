//! Plants and everything that happens to them, in types of its own: no file here names a message of the
//! contract, a gRPC status or a codec. What comes from clients is translated above, in [`crate::wire`],
//! and so is what goes to them.

pub mod catalog;
pub mod channels;
pub mod connection;
pub mod driver;
pub mod failure;
pub mod feedback;
pub mod files;
pub mod identity;
pub mod inputs;
pub mod limits;
pub mod metrics;
pub mod modes;
pub(crate) mod mutex;
pub mod origin;
pub mod plant;
pub mod priority;
pub mod publish;
pub mod rate;
pub mod realtime;
pub mod room;
pub mod session;
pub mod tenant;
pub mod workers;
