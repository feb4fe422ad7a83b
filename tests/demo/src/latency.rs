//! Round trips: how long a controller waits from an input to the state after it.

use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};
use plantd_client::link::{LinkDriver, LinkOptions};
use plantd_client::{Client, v1};
use serde::{Deserialize, Serialize};

use crate::controller::progress;

/// Steps that are measured over each link.
const STEPS: usize = 5_000;
/// Steps ahead of them, for caches and connections to warm up.
const WARM_UP: usize = 500;

/// Round trips over one link, microseconds.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct RoundTrips {
    pub(crate) p50_us: f64,
    pub(crate) p99_us: f64,
    pub(crate) p999_us: f64,
    pub(crate) steps: u64,
}

/// Collects round trips.
#[derive(Default)]
pub(crate) struct Stopwatch {
    times: Vec<Duration>,
}

impl Stopwatch {
    pub(crate) fn record(&mut self, round_trip: Duration) {
        self.times.push(round_trip);
    }

    /// The quantile `x` is the time that a part `x` of all take at most.
    pub(crate) fn round_trips(&self) -> RoundTrips {
        let mut times = self.times.clone();
        times.sort_unstable();
        let us = |quantile: f64| {
            let rank = (quantile * times.len() as f64).ceil().max(1.0) as usize;
            times.get(rank - 1).map_or(f64::NAN, |time| time.as_nanos() as f64 / 1e3)
        };
        RoundTrips {
            p50_us: us(0.5),
            p99_us: us(0.99),
            p999_us: us(0.999),
            steps: times.len() as u64,
        }
    }
}

/// Steps a pendulum, whose step takes next to no time, over gRPC.
pub(crate) async fn over_grpc(client: &Client) -> Result<RoundTrips> {
    let plant = pendulum(client).await?;
    let mut driver = client.drive(&plant).await?;
    let mut stopwatch = Stopwatch::default();
    for k in 0..WARM_UP + STEPS {
        let start = Instant::now();
        driver.step(&[0.0]).await?;
        if k >= WARM_UP {
            stopwatch.record(start.elapsed());
        }
        progress("round trips over gRPC", k + 1, WARM_UP + STEPS);
    }
    driver.close().await?;
    client.delete_plant(plant).await?;
    Ok(stopwatch.round_trips())
}

/// The same over shared memory.
pub(crate) async fn over_shared_memory(client: &Client) -> Result<RoundTrips> {
    let plant = pendulum(client).await?;
    let mut driver = connect_link(client, &plant).await?;
    let mut stopwatch = Stopwatch::default();
    for k in 0..WARM_UP + STEPS {
        let start = Instant::now();
        driver.step(&[0.0])?;
        if k >= WARM_UP {
            stopwatch.record(start.elapsed());
        }
        progress("round trips, shared memory", k + 1, WARM_UP + STEPS);
    }
    drop(driver);
    client.delete_plant(plant).await?;
    Ok(stopwatch.round_trips())
}

/// A new pendulum; its id.
async fn pendulum(client: &Client) -> Result<String> {
    let request = v1::CreatePlantRequest { model: "pendulum".to_owned(), ..Default::default() };
    Ok(client.create_plant(request).await?.id)
}

/// Takes the lease of a plant over shared memory.
pub(crate) async fn connect_link(client: &Client, plant: &str) -> Result<LinkDriver> {
    let link = client.open_link(plant).await?;
    let options = LinkOptions {
        root: link.root_path.into(),
        connect_timeout: Duration::from_secs(10),
        timeout: Duration::from_secs(10),
        ..Default::default()
    };
    LinkDriver::connect(plant, options)
        .with_context(|| format!("cannot drive plant `{plant}` over shared memory"))
}
