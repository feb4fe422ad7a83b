//! Handles, and what every call does: look the instance up, keep panics in, tell why something was refused.

use std::collections::BTreeMap;
use std::ffi::{CStr, CString, c_char, c_void};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, RwLock};

use crate::error::FmuError;
use crate::saved::Saved;
use crate::simulation::Simulation;
use crate::types::{Environment, Handle, LogMessage, Status};

static INSTANCES: RwLock<BTreeMap<usize, Arc<Instance>>> = RwLock::new(BTreeMap::new());

/// Handles of instances and of their states are never given twice.
static NEXT_HANDLE: AtomicUsize = AtomicUsize::new(1);

struct Instance {
    log: Log,
    work: Mutex<Work>,
}

/// What calls work on.
pub(crate) struct Work {
    pub(crate) simulation: Simulation,
    states: BTreeMap<usize, Saved>,
}

/// Where messages go.
#[derive(Clone, Copy)]
pub(crate) struct Log {
    callback: LogMessage,
    environment: Environment,
}

// SAFETY: the environment is a number to this library, which it gives back to the importer in calls that
// happen in the thread of one of the importer's own.
unsafe impl Send for Log {}
// SAFETY: as above; nothing of it is ever changed.
unsafe impl Sync for Log {}

impl Log {
    pub(crate) fn new(callback: LogMessage, environment: Environment) -> Self {
        Self { callback, environment }
    }

    pub(crate) fn tell(self, status: Status, message: &str) {
        let Some(callback) = self.callback else { return };
        let category = match status {
            Status::Fatal => c"logStatusFatal",
            Status::Discard => c"logStatusDiscard",
            _ => c"logStatusError",
        };
        let message = CString::new(message.replace('\0', " ")).unwrap_or_default();
        // SAFETY: the importer has given this function for this, with this environment; both strings
        // end with a zero and live until it returns.
        unsafe { callback(self.environment, status, category.as_ptr(), message.as_ptr()) };
    }
}

impl Work {
    pub(crate) fn keep(&mut self, saved: Saved) -> Handle {
        let handle = NEXT_HANDLE.fetch_add(1, Ordering::Relaxed);
        self.states.insert(handle, saved);
        handle as Handle
    }

    pub(crate) fn state(&self, handle: Handle) -> Result<&Saved, FmuError> {
        self.states.get(&(handle as usize)).ok_or(FmuError::NoState)
    }

    pub(crate) fn free(&mut self, handle: Handle) -> Result<(), FmuError> {
        self.states.remove(&(handle as usize)).map(drop).ok_or(FmuError::NoState)
    }

    pub(crate) fn restore(&mut self, handle: Handle) -> Result<(), FmuError> {
        let saved = self.states.get(&(handle as usize)).ok_or(FmuError::NoState)?;
        self.simulation.restore(saved)
    }
}

/// Makes an instance of what `make` answers; the null handle if it answers an error.
pub(crate) fn instantiate<E: std::fmt::Display>(
    log: Log,
    make: impl FnOnce() -> Result<Simulation, E>,
) -> Handle {
    let made = catch_unwind(AssertUnwindSafe(|| match make() {
        Ok(simulation) => {
            let handle = NEXT_HANDLE.fetch_add(1, Ordering::Relaxed);
            let work = Mutex::new(Work { simulation, states: BTreeMap::new() });
            let instance = Arc::new(Instance { log, work });
            INSTANCES.write().ok()?.insert(handle, instance);
            Some(handle as Handle)
        }
        Err(error) => {
            log.tell(Status::Error, &format!("cannot be instantiated: {error}"));
            None
        }
    }));
    made.ok().flatten().unwrap_or(std::ptr::null_mut())
}

/// Forgets an instance with all its states.
pub(crate) fn free(handle: Handle) {
    // What a panic leaves behind is dropped as well.
    let freed = catch_unwind(|| {
        let mut instances = INSTANCES.write().ok()?;
        instances.remove(&(handle as usize))
    });
    drop(freed);
}

/// A call of an instance.
pub(crate) fn call(
    handle: *mut c_void,
    function: &'static str,
    body: impl FnOnce(&mut Work) -> Result<(), FmuError>,
) -> Status {
    let called = catch_unwind(AssertUnwindSafe(|| {
        let instance = INSTANCES.read().ok().and_then(|all| all.get(&(handle as usize)).cloned());
        let Some(instance) = instance else { return Status::Error };
        let result = match instance.work.lock() {
            Ok(mut work) => {
                // A panic in here poisons the lock, and with it the instance.
                body(&mut work)
            }
            Err(_) => Err(FmuError::Lost),
        };
        // The importer may call this instance again from its callback: the lock is free.
        match result {
            Ok(()) => Status::Ok,
            Err(error) => {
                instance.log.tell(error.status(), &format!("{function}: {error}"));
                error.status()
            }
        }
    }));
    called.unwrap_or(Status::Fatal)
}

/// A slice that comes as a pointer and a count; no pointer is needed where there is nothing.
///
/// # Safety
///
/// The pointer is null or points to so many values, which nobody writes meanwhile.
pub(crate) unsafe fn slice<'a, T>(
    pointer: *const T,
    count: usize,
    name: &'static str,
) -> Result<&'a [T], FmuError> {
    if count == 0 {
        return Ok(&[]);
    }
    check(pointer, count, name)?;
    // SAFETY: the pointer is not null and aligned, the size is one that memory can have, and the caller
    // vouches for what is there.
    Ok(unsafe { std::slice::from_raw_parts(pointer, count) })
}

/// The same, to be written.
///
/// # Safety
///
/// The pointer is null or points to so many values, which nobody else uses meanwhile.
pub(crate) unsafe fn slice_mut<'a, T>(
    pointer: *mut T,
    count: usize,
    name: &'static str,
) -> Result<&'a mut [T], FmuError> {
    if count == 0 {
        return Ok(&mut []);
    }
    check(pointer, count, name)?;
    // SAFETY: as for `slice`.
    Ok(unsafe { std::slice::from_raw_parts_mut(pointer, count) })
}

fn check<T>(pointer: *const T, count: usize, name: &'static str) -> Result<(), FmuError> {
    let fits =
        count.checked_mul(size_of::<T>()).is_some_and(|bytes| isize::try_from(bytes).is_ok());
    if pointer.is_null() || !pointer.is_aligned() || !fits {
        Err(FmuError::Null(name))
    } else {
        Ok(())
    }
}

/// Writes a result to where the importer wants it.
///
/// # Safety
///
/// The pointer is null or points to a value that nobody else uses meanwhile.
pub(crate) unsafe fn write<T>(
    pointer: *mut T,
    value: T,
    name: &'static str,
) -> Result<(), FmuError> {
    check(pointer, 1, name)?;
    // SAFETY: the pointer is not null and aligned, and the caller vouches for what is there.
    unsafe { pointer.write(value) };
    Ok(())
}

/// Text that ends with a zero.
///
/// # Safety
///
/// The pointer is null or points to bytes that end with a zero, which nobody writes meanwhile.
pub(crate) unsafe fn text<'a>(
    pointer: *const c_char,
    name: &'static str,
) -> Result<&'a str, FmuError> {
    if pointer.is_null() {
        return Err(FmuError::Null(name));
    }
    // SAFETY: the pointer is not null, and the caller vouches for the zero.
    unsafe { CStr::from_ptr(pointer) }.to_str().map_err(|_| FmuError::NotUtf8(name))
}
