//! What a place must be able to do in which plants survive their server.

use std::io;

use plantd_proto::v1;

use crate::core::session::shared::Session;
use crate::core::tenant::Tenant;

/// A plant in a store: whose it is, and its id.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// Whose it is.
    pub tenant: Tenant,
    /// Its id.
    pub id: String,
}

impl Place {
    pub(crate) fn of(session: &Session) -> Self {
        Self { tenant: session.owner(), id: session.id().to_owned() }
    }
}

/// Why something could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// It is another server's; its address, as far as it is known.
    #[error("another server has it: `{0}`")]
    Elsewhere(String),
    /// It is not there.
    #[error("it is not there")]
    Missing,
    /// A plant of that id is there, which no server has.
    #[error("the object store has a plant of that id already")]
    Taken,
    /// The store does not do it.
    #[error("{0}")]
    Failed(String),
}

impl From<io::Error> for StoreError {
    fn from(error: io::Error) -> Self {
        Self::Failed(error.to_string())
    }
}

/// A store of plants. Its functions wait for a disk or a network: call them where that may be.
pub trait Store: Send + Sync {
    /// The plants that are this server's, tenant by tenant.
    fn own(&self) -> Result<Vec<Place>, StoreError>;

    /// The bytes of a plant that is this server's, or nobody's: then it is this server's from now on.
    fn read(&self, place: &Place) -> Result<Vec<u8>, StoreError>;

    /// Writes a plant. One that another server has is taken from it if `takes`, else it is `Elsewhere`.
    fn write(&self, place: &Place, record: v1::PlantRecord, takes: bool) -> Result<(), StoreError>;

    /// Removes a plant.
    fn remove(&self, place: &Place) -> Result<(), StoreError>;

    /// Where a plant lies, for who looks after the store.
    fn location(&self, place: &Place) -> String;

    /// Leaves the store to other servers, after the last plant was written.
    fn release(&self);

    /// What only a store has that several servers share.
    fn shared(&self) -> Option<&dyn Shared> {
        None
    }
}

/// A store of several servers.
pub trait Shared: Store {
    /// Says where this server is reached.
    fn announce(&self, address: &str);

    /// It is known where this server is reached.
    fn is_announced(&self) -> bool;

    /// What is written from now on is given up: whoever is asked for a plant takes it.
    fn give_up(&self);

    /// Plants are given up.
    fn gives_up(&self) -> bool;

    /// A plant as it was written last, with who has it.
    fn look(&self, place: &Place) -> Result<v1::PlantRecord, StoreError>;

    /// Gives up a plant that was taken and could not be made.
    fn give_back(&self, place: &Place) -> Result<(), StoreError>;

    /// The plants of a server of that name.
    fn of(&self, server: &str) -> Result<Vec<Place>, StoreError>;

    /// Takes a plant from the server of that name.
    fn take(&self, place: &Place, server: &str) -> Result<Vec<u8>, StoreError>;

    /// Keeps a scene for all servers, in the place of one of that name.
    fn put_scene(&self, tenant: Tenant, name: &str, scene: String) -> Result<(), StoreError>;

    /// A scene that was kept.
    fn scene(&self, tenant: Tenant, name: &str) -> Result<String, StoreError>;

    /// Forgets a scene, if it is there.
    fn remove_scene(&self, tenant: Tenant, name: &str) -> Result<(), StoreError>;
}
