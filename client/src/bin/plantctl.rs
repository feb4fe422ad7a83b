//! The `plantctl` command.
fn main() {}
