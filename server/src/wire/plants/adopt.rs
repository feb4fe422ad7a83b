//! Plants of a store that servers share come to whoever is asked for them: those that their server has given up by
//! themselves, those of a server that is lost when somebody says so.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, Weak};
use std::time::{Duration, Instant};

use plantd_proto::v1;
use tokio::runtime::Handle;
use tokio::sync::Semaphore;

use crate::core::connection::Connection;
use crate::core::mutex::lock;
use crate::core::session::shared::Session;
use crate::core::workers::pool::beside_other_tasks;
use crate::wire::message::checks::check_name;
use crate::wire::plants::record::{self, sentence};
use crate::wire::plants::state::{NotRestored, restore};
use crate::wire::shared::hub::{Find, Hub};
use crate::wire::shared::state::store::{Place, Shared, StoreError};
use crate::wire::status::RpcError;

/// Callers that may wait for the store at a time.
const LOOKING_MAX: usize = 16;
/// How long a plant that is not in the store is not looked for again.
const ABSENT: Duration = Duration::from_secs(1);
/// Plants of which that is remembered.
const ABSENT_MAX: usize = 10_000;

/// Looks for plants that are not here.
struct Finder {
    hub: Weak<Hub>,
    runtime: Handle,
    looking: Semaphore,
    /// One plant at a time is taken: two calls for it find the same one.
    taking: tokio::sync::Mutex<()>,
    absent: Mutex<BTreeMap<Place, Instant>>,
}

/// What looks for the plants that a hub does not have.
pub(crate) fn finder(hub: &Arc<Hub>) -> Find {
    let finder = Finder {
        hub: Arc::downgrade(hub),
        runtime: Handle::current(),
        looking: Semaphore::new(LOOKING_MAX),
        taking: tokio::sync::Mutex::default(),
        absent: Mutex::default(),
    };
    Box::new(move |id| finder.find(id))
}

impl Finder {
    /// The plant, if the store has it; the error says where it is.
    fn find(&self, id: &str) -> Option<Result<Arc<Session>, RpcError>> {
        let hub = self.hub.upgrade()?;
        hub.shared_store()?;
        check_name("id", id).ok()?;
        let place = Place { tenant: Connection::current().tenant(), id: id.to_owned() };
        if lock(&self.absent).get(&place).is_some_and(|since| since.elapsed() < ABSENT) {
            return None;
        }
        let found = beside_other_tasks(|| self.runtime.block_on(self.look(&hub, &place)));
        if found.is_none() {
            let mut absent = lock(&self.absent);
            if absent.len() >= ABSENT_MAX {
                absent.retain(|_, since| since.elapsed() < ABSENT);
            }
            if absent.len() < ABSENT_MAX {
                absent.insert(place, Instant::now());
            }
        }
        found
    }

    async fn look(&self, hub: &Arc<Hub>, place: &Place) -> Option<Result<Arc<Session>, RpcError>> {
        let _permit = self.looking.acquire().await.ok()?;
        let record = match in_store(hub, place, |shared, place| shared.look(place)).await {
            Ok(record) => record,
            Err(StoreError::Missing) => return None,
            Err(error) => return Some(Err(RpcError::store_failed(&error))),
        };
        let holder = record.holder.clone().unwrap_or_default();
        if !holder.server.is_empty() {
            if holder.server == hub.identity.name() {
                // Another call is taking it.
                let _taking = self.taking.lock().await;
                return hub.present(&place.id).map(Ok);
            }
            let is_reached = !holder.address.is_empty();
            return is_reached.then(|| Err(RpcError::plant_elsewhere(&place.id, &holder.address)));
        }
        let _taking = self.taking.lock().await;
        if let Some(session) = hub.present(&place.id) {
            return Some(Ok(session));
        }
        if let Err(fault) =
            hub.check_new_plant(&place.id).and_then(|()| record::check_build(&record))
        {
            return Some(Err(fault));
        }
        match take(hub, place, "").await {
            Ok(session) => Some(Ok(session)),
            Err(NotRestored::Gone) => None,
            Err(NotRestored::Broken(fault)) => Some(Err(fault)),
        }
    }
}

/// Waits for the store on a thread that may.
async fn in_store<T: Send + 'static>(
    hub: &Arc<Hub>,
    place: &Place,
    ask: impl FnOnce(&dyn Shared, &Place) -> Result<T, StoreError> + Send + 'static,
) -> Result<T, StoreError> {
    let (hub, place) = (Arc::clone(hub), place.clone());
    let asked = move || match hub.shared_store() {
        Some(shared) => ask(shared, &place),
        None => Err(StoreError::Missing),
    };
    let answer = tokio::task::spawn_blocking(asked).await;
    answer.unwrap_or_else(|error| Err(StoreError::Failed(error.to_string())))
}

/// Takes a plant that a server of that name has, or nobody, and makes it here.
async fn take(hub: &Arc<Hub>, place: &Place, from: &str) -> Result<Arc<Session>, NotRestored> {
    let from = from.to_owned();
    let read = in_store(hub, place, move |shared, place| shared.take(place, &from)).await;
    let session = match restore(hub, place, read, record::whole()).await {
        Ok(session) => session,
        Err(NotRestored::Broken(fault)) => {
            let given = in_store(hub, place, |shared, place| shared.give_back(place)).await;
            if let Err(error) = given {
                tracing::error!(plant = place.id, %error, "plant not given back");
            }
            return Err(NotRestored::Broken(fault));
        }
        Err(gone) => return Err(gone),
    };
    tracing::info!(plant = place.id, step = session.step_index(), "plant taken from the store");
    Ok(session)
}

/// Answers an AdoptPlants call: takes the plants that a server of that name has, or has given up.
pub(crate) async fn adopt_plants(
    hub: &Arc<Hub>,
    request: &v1::AdoptPlantsRequest,
) -> Result<v1::AdoptPlantsResponse, RpcError> {
    let from = &request.from;
    hub.check_takes_new()?;
    if hub.shared_store().is_none() {
        let message = "this server shares no object store with others (`state_directory`)";
        return Err(RpcError::precondition("NO_OBJECT_STORE", "server", message));
    }
    if from.is_empty() || from == hub.identity.name() {
        return Err(RpcError::field("from", "must be the name of another server"));
    }
    let of_server = {
        let from = from.clone();
        let nowhere = Place { tenant: Connection::current().tenant(), id: String::new() };
        in_store(hub, &nowhere, move |shared, _| shared.of(&from)).await
    };
    let places = of_server.map_err(|error| RpcError::store_failed(&error))?;
    let mut answer = v1::AdoptPlantsResponse::default();
    for place in places {
        let admitted = async {
            let looked = in_store(hub, &place, |shared, place| shared.look(place)).await;
            let record = match looked {
                Ok(record) => record,
                // Deleted; what says so goes when it is taken.
                Err(StoreError::Missing) => return Ok(()),
                Err(error) => return Err(RpcError::store_failed(&error)),
            };
            hub.check_new_plant(&place.id).and_then(|()| record::check_build(&record))
        };
        let taken = match admitted.await {
            Ok(()) => take(hub, &place, from).await,
            Err(fault) => Err(NotRestored::Broken(fault)),
        };
        match taken {
            Ok(_) => answer.plants.push(place.id),
            Err(NotRestored::Gone) => {}
            Err(NotRestored::Broken(fault)) => {
                answer.lost.push(v1::LostPlant { id: place.id, problem: sentence(fault) });
            }
        }
    }
    tracing::info!(from, plants = answer.plants.len(), lost = answer.lost.len(), "plants adopted");
    Ok(answer)
}
