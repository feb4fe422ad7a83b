//! `GET /metrics` over HTTP/1.1: one request a connection, nothing else.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::time::timeout;

use crate::metrics::Metrics;

/// Scrapes at a time; more wait.
const CONNECTIONS_MAX: usize = 16;
/// Bytes of a request's head.
const REQUEST_BYTES_MAX: usize = 8192;
/// Time for a request and for its answer.
const PATIENCE: Duration = Duration::from_secs(5);

/// Serves until dropped.
pub async fn serve(listener: TcpListener, metrics: Arc<Metrics>) {
    let permits = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    loop {
        let Ok(permit) = Arc::clone(&permits).acquire_owned().await else { return };
        let Ok((connection, _)) = listener.accept().await else {
            // Out of file descriptors, most likely: give them time to come back.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        let metrics = Arc::clone(&metrics);
        tokio::spawn(async move {
            let _permit = permit;
            // A scraper that goes away or is too slow will come again.
            let _ = timeout(PATIENCE, answer(connection, &metrics)).await;
        });
    }
}

async fn answer(mut connection: TcpStream, metrics: &Metrics) -> io::Result<()> {
    let head = read_head(&mut connection).await?;
    let (status, kind, body) = respond(&head, metrics);
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

fn respond(head: &[u8], metrics: &Metrics) -> (&'static str, &'static str, String) {
    const TEXT: &str = "text/plain; charset=utf-8";
    const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
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
    use crate::session::DriverKind;

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
}
