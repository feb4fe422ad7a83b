//! Plants in a directory of this machine. Those of a tenant lie in a folder of its own, `tenants/NAME`.
//!
//! A file `ID.plant` is written aside and renamed: what is there is complete.

use std::fs::{self, File, TryLockError};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Result, bail};
use plantd_proto::v1;

use crate::core::modes::Mode;
use crate::core::tenant::Tenants;
use crate::wire::record::folders::{folder_of, folders};
use crate::wire::shared::state::sealed;
use crate::wire::shared::state::store::{Place, Store, StoreError};

const EXTENSION: &str = "plant";

/// Locked by the server whose plants are in the directory; its process is named in it.
const LOCK: &str = "lock";

/// A directory of one server's plants.
pub struct Directory {
    path: PathBuf,
    mode: Mode,
    tenants: Arc<Tenants>,
    lock: File,
}

impl Directory {
    /// The directory at a path, made if there is none; the mode is that of its files. Refuses one that another
    /// server uses: each would overwrite the plants of the other.
    pub fn open(path: &Path, mode: Mode, tenants: Arc<Tenants>) -> Result<Self> {
        mode.create_directory(path)?;
        let path = path.to_owned();
        let lock = take(&path.join(LOCK), mode)?;
        Ok(Self { path, mode, tenants, lock })
    }

    fn folder(&self, place: &Place) -> PathBuf {
        folder_of(&self.path, &self.tenants, place.tenant)
    }

    fn file(&self, place: &Place) -> PathBuf {
        self.folder(place).join(&place.id).with_extension(EXTENSION)
    }
}

impl Store for Directory {
    fn own(&self) -> Result<Vec<Place>, StoreError> {
        let mut places = Vec::new();
        for (tenant, folder) in folders(&self.path, &self.tenants)? {
            let mut ids = Vec::new();
            for entry in fs::read_dir(folder)? {
                let path = entry?.path();
                if path.extension().is_some_and(|kind| kind == EXTENSION)
                    && let Some(id) = path.file_stem().and_then(|stem| stem.to_str())
                {
                    ids.push(id.to_owned());
                }
            }
            ids.sort();
            places.extend(ids.into_iter().map(|id| Place { tenant, id }));
        }
        Ok(places)
    }

    fn read(&self, place: &Place) -> Result<Vec<u8>, StoreError> {
        Ok(fs::read(self.file(place))?)
    }

    fn write(&self, place: &Place, record: v1::PlantRecord, _: bool) -> Result<(), StoreError> {
        self.mode.create_directory(&self.folder(place))?;
        let path = self.file(place);
        let aside = path.with_extension("partial");
        let mut file = self.mode.create(&aside)?;
        file.write_all(&sealed(&record))?;
        file.sync_data()?;
        drop(file);
        Ok(fs::rename(aside, path)?)
    }

    fn remove(&self, place: &Place) -> Result<(), StoreError> {
        Ok(fs::remove_file(self.file(place))?)
    }

    fn location(&self, place: &Place) -> String {
        self.file(place).display().to_string()
    }

    fn release(&self) {
        if let Err(error) = self.lock.unlock() {
            tracing::error!(%error, "{} stays locked", self.path.join(LOCK).display());
        }
    }
}

/// Locks a file, as long as the process lives, and names the process in it.
fn take(path: &Path, mode: Mode) -> Result<File> {
    let mut file = mode.open_or_create(path)?;
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            let holder = fs::read_to_string(path).unwrap_or_default();
            bail!(
                "another server (process {}) keeps its plants there, and each would overwrite those of the other: \
                 name another state_directory",
                holder.trim()
            );
        }
        Err(TryLockError::Error(error)) => return Err(error.into()),
    }
    file.set_len(0)?;
    writeln!(file, "{}", std::process::id())?;
    Ok(file)
}
