//! Ways in and out: Unix-domain socket, gRPC-Web, reflection, health, shutdown.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::process::{Command, Stdio};
use std::time::Duration;

use plantd_client::{Client, Code, Error, v1};
use plantd_tests::server::{ServerProcess, binary};
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};
use tonic_reflection::pb::v1::{
    ServerReflectionRequest, server_reflection_client::ServerReflectionClient,
    server_reflection_request::MessageRequest, server_reflection_response::MessageResponse,
};

use crate::support::*;

const SERVICES: [&str; 3] =
    ["plantd.v1.ModelService", "plantd.v1.PlantService", "plantd.v1.ControlService"];

#[tokio::test]
async fn the_unix_socket_leads_to_the_same_plants() {
    let (server, over_tcp) = server().await;
    let over_unix = Client::connect(server.unix_address()).await.unwrap();
    let id = plant(&over_unix, "pendulum").await.id;
    let mut driver = over_unix.drive(&id).await.unwrap();
    let state = driver.step(&[0.1]).await.unwrap().state.unwrap();
    let seen = over_tcp.get_plant(&id).await.unwrap().plant.unwrap().state.unwrap();
    assert_eq!(bits(&seen), bits(&state));
}

#[tokio::test]
async fn health_is_reported_for_each_service() {
    let (_server, client) = server().await;
    let mut health = HealthClient::new(client.channel());
    for service in SERVICES.into_iter().chain([""]) {
        let request = HealthCheckRequest { service: service.to_owned() };
        let answer = health.check(request).await.unwrap().into_inner();
        assert_eq!(answer.status(), ServingStatus::Serving, "{service}");
    }
    let request = HealthCheckRequest { service: "plantd.v1.Nothing".to_owned() };
    assert_eq!(health.check(request).await.unwrap_err().code(), Code::NotFound);
}

#[tokio::test]
async fn reflection_lists_and_describes_the_services() {
    let (_server, client) = server().await;
    let mut reflection = ServerReflectionClient::new(client.channel());
    let mut ask = async |message_request| {
        let request =
            ServerReflectionRequest { host: String::new(), message_request: Some(message_request) };
        let stream = reflection.server_reflection_info(tokio_stream::iter([request])).await;
        let answer = soon(stream.unwrap().into_inner().message()).await.unwrap().unwrap();
        answer.message_response.unwrap()
    };
    let MessageResponse::ListServicesResponse(list) =
        ask(MessageRequest::ListServices(String::new())).await
    else {
        panic!("not a list of services")
    };
    let names: Vec<_> = list.service.iter().map(|service| service.name.as_str()).collect();
    for service in SERVICES {
        assert!(names.contains(&service), "no {service} among {names:?}");
        let symbol = MessageRequest::FileContainingSymbol(service.to_owned());
        let MessageResponse::FileDescriptorResponse(files) = ask(symbol).await else {
            panic!("{service} is not described")
        };
        assert!(!files.file_descriptor_proto.is_empty());
    }
}

#[tokio::test]
async fn a_server_is_not_reached_by_other_machines_unless_it_is_told_so() {
    let warning = "`insecure` is set";
    let (inside, _client) = server().await;
    assert!(!inside.log().contains(warning), "{}", inside.log());

    let start = |addresses: [&str; 2], insecure: &[&str]| {
        let [grpc, metrics] = addresses;
        let open = Command::new(binary("plantd").unwrap())
            .args(["serve", "--grpc", grpc, "--metrics", metrics, "--link", "off"])
            .args(insecure)
            .arg("--until-stdin-ends")
            .stdin(Stdio::null())
            .stderr(Stdio::piped())
            .output()
            .unwrap();
        (open.status.success(), String::from_utf8(open.stderr).unwrap())
    };
    let (serves, log) = start(["0.0.0.0:0", "[::]:0"], &["--insecure"]);
    assert!(serves && log.matches(warning).count() == 1, "{log}");
    for (addresses, what) in [
        (["0.0.0.0:0", "off"], "gRPC at 0.0.0.0:0"),
        (["127.0.0.1:0", "[::]:0"], "metrics at [::]:0"),
    ] {
        let (serves, log) = start(addresses, &[]);
        assert!(!serves && log.contains(what) && log.contains("--insecure"), "{log}");
    }
}

/// A browser's request: HTTP/1.1, a frame of a length and a message, trailers in the body.
#[tokio::test(flavor = "multi_thread")]
async fn grpc_web_is_served_over_http_1() {
    let (server, _client) = server().await;
    // GetModelRequest { name: "pendulum" }: field 1, length 8.
    let message = [b"\x0a\x08".as_slice(), b"pendulum"].concat();
    let (head, body) = post_grpc_web(server.address(), "ModelService/GetModel", &message);
    assert!(head.starts_with("HTTP/1.1 200"), "{head}");
    assert!(head.to_lowercase().contains("application/grpc-web+proto"), "{head}");
    let text = String::from_utf8_lossy(&body);
    assert!(text.contains("pendulum") && text.contains("theta") && text.contains("grpc-status:0"));

    let message = [b"\x0a\x04".as_slice(), b"none"].concat();
    let (head, body) = post_grpc_web(server.address(), "ModelService/GetModel", &message);
    let answer = format!("{head}{}", String::from_utf8_lossy(&body)).replace(": ", ":");
    assert!(answer.contains("grpc-status:5"), "{answer}");
}

fn post_grpc_web(address: &str, method: &str, message: &[u8]) -> (String, Vec<u8>) {
    let host = address.strip_prefix("http://").unwrap();
    let mut stream = TcpStream::connect(host).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    let length = message.len() as u32;
    let request = format!(
        "POST /plantd.v1.{method} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\
         Content-Type: application/grpc-web+proto\r\nX-Grpc-Web: 1\r\n\
         Content-Length: {}\r\n\r\n",
        5 + length
    );
    stream.write_all(request.as_bytes()).unwrap();
    stream.write_all(&[&[0], length.to_be_bytes().as_slice(), message].concat()).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let end = answer.windows(4).position(|w| w == b"\r\n\r\n").expect("a head");
    let body = answer.split_off(end + 4);
    (String::from_utf8(answer).unwrap(), body)
}

/// Older tools, and Python's own reflection client, ask for v1alpha.
#[tokio::test]
async fn reflection_is_there_in_its_older_version() {
    use tonic_reflection::pb::v1alpha;
    use v1alpha::server_reflection_client::ServerReflectionClient as Reflection;
    use v1alpha::server_reflection_request::MessageRequest;
    use v1alpha::server_reflection_response::MessageResponse;

    let (_server, client) = server().await;
    let request = v1alpha::ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    };
    let mut reflection = Reflection::new(client.channel());
    let answers = reflection.server_reflection_info(tokio_stream::iter([request])).await;
    let answer = soon(answers.unwrap().into_inner().message()).await.unwrap().unwrap();
    let Some(MessageResponse::ListServicesResponse(list)) = answer.message_response else {
        panic!("not a list of services")
    };
    for service in SERVICES {
        assert!(list.service.iter().any(|listed| listed.name == service), "{service}");
    }
}

/// A server whose drain and grace outlast the test, and a watcher of its health that has heard that it
/// serves.
async fn watched_for_health(flags: &[&str]) -> (ServerProcess, Client, HealthWatch) {
    let flags = [&["--shutdown-grace-s", "100"], flags].concat();
    let (server, client) = server_with(&flags).await;
    let mut health = HealthClient::new(client.channel());
    let request = HealthCheckRequest { service: "plantd.v1.PlantService".to_owned() };
    let mut watch = health.watch(request).await.unwrap().into_inner();
    let first = soon(watch.message()).await.unwrap().unwrap();
    assert_eq!(first.status(), ServingStatus::Serving);
    (server, client, watch)
}

type HealthWatch = tonic::Streaming<tonic_health::pb::HealthCheckResponse>;

#[tokio::test]
async fn a_watch_of_health_hears_of_the_end_and_does_not_delay_it() {
    let (mut server, client, mut watch) = watched_for_health(&["--drain-s", "0"]).await;
    let mut reflection = ServerReflectionClient::new(client.channel());
    // A stream of reflection that asks nothing.
    let asking = reflection.server_reflection_info(tokio_stream::pending()).await.unwrap();
    let stopped = tokio::task::spawn_blocking(move || server.stop());
    let last = soon(watch.message()).await.unwrap().unwrap();
    assert_eq!(last.status(), ServingStatus::NotServing);
    let end = soon(watch.message()).await.unwrap_err();
    assert_eq!(end.code(), Code::Unavailable);
    // Its question ends as well: it may be answered to the end.
    let end = soon(asking.into_inner().message()).await;
    assert!(!matches!(end, Ok(Some(_))), "{end:?}");
    assert!(soon(stopped).await.unwrap().unwrap().success());
}

#[tokio::test]
async fn a_draining_server_serves_on_until_a_second_signal() {
    let (mut server, client, mut watch) = watched_for_health(&["--drain-s", "100"]).await;
    let id = plant(&client, "pendulum").await.id;
    // A balancer, which asks now and then: it has to have time to ask again.
    let balancer = || HealthCheckRequest { service: "plantd.v1.PlantService".to_owned() };
    HealthClient::new(client.channel()).check(balancer()).await.unwrap();
    server.terminate().unwrap();
    let last = soon(watch.message()).await.unwrap().unwrap();
    assert_eq!(last.status(), ServingStatus::NotServing);
    // New connections too, and a health check by itself: what balancers do.
    let newcomer = server.client().await;
    newcomer.get_plant(&id).await.unwrap();
    let mut health = HealthClient::new(newcomer.channel());
    let answer = health.check(balancer()).await.unwrap().into_inner();
    assert_eq!(answer.status(), ServingStatus::NotServing);
    // An open stream would hold the end up for the grace as well, but for the second signal.
    let mut driver = newcomer.drive(&id).await.unwrap();
    driver.step(&[0.0]).await.unwrap();
    let stopped = tokio::task::spawn_blocking(move || server.stop());
    assert!(soon(stopped).await.unwrap().unwrap().success());
}

#[tokio::test]
async fn a_shutdown_ends_open_streams_and_the_process() {
    let (mut server, client) = server().await;
    let id = plant(&client, "pendulum").await.id;
    let request = v1::WatchRequest {
        id: id.clone(),
        fields: vec![v1::WatchField::State.into()],
        ..Default::default()
    };
    let mut watch = client.watch(request).await.unwrap();
    let mut driver = client.drive(&id).await.unwrap();
    driver.step(&[0.0]).await.unwrap();

    let stopped = tokio::task::spawn_blocking(move || server.stop());
    let end: Error = loop {
        match soon(watch.next()).await {
            Ok(Some(_)) => {}
            Ok(None) => panic!("a watch that ends as if the plant were done"),
            Err(error) => break error,
        }
    };
    assert_eq!((end.code(), end.reason()), (Some(Code::Unavailable), "SHUTTING_DOWN"));
    // Each stream ends by itself: this one may still be on its last steps.
    let steps = async {
        loop {
            if let Err(error) = driver.step(&[0.0]).await {
                break error;
            }
        }
    };
    let end = soon(steps).await;
    assert_eq!((end.code(), end.reason()), (Some(Code::Unavailable), "SHUTTING_DOWN"));
    assert!(soon(stopped).await.unwrap().unwrap().success());
}
