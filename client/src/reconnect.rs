//! A driver that survives its connection, its gateway, its server, and the move of its plant to another server.

use std::time::Duration;

use plantd_proto::v1;
use tokio::time::Instant;
use tonic::Code;

use crate::client::Client;
use crate::driver::Driver;
use crate::error::{Error, Result};

/// The first pause between two attempts, and the longest one; each is twice the last.
const PAUSE_MIN: Duration = Duration::from_millis(10);
const PAUSE_MAX: Duration = Duration::from_millis(500);

/// Servers on the way of a plant that are asked one after the other.
const HOPS_MAX: u32 = 8;

/// A [`Driver`] that opens its plant again when it has lost it, and sorts out what became of the step that was under
/// way: an input that did not arrive is sent again, an answer that was lost is read, and steps that the server has
/// lost are an error of their own.
///
/// ```no_run
/// # use std::time::Duration;
/// # use plantd_client::{Client, Error, Reconnecting, v1};
/// # async fn run(client: Client) -> plantd_client::Result<()> {
/// // The server keeps the lease for ten seconds; the driver looks for it for a minute.
/// let open = v1::DriveOpen { id: "p1".into(), grace_s: 10.0, ..Default::default() };
/// let mut driver = Reconnecting::open(client, open, Duration::from_secs(60)).await?;
/// for _ in 0..1000 {
///     match driver.step(&[0.1]).await {
///         Ok(step) => println!("{:?}", step.state),
///         Err(Error::RolledBack { from, to }) => println!("steps {to} to {from} are lost"),
///         Err(error) => return Err(error),
///     }
/// }
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct Reconnecting {
    client: Client,
    open: v1::DriveOpen,
    patience: Duration,
    driver: Driver,
    /// The step at which the plant was seen last.
    known: u64,
    reconnections: u64,
}

impl Reconnecting {
    /// Drives a plant, wherever it has gone. After a loss it is looked for as long as `patience`.
    ///
    /// # Errors
    /// Those of [`Client::drive_as`].
    pub async fn open(client: Client, open: v1::DriveOpen, patience: Duration) -> Result<Self> {
        let mut client = client;
        let mut hops = 0;
        let driver = loop {
            match client.drive_as(open.clone()).await {
                Ok(driver) => break driver,
                Err(error) => match error.elsewhere() {
                    Some(address) if hops < HOPS_MAX => client = client.at(address).await?,
                    _ => return Err(error),
                },
            }
            hops += 1;
        };
        let known = step_of(&driver);
        Ok(Self { client, open, patience, driver, known, reconnections: 0 })
    }

    /// The driver of the present connection.
    pub fn driver(&self) -> &Driver {
        &self.driver
    }

    /// How often the plant was opened again.
    pub fn reconnections(&self) -> u64 {
        self.reconnections
    }

    /// Takes one step with the input `u`, as [`Driver::step`] does. Without a lease that is kept (`grace_s`) somebody
    /// else may have driven in between: one step of theirs is taken for this one.
    ///
    /// # Errors
    /// [`Error::Step`] as of [`Driver::step`]. [`Error::RolledBack`] and [`Error::SteppedByOthers`] say where the plant
    /// is now; the input was not taken, and the driver goes on from there. Any other error is that of the last
    /// attempt, or one that no attempt can mend.
    pub async fn step(&mut self, u: &[f64]) -> Result<v1::DriveStep> {
        loop {
            let lost = match self.driver.step(u).await {
                Ok(step) => {
                    self.known = step.state.as_ref().map_or(self.known, |state| state.step);
                    return Ok(step);
                }
                Err(error) if is_lost(&error) => error,
                Err(error) => return Err(error),
            };
            self.reopen(lost).await?;
            let (from, to) = (self.known, step_of(&self.driver));
            self.known = to;
            if to < from {
                return Err(Error::RolledBack { from, to });
            }
            // A plant that runs by itself has gone on by itself.
            if to == from || !self.is_in_lockstep() {
                continue;
            }
            match self.driver.last() {
                Some(last) if to == from + 1 => return Ok(last.clone()),
                _ => return Err(Error::SteppedByOthers { from, to }),
            }
        }
    }

    /// Gives the lease back and waits until the server has done so.
    ///
    /// # Errors
    /// Those of [`Driver::close`].
    pub async fn close(self) -> Result<()> {
        self.driver.close().await
    }

    fn is_in_lockstep(&self) -> bool {
        let run = self.driver.plant().run.as_ref().and_then(|run| run.settings.as_ref());
        run.is_none_or(|settings| settings.pace() == v1::Pace::Lockstep)
    }

    /// Opens the plant again, where it is.
    async fn reopen(&mut self, mut lost: Error) -> Result<()> {
        let deadline = Instant::now() + self.patience;
        let mut address = self.client.address().to_owned();
        let mut resume = self.driver.lease_token().to_owned();
        let mut pause = PAUSE_MIN;
        loop {
            if let Some(elsewhere) = lost.elsewhere() {
                address = elsewhere.to_owned();
                // Its lease has stayed behind.
                resume.clear();
            }
            let open = v1::DriveOpen { resume: resume.clone(), ..self.open.clone() };
            let attempt = async {
                let client = self.client.at(&address).await?;
                let driver = client.drive_as(open).await?;
                Ok::<_, Error>((client, driver))
            };
            lost = match attempt.await {
                Ok((client, driver)) => {
                    (self.client, self.driver) = (client, driver);
                    self.reconnections += 1;
                    return Ok(());
                }
                Err(error) if error.reason() == "LEASE_LOST" => {
                    resume.clear();
                    continue;
                }
                Err(error) => error,
            };
            let may_come_back = is_lost(&lost) || lost.reason() == "LEASE_HELD";
            if !may_come_back || Instant::now() >= deadline {
                return Err(lost);
            }
            tokio::time::sleep(pause).await;
            pause = (2 * pause).min(PAUSE_MAX);
        }
    }
}

/// Whether an error is of the connection, or of a server that ends, and not of the plant.
fn is_lost(error: &Error) -> bool {
    match error {
        Error::StreamClosed | Error::Connect { .. } => true,
        Error::Rpc(refusal) => {
            let is_reset = matches!(refusal.code, Code::Internal | Code::Unknown | Code::Cancelled);
            matches!(refusal.code, Code::Unavailable | Code::DeadlineExceeded)
                || (is_reset && refusal.reason.is_empty())
                || matches!(&refusal.reason[..], "LEASE_LOST" | "PLANT_ELSEWHERE")
        }
        _ => false,
    }
}

fn step_of(driver: &Driver) -> u64 {
    driver.plant().state.as_ref().map_or(0, |state| state.step)
}
