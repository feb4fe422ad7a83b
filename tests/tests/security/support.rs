//! What the drills share: an authority that issues certificates, servers with people, their clients.

use std::fmt::Debug;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use plantd_client::{Answers, Client, Code, ConnectOptions, Credentials, Error, v1};
use plantd_tests::server::{ServerProcess, binary};
use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair};

/// Who issues certificates.
pub(crate) struct Authority {
    issuer: Issuer<'static, KeyPair>,
    pub(crate) pem: String,
}

impl Authority {
    pub(crate) fn new(name: &str) -> Self {
        let mut parameters = CertificateParams::new(Vec::new()).unwrap();
        parameters.distinguished_name.push(DnType::CommonName, name);
        parameters.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().unwrap();
        let pem = parameters.self_signed(&key).unwrap().pem();
        Self { issuer: Issuer::new(parameters, key), pem }
    }

    /// A certificate for somebody, under these host names, and its key.
    pub(crate) fn issue(&self, common_name: &str, hosts: &[&str]) -> (String, String) {
        let hosts: Vec<String> = hosts.iter().map(|host| (*host).to_owned()).collect();
        let mut parameters = CertificateParams::new(hosts).unwrap();
        parameters.distinguished_name.push(DnType::CommonName, common_name);
        let key = KeyPair::generate().unwrap();
        let certificate = parameters.signed_by(&key, &self.issuer).unwrap();
        (certificate.pem(), key.serialize_pem())
    }
}

/// A folder with what a server and its clients need.
pub(crate) struct Lab {
    pub(crate) folder: tempfile::TempDir,
    pub(crate) authority: Authority,
}

impl Lab {
    /// A folder with the certificate of a server on this machine.
    pub(crate) fn new() -> Self {
        let lab = Self {
            folder: tempfile::Builder::new().prefix("plantd-lab-").tempdir().unwrap(),
            authority: Authority::new("lab"),
        };
        lab.write("ca.pem", &lab.authority.pem);
        lab.write_pair("server", &lab.authority.issue("server", &["127.0.0.1", "localhost"]));
        lab.write("tokens.toml", "");
        lab
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub(crate) fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.path(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    /// Writes `NAME.pem` and `NAME.key`.
    pub(crate) fn write_pair(&self, name: &str, (certificate, key): &(String, String)) {
        self.write(&format!("{name}.pem"), certificate);
        self.write(&format!("{name}.key"), key);
    }

    /// What a configuration says of the folder's tokens.
    pub(crate) fn auth(&self) -> String {
        format!("[auth]\ntokens = \"{}\"\n", self.path("tokens.toml").display())
    }

    /// What it says of the folder's certificates.
    pub(crate) fn tls(&self, rest: &str) -> String {
        let (certificate, key) = (self.path("server.pem"), self.path("server.key"));
        let (certificate, key) = (certificate.display(), key.display());
        format!("[tls]\ncertificate = \"{certificate}\"\nkey = \"{key}\"\n{rest}\n")
    }

    /// A server with this configuration.
    pub(crate) fn start(&self, configuration: &str) -> ServerProcess {
        let path = self.write("plantd.toml", configuration);
        ServerProcess::start_with(|command| {
            command.arg("--config").arg(path);
        })
        .unwrap()
    }

    /// Runs `plantctl token`; what it prints.
    pub(crate) fn tokens(&self, arguments: &[&str]) -> String {
        let output = Command::new(binary("plantctl").unwrap())
            .arg("token")
            .args(arguments)
            .arg("--file")
            .arg(self.path("tokens.toml"))
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap().trim().to_owned()
    }

    /// A new token.
    pub(crate) fn token(&self, name: &str, role: &str, tenant: &str) -> String {
        self.tokens(&["new", name, "--role", role, "--tenant", tenant])
    }

    /// Shows a server with the folder's CA a token.
    pub(crate) fn with_token(&self, token: &str) -> Credentials {
        let ca = Some(self.path("ca.pem"));
        Credentials { token: Some(token.to_owned()), ca, ..Credentials::default() }
    }

    /// Shows it a certificate of the folder.
    pub(crate) fn with_certificate(&self, name: &str) -> Credentials {
        let path = |end: &str| Some(self.path(&format!("{name}.{end}")));
        Credentials {
            token: None,
            ca: Some(self.path("ca.pem")),
            cert: path("pem"),
            key: path("key"),
        }
    }
}

pub(crate) async fn connect(address: &str, credentials: Credentials) -> Result<Client, Error> {
    let options = ConnectOptions { credentials, ..ConnectOptions::default() };
    Client::connect_with(address, options).await
}

/// Somebody with a token.
pub(crate) async fn somebody(lab: &Lab, server: &ServerProcess, token: &str) -> Client {
    connect(server.address(), lab.with_token(token)).await.unwrap()
}

/// Waits for what must come, but not for ever.
pub(crate) async fn soon<T>(work: impl Future<Output = T>) -> T {
    tokio::time::timeout(Duration::from_secs(60), work).await.expect("an answer within 60 s")
}

/// How a watch ends.
pub(crate) async fn end_of(states: &mut Answers<v1::WatchResponse>) -> Result<(), Error> {
    soon(async {
        loop {
            match states.next().await {
                Ok(Some(_)) => {}
                ended => break ended.map(drop),
            }
        }
    })
    .await
}

pub(crate) async fn plant(client: &Client, id: &str) -> v1::PlantInfo {
    let (id, model) = (id.to_owned(), "pendulum".to_owned());
    let request = v1::CreatePlantRequest { id, model, ..Default::default() };
    client.create_plant(request).await.unwrap()
}

#[track_caller]
pub(crate) fn assert_refused<T: Debug>(result: Result<T, Error>, code: Code, reason: &str) {
    let error = result.expect_err("a refusal");
    assert_eq!((error.code(), error.reason()), (Some(code), reason), "{error}");
}

/// The sentence with which a call was refused.
#[track_caller]
pub(crate) fn refusal<T: Debug>(result: Result<T, Error>) -> String {
    result.expect_err("a refusal").to_string()
}

/// Waits until a file of the log says something.
pub(crate) async fn until_log_says(server: &ServerProcess, words: &str, count: usize) {
    soon(async {
        while server.log().matches(words).count() < count {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await;
}

pub(crate) fn watch_request(id: &str) -> v1::WatchRequest {
    let fields = vec![v1::WatchField::State.into()];
    v1::WatchRequest { id: id.to_owned(), fields, ..Default::default() }
}

/// What a server answers at the port of gRPC to a browser with these header lines.
pub(crate) fn get(server: &ServerProcess, path: &str, fields: &str) -> String {
    let host = server.address().strip_prefix("http://").unwrap();
    let mut stream = TcpStream::connect(host).unwrap();
    let head = format!("GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n{fields}\r\n");
    stream.write_all(head.as_bytes()).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    String::from_utf8_lossy(&answer).into_owned()
}
