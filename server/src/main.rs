//! The `plantd` server binary.
fn main() {}
