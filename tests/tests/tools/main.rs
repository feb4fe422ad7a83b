//! What stands around a server as users meet it: `plantctl`, recordings, the C library, FMUs, examples.

mod c_library;
mod examples;
mod fmu;
mod grpc_clients;
mod plantctl;
mod record;
mod scenarios;
