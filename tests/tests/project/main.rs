//! What the project says of itself is true: documents, structure, unsafe code, deployment.

mod deploy;
mod docs;
mod hardening;
mod house;
