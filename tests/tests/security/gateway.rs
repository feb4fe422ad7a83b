//! A gateway in front: whom it speaks for, for how long, and who is none.

use std::time::{Duration, SystemTime};

use plantd_client::{Code, Error, v1};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};
use tonic::{Request, Status};
use v1::plant_service_client::PlantServiceClient;

use crate::support::*;

/// Adds headers to each call.
#[derive(Clone)]
struct Says(Vec<(&'static str, String)>);

impl Interceptor for Says {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        for (header, value) in &self.0 {
            request.metadata_mut().append(*header, value.parse().unwrap());
        }
        Ok(request)
    }
}

type Caller = PlantServiceClient<InterceptedService<Channel, Says>>;

/// Somebody of whom these headers speak.
fn caller(channel: &Channel, headers: &[(&'static str, &str)]) -> Caller {
    let headers = headers.iter().map(|(header, value)| (*header, (*value).to_owned()));
    PlantServiceClient::with_interceptor(channel.clone(), Says(headers.collect()))
}

/// A connection over which a certificate of the lab was shown.
async fn channel(lab: &Lab, address: &str, name: &str) -> Channel {
    let read = |file: String| std::fs::read(lab.path(&file)).unwrap();
    let identity = Identity::from_pem(read(format!("{name}.pem")), read(format!("{name}.key")));
    let ca = Certificate::from_pem(read("ca.pem".to_owned()));
    let tls = ClientTlsConfig::new().ca_certificate(ca).identity(identity);
    let endpoint = Endpoint::from_shared(address.to_owned()).unwrap().tls_config(tls).unwrap();
    endpoint.connect().await.unwrap()
}

async fn create(caller: &mut Caller, id: &str) -> Result<(), Error> {
    let (id, model) = (id.to_owned(), "pendulum".to_owned());
    let request = v1::CreatePlantRequest { id, model, ..Default::default() };
    Ok(caller.create_plant(request).await.map(drop)?)
}

async fn step(caller: &mut Caller, id: &str) -> Result<(), Error> {
    let request = v1::StepRequest { id: id.to_owned(), hold: 1, ..Default::default() };
    Ok(caller.step(request).await.map(drop)?)
}

/// Watches until that is ended by the server.
async fn watch(caller: &mut Caller, id: &str) -> Result<(), Error> {
    let mut states = caller.watch(watch_request(id)).await?.into_inner();
    soon(async {
        while states.message().await?.is_some() {}
        Ok(())
    })
    .await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_gateway_speaks_for_its_callers() {
    let lab = Lab::new();
    lab.write_pair("gateway", &lab.authority.issue("gateway", &[]));
    let rule = "[[certificates]]\nsubject = \"gateway\"\nrole = \"driver\"\n";
    let rules = lab.write("rules.toml", &format!("{rule}gateway = true\n"));
    let client_ca = lab.path("ca.pem");
    let tls = lab.tls(&format!("client = \"required\"\nclient_ca = \"{}\"", client_ca.display()));
    let server = lab.start(&format!("{tls}[auth]\nrules = \"{}\"\n", rules.display()));
    let channel = channel(&lab, server.address(), "gateway").await;

    let mut anna = caller(&channel, &[("plantd-user", "anna"), ("plantd-tenant", "lab")]);
    create(&mut anna, "p1").await.unwrap();
    step(&mut anna, "p1").await.unwrap();
    // Those of one connection are kept apart.
    let other = [("plantd-user", "bert"), ("plantd-tenant", "other"), ("plantd-role", "admin")];
    let mut bert = caller(&channel, &other);
    assert_refused(step(&mut bert, "p1").await, Code::NotFound, "PLANT_NOT_FOUND");
    let viewer = [("plantd-user", "vera"), ("plantd-tenant", "lab"), ("plantd-role", "viewer")];
    let mut vera = caller(&channel, &viewer);
    assert_refused(step(&mut vera, "p1").await, Code::PermissionDenied, "ROLE");
    let mut nobody = caller(&channel, &[]);
    assert_refused(step(&mut nobody, "p1").await, Code::Unauthenticated, "NO_CREDENTIALS");
    let mut twice = caller(&channel, &[("plantd-user", "anna"), ("plantd-user", "bert")]);
    assert_refused(step(&mut twice, "p1").await, Code::Unauthenticated, "GATEWAY_HEADER");
    until_log_says(&server, "CreatePlant", 1).await;
    let log = server.log();
    let created = log.lines().find(|line| line.contains("CreatePlant")).unwrap();
    assert!(["anna", "lab", "OK"].iter().all(|word| created.contains(word)), "{created}");

    // Streams end with the caller's token, of which the gateway knows until when it counts.
    let expires = SystemTime::now() + Duration::from_secs(3);
    let expires = expires.duration_since(SystemTime::UNIX_EPOCH).unwrap().as_secs().to_string();
    let until = [("plantd-user", "anna"), ("plantd-tenant", "lab"), ("plantd-expires", &expires)];
    let ended = watch(&mut caller(&channel, &until), "p1").await;
    assert_refused(ended, Code::Unauthenticated, "CREDENTIALS_EXPIRED");
    step(&mut anna, "p1").await.unwrap();

    // What is no gateway any more speaks for nobody.
    let watching = {
        let mut anna = anna.clone();
        tokio::spawn(async move { watch(&mut anna, "p1").await })
    };
    lab.write("rules.toml", rule);
    let ended = soon(watching).await.unwrap();
    assert_refused(ended, Code::Unauthenticated, "CREDENTIALS_REVOKED");
    assert_refused(step(&mut anna, "p1").await, Code::NotFound, "PLANT_NOT_FOUND");
}

#[tokio::test(flavor = "multi_thread")]
async fn headers_of_others_say_nothing() {
    let lab = Lab::new();
    let uid = rustix::process::getuid().as_raw();
    let peer = format!("[[auth.peers]]\nuid = {uid}\nrole = \"driver\"\ngateway = true\n");
    let server = lab.start(&format!("{}{peer}", lab.auth()));
    let root = [("plantd-user", "root"), ("plantd-tenant", "lab"), ("plantd-role", "admin")];
    // The gateway's socket, and a port to which everybody can connect.
    let socket = Endpoint::from_shared(server.unix_address().to_owned()).unwrap();
    let mut behind = caller(&socket.connect().await.unwrap(), &root);
    create(&mut behind, "p1").await.unwrap();
    let port = Endpoint::from_shared(server.address().to_owned()).unwrap().connect().await.unwrap();
    let mut outside = caller(&port, &root);
    assert_refused(step(&mut outside, "p1").await, Code::Unauthenticated, "NO_CREDENTIALS");
    let token = format!("Bearer {}", lab.token("vera", "viewer", "lab"));
    until_log_says(&server, "tokens read", 2).await;
    let mut vera = caller(&port, &[root[0], root[2], ("authorization", &token)]);
    assert_refused(step(&mut vera, "p1").await, Code::PermissionDenied, "ROLE");
}
