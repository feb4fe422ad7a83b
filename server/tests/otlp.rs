//! Traces reach a collector over OTLP: a span for each call and each computation, under the caller's, and none for
//! steps.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{
    TraceService, TraceServiceServer,
};
use opentelemetry_proto::tonic::collector::trace::v1::{
    ExportTraceServiceRequest, ExportTraceServiceResponse,
};
use opentelemetry_proto::tonic::trace::v1::Span;
use plantd_proto::v1;
use tokio::net::TcpListener;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio_stream::wrappers::TcpListenerStream;
use tonic::transport::Channel;
use tonic::{Request, Response, Status};
use v1::plant_service_client::PlantServiceClient;

/// Hands on the spans that come.
struct Collector(UnboundedSender<Span>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        let scopes = request.into_inner().resource_spans.into_iter().flat_map(|r| r.scope_spans);
        for span in scopes.flat_map(|scope| scope.spans) {
            let _ = self.0.send(span);
        }
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

/// A collector on this machine: its address, and what reaches it.
async fn collector() -> (String, UnboundedReceiver<Span>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = format!("http://{}", listener.local_addr().unwrap());
    let (sender, spans) = unbounded_channel();
    let service = TraceServiceServer::new(Collector(sender));
    let router = tonic::transport::Server::builder().add_service(service);
    tokio::spawn(router.serve_with_incoming(TcpListenerStream::new(listener)));
    (address, spans)
}

/// A server that is ended when this is dropped.
struct Server(Child);

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

async fn start(folder: &Path, collector: &str) -> (Server, String) {
    let (configuration, ready) = (folder.join("plantd.toml"), folder.join("ready.json"));
    std::fs::write(&configuration, format!("[telemetry]\notlp = \"{collector}\"\n")).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_plantd"));
    command.args(["serve", "--grpc", "127.0.0.1:0", "--link", "off", "--config"]);
    command.arg(configuration).arg("--ready-file").arg(&ready);
    // What has spans sends them every so often.
    command.env("OTEL_BSP_SCHEDULE_DELAY", "50");
    let server = Server(command.stdout(Stdio::null()).spawn().unwrap());
    let address = async {
        loop {
            if let Ok(text) = std::fs::read_to_string(&ready) {
                let addresses: serde_json::Value = serde_json::from_str(&text).unwrap();
                break addresses["grpc"].as_str().unwrap().to_owned();
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    let address = tokio::time::timeout(Duration::from_secs(30), address).await.unwrap();
    (server, address)
}

async fn next(spans: &mut UnboundedReceiver<Span>) -> Span {
    let span = tokio::time::timeout(Duration::from_secs(30), spans.recv()).await;
    span.expect("a span within 30 s").expect("the collector goes on")
}

#[tokio::test(flavor = "multi_thread")]
async fn calls_and_computations_are_spans_and_steps_are_not() {
    const TRACE: &str = "0af7651916cd43dd8448eb211c80319c";
    const PARENT: &str = "b7ad6b7169203331";
    let (address, mut spans) = collector().await;
    let folder = tempfile::tempdir().unwrap();
    let (_server, address) = start(folder.path(), &address).await;
    let channel = Channel::from_shared(address).unwrap().connect().await.unwrap();
    let mut plants = PlantServiceClient::new(channel);
    let model = "pendulum".to_owned();
    let request = v1::CreatePlantRequest { id: "p".to_owned(), model, ..Default::default() };
    plants.create_plant(request).await.unwrap();
    let mut step =
        Request::new(v1::StepRequest { id: "p".to_owned(), hold: 1000, ..Default::default() });
    let traceparent = format!("00-{TRACE}-{PARENT}-01").parse().unwrap();
    step.metadata_mut().insert("traceparent", traceparent);
    plants.step(step).await.unwrap();

    let hex = |bytes: &[u8]| bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
    let mut seen = Vec::new();
    while !seen.iter().any(|span: &Span| span.name == "/plantd.v1.PlantService/Step") {
        seen.push(next(&mut spans).await);
    }
    let call = seen.last().unwrap();
    assert_eq!((hex(&call.trace_id), hex(&call.parent_span_id)), (TRACE.into(), PARENT.into()));
    assert!(call.attributes.iter().any(|attribute| attribute.key == "rpc.code"), "{call:?}");
    // Its computation ended before it and lies under it.
    let jobs = seen.iter().filter(|span| span.name == "job" && span.trace_id == call.trace_id);
    let jobs: Vec<_> = jobs.collect();
    assert!(jobs.iter().all(|job| job.parent_span_id == call.span_id), "{jobs:?}");
    let creation = seen.iter().find(|span| span.name.ends_with("/CreatePlant")).unwrap();
    assert!(creation.parent_span_id.is_empty() && creation.trace_id != call.trace_id);
    let made = seen.iter().filter(|span| span.name == "job");
    assert!(made.clone().any(|job| job.parent_span_id == creation.span_id), "{seen:?}");
    assert!(seen.len() < 20, "{} spans for a thousand steps", seen.len());
}
