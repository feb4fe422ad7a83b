//! What commands take: arguments that several of them have in common, and files.

pub(crate) mod files;
pub(crate) mod meshes;
pub(crate) mod numbers;
pub(crate) mod point;
pub(crate) mod settings;
pub(crate) mod weights;
