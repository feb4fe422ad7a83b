//! The contract, through a real client against a real server process: what each call does, and the
//! status, reason and details of each refusal.

mod analysis;
mod answers;
mod batches;
mod channels;
mod derivatives;
mod drive;
mod elements;
mod fairness;
mod feedback;
mod import;
mod kalman;
mod limits;
mod many;
mod mechanics;
mod methods;
mod momentum;
mod optimise;
mod parameters;
mod realtime;
mod refusals;
mod rest;
mod running;
mod strangers;
mod support;
mod transport;
mod usage;
mod velocity;
mod view;
mod watch;
