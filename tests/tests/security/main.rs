//! A server among strangers: who is let in, what they may do, whose things they see and how much they may use, with
//! real processes, tokens and certificates.

mod gateway;
mod identities;
mod metrics;
mod support;
mod tenants;
mod transport;
