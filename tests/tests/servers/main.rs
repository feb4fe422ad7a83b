//! Servers over time and among others: plants survive, move and are shared; what goes wrong around a server does it no
//! harm.

mod faults;
mod floods;
mod follow;
mod gateway;
mod memory;
mod modes;
mod store;
mod survive;
mod travel;
