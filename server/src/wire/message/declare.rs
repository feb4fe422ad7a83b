//! From messages to channels and faults, with every check on the way in.

use std::collections::HashSet;
use std::ops::Range;
use std::sync::Arc;

use plantd_models::scene::UnknownName;
use plantd_models::{Model, Site};
use plantd_proto::v1;
use prost::Message as _;
use v1::fault_spec::{Kind, Pattern as GivenPattern, Start as GivenStart, Target};
use v1::output_channel::Source as GivenSource;

use crate::core::channels::actuator::{Actuator, ActuatorSettings, Hold};
use crate::core::channels::fault::{Disturbance, Effect, Injected, Line, Pattern, Start};
use crate::core::channels::noise;
use crate::core::channels::pipeline::Channels;
use crate::core::channels::sensor::{Sensor, SensorSettings, Source};
use crate::core::limits::{LimitExceeded, Limits};
use crate::core::origin::Origin;
use crate::core::session::shared::Session;
use crate::wire::message::states;
use crate::wire::status::RpcError;

/// The message that something of the core was made from.
pub(crate) fn origin<M: Default + Send + Sync + 'static>(origin: &Origin) -> Arc<M> {
    Arc::clone(origin).downcast().unwrap_or_default()
}

impl Session {
    /// The channels with what they deliver.
    pub fn channels(&self) -> (Arc<v1::ChannelsInfo>, v1::Outputs) {
        self.with_core(|core| {
            let info = core.channels.as_ref().map(|channels| origin(&channels.info));
            (info.unwrap_or_default(), states::core_outputs(core).unwrap_or_default())
        })
    }
}

/// Times in whole steps of so many seconds.
#[derive(Clone, Copy)]
struct Clock {
    time_step_s: f64,
}

impl Clock {
    /// The nearest number of steps.
    fn steps(self, field: &str, time_s: f64) -> Result<u64, RpcError> {
        let steps = (not_negative(field, time_s)? / self.time_step_s).round();
        // Beyond 2⁵³ steps are not told apart.
        if steps > 9e15 {
            return Err(RpcError::field(field, "is too long"));
        }
        Ok(steps as u64)
    }

    fn at_least_one(self, field: &str, time_s: f64) -> Result<u64, RpcError> {
        Ok(self.steps(field, time_s)?.max(1))
    }

    /// Steps of a delay, for which memory is taken.
    fn delay(self, field: &str, time_s: f64, limits: &Limits) -> Result<usize, RpcError> {
        let steps = usize::try_from(self.steps(field, time_s)?).unwrap_or(usize::MAX);
        let (name, limit) = ("channel_numbers", limits.channel_numbers);
        LimitExceeded::check(name, limit, "numbers under way in a channel", steps)?;
        Ok(steps)
    }

    fn seconds(self, steps: u64) -> f64 {
        steps as f64 * self.time_step_s
    }
}

fn finite(field: &str, value: f64) -> Result<f64, RpcError> {
    if value.is_finite() { Ok(value) } else { Err(RpcError::field(field, "must be finite")) }
}

fn not_negative(field: &str, value: f64) -> Result<f64, RpcError> {
    if value.is_finite() && value >= 0.0 {
        Ok(value)
    } else {
        Err(RpcError::field(field, "must be finite and not negative"))
    }
}

fn probability(field: &str, value: f64) -> Result<f64, RpcError> {
    if (0.0..=1.0).contains(&value) {
        Ok(value)
    } else {
        Err(RpcError::field(field, "must lie between 0 and 1"))
    }
}

/// Bounds; none is infinite.
fn bounds(field: &str, min: Option<f64>, max: Option<f64>) -> Result<(f64, f64), RpcError> {
    for (name, bound) in [("min", min), ("max", max)] {
        if let Some(bound) = bound {
            finite(&format!("{field}.{name}"), bound)?;
        }
    }
    let (min, max) = (min.unwrap_or(f64::NEG_INFINITY), max.unwrap_or(f64::INFINITY));
    if min > max {
        return Err(RpcError::field(format!("{field}.min"), "is greater than `max`"));
    }
    Ok((min, max))
}

fn coordinate(model: &Model, field: String, name: &str) -> Result<usize, RpcError> {
    model.coordinate_index(name).ok_or_else(|| states::no_coordinate(field, name, model))
}

/// The entry of `u` of an input or a prescribed coordinate.
fn entry(model: &Model, field: String, name: &str) -> Result<usize, RpcError> {
    let d = model.dimensions();
    let inputs = || {
        let inputs = model.scene().inputs.iter().map(|input| input.name.as_str());
        inputs.chain(model.coordinates()[d.dynamic..].iter().map(|c| c.name.as_str()))
    };
    inputs().position(|other| other == name).ok_or_else(|| {
        let name = UnknownName::among(name, inputs());
        RpcError::field(field, format!("there is no input or prescribed coordinate {name}"))
    })
}

fn is_prescribed(model: &Model, entry: usize) -> bool {
    entry >= model.dimensions().inputs
}

/// A vector in space; empty means zero.
pub(crate) fn vector(field: String, given: &[f64]) -> Result<[f64; 3], RpcError> {
    Ok(optional(field, given, "three")?.unwrap_or_default())
}

/// So many finite numbers, in words for errors, or none.
pub(crate) fn optional<const N: usize>(
    field: String,
    given: &[f64],
    count: &str,
) -> Result<Option<[f64; N]>, RpcError> {
    match <[f64; N]>::try_from(given) {
        _ if given.is_empty() => Ok(None),
        Ok(numbers) if numbers.iter().all(|value| value.is_finite()) => Ok(Some(numbers)),
        _ => Err(RpcError::field(field, format!("must have {count} finite entries, or none"))),
    }
}

fn site(model: &Model, field: &str, point: &v1::FramePoint) -> Result<Box<Site>, RpcError> {
    let at = vector(format!("{field}.at"), &point.at)?;
    let name = &point.frame;
    let site = model.site(name, at).map(Box::new);
    site.ok_or_else(|| states::no_frame(format!("{field}.frame"), name, model))
}

/// Names of the numbers of an output.
fn names(name: &str, source: &Source) -> Vec<String> {
    let parts: &[&str] = match source {
        Source::Position(_) => &["x", "y", "z"],
        Source::Orientation(_) => &["rx", "ry", "rz"],
        _ => return vec![name.to_owned()],
    };
    parts.iter().map(|part| format!("{name}.{part}")).collect()
}

fn source(model: &Model, field: &str, given: Option<&GivenSource>) -> Result<Source, RpcError> {
    let at = |part: &str| format!("{field}.{part}");
    Ok(match given {
        None => return Err(RpcError::field(field, "measures nothing: one source is needed")),
        Some(GivenSource::Coordinate(name)) => {
            Source::Coordinate(coordinate(model, at("coordinate"), name)?)
        }
        Some(GivenSource::Velocity(name)) => {
            Source::Velocity(coordinate(model, at("velocity"), name)?)
        }
        Some(GivenSource::Acceleration(name)) => {
            Source::Acceleration(coordinate(model, at("acceleration"), name)?)
        }
        Some(GivenSource::Position(point)) => {
            Source::Position(site(model, &at("position"), point)?)
        }
        Some(GivenSource::Orientation(frame)) => {
            let site = model.site(frame, [0.0; 3]).map(Box::new);
            Source::Orientation(
                site.ok_or_else(|| states::no_frame(at("orientation"), frame, model))?,
            )
        }
        Some(GivenSource::ConstraintForce(name)) => {
            let index = model.constraint_names().iter().position(|other| other == name);
            Source::ConstraintForce(index.ok_or_else(|| {
                let name = UnknownName::among(name, model.constraint_names());
                let problem = format!("there is no constraint equation {name}");
                RpcError::field(at("constraint_force"), problem)
            })?)
        }
        Some(GivenSource::Input(name)) => Source::Input(entry(model, at("input"), name)?),
        Some(GivenSource::Energy(true)) => Source::Energy,
        Some(GivenSource::Energy(false)) => {
            return Err(RpcError::field(at("energy"), "must be true, or not given"));
        }
    })
}

fn sensor(
    given: &mut v1::OutputChannel,
    field: &str,
    model: &Model,
    clock: Clock,
    limits: &Limits,
) -> Result<Sensor, RpcError> {
    let at = |part: &str| format!("{field}.{part}");
    let source = source(model, field, given.source.as_ref())?;
    let (min, max) = bounds(field, given.min, given.max)?;
    let settings = SensorSettings {
        period: clock.at_least_one(&at("sample_period_s"), given.sample_period_s)?,
        latency: clock.delay(&at("latency_s"), given.latency_s, limits)?,
        bias: finite(&at("bias"), given.bias)?,
        noise: not_negative(&at("noise"), given.noise)?,
        quantum: not_negative(&at("quantum"), given.quantum)?,
        min,
        max,
        drop_out: probability(&at("drop_out"), given.drop_out)?,
    };
    given.sample_period_s = clock.seconds(settings.period);
    given.latency_s = clock.seconds(settings.latency as u64);
    Ok(Sensor::new(&given.name, source, settings))
}

fn actuator(
    given: &mut v1::InputChannel,
    field: &str,
    model: &Model,
    clock: Clock,
    limits: &Limits,
) -> Result<Actuator, RpcError> {
    let at = |part: &str| format!("{field}.{part}");
    let entry = entry(model, at("input"), &given.input)?;
    let (min, max) = bounds(field, given.min, given.max)?;
    let dead_band = not_negative(&at("dead_band"), given.dead_band)?;
    if dead_band > 0.0 && is_prescribed(model, entry) {
        return Err(RpcError::field(at("dead_band"), "is not for prescribed coordinates"));
    }
    let settings = ActuatorSettings {
        period: clock.at_least_one(&at("sample_period_s"), given.sample_period_s)?,
        hold: match v1::Hold::try_from(given.hold) {
            Ok(v1::Hold::Unspecified | v1::Hold::ZeroOrder) => Hold::Zero,
            Ok(v1::Hold::FirstOrder) => Hold::First,
            Err(_) => return Err(RpcError::field(at("hold"), "is not a hold")),
        },
        delay: clock.delay(&at("delay_s"), given.delay_s, limits)?,
        dead_band,
        min,
        max,
        most_change: match given.max_rate {
            None => f64::INFINITY,
            Some(rate) => not_negative(&at("max_rate"), rate)? * clock.time_step_s,
        },
        quantum: not_negative(&at("quantum"), given.quantum)?,
    };
    given.sample_period_s = clock.seconds(settings.period);
    given.delay_s = clock.seconds(settings.delay as u64);
    Ok(Actuator::new(entry, settings))
}

/// Channels without faults, before they begin at a state.
pub(crate) fn channels(
    declared: v1::Channels,
    model: &Model,
    time_step_s: f64,
    limits: &Limits,
) -> Result<Channels, RpcError> {
    let clock = Clock { time_step_s };
    let count = declared.outputs.len() + declared.inputs.len();
    LimitExceeded::check("channels", limits.channels, "channels", count)?;
    let mut in_force = declared.clone();
    let (mut sensors, mut all_names) = (Vec::new(), Vec::new());
    let mut seen = HashSet::new();
    for (index, given) in in_force.outputs.iter_mut().enumerate() {
        let field = format!("channels.outputs[{index}]");
        if given.name.is_empty() {
            return Err(RpcError::field(format!("{field}.name"), "is missing"));
        }
        let sensor = sensor(given, &field, model, clock, limits)?;
        let names = names(&given.name, &sensor.source);
        let mut taken = names.iter().chain((names.len() > 1).then_some(&given.name));
        if let Some(name) = taken.find(|name| !seen.insert((*name).clone())) {
            let problem = format!("another output has the name `{name}`");
            return Err(RpcError::field(format!("{field}.name"), problem));
        }
        all_names.extend(names);
        sensors.push(sensor);
    }
    let numbers = all_names.len() + sensors.len();
    LimitExceeded::check("outputs", limits.outputs, "numbers and flags of outputs", numbers)?;
    let mut actuators: Vec<Actuator> = Vec::new();
    for (index, given) in in_force.inputs.iter_mut().enumerate() {
        let field = format!("channels.inputs[{index}]");
        let actuator = actuator(given, &field, model, clock, limits)?;
        if actuators.iter().any(|other| other.entry == actuator.entry) {
            let problem = format!("another channel has the input `{}`", given.input);
            return Err(RpcError::field(format!("{field}.input"), problem));
        }
        actuators.push(actuator);
    }
    let seed = declared.seed;
    let info = v1::ChannelsInfo { channels: Some(in_force), names: all_names };
    let hash = noise::hash(&declared.encode_to_vec());
    let (declared, info) = (Arc::new(declared), Arc::new(info));
    let channels = Channels::new(seed, sensors, actuators, declared, info, hash, model);
    check_numbers(channels.numbers(), limits)?;
    Ok(channels)
}

pub(crate) fn check_numbers(numbers: usize, limits: &Limits) -> Result<(), RpcError> {
    let (name, what) = ("channel_numbers", "numbers kept by channels and faults");
    Ok(LimitExceeded::check(name, limits.channel_numbers, what, numbers)?)
}

/// A fault, to be put in its place in time by [`Injected::place`].
pub(crate) fn fault(
    id: u64,
    given: v1::FaultSpec,
    model: &Model,
    time_step_s: f64,
    info: &v1::ChannelsInfo,
    limits: &Limits,
) -> Result<Injected, RpcError> {
    let clock = Clock { time_step_s };
    let Some(kind) = &given.kind else {
        return Err(RpcError::field("fault", "does nothing: one of its kinds is needed"));
    };
    let start = match given.start {
        None => Start::Next,
        Some(GivenStart::StartStep(step)) => Start::Step(step),
        Some(GivenStart::StartS(time_s)) => Start::Time(finite("fault.start_s", time_s)?),
    };
    let duration = match given.duration_s {
        0.0 => None,
        time_s => Some(clock.at_least_one("fault.duration_s", time_s)?),
    };
    let pattern = pattern(given.pattern.as_ref(), clock)?;
    let effect = match kind {
        Kind::Push(push) => {
            no_target(&given)?;
            let field = "fault.push";
            let Some(point) = &push.point else {
                return Err(RpcError::field(format!("{field}.point"), "is missing"));
            };
            let (force, torque) = (&push.force, &push.torque);
            Effect::Push {
                site: site(model, &format!("{field}.point"), point)?,
                force: vector(format!("{field}.force"), force)?,
                torque: vector(format!("{field}.torque"), torque)?,
            }
        }
        Kind::Parameters(change) => {
            no_target(&given)?;
            if change.parameters.is_empty() {
                return Err(RpcError::field("fault.parameters.parameters", "are missing"));
            }
            Effect::Parameters { bit: 0 }
        }
        kind => {
            let disturbance = disturbance(kind, clock, limits)?;
            disturbed(&given, disturbance, model, info)?
        }
    };
    let hash = noise::hash(&given.encode_to_vec());
    Ok(Injected::new(id, effect, start, duration, pattern, Arc::new(given), hash))
}

fn no_target(given: &v1::FaultSpec) -> Result<(), RpcError> {
    match given.target {
        None => Ok(()),
        Some(Target::Input(_)) => {
            Err(RpcError::field("fault.input", "is not for this kind of fault"))
        }
        Some(Target::Output(_)) => {
            Err(RpcError::field("fault.output", "is not for this kind of fault"))
        }
    }
}

fn pattern(given: Option<&GivenPattern>, clock: Clock) -> Result<Pattern, RpcError> {
    Ok(match given {
        None => Pattern::Always,
        Some(GivenPattern::Intermittent(v1::Intermittent { period_s, duty })) => {
            let field = "fault.intermittent";
            let period = clock.steps(&format!("{field}.period_s"), *period_s)?.max(2);
            if !(*duty > 0.0 && *duty < 1.0) {
                return Err(RpcError::field(format!("{field}.duty"), "must lie between 0 and 1"));
            }
            let on = (duty * period as f64).round() as u64;
            Pattern::Intermittent { period, on: on.clamp(1, period - 1) }
        }
        Some(GivenPattern::Chance(chance)) => Pattern::Random {
            window: clock.at_least_one("fault.chance.window_s", chance.window_s)?,
            probability: probability("fault.chance.probability", chance.probability)?,
        },
    })
}

fn disturbance(kind: &Kind, clock: Clock, limits: &Limits) -> Result<Disturbance, RpcError> {
    let flag = |name: &str, is_set: bool, disturbance| {
        if is_set {
            Ok(disturbance)
        } else {
            Err(RpcError::field(format!("fault.{name}"), "must be true, or not given"))
        }
    };
    Ok(match kind {
        Kind::Stuck(is_set) => flag("stuck", *is_set, Disturbance::Stuck)?,
        Kind::Off(is_set) => flag("off", *is_set, Disturbance::Off)?,
        Kind::WrongSign(is_set) => flag("wrong_sign", *is_set, Disturbance::WrongSign)?,
        Kind::Offset(offset) => Disturbance::Offset(finite("fault.offset.value", offset.value)?),
        Kind::Noise(noise) => {
            Disturbance::Noise(not_negative("fault.noise.deviation", noise.deviation)?)
        }
        Kind::Delay(delay) => {
            Disturbance::Delay(clock.delay("fault.delay.delay_s", delay.delay_s, limits)?)
        }
        Kind::Loss(loss) => {
            Disturbance::DropOut(probability("fault.loss.probability", loss.probability)?)
        }
        Kind::Push(_) | Kind::Parameters(_) => {
            return Err(RpcError::field("fault", "has no numbers to disturb"));
        }
    })
}

fn disturbed(
    given: &v1::FaultSpec,
    disturbance: Disturbance,
    model: &Model,
    info: &v1::ChannelsInfo,
) -> Result<Effect, RpcError> {
    match &given.target {
        None => Err(RpcError::field("fault.input", "and `output` are both missing")),
        Some(Target::Input(name)) => {
            let entry = entry(model, "fault.input".to_owned(), name)?;
            let jumps = matches!(disturbance, Disturbance::Off | Disturbance::WrongSign);
            if jumps && is_prescribed(model, entry) {
                let problem = "is a prescribed coordinate, which would jump; `stuck` stops it";
                return Err(RpcError::field("fault.input", problem));
            }
            Ok(Effect::Input(Line::new(entry..entry + 1, disturbance)))
        }
        Some(Target::Output(name)) => {
            let (channel, range) = output(info, name).ok_or_else(|| {
                let known = info.channels.iter().flat_map(|channels| &channels.outputs);
                let name = UnknownName::among(name, known.map(|output| &output.name));
                let problem =
                    format!("there is no output channel {name}; SetChannels declares them");
                RpcError::field("fault.output", problem)
            })?;
            Ok(Effect::Output { line: Line::new(range, disturbance), channel })
        }
    }
}

/// The channel of an output or of one of its numbers, and their places in `y`.
pub(crate) fn output(info: &v1::ChannelsInfo, name: &str) -> Option<(usize, Range<usize>)> {
    let outputs = &info.channels.as_ref()?.outputs;
    let mut begin = 0;
    for (channel, output) in outputs.iter().enumerate() {
        let is_triple =
            matches!(output.source, Some(GivenSource::Position(_) | GivenSource::Orientation(_)));
        let end = begin + if is_triple { 3 } else { 1 };
        if output.name == name {
            return Some((channel, begin..end));
        }
        let part = info.names.get(begin..end)?.iter().position(|part| part == name);
        if let Some(part) = part {
            return Some((channel, begin + part..begin + part + 1));
        }
        begin = end;
    }
    None
}
