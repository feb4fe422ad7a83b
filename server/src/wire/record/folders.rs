//! Where the files of tenants lie: in `tenants/NAME` of a directory, those of nobody in the directory itself.

use std::io;
use std::path::{Path, PathBuf};

use crate::core::tenant::{Tenant, Tenants, is_tenant_name};

const TENANTS: &str = "tenants";

/// The folder of a tenant.
pub(crate) fn folder_of(directory: &Path, tenants: &Tenants, tenant: Tenant) -> PathBuf {
    match tenant {
        Tenant::NONE => directory.to_owned(),
        tenant => directory.join(TENANTS).join(&tenants.account(tenant).name),
    }
}

/// All folders that are there, each with whose it is. A folder whose name no tenant can have is somebody else's.
pub(crate) fn folders(directory: &Path, tenants: &Tenants) -> io::Result<Vec<(Tenant, PathBuf)>> {
    let mut folders = vec![(Tenant::NONE, directory.to_owned())];
    let entries = match std::fs::read_dir(directory.join(TENANTS)) {
        Ok(entries) => entries,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(folders),
        Err(error) => return Err(error),
    };
    for entry in entries {
        let entry = entry?;
        let name = entry.file_name();
        if let Some(name) = name.to_str().filter(|name| is_tenant_name(name))
            && entry.file_type()?.is_dir()
        {
            folders.push((tenants.named(name), entry.path()));
        }
    }
    folders[1..].sort_by(|(_, one), (_, other)| one.cmp(other));
    Ok(folders)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::core::room::Room;

    #[test]
    fn each_tenant_has_a_folder_of_its_own() {
        let room = Room::new("numbers", "numbers", 1);
        let tenants = Tenants::new(true, BTreeMap::new(), &room, &room);
        let directory = tempfile::tempdir().unwrap();
        let folders = || folders(directory.path(), &tenants).unwrap();
        assert_eq!(folders(), [(Tenant::NONE, directory.path().to_owned())]);
        let a = tenants.named("a");
        let folder = folder_of(directory.path(), &tenants, a);
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::create_dir_all(directory.path().join("tenants/.hidden")).unwrap();
        std::fs::write(directory.path().join("tenants/file"), "").unwrap();
        assert_eq!(folders()[1..], [(a, folder)]);
    }
}
