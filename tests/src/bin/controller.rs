//! A controller or watcher in a process of its own, for tests to kill, stop, and let misbehave. Says
//! `ready` once it holds what it asked for, and goes on until it is ended.

use std::io::Write as _;
use std::time::Duration;

use anyhow::Result;
use clap::{Parser, ValueEnum};
use plantd_client::{Client, v1};

/// Drives or watches a plant.
#[derive(Parser)]
struct Arguments {
    /// Address of the server.
    address: String,
    /// Plant.
    plant: String,
    /// What it does.
    #[arg(value_enum)]
    manner: Manner,
}

#[derive(Clone, Copy, ValueEnum)]
enum Manner {
    /// Answers each state with a force.
    Drive,
    /// Sends inputs without a pause, and reads nothing.
    Flood,
    /// Sends inputs that are none.
    Nan,
    /// Answers, but takes ten seconds for it.
    Slow,
    /// Drives with forces that depend on their number alone.
    Sway,
    /// Watches the states.
    Watch,
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<()> {
    let Arguments { address, plant, manner } = Arguments::parse();
    let client = Client::connect(address).await?;
    if let Manner::Watch = manner {
        let fields = vec![v1::WatchField::State.into(), v1::WatchField::Timing.into()];
        let request = v1::WatchRequest { id: plant, fields, ..Default::default() };
        let mut states = client.watch(request).await?;
        say_ready()?;
        while states.next().await?.is_some() {}
        return Ok(());
    }
    let mut driver = client.drive(plant).await?;
    if let Manner::Sway = manner {
        say_ready()?;
        for k in 0_u32.. {
            driver.step(&[f64::from(k % 17) - 8.0]).await?;
        }
    }
    driver.step(&[0.0]).await?;
    say_ready()?;
    loop {
        match manner {
            Manner::Flood => driver.offer(&[1.0]).await?,
            // Each is refused, and the stream goes on.
            Manner::Nan => drop(driver.step(&[f64::NAN]).await),
            Manner::Slow => {
                driver.step(&[1.0]).await?;
                tokio::time::sleep(Duration::from_secs(10)).await;
            }
            _ => drop(driver.step(&[1.0]).await?),
        }
    }
}

fn say_ready() -> Result<()> {
    println!("ready");
    Ok(std::io::stdout().flush()?)
}
