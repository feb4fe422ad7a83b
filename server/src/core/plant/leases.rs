//! Who may drive a plant: the numbers of its leases.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};

use crate::core::driver::DriverKind;
use crate::core::mutex::lock;

/// The leases of a plant, by number: each has its own, and later ones have higher ones.
#[derive(Debug, Default)]
pub(crate) struct Leases {
    /// The last number given away.
    issued: AtomicU64,
    /// The lease in force.
    holder: AtomicU64,
    /// What its holder is.
    driver: AtomicU8,
    /// The lease under which inputs come; 0 for none.
    input: AtomicU64,
    /// The last lease that was taken away.
    revoked: AtomicU64,
    /// The name under which a lease can be taken over, and its number.
    named: Mutex<Option<(String, u64)>>,
}

impl Leases {
    /// A number for a new lease.
    pub(crate) fn issue(&self) -> u64 {
        self.issued.fetch_add(1, Ordering::Relaxed) + 1
    }

    /// Makes place for a driver of that kind, or says what is there.
    pub(crate) fn claim(&self, kind: DriverKind) -> Result<(), DriverKind> {
        self.driver
            .compare_exchange(0, kind.code(), Ordering::AcqRel, Ordering::Acquire)
            .map(|_| ())
            .map_err(|code| DriverKind::from_code(code).unwrap_or(kind))
    }

    /// The driver has gone; another one may come.
    pub(crate) fn vacate(&self) {
        self.driver.store(0, Ordering::Release);
    }

    /// What the driver is.
    pub(crate) fn driver(&self) -> Option<DriverKind> {
        DriverKind::from_code(self.driver.load(Ordering::Acquire))
    }

    /// The lease of that number is in force.
    pub(crate) fn put_in_force(&self, lease: u64) {
        self.holder.store(lease, Ordering::Release);
    }

    /// Puts another lease in force instead of that one, 0 for none; false when it is not in force.
    pub(crate) fn replace(&self, former: u64, lease: u64) -> bool {
        self.holder.compare_exchange(former, lease, Ordering::AcqRel, Ordering::Acquire).is_ok()
    }

    /// Gives a lease a name, under which it can be taken over.
    pub(crate) fn set_name(&self, name: String, lease: u64) {
        *lock(&self.named) = Some((name, lease));
    }

    /// Takes the name away from the lease that has it.
    pub(crate) fn take_named(&self, name: &str) -> Option<u64> {
        lock(&self.named).take_if(|(present, _)| present == name).map(|(_, lease)| lease)
    }

    /// The lease in force, if it has that name.
    pub(crate) fn named(&self, name: &str) -> Option<u64> {
        let lease = lock(&self.named).as_ref().filter(|(present, _)| present == name)?.1;
        (self.holder.load(Ordering::Acquire) == lease && lease > self.revoked()).then_some(lease)
    }

    /// The lease under which inputs come; 0 for none.
    pub(crate) fn input(&self) -> u64 {
        self.input.load(Ordering::Acquire)
    }

    /// From now on inputs come under that lease.
    pub(crate) fn set_input(&self, lease: u64) {
        self.input.store(lease, Ordering::Release);
    }

    /// Takes a lease away.
    pub(crate) fn revoke(&self, lease: u64) {
        self.revoked.store(lease, Ordering::Release);
    }

    /// The last lease that was taken away.
    pub(crate) fn revoked(&self) -> u64 {
        self.revoked.load(Ordering::Acquire)
    }
}
