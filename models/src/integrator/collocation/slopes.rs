//! Derivatives of a step of collocation with ball joints, as dense matrices, for any scalar.
//!
//! See [`balls`](super::balls) for the equations. What is known of a stage are the derivatives of torque,
//! momentum and force by a turn `ζ` of the body in its own axes and by its angular velocity `ω`. By `η`, by its
//! rate `V`, and by a turn `c` of the centre,
//!
//! ```text
//! ζ' = D η' + exp(−η) c'        ω' = D V' + W η'        W = ∂(D V)/∂η
//! F  = Dᵀ(τ + f) + Wᵀ m         m̃  = Dᵀ m               T = exp(η) (τ + f)
//! ```
//!
//! where `D`, `W` and `exp(η)` of the joint itself change too. Of other coordinates `D = exp(η) = 1`, `W = 0`,
//! and the centre is the middle of the step. Nodes where constraints hold are places like the stages, where impulses
//! act and nothing moves; with them come derivatives by these impulses, and of the equations.
//!
//! Second derivatives of the step are the dual parts of all that.

use plantd_math::rotation::{Chart, Turn};
use plantd_math::scalar::Scalar;
use plantd_math::spatial::{Mat3, Vec3, three};

use crate::integrator::parameters::Parameters;
use crate::integrator::scheme::Tableau;
use crate::model::mechanism::Model;

/// The stages, and what they make of the step.
///
/// Tables of places have `nd` rows for each; all are row-major. Unknowns and residuals are those of the stages
/// of a coordinate side by side.
#[derive(Clone, Debug)]
pub(crate) struct Slopes<S = f64> {
    count: usize,
    /// Where something acts: the stages, and the nodes of constraints but the last.
    places: usize,
    /// Of these and of the last node, by which part of each `Y` it is from the centre: `σ_ik`, and `κ_jk − ½`.
    skew: Vec<f64>,
    pub(crate) closing: Option<Box<Closing<S>>>,
    pub(crate) theta: Parameters,
    /// First coordinates of the ball joints.
    balls: Vec<usize>,
    pub(crate) tableau: Tableau,
    pub(crate) time_step_s: f64,
    /// At the places: `L_qq + f_q`, `L_qv + f_v`, `L_vq`, `L_vv`, n columns; then by `η` and `V`.
    pub(crate) second: [Vec<S>; 4],
    /// `f_u`, ni columns; then of `F`.
    pub(crate) by_input: Vec<S>,
    /// At the places: `η`, of the last node too, and `V` of ball joints, `L_q + f` and `L_v`.
    pub(crate) offset: Vec<S>,
    pub(crate) rate: Vec<S>,
    pub(crate) torque: Vec<S>,
    pub(crate) momentum: Vec<S>,
    /// Of the step: its increments and the momentum at its start.
    pub(crate) increment: Vec<S>,
    pub(crate) start: Vec<S>,
    /// `F` and `m̃` by the centre; `T` by `η`, `V`, the centre; `T` by the inputs.
    by_center: [Vec<S>; 2],
    torques: [Vec<S>; 3],
    torque_by_input: Vec<S>,
    /// `ΣT` and the momentum at the centre.
    total: Vec<S>,
    center: Vec<S>,
    /// Derivatives of the residuals, of `ΣT`, of the momentum at the centre and of the next one, by `Y` and by the
    /// parameters `(q, p, u, k)`.
    pub(crate) residual: [Vec<S>; 2],
    total_by: [Vec<S>; 2],
    center_by: [Vec<S>; 2],
    pub(crate) next_by: [Vec<S>; 2],
}

/// Derivatives by the impulses of constraints at the nodes but the last, node after node, and of the equations at the
/// nodes but the first.
#[derive(Clone, Debug)]
pub(crate) struct Closing<S = f64> {
    /// `Dh` at all nodes, n columns.
    pub(crate) jacobians: Vec<S>,
    /// Of the residuals, and of the next momentum, by the impulses.
    pub(crate) residual: Vec<S>,
    pub(crate) next: Vec<S>,
    /// Of the equations, by `Y` and by the parameters.
    pub(crate) equations: [Vec<S>; 2],
}

fn put<S: Scalar>(row: &mut [S], at: usize, v: Vec3<S>) {
    row[at..at + 3].copy_from_slice(&v.0);
}

/// Of three rows, what stands in a column.
fn column<S: Scalar>(rows: &[S], first: usize, stride: usize, column: usize) -> Vec3<S> {
    Vec3([0, 1, 2].map(|a| rows[(first + a) * stride + column]))
}

fn put_column<S: Scalar>(rows: &mut [S], first: usize, stride: usize, column: usize, v: Vec3<S>) {
    for (a, entry) in v.0.into_iter().enumerate() {
        rows[(first + a) * stride + column] = entry;
    }
}

impl<S: Scalar> Slopes<S> {
    pub(crate) fn new(model: &Model, tableau: &Tableau) -> Self {
        let theta = Parameters::new(model);
        let (nd, n, ni, count) = (theta.nd, theta.n(), theta.ni, tableau.nodes.len());
        let zeros = |len: usize| vec![S::ZERO; len];
        let nodes = if theta.nc > 0 { count } else { 0 };
        let places = count + nodes;
        let mut skew = tableau.skew.clone();
        if nodes > 0 {
            skew.extend_from_slice(&tableau.reach_from_middle);
        }
        let impulses = nodes * theta.nc;
        let table = |columns: usize| zeros(places * nd * columns);
        let by = |rows: usize| [zeros(rows * nd * count), zeros(rows * theta.stride)];
        Self {
            count,
            places,
            closing: (nodes > 0).then(|| {
                Box::new(Closing {
                    jacobians: zeros((nodes + 1) * theta.nc * n),
                    residual: zeros(count * nd * impulses),
                    next: zeros(nd * impulses),
                    equations: [zeros(impulses * count * nd), zeros(impulses * theta.stride)],
                })
            }),
            offset: zeros(skew.len() / count * nd),
            skew,
            theta,
            balls: model.orientations.iter().copied().filter(|i| *i < nd).collect(),
            tableau: tableau.clone(),
            time_step_s: 0.0,
            second: [table(n), table(n), table(n), table(n)],
            by_input: table(ni),
            rate: table(1),
            torque: table(1),
            momentum: table(1),
            increment: zeros(nd),
            start: zeros(nd),
            by_center: [table(n), table(n)],
            torques: [table(n), table(n), table(n)],
            torque_by_input: table(ni),
            total: zeros(nd),
            center: zeros(nd),
            residual: by(count * nd),
            total_by: by(nd),
            center_by: by(nd),
            next_by: by(nd),
        }
    }

    /// Finds all derivatives.
    pub(crate) fn find(&mut self) {
        self.total.fill(S::ZERO);
        let lengths = self.lengths();
        for (place, [length, _]) in lengths.iter().enumerate() {
            self.turn_place(place, *length);
        }
        self.find_center(&lengths);
        self.find_residuals(&lengths);
        self.find_next();
        self.close();
    }

    /// How long it acts at each place, if that is what acts there, and how far each is in the step.
    fn lengths(&self) -> Vec<[f64; 2]> {
        let Tableau { nodes, weights, ends, .. } = &self.tableau;
        let stages = weights.iter().zip(nodes).map(|(b, c)| [self.time_step_s * b, *c]);
        stages.chain(ends.iter().map(|c| [1.0, *c])).take(self.places).collect()
    }

    /// Derivatives at a place, where something acts for so long, by `η`, `V` and the centre.
    fn turn_place(&mut self, place: usize, length: f64) {
        let (nd, n, ni) = (self.theta.nd, self.theta.n(), self.theta.ni);
        let own = place * nd..(place + 1) * nd;
        let of = |columns: usize| own.start * columns..own.end * columns;
        let [qq, qv, vq, vv] = self.second.each_mut().map(|table| &mut table[of(n)]);
        let [fc, mc] = self.by_center.each_mut().map(|table| &mut table[of(n)]);
        let [tq, tv, tc] = self.torques.each_mut().map(|table| &mut table[of(n)]);
        let (fu, tu) = (&mut self.by_input[of(ni)], &mut self.torque_by_input[of(ni)]);
        let [offset, rate] = [&self.offset[own.clone()], &self.rate[own.clone()]];
        let [torque, momentum] = [&self.torque[own.clone()], &self.momentum[own]];
        fc.copy_from_slice(qq);
        mc.copy_from_slice(vq);
        for &c in &self.balls {
            let chart = Chart::new(three(offset, c));
            let (d, w, turn) = (chart.dexp(), chart.slope(three(rate, c)), chart.exp());
            for at in (0..nd).map(|a| a * n + c) {
                for (q, v, center) in
                    [(&mut *qq, &mut *qv, &mut *fc), (&mut *vq, &mut *vv, &mut *mc)]
                {
                    let (by_turn, by_spin) = (three(q, at), three(v, at));
                    put(center, at, turn.apply(by_turn));
                    put(q, at, d.apply_transposed(by_turn) + w.apply_transposed(by_spin));
                    put(v, at, d.apply_transposed(by_spin));
                }
            }
        }
        tq.copy_from_slice(qq);
        tv.copy_from_slice(qv);
        tc.copy_from_slice(fc);
        tu.copy_from_slice(fu);
        for (total, torque) in self.total.iter_mut().zip(torque) {
            *total += *torque * length;
        }
        for &c in &self.balls {
            let chart = Chart::new(three(offset, c));
            let v = three(rate, c);
            let (d, w, turn) = (chart.dexp(), chart.slope(v), chart.exp());
            for b in 0..n {
                for (f, m, t) in [
                    (&mut *qq, &mut *vq, &mut *tq),
                    (&mut *qv, &mut *vv, &mut *tv),
                    (&mut *fc, &mut *mc, &mut *tc),
                ] {
                    let (by_torque, by_momentum) = (column(f, c, n, b), column(m, c, n, b));
                    put_column(t, c, n, b, turn.apply(by_torque));
                    let pushed = d.apply_transposed(by_torque) + w.apply_transposed(by_momentum);
                    put_column(f, c, n, b, pushed);
                    put_column(m, c, n, b, d.apply_transposed(by_momentum));
                }
            }
            for u in 0..ni {
                let force = column(fu, c, ni, u);
                put_column(tu, c, ni, u, turn.apply(force));
                put_column(fu, c, ni, u, d.apply_transposed(force));
            }
            // What the maps of the joint itself change.
            let (x, m) = (three(torque, c), three(momentum, c));
            let of_momentum = chart.transposed_slope(m);
            let of_force = chart.transposed_slope(x).plus(&chart.curvature(m, v));
            for (b, r) in (0..9).map(|entry| (entry / 3, entry % 3)) {
                let at = (c + r) * n + c + b;
                qq[at] += of_force.0[b][r];
                qv[at] += of_momentum.0[r][b];
                vq[at] += of_momentum.0[b][r];
                tq[at] += turn.apply(d.0[b].cross(x))[r];
            }
            let all = three(&self.total, c) + (turn.apply(x) - x) * S::constant(length);
            put(&mut self.total, c, all);
        }
    }

    /// Derivatives of `ΣT` and of the momentum at the centre.
    fn find_center(&mut self, lengths: &[[f64; 2]]) {
        let (nd, n, ni, stride) = (self.theta.nd, self.theta.n(), self.theta.ni, self.theta.stride);
        let (inputs, next, count) = (self.theta.inputs(), self.theta.next(), self.count);
        let (h, skew) = (self.time_step_s, &self.skew);
        // How the centre turns with the increment, and with the start.
        let turns: Vec<(usize, Turn<S>)> =
            self.balls.iter().map(|&c| (c, Turn::new(three(&self.increment, c)))).collect();
        let [total_y, total_theta] = &mut self.total_by;
        total_y.fill(S::ZERO);
        total_theta.fill(S::ZERO);
        for (place, &[length, node]) in lengths.iter().enumerate() {
            for a in 0..nd {
                let at = (place * nd + a) * n;
                let by_y = &mut total_y[a * nd * count..][..nd * count];
                let by_theta = &mut total_theta[a * stride..][..stride];
                let [tq, tv, tc] = self.torques.each_ref().map(|table| &table[at..][..n]);
                for b in 0..n {
                    let by_offset = tq[b] * length;
                    if b < nd {
                        by_theta[b] += tc[b] * length;
                        let by_y = &mut by_y[b * count..][..count];
                        for (k, entry) in by_y.iter_mut().enumerate() {
                            *entry += by_offset * skew[place * count + k];
                        }
                        if place < count {
                            by_y[place] += tv[b];
                        }
                    } else {
                        let by_rate = tv[b] * (length / h);
                        by_theta[b] += by_offset * (1.0 - node) - by_rate;
                        by_theta[next + b - nd] += by_offset * node + by_rate;
                    }
                }
                for u in 0..ni {
                    by_theta[inputs + u] +=
                        self.torque_by_input[(place * nd + a) * ni + u] * length;
                }
            }
        }
        // So far the columns of the start are by the centre.
        let mut by_increment = vec![S::ZERO; nd];
        for a in 0..nd {
            let by_theta = &mut total_theta[a * stride..][..stride];
            by_increment.iter_mut().zip(&*by_theta).for_each(|(to, from)| *to = *from * 0.5);
            for (c, turn) in &turns {
                let by_turn = three(by_theta, *c);
                let half = by_turn * S::constant(0.5);
                put(&mut by_increment, *c, turn.dexp_of_half().apply_transposed(half));
                put(by_theta, *c, turn.half().apply(by_turn));
            }
            for (b, moved) in by_increment.iter().enumerate() {
                let by_y = &mut total_y[(a * nd + b) * count..][..count];
                by_y.iter_mut().for_each(|entry| *entry += *moved);
            }
        }
        let [center_y, center_theta] = &mut self.center_by;
        for ((center, total), columns) in
            [(&mut *center_y, &*total_y), (&mut *center_theta, &*total_theta)]
                .into_iter()
                .zip([nd * count, stride])
        {
            center.iter_mut().zip(total).for_each(|(to, from)| *to = *from * 0.5);
            for (c, turn) in &turns {
                let map = Chart::new(turn.xi).dexp().times(&turn.torque_at_start());
                for b in 0..columns {
                    let half = column(center, *c, columns, b);
                    put_column(center, *c, columns, b, map.apply(half));
                }
            }
        }
        for a in 0..nd {
            self.center[a] = self.start[a] + self.total[a] * 0.5;
            center_theta[a * stride + n + a] += S::ONE;
        }
        for (c, turn) in &turns {
            let (chart, all) = (Chart::new(turn.xi), three(&self.total, *c));
            let d = chart.dexp();
            let at_start = three(&self.start, *c) + turn.torque_to_start(all).scaled(0.5);
            put(&mut self.center, *c, d.apply(at_start));
            let half = turn.changes().of_torque(all).scaled(S::constant(0.5));
            let own = chart.slope(at_start).plus(&d.times(&half));
            for (b, r) in (0..9).map(|entry| (entry / 3, entry % 3)) {
                center_theta[(c + r) * stride + n + c + b] = d.0[b][r];
                let by_y = &mut center_y[((c + r) * nd + c + b) * count..][..count];
                by_y.iter_mut().for_each(|entry| *entry += own.0[b][r]);
            }
        }
        // From now on the centre counts as what is unknown and what is given.
        for table in &mut self.by_center {
            for row in table.chunks_exact_mut(n) {
                for (c, turn) in &turns {
                    let by_turn = three(row, *c);
                    put(row, *c, turn.half().apply(by_turn));
                }
            }
        }
    }

    /// Derivatives of `R_j = Λ + Σ σ_ji h_i F_i − m̃_j`.
    fn find_residuals(&mut self, lengths: &[[f64; 2]]) {
        let (nd, n, ni, stride) = (self.theta.nd, self.theta.n(), self.theta.ni, self.theta.stride);
        let (inputs, next, count) = (self.theta.inputs(), self.theta.next(), self.count);
        let (skew, places) = (&self.skew, self.places);
        let h = self.time_step_s;
        let [residual_y, residual_theta] = &mut self.residual;
        let [center_y, center_theta] = &self.center_by;
        let columns = nd * count;
        // By the start the centre turns by half(ξ)ᵀ, by the increment by ½ dexp(ξ/2): the map between them.
        let maps: Vec<(usize, Mat3<S>)> = (self.balls.iter())
            .map(|&c| {
                let turn = Turn::new(three(&self.increment, c));
                (c, turn.half().times(&turn.dexp_of_half()).scaled(S::constant(0.5)))
            })
            .collect();
        let half = |row: &[S], out: &mut [S]| {
            out.iter_mut().zip(row).for_each(|(to, from)| *to = *from * 0.5);
            for (c, map) in &maps {
                put(out, *c, map.apply_transposed(three(row, *c)));
            }
        };
        let mut moved = vec![S::ZERO; places * nd];
        let mut carried = vec![S::ZERO; nd];
        for a in 0..nd {
            for j in 0..count {
                let row = a * count + j;
                residual_y[row * columns..][..columns]
                    .copy_from_slice(&center_y[a * columns..][..columns]);
                residual_theta[row * stride..][..stride]
                    .copy_from_slice(&center_theta[a * stride..][..stride]);
            }
            for i in 0..places {
                let at = (i * nd + a) * n;
                half(&self.by_center[0][at..][..nd], &mut moved[i * nd..][..nd]);
            }
            for j in 0..count {
                let row = a * count + j;
                let by_y = &mut residual_y[row * columns..][..columns];
                let by_theta = &mut residual_theta[row * stride..][..stride];
                let own = (j * nd + a) * n;
                half(&self.by_center[1][own..][..nd], &mut carried);
                for (i, [length, node]) in lengths.iter().enumerate() {
                    let at = (i * nd + a) * n;
                    let part = -skew[i * count + j];
                    let weight = part * length;
                    let [qq, qv, ..] = self.second.each_ref().map(|table| &table[at..][..n]);
                    for b in 0..n {
                        let by_offset = qq[b] * weight;
                        if b < nd {
                            by_theta[b] += self.by_center[0][at + b] * weight;
                            let through = moved[i * nd + b] * weight;
                            let entries = &mut by_y[b * count..][..count];
                            for (k, entry) in entries.iter_mut().enumerate() {
                                *entry += by_offset * skew[i * count + k] + through;
                            }
                            if i < count {
                                entries[i] += qv[b] * part;
                            }
                        } else {
                            let by_rate = qv[b] * (weight / h);
                            by_theta[b] += by_offset * (1.0 - node) - by_rate;
                            by_theta[next + b - nd] += by_offset * *node + by_rate;
                        }
                    }
                    for u in 0..ni {
                        by_theta[inputs + u] += self.by_input[(i * nd + a) * ni + u] * weight;
                    }
                }
                let [.., vq, vv] = self.second.each_ref().map(|table| &table[own..][..n]);
                let [length, node] = lengths[j];
                for b in 0..n {
                    if b < nd {
                        by_theta[b] -= self.by_center[1][own + b];
                        let entries = &mut by_y[b * count..][..count];
                        for (k, entry) in entries.iter_mut().enumerate() {
                            *entry -= vq[b] * skew[j * count + k] + carried[b];
                        }
                        entries[j] -= vv[b] * (1.0 / length);
                    } else {
                        let by_rate = vv[b] * (1.0 / h);
                        by_theta[b] -= vq[b] * (1.0 - node) - by_rate;
                        by_theta[next + b - nd] -= vq[b] * node + by_rate;
                    }
                }
            }
        }
    }

    /// Derivatives of `p[k+1] = p + ΣT + Λ × ξ`.
    fn find_next(&mut self) {
        let (nd, n, stride) = (self.theta.nd, self.theta.n(), self.theta.stride);
        let count = self.count;
        for (next, total) in self.next_by.iter_mut().zip(&self.total_by) {
            next.copy_from_slice(total);
        }
        for a in 0..nd {
            self.next_by[1][a * stride + n + a] += S::ONE;
        }
        for &c in &self.balls {
            let (xi, center) = (three(&self.increment, c), three(&self.center, c));
            for ((next, by), columns) in
                self.next_by.iter_mut().zip(&self.center_by).zip([nd * count, stride])
            {
                for b in 0..columns {
                    let carried = column(by, c, columns, b).cross(xi);
                    let sum = column(next, c, columns, b) + carried;
                    put_column(next, c, columns, b, sum);
                }
            }
            for b in 0..3 {
                let mut axis = Vec3::ZERO;
                axis.0[b] = S::ONE;
                let turned = center.cross(axis);
                for k in 0..count {
                    let at = (c + b) * count + k;
                    let sum = column(&self.next_by[0], c, nd * count, at) + turned;
                    put_column(&mut self.next_by[0], c, nd * count, at, sum);
                }
            }
        }
    }

    /// Derivatives by the impulses of constraints, and of the equations.
    fn close(&mut self) {
        let Self { closing: Some(closing), theta, count, skew, balls, tableau, .. } = self else {
            return;
        };
        let (nd, n, nc, stride, count) = (theta.nd, theta.n(), theta.nc, theta.stride, *count);
        let (columns, unknowns) = (nc * count, nd * count);
        let Closing { jacobians, residual, next, equations: [by_y, by_theta] } = &mut **closing;
        let turns: Vec<(usize, Turn<S>, Mat3<S>)> = (balls.iter())
            .map(|&c| {
                let turn = Turn::new(three(&self.increment, c));
                let to_center = Chart::new(turn.xi).dexp().times(&turn.torque_at_start());
                (c, turn, to_center)
            })
            .collect();
        by_theta.fill(S::ZERO);
        let mut center = vec![S::ZERO; nd];
        for (at, gradient) in jacobians.chunks_exact(n).enumerate() {
            let j = at / nc;
            let part = &skew[(count + j) * count..][..count];
            let offset = &self.offset[(count + j) * nd..][..nd];
            let chart = |c: usize| Chart::new(three(offset, c));
            if j < count {
                let mut push = |a: usize, [total, center, own]: [S; 3]| {
                    next[a * columns + at] = total;
                    for (k, part) in part.iter().enumerate() {
                        residual[(a * count + k) * columns + at] = center - own * *part;
                    }
                };
                for (a, entry) in gradient[..nd].iter().enumerate() {
                    push(a, [-*entry, *entry * -0.5, -*entry]);
                }
                for (c, turn, to_center) in &turns {
                    let (chart, force) = (chart(*c), -three(gradient, *c));
                    let (total, own) =
                        (chart.exp().apply(force), chart.dexp().apply_transposed(force));
                    let center = to_center.apply(total.scaled(0.5));
                    let total = total + center.cross(turn.xi);
                    (0..3).for_each(|a| push(c + a, [total[a], center[a], own[a]]));
                }
            }
            let Some(row) = at.checked_sub(nc) else { continue };
            let by_y = &mut by_y[row * unknowns..][..unknowns];
            let by_theta = &mut by_theta[row * stride..][..stride];
            by_theta[..nd].copy_from_slice(&gradient[..nd]);
            center.iter_mut().zip(gradient).for_each(|(to, from)| *to = *from * 0.5);
            for (c, turn, _) in &turns {
                let by_center = chart(*c).exp().apply(three(gradient, *c));
                put(by_theta, *c, turn.half().apply(by_center));
                let half = turn.dexp_of_half().apply_transposed(by_center.scaled(0.5));
                put(&mut center, *c, half);
            }
            for (b, entries) in by_y.chunks_exact_mut(count).enumerate() {
                let parts = entries.iter_mut().zip(part);
                parts.for_each(|(entry, part)| *entry = gradient[b] * *part + center[b]);
            }
            for (c, ..) in &turns {
                let own = chart(*c).dexp().apply_transposed(three(gradient, *c));
                for (b, own) in own.0.into_iter().enumerate() {
                    let entries = by_y[(c + b) * count..][..count].iter_mut().zip(part);
                    entries.for_each(|(entry, part)| *entry = own * *part + center[c + b]);
                }
            }
            let fraction = tableau.ends[j];
            for (b, entry) in gradient.iter().enumerate().skip(nd) {
                by_theta[b] = *entry * (1.0 - fraction);
                by_theta[theta.next() + b - nd] = *entry * fraction;
            }
        }
    }
}
