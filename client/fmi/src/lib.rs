//! The mechanics as the shared library of FMUs: co-simulation after FMI 3.0, by the plain C ABI.
//!
//! ```text
//! plantctl fmu scene.toml ──► plantd_fmi_package ──► modelDescription.xml, resources, and this library: a zip
//!                                                          │
//! importer ──► fmi3InstantiateCoSimulation ──► Blueprint ──► Simulation ──► plantd_models::Plant
//! ```
//!
//! The library that goes into an FMU describes it as well, so that neither can be of another version than
//! the other; the instantiation token holds the version and a digest of the scene and the settings.
//!
//! - A communication step is one or more time steps of the plant, with inputs that are held: the same bits
//!   as [`plantd_models::Plant::step`]. Other sizes are refused, and so are steps beyond the stop time. A
//!   step that cannot be solved leaves the instance at the start of the communication step (`fmi3Discard`).
//! - Outputs are functions of the state, so none depends on an input of the same time.
//! - `next(...)` are the entries of the state one time step ahead, `f(x, u)`; their partial derivatives by
//!   the state and the inputs are the exact A and B.
//! - States of instances are snapshots. Scene numbers are tunable parameters, by their paths; those that
//!   were set since are taken over together, by the next call that needs the mechanism.
//! - Handles of instances and of their states are numbers that are looked up: one that is freed, or none,
//!   is an error. A panic ends an instance (`fmi3Fatal`) and nothing else.
//!
//! Not there: model exchange, scheduled execution, event mode, early return, clocks, intermediate
//! updates, derivatives of outputs by time. Their functions are exported and answer `fmi3Error`.

mod absent;
mod blueprint;
mod description;
mod error;
mod functions;
mod instances;
mod package;
mod partial;
mod recipe;
mod saved;
mod simulation;
mod types;
mod variables;
