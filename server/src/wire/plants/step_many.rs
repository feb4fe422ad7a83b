//! `PlantService.StepMany`: many plants in one call, as many at a time as there are workers.

use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

use futures::future;
use plantd_proto::v1;

use crate::core::driver::DriverKind;
use crate::core::inputs::hold_input;
use crate::core::limits::LimitExceeded;
use crate::core::plant::core::Core;
use crate::core::session::lease::Lease;
use crate::core::session::shared::Session;
use crate::core::workers::pool::Abandoned;
use crate::core::workers::queue::Admission;
use crate::wire::message::plant_info::{INLINE_INSTRUCTIONS_MAX, INLINE_TIME_MAX};
use crate::wire::message::states;
use crate::wire::shared::hub::Hub;
use crate::wire::status::RpcError;

/// Answers a StepMany call.
pub(crate) async fn step_many(
    hub: &Arc<Hub>,
    request: v1::StepManyRequest,
) -> Result<v1::StepManyResponse, RpcError> {
    let (turns, instructions) = turns(hub, request)?;
    if instructions <= INLINE_INSTRUCTIONS_MAX {
        // What is left after a while is work after all.
        let began = Instant::now();
        let mut share = Share::new(turns);
        let plants = match share.go_on(|| Ok(began.elapsed() >= INLINE_TIME_MAX))? {
            Some(plants) => plants,
            None => hub.steppers.in_parts(Admission::Bounded, in_turns(share)).await?,
        };
        return Ok(v1::StepManyResponse { plants });
    }
    let shares = shares(turns, instructions, hub.steppers.count());
    let stepped = shares.into_iter().enumerate().map(|(i, share)| {
        let admission = if i == 0 { Admission::Bounded } else { Admission::Granted };
        hub.steppers.in_parts(admission, in_turns(share))
    });
    let plants = future::try_join_all(stepped).await?.into_iter().flatten().collect();
    Ok(v1::StepManyResponse { plants })
}

fn in_turns(
    mut share: Share,
) -> impl FnMut(&Abandoned) -> Result<Option<Vec<v1::SteppedPlant>>, RpcError> {
    move |abandoned| share.go_on(|| Ok(abandoned.part_is_over()?))
}

/// A plant that is to be stepped.
struct Turn {
    session: Arc<Session>,
    /// Empty for no forces.
    u: Vec<f64>,
    steps: u32,
    instructions: f64,
}

/// The plants of a checked request, and about how many instructions their steps take together.
fn turns(hub: &Hub, request: v1::StepManyRequest) -> Result<(Vec<Turn>, f64), RpcError> {
    let v1::StepManyRequest { ids, u, steps } = request;
    let (limits, steps) = (&hub.limits, steps.max(1));
    if ids.is_empty() {
        return Err(RpcError::field("ids", "are missing: at least one plant is needed"));
    }
    let all_steps = ids.len().saturating_mul(steps as usize);
    LimitExceeded::check("steps_per_call", limits.steps_per_call, "steps", all_steps)?;
    let mut places = HashMap::with_capacity(ids.len());
    let mut sessions = Vec::with_capacity(ids.len());
    let (mut entries, mut numbers) = (0, 0);
    for (i, id) in ids.iter().enumerate() {
        if let Some(first) = places.insert(id.as_str(), i) {
            let problem = format!("is `{id}`, as ids[{first}] is; each plant is stepped once");
            return Err(RpcError::field(format!("ids[{i}]"), problem));
        }
        let session = hub.session(id)?;
        let dimensions = session.model().dimensions();
        let range = entries..entries + dimensions.input();
        entries = range.end;
        numbers += states::state_numbers(dimensions);
        sessions.push((session, range));
    }
    LimitExceeded::check("reply_numbers", limits.reply_numbers, "numbers in all states", numbers)?;
    if !u.is_empty() && u.len() != entries {
        let problem = format!(
            "has {} entries; the {} plants take {entries} together, or none",
            u.len(),
            ids.len()
        );
        return Err(RpcError::field("u", problem));
    }
    let turn = |(session, range): (Arc<Session>, Range<usize>)| {
        let instructions = session.step_instructions() * f64::from(steps);
        let u = u.get(range).unwrap_or_default().to_vec();
        Turn { session, u, steps, instructions }
    };
    let turns: Vec<Turn> = sessions.into_iter().map(turn).collect();
    let instructions = turns.iter().map(|turn| turn.instructions).sum();
    Ok((turns, instructions))
}

/// The plants in their order, cut into shares of about the same work.
fn shares(turns: Vec<Turn>, instructions: f64, count: usize) -> Vec<Share> {
    let most = instructions / count.max(1) as f64;
    let (mut shares, mut share, mut work) = (Vec::new(), Vec::new(), 0.0);
    for turn in turns {
        work += turn.instructions;
        share.push(turn);
        if work >= most {
            shares.push(Share::new(std::mem::take(&mut share)));
            work = 0.0;
        }
    }
    if !share.is_empty() {
        shares.push(Share::new(share));
    }
    shares
}

/// Plants that are stepped one after the other, on their way.
struct Share {
    turns: std::vec::IntoIter<Turn>,
    /// The plant whose turn it is.
    present: Option<Stepping>,
    done: Vec<v1::SteppedPlant>,
}

struct Stepping {
    lease: Lease,
    u: Vec<f64>,
    steps: u32,
    answer: v1::SteppedPlant,
}

impl Share {
    fn new(turns: Vec<Turn>) -> Self {
        Self { done: Vec::with_capacity(turns.len()), turns: turns.into_iter(), present: None }
    }

    /// Goes on until all plants are stepped, or `is_over` after a step of one.
    fn go_on(
        &mut self,
        is_over: impl Fn() -> Result<bool, RpcError>,
    ) -> Result<Option<Vec<v1::SteppedPlant>>, RpcError> {
        loop {
            let mut present = match self.present.take() {
                Some(present) => present,
                None => {
                    let Some(turn) = self.turns.next() else {
                        return Ok(Some(std::mem::take(&mut self.done)));
                    };
                    let session = Arc::clone(&turn.session);
                    match Stepping::begin(turn) {
                        Ok(begun) => begun,
                        Err(fault) => {
                            self.done.push(failed(&session, v1::SteppedPlant::default(), fault));
                            continue;
                        }
                    }
                }
            };
            match present.step() {
                Err(fault) => {
                    let session = Arc::clone(present.lease.session());
                    self.done.push(failed(&session, present.answer, fault));
                }
                Ok(()) if present.answer.steps == present.steps => self.done.push(present.answer),
                Ok(()) => self.present = Some(present),
            }
            if is_over()? {
                return Ok(None);
            }
        }
    }
}

impl Stepping {
    fn begin(turn: Turn) -> Result<Self, RpcError> {
        let lease = turn.session.acquire(DriverKind::Step)?;
        let u = match turn.u.is_empty() {
            true => lease
                .look(|core| hold_input(core.plant()))
                .map_err(|error| RpcError::from_drive(error, lease.session()))?,
            false => turn.u,
        };
        Ok(Self { lease, u, steps: turn.steps, answer: v1::SteppedPlant::default() })
    }

    fn step(&mut self) -> Result<(), RpcError> {
        let Self { lease, u, steps, answer } = self;
        let is_last = answer.steps + 1 == *steps;
        let look = |core: &mut Core| {
            if is_last {
                answer.state = Some(states::shown(&core.published()));
                answer.u = core.applied_input().map(<[f64]>::to_vec).unwrap_or_default();
                answer.outputs = states::core_outputs(core);
            }
        };
        let stepped = lease.step_and(u, None, look);
        stepped.map_err(|error| RpcError::from_drive(error, lease.session()))?;
        answer.steps += 1;
        Ok(())
    }
}

/// The answer of a plant that stands where it was when its step failed.
fn failed(session: &Session, answer: v1::SteppedPlant, fault: RpcError) -> v1::SteppedPlant {
    let state = Some(states::shown(&session.frame().published()));
    v1::SteppedPlant { state, failure: Some(fault.into()), ..answer }
}
