//! A control period solved: its steps, halved as often as it takes.

use crate::integrator::collocation::Collocation;
use crate::integrator::report::{StepError, StepReport};
use crate::integrator::settings::{STEPS_MAX, Settings};
use crate::integrator::state::PreciseState;
use crate::integrator::workspace::{StepContext, Workspace};
use crate::linearization::linearize::Linearization;
use crate::plant::facade::Plant;
use crate::plant::period::Period;

impl Plant {
    /// Solves the period, and linearizes it if asked to; stays where it is. The report is in the workspace. The
    /// error is that of the shortest steps.
    pub(crate) fn solve(
        &mut self,
        u: &[f64],
        mut out: Option<&mut Linearization>,
    ) -> Result<(), StepError> {
        self.model.check_input(u)?;
        if let Some(out) = &out {
            out.assert_model(&self.model);
        }
        let first = match self.state {
            PreciseState { halvings: 0, .. } => 0,
            PreciseState { halvings, calm, .. } => {
                (halvings - u8::from(calm >= CALM)).min(self.most_halvings())
            }
        };
        let mut failed = false;
        for halvings in first.. {
            let result = self.attempt(u, halvings, out.as_deref_mut());
            if self.period.is_reached {
                // It holds what belongs to a step within the period.
                self.workspace.forget();
            }
            match result {
                Ok(()) => {
                    self.period.halvings = halvings;
                    self.period.failed = failed;
                    let report = &mut self.workspace.step.report;
                    (report.halvings, report.steps) = (halvings.into(), report.steps.max(1));
                    return Ok(());
                }
                Err(error) if !error.may_be_too_long() || halvings >= self.most_halvings() => {
                    return Err(error);
                }
                Err(_) => failed = true,
            }
        }
        unreachable!("the last attempt returns")
    }

    /// How often a period may be halved.
    pub(crate) fn most_halvings(&self) -> u8 {
        if self.model.turns_prescribed() {
            return 0;
        }
        let steps = self.settings.substeps as usize;
        let fits = |halvings: &u32| steps << halvings <= STEPS_MAX;
        (0..=self.settings.halvings).rev().find(fits).unwrap_or_default() as u8
    }

    /// Solves the period in so many times two steps.
    pub(crate) fn attempt(
        &mut self,
        u: &[f64],
        halvings: u8,
        mut out: Option<&mut Linearization>,
    ) -> Result<(), StepError> {
        let Self { model, settings, state, workspace, period } = self;
        let model = &**model;
        let h = settings.time_step_s;
        let count = (settings.substeps as usize) << halvings;
        period.is_reached = count > 1 || halvings != state.halvings;
        if !period.is_reached {
            let u = period.input.of_step(model, state, h, u, [0.0, 1.0])?;
            let at = StepContext { model, settings, state, u };
            return take(workspace, &mut period.collocation, at, state.time_after_s(0.0, h), out);
        }
        workspace.forget();
        period.reached.copy_from(state);
        if halvings != state.halvings {
            let ratio = f64::from(i32::from(state.halvings) - i32::from(halvings)).exp2();
            period.reached.past.stretch(ratio);
        }
        if period.collocation.is_some() {
            // What one step has of the impulses.
            let share = 1.0 / count as f64;
            period.reached.multipliers.iter_mut().for_each(|lambda| *lambda *= share);
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
        let settings = Settings { time_step_s: 1.0 / count as f64 * h, ..*settings };
        for substep in 0..count {
            let [fraction, end] = [substep, substep + 1].map(|k| k as f64 / count as f64);
            let Period { reached, collocation, input, chain, .. } = &mut *period;
            let u = input.of_step(model, state, h, u, [fraction, end])?;
            let at = StepContext { model, settings: &settings, state: reached, u };
            let start_s = state.time_after_s(fraction, h);
            match out.as_deref_mut() {
                None => take(workspace, collocation, at, start_s, None)?,
                Some(out) => {
                    let part = chain.next_part(model, out, fraction, end);
                    take(workspace, collocation, at, start_s, Some(part))?;
                    chain.go_on(out);
                }
            }
            period.advance(model, workspace);
            report.add(&workspace.step.report);
        }
        period.reached.multipliers.copy_from_slice(&period.multipliers);
        if let Some(out) = out {
            period.chain.finish(h, out);
        }
        workspace.step.report = report;
        Ok(())
    }

    /// Moves on to the solution.
    pub(crate) fn commit(&mut self) {
        let Self { model, state, workspace, period, .. } = self;
        let was = state.halvings;
        if period.is_reached {
            std::mem::swap(state, &mut period.reached);
        } else {
            state.move_on(model, workspace, period.collocation.as_deref());
        }
        let calm = period.halvings == was && !period.failed;
        state.calm = if calm { state.calm.saturating_add(1).min(CALM) } else { 0 };
        state.halvings = period.halvings;
        state.step = state.step.saturating_add(1);
        workspace.move_on();
    }
}

/// Takes a step and linearizes it if asked to; the solution is in the workspace, with its report.
#[inline]
pub(crate) fn take(
    workspace: &mut Workspace,
    collocation: &mut Option<Box<Collocation>>,
    at: StepContext<'_>,
    start_s: f64,
    out: Option<&mut Linearization>,
) -> Result<(), StepError> {
    let Some(collocation) = collocation else {
        workspace.solve(at)?;
        if let Some(out) = out {
            workspace.linearize(at, out)?;
            workspace.kkt.estimates.write(&mut workspace.step.report);
        }
        return Ok(());
    };
    collocation.solve(workspace, at, start_s)?;
    if let Some(out) = out {
        collocation.linearize(workspace, at, out)?;
    }
    Ok(())
}

/// Periods that must go well before fewer steps are tried.
pub(crate) const CALM: u8 = 4;

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::integrator::predictor::Past;
    use crate::integrator::scheme::Scheme;
    use crate::model::mechanism::Model;
    use plantd_scene::builtin;

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

    /// With one stage, collocation is the midpoint rule, with its impulses.
    #[test]
    fn one_stage_is_the_midpoint_rule() {
        for name in ["pendulum", "four-bar", "marionette"] {
            let model = Arc::new(Model::compile(&builtin::scene(name).unwrap()).unwrap());
            let mut midpoint = Plant::new(model.clone(), Settings::new(&model)).unwrap();
            let mut gauss = midpoint.clone();
            let scheme = Scheme::Gauss(1);
            gauss.state.past = Past::new(scheme, &model);
            gauss.period = Period::new(&model, scheme, &gauss.state);
            let mut outs = [Linearization::new(&model), Linearization::new(&model)];
            let near = |a: &[f64], b: &[f64], what: &str| {
                let size = a.iter().fold(1.0_f64, |most, x| most.max(x.abs()));
                let error = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                assert!(error < 1e-11 * size, "{name}: {what} by {error:e}");
            };
            for k in 0..40 {
                let wave = |i: usize| 0.1 * (0.3 * f64::from(k) + i as f64).sin();
                let d = model.dimensions;
                let mut u: Vec<f64> = (0..d.inputs).map(wave).collect();
                let held = model.coordinates[d.dynamic..].iter().enumerate();
                u.extend(held.map(|(i, c)| c.initial + 0.1 * (wave(i) - 0.1 * (i as f64).sin())));
                midpoint.step_and_linearize(&u, &mut outs[0]).unwrap();
                gauss.step_and_linearize(&u, &mut outs[1]).unwrap();
            }
            near(midpoint.q(), gauss.q(), "q");
            near(midpoint.p(), gauss.p(), "p");
            near(midpoint.multipliers(), gauss.multipliers(), "λ");
            let [a, b] = &outs;
            for (a, b, what) in [
                (a.a(), b.a(), "A"),
                (a.b(), b.b(), "B"),
                (a.multipliers_x(), b.multipliers_x(), "λ by x"),
                (a.multipliers_u(), b.multipliers_u(), "λ by u"),
            ] {
                near(a.as_slice(), b.as_slice(), what);
            }
        }
    }
}
