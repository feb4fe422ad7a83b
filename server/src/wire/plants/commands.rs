//! What is done with the channels and faults of a session.
//!
//! Memory is taken before and given back after; in the core's hands things only change places.

use std::ops::Range;
use std::sync::Arc;

use plantd_models::{Model, Settings, Site};
use plantd_proto::v1;
use v1::fault_spec::{Kind, Pattern as GivenPattern, Start as GivenStart, Target};
use v1::output_channel::Source;

use crate::core::channels::fault::{Disturbance, Effect, Injected, Pattern, Schedule, Start};
use crate::core::channels::pipeline::Channels;
use crate::core::channels::timeline::{Base, Change, Timeline};
use crate::core::limits::{LimitExceeded, Limits};
use crate::core::plant::core::Core;
use crate::core::plant::event::EventKind;
use crate::core::session::shared::Session;
use crate::wire::message::declare::{self, check_numbers, origin};
use crate::wire::status::RpcError;

impl Injected {
    /// What a client is told at a step of the plant.
    pub(crate) fn info(&self, step: u64, time_step_s: f64) -> v1::FaultInfo {
        let seconds = |steps: u64| steps as f64 * time_step_s;
        let mut fault = v1::FaultSpec::clone(&origin(&self.given));
        fault.start = Some(GivenStart::StartStep(self.schedule.start));
        fault.duration_s = self.duration.map_or(0.0, seconds);
        match (&mut fault.pattern, self.schedule.pattern) {
            (Some(GivenPattern::Intermittent(given)), Pattern::Intermittent { period, on }) => {
                given.period_s = seconds(period);
                given.duty = on as f64 / period as f64;
            }
            (Some(GivenPattern::Chance(given)), Pattern::Random { window, .. }) => {
                given.window_s = seconds(window);
            }
            _ => {}
        }
        if let (
            Some(v1::fault_spec::Kind::Delay(given)),
            Effect::Input(line) | Effect::Output { line, .. },
        ) = (&mut fault.kind, &self.effect)
            && let Disturbance::Delay(steps) = line.disturbance
        {
            given.delay_s = seconds(steps as u64);
        }
        // The last of its steps that can have been taken.
        let last = match self.effect {
            Effect::Output { .. } => Some(step),
            _ => step.checked_sub(1),
        };
        let phase = match last {
            _ if self.is_active => v1::FaultPhase::Active,
            Some(last) if self.schedule.is_over(last.saturating_add(1)) => v1::FaultPhase::Over,
            Some(last) if last >= self.schedule.start => v1::FaultPhase::Paused,
            _ => v1::FaultPhase::Waiting,
        };
        v1::FaultInfo {
            id: self.id,
            fault: Some(fault),
            phase: phase.into(),
            beginnings: self.beginnings,
            refused: false,
        }
    }
}

/// What a session's channels and faults were made from.
struct Present {
    declared: Arc<v1::Channels>,
    info: Arc<v1::ChannelsInfo>,
    faults: Vec<PresentFault>,
    numbers: usize,
    is_there: bool,
    base: Base,
    is_scheduled: bool,
}

struct PresentFault {
    id: u64,
    given: Arc<v1::FaultSpec>,
    start: Start,
    schedule: Schedule,
    is_over: bool,
}

impl Present {
    fn of(core: &Core) -> Self {
        let base = core.base();
        let Some(channels) = &core.channels else {
            return Self {
                declared: Arc::default(),
                info: Arc::default(),
                faults: Vec::new(),
                numbers: 0,
                is_there: false,
                base,
                is_scheduled: false,
            };
        };
        let step = core.plant.step_index();
        let fault = |fault: &Injected| PresentFault {
            is_over: fault.schedule.is_over(step),
            ..PresentFault::of(fault)
        };
        Self {
            declared: origin(&channels.declared),
            info: origin(&channels.info),
            faults: channels.faults.iter().map(fault).collect(),
            numbers: channels.numbers(),
            is_there: true,
            base,
            is_scheduled: channels.timeline.is_some(),
        }
    }

    /// Channels without any, to hold faults, where there are none.
    fn spare_channels(&self, limits: &Limits) -> Result<Option<Box<Channels>>, RpcError> {
        if self.is_there {
            return Ok(None);
        }
        let (model, h) = (&self.base.model, self.base.settings.time_step_s);
        let channels = declare::channels(v1::Channels::default(), model, h, limits)?;
        Ok(Some(Box::new(channels)))
    }
}

impl PresentFault {
    fn of(fault: &Injected) -> Self {
        Self {
            id: fault.id,
            given: origin(&fault.given),
            start: fault.start,
            schedule: fault.schedule,
            is_over: false,
        }
    }

    /// As it will be, once it is injected. A plant that runs goes on meanwhile: what begins with the next
    /// step may do so at any.
    fn next(fault: &Injected) -> Self {
        let mut next = Self::of(fault);
        if next.start == Start::Next {
            let pattern = Pattern::Random { window: 1, probability: 0.5 };
            next.schedule = Schedule { end: None, pattern, ..next.schedule };
        }
        next
    }
}

/// What channels become when the parameters or the time step of their plant change.
pub(crate) enum Renewed {
    /// There are none.
    Nothing,
    /// Frames have moved in their bodies.
    Sites(Vec<Site>),
    /// Times take another number of steps.
    All(Box<Channels>),
}

impl Session {
    /// Replaces the channels. Returns what is in force, and its present numbers.
    pub fn set_channels(
        &self,
        declared: v1::Channels,
        limits: &Limits,
    ) -> Result<(Arc<v1::ChannelsInfo>, Vec<f64>), RpcError> {
        let _replacing = self.replacing();
        let present = self.with_core(|core| Present::of(core));
        let (model, h) = (&present.base.model, present.base.settings.time_step_s);
        let mut channels = declare::channels(declared, model, h, limits)?;
        channels.timeline =
            timeline(&present.base, &origin(&channels.declared), present.faults.iter(), limits)?;
        let info: Arc<v1::ChannelsInfo> = origin(&channels.info);
        // Where the faults of outputs go.
        let places: Vec<Option<(usize, Range<usize>)>> = present
            .faults
            .iter()
            .map(|fault| match &fault.given.target {
                Some(Target::Output(name)) => declare::output(&info, name),
                _ => Some((0, 0..0)),
            })
            .collect();
        channels.faults.reserve_exact(places.len());
        let (former, output) = self.with_core(move |core| {
            let mut former = core.channels.take();
            let faults = former.iter_mut().flat_map(|former| former.faults.drain(..));
            for (mut fault, place) in faults.zip(places) {
                let Some((new_channel, range)) = place else { continue };
                if let Effect::Output { line, channel } = &mut fault.effect {
                    if line.range.len() != range.len() {
                        continue;
                    }
                    line.range = range;
                    *channel = new_channel;
                }
                channels.faults.push(fault);
            }
            number_changes(&mut channels.faults);
            if let Some(mut timeline) = channels.timeline.take() {
                timeline.adopt(&mut core.plant, channels.sites_mut());
                channels.timeline = Some(timeline);
            }
            channels.begin(&mut core.plant, &core.last.input);
            let output = channels.output().to_vec();
            core.channels = (!channels.is_empty()).then(|| Box::new(channels));
            (former, output)
        });
        drop(former);
        Ok((info, output))
    }

    /// Injects a fault.
    pub fn inject_fault(
        &self,
        given: v1::FaultSpec,
        limits: &Limits,
    ) -> Result<v1::FaultInfo, RpcError> {
        let _replacing = self.replacing();
        let (present, id, step, time_s) = self.with_core(|core| {
            let plant = &core.plant;
            (Present::of(core), core.faults + 1, plant.step_index(), plant.time_s())
        });
        let is_over = |fault: &&PresentFault| fault.is_over;
        let count = present.faults.len() + 1;
        let excess = count.saturating_sub(Limits::size(limits.faults));
        let gone: Vec<u64> =
            present.faults.iter().filter(is_over).take(excess).map(|fault| fault.id).collect();
        LimitExceeded::check("faults", limits.faults, "faults", count - gone.len())?;
        let time_step_s = present.base.settings.time_step_s;
        let (model, info) = (&present.base.model, &present.info);
        let mut fault = declare::fault(id, given, model, time_step_s, info, limits)?;
        fault.schedule(step, time_s, time_step_s);
        if fault.is_late(step) {
            return Err(RpcError::start_passed(fault.schedule.start, step));
        }
        let next = PresentFault::next(&fault);
        let stay = present.faults.iter().filter(|fault| !gone.contains(&fault.id));
        let all = stay.chain(std::iter::once(&next));
        let timeline = timeline(&present.base, &present.declared, all, limits)?;
        check_numbers(present.numbers.saturating_add(fault.numbers()), limits)?;
        let spare = present.spare_channels(limits)?;
        let room = Vec::with_capacity(count);
        // What is left over is given back by whoever asked, not in the core's hands.
        let (injected, _left_over) = self.with_core(move |core| {
            let (step, time_s) = (core.plant.step_index(), core.plant.time_s());
            fault.schedule(step, time_s, time_step_s);
            // A plant that runs has gone on since.
            if fault.is_late(step) {
                let late = RpcError::start_passed(fault.schedule.start, step);
                return (Err(late), (Some(fault), room, timeline, spare));
            }
            core.faults = id;
            if core.channels.is_none() {
                core.channels = spare;
            }
            let spent = core.install(timeline);
            let Some(channels) = core.channels.as_mut() else {
                return (Err(RpcError::internal("channels are gone")), (None, room, spent, None));
            };
            let mut former = std::mem::replace(&mut channels.faults, room);
            // Those that are over stay behind.
            for kept in former.extract_if(.., |fault| !gone.contains(&fault.id)) {
                channels.faults.push(kept);
            }
            fault.place(&core.plant, &core.last.input, channels.output());
            let info = fault.info(step, time_step_s);
            channels.faults.push(fault);
            number_changes(&mut channels.faults);
            (Ok(info), (None, former, spent, None))
        });
        injected
    }

    /// Gives a plant without faults those that it was saved with, `count` of them so far. The plant is to be
    /// restored after it.
    pub(crate) fn resume_faults(
        &self,
        saved: Vec<v1::SavedFault>,
        count: u64,
        limits: &Limits,
    ) -> Result<(), RpcError> {
        let _replacing = self.replacing();
        let present = self.with_core(|core| Present::of(core));
        LimitExceeded::check("faults", limits.faults, "faults", saved.len())?;
        let (model, h) = (&present.base.model, present.base.settings.time_step_s);
        let mut faults = Vec::new();
        for v1::SavedFault { id, fault, start_step } in saved {
            let given = fault.unwrap_or_default();
            let mut fault = declare::fault(id, given, model, h, &present.info, limits)?;
            fault.begin_at(start_step);
            fault.keep_start();
            faults.push(fault);
        }
        let numbers =
            faults.iter().map(Injected::numbers).fold(present.numbers, usize::saturating_add);
        check_numbers(numbers, limits)?;
        number_changes(&mut faults);
        let all: Vec<_> = faults.iter().map(PresentFault::of).collect();
        let timeline = timeline(&present.base, &present.declared, all.iter(), limits)?;
        let spare = if faults.is_empty() { None } else { present.spare_channels(limits)? };
        self.with_core(move |core| {
            core.faults = count;
            if core.channels.is_none() {
                core.channels = spare;
            }
            if let Some(channels) = &mut core.channels {
                channels.faults = faults;
                channels.timeline = timeline;
            }
        });
        Ok(())
    }

    /// Clears a fault, or with 0 all of them; returns how many.
    pub fn clear_fault(&self, id: u64, limits: &Limits) -> Result<u32, RpcError> {
        let _replacing = self.replacing();
        let present = self.with_core(|core| Present::of(core));
        let stay = present.faults.iter().filter(|fault| id != 0 && fault.id != id);
        let timeline = timeline(&present.base, &present.declared, stay, limits)?;
        let room = Vec::with_capacity(present.faults.len());
        let (former, spent) = self.with_core(move |core| {
            // Changes end while the frames of all pushes are there.
            let timeline = core.install(timeline);
            let Some(channels) = &mut core.channels else { return (Vec::new(), (None, timeline)) };
            let mut former = std::mem::replace(&mut channels.faults, room);
            for kept in former.extract_if(.., |fault| id != 0 && fault.id != id) {
                channels.faults.push(kept);
            }
            number_changes(&mut channels.faults);
            let spent = if channels.is_empty() { core.channels.take() } else { None };
            for fault in former.iter().filter(|fault| fault.is_active) {
                core.note(EventKind::FaultEnded, fault.id, 0.0);
            }
            (former, (spent, timeline))
        });
        drop(spent);
        if former.is_empty() && id != 0 {
            return Err(RpcError::fault_not_found(id));
        }
        Ok(former.len() as u32)
    }

    /// The faults.
    pub fn faults(&self) -> Vec<v1::FaultInfo> {
        self.with_core(|core| {
            let (step, h) = (core.plant.step_index(), core.plant.settings().time_step_s);
            let Some(channels) = &core.channels else { return Vec::new() };
            let is_refused = channels.timeline.as_ref().is_some_and(|timeline| timeline.is_refused);
            let info = |fault: &Injected| {
                let changes = matches!(fault.effect, Effect::Parameters { .. }) && fault.is_active;
                v1::FaultInfo { refused: changes && is_refused, ..fault.info(step, h) }
            };
            channels.faults.iter().map(info).collect()
        })
    }

    /// What the channels become with another model or other settings. The caller holds `replacing`.
    pub(crate) fn renewed_channels(
        &self,
        model: &Arc<Model>,
        settings: Settings,
        limits: &Limits,
    ) -> Result<Renewed, RpcError> {
        let (present, time_step_s) =
            self.with_core(|core| (Present::of(core), core.plant.settings().time_step_s));
        if !present.is_there {
            return Ok(Renewed::Nothing);
        }
        if present.is_scheduled {
            return Err(RpcError::parameters_scheduled(self.id()));
        }
        if settings.time_step_s == time_step_s {
            return Ok(Renewed::Sites(sites(model, &present.declared, present.faults.iter())));
        }
        let h = settings.time_step_s;
        let mut channels = declare::channels((*present.declared).clone(), model, h, limits)?;
        for PresentFault { id, given, start, .. } in present.faults {
            let given = (*given).clone();
            let mut fault = declare::fault(id, given, model, h, &origin(&channels.info), limits)?;
            fault.start = start;
            channels.faults.push(fault);
        }
        check_numbers(channels.numbers(), limits)?;
        Ok(Renewed::All(Box::new(channels)))
    }
}

/// Plants for the changes of parameters among faults, if there are any.
fn timeline<'a>(
    base: &Base,
    declared: &v1::Channels,
    faults: impl Iterator<Item = &'a PresentFault> + Clone,
    limits: &Limits,
) -> Result<Option<Box<Timeline>>, RpcError> {
    let change = |fault: &'a PresentFault| {
        let Some(Kind::Parameters(change)) = &fault.given.kind else { return None };
        let numbers = change.parameters.iter().map(|p| (p.path.clone(), p.value)).collect();
        Some(Change { schedule: fault.schedule, numbers })
    };
    let changes: Vec<Change> = faults.clone().filter_map(change).collect();
    if changes.is_empty() {
        return Ok(None);
    }
    let sites = |model: &Model| sites(model, declared, faults.clone());
    Ok(Some(Box::new(Timeline::new(base, &changes, sites, limits)?)))
}

/// Numbers the changes of parameters in the order of their faults, as [`timeline`] does.
fn number_changes(faults: &mut [Injected]) {
    let bits = faults.iter_mut().filter_map(|fault| match &mut fault.effect {
        Effect::Parameters { bit } => Some(bit),
        _ => None,
    });
    for (number, bit) in (0..).zip(bits) {
        *bit = number;
    }
}

/// The sites of all outputs and pushes, in the order of [`Channels::sites_mut`].
fn sites<'a>(
    model: &Model,
    declared: &v1::Channels,
    faults: impl Iterator<Item = &'a PresentFault>,
) -> Vec<Site> {
    let point = |point: &v1::FramePoint| {
        let at = <[f64; 3]>::try_from(&point.at[..]).unwrap_or_default();
        model.site(&point.frame, at)
    };
    let outputs = declared.outputs.iter().filter_map(|output| match &output.source {
        Some(Source::Position(at)) => point(at),
        Some(Source::Orientation(frame)) => model.site(frame, [0.0; 3]),
        _ => None,
    });
    let pushes = faults.filter_map(|fault| match &fault.given.kind {
        Some(Kind::Push(push)) => push.point.as_ref().and_then(point),
        _ => None,
    });
    outputs.chain(pushes).collect()
}

impl Core {
    /// Fits the channels to a plant of other parameters or another time step.
    pub(crate) fn renew_channels(&mut self, renewed: Renewed) -> Option<Box<Channels>> {
        match renewed {
            Renewed::Nothing => None,
            Renewed::Sites(sites) => {
                let present = self.channels.iter_mut().flat_map(|channels| channels.sites_mut());
                for (present, site) in present.zip(sites) {
                    *present = site;
                }
                None
            }
            Renewed::All(mut channels) => {
                channels.begin(&mut self.plant, &self.last.input);
                channels.place_faults(&self.plant, &self.last.input);
                self.channels.replace(channels)
            }
        }
    }
}
