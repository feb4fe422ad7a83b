//! Client of plantd: simulated plants that step when a controller says so.
//!
//! [`Client`] speaks gRPC over TCP or a Unix-domain socket; [`link::LinkDriver`] is the fast way for
//! a process on the server's machine. [`Driver`] closes a control loop with
//! one call per step:
//!
//! ```no_run
//! use plantd_client::{Client, diagonal, operating_point, v1, weights};
//!
//! # async fn balance() -> plantd_client::Result<()> {
//! let client = Client::connect("http://127.0.0.1:50051").await?;
//! let regulator = client
//!     .solve_lqr(v1::SolveLqrRequest {
//!         model: "pendulum".to_owned(),
//!         point: Some(operating_point("upright")),
//!         weights: Some(weights(diagonal([100.0, 1.0]), diagonal([1.0]))),
//!         ..Default::default()
//!     })
//!     .await?;
//! let gain = regulator.gain.expect("an LQR has a gain");
//!
//! let plant = client
//!     .create_plant(v1::CreatePlantRequest { model: "pendulum".to_owned(), ..Default::default() })
//!     .await?;
//! let mut state = plant.state.expect("a plant has a state");
//! let mut driver = client.drive(&plant.id).await?;
//! for _ in 0..1000 {
//!     state = driver.step_by(&gain, &state).await?.state.expect("a step has a state");
//! }
//! # Ok(())
//! # }
//! ```
//!
//! The server can keep the regulator for a plant ([`Client::set_feedback`]) and stream its gains ahead
//! of time; [`Client::follow_gains`] applies them in one call, [`GainSchedule`] those that were
//! collected, and [`Estimator`] runs a Kalman filter on what is measured.
//!
//! What the server refuses comes back as an [`Error`] with the gRPC code, the reason and what
//! is wrong with the request:
//!
//! ```no_run
//! # async fn upload(client: plantd_client::Client, scene: String) -> plantd_client::Result<()> {
//! if let Err(error) = client.create_model(scene).await {
//!     for violation in error.violations() {
//!         eprintln!("{}: {}", violation.field, violation.description);
//!     }
//! }
//! # Ok(())
//! # }
//! ```

mod client;
mod connection;
mod credentials;
mod driver;
mod error;
mod estimator;
mod follower;
mod handshake;
pub mod link;
mod messages;
mod reconnect;
mod recording;
mod rotation;
mod schedule;
mod stream;

pub use client::Client;
pub use connection::{ConnectOptions, DEFAULT_ADDRESS, MAX_RECEIVE_BYTES};
pub use credentials::{Authorization, AuthorizedChannel, Credentials};
pub use driver::Driver;
pub use error::{ConnectProblem, Error, Refusal, Result, Violation};
pub use estimator::Estimator;
pub use follower::Follower;
pub use messages::{
    GainExt, LawState, MatrixExt, RolloutExt, StateExt, WeightsExt, diagonal, full,
    operating_point, present_state, weights,
};
pub use reconnect::Reconnecting;
pub use recording::{RecordingEntry, RecordingReader};
pub use rotation::{compose, difference, rotations};
pub use schedule::{GainSchedule, Law};
pub use stream::Answers;

/// The messages and stubs of the contract, `plantd.v1`.
pub use plantd_proto::v1;
pub use tonic::Code;
