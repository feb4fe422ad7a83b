//! Calls of all methods of the contract, by a server in this process.

use std::time::Duration;

use anyhow::{Context as _, Result};
use http_body_util::{BodyExt as _, Full};
use plantd_proto::FILE_DESCRIPTOR_SET;
use plantd_server::config::{Config, Listen};
use plantd_server::serve::{RunningServer, Services};
use prost::Message as _;
use prost_reflect::{DescriptorPool, MessageDescriptor};
use tokio::runtime::Runtime;
use tokio::time::timeout;
use tonic::body::Body;
use tonic::codegen::Bytes;
use tonic::codegen::http::Request;
use tower::{Service as _, ServiceExt as _};

use crate::message::random;
use crate::mutate::{Rng, mutated};
use crate::targets::{BYTES_MAX, Target, seeds};

/// Longest wait for an answer; what takes longer is cancelled by going away.
const PATIENCE: Duration = Duration::from_millis(20);
/// Answers of a stream that are read.
const ANSWERS_MAX: usize = 4;
/// Inputs after which the plants of the fuzzer are made anew.
const ROUND: u64 = 64;

/// What bounds the work of one call.
const LIMITS: [(&str, u64); 14] = [
    ("coordinates", 64),
    ("models", 30),
    ("plants", 16),
    ("running_plants", 4),
    ("steps_per_call", 2000),
    ("horizon", 200),
    ("rollout_cases", 100),
    ("trajectory_numbers", 100_000),
    ("feedback_numbers", 1_000_000),
    ("watch_numbers", 1_000_000),
    ("optimization_iterations", 20),
    ("second_order_numbers", 100_000),
    ("max_iterations", 50),
    ("recording_bytes", 10_000_000),
];

/// A server that listens nowhere.
pub(super) struct Inside {
    pub(super) runtime: Runtime,
    pub(super) server: RunningServer,
    services: Services,
    pub(super) folder: tempfile::TempDir,
}

impl Inside {
    pub(super) fn new() -> Result<Self> {
        let folder = tempfile::Builder::new().prefix("fuzz-").tempdir()?;
        let recordings = Some(folder.path().join("recordings"));
        let mut config = Config {
            grpc: Listen::Off,
            metrics: Listen::Off,
            recordings,
            workers: 2,
            ..Config::default()
        };
        config.link.enabled = false;
        for (name, value) in LIMITS {
            config.limits.set(name, value).map_err(|error| anyhow::anyhow!("{error:?}"))?;
        }
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
        let server = runtime.block_on(RunningServer::start(config))?;
        let services = server.services();
        Ok(Self { runtime, server, services, folder })
    }

    /// Makes a call with one message; bytes of the first answers.
    pub(super) fn call(
        &self,
        path: &str,
        message: &[u8],
        patience: Duration,
    ) -> Option<Vec<Bytes>> {
        let length = u32::try_from(message.len()).ok()?.to_be_bytes();
        let body = Bytes::from([&[0], &length[..], message].concat());
        let request = Request::post(path).header("content-type", "application/grpc");
        let request = request.body(Body::new(Full::new(body))).ok()?;
        let mut services = self.services.clone();
        self.runtime.block_on(async {
            let answers = async {
                let response = services.ready().await.ok()?.call(request).await.ok()?;
                let mut body = response.into_body();
                let mut answers = Vec::new();
                while let Some(Ok(frame)) = body.frame().await {
                    answers.extend(frame.into_data());
                    if answers.len() >= ANSWERS_MAX {
                        break;
                    }
                }
                Some(answers)
            };
            timeout(patience, answers).await.ok().flatten()
        })
    }

    /// Deletes all plants.
    pub(super) fn clear(&self) {
        let hub = self.server.hub();
        self.runtime.block_on(async {
            loop {
                let (plants, _) = hub.page("", 100);
                if plants.is_empty() {
                    break;
                }
                for plant in plants {
                    let _ = hub.delete(plant.id()).await;
                }
            }
        });
    }
}

/// All methods: their paths and what they take.
fn methods() -> Result<Vec<(String, MessageDescriptor)>> {
    let pool = DescriptorPool::decode(FILE_DESCRIPTOR_SET)?;
    let services = pool.services().filter(|service| service.package_name() == "plantd.v1");
    let methods = services.flat_map(|service| {
        let of = service.full_name().to_owned();
        let path = move |name: &str| format!("/{of}/{name}");
        service
            .methods()
            .map(move |method| (path(method.name()), method.input()))
            .collect::<Vec<_>>()
    });
    // After it the server would take nothing new.
    Ok(methods.filter(|(path, _)| path != "/plantd.v1.ServerService/Drain").collect())
}

/// The first byte says which method, the others are the message.
struct Calls {
    inside: Inside,
    methods: Vec<(String, MessageDescriptor)>,
    /// Texts for scenes.
    texts: Vec<Vec<u8>>,
    /// Bytes are changed, too.
    mutates: bool,
    count: u64,
}

impl Calls {
    fn open(mutates: bool) -> Result<Box<dyn Target>> {
        let texts = seeds("scene", &["models/scenes", "models/scenes/elements"], "toml")?;
        let methods = methods()?;
        anyhow::ensure!((50..256).contains(&methods.len()), "{} methods", methods.len());
        Ok(Box::new(Self { inside: Inside::new()?, methods, texts, mutates, count: 0 }))
    }

    /// The plants that messages name: one of each link, in lockstep and by itself.
    fn begin(&self) -> Result<()> {
        self.inside.clear();
        for (id, model) in [("p", "pendulum"), ("c", "cart-pole"), ("m", "marionette")] {
            let (id, model) = (id.to_owned(), model.to_owned());
            let request = plantd_client::v1::CreatePlantRequest { id, model, ..Default::default() };
            // It waits for what the calls before have left to the workers, which has to end.
            let path = "/plantd.v1.PlantService/CreatePlant";
            self.inside
                .call(path, &request.encode_to_vec(), Duration::MAX)
                .context("a plant is made")?;
        }
        Ok(())
    }
}

pub(super) fn messages() -> Result<Box<dyn Target>> {
    Calls::open(false)
}

pub(super) fn bytes() -> Result<Box<dyn Target>> {
    Calls::open(true)
}

impl Target for Calls {
    fn input(&mut self, rng: &mut Rng) -> Vec<u8> {
        let method = rng.below(self.methods.len());
        let message = random(rng, &self.methods[method].1, &self.texts).encode_to_vec();
        let message = if self.mutates { mutated(rng, &[message], BYTES_MAX) } else { message };
        [&[method as u8], &message[..]].concat()
    }

    fn run(&mut self, input: &[u8]) {
        if self.count.is_multiple_of(ROUND) {
            self.begin().expect("the server goes on");
        }
        self.count += 1;
        let Some((method, message)) = input.split_first() else { return };
        let Some((path, _)) = self.methods.get(usize::from(*method)) else { return };
        self.inside.call(path, message, PATIENCE);
    }
}
