//! TLS of the TCP socket: connections are made with the certificates that are there when they are made. The files are
//! read again when they change; connections that are open stay so.

use std::io;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::task::{Context, Poll};

use futures::{Stream, StreamExt as _};
use serde::{Deserialize, Serialize};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::{NoServerSessionStorage, WebPkiClientVerifier};
use tokio_rustls::rustls::{RootCertStore, ServerConfig};
use tokio_rustls::server::TlsStream;
use tonic::transport::server::Connected;

use crate::wire::edge::admission::{Admitted, Place};
use crate::wire::edge::auth::door::{LOOK_PERIOD, Stamp};
use crate::wire::edge::certificate::Certificate;

/// The table `[tls]`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TlsSettings {
    /// The server's certificate, and those between it and its CA, in PEM.
    pub certificate: PathBuf,
    /// The key of that certificate, in PEM.
    pub key: PathBuf,
    /// Certificates of the CAs whose clients are let in, in PEM.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub client_ca: Option<PathBuf>,
    /// Whether clients show certificates.
    #[serde(default)]
    pub client: ClientCertificates,
}

/// Whether clients show certificates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ClientCertificates {
    /// They are not asked for one.
    #[default]
    None,
    /// Those who have one may.
    Optional,
    /// Nobody is let in without one.
    Required,
}

/// Why there is no TLS.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read, or has nothing in it that is looked for.
    #[error("{key} `{path}`: {problem}")]
    File {
        /// Key of the configuration.
        key: &'static str,
        /// Path.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// Certificate and key do not belong together, or are of a kind that is not known.
    #[error("tls.certificate `{certificate}` with tls.key `{key}`: {problem}")]
    Pair {
        /// Path.
        certificate: PathBuf,
        /// Path.
        key: PathBuf,
        /// What is wrong.
        problem: String,
    },
}

/// The certificates in force.
pub struct TlsFiles {
    settings: TlsSettings,
    present: RwLock<Arc<ServerConfig>>,
    stamps: Mutex<Vec<Option<Stamp>>>,
}

impl TlsFiles {
    /// Reads the files.
    pub fn read(settings: TlsSettings) -> Result<Arc<Self>, TlsError> {
        let stamps = Mutex::new(stamps(&settings));
        let present = RwLock::new(Arc::new(load(&settings)?));
        Ok(Arc::new(Self { settings, present, stamps }))
    }

    /// Looks over and over whether the files have changed. What cannot be used leaves in force what was.
    pub async fn look_after(self: Arc<Self>) {
        loop {
            tokio::time::sleep(LOOK_PERIOD).await;
            let files = Arc::clone(&self);
            // The disk may not answer.
            let _ = tokio::task::spawn_blocking(move || files.look()).await;
        }
    }

    fn look(&self) {
        let now = stamps(&self.settings);
        {
            let mut known = self.stamps.lock().unwrap_or_else(PoisonError::into_inner);
            if *known == now {
                return;
            }
            *known = now;
        }
        match load(&self.settings) {
            Ok(config) => {
                *self.present.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(config);
                tracing::info!(certificate = %self.settings.certificate.display(), "certificates read");
            }
            Err(error) => {
                tracing::error!(%error, "the certificates that were read before stay in force");
            }
        }
    }

    fn acceptor(&self) -> TlsAcceptor {
        Arc::clone(&self.present.read().unwrap_or_else(PoisonError::into_inner)).into()
    }
}

fn stamps(settings: &TlsSettings) -> Vec<Option<Stamp>> {
    let TlsSettings { certificate, key, client_ca, .. } = settings;
    [Some(certificate), Some(key), client_ca.as_ref()]
        .into_iter()
        .flatten()
        .map(|path| Stamp::of(path))
        .collect()
}

fn certificates(key: &'static str, path: &Path) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let wrong = |problem| TlsError::File { key, path: path.to_owned(), problem };
    let read = CertificateDer::pem_file_iter(path).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    match read {
        Ok(certificates) if certificates.is_empty() => {
            Err(wrong("there is no certificate in it".to_owned()))
        }
        Ok(certificates) => Ok(certificates),
        Err(error) => Err(wrong(error.to_string())),
    }
}

fn load(settings: &TlsSettings) -> Result<ServerConfig, TlsError> {
    let chain = certificates("tls.certificate", &settings.certificate)?;
    let key = PrivateKeyDer::from_pem_file(&settings.key).map_err(|error| TlsError::File {
        key: "tls.key",
        path: settings.key.clone(),
        problem: error.to_string(),
    })?;
    let provider = Arc::new(ring::default_provider());
    let pair = |problem: String| TlsError::Pair {
        certificate: settings.certificate.clone(),
        key: settings.key.clone(),
        problem,
    };
    let builder = ServerConfig::builder_with_provider(Arc::clone(&provider))
        .with_safe_default_protocol_versions()
        .map_err(|error| pair(error.to_string()))?;
    let builder = match (&settings.client_ca, settings.client) {
        (Some(path), ClientCertificates::Optional | ClientCertificates::Required) => {
            let wrong =
                |problem| TlsError::File { key: "tls.client_ca", path: path.clone(), problem };
            let mut roots = RootCertStore::empty();
            for certificate in certificates("tls.client_ca", path)? {
                roots.add(certificate).map_err(|error| wrong(error.to_string()))?;
            }
            let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider);
            let verifier = match settings.client {
                ClientCertificates::Optional => verifier.allow_unauthenticated(),
                _ => verifier,
            };
            let verifier = verifier.build().map_err(|error| wrong(error.to_string()))?;
            builder.with_client_cert_verifier(verifier)
        }
        _ => builder.with_no_client_auth(),
    };
    let mut config =
        builder.with_single_cert(chain, key).map_err(|error| pair(error.to_string()))?;
    config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    // Who comes again shows the certificate again: the CA may be another one by now.
    config.session_storage = Arc::new(NoServerSessionStorage {});
    config.send_tls13_tickets = 0;
    Ok(config)
}

/// The connections with which TLS was agreed upon. Those under way do not wait for each other; each has its place, and
/// the time that every connection has for its first request.
pub(crate) fn over_tls(
    incoming: impl Stream<Item = io::Result<Admitted<TcpStream>>>,
    files: Arc<TlsFiles>,
) -> impl Stream<Item = io::Result<Secured>> {
    incoming
        .map(move |connection| {
            let acceptor = files.acceptor();
            async move {
                let connection = connection?;
                let peer = connection.connect_info().peer();
                acceptor.accept(connection).await.map(Secured::new).inspect_err(|error| {
                    tracing::debug!(?peer, %error, "refused: no TLS");
                })
            }
        })
        .buffer_unordered(usize::MAX)
        .filter_map(|connection| std::future::ready(connection.ok().map(Ok)))
}

/// A connection over TLS.
pub(crate) struct Secured {
    stream: TlsStream<Admitted<TcpStream>>,
}

impl Secured {
    fn new(stream: TlsStream<Admitted<TcpStream>>) -> Self {
        let (connection, session) = stream.get_ref();
        let certificate = session.peer_certificates().and_then(|chain| chain.first());
        if let Some(certificate) = certificate.and_then(|der| Certificate::read(der)) {
            connection.set_certificate(certificate);
        }
        Self { stream }
    }
}

impl Connected for Secured {
    type ConnectInfo = Arc<Place>;

    fn connect_info(&self) -> Self::ConnectInfo {
        self.stream.get_ref().0.connect_info()
    }
}

impl AsyncRead for Secured {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for Secured {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}
