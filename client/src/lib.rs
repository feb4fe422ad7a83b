//! plantd-client
