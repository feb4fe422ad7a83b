//! What shows plants: drawings, poses, poles, at a pace; the page, and the files of models.

use std::collections::BTreeSet;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::{Duration, Instant};

use nalgebra::{Complex, DMatrix};
use plantd_client::{Answers, Client, Code, operating_point, present_state, v1};
use plantd_models::{Kinematics, Model, builtin};
use plantd_tests::server::{ServerProcess, binary};
use tonic::body::Body;
use tonic::codegen::Service as _;
use tonic::codegen::http::{Request, StatusCode};
use tonic::transport::Endpoint;
use v1::drawn_shape::Shape;
use v1::get_drawing_request::Of;
use v1::set_feedback_request::Reference;

use crate::support::*;

async fn watch(client: &Client, id: &str, fields: &[v1::WatchField]) -> Answers<v1::WatchResponse> {
    client.watch(request(id, fields)).await.unwrap()
}

fn request(id: &str, fields: &[v1::WatchField]) -> v1::WatchRequest {
    let fields = fields.iter().map(|&field| field.into()).collect();
    v1::WatchRequest { id: id.to_owned(), fields, ..Default::default() }
}

async fn next<T: std::fmt::Debug>(stream: &mut Answers<T>) -> T {
    soon(stream.next()).await.unwrap().expect("the stream goes on")
}

async fn drawing_of(client: &Client, of: Of) -> v1::GetDrawingResponse {
    client.get_drawing(v1::GetDrawingRequest { of: Some(of) }).await.unwrap()
}

async fn drawing_of_plant(client: &Client, id: &str) -> v1::GetDrawingResponse {
    drawing_of(client, Of::Plant(id.to_owned())).await
}

/// Poses of a drawing against kinematics at the configuration.
#[track_caller]
fn assert_poses(drawing: &v1::Drawing, poses: &v1::Poses, kinematics: &mut Kinematics, q: &[f64]) {
    kinematics.place(q, &vec![0.0; q.len()]).unwrap();
    assert_eq!(poses.frames.len(), 7 * drawing.frames.len());
    for (frame, pose) in drawing.frames.iter().zip(poses.frames.chunks(7)) {
        let at = kinematics.motion(&kinematics.point(&frame.name, [0.0; 3]).unwrap());
        let expected = [&at.position[..], &at.orientation].concat();
        let apart = pose.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(apart < 1e-12, "{}: {pose:?} instead of {expected:?}", frame.name);
    }
    let points: u32 = drawing.lines.iter().map(|line| line.points).sum();
    assert_eq!(poses.points.len(), 3 * points as usize);
    assert_eq!(poses.arrows.len(), 6 * drawing.arrows.len());
    let all = poses.points.iter().chain(&poses.arrows);
    assert!(all.into_iter().all(|x| x.is_finite()));
}

#[tokio::test]
async fn poses_are_those_of_the_state_beside_them() {
    use v1::WatchField::{Poses, State};
    let (_server, client) = server().await;
    let model = Arc::new(Model::compile(&builtin::scene("marionette").unwrap()).unwrap());
    let mut kinematics = Kinematics::new(Arc::clone(&model));
    let initial: Vec<f64> = model.coordinates().iter().map(|c| c.initial).collect();
    let of_model = drawing_of(&client, Of::Model("marionette".to_owned())).await;
    let drawing = of_model.drawing.unwrap();
    assert_poses(&drawing, &of_model.poses.unwrap(), &mut kinematics, &initial);
    assert!(drawing.size_m > 0.1 && drawing.frames.len() > 5 && drawing.lines.len() > 5);

    let id = plant(&client, "marionette").await.id;
    let of_plant = drawing_of_plant(&client, &id).await;
    assert_eq!((of_plant.drawing.as_ref(), of_plant.poses), (Some(&drawing), None));
    let mut stream = watch(&client, &id, &[State, Poses]).await;
    let mut driver = client.drive(&id).await.unwrap();
    let hold = initial[model.dimensions().dynamic..].to_vec();
    let mut seen = 0;
    for _ in 0..20 {
        driver.step(&hold).await.unwrap();
        let message = next(&mut stream).await;
        let q = message.state.unwrap().q;
        assert_poses(&drawing, &message.poses.unwrap(), &mut kinematics, &q);
        assert!(message.failure.is_none() && message.energy.is_none());
        seen += 1;
    }
    assert_eq!(seen, 20);
}

const HANGING: &str = r#"
format = 1
name = "hanging"
gravity = [0.0, 0.0, -10.0]
[[frames]]
name = "weight"
joint = { type = "free" }
body = { mass = 2.0, inertia = [0.1, 0.1, 0.1] }
[[inputs]]
name = "wind"
[[forces]]
type = "hybrid_wrench"
frame = "weight"
force = ["wind", 0.0, 0.0]
[[signals]]
drives = "wind"
type = "constant"
value = 0.5
[[constraints]]
type = "distance"
name = "string"
a = { frame = "world", at = [0.0, 0.0, 1.0] }
b = { frame = "weight" }
length = 1.0
"#;

/// The string carries the weight; the wind is what the driver and the signal send.
#[tokio::test]
async fn arrows_are_forces() {
    let (_server, client) = server().await;
    client.create_model(HANGING).await.unwrap();
    let id = plant(&client, "hanging").await.id;
    let drawing = drawing_of_plant(&client, &id).await.drawing.unwrap();
    let arrows: Vec<_> =
        drawing.arrows.iter().map(|a| (a.kind(), a.name.as_str(), a.torque)).collect();
    let kinds = [v1::ArrowKind::Input, v1::ArrowKind::Constraint];
    assert_eq!(arrows, [(kinds[0], "wind", false), (kinds[1], "string", false)]);
    let mut stream = watch(&client, &id, &[v1::WatchField::Poses, v1::WatchField::State]).await;
    let mut driver = client.drive(&id).await.unwrap();
    // The momentum of a plant at rest has half of the first step's gravity in it, and its string the other half.
    for _ in 0..2 {
        driver.step(&[-0.5]).await.unwrap();
    }
    let message = loop {
        let message = next(&mut stream).await;
        if message.step == 2 {
            break message;
        }
    };
    let arrows = message.poses.unwrap().arrows;
    let expected = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 20.0];
    let apart = arrows.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(arrows.len() == 12 && apart < 1e-9, "{arrows:?}");
    driver.step(&[2.5]).await.unwrap();
    let wind = loop {
        let message = next(&mut stream).await;
        if message.step == 3 {
            break message.poses.unwrap().arrows[3];
        }
    };
    assert_eq!(wind, 3.0);
}

fn distance(poles: &[v1::Complex], expected: &[Complex<f64>]) -> f64 {
    let nearest = |z: &v1::Complex| {
        let z = Complex::new(z.real, z.imaginary);
        expected.iter().map(|e| (z - e).norm()).fold(f64::INFINITY, f64::min)
    };
    poles.iter().map(nearest).fold(0.0, f64::max)
}

fn matrix(m: &v1::Matrix) -> DMatrix<f64> {
    DMatrix::from_row_slice(m.rows as usize, m.cols as usize, &m.data)
}

#[tokio::test]
async fn poles_are_those_of_the_map_with_and_without_feedback() {
    use v1::WatchField::{Linearization, Poles};
    let (_server, client) = server().await;
    let request = v1::CreatePlantRequest {
        model: "cart-pole".to_owned(),
        initial: Some(v1::InitialState {
            form: Some(v1::initial_state::Form::OperatingPoint("upright".to_owned())),
        }),
        ..Default::default()
    };
    let id = client.create_plant(request).await.unwrap().id;
    let mut stream = watch(&client, &id, &[Poles, Linearization]).await;
    let message = next(&mut stream).await;
    let poles = message.poles.unwrap();
    assert!(poles.closed_loop.is_empty() && message.linearization.is_some());
    let analyze = v1::AnalyzeRequest { point: Some(present_state(&id)), ..Default::default() };
    let modes = client.analyze(analyze).await.unwrap().modes;
    let expected: Vec<_> = modes.iter().map(|m| (m.real, m.imaginary)).collect();
    let found: Vec<_> = poles.open_loop.iter().map(|z| (z.real, z.imaginary)).collect();
    assert_eq!(found, expected);
    assert!(found.iter().any(|(real, _)| *real > 1.0), "upright it falls: {found:?}");

    let feedback = v1::SetFeedbackRequest {
        id: id.clone(),
        reference: Some(Reference::Point(operating_point("upright"))),
        weights: Some(unit_weights(4, 1)),
        mode: v1::FeedbackMode::Replace.into(),
        ..Default::default()
    };
    client.set_feedback(feedback).await.unwrap();
    let mut gains = client.watch_gains(&id).await.unwrap();
    let gain = next(&mut gains).await.gain.unwrap();
    // It is at rest, and its watchers learn of it all the same.
    let message = next(&mut stream).await;
    let poles = message.poles.unwrap();
    let linearization = message.linearization.unwrap();
    let [a, b] = [&linearization.a, &linearization.b].map(|m| matrix(m.as_ref().unwrap()));
    let closed = a - b * matrix(gain.k.as_ref().unwrap());
    let expected: Vec<_> = closed.complex_eigenvalues().iter().copied().collect();
    assert_eq!(poles.closed_loop.len(), 4);
    assert!(
        distance(&poles.closed_loop, &expected) < 1e-9,
        "{:?}\n{expected:?}",
        poles.closed_loop
    );
    let inside = |z: &v1::Complex| z.real.hypot(z.imaginary) < 1.0;
    assert!(poles.closed_loop.iter().all(inside), "{:?}", poles.closed_loop);
}

/// Constraints and prescribed coordinates take their poles away: as in Analyze.
#[tokio::test]
async fn poles_of_constrained_plants_are_on_their_constraints() {
    let (_server, client) = server().await;
    for model in ["four-bar", "marionette"] {
        let id = plant(&client, model).await.id;
        let mut stream = watch(&client, &id, &[v1::WatchField::Poles]).await;
        let poles = next(&mut stream).await.poles.unwrap().open_loop;
        let analyze = v1::AnalyzeRequest { point: Some(present_state(&id)), ..Default::default() };
        let modes = client.analyze(analyze).await.unwrap().modes;
        let close = |(z, m): (&v1::Complex, &v1::Mode)| {
            (z.real - m.real).hypot(z.imaginary - m.imaginary) < 1e-9
        };
        assert_eq!(poles.len(), modes.len(), "{model}");
        assert!(poles.iter().zip(&modes).all(close), "{model}");
    }
}

/// The latest state wins; what is passed over on purpose is not lost, and the last one comes.
#[tokio::test]
async fn a_watcher_can_ask_for_a_pace() {
    const STEPS: u64 = 3000;
    let (_server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let at_most_hz = 50.0;
    let paced = v1::WatchRequest { at_most_hz, ..request(&id, &[v1::WatchField::State]) };
    let mut stream = client.watch(paced.clone()).await.unwrap();
    let began = Instant::now();
    let driving = async {
        let mut driver = client.drive(&id).await.unwrap();
        for _ in 0..STEPS {
            driver.step(&[0.1]).await.unwrap();
        }
    };
    let watching = async {
        let mut seen: Vec<u64> = Vec::new();
        while seen.last() != Some(&STEPS) {
            let message = next(&mut stream).await;
            assert_eq!(message.dropped, 0, "passed over is not lost");
            seen.push(message.step);
        }
        seen
    };
    let ((), seen) = tokio::join!(driving, watching);
    let most = began.elapsed().as_secs_f64() * at_most_hz + 2.0;
    assert!((seen.len() as f64) < most, "{} messages, {most} allowed", seen.len());
    assert!(seen.len() < STEPS as usize / 2, "{} messages", seen.len());
    assert!(seen.is_sorted_by(|a, b| a < b));

    let refused = async |request: v1::WatchRequest| match client.watch(request).await {
        Ok(mut stream) => soon(stream.next()).await,
        Err(error) => Err(error),
    };
    for at_most_hz in [-1.0, f64::NAN, f64::INFINITY] {
        let wrong = v1::WatchRequest { at_most_hz, ..paced.clone() };
        assert_bad_field(refused(wrong).await, "at_most_hz");
    }
    assert_bad_field(refused(v1::WatchRequest { queue: 2, ..paced.clone() }).await, "queue");
    // As slow as one likes: the first message comes at once all the same.
    let slow = v1::WatchRequest { at_most_hz: 1e-300, ..paced };
    next(&mut client.watch(slow).await.unwrap()).await;
}

#[tokio::test]
async fn a_changed_parameter_is_another_drawing() {
    let (_server, client) = server().await;
    let id = plant(&client, "four-bar").await.id;
    let before = drawing_of_plant(&client, &id).await;
    let mut stream = watch(&client, &id, &[v1::WatchField::State]).await;
    assert_eq!(next(&mut stream).await.generation, before.generation);
    let parameter = v1::Parameter { path: "frames[crank].body.mass".to_owned(), value: 0.1 };
    let change = v1::SetParametersRequest {
        id: id.clone(),
        parameters: vec![parameter],
        ..Default::default()
    };
    client.set_parameters(change).await.unwrap();
    let after = drawing_of_plant(&client, &id).await;
    assert!(after.generation > before.generation);
    let mut driver = client.drive(&id).await.unwrap();
    driver.step(&[0.0]).await.unwrap();
    while next(&mut stream).await.generation != after.generation {}
    let crank = |response: &v1::GetDrawingResponse| {
        let frame = response.drawing.as_ref().unwrap().frames[0].clone();
        let Some(Shape::Box(shape)) = &frame.shapes[0].shape else { panic!("{frame:?}") };
        (frame.mass_kg, shape.size[2])
    };
    assert_eq!(crank(&before).0, 0.5);
    assert_eq!(crank(&after).0, 0.1);
    // The moments stay: a lighter rod that has them is longer.
    assert!((crank(&after).1 / crank(&before).1 - f64::sqrt(5.0)).abs() < 1e-12);
}

#[tokio::test]
async fn drawings_of_nothing_are_refused() {
    let (_server, client) = server().await;
    let get = async |of| client.get_drawing(v1::GetDrawingRequest { of }).await;
    assert_bad_field(get(None).await, "of");
    assert_not_found(get(Some(Of::Plant("none".to_owned()))).await, "PLANT_NOT_FOUND");
    assert_not_found(get(Some(Of::Model("none".to_owned()))).await, "MODEL_NOT_FOUND");
}

/// An answer over HTTP/1.1: its head in lower case, and its body.
fn http(server: &ServerProcess, line: &str, fields: &str) -> (String, Vec<u8>) {
    let address = server.address().strip_prefix("http://").unwrap();
    let host = if fields.to_lowercase().contains("host:") {
        String::new()
    } else {
        format!("Host: {address}\r\n")
    };
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    let head = format!("{line} HTTP/1.1\r\nConnection: close\r\n{host}{fields}\r\n");
    stream.write_all(head.as_bytes()).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let end = answer.windows(4).position(|w| w == b"\r\n\r\n").expect("a whole head");
    let head = String::from_utf8(answer[..end].to_vec()).unwrap().to_lowercase();
    (head, answer[end + 4..].to_vec())
}

fn field<'a>(head: &'a str, name: &str) -> Option<&'a str> {
    let mut fields = head.lines().filter_map(|line| line.split_once(": "));
    fields.find(|(field, _)| *field == name).map(|(_, value)| value)
}

#[track_caller]
fn assert_status(answer: &(String, Vec<u8>), status: u16) {
    assert!(answer.0.starts_with(&format!("http/1.1 {status}")), "{}", answer.0);
}

const GZIP: &str = "Accept-Encoding: br, gzip\r\n";

#[tokio::test(flavor = "multi_thread")]
async fn the_page_is_served_beside_the_services() {
    let (server, client) = server().await;
    for (path, kind, encoding) in [
        ("/", "text/html; charset=utf-8", None),
        ("/?plant=a", "text/html; charset=utf-8", None),
        ("/viewer.js", "text/javascript; charset=utf-8", Some("gzip")),
        ("/viewer.css", "text/css; charset=utf-8", None),
    ] {
        let answer = http(&server, &format!("GET {path}"), GZIP);
        assert_status(&answer, 200);
        let (head, body) = answer;
        assert_eq!(field(&head, "content-type"), Some(kind), "{head}");
        assert_eq!(field(&head, "content-encoding"), encoding, "{head}");
        assert_eq!(field(&head, "content-length"), Some(body.len().to_string().as_str()), "{head}");
        assert_eq!(field(&head, "x-content-type-options"), Some("nosniff"));
        assert_eq!(field(&head, "referrer-policy"), Some("no-referrer"));
        assert_eq!(field(&head, "cross-origin-resource-policy"), Some("same-origin"));
        let policy = field(&head, "content-security-policy").unwrap();
        for part in ["default-src 'none'", "script-src 'self'", "frame-ancestors 'none'"] {
            assert!(policy.contains(part), "{policy}");
        }
        assert!(!head.contains("access-control"), "{head}");

        // Who has it does not get it again; who asks for the head alone gets that.
        let etag = field(&head, "etag").unwrap();
        let known = format!("{GZIP}If-None-Match: W/\"other\", {etag}\r\n");
        let again = http(&server, &format!("GET {path}"), &known);
        assert_status(&again, 304);
        assert!(again.1.is_empty());
        let alone = http(&server, &format!("HEAD {path}"), GZIP);
        assert_status(&alone, 200);
        assert!(alone.1.is_empty());
        assert_eq!(field(&alone.0, "content-length"), Some(body.len().to_string().as_str()));
    }
    assert_status(&http(&server, "GET /viewer.js", ""), 406);
    for path in ["/viewer.js.gz", "/index.html", "/../etc/passwd", "/%2e%2e/x", "/models", "/x"]
        .into_iter()
        .chain(["/plantd.v1.ModelService/GetModel", "/models/a/files/b.stl", "//"])
    {
        assert_status(&http(&server, &format!("GET {path}"), ""), 404);
    }
    for method in ["PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "POST", "BREW"] {
        let answer = http(&server, &format!("{method} /"), "Content-Length: 0\r\n");
        assert_status(&answer, 405);
        assert_eq!(field(&answer.0, "allow"), Some("get, head"));
    }
    let long = format!("GET /{}", "x".repeat(4000));
    assert_status(&http(&server, &long, ""), 404);
    client.get_model("pendulum").await.unwrap();
    let url = format!("{}/", server.address());
    assert_eq!(server.addresses().view.as_ref(), Some(&url));
    assert!(server.log().contains(&format!("See the plants: {url}\n")), "{}", server.log());
}

#[tokio::test(flavor = "multi_thread")]
async fn the_page_can_be_turned_off() {
    let (server, client) = server_with(&["--view", "off"]).await;
    client.create_model(SHOWN).await.unwrap();
    let put = v1::PutModelFileRequest {
        model: "shown".to_owned(),
        file: "meshes/arm.stl".to_owned(),
        data: vec![1],
    };
    let url = client.put_model_file(put).await.unwrap();
    for path in ["/", "/viewer.js", "/viewer.css", &url] {
        assert_status(&http(&server, &format!("GET {path}"), GZIP), 404);
    }
    assert!(!server.log().contains("See the plants"), "{}", server.log());
}

#[tokio::test(flavor = "multi_thread")]
async fn the_page_is_not_for_strangers() {
    let flags = ["--allow-origin", "https://panel.example", "--allow-host", "plants.lab"];
    let (server, client) = server_with(&flags).await;
    client.create_model(SHOWN).await.unwrap();
    let put = v1::PutModelFileRequest {
        model: "shown".to_owned(),
        file: "meshes/arm.stl".to_owned(),
        data: b"mesh".to_vec(),
    };
    let url = client.put_model_file(put).await.unwrap();
    let own = server.address().strip_prefix("http://").unwrap();
    let port = own.rsplit(':').next().unwrap();
    for path in ["/", "/viewer.js", &url] {
        for fields in [
            format!("Host: plants.lab:{port}\r\n"),
            format!("Host: localhost:{port}\r\nOrigin: http://localhost:{port}\r\n"),
            format!("Host: {own}\r\nOrigin: https://panel.example\r\n"),
        ] {
            assert_status(&http(&server, &format!("GET {path}"), &format!("{GZIP}{fields}")), 200);
        }
        for fields in [
            "Host: evil.example\r\n".to_owned(),
            format!("Host: evil.example:{port}\r\nOrigin: http://evil.example:{port}\r\n"),
            format!("Host: {own}\r\nOrigin: https://evil.example\r\n"),
            format!("Host: {own}\r\nOrigin: null\r\n"),
        ] {
            let answer = http(&server, &format!("GET {path}"), &format!("{GZIP}{fields}"));
            assert_status(&answer, 403);
            assert!(!answer.0.contains("access-control") && !answer.1.ends_with(b"mesh"));
        }
    }
    // Over HTTP/2 the name is the authority.
    for (authority, status) in [(own, StatusCode::OK), ("evil.example", StatusCode::FORBIDDEN)] {
        let endpoint = Endpoint::from_shared(server.address().to_owned()).unwrap();
        let origin = format!("http://{authority}");
        let mut channel = endpoint.origin(origin.parse().unwrap()).connect().await.unwrap();
        std::future::poll_fn(|context| channel.poll_ready(context)).await.unwrap();
        let request = Request::get(format!("{origin}{url}")).body(Body::empty()).unwrap();
        assert_eq!(soon(channel.call(request)).await.unwrap().status(), status, "{authority}");
    }
    // Beyond the loopback interface programs may call it by any name; a page sends no `Origin` for a mesh.
    let (server, _client) = server_with(&["--grpc", "0.0.0.0:0", "--insecure"]).await;
    let port = server.address().rsplit(':').next().unwrap().to_owned();
    let reach = |fields: &str| {
        let mut stream = TcpStream::connect(format!("127.0.0.1:{port}")).unwrap();
        let head = format!("GET / HTTP/1.1\r\nConnection: close\r\n{fields}\r\n\r\n");
        stream.write_all(head.as_bytes()).unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        answer
    };
    assert!(reach("Host: evil.example").starts_with("HTTP/1.1 403"));
    assert!(reach(&format!("Host: 127.0.0.1:{port}")).starts_with("HTTP/1.1 200"));
    assert!(server.log().contains(&format!("See the plants: http://127.0.0.1:{port}/")));
}

const SHOWN: &str = r#"
format = 1
name = "shown"
gravity = [0.0, 0.0, -9.8]
[[frames]]
name = "arm"
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
body = { mass = 1.0, center_of_mass = [0.0, 0.0, -0.5] }
visuals = [
    { shape = { type = "mesh", file = "meshes/arm.stl", scale = [0.001, 0.001, 0.001] }, color = [1.0, 0.5, 0.0, 1.0] },
    { shape = { type = "mesh", file = "package://arm/hand.obj" } },
    { shape = { type = "mesh", file = "../outside.stl" } },
]
"#;

/// Files and addresses of the meshes of a drawing.
fn meshes(response: v1::GetDrawingResponse) -> Vec<(String, String)> {
    let frames = response.drawing.unwrap().frames.into_iter();
    let shapes = frames.flat_map(|frame| frame.shapes);
    let mesh = |shape: v1::DrawnShape| match shape.shape {
        Some(Shape::Mesh(mesh)) => Some((mesh.file, mesh.url)),
        _ => None,
    };
    shapes.filter_map(mesh).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn files_of_a_model_are_served_as_long_as_it_is_there() {
    let (server, client) = server_with(&["--limit", "model_file_bytes=1000,model_files=3"]).await;
    client.create_model(SHOWN).await.unwrap();
    let id = plant(&client, "shown").await.id;
    let put = async |model: &str, file: &str, data: Vec<u8>| {
        let (model, file) = (model.to_owned(), file.to_owned());
        client.put_model_file(v1::PutModelFileRequest { model, file, data }).await
    };
    let before = meshes(drawing_of_plant(&client, &id).await);
    assert!(before.len() == 3 && before.iter().all(|(_, url)| url.is_empty()), "{before:?}");
    let arm = put("shown", "meshes/arm.stl", vec![7; 1000]).await.unwrap();
    let hand = put("shown", "package://arm/hand.obj", b"v 0 0 0".to_vec()).await.unwrap();
    for shown in [
        meshes(drawing_of_plant(&client, &id).await),
        meshes(drawing_of(&client, Of::Model("shown".to_owned())).await),
    ] {
        let urls: BTreeSet<_> = shown.iter().map(|(_, url)| url.as_str()).collect();
        assert_eq!(urls, BTreeSet::from(["", &arm, &hand]));
    }
    let answer = http(&server, &format!("GET {arm}"), "");
    assert_status(&answer, 200);
    assert_eq!(answer.1, [7; 1000]);
    assert_eq!(field(&answer.0, "content-type"), Some("application/octet-stream"));
    assert!(field(&answer.0, "cache-control").unwrap().contains("immutable"), "{}", answer.0);
    assert!(field(&answer.0, "content-security-policy").unwrap().contains("sandbox"));
    // What a mesh refers to has no tag: it is asked for again.
    let picture = put("shown", "meshes/skin.png", vec![1, 2]).await.unwrap();
    let bare = picture.split('?').next().unwrap();
    let answer = http(&server, &format!("GET {bare}"), "");
    assert_eq!(answer.1, [1, 2]);
    assert_eq!(field(&answer.0, "content-type"), Some("image/png"));
    assert_eq!(field(&answer.0, "cache-control"), Some("no-cache"));
    // Another one in its place has another address.
    let other = put("shown", "meshes/arm.stl", vec![8; 10]).await.unwrap();
    assert_ne!(other, arm);

    for file in ["../outside.stl", "/etc/a.stl", "a/../b.stl", "a b.stl", "a.html", "a", ""] {
        assert_bad_field(put("shown", file, vec![1]).await, "file");
    }
    assert_not_found(put("none", "a.stl", vec![1]).await, "MODEL_NOT_FOUND");
    let builtin = put("pendulum", "a.stl", vec![1]).await;
    assert_refused(builtin, Code::FailedPrecondition, "BUILTIN_MODEL", "");
    for (file, bytes, limit) in
        [("b.stl", 1, "model_files"), ("meshes/arm.stl", 1001, "model_file_bytes")]
    {
        let error = put("shown", file, vec![0; bytes]).await.unwrap_err();
        assert_eq!(error.code(), Some(Code::ResourceExhausted), "{error}");
        assert!(error.to_string().contains(limit), "{error}");
    }
    // A refused file leaves the one that is there.
    assert_eq!(http(&server, &format!("GET {other}"), "").1, [8; 10]);

    client.delete_model("shown").await.unwrap();
    assert_status(&http(&server, &format!("GET {other}"), ""), 404);
    assert!(meshes(drawing_of_plant(&client, &id).await).iter().all(|(_, url)| url.is_empty()));
    client.create_model(SHOWN).await.unwrap();
    assert_status(&http(&server, &format!("GET {other}"), ""), 404);
}

#[tokio::test(flavor = "multi_thread")]
async fn scenes_of_a_folder_come_with_their_meshes() {
    let directory = tempfile::tempdir().unwrap();
    let scenes = directory.path().join("scenes");
    std::fs::create_dir_all(scenes.join("meshes")).unwrap();
    std::fs::write(scenes.join("shown.toml"), SHOWN).unwrap();
    std::fs::write(scenes.join("meshes/arm.stl"), b"arm").unwrap();
    std::fs::write(directory.path().join("outside.stl"), b"secret").unwrap();
    let (server, client) = server_with(&["--scenes", scenes.to_str().unwrap()]).await;
    let meshes = meshes(drawing_of(&client, Of::Model("shown".to_owned())).await);
    let url = &meshes.iter().find(|(file, _)| file == "meshes/arm.stl").unwrap().1;
    assert_eq!(http(&server, &format!("GET {url}"), "").1, b"arm");
    assert!(meshes.iter().all(|(file, url)| file == "meshes/arm.stl" || url.is_empty()));
    assert!(server.log().contains("outside.stl"), "{}", server.log());
}

/// A robot as robots are kept: in a package, with meshes of its own and of others.
#[tokio::test(flavor = "multi_thread")]
async fn plantctl_sends_the_meshes_that_it_finds_and_says_what_is_missing() {
    let (server, client) = server().await;
    let directory = tempfile::tempdir().unwrap();
    let package = directory.path().join("rod_description");
    for folder in ["robots", "meshes", "tex"] {
        std::fs::create_dir_all(package.join(folder)).unwrap();
    }
    let mesh =
        |file: &str| format!("<visual><geometry><mesh filename=\"{file}\"/></geometry></visual>");
    let files = ["package://rod_description/meshes/rod.obj", "package://hand/hand.stl"];
    let missing = ["package://none/none.stl", "../meshes/rod.obj"];
    let visuals: String = files.iter().chain(&missing).map(|file| mesh(file)).collect();
    let robot = format!(
        "<robot name=\"rod\"><link name=\"base\"/><joint name=\"hinge\" type=\"continuous\">\
         <parent link=\"base\"/><child link=\"rod\"/><axis xyz=\"0 1 0\"/></joint>\
         <link name=\"rod\"><inertial><origin xyz=\"0 0 -0.5\"/><mass value=\"2\"/>\
         <inertia ixx=\"0.1\" iyy=\"0.1\" izz=\"0.01\" ixy=\"0\" ixz=\"0\" iyz=\"0\"/></inertial>\
         {visuals}</link></robot>"
    );
    let path = package.join("robots/rod.urdf");
    std::fs::write(&path, robot).unwrap();
    std::fs::write(package.join("meshes/rod.obj"), "mtllib rod.mtl\nv 0 0 0\n").unwrap();
    std::fs::write(package.join("meshes/rod.mtl"), "newmtl m\nmap_Kd ../tex/rod.png\n").unwrap();
    std::fs::write(package.join("tex/rod.png"), "picture").unwrap();
    std::fs::write(directory.path().join("hand.stl"), "hand").unwrap();
    let hand = format!("hand={}", directory.path().display());
    let output = std::process::Command::new(binary("plantctl").unwrap())
        .env("PLANTD_ADDRESS", server.address())
        .args(["upload", path.to_str().unwrap(), "--package", &hand])
        .output()
        .unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{said}");
    assert!(said.contains("4 files of meshes sent"), "{said}");
    assert!(said.contains("mesh `package://none/none.stl` was not found"), "{said}");
    assert!(said.contains("mesh `../meshes/rod.obj` was not taken"), "{said}");
    let shown = meshes(drawing_of(&client, Of::Model("rod".to_owned())).await);
    let has = |file: &str| shown.iter().any(|(name, url)| name == file && !url.is_empty());
    assert!(
        files.iter().all(|file| has(file)) && !missing.iter().any(|file| has(file)),
        "{shown:?}"
    );
    // The browser finds the picture where the material says that it is.
    let picture = http(&server, "GET /models/rod/files/rod_description/tex/rod.png", "");
    assert_status(&picture, 200);
    assert_eq!(picture.1, b"picture");
}
