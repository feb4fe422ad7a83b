//! Where recordings go when they have ended, for all servers that share it.

use std::fs::File;
use std::io;

use crate::core::tenant::Tenant;

/// A recording in an archive.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Archived {
    /// Its name.
    pub name: String,
    /// Its length.
    pub bytes: u64,
}

/// A store of recordings that have ended. Its functions wait for a network.
pub trait Archive: Send + Sync {
    /// The recordings of a tenant.
    fn list(&self, tenant: Tenant) -> io::Result<Vec<Archived>>;

    /// Those that have something in it, besides nobody.
    fn tenants(&self) -> io::Result<Vec<Tenant>>;

    /// The length of a recording; none if it is not there.
    fn length(&self, tenant: Tenant, name: &str) -> io::Result<Option<u64>>;

    /// Keeps a recording.
    fn put(&self, tenant: Tenant, name: &str, file: &File) -> io::Result<()>;

    /// Writes a recording into a file.
    fn get(&self, tenant: Tenant, name: &str, file: &File) -> io::Result<()>;

    /// Removes a recording; whether it was there.
    fn delete(&self, tenant: Tenant, name: &str) -> io::Result<bool>;
}
