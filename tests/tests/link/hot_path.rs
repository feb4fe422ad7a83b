//! The loop of a paced plant asks nothing of the system but the time and its own sleep, while a driver
//! over shared memory gives it inputs. Looked at by strace, from outside.

use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use plantd_client::link::Wait;
use plantd_server::core::realtime::settings::{Pace, RunSettings};
use plantd_tests::links::{LinkFixture, new_session};

/// Steps of the plant while somebody looks.
const STEPS: u64 = 200;
/// Longest wait for anything.
const PATIENCE: Duration = Duration::from_secs(60);

#[test]
fn a_paced_step_over_shared_memory_makes_no_system_call_but_its_sleep() {
    let has_strace = Command::new("strace").arg("-V").stdout(Stdio::null()).status();
    if !has_strace.is_ok_and(|status| status.success()) {
        eprintln!("skipped: no strace");
        return;
    }
    // Who looks is a child of this process, which has to allow it where that is restricted.
    let _ = rustix::process::set_ptracer(rustix::process::PTracer::Any);
    let fixture = LinkFixture::new("cart-pole").unwrap();
    let session = &fixture.session;
    let settings = RunSettings { pace: Pace::Paced, speed: 10.0, ..RunSettings::default() };
    session.run(Some(settings), 0, 1).unwrap();
    let thread = session.with_core(|_| rustix::thread::gettid().as_raw_nonzero());
    let mut driver = fixture.connect(Wait::Poll).unwrap();
    driver.step(&[0.0]).unwrap();

    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("calls");
    let mut strace = Command::new("strace")
        .args(["-qq", "-o"])
        .arg(&file)
        .args(["-p", &thread.to_string()])
        .spawn()
        .unwrap();
    let deadline = Instant::now() + PATIENCE;
    // Calls are written once somebody looks.
    while std::fs::metadata(&file).map_or(0, |file| file.len()) == 0 {
        if let Some(status) = strace.try_wait().unwrap() {
            eprintln!("skipped: strace may not look ({status})");
            return;
        }
        assert!(Instant::now() < deadline, "strace sees nothing");
        driver.step(&[0.1]).unwrap();
    }
    let (first, mut inputs) = (driver.state().step, 0);
    while driver.state().step < first + STEPS {
        inputs += 1;
        driver.step(&[f64::from(inputs % 7)]).unwrap();
        assert!(Instant::now() < deadline, "the plant stands still");
    }
    let pid = rustix::process::Pid::from_child(&strace);
    rustix::process::kill_process(pid, rustix::process::Signal::INT).unwrap();
    strace.wait().unwrap();
    session.pause();

    let text = std::fs::read_to_string(&file).unwrap();
    let is_sleep =
        |line: &&str| line.contains("FUTEX_WAIT_BITSET") || line.contains("futex resumed");
    let is_time = |line: &&str| line.starts_with("clock_gettime");
    let is_note = |line: &&str| line.starts_with("---") || line.starts_with("strace:");
    let (allowed, other): (Vec<&str>, Vec<&str>) =
        text.lines().filter(|line| !is_note(line)).partition(|l| is_sleep(l) || is_time(l));
    assert!(inputs >= 5, "{inputs} inputs");
    assert!(allowed.len() as u64 >= STEPS / 2, "{text}");
    // The last line is cut off where strace let go; that it was attached shows as a sleep that is begun
    // again.
    let other: Vec<&str> =
        other.into_iter().filter(|line| !line.contains("restart_syscall")).collect();
    assert!(other.is_empty(), "{other:#?}");
}

/// However many want something of a plant that runs, and however long it takes, it goes on; and so do they.
#[test]
fn a_plant_that_is_flooded_takes_its_steps() {
    for pace in [Pace::Paced, Pace::Free] {
        let session = new_session("pendulum").unwrap();
        let settings = RunSettings { pace, speed: 10.0, ..RunSettings::default() };
        session.run(Some(settings), 0, 1).unwrap();
        let (is_over, served) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
        let flood = || {
            let (session, is_over) = (Arc::clone(&session), Arc::clone(&is_over));
            let served = Arc::clone(&served);
            std::thread::spawn(move || {
                while !is_over.load(Ordering::Acquire) {
                    // Longer than a step may take.
                    session.with_core(|_| std::thread::sleep(Duration::from_millis(2)));
                    served.fetch_add(1, Ordering::Relaxed);
                }
            })
        };
        let flood: Vec<_> = (0..8).map(|_| flood()).collect();
        let counts = &session.live().counts;
        let (steps, deadline) = (counts.steps.load(Ordering::Relaxed), Instant::now() + PATIENCE);
        while counts.steps.load(Ordering::Relaxed) < steps + STEPS
            || served.load(Ordering::Relaxed) < 20
        {
            assert!(Instant::now() < deadline, "{counts:?}, {served:?} were served");
            std::thread::sleep(Duration::from_millis(1));
        }
        is_over.store(true, Ordering::Release);
        for thread in flood {
            thread.join().unwrap();
        }
        session.pause();
    }
}
