//! Tokens, certificates and users: who is let in, what they may do, and for how long.

use plantd_client::{Code, Credentials, v1};
use prost::Message as _;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::transport::Endpoint;

use crate::support::*;

/// Paths of all methods of the contract.
fn methods() -> Vec<String> {
    let set = prost_types::FileDescriptorSet::decode(plantd_proto::FILE_DESCRIPTOR_SET).unwrap();
    let mut methods = Vec::new();
    for file in set.file.iter().filter(|file| file.package() == "plantd.v1") {
        for service in &file.service {
            let path = |method: &str| format!("/plantd.v1.{}/{method}", service.name());
            methods.extend(service.method.iter().map(|method| path(method.name())));
        }
    }
    methods
}

#[tokio::test(flavor = "multi_thread")]
async fn strangers_get_nothing_of_any_method() {
    let lab = Lab::new();
    let known = lab.token("anna", "viewer", "lab");
    let server = lab.start(&lab.auth());
    let endpoint = Endpoint::from_shared(server.address().to_owned()).unwrap();
    let channel = endpoint.connect().await.unwrap();
    let paths = methods();
    assert!(paths.len() > 50);
    let others = ["/grpc.reflection.v1.ServerReflection/ServerReflectionInfo", "/a.B/C", "/"];
    for path in paths.iter().map(String::as_str).chain(others) {
        for (header, reason) in [
            (None, "NO_CREDENTIALS"),
            (Some("Basic abc".to_owned()), "NO_CREDENTIALS"),
            (Some("Bearer nobody".to_owned()), "TOKEN_UNKNOWN"),
            (Some(format!("Bearer {known}x")), "TOKEN_UNKNOWN"),
        ] {
            let mut stub = tonic::client::Grpc::new(channel.clone());
            stub.ready().await.unwrap();
            let mut request = tonic::Request::new(());
            if let Some(header) = &header {
                request.metadata_mut().insert("authorization", header.parse().unwrap());
            }
            let codec = tonic_prost::ProstCodec::<(), ()>::default();
            let path = PathAndQuery::try_from(path).unwrap();
            let status = stub.unary(request, path.clone(), codec).await.unwrap_err();
            let error = plantd_client::Error::from(status);
            assert_eq!(error.code(), Some(Code::Unauthenticated), "{path}: {error}");
            assert_eq!(error.reason(), reason, "{path}: {error}");
        }
    }
    // Balancers have no name.
    let mut health = tonic_health::pb::health_client::HealthClient::new(channel);
    health.check(tonic_health::pb::HealthCheckRequest::default()).await.unwrap();

    // The page is everybody's; what it shows is not.
    assert!(get(&server, "/", "").starts_with("HTTP/1.1 200"));
    let token = format!("Authorization: Bearer {known}\r\n");
    for path in ["/metrics", "/models/a/files/b.stl", "/nothing"] {
        let answer = get(&server, path, "");
        assert!(
            answer.starts_with("HTTP/1.1 401") && answer.contains("Bearer"),
            "{path}: {answer}"
        );
        let answer = get(&server, path, "Authorization: Bearer nobody\r\n");
        assert!(answer.starts_with("HTTP/1.1 401"), "{path}: {answer}");
    }
    assert!(get(&server, "/metrics", &token).starts_with("HTTP/1.1 200"));
    assert!(get(&server, "/models/a/files/b.stl", &token).starts_with("HTTP/1.1 404"));
    // Whoever is refused learns it at once.
    let stranger = connect(server.address(), Credentials::default()).await;
    assert_refused(stranger.map(drop), Code::Unauthenticated, "NO_CREDENTIALS");
    assert!(!server.log().contains(&known));
}

#[tokio::test(flavor = "multi_thread")]
async fn roles_bound_what_somebody_may_do() {
    let lab = Lab::new();
    let (viewer, driver) = (lab.token("vera", "viewer", "lab"), lab.token("dora", "driver", "lab"));
    let server = lab.start(&lab.auth());
    let viewer = somebody(&lab, &server, &viewer).await;
    let client = somebody(&lab, &server, &driver).await;
    plant(&client, "p1").await;

    let seen = viewer.list_plants().await.unwrap();
    assert_eq!(seen.len(), 1);
    let mut states = viewer.watch(watch_request("p1")).await.unwrap();
    soon(states.next()).await.unwrap().unwrap();
    let step = v1::StepRequest { id: "p1".to_owned(), hold: 1, ..Default::default() };
    assert_refused(viewer.step(step.clone()).await, Code::PermissionDenied, "ROLE");
    assert_refused(viewer.delete_plant("p1").await, Code::PermissionDenied, "ROLE");
    assert_refused(viewer.drive("p1").await.map(drop), Code::PermissionDenied, "ROLE");
    viewer.timing("p1", false).await.unwrap();
    assert_refused(viewer.timing("p1", true).await, Code::PermissionDenied, "ROLE");
    client.timing("p1", true).await.unwrap();
    client.step(step).await.unwrap();
    client.delete_plant("p1").await.unwrap();

    // What changes something is written down, with who did it; so is who was not let.
    until_log_says(&server, "audit", 4).await;
    let log = server.log();
    let line = |words: &[&str]| {
        log.lines()
            .any(|line| line.contains("audit") && words.iter().all(|word| line.contains(word)))
    };
    assert!(line(&["dora", "lab", "CreatePlant", "p1", "OK"]), "{log}");
    assert!(line(&["dora", "DeletePlant", "p1", "OK"]), "{log}");
    assert!(line(&["vera", "DeletePlant", "ROLE"]), "{log}");
    assert!(!log.contains(&driver));
}

#[tokio::test(flavor = "multi_thread")]
async fn streams_end_when_their_token_is_revoked() {
    let lab = Lab::new();
    let (first, other) = (lab.token("anna", "driver", "lab"), lab.token("bert", "driver", "lab"));
    let server = lab.start(&lab.auth());
    let client = somebody(&lab, &server, &first).await;
    let others = somebody(&lab, &server, &other).await;
    plant(&client, "p1").await;
    plant(&client, "p2").await;
    let mut states = client.watch(watch_request("p1")).await.unwrap();
    soon(states.next()).await.unwrap().unwrap();
    let mut driver = client.drive("p1").await.unwrap();
    driver.step(&[0.1]).await.unwrap();
    let mut others_driver = others.drive("p2").await.unwrap();
    // A call that waits without end.
    let waiting = {
        let client = client.clone();
        let request = v1::RunRequest { id: "p1".to_owned(), wait: true, ..Default::default() };
        tokio::spawn(async move { client.run(request).await })
    };
    assert_eq!(lab.tokens(&["revoke", "anna", "--json"]), r#"{"revoked":1}"#);
    let ended = end_of(&mut states).await;
    assert_refused(ended, Code::Unauthenticated, "CREDENTIALS_REVOKED");
    let ended = soon(async {
        loop {
            if let Err(error) = driver.step(&[0.1]).await {
                break Err::<(), _>(error);
            }
        }
    })
    .await;
    assert_refused(ended, Code::Unauthenticated, "CREDENTIALS_REVOKED");
    let ended = soon(waiting).await.unwrap();
    assert_refused(ended, Code::Unauthenticated, "CREDENTIALS_REVOKED");
    assert_refused(client.list_plants().await, Code::Unauthenticated, "TOKEN_UNKNOWN");
    // The lease has gone with the stream; who has another token goes on as before.
    others_driver.step(&[0.1]).await.unwrap();
    soon(others.drive("p1")).await.unwrap().step(&[0.1]).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn streams_end_when_their_token_expires() {
    let lab = Lab::new();
    // Four seconds; files have whole ones.
    let token = lab.tokens(&["new", "anna", "--days", "0.00005", "--tenant", "lab"]);
    let server = lab.start(&lab.auth());
    let client = somebody(&lab, &server, &token).await;
    plant(&client, "p1").await;
    let mut states = client.watch(watch_request("p1")).await.unwrap();
    let ended = end_of(&mut states).await;
    assert_refused(ended, Code::Unauthenticated, "CREDENTIALS_EXPIRED");
    assert_refused(client.list_plants().await, Code::Unauthenticated, "CREDENTIALS_EXPIRED");
    let again = connect(server.address(), lab.with_token(&token)).await;
    assert_refused(again.map(drop), Code::Unauthenticated, "CREDENTIALS_EXPIRED");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_file_of_tokens_that_cannot_be_read_ends_nobody() {
    let lab = Lab::new();
    let token = lab.token("anna", "driver", "lab");
    let server = lab.start(&lab.auth());
    let client = somebody(&lab, &server, &token).await;
    lab.write("tokens.toml", "[[tokens]]\nname = 3\n");
    until_log_says(&server, "the tokens that were known before stay in force", 1).await;
    plant(&client, "p1").await;
    lab.write("tokens.toml", "");
    until_log_says(&server, "tokens read", 2).await;
    assert_refused(client.list_plants().await, Code::Unauthenticated, "TOKEN_UNKNOWN");
}

#[tokio::test(flavor = "multi_thread")]
async fn users_of_this_machine_are_known_on_its_socket() {
    let lab = Lab::new();
    let uid = rustix::process::getuid().as_raw();
    let rule = format!("[[auth.peers]]\nuid = {uid}\nname = \"me\"\nrole = \"driver\"\n");
    let server = lab.start(&rule);
    let client = connect(server.unix_address(), Credentials::default()).await.unwrap();
    plant(&client, "p1").await;
    let over_tcp = connect(server.address(), Credentials::default()).await;
    assert_refused(over_tcp.map(drop), Code::Unauthenticated, "NO_CREDENTIALS");

    let stranger = format!("[[auth.peers]]\nuid = {}\nrole = \"admin\"\n", uid + 1);
    let server = lab.start(&stranger);
    let unknown = connect(server.unix_address(), Credentials::default()).await;
    assert_refused(unknown.map(drop), Code::Unauthenticated, "USER_UNKNOWN");
}

#[tokio::test(flavor = "multi_thread")]
async fn rules_are_read_again_when_they_change() {
    let lab = Lab::new();
    let uid = rustix::process::getuid().as_raw();
    let rule = |role: &str| format!("[[peers]]\nuid = {uid}\nname = \"me\"\nrole = \"{role}\"\n");
    let path = lab.write("rules.toml", &rule("driver"));
    let server = lab.start(&format!("[auth]\nrules = \"{}\"\n", path.display()));
    let client = connect(server.unix_address(), Credentials::default()).await.unwrap();
    plant(&client, "p1").await;
    let mut states = client.watch(watch_request("p1")).await.unwrap();
    soon(states.next()).await.unwrap().unwrap();

    // What cannot be read changes nothing.
    lab.write("rules.toml", "[[peers]]\nuid = \"me\"\n");
    until_log_says(&server, "the rules that were known before stay in force", 1).await;
    plant(&client, "p2").await;

    lab.write("rules.toml", &rule("viewer"));
    assert_refused(end_of(&mut states).await, Code::Unauthenticated, "CREDENTIALS_REVOKED");
    let step = || v1::StepRequest { id: "p1".to_owned(), hold: 1, ..Default::default() };
    assert_refused(client.step(step()).await, Code::PermissionDenied, "ROLE");
    client.get_plant("p1").await.unwrap();

    lab.write("rules.toml", "");
    until_log_says(&server, "rules of identities read", 2).await;
    assert_refused(client.get_plant("p1").await, Code::Unauthenticated, "USER_UNKNOWN");
    lab.write("rules.toml", &rule("driver"));
    until_log_says(&server, "rules of identities read", 3).await;
    client.step(step()).await.unwrap();
}
