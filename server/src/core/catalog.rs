//! The models that a server knows: built-in ones, and uploaded ones.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, OnceLock, Weak};

use plantd_models::scene::UnknownName;
use plantd_models::{Model, builtin};
use prometheus_client::metrics::gauge::Gauge;

use crate::core::connection::{Caller, Connection};
use crate::core::files::{File, FileNameError, FileRoom, Files, path_of};
use crate::core::limits::{LimitExceeded, Limits};
use crate::core::mutex::lock;
use crate::core::room::Reservation;
use crate::core::tenant::{Tenant, Tenants};

/// Why a model was not found, kept or forgotten.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CatalogError {
    /// There is no model of that name.
    #[error("there is no model {name}")]
    NotFound {
        /// The name.
        name: UnknownName,
    },
    /// The name is taken, by an uploaded or a built-in model.
    #[error("there already is a model `{name}`")]
    Exists {
        /// The name.
        name: String,
    },
    /// Built-in models stay.
    #[error("model `{name}` came with the server and cannot be deleted")]
    Builtin {
        /// The name.
        name: String,
    },
    /// Built-in models have no files.
    #[error("model `{name}` came with the server and takes no files")]
    BuiltinFile {
        /// The name.
        name: String,
    },
    /// No file of a model has that name.
    #[error(transparent)]
    FileName(#[from] FileNameError),
    /// There are as many uploaded models, or files of them, as there may be.
    #[error(transparent)]
    Limit(#[from] LimitExceeded),
    /// A defect: a built-in scene does not compile.
    #[error("the built-in scene `{name}` does not compile: {problem}")]
    Broken {
        /// The name.
        name: String,
        /// Why not.
        problem: String,
    },
}

/// A model by name.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Name.
    pub name: String,
    /// Came with the server.
    pub builtin: bool,
    /// The model.
    pub model: Arc<Model>,
    /// Files that show it; none of a built-in one.
    pub files: Arc<Files>,
    /// Whose it is; nobody's is there for all.
    pub owner: Tenant,
}

/// An uploaded model.
struct Uploaded {
    model: Arc<Model>,
    files: Arc<Files>,
    /// Whose it is; nobody's is there for all.
    owner: Tenant,
    room: Reservation,
}

impl Uploaded {
    fn entry(&self, name: &str) -> Entry {
        let Self { model, files, owner, .. } = self;
        let (model, files) = (Arc::clone(model), Arc::clone(files));
        Entry { name: name.to_owned(), builtin: false, model, files, owner: *owner }
    }
}

/// Looks for an uploaded model by its name, and says whose it is. Waits for a store.
pub type FindModel = Box<dyn Fn(&str) -> Option<(Model, Tenant)> + Send + Sync>;

/// All models.
pub struct Catalog {
    /// The named built-in models, in the order of their names; compiled when first asked for.
    named: BTreeMap<&'static str, OnceLock<Arc<Model>>>,
    /// Members of the built-in families, as long as somebody uses them.
    generated: Mutex<HashMap<String, Weak<Model>>>,
    uploaded: Mutex<BTreeMap<String, Uploaded>>,
    models_max: u64,
    file_room: FileRoom,
    /// Looks elsewhere for models that are not here.
    pub find: OnceLock<FindModel>,
    /// Shows how many are uploaded.
    gauge: Gauge,
    tenants: Arc<Tenants>,
}

impl Catalog {
    /// A catalog with room for so many uploaded models and files as the limits say; the gauge counts the models.
    pub fn new(limits: &Limits, gauge: Gauge, tenants: Arc<Tenants>) -> Self {
        Self {
            named: builtin::NAMES.iter().map(|name| (*name, OnceLock::new())).collect(),
            generated: Mutex::default(),
            uploaded: Mutex::default(),
            models_max: limits.models,
            file_room: FileRoom::new(limits),
            find: OnceLock::new(),
            gauge,
            tenants,
        }
    }

    fn shows(&self, uploaded: &Uploaded) -> bool {
        uploaded.owner == Tenant::NONE || self.tenants.shows(uploaded.owner)
    }

    /// It is there for the caller, and may be changed.
    fn gives(&self, uploaded: &Uploaded) -> bool {
        match uploaded.owner {
            Tenant::NONE => self.tenants.may_change_shared(),
            owner => self.tenants.shows(owner),
        }
    }

    /// Names of the uploaded models that the caller may know.
    fn shown(&self) -> Vec<String> {
        let uploaded = lock(&self.uploaded);
        let shown = uploaded.iter().filter(|(_, uploaded)| self.shows(uploaded));
        shown.map(|(name, _)| name.clone()).collect()
    }

    /// The model of that name. May compile it: call it on a worker.
    pub fn get(&self, name: &str) -> Result<Entry, CatalogError> {
        if let Some(uploaded) = lock(&self.uploaded).get(name).filter(|found| self.shows(found)) {
            return Ok(uploaded.entry(name));
        }
        if let Some(model) = self.builtin(name)? {
            let (name, files) = (name.to_owned(), Arc::default());
            return Ok(Entry { name, builtin: true, model, files, owner: Tenant::NONE });
        }
        match self.find.get().and_then(|find| find(name)) {
            Some((model, owner)) => {
                // Somebody else may have found it meanwhile.
                Connection::server(owner).scope(|| self.replace(name, Arc::new(model)))
            }
            None => Err(self.not_found(name)),
        }
    }

    fn not_found(&self, name: &str) -> CatalogError {
        let families = ["chain-8", "tree-8", "scissor-8"].map(str::to_owned);
        let uploaded = self.shown();
        let known = self.named.keys().map(|name| (*name).to_owned());
        let known = known.chain(uploaded).chain(families);
        CatalogError::NotFound { name: UnknownName::among(name, known) }
    }

    fn builtin(&self, name: &str) -> Result<Option<Arc<Model>>, CatalogError> {
        if let Some(cell) = self.named.get(name) {
            if let Some(model) = cell.get() {
                return Ok(Some(Arc::clone(model)));
            }
            let Some(model) = compile_builtin(name)? else { return Ok(None) };
            return Ok(Some(Arc::clone(cell.get_or_init(|| model))));
        }
        if let Some(model) = lock(&self.generated).get(name).and_then(Weak::upgrade) {
            return Ok(Some(model));
        }
        let Some(model) = compile_builtin(name)? else { return Ok(None) };
        let mut generated = lock(&self.generated);
        generated.retain(|_, model| model.strong_count() > 0);
        generated.insert(name.to_owned(), Arc::downgrade(&model));
        Ok(Some(model))
    }

    /// Keeps an uploaded model under a name that is free.
    pub fn insert(&self, name: &str, model: Arc<Model>) -> Result<Entry, CatalogError> {
        self.keep(name, model, false)
    }

    /// Keeps an uploaded model, if need be in the place of another uploaded one of that name.
    pub fn replace(&self, name: &str, model: Arc<Model>) -> Result<Entry, CatalogError> {
        self.keep(name, model, true)
    }

    fn keep(&self, name: &str, model: Arc<Model>, replace: bool) -> Result<Entry, CatalogError> {
        Caller::note(name);
        if builtin::scene(name).is_some() {
            return Err(CatalogError::Exists { name: name.to_owned() });
        }
        let mut uploaded = lock(&self.uploaded);
        let former = uploaded.get(name);
        if former.is_some_and(|former| !replace || !self.gives(former)) {
            return Err(CatalogError::Exists { name: name.to_owned() });
        }
        let is_there = former.is_some();
        let owner = former.map_or_else(|| Connection::current().tenant(), |former| former.owner);
        let count = uploaded.len() + usize::from(!is_there);
        LimitExceeded::check("models", self.models_max, "uploaded models", count)?;
        // The room of what is replaced goes on to be taken.
        let room = match uploaded.remove(name) {
            Some(former) => former.room,
            None => self.tenants.account(owner).rooms.models.reserve(1)?,
        };
        let new = Uploaded { model, files: Arc::default(), owner, room };
        let entry = new.entry(name);
        uploaded.insert(name.to_owned(), new);
        self.gauge.set(uploaded.len() as i64);
        Ok(entry)
    }

    /// Gives an uploaded model a file under the name that its scene has for it. Answers with the path under
    /// which it is found, and the file.
    pub fn put_file(
        &self,
        model: &str,
        name: &str,
        bytes: Vec<u8>,
    ) -> Result<(String, Arc<File>), CatalogError> {
        let path = path_of(name)?;
        Caller::note(model);
        let found = self.files(model);
        let is_given = lock(&self.uploaded).get(model).is_some_and(|found| self.gives(found));
        let Some(files) = found.as_ref().filter(|_| is_given) else {
            let name = model.to_owned();
            let came_with_the_server = found.is_some() || builtin::scene(model).is_some();
            return Err(match came_with_the_server {
                true => CatalogError::BuiltinFile { name },
                false => self.not_found(model),
            });
        };
        let file = self.file_room.put(files, &path, bytes)?;
        Ok((path, file))
    }

    /// Refuses a file of a size before it is read.
    pub fn check_file_size(&self, bytes: u64) -> Result<(), CatalogError> {
        Ok(self.file_room.check_size(usize::try_from(bytes).unwrap_or(usize::MAX))?)
    }

    /// The files of an uploaded model.
    pub fn files(&self, model: &str) -> Option<Arc<Files>> {
        let uploaded = lock(&self.uploaded);
        let shown = uploaded.get(model).filter(|found| self.shows(found));
        shown.map(|uploaded| Arc::clone(&uploaded.files))
    }

    /// Forgets an uploaded model.
    pub fn remove(&self, name: &str) -> Result<(), CatalogError> {
        let mut uploaded = lock(&self.uploaded);
        Caller::note(name);
        let found = uploaded.get(name).map(|found| (self.shows(found), self.gives(found)));
        if let Some((_, true)) = found {
            uploaded.remove(name);
            self.gauge.set(uploaded.len() as i64);
            return Ok(());
        }
        if matches!(found, Some((true, false))) || builtin::scene(name).is_some() {
            return Err(CatalogError::Builtin { name: name.to_owned() });
        }
        drop(uploaded);
        Err(self.not_found(name))
    }

    /// Up to `size` models after the one named `after` (none: from the start), and whether there are
    /// more. May compile: call it on a worker.
    pub fn page(&self, after: &str, size: usize) -> Result<(Vec<Entry>, bool), CatalogError> {
        let builtin_names = self.named.keys().map(|name| (*name).to_owned());
        let uploaded_names = self.shown();
        let is_uploaded = !after.is_empty() && !self.named.contains_key(after);
        let mut names: Vec<String> = builtin_names
            .filter(|name| !is_uploaded && name.as_str() > after)
            .chain(uploaded_names.into_iter().filter(|name| !is_uploaded || name.as_str() > after))
            .collect();
        let has_more = names.len() > size;
        names.truncate(size);
        let mut entries = Vec::with_capacity(names.len());
        for name in names {
            match self.get(&name) {
                Ok(entry) => entries.push(entry),
                // Deleted since the names were read.
                Err(CatalogError::NotFound { .. }) => {}
                Err(error) => return Err(error),
            }
        }
        Ok((entries, has_more))
    }
}

fn compile_builtin(name: &str) -> Result<Option<Arc<Model>>, CatalogError> {
    let Some(scene) = builtin::scene(name) else { return Ok(None) };
    let model = Model::compile(&scene).map_err(|error| CatalogError::Broken {
        name: name.to_owned(),
        problem: error.to_string(),
    })?;
    Ok(Some(Arc::new(model)))
}
