//! Connections: addresses, timeouts and limits.

use std::time::Duration;

use tonic::transport::{Channel, Endpoint};

use crate::{Error, Result};

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
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConnectOptions {
    /// Longest wait for the connection; 5 s by default.
    pub connect_timeout: Duration,
    /// Longest wait for the answer of a call, for the opening of a stream and for each step of a
    /// [`Driver`](crate::Driver); 60 s by default. Sent to the server, which gives up as well.
    pub request_timeout: Duration,
}

impl Default for ConnectOptions {
    fn default() -> Self {
        Self { connect_timeout: Duration::from_secs(5), request_timeout: Duration::from_secs(60) }
    }
}

/// Opens a channel to `http://host:port`, `host:port` or `unix:/path`.
pub(crate) async fn connect(address: &str, options: &ConnectOptions) -> Result<Channel> {
    let endpoint = endpoint(address)?
        .connect_timeout(options.connect_timeout)
        // Without it a round trip waits for the peer's delayed acknowledgement, 40 ms.
        .tcp_nodelay(true)
        .initial_stream_window_size(STREAM_WINDOW_BYTES)
        .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
        .tcp_keepalive(Some(Duration::from_secs(30)))
        .http2_keep_alive_interval(Duration::from_secs(30))
        .user_agent(concat!("plantd-client/", env!("CARGO_PKG_VERSION")))
        .expect("the user agent is a valid header");
    let channel = tokio::time::timeout(options.connect_timeout, endpoint.connect()).await;
    let failed = |source| Error::Connect { address: address.to_owned(), source };
    match channel {
        Ok(channel) => channel.map_err(failed),
        Err(_) => Err(tonic::Status::unavailable(format!(
            "no connection to {address} within {:?}",
            options.connect_timeout
        ))
        .into()),
    }
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

fn endpoint(address: &str) -> Result<Endpoint> {
    let refused = || Error::Address { address: address.to_owned() };
    let url = if address.contains("://") || address.starts_with("unix:") {
        address.to_owned()
    } else {
        format!("http://{address}")
    };
    let has_place = match url.split_once(':') {
        Some(("unix", path)) => path.trim_start_matches("//").starts_with('/'),
        Some(("http", rest)) => rest.strip_prefix("//").is_some_and(|host| !host.is_empty()),
        _ => false,
    };
    if !has_place {
        return Err(refused());
    }
    Endpoint::from_shared(url).map_err(|_| refused())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses() {
        for good in ["http://127.0.0.1:1", "localhost:50051", "unix:/run/plantd.sock", "unix:///a"]
        {
            assert!(endpoint(good).is_ok(), "{good}");
        }
        for bad in ["", "http://", "unix:", "unix:relative", "ftp://a:1", "https://a:1", "a b"] {
            assert!(matches!(endpoint(bad), Err(Error::Address { .. })), "{bad}");
        }
    }

    #[tokio::test]
    async fn a_refused_connection_names_address_and_cause() {
        // Bound and dropped: a port that nobody listens on.
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let address = format!("http://127.0.0.1:{port}");
        let error = connect(&address, &ConnectOptions::default()).await.unwrap_err().to_string();
        assert!(error.contains(&address) && error.contains("refused"), "{error}");
    }
}
