//! The guess with which a step begins: increments of past steps, extrapolated.
//!
//! The polynomial through the last `m` increments predicts `x[k+1] = Σ ∇ʲx[k]`, `j < m`, with the backward
//! differences `∇⁰x[k] = x[k]`, `∇ʲ⁺¹x[k] = ∇ʲx[k] − ∇ʲx[k−1]`. What such a prediction is off by is the
//! difference `∇ᵐx[k+1]`: the differences of an increment tell how good each order has been, and the next
//! step takes the best. A smooth motion is predicted to many digits, and one that is pushed around is not
//! extrapolated far. Eight differences are kept, and more where steps take more than one evaluation and these would make
//! better guesses: what is foretold by less does not pay for them.
//!
//! What a change of the inputs does to an increment is no part of the differences from `∇²` on, and is guessed by
//! itself ([`push`](super::push)).
//!
//! Collocation goes on with its polynomial ([`Kind::Stages`]).

use plantd_math::scalar::{Compared, Scalar};

use crate::integrator::point::Point;
use crate::integrator::scheme::{STAGES_MAX, Scheme, Tableau};
use crate::model::mechanism::Model;

/// What the next step is guessed from.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Past {
    kind: Kind,
    /// Increments: `∇⁰x, ∇¹x, …` of each coordinate. Stages: their velocities, stage by stage, then forces.
    numbers: Vec<f64>,
    /// Increments: differences that are known, up to [`LENGTH`], one more for each step seen at most; others mean
    /// nothing. Of stages 1. Without any there is nothing to guess from.
    known: u8,
    /// Differences that the next prediction by increments takes.
    order: u8,
    /// Stages: whether the next step is as long.
    is_even: bool,
    /// Increments: where the last step was factored, if inputs push.
    pub(crate) point: Point,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    /// Increments of past steps.
    Increments,
    /// What a collocation method with so many stages had at those of its last step.
    Stages(u8),
}

/// Differences kept, at most.
pub(crate) const LENGTH: usize = 12;

/// Differences beyond the best that are kept, where more than [`FEW`] are: one may be worse, and the next one better.
const BEYOND: f64 = 2.0;

/// As many differences suffice where one evaluation a step does.
const FEW: usize = 8;

/// Takes new increments into `COUNT` differences of past ones, those from `∇²` on less what was pushed, if anything was,
/// and sums up their squares, weighed.
#[inline(always)]
fn differences_of<const COUNT: usize, S: Scalar>(
    rows: &mut [[S; LENGTH]],
    increments: &[S],
    inertia: &[f64],
    pushed: &[S],
) -> [S; LENGTH] {
    let rows = rows.iter_mut().zip(increments).zip(inertia);
    if pushed.is_empty() {
        difference::<COUNT, S>(rows.map(|((row, x), weight)| (row, *x, S::ZERO, *weight)))
    } else {
        let rows = rows.zip(pushed);
        difference::<COUNT, S>(rows.map(|(((row, x), weight), push)| (row, *x, *push, *weight)))
    }
}

#[inline(always)]
fn difference<'a, const COUNT: usize, S: Scalar>(
    rows: impl Iterator<Item = (&'a mut [S; LENGTH], S, S, f64)>,
) -> [S; LENGTH] {
    let mut errors = [S::ZERO; LENGTH];
    for (differences, increment, pushed, weight) in rows {
        let mut difference = increment;
        for (m, (kept, error)) in differences[..COUNT].iter_mut().zip(&mut errors).enumerate() {
            if m == 2 {
                difference -= pushed;
            }
            *error += difference * difference * weight;
            (*kept, difference) = (difference, difference - *kept);
        }
    }
    errors
}

/// Differences that the next prediction takes, of those that were seen: the more, the better they have been. `count` are
/// there.
#[inline(always)]
fn best_order<S: Compared>(errors: &[S; LENGTH], seen: S, count: usize) -> S {
    let (mut least, mut order) = (errors[1], S::ONE);
    // By itself a plant has as many as are gone through.
    let count = if S::IS_SEVERAL { count } else { seen.value() as usize + 1 };
    for (m, &error) in (2..).zip(&errors[2..count.clamp(2, LENGTH)]) {
        let place = S::constant(f64::from(m));
        let mut is_better = error.less(least);
        if S::IS_SEVERAL {
            is_better = is_better & place.at_most(seen);
        }
        least = S::choose(is_better, error, least);
        order = S::choose(is_better, place, order);
    }
    order
}

#[inline(always)]
pub(crate) fn least<S: Compared>(a: S, b: S) -> S {
    S::choose(a.less(b), a, b)
}

/// How many differences may be known after a step, by those that were and how often the equations were evaluated.
#[inline(always)]
fn most_known<S: Compared>(known: S, evaluations: S) -> S {
    let [one, few, all] = [1.0, FEW as f64, LENGTH as f64].map(S::constant);
    S::choose(one.less(evaluations), all, known.max(few))
}

/// Of the differences of a new increment, those of lower order than this and one more mean something.
#[inline(always)]
fn seen<S: Compared>(known: S, most: S) -> S {
    least(known, most - 1.0).max(S::ONE)
}

/// Differences that are known after a step, of which the next one takes so many.
#[inline(always)]
fn known_after<S: Compared>(known: S, order: S, most: S) -> S {
    least(least(known + 1.0, (order + BEYOND).max(S::constant(FEW as f64))), most)
}

/// Takes note of increments in the differences of past ones, by how many of these were known and how often the
/// equations were evaluated; returns how many are known now, and how many the next prediction takes.
#[inline(always)]
pub(crate) fn take_note<S: Compared>(
    rows: &mut [[S; LENGTH]],
    increments: &[S],
    inertia: &[f64],
    pushed: &[S],
    [known, evaluations]: [S; 2],
) -> [S; 2] {
    let most = most_known(known, evaluations);
    let seen = seen(known, most);
    // Of plants side by side, so many as one of them needs are gone through.
    let order = if S::any(S::constant(FEW as f64).at_most(seen)) {
        best_order(&differences_of::<LENGTH, _>(rows, increments, inertia, pushed), seen, LENGTH)
    } else {
        best_order(&differences_of::<FEW, _>(rows, increments, inertia, pushed), seen, FEW)
    };
    [known_after(known, order, most), order]
}

impl Past {
    pub(crate) fn new(scheme: Scheme, model: &Model) -> Self {
        let mut past = Self::of_size(scheme, model.dimensions.dynamic);
        if past.kind == Kind::Increments {
            past.point = Point::of(model);
        }
        past
    }

    fn of_size(scheme: Scheme, coordinates: usize) -> Self {
        let kind = match scheme {
            Scheme::Midpoint => Kind::Increments,
            Scheme::Gauss(stages) => Kind::Stages(stages as u8),
        };
        let (numbers, point) = (Vec::new(), Point::default());
        let mut past = Self { kind, numbers, known: 0, order: 0, is_even: true, point };
        past.numbers.resize(past.length(coordinates), 0.0);
        past
    }

    /// The differences of the increments, how many steps were seen, and how many differences the next guess takes;
    /// `None` if there is nothing to guess from, or it is of another kind.
    pub(crate) fn increments(&self) -> Option<(&[[f64; LENGTH]], [u8; 2])> {
        let is_known = self.kind == Kind::Increments && self.known > 0 && self.order > 0;
        is_known.then(|| (self.numbers.as_chunks().0, [self.known, self.order]))
    }

    /// Replaces the counts; the differences may be replaced after that.
    pub(crate) fn replace_increments(&mut self, [known, order]: [u8; 2]) -> &mut [[f64; LENGTH]] {
        (self.known, self.order) = (known, order);
        self.numbers.as_chunks_mut().0
    }

    /// Whether a guess goes on with the last change of the increments.
    pub(crate) fn extrapolates(&self) -> bool {
        self.kind == Kind::Increments && self.order >= 2
    }

    /// Writes the increments of the next step; false if there is nothing to guess from.
    #[inline(always)]
    pub(crate) fn predict(&self, increments: &mut [f64]) -> bool {
        if self.kind != Kind::Increments || self.known == 0 {
            return false;
        }
        let rows = self.numbers.as_chunks::<LENGTH>().0;
        for (increment, differences) in increments.iter_mut().zip(rows) {
            *increment = differences[..usize::from(self.order)].iter().sum();
        }
        true
    }

    /// Writes what the next step has at its stages; false if there is nothing to guess from.
    pub(crate) fn predict_stages(&self, tableau: &Tableau, motion: &mut [f64]) -> bool {
        if self.known == 0 || !matches!(self.kind, Kind::Stages(_)) {
            return false;
        }
        let stages = tableau.nodes.len();
        let count = motion.len() / (2 * stages);
        for (half, a) in (0..2).flat_map(|half| (0..count).map(move |a| (half, a))) {
            let entry = |j: usize| (half * stages + j) * count + a;
            let last = if self.is_even { 0.0 } else { self.numbers[entry(stages - 1)] };
            let mut next = [last; STAGES_MAX];
            if self.is_even {
                for (j, column) in tableau.onward.chunks_exact(stages).enumerate() {
                    let past = self.numbers[entry(j)];
                    next.iter_mut().zip(column).for_each(|(next, weight)| *next += weight * past);
                }
            }
            for (i, next) in next[..stages].iter().enumerate() {
                motion[entry(i)] = *next;
            }
        }
        true
    }

    /// Takes note of a step. The error of all coordinates is weighed by their `inertia`; `pushed`, if it is not empty,
    /// is what was guessed of the change of the inputs.
    #[inline(never)]
    pub(crate) fn record(
        &mut self,
        increments: &[f64],
        inertia: &[f64],
        pushed: &[f64],
        evaluations: u32,
    ) {
        self.record_here(increments, inertia, pushed, evaluations);
    }

    /// The same in the code of the caller.
    #[inline(always)]
    pub(crate) fn record_here(
        &mut self,
        increments: &[f64],
        inertia: &[f64],
        pushed: &[f64],
        evaluations: u32,
    ) {
        if self.kind != Kind::Increments {
            return;
        }
        let rows = &mut self.numbers.as_chunks_mut::<LENGTH>().0[..increments.len()];
        let counts = [self.known.into(), evaluations.into()];
        let [known, order] = take_note(rows, increments, inertia, pushed, counts);
        (self.known, self.order) = (known as u8, order as u8);
    }

    /// Takes note of the velocities and forces at the stages of a step.
    pub(crate) fn record_stages(&mut self, motion: &[f64]) {
        self.numbers.copy_from_slice(motion);
        (self.known, self.is_even) = (1, true);
    }

    /// Steps are longer by a factor from now on.
    pub(crate) fn stretch(&mut self, factor: f64) {
        match self.kind {
            // The last increment, longer by a factor, is all that is known.
            Kind::Increments => {
                self.numbers.iter_mut().step_by(LENGTH).for_each(|last| *last *= factor);
                (self.known, self.order) = (self.known.min(1), self.order.min(1));
            }
            Kind::Stages(_) => self.is_even = false,
        }
    }

    /// Its kind and its counts, for snapshots.
    pub(crate) fn code(&self) -> [u8; 3] {
        match self.kind {
            Kind::Increments => {
                let of_point = match &self.point {
                    point if point.is_empty() => 0,
                    point if point.has_ends => 4,
                    _ => 3,
                };
                [of_point, self.known, self.order]
            }
            Kind::Stages(stages) => [2, self.known + 2 * u8::from(self.is_even), stages],
        }
    }

    /// The past with that code, without its numbers, and how many it has with so many dynamic and prescribed
    /// coordinates and orientations; `None` if the code has no meaning. Nothing is allocated before
    /// [`Past::make_room`].
    pub(crate) fn from_code(code: [u8; 3], [nd, nk, no]: [usize; 3]) -> Option<(Self, [usize; 2])> {
        let longest = LENGTH as u8;
        let (kind, known, order, is_even) = match code {
            [0 | 3 | 4, known, order] if known <= longest && order <= known => {
                (Kind::Increments, known, order, true)
            }
            [2, flags, stages] if flags < 4 && (2..=STAGES_MAX as u8).contains(&stages) => {
                (Kind::Stages(stages), flags & 1, 0, flags & 2 == 2)
            }
            _ => return None,
        };
        let point = Point { has_ends: code[0] == 4, ..Point::default() };
        let of_point = match code[0] {
            3 | 4 => Point::length([nd, nk, no], point.has_ends),
            _ => 0,
        };
        let past = Self { kind, numbers: Vec::new(), known, order, is_even, point };
        let lengths = [past.length(nd), of_point];
        Some((past, lengths))
    }

    /// Numbers that it keeps for so many coordinates, but for the point.
    fn length(&self, coordinates: usize) -> usize {
        match self.kind {
            Kind::Increments => LENGTH * coordinates,
            Kind::Stages(stages) => 2 * usize::from(stages) * coordinates,
        }
    }

    /// Makes room for its numbers.
    pub(crate) fn make_room(&mut self, [own, point]: [usize; 2]) {
        self.numbers.resize(own, 0.0);
        self.point = Point::zeros(point, self.point.has_ends);
    }

    /// Whether the other is of the same method and size.
    pub(crate) fn is_like(&self, other: &Self) -> bool {
        std::mem::discriminant(&self.kind) == std::mem::discriminant(&other.kind)
            && self.numbers.len() == other.numbers.len()
            && self.point.numbers.len() == other.point.numbers.len()
    }

    /// There is no past to guess from.
    pub(crate) fn forget(&mut self) {
        (self.known, self.order) = (0, 0);
        self.point.forget();
    }

    /// Becomes another past of the same kind and size; allocates nothing.
    pub(crate) fn copy_from(&mut self, other: &Self) {
        self.numbers.clone_from(&other.numbers);
        self.point.copy_from(&other.point);
        let Self { kind, known, order, is_even, .. } = *other;
        (self.kind, self.known, self.order, self.is_even) = (kind, known, order, is_even);
    }

    /// Takes the differences that mean nothing for zero: then pasts that are the same have the same numbers.
    pub(crate) fn tidy(&mut self) {
        if self.kind == Kind::Increments {
            for differences in self.numbers.as_chunks_mut::<LENGTH>().0 {
                differences[usize::from(self.known)..].fill(0.0);
            }
        }
    }

    /// All numbers that it keeps.
    pub(crate) fn numbers(&mut self) -> impl Iterator<Item = &mut f64> {
        self.numbers.iter_mut().chain(&mut self.point.numbers)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Predictions and increments of a motion, one coordinate.
    fn run(motion: impl Fn(f64) -> f64, steps: usize) -> Vec<(f64, f64, u8)> {
        let mut predictor = Past::of_size(Scheme::Midpoint, 1);
        let step = |k| {
            let mut predicted = [0.0];
            predictor.predict(&mut predicted);
            let order = predictor.order;
            predictor.record(&[motion(k as f64)], &[1.0], &[], 2);
            (predicted[0], motion(k as f64), order)
        };
        (0..steps).map(step).collect()
    }

    #[test]
    fn a_polynomial_is_predicted_exactly() {
        for (predicted, actual, _) in &run(|t| 3.0 - t + 0.5 * t * t - 0.25 * t * t * t, 20)[6..] {
            assert!((predicted - actual).abs() < 1e-9 * actual.abs(), "{predicted} {actual}");
        }
    }

    #[test]
    fn a_smooth_motion_is_predicted_better_by_more_increments() {
        let errors: Vec<f64> =
            run(|t| (0.1 * t).sin(), 30).iter().map(|(p, a, _)| (p - a).abs()).collect();
        assert!(errors[2] > 1e-3 && errors[12..].iter().all(|e| *e < 1e-6), "{errors:?}");
    }

    #[test]
    fn a_kick_is_forgotten_and_noise_is_not_extrapolated() {
        let kicked = run(|t| if t < 20.0 { 1.0 } else { 2.0 }, 24);
        assert_eq!(kicked[21].0, 2.0, "the step after a kick takes the last increment");
        let noise = run(|t| 1.0 + (t * t * 12.9898).sin(), 40);
        assert!(noise.iter().all(|(predicted, _, _)| predicted.abs() < 20.0));
    }
}
