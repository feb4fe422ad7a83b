//! Ball joints: orientations in place of coordinates.
//!
//! A ball joint turns in one step by `R[k+1] = R[k] exp(ξ)`, is at the midpoint at `R[k] exp(ξ/2)`, and
//! its velocity is `ξ/h`. With the momentum `m = L_v` and the torque `τ = L_q` of the midpoint, in its
//! own axes,
//!
//! ```text
//! p[k]   = N⁻ m − T⁻ (½h τ + a h f) + Dh(q[k])ᵀ λ
//! p[k+1] = N⁺ m + T⁺ (½h τ + (1 − a) h f)
//! ```
//!
//! which is what the equations of the other coordinates are with `N = T = 1`. Nothing is singular but
//! a whole turn in one step. In the Newton matrix the maps weigh rows and columns of the joint: see
//! [`crate::lagrangian::generators`]. See [`plantd_math::rotation`] for the maps.

use plantd_math::eights::{Eight, InEights, in_eights};
use plantd_math::rotation;
use plantd_math::rotation::{Quaternion, Turn};
use plantd_math::rows::Block;
use plantd_math::scalar::Scalar;
use plantd_math::sided::Sided;
use plantd_math::spatial::{Mat3, Vec3, three};
use plantd_math::tree_lu::TreeLu;

use crate::integrator::ball_maps::{ToMatrices, ToMidpoint, TurnOn, Weigh, beside};
use crate::integrator::settings::Settings;
use crate::integrator::state::PreciseState;
use crate::integrator::workspace::{Tangents, Workspace};
use crate::lagrangian::curvature::Curvature;
use crate::lagrangian::generators::{Flanks, Generators, MatrixKind, Step, of_ball};
use crate::lagrangian::turning::{Turning, Weights};
use crate::model::mechanism::Model;
use crate::model::tree::JointKind;

/// No ball joint has the coordinate.
const NONE: u32 = u32::MAX;

/// The ball joints of a step.
#[derive(Clone, Debug)]
pub(crate) struct BallJoints {
    /// Orientations at the start and at the end.
    pub(crate) start: Vec<Mat3>,
    pub(crate) end: Vec<Mat3>,
    /// Those at the start, side by side.
    start_beside: Sided<Mat3<Block>>,
    /// How they turn over the step, in their own axes, at the last evaluation.
    turns: Sided<Turn<Block>>,
    /// Orientations at the end, and what they lost to rounding.
    next: Vec<Quaternion>,
    next_low: Vec<[f64; 4]>,
    /// Of each coordinate the orientation that it is a component of, times four, and the axis.
    places: Vec<u32>,
    /// Of the joints at the midpoint.
    generators: Vec<Generators>,
    /// What the axes of each ball joint have among themselves.
    within: Vec<[[f64; 3]; 3]>,
}

impl BallJoints {
    pub(crate) fn new(model: &Model) -> Self {
        let no = model.orientations.len();
        let (joints, coordinates) = (model.dynamics.joints.len(), model.dimensions.coordinates());
        let mut places = vec![NONE; if no > 0 { coordinates } else { 0 }];
        for (o, &i) in model.orientations.iter().enumerate() {
            (0..3).for_each(|axis| places[i + axis] = (4 * o + axis) as u32);
        }
        let ends = if model.dimensions.constraints > 0 { no } else { 0 };
        let mut balls = Self {
            start: vec![Mat3::IDENTITY; no],
            end: vec![Mat3::IDENTITY; no],
            start_beside: Sided(vec![Mat3([Vec3::default(); 3]); no.div_ceil(f64::BESIDE)]),
            turns: Sided::zeros::<f64>(no),
            next: vec![Quaternion::default(); ends],
            next_low: vec![[0.0; 4]; ends],
            places,
            generators: vec![Generators::default(); if no > 0 { joints } else { 0 }],
            within: vec![[[0.0; 3]; 3]; no],
        };
        balls.stay();
        balls
    }

    /// Begins at orientations.
    pub(crate) fn start_at(&mut self, orientations: &[Quaternion]) {
        let Self { start, start_beside, .. } = self;
        let task = ToMatrices { orientations, matrices: start, beside: start_beside };
        beside(orientations.len(), task);
    }

    /// How one turns over the step.
    #[inline(always)]
    pub(crate) fn turn(&self, orientation: usize) -> Turn {
        self.turns.get::<f64>(orientation)
    }

    /// How all turn over the step.
    pub(crate) fn turns(&self) -> impl Iterator<Item = Turn> {
        (0..self.start.len()).map(|o| self.turn(o))
    }

    /// None turns over the step.
    pub(crate) fn stay(&mut self) {
        (0..self.start.len()).for_each(|o| self.set_turn(o, Turn::new(Vec3::ZERO)));
    }

    /// Replaces how one turns over the step.
    pub(crate) fn set_turn(&mut self, orientation: usize, turn: Turn) {
        self.turns.put::<f64>(orientation, turn);
    }

    /// The orientation that a coordinate is a component of, and the axis.
    #[inline]
    pub(crate) fn of(&self, coordinate: usize) -> Option<(usize, usize)> {
        let place = *self.places.get(coordinate)?;
        (place != NONE).then_some((place as usize / 4, place as usize % 4))
    }

    /// Calls `entry(i, factor)` for what a coordinate's row gives to the rows of its joint, by a map of theirs.
    #[inline]
    fn for_each_row(
        &self,
        i: usize,
        map: impl Fn(usize) -> Mat3,
        mut entry: impl FnMut(usize, f64),
    ) {
        match self.of(i) {
            None => entry(i, 1.0),
            Some((o, axis)) => {
                let column = map(o).0[axis];
                (0..3).for_each(|a| entry(i - axis + a, column[a]));
            }
        }
    }

    /// [`Self::for_each_row`] for columns: by the transpose.
    #[inline]
    fn for_each_column(
        &self,
        j: usize,
        map: impl Fn(usize) -> Mat3,
        mut entry: impl FnMut(usize, f64),
    ) {
        match self.of(j) {
            None => entry(j, 1.0),
            Some((o, axis)) => {
                let columns = map(o).0;
                (0..3).for_each(|b| entry(j - axis + b, columns[b][axis]));
            }
        }
    }
}

impl Workspace {
    /// Starts at the orientations of the state, and finds how prescribed ones turn.
    pub(crate) fn prepare_orientations(
        &mut self,
        model: &Model,
        settings: &Settings,
        state: &PreciseState,
    ) {
        self.balls.start_at(&state.orientations);
        for (o, &i) in model.orientations.iter().enumerate() {
            if i >= model.dimensions.dynamic {
                let end = Quaternion::exp(three(&self.step.q_end, i));
                let turn = state.orientations[o].inverse().times(end).log();
                self.turn_by(o, turn);
                self.balls.end[o] = end.matrix();
                let velocity = turn * (1.0 / settings.time_step_s);
                self.mid.velocity[i..i + 3].copy_from_slice(&velocity.0);
            }
        }
    }

    /// Moves ball joints to the midpoint of the increment.
    pub(crate) fn turn_to_midpoint(&mut self, model: &Model) {
        let coordinates = &model.orientations[..];
        let Self { step, mid, balls: BallJoints { start_beside: start, turns, .. }, .. } = self;
        let (increment, middle) = (&step.increment[..], &mut mid.orientations[..]);
        let task = ToMidpoint { coordinates, increment, start, turns, middle };
        beside(coordinates.len(), task);
    }

    /// Moves a ball joint to the middle of a turn.
    pub(crate) fn turn_by(&mut self, orientation: usize, xi: Vec3) {
        let turn = Turn::new(xi);
        self.balls.set_turn(orientation, turn);
        self.mid.orientations[orientation] = self.balls.start[orientation].times(&turn.half());
    }

    /// Moves ball joints to the end of the increment.
    pub(crate) fn turn_to_end(&mut self, model: &Model, state: &PreciseState) {
        let (coordinates, dynamic) = (&model.orientations[..], model.dimensions.dynamic);
        let Self { step, balls: BallJoints { end, next, next_low, .. }, .. } = self;
        next.copy_from_slice(&state.orientations);
        next_low.copy_from_slice(&state.orientations_low);
        let (increment, q) = (&step.increment[..], &mut step.q_end[..dynamic]);
        let (orientations, low) = (&mut next[..], &mut next_low[..]);
        let task = TurnOn { coordinates, increment, orientations, low, q };
        beside(coordinates.len(), task);
        for (o, _) in coordinates.iter().enumerate().filter(|(_, i)| **i < dynamic) {
            end[o] = next[o].matrix();
        }
    }

    /// Finds how ball joints weigh the Newton matrix at the last evaluation.
    pub(crate) fn weigh_balls(&mut self, model: &Model, settings: &Settings) {
        let (h, a) = (settings.time_step_s, settings.force_split.at_start());
        let Self { mid, kkt, balls, .. } = self;
        let coordinates = &model.orientations[..];
        let task = Weigh {
            coordinates,
            turns: &balls.turns,
            momentum: &mid.l_v,
            torque: &mid.l_q,
            force: &mid.force,
            half: 0.5 * h,
            weight: a * h,
            weights: &mut kkt.balls,
        };
        beside(coordinates.len(), task);
        for (weights, &i) in kkt.balls.iter_mut().zip(coordinates) {
            let Some(damping) = model.damping.get(i..i + 3) else { continue };
            for (b, c) in damping.iter().enumerate() {
                weights.own.0[b] += weights.torque.0[b] * (-a * c);
            }
        }
        for &(i, inertia) in &model.armature.own {
            if let Some((o, axis)) = balls.of(i) {
                let weights = &mut kkt.balls[o];
                weights.own.0[axis] += weights.momentum.0[axis] * (-inertia / h);
            }
        }
    }

    /// Writes the Jacobian of the residual by the increment.
    pub(crate) fn fill_turned_newton_matrix(&mut self, model: &Model, settings: &Settings) {
        let (h, nd) = (settings.time_step_s, model.dimensions.dynamic);
        self.mid.mechanics.differentiate(model);
        self.weigh_balls(model, settings);
        let Self { mid, kkt, balls, .. } = self;
        let (matrix, weights) = (&mut kkt.factored.tree, &kkt.balls[..]);
        if model.couples_more_than_bodies() {
            matrix.clear();
        }
        let step = Step::new(h, MatrixKind::Newton);
        let BallJoints { generators, within, .. } = balls;
        let curvature = &mid.mechanics.curvature;
        in_eights(FillTurned { model, step, curvature, weights, generators, within, matrix });
        for joint in &model.dynamics.joints {
            if joint.kind != JointKind::Ball(0) || joint.coordinate >= nd {
                continue;
            }
            let own = &balls.within[joint.orientation];
            for (row, column) in [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)] {
                // The axes of a joint come last among those that its rows are coupled with.
                let slot = model.elimination.diagonal(joint.coordinate + row) - row + column;
                matrix.upper[slot] = own[column][row];
                matrix.lower[slot] = own[row][column];
            }
        }
        self.add_elements_to_turned_matrix(model, settings);
    }

    /// Springs, armatures, damping and forces, but for what is in the weights of ball joints.
    fn add_elements_to_turned_matrix(&mut self, model: &Model, settings: &Settings) {
        let (h, a) = (settings.time_step_s, settings.force_split.at_start());
        let nd = model.dimensions.dynamic;
        let Self { mid, kkt, balls, .. } = self;
        let (matrix, weights) = (&mut kkt.factored.tree, &kkt.balls);
        let (torque, column) = (|o: usize| weights[o].torque, |o: usize| weights[o].column);
        let mut add_turned = |i: usize, j: usize, value: f64| {
            balls.for_each_row(i, torque, |row, t| {
                balls.for_each_column(j, column, |column, c| {
                    matrix.add(&model.elimination, row, column, t * c * value);
                });
            });
        };
        if model.potentials.any {
            model.for_each_spring_derivative(&mid.mechanics.poses, &mid.q, |i, j, value| {
                if i < nd && j < nd {
                    add_turned(i, j, -0.25 * h * value);
                }
            });
        }
        let instant = mid.instant(model);
        if let Some(forces) = &model.forces {
            forces.for_each_derivative(&instant, |i, j, by_q, _| {
                if i < nd && j < nd {
                    add_turned(i, j, 0.5 * a * h * by_q);
                }
            });
            forces.for_each_derivative(&instant, |i, j, _, by_v| {
                if i < nd && j < nd && by_v != 0.0 {
                    balls.for_each_row(i, torque, |row, t| {
                        matrix.add(&model.elimination, row, j, a * t * by_v);
                    });
                }
            });
        }
        for entry in model.armature.entries().filter(|entry| balls.of(entry.row).is_none()) {
            entry.add_to(matrix, model, -1.0 / h);
        }
        for (i, c) in model.damping.iter().enumerate().filter(|(i, _)| balls.of(*i).is_none()) {
            let slot = model.elimination.diagonal(i);
            matrix.add_to_diagonal(slot, -a * c);
        }
    }

    /// Turns the constraint Jacobian at the end into one by the increment, if it is not.
    pub(crate) fn turn_end_jacobian(&mut self, model: &Model) {
        let (n, nd) = (model.dimensions.coordinates(), model.dimensions.dynamic);
        let end = &mut self.constraints.end;
        if end.is_turned() {
            return;
        }
        for &i in model.orientations.iter().filter(|i| **i < nd) {
            let to_end = rotation::dexp(three(&self.step.increment, i));
            end.turn(i, n, |part| to_end.apply_transposed(part));
        }
    }

    /// Moves the orientations of a state to the end of the step.
    pub(crate) fn turn(&self, model: &Model, state: &mut PreciseState) {
        let (coordinates, dynamic) = (&model.orientations[..], model.dimensions.dynamic);
        let PreciseState { orientations, orientations_low: low, q, q_low, .. } = state;
        let (increment, q) = (&self.step.increment[..], &mut q[..dynamic]);
        let task = TurnOn { coordinates, increment, orientations, low, q };
        beside(coordinates.len(), task);
        for (o, &i) in coordinates.iter().enumerate() {
            match q_low.get_mut(i..i + 3) {
                Some(low) => low.fill(0.0),
                None => state.orientations[o] = Quaternion::exp(three(&self.step.q_end, i)),
            }
        }
    }
}

/// The generators of all joints, `K` of ball joints by themselves, and of pairs.
struct FillTurned<'a> {
    model: &'a Model,
    step: Step,
    curvature: &'a Curvature,
    weights: &'a [Weights],
    generators: &'a mut [Generators],
    within: &'a mut [[[f64; 3]; 3]],
    matrix: &'a mut TreeLu,
}

impl InEights for FillTurned<'_> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { model, step, curvature, weights, generators, within, matrix } = self;
        for (i, joint) in model.dynamics.joints.iter().enumerate() {
            match joint.kind {
                JointKind::Ball(0) if joint.coordinate < model.dimensions.dynamic => {
                    let (parts, o) = (step.parts_of_ball::<E>(curvature, i), joint.orientation);
                    let (own, among) = of_ball(&parts, &weights[o]);
                    within[o] = among;
                    for (own, to) in own.iter().zip(&mut generators[i..]) {
                        own.put(to);
                    }
                }
                JointKind::Ball(_) => {}
                _ => step.parts::<E>(curvature, i).generators().put(&mut generators[i]),
            }
        }
        for pair in &model.pairs {
            let (a, d) =
                (&generators[pair.ancestor as usize], &generators[pair.descendant as usize]);
            matrix.upper[pair.slot as usize] = E::dot_of(&a.minus, &d.upper);
            matrix.lower[pair.slot as usize] = E::dot_of(&a.plus, &d.lower);
        }
    }
}

/// What [`Tangents::find_flanks`] does.
struct FindFlanks<'a> {
    model: &'a Model,
    step: Step,
    curvature: &'a Curvature,
    turnings: &'a [Turning],
    weights: &'a [Weights],
    flanks: &'a mut [Flanks],
}

impl InEights for FindFlanks<'_> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { model, step, curvature, turnings, weights, flanks } = self;
        for (i, joint) in model.dynamics.joints.iter().enumerate() {
            match joint.kind {
                JointKind::Ball(0) if joint.coordinate < model.dimensions.dynamic => {
                    let (parts, o) = (step.parts_of_ball::<E>(curvature, i), joint.orientation);
                    let own = Flanks::of_ball(&parts, &turnings[o], &weights[o]);
                    for (own, to) in own.iter().zip(&mut flanks[i..]) {
                        own.put(to);
                    }
                }
                JointKind::Ball(_) => {}
                _ => Flanks::of(&step.parts::<E>(curvature, i)).put(&mut flanks[i]),
            }
        }
    }
}

impl Tangents {
    /// What joints give to the linearization, at the second derivatives of `mechanics`.
    #[inline(never)]
    pub(crate) fn find_flanks(
        &mut self,
        model: &Model,
        curvature: &Curvature,
        (turnings, weights): (&[Turning], &[Weights]),
        h: f64,
    ) {
        let (step, flanks) = (Step::new(h, MatrixKind::Newton), &mut self.flanks[..]);
        in_eights(FindFlanks { model, step, curvature, turnings, weights, flanks });
    }
}
