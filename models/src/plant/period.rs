//! A control period as a sequence of steps: substeps, compositions, and what is left of a period that had
//! to be halved.
//!
//! The input is held over the period. Prescribed coordinates move at a constant rate, so that the step from
//! the fraction `c` of the period ends with them at `(1 − c') k0 + c' k1`. The multipliers of a period are
//! the sums of those of its steps: they stay impulses.
//!
//! **Halving.** A period that cannot be solved in one go is solved again in 2, 4, … 256 times as many steps.
//! The next period begins with as many; after four that went well, half as many are tried. How often a
//! period was halved is in its report: it is another map then.

use crate::integrator::collocation::Collocation;
use crate::integrator::newton::{At, Workspace};
use crate::integrator::predictor::Past;
use crate::integrator::scheme::Scheme;
use crate::integrator::settings::{STEPS_MAX, Settings};
use crate::linearization::chain::Chain;
use crate::linearization::linearize::Linearization;
use crate::model::mechanism::Model;
use crate::model::signal::Target;
use crate::plant::facade::{Plant, PreciseState, StepError, StepReport, two_sum};

/// Periods that must go well before fewer steps are tried.
const CALM: u8 = 4;

/// What periods need beside the workspace of a step.
#[derive(Clone, Debug)]
pub(crate) struct Period {
    pub(crate) scheme: Scheme,
    pub(crate) collocation: Option<Box<Collocation>>,
    /// How far a period of several steps has got.
    reached: PreciseState,
    /// Whether the solution is there; else it is in the workspace.
    is_reached: bool,
    /// How often the last solution was halved, and whether it was tried with fewer steps.
    halvings: u8,
    failed: bool,
    pub(crate) input: StepInput,
    /// Multipliers of the steps, summed.
    multipliers: Vec<f64>,
    /// Momentum before an impulse, and what it had lost to rounding.
    pub(crate) before_impulse: Vec<[f64; 2]>,
    chain: Chain,
}

impl Period {
    pub(crate) fn new(model: &Model, scheme: Scheme, state: &PreciseState) -> Self {
        let collocation = match scheme {
            Scheme::Gauss(stages) => Some(Box::new(Collocation::new(model, stages))),
            Scheme::Midpoint | Scheme::Composition(_) => None,
        };
        Self {
            scheme,
            reached: state.clone(),
            is_reached: false,
            halvings: 0,
            failed: false,
            input: StepInput {
                numbers: vec![0.0; model.dimensions.input()],
                at_middle: collocation.is_none(),
            },
            collocation,
            multipliers: vec![0.0; model.dimensions.constraints],
            before_impulse: vec![[0.0; 2]; model.dimensions.dynamic],
            chain: Chain::default(),
        }
    }
}

impl StepError {
    /// Whether shorter steps may succeed.
    fn may_be_too_long(&self) -> bool {
        match self {
            Self::NotConverged { .. }
            | Self::NotFinite { .. }
            | Self::TooFast { .. }
            | Self::Singular { .. }
            | Self::SingularConstraints { .. } => true,
            Self::Dimension { .. }
            | Self::InputNotFinite { .. }
            | Self::TooManySteps { .. }
            | Self::InconsistentConstraints { .. } => false,
        }
    }
}

impl Plant {
    /// Solves the period, and linearizes it if asked to; stays where it is. The error is that of the
    /// shortest steps.
    pub(crate) fn solve(
        &mut self,
        u: &[f64],
        mut out: Option<&mut Linearization>,
    ) -> Result<StepReport, StepError> {
        self.model.check_input(u)?;
        if let Some(out) = &out {
            out.assert_model(&self.model);
        }
        let PreciseState { halvings, calm, .. } = self.state;
        let most = self.most_halvings();
        let first = (halvings - u8::from(halvings > 0 && calm >= CALM)).min(most);
        let mut failed = false;
        for halvings in first.. {
            let result = self.attempt(u, halvings, out.as_deref_mut());
            if self.period.is_reached {
                // It holds what belongs to a step within the period.
                self.workspace.forget();
            }
            match result {
                Ok(report) => {
                    self.period.halvings = halvings;
                    self.period.failed = failed;
                    let halvings = u32::from(halvings);
                    return Ok(StepReport { halvings, steps: report.steps.max(1), ..report });
                }
                Err(error) if halvings >= most || !error.may_be_too_long() => return Err(error),
                Err(_) => failed = true,
            }
        }
        unreachable!("the last attempt returns")
    }

    /// How often a period may be halved.
    fn most_halvings(&self) -> u8 {
        if self.model.turns_prescribed() {
            return 0;
        }
        let steps = self.settings.substeps as usize * self.period.scheme.steps();
        let fits = |halvings: &u32| steps << halvings <= STEPS_MAX;
        (0..=self.settings.halvings).rev().find(fits).unwrap_or_default() as u8
    }

    /// Solves the period in so many times two steps.
    fn attempt(
        &mut self,
        u: &[f64],
        halvings: u8,
        mut out: Option<&mut Linearization>,
    ) -> Result<StepReport, StepError> {
        let Self { model, settings, state, workspace, period } = self;
        let model = &**model;
        let h = settings.time_step_s;
        let count = (settings.substeps as usize) << halvings;
        let scheme = period.scheme;
        period.is_reached = count * scheme.steps() > 1 || halvings != state.halvings;
        if !period.is_reached {
            let u = period.input.of_step(model, state, h, u, [0.0, 1.0])?;
            let at = At { model, settings, state, u };
            return take(workspace, &mut period.collocation, at, state.time_after_s(0.0, h), out);
        }
        workspace.forget();
        period.reached.copy_from(state);
        if halvings != state.halvings {
            let ratio = f64::from(i32::from(state.halvings) - i32::from(halvings)).exp2();
            period.reached.past.stretch(ratio);
        }
        period.multipliers.fill(0.0);
        if let Some(out) = out.as_deref_mut() {
            period.chain.begin(model, out);
        }
        let mut report = StepReport {
            reciprocal_condition: 1.0,
            constraint_reciprocal_condition: 1.0,
            ..StepReport::default()
        };
        let mut fraction = 0.0;
        for substep in 0..count {
            for part in 0..scheme.steps() {
                let length = scheme.fraction(part) / count as f64;
                let is_last = part + 1 == scheme.steps();
                let end =
                    if is_last { (substep + 1) as f64 / count as f64 } else { fraction + length };
                let settings = Settings { time_step_s: length * h, ..*settings };
                let Period { reached, collocation, input, chain, .. } = &mut *period;
                let u = input.of_step(model, state, h, u, [fraction, end])?;
                let at = At { model, settings: &settings, state: reached, u };
                let start_s = state.time_after_s(fraction, h);
                let part_report = match out.as_deref_mut() {
                    None => take(workspace, collocation, at, start_s, None)?,
                    Some(out) => {
                        let part = chain.next_part(model, out, fraction, end);
                        let report = take(workspace, collocation, at, start_s, Some(part))?;
                        chain.go_on(out);
                        report
                    }
                };
                period.advance(model, workspace, settings.time_step_s);
                report.add(&part_report);
                fraction = end;
            }
        }
        period.reached.multipliers.copy_from_slice(&period.multipliers);
        if let Some(out) = out {
            period.chain.finish(h, out);
        }
        Ok(report)
    }

    /// Moves on to the solution.
    pub(crate) fn commit(&mut self) {
        let Self { model, settings, state, workspace, period } = self;
        let was = state.halvings;
        if period.is_reached {
            std::mem::swap(state, &mut period.reached);
        } else {
            state.move_on(model, workspace, period.collocation.as_deref(), settings.time_step_s);
        }
        let calm = period.halvings == was && !period.failed;
        state.calm = if calm { state.calm.saturating_add(1).min(CALM) } else { 0 };
        state.halvings = period.halvings;
        state.step = state.step.saturating_add(1);
        workspace.move_on();
    }
}

/// Takes a step and linearizes it if asked to; the solution is in the workspace.
#[inline]
fn take(
    workspace: &mut Workspace,
    collocation: &mut Option<Box<Collocation>>,
    at: At<'_>,
    start_s: f64,
    out: Option<&mut Linearization>,
) -> Result<StepReport, StepError> {
    let Some(collocation) = collocation else {
        let mut report = workspace.solve(at)?;
        if let Some(out) = out {
            workspace.linearize(at, out)?;
            workspace.estimates.write(&mut report);
        }
        return Ok(report);
    };
    let report = collocation.solve(workspace, at, start_s)?;
    if let Some(out) = out {
        collocation.linearize(workspace, at, out)?;
    }
    Ok(report)
}

/// Room for the input of a step, where it is not that of the period.
#[derive(Clone, Debug)]
pub(crate) struct StepInput {
    numbers: Vec<f64>,
    /// Whether signals on inputs are taken at the middle of the step; else the stages take them.
    at_middle: bool,
}

impl StepInput {
    /// The input of the step between two fractions of the period that starts from a state with the
    /// input `u`: signals replace prescribed positions at the end of the period.
    pub(crate) fn of_step<'a>(
        &'a mut self,
        model: &Model,
        start: &PreciseState,
        h: f64,
        u: &'a [f64],
        [from, to]: [f64; 2],
    ) -> Result<&'a [f64], StepError> {
        let has_signals = !model.signals.is_empty();
        if to == 1.0 && !has_signals {
            return Ok(u);
        }
        self.numbers.copy_from_slice(u);
        let (inputs, next) = self.numbers.split_at_mut(model.dimensions.inputs);
        if has_signals {
            model.replace_prescribed(start.time_after_s(1.0, h), next);
            if self.at_middle {
                model.add_input_signals(start.time_after_s(0.5 * (from + to), h), inputs);
            }
        }
        if to != 1.0 {
            for (next, begin) in next.iter_mut().zip(&start.q[model.dimensions.dynamic..]) {
                *next = begin + to * (*next - begin);
            }
        }
        if has_signals {
            model.check_input(&self.numbers)?;
        }
        Ok(&self.numbers)
    }
}

impl Period {
    /// Moves on to the solution of a step of length `h`.
    fn advance(&mut self, model: &Model, workspace: &mut Workspace, h: f64) {
        self.reached.move_on(model, workspace, self.collocation.as_deref(), h);
        for (sum, impulse) in self.multipliers.iter_mut().zip(&workspace.multipliers) {
            *sum += impulse;
        }
        workspace.move_on();
    }
}

impl PreciseState {
    /// Time after so many more steps of length `h`, s.
    pub(crate) fn time_after_s(&self, steps: f64, h: f64) -> f64 {
        self.time_origin_s + (self.step as f64 + steps) * h
    }

    /// Adds the solution in the workspace.
    fn move_on(
        &mut self,
        model: &Model,
        workspace: &Workspace,
        collocation: Option<&Collocation>,
        h: f64,
    ) {
        let nd = model.dimensions.dynamic;
        add(&mut self.q[..nd], &mut self.q_low, &workspace.increment);
        add(&mut self.p, &mut self.p_low, &workspace.impulse);
        self.q[nd..].copy_from_slice(&workspace.q_end[nd..]);
        if !model.orientations.is_empty() {
            workspace.turn(model, self);
        }
        self.v.copy_from_slice(&workspace.velocity[nd..]);
        self.multipliers.copy_from_slice(&workspace.multipliers);
        match (&mut self.past, collocation) {
            (Past::Stages(past), Some(collocation)) => past.record(collocation.motion()),
            (past, _) => past.record(h, &workspace.increment, &model.conditioning.inertia),
        }
    }
}

/// Adds changes to sums, with what rounding took from them.
fn add(sums: &mut [f64], low: &mut [f64], changes: &[f64]) {
    for ((sum, low), change) in sums.iter_mut().zip(low).zip(changes) {
        (*sum, *low) = two_sum(*sum, change + *low);
    }
}

impl StepReport {
    /// Adds a step of a period.
    fn add(&mut self, step: &Self) {
        self.iterations += step.iterations;
        self.factorizations += step.factorizations;
        self.residual = self.residual.max(step.residual);
        self.constraint_residual = self.constraint_residual.max(step.constraint_residual);
        self.reciprocal_condition = self.reciprocal_condition.min(step.reciprocal_condition);
        self.constraint_reciprocal_condition =
            self.constraint_reciprocal_condition.min(step.constraint_reciprocal_condition);
        self.redundant_constraints = self.redundant_constraints.max(step.redundant_constraints);
        self.steps += 1;
    }
}

impl Model {
    /// Adds what signals give to inputs at a time.
    pub(crate) fn add_input_signals(&self, time_s: f64, inputs: &mut [f64]) {
        for signal in &self.signals {
            if let Target::Input(i) = signal.target {
                inputs[i] += signal.at(time_s);
            }
        }
    }

    /// Replaces prescribed positions that signals drive by where they are at a time.
    pub(crate) fn replace_prescribed(&self, time_s: f64, prescribed: &mut [f64]) {
        for signal in &self.signals {
            if let Target::Prescribed(k) = signal.target {
                prescribed[k] = signal.at(time_s);
            }
        }
    }

    /// Whether ball joints are prescribed: they turn in one step.
    pub(crate) fn turns_prescribed(&self) -> bool {
        self.orientations.iter().any(|i| *i >= self.dimensions.dynamic)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::builtin;

    /// A snapshot may say that the last period was halved more often than its settings allow.
    #[test]
    fn periods_are_halved_no_more_often_than_settings_allow() {
        let model = Arc::new(Model::compile(&builtin::scene("pendulum").unwrap()).unwrap());
        let settings = Settings { halvings: 1, ..Settings::new(&model) };
        let mut plant = Plant::new(model, settings).unwrap();
        plant.state.halvings = 3;
        let report = plant.step(&[0.0]).unwrap();
        assert_eq!((report.halvings, report.steps), (1, 2));
    }
}
