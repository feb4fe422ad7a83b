//! HTTP/2 by the frame: floods of what costs the sender little, and connections that leave work undone. While they go
//! on, a client's calls are answered and a plant keeps its pace; the offender is ended or held up; and what it took
//! comes back.

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{Shutdown, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

use plantd_client::{Client, v1};
use plantd_tests::server::ServerProcess;

/// What may stay with the process, KiB.
const KEPT_KIB: u64 = 32 << 10;
/// What may be taken while it lasts, KiB.
const TAKEN_KIB: u64 = 128 << 10;
/// Steps of the paced plant for which a flood lasts, at a thousand a second.
const STEPS: u64 = 1000;
/// Connections that flood at a time.
const OFFENDERS: usize = 2;

const DATA: u8 = 0;
const HEADERS: u8 = 1;
const PRIORITY: u8 = 2;
const RST_STREAM: u8 = 3;
const SETTINGS: u8 = 4;
const PING: u8 = 6;
const GOAWAY: u8 = 7;
const WINDOW_UPDATE: u8 = 8;
const CONTINUATION: u8 = 9;

const END_STREAM: u8 = 1;
const END_HEADERS: u8 = 4;

fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let length = u32::try_from(payload.len()).unwrap().to_be_bytes();
    [&length[1..], &[kind, flags], &stream.to_be_bytes(), payload].concat()
}

/// Header fields of a call, as literals without compression.
fn call(path: &str) -> Vec<u8> {
    let text = |value: &str| [&[u8::try_from(value.len()).unwrap()], value.as_bytes()].concat();
    [
        // POST, http.
        &[0x83, 0x86, 0x04][..],
        &text(path),
        &[0x01],
        &text("localhost"),
        &[0x0f, 0x10],
        &text("application/grpc"),
        &[0x00],
        &text("te"),
        &text("trailers"),
    ]
    .concat()
}

const GET_MODEL: &str = "/plantd.v1.ModelService/GetModel";
/// GetModelRequest { name: "pendulum" } with its head.
const PENDULUM: &[u8] = b"\0\0\0\0\x0a\x0a\x08pendulum";
const WATCH: &str = "/plantd.v1.PlantService/Watch";
/// WatchRequest { id: "paced" } with its head.
const PACED: &[u8] = b"\0\0\0\0\x07\x0a\x05paced";

/// Number of a client's nth stream.
fn stream(n: u64) -> u32 {
    u32::try_from(n % (1 << 30)).unwrap() * 2 + 1
}

/// A connection that speaks HTTP/2, and has said how much it takes.
fn connect(server: &ServerProcess, window: u32) -> std::io::Result<TcpStream> {
    let host = server.address().strip_prefix("http://").unwrap();
    let mut connection = TcpStream::connect(host)?;
    connection.set_write_timeout(Some(Duration::from_millis(500)))?;
    connection.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n")?;
    let window = [&[0, 4][..], &window.to_be_bytes()].concat();
    connection.write_all(&frame(SETTINGS, 0, 0, &window))?;
    Ok(connection)
}

/// A way to be a nuisance.
struct Flood {
    name: &'static str,
    /// What is sent first.
    first: fn() -> Vec<u8>,
    /// What is sent then, over and over, by its number.
    then: fn(u64) -> Vec<u8>,
    /// Whether answers are read.
    reads: bool,
}

/// What became of the offenders.
#[derive(Debug, Default)]
struct Count {
    frames: AtomicU64,
    /// Connections that the server ended.
    ended: AtomicU64,
    /// Of these, with this code of HTTP/2.
    calm: AtomicU64,
    /// Connections of which the server read no more.
    held_up: AtomicU64,
}

/// ENHANCE_YOUR_CALM.
const CALM: u32 = 11;

/// Reads until the end; whether the server said why with this code.
fn reads_goaway(mut connection: TcpStream) -> Option<u32> {
    let mut code = None;
    loop {
        let mut head = [0; 9];
        if connection.read_exact(&mut head).is_err() {
            return code;
        }
        let mut payload =
            vec![0; usize::from(head[0]) << 16 | usize::from(head[1]) << 8 | usize::from(head[2])];
        if connection.read_exact(&mut payload).is_err() {
            return code;
        }
        if head[3] == GOAWAY && payload.len() >= 8 {
            code = Some(u32::from_be_bytes(payload[4..8].try_into().unwrap()));
        }
    }
}

/// One connection after the other, until the end.
fn offend(server: &ServerProcess, flood: &Flood, is_over: &AtomicBool, count: &Count) {
    while !is_over.load(Ordering::Relaxed) {
        let Ok(mut connection) = connect(server, 65_535) else { continue };
        let reader = flood.reads.then(|| {
            let reader = connection.try_clone().unwrap();
            thread::spawn(move || reads_goaway(reader))
        });
        let mut next = 0;
        let mut batch = (flood.first)();
        let ended = loop {
            if is_over.load(Ordering::Relaxed) {
                break false;
            }
            match connection.write_all(&batch) {
                Ok(()) => {}
                Err(error)
                    if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) =>
                {
                    count.held_up.fetch_add(1, Ordering::Relaxed);
                    break false;
                }
                Err(_) => break true,
            }
            batch.clear();
            while batch.len() < 4096 {
                batch.extend((flood.then)(next));
                next += 1;
                count.frames.fetch_add(1, Ordering::Relaxed);
            }
        };
        count.ended.fetch_add(u64::from(ended), Ordering::Relaxed);
        let _ = connection.shutdown(Shutdown::Write);
        if !ended {
            let _ = connection.shutdown(Shutdown::Both);
        }
        if reader.is_some_and(|reader| reader.join().unwrap() == Some(CALM)) {
            count.calm.fetch_add(1, Ordering::Relaxed);
        }
    }
}

async fn soon<T>(work: impl Future<Output = T>) -> T {
    tokio::time::timeout(Duration::from_secs(60), work).await.expect("an answer within 60 s")
}

/// A server with a plant that keeps its pace, and a client with one in lockstep.
struct Bench {
    server: Arc<ServerProcess>,
    client: Client,
}

impl Bench {
    async fn new() -> Self {
        let server = Arc::new(ServerProcess::start().unwrap());
        let client = server.client().await;
        for id in ["paced", "driven"] {
            let settings = v1::PlantSettings { time_step_s: 1e-3, ..Default::default() };
            let request = v1::CreatePlantRequest {
                id: id.to_owned(),
                model: "pendulum".to_owned(),
                settings: Some(settings),
                ..Default::default()
            };
            client.create_plant(request).await.unwrap();
        }
        let settings = v1::RunSettings { pace: v1::Pace::Paced.into(), ..Default::default() };
        let id = "paced".to_owned();
        let run = v1::RunRequest { id, settings: Some(settings), ..Default::default() };
        client.run(run).await.unwrap();
        Self { server, client }
    }

    /// Drives until the paced plant has gone on for so long; what it missed meanwhile.
    async fn live_on(&self, what: &str) -> (u64, u64) {
        self.client.timing("paced", true).await.unwrap();
        let mut driver = soon(self.client.drive("driven")).await.unwrap();
        loop {
            for _ in 0..20 {
                soon(driver.step(&[0.1])).await.expect(what);
            }
            let timing = soon(self.client.timing("paced", false)).await.expect(what);
            if timing.steps >= STEPS {
                // The next one is sure to be let in.
                soon(driver.close()).await.expect(what);
                return (timing.overruns, timing.slips);
            }
        }
    }

    /// Waits until memory is back where it was.
    async fn memory_returns(&self, before: u64, what: &str) -> u64 {
        for _ in 0..600 {
            let now = self.server.resident_kib();
            if now <= before + KEPT_KIB {
                return now;
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        panic!("{what}: {} KiB before, {} KiB after", before, self.server.resident_kib());
    }
}

fn open_watch() -> Vec<u8> {
    [frame(HEADERS, END_HEADERS, 1, &call(WATCH)), frame(DATA, 0, 1, PACED)].concat()
}

const FLOODS: [Flood; 12] = [
    Flood {
        name: "rapid reset",
        first: Vec::new,
        then: |n| {
            let mut frames = frame(HEADERS, END_HEADERS, stream(n), &call(GET_MODEL));
            frames.extend(frame(RST_STREAM, 0, stream(n), &8_u32.to_be_bytes()));
            frames
        },
        reads: true,
    },
    Flood {
        name: "rapid reset of whole calls",
        first: Vec::new,
        then: |n| {
            let mut frames = frame(HEADERS, END_HEADERS, stream(n), &call(GET_MODEL));
            frames.extend(frame(DATA, END_STREAM, stream(n), PENDULUM));
            frames.extend(frame(RST_STREAM, 0, stream(n), &8_u32.to_be_bytes()));
            frames
        },
        reads: true,
    },
    Flood {
        name: "windows that make the server reset",
        first: Vec::new,
        then: |n| {
            let mut frames = frame(HEADERS, END_HEADERS, stream(n), &call(GET_MODEL));
            frames.extend(frame(WINDOW_UPDATE, 0, stream(n), &0_u32.to_be_bytes()));
            frames
        },
        reads: true,
    },
    Flood { name: "pings", first: Vec::new, then: |_| frame(PING, 0, 0, b"plantd?!"), reads: true },
    Flood {
        name: "pings whose answers nobody reads",
        first: Vec::new,
        then: |_| frame(PING, 0, 0, b"plantd?!"),
        reads: false,
    },
    Flood { name: "settings", first: Vec::new, then: |_| frame(SETTINGS, 0, 0, &[]), reads: true },
    Flood {
        name: "settings whose answers nobody reads",
        first: Vec::new,
        then: |_| frame(SETTINGS, 0, 0, &[]),
        reads: false,
    },
    Flood {
        name: "headers without end",
        first: || frame(HEADERS, 0, 1, &call(GET_MODEL)),
        then: |_| frame(CONTINUATION, 0, 1, &[&[0x00, 1, b'x', 120][..], &[b'y'; 120]].concat()),
        reads: true,
    },
    Flood {
        name: "empty headers without end",
        first: || frame(HEADERS, 0, 1, &call(GET_MODEL)),
        then: |_| frame(CONTINUATION, 0, 1, &[]),
        reads: true,
    },
    Flood {
        name: "empty data after a request",
        first: open_watch,
        then: |_| frame(DATA, 0, 1, &[]),
        reads: true,
    },
    Flood {
        name: "priorities",
        first: Vec::new,
        then: |n| frame(PRIORITY, 0, stream(n), &[0, 0, 0, 0, 1]),
        reads: true,
    },
    Flood {
        name: "frames that nobody knows",
        first: Vec::new,
        then: |_| frame(0x4f, 0, 0, &[0; 64]),
        reads: true,
    },
];

#[tokio::test(flavor = "multi_thread")]
async fn floods_of_frames_cost_others_nothing_and_leave_nothing() {
    let bench = Bench::new().await;
    let alone = bench.live_on("alone").await;
    println!("alone: overruns and slips {alone:?} in {STEPS} steps");
    for flood in &FLOODS {
        let before = bench.server.resident_kib();
        let (is_over, count) = (Arc::new(AtomicBool::new(false)), Arc::new(Count::default()));
        let offenders = (0..OFFENDERS).map(|_| {
            let (server, is_over, count) =
                (Arc::clone(&bench.server), Arc::clone(&is_over), Arc::clone(&count));
            thread::spawn(move || offend(&server, flood, &is_over, &count))
        });
        let offenders: Vec<_> = offenders.collect();
        let missed = bench.live_on(flood.name).await;
        let during = bench.server.resident_kib();
        is_over.store(true, Ordering::Relaxed);
        for offender in offenders {
            tokio::task::spawn_blocking(|| offender.join().unwrap()).await.unwrap();
        }
        let after = bench.memory_returns(before, flood.name).await;
        println!(
            "{}: overruns and slips {missed:?}; KiB {before} before, {during} during, {after} after; {count:?}",
            flood.name
        );
        assert!(count.frames.load(Ordering::Relaxed) > 1000, "{}: {count:?}", flood.name);
        let grown = during.saturating_sub(before);
        assert!(grown < TAKEN_KIB, "{}: {grown} KiB more, {count:?}", flood.name);
    }
}

/// What is sent on a connection that then leaves its work undone, and how much of its answers it takes.
struct Idler {
    name: &'static str,
    first: fn() -> Vec<u8>,
    window: u32,
    /// Connections of this kind.
    count: usize,
}

/// Calls on this many streams, each with these bytes of a message.
fn calls(count: u64, path: &str, message: &[u8], flags: u8) -> Vec<u8> {
    let one = |n| {
        let head = frame(HEADERS, END_HEADERS, stream(n), &call(path));
        [head, frame(DATA, flags, stream(n), message)].concat()
    };
    (0..count).flat_map(one).collect()
}

const IDLERS: [Idler; 5] = [
    Idler { name: "half-open connections", first: Vec::new, window: 65_535, count: 400 },
    Idler {
        name: "answers that nobody reads",
        first: || calls(200, GET_MODEL, PENDULUM, END_STREAM),
        window: 0,
        count: 40,
    },
    Idler { name: "watchers that read nothing", first: open_watch, window: 0, count: 40 },
    Idler {
        name: "messages that stay unfinished",
        first: || calls(200, GET_MODEL, &PENDULUM[..7], 0),
        window: 65_535,
        count: 40,
    },
    Idler {
        name: "calls without a message",
        first: || calls(200, GET_MODEL, &[], 0),
        window: 65_535,
        count: 40,
    },
];

#[tokio::test(flavor = "multi_thread")]
async fn work_left_undone_costs_others_nothing_and_leaves_nothing() {
    let bench = Bench::new().await;
    for idler in &IDLERS {
        let before = bench.server.resident_kib();
        let connections: Vec<_> = (0..idler.count)
            .map(|_| {
                let mut connection = connect(&bench.server, idler.window).unwrap();
                // The server may have had enough already.
                let _ = connection.write_all(&(idler.first)());
                connection
            })
            .collect();
        let missed = bench.live_on(idler.name).await;
        let during = bench.server.resident_kib();
        drop(connections);
        let after = bench.memory_returns(before, idler.name).await;
        println!(
            "{} of {}: overruns and slips {missed:?}; KiB {before} before, {during} during, {after} after",
            idler.count, idler.name
        );
        let grown = during.saturating_sub(before);
        assert!(grown < TAKEN_KIB, "{}: {grown} KiB more", idler.name);
    }
}
