//! Many paced plants on one thread: 100 pendulums and 4 marionettes at 1 kHz, after an empty loop at the
//! same rate on the same processor and beside one on another. Prints what the server counted, what the
//! empty loops saw, and the server's memory; asserts nothing.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Result;
use clap::Parser;
use plantd_client::v1;
use plantd_proto::link::monotonic_ns;
use plantd_server::core::metrics::histogram::{Histogram, Summary};
use plantd_server::core::priority::{Scheduling, allow_cpus, sharpen_timers};
use plantd_server::core::realtime::alarm::Alarm;
use plantd_tests::server::ServerProcess;

/// Runs many paced plants on one thread, after an empty loop and beside one.
#[derive(Parser)]
struct Arguments {
    /// Time to measure, twice, s.
    #[arg(long, default_value_t = 60)]
    seconds: u64,
    /// Pendulums.
    #[arg(long, default_value_t = 100)]
    pendulums: usize,
    /// Marionettes.
    #[arg(long, default_value_t = 4)]
    marionettes: usize,
    /// Time step of the plants, s.
    #[arg(long, default_value_t = 0.001)]
    time_step: f64,
    /// SCHED_FIFO priority of both loops; 0 for the usual scheduling.
    #[arg(long, default_value_t = 0)]
    fifo: u8,
    /// Time before a deadline from which the server polls the clock, us.
    #[arg(long, default_value_t = 0)]
    spin_us: u64,
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let scheduling = match arguments.fifo {
        0 => "\"normal\"".to_owned(),
        priority => format!("{{ fifo = {priority} }}"),
    };
    let directory = tempfile::tempdir()?;
    let config = directory.path().join("plantd.toml");
    let spin_us = arguments.spin_us;
    let realtime =
        format!("[realtime]\nscheduling = {scheduling}\nspin_us = {spin_us}\ncpus = [0]\n");
    std::fs::write(&config, realtime)?;
    let server = ServerProcess::start_with(|command| {
        command.arg("--config").arg(&config);
    })?;
    let client = server.client().await;
    let plants = [("pendulum", arguments.pendulums), ("marionette", arguments.marionettes)];
    let mut ids = Vec::new();
    for (model, count) in plants {
        for _ in 0..count {
            let settings =
                v1::PlantSettings { time_step_s: arguments.time_step, ..Default::default() };
            let request = v1::CreatePlantRequest {
                model: model.to_owned(),
                settings: Some(settings),
                ..Default::default()
            };
            ids.push((model, client.create_plant(request).await?.id));
        }
    }
    let time = Duration::from_secs(arguments.seconds);
    let before = EmptyLoop::start(&arguments, 0);
    tokio::time::sleep(time).await;
    let before = before.stop();
    for (_, id) in &ids {
        let settings = v1::RunSettings { pace: v1::Pace::Paced.into(), ..Default::default() };
        let request =
            v1::RunRequest { id: id.clone(), settings: Some(settings), steps: 0, wait: false };
        client.run(request).await?;
    }
    tokio::time::sleep(Duration::from_secs(1)).await;
    for (_, id) in &ids {
        client.timing(id, true).await?;
    }
    let before_kib = server.resident_kib();
    let processors = std::thread::available_parallelism().map_or(1, usize::from);
    let beside = EmptyLoop::start(&arguments, processors - 1);
    let started = Instant::now();
    tokio::time::sleep(time).await;
    let elapsed_s = started.elapsed().as_secs_f64();
    let beside = beside.stop();
    let after_kib = server.resident_kib();

    println!(
        "{} pendulums, {} marionettes, {} s at {} Hz on processor 0, {scheduling}, spin {spin_us} us",
        arguments.pendulums,
        arguments.marionettes,
        arguments.seconds,
        1.0 / arguments.time_step
    );
    println!("{:28} {:>8} {:>8} {:>8} {:>8} {:>8}", "us", "mean", "p50", "p99", "p99.9", "max");
    print_row("empty loop, before", &before.lateness);
    print_row("empty loop, beside", &beside.lateness);
    for (model, count) in plants {
        let (mut steps, mut overruns, mut slips) = (0, 0, 0);
        let mut worst = v1::GetTimingResponse::default();
        for (_, id) in ids.iter().filter(|(other, _)| *other == model) {
            let timing = client.timing(id, false).await?;
            steps += timing.steps;
            overruns += timing.overruns;
            slips += timing.slips;
            let p99 =
                |timing: &v1::GetTimingResponse| timing.lateness.map_or(0, |late| late.p99_ns);
            if p99(&timing) >= p99(&worst) {
                worst = timing;
            }
        }
        print_row(&format!("{model}, lateness of worst"), &summary(worst.lateness));
        print_row(&format!("{model}, its steps"), &summary(worst.step));
        let expected = count as f64 * elapsed_s / arguments.time_step;
        println!(
            "{model}: {steps} steps of {expected:.0} due, {:.1} overruns and {:.1} slips each",
            overruns as f64 / count as f64,
            slips as f64 / count as f64
        );
    }
    println!("empty loops: {} periods missed before, {} beside", before.missed, beside.missed);
    println!("memory of the server: {before_kib} KiB, after {elapsed_s:.0} s {after_kib} KiB");
    Ok(())
}

fn summary(times: Option<v1::TimeSummary>) -> Summary {
    let v1::TimeSummary { count, mean_ns, p50_ns, p99_ns, p999_ns, max_ns } =
        times.unwrap_or_default();
    Summary { count, mean_ns, p50_ns, p99_ns, p999_ns, max_ns }
}

fn print_row(name: &str, times: &Summary) {
    let us = |time_ns: u64| time_ns as f64 * 1e-3;
    println!(
        "{name:28} {:8.1} {:8.1} {:8.1} {:8.1} {:8.1}",
        us(times.mean_ns),
        us(times.p50_ns),
        us(times.p99_ns),
        us(times.p999_ns),
        us(times.max_ns)
    );
}

/// A loop at the same rate and with the same scheduling that does nothing.
struct EmptyLoop {
    is_over: Arc<AtomicBool>,
    thread: std::thread::JoinHandle<Seen>,
}

/// What an empty loop saw.
struct Seen {
    lateness: Summary,
    /// Periods that were over when it woke for their beginning.
    missed: u64,
}

impl EmptyLoop {
    fn start(arguments: &Arguments, processor: usize) -> Self {
        let is_over = Arc::new(AtomicBool::new(false));
        let period_ns = (arguments.time_step * 1e9) as u64;
        let scheduling = match arguments.fifo {
            0 => Scheduling::Normal,
            priority => Scheduling::Fifo(priority),
        };
        let stop = Arc::clone(&is_over);
        let thread = std::thread::spawn(move || {
            allow_cpus(&[processor]);
            scheduling.apply();
            sharpen_timers();
            let (alarm, lateness, mut missed) = (Alarm::default(), Histogram::default(), 0);
            let mut due_ns = monotonic_ns() + period_ns;
            while !stop.load(Ordering::Relaxed) {
                alarm.sleep_until(due_ns);
                let late_ns = monotonic_ns().saturating_sub(due_ns);
                lateness.record(late_ns);
                missed += u64::from(late_ns > period_ns);
                due_ns += period_ns;
            }
            Seen { lateness: lateness.summary(), missed }
        });
        Self { is_over, thread }
    }

    fn stop(self) -> Seen {
        self.is_over.store(true, Ordering::Relaxed);
        self.thread.join().expect("an empty loop does not panic")
    }
}
