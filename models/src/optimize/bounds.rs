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

use super::{Bound, BoundFault, Bounds, OptimizeError};

/// Which numbers of a trajectory a bound speaks of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Of {
    /// An entry of `x` at steps 1 to n.
    State,
    /// An entry of `u` at steps 0 to n − 1.
    Input,
    /// An entry of `x` at step n.
    Final,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Side {
    Lower,
    Upper,
    Equal,
}

/// One end of a bound.
#[derive(Clone, Copy, Debug)]
pub(super) struct End {
    pub(super) of: Of,
    pub(super) index: usize,
    side: Side,
    value: f64,
    /// Weight of the entry in the cost: the unit of the penalty.
    scale: f64,
    /// Place of its first multiplier.
    first: usize,
}

/// What an end adds at one number: value, derivative and second derivative by that number.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Penalty {
    pub(super) value: f64,
    pub(super) slope: f64,
    pub(super) curvature: f64,
}

/// The bounds of a problem, end by end.
#[derive(Clone, Debug, Default)]
pub(super) struct Ends {
    pub(super) ends: Vec<End>,
    steps: usize,
    /// Multipliers in all.
    pub(super) count: usize,
}

impl Ends {
    /// `scale` gives the weight of an entry.
    pub(super) fn new(
        bounds: &Bounds,
        (states, inputs): (usize, usize),
        steps: usize,
        scale: impl Fn(Of, usize) -> f64,
    ) -> Result<Self, OptimizeError> {
        let mut all = Self { ends: Vec::new(), steps, count: 0 };
        let lists = [
            ("states", Of::State, &bounds.states, states),
            ("inputs", Of::Input, &bounds.inputs, inputs),
            ("final_state", Of::Final, &bounds.final_state, states),
        ];
        for (list, of, bounds, entries) in lists {
            for (position, bound) in bounds.iter().enumerate() {
                let fault = |fault| OptimizeError::Bound { list, position, fault };
                check(bound, entries).map_err(fault)?;
                let scale = scale(of, bound.index);
                let mut push = |side, value| {
                    let first = all.count;
                    all.ends.push(End { of, index: bound.index, side, value, scale, first });
                    all.count += if of == Of::Final { 1 } else { steps };
                };
                if bound.min.is_some() && bound.min == bound.max {
                    bound.min.into_iter().for_each(|value| push(Side::Equal, value));
                } else {
                    bound.min.into_iter().for_each(|value| push(Side::Lower, value));
                    bound.max.into_iter().for_each(|value| push(Side::Upper, value));
                }
            }
        }
        Ok(all)
    }

    pub(super) fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    /// Ends that speak of `x` (or of `u`) at step `k`, with the place of their multipliers.
    pub(super) fn at(&self, is_input: bool, k: usize) -> impl Iterator<Item = (&End, usize)> {
        self.ends.iter().filter_map(move |end| {
            let place = match end.of {
                Of::State if !is_input && k > 0 => k - 1,
                Of::Input if is_input => k,
                Of::Final if !is_input && k == self.steps => 0,
                _ => return None,
            };
            Some((end, end.first + place))
        })
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
    pub(super) fn violation(&self, number: f64) -> f64 {
        match self.side {
            Side::Equal => self.excess(number).abs(),
            _ => self.excess(number).max(0.0),
        }
    }

    /// Violation, or, where the bound holds, how far from it a multiplier that is not zero stands.
    pub(super) fn error(&self, number: f64, multiplier: f64, penalty: f64) -> f64 {
        match self.side {
            Side::Equal => self.excess(number).abs(),
            _ => self.excess(number).max(-multiplier / (penalty * self.scale)).abs(),
        }
    }

    /// `ρ`.
    pub(super) fn weight(&self, penalty: f64) -> f64 {
        penalty * self.scale
    }

    /// The multiplier after this one.
    pub(super) fn renewed(&self, number: f64, multiplier: f64, penalty: f64) -> f64 {
        let next = multiplier + penalty * self.scale * self.excess(number);
        if self.side == Side::Equal { next } else { next.max(0.0) }
    }

    /// What it adds to the cost.
    pub(super) fn penalty(&self, number: f64, multiplier: f64, penalty: f64) -> Penalty {
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
