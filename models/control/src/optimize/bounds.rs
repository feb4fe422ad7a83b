//! Bounds, held by an augmented Lagrangian.
//!
//! For one end `c ≤ 0` with multiplier `λ ≥ 0` and penalty `ρ` the cost gets
//!
//! ```text
//! (max(0, λ + ρ c)² − λ²) / 2ρ        λ ← max(0, λ + ρ c)
//! ```
//!
//! and for equal ends, `c = 0`, it gets `λ c + ½ ρ c²` with `λ ← λ + ρ c`. Where `λ + ρ c > 0` the
//! second derivative is `ρ`, elsewhere zero: the kink is passed over, as semi-smooth Newton does.

use nalgebra::{DMatrix, DVector};

use crate::optimize::chart::chart;
use crate::optimize::error::{BoundFault, OptimizeError};
use crate::optimize::specification::{Bound, Bounds};
use crate::optimize::trajectory::Trajectory;

/// Penalty with which a search begins.
const FIRST_PENALTY: f64 = 10.0;
/// Growth of the penalty.
const PENALTY_GROWTH: f64 = 4.0;
/// The error of bounds that the penalty need not grow for, in units of the error before.
const PENALTY_WORKS: f64 = 0.5;

/// Which numbers of a trajectory a bound speaks of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Quantity {
    /// An entry of `x` at steps 1 to n.
    State,
    /// An entry of `u` at steps 0 to n − 1.
    Input,
    /// An entry of `x` at step n.
    FinalState,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Side {
    Lower,
    Upper,
    Equal,
}

/// One end of a bound.
#[derive(Clone, Copy, Debug)]
struct End {
    quantity: Quantity,
    index: usize,
    side: Side,
    value: f64,
    /// Weight of the entry in the cost: the unit of the penalty.
    scale: f64,
    /// Place of its first multiplier.
    first: usize,
}

/// What an end adds at one number: value, derivative and second derivative by that number.
#[derive(Clone, Copy, Debug, Default)]
struct Penalty {
    value: f64,
    slope: f64,
    curvature: f64,
}

/// The penalties of the bounds of a problem, end by end, with their multipliers.
#[derive(Clone, Debug)]
pub(super) struct BoundPenalty {
    ends: Vec<End>,
    steps: usize,
    /// First coordinates of ball joints.
    orientations: Vec<usize>,
    /// One for each end and step.
    pub(super) multipliers: Vec<f64>,
    pub(super) penalty: f64,
    /// Error when the multipliers were last renewed.
    pub(super) renewed_error: f64,
}

impl BoundPenalty {
    /// `scale` gives the weight of an entry.
    pub(super) fn new(
        bounds: &Bounds,
        (states, inputs): (usize, usize),
        steps: usize,
        orientations: &[usize],
        scale: impl Fn(Quantity, usize) -> f64,
    ) -> Result<Self, OptimizeError> {
        let (mut ends, mut count) = (Vec::new(), 0);
        let lists = [
            ("states", Quantity::State, &bounds.states, states, steps),
            ("inputs", Quantity::Input, &bounds.inputs, inputs, steps),
            ("final_state", Quantity::FinalState, &bounds.final_state, states, 1),
        ];
        for (list, quantity, bounds, entries, steps) in lists {
            for (position, bound) in bounds.iter().enumerate() {
                let Bound { index, min, max } = *bound;
                let fault = |fault| OptimizeError::Bound { list, position, fault };
                check(bound, entries).map_err(fault)?;
                let scale = scale(quantity, index);
                let given = if min.is_some() && min == max {
                    [min.map(|value| (Side::Equal, value)), None]
                } else {
                    [min.map(|value| (Side::Lower, value)), max.map(|value| (Side::Upper, value))]
                };
                for (side, value) in given.into_iter().flatten() {
                    ends.push(End { quantity, index, side, value, scale, first: count });
                    count += steps;
                }
            }
        }
        Ok(Self {
            ends,
            steps,
            orientations: orientations.to_vec(),
            multipliers: vec![0.0; count],
            penalty: FIRST_PENALTY,
            renewed_error: 0.0,
        })
    }

    /// Whether nothing is bounded.
    pub(super) fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    /// Ends that speak of `x` at step `k`, with the place of their multipliers.
    fn state_ends(&self, k: usize) -> impl Iterator<Item = (&End, usize)> {
        self.ends.iter().filter_map(move |end| match end.quantity {
            Quantity::State if k > 0 => Some((end, end.first + k - 1)),
            Quantity::FinalState if k == self.steps => Some((end, end.first)),
            _ => None,
        })
    }

    /// Ends that speak of `u` at step `k`, with the place of their multipliers; none after the last step.
    fn input_ends(&self, k: usize) -> impl Iterator<Item = (&End, usize)> {
        let is_input = move |end: &&End| end.quantity == Quantity::Input && k < self.steps;
        self.ends.iter().filter(is_input).map(move |end| (end, end.first + k))
    }

    /// All ends at step `k`, with the number that is bounded and the place of the multiplier.
    fn numbers<'a>(
        &'a self,
        k: usize,
        (x, u): (&'a [f64], &'a [f64]),
    ) -> impl Iterator<Item = (&'a End, f64, usize)> {
        let states = self.state_ends(k).map(|(end, place)| (end, x[end.index], place));
        states.chain(self.input_ends(k).map(|(end, place)| (end, u[end.index], place)))
    }

    /// All ends at all steps of a trajectory.
    fn all<'a>(
        &'a self,
        trajectory: &'a Trajectory,
    ) -> impl Iterator<Item = (&'a End, f64, usize)> {
        (0..=self.steps).flat_map(|k| self.numbers(k, (trajectory.x(k), trajectory.u(k))))
    }

    fn at(&self, end: &End, number: f64, place: usize) -> Penalty {
        end.penalty(number, self.multipliers[place], self.penalty)
    }

    /// What bounds add to the cost at step `k`.
    pub(super) fn value(&self, k: usize, at: (&[f64], &[f64])) -> f64 {
        if self.is_empty() {
            return 0.0;
        }
        self.numbers(k, at).map(|(end, number, place)| self.at(end, number, place).value).sum()
    }

    /// Cost of a trajectory with penalties.
    pub(super) fn merit(&self, trajectory: &Trajectory) -> f64 {
        let penalty = |k: usize| self.value(k, (trajectory.x(k), trajectory.u(k)));
        trajectory.cost + (0..=self.steps).map(penalty).sum::<f64>()
    }

    /// First coordinate of the ball joint that an entry of `x` belongs to.
    fn ball(&self, entry: usize) -> Option<usize> {
        self.orientations.iter().copied().find(|i| (*i..*i + 3).contains(&entry))
    }

    /// Adds the gradient of the penalties at step `k`.
    pub(super) fn add_gradient(
        &self,
        k: usize,
        (x, u): (&[f64], &[f64]),
        by_x: &mut DVector<f64>,
        by_u: Option<&mut DVector<f64>>,
    ) {
        for (end, place) in self.state_ends(k) {
            let slope = self.at(end, x[end.index], place).slope;
            match self.ball(end.index) {
                None => by_x[end.index] += slope,
                Some(i) => {
                    let row = chart(x, i).transpose().0[end.index - i] * slope;
                    (0..3).for_each(|a| by_x[i + a] += row[a]);
                }
            }
        }
        if let Some(by_u) = by_u {
            for (end, place) in self.input_ends(k) {
                by_u[end.index] += self.at(end, u[end.index], place).slope;
            }
        }
    }

    /// Adds the second derivatives of the penalties at step `k`.
    pub(super) fn add_curvature(
        &self,
        k: usize,
        (x, u): (&[f64], &[f64]),
        q: &mut DMatrix<f64>,
        r: Option<&mut DMatrix<f64>>,
    ) {
        for (end, place) in self.state_ends(k) {
            let curvature = self.at(end, x[end.index], place).curvature;
            match self.ball(end.index) {
                None => q[(end.index, end.index)] += curvature,
                Some(i) => {
                    let row = chart(x, i).transpose().0[end.index - i];
                    for a in 0..3 {
                        (0..3).for_each(|b| q[(i + a, i + b)] += curvature * row[a] * row[b]);
                    }
                }
            }
        }
        if let Some(r) = r {
            for (end, place) in self.input_ends(k) {
                r[(end.index, end.index)] += self.at(end, u[end.index], place).curvature;
            }
        }
    }

    /// Largest violation of a bound.
    pub(super) fn violation(&self, trajectory: &Trajectory) -> f64 {
        self.all(trajectory).fold(0.0, |worst, (end, number, _)| worst.max(end.violation(number)))
    }

    /// Largest violation of a bound, or distance of a multiplier from what it may be.
    pub(super) fn error(&self, trajectory: &Trajectory) -> f64 {
        let errors = self
            .all(trajectory)
            .map(|(end, number, place)| end.error(number, self.multipliers[place], self.penalty));
        errors.fold(0.0, f64::max)
    }

    /// Energy of the penalties, `Σ ½ ρ error²`.
    pub(super) fn energy(&self, trajectory: &Trajectory) -> f64 {
        self.all(trajectory).fold(0.0, |sum, (end, number, place)| {
            let error = end.error(number, self.multipliers[place], self.penalty);
            sum + 0.5 * (self.penalty * end.scale) * error * error
        })
    }

    /// Renews the multipliers at an error, and lets the penalty grow if that has not fallen enough.
    pub(super) fn renew(&mut self, trajectory: &Trajectory, error: f64) {
        let renewed = |(end, number, place): (&End, f64, usize)| {
            (place, end.renewed(number, self.multipliers[place], self.penalty))
        };
        for (place, multiplier) in self.all(trajectory).map(renewed).collect::<Vec<_>>() {
            self.multipliers[place] = multiplier;
        }
        if !(error <= PENALTY_WORKS * self.renewed_error) {
            self.penalty *= PENALTY_GROWTH;
        }
        self.renewed_error = error;
    }
}

fn check(bound: &Bound, entries: usize) -> Result<(), BoundFault> {
    let Bound { index, min, max } = *bound;
    if index >= entries {
        return Err(BoundFault::Index { index, entries });
    }
    if let Some(value) = [min, max].into_iter().flatten().find(|value| !value.is_finite()) {
        return Err(BoundFault::NotFinite { value });
    }
    match (min, max) {
        (None, None) => Err(BoundFault::Empty),
        (Some(min), Some(max)) if min > max => Err(BoundFault::Crossed { min, max }),
        _ => Ok(()),
    }
}

impl End {
    /// `c`, not greater than zero where the bound holds; of equal ends, zero.
    fn excess(&self, number: f64) -> f64 {
        match self.side {
            Side::Lower => self.value - number,
            Side::Upper | Side::Equal => number - self.value,
        }
    }

    /// How far the number is out of bounds.
    fn violation(&self, number: f64) -> f64 {
        self.error(number, 0.0, 1.0)
    }

    /// Violation, or, where the bound holds, how far from it a multiplier that is not zero stands.
    fn error(&self, number: f64, multiplier: f64, penalty: f64) -> f64 {
        match self.side {
            Side::Equal => self.excess(number).abs(),
            _ => self.excess(number).max(-multiplier / (penalty * self.scale)).abs(),
        }
    }

    /// The multiplier after this one.
    fn renewed(&self, number: f64, multiplier: f64, penalty: f64) -> f64 {
        let next = multiplier + penalty * self.scale * self.excess(number);
        if self.side == Side::Equal { next } else { next.max(0.0) }
    }

    /// What it adds to the cost.
    fn penalty(&self, number: f64, multiplier: f64, penalty: f64) -> Penalty {
        let (rho, c) = (penalty * self.scale, self.excess(number));
        let pull = multiplier + rho * c;
        match self.side {
            Side::Equal => {
                Penalty { value: c * (multiplier + 0.5 * rho * c), slope: pull, curvature: rho }
            }
            _ if pull <= 0.0 => {
                Penalty { value: -0.5 * multiplier * multiplier / rho, ..Penalty::default() }
            }
            side => Penalty {
                value: c * (multiplier + 0.5 * rho * c),
                slope: if side == Side::Lower { -pull } else { pull },
                curvature: rho,
            },
        }
    }
}
