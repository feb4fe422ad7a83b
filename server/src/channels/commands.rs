//! What is done with the channels and faults of a session.
//!
//! Memory is taken before and given back after; in the core's hands things only change places.

use std::ops::Range;
use std::sync::Arc;

use plantd_models::{Model, Plant, Settings, Site};
use plantd_proto::v1;
use v1::fault_spec::{Kind, Target};
use v1::output_channel::Source;

use super::Channels;
use super::declare::{self, check_numbers};
use super::fault::{Effect, Injected, Start};
use crate::limits::{LimitExceeded, Limits};
use crate::session::{Core, Session};
use crate::status::Fault;

/// What a session's channels and faults were made from.
#[derive(Default)]
struct Present {
    declared: Arc<v1::Channels>,
    info: Arc<v1::ChannelsInfo>,
    faults: Vec<PresentFault>,
    numbers: usize,
    is_there: bool,
}

struct PresentFault {
    id: u64,
    given: Arc<v1::FaultSpec>,
    start: Start,
    is_over: bool,
}

impl Present {
    fn of(core: &Core) -> Self {
        let Some(channels) = &core.channels else { return Self::default() };
        let step = core.plant.step_index();
        let fault = |fault: &Injected| PresentFault {
            id: fault.id,
            given: Arc::clone(&fault.given),
            start: fault.start,
            is_over: fault.schedule.is_over(step),
        };
        Self {
            declared: Arc::clone(&channels.declared),
            info: Arc::clone(&channels.info),
            faults: channels.faults.iter().map(fault).collect(),
            numbers: channels.numbers(),
            is_there: true,
        }
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
    ) -> Result<(Arc<v1::ChannelsInfo>, Vec<f64>), Fault> {
        let _replacing = self.replacing();
        let present = self.with_core(|core| Present::of(core));
        let mut channels = declare::channels(declared, &mut self.copy_plant(), limits)?;
        // Where the faults of outputs go.
        let places: Vec<Option<(usize, Range<usize>)>> = present
            .faults
            .iter()
            .map(|fault| match &fault.given.target {
                Some(Target::Output(name)) => declare::output(&channels.info, name),
                _ => Some((0, 0..0)),
            })
            .collect();
        channels.faults.reserve_exact(places.len());
        let info = Arc::clone(&channels.info);
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
            channels.begin(&mut core.plant, &core.input);
            let output = channels.output().to_vec();
            core.channels = (!channels.is_empty()).then(|| Box::new(channels));
            (former, output)
        });
        drop(former);
        Ok((info, output))
    }

    /// The channels with what they deliver.
    pub fn channels(&self) -> (Arc<v1::ChannelsInfo>, v1::Outputs) {
        self.with_core(|core| {
            let info = core.channels.as_ref().map(|channels| Arc::clone(&channels.info));
            (info.unwrap_or_default(), core.outputs().unwrap_or_default())
        })
    }

    /// Injects a fault.
    pub fn inject_fault(
        &self,
        given: v1::FaultSpec,
        limits: &Limits,
    ) -> Result<v1::FaultInfo, Fault> {
        let _replacing = self.replacing();
        let (present, id, mechanics) =
            self.with_core(|core| (Present::of(core), core.faults + 1, core.mechanics()));
        let is_over = |fault: &&PresentFault| fault.is_over;
        let count = present.faults.len() + 1;
        let excess = count.saturating_sub(Limits::size(limits.faults));
        let gone: Vec<u64> =
            present.faults.iter().filter(is_over).take(excess).map(|fault| fault.id).collect();
        LimitExceeded::check("faults", limits.faults, "faults", count - gone.len())?;
        let time_step_s = mechanics.settings.time_step_s;
        let fault =
            declare::fault(id, given, &mechanics.model, time_step_s, &present.info, limits)?;
        check_numbers(present.numbers.saturating_add(fault.numbers()), limits)?;
        let spare = if present.is_there {
            None
        } else {
            let none = v1::Channels::default();
            Some(Box::new(declare::channels(none, &mut self.copy_plant(), limits)?))
        };
        let room = Vec::with_capacity(count);
        let (info, former) = self
            .with_core(move |core| {
                core.faults = id;
                let channels = match &mut core.channels {
                    Some(channels) => channels,
                    none => none.insert(spare?),
                };
                let mut former = std::mem::replace(&mut channels.faults, room);
                // Those that are over stay behind.
                for kept in former.extract_if(.., |fault| !gone.contains(&fault.id)) {
                    channels.faults.push(kept);
                }
                let mut fault = fault;
                fault.place(&core.plant, &core.input, channels.output());
                let info = fault.info(core.plant.step_index(), time_step_s);
                channels.faults.push(fault);
                Some((info, former))
            })
            .ok_or_else(|| Fault::internal("channels are gone"))?;
        drop(former);
        Ok(info)
    }

    /// Clears a fault, or with 0 all of them; returns how many.
    pub fn clear_fault(&self, id: u64) -> Result<u32, Fault> {
        let _replacing = self.replacing();
        let count = self.with_core(|core| core.channels.as_ref().map_or(0, |c| c.faults.len()));
        let room = Vec::with_capacity(count);
        let (former, spent) = self.with_core(move |core| {
            let Some(channels) = &mut core.channels else { return (Vec::new(), None) };
            let mut former = std::mem::replace(&mut channels.faults, room);
            for kept in former.extract_if(.., |fault| id != 0 && fault.id != id) {
                channels.faults.push(kept);
            }
            let spent = if channels.is_empty() { core.channels.take() } else { None };
            (former, spent)
        });
        drop(spent);
        if former.is_empty() && id != 0 {
            return Err(Fault::fault_not_found(id));
        }
        Ok(former.len() as u32)
    }

    /// The faults.
    pub fn faults(&self) -> Vec<v1::FaultInfo> {
        self.with_core(|core| {
            let (step, h) = (core.plant.step_index(), core.plant.settings().time_step_s);
            let faults = core.channels.iter().flat_map(|channels| &channels.faults);
            faults.map(|fault| fault.info(step, h)).collect()
        })
    }

    /// What the channels become with another model or other settings. The caller holds `replacing`.
    pub(crate) fn renewed_channels(
        &self,
        model: &Arc<Model>,
        settings: Settings,
        limits: &Limits,
    ) -> Result<Renewed, Fault> {
        let (present, time_step_s) =
            self.with_core(|core| (Present::of(core), core.plant.settings().time_step_s));
        if !present.is_there {
            return Ok(Renewed::Nothing);
        }
        if settings.time_step_s == time_step_s {
            return Ok(Renewed::Sites(sites(model, &present)));
        }
        let mut plant = Plant::new(Arc::clone(model), settings)
            .map_err(|error| Fault::from_initial(error, "parameters"))?;
        let mut channels = declare::channels((*present.declared).clone(), &mut plant, limits)?;
        for PresentFault { id, given, start, .. } in present.faults {
            let (given, h) = ((*given).clone(), settings.time_step_s);
            let mut fault = declare::fault(id, given, model, h, &channels.info, limits)?;
            fault.start = start;
            channels.faults.push(fault);
        }
        check_numbers(channels.numbers(), limits)?;
        Ok(Renewed::All(Box::new(channels)))
    }
}

/// The sites of all outputs and pushes, in the order of [`Channels::sites_mut`].
fn sites(model: &Model, present: &Present) -> Vec<Site> {
    let point = |point: &v1::FramePoint| {
        let at = <[f64; 3]>::try_from(&point.at[..]).unwrap_or_default();
        model.site(&point.frame, at)
    };
    let outputs = present.declared.outputs.iter().filter_map(|output| match &output.source {
        Some(Source::Position(at)) => point(at),
        Some(Source::Orientation(frame)) => model.site(frame, [0.0; 3]),
        _ => None,
    });
    let pushes = present.faults.iter().filter_map(|fault| match &fault.given.kind {
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
                channels.begin(&mut self.plant, &self.input);
                let mut faults = std::mem::take(&mut channels.faults);
                for fault in &mut faults {
                    fault.place(&self.plant, &self.input, channels.output());
                }
                channels.faults = faults;
                self.channels.replace(channels)
            }
        }
    }
}
