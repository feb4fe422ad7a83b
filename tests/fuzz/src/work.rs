//! One target in a process of its own.

use std::fs::File;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use plantd_server::core::metrics::process::resident_bytes;
use rustix::process::{Resource, Rlimit, setrlimit};

use crate::mutate::Rng;
use crate::targets::{TARGETS, Target, corpus};

/// Longest time for one input.
const INPUT_TIME_MAX: Duration = Duration::from_secs(30);
/// Most memory in use, MiB, and most address space, bytes.
const RESIDENT_MIB_MAX: u64 = 1024;
const ADDRESS_BYTES_MAX: u64 = 16 << 30;

/// Codes with which a failed target ends.
const PANICKED: i32 = 101;
const HUNG: i32 = 102;
const TOO_LARGE: i32 = 103;

/// Runs one target.
#[derive(clap::Args)]
pub(crate) struct Work {
    target: String,
    #[arg(long)]
    seed: u64,
    #[arg(long)]
    seconds: f64,
    #[arg(long)]
    inputs: u64,
    /// Where the present input is written.
    #[arg(long)]
    current: PathBuf,
}

/// When an input began, in milliseconds after `start`; 0 between two.
struct Watched {
    start: Instant,
    began_ms: AtomicU64,
}

impl Watched {
    fn now_ms(&self) -> u64 {
        self.start.elapsed().as_millis() as u64 + 1
    }
}

fn resident_mib() -> u64 {
    resident_bytes().unwrap_or(0) >> 20
}

/// Ends the process when an input takes too long or too much.
fn watch() -> Arc<Watched> {
    let watched = Arc::new(Watched { start: Instant::now(), began_ms: AtomicU64::new(0) });
    let seen = Arc::clone(&watched);
    thread::spawn(move || {
        loop {
            thread::sleep(Duration::from_millis(50));
            let began_ms = seen.began_ms.load(Ordering::Relaxed);
            let time_ms = seen.now_ms().saturating_sub(began_ms);
            if began_ms > 0 && u128::from(time_ms) > INPUT_TIME_MAX.as_millis() {
                eprintln!("an input takes more than {INPUT_TIME_MAX:?}");
                std::process::exit(HUNG);
            }
            let resident = resident_mib();
            if resident > RESIDENT_MIB_MAX {
                eprintln!("{resident} MiB are in use");
                std::process::exit(TOO_LARGE);
            }
        }
    });
    // Wherever a thread panics, and whoever would catch it.
    let usual = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        usual(panic);
        std::process::exit(PANICKED);
    }));
    let limit = Rlimit { current: Some(ADDRESS_BYTES_MAX), maximum: Some(ADDRESS_BYTES_MAX) };
    // Without it the other bound holds.
    let _ = setrlimit(Resource::As, limit);
    watched
}

fn open(name: &str) -> Result<Box<dyn Target>> {
    let (_, open) = TARGETS.iter().find(|(known, _)| *known == name).context("no such target")?;
    open()
}

/// Length of the input, and the input.
fn write_current(file: &File, input: &[u8]) -> Result<()> {
    file.write_all_at(&(input.len() as u64).to_le_bytes(), 0)?;
    Ok(file.write_all_at(input, 8)?)
}

/// The input that was written last.
pub(crate) fn current(path: &Path) -> Result<Vec<u8>> {
    let bytes = std::fs::read(path).context("the target has not begun")?;
    let (length, rest) = bytes.split_first_chunk().context("there is no input")?;
    let length = u64::from_le_bytes(*length) as usize;
    Ok(rest.get(..length).context("the input is cut short")?.to_vec())
}

impl Work {
    pub(crate) fn run(&self) -> Result<()> {
        let current = File::create(&self.current)?;
        let mut target = open(&self.target)?;
        let watched = watch();
        let start = Instant::now();
        let take = |target: &mut Box<dyn Target>, input: &[u8]| {
            write_current(&current, input)?;
            watched.began_ms.store(watched.now_ms(), Ordering::Relaxed);
            target.run(input);
            watched.began_ms.store(0, Ordering::Relaxed);
            anyhow::Ok(())
        };
        // What has failed once comes first.
        for entry in corpus(&self.target).read_dir().into_iter().flatten().flatten() {
            take(&mut target, &std::fs::read(entry.path())?)?;
        }
        let mut count = 0;
        while count < self.inputs && start.elapsed().as_secs_f64() < self.seconds {
            let mut rng = Rng::new(self.seed.wrapping_shl(40).wrapping_add(count));
            let input = target.input(&mut rng);
            take(&mut target, &input)?;
            count += 1;
        }
        ensure!(count > 0 || self.inputs == 0, "no time for one input");
        let (time, resident) = (start.elapsed().as_secs_f64(), resident_mib());
        println!("{:<14}{count:>9} inputs {time:>7.1} s {resident:>5} MiB", self.target);
        drop(target);
        // Threads of servers are not waited for.
        std::process::exit(0);
    }
}

/// Runs one input.
pub(crate) fn replay(target: &str, file: &Path) -> Result<()> {
    let input = std::fs::read(file).with_context(|| file.display().to_string())?;
    let mut target = open(target)?;
    let watched = watch();
    watched.began_ms.store(watched.now_ms(), Ordering::Relaxed);
    target.run(&input);
    println!("it went well");
    Ok(())
}
