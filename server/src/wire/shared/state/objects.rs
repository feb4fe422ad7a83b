//! Plants in an object store that several servers share: an object for each plant, written only where it is as it was
//! left.
//!
//! The tag of the last write is the lock. A server writes with `If-Match`, so that one whose plants were taken by
//! another meanwhile, while it hung or was cut off, has each of its writes refused; no clock and no lease is needed.
//!
//! ```text
//! plants/ID, tenants/NAME/plants/ID                       record, with who has it (`Holder`)
//! servers/SERVER/plants/ID, servers/SERVER/tenants/...    empty: that server has had the plant
//! recordings/NAME.mcap, tenants/NAME/recordings/...       recordings that have ended
//! scenes/NAME.toml, tenants/NAME/scenes/...               scenes that were uploaded
//! ```
//!
//! What lies in `servers/SERVER` only says where to look: the plant's own object decides. A plant is deleted by
//! writing that it was, and then its object: a delete has no condition, and nobody writes over such a record.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read as _, Write as _};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::{env, iter};

use anyhow::{Context as _, Result, anyhow, ensure};
use futures::TryStreamExt as _;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{
    Error, ObjectMeta, ObjectStore, ObjectStoreExt as _, PutMode, PutOptions, PutPayload,
    UpdateVersion, WriteMultipart, parse_url_opts,
};
use plantd_proto::v1;
use tokio::runtime::Handle;

use crate::core::mutex::lock;
use crate::core::tenant::{Tenant, Tenants, is_tenant_name};
use crate::core::workers::pool::beside_other_tasks;
use crate::wire::message::checks::check_name;
use crate::wire::record::archive::{Archive, Archived};
use crate::wire::shared::state::store::{Place, Shared, Store, StoreError};
use crate::wire::shared::state::{sealed, unsealed};

const PLANTS: &str = "plants";
const SERVERS: &str = "servers";
const TENANTS: &str = "tenants";
const SCENES: &str = "scenes";
const RECORDINGS: &str = "recordings";
const RECORDING_END: &str = ".mcap";

/// Bytes of a recording that are sent at a time, and so many pieces side by side.
const PIECE_BYTES: usize = 8 << 20;
const PIECES: usize = 4;

/// Beginnings of the variables of the environment from which credentials and addresses of stores are read.
const VARIABLES: [&str; 3] = ["AWS_", "AZURE_", "GOOGLE_"];

/// How often a write is tried again that met another one.
const TRIES: usize = 3;

/// The plants of an object store.
pub struct Objects {
    store: Arc<dyn ObjectStore>,
    prefix: Path,
    server: String,
    process: u64,
    address: OnceLock<String>,
    gives_up: AtomicBool,
    tenants: Arc<Tenants>,
    /// Of the plants that this server has: what it wrote last.
    versions: Mutex<BTreeMap<Place, UpdateVersion>>,
    runtime: Handle,
}

/// A store, and where in it this installation lies.
pub(crate) fn open(url: &str) -> Result<(Arc<dyn ObjectStore>, Path)> {
    // One of the process: servers in it share it.
    static MEMORY: OnceLock<Arc<InMemory>> = OnceLock::new();
    // By what all TLS of this program is done; somebody may have said so already.
    let _ = tokio_rustls::rustls::crypto::ring::default_provider().install_default();
    if let Some(path) = url.strip_prefix("memory://") {
        let store: Arc<dyn ObjectStore> = Arc::clone(MEMORY.get_or_init(Arc::default)) as _;
        return Ok((store, Path::parse(path)?));
    }
    let scheme = url.split_once("://").map(|(scheme, _)| scheme).unwrap_or_default();
    ensure!(
        ["s3", "gs", "az"].contains(&scheme),
        "`{url}` is no object store: it begins with s3://, gs://, az:// or memory://"
    );
    let is_of_stores = |key: &str| VARIABLES.iter().any(|beginning| key.starts_with(beginning));
    let variables = env::vars().filter(|(key, _)| is_of_stores(key));
    let url = url.parse().map_err(|error| anyhow!("{error}"))?;
    let (store, prefix) = parse_url_opts(&url, variables)?;
    Ok((Arc::from(store), prefix))
}

impl Objects {
    /// The plants of a server in a store: `s3://bucket/folder`.
    pub fn open(url: &str, server: &str, tenants: Arc<Tenants>) -> Result<Self> {
        let (store, prefix) = open(url)?;
        let mut process = [0; 8];
        rustix::rand::getrandom(&mut process, rustix::rand::GetRandomFlags::empty())
            .context("random numbers")?;
        Ok(Self {
            store,
            prefix,
            server: server.to_owned(),
            process: u64::from_le_bytes(process),
            address: OnceLock::new(),
            gives_up: AtomicBool::new(false),
            tenants,
            versions: Mutex::default(),
            runtime: Handle::current(),
        })
    }

    /// Waits for the store.
    fn wait<T>(&self, answer: impl Future<Output = T>) -> T {
        beside_other_tasks(|| self.runtime.block_on(answer))
    }

    /// Who this is.
    fn holder(&self) -> v1::Holder {
        let gives_up = self.gives_up();
        v1::Holder {
            server: if gives_up { String::new() } else { self.server.clone() },
            address: self.address.get().filter(|_| !gives_up).cloned().unwrap_or_default(),
            process: self.process,
            deleted: false,
        }
    }

    /// What is a tenant's in a folder.
    fn of_tenant(&self, folder: &Path, tenant: Tenant) -> Path {
        match tenant {
            Tenant::NONE => folder.clone(),
            tenant => folder.clone().join(TENANTS).join(self.tenants.account(tenant).name.as_str()),
        }
    }

    /// Where a plant lies below a folder.
    fn below(&self, folder: &Path, place: &Place) -> Path {
        self.of_tenant(folder, place.tenant).join(PLANTS).join(place.id.as_str())
    }

    fn object(&self, place: &Place) -> Path {
        self.below(&self.prefix, place)
    }

    fn scene_object(&self, tenant: Tenant, name: &str) -> Path {
        self.of_tenant(&self.prefix, tenant).join(SCENES).join(format!("{name}.toml"))
    }

    fn recordings_folder(&self, tenant: Tenant) -> Path {
        self.of_tenant(&self.prefix, tenant).join(RECORDINGS)
    }

    fn recording_object(&self, tenant: Tenant, name: &str) -> Path {
        self.recordings_folder(tenant).join(format!("{name}{RECORDING_END}"))
    }

    fn folder_of(&self, server: &str) -> Path {
        self.prefix.clone().join(SERVERS).join(server)
    }

    fn mark(&self, server: &str, place: &Place) -> Path {
        self.below(&self.folder_of(server), place)
    }

    fn set_version(&self, place: &Place, version: Option<UpdateVersion>) {
        let mut versions = lock(&self.versions);
        match version {
            Some(version) => versions.insert(place.clone(), version),
            None => versions.remove(place),
        };
    }

    /// A plant's record, as bytes and decoded, and its version.
    async fn get(&self, place: &Place) -> Result<Found, StoreError> {
        let found = self.store.get(&self.object(place)).await?;
        let meta = &found.meta;
        let version = UpdateVersion { e_tag: meta.e_tag.clone(), version: meta.version.clone() };
        let bytes = found.bytes().await?.to_vec();
        let record = unsealed(&bytes).map_err(StoreError::Failed)?;
        let holder = record.holder.clone().unwrap_or_default();
        Ok(Found { bytes, record, holder, version })
    }

    /// Writes a record where the object is as the mode says.
    async fn put(
        &self,
        place: &Place,
        record: &v1::PlantRecord,
        mode: PutMode,
    ) -> object_store::Result<()> {
        let payload = PutPayload::from(sealed(record));
        let put = self.store.put_opts(&self.object(place), payload, PutOptions::from(mode)).await?;
        let version = UpdateVersion { e_tag: put.e_tag, version: put.version };
        self.set_version(place, Some(version));
        Ok(())
    }

    async fn write_as(
        &self,
        place: &Place,
        record: v1::PlantRecord,
        takes: bool,
    ) -> Result<(), StoreError> {
        let record = v1::PlantRecord { holder: Some(self.holder()), ..record };
        let known = lock(&self.versions).get(place).cloned();
        let mut mode = match known {
            Some(version) => PutMode::Update(version),
            None => {
                // First where to look for it: it is never there unseen.
                self.store.put(&self.mark(&self.server, place), PutPayload::new()).await?;
                PutMode::Create
            }
        };
        let mut tries = 0;
        loop {
            match self.put(place, &record, mode).await {
                Ok(()) => return Ok(()),
                Err(
                    Error::Precondition { .. }
                    | Error::AlreadyExists { .. }
                    | Error::NotFound { .. },
                ) if tries < TRIES => {}
                Err(error) => return Err(error.into()),
            }
            tries += 1;
            mode = match self.get(place).await {
                // Gone, with nobody who has it: it is written anew.
                Err(StoreError::Missing) => PutMode::Create,
                Err(error) => return Err(error),
                Ok(Found { holder, .. }) if holder.deleted => return Err(StoreError::Taken),
                // Written by this very process, whose answer was lost; or to be taken.
                Ok(found) if found.holder.process == self.process || takes => {
                    PutMode::Update(found.version)
                }
                Ok(found) => {
                    self.set_version(place, None);
                    self.unmark(&self.server, place).await;
                    let is_nobodys = found.holder.server.is_empty();
                    return Err(match is_nobodys {
                        true => StoreError::Taken,
                        false => StoreError::Elsewhere(found.holder.address),
                    });
                }
            };
        }
    }

    /// What only says where to look may stay behind.
    async fn unmark(&self, server: &str, place: &Place) {
        match self.store.delete(&self.mark(server, place)).await {
            Ok(()) | Err(Error::NotFound { .. }) => {}
            Err(error) => tracing::warn!(plant = place.id, server, %error, "a mark stays"),
        }
    }

    /// Reads a plant and makes it this server's, if that of `from` has it, or this one, or nobody.
    async fn take_from(&self, place: &Place, from: &str) -> Result<Vec<u8>, StoreError> {
        let found = match self.get(place).await {
            Err(StoreError::Missing) => {
                self.unmark(from, place).await;
                return Err(StoreError::Missing);
            }
            found => found?,
        };
        if found.holder.deleted {
            self.finish_delete(place, from).await?;
            return Err(StoreError::Missing);
        }
        let may_take = ["", from, &self.server].contains(&found.holder.server.as_str());
        if !may_take {
            self.unmark(from, place).await;
            return Err(StoreError::Elsewhere(found.holder.address));
        }
        if from != self.server {
            self.store.put(&self.mark(&self.server, place), PutPayload::new()).await?;
        }
        let record = v1::PlantRecord { holder: Some(self.holder()), ..found.record };
        match self.put(place, &record, PutMode::Update(found.version)).await {
            Ok(()) => {}
            // Somebody was faster.
            Err(Error::Precondition { .. } | Error::NotFound { .. }) => {
                return Err(StoreError::Elsewhere(String::new()));
            }
            Err(error) => return Err(error.into()),
        }
        if from != self.server {
            self.unmark(from, place).await;
        }
        Ok(found.bytes)
    }

    async fn give_back_own(&self, place: &Place) -> Result<(), StoreError> {
        let known = lock(&self.versions).remove(place);
        let Some(version) = known else { return Ok(()) };
        let found = self.get(place).await?;
        let record = v1::PlantRecord { holder: Some(v1::Holder::default()), ..found.record };
        self.put(place, &record, PutMode::Update(version)).await?;
        self.set_version(place, None);
        Ok(())
    }

    /// Deletes an object that says that its plant was deleted.
    async fn finish_delete(&self, place: &Place, server: &str) -> Result<(), StoreError> {
        match self.store.delete(&self.object(place)).await {
            Ok(()) | Err(Error::NotFound { .. }) => {}
            Err(error) => return Err(error.into()),
        }
        self.unmark(server, place).await;
        Ok(())
    }

    async fn remove_own(&self, place: &Place) -> Result<(), StoreError> {
        let known = lock(&self.versions).remove(place);
        let Some(version) = known else { return Ok(()) };
        let holder = v1::Holder { deleted: true, ..self.holder() };
        let record = v1::PlantRecord { holder: Some(holder), ..Default::default() };
        match self.put(place, &record, PutMode::Update(version)).await {
            Ok(()) => {}
            // It is another's by now, or gone.
            Err(Error::Precondition { .. } | Error::NotFound { .. }) => {
                self.unmark(&self.server, place).await;
                return Ok(());
            }
            Err(error) => return Err(error.into()),
        }
        self.set_version(place, None);
        self.finish_delete(place, &self.server).await
    }

    async fn marked(&self, server: &str) -> Result<Vec<Place>, StoreError> {
        let folder = self.folder_of(server);
        let marks: Vec<_> = self.store.list(Some(&folder)).try_collect().await?;
        let place = |path: &Path| {
            let parts: Vec<_> = path.prefix_match(&folder)?.collect();
            let parts: Vec<_> = parts.iter().map(AsRef::as_ref).collect();
            let (tenant, id) = match parts[..] {
                [PLANTS, id] => (Tenant::NONE, id),
                [TENANTS, name, PLANTS, id] if is_tenant_name(name) => {
                    (self.tenants.named(name), id)
                }
                _ => return None,
            };
            check_name("id", id).ok()?;
            Some(Place { tenant, id: id.to_owned() })
        };
        let mut places: Vec<_> = marks.iter().filter_map(|mark| place(&mark.location)).collect();
        places.sort();
        Ok(places)
    }
}

/// A plant's object.
struct Found {
    bytes: Vec<u8>,
    record: v1::PlantRecord,
    holder: v1::Holder,
    version: UpdateVersion,
}

impl From<Error> for StoreError {
    fn from(error: Error) -> Self {
        match error {
            Error::NotFound { .. } => Self::Missing,
            error => Self::Failed(error.to_string()),
        }
    }
}

impl Store for Objects {
    fn own(&self) -> Result<Vec<Place>, StoreError> {
        self.of(&self.server)
    }

    fn read(&self, place: &Place) -> Result<Vec<u8>, StoreError> {
        self.take(place, &self.server)
    }

    fn write(&self, place: &Place, record: v1::PlantRecord, takes: bool) -> Result<(), StoreError> {
        self.wait(self.write_as(place, record, takes))
    }

    fn remove(&self, place: &Place) -> Result<(), StoreError> {
        self.wait(self.remove_own(place))
    }

    fn location(&self, place: &Place) -> String {
        self.object(place).to_string()
    }

    fn release(&self) {}

    fn shared(&self) -> Option<&dyn Shared> {
        Some(self)
    }
}

impl Shared for Objects {
    fn announce(&self, address: &str) {
        let _ = self.address.set(address.to_owned());
    }

    fn is_announced(&self) -> bool {
        self.address.get().is_some()
    }

    fn give_up(&self) {
        self.gives_up.store(true, Ordering::Relaxed);
    }

    fn gives_up(&self) -> bool {
        self.gives_up.load(Ordering::Relaxed)
    }

    fn look(&self, place: &Place) -> Result<v1::PlantRecord, StoreError> {
        match self.wait(self.get(place))? {
            found if found.holder.deleted => Err(StoreError::Missing),
            found => Ok(found.record),
        }
    }

    fn give_back(&self, place: &Place) -> Result<(), StoreError> {
        self.wait(self.give_back_own(place))
    }

    fn of(&self, server: &str) -> Result<Vec<Place>, StoreError> {
        self.wait(self.marked(server))
    }

    fn take(&self, place: &Place, server: &str) -> Result<Vec<u8>, StoreError> {
        self.wait(self.take_from(place, server))
    }

    fn put_scene(&self, tenant: Tenant, name: &str, scene: String) -> Result<(), StoreError> {
        let object = self.scene_object(tenant, name);
        self.wait(self.store.put(&object, PutPayload::from(scene)))?;
        Ok(())
    }

    fn scene(&self, tenant: Tenant, name: &str) -> Result<String, StoreError> {
        let object = self.scene_object(tenant, name);
        let bytes = self.wait(async { self.store.get(&object).await?.bytes().await })?;
        String::from_utf8(bytes.into()).map_err(|error| StoreError::Failed(error.to_string()))
    }

    fn remove_scene(&self, tenant: Tenant, name: &str) -> Result<(), StoreError> {
        match self.wait(self.store.delete(&self.scene_object(tenant, name))) {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }
}

impl Archive for Objects {
    fn list(&self, tenant: Tenant) -> io::Result<Vec<Archived>> {
        let folder = self.recordings_folder(tenant);
        let objects: Vec<_> = self.wait(self.store.list(Some(&folder)).try_collect())?;
        let archived = |meta: &ObjectMeta| {
            let name = meta.location.filename()?.strip_suffix(RECORDING_END)?;
            check_name("name", name).ok()?;
            Some(Archived { name: name.to_owned(), bytes: meta.size })
        };
        Ok(objects.iter().filter_map(archived).collect())
    }

    fn tenants(&self) -> io::Result<Vec<Tenant>> {
        let folder = self.prefix.clone().join(TENANTS);
        let found = self.wait(self.store.list_with_delimiter(Some(&folder)))?;
        let names = found.common_prefixes.iter().filter_map(Path::filename);
        let names = names.filter(|name| is_tenant_name(name));
        Ok(iter::once(Tenant::NONE).chain(names.map(|name| self.tenants.named(name))).collect())
    }

    fn length(&self, tenant: Tenant, name: &str) -> io::Result<Option<u64>> {
        match self.wait(self.store.head(&self.recording_object(tenant, name))) {
            Ok(meta) => Ok(Some(meta.size)),
            Err(Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    fn put(&self, tenant: Tenant, name: &str, mut file: &File) -> io::Result<()> {
        let object = self.recording_object(tenant, name);
        let bring = async {
            let upload = self.store.put_multipart(&object).await?;
            let mut upload = WriteMultipart::new_with_chunk_size(upload, PIECE_BYTES);
            let mut piece = vec![0; PIECE_BYTES];
            loop {
                match file.read(&mut piece) {
                    Ok(0) => break,
                    Ok(length) => {
                        upload.wait_for_capacity(PIECES).await?;
                        upload.write(&piece[..length]);
                    }
                    Err(error) => {
                        upload.abort().await?;
                        return Err(error);
                    }
                }
            }
            upload.finish().await?;
            Ok(())
        };
        self.wait(bring)
    }

    fn get(&self, tenant: Tenant, name: &str, mut file: &File) -> io::Result<()> {
        let object = self.recording_object(tenant, name);
        self.wait(async {
            let mut pieces = self.store.get(&object).await?.into_stream();
            while let Some(piece) = pieces.try_next().await? {
                file.write_all(&piece)?;
            }
            Ok(())
        })
    }

    fn delete(&self, tenant: Tenant, name: &str) -> io::Result<bool> {
        let is_there = self.length(tenant, name)?.is_some();
        match self.wait(self.store.delete(&self.recording_object(tenant, name))) {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(is_there),
            Err(error) => Err(error.into()),
        }
    }
}
