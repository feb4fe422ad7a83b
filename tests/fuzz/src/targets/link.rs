//! Headers and inputs in the memory of a link, written by a process that means harm.

use std::sync::Arc;

use anyhow::{Context as _, Result};
use plantd_models::{Model, Plant, Settings, builtin};
use plantd_proto::link::{
    Code, Domain, Endpoint, Header, Kind, ProcessIdentity, Wait, monotonic_ns,
};
use plantd_server::core::metrics::registry::Metrics;
use plantd_server::core::realtime::loops::RealTime;
use plantd_server::core::realtime::settings::RealTimeSettings;
use plantd_server::core::session::creation::Origin;
use plantd_server::core::session::shared::Session;
use plantd_server::wire::link::config::LinkConfig;
use plantd_server::wire::link::host::LinkHost;

use crate::mutate::Rng;
use crate::targets::Target;

const PLANT: &str = "p";
/// Number of the driver.
const DRIVER: u64 = 7;
/// How often the lease is asked for that the driver may hold itself.
const ATTEMPTS: usize = 8;
/// Messages of one input.
const MESSAGES_MAX: usize = 3;
/// By so many numbers an input may be too long.
const LONGER: usize = 8;
/// How long what was wrong may be answered, ns.
const LISTEN_NS: u64 = 20_000;
/// Longest wait for the answer to an attachment that is in order.
const ANSWER_NS: u64 = 5_000_000_000;

/// The link of a plant, and the end of a driver.
struct Link {
    endpoint: Endpoint,
    /// The last message of the server.
    answer: Header,
    sequence: u64,
    /// Number under which the lease was given.
    holder: u64,
    input_len: usize,
    _host: LinkHost,
    _folder: tempfile::TempDir,
}

pub(super) fn link() -> Result<Box<dyn Target>> {
    let folder = tempfile::Builder::new().prefix("fuzz-").tempdir()?;
    let root = folder.path().join("link");
    let host = LinkHost::new(LinkConfig { root: root.clone(), ..LinkConfig::default() })?;
    let scene = builtin::scene("marionette").context("a built-in scene")?;
    let model = Arc::new(Model::compile(&scene)?);
    let input_len = model.dimensions().input();
    let plant = Plant::new(Arc::clone(&model), Settings::new(&model))?;
    let metrics = Arc::new(Metrics::default());
    let realtime = RealTime::new(RealTimeSettings::default(), &metrics);
    let session = Session::new(Origin::new(PLANT, "marionette"), plant, metrics, realtime);
    host.open(session)?;
    let services = Domain::find(&root, PLANT)?.join("fuzz")?.open_services(PLANT)?;
    let endpoint = Endpoint::driver(services, input_len + LONGER, Wait::default())?;
    let answer = Header::default();
    let mut link = Link {
        endpoint,
        answer,
        sequence: 0,
        holder: DRIVER,
        input_len,
        _host: host,
        _folder: folder,
    };
    link.attach()?;
    Ok(Box::new(link))
}

impl Link {
    /// What a driver in good order sends.
    fn header(&self, kind: Kind) -> Header {
        let own = ProcessIdentity::own();
        Header {
            server: self.answer.server,
            driver: DRIVER,
            sequence: self.sequence,
            pid: own.pid,
            process_start: own.start,
            stamp_ns: monotonic_ns(),
            ..Header::new(kind)
        }
    }

    /// Waits for what the server says.
    fn listen(&mut self, until_ns: u64) -> bool {
        match self.endpoint.receive(until_ns) {
            Ok(Some(message)) => {
                self.answer = *message.user_header();
                if self.answer.kind == Kind::Attached as u32 {
                    self.holder = self.answer.driver;
                }
                true
            }
            _ => false,
        }
    }

    /// The link still serves: it gives the lease to a driver that asks in good order.
    fn attach(&mut self) -> Result<()> {
        while self.listen(0) {}
        for _ in 0..ATTEMPTS {
            self.sequence = 0;
            // Under another number it may have got the lease itself, also while it asks.
            if self.holder != DRIVER {
                let header = Header { driver: self.holder, ..self.header(Kind::Detach) };
                self.endpoint.send_as_it_is(header, &[], 0)?;
            }
            let header = Header { server: 0, ..self.header(Kind::Attach) };
            self.endpoint.send_as_it_is(header, &[], 0)?;
            let until_ns = monotonic_ns() + ANSWER_NS;
            while self.listen(until_ns) {
                let Header { kind, code, driver, .. } = self.answer;
                if kind == Kind::Attached as u32 && driver == DRIVER {
                    return Ok(());
                }
                if kind == Kind::Failure as u32 && code == Code::LeaseHeld as u32 {
                    break;
                }
            }
        }
        anyhow::bail!("the link does not answer any more: {:?}", self.answer)
    }
}

/// Words of eight bytes; the last may be shorter.
fn words(input: &[u8]) -> impl Iterator<Item = u64> {
    input.chunks(8).map(|chunk| {
        let mut word = [0; 8];
        word[..chunk.len()].copy_from_slice(chunk);
        u64::from_le_bytes(word)
    })
}

impl Target for Link {
    /// Messages one after the other: which fields are other ones, what kind of message it is, its length, then the
    /// fields, then the payload.
    fn input(&mut self, rng: &mut Rng) -> Vec<u8> {
        let mut bytes = Vec::new();
        // Most often one or two fields are wrong.
        let fields = 1 << rng.below(10) | if rng.once_in(2) { 1 << rng.below(10) } else { 0 };
        let fields = if rng.once_in(6) { 0 } else { fields };
        for word in [fields, rng.integer(), rng.integer()] {
            bytes.extend(word.to_le_bytes());
        }
        for _ in 0..rng.below(64) {
            let word = if rng.once_in(2) { rng.integer() } else { rng.number().to_bits() };
            bytes.extend(word.to_le_bytes());
        }
        bytes
    }

    fn run(&mut self, input: &[u8]) {
        let mut words = words(input);
        let mut count = 0;
        while let Some(fields) = words.next()
            && count < MESSAGES_MAX
        {
            count += 1;
            self.send(fields, &mut words);
        }
        self.attach().expect("the link goes on");
    }
}

impl Link {
    /// Sends a message in which these fields are other ones.
    fn send(&mut self, fields: u64, words: &mut impl Iterator<Item = u64>) {
        let mut next = || words.next().unwrap_or_default();
        let (kind, length) = (next(), next());
        let kind = match kind % 8 {
            0 => Kind::Attach,
            1 => Kind::Detach,
            2 => Kind::State,
            _ => Kind::Input,
        };
        self.sequence = self.answer.sequence.wrapping_add(1);
        let mut header = self.header(kind);
        for (bit, field) in [
            &mut header.detail_a,
            &mut header.schema_hash,
            &mut header.server,
            &mut header.driver,
            &mut header.sequence,
            &mut header.stamp_ns,
            &mut header.poll_ns,
            &mut header.process_start,
        ]
        .into_iter()
        .enumerate()
        {
            if fields & 1 << bit != 0 {
                *field = next();
            }
        }
        if fields & 1 << 8 != 0 {
            (header.pid, header.kind) = (next() as u32, next() as u32);
            (header.magic, header.layout_version) = (next() as u32, next() as u32);
        }
        let (own, long) = (self.input_len, self.input_len + LONGER);
        let length = if fields & 1 << 9 != 0 { length as usize % (long + 1) } else { own };
        let payload: Vec<f64> = (0..length).map(|_| f64::from_bits(next())).collect();
        // What cannot be sent has reached nobody.
        if self.endpoint.send_as_it_is(header, &[&payload], 0).is_ok() {
            self.listen(monotonic_ns() + LISTEN_NS);
        }
    }
}
