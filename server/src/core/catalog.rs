//! The models that a server knows: built-in ones, and uploaded ones.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, Weak};

use plantd_models::{Model, builtin};

use crate::core::limits::LimitExceeded;
use crate::core::metrics::Metrics;
use crate::wire::status::RpcError;

/// A model by name.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Name.
    pub name: String,
    /// Came with the server.
    pub builtin: bool,
    /// The model.
    pub model: Arc<Model>,
}

/// All models.
pub struct Catalog {
    /// The named built-in models, in the order of their names; compiled when first asked for.
    named: BTreeMap<&'static str, OnceLock<Arc<Model>>>,
    /// Members of the built-in families, as long as somebody uses them.
    generated: Mutex<HashMap<String, Weak<Model>>>,
    uploaded: Mutex<BTreeMap<String, Arc<Model>>>,
    models_max: u64,
    metrics: Arc<Metrics>,
}

impl Catalog {
    /// A catalog with room for `models_max` uploaded models.
    pub fn new(models_max: u64, metrics: Arc<Metrics>) -> Self {
        Self {
            named: builtin::NAMES.iter().map(|name| (*name, OnceLock::new())).collect(),
            generated: Mutex::default(),
            uploaded: Mutex::default(),
            models_max,
            metrics,
        }
    }

    /// The model of that name. May compile it: call it on a worker.
    pub fn get(&self, name: &str) -> Result<Entry, RpcError> {
        if let Some(model) = lock(&self.uploaded).get(name) {
            let model = Arc::clone(model);
            return Ok(Entry { name: name.to_owned(), builtin: false, model });
        }
        let model = self.builtin(name)?.ok_or_else(|| RpcError::model_not_found(name))?;
        Ok(Entry { name: name.to_owned(), builtin: true, model })
    }

    fn builtin(&self, name: &str) -> Result<Option<Arc<Model>>, RpcError> {
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

    /// Keeps an uploaded model.
    pub fn insert(&self, name: &str, model: Arc<Model>) -> Result<Entry, RpcError> {
        if builtin::scene(name).is_some() {
            return Err(RpcError::model_exists(name));
        }
        let mut uploaded = lock(&self.uploaded);
        if uploaded.contains_key(name) {
            return Err(RpcError::model_exists(name));
        }
        LimitExceeded::check("models", self.models_max, "uploaded models", uploaded.len() + 1)?;
        uploaded.insert(name.to_owned(), Arc::clone(&model));
        self.metrics.set_models(uploaded.len());
        Ok(Entry { name: name.to_owned(), builtin: false, model })
    }

    /// Forgets an uploaded model.
    pub fn remove(&self, name: &str) -> Result<(), RpcError> {
        let mut uploaded = lock(&self.uploaded);
        if uploaded.remove(name).is_some() {
            self.metrics.set_models(uploaded.len());
            return Ok(());
        }
        if builtin::scene(name).is_some() {
            let problem = format!("model `{name}` came with the server and cannot be deleted");
            return Err(RpcError::precondition("BUILTIN_MODEL", format!("model:{name}"), problem));
        }
        Err(RpcError::model_not_found(name))
    }

    /// Up to `size` models after the one named `after` (none: from the start), and whether there are
    /// more. May compile: call it on a worker.
    pub fn page(&self, after: &str, size: usize) -> Result<(Vec<Entry>, bool), RpcError> {
        let builtin_names = self.named.keys().map(|name| (*name).to_owned());
        let uploaded_names: Vec<String> = lock(&self.uploaded).keys().cloned().collect();
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
                Err(fault) if fault.reason() == "MODEL_NOT_FOUND" => {}
                Err(fault) => return Err(fault),
            }
        }
        Ok((entries, has_more))
    }
}

fn compile_builtin(name: &str) -> Result<Option<Arc<Model>>, RpcError> {
    let Some(scene) = builtin::scene(name) else { return Ok(None) };
    let model = Model::compile(&scene).map_err(|error| {
        RpcError::internal(format!("the built-in scene `{name}` does not compile: {error}"))
    })?;
    Ok(Some(Arc::new(model)))
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
