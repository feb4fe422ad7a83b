//! A control period as a sequence of steps: substeps, and those of a period that had to be halved.
//!
//! The input is held over the period. Prescribed coordinates move at a constant rate, so that the step from
//! the fraction `c` of the period ends with them at `(1 − c') k0 + c' k1`. The multipliers of a period are
//! the sums of those of its steps: they stay impulses.
//!
//! **Halving.** A period that cannot be solved in one go is solved again in 2, 4, … 256 times as many steps.
//! The next period begins with as many; after four that went well, half as many are tried. How often a
//! period was halved is in its report: it is another map then.

use crate::integrator::collocation::Collocation;
use crate::integrator::report::StepError;
use crate::integrator::response::Response;
use crate::integrator::scheme::Scheme;
use crate::integrator::state::{PreciseState, add};
use crate::integrator::workspace::{StepIncrement, Workspace};
use crate::linearization::chain::Chain;
use crate::model::mechanism::Model;
use crate::model::signal::Target;

/// What periods need beside the workspace of a step.
#[derive(Clone, Debug)]
pub(crate) struct Period {
    pub(crate) scheme: Scheme,
    pub(crate) collocation: Option<Box<Collocation>>,
    /// How far a period of several steps has got.
    pub(crate) reached: PreciseState,
    /// Whether the solution is there; else it is in the workspace.
    pub(crate) is_reached: bool,
    /// How often the last solution was halved, and whether it was tried with fewer steps.
    pub(crate) halvings: u8,
    pub(crate) failed: bool,
    pub(crate) input: StepInput,
    /// Multipliers of the steps, summed.
    pub(crate) multipliers: Vec<f64>,
    /// Momentum before an impulse, and what it had lost to rounding.
    pub(crate) before_impulse: Vec<[f64; 2]>,
    pub(crate) chain: Chain,
}

impl Period {
    pub(crate) fn new(model: &Model, scheme: Scheme, state: &PreciseState) -> Self {
        let collocation = match scheme {
            Scheme::Gauss(stages) => Some(Box::new(Collocation::new(model, stages))),
            Scheme::Midpoint => None,
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
    /// Moves on to the solution of a step.
    pub(crate) fn advance(&mut self, model: &Model, workspace: &mut Workspace) {
        self.reached.move_on(model, workspace, self.collocation.as_deref());
        for (sum, impulse) in self.multipliers.iter_mut().zip(&workspace.step.multipliers) {
            *sum += impulse;
        }
        workspace.move_on();
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

impl PreciseState {
    /// Adds the solution in the workspace.
    pub(crate) fn move_on(
        &mut self,
        model: &Model,
        workspace: &Workspace,
        collocation: Option<&Collocation>,
    ) {
        if collocation.is_none() && self.move_few_on(model, workspace).is_some() {
            return;
        }
        let d = model.dimensions;
        let nd = d.dynamic;
        add(&mut self.q[..nd], &mut self.q_low, &workspace.step.increment);
        add(&mut self.p, &mut self.p_low, &workspace.step.impulse);
        if d.prescribed > 0 {
            self.q[nd..].copy_from_slice(&workspace.step.q_end[nd..]);
            self.v.copy_from_slice(&workspace.mid.velocity[nd..]);
        }
        if !model.orientations.is_empty() {
            workspace.turn(model, self);
        }
        if d.constraints > 0 {
            self.multipliers.copy_from_slice(&workspace.step.multipliers);
        }
        match collocation {
            Some(collocation) => self.past.record_stages(&collocation.motion),
            None => {
                let inertia = &model.conditioning.inertia;
                let Response { pushed, point, .. } = &workspace.response;
                let StepIncrement { increment, report, .. } = &workspace.step;
                self.past.record(increment, inertia, pushed, report.iterations);
                self.past.point.follow(point);
            }
        }
    }
}
