//! How a client shows who it is, and how it knows the server.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr as _;

use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Identity};

use crate::error::{Error, Result};

/// How a client shows who it is, and how it knows the server. Nothing of it is needed where a server asks nobody who
/// they are and does not speak TLS.
#[derive(Clone, Default, PartialEq, Eq)]
pub struct Credentials {
    /// A bearer token, which `plantctl token new` makes. Sent with every call; in the clear unless the address begins
    /// with `https://` or `unix:`.
    pub token: Option<String>,
    /// Certificates of the CA that issued the server's, PEM. Without it those count that the system trusts.
    pub ca: Option<PathBuf>,
    /// A certificate of the client's own, PEM, and those between it and its CA.
    pub cert: Option<PathBuf>,
    /// The key of that certificate, PEM.
    pub key: Option<PathBuf>,
}

/// The token is not shown.
impl fmt::Debug for Credentials {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { token, ca, cert, key } = self;
        let token = token.as_ref().map(|_| "...");
        f.debug_struct("Credentials")
            .field("token", &token)
            .field("ca", ca)
            .field("cert", cert)
            .field("key", key)
            .finish()
    }
}

impl Credentials {
    /// What the environment variables `PLANTD_TOKEN`, `PLANTD_CA`, `PLANTD_CERT` and `PLANTD_KEY` say.
    pub fn from_env() -> Self {
        let path = |name| std::env::var_os(name).filter(|path| !path.is_empty()).map(PathBuf::from);
        Self {
            token: std::env::var("PLANTD_TOKEN").ok().filter(|token| !token.is_empty()),
            ca: path("PLANTD_CA"),
            cert: path("PLANTD_CERT"),
            key: path("PLANTD_KEY"),
        }
    }

    /// How TLS is to be agreed upon with a server.
    pub(crate) fn tls(&self) -> Result<ClientTlsConfig> {
        let read = |what, path: &PathBuf| {
            std::fs::read(path).map_err(|error| Error::Credentials {
                what,
                problem: format!("{}: {error}", path.display()),
            })
        };
        let tls = match &self.ca {
            Some(path) => {
                ClientTlsConfig::new().ca_certificate(Certificate::from_pem(read("ca", path)?))
            }
            None => ClientTlsConfig::new().with_native_roots(),
        };
        match (&self.cert, &self.key) {
            (Some(cert), Some(key)) => {
                let identity = Identity::from_pem(read("cert", cert)?, read("key", key)?);
                Ok(tls.identity(identity))
            }
            (None, None) => Ok(tls),
            (Some(_), None) => Err(lacks("cert", "`key` is missing: a certificate takes its key")),
            (None, Some(_)) => Err(lacks("key", "`cert` is missing: a key takes its certificate")),
        }
    }

    /// What is sent with every call.
    pub(crate) fn header(&self) -> Result<Authorization> {
        let Some(token) = &self.token else { return Ok(Authorization { header: None }) };
        let header = MetadataValue::from_str(&format!("Bearer {}", token.trim()));
        let mut header =
            header.map_err(|_| lacks("token", "it has characters that no token has"))?;
        // Neither in logs nor in the tables of HTTP/2, where it could be guessed.
        header.set_sensitive(true);
        Ok(Authorization { header: Some(header) })
    }
}

fn lacks(what: &'static str, problem: &str) -> Error {
    Error::Credentials { what, problem: problem.to_owned() }
}

/// Sends a token with every call.
#[derive(Clone, Debug)]
pub struct Authorization {
    header: Option<MetadataValue<Ascii>>,
}

impl Interceptor for Authorization {
    fn call(
        &mut self,
        mut request: tonic::Request<()>,
    ) -> Result<tonic::Request<()>, tonic::Status> {
        if let Some(header) = &self.header {
            request.metadata_mut().insert("authorization", header.clone());
        }
        Ok(request)
    }
}

/// A connection that says with every call who calls.
pub type AuthorizedChannel = InterceptedService<Channel, Authorization>;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_is_sent_and_never_shown() {
        let token = Some("abc".to_owned());
        let credentials = Credentials { token, ..Credentials::default() };
        assert!(!format!("{credentials:?}").contains("abc"));
        let mut authorization = credentials.header().unwrap();
        let request = authorization.call(tonic::Request::new(())).unwrap();
        assert_eq!(request.metadata().get("authorization").unwrap(), "Bearer abc");
        assert!(!format!("{authorization:?} {request:?}").contains("abc"));
        let token = Some("a\nb".to_owned());
        let wrong = Credentials { token, ..Credentials::default() }.header().unwrap_err();
        assert!(wrong.to_string().contains("token"), "{wrong}");
    }

    #[test]
    fn files_that_are_not_there_are_named() {
        let path = Some(PathBuf::from("/no/such/file"));
        for (credentials, said) in [
            (Credentials { ca: path.clone(), ..Credentials::default() }, "ca"),
            (Credentials { cert: path.clone(), ..Credentials::default() }, "`key` is missing"),
            (Credentials { key: path.clone(), ..Credentials::default() }, "`cert` is missing"),
        ] {
            let error = credentials.tls().unwrap_err().to_string();
            assert!(error.contains(said), "{error}");
        }
    }
}
