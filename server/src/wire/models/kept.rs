//! Scenes that servers share: what is uploaded to one is a model of all that have the same object store.

use std::collections::HashMap;
use std::sync::{Arc, Weak};

use plantd_models::Model;
use plantd_proto::v1;

use crate::core::catalog::{Entry, FindModel};
use crate::core::connection::Connection;
use crate::core::tenant::Tenant;
use crate::wire::message::checks::check_name;
use crate::wire::models::model::compile;
use crate::wire::shared::hub::Hub;
use crate::wire::shared::state::store::StoreError;
use crate::wire::status::RpcError;

/// Keeps an uploaded model for all servers.
pub(crate) fn keep(hub: &Hub, entry: &Entry) -> Result<(), RpcError> {
    let Some(shared) = hub.shared_store() else { return Ok(()) };
    let kept = shared.put_scene(entry.owner, &entry.name, entry.model.scene().to_toml());
    kept.map_err(|error| RpcError::store_failed(&error))
}

/// Forgets a model for all servers; those that have used it have it until they end.
pub(crate) fn forget(hub: &Hub, entry: &Entry) -> Result<(), RpcError> {
    let Some(shared) = hub.shared_store() else { return Ok(()) };
    let removed = shared.remove_scene(entry.owner, &entry.name);
    removed.map_err(|error| RpcError::store_failed(&error))
}

/// What looks for the models that a hub does not have.
pub(crate) fn finder(hub: &Arc<Hub>) -> FindModel {
    let hub: Weak<Hub> = Arc::downgrade(hub);
    Box::new(move |name| find(&*hub.upgrade()?, name))
}

/// A model that another server has kept, and whose it is.
fn find(hub: &Hub, name: &str) -> Option<(Model, Tenant)> {
    let shared = hub.shared_store()?;
    check_name("name", name).ok()?;
    let own = Connection::current().tenant();
    let places = if own == Tenant::NONE { vec![own] } else { vec![own, Tenant::NONE] };
    for tenant in places {
        let scene = match shared.scene(tenant, name) {
            Ok(scene) => scene,
            Err(StoreError::Missing) => continue,
            Err(error) => {
                tracing::error!(model = name, %error, "scene not read");
                return None;
            }
        };
        let toml = v1::SceneFormat::Toml.into();
        match compile(&scene, toml, &HashMap::new(), &hub.limits) {
            Ok(Ok((model, _))) => return Some((model, tenant)),
            Ok(Err(error)) => tracing::error!(model = name, %error, "scene of no use"),
            Err(fault) => {
                let error = tonic::Status::from(fault);
                tracing::error!(model = name, error = error.message(), "scene of no use");
            }
        }
        return None;
    }
    None
}
