//! Ball joints in collocation: curves of orientations as the exponentials of polynomials.
//!
//! Over a step a ball joint turns by `ξ = Σ Y_j`. About the orientation half-way, `C = R exp(ξ/2)`, its stages are
//! at
//!
//! ```text
//! R_i = C exp(η_i)     η_i = Σ_j σ_ij Y_j     ω_i = D(η_i) V_i     V_i = Y_i / (h b_i)     σ_ij = μ_ij − ½
//! ```
//!
//! with `D(η) = dexp₋η`. So `Ld = Σ h b_i L(R_i, ω_i)` is a function of the ends of the step, and its equations are,
//! with momentum `m` and torque `τ + f` of the stages in the joint's own axes, and `W = ∂(D V)/∂η`,
//!
//! ```text
//! P_i = h b_i (Dᵀ(τ + f) + Wᵀ m)_i      T = Σ h b_i (exp(η) (τ + f))_i
//! p   = N⁻ Λ − ½ T⁻ T                   0 = Λ + Σ_i σ_ji P_i − (Dᵀ m)_j
//! p[k+1] = N⁺ Λ + ½ T⁺ T = p + T + Λ × ξ
//! ```
//!
//! Constraints hold at nodes of their own ([`closures`](super::closures)), where orientations are found as at the
//! stages, from `η̃_j = Σ_k (κ_jk − ½) Y_k`: `R̃_0 = R[k]` and `R̃_s = R[k+1]`. Their impulses `F̃_j = −Dhᵀ Λ_j`, in the
//! joint's axes there, count as those of stages: `Dᵀ F̃` in place of `P`, `exp(η̃) F̃` in `T`.
//!
//! The maps are those of [`plantd_math::rotation`]. For one stage, `Λ = m`, that is the midpoint rule of
//! [`balls`](crate::integrator::balls). Other coordinates have `D = exp(η) = N = T⁻ = 1` and `W = 0`: then it is
//! ordinary collocation.
//!
//! The middle belongs to both ends alike, and `σ` is skew: what is symmetric in time stays so. The equations come
//! from a function of the ends: the step is symplectic. That function does not change when all orientations are
//! turned in space: the momentum of such turns is kept, whatever the length of the step. It differs from that of
//! the motion itself by `O(h^(2s+1))`, since in the chart `η` about any fixed orientation it is that of ordinary
//! collocation: the order is `2s`.

use std::array;

use plantd_math::rotation::{Chart, Turn};
use plantd_math::rows::Block;
use plantd_math::scalar::{LanesOf, Scalar, Side, in_registers};
use plantd_math::sided::Sided;
use plantd_math::spatial::{Mat3, Vec3, three};

use crate::integrator::ball_maps::{CarryOn, ToMatrices, ToMidpoint, beside};
use crate::integrator::scheme::Tableau;
use crate::integrator::state::PreciseState;
use crate::integrator::workspace::Workspace;
use crate::model::mechanism::Model;

/// Rounds in which rates of `η` are found from angular velocities.
const ROUNDS: usize = 3;

/// The ball joints of all stages, `N` of them side by side.
#[derive(Clone, Debug)]
pub(crate) struct Balls<const N: usize> {
    /// First coordinates.
    pub(crate) coordinates: Vec<usize>,
    count: usize,
    width: usize,
    /// `σ_ij`, column after column, padded.
    skew: Vec<LanesOf<N>>,
    /// Orientations at the start and half-way, and how they turn; side by side, of the `places` in `turn`.
    start: Vec<Mat3>,
    start_beside: Sided<Mat3<Block>>,
    centers: Vec<Mat3>,
    turns: Sided<Turn<Block>>,
    places: Vec<usize>,
    /// `ξ`.
    turn: Vec<f64>,
    /// `T`, and `Λ`.
    total: Vec<f64>,
    carried: Vec<f64>,
    /// Of each `N` stages, joint after joint: orientations, charts, `V`.
    orientations: Vec<Mat3<LanesOf<N>>>,
    charts: Vec<Chart<LanesOf<N>>>,
    rates: Vec<Vec3<LanesOf<N>>>,
    /// `h b_i exp(η) (τ + f)`, as numbers of coordinates are.
    torque: Vec<f64>,
    /// With constraints.
    nodes: Option<Box<Nodes<N>>>,
}

/// The ball joints where constraints hold.
#[derive(Clone, Debug)]
struct Nodes<const N: usize> {
    /// `κ_jk − ½` of the start, and of each `N` nodes after it side by side, stage after stage.
    start_skew: Vec<f64>,
    skew: Vec<LanesOf<N>>,
    /// Of the start, and of each `N` nodes, joint after joint.
    start_charts: Vec<Chart>,
    charts: Vec<Chart<LanesOf<N>>>,
    orientations: Vec<Mat3<LanesOf<N>>>,
    /// `Σ exp(η̃) F̃`.
    torque: Vec<Vec3>,
}

/// The numbers of the three coordinates of a joint, of `N` stages.
#[inline(always)]
fn load<const N: usize>(
    numbers: &[f64],
    coordinate: usize,
    width: usize,
    first: usize,
) -> Vec3<LanesOf<N>> {
    let mut all = [LanesOf::ZERO; 3];
    for (a, own) in all.iter_mut().enumerate() {
        *own = LanesOf::load(&numbers[(coordinate + a) * width + first..]);
    }
    Vec3(all)
}

#[inline(always)]
fn store<const N: usize>(
    numbers: &mut [f64],
    coordinate: usize,
    width: usize,
    first: usize,
    values: Vec3<LanesOf<N>>,
) {
    for a in 0..3 {
        values[a].store(&mut numbers[(coordinate + a) * width + first..]);
    }
}

#[inline(always)]
fn lane<const N: usize>(v: Vec3<LanesOf<N>>, lane: usize) -> Vec3 {
    Vec3(v.0.map(|c| c.0[lane]))
}

impl<const N: usize> Balls<N> {
    pub(super) fn new(model: &Model, tableau: &Tableau) -> Self {
        let count = tableau.nodes.len();
        let width = count.next_multiple_of(N);
        let coordinates = model.orientations.clone();
        let no = coordinates.len();
        let stages = no * width / N;
        let entry = |i: usize, j: usize| {
            if i < count { tableau.skew[i * count + j] } else { 0.0 }
        };
        let from_middle = |j: usize, k: usize| match j < count {
            true => tableau.reach_from_middle[(j + 1) * count + k],
            false => 0.0,
        };
        let columns = (0..count).flat_map(|j| (0..width).step_by(N).map(move |i| (i, j)));
        Self {
            count,
            width,
            skew: columns
                .map(|(i, j)| LanesOf(array::from_fn(|lane| entry(i + lane, j))))
                .collect(),
            start: vec![Mat3::IDENTITY; no],
            start_beside: Sided(vec![Mat3([Vec3::default(); 3]); no.div_ceil(f64::BESIDE)]),
            centers: vec![Mat3::IDENTITY; no],
            turns: Sided::zeros::<f64>(no),
            places: (0..no).map(|o| 3 * o).collect(),
            turn: vec![0.0; 3 * no],
            total: vec![0.0; 3 * no],
            carried: vec![0.0; 3 * no],
            orientations: vec![Mat3::IDENTITY; stages],
            charts: vec![Chart::new(Vec3::ZERO); stages],
            rates: vec![Vec3::ZERO; stages],
            torque: vec![0.0; 3 * no * width],
            nodes: (model.dimensions.constraints > 0).then(|| {
                Box::new(Nodes {
                    start_skew: tableau.reach_from_middle[..count].to_vec(),
                    skew: (0..width / N)
                        .flat_map(|g| (0..count).map(move |k| (g, k)))
                        .map(|(g, k)| LanesOf(array::from_fn(|lane| from_middle(g * N + lane, k))))
                        .collect(),
                    start_charts: vec![Chart::new(Vec3::ZERO); no],
                    charts: vec![Chart::new(Vec3::ZERO); stages],
                    orientations: vec![Mat3::IDENTITY; stages],
                    torque: vec![Vec3::ZERO; no],
                })
            }),
            coordinates,
        }
    }

    /// Starts at a state: `increment` has `h b_i ω_i`, and gets the `Y_i` that belong to them.
    pub(super) fn begin(&mut self, state: &PreciseState, increment: &mut [f64]) {
        let orientations = &state.orientations[..];
        let (matrices, sides) = (&mut self.start[..], &mut self.start_beside);
        beside(orientations.len(), ToMatrices { orientations, matrices, beside: sides });
        let (width, groups) = (self.width, self.groups());
        for &c in &self.coordinates {
            let mut turned = [Vec3::ZERO; 2];
            for (g, turned) in turned.iter_mut().enumerate().take(groups) {
                *turned = load(increment, c, width, g * N);
            }
            for _ in 0..ROUNDS {
                let offset = [0, 1]
                    .map(|g| if g < groups { self.offset(increment, c, g) } else { Vec3::ZERO });
                for g in 0..groups {
                    let own = Chart::new(offset[g]).inverse_dexp().apply(turned[g]);
                    store(increment, c, width, g * N, own);
                }
            }
        }
    }

    fn groups(&self) -> usize {
        self.width / N
    }

    /// `Σ_j σ_ij x_j` of `N` stages.
    #[inline(always)]
    fn offset(&self, numbers: &[f64], coordinate: usize, g: usize) -> Vec3<LanesOf<N>> {
        let (width, groups) = (self.width, self.groups());
        let mut sums = [LanesOf::ZERO; 3];
        for (a, sum) in sums.iter_mut().enumerate() {
            let numbers = &numbers[(coordinate + a) * width..][..self.count];
            for (column, x) in self.skew.chunks_exact(groups).zip(numbers) {
                *sum += column[g] * *x;
            }
        }
        Vec3(sums)
    }

    /// Orientations of `N` stages.
    #[inline(always)]
    pub(super) fn orientations(&self, g: usize) -> &[Mat3<LanesOf<N>>] {
        let no = self.coordinates.len();
        &self.orientations[g * no..][..no]
    }

    /// Orientations at the start.
    pub(super) fn start(&self) -> &[Mat3] {
        &self.start
    }

    /// Orientations half-way.
    pub(super) fn centers(&self) -> &[Mat3] {
        &self.centers
    }

    /// Moves to the start, where constraints act, too.
    pub(super) fn move_to_start(&mut self, increment: &[f64]) {
        let Some(nodes) = &mut self.nodes else { return };
        for (c, chart) in self.coordinates.iter().zip(&mut nodes.start_charts) {
            *chart = Chart::new(Vec3([0, 1, 2].map(|a| {
                let numbers = &increment[(c + a) * self.width..][..self.count];
                nodes.start_skew.iter().zip(numbers).map(|(s, y)| s * y).sum()
            })));
        }
    }

    /// Moves to `N` nodes of the constraints after the start, where the orientations are returned.
    pub(super) fn move_to_nodes(&mut self, increment: &[f64], g: usize) -> &[Mat3<LanesOf<N>>] {
        let (no, width, count) = (self.coordinates.len(), self.width, self.count);
        let Self { nodes: Some(nodes), coordinates, centers, .. } = self else { return &[] };
        let Nodes { skew, charts, orientations, .. } = &mut **nodes;
        let (charts, orientations) = (&mut charts[g * no..], &mut orientations[g * no..][..no]);
        in_registers!(LanesOf<N>, {
            let skew = &skew[g * count..][..count];
            for (o, (c, center)) in coordinates.iter().zip(centers).enumerate() {
                let mut offset = [LanesOf::ZERO; 3];
                for (a, sum) in offset.iter_mut().enumerate() {
                    for (skew, y) in skew.iter().zip(&increment[(c + a) * width..][..count]) {
                        *sum += *skew * *y;
                    }
                }
                let chart = Chart::new(Vec3(offset));
                orientations[o] = Mat3::lift(*center).times(&chart.exp());
                charts[o] = chart;
            }
            &*orientations
        })
    }

    /// Takes the impulses of constraints at the start, in the charts from now on.
    pub(super) fn take_start_pushes(&mut self, pushes: &mut [f64]) {
        let Some(nodes) = &mut self.nodes else { return };
        for ((&c, chart), torque) in
            self.coordinates.iter().zip(&nodes.start_charts).zip(&mut nodes.torque)
        {
            let push = three(pushes, c);
            *torque += chart.exp().apply(push);
            pushes[c..c + 3].copy_from_slice(&chart.dexp().apply_transposed(push).0);
        }
    }

    /// The same at `N` nodes.
    pub(super) fn take_pushes(&mut self, g: usize, pushes: &mut [LanesOf<N>]) {
        let Self { nodes: Some(nodes), coordinates, .. } = self else { return };
        let no = coordinates.len();
        in_registers!(LanesOf<N>, {
            let charts = &nodes.charts[g * no..][..no];
            for ((&c, chart), torque) in coordinates.iter().zip(charts).zip(&mut nodes.torque) {
                let push = three(pushes, c);
                let turned = chart.exp().apply(push);
                for (sum, all) in torque.0.iter_mut().zip(turned.0) {
                    *sum = all.0.into_iter().fold(*sum, |sum, x| sum + x);
                }
                pushes[c..c + 3].copy_from_slice(&chart.dexp().apply_transposed(push).0);
            }
        })
    }

    /// `η̃` of a joint at a node.
    pub(super) fn at_node(&self, o: usize, j: usize) -> Vec3 {
        let Some(nodes) = self.nodes.as_deref() else { return Vec3::ZERO };
        match j.checked_sub(1) {
            None => nodes.start_charts[o].vector(),
            Some(j) => lane(nodes.charts[j / N * self.coordinates.len() + o].vector(), j % N),
        }
    }

    /// Finds where the joints are half-way.
    pub(super) fn turn(&mut self, increment: &[f64]) {
        if let Some(nodes) = &mut self.nodes {
            nodes.torque.fill(Vec3::ZERO);
        }
        for (&c, turn) in self.coordinates.iter().zip(self.turn.as_chunks_mut::<3>().0) {
            for (a, turn) in turn.iter_mut().enumerate() {
                *turn = increment[(c + a) * self.width..][..self.count].iter().sum();
            }
        }
        let Self { places, turn, start_beside: start, turns, centers, .. } = self;
        let (coordinates, increment, middle) = (&places[..], &turn[..], &mut centers[..]);
        beside(places.len(), ToMidpoint { coordinates, increment, start, turns, middle });
    }

    /// Moves to `N` stages; writes `η` and `ω` in place of coordinates and velocities.
    pub(super) fn move_to(
        &mut self,
        increment: &[f64],
        rates: LanesOf<N>,
        g: usize,
        [q, velocity]: [&mut [LanesOf<N>]; 2],
    ) {
        in_registers!(LanesOf<N>, {
            let no = self.coordinates.len();
            for o in 0..no {
                let (c, at) = (self.coordinates[o], g * no + o);
                let offset = self.offset(increment, c, g);
                let rate = load(increment, c, self.width, g * N) * rates;
                let chart = Chart::new(offset);
                self.orientations[at] = Mat3::lift(self.centers[o]).times(&chart.exp());
                q[c..c + 3].copy_from_slice(&offset.0);
                velocity[c..c + 3].copy_from_slice(&chart.dexp().apply(rate).0);
                (self.charts[at], self.rates[at]) = (chart, rate);
            }
        })
    }

    /// Takes forces and momenta of `N` stages in the chart; returns what they are the sums of, at most.
    pub(super) fn take(
        &mut self,
        lengths: LanesOf<N>,
        g: usize,
        (force, l_v): (&[LanesOf<N>], &[LanesOf<N>]),
        [impulse, momentum]: [&mut [f64]; 2],
    ) {
        in_registers!(LanesOf<N>, {
            let (no, width, first) = (self.coordinates.len(), self.width, g * N);
            for o in 0..no {
                let (c, at) = (self.coordinates[o], g * no + o);
                let chart = &self.charts[at];
                let (torque, m) = (three(force, c) * lengths, three(l_v, c));
                let (d, w) = (chart.dexp(), chart.slope(self.rates[at]));
                let pushed = d.apply_transposed(torque) + w.apply_transposed(m) * lengths;
                store(impulse, c, width, first, pushed);
                store(momentum, c, width, first, d.apply_transposed(m));
                store(&mut self.torque, 3 * o, width, first, chart.exp().apply(torque));
            }
        })
    }

    /// Finds `T` and `Λ`.
    fn carry(&mut self, state: &PreciseState) {
        for (o, total) in self.total.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            for (a, total) in total.iter_mut().enumerate() {
                *total = self.torque[(3 * o + a) * self.width..][..self.count].iter().sum();
            }
            if let Some(nodes) = &self.nodes {
                *total = (Vec3(*total) + nodes.torque[o]).0;
            }
        }
        let Self { coordinates, places, turns, total, carried, .. } = self;
        let momenta = [&state.p[..], &state.p_low[..]];
        let task = CarryOn { coordinates, places, turns, momenta, total, carried };
        beside(places.len(), task);
    }

    /// Writes the residuals of ball joints.
    pub(super) fn find_residuals(
        &mut self,
        state: &PreciseState,
        [impulse, momentum]: [&[f64]; 2],
        residual: &mut [f64],
    ) {
        self.carry(state);
        in_registers!(LanesOf<N>, {
            for o in 0..self.coordinates.len() {
                let (c, carried) = (self.coordinates[o], three(&self.carried, 3 * o));
                for g in 0..self.groups() {
                    let first = g * N;
                    let own = self.offset(impulse, c, g) + Vec3::lift(carried)
                        - load(momentum, c, self.width, first);
                    for (a, own) in own.0.into_iter().enumerate() {
                        let residual = &mut residual[(c + a) * self.count..][..self.count];
                        own.store_some(&mut residual[first..]);
                    }
                }
            }
        })
    }

    /// From a right-hand side by `η` to one by turns of the body, or from its turn to the change of `η`.
    pub(super) fn change_axes(&self, x: &mut [LanesOf<N>], g: usize, back: bool) {
        in_registers!(LanesOf<N>, {
            let no = self.coordinates.len();
            for (&c, chart) in self.coordinates.iter().zip(&self.charts[g * no..][..no]) {
                let inverse = chart.inverse_dexp();
                let v = three(x, c);
                let v = if back { inverse.apply(v) } else { inverse.apply_transposed(v) };
                x[c..c + 3].copy_from_slice(&v.0);
            }
        })
    }

    /// Writes the impulses `p[k+1] − p` of ball joints.
    pub(super) fn finish(&self, impulse: &mut [f64]) {
        for (o, &c) in self.coordinates.iter().enumerate() {
            let [turn, total, carried] =
                [&self.turn, &self.total, &self.carried].map(|list| three(list, 3 * o));
            let change = total + carried.cross(turn);
            impulse[c..c + 3].copy_from_slice(&change.0);
        }
    }

    /// Places a workspace at a stage.
    pub(super) fn place(&self, workspace: &mut Workspace, stage: usize) {
        let no = self.coordinates.len();
        let at = stage / N * no;
        for (to, from) in workspace.mid.orientations.iter_mut().zip(&self.orientations[at..]) {
            *to = Mat3(from.0.map(|axis| lane(axis, stage % N)));
        }
    }

    /// `η` and `V` of a joint at a stage.
    pub(super) fn at(&self, o: usize, stage: usize, q: &[LanesOf<N>]) -> [Vec3; 2] {
        let at = stage / N * self.coordinates.len() + o;
        let one = stage % N;
        [lane(three(q, self.coordinates[o]), one), lane(self.rates[at], one)]
    }
}
