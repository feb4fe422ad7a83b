//! `GET /metrics` over HTTP/1.1: one request a connection, nothing else, and not for pages of strangers.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::time::timeout;

use crate::core::metrics::registry::Metrics;
use crate::wire::names::{Foreign, Names};

/// Scrapes at a time; more wait.
const CONNECTIONS_MAX: usize = 16;
/// Bytes of a request's head.
const REQUEST_BYTES_MAX: usize = 8192;
/// Time for a request and for its answer.
const PATIENCE: Duration = Duration::from_secs(5);

/// Content type of metrics.
pub(super) const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
const TEXT: &str = "text/plain; charset=utf-8";

/// Serves until dropped.
pub async fn serve(listener: TcpListener, metrics: Arc<Metrics>, names: Names) {
    let names = Arc::new(names);
    let permits = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    loop {
        let Ok(permit) = Arc::clone(&permits).acquire_owned().await else { return };
        let Ok((connection, _)) = listener.accept().await else {
            // Out of file descriptors, most likely: give them time to come back.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        let (metrics, names) = (Arc::clone(&metrics), Arc::clone(&names));
        tokio::spawn(async move {
            let _permit = permit;
            // A scraper that goes away or is too slow will come again.
            let _ = timeout(PATIENCE, answer(connection, &metrics, &names)).await;
        });
    }
}

async fn answer(mut connection: TcpStream, metrics: &Metrics, names: &Names) -> io::Result<()> {
    let head = read_head(&mut connection).await?;
    let (status, kind, body) = match check(&head, names) {
        Ok(()) => respond(&head, metrics),
        Err(foreign) => ("403 Forbidden", TEXT, format!("{foreign}\n")),
    };
    let answer = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{body}",
        body.len()
    );
    connection.write_all(answer.as_bytes()).await?;
    connection.shutdown().await
}

async fn read_head(connection: &mut TcpStream) -> io::Result<Vec<u8>> {
    let mut head = Vec::with_capacity(1024);
    while !head.windows(4).any(|window| window == b"\r\n\r\n") {
        if head.len() >= REQUEST_BYTES_MAX || connection.read_buf(&mut head).await? == 0 {
            break;
        }
    }
    Ok(head)
}

fn check(head: &[u8], names: &Names) -> Result<(), Foreign> {
    // What is no text is no name.
    let head = String::from_utf8_lossy(head);
    let of = |name: &'static str| {
        let fields = head.lines().skip(1).filter_map(|line| line.split_once(':'));
        let named = fields.filter(move |(field, _)| field.trim().eq_ignore_ascii_case(name));
        named.map(|(_, value)| value.trim())
    };
    names.check(|| of("host"), || of("origin"))
}

fn respond(head: &[u8], metrics: &Metrics) -> (&'static str, &'static str, String) {
    let line = head.split(|byte| *byte == b'\r').next().unwrap_or_default();
    let mut words = line.split(|byte| *byte == b' ');
    match (words.next(), words.next()) {
        (Some(b"GET"), Some(b"/metrics")) => match metrics.encode() {
            Ok(text) => ("200 OK", OPEN_METRICS, text),
            Err(error) => ("500 Internal Server Error", TEXT, error.to_string()),
        },
        (Some(b"GET"), _) => ("404 Not Found", TEXT, "metrics are at /metrics\n".to_owned()),
        _ => ("405 Method Not Allowed", TEXT, "only GET\n".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::driver::DriverKind;

    #[test]
    fn metrics_are_served_and_nothing_else_is() {
        let metrics = Metrics::default();
        metrics.stepped(DriverKind::Drive);
        let (status, _, body) = respond(b"GET /metrics HTTP/1.1\r\nHost: a\r\n\r\n", &metrics);
        assert_eq!(status, "200 OK");
        assert!(body.contains("plantd_steps_total{driver=\"drive\"} 1"), "{body}");
        assert!(body.contains("plantd_step_duration_seconds_bucket"), "{body}");
        assert!(respond(b"GET / HTTP/1.1\r\n\r\n", &metrics).0.starts_with("404"));
        assert!(respond(b"POST /metrics HTTP/1.1\r\n\r\n", &metrics).0.starts_with("405"));
        assert!(respond(b"", &metrics).0.starts_with("405"));
    }
    #[test]
    fn strangers_are_refused() {
        let check = |fields: &str| {
            check(format!("GET /metrics HTTP/1.1\r\n{fields}\r\n").as_bytes(), &Names::default())
        };
        check("Host: 127.0.0.1:9464\r\n").unwrap();
        check("").unwrap();
        let host = "evil.example".to_owned();
        assert_eq!(check("hOST: evil.example\r\n"), Err(Foreign::Host(host.clone())));
        check("Host: localhost\r\nHost: evil.example\r\n").unwrap_err();
        check("Host : evil.example\r\n").unwrap_err();
        check("Host: localhost\r\nOrigin: http://evil.example\r\n").unwrap_err();
    }
}
