//! Steps of several plants of one model side by side, one in each lane of registers: the same map, the same bits.
//!
//! A second Newton loop beside that of [`newton`](super::newton), because lanes converge, and need new factors,
//! one by one: what one of them has reached is put aside, and the others go on. All formulas are those of the
//! other loop, on other numbers. It knows the usual way of a step alone: from a guess by past increments to
//! convergence. A lane that leaves it is not solved here, and has its step taken by the other loop. What it gains
//! is in `docs/figures.md`; tests hold each lane to the bits of the other loop. Of one joint, or of two in a row, lanes
//! have a loop of their own ([`row`]).

pub(crate) mod row;

use std::f64::consts::PI;

use plantd_math::norms::largest_of_each;
use plantd_math::scalar::{Compared, LanesOf, Scalar, Truths, in_registers};
use plantd_math::tree_lu::TreeLu;

use crate::integrator::foresight::{Strayed, is_negligible};
use crate::integrator::midpoint::{Midpoint, middle};
use crate::integrator::newton::{CONVERGED, Chord, STALE, is_round_off};
use crate::integrator::point::{Parts, Point};
use crate::integrator::predictor::{LENGTH, take_note};
use crate::integrator::push::weigh;
use crate::integrator::report::{StepError, StepReport};
use crate::integrator::residual::sum_of;
use crate::integrator::response::Response;
use crate::integrator::settings::Settings;
use crate::integrator::state::{PreciseState, add};
use crate::kkt::planar::Elimination;
use crate::kkt::system::Factors;
use crate::lagrangian::arrangement::Planar;
use crate::lagrangian::forces::input_forces;
use crate::lagrangian::generators::MatrixKind;
use crate::lagrangian::mechanics::Kept;
use crate::lagrangian::nudge::Nudge;
use crate::lagrangian::planar::PlanarTree;
use crate::model::mechanism::{CoordinateLaw, Forces, Model, Solver};

/// The memory of a step of plants side by side.
#[derive(Clone, Debug)]
pub(crate) struct Abreast<const N: usize> {
    mid: Midpoint<LanesOf<N>>,
    /// `r1`; a correction takes its place.
    residual: Vec<LanesOf<N>>,
    round_off: LanesOf<N>,
    increment: Vec<LanesOf<N>>,
    impulse: Vec<LanesOf<N>>,
    /// What lanes have come to that are done.
    solved: [Vec<LanesOf<N>>; 2],
    /// How many evaluations that took.
    evaluations: LanesOf<N>,
    systems: Systems<N>,
    diagonal: Vec<LanesOf<N>>,
    nudge: Nudge<LanesOf<N>>,
    push: Option<Push<N>>,
    /// Joints, where steps are [those of a few](super::few), else zero.
    few_joints: usize,
}

/// States side by side.
#[derive(Clone, Debug)]
pub(crate) struct States<const N: usize> {
    q: Vec<LanesOf<N>>,
    q_low: Vec<LanesOf<N>>,
    p: Vec<LanesOf<N>>,
    p_low: Vec<LanesOf<N>>,
    /// Differences of past increments, how many steps were seen, and how many differences the next guess takes.
    past: Vec<[LanesOf<N>; LENGTH]>,
    known: LanesOf<N>,
    order: LanesOf<N>,
    /// Of the last step, where inputs push.
    last: Option<Last<N>>,
}

/// Where the last step was factored first, and its factors.
#[derive(Clone, Debug)]
struct Last<const N: usize> {
    points: Points<N>,
    factors: System<LanesOf<N>>,
}

/// Factors of a step: the first ones, those in their place, and room to make others.
#[derive(Clone, Debug)]
struct Systems<const N: usize> {
    first: System<LanesOf<N>>,
    later: System<LanesOf<N>>,
    room: System<LanesOf<N>>,
    /// Whether `later` has taken the place of `first`.
    is_later: bool,
    /// Second derivatives where those that are needed were found before; none where none are.
    kept: Option<Kept<LanesOf<N>>>,
    /// The smallest pivots, relative.
    pivots: LanesOf<N>,
}

/// The Newton matrices, factored.
#[derive(Clone, Debug)]
enum System<S: Planar> {
    Tree(TreeLu<S>),
    Planar(Box<Elimination<S>>),
}

/// As [`push`](super::push).
#[derive(Clone, Debug)]
struct Push<const N: usize> {
    pushed: Vec<LanesOf<N>>,
    points: Points<N>,
}

/// Parts of points where steps were factored first.
#[derive(Clone, Debug)]
struct Points<const N: usize> {
    force: Vec<LanesOf<N>>,
    increment: Vec<LanesOf<N>>,
    angles: Vec<LanesOf<N>>,
    weighed: Vec<LanesOf<N>>,
}

impl<S: Planar> System<S> {
    fn new(model: &Model) -> Self {
        match model.solver {
            Solver::Planar => Self::Planar(Box::new(Elimination::new(model.dimensions.dynamic))),
            _ => Self::Tree(TreeLu::new(&model.elimination)),
        }
    }

    /// Factors at the last evaluation; the smallest pivot.
    #[inline(always)]
    fn factor(
        &mut self,
        model: &Model,
        settings: &Settings,
        mid: &mut Midpoint<S>,
        diagonal: &mut [S],
    ) -> S {
        let (h, inertia) = (settings.time_step_s, &model.conditioning.inertia);
        match self {
            Self::Tree(matrix) => {
                mid.fill_newton_matrix(model, settings, matrix);
                matrix.factor(&model.elimination, inertia, 1.0 / h.abs()).relative
            }
            Self::Planar(matrix) => {
                mid.fill_diagonal(model, settings, diagonal);
                match (mid.mechanics.planar.as_deref_mut(), &model.planar) {
                    (Some(PlanarTree::Many(tree)), Some(joints)) => {
                        tree.differentiate(joints);
                        let kind = MatrixKind::Newton;
                        matrix.factor(tree, joints, diagonal, inertia, h, kind).relative
                    }
                    _ => S::ZERO,
                }
            }
        }
    }

    #[inline(always)]
    fn solve(&mut self, model: &Model, x: &mut [S]) {
        match (self, &model.planar) {
            (Self::Tree(matrix), _) => matrix.substitute(&model.elimination, x),
            (Self::Planar(matrix), Some(joints)) => matrix.solve(joints, x),
            (Self::Planar(_), None) => {}
        }
    }

    /// Takes the factors of others where that is said.
    #[inline(never)]
    fn take_where(&mut self, truth: S::Truth, others: &Self) {
        in_registers!(S, {
            match (self, others) {
                (Self::Tree(own), Self::Tree(others)) => own.take_where(truth, others),
                (Self::Planar(own), Self::Planar(others)) => own.take_where(truth, others),
                _ => {}
            }
        })
    }
}

impl<const N: usize> Points<N> {
    fn new(nd: usize) -> Self {
        let zeros = || vec![LanesOf::ZERO; nd];
        Self { force: zeros(), increment: zeros(), angles: zeros(), weighed: zeros() }
    }
}

/// Copies numbers into a lane.
fn load<const N: usize>(lane: usize, to: &mut [LanesOf<N>], from: &[f64]) {
    to.iter_mut().zip(from).for_each(|(to, from)| to.0[lane] = *from);
}

/// Copies numbers out of a lane.
fn store<const N: usize>(lane: usize, from: &[LanesOf<N>], to: &mut [f64]) {
    to.iter_mut().zip(from).for_each(|(to, from)| *to = from.0[lane]);
}

impl Model {
    /// Whether plants with these settings have a way side by side: trees of bodies alone, with damping, armatures,
    /// inputs, linear springs and dry friction on coordinates, in space by the elimination tree and in planes; one
    /// midpoint step a period.
    pub(crate) fn goes_abreast(&self, settings: &Settings) -> bool {
        let d = self.dimensions;
        settings.order == 2
            && settings.substeps == 1
            && d.dynamic > 0
            && d.prescribed == 0
            && d.constraints == 0
            && self.orientations.is_empty()
            && self.has_simple_elements()
            && self.signals.is_empty()
            && matches!(self.solver, Solver::Tree | Solver::Planar)
    }
}

impl Forces {
    /// Whether none branches, and all are on single coordinates.
    pub(crate) fn go_abreast(&self) -> bool {
        let is_smooth = |law: &CoordinateLaw| {
            matches!(law, CoordinateLaw::Friction { .. } | CoordinateLaw::Constant(_))
        };
        self.coupling() == 0 && self.coordinate_forces.iter().all(|force| is_smooth(&force.law))
    }
}

impl<const N: usize> States<N> {
    pub(crate) fn new(model: &Model) -> Self {
        let nd = model.dimensions.dynamic;
        let zeros = || vec![LanesOf::ZERO; nd];
        let last = || Last { points: Points::new(nd), factors: System::new(model) };
        Self {
            q: zeros(),
            q_low: zeros(),
            p: zeros(),
            p_low: zeros(),
            past: vec![[LanesOf::ZERO; LENGTH]; nd],
            known: LanesOf::ONE,
            order: LanesOf::ONE,
            last: (!Point::of(model).is_empty()).then(last),
        }
    }

    /// Takes a state into a lane, with the factors that the next guess needs; false if it has to be stepped by
    /// itself first.
    pub(crate) fn load(
        &mut self,
        lane: usize,
        settings: &Settings,
        state: &PreciseState,
        response: &Response,
    ) -> bool {
        let Some((past, [known, order])) = state.past.increments() else { return false };
        if state.halvings != 0 {
            return false;
        }
        if let Some(Last { points, factors }) = &mut self.last {
            let (point, n) = (&state.past.point, state.q.len());
            let kept = &response.kept;
            if !point.is_of_length(settings.time_step_s)
                || !response.kept_at.is_factored_as(point, n)
                || kept.valid != Factors::Tree
            {
                return false;
            }
            if let System::Tree(factors) = factors {
                factors.take_lane(lane, &kept.tree);
            }
            let Parts { force, increment, angles, weighed, .. } = point.parts(n, n);
            load(lane, &mut points.force, force);
            load(lane, &mut points.increment, increment);
            load(lane, &mut points.angles, angles);
            load(lane, &mut points.weighed, weighed);
        }
        load(lane, &mut self.q, &state.q);
        load(lane, &mut self.q_low, &state.q_low);
        load(lane, &mut self.p, &state.p);
        load(lane, &mut self.p_low, &state.p_low);
        self.past.iter_mut().zip(past).for_each(|(own, past)| load(lane, own, past));
        (self.known.0[lane], self.order.0[lane]) = (f64::from(known), f64::from(order));
        true
    }

    /// Takes the state out of a lane, but for what counts steps.
    pub(crate) fn store(&self, lane: usize, state: &mut PreciseState) {
        self.write(lane, &mut state.q, &mut state.p);
        store(lane, &self.q_low, &mut state.q_low);
        store(lane, &self.p_low, &mut state.p_low);
        let counts = [self.known.0[lane] as u8, self.order.0[lane] as u8];
        let past = state.past.replace_increments(counts);
        past.iter_mut().zip(&self.past).for_each(|(past, own)| store(lane, own, past));
        if let Some(Last { points, .. }) = &self.last {
            let n = state.q.len();
            let (_, rest) = state.past.point.numbers.split_at_mut(1);
            let lists = [&points.force, &points.increment, &points.angles, &points.weighed];
            for (list, to) in lists.into_iter().zip(rest.chunks_exact_mut(n)) {
                store(lane, list, to);
            }
        }
    }

    /// Writes configuration and momentum of a lane.
    pub(crate) fn write(&self, lane: usize, q: &mut [f64], p: &mut [f64]) {
        store(lane, &self.q, q);
        store(lane, &self.p, p);
    }

    /// Nothing of use is in a lane any more: it rests at the origin.
    pub(crate) fn clear(&mut self, lane: usize) {
        let lists = [&mut self.q, &mut self.q_low, &mut self.p, &mut self.p_low];
        let past = self.past.iter_mut().flatten();
        lists.into_iter().flatten().chain(past).for_each(|number| number.0[lane] = 0.0);
        (self.known.0[lane], self.order.0[lane]) = (1.0, 1.0);
    }
}

impl<const N: usize> Abreast<N> {
    pub(crate) fn new(model: &Model, settings: &Settings) -> Self {
        let nd = model.dimensions.dynamic;
        let zeros = || vec![LanesOf::ZERO; nd];
        let system = || System::new(model);
        let pushes = !Point::of(model).is_empty();
        let mut mid = Midpoint::new(model);
        mid.inputs = vec![LanesOf::ZERO; model.dimensions.inputs];
        Self {
            mid,
            residual: zeros(),
            round_off: LanesOf::ONE,
            increment: zeros(),
            impulse: zeros(),
            solved: [zeros(), zeros()],
            evaluations: LanesOf::ZERO,
            systems: Systems {
                first: system(),
                later: system(),
                room: system(),
                is_later: false,
                kept: model.is_foreseen(settings).then(|| Kept::new(model)),
                pivots: LanesOf::ONE,
            },
            diagonal: zeros(),
            nudge: Nudge::new(model),
            push: pushes.then(|| Push { pushed: zeros(), points: Points::new(nd) }),
            few_joints: model.few_joints(),
        }
    }

    /// Sets the inputs, those of one plant after those of the other, `width` of each; in which lanes they are finite.
    #[inline(always)]
    pub(crate) fn set_inputs(&mut self, inputs: &[f64], width: usize) -> Truths<N> {
        let mut are_finite = LanesOf::<N>::all(true);
        for (k, lanes) in self.mid.inputs.iter_mut().enumerate() {
            for (lane, u) in lanes.0.iter_mut().zip(inputs[k..].iter().step_by(width)) {
                *lane = *u;
            }
            are_finite = are_finite & lanes.abs().less(LanesOf::constant(f64::INFINITY));
        }
        are_finite
    }

    /// Solves a step of the lanes that are said; those that are solved are returned, and their results
    /// written.
    #[inline(never)]
    pub(crate) fn solve(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &mut States<N>,
        lanes: Truths<N>,
        results: &mut [Result<StepReport, StepError>],
    ) -> Truths<N> {
        match self.few_joints {
            1 => return self.solve_joints::<1>(model, settings, state, lanes, results),
            2 => return self.solve_joints::<2>(model, settings, state, lanes, results),
            _ => {}
        }
        in_registers!(LanesOf<N>, {
            let Midpoint { inputs, input_force, force, .. } = &mut self.mid;
            input_forces(&model.coordinate_inputs, inputs, input_force);
            force.copy_from_slice(input_force);
            self.predict(state);
            let mut lanes = lanes;
            if self.push.is_some() {
                lanes = lanes & self.push(model, settings, state);
            }
            self.iterate(model, settings, state, lanes, results)
        })
    }

    /// As [`Past::predict`](super::predictor::Past::predict).
    #[inline(always)]
    fn predict(&mut self, state: &States<N>) {
        let States { past, order, .. } = state;
        let most = order.largest() as usize;
        for (increment, differences) in self.increment.iter_mut().zip(past) {
            let mut sum = differences[0];
            for (m, difference) in differences.iter().enumerate().take(most).skip(1) {
                let is_taken = LanesOf::constant(m as f64).less(*order);
                sum = LanesOf::choose(is_taken, sum + *difference, sum);
            }
            *increment = sum;
        }
    }

    /// As [`Workspace::push`](super::workspace::Workspace::push); which lanes may go on.
    #[inline(always)]
    fn push(&mut self, model: &Model, settings: &Settings, state: &mut States<N>) -> Truths<N> {
        let all = LanesOf::<N>::all(true);
        let Some(Push { pushed, .. }) = &mut self.push else { return all };
        let Some(Last { points: last, factors }) = &mut state.last else { return all };
        let (h, a) = (settings.time_step_s, settings.force_split.at_start());
        let mut is_pushed = LanesOf::all(false);
        for (i, pushed) in pushed.iter_mut().enumerate() {
            *pushed = (weigh(a, self.mid.input_force[i], last.force[i]) - last.weighed[i]) * h;
            is_pushed = is_pushed | !pushed.abs().at_most(LanesOf::ZERO);
        }
        if !LanesOf::any(is_pushed) {
            pushed.fill(LanesOf::ZERO);
            return all;
        }
        factors.solve(model, pushed);
        let mut is_finite = all;
        let extrapolates = is_pushed & LanesOf::constant(2.0).at_most(state.order);
        for (increment, pushed) in self.increment.iter_mut().zip(pushed) {
            is_finite = is_finite & pushed.abs().less(LanesOf::constant(f64::INFINITY));
            *pushed = LanesOf::choose(is_pushed, -*pushed, LanesOf::ZERO);
            *increment = LanesOf::choose(extrapolates, *increment + *pushed, *increment);
        }
        is_finite
    }

    /// Evaluates the residual at the increments; its size.
    #[inline(always)]
    fn evaluate(&mut self, model: &Model, settings: &Settings, state: &States<N>) -> LanesOf<N> {
        let Self { mid, residual, increment, .. } = self;
        let h = settings.time_step_s;
        let inverse = 1.0 / h;
        for (i, x) in increment.iter().enumerate() {
            let turns = mid.turns_per_radian[i];
            [mid.q[i], mid.velocity[i], mid.angles[i]] =
                middle(*x, state.q[i], state.q_low[i], turns, inverse);
        }
        mid.evaluate(model);
        let weight = settings.force_split.at_start() * h;
        // As `largest_of_each`, without a list of magnitudes.
        let (mut round_off, mut sum) = (LanesOf::ZERO, LanesOf::ZERO);
        for (i, residual) in residual.iter_mut().enumerate() {
            let of_mid = [mid.l_q[i], mid.l_v[i], mid.force[i], mid.angles[i]];
            let momentum = [state.p[i], state.p_low[i]];
            let [value, magnitude] = sum_of(momentum, of_mid, 0.5 * h, weight);
            *residual = value;
            round_off = LanesOf::choose(round_off.less(magnitude), magnitude, round_off);
            sum += magnitude;
        }
        let is_finite = sum.less(LanesOf::constant(f64::INFINITY));
        let round_off = LanesOf::choose(is_finite, round_off, LanesOf::constant(f64::NAN));
        self.round_off = round_off.max(LanesOf::constant(f64::MIN_POSITIVE));
        largest_of_each(residual) / (self.round_off * f64::EPSILON)
    }

    /// Factors at the last evaluation where that is said, for the first time or again.
    #[inline(always)]
    fn factor(&mut self, model: &Model, settings: &Settings, is_fresh: Truths<N>, is_first: bool) {
        let Self { systems, mid, diagonal, .. } = self;
        let Systems { first, later, room, is_later, kept, pivots } = systems;
        if is_first {
            *is_later = false;
            *pivots = first.factor(model, settings, mid, diagonal);
            return;
        }
        if let Some(kept) = kept {
            mid.mechanics.put_aside(kept);
        }
        let own = room.factor(model, settings, mid, diagonal);
        *pivots = LanesOf::choose(is_fresh, own, *pivots);
        if LanesOf::<N>::any(!is_fresh) {
            room.take_where(!is_fresh, if *is_later { &*later } else { &*first });
            if let Some(kept) = kept {
                mid.mechanics.take_where(!is_fresh, kept);
            }
        }
        std::mem::swap(room, later);
        *is_later = true;
    }

    /// Takes note of the point where the step has just been factored for the first time.
    #[inline(always)]
    fn note_point(&mut self, settings: &Settings, state: &States<N>) {
        let (Some(Push { points: next, .. }), Some(Last { points: last, .. })) =
            (&mut self.push, &state.last)
        else {
            return;
        };
        let a = settings.force_split.at_start();
        let forces = self.mid.input_force.iter().zip(&last.force);
        for (w, (force, before)) in next.weighed.iter_mut().zip(forces) {
            *w = weigh(a, *force, *before);
        }
        next.force.copy_from_slice(&self.mid.input_force);
        next.increment.copy_from_slice(&self.increment);
        next.angles.copy_from_slice(&self.mid.angles);
    }

    /// Puts aside what some lanes have come to; those whose joints turned too far are not done.
    #[inline(always)]
    fn accept(
        &mut self,
        model: &Model,
        settings: &Settings,
        lanes: Truths<N>,
        is_nudged: bool,
    ) -> Truths<N> {
        let Self { mid, nudge, residual, increment, impulse, solved, .. } = self;
        let h = settings.time_step_s;
        mid.write_impulse(h, impulse);
        if is_nudged {
            nudge.move_on(model, &mut mid.mechanics, residual, h, |_| {}, impulse);
            nudge.move_springs_on(model, h, impulse);
        }
        for (solved, now) in solved.iter_mut().zip([&*increment, &*impulse]) {
            for (solved, now) in solved.iter_mut().zip(now) {
                *solved = LanesOf::choose(lanes, *now, *solved);
            }
        }
        lanes & largest_of_each(increment).at_most(LanesOf::constant(PI))
    }

    /// As [`Workspace::iterate`](super::workspace::Workspace) of the other loop.
    #[inline(always)]
    fn iterate(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &States<N>,
        lanes: Truths<N>,
        results: &mut [Result<StepReport, StepError>],
    ) -> Truths<N> {
        let constant = LanesOf::<N>::constant;
        let patience = if matches!(self.systems.first, System::Planar(_)) { 2 } else { 3 };
        let mut chord = Chord::<LanesOf<N>>::new(settings, patience, false);
        let foresees = model.is_foreseen(settings);
        let mut strayed = Strayed::<LanesOf<N>>::default();
        let (mut live, mut done) = (lanes, LanesOf::<N>::all(false));
        self.evaluations = LanesOf::ZERO;
        let (mut factorizations, mut iterations) = (LanesOf::<N>::ZERO, 0);
        while LanesOf::<N>::any(live) && iterations < settings.max_iterations {
            iterations += 1;
            self.evaluations = LanesOf::choose(live, self.evaluations + 1.0, self.evaluations);
            let size = self.evaluate(model, settings, state);
            live = live & size.less(constant(f64::INFINITY));
            let converged = chord.judge(size, LanesOf::ZERO);
            let is_fresh = chord.is_fresh & live;
            if LanesOf::<N>::any(is_fresh) {
                self.factor(model, settings, is_fresh, iterations == 1);
                if iterations == 1 {
                    self.note_point(settings, state);
                }
                factorizations = LanesOf::choose(is_fresh, factorizations + 1.0, factorizations);
                let is_regular = constant(settings.singular_below).at_most(self.systems.pivots);
                live = live & (is_regular | !is_fresh);
                strayed.begin_again(is_fresh);
            }
            let mut report = |lanes: Truths<N>, residual: LanesOf<N>, pivots: LanesOf<N>| {
                for (lane, result) in results.iter_mut().enumerate().filter(|(l, _)| lanes.of(*l)) {
                    *result = Ok(StepReport {
                        iterations,
                        factorizations: factorizations.0[lane] as u32,
                        residual: residual.0[lane],
                        reciprocal_condition: pivots.0[lane],
                        ..StepReport::UNCONSTRAINED
                    });
                }
            };
            if iterations == 1 {
                let rests = live & size.at_most(constant(CONVERGED));
                if LanesOf::<N>::any(rests) {
                    report(rests, size, self.systems.pivots);
                    done = done | self.accept(model, settings, rests, false);
                    live = live & !rests;
                }
            }
            if !LanesOf::<N>::any(live) {
                break;
            }
            let Self { systems, residual, increment, .. } = self;
            let system = if systems.is_later { &mut systems.later } else { &mut systems.first };
            system.solve(model, residual);
            for (x, r) in increment.iter_mut().zip(residual) {
                *x -= *r;
            }
            let ends = live & converged & size.at_most(constant(STALE));
            if LanesOf::<N>::any(ends) {
                report(ends, size, self.systems.pivots);
                done = done | self.accept(model, settings, ends, false);
                live = live & !ends;
            }
            if foresees {
                let unit = self.round_off * f64::EPSILON * settings.time_step_s.abs();
                let inertia = &model.conditioning.inertia;
                let left = strayed.left(&self.residual, &self.increment, inertia, unit);
                let expected = chord.expected();
                let ends = live & is_negligible(left, expected);
                if LanesOf::<N>::any(ends) {
                    let less = LanesOf::choose(left.less(expected), left, expected);
                    report(ends, less, self.systems.pivots);
                    done = done | self.accept(model, settings, ends, true);
                    live = live & !ends;
                }
            }
            let mut is_idle = LanesOf::<N>::all(true);
            for ((r, angle), x) in self.residual.iter().zip(&self.mid.angles).zip(&self.increment) {
                is_idle = is_idle & is_round_off(*r, *angle, *x);
            }
            chord.is_idle = is_idle;
            let ends = live & converged;
            if LanesOf::<N>::any(ends) {
                report(ends, size, self.systems.pivots);
                self.evaluate(model, settings, state);
                done = done | self.accept(model, settings, ends, false);
                live = live & !ends;
            }
        }
        done
    }

    /// Moves all lanes on to what they have come to.
    #[inline(never)]
    pub(crate) fn move_on(&mut self, model: &Model, state: &mut States<N>) {
        match self.few_joints {
            1 => in_registers!(LanesOf<N>, { self.move_joints_on::<1>(model, state) }),
            2 => in_registers!(LanesOf<N>, { self.move_joints_on::<2>(model, state) }),
            _ => in_registers!(LanesOf<N>, { self.move_all_on(model, state) }),
        }
    }

    #[inline(always)]
    fn move_all_on(&mut self, model: &Model, state: &mut States<N>) {
        let Self { solved: [increment, impulse], evaluations, push, systems, .. } = self;
        let States { q, q_low, p, p_low, past, known, order, last } = state;
        add(q, q_low, increment);
        add(p, p_low, impulse);
        let inertia = &model.conditioning.inertia[..];
        let pushed = push.as_ref().map_or(&[][..], |push| &push.pushed);
        let counts = [*known, *evaluations];
        [*known, *order] = take_note(past, increment, inertia, pushed, counts);
        if let (Some(push), Some(last)) = (push, last) {
            std::mem::swap(&mut last.points, &mut push.points);
            std::mem::swap(&mut last.factors, &mut systems.first);
        }
    }
}
