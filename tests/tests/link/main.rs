//! The shared-memory link, with a server in this process and with real ones.

mod drill;
mod driver;
mod hot_path;
mod server;
