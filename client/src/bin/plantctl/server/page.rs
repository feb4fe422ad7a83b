//! The page and one recording on a free port of the loopback interface, for the browser of whoever asked.

use std::fs::File;
use std::io::{self, Read as _, Seek as _, SeekFrom};
use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context as _, Result};
use futures::stream;
use http_body_util::combinators::BoxBody;
use http_body_util::{BodyExt as _, Full, StreamBody};
use hyper::body::{Bytes, Frame, Incoming};
use hyper::header::{
    ACCEPT_RANGES, CACHE_CONTROL, CONTENT_ENCODING, CONTENT_LENGTH, CONTENT_RANGE,
    CONTENT_SECURITY_POLICY, CONTENT_TYPE, HOST, HeaderValue, ORIGIN, RANGE,
};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::TokioIo;
use plantd_viewer::{HEADERS, PARTS, POLICY, Part};
use tokio::net::TcpListener;

/// Where the recording is.
const RECORDING: &str = "/recording.mcap";
/// Bytes that are read at a time.
const PIECE: usize = 1 << 18;

type Body = BoxBody<Bytes, io::Error>;

/// The page with a recording, once it listens.
pub(crate) struct PageServer {
    listener: TcpListener,
    site: Arc<Site>,
}

struct Site {
    address: SocketAddr,
    recording: File,
    length: u64,
}

impl PageServer {
    /// Listens on a free port.
    pub(crate) async fn bind(recording: &Path) -> Result<Self> {
        let open = || format!("cannot read {}", recording.display());
        let recording = File::open(recording).with_context(open)?;
        let length = recording.metadata()?.len();
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await?;
        let address = listener.local_addr()?;
        Ok(Self { listener, site: Arc::new(Site { address, recording, length }) })
    }

    /// The page's address with the recording in it.
    pub(crate) fn url(&self) -> String {
        format!("http://{}/?recording={RECORDING}", self.site.address)
    }

    /// Serves until it is dropped.
    pub(crate) async fn serve(self) -> Result<()> {
        loop {
            let (connection, _) = self.listener.accept().await?;
            let site = Arc::clone(&self.site);
            let answer = service_fn(move |request| {
                let response = site.answer(&request);
                async move { response }
            });
            let serve = http1::Builder::new().serve_connection(TokioIo::new(connection), answer);
            tokio::spawn(async {
                // A browser that goes away in the middle concerns nobody.
                let _ = serve.await;
            });
        }
    }
}

impl Site {
    fn answer(&self, request: &Request<Incoming>) -> io::Result<Response<Body>> {
        let mut response = self.find(request)?;
        let headers = response.headers_mut();
        headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY));
        headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-cache"));
        for (name, value) in HEADERS {
            headers.insert(name, HeaderValue::from_static(value));
        }
        Ok(response)
    }

    fn find(&self, request: &Request<Incoming>) -> io::Result<Response<Body>> {
        let header = |name| request.headers().get(name).map(|value| value.to_str().unwrap_or("?"));
        // A name that an attacker has made to lead here is none of these, and no other page says them.
        let hosts =
            ["127.0.0.1", "localhost"].map(|name| format!("{name}:{}", self.address.port()));
        let is_own = |host: &str| hosts.iter().any(|own| own.eq_ignore_ascii_case(host));
        let is_host = header(HOST).is_some_and(is_own);
        let is_origin =
            header(ORIGIN).is_none_or(|origin| origin.strip_prefix("http://").is_some_and(is_own));
        if !is_host || !is_origin {
            return Ok(text(StatusCode::FORBIDDEN, "not under this name\n"));
        }
        if !matches!(*request.method(), Method::GET | Method::HEAD) {
            // What the page asks a server of plants: it knows what to do where there is none.
            return Ok(text(
                StatusCode::SERVICE_UNAVAILABLE,
                "a recording, and no server of plants\n",
            ));
        }
        let path = request.uri().path();
        if path == RECORDING {
            let range = header(RANGE).and_then(|range| part_of(range, self.length));
            return self.recording(range, request.method() == Method::HEAD);
        }
        let Some(Part { kind, bytes, is_compressed, .. }) =
            PARTS.iter().find(|part| part.path == path)
        else {
            return Ok(text(StatusCode::NOT_FOUND, "there is nothing here\n"));
        };
        let mut response = Response::new(whole(bytes));
        response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(kind));
        if *is_compressed {
            response.headers_mut().insert(CONTENT_ENCODING, HeaderValue::from_static("gzip"));
        }
        Ok(response)
    }

    /// The recording, or a part of it.
    fn recording(&self, range: Option<(u64, u64)>, is_head: bool) -> io::Result<Response<Body>> {
        let (from, end) = range.unwrap_or((0, self.length));
        let mut response = match is_head {
            true => Response::new(whole(b"")),
            false => Response::new(pieces(self.recording.try_clone()?, from, end)),
        };
        let headers = response.headers_mut();
        headers.insert(CONTENT_TYPE, HeaderValue::from_static("application/octet-stream"));
        headers.insert(ACCEPT_RANGES, HeaderValue::from_static("bytes"));
        headers.insert(CONTENT_LENGTH, HeaderValue::from(end - from));
        if range.is_some() {
            let value = format!("bytes {from}-{}/{}", end - 1, self.length);
            headers.extend(HeaderValue::try_from(value).ok().map(|value| (CONTENT_RANGE, value)));
            *response.status_mut() = StatusCode::PARTIAL_CONTENT;
        }
        Ok(response)
    }
}

/// The first byte and the end of a range, `bytes=FIRST-LAST`; none where it is another one or empty.
fn part_of(range: &str, length: u64) -> Option<(u64, u64)> {
    let (first, last) = range.strip_prefix("bytes=")?.split_once('-')?;
    let (from, end) = match (first.trim(), last.trim()) {
        ("", count) => (length.saturating_sub(count.parse().ok()?), length),
        (first, "") => (first.parse().ok()?, length),
        (first, last) => (first.parse().ok()?, last.parse::<u64>().ok()?.saturating_add(1)),
    };
    let end = end.min(length);
    (from < end).then_some((from, end))
}

fn text(status: StatusCode, text: &'static str) -> Response<Body> {
    let mut response = Response::new(whole(text.as_bytes()));
    *response.status_mut() = status;
    let kind = HeaderValue::from_static("text/plain; charset=utf-8");
    response.headers_mut().insert(CONTENT_TYPE, kind);
    response
}

fn whole(bytes: &'static [u8]) -> Body {
    Full::new(Bytes::from_static(bytes)).map_err(|never| match never {}).boxed()
}

/// A part of a file, piece by piece.
fn pieces(file: File, from: u64, end: u64) -> Body {
    let piece = move |(file, at): (File, u64)| async move {
        let read = || {
            let mut bytes = vec![0; PIECE.min((end - at) as usize)];
            // The place in the file is shared by all who read it.
            let mut file = &file;
            file.seek(SeekFrom::Start(at))?;
            let count = file.read(&mut bytes)?;
            bytes.truncate(count);
            Ok(bytes)
        };
        match read() {
            Ok(bytes) if bytes.is_empty() => None,
            Ok(bytes) => {
                let next = at + bytes.len() as u64;
                Some((Ok(Frame::data(Bytes::from(bytes))), (file, next)))
            }
            Err(error) => Some((Err(error), (file, end))),
        }
    };
    StreamBody::new(stream::unfold((file, from), piece)).boxed()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_those_of_the_standard() {
        for (range, part) in [
            ("bytes=0-99", Some((0, 100))),
            ("bytes=10-", Some((10, 1000))),
            ("bytes=-10", Some((990, 1000))),
            ("bytes=990-5000", Some((990, 1000))),
            ("bytes=1000-", None),
            ("bytes=5-4", None),
            ("lines=0-1", None),
            ("bytes=0-1,5-6", None),
        ] {
            assert_eq!(part_of(range, 1000), part, "{range}");
        }
    }
}
