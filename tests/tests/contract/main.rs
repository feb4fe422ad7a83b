//! The contract, through a real client against a real server process: what each call does, and the
//! status, reason and details of each refusal.

mod answers;
mod drive;
mod limits;
mod refusals;
mod support;
mod transport;
mod watch;
