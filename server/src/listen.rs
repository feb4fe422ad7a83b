//! Listening sockets: TCP without delay, unix-domain.

use std::fs::Permissions;
use std::io;
use std::net::SocketAddr;
use std::os::unix::fs::{FileTypeExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::net::UnixStream;
use tokio_stream::wrappers::UnixListenerStream;
use tonic::transport::server::TcpIncoming;

use crate::core::modes::Mode;

/// How often the server asks a silent client whether it is alive, and how long it may take to say so.
pub(crate) const KEEP_ALIVE_INTERVAL: Duration = Duration::from_secs(10);
pub(crate) const KEEP_ALIVE_TIMEOUT: Duration = Duration::from_secs(5);

/// Listens on a TCP address. Small answers are sent at once: with Nagle's algorithm a call takes
/// 40 ms.
pub fn bind_tcp(address: SocketAddr) -> io::Result<TcpIncoming> {
    Ok(TcpIncoming::bind(address)?
        .with_nodelay(Some(true))
        .with_keepalive(Some(KEEP_ALIVE_INTERVAL)))
}

/// Connections that may wait to be accepted.
const BACKLOG: u32 = 1024;

/// A unix-domain socket that disappears with its listener.
pub struct UnixSocket {
    path: PathBuf,
}

impl UnixSocket {
    /// Listens on a path. A socket that a dead server has left there is replaced. Who may connect is what the
    /// mode says; at no time may others.
    pub async fn bind(path: &Path, mode: Mode) -> io::Result<(Self, UnixListenerStream)> {
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
        let socket = tokio::net::UnixSocket::new_stream()?;
        // The file gets the mode that the socket has when it is bound, less the umask.
        let bits = rustix::fs::Mode::from_bits_truncate(mode.bits() as rustix::fs::RawMode);
        rustix::fs::fchmod(&socket, bits)?;
        socket.bind(path)?;
        let bound = Self { path: path.to_owned() };
        std::fs::set_permissions(path, Permissions::from_mode(mode.bits()))?;
        Ok((bound, UnixListenerStream::new(socket.listen(BACKLOG)?)))
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

#[cfg(test)]
mod tests {
    use futures::StreamExt as _;
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
        drop(tokio::net::UnixListener::bind(&path).unwrap());
        assert!(is_socket(&path));
        let (socket, _listener) = UnixSocket::bind(&path, Mode::GROUP).await.unwrap();
        let Err(error) = UnixSocket::bind(&path, Mode::GROUP).await else { panic!("bound twice") };
        assert_eq!(error.kind(), io::ErrorKind::AddrInUse);
        drop(socket);
        assert!(!path.exists());
    }
}
