//! TLS: which side refuses whom, and certificates that change while streams are open.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use plantd_client::{Client, Code, ConnectProblem, Credentials, Error};
use plantd_tests::server::ServerProcess;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, ServerName};
use tokio_rustls::rustls::{ClientConfig, RootCertStore};
use tonic::transport::{Certificate, ClientTlsConfig, Endpoint};

use crate::support::*;

#[track_caller]
fn problem(result: Result<Client, Error>) -> ConnectProblem {
    match result.map(drop).expect_err("no connection") {
        Error::Connect { problem, .. } => problem,
        other => panic!("{other}"),
    }
}

/// A connection by hand.
async fn secured(lab: &Lab, server: &ServerProcess) -> TlsStream<TcpStream> {
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_file(lab.path("ca.pem")).unwrap()).unwrap();
    let provider = Arc::new(tokio_rustls::rustls::crypto::ring::default_provider());
    let mut config = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    config.alpn_protocols = vec![b"http/1.1".to_vec()];
    let host = server.address().strip_prefix("https://").unwrap();
    let stream = TcpStream::connect(host).await.unwrap();
    let name = ServerName::try_from("127.0.0.1").unwrap();
    TlsConnector::from(Arc::new(config)).connect(name, stream).await.unwrap()
}

async fn get(lab: &Lab, server: &ServerProcess, path: &str, fields: &str) -> String {
    let mut stream = secured(lab, server).await;
    let head = format!("GET {path} HTTP/1.1\r\nConnection: close\r\n{fields}\r\n");
    stream.write_all(head.as_bytes()).await.unwrap();
    let mut answer = Vec::new();
    // Some end without TLS's farewell.
    let _ = stream.read_to_end(&mut answer).await;
    String::from_utf8_lossy(&answer).into_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn each_side_says_what_it_refuses() {
    let lab = Lab::new();
    let foreign = Authority::new("foreign");
    lab.write("foreign-ca.pem", &foreign.pem);
    lab.write_pair("anna", &lab.authority.issue("anna", &[]));
    lab.write_pair("carl", &lab.authority.issue("carl", &[]));
    lab.write_pair("mallory", &foreign.issue("anna", &[]));
    let ca = lab.path("ca.pem");
    let mutual = lab.tls(&format!("client_ca = \"{}\"\nclient = \"required\"", ca.display()));
    let rule = "[[auth.certificates]]\nsubject = \"anna\"\ntenant = \"lab\"\nrole = \"driver\"\n";
    let server = lab.start(&format!("{mutual}{rule}"));
    let address = server.address();
    assert!(address.starts_with("https://"));

    let client = connect(address, lab.with_certificate("anna")).await.unwrap();
    plant(&client, "p1").await;
    let stranger = connect(address, lab.with_certificate("carl")).await;
    assert_refused(stranger.map(drop), Code::Unauthenticated, "CERTIFICATE_UNKNOWN");
    let refused = connect(address, lab.with_certificate("mallory")).await;
    let refused = problem(refused);
    assert!(matches!(refused, ConnectProblem::CertificateRefused(_)), "{refused}");
    let without = Credentials { ca: Some(ca.clone()), ..Credentials::default() };
    assert_eq!(problem(connect(address, without.clone()).await), ConnectProblem::CertificateNeeded);
    let trusts_others =
        Credentials { ca: Some(lab.path("foreign-ca.pem")), ..lab.with_certificate("anna") };
    assert_eq!(problem(connect(address, trusts_others).await), ConnectProblem::UnknownAuthority);
    let plain = address.replace("https://", "http://");
    let refused = problem(connect(&plain, Credentials::default()).await);
    assert!(matches!(refused, ConnectProblem::NotGrpc(_)), "{refused}");
    // By the name of the host, as by its number.
    let by_name = address.replace("127.0.0.1", "localhost");
    connect(&by_name, lab.with_certificate("anna")).await.unwrap().list_plants().await.unwrap();

    lab.write_pair("server", &lab.authority.issue("server", &["plants.lab"]));
    let elsewhere = lab.start(&format!("{}{}", lab.tls(""), lab.auth()));
    assert_eq!(
        problem(connect(elsewhere.address(), without.clone()).await),
        ConnectProblem::WrongName
    );
    let open = lab.start("");
    let secured = open.address().replace("http://", "https://");
    assert_eq!(problem(connect(&secured, without).await), ConnectProblem::NoTls);
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_of_strangers_are_refused_over_tls_too() {
    let lab = Lab::new();
    let token = lab.token("anna", "driver", "lab");
    let server = lab.start(&format!("{}{}", lab.tls(""), lab.auth()));
    let host = server.address().strip_prefix("https://").unwrap().to_owned();
    let named = |host: &str| format!("Host: {host}\r\nAccept-Encoding: gzip\r\n");
    assert!(get(&lab, &server, "/", &named(&host)).await.starts_with("HTTP/1.1 200"));
    assert!(get(&lab, &server, "/", &named("evil.example")).await.starts_with("HTTP/1.1 403"));
    let foreign = format!("{}Origin: https://evil.example\r\n", named(&host));
    assert!(get(&lab, &server, "/", &foreign).await.starts_with("HTTP/1.1 403"));
    // A token opens nothing to a page of another origin.
    let bearer = format!("Authorization: Bearer {token}\r\n");
    let with_token = format!("{foreign}{bearer}");
    assert!(get(&lab, &server, "/metrics", &with_token).await.starts_with("HTTP/1.1 403"));
    let own = format!("{}Origin: https://{host}\r\n{bearer}", named(&host));
    assert!(get(&lab, &server, "/metrics", &own).await.starts_with("HTTP/1.1 200"));

    // Over HTTP/2.
    let ca = Certificate::from_pem(&lab.authority.pem);
    for (origin, code) in
        [(host.as_str(), Code::Unauthenticated), ("evil.example", Code::PermissionDenied)]
    {
        let tls = ClientTlsConfig::new().ca_certificate(ca.clone()).domain_name("127.0.0.1");
        let endpoint = Endpoint::from_shared(server.address().to_owned()).unwrap();
        let endpoint = endpoint.tls_config(tls).unwrap();
        let channel = endpoint.origin(format!("https://{origin}").parse().unwrap());
        let channel = channel.connect().await.unwrap();
        let mut plants = plantd_client::v1::plant_service_client::PlantServiceClient::new(channel);
        let mut request = tonic::Request::new(Default::default());
        // Programs may call by any name where the server listens beyond loopback; pages say where they come from.
        request.metadata_mut().insert("origin", format!("https://{origin}").parse().unwrap());
        assert_eq!(plants.list_plants(request).await.unwrap_err().code(), code, "{origin}");
    }
    assert!(!server.log().contains(&token));
}

#[tokio::test(flavor = "multi_thread")]
async fn certificates_change_and_no_stream_breaks() {
    let lab = Lab::new();
    let token = lab.token("anna", "driver", "lab");
    let server = lab.start(&format!("{}{}", lab.tls(""), lab.auth()));
    let client = somebody(&lab, &server, &token).await;
    plant(&client, "p1").await;
    let shown = async || {
        let stream = secured(&lab, &server).await;
        stream.get_ref().1.peer_certificates().unwrap()[0].clone().into_owned()
    };
    let first = shown().await;

    // A driver that steps all the while.
    let has_changed = Arc::new(AtomicBool::new(false));
    let driving = {
        let (client, has_changed) = (client.clone(), Arc::clone(&has_changed));
        tokio::spawn(async move {
            let mut driver = client.drive("p1").await.unwrap();
            let mut steps = 0_u64;
            while !has_changed.load(Ordering::Relaxed) {
                driver.step(&[0.1]).await.unwrap();
                steps += 1;
            }
            driver.step(&[0.1]).await.unwrap().state.unwrap().step == steps + 1
        })
    };
    let other = lab.authority.issue("server", &["127.0.0.1", "localhost"]);
    // For a moment the two files do not belong together: what was there stays in force.
    lab.write("server.pem", &other.0);
    until_log_says(&server, "the certificates that were read before stay in force", 1).await;
    assert_eq!(shown().await, first);
    lab.write("server.key", &other.1);
    until_log_says(&server, "certificates read", 1).await;
    assert_ne!(shown().await, first);
    let newcomer = somebody(&lab, &server, &token).await;
    assert_eq!(newcomer.list_plants().await.unwrap().len(), 1);
    tokio::time::sleep(Duration::from_millis(100)).await;
    has_changed.store(true, Ordering::Relaxed);
    assert!(soon(driving).await.unwrap(), "each step was taken once");
}
