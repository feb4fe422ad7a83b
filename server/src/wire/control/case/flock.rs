//! Cases with nothing but inputs, several at a time: where the mechanics can, they go side by side in wide registers,
//! each to the same bits as by itself.

use std::sync::Arc;

use plantd_models::{Fleet, Plant};

use crate::core::workers::pool::Abandoned;
use crate::wire::control::case::{Case, Ended, Machine, Shared, Simulation};
use crate::wire::message::states;
use crate::wire::status::RpcError;

/// Cases side by side, at most.
pub(crate) const ABREAST: usize = 8;

/// Cases on their way together.
pub(crate) struct Flock {
    cases: Vec<Simulation>,
    /// Made in the first part.
    fleet: Option<Fleet>,
    /// Of all plants, one after the other.
    inputs: Vec<f64>,
    /// Cases that have a plant, by its index.
    moving: Vec<usize>,
    /// Steps that all have taken that have not ended.
    taken: usize,
}

/// Whether cases may go together: it is enough to look at their plants at the end, or for the state alone.
pub(crate) fn may_go_together(shared: &Shared) -> bool {
    shared.every.is_none() && shared.expected.is_none()
}

impl Flock {
    /// The cases have nothing but inputs.
    pub(crate) fn new(cases: Vec<Case>, shared: &Arc<Shared>) -> Self {
        let begin = |case| Simulation::new(case, Arc::clone(shared));
        let cases: Vec<_> = cases.into_iter().map(begin).collect();
        Self { cases, fleet: None, inputs: Vec::new(), moving: Vec::new(), taken: 0 }
    }

    /// Goes on for a part; the answers when all have ended.
    pub(crate) fn go_on(&mut self, abandoned: &Abandoned) -> Result<Option<Vec<Ended>>, RpcError> {
        if self.fleet.is_none() {
            self.begin(abandoned)?;
        }
        while self.step()? {
            if abandoned.part_is_over()? {
                return Ok(None);
            }
        }
        let plants = self.fleet.take().map(Fleet::into_plants).unwrap_or_default();
        for (case, plant) in self.moving.iter().zip(plants) {
            self.cases[*case].end(plant)?;
        }
        Ok(Some(self.cases.iter_mut().map(Simulation::ended).collect()))
    }

    fn begin(&mut self, abandoned: &Abandoned) -> Result<(), RpcError> {
        let mut plants = Vec::with_capacity(self.cases.len());
        for (index, case) in self.cases.iter_mut().enumerate() {
            match case.begin(abandoned) {
                Ok(()) => {}
                Err(fault) if fault.reason() == "CANCELLED" => return Err(fault),
                Err(fault) => case.response.failure = Some(fault.into()),
            }
            if let Some(Machine::Map(plant)) = case.machine.take() {
                self.inputs.extend_from_slice(case.input());
                self.moving.push(index);
                plants.push(*plant);
            }
        }
        self.fleet = Some(Fleet::new(plants));
        Ok(())
    }

    /// Takes a step with each case that has not ended; false when all have.
    fn step(&mut self) -> Result<bool, RpcError> {
        let Self { cases, fleet: Some(fleet), inputs, moving, taken } = self else {
            return Err(RpcError::internal("cases that have not begun"));
        };
        let now = *taken;
        let goes_on = |case: &Simulation| {
            case.taken == now && case.taken < case.case.steps && case.response.failure.is_none()
        };
        let mut any = false;
        for (place, index) in moving.iter().enumerate() {
            let case = &mut cases[*index];
            let is_over = !goes_on(case);
            fleet.rest(place, is_over);
            if !is_over {
                let width = case.input().len();
                inputs[place * width..][..width].copy_from_slice(case.input());
                case.count_cost();
                any = true;
            }
        }
        if !any {
            return Ok(false);
        }
        for (index, result) in moving.iter().zip(fleet.step(inputs)) {
            let case = &mut cases[*index];
            if goes_on(case) {
                match result {
                    Ok(_) => case.taken += 1,
                    Err(error) => {
                        case.response.failure = Some(RpcError::from(error.clone()).into())
                    }
                }
            }
        }
        *taken += 1;
        for (place, index) in moving.iter().enumerate() {
            let case = &mut cases[*index];
            if case.taken == *taken && case.is_looked_at() {
                case.x = states::x(fleet.plant(place));
                case.note_extremes();
            }
        }
        Ok(true)
    }
}

impl Simulation {
    /// What is said of the last state of its plant.
    fn end(&mut self, plant: Plant) -> Result<(), RpcError> {
        self.machine = Some(Machine::Map(Box::new(plant)));
        self.sum_up()
    }
}
