//! The end of a step without another look: what the last correction leaves over is foreseen, and the impulse
//! follows the correction by its derivative.
//!
//! After a correction `x'` with the Jacobian itself, what is left of the residual is of second order,
//! `½ K' x' x'`. It is next to nothing but the change of the momentum with the mass matrix, whose entries change
//! by at most `2 α √(I_i I_j)`, with the largest inertia `I` that each coordinate can have:
//!
//! ```text
//! |r1| ≲ √I_max (1 + Σ |x|) α σ / h      α = Σ |x'_i|      σ² = Σ I_i x'_i²
//! ```
//!
//! With the Jacobian of an increment that is `y` away it is `α_y σ + α σ_y + α σ` in place of `α σ`. In motions
//! of many joints less than a tenth of it is left. Metres count as radians: of slides that is more than it need
//! be. A second estimate is [`Chord::expected`](super::newton), from how the residual has fallen so far.
//!
//! Springs and forces leave `½ K' x' x'` of their own, no more than `¼ h α² C`, where `C` bounds second derivatives of
//! `τ + f` along changes of the midpoint by `½ x'` and of its velocity by `x'/h`. Each element bounds its own, from
//! levers, lengths and forces at the last evaluation; it is what is there some ten to a thousand times, and still far
//! less than what the mass matrix leaves.
//!
//! `p[k+1] = p[k] + h (τ + f)` has been found before the correction; what the correction makes of it is linear,
//! with an error as small as what is left of the residual.
//!
//! The residual is linear in the multipliers. Constraints are evaluated where the correction leads, once more or
//! for the last time: it is where the next step begins. Where they are next to singular, multipliers are large, and
//! so is what rounding leaves of a correction: there nothing is foreseen.

use plantd_math::scalar::Compared;
use plantd_math::spatial::three;

use crate::integrator::midpoint::Midpoint;
use crate::integrator::report::StepReport;
use crate::integrator::settings::{ForceSplit, Settings};
use crate::integrator::state::PreciseState;
use crate::integrator::workspace::Workspace;
use crate::kkt::system::{Estimates, Recursion};
use crate::lagrangian::arrangement::Planar;
use crate::lagrangian::fields::OwnTorque;
use crate::lagrangian::instant::Instant;
use crate::lagrangian::kinematics::Place;
use crate::lagrangian::mechanics::Mechanics;
use crate::lagrangian::nudge::Nudge;
use crate::model::mechanism::{CoordinateSpring, Forces, LinearSpring, Model, Spring};

/// What may be left of the residual unseen, in units of its round-off, as it is estimated.
const UNSEEN: f64 = 0.5;
/// How much constraints may be violated, in units of round-off, and the least reciprocal condition estimate.
const HELD: f64 = 1.0;
const REGULAR: f64 = 1e-4;
/// The same where the residual has fallen accordingly, and what may be expected from that. By itself the fall says
/// little: what is linear falls at once, and hides what is not.
const BORNE_OUT: f64 = 16.0;
const EXPECTED: f64 = 0.2;

/// How far corrections have gone from the increment of the Jacobian.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Strayed<S = f64> {
    /// `α`.
    turned: S,
    /// `σ`.
    weighed: S,
}

impl<S: Compared> Strayed<S> {
    /// What a correction of an increment leaves of the residual, in units that are given.
    #[inline(always)]
    pub(crate) fn left(
        &mut self,
        corrections: &[S],
        increments: &[S],
        inertia: &[f64],
        unit: S,
    ) -> S {
        let ([mut turned, mut moved, mut square], mut largest) = ([S::ZERO; 3], 0.0_f64);
        for ((x, increment), inertia) in corrections.iter().zip(increments).zip(inertia) {
            turned += x.abs();
            moved += increment.abs();
            square += *x * *x * *inertia;
            largest = largest.max(*inertia);
        }
        let weighed = square.sqrt();
        let product = self.turned * weighed + turned * (self.weighed + weighed);
        self.turned += turned;
        self.weighed += weighed;
        product * largest.sqrt() * (moved + 1.0) / unit
    }

    /// `α`.
    pub(crate) fn turned(&self) -> S {
        self.turned
    }

    /// A new Jacobian, where there is one.
    #[inline(always)]
    pub(crate) fn begin_again(&mut self, is_fresh: S::Truth) {
        self.turned = S::choose(is_fresh, S::ZERO, self.turned);
        self.weighed = S::choose(is_fresh, S::ZERO, self.weighed);
    }
}

impl Model {
    /// Whether bodies, with constraints, damping, armatures, inputs and linear springs on coordinates, are all there
    /// is.
    pub(crate) fn is_of_bodies(&self) -> bool {
        let mut springs = self.potentials.springs.iter();
        self.forces.is_none() && springs.all(|spring| matches!(spring, Spring::Coordinate(_)))
    }

    /// Whether springs and forces are such as plants side by side have: linear springs, dry friction and constant
    /// forces, all on coordinates.
    pub(crate) fn has_simple_elements(&self) -> bool {
        self.forces.as_ref().is_none_or(Forces::go_abreast)
            && self.potentials.springs.iter().all(Spring::is_linear)
    }

    /// Whether the end of steps is foreseen: of bodies and linear springs of coordinates, where the impulse has a
    /// derivative that is as cheap as a correction; and of all that generators have, with equal halves of forces.
    ///
    /// Of springs that swing faster than a radian a step, the impulse of a guess is so much larger than that of the
    /// solution that its round-off shows.
    pub(crate) fn is_foreseen(&self, settings: &Settings) -> bool {
        let (square, inertia) = (settings.time_step_s.powi(2), &self.conditioning.inertia);
        let is_slow = |i: &usize, stiffness: f64| {
            inertia.get(*i).is_none_or(|inertia| stiffness * square <= *inertia)
        };
        let is_soft = |spring: &Spring| match spring {
            Spring::Coordinate(CoordinateSpring { coordinate, stiffness, .. }) => {
                is_slow(coordinate, *stiffness)
            }
            Spring::Linear(LinearSpring { terms, stiffness, .. }) => {
                terms.iter().all(|(i, c)| is_slow(i, stiffness * c * c))
            }
            _ => true,
        };
        let is_symmetric = settings.force_split == ForceSplit::Symmetric;
        let has_derivative = if self.is_of_bodies() {
            self.orientations.is_empty() || is_symmetric
        } else {
            is_symmetric && self.foresees_elements
        };
        has_derivative && self.potentials.springs.iter().all(is_soft)
    }
}

/// Whether a residual that is estimated and expected to be left may stay unseen.
#[inline(always)]
pub(crate) fn is_negligible<S: Compared>(left: S, expected: S) -> S::Truth {
    let [unseen, borne_out, little] = [UNSEEN, BORNE_OUT, EXPECTED].map(S::constant);
    left.at_most(unseen) | (left.at_most(borne_out) & expected.at_most(little))
}

/// How a correction changes a coordinate at the midpoint, and its velocity.
#[inline(always)]
pub(crate) fn change_of<S: Compared>(x: S, h: f64) -> [S; 2] {
    [x * -0.5, -x / h]
}

impl<S: Planar> Nudge<S> {
    /// Moves an impulse on by a correction, but for what ball joints make of it.
    #[inline(always)]
    pub(crate) fn move_on(
        &mut self,
        model: &Model,
        mechanics: &mut Mechanics<S>,
        corrections: &[S],
        h: f64,
        turn: impl FnOnce(&mut [S]),
        impulse: &mut [S],
    ) {
        let changes = self.position.iter_mut().zip(&mut self.velocity);
        for ((position, velocity), x) in changes.zip(corrections) {
            [*position, *velocity] = change_of(*x, h);
        }
        turn(&mut self.position);
        self.find(model, mechanics);
        for (impulse, l_q) in impulse.iter_mut().zip(&self.l_q) {
            *impulse += *l_q * h;
        }
        for ((impulse, c), x) in impulse.iter_mut().zip(&model.damping).zip(corrections) {
            *impulse += *x * *c;
        }
    }

    /// The same of linear springs on coordinates, where nothing else acts.
    #[inline(always)]
    pub(crate) fn move_springs_on(&self, model: &Model, h: f64, impulse: &mut [S]) {
        for spring in &model.potentials.springs {
            let Spring::Coordinate(CoordinateSpring { coordinate: i, stiffness, .. }) = spring
            else {
                continue;
            };
            if let (Some(impulse), Some(x)) = (impulse.get_mut(*i), self.position.get(*i)) {
                *impulse -= *x * (stiffness * h);
            }
        }
    }
}

impl Workspace {
    /// What the last correction leaves of the residual, in units of its round-off.
    #[inline(never)]
    pub(crate) fn foresee<const BODIES: bool>(
        &self,
        model: &Model,
        settings: &Settings,
        strayed: &mut Strayed,
    ) -> f64 {
        let (h, round_off) = (settings.time_step_s, f64::EPSILON * self.residual.round_off);
        let (corrections, inertia) = (&self.residual.dynamics, &model.conditioning.inertia);
        let before = strayed.turned;
        let unit = round_off * h.abs();
        let left = strayed.left(corrections, &self.step.increment, inertia, unit);
        if BODIES || left > BORNE_OUT {
            return left;
        }
        // `α_y α + α_y α + α²`.
        let square = strayed.turned.powi(2) - before.powi(2);
        left + square * (0.25 * h * self.mid.curve(model, h)).abs() / round_off
    }

    /// Whether the constraints hold where the last correction leads; if they do, what the next step begins with is
    /// found, too.
    pub(crate) fn holds_constraints(
        &mut self,
        model: &Model,
        state: &PreciseState,
        report: &mut StepReport,
    ) -> bool {
        if model.dimensions.constraints == 0 {
            return true;
        }
        let Estimates { constraints, redundant, .. } = self.kkt.estimates;
        if constraints < REGULAR || redundant > 0 {
            return false;
        }
        report.constraint_residual = self.evaluate_end(model, state);
        let holds = report.constraint_residual <= HELD;
        if holds {
            self.constraints.end.begin(model, &self.step.q_end);
        }
        holds
    }

    /// Moves the impulse on by the last correction, at the last factorization; but for
    /// [what is not of bodies](Self::nudge_elements).
    #[inline(never)]
    pub(crate) fn nudge_impulse<const BODIES: bool>(&mut self, model: &Model, settings: &Settings) {
        let h = settings.time_step_s;
        let Self { step, mid, balls, residual, kkt, nudge, .. } = self;
        let corrections = &residual.dynamics[..];
        let orientations = || {
            let all = model.orientations.iter().enumerate();
            all.filter(|(_, i)| **i < model.dimensions.dynamic).map(|(o, i)| (o, *i))
        };
        let turn = |position: &mut [f64]| {
            for (o, i) in orientations() {
                let turned = kkt.balls[o].column.apply(three(position, i));
                position[i..i + 3].copy_from_slice(&turned.0);
            }
        };
        nudge.move_on(model, &mut mid.mechanics, corrections, h, turn, &mut step.impulse);
        if BODIES {
            nudge.move_springs_on(model, h, &mut step.impulse);
        }
        if model.orientations.is_empty() {
            return;
        }
        model.armature.add_momentum(&nudge.velocity, &mut nudge.l_v);
        // Of m × ξ.
        for (o, i) in orientations() {
            let (m, x) = (three(&mid.l_v, i), three(corrections, i));
            let change = three(&nudge.l_v, i).cross(balls.turn(o).xi) - m.cross(x);
            for (impulse, change) in step.impulse[i..i + 3].iter_mut().zip(change.0) {
                *impulse += change;
            }
        }
    }

    /// Moves the impulse on by what springs and forces make of the change that [`Self::nudge_impulse`] has moved it by,
    /// with equal halves.
    #[inline(never)]
    pub(crate) fn nudge_elements(&mut self, model: &Model, h: f64) {
        let Self { step, mid, kkt, nudge, .. } = self;
        let Nudge { position, velocity, .. } = nudge;
        let (impulse, at) = (&mut step.impulse[..], mid.instant(model));
        let nd = impulse.len();
        let mut add = |i: usize, j: usize, by_q: f64, by_v: f64| {
            if i < nd && j < nd {
                impulse[i] += h * (by_q * position[j] + by_v * velocity[j]);
            }
        };
        let has_springs = model.potentials.any;
        if !matches!(kkt.factored.recursion, Recursion::Spatial(_)) {
            if has_springs {
                let mut add = |i, j, value: f64| add(i, j, -value, 0.0);
                model.for_each_spring_derivative(at.poses, at.q, &mut add);
            }
            if let Some(forces) = &model.forces {
                forces.for_each_derivative(&at, add);
            }
            return;
        }
        if has_springs {
            model.for_each_own_spring_derivative(at.poses, at.q, |i, value| add(i, i, -value, 0.0));
        }
        if let Some(forces) = &model.forces {
            forces.for_each_own_derivative(&at, |i, by_q, by_v| add(i, i, by_q, by_v));
        }
        if !model.orientations.is_empty() {
            mid.for_each_own_torque(model, (kkt.fields.as_deref(), 1.0), |o, own| {
                let first = model.orientations[o];
                for (row, column) in (0..9).map(|entry| (entry / 3, entry % 3)) {
                    let OwnTorque { by_turn, by_velocity } = own;
                    let [by_q, by_v] = [by_turn, by_velocity].map(|by| by.0[column][row]);
                    add(first + row, first + column, by_q, by_v);
                }
            });
        }
        if let Some(tied) = &kkt.tied {
            tied.add_change([position, velocity], h, impulse);
        }
        if let Some(fields) = &mut kkt.fields {
            let curvature = &mid.mechanics.curvature;
            fields.add_change(model, curvature, [position, velocity], h, impulse);
        }
    }
}

impl Midpoint {
    /// A bound of the second derivative of `L_q + f` along changes of the increment whose magnitudes sum up to one, as
    /// far as springs and forces make it.
    fn curve(&self, model: &Model, h: f64) -> f64 {
        let (at, moved, mut sum) = (self.instant(model), 0.5, 0.0);
        if model.potentials.any {
            let Instant { tree, poses, q, .. } = at;
            sum += moved * moved * model.third_spring_derivative(Place { tree, poses, q });
        }
        if let Some(forces) = &model.forces {
            sum += forces.second_derivative(&at, [moved, 1.0 / h.abs()]);
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::model::mechanism::Solver;
    use crate::plant::facade::Plant;
    use crate::plant::initial::Initial;
    use plantd_math::norms::largest;
    use plantd_scene::builtin;

    /// The residual that a solution leaves, where it was not looked at, and how far its impulse is from what it is there,
    /// both in units of round-off.
    fn look(plant: &mut Plant) -> Option<[f64; 2]> {
        let Plant { model, settings, state, workspace, .. } = plant;
        if workspace.step.is_evaluated {
            return None;
        }
        let impulse = workspace.step.impulse.clone();
        let size = workspace.evaluate(model, settings, state);
        workspace.find_impulse(model, settings);
        let apart: Vec<f64> =
            impulse.iter().zip(&workspace.step.impulse).map(|(a, b)| a - b).collect();
        Some([size, largest(&apart) / (f64::EPSILON * workspace.residual.round_off)])
    }

    /// What was not looked at is what it was taken for: residual and impulse at the solution, in motions that go
    /// on by themselves, and in those that are pushed anew at each step.
    #[test]
    fn what_is_left_unseen_is_round_off() {
        let mut unseen = 0;
        let in_space =
            ["spherical-pendulum", "tree-15", "walker-9", "balls-1", "balls-2", "balls-31"];
        let in_planes = ["pendulum", "double-pendulum", "cart-pole", "chain-8"];
        let sprung = ["tree-15 sprung", "walker-9 sprung", "chain-8 sprung"];
        for name in [&in_space[..], &in_planes, &["chain-8 in space"], &sprung].concat() {
            let (scene, is_sprung) = (name.split(' ').next().unwrap(), sprung.contains(&name));
            let mut model = Model::compile(&builtin::scene(scene).unwrap()).unwrap();
            assert_eq!(model.planar.is_none(), in_space.contains(&scene), "{name}");
            if name.ends_with(" in space") {
                (model.planar, model.solver) = (None, Solver::Spatial);
            }
            if is_sprung {
                let spring =
                    |coordinate| CoordinateSpring { coordinate, rest: 0.2, stiffness: 9.0 };
                // The walker's first coordinates are those of its hull.
                let sprung = (6..model.dimensions.dynamic).map(spring).map(Spring::Coordinate);
                model.potentials.springs.extend(sprung);
                model.potentials.any = true;
            }
            // The chain's springs drive it so that new factors and more corrections leave up to 83 units.
            let floor = if is_sprung { 128.0 } else { 64.0 };
            let model = Arc::new(model);
            let settings = Settings { time_step_s: 0.002, ..Settings::new(&model) };
            let mut plant = Plant::new(Arc::clone(&model), settings).unwrap();
            let n = model.dimensions.coordinates();
            let q = plant.state.q.clone();
            let v = (0..n).map(|i| (1.7 * i as f64).sin()).collect();
            plant.initialize(&Initial::Velocity { q, v }).unwrap();
            let mut u = vec![0.0; model.dimensions.input()];
            for k in 0..60 {
                if k > 30 {
                    u.iter_mut().zip(0..).for_each(|(u, i)| *u = f64::from(k * k + i).sin());
                }
                plant.solve(&u, None).unwrap();
                let report = plant.workspace.step.report;
                if let Some([size, apart]) = look(&mut plant) {
                    unseen += 1;
                    assert!(report.residual <= UNSEEN && size < floor, "{name}: {size}");
                    assert!(apart < 1.0, "{name}: {apart}");
                }
                plant.commit();
            }
        }
        assert!(unseen > 250, "{unseen}");
    }

    /// A walker that is pulled, pushed and braked: from the world, between its hull and a foot, and at joints.
    const PULLED: &str = r#"
[[springs]]
type = "two_point"
a = { frame = "foot0", at = [0.0, 0.1, -0.2] }
b = { frame = "world", at = [0.5, 0.0, -1.5] }
stiffness = 40.0
rest_length = 0.5
[[springs]]
type = "two_point"
a = { frame = "hull", at = [0.0, 0.1, 0.2] }
b = { frame = "foot2" }
stiffness = 20.0
[[springs]]
type = "path"
points = [{ frame = "hull", at = [0.1, 0.0, 0.2] }, { frame = "foot2" }, { frame = "hull" }]
stiffness = 10.0
rest_length = 0.3
[[springs]]
type = "orientation"
frame = "hull"
stiffness = 5.0
[[springs]]
type = "stop"
coordinate = "knee1"
range = [-0.1, 0.1]
stiffness = 30.0
damping = 2.0
transition = 0.3
[[springs]]
type = "spline"
coordinate = "knee2"
knots = [{ x = -1.0, value = 2.0 }, { x = 0.0, value = 0.0 }, { x = 1.0, value = -3.0 }]
[[forces]]
type = "body_wrench"
frame = "foot1"
force = [0.3, 0.0, 2.0]
torque = [0.0, 0.1, 0.2]
[[forces]]
type = "hybrid_wrench"
frame = "hull"
force = [0.3, 0.0, 20.0]
torque = [0.0, 0.0, 0.0]
[[forces]]
type = "drag"
frame = "foot1"
coefficient = 0.5
[[forces]]
type = "two_point_damper"
a = { frame = "hull" }
b = { frame = "foot2", at = [0.0, 0.0, -0.3] }
damping = 1.5
[[forces]]
type = "path_damper"
points = [{ frame = "hull", at = [0.1, 0.0, 0.2] }, { frame = "foot2" }]
damping = 0.5
[[forces]]
type = "friction"
coordinate = "hip3"
force = 0.5
velocity = 0.3
[[forces]]
type = "coordinate_drag"
coordinate = "hip2"
coefficient = 0.2
cubic = 0.1
"#;

    /// The same with what acts on bodies, by generators and entry by entry; and the motion is that of steps of which all
    /// are looked at.
    #[test]
    fn what_elements_leave_unseen_is_round_off() {
        for is_generated in [true, false] {
            let text = builtin::scene("walker-4").unwrap().to_toml() + PULLED;
            let scene = plantd_scene::Scene::from_toml(&text).unwrap();
            let [mut plant, mut looked_at] = [true, false].map(|foresees| {
                let mut model = Model::compile(&scene).unwrap();
                model.solver = if is_generated { Solver::Spatial } else { Solver::Tree };
                model.foresees_elements &= foresees;
                let settings = Settings { time_step_s: 0.002, ..Settings::new(&model) };
                Plant::new(Arc::new(model), settings).unwrap()
            });
            let n = plant.model.dimensions.coordinates();
            let q = plant.state.q.clone();
            let v: Vec<f64> = (0..n).map(|i| (1.7 * i as f64).sin()).collect();
            for plant in [&mut plant, &mut looked_at] {
                plant.initialize(&Initial::Velocity { q: q.clone(), v: v.clone() }).unwrap();
            }
            let u = vec![0.3; plant.model.dimensions.input()];
            let mut unseen = 0;
            for _ in 0..200 {
                looked_at.step(&u).unwrap();
                plant.solve(&u, None).unwrap();
                if let Some([size, apart]) = look(&mut plant) {
                    unseen += 1;
                    assert!(size < 64.0 && apart < 1.0, "{size} {apart}");
                }
                plant.commit();
            }
            assert!(unseen > 100, "{unseen}");
            for (a, b) in [(plant.q(), looked_at.q()), (plant.p(), looked_at.p())] {
                let apart: Vec<f64> = a.iter().zip(b).map(|(a, b)| a - b).collect();
                assert!(largest(&apart) < 1e-11, "{:e}", largest(&apart));
            }
        }
    }

    /// The same with constraints, which hold where nobody looked at the rest.
    #[test]
    fn constraints_hold_and_what_is_unseen_is_round_off() {
        let mut unseen = 0;
        for name in ["four-bar", "scissor-8", "marionette"] {
            let model = Arc::new(Model::compile(&builtin::scene(name).unwrap()).unwrap());
            let settings = Settings { time_step_s: 0.002, ..Settings::new(&model) };
            let mut plant = Plant::new(Arc::clone(&model), settings).unwrap();
            plant.initialize(&Initial::Scene).unwrap();
            let mut u = vec![0.0; model.dimensions.input()];
            plant.hold_input(&mut u);
            for _ in 0..60 {
                plant.solve(&u, None).unwrap();
                let Plant { model, state, workspace, .. } = &mut plant;
                let report = workspace.step.report;
                if !workspace.step.is_evaluated {
                    unseen += 1;
                    assert!(report.constraint_residual <= HELD, "{name}");
                    let impulse = workspace.step.impulse.clone();
                    let size = workspace.evaluate(model, &settings, state);
                    assert!(size < 64.0, "{name}: {size}");
                    workspace.find_impulse(model, &settings);
                    let Workspace { step, constraints, residual, .. } = &mut *workspace;
                    let multipliers = &step.multipliers;
                    constraints.start.subtract_pushes(model, multipliers, &mut step.impulse);
                    let apart: Vec<f64> =
                        impulse.iter().zip(&step.impulse).map(|(a, b)| a - b).collect();
                    let apart = largest(&apart) / (f64::EPSILON * residual.round_off);
                    assert!(apart < 16.0, "{name}: {apart}");
                    step.impulse.copy_from_slice(&impulse);
                }
                plant.commit();
            }
        }
        assert!(unseen > 60, "{unseen}");
    }
}
