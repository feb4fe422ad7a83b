//! What the two links cost beside what they are made of, in one run: a closed-loop round trip of a plant
//! over shared memory beside a bare iceoryx2 ping-pong, and over gRPC beside a bare tonic stream echo of
//! the same messages, each between two processes on a processor each. They take turns; whose turn it is
//! not is stopped, so that nobody polls beside the others. Prints the ratio; asserts nothing.

use std::convert::Infallible;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};
use clap::Parser;
use futures::future::BoxFuture;
use futures::stream::BoxStream;
use futures::{FutureExt as _, StreamExt as _};
use hdrhistogram::Histogram;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use plantd_client::link::{LinkDriver, LinkOptions, Wait};
use plantd_client::{Client, Driver, v1};
use plantd_proto::link::Header;
use plantd_server::core::priority::allow_cpus;
use plantd_server::wire::message::states::{clocks, plant_state};
use plantd_tests::links::{ChildProcess, PLANT, new_plant};
use plantd_tests::server::{ServerProcess, binary};
use rustix::process::{Pid, Signal, kill_process};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::body::Body;
use tonic::codegen::{Service, http};
use tonic::server::{Grpc, NamedService, StreamingService};
use tonic::{Request, Response, Status, Streaming};
use tonic_prost::ProstCodec;

/// Measures the round trips of both links beside bare ones.
#[derive(Parser)]
struct Arguments {
    /// Built-in model.
    #[arg(long, default_value = "pendulum")]
    model: String,
    /// Round trips in a turn.
    #[arg(long, default_value_t = 1_000)]
    steps: u64,
    /// Turns.
    #[arg(long, default_value_t = 40, value_parser = clap::value_parser!(u32).range(1..))]
    turns: u32,
    /// Serves as the other end of a bare link: `iceoryx` or `grpc`.
    #[arg(long, hide = true)]
    echo: Option<String>,
    /// Where the other end finds what it needs.
    #[arg(long, hide = true)]
    at: Option<PathBuf>,
}

type Times = Histogram<u64>;

/// Largest time that is told from longer ones, ns.
const LONGEST_NS: u64 = 10_000_000_000;
/// Longest wait for the other end.
const PATIENCE: Duration = Duration::from_secs(30);
/// First round trips of a turn, which are not counted.
const WARM_UP: u64 = 500;

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    match arguments.echo.as_deref() {
        Some("iceoryx") => echo_iceoryx(arguments.at.as_deref().context("no path")?),
        Some("grpc") => {
            let at = arguments.at.as_deref().context("no path")?;
            runtime.block_on(serve_echo(at, &arguments.model))
        }
        Some(other) => anyhow::bail!("no echo `{other}`"),
        None => runtime.block_on(measure(&arguments)),
    }
}

async fn measure(arguments: &Arguments) -> Result<()> {
    let [mut alone, mut ping_pong, mut over_link, mut bare_stream, mut over_grpc] = [
        Row::new("step in process")?,
        Row::new("bare iceoryx2 ping-pong")?,
        Row::new("plant over shared memory")?,
        Row::new("bare tonic stream echo")?,
        Row::new("plant over gRPC")?,
    ];
    let directory = tempfile::Builder::new().prefix("plantd-").tempdir()?;
    // Built, if need be, with all processors. The others inherit the last one; this process takes the first.
    binary("plantd")?;
    let processors = std::thread::available_parallelism()?.get();
    allow_cpus(&[processors - 1]);
    let mut bare = BareIceoryx::start(&arguments.model)?;
    suspend(bare.other.pid())?;
    let mut link = SharedMemory::start(&directory.path().join("link"), &arguments.model)?;
    suspend(link.host.pid())?;
    let mut echo = BareGrpc::start(&directory.path().join("echo.sock"), &arguments.model).await?;
    suspend(echo.other.pid())?;
    let mut grpc = PlantOverGrpc::start(&arguments.model).await?;
    suspend(grpc.server.pid())?;
    allow_cpus(&[0]);
    let mut plant = new_plant(&arguments.model)?;
    let mut u = vec![0.0; plant.model().dimensions().input()];
    plant.hold_input(&mut u);
    let round_trips = 0..WARM_UP + arguments.steps;
    for _ in 0..arguments.turns {
        for k in round_trips.clone() {
            let started = Instant::now();
            plant.step(&u)?;
            alone.count(k, started)?;
        }
        resume(bare.other.pid())?;
        for k in round_trips.clone() {
            let started = Instant::now();
            bare.round_trip(&u)?;
            ping_pong.count(k, started)?;
        }
        suspend(bare.other.pid())?;
        resume(link.host.pid())?;
        for k in round_trips.clone() {
            let started = Instant::now();
            link.driver.step(&u)?;
            over_link.count(k, started)?;
        }
        suspend(link.host.pid())?;
        resume(echo.other.pid())?;
        for k in round_trips.clone() {
            let started = Instant::now();
            echo.round_trip(&u).await?;
            bare_stream.count(k, started)?;
        }
        suspend(echo.other.pid())?;
        resume(grpc.server.pid())?;
        for k in round_trips.clone() {
            let started = Instant::now();
            grpc.driver.step(&u).await?;
            over_grpc.count(k, started)?;
        }
        suspend(grpc.server.pid())?;
        for row in [&mut alone, &mut ping_pong, &mut over_link, &mut bare_stream, &mut over_grpc] {
            row.end_turn()?;
        }
    }
    for pid in [link.host.pid(), grpc.server.pid()] {
        resume(pid)?;
    }
    println!(
        "{}, {} turns of {} round trips, us",
        arguments.model, arguments.turns, arguments.steps
    );
    println!("{:28} {:>8} {:>8} {:>8}", "", "p50", "p99", "p99.9");
    for row in [&alone, &ping_pong, &over_link, &bare_stream, &over_grpc] {
        row.print();
    }
    println!("a turn's median over those of the bare link and the step: median, and quartiles");
    print_ratio("shared memory", &over_link, &ping_pong, &alone);
    print_ratio("gRPC", &over_grpc, &bare_stream, &alone);
    link.finish()
}

/// What is measured, turn by turn.
struct Row {
    name: &'static str,
    all: Times,
    turn: Times,
    /// Of each turn, ns.
    medians: Vec<f64>,
}

impl Row {
    fn new(name: &'static str) -> Result<Self> {
        let times = Times::new_with_max(LONGEST_NS, 3)?;
        Ok(Self { name, all: times.clone(), turn: times, medians: Vec::new() })
    }

    /// Counts a round trip that began then, unless it is one of the first of a turn.
    fn count(&mut self, k: u64, started: Instant) -> Result<()> {
        if k >= WARM_UP {
            self.turn.record(started.elapsed().as_nanos() as u64)?;
        }
        Ok(())
    }

    fn end_turn(&mut self) -> Result<()> {
        self.medians.push(self.turn.value_at_quantile(0.5) as f64);
        self.all.add(&self.turn)?;
        self.turn.reset();
        Ok(())
    }

    fn print(&self) {
        let us = |quantile| self.all.value_at_quantile(quantile) as f64 * 1e-3;
        println!("{:28} {:8.2} {:8.2} {:8.2}", self.name, us(0.5), us(0.99), us(0.999));
    }
}

/// The machine is faster in some turns than in others: ratios are those within a turn.
fn print_ratio(name: &str, plant: &Row, bare: &Row, step: &Row) {
    let bare_and_step = bare.medians.iter().zip(&step.medians).map(|(bare, step)| bare + step);
    let mut ratios: Vec<f64> =
        plant.medians.iter().zip(bare_and_step).map(|(a, b)| a / b).collect();
    ratios.sort_by(f64::total_cmp);
    let at = |quarter: usize| ratios[(ratios.len() - 1) * quarter / 4];
    println!("{name:28} {:8.2} {:8.2} {:8.2}", at(2), at(1), at(3));
}

fn suspend(pid: u32) -> Result<()> {
    signal(pid, Signal::STOP)
}

fn resume(pid: u32) -> Result<()> {
    signal(pid, Signal::CONT)
}

fn signal(pid: u32, signal: Signal) -> Result<()> {
    let pid = Pid::from_raw(pid.cast_signed()).context("a process has a number")?;
    Ok(kill_process(pid, signal)?)
}

/// A process that ends with its value.
struct Other(Child);

impl Other {
    fn start(echo: &str, at: &Path, model: &str) -> Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        Ok(Self(command.args(["--model", model, "--echo", echo, "--at"]).arg(at).spawn()?))
    }

    fn pid(&self) -> u32 {
        self.0.id()
    }
}

impl Drop for Other {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The plant's link, polling on both sides.
struct SharedMemory {
    driver: LinkDriver,
    host: ChildProcess,
}

impl SharedMemory {
    fn start(root: &Path, model: &str) -> Result<Self> {
        let program = std::env::current_exe()?.with_file_name("link_host");
        let mut host = ChildProcess::start(&program, root, &["--model", model, "--poll"])?;
        host.wait_for_line("open")?;
        let options =
            LinkOptions { root: root.to_owned(), wait: Wait::Poll, ..LinkOptions::default() };
        Ok(Self { driver: LinkDriver::connect(PLANT, options)?, host })
    }

    fn finish(mut self) -> Result<()> {
        drop(self.driver);
        anyhow::ensure!(self.host.finish()?, "the host failed");
        Ok(())
    }
}

/// Publish and subscribe of slices with a header of the link's size, polled, without anything else.
struct BareIceoryx {
    ends: Ends,
    answer_len: usize,
    /// The last answer.
    state: Vec<f64>,
    other: Other,
}

/// The ports of one end.
struct Ends {
    publisher: Publisher<ipc::Service, [f64], Header>,
    subscriber: Subscriber<ipc::Service, [f64], Header>,
    _node: Node<ipc::Service>,
}

impl Ends {
    /// Of the two services of a name, sends to `out` and receives from `back`.
    fn new(name: &str, out: &str, back: &str) -> Result<Self> {
        let node = NodeBuilder::new().create::<ipc::Service>()?;
        let service = |direction: &str| -> Result<_> {
            let name = ServiceName::new(&format!("{name}/{direction}"))?;
            Ok(node
                .service_builder(&name)
                .publish_subscribe::<[f64]>()
                .user_header::<Header>()
                .enable_safe_overflow(true)
                .subscriber_max_buffer_size(2)
                .open_or_create()?)
        };
        let (out, back) = (service(out)?, service(back)?);
        let subscriber = back.subscriber_builder().create()?;
        let publisher = out.publisher_builder().initial_max_slice_len(512).create()?;
        Ok(Self { publisher, subscriber, _node: node })
    }

    fn send(&self, payload: &[f64]) -> Result<()> {
        let mut sample = self.publisher.loan_slice(payload.len())?;
        sample.payload_mut().copy_from_slice(payload);
        sample.send()?;
        Ok(())
    }
}

impl BareIceoryx {
    fn start(model: &str) -> Result<Self> {
        let name = format!("plantd-overhead-{}", std::process::id());
        let ends = Ends::new(&name, "ping", "pong")?;
        let other = Other::start("iceoryx", Path::new(&name), model)?;
        let d = new_plant(model)?.model().dimensions();
        let mut bare =
            Self { ends, answer_len: d.state() + d.constraints, state: Vec::new(), other };
        // Until the other end is there.
        let deadline = Instant::now() + PATIENCE;
        while bare.ends.subscriber.receive()?.is_none() {
            anyhow::ensure!(Instant::now() < deadline, "the other end does not answer");
            bare.ends.send(&[bare.answer_len as f64])?;
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(Duration::from_millis(10));
        while bare.ends.subscriber.receive()?.is_some() {}
        bare.round_trip(&[0.0])?;
        Ok(bare)
    }

    /// As many numbers one way as an input has, as many back as a state has, which are read.
    fn round_trip(&mut self, u: &[f64]) -> Result<()> {
        let mut message = [0.0; 64];
        message[0] = self.answer_len as f64;
        self.ends.send(&message[..u.len().clamp(1, 64)])?;
        let answer = loop {
            match self.ends.subscriber.receive()? {
                Some(answer) => break answer,
                None => std::hint::spin_loop(),
            }
        };
        self.state.clear();
        self.state.extend_from_slice(answer.payload());
        Ok(())
    }
}

/// The other end: answers with as many numbers as the first one says. Is killed.
fn echo_iceoryx(name: &Path) -> Result<()> {
    let name = name.to_str().context("a name in UTF-8")?;
    let ends = Ends::new(name, "pong", "ping")?;
    let answer = [0.0; 512];
    loop {
        if let Some(message) = ends.subscriber.receive()? {
            let len = message.payload().first().copied().unwrap_or(0.0) as usize;
            ends.send(&answer[..len.min(512)])?;
        } else {
            std::hint::spin_loop();
        }
    }
}

/// A driver of a plant of a real server.
struct PlantOverGrpc {
    driver: Driver,
    server: ServerProcess,
}

impl PlantOverGrpc {
    async fn start(model: &str) -> Result<Self> {
        let server = ServerProcess::start()?;
        let client = Client::connect(server.unix_address()).await?;
        let request = v1::CreatePlantRequest { model: model.to_owned(), ..Default::default() };
        let id = client.create_plant(request).await?.id;
        Ok(Self { driver: client.drive(id).await?, server })
    }
}

/// A bidirectional stream of the same messages to a server that only sends back.
struct BareGrpc {
    requests: mpsc::Sender<v1::DriveRequest>,
    answers: Streaming<v1::DriveResponse>,
    other: Other,
}

impl BareGrpc {
    async fn start(socket: &Path, model: &str) -> Result<Self> {
        let other = Other::start("grpc", socket, model)?;
        let deadline = Instant::now() + PATIENCE;
        while !socket.exists() {
            anyhow::ensure!(Instant::now() < deadline, "the other end does not listen");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        let address = format!("unix:{}", socket.display());
        let channel = Client::connect(address).await?.channel();
        let (requests, queue) = mpsc::channel(1);
        let mut client = tonic::client::Grpc::new(channel);
        client.ready().await?;
        let path = http::uri::PathAndQuery::from_static("/echo.EchoService/Echo");
        let codec = ProstCodec::<v1::DriveRequest, v1::DriveResponse>::default();
        let request = Request::new(ReceiverStream::new(queue));
        let answers = client.streaming(request, path, codec).await?.into_inner();
        Ok(Self { requests, answers, other })
    }

    async fn round_trip(&mut self, u: &[f64]) -> Result<()> {
        let input = v1::DriveInput { sequence: 1, u: u.to_vec(), answers_ns: 1 };
        let request = v1::drive_request::Request::Input(input);
        self.requests.send(v1::DriveRequest { request: Some(request) }).await?;
        self.answers.message().await?.context("the echo has ended")?;
        Ok(())
    }
}

/// The other end: answers each input with a step that is not taken. Is killed.
async fn serve_echo(socket: &Path, model: &str) -> Result<()> {
    let mut plant = new_plant(model)?;
    let report = v1::StepReport { iterations: 2, residual: 0.5, ..Default::default() };
    let step = v1::DriveStep {
        sequence: 1,
        state: Some(plant_state(&mut plant)),
        report: Some(report),
        clocks: Some(clocks(0.1, 1 << 50)),
        ..Default::default()
    };
    let response = v1::drive_response::Response::Step(step);
    let answer = v1::DriveResponse { response: Some(response) };
    let listener = tokio::net::UnixListener::bind(socket)?;
    let incoming = tokio_stream::wrappers::UnixListenerStream::new(listener);
    tonic::transport::Server::builder()
        .add_service(EchoService(answer))
        .serve_with_incoming(incoming)
        .await?;
    Ok(())
}

/// Echoes this answer.
#[derive(Clone)]
struct EchoService(v1::DriveResponse);

impl NamedService for EchoService {
    const NAME: &'static str = "echo.EchoService";
}

impl Service<http::Request<Body>> for EchoService {
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<'static, Result<Self::Response, Infallible>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        let answer = self.0.clone();
        async move {
            let codec = ProstCodec::<v1::DriveResponse, v1::DriveRequest>::default();
            Ok(Grpc::new(codec).streaming(Echo(answer), request).await)
        }
        .boxed()
    }
}

struct Echo(v1::DriveResponse);

impl StreamingService<v1::DriveRequest> for Echo {
    type Response = v1::DriveResponse;
    type ResponseStream = BoxStream<'static, Result<v1::DriveResponse, Status>>;
    type Future = BoxFuture<'static, Result<Response<Self::ResponseStream>, Status>>;

    fn call(&mut self, request: Request<Streaming<v1::DriveRequest>>) -> Self::Future {
        let answer = self.0.clone();
        let answers = request.into_inner().map(move |input| input.map(|_| answer.clone()));
        async move { Ok(Response::new(answers.boxed())) }.boxed()
    }
}
