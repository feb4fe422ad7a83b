//! The state of a plant: as users see it, and with the digits that rounding took.

use plantd_math::rotation::Quaternion;
use plantd_math::scalar::Scalar;
use plantd_math::spatial::three;
use plantd_math::sums::two_sum;

use crate::integrator::predictor::Past;
use crate::integrator::scheme::Scheme;
use crate::model::mechanism::Model;

/// A state, by value.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct State {
    /// Steps since the plant was initialised.
    pub step: u64,
    /// Configuration, nd + nk.
    pub q: Vec<f64>,
    /// Momentum, nd.
    pub p: Vec<f64>,
    /// Velocity of prescribed coordinates over the last step, nk.
    pub v: Vec<f64>,
    /// Constraint impulses of the last step, nc; zero before the first.
    pub multipliers: Vec<f64>,
}

impl State {
    /// `x = (q, p, v)`.
    pub fn x(&self) -> Vec<f64> {
        [&self.q[..], &self.p, &self.v].concat()
    }
}

/// The state with what keeps its digits: sums are compensated, and past increments start the solver.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PreciseState {
    pub(crate) step: u64,
    /// Time that step 0 would have had with the present time step, s; zero unless it has changed.
    pub(crate) time_origin_s: f64,
    pub(crate) q: Vec<f64>,
    /// What `q` of the dynamic coordinates lost to rounding.
    pub(crate) q_low: Vec<f64>,
    pub(crate) p: Vec<f64>,
    /// What `p` lost to rounding.
    pub(crate) p_low: Vec<f64>,
    pub(crate) v: Vec<f64>,
    /// Orientations of ball joints; `q` has their rotation vectors.
    pub(crate) orientations: Vec<Quaternion>,
    /// What they lost to rounding.
    pub(crate) orientations_low: Vec<[f64; 4]>,
    pub(crate) multipliers: Vec<f64>,
    /// What the next step is guessed from.
    pub(crate) past: Past,
    /// How often the last period was halved, and how many since went well.
    pub(crate) halvings: u8,
    pub(crate) calm: u8,
}

impl PreciseState {
    pub(crate) fn zeros([nd, nk, nc, orientations]: [usize; 4], past: Past) -> Self {
        Self {
            step: 0,
            time_origin_s: 0.0,
            q: vec![0.0; nd + nk],
            q_low: vec![0.0; nd],
            p: vec![0.0; nd],
            p_low: vec![0.0; nd],
            v: vec![0.0; nk],
            orientations: vec![Quaternion::default(); orientations],
            orientations_low: vec![[0.0; 4]; orientations],
            multipliers: vec![0.0; nc],
            past,
            halvings: 0,
            calm: 0,
        }
    }

    /// Becomes another state of the same model and method; allocates nothing.
    pub(crate) fn copy_from(&mut self, other: &Self) {
        let Self { step, time_origin_s, halvings, calm, .. } = *other;
        (self.step, self.time_origin_s, self.halvings, self.calm) =
            (step, time_origin_s, halvings, calm);
        self.q.copy_from_slice(&other.q);
        self.q_low.copy_from_slice(&other.q_low);
        self.p.copy_from_slice(&other.p);
        self.p_low.copy_from_slice(&other.p_low);
        self.v.copy_from_slice(&other.v);
        self.orientations.copy_from_slice(&other.orientations);
        self.orientations_low.copy_from_slice(&other.orientations_low);
        self.multipliers.copy_from_slice(&other.multipliers);
        self.past.copy_from(&other.past);
    }

    /// Takes the orientations from `q`.
    pub(crate) fn orient(&mut self, model: &Model) {
        self.orientations_low.fill([0.0; 4]);
        for (orientation, &i) in self.orientations.iter_mut().zip(&model.orientations) {
            *orientation = Quaternion::exp(three(&self.q, i));
            self.q[i..i + 3].copy_from_slice(&orientation.log().0);
        }
    }

    /// At rest in the initial configuration of the scene.
    pub(crate) fn new(model: &Model, scheme: Scheme) -> Self {
        let d = model.dimensions();
        let no = model.orientations.len();
        let q = model.coordinates().iter().map(|c| c.initial).collect();
        let past = Past::new(scheme, model);
        let sizes = [d.dynamic, d.prescribed, d.constraints, no];
        let mut state = Self { q, ..Self::zeros(sizes, past) };
        state.orient(model);
        state
    }
}

impl PreciseState {
    /// Time after so many more steps of length `h`, s.
    pub(crate) fn time_after_s(&self, steps: f64, h: f64) -> f64 {
        self.time_origin_s + (self.step as f64 + steps) * h
    }
}

/// Adds changes to sums, with what rounding took from them.
#[inline(always)]
pub(crate) fn add<S: Scalar>(sums: &mut [S], low: &mut [S], changes: &[S]) {
    for ((sum, low), change) in sums.iter_mut().zip(low).zip(changes) {
        (*sum, *low) = two_sum(*sum, *change + *low);
    }
}
