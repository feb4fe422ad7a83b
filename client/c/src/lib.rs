//! The shared-memory driver for C and C++: what `plantd.h` declares, around
//! [`plantd_client::link::LinkDriver`].
//!
//! Every pointer is checked for null, panics stay inside, and what went wrong is kept as a code and a
//! message: that of a link with the link, that of opening one with the thread. A link belongs to the thread
//! that has opened it.

mod state;
mod status;

use std::cell::RefCell;
use std::ffi::{CStr, CString, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::thread::ThreadId;
use std::time::Duration;

use plantd_client::link::{LinkDriver, LinkOptions, Wait};

use crate::state::{Dimensions, State};
use crate::status::{Failure, Status};

/// Polls all the time.
const POLL_FOREVER_NS: u64 = u64::MAX;

/// Marks memory that is a link.
const MAGIC: u64 = 0x6b6e_696c_746e_6c70;

/// An open link, `struct plantd_link`.
pub struct Link {
    magic: u64,
    owner: ThreadId,
    driver: LinkDriver,
    message: CString,
}

/// How to open a link, `struct plantd_options`.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct Options {
    /// Root path of the server's links; null means the server's default.
    root: *const c_char,
    poll_ns: u64,
    timeout_s: f64,
    connect_timeout_s: f64,
}

thread_local! {
    /// Why this thread could not open a link, or called one that is none.
    static MESSAGE: RefCell<CString> = RefCell::new(CString::default());
}

/// Version of the library.
#[unsafe(no_mangle)]
pub extern "C" fn plantd_version() -> *const c_char {
    const VERSION: &[u8] = concat!(env!("CARGO_PKG_VERSION"), "\0").as_bytes();
    VERSION.as_ptr().cast()
}

/// Usual options.
///
/// # Safety
///
/// The pointer is null or points to memory for them.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn plantd_options_init(options: *mut Options) {
    if !options.is_null() {
        let LinkOptions { wait, timeout, connect_timeout, .. } = LinkOptions::default();
        let poll_ns = match wait {
            Wait::Poll => POLL_FOREVER_NS,
            Wait::PollThenSleep(time) => time.as_nanos() as u64,
        };
        let usual = Options {
            root: std::ptr::null(),
            poll_ns,
            timeout_s: timeout.as_secs_f64(),
            connect_timeout_s: connect_timeout.as_secs_f64(),
        };
        // SAFETY: the pointer is not null, and the caller vouches for the memory.
        unsafe { options.write(usual) };
    }
}

/// Opens the link of a plant and takes its lease.
///
/// # Safety
///
/// Strings are null or end with a zero; other pointers are null or point to what their types say.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn plantd_link_open(
    plant: *const c_char,
    options: *const Options,
    link: *mut *mut Link,
) -> Status {
    let opened = guarded(|| {
        if link.is_null() {
            return Err(Failure::Argument("link is a null pointer"));
        }
        // SAFETY: the pointer is not null, and the caller vouches for what is there.
        unsafe { link.write(std::ptr::null_mut()) };
        // SAFETY: the caller's duty.
        let plant = unsafe { text(plant, "plant is a null pointer") }?;
        // SAFETY: the caller's duty.
        let driver = LinkDriver::connect(plant, unsafe { link_options(options) }?)?;
        let owner = std::thread::current().id();
        let opened = Link { magic: MAGIC, owner, driver, message: CString::default() };
        // SAFETY: as above.
        unsafe { link.write(Box::into_raw(Box::new(opened))) };
        Ok(())
    });
    keep_with_thread(opened)
}

/// Opens a link again.
///
/// # Safety
///
/// The pointer is null or a link that is open.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn plantd_link_reconnect(link: *mut Link) -> Status {
    // SAFETY: the caller's duty.
    unsafe { with(link, |driver| Ok(driver.reconnect()?)) }
}

/// Takes a step.
///
/// # Safety
///
/// Pointers are null, or a link that is open, so many numbers, and memory for a state.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn plantd_link_step(
    link: *mut Link,
    u: *const f64,
    count: usize,
    state: *mut State,
) -> Status {
    let step = |driver: &mut LinkDriver| {
        // SAFETY: the caller's duty.
        let view = driver.step(unsafe { numbers(u, count) }?)?;
        // SAFETY: the caller's duty.
        unsafe { State::write(&view, state) };
        Ok(())
    };
    // SAFETY: the caller's duty.
    unsafe { with(link, step) }
}

/// Gives a plant that runs by itself an input.
///
/// # Safety
///
/// As for [`plantd_link_step`].
#[unsafe(no_mangle)]
pub unsafe extern "C" fn plantd_link_offer(link: *mut Link, u: *const f64, count: usize) -> Status {
    // SAFETY: the caller's duty.
    unsafe { with(link, |driver| Ok(driver.offer(numbers(u, count)?)?)) }
}

/// Waits for the next state of a plant that runs by itself.
///
/// # Safety
///
/// As for [`plantd_link_step`].
#[unsafe(no_mangle)]
pub unsafe extern "C" fn plantd_link_next(link: *mut Link, state: *mut State) -> Status {
    let next = |driver: &mut LinkDriver| {
        let view = driver.next_state()?;
        // SAFETY: the caller's duty.
        unsafe { State::write(&view, state) };
        Ok(())
    };
    // SAFETY: the caller's duty.
    unsafe { with(link, next) }
}

/// The last state.
///
/// # Safety
///
/// As for [`plantd_link_step`].
#[unsafe(no_mangle)]
pub unsafe extern "C" fn plantd_link_state(link: *mut Link, state: *mut State) -> Status {
    let read = |driver: &mut LinkDriver| {
        if state.is_null() {
            return Err(Failure::Argument("state is a null pointer"));
        }
        // SAFETY: the caller's duty.
        unsafe { State::write(&driver.state(), state) };
        Ok(())
    };
    // SAFETY: the caller's duty.
    unsafe { with(link, read) }
}

/// Sizes and time step of the plant.
///
/// # Safety
///
/// Pointers are null, or a link that is open and memory for the sizes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn plantd_link_dimensions(
    link: *mut Link,
    dimensions: *mut Dimensions,
) -> Status {
    let read = |driver: &mut LinkDriver| {
        if dimensions.is_null() {
            return Err(Failure::Argument("dimensions is a null pointer"));
        }
        // SAFETY: the pointer is not null, and the caller vouches for the memory.
        unsafe { dimensions.write(Dimensions::of(driver)) };
        Ok(())
    };
    // SAFETY: the caller's duty.
    unsafe { with(link, read) }
}

/// What went wrong in the last call of the link that failed; without a link, in opening one.
///
/// # Safety
///
/// The pointer is null or a link that is open.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn plantd_link_error(link: *const Link) -> *const c_char {
    // SAFETY: the caller's duty.
    match unsafe { link.as_ref() } {
        Some(link) if link.magic == MAGIC => link.message.as_ptr(),
        _ => MESSAGE.with_borrow(|message| message.as_ptr()),
    }
}

/// Name of a code.
#[unsafe(no_mangle)]
pub extern "C" fn plantd_status_name(status: i32) -> *const c_char {
    Status::name(status).as_ptr()
}

/// Gives the lease back and closes a link.
///
/// # Safety
///
/// The pointer is null or a link that is open, and is not used any more if the call succeeds.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn plantd_link_close(link: *mut Link) -> Status {
    if link.is_null() {
        return Status::Ok;
    }
    // SAFETY: the caller's duty.
    let checked = unsafe { with(link, |_| Ok(())) };
    if checked != Status::Ok {
        return checked;
    }
    keep_with_thread(guarded(|| {
        // SAFETY: it came from a box, and the caller vouches that nobody uses it.
        let mut link = unsafe { Box::from_raw(link) };
        link.magic = 0;
        Ok(())
    }))
}

/// Keeps panics in.
fn guarded(body: impl FnOnce() -> Result<(), Failure>) -> Result<(), Failure> {
    catch_unwind(AssertUnwindSafe(body)).unwrap_or(Err(Failure::Panic))
}

/// A call of a link.
///
/// # Safety
///
/// The pointer is null or a link that is open.
unsafe fn with(
    link: *mut Link,
    body: impl FnOnce(&mut LinkDriver) -> Result<(), Failure>,
) -> Status {
    // SAFETY: the caller's duty.
    let Some(link) = (unsafe { link.as_mut() }).filter(|link| link.magic == MAGIC) else {
        return keep_with_thread(Err(Failure::Argument("link is null or not open")));
    };
    if link.owner != std::thread::current().id() {
        // The message belongs to the other thread.
        return keep_with_thread(Err(Failure::Thread));
    }
    match guarded(|| body(&mut link.driver)) {
        Ok(()) => Status::Ok,
        Err(failure) => {
            link.message = failure.message();
            failure.status()
        }
    }
}

fn keep_with_thread(result: Result<(), Failure>) -> Status {
    let Err(failure) = result else { return Status::Ok };
    MESSAGE.with_borrow_mut(|message| *message = failure.message());
    failure.status()
}

/// # Safety
///
/// The pointer is null or points to options.
unsafe fn link_options(options: *const Options) -> Result<LinkOptions, Failure> {
    // SAFETY: the caller's duty.
    let Some(options) = (unsafe { options.as_ref() }) else { return Ok(LinkOptions::default()) };
    let seconds =
        |value, what| Duration::try_from_secs_f64(value).map_err(|_| Failure::Argument(what));
    let root = match options.root.is_null() {
        true => LinkOptions::default().root,
        // SAFETY: the caller's duty.
        false => PathBuf::from(unsafe { text(options.root, "root is a null pointer") }?),
    };
    let wait = match options.poll_ns {
        POLL_FOREVER_NS => Wait::Poll,
        time => Wait::PollThenSleep(Duration::from_nanos(time)),
    };
    let timeout = seconds(options.timeout_s, "timeout_s is no time")?;
    let connect_timeout = seconds(options.connect_timeout_s, "connect_timeout_s is no time")?;
    Ok(LinkOptions { root, wait, timeout, connect_timeout })
}

/// # Safety
///
/// The pointer is null or points to bytes that end with a zero.
unsafe fn text<'a>(pointer: *const c_char, null: &'static str) -> Result<&'a str, Failure> {
    if pointer.is_null() {
        return Err(Failure::Argument(null));
    }
    // SAFETY: the pointer is not null, and the caller vouches for the zero.
    let text = unsafe { CStr::from_ptr(pointer) }.to_str();
    text.map_err(|_| Failure::Argument("a string is not UTF-8"))
}

/// # Safety
///
/// The pointer is null or points to so many numbers.
unsafe fn numbers<'a>(pointer: *const f64, count: usize) -> Result<&'a [f64], Failure> {
    if count == 0 {
        return Ok(&[]);
    }
    if pointer.is_null() || count > isize::MAX as usize / size_of::<f64>() {
        return Err(Failure::Argument("u is a null pointer, or its count is none"));
    }
    // SAFETY: the pointer is not null, the size is possible, and the caller vouches for the numbers.
    Ok(unsafe { std::slice::from_raw_parts(pointer, count) })
}
