//! Round trip of one step over shared memory by the Rust driver and by the C library, turn by turn in one
//! process, against a host in another. Prints a table; asserts nothing.

use std::ffi::{CString, c_char, c_void};
use std::path::Path;
use std::time::Instant;

use anyhow::{Context as _, Result, ensure};
use clap::Parser;
use libloading::Library;
use plantd_client::link::{LinkDriver, LinkOptions, Wait};
use plantd_tests::links::{ChildProcess, PLANT, new_plant};

/// Measures the round trip of a step over shared memory, in Rust and in C.
#[derive(Parser)]
struct Arguments {
    /// Built-in model; one without prescribed coordinates.
    #[arg(long, default_value = "pendulum")]
    model: String,
    /// Steps of a turn.
    #[arg(long, default_value_t = 20_000)]
    steps: usize,
    /// Turns of each.
    #[arg(long, default_value_t = 10)]
    turns: usize,
}

/// `plantd_options`.
#[repr(C)]
struct Options {
    root: *const c_char,
    poll_ns: u64,
    timeout_s: f64,
    connect_timeout_s: f64,
}

type Open = unsafe extern "C" fn(*const c_char, *const Options, *mut *mut c_void) -> i32;
type Step = unsafe extern "C" fn(*mut c_void, *const f64, usize, *mut c_void) -> i32;
type Close = unsafe extern "C" fn(*mut c_void) -> i32;

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let directory = tempfile::Builder::new().prefix("plantd-").tempdir()?;
    let root = directory.path().join("link");
    let program = std::env::current_exe()?;
    let mut host = ChildProcess::start(
        program.with_file_name("link_host"),
        &root,
        &["--model", &arguments.model, "--poll"],
    )?;
    host.wait_for_line("open")?;
    // SAFETY: it is the library that is measured.
    let library = unsafe { Library::new(program.with_file_name("libplantd.so")) }
        .context("`cargo build --release -p plantd-link-c` builds the library")?;
    let inputs = new_plant(&arguments.model)?.model().dimensions().inputs;
    let mut rows = [("Rust", Vec::new()), ("C", Vec::new())];
    for _ in 0..arguments.turns {
        rows[0].1.push(median_ns(rust(&root, arguments.steps)?));
        rows[1].1.push(median_ns(c(&library, &root, arguments.steps, inputs)?));
    }
    println!("model {}, {} turns of {} steps", arguments.model, arguments.turns, arguments.steps);
    let mut medians = [0.0; 2];
    for ((name, turns), median) in rows.into_iter().zip(&mut medians) {
        let least = turns.iter().copied().fold(f64::INFINITY, f64::min);
        *median = median_ns(turns);
        println!(
            "{name:<5} median of the turns' p50 {:.3} us, least {:.3} us",
            *median / 1e3,
            least / 1e3
        );
    }
    println!("C over Rust: {:.3}", medians[1] / medians[0]);
    ensure!(host.finish()?, "the host failed");
    Ok(())
}

fn rust(root: &Path, steps: usize) -> Result<Vec<f64>> {
    let options = LinkOptions { root: root.to_owned(), wait: Wait::Poll, ..LinkOptions::default() };
    let mut driver = LinkDriver::connect(PLANT, options)?;
    let u = vec![0.0; driver.dimensions().inputs];
    let step = || Ok(driver.step(&u).map(drop)?);
    times_ns(steps, step)
}

fn c(library: &Library, root: &Path, steps: usize, inputs: usize) -> Result<Vec<f64>> {
    // SAFETY: these are the types of `client/c/plantd.h`.
    let (open, step, close) = unsafe {
        (
            library.get::<Open>(b"plantd_link_open\0")?,
            library.get::<Step>(b"plantd_link_step\0")?,
            library.get::<Close>(b"plantd_link_close\0")?,
        )
    };
    let (plant, root) = (CString::new(PLANT)?, CString::new(root.to_str().context("UTF-8")?)?);
    let options =
        Options { root: root.as_ptr(), poll_ns: u64::MAX, timeout_s: 1.0, connect_timeout_s: 1.0 };
    let mut link = std::ptr::null_mut();
    // SAFETY: strings end with a zero, the other pointers are those of variables.
    ensure!(unsafe { open(plant.as_ptr(), &options, &mut link) } == 0, "cannot open the link");
    // Room for a `plantd_state`, with more than it needs.
    let mut state = [0_u64; 64];
    let u = vec![0.0; inputs];
    let times = times_ns(steps, || {
        // SAFETY: the count is that of the vector, and there is room for a state.
        let status = unsafe { step(link, u.as_ptr(), u.len(), state.as_mut_ptr().cast()) };
        ensure!(status == 0, "status {status}");
        Ok(())
    });
    // SAFETY: the link is not used any more.
    ensure!(unsafe { close(link) } == 0, "cannot close the link");
    times
}

/// Times each call, after some that warm up.
fn times_ns(steps: usize, mut step: impl FnMut() -> Result<()>) -> Result<Vec<f64>> {
    let mut times = Vec::with_capacity(steps);
    for k in 0..steps + steps / 10 {
        let start = Instant::now();
        step()?;
        if k >= steps / 10 {
            times.push(start.elapsed().as_nanos() as f64);
        }
    }
    Ok(times)
}

fn median_ns(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times.get(times.len() / 2).copied().unwrap_or(f64::NAN)
}
