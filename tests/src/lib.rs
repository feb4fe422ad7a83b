//! plantd-tests
