//! plantd-server
