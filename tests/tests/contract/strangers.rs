//! Strangers keep nobody out, take no memory, and pages of theirs are not served.

use std::convert::Infallible;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use http_body::Frame;
use plantd_client::{Client, Code, v1};
use plantd_tests::server::ServerProcess;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tonic::body::Body;
use tonic::codegen::http::{Request, StatusCode};
use tonic::codegen::{Bytes, Service as _};
use tonic::transport::{Channel, Endpoint};
use v1::model_service_client::ModelServiceClient;

use crate::support::*;

/// What a connection says that never makes a request.
const SILENCE: [(&str, &[u8]); 3] = [
    ("nothing", b""),
    ("slow headers", b"POST /plantd.v1.ModelService/GetModel HTTP/1.1\r\nHost: localhost\r\nX: "),
    ("half a preface", b"PRI * HTTP/2.0\r\n"),
];

fn host(server: &ServerProcess) -> &str {
    server.address().strip_prefix("http://").unwrap()
}

fn silent(server: &ServerProcess, words: &[u8]) -> TcpStream {
    let mut stream = TcpStream::connect(host(server)).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    stream.write_all(words).unwrap();
    stream
}

#[tokio::test(flavor = "multi_thread")]
async fn silent_connections_keep_nobody_out() {
    let mut files = getrlimit(Resource::Nofile);
    files.current = files.maximum;
    setrlimit(Resource::Nofile, Rlimit { ..files }).unwrap();
    let count = files.maximum.map_or(1100, |maximum| maximum.saturating_sub(100).min(1100));

    let (server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let mut driver = client.drive(&id).await.unwrap();
    for (kind, words) in SILENCE {
        let connections: Vec<_> = (0..count).map(|_| silent(&server, words)).collect();
        soon(driver.step(&[0.1])).await.expect(kind);
        let newcomer = soon(Client::connect(server.address())).await.expect(kind);
        let over_unix = soon(Client::connect(server.unix_address())).await.expect(kind);
        let other = soon(plant(&newcomer, "pendulum")).await.id;
        let mut other = soon(over_unix.drive(&other)).await.unwrap();
        soon(other.step(&[0.1])).await.expect(kind);
        soon(driver.step(&[0.1])).await.expect(kind);
        drop(connections);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_connection_that_asks_for_nothing_is_ended() {
    let (server, client) = server_with(&["--limit", "first_request_s=1"]).await;
    let id = plant(&client, "pendulum").await.id;
    let mut driver = client.drive(&id).await.unwrap();
    let idle = server.client().await;
    plant(&idle, "pendulum").await;
    for (kind, mut stream) in SILENCE.map(|(kind, words)| (kind, silent(&server, words))) {
        let mut rest = Vec::new();
        // Ended in good order or not, but ended.
        if let Err(error) = stream.read_to_end(&mut rest) {
            assert_eq!(error.kind(), std::io::ErrorKind::ConnectionReset, "{kind}");
        }
    }
    driver.step(&[0.1]).await.unwrap();
    plant(&idle, "pendulum").await;
}

/// A message of 16 MiB of which the last byte never comes.
struct HeldBack {
    left: usize,
}

const MESSAGE_BYTES: usize = 16 << 20;

impl http_body::Body for HeldBack {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        _: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        const PIECE: &[u8] = &[b' '; 64 << 10];
        let piece = match self.left {
            1 => return Poll::Pending,
            // CreateModelRequest: its field 1, a text, takes all of it.
            MESSAGE_BYTES => {
                let length = MESSAGE_BYTES as u32;
                self.left -= 5;
                let text = [0x0a, 0xfb, 0xff, 0xff, 0x07];
                Bytes::from([&[0], &length.to_be_bytes()[..], &text].concat())
            }
            left => {
                let count = PIECE.len().min(left - 1);
                self.left -= count;
                Bytes::from_static(&PIECE[..count])
            }
        };
        Poll::Ready(Some(Ok(Frame::data(piece))))
    }
}

fn grpc(path: &str, body: Body) -> Request<Body> {
    Request::post(path)
        .header("content-type", "application/grpc")
        .header("te", "trailers")
        .body(body)
        .unwrap()
}

fn kilobytes(server: &ServerProcess, key: &str) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{}/status", server.pid())).unwrap();
    let line = status.lines().find(|line| line.starts_with(key)).unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn messages_whose_last_byte_is_held_back_share_a_budget() {
    const STREAMS: usize = 32;
    const BUDGET: u64 = 64 << 20;
    let limits = format!("unfinished_message_bytes={BUDGET},message_s=3");
    let (server, client) = server_with(&["--limit", &limits]).await;
    let id = plant(&client, "pendulum").await.id;
    let mut driver = client.drive(&id).await.unwrap();
    driver.step(&[0.1]).await.unwrap();
    let before = kilobytes(&server, "VmRSS");

    let address = server.address().to_owned();
    let channel = Endpoint::from_shared(address.clone()).unwrap().connect().await.unwrap();
    let path = format!("{address}/plantd.v1.ModelService/CreateModel");
    let refusals = (0..STREAMS).map(|_| {
        let (mut channel, path) = (channel.clone(), path.clone());
        tokio::spawn(async move {
            let body = Body::new(HeldBack { left: MESSAGE_BYTES });
            std::future::poll_fn(|context| channel.poll_ready(context)).await.unwrap();
            let response = channel.call(grpc(&path, body)).await.unwrap();
            tonic::Status::from_header_map(response.headers()).unwrap()
        })
    });
    let refusals: Vec<_> = refusals.collect();
    let mut reasons = [0, 0];
    for refusal in refusals {
        soon(driver.step(&[0.1])).await.unwrap();
        let status = soon(refusal).await.unwrap();
        assert_eq!(status.code(), Code::ResourceExhausted, "{status}");
        let names = ["`unfinished_message_bytes`", "`message_s`"];
        let name = names.iter().position(|name| status.message().contains(name));
        reasons[name.unwrap_or_else(|| panic!("{status}"))] += 1;
    }
    assert!(reasons[0] > 0 && reasons[1] > 0, "{reasons:?}");
    let grown = (kilobytes(&server, "VmHWM") - before) << 10;
    assert!(grown < BUDGET + (64 << 20), "{} MiB more for {BUDGET} bytes", grown >> 20);

    // What they took has come back.
    let large = format!("{TWO_PENDULUMS}\n{}", "#".repeat(3 << 20));
    soon(client.create_model(large)).await.unwrap();
}

/// A body in one piece.
struct Whole(Option<Bytes>);

impl http_body::Body for Whole {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        _: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        Poll::Ready(self.0.take().map(|bytes| Ok(Frame::data(bytes))))
    }
}

/// A field of nested messages around these bytes.
fn within(tag: u8, bytes: &[u8]) -> Vec<u8> {
    let mut field = vec![tag];
    let mut length = bytes.len();
    while length > 0x7f {
        field.push((length & 0x7f) as u8 | 0x80);
        length >>= 7;
    }
    field.push(length as u8);
    field.extend_from_slice(bytes);
    field
}

/// Calls a method with one message; its status.
async fn call_with(server: &ServerProcess, method: &str, message: &[u8]) -> tonic::Status {
    let address = server.address().to_owned();
    let path = format!("{address}/plantd.v1.{method}");
    let mut channel = Endpoint::from_shared(address).unwrap().connect().await.unwrap();
    std::future::poll_fn(|context| channel.poll_ready(context)).await.unwrap();
    let length = u32::try_from(message.len()).unwrap().to_be_bytes();
    let body = Bytes::from([&[0], &length[..], message].concat());
    let request = grpc(&path, Body::new(Whole(Some(body))));
    let response = soon(channel.call(request)).await.unwrap();
    tonic::Status::from_header_map(response.headers()).expect("refused before the first answer")
}

/// Two bytes of an empty part become hundreds in memory.
#[tokio::test(flavor = "multi_thread")]
async fn messages_of_many_empty_parts_take_no_memory() {
    let (server, client) = server().await;
    let bytes = (MESSAGE_BYTES - 64) / 2;
    let parts = |tag: u8, count: usize| [tag, 0].repeat(count);
    let floods = [
        ("ControlService/Rollout", parts(0x1a, bytes)),
        ("ControlService/Analyze", parts(0x2a, bytes)),
        ("ControlService/SolveTrajectoryLqr", parts(0x32, bytes)),
        // TrajectoryCost.stages and TrajectoryBounds.state, inside of the request.
        ("ControlService/OptimizeTrajectory", within(0x1a, &parts(0x22, bytes))),
        ("ControlService/OptimizeTrajectory", within(0x32, &parts(0x0a, bytes))),
        ("PlantService/SetParameters", parts(0x12, bytes)),
        ("PlantService/SetSafety", parts(0x12, bytes)),
        ("PlantService/SetFeedback", parts(0x32, bytes)),
        ("PlantService/Watch", parts(0x22, bytes)),
        ("ModelService/Settle", parts(0x22, bytes)),
    ];
    client.get_model("pendulum").await.unwrap();
    let before = kilobytes(&server, "VmRSS");
    for (method, message) in floods {
        let status = call_with(&server, method, &message).await;
        assert_eq!(status.code(), Code::ResourceExhausted, "{method}: {status}");
        assert!(status.message().contains("`message_parts` is 131072"), "{method}: {status}");
    }
    // As many as are allowed, of the largest.
    for (method, tag) in [("ControlService/Rollout", 0x1a), ("PlantService/SetFeedback", 0x32)] {
        let status = call_with(&server, method, &parts(tag, 131_072)).await;
        assert_ne!(status.code(), Code::Ok, "{method}");
        assert!(!status.message().contains("`message_parts`"), "{method}: {status}");
    }
    let grown = (kilobytes(&server, "VmHWM") - before) >> 10;
    assert!(grown < 128, "{grown} MiB more");
}

/// A message may be long, and have many parts, as far as somebody needs it.
#[tokio::test(flavor = "multi_thread")]
async fn long_trajectories_and_many_cases_are_served() {
    let (_server, client) = server().await;
    let case = v1::RolloutCase { hold: 1, ..Default::default() };
    let request = v1::RolloutRequest {
        model: "pendulum".to_owned(),
        cases: vec![case; 10_000],
        ..Default::default()
    };
    let mut cases = client.rollout(request).await.unwrap();
    let mut count = 0;
    while cases.next().await.unwrap().is_some() {
        count += 1;
    }
    assert_eq!(count, 10_000);
}

/// GetModelRequest { name: "pendulum" } with its head.
const GET_MODEL: &[u8] = b"\0\0\0\0\x0a\x0a\x08pendulum";

/// The answer to a request over HTTP/1.1 with these further header lines.
fn http_1(address: &str, line: &str, fields: &str, body: &[u8]) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    let length = body.len();
    let head = format!(
        "{line} HTTP/1.1\r\nConnection: close\r\nContent-Length: {length}\r\n{fields}\r\n\r\n"
    );
    stream.write_all(&[head.as_bytes(), body].concat()).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    String::from_utf8_lossy(&answer).to_lowercase()
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_of_strangers_are_refused_over_http_1() {
    let flags = ["--allow-origin", "https://panel.example", "--allow-host", "plants.lab"];
    let (server, _client) = server_with(&flags).await;
    let line = "POST /plantd.v1.ModelService/GetModel";
    let own = host(&server);
    let port = own.rsplit(':').next().unwrap();
    let call = |fields: &str| {
        let fields = format!("Content-Type: application/grpc-web+proto\r\n{fields}");
        http_1(own, line, &fields, GET_MODEL)
    };
    for fields in [
        format!("Host: {own}"),
        format!("Host: localhost:{port}\r\nOrigin: http://localhost:{port}"),
        format!("Host: {own}\r\nOrigin: https://panel.example"),
        format!("Host: plants.lab:{port}\r\nOrigin: http://plants.lab:{port}"),
    ] {
        let answer = call(&fields);
        assert!(answer.starts_with("http/1.1 200") && answer.contains("theta"), "{answer}");
    }
    for fields in [
        format!("Host: {own}\r\nOrigin: https://evil.example"),
        format!("Host: {own}\r\nOrigin: http://localhost:3000"),
        format!("Host: {own}\r\nOrigin: null"),
        format!("Host: evil.example:{port}\r\nOrigin: http://evil.example:{port}"),
        format!("Host: evil.example:{port}"),
    ] {
        let answer = call(&fields);
        assert!(answer.starts_with("http/1.1 403"), "{fields}\n{answer}");
        assert!(answer.contains("grpc-status: 7") && !answer.contains("theta"), "{answer}");
        assert!(!answer.contains("access-control"), "{answer}");
    }
    let preflight = format!("Host: {own}\r\nOrigin: https://evil.example");
    let answer = http_1(own, "OPTIONS /plantd.v1.ModelService/GetModel", &preflight, b"");
    assert!(answer.starts_with("http/1.1 403"), "{answer}");
    assert!(answer.contains("pages of `https://evil.example` may not"), "{answer}");
}

#[tokio::test(flavor = "multi_thread")]
async fn metrics_are_not_for_pages_of_strangers() {
    let server = ServerProcess::start().unwrap();
    let metrics = server.addresses().metrics.as_ref().unwrap();
    let address = metrics.strip_prefix("http://").unwrap().strip_suffix("/metrics").unwrap();
    let answer = http_1(address, "GET /metrics", &format!("Host: {address}"), b"");
    assert!(answer.starts_with("http/1.1 200") && answer.contains("plantd_plants"), "{answer}");
    for fields in ["Host: evil.example", "Host: localhost\r\nOrigin: http://evil.example"] {
        let answer = http_1(address, "GET /metrics", fields, b"");
        assert!(answer.starts_with("http/1.1 403") && !answer.contains("plantd_"), "{answer}");
        assert!(!answer.contains("access-control"), "{answer}");
    }
}

/// A channel to an address that calls itself otherwise in `:authority`.
async fn channel(address: &str, authority: &str) -> Channel {
    let endpoint = Endpoint::from_shared(address.to_owned()).unwrap();
    endpoint.origin(format!("http://{authority}").parse().unwrap()).connect().await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_of_strangers_are_refused_over_http_2() {
    let (server, _client) = server().await;
    let get = async |authority: &str, origin: Option<&str>| {
        let mut models = ModelServiceClient::new(channel(server.address(), authority).await);
        let name = "pendulum".to_owned();
        let mut request = tonic::Request::new(v1::GetModelRequest { name });
        if let Some(origin) = origin {
            request.metadata_mut().insert("origin", origin.parse().unwrap());
        }
        soon(models.get_model(request)).await
    };
    get("localhost:1", None).await.unwrap();
    get("[::1]", Some("http://[::1]")).await.unwrap();
    for (authority, origin) in [
        ("evil.example", None),
        ("evil.example:1", Some("http://evil.example:1")),
        ("localhost:1", Some("http://evil.example")),
    ] {
        let status = get(authority, origin).await.unwrap_err();
        assert_eq!(status.code(), Code::PermissionDenied, "{status}");
        assert!(status.message().contains("`allowed_"), "{status}");
    }

    let mut channel = channel(server.address(), "evil.example").await;
    let path = "http://evil.example/plantd.v1.ModelService/GetModel";
    std::future::poll_fn(|context| channel.poll_ready(context)).await.unwrap();
    let response = soon(channel.call(grpc(path, Body::empty()))).await.unwrap();
    assert_eq!(response.status(), StatusCode::FORBIDDEN);
    assert_eq!(response.headers()["grpc-status"], "7");
}

/// Programs send all sorts of names over a unix-domain socket; pages send nothing.
#[tokio::test(flavor = "multi_thread")]
async fn any_name_leads_through_the_unix_socket() {
    let (server, _client) = server().await;
    let path = server.unix_address().strip_prefix("unix:").unwrap();
    for host in ["localhost", path, "plants.lab", "%2Frun%2Fplantd.sock"] {
        let mut stream = std::os::unix::net::UnixStream::connect(path).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        let head = format!(
            "POST /plantd.v1.ModelService/GetModel HTTP/1.1\r\nHost: {host}\r\n\
             Connection: close\r\nContent-Type: application/grpc-web+proto\r\n\
             Content-Length: {}\r\n\r\n",
            GET_MODEL.len()
        );
        stream.write_all(&[head.as_bytes(), GET_MODEL].concat()).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        assert!(answer.starts_with(b"HTTP/1.1 200"), "{}", String::from_utf8_lossy(&answer));
    }
}
