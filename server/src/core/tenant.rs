//! Tenants: to whom plants, models and recordings belong, and how much of the server each may use.
//!
//! Where nobody is asked who they are there is one tenant only, [`Tenant::NONE`], and nobody is kept from anything.

use std::collections::BTreeMap;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex};

use serde::{Deserialize, Serialize};

use crate::core::connection::Connection;
use crate::core::limits::LimitExceeded;
use crate::core::mutex::lock;
use crate::core::rate::Rate;
use crate::core::room::{Reservation, Room};

/// Stands in the configuration for every tenant that is not named.
pub const ANY_TENANT: &str = "*";

/// A tenant, by its number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Tenant(u32);

impl Tenant {
    /// Nobody: what was there before identities were asked for, and what came with the server.
    pub const NONE: Self = Self(0);
}

macro_rules! tenant_limits {
    (
        rooms { $($(#[doc = $doc:literal])+ $name:ident: $what:literal;)+ }
        rates { $($(#[doc = $rate_doc:literal])+ $rate:ident: $rate_what:literal;)+ }
    ) => {
        /// What a tenant may use at a time, besides the limits of the server, which hold for all together.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct TenantLimits {
            $($(#[doc = $doc])+ #[serde(skip_serializing_if = "Option::is_none")] pub $name: Option<u64>,)+
            $($(#[doc = $rate_doc])+ #[serde(skip_serializing_if = "Option::is_none")] pub $rate: Option<u64>,)+
        }

        impl TenantLimits {
            /// Names of all of them.
            pub const NAMES: &[&str] = &[$(stringify!($name),)+ $(stringify!($rate)),+];
        }

        /// What is left to a tenant.
        #[derive(Debug)]
        pub struct Rooms {
            $($(#[doc = $doc])+ pub $name: Arc<Room>,)+
        }

        impl Rooms {
            fn new(limits: &TenantLimits) -> Self {
                Self {
                    $($name: Room::new(
                        concat!("tenant.", stringify!($name)),
                        $what,
                        limits.$name.unwrap_or(u64::MAX),
                    ),)+
                }
            }
        }

        /// How much a tenant may have in a second.
        #[derive(Debug)]
        pub struct Rates {
            $($(#[doc = $rate_doc])+ pub $rate: Arc<Rate>,)+
        }

        impl Rates {
            fn new(limits: &TenantLimits) -> Self {
                Self {
                    $($rate: Rate::new(
                        concat!("tenant.", stringify!($rate)),
                        $rate_what,
                        limits.$rate,
                    ),)+
                }
            }
        }
    };
}

tenant_limits! {
    rooms {
        /// Plants.
        plants: "plants of this tenant";
        /// Plants that run by themselves.
        running_plants: "plants of this tenant that run by themselves";
        /// Uploaded models.
        models: "uploaded models of this tenant";
        /// Open streams and calls.
        streams: "open streams and calls of this tenant";
        /// Open Watch, WatchGains and WatchEvents streams.
        watchers: "watchers of this tenant";
        /// Numbers held in the queues of its watchers (8 bytes each).
        watch_numbers: "numbers in the queues of this tenant's watchers";
        /// Numbers held by the feedbacks of its plants (8 bytes each).
        feedback_numbers: "numbers in the feedbacks of this tenant's plants";
        /// Trajectory regulators, filters and optimisations.
        trajectory_solves: "regulators, filters and optimisations of this tenant";
        /// Recordings in progress.
        active_recordings: "recordings of this tenant in progress";
        /// Bytes of all its recordings.
        recording_bytes: "bytes of this tenant's recordings";
        /// Numbers in the matrices of its regulators, filters and optimisations (8 bytes each).
        trajectory_numbers: "numbers in the matrices of this tenant's regulators, filters and optimisations";
    }
    rates {
        /// Messages to the server in a second, over all of its connections.
        messages_per_s: "messages in a second";
        /// Milliseconds of processor time of workers in a second.
        worker_ms_per_s: "milliseconds of workers in a second";
    }
}

/// What the configuration says of a tenant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TenantSettings {
    /// What it may use.
    pub limits: TenantLimits,
}

/// What is known of a tenant.
#[derive(Debug)]
pub struct Account {
    /// Which one.
    pub tenant: Tenant,
    /// Its name; empty of [`Tenant::NONE`].
    pub name: String,
    /// What it may use.
    pub limits: TenantLimits,
    /// What is left of it.
    pub rooms: Rooms,
    /// What it may have in a second.
    pub rates: Rates,
    /// What has happened.
    pub counts: TenantCounts,
}

/// What is counted of a tenant.
#[derive(Debug, Default)]
pub struct TenantCounts {
    /// Calls that ended, by the name of their code.
    calls: Mutex<BTreeMap<&'static str, u64>>,
    /// Steps of its plants that ended after the next one was due.
    pub overruns: Arc<AtomicU64>,
}

impl TenantCounts {
    /// A call ended.
    pub fn call_ended(&self, code: &'static str) {
        *lock(&self.calls).entry(code).or_default() += 1;
    }

    /// Calls that ended, by the name of their code.
    pub fn calls(&self) -> BTreeMap<&'static str, u64> {
        lock(&self.calls).clone()
    }
}

/// All tenants that have been heard of since the start.
#[derive(Debug)]
pub struct Tenants {
    are_apart: bool,
    /// Room of all tenants together.
    watch_room: Arc<Room>,
    feedback_room: Arc<Room>,
    settings: BTreeMap<String, TenantSettings>,
    accounts: Mutex<Vec<Arc<Account>>>,
}

/// Nobody is kept apart from anybody, as where nobody is asked who they are.
impl Default for Tenants {
    fn default() -> Self {
        let room = Room::new("numbers", "numbers", u64::MAX);
        Self::new(false, BTreeMap::new(), &room, &room)
    }
}

impl Tenants {
    /// None so far. Only where they are kept apart does it matter whose something is.
    pub fn new(
        are_apart: bool,
        settings: BTreeMap<String, TenantSettings>,
        watch_room: &Arc<Room>,
        feedback_room: &Arc<Room>,
    ) -> Self {
        let (watch_room, feedback_room) = (Arc::clone(watch_room), Arc::clone(feedback_room));
        let tenants =
            Self { are_apart, watch_room, feedback_room, settings, accounts: Mutex::default() };
        let nobody = tenants.open("", TenantLimits::default(), Tenant::NONE);
        lock(&tenants.accounts).push(nobody);
        tenants
    }

    fn open(&self, name: &str, limits: TenantLimits, tenant: Tenant) -> Arc<Account> {
        let mut rooms = Rooms::new(&limits);
        for (room, whole) in [
            (&mut rooms.watch_numbers, &self.watch_room),
            (&mut rooms.feedback_numbers, &self.feedback_room),
        ] {
            *room = room.part_of(whole);
        }
        Arc::new(Account {
            tenant,
            name: name.to_owned(),
            rates: Rates::new(&limits),
            limits,
            rooms,
            counts: TenantCounts::default(),
        })
    }

    /// The tenant of that name, which is in the configuration, in a file of tokens or the name of a folder.
    pub fn named(&self, name: &str) -> Tenant {
        let mut accounts = lock(&self.accounts);
        if let Some(account) = accounts.iter().find(|account| account.name == name) {
            return account.tenant;
        }
        let tenant = Tenant(u32::try_from(accounts.len()).unwrap_or(u32::MAX));
        let settings = self.settings.get(name).or_else(|| self.settings.get(ANY_TENANT));
        let limits = settings.copied().unwrap_or_default().limits;
        accounts.push(self.open(name, limits, tenant));
        tenant
    }

    /// Whether a tenant has been heard of, or there are fewer than so many.
    pub fn has_room_for(&self, name: &str, tenants_max: usize) -> bool {
        let accounts = lock(&self.accounts);
        accounts.len() < tenants_max || accounts.iter().any(|account| account.name == name)
    }

    /// What is known of a tenant.
    pub fn account(&self, tenant: Tenant) -> Arc<Account> {
        let accounts = lock(&self.accounts);
        Arc::clone(accounts.get(tenant.0 as usize).unwrap_or(&accounts[0]))
    }

    /// All that have been heard of, without [`Tenant::NONE`].
    pub fn accounts(&self) -> Vec<Arc<Account>> {
        lock(&self.accounts)[1..].to_vec()
    }

    /// What is known of the tenant for which the present task works.
    pub fn current(&self) -> Arc<Account> {
        self.account(Connection::current().tenant())
    }

    /// Whether the present task may know of what belongs to this tenant.
    pub fn shows(&self, owner: Tenant) -> bool {
        !self.are_apart || Connection::current().sees(owner)
    }

    /// Whether the present task may change anything, and not only look.
    pub fn may_drive(&self) -> bool {
        !self.are_apart || Connection::current().drives()
    }

    /// Whether the present task may change what belongs to nobody, and is there for all.
    pub fn may_change_shared(&self) -> bool {
        !self.are_apart || Connection::current().sees_all()
    }

    /// Room for one more of what the present task's tenant may have.
    pub fn take(&self, room: impl Fn(&Rooms) -> &Arc<Room>) -> Result<Reservation, LimitExceeded> {
        room(&self.current().rooms).reserve(1)
    }
}

/// Whether a tenant may be called so: it is the name of a folder.
pub fn is_tenant_name(name: &str) -> bool {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    !name.is_empty() && name.len() <= 64 && !name.starts_with('.') && name.bytes().all(is_plain)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::connection::Sight;

    #[test]
    fn each_tenant_has_room_of_its_own() {
        let plants = |count| TenantSettings {
            limits: TenantLimits { plants: Some(count), ..TenantLimits::default() },
        };
        let room = Room::new("watch_numbers", "numbers", 10);
        let settings =
            BTreeMap::from([("a".to_owned(), plants(1)), (ANY_TENANT.to_owned(), plants(2))]);
        let tenants = Tenants::new(true, settings, &room, &room);
        let (a, b) = (tenants.named("a"), tenants.named("b"));
        assert_eq!(tenants.named("a"), a);
        let take = |tenant| {
            let connection = Connection::of_tenant(1, tenant, Sight::Own);
            connection.scope(|| tenants.take(|rooms| &rooms.plants))
        };
        let first = take(a).unwrap();
        let refused = take(a).unwrap_err();
        assert_eq!((refused.name, refused.limit, refused.actual), ("tenant.plants", 1, 2));
        let _others = [take(b).unwrap(), take(b).unwrap()];
        take(b).unwrap_err();
        drop(first);
        take(a).unwrap();
        // Nobody is bounded by the limits of the server alone.
        take(Tenant::NONE).unwrap();
    }

    #[test]
    fn what_is_anothers_is_not_shown() {
        let room = Room::new("watch_numbers", "numbers", 10);
        let tenants = Tenants::new(true, BTreeMap::new(), &room, &room);
        let (a, b) = (tenants.named("a"), tenants.named("b"));
        let shown = |connection: Connection| {
            connection.scope(|| [Tenant::NONE, a, b].map(|owner| tenants.shows(owner)))
        };
        assert_eq!(shown(Connection::of_tenant(1, a, Sight::Look)), [false, true, false]);
        assert_eq!(shown(Connection::of_tenant(1, a, Sight::All)), [true, true, true]);
        // A task of which nobody knows for whom it works sees nothing.
        assert!(![Tenant::NONE, a, b].iter().any(|owner| tenants.shows(*owner)));
        assert!(Tenants::default().shows(Tenant::NONE));
    }

    #[test]
    fn no_tenant_is_called_like_a_path() {
        assert!(is_tenant_name("lab-1.a_b"));
        for name in ["", "..", ".", "a/b", "/", "a b", "\u{fc}", &"a".repeat(65)] {
            assert!(!is_tenant_name(name), "{name}");
        }
    }
}
