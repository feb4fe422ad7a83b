//! Second derivatives of the map, and the dynamics of continuous time.

use plantd_client::{
    Client, Code, MatrixExt as _, StateExt as _, operating_point, present_state, v1,
};

use crate::support::*;

/// A request at the present state of a plant.
fn of_plant(id: &str) -> v1::LinearizeSecondOrderRequest {
    v1::LinearizeSecondOrderRequest { point: Some(present_state(id)), ..Default::default() }
}

/// A request at a state and an input.
fn at(model: &str, x: &[f64], u: &[f64], nd: usize, n: usize) -> v1::Point {
    assert_eq!(x.len(), 2 * n, "{model}");
    let state = v1::State {
        q: x[..n].to_vec(),
        p: x[n..n + nd].to_vec(),
        v: x[n + nd..].to_vec(),
        ..Default::default()
    };
    let here = v1::StateAndInput { state: Some(state), u: u.to_vec() };
    v1::Point { source: Some(v1::point::Source::StateAndInput(here)) }
}

/// The numbers that the paper prints for its pendulum.
#[tokio::test]
async fn the_papers_second_derivatives() {
    let (_server, client) = server().await;
    let settings = v1::PlantSettings {
        time_step_s: 0.1,
        force_split: v1::ForceSplit::Paper.into(),
        ..Default::default()
    };
    let request = v1::LinearizeSecondOrderRequest {
        model: "pendulum".to_owned(),
        settings: Some(settings),
        point: Some(at("pendulum", &[0.2, 0.5], &[0.8], 1, 1)),
        weights: None,
    };
    let tensors = client.linearize_second_order(request).await.unwrap().tensors.unwrap();
    let [xx, xu, uu] = [tensors.xx, tensors.xu, tensors.uu].map(Option::unwrap);
    assert_eq!((xx.outputs, xx.first, xx.second), (2, 2, 2));
    assert_eq!((xu.outputs, xu.first, xu.second), (2, 2, 1));
    assert_eq!((uu.outputs, uu.first, uu.second), (2, 1, 1));
    assert!(tensors.multipliers_xx.unwrap().data.is_empty());
    let close = |actual: &[f64], expected: &[f64]| {
        assert_eq!(actual.len(), expected.len());
        for (a, e) in actual.iter().zip(expected) {
            assert!((a / e - 1.0).abs() < 1e-5, "{a:e} instead of {e:e}");
        }
    };
    close(&xx.data[..4], &[1.01210e-2, 5.06048e-4, 5.06048e-4, 2.53024e-5]);
    close(&xx.data[4..], &[0.2024192, 1.01210e-2, 1.01210e-2, 5.06048e-4]);
    close(&xu.data, &[5.06048e-5, 2.53024e-6, 1.01210e-3, 5.06048e-5]);
    close(&uu.data, &[2.53024e-7, 5.06048e-6]);
}

/// Tensors against central differences of Linearize, and the contraction against the tensors, on a
/// constrained mechanism in motion.
#[tokio::test]
async fn tensors_differences_and_contractions_agree() {
    let (_server, client) = server().await;
    let id = plant(&client, "four-bar").await.id;
    let step = v1::StepRequest {
        id: id.clone(),
        u: Some(v1::Matrix::from_rows(&[[0.4]; 8])),
        ..Default::default()
    };
    let state = client.step(step).await.unwrap().states.remove(0);
    let answer = client.linearize_second_order(of_plant(&id)).await.unwrap();
    assert_eq!(bits(answer.state.as_ref().unwrap()), bits(&state));
    assert_eq!((answer.u.as_slice(), answer.next.unwrap().step), ([0.4].as_slice(), 9));
    let report = answer.report.unwrap();
    let conditions = [report.reciprocal_condition, report.constraint_reciprocal_condition];
    assert!(conditions.iter().all(|c| *c > 0.0 && *c <= 1.0), "{report:?}");
    let tensors = answer.tensors.unwrap();
    let (xx, xu) = (tensors.xx.unwrap(), tensors.xu.unwrap());
    let (mxx, muu) = (tensors.multipliers_xx.unwrap(), tensors.multipliers_uu.unwrap());
    assert_eq!((mxx.outputs, mxx.first, mxx.second, muu.data.len()), (2, 6, 6, 2));

    // Differences along the momenta keep to the constraints; q would leave them.
    let first = async |x: &[f64], u: f64| {
        let request = v1::LinearizeRequest {
            model: "four-bar".to_owned(),
            point: Some(at("four-bar", x, &[u], 3, 3)),
            ..Default::default()
        };
        client.linearize(request).await.unwrap().linearization.unwrap()
    };
    let (x, step) = (state.x(), 1e-4);
    for direction in 3..6 {
        let moved = |sign: f64| {
            let mut x = x.clone();
            x[direction] += sign * step;
            x
        };
        let (low, high) = (first(&moved(-1.0), 0.4).await, first(&moved(1.0), 0.4).await);
        let difference = |low: &v1::Matrix, high: &v1::Matrix, i: usize, j: usize| {
            (high.at(i, j) - low.at(i, j)) / (2.0 * step)
        };
        for i in 0..6 {
            for j in 0..6 {
                let exact = xx.data[(i * 6 + j) * 6 + direction];
                let (low, high) = (low.a.as_ref().unwrap(), high.a.as_ref().unwrap());
                let error = difference(low, high, i, j) - exact;
                assert!(error.abs() < 1e-5 * (1.0 + exact.abs()), "xx[{i}][{j}][{direction}]");
            }
            let exact = xu.data[i * 6 + direction];
            let error = difference(low.b.as_ref().unwrap(), high.b.as_ref().unwrap(), i, 0) - exact;
            assert!(error.abs() < 1e-5 * (1.0 + exact.abs()), "xu[{i}][{direction}]");
        }
        for c in 0..2 {
            for j in 0..6 {
                let exact = mxx.data[(c * 6 + j) * 6 + direction];
                let (low, high) =
                    (low.multipliers_x.as_ref().unwrap(), high.multipliers_x.as_ref().unwrap());
                let error = difference(low, high, c, j) - exact;
                assert!(error.abs() < 1e-4 * (1.0 + exact.abs()), "multipliers_xx[{c}][{j}]");
            }
        }
    }

    let weights = v1::ContractionWeights {
        x: (0..6).map(|i| f64::from(i + 1).sin()).collect(),
        multipliers: vec![0.3, -0.7],
    };
    let request =
        v1::LinearizeSecondOrderRequest { weights: Some(weights.clone()), ..of_plant(&id) };
    let contracted = client.linearize_second_order(request).await.unwrap();
    assert_eq!(contracted.linearization, answer.linearization);
    assert!(contracted.tensors.is_none());
    let sum = contracted.contraction.unwrap().xx.unwrap();
    let scale = sum.data.iter().fold(0.0, |m: f64, e| m.max(e.abs()));
    for (k, entry) in sum.data.iter().enumerate() {
        let of = |tensor: &v1::Tensor, weights: &[f64]| -> f64 {
            weights.iter().enumerate().map(|(i, w)| w * tensor.data[i * 36 + k]).sum()
        };
        let expected = of(&xx, &weights.x) + of(&mxx, &weights.multipliers);
        assert!((entry - expected).abs() < 1e-10 * scale, "entry {k}");
    }
}

#[tokio::test]
async fn tensors_that_are_too_large_are_refused_and_can_be_contracted() {
    let (_server, client) = server().await;
    let request = |weights| v1::LinearizeSecondOrderRequest {
        model: "marionette".to_owned(),
        point: Some(operating_point("initial")),
        weights,
        ..Default::default()
    };
    let refused = client.linearize_second_order(request(None)).await;
    assert!(refused.as_ref().unwrap_err().to_string().contains("reply_numbers"));
    assert_refused(refused, Code::ResourceExhausted, "LIMIT_EXCEEDED", "");
    let weights = |x: usize| v1::ContractionWeights { x: vec![1.0; x], multipliers: Vec::new() };
    let sum = client.linearize_second_order(request(Some(weights(80)))).await.unwrap();
    let sum = sum.contraction.unwrap();
    let shape = |m: Option<v1::Matrix>| m.map(|m| (m.rows, m.cols, m.data.len())).unwrap();
    assert_eq!(shape(sum.xx), (80, 80, 6400));
    assert_eq!(shape(sum.xu), (80, 18, 1440));
    assert_eq!(shape(sum.uu), (18, 18, 324));
    let bad = client.linearize_second_order(request(Some(weights(79)))).await;
    assert_bad_field(bad, "weights.x");

    let (_server, client) = server_with(&["--limit", "second_order_numbers=1000"]).await;
    let refused = client.linearize_second_order(request(Some(weights(80)))).await;
    assert!(refused.as_ref().unwrap_err().to_string().contains("second_order_numbers"));
    assert_refused(refused, Code::ResourceExhausted, "LIMIT_EXCEEDED", "");
}

/// A point of 2 kg on a rod of 3 m, in Cartesian coordinates.
const CARTESIAN: &str = r#"
format = 1
name = "cartesian"
gravity = [0.0, -9.8, 0.0]

[[frames]]
name = "x"
joint = { type = "prismatic", axis = [1.0, 0.0, 0.0] }

[[frames]]
name = "y"
parent = "x"
joint = { type = "prismatic", axis = [0.0, 1.0, 0.0] }
body = { mass = 2.0 }

[[coordinates]]
name = "y"
initial = -3.0

[[constraints]]
type = "distance"
name = "rod"
a = { frame = "world" }
b = { frame = "y" }
length = 3.0
"#;

fn dynamics(model: &str, order: u32) -> v1::EvaluateDynamicsRequest {
    v1::EvaluateDynamicsRequest { model: model.to_owned(), order, ..Default::default() }
}

#[tokio::test]
async fn accelerations_and_their_derivatives_in_closed_form() {
    let (_server, client) = server().await;
    let request = v1::EvaluateDynamicsRequest {
        q: vec![0.4],
        v: vec![3.0],
        inputs: vec![0.7],
        ..dynamics("pendulum", 2)
    };
    let answer = client.evaluate_dynamics(request).await.unwrap();
    let (g, sin, cos) = (9.8, f64::sin(0.4), f64::cos(0.4));
    let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-12, "{a} instead of {b}");
    close(answer.acceleration[0], 0.7 - g * sin);
    let jacobian = answer.jacobian.unwrap();
    assert_eq!((jacobian.rows, jacobian.cols), (1, 3));
    jacobian.data.iter().zip([-g * cos, 0.0, 1.0]).for_each(|(a, b)| close(*a, b));
    let hessian = answer.hessian.unwrap();
    assert_eq!((hessian.outputs, hessian.first, hessian.second), (1, 3, 3));
    hessian
        .data
        .iter()
        .enumerate()
        .for_each(|(i, &a)| close(a, if i == 0 { g * sin } else { 0.0 }));

    // Hanging: the rod pulls with m (g + v² / l), which is 2 l lambda.
    client.create_model(CARTESIAN).await.unwrap();
    let request = v1::EvaluateDynamicsRequest { v: vec![1.5, 0.0], ..dynamics("cartesian", 1) };
    let answer = client.evaluate_dynamics(request).await.unwrap();
    close(answer.multipliers[0], 2.0 * (g + 1.5 * 1.5 / 3.0) / 6.0);
    close(answer.acceleration[0], 0.0);
    close(answer.acceleration[1], 1.5 * 1.5 / 3.0);
    let jacobian = answer.jacobian.unwrap();
    assert_eq!((jacobian.rows, jacobian.cols), (3, 4));
    assert!(answer.hessian.is_none());
    // d(multiplier) / d(velocity along x) = 2 m v / (2 l²).
    close(jacobian.at(2, 2), 2.0 * 1.5 / 9.0);
    let value = client.evaluate_dynamics(dynamics("cartesian", 0)).await.unwrap();
    assert!(value.jacobian.is_none() && value.hessian.is_none());
}

#[tokio::test]
async fn bad_requests_name_their_field() {
    let (_server, client) = server().await;
    let changed = |change: &dyn Fn(&mut v1::EvaluateDynamicsRequest)| {
        let mut request = dynamics("cart-pole", 1);
        change(&mut request);
        request
    };
    for (request, field) in [
        (changed(&|r| r.q = vec![0.0]), "q"),
        (changed(&|r| r.v = vec![0.0, f64::NAN]), "v[1]"),
        (changed(&|r| r.inputs = vec![0.0; 2]), "inputs"),
        (changed(&|r| r.prescribed_acceleration = vec![0.0]), "prescribed_acceleration"),
        (changed(&|r| r.order = 3), "order"),
        (changed(&|r| r.operating_point = "sideways".to_owned()), "operating_point"),
    ] {
        assert_bad_field(client.evaluate_dynamics(request).await, field);
    }
    assert_not_found(client.evaluate_dynamics(dynamics("none", 0)).await, "MODEL_NOT_FOUND");
    assert_limited_hessian(&client).await;
}

async fn assert_limited_hessian(client: &Client) {
    let refused = client.evaluate_dynamics(dynamics("chain-100", 2)).await;
    assert!(refused.as_ref().unwrap_err().to_string().contains("reply_numbers"));
    assert_refused(refused, Code::ResourceExhausted, "LIMIT_EXCEEDED", "");
    client.evaluate_dynamics(dynamics("chain-100", 1)).await.unwrap();
}
