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

use crate::integrator::balls::BallJoints;
use crate::integrator::workspace::{StepContext, Tangents, Workspace};
use crate::lagrangian::generators::{Within, dot};
use crate::lagrangian::turning::Turning;
use crate::linearization::linearize::Linearization;
use crate::math::simd::wide;
use crate::math::spatial::{Mat3, Vec3, three};
use crate::model::mechanism::Model;
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
                    self.tangents.stiffness[at.row * nd + column] += change(start);
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
        let (nd, stride, increment) = (self.nd, self.stride, &mut *self.increment);
        let Tangents { flanks, stiffness, end_slopes, .. } = &mut *self.tangents;
        wide!({
            stiffness.fill(0.0);
            end_slopes.fill(0.0);
            for pair in &model.pairs {
                let (i, j) = (pair.row as usize, pair.column as usize);
                let (a, d) = (&flanks[pair.ancestor as usize], &flanks[pair.descendant as usize]);
                increment[i * stride + j] = dot(&a.newton.minus, &d.below);
                increment[j * stride + i] = dot(&a.above, &d.newton.lower);
                stiffness[i * nd + j] = dot(&a.carry, &d.below);
                stiffness[j * nd + i] = dot(&a.above, &d.push);
                end_slopes[i * nd + j] = dot(&a.carry, &d.newton.upper);
                end_slopes[j * nd + i] = dot(&a.newton.plus, &d.push);
            }
        });
    }

    /// The same for the axes of one ball joint. The change of `m × ξ + (2a − 1) h (T⁻ − 1) f` with `ξ` is
    /// `turned`.
    fn put_ball(&mut self, turning: &Turning, within: &Within, turned: &Mat3) {
        let Self { h, nd, stride, .. } = *self;
        let Within { tau_z, tau_v, m_v } = within;
        let (start, middle) = (&turning.by_start.0, &turning.by_next.0);
        let spin = turning.spin();
        let [torque, momentum] = [tau_z.times(start), tau_v.transpose().times(start)];
        let residual = turning.torque.times(&torque.scaled(0.5 * h));
        let residual = residual.minus(&turning.momentum.times(&momentum));
        let stiffness = torque.scaled(h).plus(&spin.times(&momentum));
        let torque = tau_z.times(middle).plus(&tau_v.scaled(1.0 / h));
        let momentum = tau_v.transpose().times(middle).plus(&m_v.scaled(1.0 / h));
        let slopes = torque.scaled(h).plus(&spin.times(&momentum)).plus(turned);
        let first = turning.coordinate;
        for (row, column) in (0..9).map(|entry| (entry / 3, entry % 3)) {
            let (i, j) = (first + row, first + column);
            self.increment[i * stride + j] = residual.0[column][row];
            self.tangents.stiffness[i * nd + j] = stiffness.0[column][row];
            self.tangents.end_slopes[i * nd + j] = slopes.0[column][row];
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
        let Self { mid, kkt, balls, tangents, .. } = self;
        let balls = &*balls;
        let turns = model.orientations.iter().zip(&balls.turns);
        out.turnings.extend(turns.map(|(&i, turn)| Turning::new(model, i, *turn, h)));
        tangents.find_flanks(model, &mid.mechanics, (&out.turnings, &kkt.balls), &balls.vertical, h);
        let split = h * out.at_start;
        let mut sink = Sink {
            balls,
            turnings: &out.turnings,
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
        for (first, joint) in joints.iter().enumerate() {
            if joint.kind == JointKind::Ball(0) && joint.coordinate < sink.nd {
                let i = joint.coordinate;
                let turning = &sink.turnings[joint.orientation];
                let forces = turning.by_turn(Vec3::ZERO, Vec3::ZERO, three(&mid.force, i))[1];
                let momentum = three(&mid.l_v, i);
                let turned = Mat3(Mat3::IDENTITY.0.map(|axis| momentum.cross(axis)));
                let turned = turned.plus(&forces.scaled(sink.skew));
                let within = Within::new(&mid.mechanics, model.gravity, first);
                sink.put_ball(turning, &within, &turned);
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
        for &(i, mass) in &model.armature {
            sink.add(i, i, Entry { momentum: [0.0, mass], ..Entry::default() });
        }
        for (i, c) in model.damping.iter().enumerate() {
            sink.add(i, i, Entry { force: [0.0, -c], ..Entry::default() });
        }
        if let Some(forces) = &model.forces {
            forces.for_each_derivative(&mid.instant(model), |i, j, by_q, by_v| {
                if i < sink.nd {
                    sink.add(i, j, Entry { force: [by_q, by_v], ..Entry::default() });
                }
            });
        }
        self.fill_turned_inputs(model, out);
    }

    /// What unit inputs give, in the places of [`Model::input_pattern`].
    fn fill_turned_inputs(&mut self, model: &Model, out: &mut Linearization) {
        let (h, nd) = (out.time_step_s, out.nd);
        let (split, skew) = (h * out.at_start, (2.0 * out.at_start - 1.0) * h);
        let Linearization { inputs, turnings, .. } = out;
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
