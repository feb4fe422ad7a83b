//! Connections: addresses, timeouts and limits.

use std::fmt::Write as _;
use std::io;
use std::os::unix::fs::FileTypeExt as _;
use std::path::Path;
use std::time::Duration;

use tonic::codegen::http::Uri;
use tonic::codegen::http::uri::{InvalidUri, PathAndQuery};
use tonic::transport::Endpoint;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use crate::credentials::{AuthorizedChannel, Credentials};
use crate::error::{ConnectProblem, Error, Result, root_cause};
use crate::handshake::refusal;

/// Where a server listens unless it is told otherwise.
pub const DEFAULT_ADDRESS: &str = "http://127.0.0.1:50051";

/// Largest message accepted from a server, bytes. Answers hold no more than a request asked for, so
/// this only stops a runaway peer: the linearization of 512 coordinates takes 50 MiB.
pub const MAX_RECEIVE_BYTES: usize = 256 << 20;

/// Bytes that the server may send ahead on one stream. Small, so that a watcher that pauses finds
/// little that is stale when it goes on.
const STREAM_WINDOW_BYTES: u32 = 64 << 10;

/// Bytes that the server may send ahead on all streams of a connection. The HTTP/2 library closes a
/// connection on which the unread small frames cost more memory than half of this, at 256 bytes a
/// frame; a stream window full of the smallest states costs a third of a MiB.
const CONNECTION_WINDOW_BYTES: u32 = 64 << 20;

/// Limits of a connection.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConnectOptions {
    /// Longest wait for the connection; 5 s by default.
    pub connect_timeout: Duration,
    /// Longest wait for the answer of a call, for the opening of a stream and for each step of a
    /// [`Driver`](crate::Driver); 60 s by default. Sent to the server, which gives up as well.
    pub request_timeout: Duration,
    /// How the client shows who it is, and how it knows the server.
    pub credentials: Credentials,
    /// Name by which the server is called, if not by the host of its address: for gateways that route by names which
    /// DNS does not lead to them.
    pub authority: Option<String>,
}

impl Default for ConnectOptions {
    fn default() -> Self {
        Self {
            connect_timeout: Duration::from_secs(5),
            request_timeout: Duration::from_secs(60),
            credentials: Credentials::default(),
            authority: None,
        }
    }
}

/// Opens a channel to `http://host:port`, `https://host:port`, `host:port` or `unix:/path`.
pub(crate) async fn connect(address: &str, options: &ConnectOptions) -> Result<AuthorizedChannel> {
    let channel = open(address, options).await?;
    let failed = |problem| Error::Connect { address: address.to_owned(), problem };
    let limit = options.connect_timeout;
    match tokio::time::timeout(limit, speaks_grpc(channel.clone())).await {
        Ok(Ok(Some(stranger))) => Err(stranger.into()),
        Ok(Ok(None)) => Ok(channel),
        Ok(Err(problem)) if address.starts_with("https://") => {
            let said = refusal(address, &options.credentials, limit).await;
            Err(failed(said.and_then(|said| tls_problem(&said)).unwrap_or(problem)))
        }
        Ok(Err(problem)) => Err(failed(problem)),
        Err(_) => Err(failed(ConnectProblem::Silent(limit))),
    }
}

/// Opens a channel without asking what is at its other end.
async fn open(address: &str, options: &ConnectOptions) -> Result<AuthorizedChannel> {
    let authorization = options.credentials.header()?;
    let endpoint = endpoint(address)?;
    let endpoint = match address.starts_with("https://") {
        true => secured(endpoint, &options.credentials)?,
        false => endpoint,
    };
    let endpoint = endpoint
        .connect_timeout(options.connect_timeout)
        // Without it a round trip waits for the peer's delayed acknowledgement, 40 ms.
        .tcp_nodelay(true)
        .initial_stream_window_size(STREAM_WINDOW_BYTES)
        .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
        .tcp_keepalive(Some(Duration::from_secs(30)))
        .http2_keep_alive_interval(Duration::from_secs(30))
        .user_agent(concat!("plantd-client/", env!("CARGO_PKG_VERSION")))
        .expect("the user agent is a valid header");
    let endpoint = match &options.authority {
        Some(name) => endpoint.origin(origin(address, name)?),
        None => endpoint,
    };
    let failed = |problem| Error::Connect { address: address.to_owned(), problem };
    let limit = options.connect_timeout;
    let channel = match tokio::time::timeout(limit, endpoint.connect()).await {
        Ok(Ok(channel)) => channel,
        Ok(Err(error)) => return Err(failed(problem(address, &error, limit))),
        Err(_) => return Err(failed(ConnectProblem::TimedOut(limit))),
    };
    Ok(AuthorizedChannel::new(channel, authorization))
}

/// Asks the health service of gRPC whether a server serves; it answers everybody, whoever they are.
pub(crate) async fn is_serving(
    address: &str,
    service: &str,
    options: &ConnectOptions,
) -> Result<bool> {
    let mut health = HealthClient::new(open(address, options).await?);
    let ask = health.check(HealthCheckRequest { service: service.to_owned() });
    let answer = within(options.connect_timeout, ask).await?.into_inner();
    Ok(answer.status() == ServingStatus::Serving)
}

/// Why a connection could not be made.
fn problem(
    address: &str,
    error: &(dyn std::error::Error + 'static),
    limit: Duration,
) -> ConnectProblem {
    let socket = address.strip_prefix("unix:").map(|path| Path::new(path.trim_start_matches("//")));
    let mut cause = Some(error);
    while let Some(error) = cause {
        if error.to_string() == "dns error" {
            return ConnectProblem::UnknownHost;
        }
        cause = error.source();
    }
    if let Some(problem) = tls_problem(error) {
        return problem;
    }
    let cause = root_cause(error);
    let kind = cause.downcast_ref::<io::Error>().map(io::Error::kind);
    match (kind, socket) {
        (Some(io::ErrorKind::ConnectionRefused), None) => ConnectProblem::Refused,
        (Some(io::ErrorKind::ConnectionRefused), Some(path)) if is_socket(path) => {
            ConnectProblem::DeadSocket
        }
        (Some(io::ErrorKind::ConnectionRefused), Some(_)) => ConnectProblem::NotASocket,
        (Some(io::ErrorKind::NotFound), Some(_)) => ConnectProblem::NoSocket,
        (Some(io::ErrorKind::PermissionDenied), Some(_)) => ConnectProblem::Denied,
        (Some(io::ErrorKind::TimedOut), _) => ConnectProblem::TimedOut(limit),
        _ => ConnectProblem::Other(cause.to_string()),
    }
}

fn is_socket(path: &Path) -> bool {
    std::fs::metadata(path).is_ok_and(|metadata| metadata.file_type().is_socket())
}

/// Which side has refused TLS, and why.
fn tls_problem(error: &(dyn std::error::Error + 'static)) -> Option<ConnectProblem> {
    let mut text = String::new();
    let mut cause = Some(error);
    while let Some(error) = cause {
        let _ = write!(text, "{error}; ");
        cause = error.source();
    }
    let said = |words: &[&str]| words.iter().any(|word| text.contains(word));
    // What rustls says of the server's certificate, and the alerts that servers send.
    let problem = if said(&["invalid peer certificate: UnknownIssuer"]) {
        ConnectProblem::UnknownAuthority
    } else if said(&["certificate not valid for name", "NotValidForName"]) {
        ConnectProblem::WrongName
    } else if said(&["invalid peer certificate"]) {
        ConnectProblem::BadCertificate(root_cause(error).to_string())
    } else if said(&["fatal alert: CertificateRequired"]) {
        ConnectProblem::CertificateNeeded
    } else if said(&["fatal alert: UnknownCA", "fatal alert: BadCertificate"])
        || said(&["fatal alert: CertificateExpired", "fatal alert: DecryptError"])
        || said(&["fatal alert: CertificateUnknown"])
    {
        ConnectProblem::CertificateRefused(root_cause(error).to_string())
    } else if said(&["InvalidContentType", "InvalidMessage("]) {
        ConnectProblem::NoTls
    } else {
        return None;
    };
    Some(problem)
}

/// Whether there is a gRPC server at the other end: it says of a method that nobody has that it has none, or that it
/// does not know who asks. HTTP/2 does not wait for the other side before it calls a connection made.
async fn speaks_grpc(channel: AuthorizedChannel) -> Result<Option<tonic::Status>, ConnectProblem> {
    let mut stub = tonic::client::Grpc::new(channel);
    let path = PathAndQuery::from_static("/plantd.v1.Connection/Probe");
    let not_grpc = |error: &(dyn std::error::Error + 'static)| {
        let other = || ConnectProblem::NotGrpc(root_cause(error).to_string());
        Err(tls_problem(error).unwrap_or_else(other))
    };
    if let Err(error) = stub.ready().await {
        return not_grpc(&error);
    }
    let codec = tonic_prost::ProstCodec::<(), ()>::default();
    match stub.unary(tonic::Request::new(()), path, codec).await {
        Err(status) if is_local(&status) => not_grpc(&status),
        Err(status) if status.code() == tonic::Code::Unauthenticated => Ok(Some(status)),
        _ => Ok(None),
    }
}

/// No gRPC server has said it.
fn is_local(status: &tonic::Status) -> bool {
    std::error::Error::source(status).is_some()
        || status.message().starts_with("grpc-status header missing")
}

/// Waits for `work`, but not longer than `limit`. Unlike a deadline sent with the request it does not
/// end a stream that has been opened.
pub(crate) async fn within<T, E: Into<Error>>(
    limit: Duration,
    work: impl Future<Output = Result<T, E>>,
) -> Result<T> {
    match tokio::time::timeout(limit, work).await {
        Ok(result) => result.map_err(Into::into),
        Err(_) => Err(tonic::Status::deadline_exceeded(format!("no answer in {limit:?}")).into()),
    }
}

/// What a server of that name is called with.
fn origin(address: &str, name: &str) -> Result<Uri> {
    let scheme = if address.starts_with("https://") { "https" } else { "http" };
    let refused =
        |_: InvalidUri| Error::Address { address: name.to_owned(), problem: "it is no host name" };
    format!("{scheme}://{name}").parse().map_err(refused)
}

/// An endpoint with TLS.
fn secured(endpoint: Endpoint, credentials: &Credentials) -> Result<Endpoint> {
    endpoint.tls_config(credentials.tls()?).map_err(|error| Error::Credentials {
        what: "ca, cert or key",
        problem: root_cause(&error).to_string(),
    })
}

fn endpoint(address: &str) -> Result<Endpoint> {
    let refused = |problem| Error::Address { address: address.to_owned(), problem };
    let url = if address.contains("://") || address.starts_with("unix:") {
        address.to_owned()
    } else {
        format!("http://{address}")
    };
    let problem = match url.split_once(':') {
        Some(("unix", path)) if path.trim_start_matches("//").starts_with('/') => None,
        Some(("unix", _)) => Some("the path of a socket begins with `/`"),
        Some(("http" | "https", rest)) => {
            let has_host = rest.strip_prefix("//").is_some_and(|host| !host.is_empty());
            (!has_host).then_some("it names no host")
        }
        _ => Some("the scheme is unknown"),
    };
    if let Some(problem) = problem {
        return Err(refused(problem));
    }
    Endpoint::from_shared(url).map_err(|_| refused("it cannot be read"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses() {
        for good in [
            "http://127.0.0.1:1",
            "https://plants.lab:1",
            "localhost:50051",
            "unix:/run/plantd.sock",
            "unix:///a",
        ] {
            assert!(endpoint(good).is_ok(), "{good}");
        }
        for (bad, said) in [
            ("", "no host"),
            ("http://", "no host"),
            ("unix:", "begins with `/`"),
            ("unix:relative", "begins with `/`"),
            ("ftp://a:1", "scheme"),
            ("https://", "no host"),
            ("a b", "cannot be read"),
        ] {
            let error = endpoint(bad).unwrap_err();
            assert!(matches!(error, Error::Address { .. }), "{bad}");
            assert!(error.to_string().contains(said), "{bad}: {error}");
        }
    }

    /// What is said of an address, which the sentence names.
    async fn failure(address: &str) -> ConnectProblem {
        let options =
            ConnectOptions { connect_timeout: Duration::from_millis(500), ..Default::default() };
        let error = connect(address, &options).await.unwrap_err();
        let sentence = error.to_string();
        assert!(sentence.contains(address) && !sentence.contains("transport error"), "{sentence}");
        match error {
            Error::Connect { problem, .. } => problem,
            other => panic!("{other}"),
        }
    }

    #[tokio::test]
    async fn each_mistake_has_a_name_of_its_own() {
        // Bound and dropped: a port that nobody listens on.
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        assert_eq!(failure(&format!("http://127.0.0.1:{port}")).await, ConnectProblem::Refused);
        let unknown = failure("http://no-such-host.invalid:1").await;
        assert!(
            matches!(unknown, ConnectProblem::UnknownHost | ConnectProblem::TimedOut(_)),
            "{unknown}"
        );

        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| format!("unix:{}", directory.path().join(name).display());
        assert_eq!(failure(&path("nothing")).await, ConnectProblem::NoSocket);
        std::fs::write(directory.path().join("file"), "").unwrap();
        assert_eq!(failure(&path("file")).await, ConnectProblem::NotASocket);
        let listener = std::os::unix::net::UnixListener::bind(directory.path().join("socket"));
        drop(listener.unwrap());
        assert_eq!(failure(&path("socket")).await, ConnectProblem::DeadSocket);
    }

    #[tokio::test]
    async fn servers_of_something_else_are_told_from_those_that_are_not_there() {
        use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let silent = failure(&address).await;
        assert_eq!(silent, ConnectProblem::Silent(Duration::from_millis(500)));

        tokio::spawn(async move {
            while let Ok((mut stream, _)) = listener.accept().await {
                tokio::spawn(async move {
                    let _ = stream.read(&mut [0; 1024]).await;
                    let _ = stream.write_all(b"HTTP/1.1 400 Bad Request\r\n\r\n").await;
                });
            }
        });
        let other = failure(&address).await;
        assert!(matches!(other, ConnectProblem::NotGrpc(_)), "{other}");
    }
}
