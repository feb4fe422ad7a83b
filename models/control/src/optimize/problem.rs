//! What does not change during a search: the cost, and the initial states that may be.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use plantd_models::{Model, Plant, State};

use crate::optimize::bounds::{BoundPenalty, Quantity};
use crate::optimize::chart;
use crate::optimize::error::OptimizeError;
use crate::optimize::products::{WeightShape, dot};
use crate::optimize::specification::{Bounds, FreeInitialState, TrajectoryCost};
use crate::optimize::trajectory::{Trajectory, rows};
use crate::weights::{Momentum, StageWeights, TrajectoryWeights, Weights};

/// Deviations from what is desired, and what the weights make of them, of one step.
#[derive(Clone, Debug)]
pub(super) struct Deviation {
    /// `x ⊖ x_desired`, of projected momenta where these are weighed.
    pub(super) x: Vec<f64>,
    /// `u − u_desired`.
    u: Vec<f64>,
    /// `Q dx + S du + x_linear`.
    pub(super) by_x: Vec<f64>,
    /// `R du + Sᵀ dx + u_linear`.
    pub(super) by_u: Vec<f64>,
    /// At `x`; none where the state's own momentum is weighed.
    pub(super) projector: Option<Box<Plant>>,
}

#[derive(Debug)]
pub(super) struct Problem {
    pub(super) model: Arc<Model>,
    pub(super) steps: usize,
    pub(super) states: usize,
    pub(super) inputs: usize,
    weights: TrajectoryWeights,
    shapes: Vec<[WeightShape; 2]>,
    final_shape: WeightShape,
    /// Projects momenta; none where the state's own are weighed.
    projector: Option<Box<Plant>>,
    /// With projected momenta where these are weighed.
    x_desired: Vec<f64>,
    u_desired: Vec<f64>,
    pub(super) initial: InitialChoice,
    /// No step costs less than nothing.
    pub(super) is_nonnegative: bool,
}

/// Which initial states there are to choose from.
#[derive(Debug)]
pub(super) struct InitialChoice {
    /// The initial state of the guess.
    pub(super) reference: State,
    /// Which entries of `x[0]` may change; none where it is given.
    pub(super) free: Option<Vec<bool>>,
    /// Weight of its change.
    pub(super) weight: Option<DMatrix<f64>>,
}

/// Where a cost is evaluated and differentiated.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point<'a> {
    pub(super) problem: &'a Problem,
    pub(super) bounds: &'a BoundPenalty,
    pub(super) motion: &'a Trajectory,
}

impl Problem {
    pub(super) fn new(
        plant: &Plant,
        steps: usize,
        cost: TrajectoryCost,
        free: Option<FreeInitialState>,
        reference: State,
    ) -> Result<Self, OptimizeError> {
        let model = Arc::clone(plant.model());
        let d = model.dimensions();
        let (states, inputs) = (d.state(), d.input());
        OptimizeError::check("the desired x", &cost.x, (steps + 1, states))?;
        OptimizeError::check("the desired u", &cost.u, (steps, inputs))?;
        let weights = cost.weights;
        weights.stage(0).check_system(states, inputs)?;
        if let Some(actual) = weights.steps().filter(|actual| *actual != steps) {
            return Err(OptimizeError::Stages { actual, expected: steps });
        }
        let own = weights.steps().unwrap_or(1);
        let shapes = |k| [weights.stage(k).q(), weights.stage(k).r()].map(WeightShape::new);
        let shapes = (0..own).map(shapes).collect();
        let plain = |stage: &StageWeights| {
            stage.is_convex() && stage.x_linear().is_none() && stage.u_linear().is_none()
        };
        let is_nonnegative = (0..own).all(|k| plain(weights.stage(k)));
        let initial = InitialChoice::new(free, reference, states)?;
        let projects = cost.momentum == Momentum::Projected && d.constraints > 0;
        let mut projector = projects.then(|| Box::new(plant.clone()));
        let x_desired = desired_states(&cost.x, projector.as_deref_mut())?;
        Ok(Self {
            steps,
            states,
            inputs,
            shapes,
            final_shape: WeightShape::new(weights.q_final()),
            x_desired,
            projector,
            u_desired: rows(&cost.u),
            weights,
            initial,
            is_nonnegative,
            model,
        })
    }

    /// The penalties of bounds, each in the unit of the weight of its entry.
    pub(super) fn penalize(&self, bounds: &Bounds) -> Result<BoundPenalty, OptimizeError> {
        let scale = |quantity, index| {
            let stage = self.weights.stage(0);
            let all = match quantity {
                Quantity::State => stage.q().diagonal(),
                Quantity::Input => stage.r().diagonal(),
                Quantity::FinalState => self.weights.q_final().diagonal(),
            };
            let positive = all.iter().filter(|weight| **weight > 0.0);
            let mean = positive.clone().sum::<f64>() / positive.count().max(1) as f64;
            match all[index] {
                weight if weight > 0.0 => weight,
                _ if mean > 0.0 => mean,
                _ => 1.0,
            }
        };
        let sizes = (self.states, self.inputs);
        BoundPenalty::new(bounds, sizes, self.steps, self.model.orientations(), scale)
    }

    pub(super) fn deviation(&self) -> Deviation {
        let (x, u) = (vec![0.0; self.states], vec![0.0; self.inputs]);
        Deviation { by_x: x.clone(), by_u: u.clone(), x, u, projector: self.projector.clone() }
    }

    pub(super) fn stage(&self, k: usize) -> &StageWeights {
        self.weights.stage(k)
    }

    /// Whether these are the second derivatives of all steps.
    pub(super) fn has_weights(&self, weights: &Weights) -> bool {
        let (own, other) = (self.weights.stage(0), weights.stage());
        self.weights.steps().is_none()
            && (own.q(), own.r(), own.s()) == (other.q(), other.r(), other.s())
            && self.weights.q_final() == weights.q_final()
    }

    pub(super) fn q_final(&self) -> &DMatrix<f64> {
        self.weights.q_final()
    }

    /// `x ⊖ reference`, of whole states.
    pub(super) fn difference(&self, reference: &[f64], x: &[f64], out: &mut [f64]) {
        self.model.write_state_difference(reference, x, out);
    }

    /// Change of an initial state and its weight; none where it costs nothing.
    pub(super) fn initial_change(&self, x: &[f64]) -> Option<(DVector<f64>, &DMatrix<f64>)> {
        let weight = self.initial.weight.as_ref()?;
        let mut change = DVector::zeros(self.states);
        self.difference(&self.initial.reference.x(), x, change.as_mut_slice());
        Some((change, weight))
    }

    /// Second derivatives of the cost of a change of the initial state, by its tangent space.
    pub(super) fn turned_weight(&self, change: &[f64], weight: &DMatrix<f64>) -> DMatrix<f64> {
        let mut weight = weight.clone();
        chart::turn_weight(self.model.orientations(), change, &mut weight);
        weight
    }

    /// What an initial state costs.
    pub(super) fn initial_cost(&self, x: &[f64]) -> f64 {
        let cost = |(change, weight): (DVector<f64>, _)| 0.5 * change.dot(&(weight * &change));
        self.initial_change(x).map_or(0.0, cost)
    }

    /// Evaluates the deviation at step `k`; of the final step without `u`. Returns the cost.
    pub(super) fn evaluate(&self, k: usize, x: &[f64], u: &[f64], at: &mut Deviation) -> f64 {
        let desired = &self.x_desired[k * self.states..][..self.states];
        self.difference(desired, x, &mut at.x);
        if let Some(plant) = &mut at.projector {
            let momentum = self.model.dimensions().momentum();
            plant.place(x);
            let momenta = plant.projected_momentum().into_iter().zip(&desired[momentum.clone()]);
            for (dx, (p, desired)) in at.x[momentum].iter_mut().zip(momenta) {
                *dx = p - desired;
            }
        }
        if k == self.steps {
            self.final_shape.multiply(self.weights.q_final(), &at.x, &mut at.by_x);
            return 0.5 * dot(&at.x, &at.by_x);
        }
        let desired = &self.u_desired[k * self.inputs..][..self.inputs];
        for (du, (u, desired)) in at.u.iter_mut().zip(u.iter().zip(desired)) {
            *du = u - desired;
        }
        let stage = self.weights.stage(k);
        let [q, r] = &self.shapes[if self.shapes.len() == 1 { 0 } else { k }];
        q.multiply(stage.q(), &at.x, &mut at.by_x);
        r.multiply(stage.r(), &at.u, &mut at.by_u);
        let mut cost = 0.5 * (dot(&at.x, &at.by_x) + dot(&at.u, &at.by_u));
        if let Some(s) = stage.s() {
            for (column, (by_u, du)) in
                s.as_slice().chunks_exact(self.states.max(1)).zip(at.by_u.iter_mut().zip(&at.u))
            {
                let product = dot(column, &at.x);
                cost += product * du;
                *by_u += product;
                at.by_x.iter_mut().zip(column).for_each(|(by_x, s)| *by_x += s * du);
            }
        }
        let linear =
            [(stage.x_linear(), &at.x, &mut at.by_x), (stage.u_linear(), &at.u, &mut at.by_u)];
        for (weight, deviation, by) in linear {
            if let Some(weight) = weight {
                cost += dot(weight.as_slice(), deviation);
                by.iter_mut().zip(weight.iter()).for_each(|(by, w)| *by += w);
            }
        }
        cost
    }

    /// Whether projected momenta are weighed in place of others.
    pub(super) fn projects(&self) -> bool {
        self.projector.is_some()
    }

    /// Whether what is weighed is anything but the difference of states.
    pub(super) fn is_curved(&self) -> bool {
        !self.model.orientations().is_empty() || self.projects()
    }
}

/// The desired states, one after the other, with their momenta projected if they are to be.
fn desired_states(x: &DMatrix<f64>, plant: Option<&mut Plant>) -> Result<Vec<f64>, OptimizeError> {
    let mut desired = rows(x);
    let Some(plant) = plant else { return Ok(desired) };
    let d = plant.model().dimensions();
    for (row, x) in desired.chunks_exact_mut(d.state().max(1)).enumerate() {
        plant.place(x);
        let p = plant.projected_momentum();
        if let Some(i) = p.iter().position(|entry| !entry.is_finite()) {
            let what = "the projected momentum of the desired x";
            return Err(OptimizeError::NotFinite { what, row, col: d.coordinates() + i });
        }
        x[d.momentum()].copy_from_slice(&p);
    }
    Ok(desired)
}

impl InitialChoice {
    fn new(
        free: Option<FreeInitialState>,
        reference: State,
        states: usize,
    ) -> Result<Self, OptimizeError> {
        let Some(FreeInitialState { entries, weight }) = free else {
            return Ok(Self { reference, free: None, weight: None });
        };
        let mut is_free = vec![entries.is_empty(); states];
        for entry in entries {
            *is_free.get_mut(entry).ok_or(OptimizeError::FreeEntry { entry, states })? = true;
        }
        if let Some(weight) = &weight {
            let (rows, cols) = weight.shape();
            if (rows, cols) != (states, states) {
                return Err(OptimizeError::Dimension {
                    what: "the weight of the initial state",
                    rows,
                    cols,
                    expected_rows: states,
                    expected_cols: states,
                });
            }
            // Convex, by the rules of any state weight.
            StageWeights::new(weight.clone(), DMatrix::zeros(0, 0), None, None, None)?;
        }
        Ok(Self { reference, free: Some(is_free), weight })
    }
}
