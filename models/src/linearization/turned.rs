//! The derivatives of the equations of a step with ball joints, by start, next and inputs.
//!
//! Rows and columns of ball joints are weighed by the maps of their [`Turning`]. With torque `τ = L_q`,
//! momentum `m = L_v` and force `f` of the midpoint, the weight `a` of `F⁻`, and a dash for derivatives by a
//! column,
//!
//! ```text
//! rows of r1         T⁻ (½h τ' + a h f') − N⁻ m'
//! rows of p[k+1]     h (τ' + f') + m' × ξ + (2a − 1) h (T⁻ − 1) f'
//! ```
//!
//! which for other coordinates is what it is with `T⁻ = N⁻ = 1` and `ξ = 0`. Next is `ξ` itself: its columns
//! turn the maps, too. What the Lagrangian of the bodies gives is products of
//! [`generators`](crate::lagrangian::generators); springs and forces come entry by entry, and each goes to all
//! rows and columns of the ball joints that it belongs to.

use plantd_math::eights::{Eight, InEights, in_eights};
use plantd_math::rotation;
use plantd_math::simd::wide;
use plantd_math::spatial::{Mat3, three};

use crate::integrator::balls::BallJoints;
use crate::integrator::workspace::{StepContext, Tangents, Workspace};
use crate::kkt::space::margins::OfBall;
use crate::lagrangian::curvature::Within;
use crate::lagrangian::fields::OwnTorque;
use crate::lagrangian::generators::{Flanks, Parts};
use crate::lagrangian::turning::Turning;
use crate::linearization::ends::Ends;
use crate::linearization::linearize::Linearization;
use crate::model::mechanism::{Model, Pair};
use crate::model::tree::JointKind;

/// Derivatives of torque, momentum and force of one coordinate by position and velocity of another.
#[derive(Clone, Copy, Debug, Default)]
struct Entry {
    torque: [f64; 2],
    momentum: [f64; 2],
    force: [f64; 2],
}

/// What the row of a coordinate gives to a row of its joint.
#[derive(Clone, Copy, Debug)]
struct Row {
    row: usize,
    /// Whether it is its own.
    own: f64,
    /// Of `T⁻`, `N⁻` and of `× ξ`.
    torque: f64,
    momentum: f64,
    spin: f64,
}

/// By how much position and velocity of a coordinate change with a column of its joint.
#[derive(Clone, Copy, Debug)]
struct Column {
    column: usize,
    start: [f64; 2],
    next: [f64; 2],
}

/// Where the derivatives of a step go.
struct Sink<'a> {
    balls: &'a BallJoints,
    turnings: &'a [Turning],
    tangents: &'a mut Tangents,
    increment: &'a mut [f64],
    momentum: &'a mut [f64],
    h: f64,
    /// `a h` and `(2a − 1) h`.
    split: f64,
    skew: f64,
    nd: usize,
    nk: usize,
    stride: usize,
}

impl Sink<'_> {
    fn rows(&self, i: usize) -> impl Iterator<Item = Row> + use<> {
        let alone = Row { row: i, own: 1.0, torque: 1.0, momentum: 1.0, spin: 0.0 };
        let rows = match self.balls.of(i) {
            None => [Some(alone), None, None],
            Some((o, axis)) => {
                let turning = &self.turnings[o];
                let [torque, momentum, spin] =
                    [turning.torque, turning.momentum, turning.spin()].map(|map| map.0[axis]);
                [0, 1, 2].map(|a| {
                    let (row, own) = (i - axis + a, f64::from(u8::from(a == axis)));
                    let (torque, momentum, spin) = (torque[a], momentum[a], spin[a]);
                    Some(Row { row, own, torque, momentum, spin })
                })
            }
        };
        rows.into_iter().flatten()
    }

    fn columns(&self, j: usize) -> impl Iterator<Item = Column> + use<> {
        let next = [0.5, 1.0 / self.h];
        let start = if j < self.nd { [1.0, 0.0] } else { [0.5, -1.0 / self.h] };
        let columns = match self.balls.of(j) {
            None => [Some(Column { column: j, start, next }), None, None],
            Some((o, axis)) => {
                let Turning { by_start, by_next, .. } = &self.turnings[o];
                [0, 1, 2].map(|b| {
                    let [start, next] = [by_start, by_next]
                        .map(|(position, velocity)| [position.0[b][axis], velocity.0[b][axis]]);
                    Some(Column { column: j - axis + b, start, next })
                })
            }
        };
        columns.into_iter().flatten()
    }

    /// Adds an entry, in row `i` and column `j` of the derivatives of the Lagrangian and of forces.
    fn add(&mut self, i: usize, j: usize, entry: Entry) {
        let Self { h, split, skew, nd, nk, stride, .. } = *self;
        let Entry { torque, momentum, force } = entry;
        for at in self.rows(i) {
            let residual = |[p, v]: [f64; 2]| {
                let impulse = (torque[0] * p + torque[1] * v) * (0.5 * h)
                    + (force[0] * p + force[1] * v) * split;
                impulse * at.torque - (momentum[0] * p + momentum[1] * v) * at.momentum
            };
            let change = |[p, v]: [f64; 2]| {
                let force = force[0] * p + force[1] * v;
                let impulse = (torque[0] * p + torque[1] * v + force) * h;
                let skewed = force * skew * (at.torque - at.own);
                impulse * at.own + (momentum[0] * p + momentum[1] * v) * at.spin + skewed
            };
            for Column { column, start, next } in self.columns(j) {
                self.increment[at.row * stride + column] += residual(start);
                if column < nd {
                    self.momentum[at.row * stride + column] += change(start);
                    self.tangents.end_slopes[at.row * nd + column] += change(next);
                } else {
                    self.increment[at.row * stride + column + nd + nk] += residual(next);
                    self.momentum[at.row * stride + column] += change(start);
                    self.momentum[at.row * stride + column + nd + nk] += change(next);
                }
            }
        }
    }

    /// What the Lagrangian of the bodies gives to pairs of dynamic joints, a joint with itself included.
    #[inline(never)]
    fn put_pairs(&mut self, model: &Model) {
        let (nd, stride) = (self.nd, self.stride);
        let (increment, momentum) = (&mut *self.increment, &mut *self.momentum);
        let Tangents { flanks, end_slopes, .. } = &mut *self.tangents;
        end_slopes.fill(0.0);
        let pairs = &model.pairs[..];
        in_eights(PutPairs { pairs, flanks, increment, momentum, end_slopes, nd, stride });
    }

    /// The same for the axes of one ball joint.
    fn put_ball(&mut self, first: usize, own: &OfBall) {
        let Self { nd, stride, .. } = *self;
        for (row, column) in (0..9).map(|entry| (entry / 3, entry % 3)) {
            let (i, j) = (first + row, first + column);
            self.increment[i * stride + j] = own.residual.0[column][row];
            self.momentum[i * stride + j] = own.by_start.0[column][row];
            self.tangents.end_slopes[i * nd + j] = own.by_increment.0[column][row];
        }
    }
}

impl OfBall {
    /// What the Lagrangian of the bodies gives. The change of `m × ξ + (2a − 1) h (T⁻ − 1) f` with `ξ` is
    /// `turned`.
    #[inline(always)]
    fn new(turning: &Turning, within: &Within, turned: &Mat3, h: f64) -> Self {
        let Within { tau_z, tau_v, m_v } = within;
        let (start, middle) = (&turning.by_start.0, &turning.by_next.0);
        let spin = turning.spin();
        let [torque, momentum] = [tau_z.times(start), tau_v.transpose().times(start)];
        let residual = turning.torque.times(&torque.scaled(0.5 * h));
        let residual = residual.minus(&turning.momentum.times(&momentum));
        let by_start = torque.scaled(h).plus(&spin.times(&momentum));
        let torque = tau_z.times(middle).plus(&tau_v.scaled(1.0 / h));
        let momentum = tau_v.transpose().times(middle).plus(&m_v.scaled(1.0 / h));
        let by_increment = torque.scaled(h).plus(&spin.times(&momentum)).plus(turned);
        Self { residual, by_start, by_increment }
    }

    /// A torque that follows from its own turn and velocity.
    pub(crate) fn add_torque(&mut self, turning: &Turning, torque: &OwnTorque, h: f64) {
        let OwnTorque { by_turn, by_velocity } = torque;
        let (start, middle) = (&turning.by_start.0, &turning.by_next.0);
        let by_start = by_turn.times(start).scaled(h);
        self.residual = self.residual.plus(&turning.torque.times(&by_start.scaled(0.5)));
        self.by_start = self.by_start.plus(&by_start);
        let by_increment = by_turn.times(middle).scaled(h).plus(by_velocity);
        self.by_increment = self.by_increment.plus(&by_increment);
    }

    /// Dampers and armatures of its coordinates, which change with the velocity `ξ/h` alone.
    fn add(
        &mut self,
        turning: &Turning,
        axis: usize,
        [damping, inertia]: [f64; 2],
        [h, skew]: [f64; 2],
    ) {
        let [own, torque] = [Mat3::IDENTITY, turning.torque].map(|map| map.0[axis]);
        let force = own * h + (torque - own) * skew;
        let change = force * -damping + turning.spin().0[axis] * inertia;
        self.by_increment.0[axis] += change * (1.0 / h);
    }
}

/// What [`Sink::put_pairs`] does.
struct PutPairs<'a> {
    pairs: &'a [Pair],
    flanks: &'a [Flanks],
    increment: &'a mut [f64],
    momentum: &'a mut [f64],
    end_slopes: &'a mut [f64],
    nd: usize,
    stride: usize,
}

impl InEights for PutPairs<'_> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { pairs, flanks, increment, momentum, end_slopes, nd, stride } = self;
        for pair in pairs {
            let (i, j) = (pair.row as usize, pair.column as usize);
            let (a, d) = (&flanks[pair.ancestor as usize], &flanks[pair.descendant as usize]);
            if !(a.is_turned || d.is_turned) {
                // ¼h L_qq, ½ L_vq and ½ L_qv.
                let Parts { axis, rate, .. } = &a.parts;
                let Parts { force, slope, .. } = &d.parts;
                let half = 2.0 * E::dot_of(rate, slope);
                let (vq, qv) = (2.0 * E::dot_of(axis, slope), 2.0 * E::dot_of(rate, force));
                increment[i * stride + j] = half - vq;
                increment[j * stride + i] = half - qv;
                end_slopes[i * nd + j] = half + qv;
                end_slopes[j * nd + i] = half + vq;
                momentum[i * stride + j] = 2.0 * half;
                momentum[j * stride + i] = 2.0 * half;
                continue;
            }
            increment[i * stride + j] = E::dot_of(&a.newton.minus, &d.below);
            increment[j * stride + i] = E::dot_of(&a.above, &d.newton.lower);
            momentum[i * stride + j] = E::dot_of(&a.carry, &d.below);
            momentum[j * stride + i] = E::dot_of(&a.above, &d.push);
            end_slopes[i * nd + j] = E::dot_of(&a.carry, &d.newton.upper);
            end_slopes[j * nd + i] = E::dot_of(&a.newton.plus, &d.push);
        }
    }
}

impl Workspace {
    /// Writes `r1'` into `out.increment` and starts `out.momentum`, both zero, with what does not depend on `x'`,
    /// but for constraints and momenta; the second derivatives are those of the last Newton matrix.
    pub(crate) fn fill_turned_right_hand_sides(
        &mut self,
        at: StepContext<'_>,
        out: &mut Linearization,
    ) {
        let (model, h) = (at.model, at.settings.time_step_s);
        self.find_turnings(at, &mut out.ends);
        let Self { mid, kkt, balls, tangents, .. } = self;
        let balls = &*balls;
        tangents.find_flanks(model, &mid.mechanics.curvature, (&out.ends.turnings, &kkt.balls), h);
        let split = h * out.ends.at_start;
        let mut sink = Sink {
            balls,
            turnings: &out.ends.turnings,
            tangents,
            increment: &mut out.increment,
            momentum: &mut out.momentum,
            h,
            split,
            skew: 2.0 * split - h,
            nd: out.nd,
            nk: out.nk,
            stride: out.stride,
        };
        let joints = &model.dynamics.joints;
        sink.put_pairs(model);
        for (o, &first) in model.orientations.iter().enumerate() {
            if first < sink.nd {
                let own = sink.tangents.balls[o];
                sink.put_ball(first, &own);
            }
        }
        for pair in &model.mixed_pairs {
            let second = mid.mechanics.pair(model, pair.ancestor, pair.descendant);
            let coordinate = |joint: usize| joints[joint].coordinate;
            let entries = second.entries(coordinate(pair.ancestor), coordinate(pair.descendant));
            let nd = sink.nd;
            for (i, j, entry) in entries.into_iter().filter(|entry| entry.0 < nd) {
                let (torque, momentum) = ([entry.qq, entry.qv], [entry.vq, entry.vv]);
                sink.add(i, j, Entry { torque, momentum, ..Entry::default() });
            }
        }
        if model.potentials.any {
            model.for_each_spring_derivative(&mid.mechanics.poses, &mid.q, |i, j, value| {
                if i < sink.nd {
                    sink.add(i, j, Entry { torque: [-value, 0.0], ..Entry::default() });
                }
            });
        }
        for a in model.armature.entries().filter(|a| balls.of(a.row).is_none()) {
            sink.add(a.row, a.column, Entry { momentum: [0.0, a.inertia], ..Entry::default() });
        }
        for (i, c) in model.damping.iter().enumerate().filter(|(i, _)| balls.of(*i).is_none()) {
            sink.add(i, i, Entry { force: [0.0, -c], ..Entry::default() });
        }
        if let Some(forces) = &model.forces {
            forces.for_each_derivative(&mid.instant(model), |i, j, by_q, by_v| {
                if i < sink.nd {
                    sink.add(i, j, Entry { force: [by_q, by_v], ..Entry::default() });
                }
            });
        }
        self.fill_turned_inputs(model, &mut out.ends);
    }

    /// How ball joints turn, and what they have of themselves, at the second derivatives of the last Newton
    /// matrix.
    pub(crate) fn find_turnings(&mut self, at: StepContext<'_>, ends: &mut Ends) {
        let (model, h, nd) = (at.model, at.settings.time_step_s, at.model.dimensions.dynamic);
        let skew = (2.0 * ends.at_start - 1.0) * h;
        let Self { mid, balls, tangents, .. } = self;
        let turns = model.orientations.iter().zip(balls.turns());
        ends.turnings.clear();
        ends.turnings.extend(turns.map(|(&i, turn)| Turning::new(model, i, turn, h)));
        let (turnings, all) = (&ends.turnings[..], &mut tangents.balls[..]);
        wide!({
            for (first, joint) in model.dynamics.joints.iter().enumerate() {
                let i = joint.coordinate;
                if joint.kind != JointKind::Ball(0) || i >= nd {
                    continue;
                }
                let turning = &turnings[joint.orientation];
                let mut turned = rotation::crossed(-three(&mid.l_v, i));
                if skew != 0.0 {
                    let forces = turning.turn.changes().of_torque(three(&mid.force, i));
                    turned = turned.plus(&forces.scaled(skew));
                }
                let within = mid.mechanics.curvature.within_ball(first);
                let own = &mut all[joint.orientation];
                *own = OfBall::new(turning, &within, &turned, h);
                for (axis, c) in model.damping.iter().skip(i).take(3).enumerate() {
                    own.add(turning, axis, [*c, 0.0], [h, skew]);
                }
            }
        });
        for &(i, inertia) in &model.armature.own {
            if let Some((o, axis)) = balls.of(i) {
                tangents.balls[o].add(&ends.turnings[o], axis, [0.0, inertia], [h, skew]);
            }
        }
    }

    /// What unit inputs give, in the places of [`Model::input_pattern`].
    pub(crate) fn fill_turned_inputs(&mut self, model: &Model, ends: &mut Ends) {
        let (h, nd) = (ends.time_step_s, model.dimensions.dynamic);
        let (split, skew) = (h * ends.at_start, (2.0 * ends.at_start - 1.0) * h);
        let Ends { inputs, turnings, .. } = ends;
        let mut places = inputs.iter_mut();
        let mut put = |i: usize, by_u: f64| {
            let mut set = |residual: f64, momentum: f64| {
                if let Some(place) = places.next() {
                    (place.residual, place.momentum) = (residual, momentum);
                }
            };
            match self.balls.of(i) {
                None => set(split * by_u, h * by_u),
                Some((o, axis)) => {
                    let torque = turnings[o].torque.0[axis];
                    for (a, torque) in torque.0.into_iter().enumerate() {
                        let own = if a == axis { 1.0 } else { 0.0 };
                        let change = h * own + skew * (torque - own);
                        set(split * torque * by_u, change * by_u);
                    }
                }
            }
        };
        model.coordinate_inputs.iter().for_each(|input| put(input.coordinate, input.gain));
        if let Some(forces) = &model.forces {
            forces.for_each_input_derivative(&self.mid.instant(model), |i, _, by_u| {
                if i < nd {
                    put(i, by_u);
                }
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::integrator::blocks::StepBlocks;
    use crate::integrator::settings::{ForceSplit, Settings};
    use crate::lagrangian::samples::assert_close;
    use crate::plant::facade::Plant;
    use plantd_scene::Scene;

    /// A body that floats beside a base that is turned, with all that acts on ball joints.
    const SCENE: &str = r#"
format = 1
name = "platform"
time_step_s = 0.005
gravity = [0.5, 0.0, -9.81]
damping = 0.02

[[frames]]
name = "platform"
translation = [0.1, 0.0, 0.0]
joint = { type = "ball" }
[[frames]]
name = "mast"
parent = "platform"
translation = [0.0, 0.2, 0.1]
joint = { type = "revolute", axis = [1.0, 0.2, 0.0] }
body = { mass = 0.8, center_of_mass = [0.0, 0.1, 0.3], inertia = [0.02, 0.02, 0.01] }
[[frames]]
name = "bob"
parent = "mast"
translation = [0.0, 0.0, 0.5]
joint = { type = "ball" }
body = { mass = 0.5, center_of_mass = [0.1, 0.0, -0.3], inertia = [0.02, 0.03, 0.025, 1e-3, 0.0, 2e-3] }
[[frames]]
name = "free"
joint = { type = "free" }
translation = [0.6, 0.0, 0.0]
body = { mass = 1.0, center_of_mass = [0.05, 0.0, 0.0], inertia = [0.02, 0.03, 0.025] }

[[coordinates]]
name = "platform_rx"
kind = "prescribed"
initial = 0.3
[[coordinates]]
name = "platform_ry"
kind = "prescribed"
initial = -0.2
[[coordinates]]
name = "platform_rz"
kind = "prescribed"
initial = 0.5
[[coordinates]]
name = "bob_rx"
initial = 0.4
armature = 0.01
[[coordinates]]
name = "free_rz"
initial = -0.6

[[springs]]
type = "two_point"
a = { frame = "bob", at = [0.0, 0.0, -0.5] }
b = { frame = "world", at = [1.0, 0.0, 0.0] }
stiffness = 20.0
rest_length = 0.4
[[springs]]
type = "two_point"
a = { frame = "bob", at = [0.1, 0.0, -0.5] }
b = { frame = "free", at = [0.0, 0.2, 0.0] }
stiffness = 10.0
rest_length = 0.2

[[inputs]]
name = "twist"
coordinate = "bob_ry"
gain = 0.7
[[inputs]]
name = "push"
coordinate = "free_x"
[[inputs]]
name = "thrust"
[[forces]]
type = "body_wrench"
frame = "bob"
force = [0.3, 0.0, "thrust"]
torque = [0.0, "thrust", 0.1]
[[forces]]
type = "two_point_damper"
a = { frame = "bob", at = [0.1, 0.0, -0.5] }
b = { frame = "free", at = [0.0, 0.2, 0.0] }
damping = 0.4
[[forces]]
type = "coordinate_drag"
coordinate = "free_ry"
coefficient = 0.03
"#;

    /// What is filled entry by entry and by generators is what all blocks of all coordinates are.
    #[test]
    fn derivatives_are_those_of_dense_blocks() {
        let model = Arc::new(Model::compile(&Scene::from_toml(SCENE).unwrap()).unwrap());
        let d = model.dimensions;
        let (n, nd, ni) = (d.coordinates(), d.dynamic, d.inputs);
        for force_split in [ForceSplit::Symmetric, ForceSplit::Paper] {
            let settings = Settings { force_split, ..Settings::new(&model) };
            let mut plant = Plant::new(Arc::clone(&model), settings).unwrap();
            let mut u = vec![0.0; d.input()];
            for k in 0..30 {
                plant.hold_input(&mut u);
                u.iter_mut().zip(0..).for_each(|(u, i)| *u += 0.02 * f64::from(k + i).sin());
                plant.step(&u).unwrap();
            }
            let mut out = Linearization::new(&model);
            plant.linearize(&u, &mut out).unwrap();
            let (workspace, state) = (&mut plant.workspace, &plant.state);
            let at = StepContext { model: &model, settings: &settings, state, u: &u };
            let mut blocks = StepBlocks::<f64>::new(&model);
            blocks.q_start.copy_from_slice(&state.q);
            blocks.next[..nd].copy_from_slice(&workspace.step.increment);
            blocks.next[nd..].copy_from_slice(&workspace.step.q_end[nd..]);
            for (o, &i) in model.orientations.iter().enumerate() {
                blocks.next[i..i + 3].copy_from_slice(&workspace.balls.turn(o).xi.0);
            }
            blocks.orientations[0].copy_from_slice(&workspace.balls.start);
            blocks.multipliers.copy_from_slice(&workspace.step.multipliers);
            blocks.inputs.copy_from_slice(&u[..ni]);
            blocks.evaluate(&model, &settings);

            workspace.fill_newton_matrix(&model, &settings);
            let (mut found, mut expected) = (Vec::new(), Vec::new());
            for row in 0..nd {
                for (slot, column) in model.elimination.entries_of(row) {
                    let tree = &workspace.kkt.factored.tree;
                    found.push(tree.upper[slot]);
                    expected.push(blocks.residual_next[column * n + row]);
                    if row != column {
                        found.push(tree.lower[slot]);
                        expected.push(blocks.residual_next[row * n + column]);
                    }
                }
            }
            assert_close("newton", &found, &expected);

            workspace.fill_right_hand_sides(at, &mut out);
            let next = out.next_columns();
            let Linearization { increment, momentum, stride, .. } = &out;
            for i in 0..nd {
                let (row, from) = (i * n..(i + 1) * n, i * stride);
                let start = &blocks.residual_start[row.clone()];
                assert_close("residual by start", &increment[from..][..n], start);
                let by_next = &blocks.residual_next[row.clone()][nd..];
                assert_close("residual by next", &increment[from + next..][..n - nd], by_next);
                let end_slopes = &workspace.tangents.end_slopes;
                let by_start = &blocks.momentum_start[row.clone()];
                assert_close("momentum by start", &momentum[from..][..n], by_start);
                let by_next = &blocks.momentum_next[row.clone()];
                assert_close("momentum by next", &end_slopes[i * nd..][..nd], &by_next[..nd]);
                let found = &momentum[from + next..][..n - nd];
                assert_close("momentum by next position", found, &by_next[nd..]);
            }
            let (mut residual, mut change) = (vec![0.0; nd * ni], vec![0.0; nd * ni]);
            for place in &out.ends.inputs {
                let entry = place.coordinate * ni + place.input;
                residual[entry] += place.residual;
                change[entry] += place.momentum;
            }
            assert_close("residual by inputs", &residual, &blocks.residual_inputs);
            assert_close("momentum by inputs", &change, &blocks.momentum_inputs);
        }
    }
}
