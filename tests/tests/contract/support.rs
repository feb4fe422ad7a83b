//! What the tests share.

use std::fmt::Debug;
use std::time::Duration;

use plantd_client::{Client, Code, Error, v1};
use plantd_tests::server::ServerProcess;

/// A server of its own and a client of it.
pub(crate) async fn server() -> (ServerProcess, Client) {
    let server = ServerProcess::start().unwrap();
    let client = server.client().await;
    (server, client)
}

/// A server with these flags added.
pub(crate) async fn server_with(flags: &[&str]) -> (ServerProcess, Client) {
    let server = ServerProcess::start_with(|command| {
        command.args(flags);
    })
    .unwrap();
    let client = server.client().await;
    (server, client)
}

/// Waits for what must come, but not for ever.
pub(crate) async fn soon<T>(work: impl Future<Output = T>) -> T {
    tokio::time::timeout(Duration::from_secs(30), work).await.expect("an answer within 30 s")
}

/// Creates a plant of a model where its scene starts.
pub(crate) async fn plant(client: &Client, model: &str) -> v1::PlantInfo {
    let request = v1::CreatePlantRequest { model: model.to_owned(), ..Default::default() };
    client.create_plant(request).await.unwrap()
}

/// Waits until nobody drives the plant: the server sees after a while that a driver has gone.
pub(crate) async fn undriven(client: &Client, id: &str) {
    let free = async {
        while !client.get_plant(id).await.unwrap().plant.unwrap().driver.is_empty() {
            tokio::task::yield_now().await;
        }
    };
    soon(free).await;
}

/// Asserts that a call was refused with this code and reason, and that one of the faults it names
/// is `field`; an empty field means that no fault of the request is named.
#[track_caller]
pub(crate) fn assert_refused<T: Debug>(
    result: Result<T, Error>,
    code: Code,
    reason: &str,
    field: &str,
) {
    let error = result.expect_err("a refusal");
    assert_eq!((error.code(), error.reason()), (Some(code), reason), "{error}");
    let fields: Vec<_> = error.violations().iter().map(|v| v.field.as_str()).collect();
    if field.is_empty() {
        assert!(fields.is_empty(), "{fields:?}");
    } else {
        assert!(fields.contains(&field), "no `{field}` among {fields:?}");
    }
    assert!(error.violations().iter().all(|v| !v.description.is_empty()), "{error}");
}

/// INVALID_ARGUMENT, INVALID_FIELD.
#[track_caller]
pub(crate) fn assert_bad_field<T: Debug>(result: Result<T, Error>, field: &str) {
    assert_refused(result, Code::InvalidArgument, "INVALID_FIELD", field);
}

/// NOT_FOUND.
#[track_caller]
pub(crate) fn assert_not_found<T: Debug>(result: Result<T, Error>, reason: &str) {
    assert_refused(result, Code::NotFound, reason, "");
}

/// The bits of a state: equal bits, equal states.
pub(crate) fn bits(state: &v1::State) -> (u64, Vec<u64>) {
    let numbers = [&state.q, &state.p, &state.v, &state.multipliers];
    (state.step, numbers.into_iter().flatten().map(|x| x.to_bits()).collect())
}

/// Initial state: configuration and velocity.
pub(crate) fn at_velocity(q: &[f64], v: &[f64]) -> v1::InitialState {
    let velocity = v1::initial_state::Velocity { q: q.to_vec(), v: v.to_vec() };
    v1::InitialState { form: Some(v1::initial_state::Form::Velocity(velocity)) }
}

/// Weights that are identities.
pub(crate) fn unit_weights(states: usize, inputs: usize) -> v1::LqrWeights {
    v1::LqrWeights {
        q: Some(plantd_client::diagonal(vec![1.0; states])),
        r: Some(plantd_client::diagonal(vec![1.0; inputs])),
        ..Default::default()
    }
}

/// Two pendulums side by side, of which only the first is driven; both stand upright.
pub(crate) const TWO_PENDULUMS: &str = r#"
format = 1
name = "two-pendulums"
gravity = [0.0, -9.8, 0.0]

[[frames]]
name = "left"
joint = { type = "revolute", axis = [0.0, 0.0, 1.0] }
body = { mass = 1.0, center_of_mass = [0.0, 1.0, 0.0] }

[[frames]]
name = "right"
joint = { type = "revolute", axis = [0.0, 0.0, 1.0] }
body = { mass = 1.0, center_of_mass = [0.0, 1.0, 0.0] }

[[inputs]]
name = "torque"
coordinate = "left"
"#;
