//! Listening sockets: TCP without delay, unix-domain, and a bound on connections.

use std::io;
use std::net::SocketAddr;
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use futures::{Stream, StreamExt, stream};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_stream::wrappers::UnixListenerStream;
use tonic::transport::server::{Connected, TcpIncoming};

use crate::grpc::KEEP_ALIVE_INTERVAL;

/// Listens on a TCP address. Small answers are sent at once: with Nagle's algorithm a call takes
/// 40 ms.
pub fn bind_tcp(address: SocketAddr) -> io::Result<TcpIncoming> {
    Ok(TcpIncoming::bind(address)?
        .with_nodelay(Some(true))
        .with_keepalive(Some(KEEP_ALIVE_INTERVAL)))
}

/// A unix-domain socket that disappears with its listener.
pub struct UnixSocket {
    path: PathBuf,
}

impl UnixSocket {
    /// Listens on a path. A socket that a dead server has left there is replaced.
    pub async fn bind(path: &Path) -> io::Result<(Self, UnixListenerStream)> {
        if is_socket(path) {
            match UnixStream::connect(path).await {
                Ok(_) => {
                    let message = format!("another server listens on `{}`", path.display());
                    return Err(io::Error::new(io::ErrorKind::AddrInUse, message));
                }
                Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {
                    std::fs::remove_file(path)?;
                }
                Err(error) => return Err(error),
            }
        }
        let listener = UnixListener::bind(path)?;
        Ok((Self { path: path.to_owned() }, UnixListenerStream::new(listener)))
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

fn is_socket(path: &Path) -> bool {
    std::fs::symlink_metadata(path).is_ok_and(|metadata| metadata.file_type().is_socket())
}

impl Drop for UnixSocket {
    fn drop(&mut self) {
        if let Err(error) = std::fs::remove_file(&self.path) {
            tracing::warn!(path = %self.path.display(), %error, "socket not removed");
        }
    }
}

/// Accepts connections only while there are permits.
pub fn admit<S, IO>(
    incoming: S,
    permits: Arc<Semaphore>,
) -> impl Stream<Item = io::Result<Admitted<IO>>>
where
    S: Stream<Item = io::Result<IO>> + Unpin,
{
    stream::unfold((incoming, permits), |(mut incoming, permits)| async {
        // The semaphore is never closed.
        let permit = Arc::clone(&permits).acquire_owned().await.ok()?;
        let connection = incoming.next().await?;
        let admitted = connection.map(|io| Admitted { io, _permit: permit });
        Some((admitted, (incoming, permits)))
    })
}

/// A connection that holds a permit.
pub struct Admitted<IO> {
    io: IO,
    _permit: OwnedSemaphorePermit,
}

impl<IO: Connected> Connected for Admitted<IO> {
    type ConnectInfo = IO::ConnectInfo;

    fn connect_info(&self) -> Self::ConnectInfo {
        self.io.connect_info()
    }
}

impl<IO: AsyncRead + Unpin> AsyncRead for Admitted<IO> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.io).poll_read(context, buffer)
    }
}

impl<IO: AsyncWrite + Unpin> AsyncWrite for Admitted<IO> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.io).poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.io).poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.io.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.io).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.io).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use tokio::net::TcpStream;

    use super::*;

    #[tokio::test]
    async fn accepted_connections_send_without_delay() {
        let mut incoming = bind_tcp(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
        let address = incoming.local_addr().unwrap();
        let (client, accepted) = tokio::join!(TcpStream::connect(address), incoming.next());
        client.unwrap();
        assert!(accepted.unwrap().unwrap().nodelay().unwrap());
    }

    #[tokio::test]
    async fn a_dead_servers_socket_is_replaced_and_a_live_ones_is_not() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("plantd.sock");
        drop(UnixListener::bind(&path).unwrap());
        assert!(is_socket(&path));
        let (socket, _listener) = UnixSocket::bind(&path).await.unwrap();
        let Err(error) = UnixSocket::bind(&path).await else { panic!("bound twice") };
        assert_eq!(error.kind(), io::ErrorKind::AddrInUse);
        drop(socket);
        assert!(!path.exists());
    }

    #[tokio::test]
    async fn a_connection_waits_for_a_permit() {
        let connections = stream::iter([1_u8, 2].map(|n| Ok(tokio_test_io(n))));
        let mut admitted = Box::pin(admit(connections, Arc::new(Semaphore::new(1))));
        let first = admitted.next().await.unwrap().unwrap();
        assert!(futures::poll!(admitted.next()).is_pending());
        drop(first);
        assert!(admitted.next().await.unwrap().is_ok());
    }

    fn tokio_test_io(_: u8) -> tokio::io::DuplexStream {
        tokio::io::duplex(1).0
    }
}
